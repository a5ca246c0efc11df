"""Rules that turn measurements into verdicts on final values, and the record of the verdicts. Nothing here depends on
scenes.

- `weigh` turns gradients and curvature into spreads and verdicts, in a `CertaintyRecord`.
- `judge_together` judges all directions together, and finds out which of them compensate for each other.
- `ParameterVerdict`, `judge` and `summarise` apply the rules below.

The first rule that applies to an entry decides. `limit` is the distance to the optimum that the entry does not exceed
with a probability of `CONFIDENCE`, and `limit_of_run` the same without the noise of the target. `spread` is the
standard deviation of the entry's final value around the optimum. `alone` is the spread that remains if all other
parameters are known. tau is the entry's tolerance: `TOLERANCE` times the value, or times a share of the scale if that
is larger.

| verdict          | condition |
|---|---|
| `not seen`       | a texel that no view shows, even if its light reaches the images |
| `no effect`      | every gradient sample was exactly 0, and neither of the next two rules applies |
| `at its bound`   | the value is within a step of a bound, and the gradient does not pull it back |
| `effect lost`    | the run has moved it, and every gradient sample of its whole parameter was exactly 0 |
| `settled`        | `limit` <= tau |
| `still moving`   | the gradients pull it by more than their noise, and `limit_of_run` > tau |
| `not determined` | `alone` <= `OTHERS` of `spread`: others compensate for it; the most correlated one is named |
| `below the noise`| otherwise: the gradients do not determine the value to tau |

A `settled` parameter becomes `still moving` if the parameter that compensates for it is `still moving`, because both
move together.

If the derivative of a parameter lacks a significant share, or if this share is unknown, its verdict is `derivative
incomplete`. A run measures the missing share before its first iteration (`measure/missing.py`).

If the model does not fit the targets (`fit.py`), spreads include the offset that the misfit may have caused. A
`settled` parameter that a larger misfit would unsettle gets the verdict `MISFIT`.

A small parameter is `settled` if at least `SETTLED_SHARE` of its entries with an effect are settled. The entries of a
large parameter are judged in groups. If the limit of their root mean square is at most tau, all of them are settled.
Otherwise, the parameter gets the most frequent verdict of the unsettled visible entries with an effect.
"""

from __future__ import annotations

import enum
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reslrb_cli.optimization.uncertainty.coupling import Maps, texel_offsets
from reslrb_cli.optimization.uncertainty.curvature import EntryCurvature, ParameterDirection
from reslrb_cli.optimization.uncertainty.fit import FitRecord
from reslrb_cli.optimization.uncertainty.posterior import (
    CURVATURE_ERROR,
    SURE,
    TOLERANCE,
    Measured,
    Posterior,
    joint,
    pooled,
    spread_of,
)
from reslrb_cli.records.decisions import Jsonable
from reslrb_cli.records.measurements import INCOMPLETE, MISFIT
from reslrb_cli.statistics import Array, rms

#: Remaining share of a value's spread, given the others, below which they compensate for it.
OTHERS = 0.5
#: Minimum share of settled entries among those with an effect.
SETTLED_SHARE = 0.8
#: Minimum correlation of the offsets of two entries that compensate for each other.
LEAST_CORRELATION = 0.5
#: Entries are on their way if the cosine between their movement so far and the remaining distance exceeds this.
ON_THE_WAY = 0.3
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
    MISFIT = MISFIT
    SETTLED = "settled"


#: Verdicts on entries without an effect on the images at their final values.
WITHOUT = (ParameterVerdict.NO_EFFECT, ParameterVerdict.EFFECT_LOST, ParameterVerdict.NOT_SEEN)


@dataclass(frozen=True)
class Estimate:
    """Estimates for the N entries of a parameter, each (N,): the limits of their distances from the optimum, the
    spreads, the spreads given all other parameters, and the entries that gradients pull.
    """

    limit: Array
    limit_of_run: Array
    spread: Array
    alone: Array
    is_pulled: Array


def judge(own: Measured, found: Estimate, tolerance: Array) -> list[ParameterVerdict]:
    """Return the verdict on each entry of a parameter. `tolerance` (N,) is in the parameter's unit."""
    lost = own.moved & (not own.touched.any())
    rules = [
        (~own.touched & ~(own.at_bound & own.moved) & ~lost, ParameterVerdict.NO_EFFECT),
        (own.at_bound, ParameterVerdict.AT_BOUND),
        (lost, ParameterVerdict.EFFECT_LOST),
        (found.limit <= tolerance, ParameterVerdict.SETTLED),
        (found.is_pulled & (found.limit_of_run > tolerance), ParameterVerdict.STILL_MOVING),
        (found.alone <= OTHERS * found.spread, ParameterVerdict.NOT_DETERMINED),
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
    run's iterations. `iterations`, `learning_rate` and `target_spp` repeat the run's settings.
    `learning_rate` is that of `optimizer`. `target_noise` is `measured` if all targets were rendered, `in part` if some
    were, otherwise `left out`. The spreads include only the noise of rendered targets. `is_biased` is true if noise of
    the images biases the gradients of the loss. The spreads, and the parts `of_target`, then include the bias. `fit`
    states whether the model fits the targets.
    """

    parameters: dict[str, ParameterCertainty]
    measure_s: float
    share: float
    iterations: int
    learning_rate: float
    target_noise: str
    target_spp: int | None = None
    is_biased: bool = False
    fit: FitRecord | None = None

    def without_derivatives(self, keys: Collection[str]) -> CertaintyRecord:
        """Return the record with the verdict `derivative incomplete` for the parameters `keys`."""
        verdict = ParameterVerdict.INCOMPLETE.value
        judged = {key: replace(about, verdict=verdict, shares={verdict: 1.0}, partner=None) if key in keys else about
                  for key, about in self.parameters.items()}  # fmt: skip
        return replace(self, parameters=judged)


@dataclass
class Judged:
    """Joint estimate of all free directions. `places` has the row of each free direction, by its place. `partners`
    names the parameter that compensates for each direction.
    """

    posterior: Posterior | None
    places: dict[int, int]
    partners: list[str | None]


def judge_together(
    measured: Mapping[str, Measured],
    directions: Sequence[ParameterDirection],
    curvature: Array,
    fixed: Array,
    own: Array | None = None,
) -> Judged:
    """Judge all directions in one joint posterior. `curvature` is H (M, M), and `fixed` is the target noise B (M, M).
    `own` (M,) is the curvature along each direction if no texture follows.

    Entries at their bounds, or without effect, count as known.
    """
    at = [place for place, direction in enumerate(directions) if _is_free(measured[direction.key], direction)]
    partners: list[str | None] = [None] * len(directions)
    if not at:
        return Judged(None, {}, partners)
    chosen = [directions[place] for place in at]
    count = min(_recorded(measured, each) for each in chosen)
    series = [_series(measured, each, count) for each in chosen]
    gradients, offsets = (np.array(part).T for part in zip(*series, strict=True))
    scale = np.array([1.0 if each.entry is None else measured[each.key].prior for each in chosen])
    free = np.ix_(at, at)
    posterior = joint(gradients, offsets, scale, curvature[free], fixed[free], None if own is None else own[at])
    correlation = np.abs(posterior.covariance) / np.maximum(np.outer(posterior.error, posterior.error), 1e-300)
    for row, place in zip(correlation, at, strict=True):
        partners[place] = _partner(row, place, at, directions) or directions[place].partner
    return Judged(posterior, {place: row for row, place in enumerate(at)}, partners)


def _is_free(own: Measured, direction: ParameterDirection) -> bool:
    held = direction.entry is not None and bool(own.at_bound[direction.entry])
    return not held and bool(np.any(own.gradients @ direction.vector))


def _recorded(measured: Mapping[str, Measured], direction: ParameterDirection) -> int:
    """Return the number of iterations with recorded gradients along a direction."""
    rows = [measured[direction.key].last, *(measured[key].rows for key in direction.followers)]
    return min(0 if row is None else len(row) for row in rows)


def _series(measured: Mapping[str, Measured], direction: ParameterDirection, count: int) -> tuple[Array, Array]:
    """Return the gradients along a direction, and the distances of their values from the final values. Both have the
    last `count` iterations, and then the gradients at the final values.
    """
    own = measured[direction.key]
    along = own.gradients @ direction.vector
    for key, d in direction.followers.items():
        along = along + measured[key].gradients @ d
    if not count or own.last is None:
        return along, np.zeros(len(along))
    column = direction.entry if direction.entry is not None else direction.channel or 0
    gradients, values = own.last[-count:, 0, column], own.last[-count:, 1, column]
    for key, d in direction.followers.items():
        if (rows := measured[key].rows) is not None:
            gradients = gradients + rows[-count:, 0] @ d
    size = np.linalg.norm(direction.vector) if direction.entry is None else None
    final = own.value[column] if size is None else np.log(size)
    return np.concatenate([gradients, along]), np.concatenate([values - final, np.zeros(len(along))])


def _partner(row: Array, place: int, chosen: Sequence[int], directions: Sequence[ParameterDirection]) -> str | None:
    """Return the parameter whose offset has the highest correlation with the offset at `place`. Return None if no other
    offset has a sufficient correlation.
    """
    others = {other: value for other, value in zip(chosen, row, strict=True) if other != place}
    likely = {other: value for other, value in others.items() if value >= LEAST_CORRELATION}
    foreign = {other: value for other, value in likely.items() if directions[other].key != directions[place].key}
    pool = foreign or likely
    return directions[max(pool, key=lambda other: pool[other])].key if pool else None


def weigh(
    measured: Mapping[str, Measured],
    directions: Sequence[ParameterDirection],
    curvature: Array,
    fixed: Array,
    by_entry: Mapping[str, EntryCurvature],
    own_curvature: Array | None = None,
    maps: Sequence[Maps] = (),
) -> dict[str, ParameterCertainty]:
    """Return the certainty of each parameter, from the curvature along directions and, for large parameters, the
    curvature of each entry.

    `fixed` is the target noise B (M, M), in the same directions as `curvature`. `own_curvature` (M,) is the curvature
    along the directions if no texture follows. `maps` are textures of the same shape.
    """
    found, result = judge_together(measured, directions, curvature, fixed, own_curvature), {}
    groups = {key: _groups(own, by_entry[key]) for key, own in measured.items() if key in by_entry}
    others = _left_by_others(measured, directions, by_entry, found, maps)
    for key, own in measured.items():
        at = [place for place, direction in enumerate(directions) if direction.key == key]
        if at and directions[at[0]].entry is not None:
            result[key] = _small(own, at, found)
        else:
            result[key] = _large(own, groups.get(key, []), at, found, *others.get(key, (None, None)))
    moving = {key for key, about in result.items() if about.verdict == ParameterVerdict.STILL_MOVING.value}
    for place, direction in enumerate(directions):
        about = result[direction.key]
        if about.verdict == ParameterVerdict.SETTLED.value and found.partners[place] in moving - {direction.key}:
            result[direction.key] = replace(about, verdict=ParameterVerdict.STILL_MOVING.value)
    return result


def with_misfit(
    found: Mapping[str, ParameterCertainty],
    wider: Mapping[str, ParameterCertainty],
    widest: Mapping[str, ParameterCertainty],
) -> dict[str, ParameterCertainty]:
    """Return the certainty with the spreads of `wider`, which include the misfit of the model. Settled parameters that
    are not settled in `widest` get the verdict `MISFIT`.
    """
    settled, misfit, result = ParameterVerdict.SETTLED.value, ParameterVerdict.MISFIT.value, {}
    for key, about in found.items():
        about = replace(about, spread=wider[key].spread)
        if about.verdict == settled and widest[key].verdict != settled:
            shares = {misfit if name == settled else name: share for name, share in about.shares.items()}
            about = replace(about, verdict=misfit, shares=shares)
        result[key] = about
    return result


def _left_by_others(
    measured: Mapping[str, Measured],
    directions: Sequence[ParameterDirection],
    by_entry: Mapping[str, EntryCurvature],
    found: Judged,
    maps: Sequence[Maps],
) -> dict[str, tuple[Array, str | None]]:
    """Return for each texture the mean square offset (N,) that images do not determine, because other parameters
    compensate for it. Also return the parameter that compensates for most of it.
    """
    result: dict[str, tuple[Array, str | None]] = {}
    for each in maps:
        keys = {key for key, _ in each.names}
        known = keys & set(by_entry)
        noise = dict.fromkeys(keys, 0.0) | {key: by_entry[key].mean_of_target(_free(measured[key])) for key in known}
        left = each.undetermined(measured, noise)
        result |= {key: (left[key], each.partner(key)) for key in keys}
    if found.posterior is not None:
        spreads = [found.posterior.spread[found.places[place]] if place in found.places else 0.0
                   for place in range(len(directions))]  # fmt: skip
        for key, (squares, source) in texel_offsets(directions, spreads).items():
            by_map, partner = result.get(key, (np.zeros_like(squares), source))
            result[key] = by_map + squares, source if squares.sum() > by_map.sum() else partner
    return result


def _small(own: Measured, at: Sequence[int], found: Judged) -> ParameterCertainty:
    partners = [found.partners[place] for place in at]

    def of(name: str, otherwise: float) -> Array:
        """Return a field of the posterior for each entry. Entries that are not free have the value `otherwise`."""
        return np.array([
            getattr(found.posterior, name)[found.places[place]] if place in found.places else otherwise for place in at
        ])  # fmt: skip

    to_go, of_target = own.within(of("to_go", 0.0)), of("of_target", 0.0)
    spread = spread_of(to_go, of("error", own.prior), of_target)  # bounds may have shortened the distance
    alone = np.where([partner is None for partner in partners], np.inf, of("alone", np.inf))
    estimate = Estimate(of("limit", np.inf), of("limit_of_run", np.inf), spread, alone, of("is_pulled", 0.0) > 0)
    verdicts = judge(own, estimate, own.tolerance(own.value))
    if own.seen is not None:
        verdicts = [v if seen else ParameterVerdict.NOT_SEEN for v, seen in zip(verdicts, own.seen, strict=True)]
    known = [each not in (ParameterVerdict.AT_BOUND, *WITHOUT) for each in verdicts]
    is_tiny = own.is_map and any(known)
    if is_tiny and _limit_of_all(own, at, found, np.array(known)) <= own.tolerance(rms(own.value[known])):
        verdicts = [ParameterVerdict.SETTLED if each else v for each, v in zip(known, verdicts, strict=True)]
    verdict = summarise(shares(verdicts))
    named = [name for name, each in zip(partners, verdicts, strict=True) if name and each is verdict]
    partner = named[0] if named and verdict is ParameterVerdict.NOT_DETERMINED else None
    # A value at a bound may be as far from the optimum as the optimum is beyond the bound.
    parts = [np.where(known, part, np.nan) for part in (spread, to_go, of_target)]
    if is_tiny:
        parts = [np.array([rms(part[known])]) for part in parts]
    return _certainty(verdict, verdicts, partner, *parts)


def _limit_of_all(own: Measured, at: Sequence[int], found: Judged, known: Array) -> float:
    """Return the limit of the root mean square offset of the `known` entries of a small texture. Offsets that are
    correlated do not average out.
    """
    assert found.posterior is not None
    rows = [found.places[place] for place, each in zip(at, known, strict=True) if each and place in found.places]
    if len(rows) < known.sum():
        return np.inf
    posterior = found.posterior
    squares = posterior.spread[rows] ** 2 + (CURVATURE_ERROR * posterior.pulled[rows]) ** 2
    both = posterior.covariance[np.ix_(rows, rows)] + np.diag(posterior.of_target[rows] ** 2)
    return float(np.sqrt(squares.mean() + SURE * np.sqrt(2 * np.sum(both**2)) / len(rows)))


def _large(
    own: Measured, rows: Sequence[Group], at: Sequence[int], found: Judged, left: Array | None, other: str | None
) -> ParameterCertainty:
    """Judge the entries of a large parameter in groups. Another parameter may still compensate for the offset of the
    whole parameter. The mean square offset `left` (N,) of single entries is undetermined, because the parameter `other`
    compensates for it.
    """
    shape, kept = own.value.shape, _free(own)
    limit, limit_of_run, known = np.full((3, *shape), np.inf)
    spread, pulled = np.zeros(shape), np.zeros(shape, dtype=bool)
    if left is not None:
        rows = [replace(each, unknown=each.unknown + max(float(left[each.entries].mean()), 0.0)) for each in rows]
    for each in rows:
        group = each.entries
        limit[group], limit_of_run[group], pulled[group] = each.limit, each.limit_of_run, each.is_pulled
        spread[group], known[group] = each.spread, each.known
    tolerance = np.full(shape, own.tolerance(rms(own.value[kept]) if kept.any() else 0.0))
    estimate = Estimate(limit, limit_of_run, spread, known, pulled)
    verdicts = judge(own, estimate, tolerance)
    total = Group.together(rows)
    if total is not None and total.limit <= tolerance[0]:
        verdicts = [ParameterVerdict.SETTLED if free else v for free, v in zip(kept, verdicts, strict=True)]
    if own.seen is not None:
        verdicts = [v if seen else ParameterVerdict.NOT_SEEN for v, seen in zip(verdicts, own.seen, strict=True)]
    verdict = summarise(shares(verdicts))
    partner = other if verdict is ParameterVerdict.NOT_DETERMINED else None
    for place in at if verdict in (ParameterVerdict.SETTLED, ParameterVerdict.BELOW_NOISE) else ():
        name, row = found.partners[place], found.places.get(place)
        if name is not None and row is not None and found.posterior is not None:
            alone, whole = found.posterior.alone[row], found.posterior.spread[row]
            if alone <= OTHERS * whole and whole > TOLERANCE:
                verdict, partner = ParameterVerdict.NOT_DETERMINED, name
    if total is None:
        return _certainty(verdict, verdicts, partner, *np.full((3, 1), np.nan))
    sizes = (min(total.spread, own.prior), max(total.square, 0.0) ** 0.5, total.of_target**0.5)
    return _certainty(verdict, verdicts, partner, *(np.array([size]) for size in sizes))


@dataclass(frozen=True)
class Group:
    """Estimate for a group of entries with the indices `entries`: the mean square of their offsets, its standard error,
    and the mean square of the part that comes from the target. `unknown` is the mean square of the part that images do
    not determine. `is_pulled` is true if the entries are on their way. `noise` is the mean square of the error of the
    mean offsets, if they were measured by gradients that have moved the values.
    """

    entries: Array
    square: float
    error: float
    of_target: float
    unknown: float
    is_pulled: bool = False
    noise: float = 0.0

    @property
    def known(self) -> float:
        """Root mean square of the offsets without the part that images do not determine. A standard error is added,
        because the estimate may be negative.
        """
        return float(np.sqrt(max(self.square, 0.0) + self.error + self.noise + self.of_target))

    @property
    def spread(self) -> float:
        """Root mean square of the offsets."""
        return float(np.sqrt(self.known**2 + self.unknown))

    @property
    def limit(self) -> float:
        """Limit of the root mean square of the offsets, for a target without noise."""
        left = (1 + CURVATURE_ERROR) ** 2 * max(self.square, 0.0)
        return float(np.sqrt(left + SURE * (self.error + self.noise) + self.of_target + self.unknown))

    @property
    def limit_of_run(self) -> float:
        """Like `limit`, but for the optimum of the noisy target."""
        return replace(self, of_target=0.0).limit

    @staticmethod
    def together(groups: Sequence[Group]) -> Group | None:
        """Return the estimate for all entries of some groups, or None without groups."""
        if not groups:
            return None
        counts = np.array([each.entries.size for each in groups])
        rows = np.array([(each.square, each.of_target, each.unknown, each.noise, each.error) for each in groups])
        square, of_target, unknown, noise, _ = counts @ rows / counts.sum()
        error = float(np.linalg.norm(counts * rows[:, -1]) / counts.sum())
        entries = np.concatenate([each.entries for each in groups])
        return Group(entries, float(square), error, float(of_target), float(unknown), noise=float(noise))


def _free(own: Measured) -> Array:
    """Return the visible entries (N,) that may move."""
    return own.is_free if own.seen is None else own.is_free & own.seen


def _groups(own: Measured, by_entry: EntryCurvature) -> list[Group]:
    """Estimate the offsets of the free entries of a large parameter in groups. They are as large as at the start if
    noise hides the curvature, or if the noise of the gradients exceeds this size.
    """
    if not (groups := own.groups_of_curvature(_free(own), by_entry.diagonal)):
        return []
    inside = np.isin(np.arange(own.value.size), np.concatenate(groups))
    gradients, moved = own.in_blocks
    offsets, h, unknown = by_entry.solve(np.where(inside, gradients, 0.0), groups)
    offsets = offsets - moved
    found = []
    for group in groups:
        if h[group[0]] <= 0:
            found.append(Group(group, 0.0, 0.0, 0.0, own.prior**2))
            continue
        square, error = pooled(offsets[:, group])
        way, left = (own.value - own.start)[group], offsets[:, group].mean(axis=0)
        cosine = -way @ left / max(float(np.linalg.norm(way) * np.linalg.norm(left)), 1e-300)
        of_target = by_entry.mean_of_target(group) / h[group[0]] ** 2
        # Both halves of the mean have twice its variance, and a drift counts as a whole.
        halves = [half.mean(axis=0) for half in np.array_split(offsets[:, group], 2)]
        noise = 0.0 if own.rows is None else float(np.mean((halves[0] - halves[1]) ** 2)) / 4
        is_pulled = bool(square > SURE * error and cosine > ON_THE_WAY)
        each = Group(group, square, error, of_target, unknown * own.prior**2, is_pulled, noise)
        found.append(each if each.spread <= own.prior else Group(group, 0.0, 0.0, 0.0, own.prior**2))
    return found


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
