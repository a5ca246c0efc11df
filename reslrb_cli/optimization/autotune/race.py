"""Races of candidates before a run's first iteration: what they may cost, how they compare, what is kept of them.

- `Tuner.decide`: one decision, which is what an earlier run kept, or what is measured now, in a run long enough.
- `compare`: how much more efficient one way of sampling a gradient is than another, by steps of both, and how sure:

      gain = (variance * time of the one) / (variance * time of the other)

  Variance is summed over the parameters, each over its gradient's mean square. The interval is that of the logarithm of
  the variances' quotient by the jackknife over the steps, and of times by what a single one may be off.
- `Turns`: whether another way of taking steps pays, by steps of both in turns, whose gradients estimate the same. Times
  are those of kernels, and, alike for both, what goes on beside them in a run for as many samples, which counts where
  iterations take milliseconds. A table that steps draw from is learned first, of other paths than theirs, and held.

For another option of which two ways are compared: its record in `records/decisions.py` (a `PaidRecord`); its row in
`LATER`; in `sampling.py` a `Turns` that makes the record (`SequencePilot`), a function beside `_sequence` that has
`Tuner.decide` find it, by a `StepTrial` of two integrators, and lines in `settle_sampling` that take it. If an option
has more than two values, each takes turns with the best so far.
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

#: Iterations of the run that what measuring costs is a share of.
ITERATIONS = 200
#: Shares of a run of ITERATIONS, compilation left out: the limit for all measuring, and the plans for guiding, sequence
#: and paths. If guiding is not decided after its plan, it may go on to the limit, less the plan for the sequence.
SHARE, GUIDING_SHARE, SEQUENCE_SHARE, PATHS_SHARE = 0.05, 0.025, 0.005, 0.015
#: What measurements take at least that say anything. Compiling is that of both kinds of steps, and of walks that are
#: learned from.
GUIDING_NEEDS, SEQUENCE_NEEDS, PATHS_NEEDS = (2.5, 3.0), (2.5, 1.0), (1.5, 2.0)
#: The same of camera paths alone beside half of each kind: kernels are those of the run, whichever wins, and few steps
#: of few samples tell.
CAMERA_NEEDS = (0.0, 3.0)
#: The decisions by option: the time that is kept aside for each, and its plan.
#: What it takes at the least would be too little where kernels are there: first steps take their time all the same.
LATER = {
    "paths": (PATHS_NEEDS[0], PATHS_SHARE * ITERATIONS),
    "guiding": (GUIDING_NEEDS[0], GUIDING_SHARE * ITERATIONS),
    "sequence": (SEQUENCE_NEEDS[0], SEQUENCE_SHARE * ITERATIONS),
}
#: Relative error of a single time that must not decide anything.
TIMING_NOISE = 1.1
CONFIDENCE = 0.95
#: What is left of a sum where nothing should be, as a share of it.
ROUNDING = 1e-12
Say = Callable[[str], None]
Record = TypeVar("Record", bound=Finding)
Gradients = dict[str, Array]
#: A gain and the ends of its interval; nothing where it cannot be told.
Gain = tuple[float, float, float] | tuple[None, None, None]
NOTHING: Gain = (None, None, None)
logger = logging.getLogger(__name__)


# --- one decision -----------------------------------------------------------------------------------------------------


class Tuner:
    """Decides; `problem` is the one that was given, with what has been decided since.

    `say` is told what is decided, and once that something is measured; `cache` holds what earlier runs measured.
    """

    def __init__(self, problem: Problem, say: Say, cache: PilotCache | None = None) -> None:
        self.problem, self.say, self._cache = problem, say, cache

    def take(self, **decided: Any) -> None:
        """Have fields of `problem` from now on."""
        self.problem = replace(self.problem, **decided)

    def set_aside(self, size: int) -> None:
        """Expect so many more bytes in all steps, where a memory budget is kept."""
        if (memory := self.problem.memory) is not None:
            expected = replace(memory.expected_bytes, fixed=memory.expected_bytes.fixed + size)
            self.take(memory=replace(memory, expected_bytes=expected))

    def tell(self) -> None:
        """Say the decisions in one line, or each with its reason in verbose runs."""
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
        """What an earlier run measured and kept, if it `fits`; else what `measure` finds now, which is kept.

        `of` is what that depends on besides the situation, `needs` what measuring by steps of `integrator` and others
        takes at least that says anything (`Allowance.affords`), `unmeasured` the decision without, with a note. What is
        to be measured `later` has its time kept aside, where there is enough for both.
        """
        key = ""
        if self._cache is not None:
            key = key_of({**of, **situation(self.problem)})
            try:
                kept = replace(kind.from_json(self._cache.get(key)), cached=True)
                if fits(kept):
                    return kept
            except TypeError:
                pass  # nothing there, or nothing that this version wrote
        allowance = self.allowance(integrator)
        if not allowance.affords(*needs):
            return unmeasured(allowance.note())
        if not allowance.spent_s:
            self.say("measuring which sampling is most efficient here")
        with allowance.spending(later if allowance.affords(*needs, *later) else ()):
            record = measure(allowance)
        logger.debug(allowance.line())
        if self._cache is not None:
            self._cache.put(key, record.to_json())
        return record

    def allowance(self, integrator: Tracer) -> Allowance:
        """What may be spent: as begun before, or by two first steps of `integrator` now, of few samples."""
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
    """Whether this option of the integrator is left to measurement."""
    options = config.integrator.options()
    if option == "paths":  # of both kinds the share is measured alike
        return options.get("paths") == "auto" or (options.get("paths"), options.get("light_share")) == ("both", "auto")
    return bool(options.get(option) == "auto")


def sets_of(config: Config) -> int:
    """The sets that a step's samples are traced in: those that have one dL/dI each, or the halves of these."""
    return (config.run.batches if config.adjoint == "batched" else 1) * config.halves * config.shares


def situation(problem: Problem) -> dict[str, Any]:
    """Return all that a decision depends on, as plain values: settings, and the contents of the files they name."""
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
#: Whenever as many rounds have been taken as are planned for it is asked whether it is clear, so often at the most.
LOOKS = 3
#: What is on before the last of these looks has to be surer than it would have to be at the end: looking again and
#: again must not make what is worth nothing pass.
CLEAR = 0.99
#: Steps' worth of time that the rounds are planned for.
PLANNED = 3.4
#: Samples of each walk that a table learns from, as a share of a step's, and walks that it learns from before it is
#: tried, where there is time for more than one.
LEARNING_SHARE, LEARNINGS = 0.4, 2


def lessons(problem: Problem) -> float:
    """How often tables of guided emission learn in an iteration of the run, in the mean over all of it."""
    run, sensors = problem.config.run, len(problem.trained)
    each = run.batches - 1 if problem.config.adjoint == "batched" else 1
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


#: A step as it is, or one the other way, of a round and so many samples per pixel; from what the table has learned,
#: which stays as it is. Equal rounds have equal seeds, others than those of any walk that is learned from.
Take = Callable[[bool, int, int], Step]
#: Have the table learn, from a walk of a round and so many samples per pixel; what is not given is left at 0.
Learn = Callable[[int, int], Step]


class Turns(Generic[Record]):
    """One decision, by steps that `take` takes, and walks that `learn` does, where a table has yet to learn. `views` is
    how many times the views of an iteration are those of a step here, `share` what of ITERATIONS this may cost, and
    `most` what of them the least number of rounds may, where that is more."""

    LEAST, LOOKS = LEAST_ROUNDS, LOOKS
    #: Whether it is decided apart for images that have samples of their own.
    APART = False

    def __init__(
        self, take: Take, sizes: Sizes, views: float, share: float, most: float = 0.0, learn: Learn | None = None
    ) -> None:
        self._spent_ms = self._compile_ms = 0.0
        self._take, self._learn, self._sizes, self._views = take, learn, sizes, views
        self._share, self._most = share, max(share, most)
        self._apart = self.APART and sizes.alone
        self._plain: list[Step] = []  # all steps as they are whose times count
        self._steps: tuple[list[Step], list[Step]] = ([], [])  # of either kind
        self._walk = Step()

    def run(self) -> Record:
        """Measure, and decide."""
        spp, take = self._sizes.trial, self._take
        self._spend(take(False, 0, spp), first=True)
        plain = self._spend(take(False, 0, spp))
        self._plain.append(plain)
        # What Python takes is the same for both.
        kernels = (1 + self._sizes.longer) * (plain.kernel_ms + plain.image_ms)
        if not self._learned(kernels + 2 * plain.beside_ms):
            most = f"{self._most * ITERATIONS:.2g}"
            return self._record(f"to measure it would cost more than {most} iteration{'s' * (most != '1')}")
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
        """Have the table learn, if it has not; False where that, and rounds of so long, cannot be afforded."""
        if self._learn is None:
            return self._affords(self.LEAST * round_ms)
        walk = self._learn(0, self._sizes.learning)
        if not self._affords(walk.wall_ms + self.LEAST * round_ms):
            self._spend(walk, first=True)
            return False
        self._walk = self._spend(walk)
        # What one walk more would gain is little beside what rounds that are too few leave open.
        rounds = max(self._sizes.rounds // 2, self.LEAST)
        for number in range(1, LEARNINGS):
            if self._affords(self._walk.wall_ms + rounds * round_ms):
                self._walk = self._spend(self._learn(number, self._sizes.learning))
        return True

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
        share = self._share if len(self._steps[True]) >= self.LEAST else self._most
        return self._spent_ms + more_ms <= share * ITERATIONS * self._iteration_ms

    def _more_ms(self) -> float:
        """What a step of the other kind, of `trial` samples, takes in a run beside its own kernels."""
        return 0.0

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> Record:
        """The record of a decision, `found` what all of them hold."""
        raise NotImplementedError

    def _times(self, other: bool, images: bool) -> list[float]:
        """Of steps of one kind, whose images, where they have samples of their own, are drawn the other way or not."""
        beside = self._python_ms + (self._more_ms() if other else 0.0)
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

    def _decided(self) -> Record:
        if len(self._steps[False]) < self.LEAST:
            return self._record(f"{len(self._steps[False])} steps of both are too few to tell")
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
        """Return the fields that all records of decisions by turns have."""
        cost = {"measure_s": self._spent_ms / 1e3, "compile_s": self._compile_ms / 1e3}
        return {"rounds": len(self._steps[True]), "spp": self._sizes.trial, "note": note, **cost}

    def _spend(self, step: Step, first: bool = False) -> Step:
        """Count the time of a step. A `first` step compiles kernels, so all of its time counts as compilation."""
        self._spent_ms += 0.0 if first else step.wall_ms
        self._compile_ms += step.compile_ms + (step.wall_ms if first else 0.0)
        return step
