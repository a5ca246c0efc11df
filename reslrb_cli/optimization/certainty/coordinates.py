"""All directions judged together: which of them make up for each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.optimization.certainty.directions import Direction
from reslrb_cli.optimization.certainty.measured import Measured
from reslrb_cli.optimization.certainty.posterior import alone, joint

Array = np.ndarray[Any, Any]

#: Two entries whose offsets are so correlated make up for each other.
LEAST_CORRELATION = 0.5
#: The noise of gradients is at most so much like their curvature: some of it is each one's own.
LIKE = 0.95


@dataclass
class Coordinates:
    """The joint posterior of all directions that are free, by place: spread, and what of it is the target's; without
    that the way to go and its error; and partners."""

    spread: Array
    of_target: Array
    to_go: Array
    error: Array
    partners: list[str | None]
    alone: Array


def judge_together(
    measured: Mapping[str, Measured], directions: Sequence[Direction], curvature: Array, fixed: Array
) -> Coordinates:
    """All directions, of curvature H and target's noise B (M, M), in one posterior.

    What stands at its bound, or has no effect, is taken for known: the others are judged without it.
    """
    count = len(directions)
    scale = np.array([1.0 if d.entry is None else measured[d.key].prior for d in directions])
    response, noise, gradient = (np.zeros(count) for _ in range(3))
    free, rows = np.ones(count, dtype=bool), []
    for place, direction in enumerate(directions):
        own, v = measured[direction.key], direction.vector
        rows.append(along := own.gradients @ v)
        response[place] = own.response @ v**2 / np.sum(v**2) ** 2
        gradient[place], noise[place] = along.mean(), np.var(along, ddof=1)
        if direction.entry is not None:
            noise[place] = own.noise[direction.entry]
            free[place] = not own.at_bound[direction.entry]
        free[place] = free[place] and np.any(along)
    of_target, to_go, error = (np.zeros(count) for _ in range(3))
    result = Coordinates(scale.copy(), of_target, to_go, error, [None] * count, scale.copy())
    chosen = np.flatnonzero(free)
    if not chosen.size:
        return result
    first = next(iter(measured.values()))
    p, size, variance, g = (each[chosen] for each in (response, scale, noise, gradient))
    free_ones = np.ix_(chosen, chosen)
    H, B, samples = curvature[free_ones], fixed[free_ones], np.array([rows[place] for place in chosen])
    count = samples.shape[1]
    Sigma = noise_covariance(samples, variance, H)
    posterior, whole = (joint(H, p, size, Sigma, g, count, first.rates, each) for each in (None, B))
    to_go, error = alone(np.diag(H), p, size, variance, g, count, first.rates, np.maximum(np.diag(B), 0.0))
    result.to_go[chosen], result.error[chosen] = posterior.to_go, posterior.error
    result.spread[chosen], result.of_target[chosen] = whole.spread, whole.of_target
    result.alone[chosen] = np.hypot(to_go, error)
    correlation = np.abs(posterior.covariance) / np.maximum(np.outer(posterior.error, posterior.error), 1e-300)
    for row, place in zip(correlation, chosen.tolist(), strict=True):
        result.partners[place] = _partner(row, place, chosen, directions)
    return result


def noise_covariance(samples: Array, variance: Array, curvature: Array) -> Array:
    """The covariance (M, M) of the noise of one gradient, of (M, K) samples, M variances, and H (M, M).

    Far fewer samples than entries tell no covariance. But noise that comes from dL/dI reaches the parameters through
    the same J as the curvature: its correlations are taken for those of H, times one factor in [0, LIKE] that fits the
    samples best.
    """
    size = np.sqrt(np.maximum(np.diag(curvature), 0.0))
    alike = np.clip(curvature / np.maximum(np.outer(size, size), 1e-300), -1, 1) * np.outer(size > 0, size > 0)
    deviation = samples - samples.mean(axis=1, keepdims=True)
    sd = np.sqrt(np.maximum(variance, 1e-300))
    found = (deviation @ deviation.T) / (samples.shape[1] - 1) / np.outer(sd, sd)
    beside = ~np.eye(len(sd), dtype=bool)
    weight = float(np.sum(np.square(alike[beside])))
    factor = float(np.clip(np.sum(found[beside] * alike[beside]) / weight, 0, LIKE)) if weight else 0.0
    result: Array = np.where(beside, factor * alike, 1.0) * np.outer(sd, sd)
    return result


def _partner(row: Array, place: int, chosen: Array, directions: Sequence[Direction]) -> str | None:
    """The parameter whose offset is the most correlated with that at `place`; another one, if any is."""
    others = {other: value for other, value in zip(chosen.tolist(), row, strict=True) if other != place}
    likely = {other: value for other, value in others.items() if value >= LEAST_CORRELATION}
    foreign = {other: value for other, value in likely.items() if directions[other].key != directions[place].key}
    pool = foreign or likely
    return directions[max(pool, key=lambda other: pool[other])].key if pool else None
