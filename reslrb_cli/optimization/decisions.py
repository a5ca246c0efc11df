"""What is found out about a run before its first iteration, and goes into its record."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Protocol

from reslrb_cli.records.clock import MIB


@dataclass(frozen=True)
class Estimate:
    """Bytes that a step is expected to take: what stands before it, with the targets (`fixed`), its images and
    parameters (`images`), thread-local memory (`scratch`), and what is kept of the paths of one pass (`paths`)."""

    fixed: int
    images: int
    scratch: int
    paths: int

    @property
    def total(self) -> int:
        """All of it."""
        return self.fixed + self.images + self.scratch + self.paths


@dataclass
class MemoryPlan:
    """How a budget is kept: the samples of a pass, what is expected, and, after the first iterations, what was used."""

    budget_bytes: int
    samples_per_pass: int
    passes: int
    expected_bytes: Estimate
    peak_mib: float | None = None
    exceeded: bool = False

    def check(self, peak: float) -> str | None:
        """Take note of the allocator's peak in MiB; the warning, the first time that it is above the budget."""
        self.peak_mib = peak
        used, before = peak * MIB + self.expected_bytes.scratch, self.exceeded
        self.exceeded = used > self.budget_bytes
        if not self.exceeded or before:
            return None
        allowed = f"{self.budget_bytes / MIB:.1f} MiB"
        return f"run.memory_budget: {used / MIB:.1f} MiB were used, more than the {allowed} that it allows"

    def to_json(self) -> dict[str, Any]:
        """For the manifest."""
        return asdict(self)


class Cache(Protocol):
    """Where pilots' outcomes are kept."""

    def get(self, key: str) -> dict[str, Any] | None: ...

    def put(self, key: str, entry: dict[str, Any]) -> None: ...


@dataclass(frozen=True)
class Sensitivity:
    """What was measured of one parameter of `entries` numbers, in the scene's units.

    `value`, `gradient` and `noise` are root mean squares over the entries: of the values, of the gradient (0 where the
    samples do not tell it from noise), of the standard deviation of one sample (one step's gradient). `change` is
    relative, per unit; it, `curvature` (loss per unit²) and `length` are None where no change of the image was seen.
    """

    key: str
    entries: int
    value: float
    gradient: float
    noise: float
    change: float | None = None
    curvature: float | None = None
    length: float | None = None

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Scaled(Sensitivity):
    """What was measured of a parameter, and what was made of it.

    `own_length` is `length` in what the optimiser moves, its variable, and `first_step`, in the scene's units, how far
    one learning rate of that moves the value where it starts; both are None where the parameter was not scaled.
    """

    own_length: float | None = None
    first_step: float | None = None
