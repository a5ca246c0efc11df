"""Properties of the scripts that are cheap to test. Whether the scripts set up a bare machine is tested by running them
there.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from turns import common_setup, in_part, read_part

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ["scripts/setup", "scripts/demo", "scripts/test", "scripts/paper", "scripts/benchmarks", "scripts/gpu_check",
           ".ci/run"]  # fmt: skip


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_executable_and_valid(name: str) -> None:
    assert os.access(ROOT / name, os.X_OK)
    assert subprocess.run(["bash", "-n", ROOT / name], check=False).returncode == 0


@pytest.mark.parametrize(("script", "word"), [("setup", "--tset"), ("paper", "figure0")])
def test_unknown_words_are_refused(script: str, word: str) -> None:
    done = subprocess.run([ROOT / "scripts" / script, word], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.startswith(f"usage: scripts/{script}")) == (2, True)


def test_parts_have_each_test_once() -> None:
    items = [SimpleNamespace(path=file, name=n) for file, count in (("a", 7), ("b", 1), ("c", 2), ("d", 30), ("e", 1))
             for n in range(count)]  # fmt: skip
    for parts in (1, 2, 3, 8, 50):
        found = [in_part(items, part, parts) for part in range(1, parts + 1)]  # type: ignore[arg-type]
        assert sorted((each.path, each.name) for part in found for each in part) == sorted(
            (each.path, each.name) for each in items
        )
        if parts <= 8:
            assert max(map(len, found)) <= len(items) / parts + 3
    for wrong in ("3/2", "0/2", "2", "a/b"):
        with pytest.raises(ValueError):  # noqa: PT011  # by `int` or by the function
            read_part(wrong)


#: A substitute for Python that makes an environment of itself, and finds every package there.
PYTHON = """#!/usr/bin/env bash
case "$*" in
*"-m venv"*) mkdir -p "${@: -1}/bin" && cp "$0" "${@: -1}/bin/python" ;;
*llvm.require*) echo "$0" ;;
esac
"""


def set_up(folder: Path, python: Path, *options: str, **environment: str) -> str:
    """Run a checkout's `scripts/setup` with a fake Python, and return the output."""
    command = [folder / "scripts/setup", *options]
    environment = os.environ | {"RESLRB_PYTHON": str(python)} | environment
    done = subprocess.run(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
    )
    return done.stdout


def make_checkout(folder: Path) -> None:
    """Make a folder with the files that `scripts/setup` reads."""
    (folder / "scripts").mkdir(parents=True)
    shutil.copy(ROOT / "scripts/setup", folder / "scripts/setup")
    shutil.copy(ROOT / "pyproject.toml", folder / "pyproject.toml")


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """The fake Python."""
    return make_program(tmp_path / "python", PYTHON)


def make_program(path: Path, text: str) -> Path:
    """Write an executable script."""
    path.unlink(missing_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


def test_a_copied_folder_gets_its_own_environment(tmp_path: Path, python: Path) -> None:
    """With the copied environment, the scripts in the copy would run the original folder."""
    first, second = tmp_path / "a checkout", tmp_path / "a checkout 2"
    make_checkout(first)
    assert set_up(first, python).endswith("setup: done\n")
    (first / ".venv/bin/reslrb").write_text(f"#!{first}/.venv/bin/python")
    assert set_up(first, python) == ""
    shutil.copytree(first, second)
    assert f"removing an environment that was made for {first}\n" in set_up(second, python)
    assert not (second / ".venv/bin/reslrb").exists()
    assert (second / ".venv/bin/python").exists()
    assert set_up(second, python) == ""
    assert (first / ".venv/bin/reslrb").exists()
    assert set_up(first, python) == ""
    # The requirements changed, so setup installs into the existing environment.
    (first / "pyproject.toml").write_text("")
    assert "removing" not in set_up(first, python)
    assert (first / ".venv/bin/reslrb").exists()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with `scripts/test`, and with fake programs that it starts."""
    for folder in ("scripts", ".venv/bin"):
        (tmp_path / folder).mkdir(parents=True)
    shutil.copy(ROOT / "scripts/test", tmp_path / "scripts/test")
    make_program(tmp_path / "scripts/setup", "#!/bin/sh\n")
    return tmp_path


@pytest.mark.parametrize("broken", ["none", "ruff check", "ruff format", "mypy", "pytest -n"])
def test_the_suite_fails_with_each_of_its_checks(checkout: Path, broken: str) -> None:
    text = f"""#!/bin/sh\necho "out: $2 $3"; case "$2 $3" in "{broken}"*) echo bad >&2; exit 3 ;; esac\n"""
    make_program(checkout / ".venv/bin/python", text)
    done = subprocess.run(checkout / "scripts/test", stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == (broken != "none")
    assert re.findall(r"^out: (.*\w)", done.stdout, re.M) == ["ruff check", "ruff format", "pytest -n", "mypy"]
    assert re.findall("^bad|^failed: .*", done.stdout, re.M) == (
        [] if broken == "none" else ["bad", f"failed: {broken}"]
    )


def test_an_interrupted_suite_leaves_no_process(checkout: Path) -> None:
    text = """#!/bin/sh
    case "$2" in
    mypy) echo $$ >mypy; exec sleep 60 ;;
    pytest) trap 'exit 2' INT; while [ ! -s mypy ]; do sleep 0.01; done
        echo ready; for i in 1 2 3 4 5 6 7 8 9; do sleep 0.5; done ;;  # the signal may come between two commands
    esac
    """
    make_program(checkout / ".venv/bin/python", text.replace("\n    ", "\n"))
    suite = subprocess.Popen(checkout / "scripts/test", stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert suite.stdout is not None
    assert "ready\n" in suite.stdout
    os.killpg(suite.pid, signal.SIGINT)
    assert suite.wait(5) == 130
    mypy = Path("/proc", (checkout / "mypy").read_text().strip(), "cmdline")
    end = time.monotonic() + 5
    while mypy.exists() and mypy.read_bytes() and time.monotonic() < end:  # a zombie has no command
        time.sleep(0.01)
    assert not mypy.exists() or not mypy.read_bytes()


def test_without_chromium_the_tests_say_so_in_one_line(
    monkeypatch: pytest.MonkeyPatch, pytestconfig: pytest.Config
) -> None:
    common = common_setup(pytestconfig)
    monkeypatch.setattr(common, "find_chromium", lambda: None)
    said, left_out = [], []
    hook = SimpleNamespace(pytest_deselected=lambda items: left_out.extend(items))
    items = [SimpleNamespace(fixturenames=names, path=Path("a")) for names in (("chromium", "pages"), ())]
    common.pytest_collection_modifyitems(SimpleNamespace(hook=hook, getoption=lambda name: (1, 1)), items)
    assert (len(items), len(left_out)) == (1, 1)
    common.pytest_terminal_summary(SimpleNamespace(write_line=said.append))
    assert [line.partition(":")[0] for line in said] == ["no Chromium"]


STAMP = ROOT / ".venv/.setup-test"


@pytest.mark.skipif(  # setup would replace a foreign environment
    Path(sys.prefix) != ROOT / ".venv" or not STAMP.is_file() or not STAMP.read_text().startswith(f"{ROOT} "),
    reason="runs in the environment that scripts/setup made",
)
def test_a_second_setup_changes_nothing() -> None:
    start = time.perf_counter()
    done = subprocess.run([ROOT / "scripts/setup", "--test"], capture_output=True, text=True, check=True)
    assert time.perf_counter() - start < 3
    assert done.stdout == ""


# The commands of `scripts/gpu_check` run on a CPU at the smallest sizes. All files and tests that it names exist.

NAMES = ["doctor", "bench", "gradcheck", "gradcheck_moving", "demo", "conformance"]


def gpu_check(*words: object, python: object = sys.executable) -> subprocess.CompletedProcess[str]:
    """Run `scripts/gpu_check` on the CPU."""
    command = [ROOT / "scripts/gpu_check", "--variant", "llvm_ad_rgb", *words]
    environment = os.environ | {"PYTHON": str(python)}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


@pytest.mark.long  # takes as long as twenty other tests, and its commands have their own tests
def test_its_commands_run_at_the_smallest_sizes(tmp_path: Path, llvm: str) -> None:
    done = gpu_check("--small", "-o", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    said = (tmp_path / "summary.md").read_text()
    assert re.findall(r"^### (\w+): exit code 0 after", said, re.MULTILINE) == NAMES
    assert re.match(r"Commit \w{12}(-dirty)?, llvm_ad_rgb, ", said)
    assert len(re.findall(r"^(\d+) of \1 comparisons hold", said, re.MULTILINE)) == 2
    assert "1 passed" in said
    for record in ("bench.jsonl", "gradcheck.jsonl", "gradcheck_moving.jsonl", "demo/metrics.jsonl"):
        assert (tmp_path / record).stat().st_size > 0


@pytest.mark.parametrize("small", [[], ["--small"]])
def test_all_named_commands_exist(small: list[str]) -> None:
    listed = [line.split("\t") for line in gpu_check("--list", *small).stdout.splitlines()]
    assert [name for name, _, _ in listed] == NAMES
    assert all(0 < int(limit) <= 3600 for _, limit, _ in listed)
    words = [word for _, _, command in listed for word in shlex.split(command)]
    named = [word for word in words if word.startswith(("configs/", "tests/"))]
    assert len(named) == 4
    for file, _, test in (word.partition("::") for word in named):
        assert (ROOT / file).exists(), file
        assert not test or f"def {test}(" in (ROOT / file).read_text(), test


def test_a_failing_command_is_named_and_the_others_run(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$@"\ncase "$*" in *bench*) exit 3 ;; *optimize*) exit 124 ;; esac\n')
    python.chmod(0o755)
    (tmp_path / "out").mkdir()
    done = gpu_check("-o", tmp_path / "out", python=python)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines[:-1]] == NAMES
    assert lines[1].startswith("bench: exit code 3 after")
    assert lines[4] == "demo: stopped at its limit of 900 s"
    assert "--max-depth 128" in (tmp_path / "out" / "bench.out").read_text()
    assert gpu_check("-o", tmp_path / "out", "doctor", "conformance", python=python).returncode == 0
    assert gpu_check("docter").returncode == 2


def test_a_named_variant_is_tested_or_fails(monkeypatch: pytest.MonkeyPatch, pytestconfig: pytest.Config) -> None:
    """A requested variant that is not available fails the test run. Skipped tests would look like tests that pass on a
    GPU.
    """
    monkeypatch.setenv("RESLRB_TEST_VARIANT", "cuda_ad_rgb")
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent.so")
    with pytest.raises(pytest.fail.Exception, match="no NVIDIA driver"):
        common_setup(pytestconfig).tested_variant()
