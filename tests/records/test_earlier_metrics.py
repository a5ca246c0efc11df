"""The part of `metrics.jsonl` that a run goes on from."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.records.metrics import Clamped, MetricsWriter, Record, cut_back, finite, read_records

RECORD = Record(
    iteration=0, loss=0.1 + 0.2, step_ms=1.5, primal_ms=None, adjoint_ms=None, codegen_ms=0.0, elapsed_s=1 / 3,
    peak_mib=3.0, spp=4, lr=0.02, grad_norm=math.nan, nonfinite=2, parameter_rmse=None,
    parameter_errors={"a": 0.1}, nonfinite_by_parameter={"a": 2}, clamped=Clamped(3, {"a": 0.5}, {"a": 1e-3}),
    held_out=0.7,
)  # fmt: skip


def written(folder: Path, count: int) -> list[Record]:
    records = [replace(RECORD, iteration=number) for number in range(count)]
    with MetricsWriter(folder) as metrics:
        for record in records:
            metrics.write(record)
    return records


def text(record: Record) -> str:
    return json.dumps(finite(asdict(record)))


def test_records_are_what_they_were(tmp_path: Path) -> None:
    records = written(tmp_path, 5)
    found, size = read_records(tmp_path, 3, None)
    assert list(map(text, found)) == list(map(text, records[:3]))
    assert math.isnan(found[0].grad_norm)
    assert isinstance(found[0].clamped, Clamped)
    cut_back(tmp_path, found, size)
    assert (tmp_path / "metrics.jsonl").read_text().splitlines() == list(map(text, records[:3]))


@pytest.mark.parametrize("kept", [0, 2])
def test_the_last_line_is_put_back(tmp_path: Path, kept: int) -> None:
    records = written(tmp_path, kept)
    last = replace(RECORD, iteration=kept)
    found, size = read_records(tmp_path, kept + 1, finite(asdict(last)))
    cut_back(tmp_path, found, size)
    assert (tmp_path / "metrics.jsonl").read_text() == "".join(f"{text(each)}\n" for each in (*records, last))


def test_a_run_before_its_first_iteration_has_no_lines(tmp_path: Path) -> None:
    written(tmp_path, 2)
    cut_back(tmp_path, *read_records(tmp_path, 0, None))
    assert list(tmp_path.iterdir()) == []


BAD = {
    "another iteration": '{"iteration": 5}',
    "no record": "[1]",
    "half": '{"iteration": 0, "lo',
    "a nest": "[" * 100_000,
    "text": text(RECORD).replace('"spp": 4', '"spp": "4"'),
    "another name": text(RECORD).replace('"spp"', '"spq"'),
    "true": text(RECORD).replace('"iteration": 0', '"iteration": true'),
    "a list of errors": text(RECORD).replace('{"a": 0.1}', "[0.1]"),
    "infinity": text(RECORD).replace("1.5", "1e999"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_no_run_wrote_is_located(tmp_path: Path, case: str) -> None:
    (tmp_path / "metrics.jsonl").write_text(BAD[case] + "\n")
    with pytest.raises(ConfigError, match=r"metrics\.jsonl: line 1: is not what a run writes"):
        read_records(tmp_path, 1, None)


def test_lines_that_are_missing_are_told(tmp_path: Path) -> None:
    written(tmp_path, 2)
    with pytest.raises(ConfigError, match="holds 2 of the 4 iterations of the checkpoint"):
        read_records(tmp_path, 4, finite(asdict(replace(RECORD, iteration=3))))
