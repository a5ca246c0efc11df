"""Target pictures without symmetry, and optics with a known potential."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reslrb_cli.lens import transport

Array = NDArray[np.float64]


def smooth(n: int) -> Array:
    """Return two soft lights on soft stripes. The darkest value is about 0.1 of the brightest."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    lights = np.exp(-((x - 0.3) ** 2 + (y - 0.2) ** 2) / 0.08) + 0.7 * np.exp(-((x + 0.4) ** 2 + (y + 0.4) ** 2) / 0.05)
    return 0.15 + lights + 0.15 * (1 + np.sin(5 * x + 3 * y))


def sharp(n: int) -> Array:
    """Return a picture with a bar and a disc of value 1 on black."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    return 1.0 * (((x - 0.4) ** 2 + (y + 0.3) ** 2 < 0.1) | ((np.abs(y - 0.5) < 0.15) & (x < 0.5)))


@dataclass(frozen=True)
class Gradient:
    """Optics of optimal transport for the squared distance: T = g. `mu` (ny, nx) is the light on the aperture of
    `size`.
    """

    mu: Array
    size: tuple[float, float]

    def hit(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        return np.stack([gx, gy])

    def arriving(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        return transport.sample(self.mu, self.size, x, y)
