"""Every way in which a run ends: by itself, by a signal, or because its folder disappears. Nothing is lost, and the
folder states how the run ended.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from cli.tiny import COMPLETE, KEY, ROOT, RUN, failing_last, faults, files, full, lines, read_metrics
from compilation import search_path

from reslrb_cli.cli import main, terminal
from reslrb_cli.cli.terminal import SAME_S, SIGNALS, Interrupts
from reslrb_cli.records.manifest import read_content
from reslrb_cli.runs import prepare
from reslrb_cli.runs import recorder as recording

# The end of a run, in this process. Each part is written on its own, the manifest first. Nothing is lost, and the
# folder states the truth.


@pytest.mark.parametrize("optimize", ["real page"], indirect=True)
def test_a_run_that_ends_well_is_complete(optimize):
    code, out, err = optimize()
    assert faults(RUN, code, err) == []
    assert COMPLETE <= files(RUN)
    content = read_content(RUN)
    assert (content["status"], content["error"]) == ("finished", None)
    assert content["process"]["pid"] == os.getpid()
    assert "report.html" in out


def test_a_signal_ends_a_run_after_the_iteration(optimize, during):
    during(lambda record: os.kill(os.getpid(), signal.SIGTERM) if record.iteration == 1 else None)
    code, out, err = optimize()
    assert (code, faults(RUN, code, err)) == (130, [])
    assert COMPLETE <= files(RUN)
    assert read_content(RUN)["results"]["iterations"] == len(read_metrics(RUN)) == 2
    *_, ending, advice = out.splitlines()
    assert ending.startswith("interrupted after 2 iterations")
    assert advice == f"next: `reslrb optimize --resume {RUN}` continues this run"


@pytest.mark.parametrize(
    ("every", "saved"),
    [
        ("{iterations: 2}", [0, 2, 4, 5]),
        ("{iterations: 6}", [0, 5]),
        ("{seconds: 59}", [0, 1, 2, 3, 4, 5]),
        ("{seconds: 60}", [0, 2, 4, 5]),
        ("{seconds: 120}", [0, 3, 5]),
    ],
)
def test_checkpoints_have_the_given_distance(optimize, during, monkeypatch, every, saved):
    """Each iteration takes a minute. The first and the last state are always saved, each state once."""
    now, found = [100.0], []
    save = prepare.save_checkpoint
    monkeypatch.setattr(prepare, "save_checkpoint", lambda *given: (found.append(given[1]), save(*given)))
    monkeypatch.setattr(recording, "time", SimpleNamespace(monotonic=lambda: now[0]))
    during(lambda record: now.append(now.pop() + 60))
    assert optimize("--set", f"run.checkpoint_every={every}", "--set", "run.final_spp=1")[0] == 0
    assert found == saved


@pytest.mark.parametrize(("name", "call"), [("write_image", 0), ("write_image", 2)])
def test_a_signal_during_writing_loses_no_file(optimize, monkeypatch, name, call):
    real, calls = getattr(recording, name), []

    def interrupted(*args):
        if len(calls) == call:
            os.kill(os.getpid(), signal.SIGTERM)
        calls.append(args)
        real(*args)

    monkeypatch.setattr(recording, name, interrupted)
    code, _, err = optimize()
    begun = call > 0  # by then, all iterations are done, and nothing is left to interrupt
    assert (code, faults(RUN, code, err)) == (0 if begun else 130, [])
    assert files(RUN) >= (COMPLETE if begun else COMPLETE - {"metrics.jsonl"})


def test_a_run_that_ends_at_once_is_interrupted(optimize, during, monkeypatch):
    runs, seen = [], []
    monkeypatch.setattr("reslrb_cli.records.manifest._WRITING", mock.MagicMock())
    run = recording.Recording.run
    monkeypatch.setattr(recording.Recording, "run", lambda self, *args: runs.append(self) or run(self, *args))

    def abandon(record):
        if record.iteration == 2:
            runs[0].abandon()  # like the thread that ends the process
            seen.append(read_content(RUN))

    during(abandon)
    optimize()
    [content] = seen
    assert (content["status"], content["results"]["iterations"]) == ("interrupted", 3)
    assert content["ended"]


def test_there_is_a_checkpoint_before_the_first_iteration(optimize, monkeypatch):
    seen = []

    def look(problem, begun, on_nonfinite, **options):
        with np.load(RUN / "checkpoint" / "state.npz") as state:
            seen.append((int(state["iteration"]), state[f"parameter/{KEY}"].mean()))
        return iter(())

    monkeypatch.setattr(recording, "iterate", look)
    optimize()
    assert seen == [(0, 0.5)]


#: For each failing part: the function that writes it, the number of calls before the end of the run, and the files that
#: are then absent.
PARTS = {
    "checkpoint": ("save_checkpoint", 1, set()),
    "parameters": ("write_parameters", 2, {f"parameters/{name}" for name in
                   ("parameters.npz", "parameters.json", f"{KEY}.exr", f"{KEY}.png")}),
    "final images": ("write_image", 2, {"images/final.exr", "images/final.png"}),
}  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
def test_a_failing_part_does_not_affect_the_others(optimize, monkeypatch, part):
    name, before, absent = PARTS[part]
    failing_last(monkeypatch, name, calls=before)
    code, out, err = optimize()
    assert (code, faults(RUN, code, err), out) == (6, [], "")
    assert COMPLETE - files(RUN) == absent
    content = read_content(RUN)
    assert content["results"]["iterations"] == 5
    [line] = lines(err)
    assert line == content["error"]
    kept = 0 if part == "checkpoint" else 5
    assert line.startswith(f"runs/tiny/x: No space left on device; saved: the state after {kept} of 5 iterations, in ")
    with np.load(RUN / "checkpoint" / "state.npz") as state:
        assert int(state["iteration"]) == kept


def undrawable(folder, *now):
    raise KeyError("initial")


@pytest.mark.parametrize(
    ("draw", "reason"), [(full, "runs/tiny/x: No space left"), (undrawable, "KeyError: 'initial'")]
)
def test_a_run_finishes_without_its_page(optimize, monkeypatch, draw, reason):
    monkeypatch.setattr(recording, "write_report", draw)
    code, out, err = optimize()
    assert (code, faults(RUN, code, err)) == (0, [])
    assert COMPLETE - files(RUN) == {"report.html"}
    assert f"the page was not written: {reason}" in err
    assert out.rstrip().endswith("look at runs/tiny")


def test_an_internal_error_is_logged_with_its_traceback(optimize, during, monkeypatch):
    during(lambda record: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main.main(["optimize", "tiny.yaml"])
    content = read_content(RUN)
    assert (content["status"], content["error"]) == ("failed", "ZeroDivisionError: division by zero")
    assert (RUN / "checkpoint" / "state.npz").exists()


def test_running_out_of_memory_at_the_end_keeps_the_results(optimize, monkeypatch):
    def fail():
        raise RuntimeError("jit_malloc(): out of memory! Could not allocate 5 bytes")

    failing_last(monkeypatch, "write_image", fail, calls=2)
    code, _, err = optimize()
    assert code == 4
    assert lines(err)[-1] == read_content(RUN)["error"]
    assert COMPLETE - files(RUN) == {"images/final.exr", "images/final.png"}


# Signals: a first signal asks the run to stop, a later signal ends it at once, and no handler raises an exception.


def start(script: str, *, shell: str = "", argv0: str = "") -> subprocess.Popen[str]:
    """Start a process that runs `script`, and wait until it prints `ready`."""
    command = [sys.executable, "-c", f"import os, signal, sys, threading, time\n{script}"]
    if shell:
        command = ["sh", "-c", f'{shell}; exec "$@"', "sh", *command]
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT)}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, bufsize=0
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n", process.communicate()
    return process


def end(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=30)
    return process.returncode, out, err


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_only_sets_a_flag(number):
    before = [signal.getsignal(other) for other in SIGNALS]
    with Interrupts() as interrupts:
        assert not interrupts.requested
        os.kill(os.getpid(), number)
        time.sleep(0.05)
        assert interrupts.requested
    assert [signal.getsignal(other) for other in SIGNALS] == before
    assert not [thread for thread in threading.enumerate() if thread.name == "interrupts"]


def test_a_signal_that_comes_twice_at_once_counts_once(monkeypatch):
    """Another signal, or the same one later, ends the process."""
    now, ends, said = [100.0], [], []
    monkeypatch.setattr(terminal, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(terminal, "_say", said.append)
    for tolerated, signals, count in (
        (1, ((1, 0.0), (1, SAME_S - 0.01)), 0),
        (1, ((1, 0.0), (1, SAME_S)), 1),
        (1, ((1, 0.0), (2, 0.1)), 1),
        (2, ((1, 0.0), (2, 0.1)), 0),
        (0, ((1, 0.0),), 1),
    ):
        interrupts = Interrupts(tolerated, notice="stopping")
        monkeypatch.setattr(interrupts, "_end", lambda: ends.append(1))
        for number, at in signals:
            now[0] = 100 + at
            interrupts._see(number)
        assert interrupts.requested
        assert (len(ends), said) == (count, ["stopping"] * (tolerated > 0))
        ends.clear()
        said.clear()


def test_nested_handlers_replace_and_restore_each_other():
    with Interrupts() as outer:
        with Interrupts() as inner:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.05)
            assert inner.requested
        assert not outer.requested
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.05)
        assert outer.requested
    assert signal.set_wakeup_fd(-1) == -1


def test_other_threads_are_unaffected():
    seen = []

    def work():
        with Interrupts() as interrupts:
            seen.append(interrupts.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


def test_a_signal_during_a_recording_does_not_break_it(llvm):
    """If the signal raised an exception there, the resulting error would look like a call that cannot be recorded."""
    import drjit as dr
    import mitsuba as mi

    @dr.freeze
    def double(x):
        os.kill(os.getpid(), signal.SIGINT)
        return x * 2

    with Interrupts() as interrupts:
        assert dr.all(double(dr.opaque(mi.Float, 3, 4)) == 6)
        assert interrupts.requested


WITHIN = "from reslrb_cli.cli.terminal import Interrupts\n"
FIRST = WITHIN + "with Interrupts(tolerated=0): print('ready', flush=True); time.sleep(60)"


def test_the_second_signal_ends_it_after_a_last_act(tmp_path):
    script = f"""
from pathlib import Path
from reslrb_cli.records.atomic import write_atomically
def act(): print("the last act", flush=True)
def write(file):
    print("ready", flush=True)
    time.sleep(60)
{WITHIN}
with Interrupts(last_act=act, notice="stopping"):
    write_atomically(Path({str(tmp_path / "file")!r}), write)
"""
    process = start(script)
    process.send_signal(signal.SIGTERM)
    assert process.stderr is not None
    assert process.stderr.readline() == "stopping\n"
    assert len(list(tmp_path.iterdir())) == 1
    process.send_signal(signal.SIGINT)
    assert end(process) == (130, "the last act\n", "interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_two_signals_during_a_kernel_count_as_two():
    """Python's own handler would count only one signal, after the end of the kernel."""
    script = (
        WITHIN
        + """
import hashlib
with Interrupts():
    print("ready", flush=True)
    # in C, without Python's lock: as while a kernel runs
    hashlib.pbkdf2_hmac("sha256", b"x", b"y", 200_000_000)
"""
    )
    process = start(script)
    started = time.monotonic()
    for _ in range(2):
        time.sleep(1.2 * SAME_S)
        process.send_signal(signal.SIGINT)
    assert end(process) == (130, "", "interrupted\n")
    assert time.monotonic() - started < 20


def test_a_closed_terminal_sends_one_signal():
    """The kernel and the shell both send SIGHUP. Another signal still ends the process."""
    script = WITHIN + "with Interrupts(notice='stopping') as seen: print('ready', flush=True); time.sleep(60)"
    process = start(script)
    for _ in range(3):
        process.send_signal(signal.SIGHUP)
        time.sleep(SAME_S / 10)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert end(process) == (130, "", "stopping\ninterrupted\n")


def test_without_tolerance_the_first_signal_ends_the_process():
    """A last act that fails prevents nothing."""
    script = WITHIN + "with Interrupts(tolerated=0, last_act=lambda: 1 / 0): print('ready', flush=True); time.sleep(60)"
    process = start(script)
    process.send_signal(signal.SIGHUP)
    assert end(process) == (130, "", "interrupted\n")


def test_initially_ignored_signals_stay_ignored():
    process = start(FIRST, shell="trap '' HUP INT")  # like nohup
    for number in (signal.SIGHUP, signal.SIGINT):
        process.send_signal(number)
    time.sleep(0.2)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert end(process)[0] == 130


def test_an_impossible_last_message_is_left_out():
    process = start(FIRST, shell="exec 2>/dev/full")
    process.send_signal(signal.SIGTERM)
    assert end(process)[0] == 130


PROGRAM = """
import click
from reslrb_cli.cli import _Main, run
@click.command("waiting")
def command():
    print("ready", flush=True)
    time.sleep(60)
_Main.get_command = lambda *_args: command
sys.argv = ["reslrb", "waiting"]
"""


def test_a_command_without_signal_handling_is_ended():
    process = start(PROGRAM + "run()")
    process.send_signal(signal.SIGHUP)
    assert end(process) == (130, "", "interrupted\n")


def test_a_signal_does_not_change_the_end_of_a_finished_command():
    script = (
        PROGRAM
        + """
command.callback = lambda: 5
import atexit
atexit.register(lambda: print("ready", flush=True) or time.sleep(0.5))
run()
"""
    )
    process = start(script)
    for number in SIGNALS:
        process.send_signal(number)
    assert end(process) == (5, "", "")


def test_ctrl_c_during_loading_has_no_traceback():
    script = """
sys.argv = ["/usr/bin/reslrb"]
import subprocess
def wait(*_args, **_options):
    print("ready", flush=True)
    time.sleep(60)
subprocess.run = wait  # what looks for libLLVM
os.environ.pop("DRJIT_LIBLLVM_PATH", None)
import reslrb_cli
"""
    process = start(script)
    process.send_signal(signal.SIGINT)
    assert end(process) == (-signal.SIGINT, "", "")


RENDERS = """
import reslrb_cli, mitsuba as mi
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.step import render_image

mi.set_variant("llvm_ad_rgb")
scene, integrator = mi.load_dict(mi.cornell_box()), make_integrator("ptracer", max_depth=2)
print("ready", flush=True)
threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    for number in range(10000):
        render_image(integrator, scene, 0, number, 4)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_mitsuba_writes_no_signal_messages_to_standard_output():
    code, out, err = end(start(RENDERS))
    assert (code, out) == (0, "interrupted\n"), err


# Run folders that are removed, emptied, moved or replaced during a run.


def test_removing_the_folder_ends_the_run(optimize, during):
    during(lambda record: shutil.rmtree(RUN) if record.iteration == 1 else None)
    code, out, err = optimize("--set", "run.iterations=50")
    assert (code, out) == (6, "")
    [line] = lines(err)
    assert line.endswith("runs/tiny: has gone while the run went on")
    assert os.listdir("runs") == ["latest"]  # a link to the folder


def test_another_run_with_the_same_name_is_left_alone(optimize, during):
    seen = []

    def take(record):
        if record.iteration == 1:
            RUN.rename("runs/moved")
            RUN.mkdir()
            (RUN / "theirs").write_text("another run")
        elif record.iteration == 2:
            seen.append(record)

    during(take)
    code, out, err = optimize("--set", "run.checkpoint_every={iterations: 1}")
    assert (code, out, os.listdir(RUN)) == (6, "", ["theirs"])
    assert seen == []  # it ends at once, not after all work
    [line] = lines(err)
    assert line.endswith("runs/tiny: has gone while the run went on")
