"""The scenes that `analytic` knows the images of, as `mi.load_dict` takes them, each beside its reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.measure.analytic import Known, beam_through_slab, furnace, point_over_plane, point_through_surface
from reslrb_cli.measure.small_scenes import SIZE, diffuse, rgb, transform


@dataclass(frozen=True)
class KnownScene:
    """A scene, its image, and which parameter key each derivative of the image belongs to."""

    scene: Callable[[], dict]
    known: Known
    keys: dict[str, str]
    max_depth: int

    def gradient(self, weights: Any) -> np.ndarray:
        """Gradient of sum(image * weights) in a row, parameters in the order of `keys`."""
        gradients = self.known.gradient(weights)
        return np.concatenate([gradients[name] for name in self.keys])


def camera(origin: list, target: list, up: list, fov: float, size: int = SIZE) -> dict:
    """A pinhole camera whose image is a box filter's."""
    import mitsuba as mi

    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=up),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }


def _plane(bsdf: dict, y: float = 0) -> dict:
    """A horizontal square of side 4 that faces up."""
    return {"type": "rectangle", "bsdf": bsdf, "to_world": transform(translate=[0, y, 0], rotate=([1, 0, 0], -90),
                                                                     scale=2)}  # fmt: skip


def furnace_scene(albedo: tuple, emission: tuple, max_depth: int, size: int = SIZE) -> KnownScene:
    """The inside of a cube: Mitsuba's `path` is a quarter of a percent off in a sphere that it samples from inside."""

    def scene() -> dict:
        walls = {"type": "cube", "flip_normals": True, "bsdf": diffuse(*albedo),
                 "emitter": {"type": "area", "radiance": rgb(*emission)}}  # fmt: skip
        return {"type": "scene", "camera": camera([0, 0.1, 0.4], [0.2, 0, -1], [0, 1, 0], 60, size), "walls": walls}

    keys = {"albedo": "walls.bsdf.reflectance.value", "emission": "walls.emitter.radiance.value"}
    return KnownScene(scene, furnace(albedo, emission, max_depth, size), keys, max_depth)


def plane_scene(albedo: tuple = (0.7, 0.5, 0.3), intensity: tuple = (2, 3, 4), size: int = SIZE) -> KnownScene:
    """A point light over a plane, off the camera's axis."""
    light = (0.4, 0.8, -0.3)

    def scene() -> dict:
        return {
            "type": "scene",
            "camera": camera([0, 1.5, 0], [0, 0, 0], [0, 0, -1], 50, size),
            "light": {"type": "point", "position": list(light), "intensity": rgb(*intensity)},
            "plane": _plane(diffuse(*albedo)),
        }

    keys = {"albedo": "plane.bsdf.reflectance.value", "intensity": "light.intensity.value"}
    return KnownScene(scene, point_over_plane(albedo, intensity, light, 1.5, 50, size), keys, 2)


def refraction_scene(
    albedo: tuple = (0.7, 0.5, 0.3), intensity: tuple = (9, 6, 5), tau: tuple = (0.9, 0.8, 0.6), ior: float = 1.5,
    light: tuple = (0.3, 1.6, -0.2), size: int = SIZE,
) -> KnownScene:  # fmt: skip
    """A point light over a pool, whose bottom a camera sees from inside of it."""

    def scene() -> dict:
        glass = {"type": "dielectric", "int_ior": ior, "ext_ior": 1.0, "specular_transmittance": rgb(*tau)}
        return {
            "type": "scene",
            "camera": camera([0, 0.9, 0], [0, 0, 0], [0, 0, -1], 60, size),
            "light": {"type": "point", "position": list(light), "intensity": rgb(*intensity)},
            "plane": _plane(diffuse(*albedo)),
            "surface": _plane(glass, 1.0),
        }

    keys = {
        "albedo": "plane.bsdf.reflectance.value",
        "intensity": "light.intensity.value",
        "transmittance": "surface.bsdf.specular_transmittance.value",
    }
    known = point_through_surface(albedo, intensity, tau, ior, light, 1.0, 0.9, 60, size)
    return KnownScene(scene, known, keys, 3)


def slab_scene(
    albedo: tuple = (0.7, 0.5, 0.3), radiance: tuple = (2, 3, 4), tau: tuple = (0.9, 0.8, 0.7),
    reflectance: tuple = (0.9, 0.6, 0.8), ior: float = 1.5, degrees: float = 40, max_depth: int = 6, size: int = SIZE,
) -> KnownScene:  # fmt: skip
    """A parallel beam through a slab on a plane far below it, seen from the side."""
    distance, angle = 40.0, np.deg2rad(degrees)
    direction = np.array([np.sin(angle), -np.cos(angle), 0])
    start = -3 * direction

    def scene() -> dict:
        import mitsuba as mi

        glass = {"type": "dielectric", "int_ior": ior, "ext_ior": 1.0, "specular_transmittance": rgb(*tau),
                 "specular_reflectance": rgb(*reflectance)}  # fmt: skip
        toward = mi.ScalarTransform4f().look_at(origin=start.tolist(), target=[0, 0, 0], up=[0, 0, 1])
        below = [distance * np.tan(angle), -distance, 0.0]
        beside = [below[0] - 1.5, -distance + 3, 2.0]
        return {
            "type": "scene",
            "camera": camera(beside, below, [0, 1, 0], 12, size),
            "lamp": {"type": "rectangle", "to_world": toward, "bsdf": diffuse(0, 0, 0),
                     "emitter": {"type": "directionalarea", "radiance": rgb(*radiance)}},
            # The lower surface faces down: the glass is between them.
            "top": {"type": "rectangle", "bsdf": glass | {"id": "glass"},
                    "to_world": transform(translate=[0, 0.025, 0], rotate=([1, 0, 0], -90), scale=3)},
            "bottom": {"type": "rectangle", "bsdf": {"type": "ref", "id": "glass"},
                       "to_world": transform(translate=[0, -0.025, 0], rotate=([1, 0, 0], 90), scale=3)},
            "plane": {"type": "rectangle", "bsdf": diffuse(*albedo),
                      "to_world": transform(translate=below, rotate=([1, 0, 0], -90), scale=6)},
        }  # fmt: skip

    keys = {
        "albedo": "plane.bsdf.reflectance.value",
        "radiance": "lamp.emitter.radiance.value",
        "transmittance": "top.bsdf.specular_transmittance.value",
        "reflectance": "top.bsdf.specular_reflectance.value",
    }
    known = beam_through_slab(albedo, radiance, tau, reflectance, ior, float(angle), max_depth, size)
    return KnownScene(scene, known, keys, max_depth)
