"""Content of a run's page, as text and in a browser's layout."""

from __future__ import annotations

import base64
import html
import html.parser
import io
import json
import re
import time

import numpy as np
import pytest
from report.chromium import PATIENCE
from report.measured import (
    FLOOR,
    LAMP,
    SCALING,
    make_run,
    texture,
    write_bench,
    write_convergence,
    write_gradcheck,
)

from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.images import read_layers, read_parameters, write_file
from reslrb_cli.records.manifest import Status, read_manifest
from reslrb_cli.report import page as page_module
from reslrb_cli.report.page import render, write_page, write_report
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.values import hatched, texture_pictures
from reslrb_cli.report.plots import COLORS
from reslrb_cli.report.sources import ShownRun, read_sources
from reslrb_cli.report.tonemap import exposure_for, exposure_words, shown_exposures

# The content of a run's page.


class Page(html.parser.HTMLParser):
    """Parsed page with its text by section, tables by section, elements, and pictures."""

    VOID = ("meta", "img", "br", "wbr")

    def __init__(self, markup):
        super().__init__()
        self.open, self.tags, self.pictures = [], [], []
        self.sections, self.cells, self.title = {"": ""}, {"": []}, ""
        self.feed(markup)
        assert self.open == [], "an element is not closed"

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag == "img":
            self.pictures.append((dict(attributes)["alt"], dict(attributes)["src"]))
        if tag == "section":
            self.title = None
        if tag == "tr":
            self.cells[self.title or ""].append([])
        if tag in ("td", "th"):
            self.cells[self.title or ""][-1].append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            return
        if self.open and self.open[-1] == "h2":
            self.title = data
            self.sections[data], self.cells[data] = "", []
        self.sections[self.title or ""] += data
        if "td" in self.open or "th" in self.open:
            self.cells[self.title or ""][-1][-1] += data

    def row(self, section, first):
        return next(row for row in self.cells[section] if row and row[0].startswith(first))


def render_run(folder):
    return render(read_sources([folder]))


def page_of(folder):
    return Page(write_report(folder).read_text(encoding="utf-8"))


def pixels(uri):
    from matplotlib.image import imread

    return imread(io.BytesIO(base64.b64decode(uri.partition(",")[2])))[:, :, :3]


def test_values_and_errors_of_every_parameter(tmp_path):
    page = page_of(make_run(tmp_path / "lamp"))
    head, *_ = page.cells["Parameters"]
    assert head == ["parameter", "start", "end", "true", "RMSE", "relative error"]
    lamp = page.row("Parameters", LAMP)
    assert lamp[1:4] == ["2 1 0.5", "3.6 1.8 0.9", "4 2 1"]
    assert lamp[4:] == ["0.5 → 0.1", "0.5 → 0.1"]
    assert "intensity" in lamp[0]
    floor = page.row("Parameters", FLOOR)
    assert "mean" in floor[1]
    assert "8×8×3" in floor[0]
    assert "75 % reached" in floor[0]
    assert f"relative error 0.5 to 0.1 at worst ({FLOOR})" in page.sections[""]


def test_without_a_truth_there_are_still_values(tmp_path):
    page = page_of(make_run(tmp_path / "lamp", truth=False))
    assert page.cells["Parameters"][0] == ["parameter", "start", "end"]
    assert page.row("Parameters", LAMP)[1:] == ["2 1 0.5", "3.6 1.8 0.9"]
    assert [alt for alt, _ in page.pictures if FLOOR in alt] == [f"start: {FLOOR}", f"end: {FLOOR}"]
    assert "RMSE" not in page.sections["Parameters"] + page.sections["Convergence"]


def test_textures_are_shown_side_by_side(tmp_path):
    page = page_of(make_run(tmp_path / "lamp"))
    shown = {alt: pixels(uri) for alt, uri in page.pictures if FLOOR in alt}
    assert list(shown) == [f"{name}: {FLOOR}" for name in ("start", "end", "true", "reached")]
    assert all(picture.shape == (8, 8, 3) for picture in shown.values())
    assert not np.any(shown[f"reached: {FLOOR}"][:2])
    assert np.all(shown[f"reached: {FLOOR}"][2:] == 1)
    linear = np.load(tmp_path / "lamp" / "parameters" / "true" / "parameters.npz")[FLOOR]
    expected = np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
    np.testing.assert_allclose(shown[f"true: {FLOOR}"], expected, atol=0.01)


def test_heights_are_shown_from_lowest_to_highest(tmp_path):
    """Heights may be negative, and far below the values that a picture shows."""
    heights = np.array([[-1e-3, 0, 3e-3]], np.float32)[:, :, None]
    (tmp_path / "parameters" / "true").mkdir(parents=True)
    np.savez(tmp_path / "parameters" / "parameters.npz", **{"slab.heightmap": np.zeros_like(heights)})
    np.savez(tmp_path / "parameters" / "true" / "parameters.npz", **{"slab.heightmap": heights})
    about = {"quantity": "length", "shape": [1, 3, 1]}
    manifest = {"results": {"parameters": {"slab.heightmap": about}}}
    page = Page(texture_pictures(ShownRun(tmp_path, "slab", manifest, [])))
    shown = {alt: pixels(uri) for alt, uri in page.pictures}
    assert shown["true: slab.heightmap"][0, 0, 0] == 0
    assert shown["true: slab.heightmap"][0, 2, 0] == 1
    assert shown["true: slab.heightmap"][0, 1, 0] == pytest.approx(shown["end: slab.heightmap"][0, 0, 0], abs=1e-6)
    assert "black is -0.001, white is 0.003" in page.sections[""]


def test_every_sensor_has_its_images_and_error_map(tmp_path):
    page = page_of(make_run(tmp_path / "lamp", sensors=3))
    alts = [alt for alt, _ in page.pictures if FLOOR not in alt]
    assert len(alts) == 5 * 3
    assert sum("error map" in alt for alt in alts) == sum("derivative" in alt for alt in alts) == 3
    assert page.sections["Images"].count("or more") == 2 * 3
    assert "Sensor 2" in page.sections["Images"]


def test_the_colours_of_an_error_map_end_at_the_stated_value(tmp_path):
    folder = make_run(tmp_path / "lamp")
    page = page_of(folder)
    [(alt, uri)] = [(alt, uri) for alt, uri in page.pictures if "error map" in alt]
    end = float(re.search(r"to (\S+)$", alt)[1])
    from matplotlib import colormaps

    error = np.abs(read_layers(folder / "images" / "comparison.exr")["difference"]).mean(axis=2)
    assert np.mean(error > end) <= 0.01
    assert error.max() > 0.5 * end
    np.testing.assert_allclose(pixels(uri), colormaps["inferno"](np.minimum(error / end, 1))[:, :, :3], atol=0.01)
    from matplotlib.image import imread

    np.testing.assert_allclose(imread(folder / "images" / "error.png")[:, :, :3], pixels(uri), atol=0.01)
    assert f"{end:g} or more" in page.sections["Images"]


def test_dark_scenes_are_shown_brighter_and_say_so(tmp_path):
    from reslrb_cli.records.images import load_image, write_image

    folder = make_run(tmp_path / "lamp")
    before = {alt: pixels(uri) for alt, uri in page_of(folder).pictures}
    for name in ("initial", "final", "target"):
        write_image(folder / "images" / name, load_image(folder / "images" / f"{name}.exr") * np.float32(1e-6))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["views"][0]["shown"] = 1e6
    (folder / "manifest.json").write_text(json.dumps(manifest))
    page = page_of(folder)
    assert re.search(r"shown 1e\+06 times brighter", page.sections["Images"])
    after = {alt: pixels(uri) for alt, uri in page.pictures}
    assert np.abs(after["target"].mean() - before["target"].mean()) < 0.1
    assert after["start"].mean() < 0.8 * after["target"].mean()


def test_swatches_have_the_colours_of_the_values(tmp_path):
    """All moments of a lamp share one exposure, in sRGB. Values that are not colours have no swatch."""
    keys = FLOOR, LAMP, "plate.eta.value", "paint.reflectance.values"  # the last one is a spectrum of three values
    markup = render_run(make_run(tmp_path / "lamp", keys=keys))
    swatches = [
        tuple(map(int, found.split(","))) for found in re.findall(r'"swatch" style="background:rgb\((.*?)\)"', markup)
    ]
    lamp = swatches[3:]
    assert len(lamp) == 3
    assert lamp[2] == (255, 188, 137)  # 4, 2, 1 divided by 4, in sRGB
    assert lamp[0] == (188, 137, 99)


def test_scaling_memory_and_run_are_tables(tmp_path):
    page = page_of(make_run(tmp_path / "lamp", scaling=SCALING))
    assert page.row("Scale of the parameters", LAMP)[1] == "3e+06"
    assert page.row("Run", "time per iteration")[1] == "90 ms (median)"
    assert page.row("Run", "device")[1] == "a machine"
    everything = "".join(page.sections.values())
    assert "{'" not in everything
    assert "None" not in everything


def test_a_run_that_ended_early_says_why(tmp_path):
    folder = make_run(tmp_path / "lamp")
    assert not [row for row in page_of(folder).cells["Run"] if row and row[0] == "ended early"]
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["results"]["stopped"] = "the time is up, after 3 s of iterations"
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert page_of(folder).row("Run", "ended early")[1] == "the time is up, after 3 s of iterations"


def test_a_model_that_does_not_fit_has_a_command(tmp_path):
    """The command is beside the entries of `parameters`."""
    cause = {"key": "ball.alpha", "p": 0.0, "explained": 1.0, "value": [0.2], "proposed": [0.4], "bounds": "[0.02, 1]"}
    fit = {"p": 0.002, "misfit": 0.06, "energy": 1.0, "is_significant": True, "candidates": [cause]}
    folder = make_run(tmp_path / "lamp", iterations=0, results={"certainty": {
        "fit": fit, "parameters": {}, "measure_s": 1.0, "share": 0.1}})  # fmt: skip
    told = page_of(folder).sections["Parameters"]
    assert "- {key: ball.alpha, bounds: [0.02, 1]}" in told
    assert told.strip().endswith(f"reslrb optimize {folder} --free ball.alpha")


@pytest.mark.parametrize("is_significant", [True, False])
def test_a_map_shows_where_the_misfit_is(tmp_path, is_significant):
    """A map of an earlier end of the run is not shown beside a model that fits."""
    fit = {"p": 0.002, "misfit": 0.06, "energy": 1.0, "is_significant": is_significant, "candidates": []}
    folder = make_run(tmp_path / "lamp", results={"certainty": {
        "fit": fit, "parameters": {}, "measure_s": 1.0, "share": 0.1}})  # fmt: skip
    values = np.zeros((24, 32, 1), np.float32)
    values[4:8] = -0.77
    write_file(folder / "images/misfit.exr", values, linear=True)
    told = page_of(folder).sections["Images"]
    assert ("red is too bright" in told) == is_significant
    assert ("−0.8" in told) == is_significant


def test_paths_and_their_sampling_are_reported(tmp_path):
    """Decisions on `auto` settings appear in the order in which they are made."""
    why = "camera paths have 1.5 times the efficiency here (1.2 to 1.9)"
    decisions = [Decision(setting="paths", value="camera", why=why, gain=1.5, low=1.2, high=1.9, seconds=2.0)]
    decisions += [Decision(setting="guiding", value="off", why="<b>")]
    records = [each.to_json() for each in decisions]
    told = page_of(make_run(tmp_path / "all", iterations=0, decisions=records)).sections["Choice of the samples"]
    lines = [f"paths camera: {why} (measured in 2.0 s)", "guiding off: <b>"]
    assert [told.count(line) for line in lines] == [1] * len(lines)
    assert sorted(lines, key=told.index) == lines


def test_without_decisions_none_are_reported(tmp_path):
    title = "Choice of the samples"
    assert title not in page_of(make_run(tmp_path / "none", iterations=0)).sections
    damaged = page_of(make_run(tmp_path / "other", iterations=0, decisions=[{"of another": "version"}]))
    assert "cannot be shown" in damaged.sections[title]


def test_faults_come_first(tmp_path):
    trend = {"start": {"mean": 0.0131, "error": 0.0004}, "end": {"mean": 0.0133, "error": 0.0004}, "change": "flat"}
    page = page_of(make_run(tmp_path / "lamp", results={"loss_trend": trend, "worse": [LAMP]}))
    assert "the loss did not fall (0.0131 ± 0.0004 at the start, 0.0133 ± 0.0004 at the end)" in page.sections[""]
    assert f"{LAMP} got worse (RMSE 0.5 to 0.1)" in page.sections[""]
    assert page.row("Parameters", LAMP)[4].endswith("worse")
    failed = page_of(make_run(tmp_path / "failed", status=Status.FAILED, error="no light: <b>"))
    assert "no light: <b>" in failed.sections[""]
    assert "b" not in failed.tags[:20]


EVIL = '<script>alert("1")</script>.a & b.value'


def test_nothing_is_loaded_from_elsewhere(tmp_path):
    markup = render_run(make_run(tmp_path / "lamp"))
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', markup) == []
    assert "url(http" not in markup
    assert "default-src 'none'" in html.unescape(markup)
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in markup


def test_an_almost_empty_folder_has_a_page(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "No iteration was completed" in page_of(empty).sections["Convergence"]
    damaged = make_run(tmp_path / "damaged")
    for path in [*damaged.glob("images/*.exr"), *damaged.glob("parameters/**/*.np[yz]")]:
        path.write_bytes(path.read_bytes()[:-40] if path.stat().st_size > 100 else b"")
    (damaged / "images" / "final.exr").write_bytes(b"")
    (damaged / "images" / "target.exr").unlink()
    page = page_of(damaged)
    assert page.row("Parameters", LAMP)[1] == "2 1 0.5"
    assert "end" not in [alt for alt, _ in page.pictures]


@pytest.mark.long
def test_a_page_of_a_long_run_with_large_pictures_is_small(tmp_path):
    folder = make_run(tmp_path / "long", iterations=1200, size=(500, 700))
    page = write_report(folder)
    assert page.stat().st_size < 6e6
    parsed = Page(page.read_text())
    assert max(pixels(uri).shape[1] for _, uri in parsed.pictures) <= 640
    assert "Each point is the mean of " in parsed.sections["Convergence"]


def grey(shape=(64, 64), value=0.02):
    return np.full((*shape, 3), value, np.float32)


def test_a_visible_lamp_does_not_darken_the_rest():
    room = np.random.default_rng(0).uniform(0.01, 0.02, (64, 64, 3)).astype(np.float32)
    lamps = np.zeros((64, 64), bool)
    lamps[:8, :8] = True
    lit = np.where(lamps[:, :, None], np.float32(50), room)
    assert exposure_for(lit) == 0.016  # without known lamps
    assert exposure_for(lit, lamps) == exposure_for(room)
    assert 0.7 < 0.02 * exposure_for(lit, lamps) < 0.9
    # An area that is not much brighter than the rest counts for the exposure, and so does a lamp that fills the view.
    assert exposure_for(np.where(lamps[:, :, None], np.float32(0.05), room), lamps) == pytest.approx(16)
    assert exposure_for(lit, np.ones_like(lamps)) == exposure_for(lit)
    assert exposure_for(np.where(lamps[:, :, None], np.float32(50), 0), lamps) == 0.016
    # Fireflies outside the lamp do not count.
    few = lit.copy()
    few[40, ::20] = 1e6
    assert exposure_for(few, lamps) == pytest.approx(exposure_for(room), rel=0.05)


def test_a_small_caustic_is_not_blown_out():
    assert exposure_for(None) == exposure_for(grey(value=0.0)) == exposure_for(grey(value=0.5)) == 1
    assert exposure_for(grey(value=np.nan)) == exposure_for(np.zeros((0, 4, 3))) == 1
    image = grey(value=0.0)
    image[30:33, 30:38] = 40.0  # less than a hundredth of the pixels, and all of the light
    assert exposure_for(image) == 0.02
    assert exposure_for(image + np.float32(0.01)) == 0.02
    few = image + np.float32(0.01)
    few[0, :4, 0] = 1e9, np.inf, np.nan, 1e9  # a thousandth of the pixels
    assert exposure_for(few) == 0.02


def test_clipping_is_mentioned():
    image = grey(value=0.5)
    image[:16] = 2.0
    assert exposure_words(1.0, image) == "25 % of the target is brighter than white, and clipped"
    assert exposure_words(0.5, image) == "shown 2 times darker"
    assert exposure_words(1.0) == exposure_words(1.0, grey(value=0.5)) == ""


def test_images_have_the_exposure_of_the_manifest(tmp_path):
    folder = make_run(tmp_path / "lamp", sensors=2, views=[{"sensor": 0, "shown": 0.1}, {"sensor": 1}])
    assert re.findall(r"shown .*? times \w{6}", page_of(folder).sections["Images"]) == ["shown 10 times darker"]
    assert shown_exposures([{"sensor": 0, "shown": "x"}]) == shown_exposures(None) == {}
    assert shown_exposures([{"sensor": 3, "shown": 2}]) == {"": 2.0}


# The layout of pages in a browser: no sideways scrolling on a phone or a wide screen, nothing loaded, and no script.

LONG = "wall_of_the_north_western_corridor_behind_the_second_door_0123456789_" * 3 + ".brdf_0.reflectance.value"
NOISY = {"start": {"mean": 1.31e-7, "error": 4e-9}, "end": {"mean": 1.33e-7, "error": 4e-9}, "change": "flat"}
EVERYTHING = "all of them, and measurements"
RUNS = {
    "textures and colours": {"scaling": SCALING},
    "three sensors": {"sensors": 3, "size": (240, 320)},
    "no truth": {"truth": False},
    "failed": {"status": Status.FAILED, "error": "x" * 400, "iterations": 0},
    "long-" * 40 + "name": {"keys": ("<script>document.title = 'evil'</script>", LONG), "device": "d" * 300,
                            "command_line": ["reslrb", "optimize", "/a/very/long/path" * 20],
                            "results": {"loss_trend": NOISY, "worse": [LONG]}},
}  # fmt: skip


@pytest.fixture(scope="module")
def pages(llvm, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    folders = {name: make_run(folder / name, **options) for name, options in RUNS.items()}
    for made in folders.values():
        (made / "config.yaml").write_text(f"scene:\n  file: {'/a/long/path' * 30}\n  name: {'x' * 300}\n")
    written = {name: write_report(made) for name, made in folders.items()}
    write_bench(folder / "bench.jsonl")
    write_gradcheck(folder / "check <script>.jsonl", LONG)
    write_convergence(folder / "convergence.jsonl")
    files = ("bench.jsonl", "check <script>.jsonl", "convergence.jsonl")
    some = [made for name, made in folders.items() if name not in ("three sensors", "no truth")]
    sources = read_sources([*some, *(folder / name for name in files)])
    written[EVERYTHING] = folder / "everything.html"
    write_page(sources, written[EVERYTHING])
    return written


#: The text of elements that extend beyond the window, or that their container cuts off.
OUTSIDE = """[...document.querySelectorAll('body *')].filter(e => {
    const box = e.getBoundingClientRect();
    return box.right > WIDTH + 0.5 || box.left < -0.5 || (e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0
        && !['inline', 'contents'].includes(getComputedStyle(e).display) && !e.closest('svg'));
}).map(e => e.tagName + ': ' + e.textContent.slice(0, 60))"""


@pytest.mark.parametrize("name", [*RUNS, EVERYTHING])
def test_nothing_scrolls_sideways(chromium, pages, name):
    chromium.open(pages[name], 320)
    assert chromium.evaluate("document.scripts.length") == 1  # markup in names has no effect
    for width in (320, 750, 1400):
        chromium.show(width)
        assert chromium.evaluate("document.documentElement.scrollWidth") <= width
        assert chromium.evaluate(OUTSIDE.replace("WIDTH", str(width))) == []


def test_pictures_and_curves_work_without_script_and_network(chromium, pages):
    page = pages["textures and colours"]
    chromium.open(page, 400, scripts=False)
    assert chromium.requests()[0] == page.absolute().as_uri()
    assert all(address.startswith("data:") for address in chromium.requests()[1:])
    broken = "[...document.images].filter(i => !i.complete || i.naturalWidth == 0).length"
    assert chromium.evaluate(broken) == 0
    assert chromium.evaluate("document.images.length") == 9
    drawn = "[...document.querySelectorAll('svg')].map(s => s.getBoundingClientRect().height)"
    heights = chromium.evaluate(drawn)
    assert len(heights) == 4
    assert min(heights) > 100
    assert [event for event in chromium.events if event["method"] == "Log.entryAdded"] == []


def test_a_slider_compares_the_images_of_each_sensor(chromium, pages):
    chromium.open(pages["three sensors"], 1280)
    assert chromium.evaluate("document.querySelectorAll('.compare').length") == 3
    move = """(() => { const [slider, over] = [document.querySelector('.compare input'), '.stage img:last-child'];
        slider.value = VALUE; slider.dispatchEvent(new Event('input'));
        return getComputedStyle(document.querySelector(over)).clipPath })()"""
    assert chromium.evaluate(move.replace("VALUE", "20")) == "inset(0px 80% 0px 0px)"
    choose = """(() => { const choice = document.querySelector('.compare select');
        choice.value = 'target'; choice.dispatchEvent(new Event('input'));
        return document.querySelector('.stage img:last-child').src
            == document.querySelector('img[data-moment=target]').src })()"""
    assert chromium.evaluate(choose)
    # Each picture is shown once, and its maps beside the slider.
    shown = "[...document.querySelectorAll('figure')].filter(f => f.checkVisibility()).length"
    assert chromium.evaluate("[...document.querySelectorAll('img[data-moment]')].every(i => !i.checkVisibility())")
    figures = chromium.evaluate(shown)
    chromium.open(pages["three sensors"], 1280, scripts=False)
    assert chromium.evaluate(shown) == figures + 9
    assert chromium.evaluate("document.querySelectorAll('.compare').length") == 0
    assert chromium.evaluate("document.querySelectorAll('img[data-moment]').length") == 9


#: A drag on the picture from the middle to a fifth of its width, and a click, as events of a pointer.
POINTER = """(() => { const stage = document.querySelector('.stage'), box = stage.getBoundingClientRect();
    stage.setPointerCapture = () => {};
    const at = (type, share) => stage.dispatchEvent(new (type == 'click' ? MouseEvent : PointerEvent)(type,
        {bubbles: true, pointerId: 1, clientX: box.x + share * box.width, clientY: box.y + 5}));
    for (const [type, share] of EVENTS) at(type, share);
    return [document.querySelector('.compare input').value, document.querySelectorAll('dialog').length] })()"""


def test_the_border_is_dragged_on_the_picture_and_a_click_enlarges_it(chromium, pages):
    chromium.open(pages["three sensors"], 1280)
    drag = "[['pointerdown', .5], ['pointermove', .3], ['pointermove', .2], ['pointerup', .2], ['click', .2]]"
    assert chromium.evaluate(POINTER.replace("EVENTS", drag)) == ["20", 0]
    click = "[['pointerdown', .1], ['pointerup', .1], ['click', .1]]"
    assert chromium.evaluate(POINTER.replace("EVENTS", click)) == ["20", 1]
    left = "document.querySelector('dialog img').src == document.querySelector('.stage img:last-child').src"
    assert chromium.evaluate(left)
    chromium.evaluate("document.querySelector('dialog').click()")
    assert chromium.wait_for("document.querySelectorAll('dialog').length == 0", PATIENCE)


def test_a_page_in_progress_keeps_the_reader_s_place(chromium, tmp_path, monkeypatch):
    """It reloads itself, but not while a picture is enlarged, and keeps the border of the pictures."""
    monkeypatch.setattr("reslrb_cli.report.page.REFRESH_SECONDS", 0.5)
    page = write_report(make_run(tmp_path / "run"), {"status": "running", "views": [{"sensor": 0, "shown": 1.0}]})
    chromium.open(page, 1280)
    chromium.evaluate("document.querySelector('.compare input').value = 30")
    chromium.evaluate("document.querySelector('.compare input').dispatchEvent(new Event('input'))")
    chromium.evaluate("window.seen = 1; document.querySelector('.stage').click()")
    time.sleep(0.7)
    assert chromium.evaluate("[window.seen, document.querySelectorAll('dialog').length]") == [1, 1]
    chromium.evaluate("document.querySelector('dialog').click()")
    assert chromium.wait_for("window.seen != 1 && document.readyState == 'complete'", PATIENCE)
    assert chromium.evaluate("document.querySelector('.compare input').value") == "30"


def test_only_a_reliable_result_is_green(chromium, pages, tmp_path):
    certain = {"certainty": {"parameters": {FLOOR: {"verdict": "settled"}}}, "loss_trend": {"change": "fell"}}
    good = write_report(make_run(tmp_path / "good", results=certain))
    colors = []
    for path in (good, pages["no truth"]):
        chromium.open(path, 1280)
        colors.append(chromium.evaluate("getComputedStyle(document.querySelector('.status')).color"))
    assert colors == ["rgb(23, 112, 58)", "rgb(138, 75, 0)"]


def test_the_page_of_a_running_run_reloads_until_the_end(chromium, pages, tmp_path, monkeypatch):
    monkeypatch.setattr(page_module, "REFRESH_SECONDS", 0.5)
    folder = make_run(tmp_path / "run", iterations=3, truth=False)
    path = write_report(folder, read_manifest(folder) | {"status": "running"}, {})
    chromium.open(path, 1400)
    assert chromium.evaluate("document.querySelector('.status').textContent") == "running"
    write_report(folder)
    assert chromium.wait_for("document.querySelector('.status')?.textContent == 'finished'", PATIENCE)
    chromium.events.clear()
    assert not chromium.wait_for("false", 1)
    assert chromium.requests() == []


def test_text_has_contrast_with_its_background(chromium, pages):
    """Every element with text of its own has at least WCAG's contrast of 4.5, in light and in dark mode."""
    contrast = """(() => {
        const level = c => c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4;
        const light = c => { const [r, g, b] = c.match(/[\\d.]+/g).map(Number);
            return 0.2126 * level(r) + 0.7152 * level(g) + 0.0722 * level(b) };
        const behind = e => { const c = getComputedStyle(e).backgroundColor;
            return c.startsWith('rgba') && c.endsWith(' 0)') ? behind(e.parentElement) : c };
        return [...document.querySelectorAll('body *')].filter(e => !e.closest('svg')
            && [...e.childNodes].some(n => n.nodeType == 3 && n.data.trim())).map(e => {
            const a = light(getComputedStyle(e).color), b = light(behind(e));
            return [(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), e.textContent.slice(0, 40)] })
            .filter(([ratio]) => ratio < 4.5) })()"""
    for name in ("textures and colours", "failed", "long-" * 40 + "name", EVERYTHING):
        chromium.open(pages[name], 1400)
        for dark in (False, True):
            chromium.show(1400, dark)
            assert chromium.evaluate(contrast) == []
            background = chromium.evaluate("getComputedStyle(document.body).backgroundColor")
            assert (background == "rgb(255, 255, 255)") == (not dark)


def test_losses_of_saved_images_are_drawn(tmp_path):
    """Noise of the iterations' images can hide that the loss falls."""
    losses = {"image_loss": {"initial": 0.3, "final": 0.01}}
    with_saved, without = (render(read_sources([make_run(tmp_path / name, results=found)]))
                           for name, found in (("a", losses), ("b", {})))  # fmt: skip
    assert "saved images, with less noise" in with_saved
    assert "saved images, with less noise" not in without
    drawn = [[markup.partition("</svg>")[0].count(f"stroke: {colour}") for colour in COLORS[:2]]
             for markup in (with_saved, without)]  # fmt: skip
    assert [all(drawn[0]), drawn[1][1]] == [True, 0]


def test_texels_that_nothing_sees_are_hatched(tmp_path, monkeypatch):
    """Their values are the initial ones, or those of their neighbours."""
    array = texture(8, 8)
    where = np.zeros((8, 8), bool)
    where[:2] = True
    shown = hatched(array, where)
    assert np.array_equal(shown[2:], array[2:])
    assert set(np.unique(shown[:2])) == {np.float32(0.15), np.float32(0.5)}
    run, shown = make_run(tmp_path / "a"), {}

    def seen(values, alt, *caption):
        shown[alt.partition(":")[0]] = values
        return show(values, alt, *caption)

    monkeypatch.setattr("reslrb_cli.report.page.values.show", seen)
    page = Page(render(read_sources([run])))
    assert "the other texels are not recovered, and hatched at the end" in page.sections["Textures"]
    final = read_parameters(run / "parameters")[FLOOR]
    assert np.array_equal(shown["end"], hatched(final, where))  # nothing reaches the first two rows
    assert np.array_equal(shown["start"], read_parameters(run / "parameters" / "initial")[FLOOR])
