"""Whether a run's emission is guided, settled before its first iteration where that is left to measurement."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Reslrb
from reslrb_cli.config.files import in_words
from reslrb_cli.integrators import Reslrb as Tracer
from reslrb_cli.integrators import render_image
from reslrb_cli.integrators.guiding import Purpose
from reslrb_cli.integrators.interface import Job
from reslrb_cli.optimization.choice import Cache, Say, situation
from reslrb_cli.optimization.guiding_pilot import GuidingPilot, Sizes, Taken
from reslrb_cli.optimization.pilot import SHARE as PILOT_SHARE
from reslrb_cli.optimization.samples import take_gradient
from reslrb_cli.optimization.views import View, slope, to_tensor
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.records.guided import GuidedRecord
from reslrb_cli.records.pilot_cache import key_of
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]

#: Views that are looked at, spread over those that are trained on, and values of each one's image.
MOST_VIEWS, MOST_VALUES = 4, 2**15
#: Samples of the image that dL/dI is held at, as a share of a step's.
IMAGE_SHARE = 0.25


def settle_guiding(problem: Problem, say: Say, cache: Cache | None = None) -> None:
    """Have `problem.integrator`, whose estimator is settled, guided where that is left to measurement, and pays.

    Needs the targets. `problem.guided` is what was measured.
    """
    if not is_undecided(problem):
        return
    problem.guided = _record(problem, say, cache)
    say(problem.guided.line())
    if take_up(problem) and problem.memory is not None:
        plan = problem.memory
        expected = replace(plan.expected_bytes, fixed=plan.expected_bytes.fixed + table_bytes(problem))
        problem.memory = replace(plan, expected_bytes=expected)


def is_undecided(problem: Problem) -> bool:
    """Whether it is left to measurement."""
    integrator = problem.config.integrator
    return isinstance(integrator, Reslrb) and integrator.guiding == "auto"


def take_up(problem: Problem) -> bool:
    """Do as `problem.guided` says; whether that makes `problem.integrator` a guided one."""
    if problem.guided is None or not problem.guided.guided:
        return False
    problem.integrator = problem.integrator.afresh(guided=True, images=problem.guided.images)
    return True


def table_bytes(problem: Problem) -> int:
    """Bytes of the tables of all sensors, if `problem.integrator` is guided, or were."""
    made = problem.integrator.afresh(guided=True)
    made.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # cuts the grid
    return int(made.preparation.guiding.bytes(len(problem.sensors)))


def _record(problem: Problem, say: Say, cache: Cache | None) -> GuidedRecord:
    """What an earlier run measured, or what is measured now."""
    if problem.memory is not None:
        free, needed = problem.memory.budget_bytes - problem.memory.expected_bytes.total, table_bytes(problem)
        if needed > free:
            return GuidedRecord(False, note=f"run.memory_budget has no room for tables of {in_words(needed)}")
    chosen = None if problem.pilot is None else problem.pilot.chosen
    key = "" if cache is None else key_of({"guiding": 1, "of": chosen, **situation(problem)})
    if cache is not None:
        try:
            return replace(GuidedRecord.from_json(cache.get(key) or {}), cached=True)
        except TypeError:
            pass  # nothing there, or nothing that this version wrote
    say("guiding auto: measuring")
    trial = StepTrial(problem)
    views = len(problem.drawn(0)) / len(trial.views)
    share = max(PILOT_SHARE - (0.0 if problem.pilot is None else problem.pilot.share), 0.0)
    record = GuidingPilot(trial, sizes(problem), views, share).run()
    if cache is not None:
        cache.put(key, record.to_json())
    return record


def sizes(problem: Problem) -> Sizes:
    """The samples of the run's steps."""
    run, adjoint = problem.config.run, problem.config.adjoint
    call = run.spp // run.batches if adjoint == "batched" else run.spp
    part = min(problem.samples_per_pass or call, call)
    entries = sum(problem.selection.array(key).size for key in problem.selection.keys)
    return Sizes(run.spp, call, part, adjoint == "independent", entries)


class StepTrial:
    """Steps of a problem as `problem.integrator` takes them, guided or not; they leave neither gradient nor change
    behind. `views` are those that are looked at."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._clock = problem, StepClock()
        self._adjoint = problem.config.adjoint
        # Of their own: tables and recordings of other sample counts end with them.
        plain: Tracer = problem.integrator
        made = {guided: plain.afresh(guided=guided) for guided in (False, True)}
        self._tracers = {g: one.with_options(samples_per_pass=None, freeze=plain.freeze) for g, one in made.items()}
        trained = problem.trained
        count = min(len(trained), MOST_VIEWS)
        self.views = [trained[k * len(trained) // count] for k in range(count)]
        problem.apply()
        self._slopes = [self._slope(view) for view in self.views]
        take_gradient(problem)  # recovered exposures have some of these

    def _slope(self, view: View) -> mi.TensorXf:
        """dL/dI, which is held; 0 where it is not finite."""
        spp = max(int(IMAGE_SHARE * self._problem.config.run.spp), 1)
        image = render_image(self._tracers[False], self._problem.scene, view.sensor, self._seed(0, view, "image"), spp)
        return to_tensor(np.nan_to_num(slope(view.objective, np.array(image)), nan=0.0, posinf=0.0, neginf=0.0))

    def learn(self, round: int, spp: int) -> Taken:
        """Have the table learn, and be ready to be drawn from, as it is from then on."""
        tracer = self._tracers[True]
        guiding = tracer.preparation.guiding
        assert guiding is not None
        guiding.held = False
        with self._clock.step() as times:
            for view, gradient in zip(self.views, self._slopes, strict=True):
                job = self._job(view, self._seed(round, view, "learned from"), spp)
                tracer.learn_now(job, gradient)
                for purpose in Purpose if self._adjoint == "independent" else (Purpose.BOTH, Purpose.IMAGE):
                    tracer.passes(job, purpose)
        guiding.held = True
        return _taken(times)

    def take(self, guided: bool, round: int, spp: int) -> Taken:
        """One step of all views."""
        problem, images = self._problem, {}
        tracer, name = self._tracers[guided], "on" if guided else "off"
        problem.apply()
        with self._clock.step() as times:
            for view, gradient in zip(self.views, self._slopes, strict=True):
                job = self._job(view, self._seed(round, view, name), spp)
                image = self._differentiate(tracer, view, job, gradient)
                gradients = problem.gradients()
                dr.eval(image, gradients)
                images[str(view.sensor)] = image
        taken = _taken(times)
        taken.gradients = take_gradient(problem)
        if self._adjoint == "independent":
            with self._clock.step() as times:
                for view in self.views:
                    job = self._job(view, self._seed(round, view, f"image, {name}"), spp)
                    images[str(view.sensor)] = tracer.image(job)
            other = _taken(times)
            taken.image_ms = other.kernel_ms
            taken.wall_ms, taken.compile_ms = taken.wall_ms + other.wall_ms, taken.compile_ms + other.compile_ms
        taken.images = {name: _few(image) for name, image in images.items()}
        return taken

    def _differentiate(self, tracer: Tracer, view: View, job: Job, gradient: mi.TensorXf) -> mi.TensorXf | None:
        """Add the gradient of a job's samples, as a step of the run does; their image, where there is one."""
        on_samples = self._problem.on_samples(view)
        if self._adjoint == "correlated":
            image = tracer.correlated(job, lambda image: gradient)
        elif self._adjoint == "independent" and on_samples is None:
            tracer.backward(job, gradient)
            return None
        else:
            image = tracer.known(job, gradient)
        if on_samples is not None:
            on_samples(image, gradient)
        return image

    def _job(self, view: View, number: int, spp: int) -> Job:
        scene = self._problem.scene
        opaque = dr.opaque(mi.UInt32, number)
        return Job(scene, scene.sensors()[view.sensor], opaque, spp, self._problem.selection.params)

    def _seed(self, round: int, view: View, what: str) -> int:
        return seed(self._problem.config.run.seed, round, view.sensor, f"guiding, {what}")


def _taken(times: StepTimes) -> Taken:
    # Kernels are compiled side by side: their times can add up to more than was waited for.
    wall_ms = max(times.wall_ms - times.codegen_ms, times.kernel_ms)
    return Taken(kernel_ms=times.kernel_ms, wall_ms=wall_ms, compile_ms=times.codegen_ms)


def _few(image: mi.TensorXf) -> Array:
    """Values of an image, spread over it, 0 where they are not finite."""
    values = np.array(image, dtype=np.float32).ravel()
    values = values[:: -(-values.size // MOST_VALUES)]
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
