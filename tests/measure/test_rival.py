"""`prb` beside the estimator of a run: when it is tried, what is said of it, and what its interval is worth."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from cli.test_optimize import CONFIG, KEY, SCENE

from reslrb_cli.cli import main
from reslrb_cli.config.loader import load
from reslrb_cli.measure import prb_comparison
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune import race
from reslrb_cli.records.decisions import RivalRecord
from reslrb_cli.records.manifest import read_manifest

OWN = "{max_depth: 3, guiding: off, sequence: independent}"
AUTO = CONFIG.replace("{type: ptracer, max_depth: 3}", OWN).replace("iterations: 25", "iterations: 2, measuring: 1000")
POINT = """<emitter type="point" id="bulb"><point name="position" x="0" y="0" z="2"/>
    <rgb name="intensity" value="3, 3, 3"/></emitter>"""
GLASS = """<shape type="sphere"><float name="radius" value="0.2"/><point name="center" x="0" y="0" z="1"/>
    <bsdf type="dielectric"/></shape>"""


@pytest.fixture
def experiment(llvm, tmp_path, monkeypatch):
    import mitsuba as mi

    mi.Bitmap(np.full((4, 4, 3), 0.6, dtype=np.float32)).write(str(tmp_path / "poster.exr"))
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "box.yaml").write_text(AUTO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RESLRB_CACHE", str(tmp_path / "cache"))
    logging.getLogger("reslrb_cli").setLevel(logging.INFO)


def optimize(capsys, *settings):
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        main(["optimize", "box.yaml", "--force", *(word for setting in settings for word in ("--set", setting))])
    assert not end.value.code
    return capsys.readouterr().err, read_manifest(Path("runs/box"))


def test_it_is_measured_once_and_remembered(experiment, capsys):
    err, manifest = optimize(capsys)
    found = RivalRecord.from_json(manifest["rival"])
    assert found.integrator == "prb"
    if found.advantage is not None:
        assert found.low < found.advantage < found.high
        assert prb_comparison.LEAST_ROUNDS <= found.rounds <= prb_comparison.MOST_ROUNDS
        assert (f"{found.line()}; --set" in err) == found.is_better
        assert found.line(cost=True).replace("&", "&amp;") in Path("runs/box/report.html").read_text()
    err, again = optimize(capsys)
    assert again["rival"] == {**manifest["rival"], "cached": True}
    assert "measuring" not in err


def test_the_tables_of_a_guided_run_learn_nothing_from_it(experiment: None) -> None:
    """A run begins alike whether this was measured now or by an earlier one."""
    problem = assemble(load("box.yaml", ["integrator.guiding=on"]))
    assert prb_comparison.measure_rival(problem, None, lambda line: None) is not None
    assert problem.integrator.preparation.guiding.learned == {}


def test_it_is_not_tried_where_nobody_chose_an_estimator(experiment, capsys, monkeypatch):
    """And a better one is one line, one that may be no better none."""
    from reslrb_cli.runs import prepare

    err, manifest = optimize(capsys, "integrator.estimator=stack")
    assert manifest["rival"] is None
    assert "prb" not in err
    better = RivalRecord(integrator="prb", rounds=8, spp=4, advantage=5.0, low=3.0, high=8.0, measure_s=1.5)
    monkeypatch.setattr(prepare, "measure_rival", lambda problem, cache, say: better)
    err, manifest = optimize(capsys, "integrator.estimator=stack")
    assert f"{better.line()}; --set integrator.type=prb" in err
    assert better.line(cost=True).startswith("prb: 5 times the efficiency here (3 to 8) (measured in 1.5 s")
    assert manifest["rival"] == better.to_json()
    no_better = RivalRecord(integrator="prb", rounds=8, advantage=1.5, low=0.9, high=2.5)
    monkeypatch.setattr(prepare, "measure_rival", lambda problem, cache, say: no_better)
    assert "prb" not in optimize(capsys, "integrator.estimator=stack")[0]


@pytest.mark.parametrize(("extra", "applies"), [("", True), (GLASS + POINT, False)])
def test_it_is_tried_where_it_finds_the_light(experiment, extra, applies):
    from reslrb_cli.optimization.assemble import assemble_scene

    Path("scene.xml").write_text(SCENE.replace("</scene>", f"{extra}</scene>"))
    assert (prb_comparison.why_not(assemble_scene(load("box.yaml", []))) is None) == applies


def samples(sd, count, seed, entries=200):
    random = np.random.default_rng(seed)
    return [{KEY: (1 + sd * random.normal(size=entries)).astype(np.float32)} for _ in range(count)]


@pytest.mark.parametrize("entries", [3, 200])
def test_the_interval_holds_the_truth_as_often_as_it_says(entries):
    """Four times the variance at half the time; without what single times may be off, the level is the nominal one."""
    inside = 0
    for seed in range(200):
        own, other = samples(2.0, 8, 2 * seed, entries), samples(1.0, 8, 2 * seed + 1, entries)
        value, low, high = race.compare(own, [2.0] * 8, other, [4.0] * 8)
        low, high = low * race.TIMING_NOISE, high / race.TIMING_NOISE
        assert low < value < high
        inside += low < 2.0 < high
    # 190 of 200 are expected; fewer than 176 have a probability of 1e-4.
    assert inside >= 176


def test_equals_are_hardly_ever_called_better():
    better = sum(
        race.compare(samples(1.0, 8, 2 * seed), [3.0] * 8, samples(1.0, 8, 2 * seed + 1), [3.0] * 8)[1] > 1
        for seed in range(200)
    )
    assert better <= 13  # 5 are expected on this side without what times may be off


def test_no_noise_is_no_comparison():
    still = [{KEY: np.ones(4, np.float32)}] * 6
    assert race.compare(still, [1.0] * 6, samples(1.0, 6, 1, 4), [1.0] * 6) == (None, None, None)


def test_gradients_of_no_light_tell_nothing():
    none = [{KEY: np.zeros(3, dtype=np.float32)} for _ in range(8)]
    assert race.compare(none, [1.0] * 8, none, [1.0] * 8) == (None, None, None)
