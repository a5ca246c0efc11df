"""The scripts' cheap properties; that they set up a bare machine is tried by running them on one."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ["scripts/setup", "scripts/demo", "scripts/test", ".ci/run"]


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_can_be_run_and_parsed(name: str) -> None:
    assert os.access(ROOT / name, os.X_OK)
    assert subprocess.run(["bash", "-n", ROOT / name], check=False).returncode == 0


def test_setup_refuses_an_unknown_option() -> None:
    done = subprocess.run([ROOT / "scripts/setup", "--tset"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: scripts/setup")


@pytest.mark.skipif(Path(sys.prefix) != ROOT / ".venv", reason="runs in the environment that scripts/setup made")
def test_a_second_setup_does_nothing() -> None:
    start = time.perf_counter()
    done = subprocess.run([ROOT / "scripts/setup", "--test"], capture_output=True, text=True, check=True)
    assert time.perf_counter() - start < 3
    assert done.stdout == ""
