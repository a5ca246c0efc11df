"""Gradients of every estimator are tested at equal seeds, in expectation, in forward mode, and where factors are
zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import Agreement, compare
from conformance.gradient_cases import (
    _IN_VIEW,
    AT_EQUAL_SEEDS,
    CASES,
    IN_EXPECTATION,
    TEXELS,
    black_pane,
    floor,
)
from conformance.scenes import plugin
from turns import a_few, taking_turns

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.step import gradient_step, known_step, render_image
from reslrb_cli.measure.gradients import Case, integrator, relative, seeds
from reslrb_cli.measure.scenes.case import Differences, SceneCase
from reslrb_cli.measure.scenes.small import bitmap, diffuse, lamp, rgb, room, texture, transform, veiled
from reslrb_cli.scene.upsampling import DARKEST

pytestmark = pytest.mark.usefixtures("llvm")


# Every estimator in every case: exact estimators equal naive AD of the same paths, the others equal it in expectation.
# The cases' own references (`test_gradient` below) show that naive AD of our walk is right. Here naive AD is the
# reference at equal seeds, which reveals faults that a test over many seeds cannot find.

EXACT = {"gather": {}, "stack": {}, "stack_of_2": {"estimator": "stack", "stack_size": 2}}
RANDOM = {
    "reservoir": {},
    "reservoir_of_4": {"estimator": "reservoir", "capacity": 4},
    "event": {},
    "event_of_4": {"estimator": "event", "capacity": 4},
}
BY_ADJOINT = {
    "reservoir_by_adjoint": {"estimator": "reservoir", "weight": "adjoint"},
    "event_by_adjoint": {"estimator": "event", "weight": "adjoint"},
}


def estimator(case: SceneCase, name: str, options: dict):
    """Return the integrator of a case with this estimator."""
    return integrator("reslrb", **case.own | {"estimator": name} | options)


@taking_turns("case", CASES, "adjoint", ("correlated", "independent"), AT_EQUAL_SEEDS)
def test_exact_estimators_equal_naive_ad(case: SceneCase, adjoint: str):
    scene = Case(case.scene(), case.keys)
    reference = scene.gradient(integrator("walk_ad", **case.own), 5, case.spp, adjoint=adjoint)
    for name, options in EXACT.items():
        ours = scene.gradient(estimator(case, name, options), 5, case.spp, adjoint=adjoint)
        error = relative(ours, reference)
        print(case.name, adjoint, name, f"{error:.1e}")
        assert error < scene.rounding(), f"{name}, {adjoint}: {error:.1e}"


def agree(case: SceneCase, count: int, candidates: dict[str, dict], adjoint: str) -> None:
    """Compare each candidate with `gather` at other seeds, over `count` seeds each."""
    scene = Case(case.scene(), case.keys)
    reference = scene.gradients(estimator(case, "gather", {}), seeds(count, 1), case.spp, adjoint=adjoint)
    for name, options in candidates.items():
        ours = scene.gradients(estimator(case, name, options), seeds(count), case.spp, adjoint=adjoint)
        result = compare(ours, reference, block=None)
        print(case.name, name, result)
        assert result, name
        assert np.isfinite(ours).all()


FEW = ("texture", "roulette", "crop", "glass", "mask_texture_in_view", "area_texture", "two_emitters")


@pytest.mark.long
@pytest.mark.parametrize("case", a_few(CASES, ["texture"]))
def test_random_estimators_agree(case: SceneCase):
    count = 16 if case.name == "texture" else 200 if case.name in FEW else 40
    agree(case, count, RANDOM, "correlated")
    agree(case, count, BY_ADJOINT, "independent")


@pytest.mark.long
def test_event_agrees_without_connected_lobes():
    [case] = [case for case in CASES if case.name == "glass"]
    agree(case, 16, {"event": {}}, "correlated")


@taking_turns("name", ["reservoir", "gather", "event", "stack"], "max_depth", [0, 1])
def test_without_light_paths_the_gradient_is_zero(name: str, max_depth: int):
    case = next(case for case in CASES if case.name == "texture")
    scene = Case(case.scene(), case.keys)
    assert not scene.gradient(integrator("reslrb", estimator=name, max_depth=max_depth), 3, 4).any()


# The gradient of the reservoir estimator against `ptracer`, `prb` and finite differences: equal in expectation.

#: Largest allowed noise of a comparison, as a share of the gradient. With more noise, a wrong gradient would pass.
RESOLUTION = 0.1


def agreement(case: SceneCase, count: int) -> Agreement:
    """Compare gradients with the case's reference over `count` seeds each."""
    scene = Case(case.scene(), case.keys)
    ours = scene.gradients(integrator("reslrb", **case.own), seeds(count), case.spp)
    source = case.source
    if isinstance(source, Differences):
        image = integrator("reslrb", **case.options)
        directions = scene.directions(max(2, count // 16))
        ours = ours @ directions.T
        reference = np.array([
            [scene.difference(image, direction, seed, case.spp, source.step, source.sides) for direction in directions]
            for seed in seeds(count, 1)
        ])  # fmt: skip
    else:
        reference = scene.gradients(integrator(source.name, **case.options), seeds(count, 1), case.spp)
    size = np.linalg.norm(reference.mean(0))
    noise = np.linalg.norm(np.hypot(ours.std(0), reference.std(0))) / np.sqrt(count)
    assert noise < RESOLUTION * size, f"{case.name}: standard error {noise / size:.1%} of the gradient"
    return compare(ours, reference, block=None)


@pytest.mark.parametrize("case", a_few(CASES, ["glass", "mask"]))  # the images of other tests have rough metal
def test_gradient(case: SceneCase):
    result = agreement(case, 16 if case.name in IN_EXPECTATION else 64)
    print(case.name, case.source, result)
    assert result


# Naive AD of our walk, forward mode, and the reservoir, each compared with the others at equal seeds.

BY_NAME = {case.name: case for case in CASES}

#: Cases in which stock `ptracer` is right and traces the same paths. Excluded are masks, rotated environment maps, bump
#: and normal maps, directions that move with a parameter, and textures of lamps, whose black texels `ptracer` does not
#: draw.
SAME_PATHS = ("texture", "gaussian", "crop", "rgba", "thin_lens", "twosided", "mirror", "glass", "area",
              "point", "spot", "projector", "directional", "directionalarea", "constant")  # fmt: skip


@pytest.mark.parametrize(
    "name",
    a_few(SAME_PATHS, ("crop", "projector")),
)
def test_walk_ad_equals_ptracer(name: str):
    case = BY_NAME[name]
    scene = Case(case.scene(), case.keys)
    options = {**case.options, "hide_emitters": True}
    ours = scene.gradient(integrator("walk_ad", **options), 3, 64)
    assert relative(ours, scene.gradient(integrator("ptracer", **options), 3, 64)) < scene.rounding()


def forward(scene: Case, integrator: Any, seed: int, spp: int) -> np.ndarray:
    """Return the image's derivative along the first of the random parameter directions. The derivative comes from
    `mi.render`, as for Mitsuba's users.
    """

    def tangent() -> Any:
        image = mi.render(scene.scene, scene.params, integrator=integrator, seed=seed, seed_grad=seed + 1, spp=spp)
        return dr.forward_to(image)

    return scene.along(scene.directions(1)[0], tangent)[:, :, :3]  # alpha has no derivative


#: Forward mode in the default suite: everything that it does along a path (emission, factors, delta lobes, masks,
#: visible emitters). The other cases have other BSDFs and emitters, which do not change forward
#: mode.
QUICK = ("roulette", "glass", "mask_texture_in_view", "visible_lamp")


@pytest.mark.parametrize("name", a_few([n for n in BY_NAME if n != "texture_prb"], QUICK))
def test_forward_mode_equals_walk_ad(name: str):
    case = BY_NAME[name]
    scene, options = Case(case.scene(), case.keys), case.own
    tangent = forward(scene, plugin("reslrb", **options), 3, 32)
    naive = forward(scene, plugin("walk_ad", **options), 3, 32)
    assert np.abs(naive).max() > 0
    assert relative(tangent, naive) < 1e-5
    # The adjoint of the same derivative: <weights, J v> = <J^T weights, v>, at the same seed as forward mode.
    gradient = scene.gradient(integrator("walk_ad", **options), 4, 32)
    assert np.sum(naive * np.array(scene.weights)) == pytest.approx(gradient @ scene.directions(1)[0], rel=1e-3)


# Factors that are exactly zero: their derivative is finite, and no estimator may lose it.  The image is a polynomial in
# each parameter. If the paths do not depend on the parameter, finite differences are exact up to rounding. They are
# one-sided where the domain ends. Otherwise the gradients are compared in expectation.


def tiles(*texels: tuple[float, ...]) -> dict:
    """Return a texture with these columns. Mitsuba requires at least two rows and columns."""
    return bitmap(
        np.broadcast_to(np.array(texels, float).reshape(1, len(texels), -1), (2, len(texels), len(texels[0])))
    )


def matte(texture: dict) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}


def blend(weight: dict) -> dict:
    return {"type": "blendbsdf", "weight": weight, "first": diffuse(0.8, 0.3, 0.2), "second": diffuse(0.1, 0.6, 0.4)}


@dataclass(frozen=True)
class ZeroCase:
    """Case of `test_zero`. `sides` is the direction in which the domain continues. With `fixed_paths`, paths do not
    depend on the parameters.
    """

    name: str
    scene: Callable[[], dict]
    keys: tuple[str, ...]
    sides: str = "up"
    fixed_paths: bool = True
    step: float = 0.1
    spp: int = 64
    max_depth: int = 4
    lost: str = ""  # why the derivative is lost, if it is known to be


CLIPPED = "Mitsuba clips opacities and weights to [0, 1], and Dr.Jit's clip has no derivative at the lower end"
NOT_SAMPLED = "what has a probability of zero is not sampled, here light that passes an opaque mask"

ZERO_CASES = [
    ZeroCase("texel_zero_in_one_channel", lambda: floor(matte(tiles((0.5, 0.0, 0.4), (0.6, 0.3, 0.0)))), (TEXELS,)),
    ZeroCase("texel_zero_in_all", lambda: floor(matte(tiles((0, 0, 0), (0.6, 0.3, 0.5)))), (TEXELS,)),
    ZeroCase("everything_black", lambda: room(floor=matte(tiles((0, 0, 0), (0, 0, 0))), wall=matte(rgb(0, 0, 0)),
                                              side=matte(rgb(0.5, 0, 0.5))),
             (TEXELS, "wall.brdf_0.reflectance.value", "side.brdf_0.reflectance.value"), max_depth=5),
    ZeroCase("lamp_zero_in_one_channel", lambda: room(lamp=lamp(radiance=rgb(2, 0, 3))),
             ("lamp.emitter.radiance.value", "floor.brdf_0.reflectance.value")),
    ZeroCase("lamp_zero_in_all", lambda: room(lamp=lamp(radiance=rgb(0, 0, 0))), ("lamp.emitter.radiance.value",)),
    ZeroCase("lamp_and_texel_zero", lambda: floor(matte(tiles((0, 0.4, 0), (0.6, 0.3, 0.5))),
                                                  lamp=lamp(radiance=rgb(0, 2, 3))),
             ("lamp.emitter.radiance.value", TEXELS)),
    ZeroCase("lamp_texture_zero_in_one_channel",
             lambda: room(lamp=lamp(radiance=tiles((4, 0, 3), (1, 2, 5)))), ("lamp.emitter.radiance.data",),
             fixed_paths=False),
    ZeroCase("lamp_texture_zero_in_all", lambda: room(lamp=lamp(radiance=tiles((0, 0, 0), (1, 2, 5)))),
             ("lamp.emitter.radiance.data",), fixed_paths=False),
    ZeroCase("point_zero", lambda: room(lamp=None, light={"type": "point", "position": [0.5, 0.9, 0.8],
                                                           "intensity": rgb(0, 1, 0)}), ("light.intensity.value",)),
    ZeroCase("constant_zero", lambda: room(lamp=None, light={"type": "constant", "radiance": rgb(0, 1, 0)}),
             ("light.radiance.value",), spp=128),
    ZeroCase("opacity_0", lambda: veiled(0.0), ("veil.bsdf.opacity.value",), fixed_paths=False, spp=256, lost=CLIPPED),
    ZeroCase("opacity_1", lambda: veiled(1.0), ("veil.bsdf.opacity.value",), "down",
             fixed_paths=False, spp=256, lost=NOT_SAMPLED),
    ZeroCase("opacity_0_in_view", lambda: veiled(0.0, _IN_VIEW), ("veil.bsdf.opacity.value",),
             fixed_paths=False, lost=CLIPPED),
    ZeroCase("opacity_1_in_view", lambda: veiled(1.0, _IN_VIEW), ("veil.bsdf.opacity.value",), "down",
             fixed_paths=False, lost=NOT_SAMPLED),
    ZeroCase("opacity_near_0", lambda: veiled(0.08), ("veil.bsdf.opacity.value",), "both", fixed_paths=False, step=0.08,
             spp=512),
    ZeroCase("opacity_near_1", lambda: veiled(0.92, _IN_VIEW), ("veil.bsdf.opacity.value",), "both",
             fixed_paths=False, step=0.08, spp=256),
    ZeroCase("blend_0", lambda: floor(blend(tiles((0,), (0.4,)))), ("floor.weight.data",),
             fixed_paths=False, lost=CLIPPED),
    ZeroCase("blend_1", lambda: floor(blend(tiles((1,), (0.4,)))), ("floor.weight.data",), "down", fixed_paths=False),
    ZeroCase("mirror_zero", lambda: room(lamp=lamp(radiance=rgb(9, 9, 9)), floor={
                 "type": "blendbsdf", "weight": 0.5, "first": diffuse(0.5, 0.5, 0.5),
                 "second": {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": rgb(0.8, 0, 0)}}),
             ("floor.bsdf_1.specular_reflectance.value",)),
]  # fmt: skip


def directions(case: ZeroCase, scene: Case) -> np.ndarray:
    """Return directions (K, P). These are the parameters' axes, or a few directions into the domain if paths depend on
    many parameters.
    """
    size = sum(len(value) for value in scene.initial.values())
    return np.eye(size) if case.fixed_paths or size <= 2 else np.abs(scene.directions(2))


def differences(case: ZeroCase, scene: Case, along: np.ndarray, count: int, block: int) -> np.ndarray:
    """Return finite differences (N, K) along K directions at N seeds."""
    image, step = integrator("walk_ad", case.max_depth), case.step / 10 if mi.is_spectral else case.step
    return np.array([
        [scene.difference(image, direction, seed, case.spp, step, case.sides) for direction in along]
        for seed in seeds(count, block)
    ])  # fmt: skip


#: The case of the default suite. test_extreme.py has a black lamp.
QUICK_ZERO = ("texel_zero_in_one_channel",)


def parameters() -> list:
    """Return the cases. Cases whose derivative is known to be lost must fail."""
    return [
        pytest.param(case, id=case.name,
                     marks=[*([pytest.mark.xfail(reason=case.lost, strict=True)] if case.lost else []),
                            *([] if case.name in QUICK_ZERO else [pytest.mark.long])])
        for case in ZERO_CASES
    ]  # fmt: skip


@pytest.mark.parametrize("case", parameters())
def test_zero(case: ZeroCase):
    scene, count = Case(case.scene(), case.keys), 12 if case.lost else 16
    if mi.is_spectral:  # no spectrum has the colour 0, and the image is a polynomial of none
        scene.initial = {key: np.maximum(value, DARKEST) for key, value in scene.initial.items()}
        scene.set(scene.initial)
    along = directions(case, scene)
    ours = scene.gradients(integrator("reslrb", case.max_depth), seeds(count), case.spp) @ along.T
    naive = scene.gradients(integrator("walk_ad", case.max_depth), seeds(count), case.spp) @ along.T
    if case.fixed_paths:
        # At equal seeds, naive AD and finite differences differ only by rounding, so that two seeds are enough.
        assert relative(naive[:2], differences(case, scene, along, 2, 0)) < max(2e-3, scene.rounding())
        reference = naive
    else:
        reference = differences(case, scene, along, count, 1)
        result = compare(naive, reference, block=None)
        print(case.name, "walk_ad", result)
        assert result, f"walk_ad {result}"
    result = compare(ours, reference, block=None)
    print(case.name, result)
    assert result
    assert (np.abs(ours.mean(0)) > 3 * ours.std(0) / np.sqrt(count)).mean() > 0.5, "zero within noise"


# A pane with a black channel, or a black pane, at each place of a path: before the sensor, before a lamp, and between
# the sensor and a lamp in view.


def panes() -> dict[str, dict[str, Any]]:
    """Return the place of the pane, and objects in addition to the room, by the name of the place."""
    behind = transform(translate=[0.1, -0.2, 0.6], rotate=([0, 1, 0], 15), scale=0.3)
    return {
        "sensor": {"place": _IN_VIEW},
        "lamp": {"place": {}},
        "visible lamp": {"place": _IN_VIEW, "sign": lamp(radiance=rgb(2, 1, 3)) | {"to_world": behind}},
    }


PANES = ("sensor", "lamp", "visible lamp")
PANE_CASES = [
    f"{place}-{color}-{paths}" for place in PANES for color in ("one", "all") for paths in ("light", "camera", "both")
]


@pytest.mark.parametrize("name", a_few(PANE_CASES, ["sensor-one-both", "lamp-all-light"]))
def test_a_black_pane_keeps_its_derivative(name: str):
    """At equal seeds, the gradient equals differences into the domain. Paths do not depend on the colour."""
    place, color, paths = name.split("-")
    things = panes()[place]
    pane = black_pane((0, 0.6, 0.7) if color == "one" else (0, 0, 0), **things.pop("place"))
    case = Case(room(pane=pane, **things), ("pane.bsdf.specular_transmittance.value",))
    tracer = integrator("reslrb", 5, estimator="stack", paths=paths)
    expected = np.array([case.difference(tracer, direction, 3, 64, 0.1, "up") for direction in np.eye(3)])
    assert np.abs(expected).min() > 0.1
    for name in ("stack", "gather") if paths == "light" else ("stack",):
        found = case.gradient(integrator("reslrb", 5, estimator=name, paths=paths), 3, 64)
        np.testing.assert_allclose(found, expected, rtol=2e-3)


# `trajectory`, which is Dr.Jit's own reversal of the walk, has the gradient of `walk_ad` at equal seeds.

FEW_TRAJECTORIES = ("passes", "glass", "envmap")
NAMES = ("texture", "roulette", "passes", "gaussian", "thin_lens", "plastic", "glass", "bumpmap", "area_texture",
         "envmap", "visible_lamp")  # fmt: skip


def options(case: SceneCase) -> dict:
    return case.own


@taking_turns("name", NAMES, "adjoint", ("correlated", "independent"), FEW_TRAJECTORIES)
def test_equal_seeds_give_equal_gradients(name: str, adjoint: str) -> None:
    named = BY_NAME[name]
    case = Case(named.scene(), named.keys)
    expected = case.gradient(integrator("walk_ad", **options(named)), 3, 8, adjoint=adjoint)
    found = case.gradient(integrator("trajectory", **options(named)), 3, 8, adjoint=adjoint)
    assert np.abs(expected).sum() > 0
    assert relative(found, expected) < (case.rounding() if mi.is_spectral else 2e-5)


def test_masks_without_parameters_are_passed() -> None:
    mask = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}
    placed = transform(translate=[0.1, 0.2, 0.2], rotate=([1, 0, 0], -80), scale=0.5)
    case = Case(room(veil={"type": "rectangle", "to_world": placed, "bsdf": mask}), ("floor.brdf_0.reflectance.value",))
    expected = case.gradient(integrator("walk_ad", 6), 3, 8)
    assert np.abs(expected).sum() > 0
    found = case.gradient(integrator("trajectory", 6), 3, 8)
    assert relative(found, expected) < (case.rounding() if mi.is_spectral else 2e-5)


def test_masks_with_parameters_are_refused() -> None:
    named = BY_NAME["mask"]
    case = Case(named.scene(), named.keys)
    with pytest.raises(UnsupportedScene, match="masks"):
        case.gradient(integrator("trajectory"), 3, 8)


def test_endless_paths_are_refused() -> None:
    with pytest.raises(Exception, match="max_depth"):
        make_integrator("trajectory", max_depth=-1)


@pytest.mark.parametrize("name", a_few(["ptracer", "trajectory", "walk_ad", "reservoir", "gather", "stack"],
                                       ["ptracer", "trajectory", "reservoir", "stack"]))  # fmt: skip
def test_a_known_adjoint_gives_the_image_and_gradient_of_a_correlated_step(name: str) -> None:
    named = BY_NAME["texture"]
    case = Case(named.scene(), named.keys)
    chosen = integrator("reslrb", estimator=name) if name in ("reservoir", "gather", "stack") else integrator(name)
    [key, *_] = case.keys

    def run(known: bool) -> tuple[np.ndarray, np.ndarray, float]:
        dr.enable_grad(case.params[key])
        dr.set_grad(case.params[key], 0)
        case.params.update()
        common = {"seed": 5, "spp": 8, "params": case.params}
        if known:
            step = known_step(chosen, case.scene, 0, case.weights, **common)
        else:
            step = gradient_step(chosen, case.scene, 0, case.objective, **common)
        return np.array(step.image), np.array(dr.grad(case.params[key])), float(np.array(step.loss).item())

    for expected, found in zip(run(False), run(True), strict=True):
        np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-5 * np.abs(expected).max())


# The samples that delta comes from.  If one set of samples serves image and gradient, the image's noise biases an L2
# gradient. With an independent set, or with batches, there is no bias.

SPP = 4
COUNT = 64
ADJOINTS = {
    "correlated": {"adjoint": "correlated"},
    "independent": {"adjoint": "independent"},
    "two batches": {"adjoint": "batched", "batches": 2},
    "four batches": {"adjoint": "batched", "batches": 4},
}


@pytest.fixture(scope="module")
def case_of_two() -> Case:
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(3, 4)}}
    return Case(floor(bsdf), [TEXELS])


@pytest.fixture(scope="module")
def reference(case_of_two: Case) -> tuple:
    """Target, and gradients of the L2 loss. For these gradients, delta is taken from the mean image of many samples."""
    tracer = integrator("reslrb")
    mean = np.mean([render_image(tracer, case_of_two.scene, 0, 50_000 + i, 1024) for i in range(8)], axis=0)
    target = mi.TensorXf((mean * np.random.default_rng(3).uniform(0.7, 1.2, mean.shape)).astype(np.float32))
    delta = 2 * (mi.TensorXf(mean.astype(np.float32)) - target) / mean.size
    exact = integrator("reslrb", estimator="gather")

    def step(seed: int) -> np.ndarray:
        return case_of_two.gradient(exact, seed, 256, step=lambda *args, **options: known_step(
            *args[:3], delta, seed=options["seed"], spp=options["spp"], params=options["params"]))  # fmt: skip

    return target, np.stack([step(seed) for seed in seeds(16, 70)])


def l2(target):
    """Return the mean square difference from the target, as a function of the image."""
    return lambda image: dr.mean(dr.square(image - target), axis=None)


def agreement_adjoint(case: Case, reference: tuple, name: str, estimator: str = "stack") -> Agreement:
    target, expected = reference
    stock = estimator in ("ptracer", "walk_ad", "prb")
    tracer = integrator(estimator) if stock else integrator("reslrb", estimator=estimator, freeze=True)
    objective = l2(target)
    ours = [case.gradient(tracer, seed, SPP, objective, **ADJOINTS[name]) for seed in seeds(COUNT)]
    return compare(np.stack(ours), expected, block=None)


@pytest.mark.parametrize(
    "name",
    a_few(["independent", "two batches", "four batches"], ["two batches"]),
)
def test_l2_gradient_is_unbiased(case_of_two: Case, reference: tuple, name: str):
    result = agreement_adjoint(case_of_two, reference, name)
    print(name, result)
    assert result


def test_correlated_samples_are_measurably_biased(case_of_two: Case, reference: tuple):
    result = agreement_adjoint(case_of_two, reference, "correlated")
    print("correlated", result)
    assert not result
    assert np.abs(result.z).max() > 2 * result.threshold


@pytest.mark.long
@pytest.mark.parametrize("name", ["reservoir", "gather", "event", "ptracer", "walk_ad", "prb"])
def test_batches_work_for_every_integrator(case_of_two: Case, reference: tuple, name: str):
    result = agreement_adjoint(case_of_two, reference, "four batches", name)
    print(name, result)
    assert result


@pytest.mark.parametrize("batches", [1, 3])
def test_batches_that_do_not_divide_are_refused(case_of_two: Case, reference: tuple, batches: int):
    with pytest.raises(
        ValueError, match='"batches" must be an integer from 2' if batches < 2 else "multiple of the batches"
    ):
        case_of_two.gradient(integrator("reslrb"), 1, SPP, l2(reference[0]), adjoint="batched", batches=batches)
