"""`reslrb convergence --runs N --json FILE`: one object a line: whole optimisations against run time, and methods."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from reslrb_cli.records.bench import BenchStatus
from reslrb_cli.records.convergence import Method, Range
from reslrb_cli.records.metrics import finite


@dataclass(frozen=True)
class Band:
    """The median of several runs, and the least and the greatest of them."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Band | None:
        """The band of some values; None where there are none."""
        return cls(statistics.median(values), min(values), max(values)) if values else None


@dataclass(frozen=True)
class RunPointRecord:
    """Where one run stands after `elapsed_s` seconds, all its costs counted: `iteration` of them are done by then.

    `loss` is that of an image which all methods share the samples of. `parameter_error` is the root mean square error
    over all parameters whose true value is known, or, where these have no common unit, the root mean square of their
    relative errors; None where no true value is known. What is not finite becomes null in JSON.
    """

    method: Method
    seed: int
    elapsed_s: float
    iteration: int
    loss: float
    parameter_error: float | None

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return _line("run_point", self)


@dataclass(frozen=True)
class RunMethodRecord:
    """What the runs of one method came to after `elapsed_s` seconds each.

    `runs` is the number of those that came so far, which the bands are over; `status` is not ok where one of them ended
    before, as `message` says. `first_s` are the seconds until the first iteration was done: loading, pilot, compiling.
    What was not measured is None.
    """

    method: Method
    status: BenchStatus
    runs: int
    elapsed_s: float
    iterations: Band | None = None
    first_s: Band | None = None
    loss: Band | None = None
    parameter_error: Band | None = None
    message: str = ""

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return _line("run_method", self)


@dataclass(frozen=True)
class RunBestRecord:
    """A method at the best of its learning rates, and over the method that was named first.

    `of` is what is compared at the end of the runs, `loss` or `parameter_error`; `value` is that of the best rate,
    `at`, which is None where there is one alone; at the `outermost` of those that were tried a better one may lie
    beyond. `ratio` is the median over that of the method `to` at its own best; None where that is not known. `line`
    is the record in words.
    """

    label: str
    of: str
    at: str | None
    outermost: bool
    runs: int
    value: Band
    ratio: Range | None
    to: str | None
    line: str = ""

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return json.dumps({"kind": "run_best"} | finite(asdict(self)), allow_nan=False)


def _line(kind: str, record: RunPointRecord | RunMethodRecord) -> str:
    """One line: the method's fields beside the others; figures that are not finite become null."""
    values = asdict(record)
    method = values.pop("method")
    return json.dumps({"kind": kind} | method | finite(values), allow_nan=False)
