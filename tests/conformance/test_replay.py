"""A replay visits the same vertices as the image pass. Values of dL/dI that are not finite are replaced by 0, and
counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.gradient_cases import CASES, TEXELS, floor
from turns import a_few

from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.reservoir import ReservoirSelection
from reslrb_cli.integrators.protocol import Job, first_channels
from reslrb_cli.integrators.step import gradient_step, known_step, render_image
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.scenes.small import bitmap, camera, diffuse, lamp, rgb, room, texture, transform
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.walk import Hooks

pytestmark = pytest.mark.usefixtures("llvm")


# A replay follows the image pass up to the kept connection, with the same vertices and the same factors.

BY_NAME = {case.name: case for case in CASES}
#: Cases for every way of drawing random numbers: delta lobes, masks, an aperture, several emitters, roulette.
NAMES = ("texture", "roulette", "thin_lens", "plastic", "blend", "glass", "mirror", "bumpmap", "mask",
         "mask_texture_in_view", "area_texture", "envmap", "two_emitters", "visible_lamp")  # fmt: skip
#: The cases of the default suite.
FEW = ("roulette", "thin_lens", "blend", "glass", "bumpmap", "mask", "envmap", "two_emitters")

NONE = 0xFFFFFFFF


@dataclass
class Kept:
    """State of the reservoir, with the index and position of the kept vertex. Index 0 means that the reservoir holds no
    vertex.
    """

    state: Any
    I: Any  # noqa: E741
    p: Any


class Recording(ReservoirSelection):
    """Image pass of the reservoir, with all connections as candidates. The pass also keeps index and position of the
    kept vertex.
    """

    def start(self, product: Any) -> Kept:
        return Kept(super().start(product), mi.UInt32(0), mi.Point3f(0))

    def wants(self, state: Kept, vertex: Any) -> Any:
        return mi.Bool(True)

    def concerned(self, state: Any) -> Any:
        return mi.Bool(True)

    def vertex(self, state: Kept, vertex: Any, connection: Any, scattering: Any, numbers: list[Any]) -> Kept:
        [slot] = state.state.slots
        before = replace(state.state, slots=[replace(slot, last=mi.UInt32(NONE))])
        after = super().vertex(before, vertex, connection, scattering, numbers)
        taken = after.slots[0].last != NONE
        return Kept(after, dr.select(taken, vertex.depth, state.I), dr.select(taken, vertex.si.p, state.p))


class Rewalk(Hooks):
    """Replay that differentiates nothing. The replay multiplies all factors up to the kept connection again."""

    needs_product = False
    connects = True

    def __init__(self, samples: Any, kept: Any, emission: Any) -> None:
        self.samples, self.kept, self.emission = samples, kept, emission

    def start(self, product: Any) -> list[Any]:
        return [mi.Spectrum(self.emission), mi.Spectrum(0), mi.Point3f(0), mi.Point2f(0), mi.UInt32(0)]

    def goes_on(self, state: Any, vertex: Any) -> Any:
        return vertex.depth < self.kept.I

    def vertex(self, state: Any, vertex: Any, connection: Any, scattering: Any, numbers: list[Any]) -> Any:
        here = vertex.active & (vertex.depth == self.kept.I)
        found = [state[0] * connection.c * self.samples.scale, vertex.si.p, connection.u, vertex.depth]
        latest = [dr.select(here, new, old) for new, old in zip(found, state[1:], strict=True)]
        return [state[0] * scattering.s, *latest]


@pytest.mark.parametrize("name", a_few(NAMES, FEW))
def test_a_replay_visits_the_same_vertices(name: str):
    import numpy as np

    case = BY_NAME[name]
    scene = Case(case.scene(), case.keys)
    ours = integrator("reslrb", **case.own)
    with dr.suspend_grad():
        [samples] = ours.passes(Job(scene.scene, scene.scene.sensors()[0], mi.UInt32(5), 64))
        context = Pass(samples, None, None)
        kept = context.walk(Recording(context, 1, "luminance"))
        dr.eval(kept)
        slot, active = kept.state.slots[0], kept.state.W > 0
        emission = sample_emission(samples, samples.sampler()).E
        _, C, p, u, I = context.walk(Rewalk(samples, kept, emission), active)  # noqa: E741
        stored = slot.C.value()
        dr.eval(C, p, u, I, stored)
    where = np.array(active)
    assert where.sum() > 1000
    assert len(np.unique(np.array(I)[where])) > 1, "paths of one length only"
    assert np.array_equal(np.array(I)[where], np.array(kept.I)[where])

    def error(found: Any, expected: Any) -> float:
        found, expected = np.array(found, np.float64).T[where], np.array(expected, np.float64).T[where]
        return (np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)).max()

    assert error(p, kept.p) < 1e-6
    assert error(u, slot.u) < 1e-6
    if not samples.plan.roulette:  # a replay does not know the roulette's weights
        assert error(C, stored) < 1e-6


def test_without_light_there_is_no_replay():
    """If a scene's light reaches nothing, the reservoir keeps nothing and the gradient is zero."""
    lamp = room()["lamp"] | {"to_world": transform(translate=[0, 5, 0], rotate=([1, 0, 0], -90))}
    case = Case(room(lamp=lamp | {"emitter": {"type": "area", "radiance": rgb(1, 1, 1)}}),
                ("floor.brdf_0.reflectance.value",))  # fmt: skip
    assert not case.gradient(integrator("reslrb"), 1, 16).any()


# Derivatives of a loss that are not finite: every step counts them, and replaces them by 0.

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
}
#: Each integrator appears once, and each choice of samples with several integrators.
REFUSED = [
    pytest.param(name, adjoint, marks=() if quick else pytest.mark.long)
    for names, adjoint, quick in (
        (("reservoir", "stack", "walk_ad", "ptracer"), "independent", True),
        (("reservoir adjoint", "gather", "event", "event adjoint", "prb", "trajectory"), "independent", False),
        (("stack",), "correlated", True), (("ptracer",), "correlated", False),
        (("stack",), "batched", True), (("ptracer",), "batched", False),
    ) for name in names
]  # fmt: skip


@pytest.fixture(scope="module")
def case() -> Case:
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(3, 4)}}
    return Case(floor(bsdf), [TEXELS])


def spoilt(case: Case, bad: float) -> tuple:
    """Return two sets of weights of a linear objective. In one channel of each of some pixels, the first set has `bad`
    and the second set has 0.
    """
    weights = np.array(case.weights)
    with_bad, with_zero = weights.copy(), weights.copy()
    for channel, (row, column) in enumerate(PIXELS):
        with_bad[row, column, channel] = bad
        with_zero[row, column, channel] = 0
    return mi.TensorXf(with_bad), mi.TensorXf(with_zero)


def spoil(case: Case, key: str, channels: slice) -> None:
    """Set a texel of the scene to NaN. Mitsuba's loader would replace the NaN of a colour by a spectrum."""
    texels = np.array(case.params[key])
    texels[1, 2, channels] = np.nan
    case.params[key] = mi.TensorXf(texels)
    case.params.update()


def linear(weights):
    """Return the objective sum(image * weights)."""
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
    assert int(result.refused.count[0]) == len(PIXELS)
    assert result.refused.entry() == (9, 5, 0)


@pytest.mark.parametrize(("name", "adjoint"), REFUSED)
def test_a_step_replaces_nan_by_zero_and_counts_it(case, name, adjoint):
    check(case, name, adjoint, math.nan)


def test_infinities_are_refused_too(case):
    check(case, "stack", "correlated", -math.inf)


def test_a_film_with_alpha_counts_all():
    alpha = Case(floor(diffuse(0.5, 0.4, 0.3), camera=camera(pixel_format="rgba")), ["floor.reflectance.value"])
    check(alpha, "stack", "correlated", math.nan)


@pytest.mark.parametrize("name", ["stack", "ptracer"])
def test_a_step_with_a_known_derivative_counts_them(case, name):
    with_bad, _ = spoilt(case, math.nan)
    results = []

    def step(tracer, scene, sensor, objective, **options):
        results.append(known_step(tracer, scene, sensor, with_bad, **options))

    kind, options = INTEGRATORS[name]
    assert np.isfinite(case.gradient(integrator(kind, **options), 3, 4, step=step)).all()
    assert int(results[0].refused.count[0]) == len(PIXELS)
    assert np.isfinite(np.array(results[0].loss)).all()


def test_finite_values_are_not_refused(case):
    result, _ = step_and_gradient(case, integrator("reslrb"), linear(case.weights), adjoint="correlated")
    assert int(result.refused.count[0]) == 0
    assert result.refused.entry() is None


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba"])
def test_non_finite_light_shows_in_the_image(pixel_format):
    """On a CPU, atomic sums drop a NaN that is alone at its address. A NaN must not vanish from films with alpha."""
    bsdf = {"type": "diffuse", "reflectance": bitmap(np.full((4, 4, 3), 0.5, np.float32))}
    case = Case(floor(bsdf, camera=camera(pixel_format=pixel_format)), [])
    spoil(case, "floor.reflectance.data", slice(0, 1))
    image = np.array(render_image(integrator("reslrb", max_depth=2), case.scene, 0, 5, 4))
    assert not np.isfinite(image).all()
    others = 3 if mi.is_spectral else 1  # a spectrum without a value has none in any channel
    assert np.isfinite(image[:, :, others:]).all(), "the other channels are as they were"


@pytest.mark.parametrize("name", [name for name in INTEGRATORS if name != "prb"])
def test_a_non_finite_contribution_shows_in_the_gradient(name):
    """A non-finite contribution has an infinite weight in a reservoir, which must not skip this contribution."""
    bsdf, light = diffuse(0.5, 0.4, 0.3), 3e38
    if mi.is_spectral:  # Mitsuba's derivative of a colour's spectrum is NaN, not infinite: atomic sums drop it
        bsdf, light = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}, 1e37
    scene = floor(bsdf, lamp=lamp(radiance=rgb(light, light, light)))
    case = Case(scene, ["floor.reflectance.value"])
    kind, options = INTEGRATORS[name]
    assert not np.isfinite(case.gradient(integrator(kind, **options), 3, 16, adjoint="independent")).any()


@pytest.mark.parametrize("name", ["reservoir", "gather", "event", "stack"])
def test_a_nan_factor_shows_in_the_gradient(name):
    scene = floor({"type": "diffuse", "reflectance": bitmap(np.full((4, 4, 3), 0.5, np.float32))})
    case = Case(scene, ["wall.brdf_0.reflectance.value"])
    spoil(case, "floor.reflectance.data", slice(None))
    kind, options = INTEGRATORS[name]
    assert not np.isfinite(case.gradient(integrator(kind, **options), 3, 64, adjoint="independent")).any()
