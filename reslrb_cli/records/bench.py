"""`reslrb bench --json FILE`: one object a line, one line a case and depth, or what else is swept."""

from __future__ import annotations

import enum
import json
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass


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
class BenchRecord:
    """Cost of a step of one integrator at one depth, number of samples, size of film, and size of textures.

    `estimator` is None where the integrator has none; what makes it another than by default, but for `capacity`, stands
    behind its name, `reservoir(weight=adjoint)`. `step_ms` is wall time, `kernel_ms` what kernels took of it,
    `codegen_ms` their generation (and the look into the cache of kernels), `tracing_ms` the rest: Python and what it
    calls; all of warm steps. `cold_ms` is the wall time of the first step in a new process with an empty kernel cache,
    `cold_codegen_ms` its part in which kernels were generated and compiled. `peak_mib` is the most that the allocator
    held in that step, the scene included. `scratch_bytes` is thread-local memory of a path. `texels` are those of all
    textures that are parameters. What was not measured is None: everything, where `status` is not ok.
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
    step_ms: Spread | None
    kernel_ms: Spread | None
    codegen_ms: Spread | None
    tracing_ms: Spread | None
    cold_ms: float | None
    cold_codegen_ms: float | None
    peak_mib: float | None
    scratch_bytes: int | None
    repeats: int
    texels: int | None = None

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return json.dumps(asdict(self), allow_nan=False)
