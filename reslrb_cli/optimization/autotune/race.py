"""Races between two ways to sample a gradient, before the first iteration. `sampling` has the raced settings.

`StepTrial` takes the steps of a problem, with dL/dI fixed at one image. `Turns` takes a fixed number of steps of both
ways in turns, and decides. Both ways have the same mean, so the gain compares variance times time.

    gain = (variance * time of the one) / (variance * time of the other)

The variance is a sum over the parameters. Each parameter's variance is divided by the mean square of its gradient. The
jackknife over the steps gives the interval for the logarithm of the variance ratio. The error of single times is added.
Times include kernels and the run's other work, which counts equally for both ways. If steps sample from a table, the
table first learns from other paths, and then stays fixed.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.guiding.tables import Guiding, Purpose, learnings
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.integrators.step import render_image
from reslrb_cli.optimization.loading import pass_spp
from reslrb_cli.optimization.nonfinite import finite
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.optimization.views import View, slope, to_tensor
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array, jackknife_variance, special, squares_without, sum_of_squares

#: Relative error of a single time that must not decide anything.
TIMING_NOISE = 1.1
CONFIDENCE = 0.95
#: Minimum relative efficiency of the image.
LEAST_IMAGE = 0.95
#: Rounding error of a sum that should vanish, as a share of it.
ROUNDING = 1e-12
#: Views for the comparison, spread over the training views, and values of each image.
MOST_VIEWS, MOST_VALUES = 4, 2**15
#: Samples of the image at which dL/dI is fixed, as a share of a step's.
IMAGE_SHARE = 0.25
Gradients = dict[str, Array]
#: A gain and the ends of its interval.
Gain = tuple[float, float, float]


# --- steps, and how they compare --------------------------------------------------------------------------------------


@dataclass
class Step:
    """A gradient step or a learning walk, with its gradients, its image for each view, and times in milliseconds.

    `kernel_ms` is the time of the kernels. `image_ms` is the kernel time of an image with its own samples. `compile_ms`
    is the time to generate and compile kernels. `wall_ms` is everything else.
    """

    gradients: Gradients = field(default_factory=dict)
    images: Gradients = field(default_factory=dict)
    kernel_ms: float = 0.0
    image_ms: float = 0.0
    wall_ms: float = 0.0
    compile_ms: float = 0.0

    @property
    def beside_ms(self) -> float:
        """Time beside the kernels."""
        return max(self.wall_ms - self.kernel_ms - self.image_ms, 0.0)


def timed(times: StepTimes) -> Step:
    """Return a step with these times."""
    # Kernels are compiled in parallel: their times can add up to more than the wait.
    waited_ms = max(times.wall_ms - times.codegen_ms, times.kernel_ms)
    return Step(kernel_ms=times.kernel_ms, wall_ms=waited_ms, compile_ms=times.codegen_ms)


def measured_step(problem: Problem, integrator: Any, clock: StepClock, round: int, spp: int) -> Step:
    """Take one step of all views, with separate seeds. Leaves neither a gradient nor a change."""
    with clock.step() as times:
        problem.apply()
        sample_gradient(problem, integrator, round, "pilot", spp)
        take_gradient(problem)
    return timed(times)


def compare(
    own: Sequence[Gradients], own_ms: Sequence[float], other: Sequence[Gradients], other_ms: Sequence[float]
) -> Gain | None:  # fmt: skip
    """Return the efficiency of `other` divided by the efficiency of `own`, with the confidence interval of the ratio.

    `own` and `other` have the gradients of at least three steps, by parameter. `own_ms` and `other_ms` have the times
    of steps in any unit. Returns None if one way has no noise.
    """
    squares = {key: float(np.mean([sum_of_squares(g[key]) for g in (*own, *other)])) for key in own[0]}
    known = [_log_variances(gradients, {key: square for key, square in squares.items() if square > 0})
             for gradients in (own, other)]  # fmt: skip
    if known[0] is None or known[1] is None:
        return None
    times = statistics.median(own_ms) / max(statistics.median(other_ms), 1e-6)
    advantage = math.exp(known[0][0] - known[1][0]) * times
    variance = sum(float(jackknife_variance(each[1])) for each in known if each is not None)
    half = float(special().stdtrit(min(len(own), len(other)) - 1, (1 + CONFIDENCE) / 2)) * math.sqrt(variance)
    factor = math.exp(min(half, 50.0)) * TIMING_NOISE
    return advantage, advantage / factor, advantage * factor


def _log_variances(gradients: Sequence[Gradients], squares: dict[str, float]) -> tuple[float, Array] | None:
    """Return the logarithm of the total variance of all parameters. Also return the logarithms with each round left out
    in turn. Return None without noise. `squares` has the mean square norm of each parameter's gradient.
    """
    if not squares:  # such as no light
        return None
    rows = np.array([
        np.concatenate([g[key].astype(np.float64) / math.sqrt(square) for key, square in squares.items()])
        for g in gradients
    ])  # fmt: skip
    whole, without = squares_without(rows)
    if not without.min() > ROUNDING * whole:
        return None
    return math.log(whole / (len(rows) - 1)), np.log(without / (len(rows) - 2))


# --- two ways in turns ------------------------------------------------------------------------------------------------

#: Fewer rounds give no result.
LEAST_ROUNDS = 4
#: Rounds for gradients with many entries, and with few, which tell less per round.
ROUNDS, ROUNDS_OF_FEW, FEW_ENTRIES = 8, 16, 64
#: Time for all rounds, in steps.
PLANNED = 3.4
#: Samples of the walk for learning, as a share of a step's.
LEARNING_SHARE = 0.6


def lessons(problem: Problem) -> float:
    """Return how often tables of guided emission learn per iteration, as the mean over the run."""
    run, sensors = problem.config.run, len(problem.trained)
    each = run.batches - 1 if problem.config.adjoint == "batched" else 1
    each = each if problem.config.shards == 1 else 1  # of shards, once a step
    gradients = run.iterations * each * len(problem.drawn(0)) / sensors
    return learnings(max(round(gradients), 1)) * sensors / run.iterations


@dataclass(frozen=True)
class Sizes:
    """Samples per pixel. `step` is the sample count per step of the run, `call` per set with one dL/dI, and `part` per
    pass of a set.

    `alone` tells whether images have their own samples. `rounds` is the number of rounds. `lessons` is how
    often tables of guided emission learn for each set, averaged over the run. A step with the option may take `longer`
    times as long as a plain step. `planned` is at most PLANNED.
    """

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
        """Samples of each measured step."""
        return max(min(int(self.planned * self.step / ((1 + self.longer) * self.rounds)), self.part), 1)

    @property
    def learning(self) -> int:
        """Samples of the learning walk."""
        return max(min(int(LEARNING_SHARE * self.step), self.part), 1)


def sizes(problem: Problem, longer: float, planned: float = PLANNED) -> Sizes:
    """Return the sample counts of the run's steps and of the planned measured steps."""
    config = problem.config
    spp, call = config.run.spp, config.set_spp
    entries = sum(problem.selection.array(key).size for key in problem.selection.keys)
    learned = lessons(problem) / (spp / call * len(problem.drawn(0)))
    rounds = ROUNDS_OF_FEW if entries < FEW_ENTRIES else ROUNDS
    alone = config.adjoint == "independent"
    return Sizes(spp, call, pass_spp(config), alone, rounds, learned, longer, planned)


@dataclass(frozen=True)
class Finding:
    """Result of a race. `other` tells whether the other way is better.

    `gain` is the gain of the other way. `note` gives a reason if the gain alone does not decide. `is_open` is true if
    the time was up before the race was decided. More time may lead to another result.
    """

    other: bool
    gain: Gain | None
    note: str
    is_open: bool = False

    def why(self) -> str:
        """Return the gain in words, or the reason why there is none."""
        if self.gain is None:
            return self.note
        gain, low, high = self.gain
        found = f"{gain:.2g} times the efficiency here ({low:.2g} to {high:.2g})"
        return f"{found}; {self.note}" if self.note else found


class Turns:
    """A race. `take(other, round, spp)` takes its steps, with a learned table that stays unchanged. If a table must
    learn, `learn(spp)` updates it from a walk, with seeds that no step has.

    The race ends early after `limit_s` seconds. With `guides`, the other way is guided, and its time includes the
    learning of the run. Otherwise, the race takes all rounds in any case, or as many as a step has samples. Steps of
    milliseconds, whose time is that of Python code, are then measured, too.
    """

    def __init__(
        self, take: Callable[[bool, int, int], Step], sizes: Sizes, limit_s: float,
        learn: Callable[[int], Step] | None = None, guides: bool = False,
    ) -> None:  # fmt: skip
        self._spent_ms = 0.0
        self._take, self._learn, self._sizes = take, learn, sizes
        self._limit_ms, self._guides = 1e3 * limit_s, guides
        self._sure = 0 if guides else max(min(sizes.rounds, sizes.step), LEAST_ROUNDS)
        self._steps: tuple[list[Step], list[Step]] = ([], [])  # of both kinds
        self._walk = Step()

    def run(self) -> Finding:
        """Measure and decide."""
        spp, take = self._sizes.trial, self._take
        self._spend(take(False, 0, spp))  # compiles kernels
        plain = self._spend(take(False, 0, spp))
        # Python's time is the same for both.
        round_ms = (1 + self._sizes.longer) * (plain.kernel_ms + plain.image_ms) + 2 * plain.beside_ms
        if self._learn is not None:
            self._walk = self._spend(self._learn(self._sizes.learning))
        if not self._affords(LEAST_ROUNDS * round_ms):
            return Finding(False, None, f"measuring it would take more than {self._limit_ms / 1e3:.2g} s", True)
        self._spend(take(True, 0, spp))
        for round in range(1, 1 + self._sizes.rounds):
            for other in (False, True):
                self._steps[other].append(self._spend(take(other, round, spp)))
            if not self._affords(sum(steps[-1].wall_ms for steps in self._steps)):
                break
        found = self._decided()
        if round < self._sizes.rounds and found.gain is not None and found.gain[1] <= 1 <= found.gain[2]:
            return replace(found, note=f"not decided in {self._limit_ms / 1e3:.2g} s", is_open=True)
        return found

    def _affords(self, more_ms: float) -> bool:
        return len(self._steps[True]) < self._sure or self._spent_ms + more_ms <= self._limit_ms

    def _learning_ms(self) -> float:
        """Return the time that learning adds to a guided step of `trial` samples, as the mean over the run."""
        sizes = self._sizes
        kernel = self._walk.kernel_ms * sizes.part / sizes.learning
        return (kernel + self._walk.beside_ms) * sizes.lessons * sizes.trial / sizes.call

    def _times(self, other: bool) -> list[float]:
        """Return the times of steps of one kind. Time outside of kernels occurs once for each `call` of a run."""
        steps, beside = self._steps[other], statistics.median(step.beside_ms for step in self._steps[False])
        beside = beside * self._sizes.trial / self._sizes.call + statistics.median(step.image_ms for step in steps)
        beside += self._learning_ms() if other and self._guides else 0.0
        return [step.kernel_ms + beside for step in steps]

    def _gain(self) -> Gain | None:
        """Return the gain in efficiency for the gradient."""
        own, other = ([step.gradients for step in steps] for steps in self._steps)
        return compare(own, self._times(False), other, self._times(True))

    def _image_gain(self) -> Gain | None:
        """Return the gain in efficiency for the image, from the samples of the gradient or from its own samples."""
        own, other = ([step.images for step in steps] for steps in self._steps)
        if self._sizes.alone:  # time outside kernels counts once, with the gradient
            own_ms, other_ms = ([step.image_ms for step in steps] for steps in self._steps)
        else:
            own_ms, other_ms = self._times(False), self._times(True)
        return compare(own, own_ms, other, other_ms)

    def _decided(self) -> Finding:
        if (count := len(self._steps[False])) < LEAST_ROUNDS:
            return Finding(False, None, f"{count} steps of both are too few to decide", True)
        gain, image = self._gain(), self._image_gain()
        if gain is None:
            return Finding(False, None, "gradients have no noise")
        if gain[1] > 1 and image is not None and image[2] < LEAST_IMAGE:
            whose = "images have" if self._sizes.alone else "the image, of the same samples, has"
            return Finding(False, gain, f"{whose} {image[0]:.2g} times the efficiency")
        return Finding(gain[1] > 1, gain, "")

    def _spend(self, step: Step) -> Step:
        """Add the time of a step."""
        self._spent_ms += step.wall_ms + step.compile_ms
        return step


# --- steps ------------------------------------------------------------------------------------------------------------


class StepTrial:
    """Steps of a problem, taken by the integrator `plain` or by the integrator `other`. The steps leave no gradients,
    and do not change the problem.

    `views` are the used views. At most one of the integrators is guided. It samples from `table`, which `learn` fills.
    The seeds depend on `what`, the name of the current decision.
    """

    def __init__(self, problem: Problem, what: str, plain: Tracer, other: Tracer) -> None:
        self._problem, self._what, self._clock = problem, what, StepClock()
        self._adjoint = problem.config.adjoint
        # Separate integrators, because other sample counts would drop the tables and recordings of the run.
        self._tracers = [one.with_options(samples_per_pass=None, freeze=one.freeze) for one in (plain, other)]
        self._guided = next((one for one in self._tracers if one.preparation.guiding is not None), None)
        self.table: Guiding | None = None if self._guided is None else self._guided.preparation.guiding
        if self._guided is not None and self.table is not None:
            self.table.held = True  # steps must not update it
            self._guided.preparation.draw_from(self.table, problem.scene)
        problem.apply()
        trained = problem.trained
        count = min(len(trained), MOST_VIEWS)
        self.views: list[View] = [trained[k * len(trained) // count] for k in range(count)]
        self._slopes = [self._slope(view) for view in self.views]
        take_gradient(problem)  # recovered exposures have some of these entries

    def race(self, sizes: Sizes, limit_s: float, guides: bool = False) -> Finding:
        """Return the result of alternating steps (`Turns`)."""
        return Turns(self.take, sizes, limit_s, None if self.table is None else self.learn, guides).run()

    def _slope(self, view: View) -> mi.TensorXf:
        """Return the fixed dL/dI. Non-finite values become 0."""
        spp = max(int(IMAGE_SHARE * self._problem.config.run.spp), 1)
        image = render_image(self._tracers[False], self._problem.scene, view.sensor, self._seed(0, view, "image"), spp)
        return to_tensor(finite(slope(view.objective, np.array(image))))

    def learn(self, spp: int) -> Step:
        """Let the table learn, and prepare it for sampling. It stays unchanged from then on.

        All work is done twice, and the first result is dropped. The learning time then excludes compilation.
        """
        jobs = [self._job(view, self._seed(0, view, "learned from"), spp) for view in self.views]
        assert self.table is not None
        first = self._teach(self.table, jobs)
        self.table.forget()
        taken = timed(self._teach(self.table, jobs))
        taken.compile_ms += first.wall_ms
        return taken

    def _teach(self, table: Guiding, jobs: list[Job]) -> StepTimes:
        guided = self._guided
        assert guided is not None
        with self._clock.step() as times:
            for view, job, gradient in zip(self.views, jobs, self._slopes, strict=True):
                guided.learn_now(job, gradient)
                for purpose in Purpose if self._adjoint == "independent" else (Purpose.BOTH, Purpose.IMAGE):
                    table.table(view.sensor, purpose)
        return times

    def take(self, other: bool, round: int, spp: int) -> Step:
        """Take one step of all views."""
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
        for key, image in images.items():  # some values, distributed over the image
            values = np.array(image, dtype=np.float32).ravel()
            taken.images[key] = finite(values[:: -(-values.size // MOST_VALUES)])
        return taken

    def _differentiate(self, tracer: Tracer, view: View, job: Job, gradient: mi.TensorXf) -> mi.TensorXf | None:
        """Add the gradient of a job's samples as in a step of the run. Returns their image if there is one."""
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
