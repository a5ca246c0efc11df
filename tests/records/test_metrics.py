"""metrics.jsonl and files of measurements: keys, incomplete lines, and the data from which a run continues."""

from __future__ import annotations

import errno
import json
import math
import os
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import read_metrics

from reslrb_cli.errors import ConfigError
from reslrb_cli.records import clock as clocks
from reslrb_cli.records.checkpoint import save_checkpoint
from reslrb_cli.records.clock import summarise
from reslrb_cli.records.manifest import versions
from reslrb_cli.records.measurement_files import LivePage, Origin, read_lines
from reslrb_cli.records.metrics import (
    MetricsWriter,
    NonFiniteTally,
    Record,
    Regularized,
    RegularizedTally,
    cut_back,
    finite,
)

# metrics.jsonl: its keys, values without a number, and lines that a crash cut short.

KEYS = [
    "iteration", "loss", "step_ms", "codegen_ms", "elapsed_s", "peak_mib", "spp", "lr",
    "grad_norm", "nonfinite", "parameter_rmse", "parameter_errors", "nonfinite_by_parameter",
    "held_out", "regularized", "curvature_s",
]  # fmt: skip


def make_record(**changes):
    values = {
        "iteration": 0, "loss": 0.5, "step_ms": 3.0, "codegen_ms": 1.0,
        "elapsed_s": 0.1, "peak_mib": 2.0, "spp": 16, "lr": 0.02, "grad_norm": 1.0, "nonfinite": 0,
        "parameter_rmse": None,
    }  # fmt: skip
    return Record(**{**values, **changes})


def test_a_record_has_the_documented_keys_in_order():
    assert list(json.loads(make_record().to_json())) == KEYS


def test_non_finite_numbers_become_null():
    line = make_record(loss=math.nan, grad_norm=math.inf, nonfinite=3, parameter_errors={"a": math.inf}).to_json()
    content = json.loads(line, parse_constant=lambda name: (_ for _ in ()).throw(ValueError(name)))
    assert content["parameter_errors"] == {"a": None}
    assert (content["loss"], content["grad_norm"], content["nonfinite"]) == (None, None, 3)


def test_each_line_is_on_disk_at_once(tmp_path):
    with MetricsWriter(tmp_path) as writer:
        for iteration in range(3):
            writer.write(make_record(iteration=iteration))
            assert [record["iteration"] for record in read_metrics(tmp_path)] == list(range(iteration + 1))


def test_a_torn_last_line_is_repaired_before_the_next_one(tmp_path):
    with MetricsWriter(tmp_path) as writer:
        writer.write(make_record())
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 1, "lo')
    with MetricsWriter(tmp_path) as writer:
        assert (tmp_path / "metrics.jsonl").read_text().endswith("}\n")
        writer.write(make_record(iteration=1))
    assert [record["iteration"] for record in read_metrics(tmp_path)] == [0, 1]


def test_an_incomplete_line_leaves_complete_ones(tmp_path, file_size_limit):
    line = len(make_record().to_json()) + 1
    with MetricsWriter(tmp_path) as writer:
        writer.write(make_record())
        with file_size_limit(line + 10), pytest.raises(OSError, match=r"metrics\.jsonl") as error:
            writer.write(make_record())
        assert error.value.errno == errno.EFBIG
        assert (tmp_path / "metrics.jsonl").stat().st_size == line
        writer.write(make_record(iteration=1))
    assert [record["iteration"] for record in read_metrics(tmp_path)] == [0, 1]


def test_lines_are_flushed_before_a_checkpoint(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: flushed.append(os.fstat(descriptor).st_size))
    with MetricsWriter(tmp_path) as writer:
        writer.sync()
        assert flushed == []
        writer.write(make_record())
        writer.sync()
        assert flushed == [(tmp_path / "metrics.jsonl").stat().st_size]


def test_a_removed_file_is_detected(tmp_path):
    with MetricsWriter(tmp_path) as writer:
        writer.write(make_record())
        (tmp_path / "metrics.jsonl").unlink()
        with pytest.raises(FileNotFoundError, match="removed while the run went on"):
            writer.write(make_record())


def test_a_checkpoint_can_be_read_by_numpy(tmp_path):
    import numpy as np

    for iteration in (5, 6):
        save_checkpoint(
            tmp_path, iteration, {"parameter/a.data": np.full((2, 2, 3), 0.5), "optimizer/a.data/0": np.array([6])}
        )
    with np.load(tmp_path / "state.npz") as state:
        assert int(state["iteration"]) == 6
        assert state["parameter/a.data"].shape == (2, 2, 3)
        assert state["optimizer/a.data/0"] == 6
    assert sorted(path.name for path in tmp_path.iterdir()) == ["previous.npz", "state.npz"]


def test_non_finite_values_and_bad_lines_are_reported_on_reading(tmp_path):
    file = tmp_path / "metrics.jsonl"
    lines = ('{"a": 1e999, "b": [-1e999, NaN, {"c": Infinity}], "d": 1.5, "e": 7}', "", "[1]")
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(ConfigError, match=r"metrics\.jsonl: line 3: is damaged"):
        read_lines(file)
    file.write_text("\n".join(lines[:2]) + '\n{"a": 2}\n{"a"')  # a writer may still complete the last line
    assert read_lines(file) == [{"a": None, "b": [None, None, {"c": None}], "d": 1.5, "e": 7}, {"a": 2}]


# The log of a run, and its state after the run is resumed.

RECORD = Record(
    iteration=0, loss=0.1 + 0.2, step_ms=1.5, codegen_ms=0.0, elapsed_s=1 / 3,
    peak_mib=3.0, spp=4, lr=0.02, grad_norm=math.nan, nonfinite=2, parameter_rmse=None,
    parameter_errors={"a": 0.1}, nonfinite_by_parameter={"a": 2},
    held_out=0.7, regularized=Regularized({"a": {"thickness": 0.5}}, {"a": 3}),
)  # fmt: skip


def written(folder: Path, count: int) -> list[str]:
    records = [replace(RECORD, iteration=number) for number in range(count)]
    with MetricsWriter(folder) as metrics:
        for record in records:
            metrics.write(record)
    return [json.dumps(finite(asdict(record))) for record in records]


#: Places of the lines of five iterations in a damaged log, by the damage, and the iterations that remain of four.
DAMAGES: dict[str, tuple[list[int | str], list[int]]] = {
    "none": ([0, 1, 2, 3, 4], [0, 1, 2, 3]),
    "short": ([0, 1], [0, 1]),
    "empty": ([], []),
    "a line is missing": ([0, 2, 3, 4], [0, 2, 3]),
    "a line is twice": ([0, 1, 1, 2, 3], [0, 1, 2, 3]),
    "other lines": ([0, "[1]", "[" * 100_000, "nothing", '{"iteration": "1"}', "\0" * 9, 3, 4], [0, 3]),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_log_is_cut_back_to_the_iterations_of_a_state(tmp_path: Path, damage: str) -> None:
    lines, (places, kept) = written(tmp_path, 5), DAMAGES[damage]
    file = tmp_path / "metrics.jsonl"
    file.write_text("".join(f"{lines[each] if isinstance(each, int) else each}\n" for each in places) + '{"iterat')
    assert cut_back(tmp_path, 4) == 4 - len(kept)
    assert file.exists() == bool(kept)
    if kept:
        assert file.read_text().splitlines() == [lines[each] for each in kept]
    assert cut_back(tmp_path, 0) == 0
    assert list(tmp_path.iterdir()) == []


def test_a_line_without_its_end_is_dropped(tmp_path: Path) -> None:
    """The next line would continue it."""
    lines = written(tmp_path, 3)
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines))
    assert cut_back(tmp_path, 3) == 1
    assert (tmp_path / "metrics.jsonl").read_text() == f"{lines[0]}\n{lines[1]}\n"


def test_iterations_with_values_that_are_not_finite_are_counted():
    tally = NonFiniteTally()
    for count in (0, 1, 3):
        tally.add(make_record(nonfinite=count, nonfinite_by_parameter={"a": count} if count else {}))
    assert (tally.iterations, tally.values, tally.by_parameter) == (2, 4, {"a": 4})
    assert str(tally) == "4 values not finite (a 4) in 2 iterations"


def test_costs_of_regularizers_are_the_last_ones_and_held_heights_are_counted():
    tally = RegularizedTally()
    assert str(tally) == ""
    for held in ({"face": 3}, {"face": 0}, {"face": 2, "back": 1}):
        tally.add(make_record(regularized=Regularized({"face": {"smooth": 0.125, "total": 0.0}}, held)))
    tally.add(make_record())
    assert (tally.iterations, tally.held_iterations) == (3, 2)
    assert str(tally) == (
        "beside the loss: smooth of face 0.125, heights held at the least thickness in 2 iterations (3 at last)"
    )


def test_a_clock_adds_up_its_steps_and_counts_new_kernels(llvm, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(clocks, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    clock, found = clocks.StepClock(10.0), []
    for factor, seconds in ((2, 1.0), (2, 2.0), (3, 4.0), (2, 8.0)):
        with clock.step() as times:
            now[0] += seconds
            dr.eval(dr.arange(mi.Float, 7 + factor) * factor)
        found.append((times.wall_ms, times.new_kernels, len(clock.history)))
    monkeypatch.setattr(dr, "sync_thread", lambda: now.append(now.pop() + 8))  # kernels that are at work
    with clock.counted():
        pass
    assert found == [(1000.0, 1, 1), (2000.0, 0, 1), (4000.0, 1, 1), (8000.0, 0, 1)]
    assert clock.elapsed_s == 33.0


def test_compilation_counts_as_code_generation():
    history = [{"execution_time": 1.0, "codegen_time": 2.0, "backend_time": 4.0}, {"execution_time": 8.0}, {}]
    assert summarise(history) == (9.0, 6.0)


def test_a_page_takes_a_small_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is written at most every 5 seconds, and takes at most a twentieth of the time. A failure is its last one."""
    now, written, takes = [100.0], list[float](), [0.1, 2.0, 0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    def write() -> None:
        written.append(now[0])
        now[0] += takes.pop(0)  # the fourth time fails

    page = LivePage(write)
    for tenth in range(1000, 2000):
        now[0] = max(now[0], tenth / 10)
        page.refresh()
    np.testing.assert_allclose(written, [100, 105.1, 147.1, 152.1])


# The first line of a file of measurements.


def test_the_file_names_the_command_and_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/home/me/.venv/bin/reslrb", "bench", "a b.yaml", "\x1b[31m", "--rounds", "3"])
    entry = json.loads(Origin("a machine", "llvm_ad_rgb").to_json())
    assert entry["command"][:3] == ["reslrb", "bench", "a b.yaml"]
    assert "\x1b" not in "".join(entry["command"])
    assert entry["versions"] == versions()
    assert {"reslrb", "python", "mitsuba", "drjit"} <= set(entry["versions"])
    assert (entry["device"], entry["variant"]) == ("a machine", "llvm_ad_rgb")
    assert entry["platform"]
    assert entry["written"].endswith("+00:00")
