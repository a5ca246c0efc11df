"""Errors of parameters: over what is reached, in units that add up or do not, and at resolutions that differ."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from optimization.toy import make_problem

from reslrb_cli.optimization.errors import ErrorMeter, nearest, quantity
from reslrb_cli.scene.values import resample


def texture(height, width, seed=0):
    return np.random.default_rng(seed).uniform(0.1, 0.9, (height, width, 3)).astype(np.float32)


def everything(array):
    return np.ones(array.shape[:2] if array.ndim == 3 else array.shape, dtype=bool)


def meter_of(truth, quantities=None):
    return ErrorMeter(truth, {key: everything(value) for key, value in truth.items()}, quantities)


def test_errors_are_taken_over_the_mask(tmp_path):
    problem = make_problem(tmp_path)
    problem.truth["albedo"] = np.array(problem.optimizer["albedo"]) + np.array([[[1.0], [50.0]], [[2.0], [3.0]]])
    meter = problem.error_meter()
    errors = meter.errors(problem.selection.array)
    assert errors["albedo"] == pytest.approx(np.sqrt((1 + 4 + 9) / 3), rel=1e-5)
    assert meter.total(errors) == pytest.approx(np.sqrt((1 + 4 + 9) / 3), rel=1e-5)
    truth = problem.truth["albedo"][problem.masks["albedo"]]
    assert meter.scales["albedo"] == pytest.approx(np.sqrt(np.mean(truth**2)), rel=1e-5)
    problem.masks["albedo"][:] = False
    meter = problem.error_meter()
    assert meter.errors(problem.selection.array) == {}
    assert meter.total({}) is None


def test_the_error_of_several_parameters_counts_their_entries():
    meter = meter_of({"a.reflectance": np.zeros(3), "b.alpha": np.zeros(())})
    errors = meter.errors(lambda key: np.full((3,) if key.startswith("a") else (), 1.0 if key.startswith("a") else 3.0))
    assert errors == {"a.reflectance": 1.0, "b.alpha": 3.0}
    assert meter.total(errors) == pytest.approx(np.sqrt((3 * 1 + 9) / 4))


def test_units_that_differ_are_not_added_up():
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


def test_units_of_what_has_no_error_do_not_matter():
    """A lamp that nothing reaches has no error that could be added."""
    masks = {"wall": np.ones(3, bool), "lamp": np.zeros(3, bool)}
    meter = ErrorMeter({"wall": np.ones(3), "lamp": np.ones(3)}, masks, {"wall": "", "lamp": "intensity"})
    assert meter.one_unit
    assert meter.errors(lambda key: np.zeros(3)) == {"wall": 1.0}


def test_a_black_truth_has_no_relative_error():
    meter = meter_of({"soot": np.zeros(3), "wall": np.ones(3)})
    assert meter.relative({"soot": 0.3, "wall": 0.5}) == {"wall": 0.5}


@pytest.mark.parametrize(("own", "true"), [((4, 6), (8, 12)), ((16, 12), (8, 6)), ((4, 12), (8, 6)), ((5, 7), (8, 8))])
def test_another_resolution_is_compared_on_the_finer_grid(own, true):
    value, truth = texture(*own, seed=1), texture(*true, seed=2)
    mask = np.ones(own, dtype=bool)
    mask[: own[0] // 2] = False
    grid = max(own[0], true[0]), max(own[1], true[1])
    expected = (resample(value, grid[::-1]) - resample(truth, grid[::-1]))[nearest(mask, grid)]
    error = ErrorMeter({"t": truth}, {"t": mask}).errors(lambda key: value)["t"]
    assert error == pytest.approx(np.sqrt(np.mean(np.square(expected, dtype=np.float64))), rel=1e-5)
    flat = ErrorMeter({"t": np.full_like(truth, 0.3)}, {"t": mask}).errors(lambda key: np.full_like(value, 0.5))
    assert flat["t"] == pytest.approx(0.2, rel=1e-5)


def test_the_truth_at_its_own_resolution_is_resampled_by_nothing():
    value, truth = texture(4, 4, seed=1), texture(4, 4, seed=2)
    error = meter_of({"t": truth}).errors(lambda key: value)["t"]
    assert error == pytest.approx(np.sqrt(np.mean(np.square(value - truth, dtype=np.float64))), rel=1e-6)


def test_a_mask_on_a_finer_grid():
    mask = np.array([[True, False], [False, False]])
    expected = np.zeros((4, 6), dtype=bool)
    expected[:2, :3] = True
    assert np.array_equal(nearest(mask, (4, 6)), expected)
    assert np.array_equal(nearest(expected, (2, 2)), mask)


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
}


@pytest.mark.parametrize("name", EMITTERS)
def test_quantities(name):
    scene, key, expected = EMITTERS[name]
    bitmap = mi.Bitmap(np.ones((4, 4, 3), dtype=np.float32))
    if scene["type"] == "envmap":
        scene = {**scene, "bitmap": bitmap}
    if scene["type"] == "projector":
        scene = {**scene, "irradiance": {**IMAGE, "bitmap": bitmap}}
    params = mi.traverse(mi.load_dict(scene))
    assert quantity(params, key) == expected
