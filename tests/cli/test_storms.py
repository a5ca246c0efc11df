"""Runs and measurements that are killed, or whose disk is full. The remaining files are complete and sufficient for a
continuation.
"""

from __future__ import annotations

import errno
import json
import os
import random
import re
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cli import tiny
from cli.tiny import COMPLETE, faults, files, start, write_experiment
from compilation import search_path
from turns import a_few

from reslrb_cli.cli.options import Keeper
from reslrb_cli.cli.terminal import SIGNALS
from reslrb_cli.records import measurement_files
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.measurements import SummaryRecord

# Runs that are hit at random moments, and runs on disks that are too small. The remaining files are complete and true.
# The default suite has one run of each kind. `-m long` has enough runs to hit every part of a run.

#: Moments of a run, each with a text that the run has then printed, or with a file that the run folder then holds.
MOMENTS = {"loading": "variant ", "the target": "rendering ", "the mask": "finding ", "iterations": "metrics.jsonl"}
LONG = ["--set", "run.iterations=20000"]


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    write_experiment(tmp_path)
    return tmp_path


def wait_for(process: subprocess.Popen[str], folder: Path, moment: str) -> str:
    """Wait until a run has reached `moment`, and return the text that it printed until then."""
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
    """Send a signal, then SIGTERM until there were `times` signals. Return the exit code and standard error."""
    for _ in range(times):
        process.send_signal(number)
        number = signal.SIGTERM  # the same signal would count once
        time.sleep(random.uniform(0, 0.1) if times > 1 else 0)
    _, err = process.communicate(timeout=120)
    return process.returncode, err


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("moment", a_few(MOMENTS, ["loading"]))
def test_ctrl_c_at_every_stage(experiment: Path, moment: str) -> None:
    process = start(experiment, *LONG, details=True)
    run = experiment / "runs" / "tiny"
    wait_for(process, run, MOMENTS[moment])
    code, err = hit(process, signal.SIGINT, 1)
    assert (code, faults(run, code, err)) == (130, [])
    if run.exists():
        assert COMPLETE - {"metrics.jsonl"} <= files(run)
        return
    assert err.splitlines()[-1] == "interrupted"
    assert not (experiment / "runs").exists() or os.listdir(experiment / "runs") == []


@pytest.mark.usefixtures("llvm")
@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "count", "times"),
    [(signal.SIGKILL, 30, 1), *((number, 10, 1) for number in SIGNALS), (signal.SIGINT, 10, 2)],
)
def test_many_signals(experiment: Path, number: int, count: int, times: int) -> None:
    """Runs get a signal at random moments after every stage. The files that they leave are complete."""
    chance, stages = random.Random(int(number)), ["", *MOMENTS.values()]
    for index in range(count):
        run = experiment / "runs" / f"run-{index}"
        process = start(experiment, "--set", f"run.name=run-{index}", "--set", "run.iterations=30", details=True)
        wait_for(process, run, stages[index % len(stages)])
        time.sleep(chance.uniform(0, 1))
        code, err = hit(process, number, times)
        assert code in (0, 130, -number)
        # In the first moments after its start, Python itself handles a signal. Later, a traceback is a fault.
        begun = stages[index % len(stages)] != "" or "KeyboardInterrupt" not in err or "reslrb_cli" in err
        assert faults(run, code if begun else 130, err if begun else "") == [], (index, code, err)
        if number != signal.SIGKILL and code == 130 and times == 1 and run.exists():
            assert COMPLETE - {"metrics.jsonl"} <= files(run), (index, code, err)
        read_manifest(run)  # a reader repairs the folder
    left = list((experiment / "runs").glob(".*"))
    assert not left or number == signal.SIGKILL  # the next run removes these files after a minute


def mount(place: Path, kib: int) -> None:
    """Mount a disk of `kib` KiB at `place`. Skip the test where mounting is not allowed."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(place)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no `mount` here")
    if done.returncode:
        pytest.skip(f"no disk can be mounted here: {done.stderr.strip()}")


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("kib", a_few([8, 16, 48, 96, 128, 192, 256, 512], ["192"]))
def test_a_small_disk(experiment: Path, disk: Path, monkeypatch: pytest.MonkeyPatch, kib: int) -> None:
    """The run ends with one line and exit code 6. The last written state is complete. A disk of 192 KiB has room for
    the start of a run.
    """
    mount(disk, kib)
    monkeypatch.chdir(experiment)
    result = tiny.reslrb("optimize", "tiny.yaml", "--set", f"run.output={disk}/runs", *LONG, "--quiet")
    run = disk / "runs" / "tiny"
    assert (result.exit_code, result.stdout) == (6, "")
    [line] = result.stderr.splitlines()
    assert re.match(rf"{re.escape(str(disk))}\S*: No space left on device; ", line)
    if not run.exists():
        assert "no run folder was made" in line
        assert not list(disk.glob("runs/*"))
        return
    assert read_manifest(run)["status"] in ("failed", "interrupted")  # interrupted if the error could not be written
    if (run / "checkpoint" / "state.npz").exists():
        with np.load(run / "checkpoint" / "state.npz") as state:
            assert f"saved: the state after {int(state['iteration'])} of " in line


@pytest.mark.long
@pytest.mark.usefixtures("llvm")
def test_a_run_without_a_terminal(experiment: Path) -> None:
    script = "import sys; sys.argv = ['reslrb', 'optimize', 'tiny.yaml']; from reslrb_cli.cli import run; run()"
    environment = {**os.environ, "PYTHONPATH": search_path(Path(__file__).resolve().parents[2])}
    command = f'exec "$PYTHON" -c "{script}" 2>&-'
    environment["PYTHON"] = sys.executable
    done = subprocess.run(["sh", "-c", command], cwd=experiment, env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert COMPLETE <= files(experiment / "runs" / "tiny")


@pytest.mark.usefixtures("llvm")
@pytest.mark.long
def test_a_closed_terminal(experiment: Path) -> None:
    """The progress bar then has no terminal. The hang-up signal ends the run in order."""
    fcntl, pty, termios = (pytest.importorskip(name) for name in ("fcntl", "pty", "termios"))
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = start(experiment, *LONG, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    run = experiment / "runs" / "tiny"
    shown = b""
    while b"loss" not in shown:  # a bar of 80 columns always has room for the loss, despite other long words
        shown += os.read(ours, 4096)
    os.close(ours)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGHUP)
    process.wait(timeout=60)
    assert faults(run, 130, "") == []  # exit code 130 replaces the last line, which cannot be printed
    assert COMPLETE <= files(run)


# Files of measurements in progress, which are complete and current.


def lines(*words: str) -> list[SummaryRecord]:
    return [SummaryRecord(word) for word in words]


def read(path: Path) -> list[str]:
    """Return the text of all lines after the first line. The first line states where the measurement comes from."""
    origin, *others = [json.loads(line) for line in path.read_text().splitlines()]
    assert origin == {"kind": "summary", "line": "here", "remark": ""}
    return [line["line"] for line in others]


class Measurement:
    """Measurement whose lines a test can change while the measurement goes on."""

    def __init__(self, file: Path) -> None:
        self.lines = lines()
        self.keeper = Keeper(file, *lines("here"), lambda: self.lines)


def test_the_file_is_current(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurement_files, "PAGE_SECONDS", 0.0)
    monkeypatch.setattr(measurement_files, "PAGE_SHARE", 0.0)
    file = tmp_path / "c.jsonl"
    measured = Measurement(file)
    measured.lines = lines("a")
    measured.keeper.refresh()
    assert read(file) == ["a"]
    measured.lines = lines("a", "c")
    measured.keeper.finish(interrupted=True)
    assert read(file) == ["a", "c"]
    assert [path.name for path in tmp_path.iterdir()] == ["c.jsonl"]


def test_an_earlier_file_is_replaced_at_the_end_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(measurement_files, "PAGE_SECONDS", 0.0)
    monkeypatch.setattr(measurement_files, "PAGE_SHARE", 0.0)
    file, partial = tmp_path / "c.jsonl", tmp_path / "c.jsonl.partial"
    file.write_text("old\n")
    for interrupted in (True, False):
        measured = Measurement(file)
        measured.lines = lines("a")
        measured.keeper.refresh()
        assert (file.read_text(), read(partial)) == ("old\n", ["a"])  # killed now, it leaves both
        measured.lines = lines("a", "c")
        measured.keeper.finish(interrupted)
        said = f"--json: {file} has not changed; the interrupted measurement is in {partial}\n"
        assert capsys.readouterr().out == (said if interrupted else "")
        assert read(partial if interrupted else file) == ["a", "c"]
        assert partial.exists() == (file.read_text() == "old\n") == interrupted


@pytest.mark.parametrize("reason", [errno.EBUSY, errno.EACCES, errno.ENAMETOOLONG])
def test_a_file_that_cannot_be_replaced_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: int
) -> None:
    """A file that is a mount of its own, a folder without write permission, or a long name."""
    file = tmp_path / ("n" * 250 if reason == errno.ENAMETOOLONG else "c.jsonl")

    def refuse(*_: object) -> None:
        raise OSError(reason, os.strerror(reason))

    if reason != errno.ENAMETOOLONG:
        monkeypatch.setattr(os, "replace", refuse)
    file.write_text("old\n" * 1000)
    measured = Measurement(file)
    measured.lines = lines("a")
    measured.keeper.refresh()
    measured.keeper.finish(interrupted=False)
    assert read(file) == ["a"]
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def test_a_failed_intermediate_write_is_reported_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "c.jsonl"
    measured = Measurement(file)
    measured.keeper.refresh()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(file))

    monkeypatch.setattr("reslrb_cli.records.measurement_files.write_atomically", full)
    measured.keeper.refresh()
    with pytest.raises(OSError, match="No space left"):
        measured.keeper.finish(interrupted=False)


def test_a_pipe_gets_all_lines_at_the_end(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    measured = Measurement(tmp_path / "pipe")
    measured.lines = lines("a")
    measured.keeper.refresh()
    measured.keeper.finish(interrupted=False)
    assert os.read(reader, 1000).splitlines()[1:] == [b'{"kind": "summary", "line": "a", "remark": ""}']
    os.close(reader)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]
