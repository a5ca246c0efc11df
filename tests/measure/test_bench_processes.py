"""How the end of a process is read, and what kernels say of thread-local memory."""

from __future__ import annotations

import io
import sys
from typing import Any

import pytest

from reslrb_cli.measure.processes import Ended, Process, Refused, Stopped, last_words
from reslrb_cli.measure.workers import scratch_bytes
from reslrb_cli.records.measurements import BenchStatus

FIRST = {"memory_limit": None}
FAILED, OUT_OF_MEMORY = BenchStatus.FAILED, BenchStatus.OUT_OF_MEMORY


def end_of(script: str, limit: int | None = None) -> Ended:
    process = Process(
        {"memory_limit": limit}, command=[sys.executable, "-c", f"import json, os, signal, sys, time\n{script}"]
    )
    try:
        with pytest.raises(Ended) as caught:
            process.answer(lambda: False)
        return caught.value
    finally:
        process.close()


@pytest.mark.parametrize(
    ("script", "status", "reason"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", OUT_OF_MEMORY, "ended by SIGKILL"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", FAILED, "ended by SIGSEGV"),
        ("sys.exit(7)", FAILED, "ended by exit code 7"),
        ("raise ValueError('of all things')", FAILED, "ended by exit code 1: ValueError: of all things"),
        ("sys.stderr.write('std::bad_alloc\\n'); sys.stderr.flush(); os.abort()", OUT_OF_MEMORY, "SIGABRT: std::bad"),
        ("sys.stderr.write('>>> jit_malloc(): out of memory!\\nir\\n'); sys.exit(1)", OUT_OF_MEMORY, "1: jit_malloc()"),
        ("print(json.dumps({'failure': 'failed', 'reason': 'why'}), flush=True); time.sleep(9)", FAILED, "why"),
    ],
)
def test_ends_are_told_apart(script: str, status: BenchStatus, reason: str) -> None:
    end = end_of(script)
    assert end.status is status
    assert reason in end.reason


def test_a_crash_close_to_the_limit_is_one_of_memory() -> None:
    crash = "time.sleep(0.3); os.kill(os.getpid(), signal.SIGSEGV)"
    end = end_of(crash, limit=4 * 2**20)  # not set by this process, but in use many times over
    assert end.status is OUT_OF_MEMORY
    assert "of 4 MiB in use" in end.reason
    assert end_of(crash, limit=2**50).status is FAILED


def test_a_refusal_holds_for_all() -> None:
    answer = {"failure": "refused", "reason": "x.yaml: scene.file: no such file", "exit_code": 2}
    process = Process(FIRST, command=[sys.executable, "-c", f"import json; print(json.dumps({answer!r}))"])
    with pytest.raises(Refused, match=r"scene\.file: no such file") as caught:
        process.answer(lambda: False)
    assert caught.value.exit_code == 2
    process.close()


def test_waiting_can_be_stopped() -> None:
    process = Process(FIRST, command=[sys.executable, "-c", "import time; time.sleep(60)"])
    with pytest.raises(Stopped):
        process.answer(lambda: True)
    process.close()
    process.close()


def test_last_words() -> None:
    assert last_words("") == ""
    assert last_words("a\n\n b \n") == "b"
    assert last_words("a\n>>> jit_malloc(): out of memory\nmore\n") == "jit_malloc(): out of memory"


LLVM = """
    %arr_1 = alloca float, i32 112, align 64
    %arr_3 = alloca i8, i32 112, align 16
    %arr_5 = alloca i64, i32 112, align 128
    %buffer = alloca i8, i32 1368, align 64
    %index_next = add i64 %index, 16
"""
PTX = """
    .local .align 4 .b32 arr_12[7];
    .local .align 8 .b64 arr_13[7];
    .local .align 4 .b8 other[64];
"""


@pytest.mark.parametrize(("ir", "expected"), [(LLVM, 7 * (4 + 1 + 8)), (PTX, 7 * (4 + 8)), ("", 0)])
def test_scratch_bytes_of_a_kernel(ir: str, expected: int) -> None:
    assert scratch_bytes([{}, {"ir": io.StringIO(ir)}, {"ir": ""}]) == expected


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(("entries", "expected"), [(0, 0), (5, 40), (9, 72)])
def test_scratch_bytes_of_a_real_kernel(entries: int, expected: int) -> None:
    import drjit as dr
    import mitsuba as mi

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        index = dr.opaque(mi.UInt32, 1, 64) % max(entries, 1)
        value: Any = mi.Float(index)
        if entries:
            memory = dr.alloc_local(mi.Point2f, entries)
            memory.write(mi.Point2f(value), index)
            value = dr.sum(memory.read(index + 0))
        dr.eval(value)
        assert scratch_bytes(dr.kernel_history()) == expected
