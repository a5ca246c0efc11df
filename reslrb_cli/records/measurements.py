"""Records that the measuring commands write with `--json`, one object per line.

`record_of` turns a line back into a record.
"""

from __future__ import annotations

import enum
import functools
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

from reslrb_cli.records.metrics import Line, finite


class BenchStatus(str, enum.Enum):
    """Outcome of a case. Cases that refuse the scene have no records."""

    OK = "ok"
    OUT_OF_MEMORY = "out_of_memory"
    FAILED = "failed"
    REFUSED = "refused"


@dataclass(frozen=True)
class Spread:
    """Median, minimum and maximum of repeated measurements."""

    median: float
    min: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Return the spread of at least one value."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Method:
    """Measured method: an integrator and the sampling of its steps.

    `label` is the method as the user wrote it. `options` are all options of its integrator, with its `type`. `spp` are
    the samples per pixel of a step. `adjoint` is `run.adjoint`, or None if dL/dI is fixed or nothing is differentiated.
    """

    label: str
    options: Mapping[str, Any]
    spp: int
    max_depth: int | None = None
    adjoint: str | None = None


@dataclass(frozen=True)
class BenchRecord(Line):
    """Cost of a step of one method, for one film size and texture size.

    - `step_ms` is the wall time of warm steps. `kernel_ms` is the part for executing kernels. `codegen_ms` is the part
        for generating kernels, including the lookup in the kernel cache. `tracing_ms` is the remaining part, mostly
        Python.
    - `step_ratio` and `kernel_ratio` are the method's times divided by the baseline's times, round by round.
    - `cold_ms` is the wall time of the first step in a new process with an empty kernel cache.
    - `peak_mib` is the peak memory of the allocator in the first step, including the scene.
    - `scratch_bytes` is the thread-local memory of a path.
    - `texels` is the texel count of all textures that are parameters.

    Values that were not measured are None. If `status` is not `ok`, no value was measured, all measured values are
    None, and `message` gives the reason.
    """

    method: Method
    status: BenchStatus
    width: int | None
    height: int | None
    texels: int | None
    step_ms: Spread | None = None
    kernel_ms: Spread | None = None
    codegen_ms: Spread | None = None
    tracing_ms: Spread | None = None
    step_ratio: Spread | None = None
    kernel_ratio: Spread | None = None
    cold_ms: float | None = None
    peak_mib: float | None = None
    scratch_bytes: int | None = None
    repeats: int = 0
    message: str = ""


#: Relative errors for which the required time is reported.
TARGETS = (0.1, 0.03, 0.01)


@dataclass(frozen=True)
class Range:
    """Estimate with its 95 % interval."""

    value: float
    low: float
    high: float


#: Minimum number of averages for an error that counts. The logarithms of the errors of fewer averages are skewed.
FEWEST_AVERAGES = 4


@dataclass(frozen=True)
class PointRecord(Line):
    """Error of the average of `steps` steps, which take `elapsed_s` seconds.

    `parameter` is a parameter key, `all` (all parameters together, if there are several) or `image`. Errors are in L2
    over all entries, relative to the norm of the estimated quantity. `relative_rmse` is the root mean square error of
    `repeats` averages. The error of the reference, `reference_rmse`, is subtracted. If `reference_rmse` exceeds the
    measured error, `relative_rmse` is None. `low` and `high` are the ends of the 95 % interval of `relative_rmse`. They
    are None if `relative_rmse` is None, or if there are too few averages.
    """

    KIND: ClassVar[str] = "point"

    method: Method
    parameter: str
    steps: int
    elapsed_s: float
    relative_rmse: float | None
    reference_rmse: float | None
    repeats: int
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Bias:
    """Bias of a method for one parameter, or the worst bias of all parameters.

    `bias_z` is the largest deviation from `bias_reference` in standard errors, and `bias_z_limit` its limit. By chance,
    any value of a measurement exceeds its limit with probability 1e-4. `biased` is None if the bias is undecided.
    `message` then gives the reason. Without an independent reference, `bias_z` is None.
    """

    bias_z: float | None = None
    bias_z_limit: float | None = None
    bias_reference: str | None = None
    biased: bool | None = None
    message: str = ""


@dataclass(frozen=True, kw_only=True)
class MethodRecord(Bias, Line):
    """Summary of the points of one method and parameter.

    - `repeats` is the number of steps.
    - `relative_rmse` is the error of one step, computed from the variance of the steps. `step_s` is the number of
        seconds per step.
    - `cold_s` are the seconds of the first step in a new process, including compilation.
    - `efficiency` is 1 / ((relative variance + squared relative bias) * seconds). `efficiency_freedom` are the degrees
        of freedom of its interval.
    - `bias` is the relative bias, if there is one.
    - `seconds_to` has the time until averages reach each error (`0.1`, `0.03`, `0.01`). The time is None if a bias
        keeps averages above the error.
    - `extrapolated` lists the errors that need more steps than were measured, or that are below the reference's error.

    Values that were not measured are None.
    """

    KIND: ClassVar[str] = "method"

    method: Method
    parameter: str
    status: BenchStatus
    step_s: float | None = None
    repeats: int = 0
    cold_s: float | None = None
    relative_rmse: float | None = None
    reference_rmse: float | None = None
    efficiency: Range | None = None
    efficiency_freedom: float | None = None
    bias: float | None = None
    seconds_to: dict[str, float | None] = field(default_factory=lambda: {f"{target:g}": None for target in TARGETS})
    extrapolated: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class ReferenceRecord(Bias, Line):
    """Reference for the errors: the mean of `repeats` steps, with the relative standard error `reference_rmse`."""

    KIND: ClassVar[str] = "reference"

    method: Method
    parameter: str
    repeats: int
    reference_rmse: float | None


@dataclass(frozen=True)
class SummaryRecord(Line):
    """Sentence about the best method. `remark` is a warning if times of several sessions are compared."""

    KIND: ClassVar[str] = "summary"

    line: str
    remark: str = ""


class Reference(str, enum.Enum):
    """Reference for a gradient.

    `forward_mode` uses the dot product <w, J v> = <J^T w, v>. Earlier versions also
    have `unguided`, unguided steps of the same estimator.
    """

    PTRACER = "ptracer"
    WALK_AD = "walk_ad"
    PATH = "path"
    PRB = "prb"
    FINITE_DIFFERENCE = "finite_difference"
    ANALYTIC = "analytic"
    FORWARD_MODE = "forward_mode"
    UNGUIDED = "unguided"


class Kind(str, enum.Enum):
    """Kind of comparison.

    `equal_seeds` compares by relative L2. Both sides compute equal numbers except for rounding. `expectation` compares
    by z scores over many seeds. `image` compares images instead of gradients, by z scores.
    """

    EQUAL_SEEDS = "equal_seeds"
    EXPECTATION = "expectation"
    IMAGE = "image"


class Verdict(str, enum.Enum):
    """Result of a comparison. All values except `holds` and `fails` mean undecided. `message` then gives the reason.

    - `heavy_tailed`: single seeds dominate the variance, so z scores prove nothing.
    - `unresolved`: noise hides deviations as large as the gradient itself.
    - `unreached`: gradient and reference are exactly zero.
    - `no_reference`: no reference is available.
    - `not_measured`: the time ran out before the first samples.
    """

    HOLDS = "holds"
    FAILS = "fails"
    HEAVY_TAILED = "heavy_tailed"
    UNRESOLVED = "unresolved"
    UNREACHED = "unreached"
    NO_REFERENCE = "no_reference"
    NOT_MEASURED = "not_measured"


@dataclass(frozen=True)
class Compared:
    """Two sides of a comparison: an integrator's gradient for a parameter, and a reference.

    `case` is the configuration, or a case of a suite. `parameter` is None if all parameters together or the image are
    compared. `label` is the integrator as the user wrote it. `options` are the options of its paths, and empty for
    light paths. `seeds` is the number of gradients on each side.
    """

    case: str
    parameter: str | None
    label: str
    options: Mapping[str, Any]
    reference: Reference
    kind: Kind
    seeds: int


@dataclass(frozen=True)
class Comparison:
    """Outcome of a comparison of estimates with a reference.

    - `relative_l2` is the distance from the reference divided by the reference's norm. The distance compares samples at
        equal seeds, and means otherwise.
    - `z_rms` and `z_max` are in standard errors. Their limits are corrected for the number of comparisons.
    - `cosine` is the cosine of the angle between the means.
    - `variance_ratio` is the variance divided by the reference's variance.
    - `detectable` is the smallest detectable deviation, as a fraction of the reference.
    - `message` has remarks.

    Values that do not apply are None.
    """

    verdict: Verdict
    relative_l2: float | None = None
    relative_l2_limit: float | None = None
    z_rms: float | None = None
    z_rms_limit: float | None = None
    z_max: float | None = None
    z_max_limit: float | None = None
    cosine: float | None = None
    variance_ratio: float | None = None
    detectable: float | None = None
    message: str = ""

    @property
    def holds(self) -> bool | None:
        """Whether the comparison holds, or None if it is undecided."""
        return {Verdict.HOLDS: True, Verdict.FAILS: False}.get(self.verdict)


@dataclass(frozen=True)
class GradcheckRecord(Comparison, Compared, Line):
    """One comparison: its two sides and the outcome."""

    def to_json(self) -> str:
        """Return the record as one line of JSON. Numbers that are not finite become null."""
        return json.dumps(finite(asdict(self)) | {"holds": self.holds}, allow_nan=False)


@dataclass(frozen=True)
class Band:
    """Median, minimum and maximum of several runs."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Band | None:
        """Return the band of `values`, or None if there are no values."""
        return cls(statistics.median(values), min(values), max(values)) if values else None


#: Probability that a complete derivative of a parameter counts as incomplete, and the maximum number of looks at its
#: samples.
ALARM, LOOKS = 0.005, 4

#: Missing share that rounding in single precision can cause.
LEAST = 1e-4

#: Missing share that changes the direction of a run's steps, and one that may reverse it.
NOTICED, HALF = 0.05, 0.5

#: Standard error of the share that is small enough.
KNOWN = 0.03

#: Standard errors by which edges must reduce a share to stay on. The samples of both measurements have common seeds, so
#: that the true error is smaller.
REDUCED = 2

#: Verdict on a parameter with an incomplete derivative.
INCOMPLETE = "derivative incomplete"
#: Verdict on a value that is settled, unless the misfit of the model has moved it.
MISFIT = "settled, but the model does not explain the picture"


def student(seeds: int, directions: int) -> float:
    """Return how many standard errors make a mean over `seeds` samples significant (Student's t). The limit accounts
    for all looks and all directions (Bonferroni).
    """
    from reslrb_cli.statistics import special  # late, because it imports NumPy, and `--help` reads these records

    return float(special().stdtrit(seeds - 1, 1 - ALARM / (2 * LOOKS * directions)))


@dataclass(frozen=True)
class MissingRecord(Line):
    """Share of a parameter's derivative that the attached gradient lacks, relative to finite differences.

    `share` and `standard_error` are None if noise hides the derivative, or if nothing was measured (`seeds` is 0). The
    gradient was sampled along `directions`, with `seeds` independent samples.
    """

    case: str
    parameter: str
    share: float | None
    standard_error: float | None
    directions: int
    seeds: int
    kind: Literal["missing"] = "missing"

    @property
    def margin(self) -> float:
        """Half of the share's confidence interval. The probability that any look at the samples finds a complete
        derivative outside of the interval is at most `ALARM`.
        """
        if self.standard_error is None or self.seeds < 2:
            return math.inf
        return student(self.seeds, self.directions) * self.standard_error

    @property
    def is_unknown(self) -> bool:
        """True if there is no share, or if the share's interval includes both 0 and a value above one half."""
        return self.share is None or (self.share <= self.margin and self.share + self.margin > HALF)

    @property
    def is_incomplete(self) -> bool:
        """True if the missing share is unknown, or so large that the recovered values are unreliable."""
        return self.is_unknown or (self.share or 0) > max(self.margin, NOTICED)

    @property
    def is_for_the_most_part(self) -> bool:
        """True if the whole interval of the missing share is above one half."""
        return self.share is not None and self.share - self.margin > HALF

    @property
    def is_decided(self) -> bool:
        """True if more seeds would hardly change whether the derivative is incomplete, or for the most part missing."""
        if self.share is None or self.is_unknown:
            return False
        if self.is_incomplete:
            return self.is_for_the_most_part or self.share + self.margin <= HALF
        return (self.standard_error or 0) < KNOWN

    def is_reduced_to(self, other: MissingRecord | None) -> bool:
        """True if `other`, the record with edges, may lack less: its share is smaller, or one of the two is unknown."""
        if other is None or other.share is None or self.share is None or self.is_unknown or other.is_unknown:
            return True
        errors = (self.standard_error or 0, other.standard_error or 0)
        return self.share - other.share > REDUCED * math.hypot(*errors)

    def percent(self) -> str:
        """Return the share in words."""
        if self.share is None or self.standard_error is None:
            return "an unknown share"
        return f"{_percent(self.share)} +- {_percent(self.standard_error)}"

    def line(self) -> str:
        """Return the record as one line of text."""
        if not self.seeds:
            return (
                f"{self.parameter}: the derivative may lack silhouettes and shadow edges; the missing share was not "
                "measured (too few samples, or a derivative of the loss that is 0)"
            )
        if self.share is None or self.standard_error is None:
            return f"{self.parameter}: {self.seeds} seeds cannot distinguish the derivative from 0"
        figures = self.percent()
        if self.is_unknown:
            return (
                f"{self.parameter}: {self.seeds} seeds cannot determine the missing share of the derivative "
                f"({figures}; silhouettes, shadow edges, light that leaves the film)"
            )
        if self.share <= max(self.margin, LEAST):
            return f"{self.parameter}: {self.seeds} seeds detect no missing part of the derivative ({figures})"
        return (
            f"{self.parameter}: {figures} of the derivative is missing (silhouettes, shadow edges, light that leaves "
            "the film)"
        )


def _percent(share: float) -> str:
    return f"{share:.1%}" if share < 0.0995 else f"{share:.0%}"


R = TypeVar("R", bound=Line)


def record_of(kind: type[R], entry: Mapping[str, Any]) -> R | None:
    """Return the record of class `kind` in `entry`, which is a line read from a file. Return None if the line holds no
    such record. Keys that the class does not have are left out, because a later version may have written them.
    """
    if "label" not in entry:  # older versions have two fields
        parts = (entry.get("integrator"), entry.get("estimator"))
        entry = {**entry, "label": ":".join(filter(None, parts)), "options": {}}
    if "method" in kind.__annotations__:  # its fields are in the line itself
        entry = {**entry, "method": entry}
    try:
        found: R = _reader(kind).validate_python(entry)  # type: ignore[arg-type]  # types are hashable
    except ValidationError:
        return None
    return found


@functools.cache
def _reader(kind: type[Line]) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def incomplete_records(entries: Sequence[Mapping[str, Any]]) -> list[MissingRecord]:
    """Return the records of incomplete derivatives among the `entries` of a manifest."""
    found = (record_of(MissingRecord, entry) for entry in entries)
    return [record for record in found if record is not None and record.is_incomplete]
