"""Cases of the gradient conformance tests. Each case has a scene, parameters and a reference.

- `ptracer` is naive AD. It is not used where sampling depends on the parameter, because `ptracer` differentiates
    densities but not the choice of lobe.
- `prb` is not used for delta lobes, which `prb` does not differentiate, or where only light paths find the light.
- `fd` means finite differences of our own image. The image tests compare this image with `path` and `ptracer`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.measure.scenes.case import Differences, SceneCase, Source
from reslrb_cli.measure.scenes.catalogue import FLOOR, LAMP, OPACITY, PRB, PTRACER, TEXELS, VEIL, WALL
from reslrb_cli.measure.scenes.moving import mesh
from reslrb_cli.measure.scenes.small import (
    bitmap,
    camera,
    diffuse,
    lamp,
    matte,
    rectangle,
    rgb,
    room,
    sphere,
    texture,
    transform,
    veiled,
)

FD = Differences(0.05)


def case(name: str, scene: Callable[[], dict], keys: tuple[str, ...], source: Source = PTRACER, **more: Any
         ) -> SceneCase:  # fmt: skip
    return SceneCase(name, "", scene, keys, source, **more)


def floor(bsdf: dict, **changes: Any) -> dict:
    """Return the room with the unchanged `bsdf` on its floor. The BSDF's parameters are named `floor.*`."""
    return room(floor=bsdf, **changes)


def _tiles(low: float = 0.2, high: float = 0.8, channels: int = 3, seed: int = 1) -> dict:
    return texture(2, 2, low, high, seed, channels)


def _pane(bsdf: dict, **to_world: Any) -> dict:
    """Return a small sheet that hangs in the room. By default, the sheet is between the light and the floor."""
    return rectangle(bsdf, **to_world or {"translate": [0.1, 0.2, 0.2], "rotate": ([1, 0, 0], -80), "scale": 0.5})


#: Place of a sheet between the camera and the corner.
_IN_VIEW = {"translate": [0.2, -0.1, 1.2], "rotate": ([0, 1, 0], 15), "scale": 0.4}


def black_pane(color: tuple[float, float, float], **to_world: Any) -> dict:
    """Return a pane of thin glass that lets light of this colour through."""
    return _pane({"type": "thindielectric", "specular_transmittance": rgb(*color)}, **to_world)


def _ball(bsdf: dict) -> dict:
    return sphere(bsdf, [0.1, 0.0, 0.1], 0.35)


def _perturbed(kind: str) -> dict:
    random = np.random.default_rng(5)
    if kind == "bumpmap":
        height = bitmap(random.uniform(0, 0.3, (4, 4, 1)), "bilinear")
        return {"type": kind, "arbitrary": height, "scale": 1.0, "bsdf": diffuse(0.7, 0.5, 0.6)}
    normals = np.concatenate([random.uniform(0.35, 0.65, (4, 4, 2)), np.ones((4, 4, 1))], -1)
    return {"type": kind, "normalmap": bitmap(normals, "bilinear") | {"raw": True}, "bsdf": diffuse(0.7, 0.5, 0.6)}


def _emitter(**emitter: Any) -> dict:
    return room(lamp=None, light=emitter)


def _environment() -> dict:
    sky = np.random.default_rng(2).uniform(0.3, 1.5, (4, 8, 3)).astype(np.float32)
    return room(lamp=None, sky={"type": "envmap", "bitmap": mi.Bitmap(sky),
                                "to_world": transform(rotate=([1, 0.3, 0.2], 50))})  # fmt: skip


def _vertex_colors() -> dict:
    corners = np.array([[-0.8, -0.6, -0.5], [0.6, -0.6, -0.5], [0.6, -0.5, 0.6], [-0.8, -0.4, 0.5]])
    bsdf = matte({"type": "mesh_attribute", "name": "vertex_color"})
    sheet = mesh(corners, np.array([[0, 2, 1], [0, 3, 2]]), bsdf, name="sheet")
    sheet.add_attribute("vertex_color", 3, [0.8, 0.3, 0.2, 0.2, 0.7, 0.4, 0.5, 0.5, 0.9, 0.6, 0.8, 0.3])
    return room(sheet=sheet)


def _textured(**changes: Any) -> dict:
    return floor(matte(texture(3, 4)), **changes)


CASES = [
    # ---- What a walk may do: texture and colours throughout ----
    case("texture", _textured, (TEXELS, WALL)),
    case("texture_prb", _textured, (TEXELS,), PRB),
    case("roulette", _textured, (TEXELS,), ours={"rr_depth": 1}, options={"max_depth": 6}),
    case("passes", _textured, (TEXELS,), ours={"samples_per_pass": 16}),
    case("gaussian", lambda: _textured(camera=camera("gaussian")), (TEXELS,)),
    case("lanczos", lambda: _textured(camera=camera("lanczos")), (TEXELS,)),
    case("crop",
         lambda: _textured(camera=camera("tent", crop_offset_x=3, crop_offset_y=5, crop_width=9, crop_height=7)),
         (TEXELS,)),
    case("rgba", lambda: _textured(camera=camera(pixel_format="rgba")), (TEXELS,)),
    case("thin_lens", lambda: _textured(camera=camera(sensor="thinlens")), (TEXELS,)),
    # ---- BSDFs ----
    case("one_sided", lambda: floor(diffuse(_tiles())), ("floor.reflectance.data",)),
    case("roughconductor", lambda: floor({"type": "roughconductor", "alpha": 0.4, "specular_reflectance": _tiles()}),
         ("floor.alpha.value", "floor.specular_reflectance.data"), PRB),
    case("roughconductor_texture", lambda: floor({"type": "roughconductor", "alpha": _tiles(0.3, 0.6, 1)}),
         ("floor.alpha.data",), PRB),
    case("plastic", lambda: floor({"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.5),
         "specular_reflectance": rgb(0.9, 0.8, 0.7)}),
         ("floor.diffuse_reflectance.value", "floor.specular_reflectance.value"), FD),
    case("roughplastic", lambda: floor({"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": _tiles(),
         "specular_reflectance": rgb(0.9, 0.8, 0.7)}),
         ("floor.diffuse_reflectance.data", "floor.specular_reflectance.value"), PRB),
    case("principled",
         lambda: floor({"type": "principled", "base_color": _tiles(), "roughness": 0.5, "metallic": 0.3}),
         ("floor.base_color.data", "floor.roughness.value", "floor.metallic.value"), PRB),
    case("blend", lambda: floor({"type": "blendbsdf", "weight": _tiles(channels=1), "first": diffuse(0.8, 0.3, 0.2),
         "second": {"type": "roughconductor", "alpha": 0.3}}),
         ("floor.weight.data", "floor.bsdf_0.reflectance.value"), PRB),
    case("twosided", lambda: room(pane=_pane({"type": "twosided", "id": "pane_bsdf", "front": diffuse(0.8, 0.3, 0.2),
         "back": diffuse(0.2, 0.7, 0.5)}, **_IN_VIEW)),
         ("pane.bsdf.brdf_0.reflectance.value", "pane.bsdf.brdf_1.reflectance.value")),
    case("bumpmap", lambda: floor(_perturbed("bumpmap")), ("floor.nested_texture.data",), PRB, spp=256),
    case("normalmap", lambda: floor(_perturbed("normalmap")), ("floor.normalmap.data",), PRB, spp=256),
    case("mirror", lambda: room(pane=_pane({"type": "twosided", "bsdf": {
         "type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)}}), floor=matte(_tiles())),
         ("pane.bsdf.brdf_0.specular_reflectance.value", TEXELS), spp=128),
    case("glass", lambda: room(ball=_ball({"type": "dielectric", "specular_reflectance": rgb(0.9, 0.7, 0.5),
         "specular_transmittance": rgb(0.8, 0.9, 0.7)})),
         ("ball.bsdf.specular_reflectance.value", "ball.bsdf.specular_transmittance.value",
         FLOOR), spp=128, options={"max_depth": 6}),
    case("roughdielectric", lambda: room(ball=_ball({"type": "roughdielectric", "alpha": 0.3,
         "specular_transmittance": rgb(0.9, 0.7, 0.5)})),
         ("ball.bsdf.specular_transmittance.value", "ball.bsdf.alpha.value"), PRB, spp=512, options={"max_depth": 5}),
    case("bumped_mirror", lambda: floor({"type": "bumpmap", "scale": 1.0, "bsdf": {
         "type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)},
         "arbitrary": bitmap(np.random.default_rng(5).uniform(0, 0.1, (4, 4, 1)), "bilinear")}),
         ("floor.nested_bsdf.specular_reflectance.value",), FD, spp=128),
    case("mesh_attribute", _vertex_colors, ("sheet.vertex_color",)),
    # ---- Masks ----
    case("mask", lambda: veiled(0.4), (OPACITY, VEIL, FLOOR), FD),
    case("mask_not_differentiated", lambda: veiled(0.4), (FLOOR,), PRB),
    case("mask_texture_in_view", lambda: veiled(_tiles(channels=1), _IN_VIEW),
         ("veil.bsdf.opacity.data",), FD, spp=128),
    case("plastic_beside_mask",
         lambda: veiled(0.4) | {"floor": {"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.5),
         "specular_reflectance": rgb(0.9, 0.8, 0.7)}},
         ("floor.diffuse_reflectance.value", "floor.specular_reflectance.value"), FD, spp=256),
    case("masked_mirror",
         lambda: room(pane=_pane({"type": "mask", "opacity": 0.6, "bsdf": {"type": "twosided", "bsdf": {
         "type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)}}})),
         ("pane.bsdf.opacity.value", "pane.bsdf.nested_bsdf.brdf_0.specular_reflectance.value"), FD, spp=256),
    case("thin_glass",
         lambda: room(pane=_pane({"type": "thindielectric", "specular_transmittance": rgb(0.9, 0.7, 0.5),
         "specular_reflectance": rgb(0.7, 0.8, 0.9)})),
         ("pane.bsdf.specular_transmittance.value", "pane.bsdf.specular_reflectance.value"), FD, spp=256),
    case("black_pane", lambda: room(pane=black_pane((0, 0.6, 0.7), **_IN_VIEW)),
         ("pane.bsdf.specular_transmittance.value", FLOOR), FD, spp=256),
    # ---- Emitters ----
    case("area", room, (LAMP, WALL)),
    case("area_texture", lambda: room(lamp=lamp(radiance=_tiles(2, 6))), ("lamp.emitter.radiance.data",), PRB),
    case("area_texture_bilinear",
         lambda: room(lamp=lamp(radiance=bitmap(np.random.default_rng(4).uniform(1, 5, (3, 3, 3)), "bilinear"))),
         ("lamp.emitter.radiance.data",), PRB),
    case("point", lambda: _emitter(type="point", position=[0.5, 0.9, 0.8], intensity=rgb(1, 2, 3)),
         ("light.intensity.value",)),
    case("spot", lambda: _emitter(type="spot", intensity=rgb(3, 2, 1), cutoff_angle=40,
         to_world=transform(translate=[0.2, 1.5, 0.3], rotate=([1, 0, 0], 90))), ("light.intensity.value",)),
    case("projector", lambda: _emitter(type="projector", irradiance=_tiles(1, 4), fov=45,
         to_world=transform(translate=[0.2, 1.5, 0.3], rotate=([1, 0, 0], 90))), ("light.irradiance.data",), PRB),
    case("directional", lambda: _emitter(type="directional", direction=[-0.3, -1, -0.5], irradiance=rgb(1, 2, 3)),
         ("light.irradiance.value",), spp=128),
    case("directionalarea", lambda: room(lamp=lamp() | {"emitter": {"type": "directionalarea",
         "radiance": rgb(3, 2, 4)}}), (LAMP,)),
    case("constant", lambda: _emitter(type="constant", radiance=rgb(1, 0.5, 0.8)),
         ("light.radiance.value", WALL), PRB, spp=128),
    case("envmap", _environment, ("sky.data",), PRB, spp=256),
    case("two_emitters", lambda: _environment() | {"lamp": lamp(radiance=rgb(3, 4, 5))},
         ("sky.data", LAMP, FLOOR), PRB, spp=256),
    case("visible_lamp", lambda: room(sign=_pane(diffuse(0.2, 0.2, 0.2), **_IN_VIEW)
         | {"emitter": {"type": "area", "radiance": _tiles(0.5, 2)}}), ("sign.emitter.radiance.data", LAMP), PRB),
]  # fmt: skip

#: Cases in which the default suite compares the exact estimators with naive AD (test_gradients.py).
AT_EQUAL_SEEDS = ("roulette", "mask_texture_in_view", "visible_lamp")
#: Cases in which the default suite compares the reservoir with stock integrators and with finite differences.
IN_EXPECTATION = ("roughconductor", "glass", "mask")
