"""Comparisons of options before the first iteration: their cost, their evaluation, and their storage.

- `Tuner.decide` makes one decision. The method uses the result of an earlier run, or measures now if the run is long
    enough.
- `compare` compares two ways of sampling a gradient. The function returns the gain in efficiency, with its interval.
- `Turns` decides whether another way of taking steps pays. Steps of both ways alternate, and their gradients have the
    same mean.

The gain compares variance times time.

    gain = (variance * time of the one) / (variance * time of the other)

The variance is a sum over the parameters. Each parameter's variance is divided by the mean square of its gradient. The
jackknife over the steps gives the interval for the logarithm of the variance ratio. The error of single times is added.
Times include kernels and the run's other work. The other work counts equally for both options, and matters if
iterations take milliseconds. If steps sample from a table, the table first learns from other paths. The table then
stays fixed.

A new option with two alternatives needs a record in `records/decisions.py` (a `PaidRecord`) and a row in `LATER`. The
option also needs a `Turns` in `sampling.py` that makes the record (like `SequencePilot`). The option also needs a
function like `_sequence` that calls `Tuner.decide`. `settle_sampling` calls this function. If an option has more than
two values, each value competes with the best value so far.
"""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import mitsuba as mi
import numpy as np

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.config.schema import Config
from reslrb_cli.guiding.tables import learnings
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.optimization.decisions import Allowance, Need
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.records.cache import PilotCache, key_of
from reslrb_cli.records.clock import StepClock, StepTimes
from reslrb_cli.records.decisions import LEAST_IMAGE, Finding
from reslrb_cli.records.manifest import versions
from reslrb_cli.scene.files import file_digests, files_of
from reslrb_cli.statistics import Array, jackknife_variance, sum_of_squares

#: Iterations of the run to which the cost of measuring is compared.
ITERATIONS = 200
#: Shares of a run of ITERATIONS without compilation: the limit for all measuring, and the plans for guiding, sequence
#: and paths. If guiding is open after its plan, it may use the limit less the plan for the sequence.
SHARE, GUIDING_SHARE, SEQUENCE_SHARE, PATHS_SHARE = 0.05, 0.025, 0.005, 0.015
#: Minimum cost of useful measurements. Compilation is that of both kinds of steps and of walks for learning.
GUIDING_NEEDS, SEQUENCE_NEEDS, PATHS_NEEDS = (2.5, 3.0), (2.5, 1.0), (1.5, 2.0)
#: The same for camera paths only against half of each kind: the run uses the kernels of either outcome, and few steps
#: with few samples suffice.
CAMERA_NEEDS = (0.0, 3.0)
#: The decisions by option: the reserved time for each, and its plan. The minimum would be too little if kernels are
#: cached, because first steps take their time anyway.
LATER = {
    "paths": (PATHS_NEEDS[0], PATHS_SHARE * ITERATIONS),
    "guiding": (GUIDING_NEEDS[0], GUIDING_SHARE * ITERATIONS),
    "sequence": (SEQUENCE_NEEDS[0], SEQUENCE_SHARE * ITERATIONS),
}
#: Relative error of a single time that must not decide anything.
TIMING_NOISE = 1.1
CONFIDENCE = 0.95
#: Rounding error of a sum that should vanish, as a share of it.
ROUNDING = 1e-12
Say = Callable[[str], None]
Record = TypeVar("Record", bound=Finding)
Gradients = dict[str, Array]
#: A gain and the ends of its interval; NaN if unknown.
Gain = tuple[float, float, float] | tuple[None, None, None]
NOTHING: Gain = (None, None, None)
logger = logging.getLogger(__name__)


# --- one decision -----------------------------------------------------------------------------------------------------


class Tuner:
    """Decisions before a run. `problem` is the given problem, with the decisions so far.

    `say` is called with the decisions, and once before a measurement. `cache` has measurements of earlier runs.
    """

    def __init__(self, problem: Problem, say: Say, cache: PilotCache | None = None) -> None:
        self.problem, self.say, self._cache = problem, say, cache

    def take(self, **decided: Any) -> None:
        """Change fields of `problem` from now on."""
        self.problem = replace(self.problem, **decided)

    def set_aside(self, size: int) -> None:
        """Add `size` bytes to the expected memory of all steps, if there is a memory budget."""
        if (memory := self.problem.memory) is not None:
            expected = replace(memory.expected_bytes, fixed=memory.expected_bytes.fixed + size)
            self.take(memory=replace(memory, expected_bytes=expected))

    def tell(self) -> None:
        """Print the decisions in one line, or each with its reason in verbose runs."""
        decided = self.problem.sides, self.problem.guided, self.problem.sequence, self.problem.pixels
        found = [each for each in decided if each is not None]
        if logger.isEnabledFor(logging.DEBUG):
            for each in found:
                self.say(each.line(cost=True))
        elif found:
            measured = any(each.measure_s or each.cached for each in found)
            chosen = ", ".join(each.decision() for each in found)
            self.say(f"chosen {'by measurement' if measured else 'without measuring'}: {chosen} (-v gives the reasons)")

    def decide(
        self,
        kind: type[Record],
        of: dict[str, Any],
        needs: Sequence[Need],
        integrator: Tracer,
        measure: Callable[[Allowance], Record],
        unmeasured: Callable[[str], Record],
        fits: Callable[[Record], bool] = lambda record: True,
        later: Sequence[Need] = (),
    ) -> Record:
        """Return the decision of an earlier run if it `fits`. Without a stored decision that fits, measure now with
        `measure`, and store the result.

        `of` has the conditions of the decision that `situation` does not contain. `needs` are the minimum costs of
        useful measurements with steps of `integrator` and of its alternatives (`Allowance.affords`). `unmeasured` takes
        a note, and returns the decision without a measurement. Time for `later` measurements is reserved if the time
        suffices for the present and the `later` measurements.
        """
        key = ""
        if self._cache is not None:
            key = key_of({**of, **situation(self.problem)})
            try:
                kept = replace(kind.from_json(self._cache.get(key)), cached=True)
                if fits(kept):
                    return kept
            except TypeError:
                pass  # absent, or written by another version
        allowance = self.allowance(integrator)
        if not allowance.affords(*needs):
            return unmeasured(allowance.note())
        if not allowance.spent_s:
            self.say("measuring which sampling is most efficient")
        with allowance.spending(later if allowance.affords(*needs, *later) else ()):
            record = measure(allowance)
        logger.debug(allowance.line())
        if self._cache is not None:
            self._cache.put(key, record.to_json())
        return record

    def allowance(self, integrator: Tracer) -> Allowance:
        """Return the time limit of all measurements. If the time limit is not yet available, two first steps of
        `integrator` with few samples determine the limit.
        """
        problem, run = self.problem, self.problem.config.run
        if problem.allowance is not None:
            return problem.allowance
        unit = sets_of(problem.config)
        own = integrator.to_measure().with_options(samples_per_pass=None, freeze=False)
        clock = StepClock()
        first, second = (measured_step(problem, own, clock, 0, unit) for _ in range(2))
        compile_ms = max(first.wall_ms + first.compile_ms - second.wall_ms, 0.0)
        iteration_ms = second.beside_ms + second.kernel_ms * run.spp / unit
        run_ms = compile_ms + run.iterations * iteration_ms
        run_s = min(run_ms / 1e3, run.max_seconds or math.inf)
        found = Allowance(run.measuring, run_s, compile_ms / 1e3, iteration_ms / 1e3)
        self.take(allowance=found)
        return found


def is_auto(config: Config, option: str) -> bool:
    """Whether this option of the integrator is decided by measurement."""
    options = config.integrator.options()
    if option == "paths":  # `both` measures its share in the same way
        return options.get("paths") == "auto" or (options.get("paths"), options.get("light_share")) == ("both", "auto")
    return bool(options.get(option) == "auto")


def sets_of(config: Config) -> int:
    """Return the number of sets in which a step's samples are traced. Each set has one dL/dI, or is one half."""
    return (config.run.batches if config.adjoint == "batched" else 1) * config.shares


def situation(problem: Problem) -> dict[str, Any]:
    """Return everything that a decision depends on as plain values, including settings and the contents of their
    files.
    """
    config = problem.config
    settings = config.model_dump(mode="json", include={"scene", "target", "views", "parameters", "integrator", "loss"})
    for spec in settings["parameters"]:
        del spec["learning_rate"]
    return {
        "settings": settings,
        "files": file_digests(files_of(config)),
        "sensors": problem.sensors,
        "views": [[view.share, view.held_out, *(own.token for own in view.codes)] for view in problem.views],
        "parameters": {key: list(problem.selection.array(key).shape) for key in problem.selection.keys},
        "run": config.step_options() | {"memory_budget": config.run.memory_budget},
        "versions": versions(),
        "variant": mi.variant(),
        "device": device_name(mi.variant()),
    }


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


def timed(times: StepTimes, wall_ms: float | None = None) -> Step:
    """Return a step with these times. If the process waited for other work, `wall_ms` replaces the clock's wall
    time.
    """
    # Kernels are compiled in parallel: their times can add up to more than the wait.
    waited_ms = max((times.wall_ms if wall_ms is None else wall_ms) - times.codegen_ms, times.kernel_ms)
    return Step(kernel_ms=times.kernel_ms, wall_ms=waited_ms, compile_ms=times.codegen_ms)


def measured_step(problem: Problem, integrator: Any, clock: StepClock, round: int, spp: int) -> Step:
    """Take one step of all views, with separate seeds. Leaves neither a gradient nor a change."""
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
    """Return the efficiency of `other` divided by the efficiency of `own`, with the confidence interval of the ratio.

    `own` and `other` have the gradients of at least three steps, by parameter. `own_ms` and `other_ms` have the times
    of steps in any unit. Returns NOTHING if one way has no noise.
    """
    units = scales([*own, *other])
    found = [_log_variances(gradients, units) for gradients in (own, other)] if units else [None]  # such as no light
    known = [each for each in found if each is not None]
    if len(known) < 2:
        return NOTHING
    from scipy.special import stdtrit  # late: every run imports this module, and few need SciPy

    times = statistics.median(own_ms) / max(statistics.median(other_ms), 1e-6)
    advantage = math.exp(known[0][0] - known[1][0]) * times
    variance = sum(float(jackknife_variance(without)) for _, without in known)
    half = float(stdtrit(min(len(own), len(other)) - 1, (1 + confidence) / 2)) * math.sqrt(variance)
    factor = math.exp(min(half, 50.0)) * TIMING_NOISE
    return advantage, advantage / factor, advantage * factor


def scales(gradients: Sequence[Gradients]) -> dict[str, float]:
    """Return the mean square norm of each parameter's gradient, if it has a gradient."""
    found = {key: float(np.mean([sum_of_squares(g[key]) for g in gradients])) for key in gradients[0]}
    return {key: scale for key, scale in found.items() if scale > 0}


def _log_variances(gradients: Sequence[Gradients], scales: dict[str, float]) -> tuple[float, Array] | None:
    """Return the logarithm of the total variance of all parameters. Also return the logarithms with each round left out
    in turn.
    """
    rows = np.array([
        np.concatenate([g[key].astype(np.float64) / math.sqrt(scale) for key, scale in scales.items()])
        for g in gradients
    ])  # fmt: skip
    count = len(rows)
    squares = np.square(rows - rows.mean(axis=0)).sum(axis=1) if rows.size else np.zeros(count)
    whole = float(squares.sum())
    # Leave-one-out: dropping a row lowers the sum of squares by its squared distance and that of the mean of the
    # others.
    without = whole - squares * count / (count - 1)
    if not without.min() > ROUNDING * whole:
        return None
    return math.log(whole / (count - 1)), np.log(without / (count - 2))


# --- two ways in turns ------------------------------------------------------------------------------------------------

#: Fewer rounds give no result.
LEAST_ROUNDS = 4
#: Maximum number of checks whether the result is clear, one after each planned number of rounds.
LOOKS = 3
#: Confidence needed before the last check, higher than at the end: repeated checks must not let a useless option pass.
CLEAR = 0.99
#: Time for the planned rounds, in steps.
PLANNED = 3.4
#: Samples of each walk for learning, as a share of a step's, and number of such walks before the trial if there is time
#: for more than one.
LEARNING_SHARE, LEARNINGS = 0.4, 2


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

    `alone` tells whether images have their own samples. `rounds` is the planned number of rounds. `lessons` is how
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
        """Samples of each learning walk."""
        return max(min(int(LEARNING_SHARE * self.step), self.part), 1)


#: Take a plain step or one with the option, given a round and the samples per pixel, with the learned table, which
#: stays unchanged. Equal rounds have equal seeds, different from those of any walk for learning.
Take = Callable[[bool, int, int], Step]
#: Update the table from a walk of a round with these samples per pixel; unmeasured times stay 0.
Learn = Callable[[int, int], Step]


class Turns(Generic[Record]):
    """A decision based on steps that `take` returns. If a table must learn, `learn` provides the learning walks.

    `views` is the view count of an iteration divided by the view count of a measured step. The decision may cost
    `share` times the time of ITERATIONS iterations. If `most` exceeds `share`, the minimum number of rounds may cost
    `most` times the time of ITERATIONS iterations.
    """

    LEAST, LOOKS = LEAST_ROUNDS, LOOKS
    #: Whether the image, if it has its own samples, gets its own decision.
    APART = False

    def __init__(
        self, take: Take, sizes: Sizes, views: float, share: float, most: float = 0.0, learn: Learn | None = None
    ) -> None:
        self._spent_ms = self._compile_ms = 0.0
        self._take, self._learn, self._sizes, self._views = take, learn, sizes, views
        self._share, self._most = share, max(share, most)
        self._apart = self.APART and sizes.alone
        self._plain: list[Step] = []  # all plain steps with valid times
        self._steps: tuple[list[Step], list[Step]] = ([], [])  # of both kinds
        self._walk = Step()

    def run(self) -> Record:
        """Measure and decide."""
        spp, take = self._sizes.trial, self._take
        self._spend(take(False, 0, spp), first=True)
        plain = self._spend(take(False, 0, spp))
        self._plain.append(plain)
        # Python's time is the same for both.
        kernels = (1 + self._sizes.longer) * (plain.kernel_ms + plain.image_ms)
        if not self._learned(kernels + 2 * plain.beside_ms):
            most = f"{self._most * ITERATIONS:.2g}"
            return self._record(f"measuring it would take more than {most} iteration{'s' * (most != '1')}")
        self._spend(take(True, 0, spp), first=True)
        for round in range(1, 1 + self.LOOKS * self._sizes.rounds):
            for other in (False, True):
                self._steps[other].append(self._spend(take(other, round, spp)))
            self._plain.append(self._steps[False][-1])
            if not self._affords(sum(steps[-1].wall_ms for steps in self._steps)):
                break
            if round % self._sizes.rounds == 0 and self._is_clear():
                break
        return self._decided()

    def _learned(self, round_ms: float) -> bool:
        """Let the table learn if it must. Returns False if the time does not suffice for learning and for the minimum
        number of rounds of `round_ms` each.
        """
        if self._learn is None:
            return self._affords(self.LEAST * round_ms)
        walk = self._learn(0, self._sizes.learning)
        if not self._affords(walk.wall_ms + self.LEAST * round_ms):
            self._spend(walk, first=True)
            return False
        self._walk = self._spend(walk)
        # One more walk gains little compared with the uncertainty of too few rounds.
        rounds = max(self._sizes.rounds // 2, self.LEAST)
        for number in range(1, LEARNINGS):
            if self._affords(self._walk.wall_ms + rounds * round_ms):
                self._walk = self._spend(self._learn(number, self._sizes.learning))
        return True

    @property
    def _iteration_ms(self) -> float:
        """Time of an iteration of the run in milliseconds. The time includes the kernels for all samples, and the other
        work for each set.
        """
        kernels = statistics.median(step.kernel_ms + step.image_ms for step in self._plain)
        return self._views * (kernels + self._python_ms) * self._sizes.step / self._sizes.trial

    @property
    def _python_ms(self) -> float:
        """Time outside of kernels for `trial` samples in a run. It occurs once for each `call`."""
        beside = statistics.median(step.beside_ms for step in self._plain)
        return beside * self._sizes.trial / self._sizes.call

    def _affords(self, more_ms: float) -> bool:
        share = self._share if len(self._steps[True]) >= self.LEAST else self._most
        return self._spent_ms + more_ms <= share * ITERATIONS * self._iteration_ms

    def _more_ms(self) -> float:
        """Return the additional time outside of kernels that a step with the option takes in a run. The time is for
        `trial` samples.
        """
        return 0.0

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> Record:
        """Return the record of a decision. `found` has its common fields."""
        raise NotImplementedError

    def _times(self, other: bool, images: bool) -> list[float]:
        """Return the times of steps of one kind. `images` is True if images with their own samples use the option as
        well.
        """
        beside = self._python_ms + (self._more_ms() if other else 0.0)
        if self._sizes.alone:
            beside += statistics.median(step.image_ms for step in self._steps[other and images])
        return [step.kernel_ms + beside for step in self._steps[other]]

    def _gain(self, images: bool, confidence: float = CONFIDENCE) -> Gain:
        """Return the gain of the gradient. `images` is True if images use the option as well."""
        own, other = ([step.gradients for step in steps] for steps in self._steps)
        return compare(own, self._times(False, images), other, self._times(True, images), confidence)

    def _image_gain(self) -> Gain:
        """Return the gain in efficiency for the image. If images have their own samples, these samples give the gain.
        Without separate image samples, the gradient's samples also give the image.
        """
        own, other = ([step.images for step in steps] for steps in self._steps)
        times = [self._times(each, False) for each in (False, True)]
        if self._sizes.alone:  # time outside kernels counts once, with the gradient
            times = [[step.image_ms for step in steps] for steps in self._steps]
        return compare(own, times[0], other, times[1])

    def _is_clear(self) -> bool:
        """True if no more steps are needed. The alternative is then clearly better, or clearly not better."""
        _, low, high = self._gain(not self._apart or self._images(self._image_gain()), CLEAR)
        return low is None or high is None or low > 1 or high < 1

    def _images(self, gain: Gain) -> bool:
        """True if images also use the alternative. If images have no separate decision, True if the alternative does
        not harm images.
        """
        if self._apart:
            return gain[1] is not None and gain[1] > 1
        return gain[2] is None or gain[2] >= LEAST_IMAGE

    def _decided(self) -> Record:
        if len(self._steps[False]) < self.LEAST:
            return self._record(f"{len(self._steps[False])} steps of both are too few to decide")
        picture = self._image_gain()
        images = self._images(picture)
        gain = self._gain(images or not self._apart)
        if gain[1] is None:
            return self._record("gradients have no noise")
        note = ""
        if gain[1] > 1 and not (images or self._apart):
            whose = "images have" if self._sizes.alone else "the image, of the same samples, has"
            note = f"{whose} {picture[0]:.2g} times the efficiency"
        on = gain[1] > 1 and not note
        return self._record(note, gain, picture, on, on and images)

    def _record(
        self, note: str, gain: Gain = NOTHING, picture: Gain = NOTHING, other: bool = False, images: bool = False
    ) -> Record:
        found = self._found(note) | dict(zip(("gain", "low", "high"), gain, strict=True))
        found |= dict(zip(("image_gain", "image_low", "image_high"), picture, strict=True))
        return self._decide(other, images, found | {"share": self._spent_ms / (ITERATIONS * self._iteration_ms)})

    def _found(self, note: str) -> dict[str, Any]:
        """Return the fields that are common to all records of `Turns` decisions."""
        cost = {"measure_s": self._spent_ms / 1e3, "compile_s": self._compile_ms / 1e3}
        return {"rounds": len(self._steps[True]), "spp": self._sizes.trial, "note": note, **cost}

    def _spend(self, step: Step, first: bool = False) -> Step:
        """Add the time of a step. A `first` step compiles kernels, so its whole time counts as compilation."""
        self._spent_ms += 0.0 if first else step.wall_ms
        self._compile_ms += step.compile_ms + (step.wall_ms if first else 0.0)
        return step
