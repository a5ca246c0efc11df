"""Light through glass onto a floor, and from there onto walls that alone are seen: what follows a diffuse bounce.

On the wall there are edges at rest, over which a direction that turns with the floor, from a point that moves on it,
sweeps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import camera
from reslrb_cli.measure.attached.amplitudes import Move
from reslrb_cli.measure.attached.glass import slab, spot, waving
from reslrb_cli.measure.attached.scene import FILTER, SIZE, AttachedScene
from reslrb_cli.measure.small_scenes import bitmap, diffuse, transform


def wall(bsdf: dict[str, Any], turn: float = -90, x: float = 1.0) -> dict[str, Any]:
    """A wall at `x`, which faces back to the axis; `turn` is its angle about the vertical."""
    return {"type": "rectangle", "bsdf": bsdf,
            "to_world": transform(translate=[x, 1, 0], rotate=([0, 1, 0], turn), scale=3)}  # fmt: skip


def room(**changes: Any) -> dict[str, Any]:
    """A slab with waves over the floor of a room, and a camera over the caustic that looks at what is at x = 1.

    `changes` are objects beside these, or in place of them.
    """
    seen = camera([-0.6, 0.8, 0], [1, 0.8, 0], [0, 1, 0], 40, SIZE)
    seen["film"]["rfilter"] = FILTER
    return slab(lamp=spot(cutoff=8), camera=seen) | changes


def steps() -> dict[str, Any]:
    """A texture of 24 stripes and blocks, light and dark."""
    texels = np.random.default_rng(2).choice([0.1, 0.9], (24, 24, 1)) * np.ones(3)
    return {"type": "diffuse", "reflectance": bitmap(texels, "nearest")}


def corner() -> dict[str, Any]:
    """Two walls that meet in the middle of the view, one light and one dark."""
    return room(light=wall(diffuse(0.9, 0.9, 0.9), -50), dark=wall(diffuse(0.15, 0.15, 0.15), -130))


def shelf() -> dict[str, Any]:
    """A panel that faces the wall and fills the view: each path to it has two diffuse vertices and one connection.

    It hangs above the floor: light passes below it to the wall, and comes back. Its shadow's edge is missing.
    """
    seen = camera([0.95, 0.8, 0], [0, 0.8, 0], [0, 1, 0], 50, SIZE)
    seen["film"]["rfilter"] = FILTER
    panel = {"type": "rectangle", "bsdf": diffuse(0.7, 0.8, 0.9),
             "to_world": transform(translate=[0.45, 0.8, 0], rotate=([0, 1, 0], 90), scale=0.3)}  # fmt: skip
    return slab(lamp=spot(cutoff=8), camera=seen, wall=wall(diffuse(0.8, 0.7, 0.6)), panel=panel)


def moved(scene: Any) -> list[Move]:
    """The waves of the slab by their size, and a few smooth displacements."""
    return waving(scene, count=2)


#: A path from the lamp through both surfaces of the slab to the floor, a wall, and the camera.
OPTIONS = {"max_depth": 5}
SCENES = [
    AttachedScene("bounce", "a slab that lights a wall by way of the floor",
                  lambda: room(wall=wall(diffuse(0.8, 0.7, 0.6))), moved, spp=512, seeds=32, options=OPTIONS),
    AttachedScene("bounce_steps", "the same onto a texture with steps", lambda: room(wall=wall(steps())), moved,
                  spp=512, seeds=32, options=OPTIONS),
    AttachedScene("bounce_corner", "the same into a corner of two walls", corner, moved,
                  spp=512, seeds=32, options=OPTIONS),
]  # fmt: skip
