"""What is found out about a run before its first iteration, and goes into its record."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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


#: Time as a multiple of what a run has: kernels to compile, in those of one step, and iterations' worth of work.
Need = tuple[float, float]


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
    aside_s: float = 0.0
    since_s: float | None = None

    @property
    def left_s(self) -> float:
        """What has not been spent, up to now, nor is kept aside."""
        running = 0.0 if self.since_s is None else time.perf_counter() - self.since_s
        return max(self.share * self.run_s - self.spent_s - self.aside_s - running, 0.0)

    def affords(self, *needs: Need) -> bool:
        """Whether there is time for all of these."""
        return self._seconds(needs) <= self.left_s

    def _seconds(self, needs: Sequence[Need]) -> float:
        return sum(kernels * self.compile_s + iterations * self.iteration_s for kernels, iterations in needs)

    @contextmanager
    def spending(self, later: Sequence[Need]) -> Iterator[None]:
        """Count the block's time as spent; what is measured `later` has its time kept aside until the block ends."""
        self.aside_s, self.since_s = self._seconds(later), time.perf_counter()
        yield
        self.spent_s += time.perf_counter() - self.since_s
        self.aside_s, self.since_s = 0.0, None

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
