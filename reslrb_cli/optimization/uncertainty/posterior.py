"""Distance of the final values from the optimum. The estimate is the offset that remains after the run's steps,
corrected by gradients at the end.

A `Measured` has the measurements of one parameter at the end of a run. A `Posterior` is the result. `joint` treats
entries together. `alone` treats each entry as if all other entries were known.

Near the optimum, the loss is quadratic with curvature H. The offset of the values from the optimum is d = x - x*. P is
an entry's movement by one step per unit of gradient (`Optimizer.response`).

    d <- d - eta_t P (H d + noise)

C is the covariance of the offset. C starts with the square of each entry's scale, because nothing is known about the
optimum. Each step changes C.

    C <- (1 - eta_t P H) C (1 - eta_t P H)^T + eta_t^2 P Sigma P

C has three parts: the initial offset that remains after too few iterations, directions that the view does not
determine, and the steps' noise. In undetermined directions, H has no curvature, so C keeps its initial value. After the
steps, the mean g of K gradients at the final values measures H d. The measurement updates C as in a Kalman filter.

    gain = C H (H C H + Sigma / K)^-1,   to go = gain g,   C <- C - gain H C

The last iterations measure H d as well (`Measured.last`). The noise of the last iterations is part of C, but the total
movement m of the last iterations is known. C is then the covariance of the values before the last iterations. The
offset d has the mean m in place of 0. The gradient of a step is H (d + y) plus noise. Here y is the offset of the
step's values from the final values. After subtracting H y, a step's gradient counts as one more gradient at the end.

    to go = m + gain (g - H m)

C is only as good as the model. At first, other parameters with wrong values may have driven the parameters of C in the
wrong direction. The curvature may also have been smaller during the run. C may then be too small by any factor, because
the remainder of the initial offset falls exponentially. Gradients at the end show this. Let u be an eigenvector of H
with curvature h. For u (g - H m), the model predicts the variance h^2 c + s. The term c comes from C, and s comes from
noise. If the observed u (g - H m) exceeds `SURPRISE` standard deviations, c is replaced.

    c <- ((u (g - H m))^2 - s) / h^2      at most that of the start

Noise of the target adds the same b to every gradient. A gradient is then H d + b + noise. Here d is the offset from the
optimum for a target without noise. B is the second moment of b. D is the steps' total movement per unit of a constant
gradient. E, cov(d, g) and cov(g) replace C, C H and H C H + Sigma / K.

    D <- (1 - eta_t P H) D + eta_t P
    E = C + D B D^T,   cov(d, g) = E H - D B,   cov(g) = H E H - H D B - B D^T H + B + Sigma / K

If the run has converged, D = H^-1. In a converged run, no gradient shows the effect of b. The covariance H^-1 B H^-1
remains.

The model omits momentum, because over many steps the movement is the same with and without momentum. P is measured at
the end of the run. eta_t contains the ratio of earlier step lengths to the final step length (`Measured.pace`). For
Adam, earlier steps are shorter until the large gradients of the start are forgotten.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from reslrb_cli.statistics import Array

#: A distance of this many standard errors is significant; the same for gradients.
SURE = 2.0
#: Gradients this many standard deviations from the model's prediction contradict the model.
SURPRISE = 3.0
#: A value within this share of its scale of a bound counts as at the bound, however small the steps are.
AT_BOUND = 1e-3
#: Steps by which noise may have moved a value away from its bound.
STEPS_OFF = 3.0


@dataclass(frozen=True)
class Measured:
    """Parameter of N entries at the end of a run: its values (N,), bounds, scale, and K gradients (K, N).

    - `response` is an entry's movement by one step per unit of gradient, at the schedule's factor 1. `rates` has the
        schedule's factor for each iteration.
    - `pace` is the step length of each iteration divided by the step length at the end. `pace` is None if all step
        lengths are equal.
    - `last` (n, 2, N) has the last n iterations, if known: the gradients, and the values at which the gradients were
        computed. `recent` (N,) is the mean square of the gradients in the last
        iterations, if the optimiser stores this mean.
    - `seen` (N,) marks the entries of a texture that some view shows. `seen` is None for other parameters.
    - `start` (N,) are the values before the first iteration.
    - `mean` and `noise`, both (N,), are the gradients' mean and variance.
    """

    value: Array
    bounds: tuple[float, float]
    scale: float
    gradients: Array
    response: Array
    rates: Sequence[float]
    is_small: bool
    recent: Array | None = None
    seen: Array | None = None
    last: Array | None = None
    pace: Array | None = None
    start: Array | None = None
    mean: Array = field(init=False)
    noise: Array = field(init=False)

    def __post_init__(self) -> None:
        noise = np.var(self.gradients, axis=0, ddof=1)
        if self.is_small and self.recent is None:  # few samples: use the mean over all entries
            noise = np.where(noise > 0, noise.mean(), 0.0)
        mean = self.gradients.mean(axis=0)
        if self.recent is not None:  # the longer average, because few samples of heavy-tailed gradients underestimate
            noise = np.maximum(noise, self.recent - mean**2)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "noise", noise)

    @property
    def prior(self) -> float:
        """Standard deviation of an entry's offset at the start. For a parameter with bounds, the standard deviation is
        at most that of a uniform distribution between the bounds.
        """
        low, high = self.bounds
        return min(self.scale, (high - low) / np.sqrt(12))

    @property
    def steps(self) -> Array:
        """Step factor eta of each iteration, which is the schedule's factor times the pace."""
        rates = np.asarray(self.rates, dtype=np.float64)
        return rates if self.pace is None else rates * self.pace

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
        step = self.response * self.rates[-1] * np.sqrt(self.noise)  # the noise of the last step
        near = np.maximum(AT_BOUND * self.scale, STEPS_OFF * step)
        back = SURE * np.sqrt(self.noise / len(self.gradients))
        lower = (self.value - low <= near) & (self.mean >= np.where(self.value <= low, -back, back))
        upper = (high - self.value <= near) & (self.mean <= np.where(self.value >= high, back, -back))
        return np.asarray(lower | upper)

    @property
    def moved(self) -> Array:
        """Entries (N,) that the run has moved. They had gradients on the way, but may have none at their final
        values.
        """
        return np.zeros(self.value.shape, dtype=bool) if self.start is None else self.value != self.start

    def within(self, to_go: Array) -> Array:
        """Return movements to the optimum, clipped at the bounds. Far away, the curvature is not valid."""
        low, high = self.bounds
        return np.clip(to_go, np.minimum(self.value - high, 0), np.maximum(self.value - low, 0)).astype(np.float64)


@dataclass(frozen=True)
class Posterior:
    """Estimated offset of each of M entries from the optimum.

    A posterior has the mean offset `to_go` (M,) and its `variance` (M,). `of_target` (M,) is the part of the spread
    that comes from the target. If the entries were judged together, the posterior also has the covariance (M, M).
    """

    to_go: Array
    variance: Array
    of_target: Array
    covariance: Array | None = None

    @property
    def error(self) -> Array:
        """Standard error of `to_go`, (M,)."""
        return np.sqrt(np.maximum(self.variance, 0.0))

    @property
    def spread(self) -> Array:
        """Root mean square (M,) of the offset, which is one standard deviation of a final value around the optimum."""
        return np.hypot(self.to_go, self.error)


@dataclass(frozen=True)
class Entries:
    """M entries at the end of a run.

    - `response` (M,) is the diagonal of P, and `scale` (M,) is the standard deviation of the offset at the start.
    - `gradient` (M,) is the mean of `samples` gradients. `samples` is one count for all entries, or one count for each
        entry. If the counts differ, the smaller sample set is part of the larger sample set.
    - `rates` are the eta of all iterations. `came` (M,) is the known movement in the last iterations, which `rates`
        does not contain.
    """

    response: Array
    scale: Array
    gradient: Array
    samples: int | Array
    rates: Sequence[float] | Array
    came: Array | float = 0.0


def joint(entries: Entries, curvature: Array, noise: Array, fixed: Array | None = None) -> Posterior:
    """Return the joint offset of all entries.

    `curvature` is H (M, M), and `noise` the covariance of one gradient (M, M). `fixed` is the matrix B (M, M) of the
    noise that all gradients have in common, or None. The computation expresses each entry in units of the entry's
    scale. Matrices of entries with different units are therefore well-conditioned.
    """
    scale, gradient = entries.scale, entries.gradient
    units = np.outer(scale, scale)
    H, Sigma = _positive(curvature * units), _positive(noise * units)
    C, D = _after(H, entries.response / scale**2, Sigma, entries.rates)
    B = np.zeros_like(H) if fixed is None else _positive(fixed * units)
    counts = np.broadcast_to(np.asarray(entries.samples, dtype=np.float64), scale.shape)
    m, driven = entries.came / scale, D @ B @ D.T
    E, pulled = C + driven, H @ D @ B
    beside = B - pulled - pulled.T + Sigma / np.maximum.outer(counts, counts)
    surprise = gradient * scale - H @ m
    E = E + _unforeseen(H, E, beside, surprise)
    seen = H @ E @ H + beside
    seen = seen + np.eye(len(scale)) * max(1e-9 * float(np.trace(seen)), 1e-30)
    shared = E @ H - D @ B
    gain = np.linalg.solve(seen, shared.T).T
    covariance = _positive(E - gain @ shared.T) * units
    of_target = np.sqrt(np.maximum(np.diag(driven), 0.0)) * scale
    return Posterior((m + gain @ surprise) * scale, np.diag(covariance), of_target, covariance)


def _unforeseen(H: Array, E: Array, beside: Array, surprise: Array) -> Array:
    """Return the amount to add to the offsets' covariance E if the gradients contradict E. The addition and E are in
    units of the standard deviations at the start.

    `surprise` is the difference between measured and expected gradients. `beside` is the part of `surprise`'s
    covariance that does not come from E.
    """
    values, vectors = np.linalg.eigh(H)
    c, s = (np.einsum("me,mn,ne->e", vectors, each, vectors) for each in (E, beside))
    square, h2 = (vectors.T @ surprise) ** 2, np.maximum(values, 0.0) ** 2
    found = np.clip((square - s) / np.maximum(h2, 1e-300), 0.0, 1.0)
    more = np.where(square > SURPRISE**2 * np.maximum(h2 * c + s, 1e-300), np.maximum(found - c, 0.0), 0.0)
    return np.asarray((vectors * more) @ vectors.T)


def alone(entries: Entries, curvature: Array, noise: Array, fixed: Array | float = 0.0) -> Posterior:
    """Return the offset of each entry, as if all other entries were known. `curvature`, `noise` and `fixed` are the
    diagonals (M,) of the matrices in `joint`. The function does not correct the model's covariance C, even if gradients
    contradict the model.
    """
    response, came = entries.response, entries.came
    h = np.maximum(curvature, 0.0)
    C, D = entries.scale**2, np.zeros_like(h)
    for rate in entries.rates:
        left = np.clip(1 - rate * response * h, 0, 1)
        C = left**2 * C + (rate * response) ** 2 * noise
        D = left * D + _driven(rate * response, h)
    E = C + D**2 * fixed
    seen = h**2 * E - 2 * h * D * fixed + fixed + np.maximum(noise / entries.samples, 1e-300)
    shared = E * h - D * fixed
    gain = shared / seen
    return Posterior(came + gain * (entries.gradient - h * came), E - gain * shared, D * np.sqrt(fixed))


def _driven(step: Array, curvature: Array) -> Array:
    """Return one step's movement per unit of a constant gradient. The movement ends where the curvature compensates for
    the gradient.
    """
    return np.asarray(np.minimum(step, 1 / np.maximum(curvature, 1e-300)))


def _after(H: Array, response: Array, noise: Array, rates: Sequence[float] | Array) -> tuple[Array, Array]:
    """Return the covariance after all steps if all variances are 1 at the start. Also return the total movement by a
    constant gradient.

    An entry that no step moves stays unchanged.
    """
    C, D, moved = np.eye(len(response)), np.zeros_like(H), response > 0
    if not moved.any():
        return C, D
    # Steps are symmetric in units of the square root of the response.
    q, free = np.sqrt(response[moved]), np.ix_(moved, moved)
    values, vectors = np.linalg.eigh(H[free] * np.outer(q, q))
    now = vectors.T @ np.diag(q**-2) @ vectors
    shaken = vectors.T @ (noise[free] * np.outer(q, q)) @ vectors
    values, driven = np.maximum(values, 0.0), np.zeros(len(values))
    for rate in rates:
        left = np.clip(1 - rate * values, 0, 1)
        now = left[:, None] * now * left[None, :] + rate**2 * shaken
        driven = left * driven + _driven(np.full_like(values, rate), values)
    back = q[:, None] * vectors
    C[free], D[free] = back @ now @ back.T, (back * driven) @ back.T
    return C, D


def _positive(matrix: Array) -> Array:
    """Return the nearest symmetric matrix without negative eigenvalues. Noise causes negative eigenvalues."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
