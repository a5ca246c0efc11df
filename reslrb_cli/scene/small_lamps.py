"""Lamps in view that are smaller than a pixel, which rays through the pixels hardly ever hit."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.lamps import Lamp

#: What a lamp's diameter on the film is below, in pixels.
SMALL = 1.0
#: Lamps, at the most: of those, light is told from all other by comparing each in turn.
MOST = 64
#: Points of a lamp along each side of a grid, by which it is found to be in view.
POINTS = 16


def small_lamps(scene: mi.Scene, sensor: mi.Sensor, lamps: Iterable[Lamp]) -> tuple[Lamp, ...]:
    """Those of the lamps that `sensor` sees directly as less than a pixel; none where there are more than MOST.

    Lamps that shine along their normal alone are not seen at all.
    """
    found = [lamp for lamp in lamps if not lamp.parallel and _pixels(sensor, lamp.shape) < SMALL]
    if len(found) > MOST:
        return ()
    return tuple(lamp for lamp in found if _is_in_view(scene, sensor, lamp.shape))


def _pixels(sensor: mi.Sensor, shape: mi.Shape) -> float:
    """The diameter on the film, in pixels, of the sphere around the shape's bounding box, wherever the sensor looks."""
    box = shape.bbox()
    radius = float(np.linalg.norm(np.ravel(box.max) - np.ravel(box.min))) / 2
    eye = np.ravel(sensor.world_transform().translation())
    distance = float(np.linalg.norm((np.ravel(box.max) + np.ravel(box.min)) / 2 - eye))
    if not distance > radius:
        return np.inf
    half = np.tan(np.deg2rad(float(mi.traverse(sensor)["x_fov"][0])) / 2)
    return float(radius / distance / half * int(sensor.film().size()[0]))


def _is_in_view(scene: mi.Scene, sensor: mi.Sensor, shape: mi.Shape) -> bool:
    """Whether any of a grid of points on the shape is before the lens, with nothing in between."""
    lane = dr.arange(mi.UInt32, POINTS**2)
    sample = (mi.Point2f(lane % POINTS, lane // POINTS) + 0.5) / POINTS
    with dr.suspend_grad():
        si = mi.SurfaceInteraction3f(shape.sample_position(sensor.shutter_open(), sample), mi.Color0f())
        ds, _ = sensor.sample_direction(si, mi.Point2f(0.5), True)
        seen = ds.pdf > 0
        return bool(dr.any(seen & ~scene.ray_test(si.spawn_ray_to(ds.p), seen)))
