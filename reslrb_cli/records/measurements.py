"""The records that measuring commands write with `--json`, one object a line.

Lines of `gradcheck` are read back as the records that they were, where they are whole.
"""

from __future__ import annotations

import enum
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

from reslrb_cli.records.metrics import Line, finite


class BenchStatus(str, enum.Enum):
    """How a case ended."""

    OK = "ok"
    OUT_OF_MEMORY = "out_of_memory"
    FAILED = "failed"


@dataclass(frozen=True)
class Spread:
    """Median, least and greatest of repeated measurements."""

    median: float
    min: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """The spread of at least one value."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class BenchRecord(Line):
    """Cost of a step of one integrator at one depth, number of samples, size of film, and size of textures.

    `estimator` is None where the integrator has none; what makes it another than by default, but for `capacity`, stands
    behind its name, `reservoir(weight=adjoint)`. `step_ms` is wall time, `kernel_ms` what kernels took of it,
    `codegen_ms` their generation (and the look into the cache of kernels), `tracing_ms` the rest: Python and what it
    calls; all of warm steps. `cold_ms` is the wall time of the first step in a new process with an empty kernel cache,
    `cold_codegen_ms` its part in which kernels were generated and compiled. `peak_mib` is the most that the allocator
    held in that step, the scene included. `scratch_bytes` is thread-local memory of a path. `texels` are those of all
    textures that are parameters. `paths` are those of the integrator (`light`, `camera`, `both`), `light_share` is the
    share of light paths where there are both. What was not measured is None: everything, where `status` is not ok.
    """

    integrator: str
    estimator: str | None
    capacity: int | None
    max_depth: int
    rr_depth: int
    spp: int
    width: int | None
    height: int | None
    status: BenchStatus
    step_ms: Spread | None = None
    kernel_ms: Spread | None = None
    codegen_ms: Spread | None = None
    tracing_ms: Spread | None = None
    cold_ms: float | None = None
    cold_codegen_ms: float | None = None
    peak_mib: float | None = None
    scratch_bytes: int | None = None
    repeats: int = 0
    texels: int | None = None
    paths: str = "light"
    light_share: float | None = None


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
    samples per pixel of a step. `paths` and `light_share` are as in a `BenchRecord`; `auto` and None: the run decides.
    """

    label: str
    integrator: str
    estimator: str | None
    capacity: int | None
    adjoint: str | None
    spp: int
    paths: str = "light"
    light_share: float | None = None


@dataclass(frozen=True)
class PointRecord(Line):
    """The error of the average of `steps` steps, which take `elapsed_s` seconds.

    `parameter` is a parameter's key, `all` (of them together) or `image`. Errors are relative to the size of what is
    estimated, in L2 over all its entries. `relative_rmse` has the reference's own error, `reference_rmse`, subtracted,
    and is the root of the mean square over `repeats` such averages; None where it drowns in the reference's.
    """

    KIND: ClassVar[str] = "point"

    method: Method
    parameter: str
    steps: int
    elapsed_s: float
    relative_rmse: float | None
    reference_rmse: float | None
    repeats: int


@dataclass(frozen=True)
class MethodRecord(Line):
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

    KIND: ClassVar[str] = "method"

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


@dataclass(frozen=True)
class ReferenceRecord(Line):
    """What errors are taken from: the mean of `repeats` steps, with the relative standard error `reference_rmse`.

    `bias_z` is its own largest deviation from an independent reference, as of a `MethodRecord`; None where there is
    none.
    """

    KIND: ClassVar[str] = "reference"

    method: Method
    parameter: str
    repeats: int
    reference_rmse: float | None
    bias_z: float | None = None
    bias_z_limit: float | None = None
    bias_reference: str | None = None
    biased: bool | None = None
    message: str = ""


@dataclass(frozen=True)
class SummaryRecord(Line):
    """Which method is the best, in words."""

    KIND: ClassVar[str] = "summary"

    line: str


class Reference(str, enum.Enum):
    """What a gradient is compared with; `forward_mode` by the dot product <w, J v> = <J^T w, v>.

    `unguided`: guided steps are compared with unguided steps of the same estimator.
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
    """How it is compared.

    `equal_seeds`: by relative L2, where both compute the same numbers but for rounding. `expectation`: by z scores over
    many seeds. `image`: so too, but not the gradient, the image it belongs to.
    """

    EQUAL_SEEDS = "equal_seeds"
    EXPECTATION = "expectation"
    IMAGE = "image"


class Verdict(str, enum.Enum):
    """What came of it. All but `holds` and `fails` leave the question open, and `message` says why.

    `heavy_tailed`: single seeds carry the variance, so that z scores prove nothing. `unresolved`: noise hides
    deviations as large as the gradient itself. `unreached`: gradient and reference are exactly zero.
    `no_reference`: nothing here counts as one. `not_measured`: time was up before there were samples.
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
    """The two sides of a comparison: the gradient of a parameter by an integrator, and a reference.

    `case` names the scene: the configuration, or a case of a suite. `parameter` is None where all are compared
    together, or the image; `estimator` where the integrator has none. `seeds` is how many gradients each side has.
    """

    case: str
    parameter: str | None
    integrator: str
    estimator: str | None
    reference: Reference
    kind: Kind
    seeds: int


@dataclass(frozen=True)
class Comparison:
    """The outcome of a comparison of estimates with a reference.

    `relative_l2` is the distance from the reference over its norm: at equal seeds of the samples, else of the
    means. `z_rms` and `z_max` are in standard errors; each has its limit, corrected for the number of comparisons.
    `cosine` is that of the angle between the means, `variance_ratio` the variance over that of the reference.
    `detectable` is the least deviation, as a fraction of the reference, that would have been seen. `message` says what
    the figures do not. What does not apply is None.
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
        """True or False where the comparison decides; None where it does not."""
        return {Verdict.HOLDS: True, Verdict.FAILS: False}.get(self.verdict)


@dataclass(frozen=True)
class GradcheckRecord(Comparison, Compared, Line):
    """One comparison: what was compared, by which paths (as in a `BenchRecord`), and what was found."""

    paths: str = "light"
    light_share: float | None = None

    def to_json(self) -> str:
        """The record as one line of JSON; figures that are not finite become null."""
        return json.dumps(finite(asdict(self)) | {"holds": self.holds}, allow_nan=False)


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


#: Standard errors within which a share counts as none.
NOTHING = 3

#: A share that single precision may have made.
LEAST = 1e-4

#: A share that turns a run's steps, where it is told from 0; and one with which they may lead the other way.
NOTICED, HALF = 0.05, 0.5

#: A standard error of a share that is small enough.
KNOWN = 0.03

#: The verdict on a parameter whose derivative lacks that much.
INCOMPLETE = "derivative incomplete"


@dataclass(frozen=True)
class MissingRecord(Line):
    """The share of a parameter's derivative that is not in the attached gradient, relative to finite differences.

    `share` and `standard_error` are None where the derivative itself is lost in its noise, and where there was no time
    to measure them (no `seeds`).
    """

    case: str
    parameter: str
    share: float | None
    standard_error: float | None
    directions: int
    seeds: int
    kind: Literal["missing"] = "missing"

    @property
    def is_unknown(self) -> bool:
        """Whether more than half may be missing, without being told from 0."""
        if self.share is None or self.standard_error is None:
            return True
        margin = NOTHING * self.standard_error
        return self.share <= margin and self.share + margin > HALF

    @property
    def is_incomplete(self) -> bool:
        """Whether the values that the derivative leads to cannot be relied on."""
        return self.is_unknown or (self.share or 0) > max(NOTHING * (self.standard_error or 0), NOTICED)

    @property
    def is_for_the_most_part(self) -> bool:
        """Whether more than half is missing, by two standard errors."""
        return self.share is not None and self.share - 2 * (self.standard_error or 0) > HALF

    @property
    def is_known(self) -> bool:
        """Whether more seeds would hardly change what is made of it."""
        return self.standard_error is not None and (self.standard_error < KNOWN or self.is_for_the_most_part)

    def percent(self) -> str:
        """The share in words."""
        if self.share is None or self.standard_error is None:
            return "an unknown share"
        return f"{_percent(self.share)} +- {_percent(self.standard_error)}"

    def line(self) -> str:
        """What it says, in one line."""
        if not self.seeds:
            return (
                f"{self.parameter}: silhouettes and edges of shadows are not in the derivative; there was no time to "
                "measure what they make up"
            )
        if self.share is None or self.standard_error is None:
            return f"{self.parameter}: the derivative itself is less than what {self.seeds} seeds could see"
        figures = self.percent()
        if self.is_unknown:
            return (
                f"{self.parameter}: {self.seeds} seeds could not tell what share of the derivative is missing "
                f"({figures}; silhouettes, edges of shadows, light that leaves the film)"
            )
        if self.share <= max(NOTHING * self.standard_error, LEAST):
            return f"{self.parameter}: nothing is missing that {self.seeds} seeds could see ({figures})"
        return (
            f"{self.parameter}: {figures} of the derivative is missing (silhouettes, edges of shadows, light that "
            "leaves the film)"
        )


def _percent(share: float) -> str:
    return f"{share:.1%}" if share < 0.0995 else f"{share:.0%}"


_READERS: dict[type[Line], TypeAdapter[Any]] = {kind: TypeAdapter(kind) for kind in (GradcheckRecord, MissingRecord)}
R = TypeVar("R", bound=Line)


def record_of(kind: type[R], entry: Mapping[str, Any]) -> R | None:
    """The record of that class which a line, read back, holds; None where it holds none."""
    try:
        found: R = _READERS[kind].validate_python(entry)
    except ValidationError:
        return None
    return found


def incomplete_records(entries: Sequence[Mapping[str, Any]]) -> list[MissingRecord]:
    """The records among `entries`, of a manifest, that say that a derivative is incomplete."""
    found = (record_of(MissingRecord, entry) for entry in entries)
    return [record for record in found if record is not None and record.is_incomplete]
