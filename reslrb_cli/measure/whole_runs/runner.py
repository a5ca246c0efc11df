"""One whole optimisation by one method, in a process of its own (`worker.py`), which goes on as far as it is asked to.

Its time is what a user of the method waits for: loading the scene, what is left to measurement, compiling, steps and
updates. Starting Python is not in it, nor is the target, which all methods have from the one that judges them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import loads
from reslrb_cli.measure.border_mask import leave_out_border
from reslrb_cli.measure.worker import Begun
from reslrb_cli.optimization.choice import find_options, settle_integrator
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.problem import Problem, assemble_scene
from reslrb_cli.optimization.sequence_choice import settle_sampling
from reslrb_cli.optimization.views import set_targets
from reslrb_cli.records.clock import peak_mib
from reslrb_cli.records.metrics import Record

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class State:
    """The parameters' `values` after `iteration` iterations, which took `elapsed_s` seconds of counted time."""

    elapsed_s: float
    iteration: int
    values: dict[str, Array]


class Advance:
    """An optimisation that is brought forward bit by bit; `now` is its newest state, `before` the one before that.

    All of its time counts, what it spends between its steps too; what `take` does, which copies the values, does not.
    `loading_s` has gone before the first iteration; `first_s` is the time of the first state.
    """

    def __init__(
        self,
        records: Iterator[Record],
        take: Callable[[], dict[str, Array]],
        loading_s: float,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._records, self._take, self._spent_s, self._clock = records, take, loading_s, clock
        self.before = self.now = State(0.0, 0, take())
        self.first_s: float | None = None
        self.finished = False
        self._quickest_s, self._limit_s = 0.0, float("inf")

    def progress(self) -> float:
        """The share of the time from its first state to its end that has gone: 0 to 1; compiling is before that."""
        if self.first_s is None or self.first_s >= self._limit_s:
            return 0.0
        return min((self._spent_s - self.first_s) / (self._limit_s - self.first_s), 1.0)

    def until(self, elapsed_s: float, limit_s: float) -> State:
        """The state that stands at `elapsed_s`: the newest that was done by then; times asked for may not fall.

        An iteration that would not be done by `limit_s` even if it were the quickest so far is not begun.
        """
        self._limit_s = limit_s
        while not self.finished and self.now.elapsed_s <= elapsed_s:
            if self.now.elapsed_s + self._quickest_s > limit_s:
                break
            began = self._clock()
            record = next(self._records, None)
            if record is None:
                self.finished = True
                break
            self._spent_s += self._clock() - began
            self.before, done_s = self.now, self._spent_s
            if self.first_s is None:
                self.first_s = done_s
            else:
                taken_s = done_s - self.before.elapsed_s
                self._quickest_s = min(self._quickest_s or taken_s, taken_s)
            self.now = State(done_s, record.iteration + 1, self._take())
        return self.now if self.now.elapsed_s <= elapsed_s else self.before


def begin(first: dict[str, Any]) -> Begun:
    """Begin the process. A question asks for the state at `until_s`, with no more than `limit_s` ever to come.

    Its values go to the file `out`; the answer has its `iteration`, the time of the first one, whether all of them are
    done, and the peak of Dr.Jit's arrays.
    """
    start = time.perf_counter()
    problem = assemble_scene(loads(first["config"], first["source"]))
    options = find_options(problem)
    with np.load(first["targets"]) as targets:
        set_targets(problem.views, targets)
    if first["masked"]:
        leave_out_border(problem)
    # Nothing is remembered of earlier pilots: what a pilot costs is to be seen.
    settle_integrator(problem, options, lambda line: None, None)
    settle_sampling(problem, lambda line: None, None)
    dr.sync_thread()
    loading_s = time.perf_counter() - start
    records = optimize(problem, progress=lambda: advance.progress())  # first asked for in its first iteration
    advance = Advance(records, lambda: copies(problem), loading_s)

    def answer(question: dict[str, Any]) -> dict[str, Any]:
        state = advance.until(question["until_s"], question["limit_s"])
        save(question["out"], state.values)
        reply = {
            "iteration": state.iteration,
            "first_s": advance.first_s,
            "finished_s": advance.now.elapsed_s if advance.finished else None,
            "peak_mib": peak_mib(dr.backend_v(mi.Float)),
        }
        if question["release"]:
            dr.flush_malloc_cache()
        return reply

    return {"loading_s": loading_s, "chose": decisions(problem)}, answer


def decisions(problem: Problem) -> list[str]:
    """What was decided by measurement, in words; of how samples are drawn without figures, which differ every time."""
    found = [] if problem.pilot is None else [problem.pilot.line()]
    return found + [each.decision() for each in (problem.guided, problem.sequence) if each is not None]


def copies(problem: Problem) -> dict[str, Array]:
    """The parameters' values, in memory of their own: what `values` returns may be Dr.Jit's, and change."""
    return {key: np.array(value) for key, value in problem.values().items()}


def save(path: str | Path, values: dict[str, Array]) -> None:
    """Write values by key. Keys hold characters that are no names of files, so they are numbered in order."""
    with Path(path).open("wb") as file:
        np.savez(file, **{str(number): value for number, value in enumerate(values.values())})  # type: ignore[arg-type]


def load(path: str | Path, keys: list[str]) -> dict[str, Array]:
    """What `save` wrote of values of these keys."""
    with np.load(path) as arrays:
        return {key: arrays[str(number)] for number, key in enumerate(keys)}
