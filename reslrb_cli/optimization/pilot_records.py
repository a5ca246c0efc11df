"""What a pilot tries, measures and finds; the statistics of gradients that it judges by."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

#: Iterations of the run that a pilot's cost is a share of.
ITERATIONS = 200

Gradients = dict[str, "np.ndarray[Any, Any]"]


@dataclass(frozen=True)
class Candidate:
    """An estimator and its options. `exact`: it uses every connection. `passes` are those of
    a step in the pilot; other passes are other paths. `parent`: the label of the candidate that it varies."""

    options: dict[str, Any]
    exact: bool
    passes: int = 1
    parent: str | None = None

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

    `share` is what the measurement cost of 200 iterations of that candidate; `compile_s` are the first steps.
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
        if self.advantage is not None:
            over = f", {self.advantage:.2f} times as efficient as the next, {self.next_label}"
        cost = f"measured in {self.measure_s:.1f} s, {100 * self.share:.1f} % of {ITERATIONS} iterations, and "
        cost += f"{self.compile_s:.1f} s of first steps"
        return f"estimator {self.label}{over} ({'as an earlier run measured' if self.cached else cost})"


def square(values: np.ndarray[Any, Any]) -> float:
    """Sum of the squares of all entries, in double precision."""
    return float(np.sum(np.square(values, dtype=np.float64)))


def sample_variance(values: list[np.ndarray[Any, Any]]) -> float:
    """Sum over the entries; the mean square where there is one sample only."""
    if len(values) < 2:
        return square(values[0])
    return float(np.sum(np.var(np.array(values, dtype=np.float64), axis=0, ddof=1)))
