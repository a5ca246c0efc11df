"""Lamps, receivers and rooms that move."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.attached.amplitudes import Displacement, Move, Pose
from reslrb_cli.measure.attached.glass import setting, slab, square_lamp, vertices
from reslrb_cli.measure.attached.meshes import grid, mesh, smooth_fields
from reslrb_cli.measure.attached.scene import AttachedScene
from reslrb_cli.measure.small_scenes import diffuse, rgb

AIM = ("tx", "ty", "tz", "rx", "rz")


def point(position: tuple = (0.1, 1.5, 0.2)) -> dict:
    return {"type": "point", "position": list(position), "intensity": rgb(3, 2, 4)}


def bulb(radius: float = 0.3) -> dict:
    """A ball that glows."""
    return {"type": "sphere", "center": [0.1, 2.2, 0.2], "radius": radius, "bsdf": diffuse(0, 0, 0),
            "emitter": {"type": "area", "radiance": rgb(3, 2, 4)}}  # fmt: skip


def hills() -> dict:
    """A receiver that is bent a little, under a point light."""
    positions, faces, uv = grid(128, lambda x, z: 0.05 * np.sin(2 * x + 1) * np.cos(3 * z), 4, 1.5)
    return setting(floor=mesh(positions, faces, diffuse(0.8, 0.7, 0.6), uv), lamp=point())


def rolling(scene: Any, name: str = "floor", y: float = 0) -> list[Move]:
    """A sheet by smooth displacements that end beyond the film, and before the sheet does."""
    positions = vertices(scene, name)
    about = positions - [0, y, 0]
    near = np.exp(-np.square(about / 1.5).sum(1))[:, None]
    hills = about * [0, 4, 0]
    return [Displacement(f"{name}.vertex_positions", np.stack([hills, *smooth_fields(positions, 10, 1.5)]) * near)]


SCENES = [
    AttachedScene("moved_point", "a point light over a plane", lambda: setting(lamp=point()),
                  lambda scene: [Pose("lamp.position", ("ty", "tx", "tz"))], options={"max_depth": 2}),
    AttachedScene("moved_spot", "a spot light over glass with waves, moved and turned", slab,
                  lambda scene: [Pose("lamp.to_world", AIM, (0.05, 3.2, -0.04))], spp=512),
    AttachedScene("moved_area", "an area light over a plane, moved, turned and scaled",
                  lambda: setting(lamp=square_lamp(0.4, 2.2)),
                  lambda scene: [Pose("lamp.to_world", (*AIM, "s"), (0.05, 2.2, -0.04))],
                  options={"max_depth": 2}, spp=128),
    AttachedScene("moved_bulb", "a ball that glows over a plane, moved and scaled", lambda: setting(lamp=bulb()),
                  lambda scene: [Pose("lamp.to_world", ("ty", "tx", "tz", "s"), (0.1, 2.2, 0.2))],
                  options={"max_depth": 2}),
    AttachedScene("moved_receiver", "a plane under a point light, moved and tilted", lambda: setting(lamp=point()),
                  lambda scene: [Pose("floor.to_world", ("ty", "rx", "rz"))], options={"max_depth": 2}),
    AttachedScene("bent_receiver", "a plane under a point light that is bent", hills, rolling,
                  options={"max_depth": 2}, spp=256),
]  # fmt: skip
