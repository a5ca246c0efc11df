"""Factors that are exactly zero: their derivative is finite, and neither estimator may lose it.

The image is a polynomial in each parameter, so that finite differences, one-sided where the domain ends, are exact up
to rounding as long as the paths do not depend on the parameter; otherwise they are compared in expectation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from agreement import compare
from conformance.gradient_cases import _IN_VIEW, FLOOR, _mask, floor

from reslrb_cli.measure.gradients import Case, integrator, relative, seeds
from reslrb_cli.measure.scenes.small import bitmap, diffuse, lamp, rgb, room

pytestmark = pytest.mark.usefixtures("llvm")


def tiles(*texels: tuple[float, ...]) -> dict:
    """A texture with these columns; two rows and columns is the least that Mitsuba takes."""
    return bitmap(
        np.broadcast_to(np.array(texels, float).reshape(1, len(texels), -1), (2, len(texels), len(texels[0])))
    )


def matte(texture: dict) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}


def blend(weight: dict) -> dict:
    return {"type": "blendbsdf", "weight": weight, "first": diffuse(0.8, 0.3, 0.2), "second": diffuse(0.1, 0.6, 0.4)}


@dataclass(frozen=True)
class ZeroCase:
    """`sides`: which way the domain goes on. `fixed_paths`: paths do not depend on the parameters."""

    name: str
    scene: Callable[[], dict]
    keys: tuple[str, ...]
    sides: str = "up"
    fixed_paths: bool = True
    step: float = 0.1
    spp: int = 64
    max_depth: int = 4
    lost: str = ""  # why the derivative is not found, where it is known not to be


CLIPPED = "Mitsuba clips opacities and weights to [0, 1], and Dr.Jit's clip has no derivative at the lower end"
NOT_SAMPLED = "what has a probability of zero is not sampled, here light that passes an opaque mask"

CASES = [
    ZeroCase("texel_zero_in_one_channel", lambda: floor(matte(tiles((0.5, 0.0, 0.4), (0.6, 0.3, 0.0)))), (FLOOR,)),
    ZeroCase("texel_zero_in_all", lambda: floor(matte(tiles((0, 0, 0), (0.6, 0.3, 0.5)))), (FLOOR,)),
    ZeroCase("everything_black", lambda: room(floor=matte(tiles((0, 0, 0), (0, 0, 0))), wall=matte(rgb(0, 0, 0)),
                                              side=matte(rgb(0.5, 0, 0.5))),
             (FLOOR, "wall.brdf_0.reflectance.value", "side.brdf_0.reflectance.value"), max_depth=5),
    ZeroCase("lamp_zero_in_one_channel", lambda: room(lamp=lamp(radiance=rgb(2, 0, 3))),
             ("lamp.emitter.radiance.value", "floor.brdf_0.reflectance.value")),
    ZeroCase("lamp_zero_in_all", lambda: room(lamp=lamp(radiance=rgb(0, 0, 0))), ("lamp.emitter.radiance.value",)),
    ZeroCase("lamp_and_texel_zero", lambda: floor(matte(tiles((0, 0.4, 0), (0.6, 0.3, 0.5))),
                                                  lamp=lamp(radiance=rgb(0, 2, 3))),
             ("lamp.emitter.radiance.value", FLOOR)),
    ZeroCase("lamp_texture_zero_in_one_channel",
             lambda: room(lamp=lamp(radiance=tiles((4, 0, 3), (1, 2, 5)))), ("lamp.emitter.radiance.data",),
             fixed_paths=False),
    ZeroCase("lamp_texture_zero_in_all", lambda: room(lamp=lamp(radiance=tiles((0, 0, 0), (1, 2, 5)))),
             ("lamp.emitter.radiance.data",), fixed_paths=False),
    ZeroCase("point_zero", lambda: room(lamp=None, light={"type": "point", "position": [0.5, 0.9, 0.8],
                                                           "intensity": rgb(0, 1, 0)}), ("light.intensity.value",)),
    ZeroCase("constant_zero", lambda: room(lamp=None, light={"type": "constant", "radiance": rgb(0, 1, 0)}),
             ("light.radiance.value",), spp=128),
    ZeroCase("opacity_0", lambda: _mask(0.0), ("veil.bsdf.opacity.value",), fixed_paths=False, spp=256, lost=CLIPPED),
    ZeroCase("opacity_1", lambda: _mask(1.0), ("veil.bsdf.opacity.value",), "down",
             fixed_paths=False, spp=256, lost=NOT_SAMPLED),
    ZeroCase("opacity_0_in_view", lambda: _mask(0.0, **_IN_VIEW), ("veil.bsdf.opacity.value",),
             fixed_paths=False, lost=CLIPPED),
    ZeroCase("opacity_1_in_view", lambda: _mask(1.0, **_IN_VIEW), ("veil.bsdf.opacity.value",), "down",
             fixed_paths=False, lost=NOT_SAMPLED),
    ZeroCase("opacity_near_0", lambda: _mask(0.08), ("veil.bsdf.opacity.value",), "both", fixed_paths=False, step=0.08,
             spp=512),
    ZeroCase("opacity_near_1", lambda: _mask(0.92, **_IN_VIEW), ("veil.bsdf.opacity.value",), "both",
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
    """The parameters' axes, or a few directions into the domain where there are many parameters: (K, P)."""
    size = sum(len(value) for value in scene.initial.values())
    return np.eye(size) if case.fixed_paths or size <= 2 else np.abs(scene.directions(2))


def differences(case: ZeroCase, scene: Case, along: np.ndarray, count: int, block: int) -> np.ndarray:
    """Finite differences: (N, K)."""
    image = integrator("walk_ad", case.max_depth)
    return np.array([
        [scene.difference(image, direction, seed, case.spp, case.step, case.sides) for direction in along]
        for seed in seeds(count, block)
    ])  # fmt: skip


#: Of the default suite: zeros of texels, lamps, blends and mirrors once; of what is lost, one.
QUICK = ("texel_zero_in_one_channel", "lamp_texture_zero_in_all", "blend_1", "mirror_zero")


def parameters() -> list:
    """The cases; those whose derivative is known to be lost have to fail."""
    return [
        pytest.param(case, id=case.name,
                     marks=[*([pytest.mark.xfail(reason=case.lost, strict=True)] if case.lost else []),
                            *([] if case.name in QUICK else [pytest.mark.long])])
        for case in CASES
    ]  # fmt: skip


@pytest.mark.parametrize("case", parameters())
def test_zero(case: ZeroCase):
    scene, count = Case(case.scene(), case.keys), 12 if case.lost else 16
    along = directions(case, scene)
    ours = scene.gradients(integrator("reslrb", case.max_depth), seeds(count), case.spp) @ along.T
    naive = scene.gradients(integrator("walk_ad", case.max_depth), seeds(count), case.spp) @ along.T
    if case.fixed_paths:
        # At equal seeds nothing but rounding is between naive AD and differences: two seeds tell.
        assert relative(naive[:2], differences(case, scene, along, 2, 0)) < 2e-3
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
