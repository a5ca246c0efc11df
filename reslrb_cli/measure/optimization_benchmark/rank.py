"""The results of whole optimisations: each method at its best learning rate, and which is the best (`outcome`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from reslrb_cli.measure.processes import Contestant, Ended, Refused
from reslrb_cli.records.measurements import (
    Band,
    BenchStatus,
    Method,
    Range,
    RunBestRecord,
    RunMethodRecord,
    RunPointRecord,
)

#: Times at which runs are looked at.
POINTS = 16


@dataclass(kw_only=True)
class Run(Contestant):
    """A process under way, and where it stands: `state` is the newest that is known, `points` those at given times.

    `counted_s` is the time of its own that it has had, at least. Values go by way of `out`.
    """

    method: Method
    seed: int
    out: Path
    state: RunPointRecord
    counted_s: float = 0.0
    first_s: float | None = None
    points: list[RunPointRecord] = field(default_factory=list)

    def complete(self, limit_s: float) -> bool:
        """Whether it came to the end of its time."""
        return bool(self.points) and self.points[-1].elapsed_s == limit_s

    def kept(self) -> dict[str, Any]:
        """What a later session needs, as JSON has it."""
        refusal = self.refusal and {"line": str(self.refusal), "exit_code": int(self.refusal.exit_code)}
        points = [[p.elapsed_s, p.iteration, p.loss, p.parameter_error] for p in self.points]
        return {"label": self.method.label, "seed": self.seed, "first_s": self.first_s, "refusal": refusal,
                "points": points, "end": self.end and vars(self.end)}  # fmt: skip

    def restore(self, entry: Mapping[str, Any]) -> None:
        """Have what `kept` returned, and stand where its last point does."""
        self.points = [RunPointRecord(self.method, self.seed, *point) for point in entry["points"]]
        self.state = self.points[-1] if self.points else self.state
        self.first_s, self.end = entry["first_s"], entry["end"] and Ended(**entry["end"])
        self.refusal = entry["refusal"] and Refused(**entry["refusal"])


def times(limit_s: float) -> list[float]:
    """When runs are looked at, in seconds: closer together at their beginning, where losses fall fastest."""
    return [limit_s * (number / POINTS) ** 2 for number in range(1, POINTS + 1)]


#: Fewer seeds than these say nothing of how far a median of theirs may be off.
LEAST_SEEDS = 5

#: Times that seeds are drawn anew, and what they are drawn by: the same runs have the same interval.
RESAMPLES, RESAMPLED_BY = 4000, 15

#: What share of the resamples an interval holds.
CONFIDENCE = 0.95


def best_of(values: Mapping[str, Sequence[float]], rates: Mapping[str, str]) -> dict[str, str]:
    """By method the label, a key of `values`, of its rate of the lowest median; `rates` has each label's method."""
    best: dict[str, str] = {}
    for label in values:
        name = rates[label]
        if name not in best or np.median(values[label]) < np.median(values[best[name]]):
            best[name] = label
    return best


def ratio(own: Sequence[Sequence[float]], base: Sequence[Sequence[float]]) -> Range | None:
    """The median over the seeds at the best of one method's rates, over that of another, and its 95 % interval.

    One row of values a rate, one column a seed, the same seeds for all. The interval is the bootstrap's: seeds are
    drawn anew for all rates of both, and each time the best rates are chosen anew, so that the luck of the best of
    several is in it. None of fewer than LEAST_SEEDS, and where a median is not finite, or 0.
    """
    seeds = min((len(values) for values in (*own, *base)), default=0)
    if seeds < LEAST_SEEDS or not (own and base):
        return None
    drawn = np.random.default_rng(RESAMPLED_BY).integers(seeds, size=(RESAMPLES, seeds))
    sides = [np.array([values[:seeds] for values in side], dtype=np.float64) for side in (own, base)]
    found = [float(np.median(side, axis=1).min()) for side in sides]
    if not all(math.isfinite(value) and value > 0 for value in found):
        return None
    lowest = [np.median(side[:, drawn], axis=2).min(axis=0) for side in sides]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = lowest[0] / lowest[1]
    if np.isnan(ratios).any():
        return None
    low, high = np.quantile(ratios, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="nearest")
    return Range(found[0] / found[1], float(low), float(high))


#: The probability that among equal methods any is told apart from the best.
ALPHA = 0.05


@dataclass(frozen=True)
class Verdict:
    """The method of the lowest median, those `tied` with it, and those that it `beats`, by label, the lowest first.

    `too_few`: there are so few runs that the test could not have told any apart; `enough` runs of each could.
    """

    best: str
    tied: list[str]
    beats: list[str]
    too_few: bool
    enough: int


def method_records(runs: Sequence[Run], limit_s: float) -> list[RunMethodRecord]:
    """One record for each method: bands over the runs that came to the end of their time."""
    return [_record([run for run in runs if run.method == method], method, limit_s) for method in _methods(runs)]


def _record(runs: Sequence[Run], method: Method, limit_s: float) -> RunMethodRecord:
    done = [run for run in runs if run.complete(limit_s)]
    last = [run.points[-1] for run in done]
    ends = [(run, run.end) for run in runs if run.end is not None]
    errors = [point.parameter_error for point in last if point.parameter_error is not None]
    refused = next((str(run.refusal) for run in runs if run.refusal is not None), "")
    return RunMethodRecord(
        method=method,
        status=ends[0][1].status if ends else BenchStatus.FAILED if refused else BenchStatus.OK,
        runs=len(done),
        elapsed_s=limit_s,
        iterations=Band.of([point.iteration for point in last]),
        first_s=Band.of([run.first_s for run in done if run.first_s is not None]),
        loss=Band.of([point.loss for point in last]),
        parameter_error=Band.of(errors),
        message=f"{len(ends)} of {len(runs)} ended before their time: {ends[0][1].reason}" if ends else refused,
    )


def _methods(runs: Sequence[Run]) -> list[Method]:
    return list(dict.fromkeys(run.method for run in runs))


def finals(runs: Sequence[Run], limit_s: float, of: str) -> dict[str, list[float]]:
    """Losses, or errors, at the end of their time (`of` a record's field), by method; those with a run that ended
    before are left out: what is left of their runs are the lucky ones. Nothing where nobody came to an iteration."""
    found: dict[str, list[float]] = {}
    if not any(run.state.iteration for run in runs):
        return found
    for method in _methods(runs):
        own = [run for run in runs if run.method == method]
        values = [getattr(run.points[-1], of) for run in own if run.complete(limit_s)]
        if values and None not in values and not any(run.end or run.refusal for run in own):
            found[method.label] = [value if math.isfinite(value) else math.inf for value in values]
    return found


def find_best(values: Mapping[str, Sequence[float]], paired: bool = False) -> Verdict | None:
    """Which method has the lowest median, and who is tied with it; None where there is nothing to compare.

    Those are tied with it whose values the Mann-Whitney test does not tell from its own: two-sided, exact for few
    values of which no two are equal, at ALPHA over the number of the others. `paired`: values at the same place are of
    the same seed, and Wilcoxon's test of the signed ranks of their differences is taken, which are finite.
    """
    if not values:
        return None
    order = sorted(values, key=lambda label: float(np.median(values[label])))
    best, others = order[0], order[1:]
    level = ALPHA / max(len(others), 1)
    test, least_p = (_signed_ranks, _least_paired_p) if paired else (_ranks, _least_p)
    apart = [label for label in others if test(values[best], values[label]) < level]
    enough = next(count for count in range(2, 1000) if least_p(count, count) < level)
    can_tell = any(least_p(len(values[best]), len(values[label])) < level for label in others)
    tied = [label for label in others if label not in apart]
    return Verdict(best, tied, apart, bool(others) and not can_tell, enough)


def _ranks(one: Sequence[float], other: Sequence[float]) -> float:
    return float(stats.mannwhitneyu(one, other).pvalue)


def _signed_ranks(one: Sequence[float], other: Sequence[float]) -> float:
    """Two-sided, but where the pairs have the other one lower, whatever the medians: then 1."""
    differences = np.subtract(one, other, dtype=np.float64)
    if not differences.any():
        return 1.0
    return min(2.0 * float(stats.wilcoxon(differences, alternative="less").pvalue), 1.0)


def _least_p(one: int, other: int) -> float:
    """The least probability that the test can find between so many values and so many others."""
    return 2.0 / math.comb(one + other, one)


def _least_paired_p(one: int, other: int) -> float:
    """The same of so many pairs."""
    return 2.0 ** (1 - min(one, other))


@dataclass(frozen=True)
class Outcome:
    """`methods` have all rates apart; `bests`, and the verdicts on `loss` and `error`, each method at its best."""

    methods: list[RunMethodRecord]
    bests: list[RunBestRecord]
    loss: Verdict | None
    error: Verdict | None


def outcome(runs: Sequence[Run], limit_s: float, names: Mapping[str, str]) -> Outcome:
    """Of runs of so many seconds; `names` has the method's label by that of each of its rates."""
    bests, verdicts = [], []
    for of in ("loss", "parameter_error"):
        values = finals(runs, limit_s, of)
        # Of a seed that was broken off some have runs: medians over other seeds than the others' would be compared.
        seeds = min(map(len, values.values()), default=0)
        values = {label: found[:seeds] for label, found in values.items()}
        best = best_of(values, names)
        verdicts.append(find_best({name: values[label] for name, label in best.items()}))
        bests += _bests(of, values, best, names)
    return Outcome(method_records(runs, limit_s), bests, *verdicts)


def _bests(
    of: str, values: Mapping[str, Sequence[float]], best: Mapping[str, str], names: Mapping[str, str]
) -> list[RunBestRecord]:
    """Of each method, where there is more to say than its own record does."""
    rows = {name: [values[label] for label in values if names[label] == name] for name in best}
    base = next((name for name in names.values() if name in best), None)
    found = []
    for name, label in best.items():
        of_all = [each for each, method in names.items() if method == name]
        value = Band.of(values[label])
        apart = None if name == base or base is None else ratio(rows[name], rows[base])
        if value is not None and (len(of_all) > 1 or apart is not None):
            outermost = len(of_all) > 1 and label in (of_all[0], of_all[-1])
            at = label if len(of_all) > 1 else None
            to = None if apart is None else base
            found.append(RunBestRecord(name, of, at, outermost, len(values[label]), value, apart, to))
    return found
