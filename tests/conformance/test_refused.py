"""Derivatives of a loss that are not finite: every step takes them for 0, and counts them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conformance.gradient_cases import FLOOR, floor

from reslrb_cli.integrators.protocol import first_channels
from reslrb_cli.integrators.step import gradient_step, known_step, render_image
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.scenes.small import bitmap, camera, diffuse, lamp, load, rgb, texture

pytestmark = pytest.mark.usefixtures("llvm")
PIXELS = ((5, 9), (8, 8), (11, 3))  # row, column
INTEGRATORS = {
    "reservoir": ("reslrb", {"estimator": "reservoir"}),
    "reservoir adjoint": ("reslrb", {"estimator": "reservoir", "weight": "adjoint"}),
    "gather": ("reslrb", {"estimator": "gather"}),
    "event": ("reslrb", {"estimator": "event"}),
    "event adjoint": ("reslrb", {"estimator": "event", "weight": "adjoint"}),
    "stack": ("reslrb", {"estimator": "stack"}),
    "walk_ad": ("walk_ad", {}),
    "ptracer": ("ptracer", {}),
    "prb": ("prb", {}),
    "trajectory": ("trajectory", {}),
}
ADJOINTS = {
    "correlated": {"adjoint": "correlated"},
    "independent": {"adjoint": "independent"},
    "batched": {"adjoint": "batched", "batches": 2},
    "again": {"adjoint": "batched", "batches": 2, "first_batch": "again"},
}
#: Each integrator once, each choice of samples for several.
CASES = [(name, "independent") for name in INTEGRATORS]
CASES += [(name, "correlated") for name in ("stack", "gather", "walk_ad", "ptracer", "prb")]
CASES += [(name, adjoint) for name in ("stack", "ptracer") for adjoint in ("batched", "again")]


@pytest.fixture(scope="module")
def case() -> Case:
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(3, 4)}}
    return Case(floor(bsdf), [FLOOR])


def spoilt(case: Case, bad: float) -> tuple:
    """Weights of a linear objective with `bad` in a channel each of some pixels, and with 0 there."""
    import mitsuba as mi

    weights = np.array(case.weights)
    with_bad, with_zero = weights.copy(), weights.copy()
    for channel, (row, column) in enumerate(PIXELS):
        with_bad[row, column, channel] = bad
        with_zero[row, column, channel] = 0
    return mi.TensorXf(with_bad), mi.TensorXf(with_zero)


def linear(weights):
    """sum(image * weights)."""
    import drjit as dr

    return lambda image: dr.sum((first_channels(image, 3) * weights).array)


def step_and_gradient(case, tracer, objective, **options):
    results = []

    def step(*args, **more):
        results.append(gradient_step(*args, **more))

    gradient = case.gradient(tracer, 3, 16, objective, step=step, **options)
    return results[0], gradient


def check(case: Case, name: str, adjoint: str, bad: float) -> None:
    kind, options = INTEGRATORS[name]
    tracer = integrator(kind, **options)
    with_bad, with_zero = spoilt(case, bad)
    result, gradient = step_and_gradient(case, tracer, linear(with_bad), **ADJOINTS[adjoint])
    _, expected = step_and_gradient(case, tracer, linear(with_zero), **ADJOINTS[adjoint])
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())
    derivatives = 2 if adjoint == "again" else 1
    assert int(result.refused.count[0]) == derivatives * len(PIXELS)
    assert result.refused.entry() == (9, 5, 0)


@pytest.mark.parametrize(("name", "adjoint"), CASES)
def test_a_step_takes_them_for_zero_and_counts_them(case, name, adjoint):
    check(case, name, adjoint, math.nan)


def test_infinities_are_refused_too(case):
    check(case, "stack", "correlated", -math.inf)


def test_a_film_with_alpha_loses_none():
    alpha = Case(floor(diffuse(0.5, 0.4, 0.3), camera=camera(pixel_format="rgba")), ["floor.reflectance.value"])
    check(alpha, "stack", "correlated", math.nan)


@pytest.mark.parametrize("name", ["stack", "ptracer"])
def test_a_step_whose_derivative_is_known_counts_them(case, name):
    with_bad, _ = spoilt(case, math.nan)
    results = []

    def step(tracer, scene, sensor, objective, **options):
        results.append(known_step(tracer, scene, sensor, with_bad, **options))

    kind, options = INTEGRATORS[name]
    assert np.isfinite(case.gradient(integrator(kind, **options), 3, 4, step=step)).all()
    assert int(results[0].refused.count[0]) == len(PIXELS)
    assert np.isfinite(np.array(results[0].loss)).all()


def test_nothing_is_refused_where_all_is_finite(case):
    result, _ = step_and_gradient(case, integrator("reslrb"), linear(case.weights), adjoint="correlated")
    assert int(result.refused.count[0]) == 0
    assert result.refused.entry() is None


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba"])
def test_light_that_is_not_finite_shows_in_the_image(pixel_format):
    """On a CPU atomic sums drop a NaN that is alone at its address: it must not vanish from films with alpha."""
    data = np.full((4, 4, 3), 0.5, np.float32)
    data[1, 2, 0] = np.nan
    bsdf = {"type": "diffuse", "reflectance": bitmap(data)}
    scene = load(floor(bsdf, camera=camera(pixel_format=pixel_format)))
    image = np.array(render_image(integrator("reslrb", max_depth=2), scene, 0, 5, 4))
    assert not np.isfinite(image).all()
    assert np.isfinite(image[:, :, 1:]).all(), "the other channels are as they were"


@pytest.mark.parametrize("name", [name for name in INTEGRATORS if name != "prb"])
def test_a_contribution_that_is_not_finite_shows_in_the_gradient(name):
    """Its weight in a reservoir is infinite: it must not be passed over."""
    scene = floor(diffuse(0.5, 0.4, 0.3), lamp=lamp(radiance=rgb(3e38, 3e38, 3e38)))
    case = Case(scene, ["floor.reflectance.value"])
    kind, options = INTEGRATORS[name]
    assert not np.isfinite(case.gradient(integrator(kind, **options), 3, 16, adjoint="independent")).any()


@pytest.mark.parametrize("name", ["reservoir", "gather", "event", "stack"])
def test_a_factor_that_is_not_a_number_shows_in_the_gradient(name):
    data = np.full((4, 4, 3), 0.5, np.float32)
    data[1, 2] = np.nan
    scene = floor({"type": "diffuse", "reflectance": bitmap(data)})
    case = Case(scene, ["wall.brdf_0.reflectance.value"])
    kind, options = INTEGRATORS[name]
    assert not np.isfinite(case.gradient(integrator(kind, **options), 3, 64, adjoint="independent")).any()
