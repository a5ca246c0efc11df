"""Cases of the gradient conformance tests. Each case has a scene, parameters and a reference.

- `ptracer` is naive AD. It is not used where sampling depends on the parameter, because `ptracer` differentiates
    densities but not the choice of lobe.
- `prb` is not used for delta lobes, which `prb` does not differentiate, or where only light paths find the light.
- `fd` means finite differences of our own image. The image tests compare this image with `path` and `ptracer`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.measure.scenes.small import bitmap, camera, diffuse, lamp, rgb, room, texture, transform


@dataclass(frozen=True)
class GradientCase:
    """One scene and its parameters. `scene` is a function because it may need Mitsuba.

    `step` and `sides` are settings of finite differences. `options` holds options of `reslrb` alone, and `both` holds
    options of both integrators.
    """

    name: str
    scene: Callable[[], dict]
    keys: tuple[str, ...]
    reference: str
    spp: int = 64
    step: float = 0.05
    sides: str = "both"
    options: dict[str, Any] = field(default_factory=dict)
    both: dict[str, Any] = field(default_factory=dict)


def floor(bsdf: dict, **changes: Any) -> dict:
    """Return the room with the unchanged `bsdf` on its floor. The BSDF's parameters are named `floor.*`."""
    return room(floor=bsdf, **changes)


def _tiles(low: float = 0.2, high: float = 0.8, channels: int = 3, seed: int = 1) -> dict:
    return texture(2, 2, low, high, seed, channels)


def _pane(bsdf: dict, **to_world: Any) -> dict:
    """Return a small sheet that hangs in the room. By default, the sheet is between the light and the floor."""
    placed = to_world or {"translate": [0.1, 0.2, 0.2], "rotate": ([1, 0, 0], -80), "scale": 0.5}
    return {"type": "rectangle", "to_world": transform(**placed), "bsdf": bsdf}


#: Place of a sheet between the camera and the corner.
_IN_VIEW = {"translate": [0.2, -0.1, 1.2], "rotate": ([0, 1, 0], 15), "scale": 0.4}


def black_pane(color: tuple[float, float, float], **to_world: Any) -> dict:
    """Return a pane of thin glass that lets light of this colour through."""
    return _pane({"type": "thindielectric", "specular_transmittance": rgb(*color)}, **to_world)


def _ball(bsdf: dict) -> dict:
    return {"type": "sphere", "center": [0.1, 0.0, 0.1], "radius": 0.35, "bsdf": bsdf}


def _mask(opacity: Any, **to_world: Any) -> dict:
    return room(veil=_pane({"type": "mask", "opacity": opacity, "id": "veil_bsdf",
                            "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}, **to_world))  # fmt: skip


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
    sheet = mi.Mesh("sheet", 4, 2, has_vertex_texcoords=False, props=_mesh_properties())
    params = mi.traverse(sheet)
    params["vertex_positions"] = [-0.8, -0.6, -0.5, 0.6, -0.6, -0.5, 0.6, -0.5, 0.6, -0.8, -0.4, 0.5]
    params["faces"] = [0, 2, 1, 0, 3, 2]
    params.update()
    sheet.add_attribute("vertex_color", 3, [0.8, 0.3, 0.2, 0.2, 0.7, 0.4, 0.5, 0.5, 0.9, 0.6, 0.8, 0.3])
    return room(sheet=sheet)


def _mesh_properties() -> Any:
    properties = mi.Properties()
    bsdf = mi.load_dict({"type": "twosided", "bsdf": {
        "type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}})  # fmt: skip
    properties["mesh_bsdf"] = bsdf
    return properties


FLOOR = "floor.brdf_0.reflectance.data"


def _textured(**changes: Any) -> dict:
    return floor({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(3, 4)}}, **changes)


CASES = [
    # ---- What a walk may do: texture and colours throughout ----
    GradientCase("texture", _textured, (FLOOR, "wall.brdf_0.reflectance.value"), "ptracer"),
    GradientCase("texture_prb", _textured, (FLOOR,), "prb"),
    GradientCase("roulette", _textured, (FLOOR,), "ptracer", options={"rr_depth": 1}, both={"max_depth": 6}),
    GradientCase("passes", _textured, (FLOOR,), "ptracer", options={"samples_per_pass": 16}),
    GradientCase("gaussian", lambda: _textured(camera=camera("gaussian")), (FLOOR,), "ptracer"),
    GradientCase("lanczos", lambda: _textured(camera=camera("lanczos")), (FLOOR,), "ptracer"),
    GradientCase(
        "crop",
        lambda: _textured(camera=camera("tent", crop_offset_x=3, crop_offset_y=5, crop_width=9, crop_height=7)),
        (FLOOR,), "ptracer"),
    GradientCase("rgba", lambda: _textured(camera=camera(pixel_format="rgba")), (FLOOR,), "ptracer"),
    GradientCase("thin_lens", lambda: _textured(camera=camera(sensor="thinlens")), (FLOOR,), "ptracer"),
    # ---- BSDFs ----
    GradientCase("one_sided", lambda: floor({"type": "diffuse", "reflectance": _tiles()}),
                 ("floor.reflectance.data",), "ptracer"),
    GradientCase("roughconductor",
                 lambda: floor({"type": "roughconductor", "alpha": 0.4, "specular_reflectance": _tiles()}),
                 ("floor.alpha.value", "floor.specular_reflectance.data"), "prb"),
    GradientCase("roughconductor_texture",
                 lambda: floor({"type": "roughconductor", "alpha": _tiles(0.3, 0.6, 1)}),
                 ("floor.alpha.data",), "prb"),
    GradientCase("plastic",
                 lambda: floor({"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.5),
                                "specular_reflectance": rgb(0.9, 0.8, 0.7)}),
                 ("floor.diffuse_reflectance.value", "floor.specular_reflectance.value"), "fd"),
    GradientCase("roughplastic",
                 lambda: floor({"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": _tiles(),
                                "specular_reflectance": rgb(0.9, 0.8, 0.7)}),
                 ("floor.diffuse_reflectance.data", "floor.specular_reflectance.value"), "prb"),
    GradientCase("principled",
                 lambda: floor({"type": "principled", "base_color": _tiles(), "roughness": 0.5, "metallic": 0.3}),
                 ("floor.base_color.data", "floor.roughness.value", "floor.metallic.value"), "prb"),
    GradientCase("blend",
                 lambda: floor({"type": "blendbsdf", "weight": _tiles(channels=1), "first": diffuse(0.8, 0.3, 0.2),
                                "second": {"type": "roughconductor", "alpha": 0.3}}),
                 ("floor.weight.data", "floor.bsdf_0.reflectance.value"), "prb"),
    GradientCase("twosided",
                 lambda: room(pane=_pane({"type": "twosided", "id": "pane_bsdf", "front": diffuse(0.8, 0.3, 0.2),
                                          "back": diffuse(0.2, 0.7, 0.5)}, **_IN_VIEW)),
                 ("pane.bsdf.brdf_0.reflectance.value", "pane.bsdf.brdf_1.reflectance.value"), "ptracer"),
    GradientCase("bumpmap", lambda: floor(_perturbed("bumpmap")),
                 ("floor.nested_texture.data",), "prb", spp=256),
    GradientCase("normalmap", lambda: floor(_perturbed("normalmap")), ("floor.normalmap.data",), "prb", spp=256),
    GradientCase("mirror", lambda: room(pane=_pane({"type": "twosided", "bsdf": {
                     "type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)}}),
                     floor={"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _tiles()}}),
                 ("pane.bsdf.brdf_0.specular_reflectance.value", FLOOR), "ptracer", spp=128),
    GradientCase("glass", lambda: room(ball=_ball({"type": "dielectric", "specular_reflectance": rgb(0.9, 0.7, 0.5),
                                                   "specular_transmittance": rgb(0.8, 0.9, 0.7)})),
                 ("ball.bsdf.specular_reflectance.value", "ball.bsdf.specular_transmittance.value",
                  "floor.brdf_0.reflectance.value"), "ptracer", spp=128, both={"max_depth": 6}),
    GradientCase("roughdielectric",
                 lambda: room(ball=_ball({"type": "roughdielectric", "alpha": 0.3,
                                          "specular_transmittance": rgb(0.9, 0.7, 0.5)})),
                 ("ball.bsdf.specular_transmittance.value", "ball.bsdf.alpha.value"), "prb", spp=512,
                 both={"max_depth": 5}),
    GradientCase("bumped_mirror",
                 lambda: floor({"type": "bumpmap", "scale": 1.0, "bsdf": {
                                    "type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)},
                                "arbitrary": bitmap(np.random.default_rng(5).uniform(0, 0.1, (4, 4, 1)), "bilinear")}),
                 ("floor.nested_bsdf.specular_reflectance.value",), "fd", spp=128),
    GradientCase("mesh_attribute", _vertex_colors, ("sheet.vertex_color",), "ptracer"),
    # ---- Masks ----
    GradientCase("mask", lambda: _mask(0.4),
                 ("veil.bsdf.opacity.value", "veil.bsdf.nested_bsdf.brdf_0.reflectance.value",
                  "floor.brdf_0.reflectance.value"), "fd"),
    GradientCase("mask_not_differentiated", lambda: _mask(0.4), ("floor.brdf_0.reflectance.value",), "prb"),
    GradientCase("mask_texture_in_view", lambda: _mask(_tiles(channels=1), **_IN_VIEW),
                 ("veil.bsdf.opacity.data",), "fd", spp=128),
    GradientCase("plastic_beside_mask",
                 lambda: _mask(0.4) | {"floor": {"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.5),
                                                 "specular_reflectance": rgb(0.9, 0.8, 0.7)}},
                 ("floor.diffuse_reflectance.value", "floor.specular_reflectance.value"), "fd", spp=256),
    GradientCase("masked_mirror",
                 lambda: room(pane=_pane({"type": "mask", "opacity": 0.6, "bsdf": {"type": "twosided", "bsdf": {
                     "type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)}}})),
                 ("pane.bsdf.opacity.value", "pane.bsdf.nested_bsdf.brdf_0.specular_reflectance.value"), "fd", spp=256),
    GradientCase("thin_glass",
                 lambda: room(pane=_pane({"type": "thindielectric", "specular_transmittance": rgb(0.9, 0.7, 0.5),
                                          "specular_reflectance": rgb(0.7, 0.8, 0.9)})),
                 ("pane.bsdf.specular_transmittance.value", "pane.bsdf.specular_reflectance.value"), "fd", spp=256),
    GradientCase("black_pane", lambda: room(pane=black_pane((0, 0.6, 0.7), **_IN_VIEW)),
                 ("pane.bsdf.specular_transmittance.value", "floor.brdf_0.reflectance.value"), "fd", spp=256),
    # ---- Emitters ----
    GradientCase("area", room, ("lamp.emitter.radiance.value", "wall.brdf_0.reflectance.value"), "ptracer"),
    GradientCase("area_texture", lambda: room(lamp=lamp(radiance=_tiles(2, 6))),
                 ("lamp.emitter.radiance.data",), "prb"),
    GradientCase("area_texture_bilinear",
                 lambda: room(lamp=lamp(radiance=bitmap(np.random.default_rng(4).uniform(1, 5, (3, 3, 3)),
                                                           "bilinear"))),
                 ("lamp.emitter.radiance.data",), "prb"),
    GradientCase("point", lambda: _emitter(type="point", position=[0.5, 0.9, 0.8], intensity=rgb(1, 2, 3)),
                 ("light.intensity.value",), "ptracer"),
    GradientCase("spot", lambda: _emitter(type="spot", intensity=rgb(3, 2, 1), cutoff_angle=40,
                                          to_world=transform(translate=[0.2, 1.5, 0.3], rotate=([1, 0, 0], 90))),
                 ("light.intensity.value",), "ptracer"),
    GradientCase("projector", lambda: _emitter(type="projector", irradiance=_tiles(1, 4), fov=45,
                                               to_world=transform(translate=[0.2, 1.5, 0.3], rotate=([1, 0, 0], 90))),
                 ("light.irradiance.data",), "prb"),
    GradientCase("directional",
                 lambda: _emitter(type="directional", direction=[-0.3, -1, -0.5], irradiance=rgb(1, 2, 3)),
                 ("light.irradiance.value",), "ptracer", spp=128),
    GradientCase("directionalarea", lambda: room(lamp=lamp() | {"emitter": {"type": "directionalarea",
                                                                            "radiance": rgb(3, 2, 4)}}),
                 ("lamp.emitter.radiance.value",), "ptracer"),
    GradientCase("constant", lambda: _emitter(type="constant", radiance=rgb(1, 0.5, 0.8)),
                 ("light.radiance.value", "wall.brdf_0.reflectance.value"), "prb", spp=128),
    GradientCase("envmap", _environment, ("sky.data",), "prb", spp=256),
    GradientCase("two_emitters", lambda: _environment() | {"lamp": lamp(radiance=rgb(3, 4, 5))},
                 ("sky.data", "lamp.emitter.radiance.value", "floor.brdf_0.reflectance.value"), "prb", spp=256),
    GradientCase("visible_lamp",
                 lambda: room(sign=_pane(diffuse(0.2, 0.2, 0.2), **_IN_VIEW)
                              | {"emitter": {"type": "area", "radiance": _tiles(0.5, 2)}}),
                 ("sign.emitter.radiance.data", "lamp.emitter.radiance.value"), "prb"),
]  # fmt: skip

#: Cases in which the default suite compares the exact estimators with naive AD (test_gradients.py).
AT_EQUAL_SEEDS = ("roulette", "mask_texture_in_view", "visible_lamp")
#: Cases in which the default suite compares the reservoir with stock integrators and with finite differences.
IN_EXPECTATION = ("roughconductor", "glass", "mask")
