"""Lamps, receivers and rooms that move."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import camera
from reslrb_cli.measure.attached.amplitudes import Displacement, Move, Pose
from reslrb_cli.measure.attached.glass import GLASS, bent, setting, slab, square_lamp, vertices
from reslrb_cli.measure.attached.meshes import ball, grid, mesh, smooth_fields
from reslrb_cli.measure.attached.scene import FILTER, SIZE, AttachedScene
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


def rolling(scene: Any) -> list[Move]:
    """The receiver by smooth displacements that end beyond the film."""
    positions = vertices(scene, "floor")
    near = np.exp(-np.square(positions / 3).sum(1))[:, None]
    hills = np.zeros_like(positions)
    hills[:, 1] = positions[:, 1] * 4
    return [Displacement("floor.vertex_positions", np.stack([hills, *smooth_fields(positions, 10, 1.5)]) * near)]


def cave(**objects: Any) -> dict:
    """The inside of a ball, with a camera in it: a room without corners, in which nothing hides anything."""
    seen = camera([0, 0.2, 1.2], [0.1, 0, 0], [0, 1, 0], 70, SIZE)
    seen["film"]["rfilter"] = FILTER
    return {"type": "scene", "camera": seen} | objects


def room() -> dict:
    wall = mesh(*ball(1.6, (0, 0, 0), 4, inward=True), diffuse(0.7, 0.6, 0.8))
    return cave(wall=wall, lamp=point((0.3, 0.4, -0.2)))


def room_around_glass() -> dict:
    """A lamp in a ball of glass, in a room: after a diffuse bounce light goes through the ball again."""
    wall = {"type": "sphere", "center": [0, 0, 0], "radius": 1.6, "flip_normals": True, "bsdf": diffuse(0.7, 0.6, 0.8)}
    return cave(wall=wall, lamp=point((0.32, -0.45, -0.36)), glass=mesh(*ball(0.25, (0.3, -0.5, -0.4), 4), GLASS))


SCENES = [
    AttachedScene("moved_point", "a point light over a plane", lambda: setting(lamp=point()),
                  lambda scene: [Pose("lamp.position", ("ty", "tx", "tz"))], options={"max_depth": 2}),
    AttachedScene("moved_spot", "a spot light over glass with waves, moved and turned", slab,
                  lambda scene: [Pose("lamp.to_world", AIM, (0.05, 3.2, -0.04))]),
    AttachedScene("moved_area", "an area light over a plane, moved, turned and scaled",
                  lambda: setting(lamp=square_lamp(0.4, 2.2)),
                  lambda scene: [Pose("lamp.to_world", (*AIM, "s"), (0.05, 2.2, -0.04))], options={"max_depth": 2}),
    AttachedScene("moved_bulb", "a ball that glows over a plane, moved and scaled", lambda: setting(lamp=bulb()),
                  lambda scene: [Pose("lamp.to_world", ("ty", "tx", "tz", "s"), (0.1, 2.2, 0.2))],
                  options={"max_depth": 2}),
    AttachedScene("moved_receiver", "a plane under a point light, moved and tilted", lambda: setting(lamp=point()),
                  lambda scene: [Pose("floor.to_world", ("ty", "rx", "rz"))], options={"max_depth": 2}),
    AttachedScene("bent_receiver", "a plane under a point light that is bent", hills, rolling,
                  options={"max_depth": 2}),
    AttachedScene("bent_room", "a room without corners that is bent: up to four diffuse bounces", room,
                  lambda scene: bent(scene, "wall", span=1.6), options={"max_depth": 6}),
    AttachedScene("room_around_glass", "a lamp in a ball of glass that is bent, and up to three diffuse bounces",
                  room_around_glass, lambda scene: bent(scene, "glass", span=0.25), options={"max_depth": 6},
                  step=0.005),
]  # fmt: skip
