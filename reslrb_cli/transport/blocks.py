"""Blocks of pixels that a film is divided into, where what is said at a place of it is learned."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

BLOCKS = 1 << 14  # of pixels, at most


@dataclass(frozen=True)
class Blocks:
    """Blocks of `side` x `side` pixels that cover a film (crop window) of `width` x `height`, cut off at its end."""

    width: int
    height: int
    side: int

    @staticmethod
    def of(size: tuple[int, int]) -> Blocks:
        """The smallest that are not more than BLOCKS."""
        side = 1
        while -(-size[0] // side) * -(-size[1] // side) > BLOCKS:
            side += 1
        return Blocks(*size, side)

    @property
    def columns(self) -> int:
        return -(-self.width // self.side)

    @property
    def rows(self) -> int:
        return -(-self.height // self.side)

    @property
    def count(self) -> int:
        return self.rows * self.columns

    def block(self, u: mi.Point2f) -> mi.UInt32:
        """The block that a film position (pixels) lies in, or is nearest to."""
        column, row = (mi.UInt32(dr.clip(x, 0, n - 1)) // self.side for x, n in ((u.x, self.width), (u.y, self.height)))
        return row * self.columns + column

    def areas(self) -> NDArray[np.float64]:
        """Pixels of each block (rows * columns)."""
        across, down = (np.minimum(self.side, n - np.arange(0, n, self.side)) for n in (self.width, self.height))
        return np.outer(down, across).ravel().astype(np.float64)


def film_blocks(sensor: mi.Sensor) -> Blocks:
    """The blocks of a sensor's film."""
    size = sensor.film().crop_size()
    return Blocks.of((int(size[0]), int(size[1])))
