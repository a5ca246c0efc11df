"""Steps of a run, taken two ways in turns before its first iteration, with dL/dI held: what a `StepPilot` measures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators import Reslrb as Tracer
from reslrb_cli.integrators import render_image
from reslrb_cli.integrators.guiding import Guiding, Purpose, learnings
from reslrb_cli.integrators.interface import Job
from reslrb_cli.optimization.samples import take_gradient
from reslrb_cli.optimization.step_pilot import Taken
from reslrb_cli.optimization.step_sizes import PLANNED, Sizes
from reslrb_cli.optimization.views import View, slope, to_tensor
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]

#: Views that are looked at, spread over those that are trained on, and values of each one's image.
MOST_VIEWS, MOST_VALUES = 4, 2**15
#: Samples of the image that dL/dI is held at, as a share of a step's.
IMAGE_SHARE = 0.25


def sizes(problem: Problem, longer: float, planned: float = PLANNED) -> Sizes:
    """The samples of the run's steps, and what is planned of those that are taken here."""
    run, adjoint = problem.config.run, problem.config.adjoint
    call = run.spp // run.batches if adjoint == "batched" else run.spp
    part = min(problem.samples_per_pass or call, call)
    entries = sum(problem.selection.array(key).size for key in problem.selection.keys)
    sets = run.spp / call * len(problem.drawn(0))
    return Sizes(run.spp, call, part, adjoint == "independent", entries, lessons(problem) / sets, longer, planned)


def lessons(problem: Problem) -> float:
    """How often tables of guided emission learn in an iteration of the run, in the mean over all of it."""
    run, sensors = problem.config.run, len(problem.trained)
    each = run.batches - (run.first_batch == "image") if problem.config.adjoint == "batched" else 1
    gradients = run.iterations * each * len(problem.drawn(0)) / sensors
    return learnings(max(round(gradients), 1)) * sensors / run.iterations


class StepTrial:
    """Steps of a problem by `plain`, or by `other`; they leave neither gradient nor change behind.

    `views` are those that are looked at. Where either is guided, both that are draw from one table: that of `earlier`,
    if it has learned, else one that `learn` has learn. `what` is decided here, and `earlier` what was before, with the
    same estimator; dL/dI is held where it was held there.
    """

    def __init__(
        self, problem: Problem, what: str, plain: Tracer, other: Tracer, earlier: StepTrial | None = None
    ) -> None:
        self._problem, self._what, self._clock = problem, what, StepClock()
        self._adjoint = problem.config.adjoint
        # Of their own: tables and recordings of other sample counts end with them.
        made = {False: plain, True: other}
        self._tracers = {o: one.with_options(samples_per_pass=None, freeze=one.freeze) for o, one in made.items()}
        self._guided = [one for one in self._tracers.values() if one.preparation.guiding is not None]
        self.table: Guiding | None = self._one_table(None if earlier is None else earlier.table)
        problem.apply()
        if earlier is not None:
            self.views: list[View] = earlier.views
            self._slopes: list[mi.TensorXf] = earlier._slopes
            return
        trained = problem.trained
        count = min(len(trained), MOST_VIEWS)
        self.views = [trained[k * len(trained) // count] for k in range(count)]
        self._slopes = [self._slope(view) for view in self.views]
        take_gradient(problem)  # recovered exposures have some of these

    def _one_table(self, learned: Guiding | None) -> Guiding | None:
        """What all that are guided draw from; None where none is."""
        if not self._guided:
            return None
        own = self._guided[0].preparation.guiding
        assert own is not None
        table = learned or own
        table.images, table.held = own.images, True  # steps are not to teach it
        for tracer in self._guided:
            tracer.preparation.draw_from(table, self._problem.scene)
        return table

    def part_of_views(self) -> float:
        """How many times the views of an iteration are those of a step here."""
        return len(self._problem.drawn(0)) / len(self.views)

    @property
    def learns(self) -> bool:
        """Whether there is a table that has yet to learn."""
        return self.table is not None and not self.table.learned

    def _slope(self, view: View) -> mi.TensorXf:
        """dL/dI, which is held; 0 where it is not finite."""
        spp = max(int(IMAGE_SHARE * self._problem.config.run.spp), 1)
        image = render_image(self._tracers[False], self._problem.scene, view.sensor, self._seed(0, view, "image"), spp)
        return to_tensor(np.nan_to_num(slope(view.objective, np.array(image)), nan=0.0, posinf=0.0, neginf=0.0))

    def learn(self, round: int, spp: int) -> Taken:
        """Have the table learn, and be ready to be drawn from, as it is from then on.

        The first time all of it is done before as well, and forgotten: what that compiles and records is no part of the
        time.
        """
        jobs = [self._job(view, self._seed(round, view, "learned from"), spp) for view in self.views]
        compile_ms = 0.0
        assert self.table is not None
        if self.learns:
            with self._clock.step() as times:
                self._teach(self.table, jobs)
            self.table.forget()
            compile_ms = times.wall_ms
        with self._clock.step() as times:
            self._teach(self.table, jobs)
        taken = _taken(times)
        taken.compile_ms += compile_ms
        return taken

    def _teach(self, table: Guiding, jobs: list[Job]) -> None:
        for view, job, gradient in zip(self.views, jobs, self._slopes, strict=True):
            self._guided[0].learn_now(job, gradient)
            for purpose in Purpose if self._adjoint == "independent" else (Purpose.BOTH, Purpose.IMAGE):
                table.table(view.sensor, purpose)

    def take(self, other: bool, round: int, spp: int) -> Taken:
        """One step of all views."""
        problem, images = self._problem, {}
        tracer, name = self._tracers[other], "on" if other else "off"
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
            apart = _taken(times)
            taken.image_ms = apart.kernel_ms
            taken.wall_ms, taken.compile_ms = taken.wall_ms + apart.wall_ms, taken.compile_ms + apart.compile_ms
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
        return seed(self._problem.config.run.seed, round, view.sensor, f"{self._what}, {what}")


def _taken(times: StepTimes) -> Taken:
    # Kernels are compiled side by side: their times can add up to more than was waited for.
    wall_ms = max(times.wall_ms - times.codegen_ms, times.kernel_ms)
    return Taken(kernel_ms=times.kernel_ms, wall_ms=wall_ms, compile_ms=times.codegen_ms)


def _few(image: mi.TensorXf) -> Array:
    """Values of an image, spread over it, 0 where they are not finite."""
    values = np.array(image, dtype=np.float32).ravel()
    values = values[:: -(-values.size // MOST_VALUES)]
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
