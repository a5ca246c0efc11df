"""The choice of libLLVM and of the variant, and memory that belongs to Dr.Jit."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import ROOT, reslrb
from compilation import search_path
from conformance.operations import even_table

from reslrb_cli.backend import doctor, llvm, variant
from reslrb_cli.backend.memory import own_memory
from reslrb_cli.backend.shared_library import missing_library
from reslrb_cli.backend.variant import probe
from reslrb_cli.cli import doctor as doctor_command
from reslrb_cli.errors import BackendError, ExitCode
from reslrb_cli.guiding.tables import make_grid
from reslrb_cli.optimization.views import to_tensor
from reslrb_cli.records.tree import like

# The choice of libLLVM: which of several libraries is used, which are refused, and what the user is told.

Machine = Callable[..., list[Path]]


@pytest.fixture
def _forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make each test search again, without the choice under which the tests themselves run."""
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    for cached in (llvm.choose, llvm._examine):
        cached.cache_clear()
    yield
    for cached in (llvm.choose, llvm._examine):
        cached.cache_clear()


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    """`machine({"libLLVM-15.so.1": "loads"})` makes a machine that has only these libraries.

    The text of each library gives the result of its trial. The trial prints this text as a version, or exits with this
    text as a message of the dynamic loader.
    """
    trial = tmp_path / "forecast.py"
    trial.write_text(
        "import sys\ntext = open(sys.argv[1]).read()\n"
        "sys.exit(text) if ' ' in text else print(text)\n"
        "if text == 'abort': __import__('os').abort()\n"
    )

    def make(libraries: dict[str, str]) -> list[Path]:
        paths = []
        for name, behaviour in libraries.items():
            path = tmp_path / "lib" / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(behaviour)
            paths.append(path)
        monkeypatch.setattr(llvm, "_folders", lambda: iter([tmp_path / "lib"]))
        monkeypatch.setattr(llvm.shared_library, "__file__", str(trial))
        return paths

    return make


@pytest.mark.usefixtures("_forget")
@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-15.so.1", 15),
        ("libLLVM.so.19.1", 19),
        ("libLLVM.21.1.dylib", 21),
        ("libLLVM.so", None),
        ("libLLVMSPIRVLib.so.19.1", None),
        ("libLLVM-19.a", None),
    ],
)
def test_version_from_name(name: str, version: int | None) -> None:
    assert llvm.version_from_name(Path("/lib") / name) == version


@pytest.mark.usefixtures("_forget")
def test_the_newest_working_version_is_chosen(machine: Machine) -> None:
    machine(
        {
            "libLLVM-14.so.1": "must-not-be-tried",
            "libLLVM.so.19.1": "19.1.7",
            "libLLVM.so.20.1": "20.1.2",
            "libLLVM.so.22.1": "libz3.so.4: cannot open shared object file: No such file or directory",
            "libLLVM.so.23.1": "abort",
        }
    )
    library, passed_over = llvm.choose()
    assert library is not None
    assert (library.path.name, library.version) == ("libLLVM.so.20.1", "20.1.2")
    reasons = {other.path.name: other.fault for other in passed_over}
    assert reasons["libLLVM.so.22.1"] == "it needs libz3.so.4, which is missing"
    assert "ended a process" in reasons["libLLVM.so.23.1"]


@pytest.mark.usefixtures("_forget")
def test_a_file_without_a_version_in_its_name_is_tried(machine: Machine) -> None:
    machine({"libLLVM.so": "21.1.0", "libLLVM.so.20.1": "20.1.2"})
    assert llvm.require().version == "21.1.0"


@pytest.mark.usefixtures("_forget")
@pytest.mark.parametrize("name", ["libLLVM-14.so.1", "libLLVM-18.so.1"])
def test_old_versions_are_refused(machine: Machine, name: str) -> None:
    machine({name: "must-not-be-tried"})
    with pytest.raises(BackendError, match=f"{name}: version 1[4-8] is too old") as refused:
        llvm.require()
    assert refused.value.exit_code is ExitCode.BACKEND


@pytest.mark.usefixtures("_forget")
@pytest.mark.parametrize("said", ["unknown", "16.0.6"])
def test_an_old_version_with_a_plain_name_is_refused(machine: Machine, said: str) -> None:
    machine({"libLLVM.so": said})
    with pytest.raises(BackendError, match="is too old"):
        llvm.require()


@pytest.mark.usefixtures("_forget")
def test_without_a_library_the_installation_is_explained(machine: Machine) -> None:
    machine({})
    with pytest.raises(BackendError, match=r"none found\); install"):
        llvm.require()


@pytest.mark.usefixtures("_forget")
@pytest.mark.parametrize(
    ("name", "behaviour", "reason"),
    [
        ("libLLVM-15.so.1", "15.0.6", "version 15 is too old"),
        ("libLLVM.so", "unknown", "version before 16 is too old"),
        ("other.so", "libedit.so.2: cannot open shared object file: No such file", "it needs libedit.so.2"),
    ],
)
def test_an_old_version_chosen_by_the_user_is_refused_too(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, name: str, behaviour: str, reason: str
) -> None:
    good, named = machine({"libLLVM.so.19.1": "19.1.7", name: behaviour})
    monkeypatch.setenv(llvm.VARIABLE, str(named))
    with pytest.raises(BackendError, match=f"{llvm.VARIABLE}=.*{reason}"):
        llvm.require()
    monkeypatch.setenv(llvm.VARIABLE, str(good))
    assert llvm.require().path == good


@pytest.mark.usefixtures("_forget")
def test_prepare_passes_the_choice_to_dr_jit_and_keeps_that_of_the_user(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path,) = machine({"libLLVM.so.19.1": "19.1.7"})
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    for given, used in (("", str(path)), ("/somewhere/libLLVM.so", "/somewhere/libLLVM.so")):
        monkeypatch.setenv(llvm.VARIABLE, given)
        llvm.prepare()
        assert os.environ[llvm.VARIABLE] == used


@pytest.mark.usefixtures("_forget")
@pytest.mark.parametrize(
    ("message", "library"),
    [
        ("libz3.so.4: cannot open shared object file: No such file or directory", "libz3.so.4"),
        (
            "raise ImportError('libz3.so.4: cannot open shared object file')\nlibm.so.6: cannot open shared object",
            "libm.so.6",
        ),
        ("dlopen(...): Library not loaded: @rpath/libz3.4.dylib\n  Referenced from: ...", "libz3.4.dylib"),
        ("/nope/libLLVM.so: cannot open shared object file: No such file or directory", None),
    ],
)
def test_missing_library(message: str, library: str | None) -> None:
    assert missing_library(message) == library


@pytest.mark.usefixtures("_forget")
@pytest.mark.skipif(shutil.which("cc") is None or sys.platform != "linux", reason="needs a C compiler")
def test_a_library_finds_its_dependencies_beside_it(tmp_path: Path) -> None:
    (tmp_path / "a.c").write_text("int one(void) { return 1; }")
    (tmp_path / "b.c").write_text("int one(void); int two(void) { return one() + 1; }")
    build = ["cc", "-shared", "-fPIC", "-o"]
    subprocess.run([*build, "libneed.so.1.2", "-Wl,-soname,libneed.so.1", "a.c"], cwd=tmp_path, check=True)
    subprocess.run([*build, "libuser.so", "b.c", "./libneed.so.1.2"], cwd=tmp_path, check=True)
    script = (
        "import sys; from pathlib import Path; from reslrb_cli.backend import shared_library\n"
        "print(shared_library.load(Path(sys.argv[1])).two())"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "libuser.so")]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == "2"
    (tmp_path / "libneed.so.1.2").unlink()
    assert "libneed.so.1" in subprocess.run(command, capture_output=True, text=True, check=False).stderr


@pytest.mark.usefixtures("_forget")
def test_the_command_line_exits_with_3(tmp_path: Path) -> None:
    name = "libLLVM-15.so.1"
    (tmp_path / name).write_bytes(b"")
    script = "from reslrb_cli.cli import main; main(prog_name='reslrb')"
    env = {**os.environ, llvm.VARIABLE: str(tmp_path / name), "DRJIT_LIBCUDA_PATH": "/nonexistent"}
    done = subprocess.run(
        [sys.executable, "-c", script, "doctor"], capture_output=True, text=True, env=env, check=False
    )
    assert done.returncode == ExitCode.BACKEND
    assert "is too old" in done.stdout
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


# The choice of the variant: CUDA if it can trace a ray, otherwise LLVM, and a reason if neither works.


def test_auto_uses_cuda_if_it_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant, "missing_cuda", lambda _name: "")
    assert variant.choose("auto") == ("cuda_ad_rgb", "")
    monkeypatch.setattr(variant, "missing_cuda", lambda _name: "no OptiX")
    assert variant.choose("auto") == ("llvm_ad_rgb", "; no CUDA: no OptiX")


def test_a_driver_alone_is_not_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant.ctypes, "CDLL", lambda _name: None)
    monkeypatch.setattr(variant, "probe", lambda _name: "jit_optix_api_init(): could not be loaded")
    assert "optix" in variant.missing_cuda()


def test_cuda_without_a_driver_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    with pytest.raises(BackendError, match="no NVIDIA driver") as refused:
        variant.set_variant("cuda_ad_rgb")
    assert refused.value.exit_code is ExitCode.BACKEND


def test_a_hanging_driver_counts_as_no_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 'A GPU, 1.2'\n[ -e hangs ] && exec sleep 30\n:\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.chdir(tmp_path)
    assert doctor.ask_gpu("name,driver_version") == ["A GPU, 1.2"]
    (tmp_path / "hangs").touch()
    monkeypatch.setattr(doctor, "PATIENCE", 0.2)
    start = time.monotonic()
    assert doctor.ask_gpu("name,driver_version") == []
    assert time.monotonic() - start < 10


@pytest.mark.parametrize(
    ("own", "limits", "expected"),
    [
        ("0::/", {"memory.max": (900, 100)}, (900, 800)),
        ("0::/slurm/job/step", {"slurm/job/memory.max": (500, 100)}, (500, 400)),
        ("0::/a/b", {"memory.max": (900, 800), "a/memory.max": (300, 50), "a/b/memory.max": (600, 10)}, (300, 100)),
        ("0::/a/b", {"a/memory.max": ("max", 50)}, None),
        ("0::/host/only", {"memory.max": (700, 0)}, (700, 700)),  # in a container
        ("0::/a", {"c/memory.max": (10, 0)}, None),
        ("5:cpu,memory:/a/b\n4:pids:/a", {"memory/a/memory.limit_in_bytes": (400, 1)}, (400, 399)),
        ("", {}, None),
    ],
)
def test_limits_of_nested_control_groups_count(
    own: str, limits: dict[str, tuple[int | str, int]], expected: tuple[int, int] | None, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    before = doctor.memory_bytes("llvm_ad_rgb")
    monkeypatch.setattr(doctor, "GROUPS", tmp_path)
    monkeypatch.setattr(doctor, "OWN_GROUPS", tmp_path / "own")
    (tmp_path / "own").write_text(own)
    for name, (limit, used) in limits.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"{limit}\n")
        other = "memory.usage_in_bytes" if "limit_in" in name else "memory.current"
        (tmp_path / name).with_name(other).write_text(f"{used}\n")
    if expected is None:
        assert doctor.memory_bytes("llvm_ad_rgb") >= before
    else:
        assert (doctor.memory_bytes("llvm_ad_rgb"), doctor.free_bytes("llvm_ad_rgb")) == expected


def test_set_variant_logs_its_choice(llvm: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        assert variant.set_variant("llvm_ad_rgb") == "llvm_ad_rgb"
    assert "variant llvm_ad_rgb (libLLVM " in caplog.text


def test_the_trial_compiles_and_traces(llvm: str) -> None:
    assert probe("llvm_ad_rgb") == ""


@pytest.mark.parametrize(
    ("script", "failure"),
    [
        ("raise RuntimeError('no such device')", "RuntimeError: no such device"),
        ("import os, sys; print('LLVM ERROR: x', file=sys.stderr, flush=True); os.abort()", "signal 6: LLVM ERROR: x"),
        ("raise ImportError('libatomic.so.1: cannot open shared object file: ...')", "needs libatomic.so.1"),
        ("raise SystemExit(3)", "ended with code 3"),
    ],
)
def test_a_failed_trial_is_one_line(monkeypatch: pytest.MonkeyPatch, script: str, failure: str) -> None:
    monkeypatch.setattr(variant, "_SCRIPT", script)
    assert failure in probe.__wrapped__("llvm_ad_rgb")


def test_an_old_libllvm_chosen_by_dr_jit_is_refused(llvm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import drjit as dr

    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 6))
    with pytest.raises(BackendError, match="loaded libLLVM 15"):
        variant.set_variant("llvm_ad_rgb")


def test_an_old_libllvm_is_told_at_import_and_refused_before_it_aborts(
    llvm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import drjit as dr

    import reslrb_cli as rl
    from reslrb_cli.backend import llvm as choice

    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 6))
    advice = "loaded libLLVM 15, which can end the process; import reslrb_cli before mitsuba and drjit, or set "
    with pytest.warns(UserWarning, match=advice):
        choice.prepare()
    variant.check_variant.cache_clear()
    for call in (rl.register, lambda: rl.load_scene("scene.xml")):
        with pytest.raises(BackendError, match=advice):
            call()
    monkeypatch.setattr("mitsuba.variant", lambda: "cuda_ad_rgb")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        choice.prepare()


def test_an_unknown_variant_is_refused(llvm: str) -> None:
    with pytest.raises(BackendError, match="has no variant llvm_ad_taste"):
        variant.set_variant("llvm_ad_taste")


# Values from NumPy lie in Dr.Jit's own memory, so that kernels and recordings fit all later values.

ALIGNMENT = 64  # bytes, as in Dr.Jit's own memory


def address(array):
    """Return the memory address of a Dr.Jit array."""
    return np.array(array, copy=False).ctypes.data


def lying_at(offset, values):
    """Return a NumPy array that begins `offset` bytes after a multiple of ALIGNMENT."""
    values = np.asarray(values)
    room = np.empty(values.nbytes + 2 * ALIGNMENT, np.uint8)
    begin = -room.ctypes.data % ALIGNMENT + offset
    array = room[begin : begin + values.nbytes].view(values.dtype)
    array[:] = values
    return array


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("offset", [0, 4])
@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("Float", np.float32([-0.0, np.nan, np.inf, 1e-45, 3.0])),
        ("UInt32", np.uint32([0, 1, 2**32 - 1])),
    ],
)
def test_bits_are_kept_outside_the_memory_of_numpy(kind, values, offset):
    given = lying_at(offset, values)
    copy = own_memory(getattr(mi, kind), given)
    assert address(copy) % ALIGNMENT == 0
    assert address(copy) != given.ctypes.data
    given[:] = 5  # a copy with shared memory would change
    assert np.array(copy).tobytes() == values.tobytes()


@pytest.mark.usefixtures("llvm")
def test_restored_arrays_are_copied():
    image = lying_at(16, np.arange(12, dtype=np.float32)).reshape(2, 2, 3)
    assert address(to_tensor(image).array) % ALIGNMENT == 0
    value = dr.ones(mi.TensorXf, (2, 2, 3))
    assert address(like(value, image).array) % ALIGNMENT == 0
    for _ in range(8):  # NumPy's memory has another address every time
        table = even_table(make_grid([True] * 4, [1.0, 2.0], 14))
        assert [address(part) % ALIGNMENT for part in (table.slots, table.weights, table.edges)] == [0, 0, 0]


#: Mitsuba needs two threads to read and write EXR files.
ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from reslrb_cli.backend.variant import set_variant
set_variant("llvm_ad_rgb")
import mitsuba as mi, numpy as np
file = sys.argv[1] + "/image.exr"
mi.Bitmap(np.ones((8, 8, 3), np.float32)).write(file)
print(np.array(mi.Bitmap(file)).sum())
"""


@pytest.mark.usefixtures("llvm")
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs to choose the cores of a process")
def test_a_machine_of_one_core_reads_and_writes_images(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ONE_CORE, str(tmp_path)], capture_output=True, text=True, check=False, timeout=60,
        env={"PYTHONPATH": search_path(ROOT), "HOME": str(tmp_path)},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "192.0\n"), done.stderr


# `reslrb doctor`.


@pytest.mark.parametrize(
    ("missing", "packages", "lines", "code"),
    [
        (("", "no CUDA"), {"drjit": "1"}, ["variant auto is a", "a works on CPU", "lib", "b not usable: no CUDA"], 0),
        (("too old", ""), {"drjit": "1"}, ["variant auto is b", "a not usable: too old", "b works on GPU"], 0),
        (("too old", "no CUDA"), {"drjit": "1"}, ["variant none works", "a not usable: too old"], ExitCode.BACKEND),
        (("", ""), {"reslrb": None, "drjit": "1"}, ["reslrb not installed"], 0),
        (("", ""), {"reslrb": None, "drjit": None}, ["drjit not installed"], ExitCode.BACKEND),
    ],
)
def test_doctor_names_what_works_and_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, missing: tuple[str, str], packages: dict[str, str | None], lines: list[str],
    code: int,
) -> None:  # fmt: skip
    devices = (("a", "CPU", "lib"), ("b", "GPU", ""))
    found = [
        SimpleNamespace(variant=name, device=device, library=library, missing=fault)
        for (name, device, library), fault in zip(devices, missing, strict=True)
    ]
    monkeypatch.setattr(doctor_command, "backends", lambda: found)
    monkeypatch.setattr(doctor_command, "packages", lambda: packages)
    result = reslrb("doctor")
    said = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert (set(lines) <= set(said), "lib" in said, result.exit_code) == (True, not missing[0], code)
    assert ("pip install drjit" in result.output) is (packages["drjit"] is None)
