"""Steps of a run taken two ways in turns, before its first iteration, with dL/dI held: whether one way pays.

- `Sizes`: how many samples these steps have, and how often tables of guided emission learn
- `StepTrial`: the steps of a problem, as they are or by another way of drawing samples
- `StepPilot`: whether that other way pays, decided from steps of both that take turns

Gradients have dL/dI held at one image's, so that both kinds estimate the same. Times are those of kernels, and, alike
for both kinds, what goes on beside them in a run for as many samples: it counts where iterations take milliseconds.
Where steps draw from a table that paths before them have made, it is learned first, and held: none of the steps' paths
is one that it learned from.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.guiding.tables import Guiding, Purpose, learnings
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.integrators.step import render_image
from reslrb_cli.optimization.autotune.efficiency import CONFIDENCE, ITERATIONS, Gain, Gradients, compare
from reslrb_cli.optimization.sensitivity import take_gradient
from reslrb_cli.optimization.views import View, slope, to_tensor
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.records.decisions import LEAST_IMAGE, PaidRecord
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


#: Rounds that are planned for, of gradients of many entries, and of few, which tell less each.
ROUNDS, ROUNDS_OF_FEW, FEW_ENTRIES = 8, 16, 64


#: Samples of each walk that a table learns from, as a share of a step's.
LEARNING_SHARE = 0.4


#: Steps' worth of time that the rounds are planned for.
PLANNED = 3.4


def lessons(problem: Problem) -> float:
    """How often tables of guided emission learn in an iteration of the run, in the mean over all of it."""
    run, sensors = problem.config.run, len(problem.trained)
    each = run.batches - (run.first_batch == "image") if problem.config.adjoint == "batched" else 1
    gradients = run.iterations * each * len(problem.drawn(0)) / sensors
    return learnings(max(round(gradients), 1)) * sensors / run.iterations


@dataclass(frozen=True)
class Sizes:
    """Samples per pixel: of a step of the run (`step`), of each set of its samples that has one dL/dI (`call`), and of
    a pass of these (`part`). `alone`: images have samples of their own. `entries` are those of all gradients.
    `lessons` says how often tables of guided emission learn for each such set, in the mean over the run. A step of the
    other kind may take `longer` times as long as one of this; `planned` are PLANNED, or less."""

    step: int
    call: int
    part: int
    alone: bool
    entries: int
    lessons: float
    longer: float
    planned: float = PLANNED

    @property
    def rounds(self) -> int:
        """How many rounds are planned for."""
        return ROUNDS_OF_FEW if self.entries < FEW_ENTRIES else ROUNDS

    @property
    def trial(self) -> int:
        """Samples of each step that is taken here."""
        return max(min(int(self.planned * self.step / ((1 + self.longer) * self.rounds)), self.part), 1)

    @property
    def learning(self) -> int:
        """Samples of each walk that is learned from here."""
        return max(min(int(LEARNING_SHARE * self.step), self.part), 1)


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


Record = TypeVar("Record", bound=PaidRecord)


#: Fewer rounds than these say nothing.
LEAST_ROUNDS = 4


#: Whenever as many rounds have been taken as are planned for it is asked whether it is clear, so often at the most.
LOOKS = 3


#: What is on before the last of these looks has to be surer than it would have to be at the end: looking again and
#: again must not make what is worth nothing pass.
CLEAR = 0.99


#: Walks that a table learns from before it is tried, where there is time for more than one.
LEARNINGS = 2


@dataclass
class Taken:
    """A step, or a walk that was learned from: its gradients, its image by view, and milliseconds: of the kernels, of
    those of an image that has samples of its own, and all that was waited for but for `compile_ms`."""

    gradients: Gradients = field(default_factory=dict)
    images: Gradients = field(default_factory=dict)
    kernel_ms: float = 0.0
    image_ms: float = 0.0
    wall_ms: float = 0.0
    compile_ms: float = 0.0

    @property
    def beside_ms(self) -> float:
        """What was waited for beside the kernels."""
        return max(self.wall_ms - self.kernel_ms - self.image_ms, 0.0)


class Trial(Protocol):
    """What is measured. Equal rounds have equal seeds, others than those of any walk that is learned from."""

    @property
    def learns(self) -> bool:
        """Whether there is a table that has yet to learn."""
        ...

    def learn(self, round: int, spp: int) -> Taken:
        """Have the table learn, from a walk of `spp` samples per pixel; what is not given is left at 0."""
        ...

    def take(self, other: bool, round: int, spp: int) -> Taken:
        """A step as it is, or one that draws the other way; from what the table has learned, which stays as it is."""
        ...


class StepPilot(Generic[Record]):
    """One decision. `views` is how many times the views of an iteration are those of a step here, `share` what of
    ITERATIONS this may cost."""

    def __init__(self, trial: Trial, sizes: Sizes, views: float, share: float) -> None:
        self._trial, self._sizes, self._views, self._share = trial, sizes, views, share
        self._spent_ms = self._compile_ms = 0.0
        self._plain: list[Taken] = []  # all steps as they are whose times count
        self._steps: dict[bool, list[Taken]] = {False: [], True: []}
        self._walk = Taken()

    def run(self) -> Record:
        """Measure, and decide."""
        spp = self._sizes.trial
        self._first(self._trial.take(False, 0, spp))
        plain = self._spend(self._trial.take(False, 0, spp))
        self._plain.append(plain)
        # What Python takes is the same for both.
        kernels = (1 + self._sizes.longer) * (plain.kernel_ms + plain.image_ms)
        if not self._learned(kernels + 2 * plain.beside_ms):
            return self._off(f"to measure it would cost more than {100 * self._share:.2g} % of {ITERATIONS} iterations")
        self._first(self._trial.take(True, 0, spp))
        for round in range(1, 1 + LOOKS * self._sizes.rounds):
            both = [self._spend(self._trial.take(other, round, spp)) for other in (False, True)]
            for other, step in zip((False, True), both, strict=True):
                self._steps[other].append(step)
            self._plain.append(both[0])
            if not self._affords(sum(step.wall_ms for step in both)):
                break
            if round % self._sizes.rounds == 0 and self._is_clear():
                break
        return self._decided()

    def _learned(self, round_ms: float) -> bool:
        """Have the table learn, if it has not; False where that, and rounds of so long, cannot be afforded."""
        if not self._trial.learns:
            return self._affords(LEAST_ROUNDS * round_ms)
        walk = self._trial.learn(0, self._sizes.learning)
        if not self._affords(walk.wall_ms + LEAST_ROUNDS * round_ms):
            self._first(walk)
            return False
        self._walk = self._spend(walk)
        # What one walk more would gain is little beside what rounds that are too few leave open.
        rounds = max(self._sizes.rounds // 2, LEAST_ROUNDS)
        for number in range(1, LEARNINGS):
            if self._affords(self._walk.wall_ms + rounds * round_ms):
                self._walk = self._spend(self._trial.learn(number, self._sizes.learning))
        return True

    # --- cost ---------------------------------------------------------------------------------------------------------

    def _first(self, taken: Taken) -> Taken:
        """A step that had its kernels compiled, whose times are not counted."""
        self._compile_ms += taken.wall_ms + taken.compile_ms
        return taken

    def _spend(self, taken: Taken) -> Taken:
        self._spent_ms += taken.wall_ms
        self._compile_ms += taken.compile_ms
        return taken

    @property
    def _iteration_ms(self) -> float:
        """Of the run: kernels of all its samples, and what goes on beside them for each set that has one dL/dI."""
        kernels = statistics.median(step.kernel_ms + step.image_ms for step in self._plain)
        return self._views * (kernels + self._python_ms) * self._sizes.step / self._sizes.trial

    @property
    def _python_ms(self) -> float:
        """What goes on beside the kernels of `trial` samples in a run, which has it once for each `call`."""
        beside = statistics.median(step.beside_ms for step in self._plain)
        return beside * self._sizes.trial / self._sizes.call

    def _affords(self, more_ms: float) -> bool:
        return self._spent_ms + more_ms <= self._share * ITERATIONS * self._iteration_ms

    # --- judgement ----------------------------------------------------------------------------------------------------

    @property
    def _apart(self) -> bool:
        """Whether it is decided apart for images that have samples of their own."""
        return False

    def _more_ms(self) -> float:
        """What a step of the other kind, of `trial` samples, takes in a run beside its own kernels."""
        return 0.0

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> Record:
        """The record of a decision, `found` what all of them hold."""
        raise NotImplementedError

    def _gain(self, images: bool, confidence: float = CONFIDENCE) -> Gain:
        """Of the gradient, as part of steps whose images, where they have samples of their own, are drawn so or not."""
        plain, other = self._steps[False], self._steps[True]
        beside = self._python_ms, self._python_ms + self._more_ms()
        if self._sizes.alone:
            own = [statistics.median(step.image_ms for step in steps) for steps in (plain, other)]
            beside = beside[0] + own[0], beside[1] + own[images]
        times = [[s.kernel_ms + more for s in steps] for steps, more in zip((plain, other), beside, strict=True)]
        gradients = [[step.gradients for step in steps] for steps in (plain, other)]
        return compare(gradients[0], times[0], gradients[1], times[1], confidence)

    def _image_gain(self) -> Gain:
        """Of the image: of samples of its own, where it has them, else of those that serve the gradient too."""
        plain, other = self._steps[False], self._steps[True]
        images = [[step.images for step in steps] for steps in (plain, other)]
        times = [[s.image_ms if self._sizes.alone else s.kernel_ms for s in steps] for steps in (plain, other)]
        if not self._sizes.alone:  # else both count once, with the gradient
            more = self._python_ms, self._python_ms + self._more_ms()
            times = [[ms + one for ms in row] for row, one in zip(times, more, strict=True)]
        return compare(images[0], times[0], images[1], times[1])

    def _is_clear(self) -> bool:
        """Whether no more steps are needed: it is not on by accident, or off at all events."""
        _, low, high = self._gain(not self._apart or self._images(self._image_gain()), CLEAR)
        return low is None or high is None or low > 1 or high < 1

    def _images(self, gain: Gain) -> bool:
        """Whether images are to be drawn so too; where that is not decided apart, whether no harm to them is seen."""
        if self._apart:
            return gain[1] is not None and gain[1] > 1
        return gain[2] is None or gain[2] >= LEAST_IMAGE

    def _decided(self) -> Record:
        if len(self._steps[False]) < LEAST_ROUNDS:
            return self._off(f"{len(self._steps[False])} steps of both are too few to tell")
        picture = self._image_gain()
        images = self._images(picture)
        gain = self._gain(images or not self._apart)
        if gain[1] is None:
            return self._off("gradients have no noise")
        note = ""
        if gain[1] > 1 and not (images or self._apart):
            whose = "images have" if self._sizes.alone else "the image, of the same samples, has"
            note = f"{whose} {picture[0]:.2g} times the efficiency"
        on = gain[1] > 1 and not note
        return self._record(on, on and images, gain, picture, note)

    def _off(self, note: str) -> Record:
        return self._record(False, False, (None, None, None), (None, None, None), note)

    def _record(self, other: bool, images: bool, gain: Gain, picture: Gain, note: str) -> Record:
        found = dict(zip(("gain", "low", "high"), gain, strict=True))
        found |= dict(zip(("image_gain", "image_low", "image_high"), picture, strict=True))
        rounds, share = len(self._steps[True]), self._spent_ms / (ITERATIONS * self._iteration_ms)
        seconds = {"measure_s": self._spent_ms / 1e3, "compile_s": self._compile_ms / 1e3}
        beside = {"rounds": rounds, "spp": self._sizes.trial, "share": share, "note": note}
        return self._decide(other, images, {**found, **seconds, **beside})
