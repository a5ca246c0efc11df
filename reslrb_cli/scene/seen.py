"""Pixels of which light tracing lacks something: at the film's border, and where the sensor sees glass, mirrors, coats.

From the smooth lobes of those light paths cannot connect to the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .needs import CROSSINGS

#: Primary rays are spread over a pixel in so many rows and columns of cells.
CELLS = 4


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
