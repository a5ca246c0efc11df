"""Glass and masks: what light passes, straight or bent, wholly or not at all."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import camera as pinhole
from reslrb_cli.measure.analytic_scenes import refraction_scene, slab_scene
from reslrb_cli.measure.extreme.case import Differences, Exact, ExtremeCase, Stock
from reslrb_cli.measure.small_scenes import bitmap, diffuse, rgb, room, transform

FLOOR = "floor.brdf_0.reflectance.value"
WALL = "wall.brdf_0.reflectance.value"
LAMP = "lamp.emitter.radiance.value"
VEIL = "veil.bsdf.nested_bsdf.brdf_0.reflectance.value"
OPACITY = "veil.bsdf.opacity.value"


def veiled(opacity: Any, **changes: Any) -> dict:
    """A sheet between lamp and floor, and between camera and wall."""
    bsdf = {"type": "mask", "opacity": opacity, "id": "veil_bsdf",
            "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}  # fmt: skip
    place = transform(translate=[0.1, 0.2, 0.2], rotate=([1, 0, 0], -80), scale=0.5)
    return room(veil={"type": "rectangle", "to_world": place, "bsdf": bsdf}, **changes)


def nested() -> dict:
    """A ball of glass in a ball of water, out of the camera's view of the floor below."""
    water = {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.0, "specular_transmittance": rgb(0.9, 0.8, 0.7)}
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.33, "specular_transmittance": rgb(0.7, 0.8, 0.9),
             "specular_reflectance": rgb(0.9, 0.6, 0.8)}  # fmt: skip
    return {
        "type": "scene",
        "camera": pinhole([0, 0.3, 0], [0, 0, 0], [0, 0, -1], 80),
        "floor": {"type": "rectangle", "bsdf": diffuse(0.7, 0.5, 0.6),
                  "to_world": transform(rotate=([1, 0, 0], -90), scale=2)},
        "water": {"type": "sphere", "center": [0, 1, 0], "radius": 0.6, "bsdf": water},
        "glass": {"type": "sphere", "center": [0.1, 1, 0], "radius": 0.35, "bsdf": glass},
        "lamp": {"type": "rectangle", "bsdf": diffuse(0, 0, 0), "emitter": {"type": "area", "radiance": rgb(9, 8, 7)},
                 "to_world": transform(translate=[0, 2.2, 0], rotate=([1, 0, 0], 90), scale=0.5)},
    }  # fmt: skip


def critical() -> dict:
    """A beam in a medium of index 1.5 that meets its flat surface, y = 0, at the critical angle, and the bottom that
    total reflection lights."""
    import mitsuba as mi

    theta = float(np.arcsin(1 / 1.5))
    start = [-float(np.sin(theta)), -float(np.cos(theta)), 0.0]
    aim = mi.ScalarTransform4f().look_at(origin=start, target=[0, 0, 0], up=[0, 0, 1])
    below = [4 * float(np.tan(theta)), -4.0, 0.0]
    surface = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0, "specular_reflectance": rgb(0.9, 0.7, 0.5)}
    return {
        "type": "scene",
        "camera": pinhole([below[0], -3, 2], below, [0, 1, 0], 20),
        "surface": {"type": "rectangle", "bsdf": surface,
                    "to_world": transform(rotate=([1, 0, 0], -90), scale=3)},
        "floor": {"type": "rectangle", "bsdf": diffuse(0.7, 0.5, 0.6),
                  "to_world": transform(translate=below, rotate=([1, 0, 0], -90), scale=2)},
        "lamp": {"type": "rectangle", "bsdf": diffuse(0, 0, 0), "to_world": aim @ mi.ScalarTransform4f().scale(0.5),
                 "emitter": {"type": "directionalarea", "radiance": rgb(3, 2, 4)}},
    }  # fmt: skip


def refraction(ior: float) -> Any:
    return refraction_scene(ior=ior)


def slab(ior: float, degrees: float, max_depth: int) -> Any:
    return slab_scene(ior=ior, degrees=degrees, max_depth=max_depth)


SURFACE = ("plane.bsdf.reflectance.value", "light.intensity.value", "surface.bsdf.specular_transmittance.value")
SLAB = ("plane.bsdf.reflectance.value", "lamp.emitter.radiance.value", "top.bsdf.specular_transmittance.value",
        "top.bsdf.specular_reflectance.value")  # fmt: skip


def _exact(name: str, about: str, known: Any, keys: tuple[str, ...], max_depth: int, **more: Any) -> ExtremeCase:
    return ExtremeCase(name, about, lambda: known().scene(), keys, Exact(known), image="ptracer", spp=512,
                       options={"max_depth": max_depth}, **more)  # fmt: skip


CASES = [
    ExtremeCase("opacity_0", "a mask that is not there", lambda: veiled(0.0), (FLOOR, LAMP), Stock("prb"), spp=128),
    ExtremeCase("opacity_1", "a mask that hides all", lambda: veiled(1.0), (FLOOR, LAMP, VEIL), Stock("prb"), spp=128),
    ExtremeCase("opacity_texture_0_and_1", "a mask of opaque and of clear texels",
                lambda: veiled(bitmap(np.array([[[0.0], [1.0]], [[1.0], [0.0]]]))), (FLOOR, LAMP, VEIL), Stock("prb"),
                spp=128),
    ExtremeCase("opacity_0.4", "the opacity of a mask, at a depth at which the image is quadratic in it",
                lambda: veiled(0.4), (OPACITY,), Differences(0.3), spp=1024, options={"max_depth": 3}, signed=True),
    ExtremeCase("albedo_0_behind_mask", "a wall that is 0 in one channel behind a mask: what the mask lets pass is "
                "a factor of a derivative that no contribution shows",
                lambda: veiled(0.4, wall={"type": "twosided", "bsdf": diffuse(0, 0.7, 0.4)}), (WALL, VEIL),
                Differences(0.05, "up"), spp=128),
    ExtremeCase("nested_dielectrics", "a ball of glass in a ball of water", nested,
                ("water.bsdf.specular_transmittance.value", "glass.bsdf.specular_transmittance.value",
                 "floor.bsdf.reflectance.value"), Stock("ptracer"), image="ptracer", spp=512,
                options={"max_depth": 8}),
    ExtremeCase("critical_angle", "a beam that is totally reflected at the critical angle", critical,
                ("surface.bsdf.specular_reflectance.value", "floor.bsdf.reflectance.value"), Stock("ptracer"),
                image="ptracer", spp=512),
    _exact("refraction", "a point light over a pool", lambda: refraction(1.5), SURFACE, 3),
    _exact("index_1", "the same without a change of index", lambda: refraction(1.0), SURFACE, 3),
    _exact("index_3", "the same with index 3", lambda: refraction(3.0), SURFACE, 3),
    _exact("slab", "a beam through a glass slab, reflected inside it up to six times", lambda: slab(1.5, 40, 10), SLAB,
           10, seeds=24),
    _exact("slab_index_3_grazing", "index 3 at 85 degrees: most of the light is reflected",
           lambda: slab(3.0, 85, 10), SLAB, 10),
]  # fmt: skip
