"""What whole runs come to: a record of each method, and which of them is the best, by a test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from reslrb_cli.measure.whole_runs.run import Run
from reslrb_cli.records.bench import BenchStatus
from reslrb_cli.records.convergence import Method
from reslrb_cli.records.whole_runs import Band, RunMethodRecord

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


def find_best(values: dict[str, list[float]]) -> Verdict | None:
    """Which method has the lowest median, and who is tied with it; None where there is nothing to compare.

    Those are tied with it whose values the Mann-Whitney test does not tell from its own: two-sided, exact for few
    values of which no two are equal, at ALPHA over the number of the others.
    """
    if not values:
        return None
    order = sorted(values, key=lambda label: float(np.median(values[label])))
    best, others = order[0], order[1:]
    level = ALPHA / max(len(others), 1)
    apart = [label for label in others if stats.mannwhitneyu(values[best], values[label]).pvalue < level]
    enough = next(count for count in range(2, 1000) if _least_p(count, count) < level)
    can_tell = any(_least_p(len(values[best]), len(values[label])) < level for label in others)
    tied = [label for label in others if label not in apart]
    return Verdict(best, tied, apart, bool(others) and not can_tell, enough)


def _least_p(one: int, other: int) -> float:
    """The least probability that the test can find between so many values and so many others."""
    return 2.0 / math.comb(one + other, one)
