"""Forecast of the memory and time of a run, measured with a few of the run's steps and a target with few samples."""

from __future__ import annotations

import bisect
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile

import mitsuba as mi

from reslrb_cli.backend.doctor import free_bytes, resident_bytes
from reslrb_cli.config.files import duration, in_words
from reslrb_cli.config.schema import Config
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import LEAST_ITERATIONS, bends_large, candidates, joint_cost, optimize
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.targets import with_short_target
from reslrb_cli.records.clock import MIB
from reslrb_cli.records.decisions import DecisionCache
from reslrb_cli.records.metrics import Record

#: Maximum number of steps until everything is compiled and recorded; minimum and maximum number of timed steps, and
#: their seconds.
WARM_UP, LEAST, MOST, SECONDS = 5, 4, 40, 5.0

#: Number of steps that suffices if they take this many seconds.
FEW, LONG = 3, 15.0

#: Iterations after which most runs with `auto` end (docs/optimizers.md), and the share of a step below which a
#: measurement of curvature is none.
USUAL, NOTICED = (LEAST_ITERATIONS, 50), 0.05


@dataclass(frozen=True)
class IterationTimes:
    """Expected times of a run's iterations, without compilation: `step_s` of each, and of measurements of curvature.

    With `auto`, `gradient_s` is the time of a measurement for large parameters, and `joint_s` of one for small ones. A
    time of 0 stands for no measurement.
    """

    step_s: float
    gradient_s: float = 0.0
    joint_s: float = 0.0

    @classmethod
    def of(cls, records: Sequence[Record], optimizer: Optimizer | None, before_s: float = 0.0) -> IterationTimes:
        """Return the times that consecutive records show. `before_s` is `elapsed_s` before the first one."""
        ends = [before_s, *(record.elapsed_s for record in records)]
        times = [after - before - record.curvature_s for (before, after), record in
                 zip(pairwise(ends), records, strict=True)]  # fmt: skip
        first = min(WARM_UP, len(records) - 1)
        step_s = statistics.median(times[first:])
        if len(records) == 1:
            step_s = max(step_s - records[0].codegen_ms / 1e3, 0.0)
        if optimizer is None or not optimizer.measures_curvature:
            return cls(step_s)
        warm = records[-1:] if len(records) == 1 else records[1:]
        gradient_s = min((record.step_ms - record.codegen_ms) / 1e3 for record in warm) if optimizer.has_large else 0.0
        due = [record for record in warm if joint_cost(record.iteration) is not None] if optimizer.block.at else []
        joint = [record.curvature_s - gradient_s * bends_large(optimizer, record.iteration) for record in due]
        # The run stops measuring once the curvature is known.
        joint_s = min(joint[-1], statistics.median(joint)) if joint else 0.0
        return cls(step_s, gradient_s, joint_s if joint_s > NOTICED * step_s else 0.0)

    def seconds(self, first: int, last: int) -> float:
        """Return the time of the iterations from `first` to before `last`."""
        large = sum(first <= 2**power - 2 < last for power in range(1, last.bit_length() + 2))
        cost = self.joint_s / max(self.step_s, 1e-9)
        joint = sum(iteration >= first and joint_cost(iteration, cost) is not None
                    for iteration in takewhile(lambda iteration: iteration < last, candidates()))  # fmt: skip
        return (last - first) * self.step_s + large * self.gradient_s + joint * self.joint_s


def measure_steps(problem: Problem) -> tuple[IterationTimes, float, float, int]:
    """Take a few steps of `problem`, which then has other values.

    Returns the times, the additional seconds of the first steps with cached kernels, the current seconds for compiling,
    and the peak in bytes, which corresponds to `peak_mib` in `metrics.jsonl`.
    """
    run = problem.config.run
    enough = {"iterations": max(run.iterations, WARM_UP + MOST), "max_seconds": None}
    config = problem.config.model_copy(update={"run": run.model_copy(update=enough)})
    records: list[Record] = []
    for record in optimize(replace(problem, config=config)):
        records.append(record)
        timed = len(records) - WARM_UP
        if len(records) >= FEW and record.elapsed_s > LONG:
            break
        if timed >= MOST or (timed >= LEAST and record.elapsed_s - records[WARM_UP - 1].elapsed_s > SECONDS):
            break
    times = IterationTimes.of(records, problem.optimizer)
    first = min(WARM_UP, len(records) - 1)
    extra = max(records[first - 1].elapsed_s - times.seconds(0, first), 0.0) if first else 0.0
    compiled = min(sum(record.codegen_ms for record in records[:first]) / 1e3, extra)
    # Kernels that run only when values change, for example to 0, do not count.
    peak = int(records[: run.iterations][-1].peak_mib * MIB)
    return times, extra - compiled, compiled, peak


def forecast_lines(
    config: Config,
    say: Callable[[str], None],
    cache: DecisionCache | None = None,
    before: Callable[[Problem], Problem] = lambda problem: problem,
) -> list[str]:
    """Measure a few steps of the run that `config` describes, and return lines about its memory and time. A variant
    must be set.

    `say` is called with lines about slow work. Decisions are stored in `cache` for the run. `before` takes the problem
    before its first iteration, and returns the problem that the run would have. Raises the same errors as the run.
    """
    # Errors are not part of a step.
    problem = before(replace(assemble(with_short_target(config, 4 * config.run.spp), say, cache), truth={}))
    say("measuring a few steps")
    times, start_s, compile_s, peak = measure_steps(problem)
    iterations = config.run.iterations
    if config.run.max_seconds is not None:
        left_s = config.run.max_seconds - problem.measured_s - start_s
        fitting = bisect.bisect_right(range(1, iterations + 1), left_s, key=lambda count: times.seconds(0, count))
        iterations = max(fitting, 1)
    elapsed_s = times.seconds(0, iterations) + start_s
    sums = f"{iterations} x {1e3 * times.step_s:.3g} ms"
    curvature_s = elapsed_s - start_s - iterations * times.step_s
    sums += f" + {duration(curvature_s)} to measure curvature" if curvature_s > 0.01 * elapsed_s else ""
    sums += f" + {duration(start_s)}" if start_s > 0.01 * elapsed_s else ""
    ends, most = "", ""
    if problem.optimizer.measures_curvature and iterations > USUAL[0]:
        usual = USUAL[0], min(USUAL[1], iterations)
        spans = " to ".join(duration(times.seconds(0, end) + start_s) for end in usual)
        most, ends = "at most ", f"; `auto` usually ends after {usual[0]} to {usual[1]} iterations ({spans})"
    return [
        f"memory of the iterations: at most {in_words(peak)}; {in_words(free_bytes(mi.variant()))} are free",
        f"memory of the whole process: {in_words(resident_bytes())}, with Python, libraries and the code of kernels",
        f"time of the iterations: {most}{duration(elapsed_s)} ({sums}){ends}",
        f"time to compile kernels: {duration(compile_s)}, which is done now and stored",
    ]
