"""Pages as a browser lays them out: no sideways scrolling on a phone or a wide screen, nothing loaded, no script."""

from __future__ import annotations

import pytest
from report.chromium import Chromium, find_chromium
from report.measured import write_bench, write_convergence, write_gradcheck, write_maps
from report.run_folder import MEMORY, PILOT, SCALING, make_run

from reslrb_cli.records.manifest import Status, read_manifest
from reslrb_cli.report import page as page_module
from reslrb_cli.report.page import write_page, write_report
from reslrb_cli.report.perceptual import with_seen_errors
from reslrb_cli.report.sources import read_sources

LONG = "wall_of_the_north_western_corridor_behind_the_second_door_0123456789_" * 3 + ".brdf_0.reflectance.value"
NOISY = {"start": {"mean": 1.31e-7, "error": 4e-9}, "end": {"mean": 1.33e-7, "error": 4e-9}, "change": "flat"}
EVERYTHING = "all of them, and measurements"
RUNS = {
    "textures and colours": {"pilot": PILOT, "memory": MEMORY, "scaling": SCALING},
    "three sensors": {"sensors": 3, "size": (240, 320)},
    "no truth": {"truth": False},
    "failed": {"status": Status.FAILED, "error": "x" * 400, "iterations": 0},
    "long-" * 40 + "name": {"keys": ("<script>document.title = 'evil'</script>", LONG), "device": "d" * 300,
                            "command_line": ["reslrb", "optimize", "/a/very/long/path" * 20],
                            "results": {"loss_trend": NOISY, "worse": [LONG]}},
}  # fmt: skip


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    executable = find_chromium()
    if executable is None:
        pytest.skip("no Chromium is installed (Debian's package is `chromium`)")
    browser = Chromium(executable, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def pages(llvm, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    folders = {name: make_run(folder / name, **options) for name, options in RUNS.items()}
    for made in folders.values():
        (made / "config.yaml").write_text(f"scene:\n  file: {'/a/long/path' * 30}\n  name: {'x' * 300}\n")
    written = {name: write_report(made) for name, made in folders.items()}
    write_bench(folder / "bench.jsonl", spps=(4, 16))
    write_gradcheck(folder / "check <script>.jsonl", LONG)
    write_convergence(folder / "convergence.jsonl")
    write_maps(folder / "maps")
    files = ("bench.jsonl", "check <script>.jsonl", "convergence.jsonl", "maps")
    some = [made for name, made in folders.items() if name not in ("three sensors", "no truth")]
    sources = read_sources([*some, *(folder / name for name in files)])
    written[EVERYTHING] = folder / "everything.html"
    write_page([with_seen_errors(source) for source in sources], written[EVERYTHING])
    return written


#: The text of elements that stick out of the window, or are cut off by the one that holds them.
OUTSIDE = """[...document.querySelectorAll('body *')].filter(e => {
    const box = e.getBoundingClientRect();
    return box.right > WIDTH + 0.5 || box.left < -0.5 || (e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0
        && !['inline', 'contents'].includes(getComputedStyle(e).display) && !e.closest('svg'));
}).map(e => e.tagName + ': ' + e.textContent.slice(0, 60))"""


@pytest.mark.parametrize("width", [320, 400, 750, 1400])
@pytest.mark.parametrize("name", [*RUNS, EVERYTHING])
def test_nothing_scrolls_sideways(chromium, pages, name, width):
    chromium.open(pages[name], width)
    assert chromium.evaluate("document.documentElement.scrollWidth") <= width
    assert chromium.evaluate(OUTSIDE.replace("WIDTH", str(width))) == []


@pytest.mark.parametrize("width", [400, 750, 1400])
def test_no_number_is_broken(chromium, pages, width):
    """Each is on one line of its own table cell."""
    broken = """[...document.querySelectorAll('.rows td, thead th')].filter(cell => {
        const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT), range = document.createRange();
        for (let node = walker.nextNode(); node; node = walker.nextNode())
            for (const word of node.data.matchAll(/[^\\s-]+/g)) {
                range.setStart(node, word.index); range.setEnd(node, word.index + word[0].length);
                if (new Set([...range.getClientRects()].map(r => r.top)).size > 1) return true;
            }
        return false }).map(cell => cell.textContent)"""
    for name in ("textures and colours", EVERYTHING):
        chromium.open(pages[name], width)
        assert chromium.evaluate(broken) == []


def test_pictures_and_curves_are_there_without_script_and_network(chromium, pages):
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


def test_a_page_of_everything_is_complete_in_itself(chromium, pages):
    chromium.open(pages[EVERYTHING], 1400)
    assert all(address.startswith("data:") for address in chromium.requests()[1:])
    assert chromium.evaluate("[...document.images].filter(i => !i.complete || i.naturalWidth == 0).length") == 0
    assert chromium.evaluate("document.images.length") > 25
    assert chromium.evaluate("document.scripts.length") == 0
    assert [event for event in chromium.events if event["method"] == "Log.entryAdded"] == []
    assert chromium.evaluate("[...document.querySelectorAll('.bar i')].some(i => i.offsetWidth > 100)")


def test_the_page_of_a_run_at_work_loads_itself_again_until_it_is_over(chromium, pages, tmp_path, monkeypatch):
    monkeypatch.setattr(page_module, "REFRESH_SECONDS", 1)
    folder = make_run(tmp_path / "run", iterations=3, truth=False)
    path = write_report(folder, read_manifest(folder) | {"status": "running"}, {})
    chromium.open(path, 1400)
    assert chromium.evaluate("document.querySelector('.status').textContent") == "running"
    write_report(folder)
    assert chromium.wait_for("document.querySelector('.status')?.textContent == 'finished'", 10)
    chromium.events.clear()
    assert not chromium.wait_for("false", 2)
    assert chromium.requests() == []


def test_markup_in_names_does_nothing(chromium, pages):
    name = "long-" * 40 + "name"
    chromium.open(pages[name], 1400)
    assert chromium.evaluate("document.title") == name
    assert chromium.evaluate("document.scripts.length") == 0


@pytest.mark.parametrize("dark", [False, True])
def test_text_stands_out_from_what_is_behind_it(chromium, pages, dark):
    """WCAG's contrast of 4.5, of every element that has text of its own, in light and in dark."""
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
        chromium.open(pages[name], 1400, dark=dark)
        assert chromium.evaluate(contrast) == []
        background = chromium.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (background == "rgb(255, 255, 255)") == (not dark)
