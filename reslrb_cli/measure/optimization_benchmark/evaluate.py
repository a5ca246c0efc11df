"""One whole optimisation (`begin_run`), and what judges all of them (`begin_judging`): each in a process of its own.

A method's own loss is of the image that it renders itself: its noise, and where `run.adjoint` takes it from, are part
of it. So losses are taken here, of images by one integrator with the same seeds for all values; none of it is in the
time of any method, nor is the target, which all have in common. Their time is what a user waits for: loading the scene,
what is left to measurement, compiling, steps and updates, but not starting Python.
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

from reslrb_cli.config.loader import told
from reslrb_cli.measure.convergence.setup import affordable_paths, find_references, shorten_target
from reslrb_cli.measure.references import leave_out_border
from reslrb_cli.measure.stepper import multiple_of
from reslrb_cli.measure.workers import Begun
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.autotune.sampling import settle
from reslrb_cli.optimization.errors import ErrorMeter
from reslrb_cli.optimization.identifiability import find_reached
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.memory import fit_memory
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.views import set_targets, target_arrays
from reslrb_cli.records.clock import peak_mib
from reslrb_cli.records.metrics import Record

Array = np.ndarray[Any, Any]

#: The purpose of the samples of the images.
_PURPOSE = "convergence, runs"

#: The share of the time that the target may take.
TARGET_SHARE = 0.1

#: The fewest samples per pixel of the images, whatever they take: the noise of fewer would be all that losses show.
LEAST_SPP = 16


class Judge:
    """Losses and errors of the parameters of `problem`, whose targets are made; `spp` are those of an image."""

    def __init__(self, problem: Problem, spp: int) -> None:
        self.problem, self.spp, self.meter = problem, spp, problem.meter

    def loss(self, values: dict[str, Array]) -> float:
        """The loss of images with `values`, by key, of all views by their shares."""
        problem = self.problem
        problem.selection.set_arrays(values)
        total = 0.0
        for view in problem.trained:
            total += float(view.objective(problem.see(view, self.spp, 0, _PURPOSE))[0])
        return total

    def error(self, values: dict[str, Array]) -> float | None:
        """The error of all parameters together; None where no true value is known."""
        return joint_error(self.meter, values)


def joint_error(meter: ErrorMeter, values: dict[str, Array]) -> float | None:
    """The root mean square error of all parameters, or, where they have no common unit, of their relative errors."""
    errors = meter.errors(lambda key: values[key])
    total = meter.total(errors)
    if total is not None:
        return total
    relative = list(meter.relative(errors).values())
    return float(np.sqrt(np.mean(np.square(relative)))) if relative else None


def begin_judging(first: dict[str, Any]) -> Begun:
    """Begin the process. The first question is to `prepare`, with a file for the targets, `out`, or to `restore` some.

    Each other one names a file of `values`; its answer has their `loss` and `error`.
    """
    start = time.perf_counter()
    problem = assemble_scene(told(first))
    loading_s = time.perf_counter() - start
    judges: list[Judge] = []

    def answer(question: dict[str, Any]) -> dict[str, Any]:
        if "prepare" in question:
            judge, facts = prepare(problem, question["out"], **question["prepare"])
        elif "restore" in question:
            judge, facts = restore(problem, question["targets"], **question["restore"])
        else:
            values = load(question["values"], problem.selection.keys)
            return {"loss": judges[0].loss(values), "error": judges[0].error(values)}
        judges.append(judge)
        return facts

    return {"loading_s": loading_s}, answer


def prepare(
    problem: Problem, out: str, budget_s: float, image_s: float, camera: bool, named: bool, light: bool = True
) -> tuple[Judge, dict[str, Any]]:
    """Make the targets, and write them to `out`; `budget_s` is the time of the whole, `image_s` that of one judgement.

    Where the `camera`'s paths take part, which may be left out unless they are `named`, and such from the `light`
    alone, all leave out the film's border. The facts: `masked` (whether that is so), `without` (stock integrators that
    are right for nothing here, and the reason), `paths` (those of the images), `loss` and `error` of the initial
    values, the seconds that a judgement takes (`judge_s`), the samples of its images (`spp`), and in words `pictures`
    and `error_of`.
    """
    references = find_references(problem, "loss")
    without = references["without"]
    initial = copies(problem)
    films = [problem.scene.sensors()[sensor].film() for sensor in problem.sensors]
    pixels = sum(int(np.prod(film.crop_size())) for film in films)
    paths = affordable_paths(problem, pixels, TARGET_SHARE * budget_s)
    problem, shortened = shorten_target(problem, paths // pixels)
    problem = find_reached(make_targets(problem, lambda line: None))
    with open(out, "wb") as file:
        np.savez(file, **target_arrays(problem.views))  # type: ignore[arg-type]
    masked = light and camera and (named or "prb" not in without) and leave_out_border(problem)
    affordable = affordable_paths(problem, pixels, image_s) // pixels
    spp = multiple_of(max(affordable, LEAST_SPP), problem.samples_per_pass)
    judge, facts = _judge(problem, spp, initial)
    kind = "RMSE of the parameters" if judge.meter.one_unit else "relative RMSE of the parameters"
    pictures = f"losses of images of {spp} spp{shortened}"
    found = {
        "without": without,
        "paths": references["paths"],
        "error_of": kind if facts["error"] is not None else "",
        "pictures": pictures,
    }
    return judge, facts | found | {"spp": spp, "masked": masked}


def restore(problem: Problem, targets: str, spp: int, masked: bool) -> tuple[Judge, dict[str, Any]]:
    """What judges as another did, by the `targets` in a file that `prepare` wrote, and images of so many samples.

    The facts: `loss` and `error` of the initial values, and `judge_s`.
    """
    initial = copies(problem)
    problem = make_targets(shorten_target(problem, 1)[0], lambda line: None)  # for the sake of the true values
    with np.load(targets) as found:
        set_targets(problem.views, found)
    problem = find_reached(problem)
    if masked:
        leave_out_border(problem)
    return _judge(problem, spp, initial)


def _judge(problem: Problem, spp: int, initial: dict[str, Array]) -> tuple[Judge, dict[str, Any]]:
    """What judges, warm, and what it says of the initial values."""
    judge = Judge(problem, spp)
    judge.loss(initial)  # which compiles
    start = time.perf_counter()
    loss = judge.loss(initial)
    return judge, {"loss": loss, "judge_s": time.perf_counter() - start, "error": judge.error(initial)}


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


def begin_run(first: dict[str, Any]) -> Begun:
    """Begin the process. A question asks for the state at `until_s`, with no more than `limit_s` ever to come.

    Its values go to the file `out`; the answer has its `iteration`, the time of the first one, whether all of them are
    done, and the peak of Dr.Jit's arrays.
    """
    start = time.perf_counter()
    problem = fit_memory(assemble_scene(told(first)))
    with np.load(first["targets"]) as targets:
        set_targets(problem.views, targets)
    if first["masked"]:
        leave_out_border(problem)
    # No cache: the measuring before the first iteration is part of the run's time.
    problem = settle(problem, lambda line: None)
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
    """What was decided, in words, without figures, which differ every time."""
    return [f"{each.setting} {each.value}" for each in problem.decisions]


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
