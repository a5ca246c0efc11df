"""Joint steps of the entries of all small parameters (`optimizer: auto`).

Colours that light each other, a lamp and the surfaces that it lights, and an exposure compensate for each other. Their
curvature H is therefore measured as a whole, by differences of images (`loop.measure_block`), until its error is small.
Motions take part, because differences of images contain silhouettes and shadows. Near the optimum x*, a gradient is
g = H (x - x*) + noise. With the means of the last n gradients and of their values, a step is

    y = mean g - H (mean x - x),   x <- x - (n H² + s v C^-1)^-1 n H y

in units in which the diagonal of H is 1. C is diagonal, with the squares of twice the longest steps L. v is the
variance of the noise of a gradient, so noise limits the steps in directions that the images hardly determine. Half the
square of g - g' - H (x - x') estimates v, where g' is the last gradient, and x' the last value. v is the mean of these
estimates over n gradients. Where the loss is not quadratic, v is larger, and the steps are shorter.

A rare bright sample makes a gradient many times as large, and would lead all values astray until the mean forgets it.
In the same units, a gradient is therefore at most as long as L, or as n^0.5 times the noise if this is longer. The same
limit, squared, holds for an estimate of v. A fixed limit would leave a bias, because noise with rare bright samples is
skewed.

n rises by 1 if the loss now rises along the last step (Kesten 1958), and falls by a quarter otherwise. While the
gradients agree, a step uses the newest gradient. When noise dominates, it uses the mean of many. If the loss
rises by more than 10 % along a step, n is halved (`loop.update`).

A step ends at the bounds. The other coordinates then take the best step beside the shorter ones, with H. Otherwise,
they would make up for steps that the bounds cut off, and the loss would rise.

The images hardly change if an exposure E rises and all colours c fall. A step dE, dc is therefore taken in E and E c,

    E <- E exp(du),   c <- ((1 + du) c + dc) exp(-du),   du = dE / E

Beside an exposure, the logarithm of each channel's mean of a texture of colours is a coordinate too. The step of this
coordinate multiplies all texels, and the texture's own step (`newton.py`) moves the texels against each other.
Separate steps would converge slowly, because exposure and texture make up for each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from reslrb_cli.optimization.uncertainty.posterior import positive
from reslrb_cli.statistics import Array

#: s, and decrease of n.
NOISE, SHRINK = 0.3, 0.25
#: Standard errors from the estimate to a limit that holds with a probability of 85 %.
SURE = 1.04
#: Columns of `rows` before H: mean gradient, mean value, last gradient, last value, last step, distance, n, v, the
#: standard error of the smallest eigenvalue of H, and the change since the last measurement of H in longest steps.
FIELDS = 10
#: Standard error of the smallest eigenvalue after a movement by one longest step, and the largest standard error, as a
#: share of the smallest eigenvalue, at which measurements end.
SHIFT, KNOWN = 0.25, 0.25


@dataclass(frozen=True)
class JointState:
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
        self.at: dict[str, slice] = {}
        self.add(sizes)

    def add(self, sizes: Mapping[str, int]) -> None:
        """Add coordinates before the first step."""
        M = sum(at.stop - at.start for at in self.at.values())
        for key, size in sizes.items():
            self.at[key] = slice(M, M + size)
            M += size
        self.rows: Array = np.zeros((M, FIELDS + M), np.float32)
        self.rows[:, 5] = np.inf

    def bend(self, curvature: Array, error: float = 0.0) -> None:
        """Take a measurement of H (M, M). `error` is the standard error of its smallest eigenvalue, in units in which
        the diagonal of H is 1.

        H becomes the mean of all measurements, weighted by the inverse squares of their errors. The error of the
        earlier ones rises as the values change (`doubt`). A measurement with a few bright samples has a large error, so
        it hardly counts. A measurement without an `error` replaces all earlier ones.
        """
        rows = self.rows.copy()
        before = self.doubt
        share = before**2 / (before**2 + error**2) if error > 0 and before < np.inf else 1.0
        rows[:, FIELDS:] += share * (curvature - rows[:, FIELDS:])
        rows[:, 8], rows[:, 9] = np.sqrt(share) * error, 0.0
        self.rows = rows

    @property
    def doubt(self) -> float:
        """Standard error of the smallest eigenvalue of H at the current values, in units in which the diagonal of H is
        1. It is infinite without a measurement.
        """
        if not self.rows[:, FIELDS:].any():
            return np.inf
        return float(np.hypot(self.rows[0, 8], SHIFT * np.abs(self.rows[:, 9]).max()))

    @property
    def is_known(self) -> bool:
        """True if the standard error of the smallest eigenvalue of H is small, so no further measurement is needed."""
        H = self.rows[:, FIELDS:].astype(np.float64)
        use = np.diag(H) > 0
        if not use.any() or not self.rows[0, 8] > 0:
            return False
        root = np.sqrt(np.diag(H)[use])
        return bool(self.doubt <= KNOWN * np.linalg.eigvalsh(H[np.ix_(use, use)] / np.outer(root, root))[0])

    def distrust(self) -> None:
        """Halve the number n of gradients in the mean, which is at least 1."""
        rows = self.rows.copy()
        rows[:, 6] = np.maximum(rows[:, 6] / 2, 1)
        self.rows = rows

    def steepness(self, key: str) -> Array:
        """Return the gradient of each entry that moves it by 1, summed over the steps. It is infinite without a
        curvature.
        """
        size = np.diag(self.rows[:, FIELDS:])[self.at[key]].astype(np.float64)
        return np.asarray(np.where(size > 0, size * np.maximum(self.rows[self.at[key], 6], 1), np.inf))

    def to_go(self, key: str) -> float:
        """Return a limit of the root mean square distance to the optimum. It is infinite if it is not known."""
        return float(np.sqrt(np.mean(np.square(self.rows[self.at[key], 5], dtype=np.float64))))

    @property
    def averaged(self) -> float:
        """Number n of gradients in the mean."""
        return float(self.rows[0, 6])

    def steps(self, now: JointState) -> Array:
        """Return the changes (M,) of the values. Coordinates without curvature do not move."""
        rows, H = self.rows.astype(np.float64), self.rows[:, FIELDS:].astype(np.float64)
        use = now.known & (np.diag(H) > 0)
        if not use.any():
            return np.zeros(len(H))
        root = np.sqrt(np.where(use, np.diag(H), 1.0))
        K = positive(np.where(np.outer(use, use), H / np.outer(root, root), 0.0))
        mean_g, mean_x, last_g, last_x, last_step = rows[:, :5].T
        y, x = np.where(use, now.gradient / root, 0.0), now.value * root
        last, variance = rows[0, 6:8]
        n = last + 1 if now.gradient @ last_step > 0 else max(1.0, last - SHRINK)
        reach = float(np.mean(np.square(root * now.longest)[use]))
        most = max(reach, n * variance)
        before = K @ (x - last_x * root) if last > 0 else np.zeros_like(x)
        new = max(min(float(np.mean(np.square(y - last_g / root - before)[use])) / 2, most), 1e-300)
        variance = variance + (new - variance) / n if variance > 0 else new
        y *= min(1.0, np.sqrt(most / max(float(np.mean(np.square(y[use]))), 1e-300)))
        mean_g = np.where(now.known, mean_g + (y * root - mean_g) / n, mean_g)
        mean_x = mean_x + (now.value - mean_x) / n
        Y = np.where(use, mean_g / root, 0.0) - K @ (mean_x * root - x)
        free = use & ~((now.value <= now.low) & (Y > 0) | (now.value >= now.high) & (Y < 0))
        step, error = np.zeros_like(x), np.zeros_like(x)
        while free.any():
            A, C = K[np.ix_(free, free)], np.square(2 * now.longest * root)[free]
            inverse = np.linalg.inv(A @ A + np.diag(NOISE * variance / n / C + 1e-8))
            step[free] = -(inverse @ A @ (Y + K @ np.where(free, 0.0, step * root))[free]) / root[free]
            error[free] = np.sqrt(np.diag(inverse) * variance / n) / root[free]
            within = np.clip(step, now.low - now.value, now.high - now.value)
            outside = free & (within != step)
            if not outside.any():
                break
            # The other coordinates follow the steps of these up to their bounds.
            step, free = np.where(outside, within, step), free & ~outside
        distance = np.abs(step) + SURE * error
        # The first gradient has no predecessor, so it says nothing about the noise.
        change = np.clip(step, -now.longest, now.longest)
        shifted = rows[:, 9] + change / np.where(now.longest > 0, now.longest, 1.0)
        fields = [mean_g, mean_x, now.gradient, now.value, step, distance, n, variance if last > 0 else 0.0, rows[0, 8]]
        rows[:, :FIELDS] = np.stack([np.broadcast_to(field, x.shape) for field in (*fields, shifted)], axis=1)
        if (tied := now.exposure >= 0).any():
            du = change[now.exposure[tied]]
            colour = now.value[tied]
            change[tied] = ((1 + du) * colour + change[tied]) * np.exp(-du) - colour
        self.rows = rows.astype(np.float32)
        return change
