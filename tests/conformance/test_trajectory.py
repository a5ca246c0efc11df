"""`trajectory`, Dr.Jit's own reversal of the walk, has the gradient of `walk_ad` at equal seeds."""

from __future__ import annotations

import numpy as np
import pytest
from conformance.gradient_cases import CASES, GradientCase
from turns import taking_turns

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators.step import gradient_step, known_step, make_integrator
from reslrb_cli.measure.gradients import Case, integrator, relative
from reslrb_cli.measure.scenes.small import diffuse, room, transform

pytestmark = pytest.mark.usefixtures("llvm")
BY_NAME = {case.name: case for case in CASES}
FEW = ("texture", "passes", "glass", "area_texture", "envmap")
NAMES = ("texture", "roulette", "passes", "gaussian", "thin_lens", "plastic", "glass", "bumpmap", "area_texture",
         "envmap", "visible_lamp")  # fmt: skip


def options(case: GradientCase) -> dict:
    return {name: value for name, value in {**case.options, **case.both}.items() if name != "image"}


@taking_turns("name", NAMES, "adjoint", ("correlated", "independent"), FEW)
def test_equal_seeds_give_equal_gradients(name: str, adjoint: str) -> None:
    named = BY_NAME[name]
    case = Case(named.scene(), named.keys)
    expected = case.gradient(integrator("walk_ad", **options(named)), 3, 8, adjoint=adjoint)
    found = case.gradient(integrator("trajectory", **options(named)), 3, 8, adjoint=adjoint)
    assert np.abs(expected).sum() > 0
    assert relative(found, expected) < 2e-5


def test_masks_without_parameters_are_passed() -> None:
    mask = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}
    placed = transform(translate=[0.1, 0.2, 0.2], rotate=([1, 0, 0], -80), scale=0.5)
    case = Case(room(veil={"type": "rectangle", "to_world": placed, "bsdf": mask}), ("floor.brdf_0.reflectance.value",))
    expected = case.gradient(integrator("walk_ad", 6), 3, 8)
    assert np.abs(expected).sum() > 0
    assert relative(case.gradient(integrator("trajectory", 6), 3, 8), expected) < 2e-5


def test_masks_with_parameters_are_refused() -> None:
    named = BY_NAME["mask"]
    case = Case(named.scene(), named.keys)
    with pytest.raises(UnsupportedScene, match="masks"):
        case.gradient(integrator("trajectory"), 3, 8)


def test_endless_paths_are_refused() -> None:
    with pytest.raises(Exception, match="max_depth"):
        make_integrator("trajectory", max_depth=-1)


@pytest.mark.parametrize("name", ["ptracer", "trajectory", "walk_ad", "reservoir", "gather", "stack"])
def test_a_known_adjoint_gives_image_and_gradient_of_a_correlated_step(name: str) -> None:
    import drjit as dr

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
