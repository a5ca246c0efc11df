"""Whole optimisations on a page: their curves, bands and table."""

from __future__ import annotations

import json

import pytest
from report.measured import convergence_lines, runs_lines
from report.test_page import Page
from report.test_several import lines_drawn

from reslrb_cli.report.page import render
from reslrb_cli.report.page.layout import COLORS
from reslrb_cli.report.sources import read_sources


def test_whole_runs(tmp_path):
    lines = [*runs_lines(), {"kind": "run_method", "label": "prb", "status": "out_of_memory", "message": "<ended>"}]
    lines += [{"kind": "run_best", "label": "x", "line": "error of x: 0.5 [0.4, 0.6] times that of ptracer"}]
    (tmp_path / "c.jsonl").write_text("".join(json.dumps(line) + "\n" for line in [*lines, {"kind": "news"}]))
    markup = render(read_sources([tmp_path / "c.jsonl"]))
    page, title = Page(markup), "Error against run time: c.jsonl"
    assert page.row(title, "ptracer, batched")[1:] == [
        "3", "4 s", "30 [28, 33]", "1.5 [1.4, 1.7]", "2.5 [1.25, 3.75]", "0.25 [0.125, 0.375]"]  # fmt: skip
    assert page.row(title, "prb")[:2] == ["prb out of memory", ""]
    assert "prb: <ended>" in page.sections[title]
    assert "best by the loss is reslrb:stack" in page.sections[title]
    assert "1 line of other kinds" in page.sections[title]
    assert "0.5 [0.4, 0.6] times that of ptracer" in page.sections[title]
    assert lines_drawn(markup) == [list(COLORS[:2])] * 2  # loss, and the parameters' error


def test_curves_of_whole_runs_are_medians_with_bands_from_the_least_to_the_greatest(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("reslrb_cli.report.page.measured.diagram", lambda curves, *_: drawn.append(curves) or "")
    (tmp_path / "c.jsonl").write_text("".join(json.dumps(line) + "\n" for line in runs_lines()))
    render(read_sources([tmp_path / "c.jsonl"]))
    losses, errors = drawn
    assert [curve.name for curve in losses] == ["ptracer, batched", "reslrb:stack, batched"]
    assert (losses[0].xs, losses[0].ys) == ([1.0, 2.0, 4.0], [10.0, 5.0, 2.5])
    assert losses[0].band == ([5.0, 2.5, 1.25], [15.0, 7.5, 3.75])
    assert errors[1].ys == pytest.approx([0.2, 0.1, 0.05])


def test_whole_runs_beside_gradients_and_runs_without_figures(tmp_path):
    lines = [*convergence_lines(), *runs_lines(finite=False), {"kind": "run_point"}, {"kind": "run_method"}]
    (tmp_path / "c.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    markup = render(read_sources([tmp_path / "c.jsonl"]))
    assert lines_drawn(markup) == [list(COLORS[:2])] * 2  # of the gradients, and of the runs' errors
    assert "of other kinds" not in markup
