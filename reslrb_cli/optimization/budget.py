"""How much memory a step takes, and the passes that keep it within a budget."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.backend.device import resident_paths
from reslrb_cli.config.passes import divisors, passes_obstacle
from reslrb_cli.estimators.base import entry_bytes
from reslrb_cli.integrators import Reslrb
from reslrb_cli.records.clock import MIB, peak_mib, reset_peak

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

#: Images of the film's size that a step has at once: block, image, loss's parts, gradient, adjoint; a batch's too.
FILM_IMAGES = 12
#: Copies of a parameter: gradients, the optimiser's moments, their next values, the best of a run.
PARAMETER_COPIES = 9
#: And those of a clamp: what is usual, the sums over the iterations, and their next values.
CLAMP_COPIES = 7


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


def standing() -> int:
    """Bytes that are allocated now."""
    reset_peak()
    return int(peak_mib(dr.backend_v(mi.Float)) * MIB)


def estimate(problem: Problem, integrator: Reslrb, samples: int, fixed: int) -> Estimate:
    """What a step takes whose passes have `samples` samples per pixel; `fixed` stands before it.

    The targets, which may not be there yet, are not part of `fixed`, but of the result's.
    """
    paths = images = targets = scratch = 0
    for index in problem.sensors:
        sensor = problem.scene.sensors()[index]
        plan = integrator.plan(problem.scene, sensor, problem.selection.params)
        width = samples * int(dr.prod(sensor.film().size()))
        if problem.config.adjoint == "correlated" and samples == problem.config.run.spp:
            # Else dL/dI is known before the paths are traced, and nothing of them outlives the kernel.
            paths = max(paths, sum(allocated(size * width) for size in entry_bytes(integrator.estimator.kept(plan))))
        block = int(dr.prod(sensor.film().crop_size())) * (sensor.film().base_channels_count() + 1)
        images = max(images, FILM_IMAGES * allocated(4 * block), 2 * allocated(4 * block) + _replicas(block))
        targets += allocated(4 * block)
        scratch = max(scratch, integrator.estimator.scratch_bytes(plan))
    copies = PARAMETER_COPIES + (0 if problem.config.optimizer.clamp_gradient is None else CLAMP_COPIES)
    for key in problem.selection.keys:
        size = int(dr.prod(dr.shape(problem.selection.value(key))))
        images += copies * allocated(4 * size) + _replicas(size)
    guiding = integrator.preparation.guiding
    tables = 0 if guiding is None else guiding.bytes(len(problem.sensors))
    return Estimate(fixed + targets + tables, images, scratch * resident_paths(), paths)


def choose_samples(problem: Problem, integrator: Reslrb, samples: int, budget: int, fixed: int) -> tuple[int, Estimate]:
    """The largest divisor of `samples` that fits into the budget, and what it takes; 0 and the least where none does.

    `samples` are those of a batch, or of a step.
    """
    pixels = max(int(dr.prod(problem.scene.sensors()[index].film().size())) for index in problem.sensors)
    for size in reversed([size for size in divisors(samples) if passes_obstacle(samples, size, pixels) is None]):
        expected = estimate(problem, integrator, size, fixed)
        if expected.total <= budget:
            return size, expected
    return 0, expected


def allocated(size: int) -> int:
    """Bytes that the allocator takes for an array: a power of two."""
    return max(1 << (size - 1).bit_length(), 64) if size else 0


def _replicas(entries: int) -> int:
    """What scattering into an array takes: on a CPU each thread has a copy of a small one."""
    threads = dr.thread_count() + 1
    if dr.backend_v(mi.Float) != dr.JitBackend.LLVM or entries * threads > dr.expand_threshold():
        return 0
    return allocated(4 * entries * threads)
