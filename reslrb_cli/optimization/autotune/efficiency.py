"""The efficiency of ways of sampling a gradient: two compared, and what a pilot tries, may spend and finds.

How much more efficient one way is than another, by steps of both, and how sure that is (`compare`):

    gain = (variance * time of the one) / (variance * time of the other)

Variance is summed over the parameters, each over its gradient's mean square. The interval is that of the logarithm of
the variances' quotient by the jackknife over the steps, and of times by what a single one may be off.

The rest is what a pilot tries (`Candidate`), measures (`Measured`), may spend (`Allowance`) and finds (`Outcome`), and
the statistics of gradients that it judges by.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


CONFIDENCE = 0.95


#: What is left of a sum where nothing should be, as a share of it.
ROUNDING = 1e-12


#: A gain and the ends of its interval; nothing where it cannot be told.
Gain = tuple[float, float, float] | tuple[None, None, None]


def compare(
    own: Sequence[Gradients],
    own_ms: Sequence[float],
    other: Sequence[Gradients],
    other_ms: Sequence[float],
    confidence: float = CONFIDENCE,
) -> Gain:
    """The efficiency of the other over that of the own, and its interval; nothing where one has no noise.

    Gradients are those of each step by parameter (three steps or more), times those of steps in any unit.
    """
    scales = {key: float(np.mean([square(g[key]) for g in (*own, *other)])) for key in own[0]}
    scales = {key: scale for key, scale in scales.items() if scale > 0}
    if not scales:  # of no light, say
        return None, None, None
    logs, variance = [], 0.0
    for gradients in (own, other):
        values = _log_variances(gradients, scales)
        if values is None:
            return None, None, None
        whole, without = values
        logs.append(whole)
        count = len(gradients)
        variance += (count - 1) / count * float(np.sum(np.square(without - without.mean())))
    from scipy.special import stdtrit  # late: every run imports this module, and few come here

    times = statistics.median(own_ms) / max(statistics.median(other_ms), 1e-6)
    advantage = math.exp(logs[0] - logs[1]) * times
    quantile = float(stdtrit(min(len(own), len(other)) - 1, (1 + confidence) / 2))
    half = quantile * math.sqrt(variance)
    factor = math.exp(min(half, 50.0)) * TIMING_NOISE
    return advantage, advantage / factor, advantage * factor


def _log_variances(gradients: Sequence[Gradients], scales: dict[str, float]) -> tuple[float, Array] | None:
    """The logarithm of the variance of all parameters, and that without each of the rounds in turn."""
    rows = np.array([
        np.concatenate([g[key].astype(np.float64) / math.sqrt(scale) for key, scale in scales.items()])
        for g in gradients
    ])  # fmt: skip
    count = len(rows)
    squares = np.square(rows - rows.mean(axis=0)).sum(axis=1) if rows.size else np.zeros(count)
    whole = float(squares.sum())
    # What a row takes with it is its own distance, and that of the mean of the others from that of all.
    without = whole - squares * count / (count - 1)
    if not without.min() > ROUNDING * whole:
        return None
    return math.log(whole / (count - 1)), np.log(without / (count - 2))


#: Iterations of the run that a pilot's cost is a share of.
ITERATIONS = 200


Gradients = dict[str, "np.ndarray[Any, Any]"]


@dataclass(frozen=True)
class Candidate:
    """An estimator and its options. `exact`: it uses every connection. `passes` are those of a step in the pilot; other
    passes are other paths. `parent`: the label of a candidate than which it is no faster; where it is the same
    estimator with more slots for connections, `varies_slots`."""

    options: dict[str, Any]
    exact: bool
    passes: int = 1
    parent: str | None = None
    varies_slots: bool = False

    @property
    def label(self) -> str:
        """The estimator in words."""
        name, *rest = (str(value) if key == "estimator" else f"{key} {value}" for key, value in self.options.items())
        return ", ".join([name, *rest])


@dataclass
class Measured:
    """One step: the gradients by parameter, and its times; `wall_ms` is all that the caller waits but for `compile_ms`,
    in which kernels were generated and compiled."""

    gradients: Gradients
    kernel_ms: float
    wall_ms: float
    compile_ms: float = 0.0


@dataclass
class Allowance:
    """Seconds that all measuring before the first iteration may take: a share of what the run itself will.

    `run_s` is that: kernels compiled (`compile_s`, what those of one step took), and iterations of `iteration_s` each,
    by two first steps of few samples. `spent_s` grows; these first steps, which the run would take as well, are no
    part of it.
    """

    share: float
    run_s: float
    compile_s: float
    iteration_s: float
    spent_s: float = 0.0

    @property
    def left_s(self) -> float:
        """What has not been spent."""
        return max(self.share * self.run_s - self.spent_s, 0.0)

    def affords(self, *needs: tuple[float, float]) -> bool:
        """Whether there is time for all of these: kernels of so many steps to compile, and so many iterations' worth
        of work."""
        return sum(k * self.compile_s + n * self.iteration_s for k, n in needs) <= self.left_s

    def iterations_left(self, kernels: float) -> float:
        """The iterations' worth of work that there is time for, once the kernels of so many steps are compiled."""
        return max(self.left_s - kernels * self.compile_s, 0.0) / max(self.iteration_s, 1e-9)

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Count the block's time."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.spent_s += time.perf_counter() - start

    def note(self) -> str:
        """The words for what there was no time to measure."""
        return f"not measured, which would take more than {100 * self.share:.3g} % of this run"

    def line(self) -> str:
        """The words for what was spent."""
        part = 100 * self.spent_s / max(self.run_s, 1e-9)
        return f"measuring took {self.spent_s:.1f} s, {part:.2g} % of what this run is expected to take"


@dataclass
class Row:
    """One line of the pilot's table. `rounds` is 0 where `note` says why a candidate was not measured."""

    estimator: str
    options: dict[str, Any]
    rounds: int
    kernel_ms: float | None = None
    variance: float | None = None
    efficiency: float | None = None
    note: str = ""


@dataclass
class Outcome:
    """What a pilot found: `chosen` are the options of its best candidate, `advantage` its efficiency over the next's.

    `share` is what the measurement cost of 200 iterations of that candidate; `compile_s` are the first steps. Where
    nothing was measured `rows` is empty, and `note` says why.
    """

    chosen: dict[str, Any]
    label: str
    rows: list[Row]
    spp: int = 0
    advantage: float | None = None
    next_label: str | None = None
    measure_s: float = 0.0
    compile_s: float = 0.0
    share: float = 0.0
    cached: bool = False
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return asdict(self)

    @staticmethod
    def from_json(data: dict[str, Any]) -> Outcome:
        """The same again. Raises TypeError or KeyError where `data` is nothing that `to_json` made."""
        return Outcome(**{**data, "rows": [Row(**row) for row in data["rows"]]})

    def line(self) -> str:
        """What the user is told."""
        over = ""
        if not self.rows:
            return f"estimator {self.label}: {self.note}"
        if self.advantage is not None:
            over = f", {self.advantage:.2f} times as efficient as the next, {self.next_label}"
        cost = f"measured in {self.measure_s:.1f} s and {self.compile_s:.1f} s of first steps"
        return f"estimator {self.label}{over} ({'as an earlier run measured' if self.cached else cost})"


def square(values: np.ndarray[Any, Any]) -> float:
    """Sum of the squares of all entries, in double precision."""
    return float(np.sum(np.square(values, dtype=np.float64)))


def sample_variance(values: list[np.ndarray[Any, Any]]) -> float:
    """Sum over the entries; the mean square where there is one sample only."""
    if len(values) < 2:
        return square(values[0])
    return float(np.sum(np.var(np.array(values, dtype=np.float64), axis=0, ddof=1)))


#: Relative error of a single time that must not decide anything.
TIMING_NOISE = 1.1
