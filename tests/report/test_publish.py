"""Figures and tables of measurements, sweeps and runs: their content, and what they refuse."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib.figure import Figure
from report.measured import (
    FLOOR,
    ORIGIN,
    convergence_lines,
    make_run,
    write_bench,
    write_convergence,
    write_gradcheck,
    write_sweep,
)

import reslrb_cli as rl
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.measurements import BenchStatus, Method, MethodRecord, PointRecord, Range
from reslrb_cli.report.panels import TIME
from reslrb_cli.report.plots import COLORS, FLOOR_STYLE, Curve, Panel, draw
from reslrb_cli.report.publish import WIDTH, as_csv, as_latex, escaped, figure, panels_of, rows_of, write
from reslrb_cli.report.sources import read_sources

HOSTILE = r"own_\{x}#1%&$~^<|>-- $\input{/etc/passwd}$"


def sources(*paths):
    return read_sources(list(paths))


def write_depths(folder, depths=(2, 4, 8)):
    """Write a convergence for each depth. The efficiency of `ptracer` is 4 with the interval [3, 5]."""
    for depth in depths:
        lines = [line | {"max_depth": depth} for line in convergence_lines()]
        (folder / f"{depth}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return [folder / f"{depth}.jsonl" for depth in depths]


def write_hostile(path):
    """Write a convergence with a method whose name has characters of LaTeX."""
    lines = [line | ({"label": HOSTILE} if line["label"] == "ptracer" else {}) for line in convergence_lines()]
    path.write_text(ORIGIN.to_json() + "\n" + "".join(json.dumps(line) + "\n" for line in lines))
    return path


# Figures: what they draw, and how large.


def test_error_against_time_of_every_parameter(tmp_path):
    """A diagram for each parameter, one below the other, with one legend outside of the axes."""
    lines = convergence_lines(FLOOR) + convergence_lines("all")
    (tmp_path / "c").write_text("".join(json.dumps(line) + "\n" for line in lines))
    shown = panels_of(sources(tmp_path / "c"))
    assert [(panel.title, panel.x, panel.y) for panel in shown] == [
        ("all parameters", "time (s)", "relative error"), (FLOOR, "time (s)", "relative error")]  # fmt: skip
    made = figure(shown)
    made.draw_without_rendering()
    assert made.get_figwidth() == WIDTH
    (legend,) = made.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["ptracer, independent", "reslrb:stack, independent", "error of the reference"]
    top = legend.get_window_extent().ymin
    for axis in made.axes:
        assert [line.get_color() for line in axis.lines if line.get_linestyle() == "-"] == list(COLORS[:2])
        assert [line.get_linestyle() for line in axis.lines].count(FLOOR_STYLE) == 1
        assert axis.get_window_extent().ymax < top
        assert axis.get_window_extent().height > 0.9 * made.dpi  # inches
        assert [axis.get_xlabel(), axis.get_ylabel()] == ["time (s)", "relative error"]
    assert len({line.get_marker() for line in made.axes[0].lines[:2]}) == 2


def test_efficiency_against_depth(tmp_path):
    (panel,) = panels_of(sources(*write_depths(tmp_path)))
    assert (panel.x, panel.y, panel.log_x) == ("path depth", "efficiency (1/s)", 2)
    for curve in panel.curves:
        assert (list(curve.xs), list(curve.ys), curve.band) == ([2, 4, 8], [4.0] * 3, ((3.0,) * 3, (5.0,) * 3))
    # files of one depth are separate
    same = sources(tmp_path / "2.jsonl", shutil.copy(tmp_path / "2.jsonl", tmp_path / "b.jsonl"))
    assert [panel.title for panel in panels_of(same)] == ["2.jsonl: all parameters", "b.jsonl: all parameters"]


def test_time_and_memory_against_depth(tmp_path):
    write_bench(tmp_path / "b")
    time, memory = panels_of(sources(tmp_path / "b"))
    assert [time.y, memory.y, time.x] == ["time of a step (ms)", "peak memory (MiB)", "path depth"]
    naive, ours = time.curves
    assert (naive.xs, naive.ys[:2]) == ([2, 4, 8], (6.0, 12.0))
    assert len(naive.known()) == 2  # the last one ran out of memory
    assert ours.band == (pytest.approx([1.8, 3.6, 7.2]), pytest.approx([2.4, 4.8, 9.6]))
    assert len(memory.curves[0].known()) == 2


def test_errors_of_whole_runs(tmp_path):
    """The curve of a combination is the median over its seeds. The loss is drawn only if no error is known."""
    write_sweep(tmp_path / "s", seeds=3)
    (panel,) = panels_of(sources(tmp_path / "s"))
    assert (panel.x, panel.y) == (TIME, "relative error of the parameters")
    assert [curve.name for curve in panel.shown()] == ["spp=4", "spp=8"]
    assert all(len(curve.band[0]) == len(curve.xs) == 30 for curve in panel.shown())
    runs = [make_run(tmp_path / name, truth=False, iterations=3) for name in ("a", "b")]
    (panel,) = panels_of(sources(*runs))
    assert (panel.y, [curve.name for curve in panel.shown()]) == ("loss", ["a", "b"])


@pytest.mark.parametrize("suffix", ["pdf", "svg", "png", "PDF"])
def test_files_are_repeatable(tmp_path, suffix):
    path = write_hostile(tmp_path / "c")
    for name in ("a", "b"):
        write(sources(path), tmp_path / f"{name}.{suffix}", "-o")
    first, second = ((tmp_path / f"{name}.{suffix}").read_bytes() for name in ("a", "b"))
    assert first == second
    begins = {"pdf": b"%PDF", "svg": b"<?xml", "png": b"\x89PNG"}[suffix.lower()]
    assert first.startswith(begins)
    assert b"/Type3" not in first  # journals refuse such fonts


# Tables: CSV, arrays and LaTeX.


def test_a_csv_has_plain_numbers(tmp_path):
    write_convergence(tmp_path / "c")
    write(sources(tmp_path / "c"), tmp_path / "c.csv", "-o")
    rows = list(csv.DictReader(io.StringIO((tmp_path / "c.csv").read_text())))
    assert [row["label"] for row in rows] == ["ptracer", "reslrb:stack"]
    row = rows[0]
    assert [float(row[name]) for name in ("efficiency", "efficiency_low", "efficiency_high", "seconds_to_0.03")] == [
        4.0, 3.0, 5.0, 120.0]  # fmt: skip
    assert (row["seconds_to_0.01"], row["adjoint"], row["biased"], row["extrapolated"]) == (
        "",
        "independent",
        "0",
        "0.03",
    )
    assert "kind" not in row


def test_tables_of_other_measurements(tmp_path):
    write_bench(tmp_path / "b")
    write_gradcheck(tmp_path / "g")
    write_sweep(tmp_path / "s", seeds=2)
    bench = rl.table(tmp_path / "b")
    assert bench["max_depth"].tolist() == [2, 2, 4, 4, 8, 8]
    np.testing.assert_allclose(bench["step_ms_high"], [7.2, 2.4, 14.4, 4.8, np.nan, 9.6])
    assert bench["status"].tolist()[-2:] == ["out_of_memory", "ok"]
    assert rl.table(str(tmp_path / "g"))["verdict"].tolist() == ["holds", "fails"]
    sweep = rl.table(tmp_path / "s")
    assert (sweep["settings_run.spp"].tolist(), sweep["runs"].tolist()) == ([4, 8], [2, 2])
    assert sweep["loss"].tolist() == [0.5, 0.5]
    assert rl.table(tmp_path / "s", "sweep_run")["seed"].tolist() == [0, 0, 1, 1]
    assert next(iter(rl.table([tmp_path / "b", tmp_path / "b"]))) == "source"


def test_records_become_arrays_and_figures(tmp_path):
    """The records of a measurement need no file."""
    method = Method("prb", {}, 4)
    points = [PointRecord(method, "image", n, float(n), 1 / n, 0.01, 8, 0.9 / n, 1.1 / n) for n in (1, 2, 4)]
    records = [
        *points,
        MethodRecord(
            method=method, parameter="image", status=BenchStatus.OK, efficiency=Range(2.0, 1.5, 2.5), biased=True
        ),
    ]
    (found,) = zip(*(rl.table(records)[name] for name in ("efficiency_low", "biased", "bias")), strict=True)
    assert found[:2] == (1.5, 1.0)
    assert np.isnan(found[2])
    assert rl.table(records, "point")["high"].tolist() == [1.1, 0.55, 0.275]
    assert rl.write_report(records, tmp_path / "f.svg") == tmp_path / "f.svg"
    assert (tmp_path / "f.svg").exists()


def test_a_latex_table(tmp_path):
    write_hostile(tmp_path / "c")
    lines = as_latex(sources(tmp_path / "c")).splitlines()
    assert lines[:2] == [
        "% needs \\usepackage{booktabs}",
        "% a machine, 3 threads, llvm_ad_rgb: reslrb bench my <box>.yaml",
    ]
    assert lines[2:4] == ["\\begin{tabular}{lrrrrrrr}", "\\toprule"]
    cells = [
        [cell.strip() for cell in line.removesuffix(" \\\\").split(" & ")] for line in lines if line.endswith("\\\\")
    ]
    assert cells[0][:5] == ["method", "step (s)", "error of a step", "efficiency (1/s)", "bias"]
    assert cells[2][3:] == ["$4.0$ [$3.0$, $5.0$]", "", "3.5", "$\\sim$120", ""]
    assert lines[-2:] == ["\\bottomrule", "\\end{tabular}"]


def unescaped(text):
    """Return the characters that LaTeX prints, by the commands of a document without packages."""
    commands = {"textbackslash": "\\", "textasciicircum": "^", "sim": "~"}
    text = re.sub(r"\\([a-z]+)(?:\{\})?", lambda found: f"\0{commands[found[1]]}", text)
    return re.sub(r"\\(.)|\$|\{(-)\}|\0(.)", lambda found: found[1] or found[2] or found[3] or "", text)


def test_names_are_escaped():
    for text in (HOSTILE, "reslrb:stack(paths=both)", "a_b", "%\\$", "{}", "10%"):
        assert unescaped(escaped(text)) == text
    assert re.findall(r"(?<!\\)[%&#_]", escaped(HOSTILE)) == []


def test_depths_are_a_column(tmp_path):
    text = as_latex(sources(*write_depths(tmp_path)))
    assert [line.split(" & ")[:2] for line in text.splitlines() if "ptracer" in line] == [
        ["ptracer, independent", f"${depth}$"] for depth in (2, 4, 8)]  # fmt: skip


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_latex_compiles_the_tables(tmp_path):
    write_hostile(tmp_path / "c")
    write_bench(tmp_path / "b")
    write_gradcheck(tmp_path / "g")
    write_sweep(tmp_path / "s", seeds=2)
    for name in "cbgs":
        write(sources(tmp_path / name), tmp_path / f"{name}.tex", "-o")
    inputs = "\n\n".join(f"\\input{{{name}.tex}}" for name in "cbgs")
    text = f"\\documentclass{{article}}\\usepackage{{booktabs}}\\begin{{document}}\n{inputs}\n\\end{{document}}\n"
    (tmp_path / "paper.tex").write_text(text)
    words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]


# What has no figure or table is refused in one line.


def test_missing_outputs_are_refused(tmp_path):
    write_bench(tmp_path / "b")
    write_gradcheck(tmp_path / "g")
    write_convergence(tmp_path / "c")
    make_run(tmp_path / "r", iterations=0)
    (tmp_path / "p").write_text(json.dumps(convergence_lines()[0]) + "\n")
    for names, file, words in (
        ("b", "x.gif", "-o: x.gif has an unknown suffix; the suffixes are .html, .csv, .tex, .pdf, .svg, .png"),
        ("g", "x.pdf", "is of gradcheck, which has no figure"),
        ("r", "x.pdf", "has no results to draw yet"),
        ("r", "x.csv", "is a run, which has no table"),
        ("bc", "x.tex", "is of convergence, and .* is of bench; give files of one kind"),
        ("p", "x.csv", "has no results for a table"),
    ):
        with pytest.raises(ConfigError, match=words):
            write(sources(*(tmp_path / name for name in names)), tmp_path / file, "-o")
        assert not (tmp_path / file).exists()
    with pytest.raises(ConfigError, match="has no results of the kind 'points' for a table"):
        rl.table(tmp_path / "c", "points")


def test_csv_quotes_names(tmp_path):
    write_hostile(tmp_path / "c")
    rows = list(csv.DictReader(io.StringIO(as_csv(rows_of(sources(tmp_path / "c"))))))
    assert rows[0]["label"] == HOSTILE


@pytest.mark.parametrize(("lowest", "scale"), [(0.0, "linear"), (1e-3, "log")])
def test_only_positive_values_have_a_logarithmic_axis(lowest, scale):
    axis = Figure().subplots()
    draw(axis, Panel("", "x", "y", [Curve("a", [1, 2, 3], [lowest, 1, 1e6])]))
    assert axis.get_yscale() == scale
