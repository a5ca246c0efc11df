"""How long light's paths have to be that a picture of a scene lacks next to nothing of what a camera would see.

A photograph has light of any number of bounces. An image of paths of at most d segments is darker, which an exposure or
a colour would make up for.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

#: Depths that are tried; the last one stands for all light.
DEPTHS = (8, 16, 32, 64)
#: What may be missing of a pixel's light, on average.
LOST = 0.01
#: Rays along each axis of the film, and paths for each of them.
_RAYS, _PATHS = 48, 32


@dataclass(frozen=True)
class Depth:
    """A path depth in segments, and the share of a pixel's light that longer paths have, on average; None of the
    greatest depth, to which nothing was compared."""

    segments: int
    missing: float | None


def find_depth(scene: mi.Scene, sensor: int) -> Depth:
    """The least of `DEPTHS` at which the view through the sensor of this index has all but `LOST` of its light.

    By camera paths of equal random numbers without roulette, so that those of one depth begin those of the next.
    """
    whole = _pixels(scene, sensor, DEPTHS[-1])
    for segments in DEPTHS[:-1]:
        missing = _missing(_pixels(scene, sensor, segments), whole)
        if missing <= LOST:
            return Depth(segments, missing)
    return Depth(DEPTHS[-1], None)


def _missing(pixels: np.ndarray, whole: np.ndarray) -> float:
    """The mean over lit pixels of what they lack: no few bright ones decide."""
    lit = np.isfinite(whole) & (whole > 0)
    return float(np.mean(1 - pixels[lit] / whole[lit])) if lit.any() else 0.0


def _pixels(scene: mi.Scene, index: int, segments: int) -> np.ndarray:
    """What the sensor sees of paths of at most so many segments, by ray: (N,) float64."""
    sensor, count = scene.sensors()[index], _RAYS**2 * _PATHS
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    pixel = dr.arange(mi.UInt32, count) // _PATHS
    corner = mi.Point2f(pixel % _RAYS, pixel // _RAYS)
    position = (corner + sampler.next_2d()) / _RAYS
    ray, weight = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, position, sampler.next_2d())
    integrator = mi.load_dict({"type": "path", "max_depth": segments, "rr_depth": DEPTHS[-1] + 1})
    light, _, _ = integrator.sample(scene, sampler, ray)
    rows = np.array(mi.luminance(mi.Color3f(weight * light)), dtype=np.float64).reshape(_RAYS**2, _PATHS)
    return np.asarray(rows.mean(axis=1))
