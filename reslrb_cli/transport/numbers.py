"""The random numbers of a light path, drawn in the order of Mitsuba's `ptracer`, used or not: from one seed both trace
the same paths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
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

    def of_early(self, early: list[Early], depth: mi.UInt32) -> Numbers:
        """The same, but those for the BSDF as `early` has them for the first vertices; the first is of depth 1."""
        bsdf = Early(self.bsdf_2d, self.bsdf_1d)
        for bounce, own in enumerate(early):
            bsdf = dr.select(depth == bounce + 1, own, bsdf)
        return replace(self, bsdf_2d=bsdf.bsdf_2d, bsdf_1d=bsdf.bsdf_1d)


@dataclass
class Early:
    """What the BSDF of one of the first vertices has, known before the path is traced."""

    bsdf_2d: mi.Point2f
    bsdf_1d: mi.Float
