"""What a pilot tries, measures, may spend and finds; the statistics of gradients that it judges by."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

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
