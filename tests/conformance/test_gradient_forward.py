"""Naive AD of our walk, forward mode, and the reservoir, each against the others at equal seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from agreement import compare
from conformance.gradient_cases import CASES
from conformance.scenes import plugin
from turns import a_few

from reslrb_cli.measure.gradients import Case, integrator, relative, seeds

pytestmark = pytest.mark.usefixtures("llvm")
BY_NAME = {case.name: case for case in CASES}

#: Where stock `ptracer` is right and traces the same paths: not masks, rotated environment maps, bump and normal maps,
#: nor where its directions move with a parameter, nor textures of lamps, whose black texels it does not draw.
SAME_PATHS = ("texture", "gaussian", "crop", "rgba", "thin_lens", "twosided", "mirror", "glass", "area",
              "point", "spot", "projector", "directional", "directionalarea", "constant")  # fmt: skip


@pytest.mark.parametrize(
    "name",
    a_few(SAME_PATHS, ("texture", "crop", "thin_lens", "projector")),
)
def test_walk_ad_is_ptracer(name: str):
    case = BY_NAME[name]
    scene = Case(case.scene(), case.keys)
    options = case.both | {"hide_emitters": True}
    ours = scene.gradient(integrator("walk_ad", **options), 3, 64)
    assert relative(ours, scene.gradient(integrator("ptracer", **options), 3, 64)) < 1e-4


def forward(scene: Case, integrator: Any, seed: int, spp: int) -> np.ndarray:
    """The image's derivative along the first of the random directions of the parameters, as Mitsuba's users get it."""
    import drjit as dr
    import mitsuba as mi

    def tangent() -> Any:
        image = mi.render(scene.scene, scene.params, integrator=integrator, seed=seed, seed_grad=seed + 1, spp=spp)
        return dr.forward_to(image)

    return scene.along(scene.directions(1)[0], tangent)[:, :, :3]  # derivative of alpha: none


#: Forward mode by default: what it does along a path (emission, factors, delta lobes, masks, what is seen), with
#: films and sensors; the other cases hold other BSDFs and emitters, to which it is the same.
QUICK = ("texture", "roulette", "thin_lens", "glass", "mask_texture_in_view", "two_emitters", "visible_lamp")


@pytest.mark.parametrize("name", a_few([n for n in BY_NAME if n not in ("texture_prb", "retained")], QUICK))
def test_forward_mode_is_walk_ad(name: str):
    case = BY_NAME[name]
    scene, options = Case(case.scene(), case.keys), case.both | case.options
    tangent = forward(scene, plugin("reslrb", **options), 3, 32)
    naive = forward(scene, plugin("walk_ad", **options), 3, 32)
    assert np.abs(naive).max() > 0
    assert relative(tangent, naive) < 1e-5
    # The adjoint of the same derivative: <weights, J v> = <J^T weights, v>, at the seed that forward mode had.
    gradient = scene.gradient(integrator("walk_ad", **options), 4, 32)
    assert np.sum(naive * np.array(scene.weights)) == pytest.approx(gradient @ scene.directions(1)[0], rel=1e-3)


@pytest.mark.parametrize("name", a_few(["texture", "roulette", "glass", "blend", "visible_lamp"], ["texture"]))
def test_forward_against_backward(name: str):
    """<weights, J v> against <J^T weights, v>, where J^T is the reservoir's."""
    case = BY_NAME[name]
    scene = Case(case.scene(), case.keys)
    options = case.both | case.options
    ours = plugin("reslrb", **options)
    direction = np.abs(scene.directions(1)[0])
    scene.directions = lambda count: direction[None]  # one sign, so that the product is not lost in its noise
    tangents = np.array([np.sum(forward(scene, ours, s, case.spp) * np.array(scene.weights)) for s in seeds(16)])
    gradients = scene.gradients(integrator("reslrb", **options), seeds(16, 1), case.spp) @ direction
    result = compare(tangents[:, None], gradients[:, None], block=None)
    assert result
    assert result.relative_error < 0.03
