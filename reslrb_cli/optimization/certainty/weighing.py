"""From gradients and curvature to spreads and verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.optimization.certainty.curvature import smooth
from reslrb_cli.optimization.certainty.directions import Direction
from reslrb_cli.optimization.certainty.posterior import alone, joint
from reslrb_cli.optimization.certainty.records import ParameterCertainty
from reslrb_cli.optimization.certainty.verdicts import (
    OTHERS,
    TOLERANCE,
    Evidence,
    Verdict,
    at_bound,
    judge,
    shares,
    summarise,
)

Array = np.ndarray[Any, Any]
Gradients = dict[str, Array]

#: Two entries whose offsets are so correlated make up for each other.
LEAST_CORRELATION = 0.5


@dataclass(frozen=True)
class Measured:
    """One parameter of N entries at the end of a run: its values (N,), bounds, scale, and K gradients (K, N).

    `response` is how far a step moves an entry per unit of gradient, at the factor 1, and `rates` are the schedule's
    factors of all iterations.
    """

    value: Array
    bounds: tuple[float, float]
    scale: float
    gradients: Array
    response: Array
    rates: Sequence[float]
    is_small: bool
    mean: Array = field(init=False)
    noise: Array = field(init=False)

    def __post_init__(self) -> None:
        noise = np.var(self.gradients, axis=0, ddof=1)
        if self.is_small:  # few samples: those of all entries
            noise = np.where(noise > 0, noise.mean(), 0.0)
        object.__setattr__(self, "mean", self.gradients.mean(axis=0))
        object.__setattr__(self, "noise", noise)

    @property
    def prior(self) -> float:
        """The standard deviation of the offset of an entry at the start: between bounds, at most that of any place."""
        low, high = self.bounds
        return min(self.scale, (high - low) / np.sqrt(12))

    @property
    def error(self) -> Array:
        """The standard error of the mean gradient, (N,)."""
        return np.sqrt(self.noise / len(self.gradients))

    @property
    def step(self) -> Array:
        """How far noise moved an entry in the last iteration, (N,)."""
        return self.response * self.rates[-1] * np.sqrt(self.noise)

    @property
    def at_bound(self) -> Array:
        """Which entries stand at a bound, (N,)."""
        (low, high), scale = self.bounds, np.full(self.value.shape, self.scale)
        return at_bound(self.value, np.float32(low), np.float32(high), scale, self.mean, self.error, self.step)


@dataclass
class _Coordinates:
    """The joint posterior of all directions that are free: spread, way to go and its error, and partners, by place."""

    spread: Array
    to_go: Array
    error: Array
    partners: list[str | None]
    alone: Array


def weigh(
    measured: Mapping[str, Measured], directions: Sequence[Direction], curvature: Array, diagonal: Gradients
) -> dict[str, ParameterCertainty]:
    """The certainty of each parameter, from the curvature along directions, and by entry for those of many entries."""
    found = _joint(measured, directions, curvature)
    places: dict[str, list[int]] = {}
    for place, direction in enumerate(directions):
        places.setdefault(direction.key, []).append(place)
    result = {}
    for key, own in measured.items():
        at = places.get(key, [])
        if at and directions[at[0]].entry is not None:
            result[key] = _small(own, at, found)
        else:
            result[key] = _large(own, diagonal.get(key), at, found)
    return result


def _joint(measured: Mapping[str, Measured], directions: Sequence[Direction], curvature: Array) -> _Coordinates:
    """What stands at its bound, or has no effect, is taken for known: the others are judged without it."""
    count = len(directions)
    scale = np.array([1.0 if d.entry is None else measured[d.key].prior for d in directions])
    response, noise, gradient = (np.zeros(count) for _ in range(3))
    free = np.ones(count, dtype=bool)
    for place, direction in enumerate(directions):
        own, v = measured[direction.key], direction.vector
        along = own.gradients @ v
        response[place] = own.response @ v**2 / np.sum(v**2) ** 2
        gradient[place], noise[place] = along.mean(), np.var(along, ddof=1)
        if direction.entry is not None:
            noise[place] = own.noise[direction.entry]
            free[place] = not own.at_bound[direction.entry]
        free[place] = free[place] and np.any(along)
    result = _Coordinates(scale.copy(), np.zeros(count), np.zeros(count), [None] * count, scale.copy())
    chosen = np.flatnonzero(free)
    if not chosen.size:
        return result
    first = next(iter(measured.values()))
    given = (response[chosen], scale[chosen], noise[chosen], gradient[chosen], len(first.gradients), first.rates)
    H = curvature[np.ix_(chosen, chosen)]
    posterior = joint(H, *given)
    to_go, error = alone(np.diag(H), *given)
    result.spread[chosen], result.to_go[chosen], result.error[chosen] = (
        posterior.spread,
        posterior.to_go,
        posterior.error,
    )
    result.alone[chosen] = np.hypot(to_go, error)
    correlation = np.abs(posterior.covariance) / np.maximum(np.outer(posterior.error, posterior.error), 1e-300)
    for row, place in zip(correlation, chosen.tolist(), strict=True):
        result.partners[place] = _partner(row, place, chosen, directions)
    return result


def _partner(row: Array, place: int, chosen: Array, directions: Sequence[Direction]) -> str | None:
    """The parameter whose offset is the most correlated with that at `place`; another one, if any is."""
    others = {other: value for other, value in zip(chosen.tolist(), row, strict=True) if other != place}
    likely = {other: value for other, value in others.items() if value >= LEAST_CORRELATION}
    foreign = {other: value for other, value in likely.items() if directions[other].key != directions[place].key}
    pool = foreign or likely
    return directions[max(pool, key=lambda other: pool[other])].key if pool else None


def _small(own: Measured, at: Sequence[int], found: _Coordinates) -> ParameterCertainty:
    spread, to_go, error = found.spread[at], found.to_go[at], found.error[at]
    alone_ = np.where([found.partners[place] is None for place in at], np.inf, found.alone[at])
    verdicts = judge(_evidence(own, spread, alone_, to_go, error))
    verdict = summarise(shares(verdicts))
    partners = [found.partners[place] for place, each in zip(at, verdicts, strict=True) if each is verdict]
    partner = next((name for name in partners if name), None) if verdict is Verdict.NOT_DETERMINED else None
    # What stands at a bound may be as far from the optimum as that is beyond it.
    known = np.where([each in (Verdict.AT_BOUND, Verdict.NO_EFFECT) for each in verdicts], np.nan, spread)
    return ParameterCertainty(
        verdict.value,
        _named(shares(verdicts)),
        _numbers(known),
        _numbers(np.where(np.isnan(known), np.nan, to_go)),
        partner,
    )


def _large(own: Measured, diagonal: Array | None, at: Sequence[int], found: _Coordinates) -> ParameterCertainty:
    """By entry as if the others were known; all of it together may still be what another parameter makes up for."""
    touched = np.any(own.gradients, axis=0)
    prior = np.full(own.value.shape, own.prior)
    spread, to_go, error = prior.copy(), np.zeros(own.value.shape), prior.copy()
    if diagonal is not None and touched.any():
        at_all = own.response[touched], prior[touched], own.noise[touched], own.mean[touched]
        h = smooth(diagonal[touched], own.noise[touched])
        to_go[touched], error[touched] = alone(h, *at_all, len(own.gradients), own.rates)
        spread = np.where(touched, np.hypot(to_go, error), prior)
    verdicts = judge(_evidence(own, spread, np.full(spread.shape, np.inf), to_go, error))
    found_shares = shares(verdicts)
    verdict, partner = summarise(found_shares), None
    for place in at if verdict in (Verdict.SETTLED, Verdict.BELOW_NOISE) else ():
        name = found.partners[place]
        if name is not None and found.alone[place] <= OTHERS * found.spread[place] and found.spread[place] > TOLERANCE:
            verdict, partner = Verdict.NOT_DETERMINED, name
    kept = [each not in (Verdict.AT_BOUND, Verdict.NO_EFFECT) for each in verdicts]
    seen = diagonal is not None and any(kept)
    sizes = [np.array([np.sqrt(np.mean(np.square(part[kept]))) if seen else np.nan]) for part in (spread, to_go)]
    return ParameterCertainty(verdict.value, _named(found_shares), _numbers(sizes[0]), _numbers(sizes[1]), partner)


def _evidence(own: Measured, spread: Array, alone_: Array, to_go: Array, error: Array) -> Evidence:
    low, high = (np.full(own.value.shape, np.float32(bound), dtype=np.float64) for bound in own.bounds)
    touched, scale = np.any(own.gradients, axis=0), np.full(own.value.shape, own.scale)
    return Evidence(
        own.value, low, high, scale, touched, own.mean, own.error, own.step, spread, alone_, to_go, error
    )  # fmt: skip


def _named(found: Mapping[Verdict, float]) -> dict[str, float]:
    return {verdict.value: share for verdict, share in found.items()}


def _numbers(values: Array) -> list[float | None] | None:
    """As JSON has them; nothing where none is known."""
    return None if np.isnan(values).all() else [None if np.isnan(value) else float(value) for value in values]
