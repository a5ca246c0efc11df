"""Properties of the scripts that are cheap to test. Whether the scripts set up a bare machine is tested by running them
there.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ["scripts/setup", "scripts/demo", "scripts/test", "scripts/paper", "scripts/benchmarks", "scripts/gpu_check",
           ".ci/run"]  # fmt: skip


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_executable_and_valid(name: str) -> None:
    assert os.access(ROOT / name, os.X_OK)
    assert subprocess.run(["bash", "-n", ROOT / name], check=False).returncode == 0


def test_setup_refuses_an_unknown_option() -> None:
    done = subprocess.run([ROOT / "scripts/setup", "--tset"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: scripts/setup")


def test_paper_refuses_an_unknown_figure() -> None:
    done = subprocess.run([ROOT / "scripts/paper", "figure0"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: scripts/paper")


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


#: A Chromium that draws pages, and one that does not.
CHROMIUM, BROKEN = "#!/bin/sh\necho '<html></html>'\n", "#!/bin/sh\nexit 1\n"
#: A substitute for `apt-get` that installs Chromium, or puts its package into the working folder.
APT = """#!/bin/sh
echo "$@" >>'{log}'
case "$*" in
*update*) ;;
*{works}install*) cp '{chromium}' '{programs}/chromium-headless-shell' ;;
*{works}download*) touch chromium.deb ;;
*) exit 100 ;;
esac
"""
#: A substitute for `dpkg` that unpacks the package.
DPKG = """#!/bin/sh
mkdir -p "$3/usr/lib/chromium" && cp '{chromium}' "$3/usr/lib/chromium/chromium-headless-shell"
"""


@pytest.mark.parametrize("user", [0, 1000])
def test_the_setup_of_the_tests_installs_chromium_if_possible(tmp_path: Path, python: Path, user: int) -> None:
    checkout, programs, log = tmp_path / "checkout", tmp_path / "programs", tmp_path / "log"
    make_checkout(checkout)
    programs.mkdir()
    for folder in (Path("/bin"), Path("/usr/bin")):
        for file in folder.iterdir():
            if "chrom" not in file.name and not (programs / file.name).is_symlink():
                (programs / file.name).symlink_to(file)
    names = {"log": log, "programs": programs, "chromium": make_program(tmp_path / "chromium", CHROMIUM)}
    make_program(programs / "id", f"#!/bin/sh\necho {user}\n")
    make_program(programs / "apt-cache", "#!/bin/sh\n")
    make_program(programs / "dpkg-query", "#!/bin/sh\nexit 1\n")
    make_program(programs / "dpkg", DPKG.format(**names))
    make_program(programs / "apt-get", APT.format(works="nothing", **names))
    make_program(programs / "chromium", BROKEN)

    said = set_up(checkout, python, "--test", PATH=str(programs))
    assert "setup: Chromium: none can be had; tests that look at pages in a browser are left out\n" in said
    assert said.endswith("setup: done\n")

    (checkout / ".venv/.setup-test").unlink()
    make_program(programs / "apt-get", APT.format(works="", **names))
    said = set_up(checkout, python, "--test", PATH=str(programs))
    found = checkout / ".cache/bin/chromium" if user else programs / "chromium-headless-shell"
    assert f"setup: Chromium: {found}\n" in said
    assert subprocess.run([found], capture_output=True, text=True, check=True).stdout == "<html></html>\n"
    assert log.read_text().count("--yes --no-install-recommends chromium-headless-shell\n") == (0 if user else 2)

    (checkout / ".venv/.setup-test").unlink()
    said = set_up(checkout, python, "--test", PATH=str(programs))
    assert f"setup: Chromium: {found}\n" in said
    assert "setup: fetching" not in said
    assert "setup: installing chromium" not in said


def test_without_chromium_the_tests_say_so_in_one_line() -> None:
    script = (
        "import sys, pytest; sys.path.insert(0, 'tests'); from report import chromium; "
        "chromium.find_chromium = lambda: None; "
        "sys.exit(pytest.main(['--collect-only', '-q', '-p', 'no:cacheprovider', 'tests/report/test_page.py']))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.count("no Chromium: tests that look at pages in a browser are left out") == 1
    assert "::test_nothing_scrolls_sideways" not in done.stdout
    assert "::test_faults_come_first" in done.stdout


@pytest.mark.skipif(
    Path(sys.prefix) != ROOT / ".venv" or (ROOT / ".venv").is_symlink(),  # setup would replace a foreign environment
    reason="runs in the environment that scripts/setup made",
)
def test_a_second_setup_changes_nothing() -> None:
    start = time.perf_counter()
    done = subprocess.run([ROOT / "scripts/setup", "--test"], capture_output=True, text=True, check=True)
    assert time.perf_counter() - start < 3
    assert done.stdout == ""
