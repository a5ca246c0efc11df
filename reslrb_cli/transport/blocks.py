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

    def root_means(self, image: mi.TensorXf) -> NDArray[np.float64]:
        """Of an image (height, width, C) the root of the mean square in each block (rows * columns), times its area.

        The unit is the image's largest value; what is not finite counts as 0.
        """
        channels, values = image.shape[2], dr.abs(image.array)
        values = dr.select(dr.isfinite(values), values, 0)
        largest = dr.max(values)
        values = dr.select(largest > 0, values / largest, 0)
        pixel = dr.arange(mi.UInt32, self.width * self.height)
        square = mi.Float(0)
        for channel in range(channels):
            square += dr.square(dr.gather(mi.Float, values, pixel * channels + channel))
        sums = dr.zeros(mi.Float, self.count)
        position = mi.Point2f(pixel % self.width, pixel // self.width)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, square, self.block(position))
        return np.sqrt(np.array(sums, np.float64) * self.areas())


def film_blocks(sensor: mi.Sensor) -> Blocks:
    """The blocks of a sensor's film."""
    size = sensor.film().crop_size()
    return Blocks.of((int(size[0]), int(size[1])))
