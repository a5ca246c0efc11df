"""What is found out about a run before its first iteration, and goes into its record."""

from __future__ import annotations

from dataclasses import dataclass

from reslrb_cli.records.clock import MIB
from reslrb_cli.records.decisions import Jsonable


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
class MemoryPlan(Jsonable):
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


@dataclass
class Allowance:
    """Seconds that all measuring before the first iteration may take: a share of what the run itself will, `run_s`.

    That is kernels compiled (`compile_s`, what those of one step took), and iterations of `iteration_s` each, by two
    first steps of few samples, which the run would take as well, and which are no part of `spent_s`.
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

    def note(self) -> str:
        """The words for what there was no time to measure."""
        return f"not measured (over {100 * self.share:.3g} % of this run)"

    def line(self) -> str:
        """The words for what was spent."""
        part = 100 * self.spent_s / max(self.run_s, 1e-9)
        return f"measuring took {self.spent_s:.1f} s, {part:.2g} % of what this run is expected to take"


@dataclass(frozen=True)
class Sensitivity(Jsonable):
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


@dataclass(frozen=True)
class Scaled(Sensitivity):
    """What was measured of a parameter, and what was made of it.

    `own_length` is `length` in what the optimiser moves, its variable, and `first_step`, in the scene's units, how far
    one learning rate of that moves the value where it starts; both are None where the parameter was not scaled.
    """

    own_length: float | None = None
    first_step: float | None = None
