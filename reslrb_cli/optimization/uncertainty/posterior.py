"""Distance of the final values from the optimum, estimated from the gradients of the last half of a run.

Near the optimum, the loss is quadratic with curvature H. A gradient at the values x is then

    g = H (x - x*) + noise

The offset of the final values is d = x_T - x*. Each gradient of the last half measures H d once the known movement of
the values is subtracted. Gradients at the final values are treated alike.

    y_t = g_t - H (x_t - x_T) = H d + noise

`joint` treats all directions together. The y_t are averaged in `BLOCKS` blocks. The variance of the block means gives
the covariance V of their mean y. No model of the noise or of the optimiser is needed. If H is wrong, or if the loss is
not quadratic, y_t drifts, and V contains the drift. The optimum is as uncertain as the scale before the measurement.

    C = scale^2,   gain = C H (H C H + V)^-1,   to go = gain y,   C <- C - gain H C

In directions that the views do not determine, H has no curvature, and C keeps its initial value. The distance between
the final values and their mean is known without H. Only the remainder (`pulled`) is wrong if H is wrong.

Noise of the target adds the same b to every gradient. B is the second moment of b, and gain B gain^T the part of the
spread that comes from the target.

`pooled` treats many entries of a large parameter as a group. Each of K independent gradients at the final values gives
an estimate H^-1 g of d. The mean of the products of two estimates, over the entries and over pairs of gradients, is an
unbiased estimate of the mean of d^2.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reslrb_cli.statistics import Array, isotonic_regression, special

#: A distance of this many standard errors is significant; the same for gradients.
SURE = 2.0
#: A value within this share of its scale of a bound counts as at the bound, however small the steps are.
AT_BOUND = 1e-3
#: Steps by which noise may have moved a value away from its bound.
STEPS_OFF = 3.0
#: Blocks of consecutive gradients.
BLOCKS = 12
#: One-sided probability that a value is within its limit, and the relative error of the curvature.
CONFIDENCE, CURVATURE_ERROR = 0.85, 0.3
#: Minimum number of entries of a group that shares its noise, and of a group that shares its curvature.
GROUP, LEAST_GROUP = 64, 4
#: Tolerance as a share of a value. Values smaller than this share of the parameter's scale have the tolerance of a
#: larger value.
TOLERANCE, LEAST_VALUE = 0.1, 0.4


@dataclass(frozen=True)
class Measured:
    """Parameter of N entries at the end of a run: its values (N,), bounds, scale, and K gradients (K, N).

    - `step` (N,) is an entry's movement by the last step, per unit of gradient.
    - `is_small` is true if each entry has its own direction.
    - `start` (N,) are the values before the first iteration.
    - `last` (n, 2, m) has the last n iterations, if known: the gradients, and the values at which they were computed.
        m is N for a small parameter. For a larger texture, they are the derivative by the logarithm of each channel's
        brightness, and that logarithm (`brightness`).
    - `rows` (n, 2, N) has the gradients and the values of the last n iterations of a small texture, if known.
    - `seen` (N,) marks the entries of a texture that some view shows. `seen` is None for other parameters.
    - `is_map` is true for a small texture or heightmap, whose entries have one spread.
    """

    value: Array
    bounds: tuple[float, float]
    scale: float
    gradients: Array
    step: Array
    is_small: bool
    start: Array
    last: Array | None = None
    seen: Array | None = None
    rows: Array | None = None
    is_map: bool = False

    @property
    def mean(self) -> Array:
        """Mean gradient (N,) at the final values."""
        return np.asarray(self.gradients.mean(axis=0))

    @cached_property
    def noise(self) -> Array:
        """Variance (N,) of one gradient. Entries of a large parameter share the variance of their group."""
        if self.is_small and self.last is not None:
            return np.var(np.concatenate([self.last[:, 0], self.gradients]), axis=0, ddof=1)
        found = np.var(self.gradients, axis=0, ddof=1)
        for group in self.groups(found > 0):
            found[group] = found[group].mean()
        return found

    @cached_property
    def in_blocks(self) -> tuple[Array, Array]:
        """Means of consecutive gradients (B, N), and the distances (B, N) of their values from the final values: the
        gradients of `rows` and those at the final values in `BLOCKS` blocks, or the K gradients at the final values.
        """
        if self.rows is None:
            return self.gradients, np.zeros_like(self.gradients)
        rows = np.concatenate([self.rows, [[g, self.value] for g in self.gradients]])
        gradients, values = np.array([part.mean(axis=0) for part in np.array_split(rows, BLOCKS)]).swapaxes(0, 1)
        return gradients, values - self.value

    @property
    def prior(self) -> float:
        """Standard deviation of an entry's offset at the start. For a parameter with bounds, the standard deviation is
        at most that of a uniform distribution between the bounds.
        """
        low, high = self.bounds
        return min(self.scale, (high - low) / np.sqrt(12))

    @property
    def touched(self) -> Array:
        """Entries (N,) with a nonzero gradient sample."""
        return np.any(self.gradients, axis=0)

    @property
    def at_bound(self) -> Array:
        """Entries (N,) at a bound. Entries at a bound are within a step of the bound, and the gradient does not pull
        the entries back.

        The gradient points to larger losses. A positive gradient therefore holds the value at the lower bound.
        """
        low, high = (np.float32(bound) for bound in self.bounds)
        near = np.maximum(AT_BOUND * self.scale, STEPS_OFF * self.step * np.sqrt(self.noise))
        back = SURE * np.sqrt(self.noise / len(self.gradients))
        lower = (self.value - low <= near) & (self.mean >= np.where(self.value <= low, -back, back))
        upper = (high - self.value <= near) & (self.mean <= np.where(self.value >= high, back, -back))
        return np.asarray(lower | upper)

    @property
    def is_free(self) -> Array:
        """Entries (N,) that may move: with a gradient, and not at a bound."""
        return np.asarray(self.touched & ~self.at_bound)

    @property
    def moved(self) -> Array:
        """Entries (N,) that the run has moved. They had gradients on the way, but may have none at their final
        values.
        """
        return np.asarray(self.value != self.start)

    def tolerance(self, value: Array | float) -> Array:
        """Return the tolerance of entries with this value."""
        return np.asarray(TOLERANCE * np.maximum(np.abs(value), LEAST_VALUE * self.scale))

    def within(self, to_go: Array) -> Array:
        """Return movements to the optimum, clipped at the bounds. Far away, the curvature is not valid."""
        low, high = self.bounds
        return np.clip(to_go, np.minimum(self.value - high, 0), np.maximum(self.value - low, 0)).astype(np.float64)

    def groups(self, kept: Array, size: int = GROUP) -> list[Array]:
        """Return the indices of the entries in `kept`, in groups of at least `size` entries whose steps have similar
        lengths. The groups are in the order of their steps.

        Adam's steps are short where gradients are large. The groups do not depend on `gradients`, so a selection by
        noise cannot bias a group's mean.
        """
        chosen = np.flatnonzero(kept)
        order = chosen[np.argsort(self.step[chosen], kind="stable")]
        return np.array_split(order, max(len(order) // size, 1)) if order.size else []

    def groups_of_curvature(self, kept: Array, diagonal: Array) -> list[Array]:
        """Return the indices of the entries in `kept`, in groups of similar curvature. `diagonal` (N,) are noisy
        measurements of the curvature.

        The curvature of entries may differ by a factor of thousands, for example at the border of a highlight. The
        longer the steps of an entry, the smaller its curvature (isotonic regression).
        """
        if not (parts := self.groups(kept, LEAST_GROUP)):
            return []
        means, counts = [diagonal[part].mean() for part in parts], [part.size for part in parts]
        blocks = isotonic_regression()(means, weights=counts, increasing=False).blocks
        return [np.concatenate(parts[first:end]) for first, end in itertools.pairwise(blocks)]


@dataclass(frozen=True)
class Posterior:
    """Estimated offset of each of M directions from the optimum.

    A posterior has the mean offset `to_go` (M,), its standard error `error` (M,), and the part `pulled` (M,) of `to_go`
    that depends on the curvature. `of_target` (M,) is the standard deviation that comes from the target's noise.
    `alone` (M,) is the error if all other directions were known, and `covariance` (M, M) that of the offsets. `sure` is
    the number of standard errors to the end of an interval.
    """

    to_go: Array
    error: Array
    pulled: Array
    of_target: Array
    alone: Array
    covariance: Array
    sure: float

    @property
    def spread(self) -> Array:
        """Root mean square (M,) of the offset, which is one standard deviation of a final value around the optimum."""
        return spread_of(self.to_go, self.error, self.of_target)

    @property
    def limit(self) -> Array:
        """Distance (M,) that the offset does not exceed with `CONFIDENCE`, for a target without noise."""
        return self._limit(self.of_target)

    @property
    def limit_of_run(self) -> Array:
        """Like `limit`, but for the optimum of the noisy target."""
        return self._limit(np.zeros_like(self.to_go))

    @property
    def is_pulled(self) -> Array:
        """Directions (M,) in which the gradients still pull the values. Values that only fluctuate are not pulled."""
        return np.asarray(np.minimum(np.abs(self.to_go), np.abs(self.pulled)) > self.sure * self.error)

    def _limit(self, of_target: Array) -> Array:
        parts = self.error**2 + (CURVATURE_ERROR * self.pulled) ** 2 + of_target**2
        return np.asarray(np.abs(self.to_go) + self.sure * np.sqrt(parts))


def spread_of(to_go: Array, error: Array, of_target: Array) -> Array:
    """Return the root mean square of offsets that were measured as `to_go`, with standard errors. The square of `to_go`
    contains that of its `error` on average, so only the larger one counts.
    """
    return np.sqrt(np.maximum(to_go**2, error**2) + of_target**2)


def joint(
    gradients: Array, offsets: Array, scale: Array, curvature: Array, fixed: Array, own: Array | None = None
) -> Posterior:
    """Return the joint offset of M directions.

    `gradients` (n, M) are the gradients, and `offsets` (n, M) the distances of their values from the final values.
    `scale` (M,) is the standard deviation of the offset at the start, `curvature` is H (M, M), and `fixed` is B (M, M).
    `own` (M,) is the curvature along each direction if nothing else moves; by default, the diagonal of H.
    The computation expresses each direction in units of its scale. Matrices of directions with different units are
    therefore well-conditioned.
    """
    units, one = np.outer(scale, scale), np.eye(len(scale))
    H, B = positive(curvature * units), positive(fixed * units)
    y = gradients * scale - (offsets / scale) @ H
    blocks = np.array([block.mean(axis=0) for block in np.array_split(y, min(BLOCKS, len(y)))])
    V = noise_covariance(blocks.T, blocks.var(axis=0, ddof=1), H) / len(blocks)
    seen = H @ H + V
    gain = np.linalg.solve(seen + one * max(1e-9 * float(np.trace(seen)), 1e-30), H).T
    to_go, C = gain @ blocks.mean(axis=0), positive(one - gain @ H)
    pulled = to_go + gain @ H @ (offsets.mean(axis=0) / scale)
    of_target = np.minimum(np.sqrt(np.maximum(np.diag(gain @ B @ gain.T), 0.0)), 1.0)
    h = np.diag(H) if own is None else own * scale**2
    alone = 1 / np.sqrt(1 + h**2 / np.maximum(np.diag(V), 1e-300))
    return Posterior(
        to_go * scale,
        np.sqrt(np.diag(C)) * scale,
        pulled * scale,
        of_target * scale,
        alone * scale,
        C * units,
        float(special().stdtrit(len(blocks) - 1, CONFIDENCE)),
    )


def noise_covariance(samples: Array, variance: Array, curvature: Array) -> Array:
    """Return the noise covariance (M, M) of one sample. `samples` (M, K) are gradients, `variance` (M,) their
    variances, and `curvature` is H (M, M).

    With far fewer samples than entries, the samples do not determine a covariance. However, noise of dL/dI reaches the
    parameters through the same Jacobian J that determines the curvature. The noise correlations are therefore the
    correlations of H times one factor in [0, `LIKE`]. The function fits the factor to the samples.
    """
    size = np.sqrt(np.maximum(np.diag(curvature), 0.0))
    alike = np.clip(curvature / np.maximum(np.outer(size, size), 1e-300), -1, 1) * np.outer(size > 0, size > 0)
    deviation = samples - samples.mean(axis=1, keepdims=True)
    sd = np.sqrt(np.maximum(variance, 1e-300))
    found = (deviation @ deviation.T) / (samples.shape[1] - 1) / np.outer(sd, sd)
    beside = ~np.eye(len(sd), dtype=bool)
    weight = float(np.sum(np.square(alike[beside])))
    factor = float(np.clip(np.sum(found[beside] * alike[beside]) / weight, 0, LIKE)) if weight else 0.0
    return np.asarray(np.where(beside, factor * alike, 1.0) * np.outer(sd, sd))


#: Maximum similarity of the gradients' noise and their curvature: part of the noise is independent.
LIKE = 0.95


def pooled(offsets: Array) -> tuple[float, float]:
    """Return an unbiased estimate of the mean square offset of N entries, and its standard error. `offsets` (K, N) are
    independent unbiased estimates of the offsets.
    """
    count = len(offsets)
    products = (offsets.sum(axis=0) ** 2 - np.square(offsets).sum(axis=0)) / (count * (count - 1))
    error = products.std(ddof=1) / np.sqrt(products.size) if products.size > 1 else np.inf
    return float(products.mean()), float(error)


def positive(matrix: Array) -> Array:
    """Return the nearest symmetric matrix without negative eigenvalues. Noise causes negative eigenvalues."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def pseudo_inverse(matrix: Array, least: float) -> Array:
    """Return the inverse of a symmetric matrix (N, N), made `positive`. The matrix is first scaled to a diagonal of 1.
    Directions with eigenvalues below the share `least` of the largest are left out. Rows of zeros have the inverse 0.
    """
    matrix = positive(matrix)
    root = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale = np.where(root > 0, 1 / np.where(root > 0, root, 1.0), 0.0)
    both = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(matrix * both, rcond=least, hermitian=True) * both)
