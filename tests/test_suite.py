"""The default suite leaves out optimisations of kernels and uses one thread. Neither changes any value."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import compilation
import pytest
from compilation import search_path

from reslrb_cli.backend import llvm as library
from reslrb_cli.backend import shared_library

# The optimisations that `compilation.py` leaves out change code, not values. They affect only the tests' own kernels.

ROOT = Path(__file__).resolve().parents[1]
#: Prints the bits of sums that rounding would change if a pass reassociated, fused or approximated.
SCRIPT = """
import sys
import reslrb_cli
if sys.argv[1] == "quick":
    from compilation import leave_out_optimisations
    assert leave_out_optimisations()
import drjit as dr
from drjit.llvm import Array3f, Float, UInt32
x = dr.linspace(Float, 0.1, 3.0, 1000)
table = dr.sin(x) * dr.exp(-x)
dr.eval(table)
v = dr.normalize(Array3f(x, dr.gather(Float, table, (UInt32(x * 331) * 7) % 1000), 1 / x))
i, y = dr.while_loop((UInt32(0), Float(x)), lambda i, y: i < 20, lambda i, y: (i + 1, y * v.y + dr.sqrt(v.x) - v.z / 3))
print(dr.reinterpret_array(UInt32, y * v.z + v.x * v.y).numpy().tobytes().hex())
"""


def compiled(way: str, home: Path) -> tuple[str, dict[str, bytes]]:
    """Return the output of the script, and the kernels that the script left on the disk, by name."""
    home.mkdir()
    folder = home / (".drjit" if way == "optimised" else compilation.CACHE.name)
    environment = {key: value for key, value in os.environ.items() if key != "DRJIT_CACHE_DIR"}
    first = compilation.STARTED if way == "inherited" else compilation.STARTED.parent
    environment |= {"HOME": str(home), "PYTHONPATH": os.pathsep.join([str(first), str(ROOT)])}
    if way == "inherited":
        environment["DRJIT_CACHE_DIR"] = str(folder)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, way], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout, {file.name: file.read_bytes() for file in folder.iterdir()}


def test_values_equal_those_of_optimised_kernels(tmp_path: Path, llvm: str) -> None:
    path = Path(os.environ.get(library.VARIABLE, ""))
    if not path.is_file() or not compilation.is_silent(shared_library.load(path)):
        pytest.skip("there is no libLLVM that leaves passes out in silence")
    values, optimised = compiled("optimised", tmp_path / "optimised")
    ours, quick = compiled("quick", tmp_path / "quick")
    assert ours == values
    # The same kernels, but with different code.
    assert set(quick) == set(optimised) != set()
    assert any(quick[name] != optimised[name] for name in quick)
    # A process that a test starts compiles the same way without being told.
    assert compiled("inherited", tmp_path / "inherited") == (values, quick)


def test_a_library_that_names_each_pass_is_left_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    class Library:
        def LLVMGetVersion(self, *parts: object) -> None:
            for part, number in zip(parts, (19, 1, 7), strict=True):
                part._obj.value = number

    monkeypatch.setenv(library.VARIABLE, __file__)
    monkeypatch.setattr(compilation.shared_library, "load", lambda path: Library())
    monkeypatch.delenv("DRJIT_CACHE_DIR", raising=False)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    assert not compilation.leave_out_optimisations()
    assert not {"DRJIT_CACHE_DIR", "PYTHONPATH"} & set(os.environ)


# Tests compute with one thread, and can still read and write files.

READS_AND_WRITES = """
import sys
from pathlib import Path
from reslrb_cli.backend.variant import set_variant
set_variant("llvm_ad_rgb")
from compilation import compute_alone
import drjit as dr, mitsuba as mi, numpy as np
from reslrb_cli.scene.load import load_scene
print(compute_alone(), dr.thread_count(), flush=True)
image = np.random.default_rng(1).uniform(size=(40, 30, 3)).astype(np.float32)
file = sys.argv[1] + "/image.exr"
mi.Bitmap(image).write(file)
assert (np.array(mi.Bitmap(file)) == image).all()
load_scene(Path(sys.argv[2]), {"resx": 16, "resy": 16})
dr.set_thread_count(2)
mi.Bitmap(image[:20]).write(file)
assert (np.array(mi.Bitmap(file)) == image[:20]).all()
"""


@pytest.mark.usefixtures("llvm")
def test_one_thread_reads_and_writes_images(tmp_path: Path) -> None:
    """A test with several threads also reads and writes images."""
    scene = ROOT / "scenes" / "grey_room" / "scene.xml"
    done = subprocess.run(
        [sys.executable, "-c", READS_AND_WRITES, str(tmp_path), str(scene)], capture_output=True, text=True,
        check=False, timeout=120, env={"PYTHONPATH": search_path(ROOT, ROOT / "tests"), "HOME": str(tmp_path)},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "True 1\n"), done.stderr


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


def test_tests_use_one_thread(llvm: str, pytestconfig: pytest.Config) -> None:
    import drjit as dr

    if os.environ.get("RESLRB_TEST_OPTIMISED") or "not long" not in pytestconfig.option.markexpr:
        pytest.skip("these tests run as users do")
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) == 1:
        pytest.skip("where there is one core, whatever sets a variant sets two threads")
    assert not llvm.startswith("llvm") or dr.thread_count() == 1
