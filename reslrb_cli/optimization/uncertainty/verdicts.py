"""Rules that turn measurements into verdicts on final values, and the record of the verdicts. Nothing here depends on
scenes.

- `weigh` turns gradients and curvature into spreads and verdicts, in a `CertaintyRecord`.
- `judge_together` judges all directions together, and finds out which of them compensate for each other.
- `ParameterVerdict`, `judge` and `summarise` apply the rules below.

The first rule that applies to an entry decides. `spread` is the standard deviation of the entry's final value around
the optimum. `alone` is the spread that remains if all other parameters are known. `to_go` is the estimated distance to
the optimum. tau is `TOLERANCE` times the entry's scale. `to_go` refers to the optimum for the noisy target. `spread`
refers to the optimum for a target without noise.

| verdict          | condition |
|---|---|
| `not seen`       | a texel that no view shows, even if its light reaches the images |
| `no effect`      | every gradient sample was exactly 0, and neither of the next two rules applies |
| `at its bound`   | the value is within a step of a bound, and the gradient does not pull it back |
| `effect lost`    | the run has moved it, and every gradient sample of its whole parameter was exactly 0 |
| `settled`        | spread <= tau |
| `still moving`   | `to_go` differs from 0 by `SURE` of its errors, and spread > tau without the target's noise |
| `not determined` | `alone` <= `OTHERS` of `spread`: others compensate for it; the most correlated one is named |
| `below the noise`| otherwise: the gradients do not determine the value to tau |

A `settled` parameter becomes `still moving` if the parameter that compensates for it is `still moving`, because both
move together.

If the derivative of a parameter lacks a significant share, or if this share is unknown, its verdict is `derivative
incomplete`. A run measures the missing share before its first iteration (`measure/missing.py`).

A parameter of several entries is `settled` if at least `SETTLED_SHARE` of its visible entries with an effect are
settled. Otherwise, the parameter gets the most frequent verdict of the unsettled visible entries with an effect.
"""

from __future__ import annotations

import enum
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reslrb_cli.optimization.uncertainty.curvature import MARGIN, ParameterDirection, smooth
from reslrb_cli.optimization.uncertainty.posterior import SURE, Entries, Measured, alone, joint
from reslrb_cli.records.decisions import Jsonable
from reslrb_cli.records.measurements import INCOMPLETE
from reslrb_cli.statistics import Array, rms

#: A value known to this share of its scale is settled.
TOLERANCE = 0.1
#: Remaining share of a value's spread, given the others, below which they compensate for it.
OTHERS = 0.5
#: Minimum share of settled entries among those with an effect.
SETTLED_SHARE = 0.8
#: Minimum correlation of the offsets of two entries that compensate for each other.
LEAST_CORRELATION = 0.5
#: Maximum similarity of the gradients' noise and their curvature: part of the noise is independent.
LIKE = 0.95
Gradients = dict[str, Array]
Values = list[float | None] | None


class ParameterVerdict(str, enum.Enum):
    """Verdict on a final value. If several verdicts are equally frequent among the entries, the first verdict in the
    order of this enum counts.
    """

    STILL_MOVING = "still moving"
    AT_BOUND = "at its bound"
    NOT_DETERMINED = "not determined"
    BELOW_NOISE = "below the noise"
    NO_EFFECT = "no effect"
    EFFECT_LOST = "effect lost"
    NOT_SEEN = "not seen"
    INCOMPLETE = INCOMPLETE
    SETTLED = "settled"


#: Verdicts on entries without an effect on the images at their final values.
WITHOUT = (ParameterVerdict.NO_EFFECT, ParameterVerdict.EFFECT_LOST, ParameterVerdict.NOT_SEEN)


def judge(
    own: Measured, spread: Array, of_run: Array, alone: Array, to_go: Array, error: Array
) -> list[ParameterVerdict]:
    """Return the verdict on each entry of a parameter. All arrays are (N,), in the parameter's unit.

    `of_run` is the spread without the target's noise, and `error` the standard error of `to_go`.
    """
    tolerance = TOLERANCE * own.scale
    lost = own.moved & (not own.touched.any())
    rules = [
        (~own.touched & ~(own.at_bound & own.moved) & ~lost, ParameterVerdict.NO_EFFECT),
        (own.at_bound, ParameterVerdict.AT_BOUND),
        (lost, ParameterVerdict.EFFECT_LOST),
        (spread <= tolerance, ParameterVerdict.SETTLED),
        ((np.abs(to_go) > SURE * error) & (of_run > tolerance), ParameterVerdict.STILL_MOVING),
        (alone <= OTHERS * spread, ParameterVerdict.NOT_DETERMINED),
        (np.ones(own.value.shape, dtype=bool), ParameterVerdict.BELOW_NOISE),
    ]
    first = np.argmax([holds for holds, _ in rules], axis=0)
    return [rules[place][1] for place in first]


def shares(verdicts: Sequence[ParameterVerdict]) -> dict[ParameterVerdict, float]:
    """Return the share of the entries with each verdict."""
    return {verdict: verdicts.count(verdict) / len(verdicts) for verdict in ParameterVerdict if verdict in verdicts}


def summarise(found: Mapping[ParameterVerdict, float]) -> ParameterVerdict:
    """Return the verdict of a parameter from the shares of its entries."""
    effective = {verdict: share for verdict, share in found.items() if verdict not in WITHOUT}
    if not effective:
        return max(WITHOUT, key=lambda verdict: found.get(verdict, 0.0))
    if effective.get(ParameterVerdict.SETTLED, 0.0) >= SETTLED_SHARE * sum(effective.values()):
        return ParameterVerdict.SETTLED
    others = [verdict for verdict in ParameterVerdict if verdict not in (ParameterVerdict.SETTLED, *WITHOUT)]
    return max(others, key=lambda verdict: found.get(verdict, 0.0))


@dataclass(frozen=True)
class ParameterCertainty:
    """Verdict on one parameter, and the share of its entries with each verdict.

    `spread` is one standard deviation of the final value around the optimum. `of_target` is the part of `spread` that
    comes from the noise of rendered targets. `to_go` is the estimated distance. All are in the parameter's unit. A
    small parameter has one number for each entry. A large parameter has the root mean square over its visible entries
    with an effect that are not at a bound. The numbers are None if nothing was measured, and for entries at their
    bounds or without effect. `partner` is the parameter that compensates for this parameter, if there is one.

    `moved` is the root mean square movement since the start, over the visible entries with a gradient. `reach` is the
    distance that all steps cover in one direction. `reach` is None if the step length depends on the gradient (`sgd`).
    `rate` is the learning rate.
    """

    verdict: str
    shares: dict[str, float]
    spread: Values
    to_go: Values
    partner: str | None = None
    of_target: Values = None
    moved: float | None = None
    reach: float | None = None
    rate: float | None = None


@dataclass(frozen=True)
class CertaintyRecord(Jsonable):
    """Certainty of all parameters, by key, and the time of the estimate.

    `measure_s` is the measuring time in seconds without compilation. `share` is `measure_s` divided by the time of the
    run's iterations. `iterations`, `scale`, `learning_rate` and `target_spp` repeat the run's settings.
    `learning_rate` is that of `optimizer`. `target_noise` is `measured` if all targets were rendered, `in part` if some
    were, otherwise `left out`. The spreads include only the noise of rendered targets.
    """

    parameters: dict[str, ParameterCertainty]
    measure_s: float
    share: float
    iterations: int
    scale: str
    learning_rate: float
    target_noise: str
    target_spp: int | None = None

    def without_derivatives(self, keys: Collection[str]) -> CertaintyRecord:
        """Return the record with the verdict `derivative incomplete` for the parameters `keys`."""
        verdict = ParameterVerdict.INCOMPLETE.value
        judged = {key: replace(about, verdict=verdict, shares={verdict: 1.0}, partner=None) if key in keys else about
                  for key, about in self.parameters.items()}  # fmt: skip
        return replace(self, parameters=judged)


@dataclass
class JointPosterior:
    """Joint posterior of all free directions, in the order of the directions.

    `spread` is the standard deviation, and `of_target` is the part of `spread` that the target's noise causes. `to_go`
    is the distance to the optimum, and `error` is its standard error. `to_go` and `error` exclude the target's noise.
    For each direction, `partners` names the parameter that compensates.
    """

    spread: Array
    of_target: Array
    to_go: Array
    error: Array
    partners: list[str | None]
    alone: Array


def judge_together(
    measured: Mapping[str, Measured], directions: Sequence[ParameterDirection], curvature: Array, fixed: Array
) -> JointPosterior:
    """Judge all directions in one joint posterior. `curvature` is H (M, M), and `fixed` is the target noise B (M, M).

    Entries at their bounds, or without effect, count as known.
    """
    count, iterations = len(directions), len(next(iter(measured.values())).rates)
    scale = np.array([1.0 if d.entry is None else measured[d.key].prior for d in directions])
    response, noise, gradient, of_target, to_go, error = (np.zeros(count) for _ in range(6))
    # Of the last iterations: their number, the mean gradient, and the movement from the mean and from the first values.
    steps, pull, mean, came = (np.zeros(count) for _ in range(4))
    free, rows = np.ones(count, dtype=bool), []
    for place, direction in enumerate(directions):
        own, v = measured[direction.key], direction.vector
        rows.append(along := own.gradients @ v)
        response[place] = own.response @ v**2 / np.sum(v**2) ** 2
        gradient[place], noise[place] = along.mean(), np.var(along, ddof=1)
        if direction.entry is not None:
            noise[place] = own.noise[direction.entry]
            free[place] = not own.at_bound[direction.entry]
            if own.last is not None:
                gradients, values = own.last[:, 0, direction.entry], own.last[:, 1, direction.entry]
                steps[place], pull[place] = len(own.last), gradients.mean()
                mean[place], came[place] = own.value[direction.entry] - (values.mean(), values[0])
        free[place] = free[place] and np.any(along)
    result = JointPosterior(scale.copy(), of_target, to_go, error, [None] * count, scale.copy())
    at = np.flatnonzero(free)
    if not at.size:
        return result
    samples = np.array([rows[place] for place in at])
    H, B = curvature[np.ix_(at, at)], fixed[np.ix_(at, at)]
    Sigma = noise_covariance(samples, noise[at], H)
    few, rates = samples.shape[1], _eta(measured, {directions[place].key for place in at.tolist()})
    counts = few + steps[at]
    gradient[at] = (few * gradient[at] + steps[at] * (pull[at] + H @ mean[at])) / counts
    until = rates[: iterations - int(steps.max())]
    entries = Entries(response[at], scale[at], gradient[at], counts, until, came[at])
    posterior, whole = (joint(entries, H, Sigma, each) for each in (None, B))
    single = alone(entries, np.diag(H), noise[at], np.maximum(np.diag(B), 0.0))
    result.to_go[at], result.error[at], result.alone[at] = posterior.to_go, posterior.error, single.spread
    result.spread[at], result.of_target[at] = whole.spread, whole.of_target
    assert posterior.covariance is not None
    correlation = np.abs(posterior.covariance) / np.maximum(np.outer(posterior.error, posterior.error), 1e-300)
    for row, place in zip(correlation, at.tolist(), strict=True):
        result.partners[place] = _partner(row, place, at, directions)
    return result


def _eta(measured: Mapping[str, Measured], keys: Collection[str]) -> Array:
    """Return one eta per iteration for all parameters in `keys`. Each eta is the geometric mean over all parameters in
    `keys`.
    """
    first, paces = next(iter(measured.values())), [measured[key].pace for key in keys]
    found = [np.log(np.maximum(pace, 1e-300)) for pace in paces if pace is not None]
    return np.asarray(first.rates, dtype=np.float64) * np.exp(np.sum(found, axis=0) / len(paces) if found else 0.0)


def noise_covariance(samples: Array, variance: Array, curvature: Array) -> Array:
    """Return the noise covariance (M, M) of one gradient. `samples` (M, K) are gradients, `variance` (M,) their
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


def _partner(row: Array, place: int, chosen: Array, directions: Sequence[ParameterDirection]) -> str | None:
    """Return the parameter whose offset has the highest correlation with the offset at `place`. Return None if no other
    offset has a sufficient correlation.
    """
    others = {other: value for other, value in zip(chosen.tolist(), row, strict=True) if other != place}
    likely = {other: value for other, value in others.items() if value >= LEAST_CORRELATION}
    foreign = {other: value for other, value in likely.items() if directions[other].key != directions[place].key}
    pool = foreign or likely
    return directions[max(pool, key=lambda other: pool[other])].key if pool else None


def weigh(
    measured: Mapping[str, Measured],
    directions: Sequence[ParameterDirection],
    curvature: Array,
    diagonal: Gradients,
    pixels: Mapping[str, int],
    fixed: Array,
    fixed_diagonal: Gradients,
) -> dict[str, ParameterCertainty]:
    """Return the certainty of each parameter, from the curvature along directions. For large parameters, also use the
    curvature of each entry.

    `pixels` is the number of image values that show a texture, if known. They determine at most as many entries.
    `fixed` is the target noise B (M, M), in the same directions as `curvature`. `fixed_diagonal` is the target noise of
    each entry, as in `diagonal`.
    """
    found, result = judge_together(measured, directions, curvature, fixed), {}
    for key, own in measured.items():
        at = [place for place, direction in enumerate(directions) if direction.key == key]
        if at and directions[at[0]].entry is not None:
            result[key] = _small(own, at, found)
        else:
            result[key] = _large(own, diagonal.get(key), fixed_diagonal.get(key), at, found, pixels.get(key))
    moving = {key for key, about in result.items() if about.verdict == ParameterVerdict.STILL_MOVING.value}
    for place, direction in enumerate(directions):
        about = result[direction.key]
        if about.verdict == ParameterVerdict.SETTLED.value and found.partners[place] in moving - {direction.key}:
            result[direction.key] = replace(about, verdict=ParameterVerdict.STILL_MOVING.value)
    return result


def _small(own: Measured, at: Sequence[int], found: JointPosterior) -> ParameterCertainty:
    to_go, error = own.within(found.to_go[at]), found.error[at]
    of_run = np.hypot(to_go, error)
    spread = np.maximum(found.spread[at], of_run)  # bounds may have shortened the distance
    partners = [found.partners[place] for place in at]
    alone_ = np.where([partner is None for partner in partners], np.inf, found.alone[at])
    verdicts = judge(own, spread, of_run, alone_, to_go, error)
    verdict = summarise(shares(verdicts))
    named = [name for name, each in zip(partners, verdicts, strict=True) if name and each is verdict]
    partner = named[0] if named and verdict is ParameterVerdict.NOT_DETERMINED else None
    # A value at a bound may be as far from the optimum as the optimum is beyond the bound.
    known = [each not in (ParameterVerdict.AT_BOUND, *WITHOUT) for each in verdicts]
    parts = (np.where(known, part, np.nan) for part in (spread, to_go, found.of_target[at]))
    return _certainty(verdict, verdicts, partner, *parts)


def _large(
    own: Measured, diagonal: Array | None, fixed: Array | None, at: Sequence[int], found: JointPosterior,
    pixels: int | None,
) -> ParameterCertainty:  # fmt: skip
    """Judge each entry of a large parameter as if all other entries and parameters were known. Another parameter may
    still compensate for the offset of the whole parameter.
    """
    touched, shape = own.touched, own.value.shape
    prior = np.full(shape, own.prior)
    spread, of_run, to_go, error, of_target = prior, prior, np.zeros(shape), prior, np.zeros(shape)
    if diagonal is not None and touched.any():
        h, B = np.zeros(shape), np.zeros(shape)
        h[touched] = smooth(diagonal[touched], own.noise[touched])
        if fixed is not None:
            B[touched] = smooth(fixed[touched], own.noise[touched], MARGIN)
        entries = Entries(own.response, prior, own.mean, len(own.gradients), own.steps)
        known, whole = (alone(entries, h, own.noise, each) for each in (0.0, B))
        to_go, error, of_target = own.within(known.to_go), known.error, whole.of_target
        of_run = np.where(touched, np.hypot(to_go, error), prior)
        spread = np.where(touched, np.hypot(own.within(whole.to_go), whole.error), prior)
    verdicts = judge(own, spread, of_run, np.full(shape, np.inf), to_go, error)
    if own.seen is not None:
        verdicts = [v if seen else ParameterVerdict.NOT_SEEN for v, seen in zip(verdicts, own.seen, strict=True)]
    verdict, partner = summarise(shares(verdicts)), None
    for place in at if verdict in (ParameterVerdict.SETTLED, ParameterVerdict.BELOW_NOISE) else ():
        name = found.partners[place]
        if name is not None and found.alone[place] <= OTHERS * found.spread[place] and found.spread[place] > TOLERANCE:
            verdict, partner = ParameterVerdict.NOT_DETERMINED, name
    shown = touched if own.seen is None else touched & own.seen
    if verdict is ParameterVerdict.SETTLED and pixels is not None and int(shown.sum()) > pixels:
        verdict, partner = ParameterVerdict.NOT_DETERMINED, None
    kept = [each not in (ParameterVerdict.AT_BOUND, *WITHOUT) for each in verdicts]
    is_known = diagonal is not None and any(kept)
    sizes = (np.array([rms(part[kept]) if is_known else np.nan]) for part in (spread, to_go, of_target))
    return _certainty(verdict, verdicts, partner, *sizes)


def _certainty(
    verdict: ParameterVerdict,
    verdicts: Sequence[ParameterVerdict],
    partner: str | None,
    spread: Array,
    to_go: Array,
    of_target: Array,
) -> ParameterCertainty:
    named = {each.value: share for each, share in shares(verdicts).items()}
    return ParameterCertainty(verdict.value, named, _numbers(spread), _numbers(to_go), partner, _numbers(of_target))


def _numbers(values: Array) -> Values:
    """Return numbers for JSON, or None if nothing is known."""
    return None if np.isnan(values).all() else [None if np.isnan(value) else float(value) for value in values]
