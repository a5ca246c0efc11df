"""The sphere that light from infinitely far away falls into, kept around shapes that move.

Emitters without a place (a constant sky, parallel light) send their rays through a sphere around the scene. Mitsuba
gives it to them when the scene is loaded: what moves out of it later would be in the dark.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

#: By how much a sphere that has become too small is larger than need be: kernels are compiled for each one.
MARGIN = 1.25
#: A sphere this many times as large as need be wastes light paths.
TOO_LARGE = 2.0


@dataclass(frozen=True)
class Horizon:
    """A sphere."""

    center: tuple[float, float, float]
    radius: float

    def holds(self, box: mi.ScalarBoundingBox3f) -> bool:
        """Whether the box lies within the sphere."""
        farthest = np.maximum(np.abs(np.subtract(box.min, self.center)), np.abs(np.subtract(box.max, self.center)))
        return float(np.linalg.norm(farthest)) <= self.radius * (1 + 1e-6)


class Surroundings:
    """The horizon of one scene: the last that was asked for."""

    def __init__(self) -> None:
        self._scene = 0  # its address
        self._horizon: Horizon | None = None

    def follow(self, scene: mi.Scene) -> Horizon:
        """A sphere that holds all shapes of the scene as they are now; the scene's emitters know it, too.

        It stays as it is while that is so.
        """
        around, before = bounds(scene), self._horizon if self._scene == scene.ptr else None
        if before is not None and before.holds(scene.bbox()) and before.radius < TOO_LARGE * around.radius:
            return before
        if before is None:
            self._horizon = around
            tell(scene, scene)
        else:
            self._horizon = Horizon(around.center, MARGIN * around.radius)
            # An emitter asks a scene for its bounds, and nothing else; this one has those that it is to know.
            half = [self._horizon.radius / 3**0.5] * 3
            corner = mi.ScalarTransform4f().translate(list(self._horizon.center)) @ mi.ScalarTransform4f().scale(half)
            tell(scene, mi.load_dict({"type": "scene", "box": {"type": "cube", "to_world": corner}}))
        self._scene = scene.ptr
        return self._horizon


def bounds(scene: mi.Scene) -> Horizon:
    """The smallest sphere around the box around all shapes."""
    sphere = scene.bbox().bounding_sphere()
    x, y, z = (float(value) for value in sphere.center)
    return Horizon((x, y, z), float(sphere.radius))


def tell(scene: mi.Scene, bounded: mi.Scene) -> None:
    """Have the emitters of `scene` that are infinitely far away light what `bounded` has bounds around."""
    for emitter in scene.emitters():
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
            emitter.set_scene(bounded)
