"""Joint steps of the entries of all small parameters (`optimizer: auto`).

Colours that light each other, a lamp and the surfaces that it lights, and an exposure compensate for each other. Their
curvature H is therefore measured as a whole, by differences of images (`loop.measure_block`). Near the optimum x*, a
gradient is g = H (x - x*) + noise. With the means of the last n gradients and of their values, a step is

    y = mean g - H (mean x - x),   x <- x - (H H + s v/n C^-1)^-1 H y

in units in which the diagonal of H is 1. C is diagonal, with the squares of twice the longest steps. v is the variance
of the noise of a gradient, so noise limits the steps in directions that the images hardly determine. v comes from
consecutive gradients: g - g' - H (x - x') has the variance 2 v. Where the loss is not quadratic, v is larger, and the
steps are shorter.

n rises by 1 if a gradient points against the last step (Kesten 1958), and falls by a quarter otherwise. While the
gradients agree, a step uses the newest gradient. When noise dominates, it uses the mean of many.

The images hardly change if an exposure E rises and all colours c fall. A step dE, dc is therefore taken in E and E c,

    E <- E exp(du),   c <- ((1 + du) c + dc) exp(-du),   du = dE / E
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from reslrb_cli.statistics import Array

#: s, decay of v, and decrease of n.
NOISE, MEMORY, SHRINK = 0.3, 0.8, 0.25
#: Standard errors to the end of an interval with a confidence of 85 %.
SURE = 1.04
#: Columns of `rows` before H: mean gradient, mean value, last gradient, last value, last step, distance, v, n.
FIELDS = 8


@dataclass(frozen=True)
class Coordinates:
    """Values, gradients, longest steps and bounds of all coordinates (M,).

    `known` marks coordinates with a gradient. `exposure` has the place of the exposure that a colour compensates for,
    or -1. The value of an exposure is its logarithm.
    """

    value: Array
    gradient: Array
    longest: Array
    low: Array
    high: Array
    known: Array
    exposure: Array


class Block:
    """Joint steps of M coordinates. `sizes` has the number of entries of each parameter.

    `rows` (M, FIELDS + M) has all data that change. A step replaces the array.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        ends = np.cumsum([0, *sizes.values()])
        self.at = {key: slice(int(ends[k]), int(ends[k + 1])) for k, key in enumerate(sizes)}
        self.rows: Array = np.zeros((int(ends[-1]), FIELDS + int(ends[-1])), np.float32)
        self.rows[:, 5] = np.inf

    def bend(self, curvature: Array) -> None:
        """Take a measurement of H (M, M)."""
        rows = self.rows.copy()
        rows[:, FIELDS:] = curvature
        self.rows = rows

    def steepness(self, key: str) -> Array:
        """Return the gradient of each entry that moves it by 1, summed over the steps. It is infinite without a
        curvature.
        """
        size = np.diag(self.rows[:, FIELDS:])[self.at[key]].astype(np.float64)
        return np.asarray(np.where(size > 0, size * np.maximum(self.rows[self.at[key], 7], 1), np.inf))

    def to_go(self, key: str) -> float:
        """Return a limit of the root mean square distance to the optimum. It is infinite if it is not known."""
        return float(np.sqrt(np.mean(np.square(self.rows[self.at[key], 5], dtype=np.float64))))

    def steps(self, now: Coordinates) -> Array:
        """Return the changes (M,) of the values. Coordinates without curvature do not move."""
        rows, H = self.rows.astype(np.float64), self.rows[:, FIELDS:].astype(np.float64)
        use = now.known & (np.diag(H) > 0)
        if not use.any():
            return np.zeros(len(H))
        root = np.sqrt(np.where(use, np.diag(H), 1.0))
        K = _positive(np.where(np.outer(use, use), H / np.outer(root, root), 0.0))
        mean_g, mean_x, last_g, last_x, last_step = rows[:, :5].T
        y, x = np.where(use, now.gradient / root, 0.0), now.value * root
        v, n = rows[0, 6], rows[0, 7]
        before = K @ (x - last_x * root) if n > 0 else np.zeros_like(x)
        new = float(np.mean((y - last_g / root - before)[use] ** 2)) / 2
        v = v**MEMORY * new ** (1 - MEMORY) if v > 0 else new
        n = n + 1 if now.gradient @ last_step > 0 else max(1.0, n - SHRINK)
        mean_g = np.where(now.known, mean_g + (now.gradient - mean_g) / n, mean_g)
        mean_x = mean_x + (now.value - mean_x) / n
        Y = np.where(use, mean_g / root, 0.0) - K @ (mean_x * root - x)
        free = use & ~((now.value <= now.low) & (Y > 0) | (now.value >= now.high) & (Y < 0))
        A = K[np.ix_(free, free)]
        damping = v / n / (2 * now.longest * root)[free] ** 2
        inverse = np.linalg.inv(A @ A + np.diag(NOISE * damping + 1e-8))
        step, error = np.zeros_like(x), np.zeros_like(x)
        step[free] = -(inverse @ A @ Y[free]) / root[free]
        error[free] = np.sqrt(np.diag(inverse) * v / n) / root[free]
        rows[:, :8] = np.stack([mean_g, mean_x, now.gradient, now.value, step, np.abs(step) + SURE * error,
                                np.full_like(x, v), np.full_like(x, n)], axis=1)  # fmt: skip
        change = np.clip(step, -now.longest, now.longest)
        if (tied := now.exposure >= 0).any():
            du = change[now.exposure[tied]]
            colour = now.value[tied]
            change[tied] = ((1 + du) * colour + change[tied]) * np.exp(-du) - colour
        self.rows = rows.astype(np.float32)
        return change


def _positive(matrix: Array) -> Array:
    """Return the nearest symmetric matrix without negative eigenvalues. Noise causes negative eigenvalues."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
