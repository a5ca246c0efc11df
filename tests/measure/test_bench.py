"""`reslrb bench`: the command line and its processes."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest
from cli.tiny import ended, measured
from kit import diffuse, ref, scene, sensor, shape

from reslrb_cli.measure.processes import CannotStart, Ended, Process, Stopped, last_words
from reslrb_cli.measure.steps import scratch_bytes
from reslrb_cli.records.measurements import BenchStatus

# `reslrb bench` from the command line, on a scene of 16x16 pixels.

KEYS = ["label", "options", "spp", "max_depth", "adjoint", "status", "width", "height", "texels", "step_ms",
        "kernel_ms", "codegen_ms", "tracing_ms", "step_ratio", "kernel_ratio", "cold_ms", "peak_mib", "scratch_bytes",
        "repeats", "message"]  # fmt: skip
SMALL = ["--set", "scene.options.size=16", "--set", "run.spp=1", "--rounds", "3"]


call = partial(ended, "bench")


def test_two_depths(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "bench.json"
    assert call(*SMALL, "--max-depth", "4", "--integrators", "reslrb:stack", "--json", str(file)) == 0
    rows = measured(file)
    assert [list(row) for row in rows] == [KEYS] * 2
    assert [(row["label"], row["max_depth"]) for row in rows] == [("reslrb:stack", depth) for depth in (2, 4)]
    assert [row["options"]["estimator"] for row in rows] == ["stack"] * 2
    for row in rows:
        assert (row["status"], row["spp"], row["width"], row["height"], row["repeats"]) == ("ok", 1, 16, 16, 3)
        for key in ("step_ms", "kernel_ms"):
            assert 0 < row[key]["min"] <= row[key]["median"] <= row[key]["max"]
        assert row["step_ms"]["median"] > row["kernel_ms"]["median"]
        assert row["cold_ms"] > row["step_ms"]["median"]
        assert row["cold_ms"] > row["codegen_ms"]["median"] >= 0
        # Each step time is the sum of its parts, but medians do not add up.
        parts = [row[key] for key in ("kernel_ms", "codegen_ms", "tracing_ms")]
        assert sum(part["min"] for part in parts) <= 1.001 * row["step_ms"]["min"]
        assert sum(part["max"] for part in parts) >= 0.999 * row["step_ms"]["max"]
        assert row["tracing_ms"]["min"] > 0
        assert row["peak_mib"] > 0
    # Depth 4 stores three vertices, and depth 2 stores one. Both have one more slot for entries that are not pushed.
    assert rows[1]["scratch_bytes"] == 2 * rows[0]["scratch_bytes"] > 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines[3:5]] == [[str(depth), "reslrb:stack"] for depth in (2, 4)]


@pytest.mark.long
def test_a_failing_case_gives_its_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cold step of the case beside it finds no compiled kernels, because its process uses no cache."""
    monkeypatch.setenv("DRJIT_CACHE_DIR", str(tmp_path / "kernels"))
    file = tmp_path / "bench.json"
    (tmp_path / "scene.xml").write_text(MASKED.replace("<shape ", '<shape banner="x" '))
    (tmp_path / "x.yaml").write_text(
        "scene: {file: scene.xml}\ntarget: {render: {}}\nparameters: [{key: veil.opacity.value}]\n"
    )
    args = ["--max-depth", "2", "--integrators", "prb,trajectory", "--json", str(file)]
    assert call(str(tmp_path / "x.yaml"), *args, "--set", "run.spp=1", "--rounds", "3") == 0
    rows = measured(file)
    assert [(row["label"], row["status"]) for row in rows] == [("prb", "ok"), ("trajectory", "failed")]
    assert rows[0]["scratch_bytes"] == 0
    assert not (tmp_path / "kernels").exists()
    printed = capsys.readouterr()
    assert "depth 2, trajectory: UnsupportedScene: trajectory: Dr.Jit cannot reverse" in printed.out
    assert printed.err.count("banner") == 1  # both leave it out, one line is shown


def test_a_wrong_variable_of_the_scene_is_one_located_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--set", "scene.options.colour=3", "--max-depth", "2", "--integrators", "reslrb:stack") == 2
    [error] = capsys.readouterr().err.strip().splitlines()
    assert "scene.options.colour: the options are" in error


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.long
def test_a_second_signal_leaves_no_processes_or_files(tmp_path: Path) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    command = [sys.executable, "-c", "from reslrb_cli.cli import run; run()", "bench", *SMALL, "--max-depth", "1024"]
    process = subprocess.Popen(
        [*command, "--integrators", "reslrb:stack"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"TMPDIR": str(folder)},
    )  # fmt: skip
    assert process.stdout is not None
    for line in process.stdout:
        if line.split()[:1] == ["2"]:  # the first depth is done, and the processes of the second are at work
            break
    while not any(folder.iterdir()):
        time.sleep(0.01)
    for number in (signal.SIGTERM, signal.SIGHUP):
        process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, "Traceback" in err) == (130, False)
    assert list(folder.iterdir()) == []


@pytest.mark.long
def test_ctrl_c_keeps_finished_measurements(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    command = [sys.executable, "-c", "from reslrb_cli.cli import main; main()", "bench", *SMALL, "--max-depth", "1024"]
    process = subprocess.Popen(
        [*command, "--integrators", "reslrb:stack", "--json", str(file)],
        stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    end = time.monotonic() + 60
    while not (file.exists() and file.read_text().count("\n") >= 2) and time.monotonic() < end:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 130
    rows = measured(file)
    assert rows
    origin = json.loads(file.read_text().partition("\n")[0])
    assert origin["command"] == ["reslrb", *command[3:], "--integrators", "reslrb:stack", "--json", str(file)]
    assert [list(row) for row in rows] == [KEYS] * len(rows)
    assert "reslrb:stack" in output


MASKED = scene(
    sensor(),
    f'<bsdf type="mask" id="veil"><float name="opacity" value="0.5"/> {diffuse("0.5")}</bsdf>',
    shape("rectangle", "", ref("veil")),
    '<emitter type="point"><point name="position" x="0" y="1" z="3"/></emitter>',
)


# How the end of a process is interpreted, and what kernels report about thread-local memory.

FIRST = {"memory_limit": None}
CHILD = """
import os, signal, sys, time
from multiprocessing.connection import Connection
parent = Connection(int(sys.argv[-1]))
"""
FAILED, OUT_OF_MEMORY = BenchStatus.FAILED, BenchStatus.OUT_OF_MEMORY


def end_of(script: str, limit: int | None = None) -> Ended:
    process = Process({"memory_limit": limit}, command=[sys.executable, "-c", f"{CHILD}\n{script}"])
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
        ("parent.send({'failure': 'failed', 'reason': 'why'}); time.sleep(9)", FAILED, "why"),
    ],
)
def test_kinds_of_ends_are_distinguished(script: str, status: BenchStatus, reason: str) -> None:
    end = end_of(script)
    assert end.status is status
    assert reason in end.reason


def test_a_crash_near_the_limit_is_attributed_to_memory() -> None:
    crash = "time.sleep(0.3); os.kill(os.getpid(), signal.SIGSEGV)"
    end = end_of(crash, limit=4 * 2**20)  # the process sets no limit, but uses many times 4 MiB
    assert end.status is OUT_OF_MEMORY
    assert "of 4 MiB seen in use" in end.reason
    assert end_of(crash, limit=2**50).status is FAILED


def test_a_refusal_applies_to_all() -> None:
    answer = {"failure": "refused", "reason": "x.yaml: scene.file: no such file", "exit_code": 2}
    process = Process(FIRST, command=[sys.executable, "-c", f"{CHILD}\nparent.send({answer!r})"])
    with pytest.raises(CannotStart, match=r"scene\.file: no such file") as caught:
        process.answer(lambda: False)
    assert caught.value.exit_code == 2
    process.close()


def test_waiting_can_be_interrupted() -> None:
    process = Process(FIRST, command=[sys.executable, "-c", "import time; time.sleep(60)"])
    with pytest.raises(Stopped):
        process.answer(lambda: True)
    process.close()
    process.close()


def test_last_messages() -> None:
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


@pytest.mark.parametrize(("entries", "expected"), [(0, 0), (5, 40), (9, 72)])
def test_scratch_bytes_of_a_real_kernel(entries: int, expected: int) -> None:
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
