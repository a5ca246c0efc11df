"""The random numbers of a light path, drawn in the order of Mitsuba's `ptracer`, used or not: from one seed both trace
the same paths."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Numbers:
    """What one segment draws: a point on the sensor's aperture, then two numbers and one for the BSDF."""

    aperture: mi.Point2f
    bsdf_2d: mi.Point2f
    bsdf_1d: mi.Float

    @staticmethod
    def draw(sampler: mi.Sampler, active: mi.Bool) -> Numbers:
        """The numbers of the next segment. Roulette's follows them, and is drawn by the walk."""
        return Numbers(sampler.next_2d(active), sampler.next_2d(active), sampler.next_1d(active))
