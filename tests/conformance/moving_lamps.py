"""Lamps that move over a floor, one of each kind. They are the cases of test_moving_emitters.py.

A camera looks straight down on the middle of the floor. dL/dI falls to zero towards the film's border. Light near the
border, where derivatives are cut off, therefore has no effect. Nothing casts a shadow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from conformance.moving import Moving, camera, flat, sheet

from reslrb_cli.measure.scenes.moving import Latents
from reslrb_cli.measure.scenes.small import bitmap, diffuse, rgb, transform

PIVOT = (0.1, 4.5, 0.2)
RADIANCE = rgb(3, 2, 4)
BLACK = diffuse(0, 0, 0)


@dataclass(frozen=True)
class LampCase:
    """Arguments of `Moving` and the settings of its measurement. The settings are the `step` of the differences, the
    samples, the seeds, and the integrators' options. If `quick` is true, the case is part of the default suite.
    """

    name: str
    scene: Callable[[], dict[str, Any]]
    start: dict[str, Any]
    key: str
    step: float = 0.02
    spp: int = 64
    seeds: int = 8
    options: dict[str, Any] = field(default_factory=dict)
    quick: bool = False

    def moving(self) -> Moving:
        """Load the scene and return it as a `Moving`."""
        initial: list[Any] = []

        def place(params: mi.SceneParameters, latents: Latents) -> None:
            if not initial:
                initial.append(_resting(params[self.key]))
            params[self.key] = _moved(latents, initial[0])

        result = Moving(self.scene(), self.start, place)
        result.weigh(smooth_weights())
        return result


def smooth_weights(size: int = 32) -> np.ndarray:
    """Return a smooth dL/dI (H, W, 3) that is zero at the border."""
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size
    inside = np.clip((np.minimum.reduce([x, 1 - x, y, 1 - y]) - 0.1) / 0.2, 0, 1)
    fade = inside * inside * (3 - 2 * inside)
    return np.stack([np.sin(5 * x) * np.cos(4 * y) + 1.5, np.cos(3 * x + 2 * y) + 1.2, x + y], -1) * fade[..., None]


def _resting(value: Any) -> Any:
    """Return a copy of an object's place before the object moves."""
    if isinstance(value, mi.Point3f):
        return mi.Point3f(value)
    return mi.Float(value) if isinstance(value, mi.Float) else mi.AffineTransform4f(value.matrix)


def _moved(latents: Latents, initial: Any) -> Any:
    """Return `initial` scaled and turned about the pivot, and then shifted. The axis of the rotation is none of the
    scene's axes.
    """
    pivot = mi.Vector3f(*PIVOT)
    identity = mi.AffineTransform4f()
    shift = mi.Vector3f(*(latents.get(name, mi.Float(0)) for name in "xyz")) + pivot
    moved = identity.translate(shift)
    if "angle" in latents:
        moved = moved @ identity.rotate(mi.Vector3f(0.8, 0, 0.6), latents["angle"])
    if "size" in latents:
        moved = moved @ identity.scale(mi.Vector3f(latents["size"]))
    moved = moved @ identity.translate(-pivot)
    if isinstance(initial, mi.Float):  # vertex positions
        return dr.ravel(moved @ dr.unravel(mi.Point3f, initial))
    return moved @ initial


def over_floor(light: dict[str, Any] | mi.Mesh, **changes: Any) -> dict[str, Any]:
    """Return a scene with a wide floor and a light above the floor."""
    above = mi.ScalarTransform4f().look_at([0, 3, 0], [0, 0, 0], [0, 0, -1])
    return {"type": "scene", "camera": camera() | {"fov": 60, "to_world": above},
            "floor": flat(diffuse(0.8, 0.7, 0.6), scale=40), "light": light} | changes  # fmt: skip


def within(light: dict[str, Any]) -> dict[str, Any]:
    """Return a scene with a light and the camera within a diffuse sphere, which has no edge."""
    shell = {"type": "sphere", "center": [0, 3, 0], "radius": 4, "flip_normals": True, "bsdf": diffuse(0.6, 0.5, 0.7)}
    return over_floor(light, floor=shell)


def surface(kind: str, emitter: str = "area", radiance: Any = None) -> dict[str, Any]:
    """Return a shape that shines down."""
    down = {"rotate": ([0.97, 0.1, 0.2], 88)} if kind in ("rectangle", "disk", "cylinder") else {}
    return {"type": kind, "to_world": transform(translate=PIVOT, **down, scale=0.4), "bsdf": BLACK,
            "emitter": {"type": emitter, "radiance": radiance or RADIANCE}}  # fmt: skip


def mesh(emitter: str = "area", radiance: Any = None, name: str = "light", at: Sequence[float] = PIVOT) -> mi.Mesh:
    """Return a rippled sheet that shines down. Its faces have different areas. By default, the sheet is at the pivot of
    the movement.
    """
    light = sheet(name, BLACK, 0.0, 5, 4.0, 0.5, emitter={"type": emitter, "radiance": radiance or RADIANCE})
    params = mi.traverse(light)
    x, y, z = np.array(params["vertex_positions"]).reshape(-1, 3).T
    down = np.stack([x * (1 + 0.3 * x) + at[0], at[1] - y, -z + at[2]], -1)
    params["vertex_positions"] = down.astype(np.float32).ravel()
    params.update()
    return light


def texture() -> dict[str, Any]:
    """Return a texture for the emission of a lamp."""
    return bitmap(np.random.default_rng(4).uniform(1, 4, (4, 4, 3)), "bilinear")


def looking_down(**emitter: Any) -> dict[str, Any]:
    """Return an emitter above the floor that looks down, slightly tilted."""
    return emitter | {"to_world": mi.ScalarTransform4f().look_at(list(PIVOT), [0.1, 0, 0.4], [0, 0, 1])}


SHIFT = {"x": 0.0, "y": 0.0, "z": 0.0}
TURN = SHIFT | {"angle": 0.0}
ALL = TURN | {"size": 1.0}
PLACE, VERTICES = "light.to_world", "light.vertex_positions"
DEEP = {"max_depth": 4}
SEEN = {"hide_emitters": False}

CASES = [
    LampCase("point", lambda: over_floor({"type": "point", "position": list(PIVOT), "intensity": RADIANCE}), SHIFT,
             "light.position", quick=True),
    LampCase("point_bounces", lambda: within({"type": "point", "position": list(PIVOT), "intensity": RADIANCE}), SHIFT,
             "light.position", spp=256, options=DEEP),
    LampCase("spot", lambda: over_floor(looking_down(type="spot", intensity=RADIANCE, cutoff_angle=30, beam_width=5)),
             TURN, PLACE),
    LampCase("spot_bounces", lambda: within(looking_down(type="spot", intensity=RADIANCE, cutoff_angle=30,
                                                         beam_width=5)), TURN, PLACE, options=DEEP),
    LampCase("projector", lambda: over_floor(looking_down(type="projector", irradiance=texture(), fov=40)), TURN,
             PLACE),
    LampCase("directional", lambda: over_floor(looking_down(type="directional", irradiance=RADIANCE),
                                               floor=flat(diffuse(0.8, 0.7, 0.6), scale=4)), {"angle": 0.0}, PLACE),
    *(LampCase(kind, lambda kind=kind: over_floor(surface(kind)), ALL, PLACE)
      for kind in ("rectangle", "disk", "sphere", "cylinder")),
    LampCase("textured", lambda: over_floor(surface("rectangle", radiance=texture())), ALL, PLACE),
    LampCase("textured_sphere", lambda: over_floor(surface("sphere", radiance=texture())), ALL, PLACE),
    LampCase("mesh", lambda: over_floor(mesh()), ALL, VERTICES, quick=True),
    LampCase("textured_mesh", lambda: over_floor(mesh(radiance=texture())), ALL, VERTICES),
    LampCase("parallel", lambda: over_floor(surface("rectangle", "directionalarea")), ALL, PLACE),
    LampCase("parallel_disk", lambda: over_floor(surface("disk", "directionalarea")), ALL, PLACE),
    LampCase("parallel_mesh", lambda: over_floor(mesh("directionalarea")), ALL, VERTICES),
    LampCase("beside_others", lambda: over_floor(
        surface("sphere"), second=mesh(name="second", at=(2.6, 3.8, 0)),
        third={"type": "point", "position": [1, 4, 0], "intensity": RADIANCE}), ALL, PLACE),
]  # fmt: skip
