"""Results: parameters in a few numbers, their errors, the best parameters, and saved images."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from optimization.toy import make_problem
from records.test_metrics import make_record

from reslrb_cli.config.loader import load, loads
from reslrb_cli.optimization import loading, loop
from reslrb_cli.optimization.assemble import assemble_scene, quantity
from reslrb_cli.optimization.problem import ErrorMeter
from reslrb_cli.optimization.results import Results, summary
from reslrb_cli.records.images import luminance
from reslrb_cli.scene.dispersion import register

# Parameters summarised in a few numbers, and results that exist whenever a run ends.


def test_small_parameters_are_reported_in_full():
    assert summary(np.array(0.25)) == {"value": 0.25}
    assert summary(np.array([0.5, 1.0, 0.25])) == {"value": [0.5, 1.0, 0.25]}
    assert summary(np.arange(8.0)) == {"mean": [3.5], "min": 0.0, "max": 7.0}


def test_textures_are_reported_by_mean_and_range_of_reached_texels():
    value = np.zeros((2, 2, 3))
    value[0, 0], value[0, 1], value[1] = (1, 2, 3), (3, 4, 5), 100
    mask = np.array([[True, True], [False, False]])
    assert summary(value, mask) == {"mean": [2.0, 3.0, 4.0], "min": 1.0, "max": 5.0}
    assert summary(value, np.zeros((2, 2), dtype=bool))["max"] == 100  # if nothing is reached, all entries count


def test_results_of_a_run(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path)
    results = Results(problem)
    for record in loop.optimize(problem):
        results.add(record)
    halfway = results.to_json()
    assert halfway["parameter_rmse"]["albedo"] == {"initial": pytest.approx(0.3), "final": None}
    assert halfway["rmse"]["final"] is None
    results.end()
    found = results.to_json()
    assert found["parameter_rmse"]["albedo"]["final"] < 0.1
    assert found["relative_error"]["albedo"]["initial"] == pytest.approx(0.3 / 0.8)
    assert found["parameters"]["albedo"]["reached"] == 0.75
    assert found["loss_trend"]["change"] == "fell"
    assert found["worse"] == []
    assert found["image_loss"] == {"initial": None, "final": None}
    image = np.full((2, 2, 4), 0.6, dtype=np.float32)
    results.see("final", problem.views[0], image)
    results.see("iteration-000002", problem.views[0], image)
    assert results.to_json()["image_loss"] == {"initial": None, "final": pytest.approx(0.04, rel=1e-4)}
    assert json.dumps(found, allow_nan=False)


@pytest.mark.parametrize(("iterations", "worse"), [(3, ["albedo"]), (4, [])])
def test_a_short_run_is_called_worse_only_at_its_end(tmp_path, iterations, worse):
    """Pages of an unfinished run request these results from the first iterations on."""
    problem = make_problem(tmp_path, sets=[f"run.iterations={iterations}"])
    results = Results(problem)
    for iteration in range(3):
        results.add(make_record(iteration=iteration, parameter_errors={"albedo": 1e-3}))
    results.end()
    assert results.to_json()["worse"] == worse


def test_a_non_finite_truth_is_null(tmp_path):
    """The manifest is JSON, which has no non-finite numbers."""
    problem = make_problem(tmp_path)
    problem.truth["albedo"][0, 0, 0] = np.nan
    results = Results(problem)
    results.end()
    found = json.loads(json.dumps(results.to_json(), allow_nan=False))
    assert found["parameter_rmse"]["albedo"] == {"initial": None, "final": None}


def test_an_image_of_each_sensor_is_requested(tmp_path):
    problem = make_problem(tmp_path, views=2)
    results = Results(problem)
    image = np.full((2, 2, 3), 0.6, dtype=np.float32)
    results.see("final", problem.views[0], image)
    assert results.to_json()["image_loss"]["final"] is None
    results.see("final", problem.views[1], image)
    assert results.to_json()["image_loss"]["final"] == pytest.approx(0.04, rel=1e-4)


# Errors of parameters: over the reached entries, in units that add up or do not.


def everything(array):
    return np.ones(array.shape[:2] if array.ndim == 3 else array.shape, dtype=bool)


def meter_of(truth, quantities=None):
    return ErrorMeter(truth, {key: everything(value) for key, value in truth.items()}, quantities)


def test_errors_are_measured_within_the_mask(tmp_path):
    problem = make_problem(tmp_path)
    problem.truth["albedo"] = np.array(problem.optimizer["albedo"]) + np.array([[[1.0], [50.0]], [[2.0], [3.0]]])
    meter = problem.meter
    errors = meter.errors(problem.selection.array)
    assert errors["albedo"] == pytest.approx(np.sqrt((1 + 4 + 9) / 3), rel=1e-5)
    assert meter.total(errors) == pytest.approx(np.sqrt((1 + 4 + 9) / 3), rel=1e-5)
    truth = problem.truth["albedo"][problem.masks["albedo"]]
    assert meter.scales["albedo"] == pytest.approx(np.sqrt(np.mean(truth**2)), rel=1e-5)
    problem.masks["albedo"][:] = False
    meter = replace(problem).meter
    assert meter.errors(problem.selection.array) == {}
    assert meter.total({}) is None


def test_colours_of_a_monochrome_run_are_compared_by_luminance(tmp_path, monkeypatch):
    """The luminance is all that such a run can recover. Its error is 0 for any colours of the right luminance."""
    truth = np.random.default_rng(3).uniform(0.1, 0.9, (4, 4, 3))
    grey = np.repeat(luminance(truth)[:, :, None], 3, axis=2)
    masks = {key: everything(truth) for key in ("colour", "map")}
    given = {"colour": truth, "map": truth[:, :, :1]}
    meter = ErrorMeter(given, masks, monochrome=True)
    assert meter.errors({"colour": grey, "map": given["map"]}.__getitem__) == {"colour": pytest.approx(0), "map": 0}
    off = meter.errors({"colour": grey + 0.1, "map": given["map"] + 0.2}.__getitem__)
    assert off == {"colour": pytest.approx(0.1, rel=1e-4), "map": pytest.approx(0.2)}
    assert meter.total(off) == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 2), rel=1e-4)
    assert ErrorMeter(given, masks).errors({"colour": grey, "map": given["map"]}.__getitem__)["colour"] > 0.1
    problem = make_problem(tmp_path)
    for monochrome in (True, False):
        monkeypatch.setattr("reslrb_cli.optimization.problem.mi", SimpleNamespace(is_monochromatic=monochrome))
        problem = replace(problem, truth={"albedo": truth}, masks={"albedo": masks["colour"]})
        assert (problem.meter.errors(lambda key: grey)["albedo"] < 1e-6) == monochrome


def test_the_error_of_several_parameters_counts_their_entries():
    meter = meter_of({"a.reflectance": np.zeros(3), "b.alpha": np.zeros(())})
    errors = meter.errors(lambda key: np.full((3,) if key.startswith("a") else (), 1.0 if key.startswith("a") else 3.0))
    assert errors == {"a.reflectance": 1.0, "b.alpha": 3.0}
    assert meter.total(errors) == pytest.approx(np.sqrt((3 * 1 + 9) / 4))


def test_different_units_are_not_added():
    truth = {"wall": np.full(3, 0.5), "lamp": np.full(3, 2e6)}
    values = {"wall": np.full(3, 0.6), "lamp": np.full(3, 1e6)}
    meter = meter_of(truth, {"wall": "", "lamp": "intensity"})
    errors = meter.errors(values.__getitem__)
    assert not meter.one_unit
    assert meter.total(errors) is None
    assert meter.relative(errors) == {"wall": pytest.approx(0.2), "lamp": pytest.approx(0.5)}
    same = meter_of(truth, {"wall": "radiance", "lamp": "radiance"})
    assert same.one_unit
    assert same.total(errors) == pytest.approx(1e6 / np.sqrt(2), rel=1e-6)


def test_units_of_parameters_without_errors_do_not_matter():
    """A lamp without any entry in its mask has no error that could be added."""
    masks = {"wall": np.ones(3, bool), "lamp": np.zeros(3, bool)}
    meter = ErrorMeter({"wall": np.ones(3), "lamp": np.ones(3)}, masks, {"wall": "", "lamp": "intensity"})
    assert meter.one_unit
    assert meter.errors(lambda key: np.zeros(3)) == {"wall": 1.0}


def test_a_black_truth_has_no_relative_error():
    meter = meter_of({"soot": np.zeros(3), "wall": np.ones(3)})
    assert meter.relative({"soot": 0.3, "wall": 0.5}) == {"wall": 0.5}


IMAGE = {"type": "bitmap", "raw": True}
EMITTERS = {
    "area": ({"type": "rectangle", "light": {"type": "area"}}, "emitter.radiance.value", "radiance"),
    "point": ({"type": "point"}, "intensity.value", "intensity"),
    "spot": ({"type": "spot"}, "intensity.value", "intensity"),
    "spot's texture": ({"type": "spot"}, "texture.value", ""),
    "directional": ({"type": "directional"}, "irradiance.value", "irradiance"),
    "constant": ({"type": "constant"}, "radiance.value", "radiance"),
    "envmap": ({"type": "envmap"}, "data", "radiance"),
    "envmap's scale": ({"type": "envmap"}, "scale", ""),
    "projector": ({"type": "projector"}, "irradiance.data", "irradiance"),
    "projector's scale": ({"type": "projector"}, "scale", ""),
    "sky": ({"type": "sunsky"}, "turbidity", ""),
    "bsdf": ({"type": "rectangle", "light": {"type": "area"}}, "bsdf.reflectance.value", ""),
    "roughness": ({"type": "roughconductor"}, "alpha.value", ""),
    "index": ({"type": "dispersivedielectric", "material": "F2"}, "nd", "nd"),
}


@pytest.mark.parametrize("name", EMITTERS)
def test_quantities(name):
    scene, key, expected = EMITTERS[name]
    bitmap = mi.Bitmap(np.ones((4, 4, 3), dtype=np.float32))
    if scene["type"] == "envmap":
        scene = {**scene, "bitmap": bitmap}
    if scene["type"] == "projector":
        scene = {**scene, "irradiance": {**IMAGE, "bitmap": bitmap}}
    register()
    params = mi.traverse(mi.load_dict(scene))
    assert quantity(params, key) == expected


# Which of the saved images are recorded.

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "stiff" / "lamp.yaml"
TINY = ["scene.options={resx: 12, resy: 12}", "integrator.max_depth=2"]


@pytest.mark.parametrize(("most", "recorded"), [(12 * 12 * 8, True), (12 * 12 * 8 - 1, False)])
def test_only_small_images_are_recorded(monkeypatch, most, recorded):
    """The trials of a recording render an image three more times. That does not pay for a large image, because it takes
    long and is rendered once.
    """
    monkeypatch.setattr(loading, "MOST_PATHS_APART", most)
    problem = assemble_scene(load(CONFIG, TINY))
    image = problem.render(0, 8, 0, "saved image")
    assert bool(problem.integrator.preparation.recordings.counts()) == recorded
    problem = replace(problem, integrator=problem.integrator.with_options(samples_per_pass=None, freeze=False))
    assert np.array_equal(image, problem.render(0, 8, 0, "saved image"))


def test_passes_of_a_large_image_are_not_recorded(monkeypatch):
    """This holds however small the last pass is."""
    monkeypatch.setattr(loading, "PATHS_PER_PASS", 12 * 12 * 4)
    monkeypatch.setattr(loading, "MOST_PATHS_APART", 12 * 12 * 3)
    problem = assemble_scene(load(CONFIG, TINY))
    problem.render(0, 5, 0, "saved image")
    assert not problem.integrator.preparation.recordings.counts()


def test_a_ptracer_run_warns_of_an_unclipped_lens(tmp_path, caplog):
    lens = '<float name="aperture_radius" value="0.1"/><float name="focus_distance" value="3"/>'
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><sensor type="thinlens" id="eye"><float name="far_clip" value="4"/>{lens}</sensor>'
        '<emitter type="point"/><shape type="rectangle" id="floor">'
        '<transform name="to_world"><translate z="5"/></transform></shape></scene>'
    )

    def lines(integrator: str) -> list[str]:
        own = "parameters: [{key: floor.bsdf.reflectance.value}]"
        text = f"scene: {{file: scene.xml}}\ntarget: {{render: {{}}}}\n{own}\nintegrator: {{type: {integrator}}}\n"
        caplog.clear()
        assemble_scene(loads(text, tmp_path / "c.yaml", []))
        return [record.getMessage() for record in caplog.records]

    assert lines("reslrb") == []
    [line] = lines("ptracer")
    assert "sensor eye: ptracer does not clip the view of a `thinlens`" in line
