"""Distribution of camera paths over a film's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from reslrb_cli.backend.memory import own_memory

EVEN = 0.25  # minimum share of camera paths that are spread evenly over the pixels
MOST_SLOTS = 4  # per pixel


@dataclass
class PixelShares:
    """Distribution of a pass's camera paths over the n pixels of a film. Each pixel has some paths.

    The first `even` paths (width 1) are distributed evenly. Their numbers per pixel differ by at most one. All later
    paths go through the array `slots` (S,) `rounds` times (width 1). `slots` holds the pixels in order. Pixel i has
    `each[i]` (n,) consecutive slots. The first slot of pixel i has the number `first[i]` (n,). The number of paths per
    pixel is therefore not random, and dividing by this number adds no noise.
    """

    slots: mi.UInt32
    first: mi.UInt32
    each: mi.UInt32
    even: mi.UInt32
    rounds: mi.UInt32

    @staticmethod
    def of(wanted: NDArray[np.floating], paths: int) -> PixelShares | None:
        """Return the distribution of `paths` paths in proportion to `wanted` (n,). A share of EVEN is distributed
        evenly.

        Returns None if the number of paths does not exceed the number of pixels.
        """
        n = wanted.size
        spare = min(int((1 - EVEN) * paths), paths - n)  # one per pixel: without it, light would be lost
        if spare <= 0 or not wanted.sum() > 0:
            return None
        slots = min(MOST_SLOTS * n, spare)
        rounds = spare // slots
        # Rounded along the order of the pixels, so that neighbours balance.
        ends = np.rint(np.cumsum(wanted, dtype=np.float64) * (slots / wanted.sum(dtype=np.float64)))
        each = np.diff(ends, prepend=0).astype(np.uint32)
        first = np.cumsum(each, dtype=np.uint32) - each
        made = PixelShares(
            own_memory(mi.UInt32, np.repeat(np.arange(n, dtype=np.uint32), each)),
            own_memory(mi.UInt32, first), own_memory(mi.UInt32, each),
            mi.UInt32(paths - rounds * slots), mi.UInt32(rounds),
        )  # fmt: skip
        dr.make_opaque(made.even, made.rounds)
        return made

    def count(self, pixel: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float:
        """Return the number of paths of a pixel."""
        return mi.Float(self._of_even(pixel) + self.rounds * dr.gather(mi.UInt32, self.each, pixel, active))

    def mean(self) -> mi.Float:
        """Return the mean number of paths of a pixel."""
        return mi.Float(self.even + self.rounds * dr.width(self.slots)) / dr.width(self.each)

    def draw(self, lane: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Return the pixel of each path, and the number of the path in that pixel."""
        n, slots = dr.width(self.each), dr.width(self.slots)
        evenly, behind = lane < self.even, lane - self.even
        slot = behind % slots
        pixel = dr.select(evenly, lane % n, dr.gather(mi.UInt32, self.slots, slot, ~evenly))
        each, first = (dr.gather(mi.UInt32, array, pixel, ~evenly) for array in (self.each, self.first))
        later = self._of_even(pixel) + behind // slots * each + slot - first
        return pixel, dr.select(evenly, lane // n, later)

    def _of_even(self, pixel: mi.UInt32) -> mi.UInt32:
        n = dr.width(self.each)
        return self.even // n + dr.select(pixel < self.even % n, mi.UInt32(1), 0)
