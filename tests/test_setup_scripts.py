"""The scripts' cheap properties; that they set up a bare machine is tried by running them on one."""

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
def test_scripts_can_be_run_and_parsed(name: str) -> None:
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


#: Stands in for Python: makes an environment of itself, and finds everything there.
PYTHON = """#!/usr/bin/env bash
case "$*" in
*"-m venv"*) mkdir -p "${@: -1}/bin" && cp "$0" "${@: -1}/bin/python" ;;
*llvm.require*) echo "$0" ;;
esac
"""


def set_up(folder: Path, python: Path) -> str:
    """Run a checkout's `scripts/setup` with a pretended Python; what it said."""
    environment = os.environ | {"RESLRB_PYTHON": str(python)}
    done = subprocess.run([folder / "scripts/setup"], env=environment, capture_output=True, text=True, check=True)
    return done.stdout


def test_a_copied_folder_gets_an_environment_of_its_own(tmp_path: Path) -> None:
    """Its scripts would otherwise run the folder that was copied."""
    python = tmp_path / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    first, second = tmp_path / "a checkout", tmp_path / "a checkout 2"
    (first / "scripts").mkdir(parents=True)
    shutil.copy(ROOT / "scripts/setup", first / "scripts/setup")
    shutil.copy(ROOT / "pyproject.toml", first / "pyproject.toml")
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
    # What is needed has changed: installed into the environment that is there.
    (first / "pyproject.toml").write_text("")
    assert "removing" not in set_up(first, python)
    assert (first / ".venv/bin/reslrb").exists()


@pytest.mark.skipif(
    Path(sys.prefix) != ROOT / ".venv" or (ROOT / ".venv").is_symlink(),  # of another folder's, it would make anew
    reason="runs in the environment that scripts/setup made",
)
def test_a_second_setup_does_nothing() -> None:
    start = time.perf_counter()
    done = subprocess.run([ROOT / "scripts/setup", "--test"], capture_output=True, text=True, check=True)
    assert time.perf_counter() - start < 3
    assert done.stdout == ""
