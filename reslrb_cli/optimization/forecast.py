"""Forecast of the memory and time of a run, measured with a few of the run's steps and a target with few samples."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import mitsuba as mi

from reslrb_cli.backend.doctor import free_bytes, resident_bytes
from reslrb_cli.config.files import duration, in_words
from reslrb_cli.config.schema import Config
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import optimize
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


def measure_steps(problem: Problem) -> tuple[float, float, float, int]:
    """Take a few steps of `problem`, which then has other values.

    Returns the seconds of one step, the additional seconds of the first steps with cached kernels, the current seconds
    for compiling, and the peak in bytes, which corresponds to `peak_mib` in `metrics.jsonl`.
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
    times = [records[0].elapsed_s, *(b.elapsed_s - a.elapsed_s for a, b in pairwise(records))]
    first = min(WARM_UP, len(records) - 1)
    steady = statistics.median(times[first:])
    extra = sum(max(seconds - steady, 0.0) for seconds in times[:first])
    compiled = min(sum(record.codegen_ms for record in records[:first]) / 1e3, extra)
    # Kernels that run only when values change, for example to 0, do not count.
    peak = int(records[: run.iterations][-1].peak_mib * MIB)
    return steady, extra - compiled, compiled, peak


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
    iteration_s, start_s, compile_s, peak = measure_steps(problem)
    iterations = config.run.iterations
    if config.run.max_seconds is not None:
        left_s = config.run.max_seconds - problem.measured_s - start_s
        iterations = min(iterations, max(int(left_s / max(iteration_s, 1e-6)), 1))
    elapsed_s = iterations * iteration_s + start_s
    sums = f"{iterations} x {1e3 * iteration_s:.3g} ms"
    sums += f" + {duration(start_s)}" if start_s > 0.01 * elapsed_s else ""
    return [
        f"memory of the iterations: at most {in_words(peak)}; {in_words(free_bytes(mi.variant()))} are free",
        f"memory of the whole process: {in_words(resident_bytes())}, with Python, libraries and the code of kernels",
        f"time of the iterations: {duration(elapsed_s)} ({sums}), and {duration(compile_s)} to compile kernels, which "
        "is done now and stored",
    ]
