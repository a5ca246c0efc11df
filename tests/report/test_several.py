"""Pages about several runs and measurements, whole optimisations, versions and commands."""

from __future__ import annotations

import json
import re
from pathlib import Path

import colour
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from report.measured import (
    LAMP,
    ORIGIN,
    SCALING,
    convergence_lines,
    make_run,
    write_bench,
    write_convergence,
    write_gradcheck,
    write_sweep,
)
from report.test_page import EVIL, Page

from reslrb_cli.errors import ConfigError
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.manifest import Status
from reslrb_cli.report.page import render
from reslrb_cli.report.page.layout import diagram
from reslrb_cli.report.page.run import DAMAGED
from reslrb_cli.report.panels import convergence_panels, label, method_naming
from reslrb_cli.report.plots import COLORS, MARKERS, draw
from reslrb_cli.report.sources import Measurements, ShownRun, read_sources

# One page about several runs and measurements: its content, and damaged or hostile input.

PLAN = {"integrator": "reslrb", "estimator": "stack", "rows": [
    {"feature": "roulette", "needed": False, "reason": "paths are short"},
    {"feature": "masks", "needed": True, "reason": "the scene has masks"},
]}  # fmt: skip


def page_of(*paths):
    return Page(render(read_sources(paths)))


def lines_drawn(markup):
    """Return the colours of the curves in each diagram, in order."""
    diagrams = re.findall(r"<svg .*?</svg>", markup, re.S)
    return [[c for c in COLORS if f"stroke: {c}" in diagram] for diagram in diagrams]


def test_every_record_of_each_run_is_shown(tmp_path):
    guiding = Decision(setting="guiding", value="off", why="not measured").to_json()
    records = {"decisions": [guiding], "scaling": SCALING, "plan": PLAN}
    page = page_of(
        make_run(tmp_path / "a", iterations=0, **records),
        make_run(tmp_path / "b", iterations=0, command_line=["reslrb", "optimize", "b"]),
    )
    for title, words in (("Plan", "the scene has masks"), ("Choice of the samples", "not measured"),
                         ("Scale of the parameters", LAMP), ("Configuration", ""), ("Run", "mitsuba")):  # fmt: skip
        assert words in page.sections[f"{title}: a"]
    assert page.row("Run: b", "command line")[1] == "reslrb optimize b"
    assert page.row("Run: b", "to repeat it")[1] == f"reslrb optimize {tmp_path / 'b' / 'config.yaml'}"
    assert "loss" in page.sections["Outcome: a"]
    plan = page_of(make_run(tmp_path / "c", plan=PLAN, iterations=0))
    head = ["part of a step", "reason"]
    assert plan.cells["Plan"] == [head, ["masks", "the scene has masks"], head, ["roulette", "paths are short"]]
    assert "1 left out: roulette" in plan.sections["Plan"]


def test_perceptual_errors(tmp_path):
    told = {"mean": 2.5, "max": 9.0}
    errors = {"psnr_db": 31.25, "ssim": 0.9, "ciede2000": told}
    same = errors | {"psnr_db": None, "ssim": None, "not_finite": 3}
    seen = {"": {"exposure": 1.0, "initial": errors, "final": same}}
    folder = make_run(tmp_path / "a", results={"seen": seen}, iterations=0)
    page = page_of(folder)
    title = "Errors as people see them"
    assert page.cells[title][0] == ["image", "PSNR", "SSIM", "CIEDE2000"]
    assert page.row(title, "start") == ["start", "31.25 dB", "0.9", "2.59"]
    assert page.row(title, "end")[1:3] == ["∞", "too small"]
    assert "3 pixels not finite" in page.row(title, "end")[0]


def test_measurements_are_recognised_by_their_contents(tmp_path):
    write_bench(tmp_path / "x.jsonl")
    write_gradcheck(tmp_path / "y.txt")
    write_convergence(tmp_path / "z")
    make_run(tmp_path / "run")
    found = read_sources([tmp_path / name for name in ("x.jsonl", "y.txt", "z", "run")])
    assert [type(source) for source in found] == [Measurements, Measurements, Measurements, ShownRun]
    assert [source.kind for source in found[:3]] == ["bench", "gradcheck", "convergence"]
    markup = render(found)
    page = Page(markup)
    assert DAMAGED not in markup
    assert list(page.sections)[1:4] == [
        "Cost of a step: x.jsonl", "Gradients against references: y.txt", "Error against run time: z"]  # fmt: skip


def test_a_bench(tmp_path):
    write_bench(tmp_path / "x.jsonl")
    markup = render(read_sources([tmp_path / "x.jsonl"]))
    page = Page(markup)
    title = "Cost of a step: x.jsonl"
    assert page.cells[title][0][:3] == ["integrator", "path depth", "step"]
    assert page.cells[title][-2][:3] == ["ptracer", "8", "out of memory"]
    assert page.cells[title][-1][:3] == ["reslrb:reservoir", "8", "8.0 ms [7.2, 9.6]"]
    assert lines_drawn(markup) == [list(COLORS[:2])] * 2
    assert "samples per pixel 4" in page.sections[title]


def test_a_gradcheck(tmp_path):
    write_gradcheck(tmp_path / "check.jsonl")
    page = page_of(tmp_path / "check.jsonl")
    text, cells = page.sections["Gradients against references: check.jsonl"], page.cells[
        "Gradients against references: check.jsonl"]  # fmt: skip
    assert cells[1][1] == "reslrb:gather"  # failures come first
    assert (cells[1][-1], cells[2][-1]) == ("fails", "holds")
    assert "reslrb:gather against ptracer: max |z| 9, limit 4" in text
    assert "1 of 2 comparisons hold, 1 fail" in text
    assert "25% +- 1.0% of the derivative is missing" in text


def test_a_convergence(tmp_path):
    lines = [*convergence_lines(), {"kind": "summary", "line": "best: reslrb:stack"}, {"kind": "news"}]
    lines[-4] |= {"biased": True, "message": "too few <steps>"}
    failed = {"kind": "method", "label": "prb", "integrator": "prb", "parameter": "all", "status": "out_of_memory"}
    lines.append(failed)
    (tmp_path / "c.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"kind": "poi')
    markup = render(read_sources([tmp_path / "c.jsonl"]))
    page = Page(markup)
    title = "Error against run time: c.jsonl"
    assert page.row(title, "ptracer, independent")[1:] == [
        "4.0 [3.0, 5.0]", "0.7 < 4.5", "3.5 s", "2 min 0 s extrapolated", "—"]  # fmt: skip
    assert page.row(title, "reslrb:stack")[:2] == ["reslrb:stack, independent biased", "4.0 [3.0, 5.0]"]
    assert page.row(title, "prb")[1:3] == ["out of memory", ""]
    assert "reslrb:stack, independent: too few <steps>" in page.sections[title]
    assert "best: reslrb:stack" in page.sections[title]
    assert lines_drawn(markup) == [list(COLORS[:2])]


def test_a_convergence_over_samples_and_of_a_single_parameter(tmp_path):
    """Each sample count is a separate method."""
    lines = convergence_lines(LAMP)
    lines += [line | {"spp": 16} for line in lines if line["kind"] == "point"]
    (tmp_path / "c.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    markup = render(read_sources([tmp_path / "c.jsonl"]))
    title = "Error against run time: c.jsonl"
    assert lines_drawn(markup) == [list(COLORS[:4])]
    assert [row[0] for row in Page(markup).cells[title][1:]] == [
        "ptracer, independent, 4 spp", "reslrb:stack, independent, 4 spp"]  # fmt: skip
    assert LAMP in Page(markup).sections[title]


def test_labels_name_their_samples_and_dldi_once():
    """A label of `--spp` has the samples already, and a method may name its dL/dI."""
    entries = [
        {"label": name, "adjoint": adjoint, "spp": spp}
        for name, adjoint, spp in (("prb, 4 spp", None, 4), ("prb", "batched", 4), ("prb, 16 spp", "batched", 16),
                                   ("reslrb:stack(adjoint=batched), 4 spp", "batched", 4), ("x, 16 spp", None, 6))
    ]  # fmt: skip
    assert [*map(method_naming(entries), entries)] == [
        "prb, 4 spp", "prb, batched, 4 spp", "prb, batched, 16 spp", "reslrb:stack(adjoint=batched), 4 spp",
        "x, 16 spp, 6 spp"]  # fmt: skip
    assert [*map(method_naming(entries[:2]), entries[:2])] == ["prb, 4 spp", "prb, batched"]


def test_references_that_differ_are_marked(tmp_path):
    lines = convergence_lines()
    lines[4] |= {"biased": True, "bias_z": 9.0, "bias_reference": "prb"}
    judged = {"bias_z": 7.5, "bias_z_limit": 4.5, "bias_reference": "ptracer"}
    for biased, word, boxes in ((True, "DIFFERS from ptracer", 1), (False, "agrees with ptracer", 0)):
        lines[-1] |= judged | {"biased": biased}
        (tmp_path / "c").write_text("".join(json.dumps(line) + "\n" for line in lines))
        markup = render(read_sources([tmp_path / "c"]))
        title = "Error against run time: c"
        assert f"all: known to 0.01, 8 steps of reslrb:stack; {word}" in Page(markup).sections[title]
        assert markup.count('class="note failed"') == boxes
    assert Page(markup).row(title, "ptracer, independent biased")[2] == "9 > 4.5against prb"
    assert [curve.name for curve in convergence_panels(lines)[0].curves] == [
        "ptracer, independent (biased)", "reslrb:stack, independent"]  # fmt: skip


def pretended_errors():
    """Return lines of one method: three errors, the last one below the error of the reference, and one from too few
    averages. The method needs 100 s for an error of 1 %, by extrapolation. The time for 10 % lies within the steps.
    """
    found = convergence_lines()[:5]
    figures = [(0.5, 0.4, 8), (1.0, 0.2, 8), (2.0, 0.004, 8), (4.0, 0.1, 2)]
    for line, (elapsed, error, repeats) in zip(found, figures, strict=False):
        ends = {} if repeats < 4 else {"low": 0.9 * error, "high": 1.2 * error}
        line |= {"elapsed_s": elapsed, "relative_rmse": error, "repeats": repeats, "reference_rmse": 0.01} | ends
    found[4] |= {"seconds_to": {"0.1": 3.5, "0.03": 12.0, "0.01": 100.0}, "extrapolated": ["0.1", "0.03", "0.01"]}
    return found


def test_hollow_points_and_extrapolations_of_a_convergence():
    (panel,) = convergence_panels(pretended_errors())
    (curve,) = panel.curves
    assert panel.floor == 0.01
    assert curve.filled().tolist() == [True, True, False, False]
    assert curve.beyond == [(12.0, 0.03), (100.0, 0.01)]
    assert [list(end[:3]) for end in curve.band] == [
        pytest.approx([0.36, 0.18, 0.0036]),
        pytest.approx([0.48, 0.24, 0.0048]),
    ]
    assert [end[3] for end in curve.band] == [None, None]
    axis = Figure().subplots()
    draw(axis, panel)
    line, hollow, extrapolated, floor = axis.lines
    assert line.get_markevery() == [True, True, False, False]
    assert (hollow.get_fillstyle(), hollow.get_xdata().tolist()) == ("none", [2.0, 4.0])
    # the dotted line begins at the last error that counts
    assert extrapolated.get_linestyle() == ":"
    assert extrapolated.get_xydata().tolist() == [[1.0, 0.2], [12.0, 0.03], [100.0, 0.01]]
    assert (floor.get_linestyle(), floor.get_ydata()[0]) == ("-.", 0.01)
    assert [axis.get_xscale(), axis.get_yscale(), len(axis.collections)] == ["log", "log", 1]


def test_the_drawing_has_hollow_points_and_dotted_lines():
    """The SVG has filled and hollow markers, and a dotted line in the colour of the method."""
    found = []
    for lines in (pretended_errors(), convergence_lines()[:5]):
        drawing = diagram(convergence_panels(lines)[0])
        markers = [
            drawing.count(f'style="{fill}; stroke: {COLORS[0]}') for fill in ("fill-opacity: 0", f"fill: {COLORS[0]}")
        ]
        found.append((*markers, len(re.findall(rf"stroke-dasharray: [^>]*stroke: {COLORS[0]}", drawing))))
    assert found == [(2, 2, 1), (0, 4, 1)]


@pytest.mark.filterwarnings("ignore:.*tritanomaly")
def test_colours_differ_for_all_eyes():
    """The smallest difference (CIEDE2000) of two colours is 15 with red-green deficiencies, and 9 with the rare
    tritanopia. Markers differ, too.
    """
    linear = colour.models.eotf_sRGB(np.array([to_rgb(color) for color in COLORS]))
    seen = {None: linear} | {
        kind: np.clip(linear @ colour.matrix_cvd_Machado2009(kind, 1.0).T, 0, 1)
        for kind in ("Protanomaly", "Deuteranomaly", "Tritanomaly")
    }
    first, second = np.triu_indices(len(COLORS), 1)
    for kind, colors in seen.items():
        lab = colour.XYZ_to_Lab(colour.RGB_to_XYZ(colors, "sRGB"))
        differences = colour.delta_E(lab[first], lab[second], method="CIE 2000")
        assert differences.min() > (9 if kind == "Tritanomaly" else 15), kind
    assert len(set(MARKERS)) == len(COLORS)


def test_names_stay_text(tmp_path):
    folder = make_run(tmp_path / "<img src=x onerror=alert(1)>", keys=(EVIL, "\x1b[31m</pre>\u202e.value"))
    write_bench(tmp_path / "<script>alert(2)<>.jsonl")
    lines = (tmp_path / "<script>alert(2)<>.jsonl").read_text().replace("reservoir", "<script>$\\\\frac$")
    (tmp_path / "<script>alert(2)<>.jsonl").write_text(lines)
    write_gradcheck(tmp_path / "g", EVIL)
    write_convergence(tmp_path / "c", EVIL)
    markup = render(read_sources([folder, *(tmp_path / name for name in ("<script>alert(2)<>.jsonl", "g", "c"))]))
    page = Page(markup)
    assert page.tags.count("script") == 1  # the page's own script
    assert "\x1b" not in markup
    assert DAMAGED not in markup
    assert "<script>alert(2)" in page.sections[""]
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', markup) == []


def test_equal_names_are_distinguished(tmp_path):
    runs = [make_run(tmp_path / parent / "lamp") for parent in ("a", "b")]
    names = [source.name for source in read_sources(runs)]
    assert names == [str(run) for run in runs]


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "no such file"),
        (f"{ORIGIN.to_json()}\n".encode(), "holds no line"),
        (b"\x00\xff not json\n\n", "line 1: is damaged, or no line that reslrb wrote"),
        (b'[1, 2]\n{"a": 1}\n', "line 1: is damaged"),
        (b"[" * 100_000 + b"\n", "line 1: is damaged"),
    ],
)
def test_other_files_are_one_located_line(tmp_path, content, line):
    path = tmp_path / "x.jsonl"
    if content is not None:
        path.write_bytes(content)
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError, match="is no run folder and no sweep; give the folder of a run"):
        read_sources([tmp_path / "folder"])
    with pytest.raises(ConfigError) as caught:
        read_sources([path])
    assert re.match(rf"{re.escape(str(path))}: {line}", str(caught.value))
    assert "\n" not in str(caught.value)


def damage(folder, change):
    """Apply `change` to the manifest in a run folder."""
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "change",
    [
        lambda manifest: manifest.update(results={"parameters": {"a": 3}, "seen": {"": 7}}),
        lambda manifest: manifest.update(results={"parameters": 5, "rmse": 3}),
        lambda manifest: manifest.update(decisions=[{"rows": 3}], scaling=[{}], plan={"rows": "no"}),
        lambda manifest: manifest.update(started="soon", views=[{"sensor": "x"}], versions={}),
    ],
)
def test_a_damaged_manifest_leaves_the_rest(tmp_path, change):
    good, bad = (make_run(tmp_path / name, iterations=0) for name in ("good", "bad"))
    damage(bad, change)
    assert "Convergence" in page_of(bad).sections
    both = page_of(good, bad)
    assert "Convergence: bad" in both.sections
    assert both.row("Run: good", "device")[1] == "a machine"


def test_damaged_lines_of_metrics_are_left_out(tmp_path, caplog):
    folder = make_run(tmp_path / "a")
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    lines[9] = re.sub(r'"loss": [^,]*', '"loss": NaN', lines[9])
    (folder / "metrics.jsonl").write_text("\n".join(lines) + '\n{"iteration": 30, "loss"')
    assert "30 iterations in" in page_of(folder).sections[""]
    assert not caplog.records
    for count, damaged in enumerate(("{torn", "[1]", "\0", '{"iteration": 3}', lines[3].replace("90.0", '"x"')), 1):
        lines[count] = damaged
        (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
        page = page_of(folder)
        assert "30 iterations in" in page.sections[""]
        assert "cannot be shown" not in page.sections["Convergence"]
        said = f"{folder / 'metrics.jsonl'}: {count} line{'s' * (count > 1)} left out, because they are damaged"
        assert caplog.messages[-1] == said


def test_one_damaged_run_leaves_the_page_of_a_sweep(tmp_path):
    folder = write_sweep(tmp_path / "s")
    before = page_of(folder)
    path = folder / "spp=8-seed=0" / "metrics.jsonl"
    path.write_text(path.read_text().replace('{"iteration": 5,', '{"iteration" 5,'))
    after = page_of(folder)
    assert "2 of 2 runs finished" in after.sections["Settings"] == before.sections["Settings"]
    assert "cannot be shown" not in "".join(after.sections.values())


def test_records_with_more_keys_are_shown_alike(tmp_path):
    """A later version may add keys to any record."""
    guiding = Decision(setting="guiding", value="off", why="not measured").to_json()
    run = make_run(tmp_path / "a", iterations=30, decisions=[guiding], scaling=SCALING, plan=PLAN)
    sweep = write_sweep(tmp_path / "s")
    write_bench(tmp_path / "b")
    write_gradcheck(tmp_path / "g")
    write_convergence(tmp_path / "c")
    for name in "bgc":
        (tmp_path / name).write_text(f"{ORIGIN.to_json()}\n{(tmp_path / name).read_text()}")
    sources = [run, sweep, *(tmp_path / name for name in "bgc")]
    before = render(read_sources(sources))
    assert DAMAGED not in before

    def more(value):
        """Return a value of JSON in which each record has one key more."""
        if isinstance(value, list):
            return [more(each) for each in value]
        is_record = isinstance(value, dict) and {"kind", "integrator", "iteration", "setting", "program"} & set(value)
        return value | {"later": {"x": 1}} if is_record else value

    for path in [*tmp_path.rglob("*.jsonl"), *(tmp_path / name for name in "bgc")]:
        lines = [json.dumps(more(json.loads(line))) for line in path.read_text().splitlines()]
        path.write_text("\n".join(lines) + "\n")
    for path in [*tmp_path.rglob("manifest.json"), sweep / "sweep.json"]:
        content = json.loads(path.read_text())
        path.write_text(json.dumps(more({name: more(value) for name, value in content.items()}) | {"later": 3}))
    assert render(read_sources(sources)) == before


def test_cases_of_a_bench_have_the_names_that_the_user_wrote(tmp_path):
    write_bench(tmp_path / "b")
    lines = [json.loads(line) for line in (tmp_path / "b").read_text().splitlines()]
    named = ["ptracer", "ptracer(rr_depth=1)", "own.py:A", "own.py:B"]
    entries = [line | {"label": name, "integrator": "same"} for name in named for line in lines[::2]]
    (tmp_path / "b").write_text("".join(json.dumps(each) + "\n" for each in entries))
    assert set(map(label, entries)) == set(named)
    page = page_of(tmp_path / "b")
    assert all(name in page.sections["Cost of a step: b"] for name in named)


def test_runs_that_have_just_started(tmp_path):
    begun = make_run(tmp_path / "begun", iterations=0, status=Status.RUNNING, results={"parameters": {}})
    for path in begun.glob("images/*"):
        path.unlink()
    page = page_of(begun, make_run(tmp_path / "whole"))
    assert "No iteration has been completed yet" in page.sections["Convergence: begun"]
    assert "<svg" not in page.sections["Convergence: begun"]


def test_many_runs_are_named_and_counted(tmp_path):
    runs = [make_run(tmp_path / f"run{number}", keys=(LAMP,), iterations=3, truth=False) for number in range(5)]
    assert "run0, run1, run2 and 2 more" in page_of(*runs).sections[""]


# The page of every kind of file shows the versions, and the command that produces the file again.


KINDS = {
    "Cost of a step": write_bench,
    "Gradients against references": write_gradcheck,
    "Error against run time": write_convergence,
}


@pytest.mark.parametrize("heading", KINDS)
def test_the_page_gives_the_command_to_repeat_it(tmp_path: Path, heading: str) -> None:
    file = tmp_path / "a.jsonl"
    KINDS[heading](file)
    title = f"{heading}: a.jsonl"
    without = page_of(file)
    assert "versions" not in without.sections[title]  # as in an older file
    file.write_text(ORIGIN.to_json() + "\n" + file.read_text())
    markup = render(read_sources([file]))
    page = page_of(file)
    assert DAMAGED not in markup
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
    assert told.count("to repeat it") == 2
    assert "reslrb bench --rounds 7" in told
