"""Measurements whose process is killed: what was measured until then stands in their files, and is gone on from."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cli.tiny import ROOT, write_experiment
from compilation import search_path

pytestmark = [
    pytest.mark.usefixtures("llvm"),
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="sends SIGKILL"),
]
BENCH = ["bench", "tiny.yaml", "--integrators", "reslrb:stack", "--max-depth", "2"]
CONVERGENCE = ["convergence", "tiny.yaml", "--integrators", "reslrb:stack"]


def start(folder: Path, *args: str) -> subprocess.Popen[str]:
    script = "import sys; sys.argv[0] = 'reslrb'; from reslrb_cli.cli import run; run()"
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", script, *args],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def repeats(file: Path) -> set[int]:
    return {
        entry["repeats"] for entry in map(json.loads, file.read_text().splitlines()) if entry.get("status") is not None
    }


@pytest.mark.parametrize(
    ("command", "steps"),
    [(BENCH, 1), pytest.param(CONVERGENCE, 2, marks=pytest.mark.long)],
    ids=["bench", "convergence"],
)
def test_a_killed_measurement_is_gone_on_from(tmp_path: Path, command: list[str], steps: int) -> None:
    """It is killed as soon as its first rounds are on the disk; of some thousands only a few are taken then."""
    write_experiment(tmp_path)
    file, kept = tmp_path / "c.jsonl", tmp_path / "c.samples.npz"
    process = start(tmp_path, *command, "--rounds", "1000000", "--json", file.name)
    end = time.monotonic() + 60
    while not (file.exists() and kept.exists()) and time.monotonic() < end:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    text = file.read_text()
    assert text.endswith("}\n")
    assert all(json.loads(line) for line in text.splitlines())
    # The next writing is seconds away, so that it is one round that stands there.
    process = start(tmp_path, *command, "--rounds", "4", "--resume", file.name)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, out + err
    assert repeats(file) == {4 * steps}
    assert {path.name for path in tmp_path.iterdir()} >= {"c.png"}
    assert not list(tmp_path.glob(".c.*"))
