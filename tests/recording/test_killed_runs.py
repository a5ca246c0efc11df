"""Runs that are killed at random moments, and on disks that are too small, until they have come to their end."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cli import tiny
from cli.test_storms import mount
from compilation import search_path
from recording.going_on import differences, left_over, optimize, records_of, state_of, work_alone

from reslrb_cli.records.manifest import read_manifest

pytestmark = [
    pytest.mark.usefixtures("llvm"),
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="sends SIGKILL"),
]
#: The program, whose steps one thread computes.
SCRIPT = f"""import sys; sys.path[:0] = [{str(tiny.ROOT)!r}, {str(tiny.ROOT / "tests")!r}]; sys.argv[0] = 'reslrb'
import pytest, reslrb_cli
from recording.going_on import work_alone
work_alone(pytest.MonkeyPatch())
from reslrb_cli.cli import run; run()"""
#: A state after each iteration: a good part of the time goes into writing them.
SETS = ["--set", "run.checkpoint_every={iterations: 1}", "--set", "run.certainty=false", "--quiet"]


def start(folder: Path, *args: str, script: str = SCRIPT) -> subprocess.Popen[str]:
    environment = {**os.environ, "RESLRB_CACHE": str(folder / "cache"), "PYTHONPATH": search_path(tiny.ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", script, "optimize", *args],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, err = process.communicate(timeout=300)
    return process.returncode, err


def count(run: Path) -> int:
    """Lines of the metrics."""
    path = run / "metrics.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def kill_at_random(process: subprocess.Popen[str], run: Path, chance: random.Random) -> None:
    """In the midst of its iterations, for the most part; else whenever it may be."""
    if chance.random() < 0.2:
        time.sleep(chance.uniform(0, 4))
    else:
        before, limit = count(run), time.monotonic() + 60
        while count(run) <= before and process.poll() is None and time.monotonic() < limit:
            time.sleep(0.005)
        time.sleep(chance.uniform(0, 0.3))
    process.kill()
    process.communicate()


@pytest.mark.parametrize(
    ("kills", "iterations"), [(1, 30), pytest.param(50, 1200, marks=pytest.mark.long)], ids=["one", "fifty"]
)
def test_a_run_that_is_killed_again_and_again_ends_where_the_other_does(
    tmp_path: Path, kills: int, iterations: int
) -> None:
    tiny.write_experiment(tmp_path)
    length = ["--set", f"run.iterations={iterations}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        patch.setenv("RESLRB_CACHE", str(tmp_path / "cache"))
        work_alone(patch)
        assert optimize("tiny.yaml", *SETS, *length, "--set", "run.name=whole") == 0
    run, chance = tmp_path / "runs/tiny", random.Random(11)
    process = start(tmp_path, "tiny.yaml", *SETS, *length)
    lives, done = 1, 0
    while lives <= kills:
        kill_at_random(process, run, chance)
        if run.exists():
            manifest = read_manifest(run)
            assert manifest is not None
            assert manifest["status"] in ("interrupted", "finished")
            assert left_over(run) == []  # a reader has put it right
            if (run / "checkpoint/state.npz").exists():
                done = int(state_of(run)["iteration"])
                assert done <= count(run)
                process = start(tmp_path, "--resume", str(run), "--quiet")
            else:
                shutil.rmtree(run)
                process = start(tmp_path, "tiny.yaml", *SETS, *length)
        else:
            process = start(tmp_path, "tiny.yaml", *SETS, *length)
        lives += 1
    code, err = end(process)
    print(f"{lives} lives, {done} iterations before the last")
    assert (code, err) == (0, "")
    assert differences(tmp_path / "runs/whole", run) == []
    assert [record["iteration"] for record in records_of(run)] == list(range(iterations))
    assert read_manifest(run)["status"] == "finished"  # type: ignore[index]


SIZES = [8, 16, 32, 48, 64, 80, 96, 112, 128, 144, 160, 192, 256, 384, 512, 1024]


@pytest.mark.long
@pytest.mark.parametrize("kib", SIZES)
def test_a_run_whose_disk_was_full_goes_on_when_there_is_room(tmp_path: Path, disk: Path, kib: int) -> None:
    tiny.write_experiment(tmp_path)
    mount(disk, kib)
    output = ["--set", f"run.output={disk}/runs"]
    code, err = end(start(tmp_path, "tiny.yaml", *SETS, "--set", "run.iterations=20000", *output))
    run = disk / "runs/tiny"
    assert code == 6, err
    if not run.exists():
        return
    assert left_over(run) == []
    assert read_manifest(run)["status"] == "failed"  # type: ignore[index]
    subprocess.run(["mount", "-o", "remount,size=8m", disk], check=True)
    if not (run / "checkpoint/state.npz").exists():
        code, err = end(start(tmp_path, "--resume", str(run), "--quiet"))
        assert (code, err) == (2, f"{run}: has no checkpoint/state.npz: the run ended before it kept anything\n")
        return
    iterations = int(state_of(run)["iteration"]) + 12
    length = ["--set", f"run.iterations={iterations}"]
    assert end(start(tmp_path, "--resume", str(run), "--quiet", *length)) == (0, "")
    assert end(start(tmp_path, "tiny.yaml", *SETS, *length)) == (0, "")
    # What certainty asks for is noted at four fifths of the iterations, which were 20000 before.
    found = differences(tmp_path / "runs/tiny", run)
    assert [name for name in found if "squares/" not in name] == []


@pytest.mark.long
def test_with_several_threads_it_is_no_farther_off_than_runs_are_from_each_other(tmp_path: Path) -> None:
    """Twice the largest distance among five whole runs, as large as sums in another order make it."""
    tiny.write_experiment(tmp_path)
    script = "import sys; sys.argv[0] = 'reslrb'; from reslrb_cli.cli import run; run()"
    sets = [*SETS, "--set", "run.iterations=80", "--set", "run.spp=1024", "--set", "run.adjoint=batched"]
    for number in range(5):
        assert end(start(tmp_path, "tiny.yaml", *sets, "--set", f"run.name=whole-{number}", script=script))[0] == 0
    process = start(tmp_path, "tiny.yaml", *sets, script=script)
    run = tmp_path / "runs/tiny"
    for _ in range(3):
        before = count(run)
        while count(run) < before + 10 and process.poll() is None:
            time.sleep(0.005)
        process.kill()
        process.communicate()
        process = start(tmp_path, "--resume", str(run), "--quiet", script=script)
    assert end(process)[0] == 0
    values = [
        state_of(tmp_path / "runs" / name)[f"parameter/{tiny.KEY}"]
        for name in (*(f"whole-{number}" for number in range(5)), "tiny")
    ]
    *whole, resumed = [value.astype(np.float64) for value in values]
    farthest = max(float(np.abs(a - b).max()) for a in whole for b in whole)
    distance = min(float(np.abs(resumed - each).max()) for each in whole)
    print(f"distance {distance:.3g}, among whole runs {farthest:.3g}")
    assert distance <= 2 * farthest
