"""Races of two ways to sample a gradient, before a run's first iteration, by steps of both.

- `compare`: how much more efficient one way is than another, and how sure:

      gain = (variance * time of the one) / (variance * time of the other)

  Variance is summed over the parameters, each over its gradient's mean square. The interval is that of the logarithm of
  the variances' quotient by the jackknife over the steps, and of times by what a single one may be off.
- `Turns`: whether another way of taking steps pays, by steps of both in turns, whose gradients estimate the same. Times
  are those of kernels, and, alike for both, what goes on beside them in a run for as many samples, which counts where
  iterations take milliseconds. A table that steps draw from is learned first, of other paths than theirs, and held.
- `StepTrial`: the steps of a problem, with dL/dI held at one image's.

`sampling.py` says what is raced.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.guiding.tables import Guiding, Purpose, learnings
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.integrators.step import render_image
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import finite, sample_gradient, take_gradient
from reslrb_cli.optimization.views import View, slope, to_tensor
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array, jackknife_variance, sum_of_squares

#: Relative error of a single time that must not decide anything.
TIMING_NOISE = 1.1
CONFIDENCE = 0.95
#: An image that serves the gradient too may lose so much of its efficiency.
LEAST_IMAGE = 0.95
#: What is left of a sum where nothing should be, as a share of it.
ROUNDING = 1e-12
#: Views that are looked at, spread over those that are trained on, and values of each one's image.
MOST_VIEWS, MOST_VALUES = 4, 2**15
#: Samples of the image that dL/dI is held at, as a share of a step's.
IMAGE_SHARE = 0.25
Gradients = dict[str, Array]
#: A gain and the ends of its interval; nothing where it cannot be told.
Gain = tuple[float, float, float] | tuple[None, None, None]
NOTHING: Gain = (None, None, None)


# --- steps, and how they compare --------------------------------------------------------------------------------------


@dataclass
class Step:
    """A step, or a walk that was learned from: its gradients, its image by view, and milliseconds: of the kernels, of
    those of an image that has samples of its own, and all that was waited for but for `compile_ms`, in which kernels
    were generated and compiled."""

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


def timed(times: StepTimes, wall_ms: float | None = None) -> Step:
    """A step that took so long; `wall_ms` where more was waited for than the clock saw."""
    # Kernels are compiled side by side: their times can add up to more than was waited for.
    waited_ms = max((times.wall_ms if wall_ms is None else wall_ms) - times.codegen_ms, times.kernel_ms)
    return Step(kernel_ms=times.kernel_ms, wall_ms=waited_ms, compile_ms=times.codegen_ms)


def measured_step(problem: Problem, integrator: Any, clock: StepClock, round: int, spp: int) -> Step:
    """Take one step of all views, with seeds of its own; leave neither gradient nor change behind."""
    start = time.perf_counter()
    problem.apply()
    with clock.step() as times:
        sample_gradient(problem, integrator, round, "pilot", spp)
    gradients = take_gradient(problem)
    return replace(timed(times, 1e3 * (time.perf_counter() - start)), gradients=gradients)


def compare(
    own: Sequence[Gradients],
    own_ms: Sequence[float],
    other: Sequence[Gradients],
    other_ms: Sequence[float],
    confidence: float = CONFIDENCE,
) -> Gain:
    """The efficiency of the other over that of the own, and its interval; nothing where one has no noise.

    Gradients are those of each step by parameter (three steps or more), times those of steps in any unit.
    """
    units = scales([*own, *other])
    found = [_log_variances(gradients, units) for gradients in (own, other)] if units else [None]  # of no light, say
    known = [each for each in found if each is not None]
    if len(known) < 2:
        return NOTHING
    from scipy.special import stdtrit  # late: every run imports this module, and few come here

    times = statistics.median(own_ms) / max(statistics.median(other_ms), 1e-6)
    advantage = math.exp(known[0][0] - known[1][0]) * times
    variance = sum(float(jackknife_variance(without)) for _, without in known)
    half = float(stdtrit(min(len(own), len(other)) - 1, (1 + confidence) / 2)) * math.sqrt(variance)
    factor = math.exp(min(half, 50.0)) * TIMING_NOISE
    return advantage, advantage / factor, advantage * factor


def scales(gradients: Sequence[Gradients]) -> dict[str, float]:
    """The mean square norm of each parameter's gradient, of those that have any."""
    found = {key: float(np.mean([sum_of_squares(g[key]) for g in gradients])) for key in gradients[0]}
    return {key: scale for key, scale in found.items() if scale > 0}


def _log_variances(gradients: Sequence[Gradients], scales: dict[str, float]) -> tuple[float, Array] | None:
    """The logarithm of the variance of all parameters, and that without each of the rounds in turn."""
    rows = np.array([
        np.concatenate([g[key].astype(np.float64) / math.sqrt(scale) for key, scale in scales.items()])
        for g in gradients
    ])  # fmt: skip
    count = len(rows)
    squares = np.square(rows - rows.mean(axis=0)).sum(axis=1) if rows.size else np.zeros(count)
    whole = float(squares.sum())
    # What a row takes with it is its own distance, and that of the mean of the others from that of all.
    without = whole - squares * count / (count - 1)
    if not without.min() > ROUNDING * whole:
        return None
    return math.log(whole / (count - 1)), np.log(without / (count - 2))


# --- two ways in turns ------------------------------------------------------------------------------------------------

#: Fewer rounds than these say nothing.
LEAST_ROUNDS = 4
#: Rounds that are planned for, of gradients of many entries, and of few, which tell less each.
ROUNDS, ROUNDS_OF_FEW, FEW_ENTRIES = 8, 16, 64
#: After the planned rounds, and after each such number more, the race ends if it is clear; so often at the most.
LOOKS = 3
#: What is on before the last of these looks has to be surer than it would have to be at the end: looking again and
#: again must not make what is worth nothing pass.
CLEAR = 0.99
#: Steps' worth of time that the rounds are planned for.
PLANNED = 3.4
#: Samples of each walk that a table learns from, as a share of a step's, and walks that it learns from before it is
#: tried, where there is time for more than one.
LEARNING_SHARE, LEARNINGS = 0.4, 2


def sets_of(config: Config) -> int:
    """The sets that a step's samples are traced in: those that have one dL/dI each, or the halves of these."""
    return (config.run.batches if config.adjoint == "batched" else 1) * config.halves * config.shares


def lessons(problem: Problem) -> float:
    """How often tables of guided emission learn in an iteration of the run, in the mean over all of it."""
    run, sensors = problem.config.run, len(problem.trained)
    each = run.batches - (run.first_batch == "image") if problem.config.adjoint == "batched" else 1
    each = each * problem.config.halves if problem.config.shards == 1 else 1  # of shards, once a step
    gradients = run.iterations * each * len(problem.drawn(0)) / sensors
    return learnings(max(round(gradients), 1)) * sensors / run.iterations


@dataclass(frozen=True)
class Sizes:
    """Samples per pixel: of a step of the run (`step`), of each set of its samples that has one dL/dI (`call`), and of
    a pass of these (`part`). `alone`: images have samples of their own. `rounds` are planned for. `lessons` says how
    often tables of guided emission learn for each such set, in the mean over the run. A step of the other kind may take
    `longer` times as long as one of this; `planned` are PLANNED, or less."""

    step: int
    call: int
    part: int
    alone: bool
    rounds: int
    lessons: float
    longer: float
    planned: float = PLANNED

    @property
    def trial(self) -> int:
        """Samples of each step that is taken here."""
        return max(min(int(self.planned * self.step / ((1 + self.longer) * self.rounds)), self.part), 1)

    @property
    def learning(self) -> int:
        """Samples of each walk that is learned from here."""
        return max(min(int(LEARNING_SHARE * self.step), self.part), 1)


def sizes(problem: Problem, longer: float, planned: float = PLANNED) -> Sizes:
    """The samples of the run's steps, and what is planned of those that are taken here."""
    run, adjoint = problem.config.run, problem.config.adjoint
    call = run.spp // sets_of(problem.config)
    part = min(problem.samples_per_pass or call, call)
    entries = sum(problem.selection.array(key).size for key in problem.selection.keys)
    learned = lessons(problem) / (run.spp / call * len(problem.drawn(0)))
    rounds = ROUNDS_OF_FEW if entries < FEW_ENTRIES else ROUNDS
    return Sizes(run.spp, call, part, adjoint == "independent", rounds, learned, longer, planned)


#: A step as it is, or one the other way, of a round and so many samples per pixel; from what the table has learned,
#: which stays as it is. Equal rounds have equal seeds, others than those of any walk that is learned from.
Take = Callable[[bool, int, int], Step]
#: Have the table learn, from a walk of a round and so many samples per pixel; what is not given is left at 0.
Learn = Callable[[int, int], Step]


@dataclass(frozen=True)
class Finding:
    """The result of a race: whether the `other` way is better, and whether `images` of their own samples are drawn that
    way too; the gain of the other way, and a `note` where the gain alone does not decide."""

    other: bool
    images: bool
    gain: Gain
    note: str
    rounds: int
    spent_s: float

    def why(self) -> str:
        """Return the gain, or why there is none, in words."""
        gain, low, high = self.gain
        if gain is None:
            return self.note
        found = f"{gain:.2g} times the efficiency here ({low:.2g} to {high:.2g})"
        return f"{found}; {self.note}" if self.note else found


class Turns:
    """A race, by steps that `take` takes, and walks that `learn` does, where a table has yet to learn.

    It ends when `limit_s` seconds are spent. With `sure` it takes all planned rounds first, or as many as a step has
    samples: steps of milliseconds, whose time is Python's, are measured too. With `guides` the other way is guided:
    it costs what tables go on learning in the run, and images that have samples of their own are decided apart.
    """

    def __init__(
        self,
        take: Take,
        sizes: Sizes,
        limit_s: float,
        learn: Learn | None = None,
        guides: bool = False,
        sure: bool = False,
    ) -> None:
        self._spent_ms = 0.0
        self._take, self._learn, self._sizes = take, learn, sizes
        self._limit_ms, self._guides = 1e3 * limit_s, guides
        self._sure = max(min(sizes.rounds, sizes.step), LEAST_ROUNDS) if sure else 0
        self._apart = guides and sizes.alone
        self._plain: list[Step] = []  # all steps as they are whose times count
        self._steps: tuple[list[Step], list[Step]] = ([], [])  # of either kind
        self._walk = Step()

    def run(self) -> Finding:
        """Measure, and decide."""
        spp, take = self._sizes.trial, self._take
        self._spend(take(False, 0, spp))  # compiles kernels
        plain = self._spend(take(False, 0, spp))
        self._plain.append(plain)
        # What Python takes is the same for both.
        kernels = (1 + self._sizes.longer) * (plain.kernel_ms + plain.image_ms)
        if not self._learned(kernels + 2 * plain.beside_ms):
            return self._found(f"to measure it would take more than {self._limit_ms / 1e3:.2g} s")
        self._spend(take(True, 0, spp))
        for round in range(1, 1 + LOOKS * self._sizes.rounds):
            for other in (False, True):
                self._steps[other].append(self._spend(take(other, round, spp)))
            self._plain.append(self._steps[False][-1])
            if not self._affords(sum(steps[-1].wall_ms for steps in self._steps)):
                break
            if round % self._sizes.rounds == 0 and self._is_clear():
                break
        return self._decided()

    def _learned(self, round_ms: float) -> bool:
        """Have the table learn, if it has not; False where that, and rounds of so long, cannot be afforded."""
        if self._learn is None:
            return self._affords(LEAST_ROUNDS * round_ms)
        self._walk = self._spend(self._learn(0, self._sizes.learning))
        if not self._affords(LEAST_ROUNDS * round_ms):
            return False
        # What one walk more would gain is little beside what rounds that are too few leave open.
        rounds = max(self._sizes.rounds // 2, LEAST_ROUNDS)
        for number in range(1, LEARNINGS):
            if self._affords(self._walk.wall_ms + rounds * round_ms):
                self._walk = self._spend(self._learn(number, self._sizes.learning))
        return True

    @property
    def _python_ms(self) -> float:
        """What goes on beside the kernels of `trial` samples in a run, which has it once for each `call`."""
        beside = statistics.median(step.beside_ms for step in self._plain)
        return beside * self._sizes.trial / self._sizes.call

    def _affords(self, more_ms: float) -> bool:
        return len(self._steps[True]) < self._sure or self._spent_ms + more_ms <= self._limit_ms

    def _learning_ms(self) -> float:
        """What tables that learn add to a guided step of `trial` samples, in the mean over the run."""
        sizes = self._sizes
        kernel = self._walk.kernel_ms * sizes.part / sizes.learning
        return (kernel + self._walk.beside_ms) * sizes.lessons * sizes.trial / sizes.call

    def _times(self, other: bool, images: bool) -> list[float]:
        """Of steps of one kind, whose images, where they have samples of their own, are drawn the other way or not."""
        beside = self._python_ms + (self._learning_ms() if other and self._guides else 0.0)
        if self._sizes.alone:
            beside += statistics.median(step.image_ms for step in self._steps[other and images])
        return [step.kernel_ms + beside for step in self._steps[other]]

    def _gain(self, images: bool, confidence: float = CONFIDENCE) -> Gain:
        """Of the gradient, as part of steps whose images are drawn the other way or not."""
        own, other = ([step.gradients for step in steps] for steps in self._steps)
        return compare(own, self._times(False, images), other, self._times(True, images), confidence)

    def _image_gain(self) -> Gain:
        """Of the image: of samples of its own, where it has them, else of those that serve the gradient too."""
        own, other = ([step.images for step in steps] for steps in self._steps)
        times = [self._times(each, False) for each in (False, True)]
        if self._sizes.alone:  # what goes on beside kernels counts once, with the gradient
            times = [[step.image_ms for step in steps] for steps in self._steps]
        return compare(own, times[0], other, times[1])

    def _is_clear(self) -> bool:
        """Whether no more steps are needed: it is not on by accident, or off at all events."""
        _, low, high = self._gain(not self._apart or self._images(self._image_gain()), CLEAR)
        return low is None or high is None or low > 1 or high < 1

    def _images(self, gain: Gain) -> bool:
        """Whether images are to be drawn so too; where that is not decided apart, whether no harm to them is seen."""
        if self._apart:
            return gain[1] is not None and gain[1] > 1
        return gain[2] is None or gain[2] >= LEAST_IMAGE

    def _decided(self) -> Finding:
        if len(self._steps[False]) < LEAST_ROUNDS:
            return self._found(f"{len(self._steps[False])} steps of both are too few to tell")
        picture = self._image_gain()
        images = self._images(picture)
        gain = self._gain(images or not self._apart)
        if gain[1] is None:
            return self._found("gradients have no noise")
        note = ""
        if gain[1] > 1 and not (images or self._apart):
            whose = "images have" if self._sizes.alone else "the image, of the same samples, has"
            note = f"{whose} {picture[0]:.2g} times the efficiency"
        on = gain[1] > 1 and not note
        return self._found(note, gain, on, on and images)

    def _found(self, note: str, gain: Gain = NOTHING, other: bool = False, images: bool = False) -> Finding:
        return Finding(other, images, gain, note, len(self._steps[True]), self._spent_ms / 1e3)

    def _spend(self, step: Step) -> Step:
        self._spent_ms += step.wall_ms + step.compile_ms
        return step


# --- steps ------------------------------------------------------------------------------------------------------------


class StepTrial:
    """Steps of a problem by `plain`, or by `other`; they leave neither gradient nor change behind.

    `views` are those that are looked at. All guided steps draw from one table, which `learn` fills. Seeds depend on
    `what` is decided.
    """

    def __init__(self, problem: Problem, what: str, plain: Tracer, other: Tracer) -> None:
        self._problem, self._what, self._clock = problem, what, StepClock()
        self._adjoint = problem.config.adjoint
        # Of their own: tables and recordings of other sample counts end with them.
        self._tracers = [one.with_options(samples_per_pass=None, freeze=one.freeze) for one in (plain, other)]
        self._guided = [one for one in self._tracers if one.preparation.guiding is not None]
        self.table: Guiding | None = self._guided[0].preparation.guiding if self._guided else None
        if self.table is not None:
            self.table.held = True  # steps are not to teach it
            for tracer in self._guided:
                tracer.preparation.draw_from(self.table, problem.scene)
        problem.apply()
        trained = problem.trained
        count = min(len(trained), MOST_VIEWS)
        self.views = [trained[k * len(trained) // count] for k in range(count)]
        self._slopes = [self._slope(view) for view in self.views]
        take_gradient(problem)  # recovered exposures have some of these

    def race(self, sizes: Sizes, limit_s: float, guides: bool = False, sure: bool = False) -> Finding:
        """Have these steps take turns."""
        learn = None if self.table is None else self.learn
        return Turns(self.take, sizes, limit_s, learn, guides, sure).run()

    def _slope(self, view: View) -> mi.TensorXf:
        """dL/dI, which is held; 0 where it is not finite."""
        spp = max(int(IMAGE_SHARE * self._problem.config.run.spp), 1)
        image = render_image(self._tracers[False], self._problem.scene, view.sensor, self._seed(0, view, "image"), spp)
        return to_tensor(finite(slope(view.objective, np.array(image))))

    def learn(self, round: int, spp: int) -> Step:
        """Have the table learn, and be ready to be drawn from, as it is from then on.

        The first time all of it is done before as well, and forgotten: what that compiles and records is no part of the
        time.
        """
        jobs = [self._job(view, self._seed(round, view, "learned from"), spp) for view in self.views]
        compile_ms = 0.0
        assert self.table is not None
        if not self.table.learned:
            compile_ms = self._teach(self.table, jobs).wall_ms
            self.table.forget()
        taken = timed(self._teach(self.table, jobs))
        taken.compile_ms += compile_ms
        return taken

    def _teach(self, table: Guiding, jobs: list[Job]) -> StepTimes:
        with self._clock.step() as times:
            for view, job, gradient in zip(self.views, jobs, self._slopes, strict=True):
                self._guided[0].learn_now(job, gradient)
                for purpose in Purpose if self._adjoint == "independent" else (Purpose.BOTH, Purpose.IMAGE):
                    table.table(view.sensor, purpose)
        return times

    def take(self, other: bool, round: int, spp: int) -> Step:
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
        taken = timed(times)
        taken.gradients = take_gradient(problem)
        if self._adjoint == "independent":
            with self._clock.step() as times:
                for view in self.views:
                    job = self._job(view, self._seed(round, view, f"image, {name}"), spp)
                    images[str(view.sensor)] = tracer.image(job)
            apart = timed(times)
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


def _few(image: mi.TensorXf) -> Array:
    """Values of an image, spread over it, 0 where they are not finite."""
    values = np.array(image, dtype=np.float32).ravel()
    return finite(values[:: -(-values.size // MOST_VALUES)])
