"""Data for a run's record, determined before the first iteration."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from reslrb_cli.records.clock import MIB
from reslrb_cli.records.decisions import Jsonable


@dataclass(frozen=True)
class Estimate:
    """Expected bytes of a step, in four parts.

    `fixed` is data before the step and targets, `images` is images and parameters, `scratch` is thread-local memory,
    and `paths` is the stored data of the paths of one pass.
    """

    fixed: int
    images: int
    scratch: int
    paths: int

    @property
    def total(self) -> int:
        """Sum of all parts."""
        return self.fixed + self.images + self.scratch + self.paths


@dataclass
class MemoryPlan(Jsonable):
    """Memory budget, samples per pass and expected bytes. After the first iterations, also the peak."""

    budget_bytes: int
    samples_per_pass: int
    passes: int
    expected_bytes: Estimate
    peak_mib: float | None = None
    exceeded: bool = False

    def check(self, peak: float) -> str | None:
        """Record the allocator's peak in MiB. Returns a warning when the used memory first exceeds the budget."""
        self.peak_mib = peak
        used, before = peak * MIB + self.expected_bytes.scratch, self.exceeded
        self.exceeded = used > self.budget_bytes
        if not self.exceeded or before:
            return None
        allowed = f"{self.budget_bytes / MIB:.1f} MiB"
        return f"run.memory_budget: {used / MIB:.1f} MiB were used, more than the budget of {allowed}"


#: Cost relative to the run: kernels to compile, in those of one step, and iterations of work.
Need = tuple[float, float]


@dataclass
class Allowance:
    """The time in seconds that all measurements before the first iteration may take. The limit is the fraction `share`
    of the run's time `run_s`.

    A run's time is `compile_s` for compiling the kernels of one step, plus `iteration_s` for each iteration. Two first
    steps with few samples determine `compile_s` and `iteration_s`. The run would take the two first steps as well.
    Therefore, the first steps do not count as `spent_s`.
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
        """Seconds of the limit that are neither spent nor reserved."""
        running = 0.0 if self.since_s is None else time.perf_counter() - self.since_s
        return max(self.share * self.run_s - self.spent_s - self.aside_s - running, 0.0)

    def affords(self, *needs: Need) -> bool:
        """True if the remaining time suffices for all measurements in `needs`."""
        return self._seconds(needs) <= self.left_s

    def _seconds(self, needs: Sequence[Need]) -> float:
        return sum(kernels * self.compile_s + iterations * self.iteration_s for kernels, iterations in needs)

    @contextmanager
    def spending(self, later: Sequence[Need]) -> Iterator[None]:
        """Count the block's time as spent. Time for `later` measurements is reserved until the block ends."""
        self.aside_s, self.since_s = self._seconds(later), time.perf_counter()
        yield
        self.spent_s += time.perf_counter() - self.since_s
        self.aside_s, self.since_s = 0.0, None

    def iterations_left(self, kernels: float) -> float:
        """Return how many iterations fit into the remaining time, after the compilation of kernels for `kernels`
        steps.
        """
        return max(self.left_s - kernels * self.compile_s, 0.0) / max(self.iteration_s, 1e-9)

    def note(self) -> str:
        """Return a note for options that remain unmeasured for lack of time."""
        return f"not measured (over {100 * self.share:.3g} % of this run)"

    def line(self) -> str:
        """Return a line about the time that was spent."""
        part = 100 * self.spent_s / max(self.run_s, 1e-9)
        return f"measuring took {self.spent_s:.1f} s, {part:.2g} % of this run's expected time"


@dataclass(frozen=True)
class Sensitivity(Jsonable):
    """Measured sensitivity of a parameter with `entries` numbers, in the scene's units.

    `value`, `gradient` and `noise` are root mean squares over the entries. `gradient` is 0 if it cannot be
    distinguished from noise, and `noise` is the standard deviation of one step's gradient. `change` is relative, per
    unit. `change`, `curvature` (loss per unit²) and `length` are None if the image did not change.
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
    """Sensitivity of a parameter, and the resulting scale.

    `own_length` is `length` in the optimiser's variable. `first_step` is how far one learning rate initially moves the
    value, in the scene's units. `own_length` and `first_step` are None if the parameter was not scaled.
    """

    own_length: float | None = None
    first_step: float | None = None
