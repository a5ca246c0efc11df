"""Pixels of which light tracing lacks something: at the film's border, and where the sensor sees glass, mirrors, coats.

From the smooth lobes of those light paths cannot connect to the sensor. And those that see lamps.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .needs import CROSSINGS, LOOK, what_is_seen

#: Primary rays are spread over a pixel in so many rows and columns of cells.
CELLS = 4
#: Points of the aperture, in [0, 1]^2, from which a lens looks for lamps.
_APERTURE = ((0.5, 0.5), (0.05, 0.5), (0.95, 0.5), (0.5, 0.05), (0.5, 0.95))


def interior(shape: tuple[int, ...], sensor: mi.Sensor) -> np.ndarray:
    """Where light tracing loses nothing by the film's border: boolean (H, W), for a sensor whose film is so large.

    Samples just outside of the film are lost, so that pixels within the filter's radius of its border lack what they
    would have added; paths from the sensor lose none.
    """
    margin = int(np.ceil(float(sensor.film().rfilter().radius()) - 0.5))
    inside = np.zeros(shape[:2], dtype=bool)
    inside[margin : shape[0] - margin, margin : shape[1] - margin] = True
    return inside


@dataclass(frozen=True)
class SeenSpecular:
    """Pixels (H, W) of a sensor's crop window that smooth specular lobes reach, by way of the reconstruction filter.

    `alone`: of surfaces that have no others (glass, mirrors), which stay black under light tracing. `mixed`: of those
    that have others beside them (coats, blends, thin panes), of which light tracing lacks a part.
    """

    alone: np.ndarray
    mixed: np.ndarray


def sees_specular(scene: mi.Scene, sensor: mi.Sensor) -> SeenSpecular:
    """Trace CELLS^2 primary rays a pixel, through see-through surfaces, and mark the pixels that their filter reaches.

    What is smaller than a cell may be missed. The rays are the same at every call.
    """
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
    count = width * height
    lane = dr.arange(mi.UInt32, count)
    corner = mi.Point2f(lane % width, lane // width)
    random = mi.PCG32(count)
    alone, mixed = dr.zeros(mi.Bool, count), dr.zeros(mi.Bool, count)
    for cell in range(CELLS * CELLS):
        # Opaque, so that all cells have one kernel.
        row, column = dr.opaque(mi.Float, cell // CELLS), dr.opaque(mi.Float, cell % CELLS)
        jitter = mi.Point2f(random.next_float32(), random.next_float32())
        u = (corner + (mi.Point2f(column, row) + jitter) / CELLS) / mi.Vector2f(width, height)
        aperture = mi.Point2f(random.next_float32(), random.next_float32())
        ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, u, aperture)
        only, beside = _first_surfaces(scene, ray, count)
        alone, mixed = alone | only, mixed | beside
        dr.eval(alone, mixed, random)
    from scipy.ndimage import maximum_filter  # here: a run that is refused does not wait for it

    # A sample that lies within the radius of a pixel's centre is at most so many pixels away.
    size = 2 * int(np.ceil(float(film.rfilter().radius()) - 0.5)) + 1

    def reached(mask: mi.Bool) -> np.ndarray:
        return np.asarray(maximum_filter(np.array(mask, dtype=bool).reshape(height, width), size))

    return SeenSpecular(reached(alone), reached(mixed))


def sees_lamps(scene: mi.Scene, sensor: mi.Sensor) -> np.ndarray:
    """Pixels (H, W) of a sensor's crop window that see an emitter directly, by way of the reconstruction filter too.

    A lamp smaller than the cells of a grid of LOOK^2 may be missed.
    """
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
    cells = np.zeros((LOOK, LOOK), dtype=bool)
    for point in _APERTURE if sensor.needs_aperture_sample() else (None,):
        cells |= np.array(what_is_seen(scene, sensor, point)[2]).reshape(LOOK, LOOK)
    if not cells.any():
        return np.zeros((height, width), dtype=bool)
    from scipy.ndimage import maximum_filter  # here: a scene that shows no lamp does not wait for it

    cells = np.asarray(maximum_filter(cells, 3))  # an edge may be anywhere between the centres of two cells
    for axis, size in enumerate((height, width)):
        first = np.arange(size) * LOOK // size
        cells = np.maximum.reduceat(cells, first, axis=axis) if size < LOOK else np.take(cells, first, axis=axis)
    return np.asarray(maximum_filter(cells, 2 * int(np.ceil(float(film.rfilter().radius()) - 0.5)) + 1))


def _first_surfaces(scene: mi.Scene, ray: mi.Ray3f, count: int) -> tuple[mi.Bool, mi.Bool]:
    """Whether delta lobes are all that a surface has, or some of it, up to the first that is not see-through."""
    lobes = int(mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission)
    active, alone, mixed = dr.full(mi.Bool, True, count), dr.zeros(mi.Bool, count), dr.zeros(mi.Bool, count)
    for _ in range(CROSSINGS):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        flags = si.bsdf().flags()
        see_through = hit & mi.has_flag(flags, mi.BSDFFlags.Null)
        specular = hit & ((flags & lobes) != 0)
        beside = specular & (see_through | mi.has_flag(flags, mi.BSDFFlags.Smooth))
        alone, mixed = alone | (specular & ~beside), mixed | beside
        ray, active = si.spawn_ray(ray.d), see_through
        dr.eval(ray, active, alone, mixed)
        if dr.none(active):
            break
    return alone, mixed
