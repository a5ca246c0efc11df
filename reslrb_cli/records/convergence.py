"""`reslrb convergence --json FILE`: one object a line: measured points, methods, and the references of their errors."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field

from reslrb_cli.records.bench import BenchStatus
from reslrb_cli.records.metrics import finite

#: Relative errors whose time is told.
TARGETS = (0.1, 0.03, 0.01)


@dataclass(frozen=True)
class Range:
    """An estimate and the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Method:
    """What was measured: an integrator, and how its steps take their samples.

    `estimator` is None where the integrator has none, `capacity` where the estimator has none; `adjoint` is
    `run.adjoint`, None where dL/dI is held or nothing is differentiated. `label` is how the user wrote it, `spp` are
    samples per pixel of a step.
    """

    label: str
    integrator: str
    estimator: str | None
    capacity: int | None
    adjoint: str | None
    spp: int


@dataclass(frozen=True)
class PointRecord:
    """The error of the average of `steps` steps, which take `elapsed_s` seconds.

    `parameter` is a parameter's key, `all` (of them together) or `image`. Errors are relative to the size of what is
    estimated, in L2 over all its entries. `relative_rmse` has the reference's own error, `reference_rmse`, subtracted,
    and is the root of the mean square over `repeats` such averages; None where it drowns in the reference's.
    """

    method: Method
    parameter: str
    steps: int
    elapsed_s: float
    relative_rmse: float | None
    reference_rmse: float | None
    repeats: int

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return _line("point", self)


@dataclass(frozen=True)
class MethodRecord:
    """What the points of one method and parameter come to; `repeats` is the number of steps.

    `relative_rmse` is that of one step, from their variance, which takes `step_s` seconds; `cold_s` is the first step
    in a new process, which compiles. `slope` is d log error / d log seconds. `efficiency` is 1 / (relative variance *
    seconds), of a `biased` method with squared bias + variance. `bias_z` is the largest deviation from
    `bias_reference`, in standard errors, `bias_z_limit` what it exceeds by chance with probability 1e-4 anywhere in the
    table; `bias` its relative size, where there is one; `biased` is None where the question is open, as `message`
    says. `independent` says whether that reference shares no code with what it judges. `seconds_to` has for each error
    (`0.1`, `0.03`, `0.01`) the time until averages are as good, None where a bias keeps them from it; those in
    `extrapolated` lie beyond the steps that were taken, or below the reference's error. What was not measured is None.
    """

    method: Method
    parameter: str
    status: BenchStatus
    repeats: int = 0
    step_s: float | None = None
    cold_s: float | None = None
    relative_rmse: float | None = None
    reference_rmse: float | None = None
    slope: Range | None = None
    efficiency: Range | None = None
    bias_z: float | None = None
    bias_z_limit: float | None = None
    bias: float | None = None
    bias_reference: str | None = None
    independent: bool = False
    biased: bool | None = None
    seconds_to: dict[str, float | None] = field(default_factory=lambda: {f"{target:g}": None for target in TARGETS})
    extrapolated: list[str] = field(default_factory=list)
    message: str = ""

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return _line("method", self)


@dataclass(frozen=True)
class ReferenceRecord:
    """What errors are taken from: the mean of `repeats` steps, with the relative standard error `reference_rmse`.

    `bias_z` is its own largest deviation from an independent reference, as of a `MethodRecord`; None where there is
    none.
    """

    method: Method
    parameter: str
    repeats: int
    reference_rmse: float | None
    bias_z: float | None = None
    bias_z_limit: float | None = None
    bias_reference: str | None = None
    biased: bool | None = None
    message: str = ""

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return _line("reference", self)


@dataclass(frozen=True)
class SummaryRecord:
    """Which method is the best, in words."""

    line: str

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return json.dumps({"kind": "summary", "line": self.line})


def _line(kind: str, record: PointRecord | MethodRecord | ReferenceRecord) -> str:
    """One line: the method's fields beside the others; figures that are not finite become null."""
    values = asdict(record)
    method = values.pop("method")
    return json.dumps({"kind": kind} | method | finite(values), allow_nan=False)
