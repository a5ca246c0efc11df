"""metrics.jsonl: its keys, what has no number, and lines that a crash cut short."""

from __future__ import annotations

import errno
import json
import math

import pytest
from cli.calling import read_metrics

from reslrb_cli.errors import ConfigError
from reslrb_cli.records import measurement_files
from reslrb_cli.records.checkpoint import save_checkpoint
from reslrb_cli.records.measurement_files import read_lines
from reslrb_cli.records.metrics import MetricsWriter, Record

KEYS = [
    "iteration", "loss", "step_ms", "primal_ms", "adjoint_ms", "codegen_ms", "elapsed_s", "peak_mib", "spp", "lr",
    "grad_norm", "nonfinite", "parameter_rmse", "parameter_errors", "nonfinite_by_parameter",
    "clamped", "held_out",
]  # fmt: skip


def make_record(**changes):
    values = {
        "iteration": 0, "loss": 0.5, "step_ms": 3.0, "primal_ms": None, "adjoint_ms": None, "codegen_ms": 1.0,
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


def test_a_torn_last_line_is_mended_before_another_follows(tmp_path):
    with MetricsWriter(tmp_path) as writer:
        writer.write(make_record())
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 1, "lo')
    with MetricsWriter(tmp_path) as writer:
        assert (tmp_path / "metrics.jsonl").read_text().endswith("}\n")
        writer.write(make_record(iteration=1))
    assert [record["iteration"] for record in read_metrics(tmp_path)] == [0, 1]


def test_no_file_is_no_records(tmp_path):
    with MetricsWriter(tmp_path):
        assert list(tmp_path.iterdir()) == []  # nor is one ever seen empty


def test_a_line_that_does_not_fit_leaves_whole_ones(tmp_path, file_size_limit):
    line = len(make_record().to_json()) + 1
    with MetricsWriter(tmp_path) as writer:
        writer.write(make_record())
        with file_size_limit(line + 10), pytest.raises(OSError, match=r"metrics\.jsonl") as error:
            writer.write(make_record())
        assert error.value.errno == errno.EFBIG
        assert (tmp_path / "metrics.jsonl").stat().st_size == line
        writer.write(make_record(iteration=1))
    assert [record["iteration"] for record in read_metrics(tmp_path)] == [0, 1]


def test_a_file_that_was_removed_is_missed(tmp_path):
    with MetricsWriter(tmp_path) as writer:
        writer.write(make_record())
        (tmp_path / "metrics.jsonl").unlink()
        with pytest.raises(FileNotFoundError, match="removed while the run went on"):
            writer.write(make_record())


def test_a_checkpoint_can_be_read_by_numpy(tmp_path):
    import numpy as np

    for iteration in (5, 6):
        save_checkpoint(tmp_path, iteration, {"a.data": np.full((2, 2, 3), 0.5)}, {"optimizer/a.data/0": np.array([6])})
    with np.load(tmp_path / "state.npz") as state:
        assert int(state["iteration"]) == 6
        assert state["parameter/a.data"].shape == (2, 2, 3)
        assert state["optimizer/a.data/0"] == 6
    assert sorted(path.name for path in tmp_path.iterdir()) == ["previous.npz", "state.npz"]


def test_what_is_not_finite_or_no_line_is_told_when_a_file_is_read(tmp_path):
    file = tmp_path / "metrics.jsonl"
    lines = (
        '{"a": 1e999, "b": [-1e999, NaN, {"c": Infinity}], "d": 1.5, "e": 7}', "", "[1]", '{"a": ', "\xe9"
    )  # fmt: skip
    file.write_bytes(b"\xef\xbb\xbf" + "\n".join(lines).encode("latin-1") + b'\n{"a": 2}')
    found = read_lines(file)
    assert found.objects == [{"a": None, "b": [None, None, {"c": None}], "d": 1.5, "e": 7}, {"a": 2}]
    assert found.damaged == [3, 4, 5]
    file.write_text('{"a": 2}\n{"a"')
    assert read_lines(file).damaged == []  # somebody is about to end it


def test_a_file_that_grows_too_large_while_it_is_read_is_refused(tmp_path, monkeypatch):
    file = tmp_path / "metrics.jsonl"
    file.write_text("{}\n" * 10)
    monkeypatch.setattr(measurement_files, "MOST_BYTES", 20)
    with pytest.raises(ConfigError, match="has 30 B"):
        read_lines(file)
    monkeypatch.setattr(measurement_files, "open_file", lambda path, most: path.open("rb"))
    with pytest.raises(ConfigError, match="has more than 20 B"):
        read_lines(file)
