"""A few steps of a run, for a forecast: what one takes, and the memory of all.

Where a step takes long, steps of fewer samples per pixel stand for it: time and memory are a constant and a part that
is proportional to the samples, which two sizes tell apart. Memory is given out in powers of two, which such a line
misses; so where two whole steps are no long wait, they say what the memory is.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice, pairwise

from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.state import guiding_of
from reslrb_cli.optimization.step_trial import lessons
from reslrb_cli.records.clock import MIB
from reslrb_cli.records.metrics import Record

#: Seconds of a step beyond which steps of fewer samples stand for it, and that those are to take.
LONG_STEP, SHORT_STEP = 2.0, 0.7
#: Seconds of a step up to which two of them are taken for their memory.
WAIT = 15.0
#: Steps until all is compiled and recorded; steps that are timed, at least, at most, and for so many seconds.
WARM_UP, LEAST, MOST, SECONDS = 5, 4, 40, 5.0


@dataclass(frozen=True)
class Steps:
    """Steps of `spp` samples per pixel: seconds of one, what the first took longer, compiling apart, and the peak."""

    spp: int
    step_s: float
    start_s: float
    compile_s: float
    peak: int


def measure_steps(problem: Problem) -> Steps:
    """What a step of the run takes, measured or by two smaller ones."""
    config = problem.config
    unit = config.run.batches if config.adjoint == "batched" else 1
    unit *= problem.samples_per_pass or 1
    whole = config.run.spp
    if unit >= whole:
        return _measure(problem, whole)
    first = _measure(problem, unit)
    if first.step_s * whole / unit <= LONG_STEP:
        steps = _measure(problem, whole)
        return replace(steps, compile_s=first.compile_s + steps.compile_s)
    small = max(min(int(SHORT_STEP / max(first.step_s, 1e-6)), whole // unit // 2), 1) * unit
    one, two = _measure(problem, small), _measure(problem, 2 * small)
    share = (whole - small) / small
    step_s = one.step_s + share * max(two.step_s - one.step_s, 0.0)
    peak = _peak(problem, whole) if step_s <= WAIT else int(one.peak + share * max(two.peak - one.peak, 0))
    return Steps(two.spp, step_s, two.start_s, first.compile_s + one.compile_s + two.compile_s, peak)


def _peak(problem: Problem, spp: int) -> int:
    """Bytes that two iterations of `spp` samples per pixel take: the second is one that was recorded."""
    with closing(_iterations(problem, spp)) as iterations:
        return _highest(problem, list(islice(iterations, 2)))


def _iterations(problem: Problem, spp: int) -> Generator[Record, None, None]:
    """The first iterations of `spp` samples per pixel, by the loop itself; then all is as it was before."""
    config, values = problem.config, problem.values()
    enough = {"spp": spp, "iterations": max(config.run.iterations, WARM_UP + MOST)}  # of a run of two, too
    problem.config = config.model_copy(update={"run": config.run.model_copy(update=enough)})
    try:
        yield from optimize(problem)
    finally:
        problem.config = config
        problem.begin_again(values)


def _highest(problem: Problem, records: Sequence[Record]) -> int:
    """The peak in bytes of those that the run has, too: kernels may become others as values move, to 0 for example."""
    return int(records[: problem.config.run.iterations][-1].peak_mib * MIB)


def _measure(problem: Problem, spp: int) -> Steps:
    """A few iterations of `spp` samples per pixel."""
    guiding = guiding_of(problem)
    records: list[Record] = []
    taught: list[int] = []  # how often tables had learned after each
    begin = time.perf_counter()
    with closing(_iterations(problem, spp)) as iterations:
        for record in iterations:
            records.append(record)
            taught.append(0 if guiding is None else guiding.lessons)
            if len(records) == WARM_UP:
                begin = time.perf_counter()
            timed = len(records) - WARM_UP
            if timed >= MOST or (timed >= LEAST and time.perf_counter() - begin > SECONDS):
                break
    times = [records[0].elapsed_s, *(b.elapsed_s - a.elapsed_s for a, b in pairwise(records))]
    steady = statistics.median(times[WARM_UP:])
    if guiding is not None:
        learned = [b - a for a, b in pairwise(taught)]
        steady = _with_learning(times[WARM_UP:], learned[WARM_UP - 1 :], lessons(problem))
    extra = sum(max(seconds - steady, 0.0) for seconds in times[:WARM_UP])
    compiled = min(sum(record.codegen_ms for record in records[:WARM_UP]) / 1e3, extra)
    return Steps(spp, steady, extra - compiled, compiled, _highest(problem, records))


def _with_learning(times: Sequence[float], learned: Sequence[int], mean: float) -> float:
    """Seconds of an iteration in which tables learn `mean` times, from some in which they learned as often as `learned`
    says: oftener than later on, since these are early ones."""
    plain = [seconds for seconds, count in zip(times, learned, strict=True) if count == 0]
    if not plain or sum(learned) == 0:
        return statistics.fmean(times)
    without = statistics.median(plain)
    return without + mean * max(sum(times) - len(times) * without, 0.0) / sum(learned)
