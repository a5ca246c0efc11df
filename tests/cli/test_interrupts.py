"""Signals: a wish to stop, the end at once, and no exception out of a handler."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from compilation import search_path

from reslrb_cli.cli.terminal import SIGNALS, Interrupts

ROOT = Path(__file__).resolve().parents[2]


def start(script: str, *, shell: str = "", argv0: str = "") -> subprocess.Popen[str]:
    """A process that runs `script` and has printed `ready`."""
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
def test_the_first_signal_only_leaves_a_mark(number):
    before = [signal.getsignal(other) for other in SIGNALS]
    with Interrupts() as interrupts:
        assert not interrupts.requested
        os.kill(os.getpid(), number)
        time.sleep(0.05)
        assert interrupts.requested
    assert [signal.getsignal(other) for other in SIGNALS] == before
    assert not [thread for thread in threading.enumerate() if thread.name == "interrupts"]


def test_one_within_another_takes_its_place_and_gives_it_back():
    with Interrupts() as outer:
        for _ in range(2):
            with Interrupts() as inner:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(0.05)
                assert inner.requested
        assert not outer.requested
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.05)
        assert outer.requested


def test_in_another_thread_nothing_happens():
    seen = []

    def work():
        with Interrupts() as interrupts:
            seen.append(interrupts.requested)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


def test_a_signal_in_a_recording_does_not_break_it(llvm):
    """Raised as an exception there, it becomes an error that looks like a call that cannot be recorded."""
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


@pytest.mark.parametrize("number", SIGNALS)
def test_where_none_is_tolerated_the_first_one_ends_the_process(number):
    process = start(FIRST)
    process.send_signal(number)
    assert end(process) == (130, "", "interrupted\n")


def test_the_second_one_ends_it_after_a_last_act(tmp_path):
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


def test_two_that_come_while_a_kernel_runs_are_two():
    """Python's own handler would see one, when the kernel has ended."""
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
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
    assert end(process) == (130, "", "interrupted\n")
    assert time.monotonic() - started < 20


def test_a_last_act_that_fails_prevents_nothing():
    script = WITHIN + "with Interrupts(tolerated=0, last_act=lambda: 1 / 0): print('ready', flush=True); time.sleep(60)"
    process = start(script)
    process.send_signal(signal.SIGHUP)
    assert end(process) == (130, "", "interrupted\n")


def test_what_was_ignored_from_the_start_stays_ignored():
    process = start(FIRST, shell="trap '' HUP INT")  # as nohup does
    for number in (signal.SIGHUP, signal.SIGINT):
        process.send_signal(number)
    time.sleep(0.2)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert end(process)[0] == 130


@pytest.mark.parametrize("stream", ["2>&-", "2>/dev/full"])
def test_a_last_word_that_cannot_be_said_is_left_out(stream):
    process = start(FIRST, shell=f"exec {stream}")
    process.send_signal(signal.SIGTERM)
    assert end(process)[0] == 130


# --- the program ------------------------------------------------------------------------------------------------------

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


@pytest.mark.parametrize("number", SIGNALS)
def test_a_command_that_knows_of_no_signals_is_ended(number):
    process = start(PROGRAM + "run()")
    process.send_signal(number)
    assert end(process) == (130, "", "interrupted\n")


def test_no_signal_changes_how_a_command_that_is_done_ends():
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


def test_while_the_program_is_loaded_ctrl_c_has_no_traceback():
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
from reslrb_cli.integrators.step import make_integrator, render_image

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


def test_mitsuba_does_not_write_of_signals_where_results_go():
    code, out, err = end(start(RENDERS))
    assert (code, out) == (0, "interrupted\n"), err
