"""Joint steps of the entries of all small parameters (`optimizer: auto`).

Colours that light each other, a lamp and the surfaces that it lights, and an exposure compensate for each other. Their
curvature H is therefore measured as a whole, by differences of images (`loop.measure_block`). Near the optimum x*, a
gradient is g = H (x - x*) + noise. With the means of the last n gradients and of their values, a step is

    y = mean g - H (mean x - x),   x <- x - (n H V^-1 H + s C^-1)^-1 n H V^-1 y

in units in which the diagonal of H is 1. C is diagonal, with the squares of twice the longest steps. V is the
covariance of the noise of a gradient, so noise limits the steps in directions that the images hardly determine. V has
the eigenvectors of H, and two variances: one for the half of the eigenvectors with the larger curvature, and one for
the others, along which noise is smaller as well. Consecutive gradients give both variances, because
g - g' - H (x - x') has the covariance 2 V. Where the loss is not quadratic, V is larger, and the steps are shorter.

n rises by 1 if the loss now rises along the last step (Kesten 1958), and falls by a quarter otherwise. While the
gradients agree, a step uses the newest gradient. When noise dominates, it uses the mean of many.

The images hardly change if an exposure E rises and all colours c fall. A step dE, dc is therefore taken in E and E c,

    E <- E exp(du),   c <- ((1 + du) c + dc) exp(-du),   du = dE / E
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from reslrb_cli.optimization.uncertainty.posterior import positive
from reslrb_cli.statistics import Array

#: s, decay of V, and decrease of n.
NOISE, MEMORY, SHRINK = 0.3, 0.8, 0.25
#: Smallest variance of V as a share of the largest.
LEAST_NOISE = 1e-4
#: Standard errors from the estimate to a limit that holds with a probability of 85 %.
SURE = 1.04
#: Columns of `rows` before H: mean gradient, mean value, last gradient, last value, last step, distance, n, and
#: the variances along the smaller and the larger curvatures.
FIELDS = 9


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
        return np.asarray(np.where(size > 0, size * np.maximum(self.rows[self.at[key], 6], 1), np.inf))

    def to_go(self, key: str) -> float:
        """Return a limit of the root mean square distance to the optimum. It is infinite if it is not known."""
        return float(np.sqrt(np.mean(np.square(self.rows[self.at[key], 5], dtype=np.float64))))

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
        y *= min(1.0, np.linalg.norm((root * now.longest)[use]) / max(float(np.linalg.norm(y)), 1e-300))
        gradient = np.where(use, y * root, 0.0)
        n, variances = rows[0, 6], rows[0, 7:FIELDS]
        before = K @ (x - last_x * root) if n > 0 else np.zeros_like(x)
        vectors = np.linalg.eigh(K[np.ix_(use, use)])[1]
        squares = np.square(vectors.T @ (y - last_g / root - before)[use]) / 2
        half = (len(squares) + 1) // 2
        new = np.array([np.mean(squares[:half]), np.mean(squares[-half:])])
        variances = np.where(variances > 0, variances**MEMORY * new ** (1 - MEMORY), new)
        n = n + 1 if now.gradient @ last_step > 0 else max(1.0, n - SHRINK)
        mean_g = np.where(now.known, mean_g + (gradient - mean_g) / n, mean_g)
        mean_x = mean_x + (now.value - mean_x) / n
        Y = np.where(use, mean_g / root, 0.0) - K @ (mean_x * root - x)
        free = use & ~((now.value <= now.low) & (Y > 0) | (now.value >= now.high) & (Y < 0))
        A, C = K[np.ix_(free, free)], np.square(2 * now.longest * root)[free]
        vectors, noise = np.linalg.eigh(A)[1], max(float(variances.max()), 1e-300)
        places = (np.arange(len(A)) >= len(A) // 2).astype(int)
        precision = (vectors * (noise / np.maximum(variances[places], LEAST_NOISE * noise))) @ vectors.T
        inverse = np.linalg.inv(A @ precision @ A + np.diag(NOISE * noise / n / C + 1e-8))
        step, error = np.zeros_like(x), np.zeros_like(x)
        step[free] = -(inverse @ A @ precision @ Y[free]) / root[free]
        error[free] = np.sqrt(np.diag(inverse) * noise / n) / root[free]
        distance = np.abs(step) + SURE * error
        fields = [mean_g, mean_x, gradient, now.value, step, distance, n, *variances]
        rows[:, :FIELDS] = np.stack([np.broadcast_to(field, x.shape) for field in fields], axis=1)
        change = np.clip(step, -now.longest, now.longest)
        if (tied := now.exposure >= 0).any():
            du = change[now.exposure[tied]]
            colour = now.value[tied]
            change[tied] = ((1 + du) * colour + change[tied]) * np.exp(-du) - colour
        self.rows = rows.astype(np.float32)
        return change
