"""Files of measurements while these go on: whole, current, and enough to go on from."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from reslrb_cli.cli.options import Keeper, read_earlier
from reslrb_cli.errors import ConfigError
from reslrb_cli.records import measurement_files
from reslrb_cli.records.measurement_files import LineFile
from reslrb_cli.records.measurements import SummaryRecord
from reslrb_cli.runs import recorder


def lines(*words: str) -> list[SummaryRecord]:
    return [SummaryRecord(word) for word in words]


def read(path: Path) -> list[str]:
    """What stands in the lines after the first, which says what measured."""
    origin, *others = [json.loads(line) for line in path.read_text().splitlines()]
    assert origin == {"kind": "summary", "line": "here"}
    return [line["line"] for line in others]


class Measurement:
    """A measurement whose lines and samples a test changes as it goes on."""

    def __init__(self, file: Path) -> None:
        self.final, self.now, self.rows = lines(), lines(), np.zeros(0)
        self.keeper = Keeper(file, *lines("here"), lambda: self.final, lambda: self.now, self.kept)

    def kept(self) -> measurement_files.Kept | None:
        return ({"rows": len(self.rows)}, {"rows": self.rows}) if len(self.rows) else None


def test_both_files_are_current_and_those_of_another_measurement_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measurement_files, "PAGE_SECONDS", 0.0)
    monkeypatch.setattr(measurement_files, "PAGE_SHARE", 0.0)
    file = tmp_path / "c.jsonl"
    file.write_text("old\n")
    measurement_files.write_samples(measurement_files.samples_file(file), {"rows": 9}, {})
    (tmp_path / ".c.samples.npz.999999999.part").write_bytes(b"what a killed process left")
    measured = Measurement(file)
    assert (file.read_text(), read_earlier(file)[0]) == ("old\n", {"rows": 9})  # until there is something
    measured.now = lines("a")
    measured.keeper.refresh()
    assert read(file) == ["a"]
    with pytest.raises(ConfigError, match=r"c\.samples\.npz: no such file"):
        read_earlier(file)
    measured.final, measured.now, measured.rows = lines("a"), lines("b"), np.ones(3)
    measured.keeper.refresh()
    assert read(file) == ["a", "b"]
    head, arrays = read_earlier(file)
    assert (head, list(arrays["rows"])) == ({"rows": 3}, [1.0] * 3)
    measured.keeper.finish(lines("a", "c"))
    assert read(file) == ["a", "c"]
    assert {path.name for path in tmp_path.iterdir()} == {"c.jsonl", "c.samples.npz"}


def test_it_is_written_every_few_seconds_and_costs_a_twentieth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, written = [100.0], []
    monkeypatch.setattr(recorder.time, "monotonic", lambda: now[0])
    measured = Measurement(tmp_path / "c.jsonl")

    def slowly(path: Path, head: object, arrays: object) -> None:
        written.append(now[0])
        now[0] += 1.0

    monkeypatch.setattr("reslrb_cli.cli.options.write_samples", slowly)
    measured.rows = np.ones(1)
    for _ in range(100):
        measured.keeper.refresh()
        now[0] += 1.0
    assert len(written) in (4, 5)
    assert np.diff(written).min() >= 20


def test_what_cannot_be_written_on_the_way_ends_nothing_and_is_told_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "c.jsonl"
    measured = Measurement(file)
    measured.keeper.refresh()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", str(file))

    monkeypatch.setattr("reslrb_cli.records.measurement_files.write_atomically", full)
    measured.keeper.refresh()
    with pytest.raises(OSError, match="No space left"):
        measured.keeper.finish(lines("a"))


def test_samples_that_are_too_large_are_not_kept_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(measurement_files, "MOST_SAMPLES_BYTES", 100)
    measured = Measurement(tmp_path / "c.jsonl")
    measured.rows = np.ones(13)
    measured.keeper.finish(lines("a"))
    assert "--resume cannot go on from it" in capsys.readouterr().out
    assert not measurement_files.samples_file(tmp_path / "c.jsonl").exists()


def test_a_pipe_has_each_line_once_as_it_comes(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    file = LineFile(tmp_path / "pipe")
    file.write(lines("a"), lines("not yet"))
    assert os.read(reader, 1000) == b'{"kind": "summary", "line": "a"}\n'
    file.write(lines("a", "b"))
    assert os.read(reader, 1000) == b'{"kind": "summary", "line": "b"}\n'
    file.close()
    os.close(reader)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_what_a_link_points_to_is_written(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "c.jsonl")
    LineFile(tmp_path / "link").write(lines("here", "a"))
    assert (tmp_path / "link").is_symlink()
    assert read(tmp_path / "c.jsonl") == ["a"]
