"""Forecast of the memory and time of a run, measured with a few of the run's steps and a target with few samples."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import mitsuba as mi

from reslrb_cli.backend.doctor import free_bytes
from reslrb_cli.config.schema import Config
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.problem import Problem, progress_spp, saved_spp
from reslrb_cli.optimization.uncertainty.measuring import LEAST_ITERATIONS
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


#: Number of steps, approximately, for the verdicts on the values after the last iteration.
VERDICTS = 30


@dataclass(frozen=True)
class Forecast:
    """Forecast of a run.

    `iteration_s` is the time of one step, `start_s` the additional time of the first steps with cached kernels, and
    `compile_s` the current time for compiling. `peak` is the memory of the iterations in bytes, and `free` the free
    memory. The fields `before_s`, `measuring_s`, `target_s`, `images_s` and `verdicts_s` are seconds outside the
    iterations. The decisions took `measuring_s` now, and a run finds them in the
    cache.
    """

    iteration_s: float
    start_s: float
    compile_s: float
    peak: int
    free: int
    iterations: int
    before_s: float
    measuring_s: float
    target_s: float
    images_s: float
    verdicts_s: float

    @property
    def elapsed_s(self) -> float:
        """Seconds that all iterations take with cached kernels, like `elapsed_s` in `metrics.jsonl`."""
        return self.iterations * self.iteration_s + self.start_s

    @property
    def whole_s(self) -> float:
        """Seconds of the whole run, with the current caches of kernels and decisions."""
        return self.elapsed_s + self.before_s + self.target_s + self.images_s + self.verdicts_s


def make_forecast(
    config: Config,
    say: Callable[[str], None],
    cache: DecisionCache | None = None,
    before: Callable[[Problem], Problem] = lambda problem: problem,
) -> Forecast:
    """Measure a few steps of the run that `config` describes. A variant must be set.

    `say` is called with lines about slow work. Decisions are stored in `cache` for the run. `before` takes the problem
    before its first iteration, and returns it. `before` makes measurements that no cache stores. Raises the same errors
    as the run.
    """
    # Errors are not part of a step.
    problem = replace(assemble(with_short_target(config), say, cache), truth={})
    image_s, views = _image_seconds(problem), len(problem.views)
    begin = time.perf_counter()
    problem = before(problem)
    before_s = time.perf_counter() - begin
    say("measuring a few steps")
    iteration_s, start_s, compile_s, peak = measure_steps(problem)
    run = config.run
    iterations = run.iterations
    if run.max_seconds is not None:
        left_s = run.max_seconds - problem.measured_s - start_s
        iterations = min(iterations, max(int(left_s / max(iteration_s, 1e-6)), 1))
    has_verdicts = run.certainty and config.by_pixel and run.iterations >= LEAST_ITERATIONS
    return Forecast(
        iteration_s=iteration_s,
        start_s=start_s,
        compile_s=compile_s,
        peak=peak,
        free=free_bytes(mi.variant()),
        iterations=iterations,
        before_s=before_s,
        measuring_s=problem.measured_s,
        target_s=image_s * config.target.render.spp * views if config.target.render else 0.0,
        images_s=image_s * 2 * saved_spp(problem) * views,
        verdicts_s=VERDICTS * iteration_s if has_verdicts else 0.0,
    )


def with_short_target(config: Config) -> Config:
    """Return the experiment with a rendered target that has at most the sample count of four steps."""
    render = config.target.render
    if render is None:
        return config
    unit = (render.integrator or config.integrator).options().get("samples_per_pass") or 1
    spp = min(render.spp, -(-4 * config.run.spp // unit) * unit)
    target = config.target.model_copy(update={"render": render.model_copy(update={"spp": spp})})
    return config.model_copy(update={"target": target})


def _image_seconds(problem: Problem) -> float:
    """Return the render time of a saved image of the first view, in seconds per sample per pixel."""
    view, spp = problem.views[0], progress_spp(problem)
    problem.render(view.sensor, spp, 0, "forecast")  # compiles, and records small calls: several times as long
    begin = time.perf_counter()
    problem.render(view.sensor, spp, 1, "forecast")
    return (time.perf_counter() - begin) / spp
