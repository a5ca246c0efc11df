"""Verdicts on final values, by rules on what was measured, and their record. Nothing here knows of scenes.

- `judge_together`: all directions judged together, and which of them make up for each other
- `ParameterCertainty`, `CertaintyRecord`: what is recorded of how certain final values are
- `weigh`: from gradients and curvature to spreads and verdicts
- `Verdict`, `judge`, `summarise`: what can be said of a final value, by the rules below

The first rule that holds of an entry decides; `spread` is the standard deviation of its final value about the optimum,
`alone` the same with all other parameters known, `to_go` the estimated way to the optimum, and tau `TOLERANCE` of the
entry's scale. All but `spread` are of the optimum of the loss with the target as it is, noise and all.

| verdict          | holds where |
|---|---|
| `not seen`       | it is a texel that no view shows, whatever light by way of it reaches the images |
| `no effect`      | every gradient sample was exactly 0 |
| `at its bound`   | the value is within a step of a bound, and the gradient does not pull it back |
| `settled`        | spread <= tau |
| `still moving`   | `to_go` is told from its error (`SURE` of them), and spread > tau without the target's noise |
| `not determined` | `alone` <= `OTHERS` of `spread`: others make up for it; the most correlated one is named |
| `below the noise`| otherwise: the gradients do not tell within tau where the value should be |

A parameter of several entries is what `SETTLED_SHARE` of those that are seen and have an effect are, if that is
`settled`; otherwise what most of the others are.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from reslrb_cli.optimization.uncertainty.curvature import MARGIN, Direction, smooth
from reslrb_cli.optimization.uncertainty.posterior import SURE, Measured, alone, at_bound, driven_alone, joint

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


def shares(verdicts: Sequence[Verdict]) -> dict[Verdict, float]:
    """The share of the entries that each verdict has, of those that occur."""
    return {verdict: verdicts.count(verdict) / len(verdicts) for verdict in Verdict if verdict in verdicts}


@dataclass(frozen=True)
class ParameterCertainty:
    """Of one parameter: its verdict, and the share of its entries that each verdict has.

    `spread` is one standard deviation of the final value about the optimum and `to_go` the estimated way there, in the
    parameter's unit: one number for each entry of a small parameter, else one, the root mean square over the entries
    that have an effect; None where none was measured, and of entries at their bounds. `partner` is the parameter that
    makes up for this one, where one does. `of_target` is what of the spread the noise of rendered targets makes, in the
    same layout.

    `moved` is the root mean square of how far the entries went since the start, and `reach` of how far all steps would
    have taken them one way, None where their length depends on the gradient (`sgd`); `rate` is the learning rate.
    `seen` is the share of a texture's texels that some view shows, None where that is not asked.
    """

    verdict: str
    shares: dict[str, float]
    spread: list[float | None] | None
    to_go: list[float | None] | None
    partner: str | None = None
    of_target: list[float | None] | None = None
    moved: float | None = None
    reach: float | None = None
    rate: float | None = None
    seen: float | None = None


@dataclass(frozen=True)
class CertaintyRecord:
    """All parameters, by key, and what it took: so many gradients, renderings along directions and random probes, in
    `measure_s` seconds, compilation (`compile_s`) apart, and that over the time of the run's iterations (`share`).

    `iterations`, `scale` and `learning_rate` (those of `optimizer`) and `target_spp` are the run's. `target_noise` says
    whether the noise of the targets is in the spreads: `measured` where all of them were rendered, `in part` where some
    were, else `left out`.
    """

    parameters: dict[str, ParameterCertainty]
    gradients: int
    changes: int
    probes: int
    measure_s: float
    compile_s: float
    share: float
    iterations: int
    scale: str
    learning_rate: float
    target_noise: str
    target_spp: int | None = None

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return asdict(self)


Gradients = dict[str, Array]


def weigh(
    measured: Mapping[str, Measured],
    directions: Sequence[Direction],
    curvature: Array,
    diagonal: Gradients,
    pixels: Mapping[str, int],
    fixed: Array,
    fixed_diagonal: Gradients,
) -> dict[str, ParameterCertainty]:
    """The certainty of each parameter, from the curvature along directions, and by entry for those of many entries.

    `pixels` is by how many values of images a texture is seen, where that is known: they tell no more entries. `fixed`
    and `fixed_diagonal` are of the noise of the targets what `curvature` and `diagonal` are of the curvature.
    """
    found = judge_together(measured, directions, curvature, fixed)
    places: dict[str, list[int]] = {}
    for place, direction in enumerate(directions):
        places.setdefault(direction.key, []).append(place)
    result = {}
    for key, own in measured.items():
        at = places.get(key, [])
        if at and directions[at[0]].entry is not None:
            result[key] = _small(own, at, found)
        else:
            result[key] = _large(own, diagonal.get(key), fixed_diagonal.get(key), at, found, pixels.get(key))
    return result


def _small(own: Measured, at: Sequence[int], found: Coordinates) -> ParameterCertainty:
    to_go, error = own.within(found.to_go[at]), found.error[at]
    of_run = np.hypot(to_go, error)
    spread = np.maximum(found.spread[at], of_run)  # bounds may have shortened the way
    alone_ = np.where([found.partners[place] is None for place in at], np.inf, found.alone[at])
    verdicts = judge(_evidence(own, spread, of_run, alone_, to_go, error))
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
        _numbers(np.where(np.isnan(known), np.nan, found.of_target[at])),
    )


def _large(
    own: Measured, diagonal: Array | None, fixed: Array | None, at: Sequence[int], found: Coordinates,
    pixels: int | None,
) -> ParameterCertainty:  # fmt: skip
    """By entry as if the others were known; all of it together may still be what another parameter makes up for."""
    touched = np.any(own.gradients, axis=0)
    prior = np.full(own.value.shape, own.prior)
    spread, of_run, to_go, error = prior.copy(), prior.copy(), np.zeros(own.value.shape), prior.copy()
    of_target = np.zeros(own.value.shape)
    if diagonal is not None and touched.any():
        h, B = np.zeros(own.value.shape), np.zeros(own.value.shape)
        h[touched] = smooth(diagonal[touched], own.noise[touched])
        if fixed is not None:
            B[touched] = smooth(fixed[touched], own.noise[touched], MARGIN)
        given = (own.response, prior, own.noise, own.mean)
        to_go, error = alone(h, *given, len(own.gradients), own.rates)
        whole, left = alone(h, *given, len(own.gradients), own.rates, B)
        of_target = driven_alone(h, own.response, own.rates) * np.sqrt(B)
        to_go = own.within(to_go)
        of_run = np.where(touched, np.hypot(to_go, error), prior)
        spread = np.where(touched, np.hypot(own.within(whole), left), prior)
    verdicts = judge(_evidence(own, spread, of_run, np.full(spread.shape, np.inf), to_go, error))
    if own.seen is not None:
        verdicts = [v if seen else Verdict.NOT_SEEN for v, seen in zip(verdicts, own.seen, strict=True)]
    found_shares = shares(verdicts)
    verdict, partner = summarise(found_shares), None
    for place in at if verdict in (Verdict.SETTLED, Verdict.BELOW_NOISE) else ():
        name = found.partners[place]
        if name is not None and found.alone[place] <= OTHERS * found.spread[place] and found.spread[place] > TOLERANCE:
            verdict, partner = Verdict.NOT_DETERMINED, name
    shown = touched if own.seen is None else touched & own.seen
    if verdict is Verdict.SETTLED and pixels is not None and int(shown.sum()) > pixels:
        verdict, partner = Verdict.NOT_DETERMINED, None
    kept = [each not in (Verdict.AT_BOUND, Verdict.NO_EFFECT, Verdict.NOT_SEEN) for each in verdicts]
    seen = diagonal is not None and any(kept)
    parts = (spread, to_go, of_target)
    sizes = [_numbers(np.array([np.sqrt(np.mean(np.square(part[kept]))) if seen else np.nan])) for part in parts]
    return ParameterCertainty(verdict.value, _named(found_shares), sizes[0], sizes[1], partner, sizes[2])


def _evidence(
    own: Measured, spread: Array, of_run: Array, alone_: Array, to_go: Array, error: Array
) -> Evidence:  # fmt: skip
    low, high = (np.full(own.value.shape, np.float32(bound), dtype=np.float64) for bound in own.bounds)
    touched, scale = np.any(own.gradients, axis=0), np.full(own.value.shape, own.scale)
    return Evidence(
        own.value, low, high, scale, touched, own.mean, own.error, own.step, spread, of_run, alone_,
        to_go, error
    )  # fmt: skip


def _named(found: Mapping[Verdict, float]) -> dict[str, float]:
    return {verdict.value: share for verdict, share in found.items()}


def _numbers(values: Array) -> list[float | None] | None:
    """As JSON has them; nothing where none is known."""
    return None if np.isnan(values).all() else [None if np.isnan(value) else float(value) for value in values]


#: A value that is known to this share of its scale is settled.
TOLERANCE = 0.1


#: Where the others are known, what is left of the spread of a value that they make up for.
OTHERS = 0.5


#: Of the entries that have an effect, so many have to be settled.
SETTLED_SHARE = 0.8


class Verdict(str, enum.Enum):
    """What is known of a final value; of equally many entries the first one here names the parameter."""

    STILL_MOVING = "still moving"
    AT_BOUND = "at its bound"
    NOT_DETERMINED = "not determined"
    BELOW_NOISE = "below the noise"
    NO_EFFECT = "no effect"
    NOT_SEEN = "not seen"
    SETTLED = "settled"


@dataclass(frozen=True)
class Evidence:
    """What was measured of the entries of a parameter: arrays (N,), in its unit but for gradients, loss per unit.

    `touched` says whether any gradient sample was not 0, `gradient` and `error` are their mean and its standard error,
    `step` how far noise moved the entry in the last iteration; `of_run` is the spread without the target's noise. `low`
    and `high` may be infinite.
    """

    value: Array
    low: Array
    high: Array
    scale: Array
    touched: Array
    gradient: Array
    error: Array
    step: Array
    spread: Array
    of_run: Array
    alone: Array
    to_go: Array
    to_go_error: Array


def judge(e: Evidence) -> list[Verdict]:
    """The verdict of each entry."""
    tolerance = TOLERANCE * e.scale
    bound = at_bound(e.value, e.low, e.high, e.scale, e.gradient, e.error, e.step)
    rules = [
        (~e.touched, Verdict.NO_EFFECT),
        (bound, Verdict.AT_BOUND),
        (e.spread <= tolerance, Verdict.SETTLED),
        ((np.abs(e.to_go) > SURE * e.to_go_error) & (e.of_run > tolerance), Verdict.STILL_MOVING),
        (e.alone <= OTHERS * e.spread, Verdict.NOT_DETERMINED),
        (np.ones(e.value.shape, dtype=bool), Verdict.BELOW_NOISE),
    ]
    first = np.argmax([holds for holds, _ in rules], axis=0)
    return [rules[place][1] for place in first]


def summarise(found: Mapping[Verdict, float]) -> Verdict:
    """The verdict of a parameter whose entries have these shares."""
    without = (Verdict.NO_EFFECT, Verdict.NOT_SEEN)
    effective = {verdict: share for verdict, share in found.items() if verdict not in without}
    if not effective:
        return max(without, key=lambda verdict: found.get(verdict, 0.0))
    if effective.get(Verdict.SETTLED, 0.0) >= SETTLED_SHARE * sum(effective.values()):
        return Verdict.SETTLED
    others = [verdict for verdict in Verdict if verdict not in (Verdict.SETTLED, *without)]
    return max(others, key=lambda verdict: found.get(verdict, 0.0))
