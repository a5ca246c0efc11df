"""Versions, and the command that does it again, on the page of every kind of file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from report.measured import ORIGIN, runs_lines, write_bench, write_convergence, write_gradcheck
from report.test_several import page_of

from reslrb_cli.errors import ConfigError
from reslrb_cli.report.page import render
from reslrb_cli.report.page.run import DAMAGED
from reslrb_cli.report.sources import read_sources


def write_runs(path: Path) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in runs_lines()))


KINDS = {
    "Cost of a step": write_bench,
    "Gradients against references": write_gradcheck,
    "Error against run time": write_convergence,
    "Error against run time, whole runs": write_runs,
}


@pytest.mark.parametrize("heading", KINDS)
def test_the_page_says_what_does_it_again(tmp_path: Path, heading: str) -> None:
    file = tmp_path / "a.jsonl"
    KINDS[heading](file)
    title = f"{heading.partition(',')[0]}: a.jsonl"
    without = page_of(file)
    assert "versions" not in without.sections[title]  # an older file
    file.write_text(ORIGIN.to_json() + "\n" + file.read_text())
    markup = render(read_sources([file]))
    page = page_of(file)
    assert DAMAGED not in markup
    assert "left out" not in page.sections[title]
    assert "reslrb bench 'my <box>.yaml'" in page.sections[title]
    for words in ("mitsuba 3.9.1", "Plan 9", "a machine, 3 threads", "llvm_ad_rgb", "2026-01-02 03:04:05 UTC"):
        assert words in page.sections[title]
    assert without.cells[title][:2] == page.cells[title][:2]


def test_two_files_in_one_have_two_origins(tmp_path: Path) -> None:
    write_bench(tmp_path / "a")
    other = json.loads(ORIGIN.to_json()) | {"command": ["reslrb", "bench", "--rounds", "7"]}
    text = (tmp_path / "a").read_text()
    (tmp_path / "a").write_text(f"{ORIGIN.to_json()}\n{text}{json.dumps(other)}\n{text}")
    told = page_of(tmp_path / "a").sections["Cost of a step: a"]
    assert told.count("to do it again") == 2
    assert "reslrb bench --rounds 7" in told


def test_an_origin_alone_is_no_measurement(tmp_path: Path) -> None:
    (tmp_path / "a").write_text(ORIGIN.to_json() + "\n")
    with pytest.raises(ConfigError, match="holds no line that"):
        read_sources([tmp_path / "a"])


def test_a_damaged_origin_leaves_the_rest(tmp_path: Path) -> None:
    write_bench(tmp_path / "a")
    text = (tmp_path / "a").read_text()
    (tmp_path / "a").write_text(json.dumps({"kind": "origin", "command": 3, "versions": "x"}) + "\n" + text)
    markup = render(read_sources([tmp_path / "a"]))
    assert DAMAGED not in markup
    assert "to do it again" not in markup
