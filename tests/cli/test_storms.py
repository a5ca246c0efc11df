"""Runs that are hit at random moments, and runs on disks that are too small: what is left is whole, and true.

A few of each by default; `-m long` has as many as it takes to hit every part of a run.
"""

from __future__ import annotations

import os
import random
import re
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from cli.tiny import COMPLETE, faults, files, start, write_experiment
from compilation import search_path

from reslrb_cli.cli.terminal import SIGNALS
from reslrb_cli.records.manifest import read_content, read_manifest

pytestmark = pytest.mark.usefixtures("llvm")
#: Moments of a run: it has printed this, or its folder holds that file.
MOMENTS = {"loading": "variant ", "the target": "rendering ", "the mask": "finding ", "iterations": "metrics.jsonl"}
LONG = ["--set", "run.iterations=20000"]


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    write_experiment(tmp_path)
    return tmp_path


def wait_for(process: subprocess.Popen[str], folder: Path, moment: str) -> str:
    """Wait until a run has come to `moment`; return what it printed on the way."""
    assert process.stderr is not None
    printed = ""
    if not moment:
        return printed
    if moment.endswith(".jsonl"):
        while not (folder / moment).exists() and process.poll() is None:
            time.sleep(0.01)
    else:
        while not printed.splitlines()[-1:] or not printed.splitlines()[-1].startswith(moment):
            line = process.stderr.readline()
            assert line, process.communicate()
            printed += line
    return printed


def hit(process: subprocess.Popen[str], number: int, times: int) -> tuple[int, str]:
    """Send a signal, or several; return exit code and standard error."""
    for _ in range(times):
        process.send_signal(number)
        time.sleep(random.uniform(0, 0.1) if times > 1 else 0)
    _, err = process.communicate(timeout=120)
    return process.returncode, err


@pytest.mark.parametrize("times", [1, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.parametrize("moment", MOMENTS)
def test_ctrl_c_at_every_stage(experiment: Path, moment: str, times: int) -> None:
    process = start(experiment, *LONG)
    run = experiment / "runs" / "tiny"
    wait_for(process, run, MOMENTS[moment])
    code, err = hit(process, signal.SIGINT, times)
    assert (code, faults(run, code, err)) == (130, [])
    if not run.exists():
        assert err.splitlines()[-1] == "interrupted"
        assert not (experiment / "runs").exists() or os.listdir(experiment / "runs") == []
    elif times == 1:
        assert COMPLETE - {"metrics.jsonl"} <= files(run)


def test_a_killed_run_can_be_read_and_replaced(experiment: Path) -> None:
    process = start(experiment, *LONG)
    run = experiment / "runs" / "tiny"
    wait_for(process, run, "metrics.jsonl")
    assert read_manifest(run)["status"] == "running"  # type: ignore[index]
    code, err = hit(process, signal.SIGKILL, 1)
    assert read_content(run)["status"] == "running"  # type: ignore[index]
    assert faults(run, code, err) == []
    assert read_content(run)["status"] == "interrupted"  # type: ignore[index]
    with np.load(run / "checkpoint" / "state.npz") as state:
        assert int(state["iteration"]) == 0
    again = start(experiment, "--force", "--quiet")
    assert again.communicate()[1] == ""
    assert again.returncode == 0
    assert os.listdir(experiment / "runs") == ["tiny"]
    assert faults(run, 0, "") == []


def storm(experiment: Path, number: int, count: int, times: int = 1) -> Counter[tuple[int, str | None]]:
    """Hit so many runs with a signal at random moments after every stage, and look at what they leave."""
    chance = random.Random(int(number))
    seen: Counter[tuple[int, str | None]] = Counter()
    stages = ["", *MOMENTS.values()]
    for index in range(count):
        name = f"run-{index}"
        run = experiment / "runs" / name
        process = start(experiment, "--set", f"run.name={name}", "--set", "run.iterations=30")
        wait_for(process, run, stages[index % len(stages)])
        time.sleep(chance.uniform(0, 1))
        code, err = hit(process, number, times)
        # Python itself answers a signal in the first moments of its start.
        begun = "KeyboardInterrupt" not in err or "reslrb_cli" in err
        assert faults(run, code if begun else 130, err if begun else "") == [], (index, code, err)
        if number != signal.SIGKILL and code == 130 and times == 1 and run.exists():
            assert COMPLETE - {"metrics.jsonl"} <= files(run), (index, code, err)
        seen[code, (read_manifest(run) or {}).get("status")] += 1
    left = list((experiment / "runs").glob(".*"))
    assert not left or number == signal.SIGKILL  # which the next run removes, after a minute
    print(signal.Signals(number).name, times, dict(seen))
    return seen


@pytest.mark.parametrize(
    ("number", "count"),
    [
        pytest.param(signal.SIGKILL, 30, marks=pytest.mark.long),
        *(pytest.param(number, 10, marks=pytest.mark.long) for number in SIGNALS),
    ],
)
def test_a_storm(experiment: Path, number: int, count: int) -> None:
    assert sum(storm(experiment, number, count).values()) == count


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_storm_of_two(experiment: Path, number: int) -> None:
    assert {code for code, _ in storm(experiment, number, 10, times=2)} <= {0, 130, -number}


# --- disks ------------------------------------------------------------------------------------------------------------


def mount(place: Path, kib: int) -> None:
    """Mount a disk of so many KiB there; skip the test where that is not allowed."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(place)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no `mount` here")
    if done.returncode:
        pytest.skip(f"no disk can be mounted here: {done.stderr.strip()}")


#: With the second there is room for the start of a run, and for what is kept back for its end.
SIZES = [8, 192]
ALL_SIZES = [4, 8, 12, 16, 24, 32, 48, 64, 80, 96, 104, 112, 120, 128, 144, 160, 176, 256, 384, 512, 768, 1024]


@pytest.mark.parametrize("kib", [*SIZES, *(pytest.param(kib, marks=pytest.mark.long) for kib in ALL_SIZES)])
def test_a_small_disk(experiment: Path, disk: Path, kib: int) -> None:
    mount(disk, kib)
    process = start(experiment, "--set", f"run.output={disk}/runs", *(LONG if kib <= 512 else []), "--quiet")
    out, err = process.communicate()
    run = disk / "runs" / "tiny"
    assert faults(run, process.returncode, err) == []
    if kib > 512:
        assert process.returncode == 0
        return
    assert (process.returncode, out) == (6, "")
    [line] = err.splitlines()
    assert re.match(rf"{re.escape(str(disk))}\S*: No space left on device; ", line)
    if not run.exists():
        assert "no run folder was made" in line
        assert not list(disk.glob("runs/*"))
        return
    content = read_content(run)
    assert content is not None
    assert content["error"] == line
    if kib >= 192:  # there was room for a reserve
        assert not {"checkpoint", "parameters"} & set(content["missing"])
    if "checkpoint" not in content["missing"]:
        done = content["results"]["iterations"]
        with np.load(run / "checkpoint" / "state.npz") as state:
            assert int(state["iteration"]) == done
        kept = f"the state after {done} of {done} iterations" if done else "the initial state"
        assert f"kept: {kept}, in " in line


def test_a_disk_that_is_full_before_the_run(experiment: Path, disk: Path) -> None:
    mount(disk, 64)
    (disk / "other").write_bytes(bytes(64 << 10))
    process = start(experiment, "--set", f"run.output={disk}/runs", "--quiet")
    assert process.communicate() == ("", f"{disk}: No space left on device; no run folder was made\n")
    assert process.returncode == 6
    assert os.listdir(disk) == ["other"]


# --- terminals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("streams", ["2>&-", pytest.param("2>/dev/full >&-", marks=pytest.mark.long)])
def test_a_run_without_a_terminal(experiment: Path, streams: str) -> None:
    script = "import sys; sys.argv = ['reslrb', 'optimize', 'tiny.yaml']; from reslrb_cli.cli import run; run()"
    environment = {**os.environ, "PYTHONPATH": search_path(Path(__file__).resolve().parents[2])}
    command = f'exec "$PYTHON" -c "{script}" {streams}'
    environment["PYTHON"] = sys.executable
    done = subprocess.run(["sh", "-c", command], cwd=experiment, env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert COMPLETE <= files(experiment / "runs" / "tiny")


def test_a_terminal_that_is_closed(experiment: Path) -> None:
    """Its progress bar goes nowhere, and the hang-up ends the run in order."""
    fcntl, pty, termios = (pytest.importorskip(name) for name in ("fcntl", "pty", "termios"))
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = start(experiment, *LONG, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    run = experiment / "runs" / "tiny"
    shown = b""
    while b"loss" not in shown:  # which a bar of 80 columns has room for, however long its other words are
        shown += os.read(ours, 4096)
    os.close(ours)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGHUP)
    process.wait(timeout=60)
    assert (process.returncode, faults(run, 130, "")) == (130, [])
    assert COMPLETE <= files(run)
