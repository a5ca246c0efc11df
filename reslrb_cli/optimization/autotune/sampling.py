"""The automatic decisions about the sampling of a run, taken before its first iteration.

`OPTIONS` has one entry for each setting of the integrator that may be `auto`. To add one, write its entry here, and let
the setting be `auto` in `config/integrators.py` (with its value before the decision in `UNDECIDED`). Everything else
(the line that the run prints, manifest, checkpoints, page, `inspect`, and runs that go on) reads the list of
`Decision`s.

Rules decide by the scene, races (`race.py`) by steps of both ways, with dL/dI held at one image's:

- `sequence` (rule): low-discrepancy numbers, unless paths are guided. Guided paths start in cells of their own, which
  leave little to spread evenly (docs/sequences.md has the figures).
- `paths` (race): camera paths alone against both kinds, where camera paths find all light. They may have a thousand
  times the efficiency, so that a run of a second is worth it, and a few small steps tell. Elsewhere both (rule).
- `pixels` (rule): how camera paths are shared out over the pixels (`guiding/pixels.py`).
- `guiding` (race): guided emission, from a table that is learned first, and held, against the run as it is without.
  To a guided step's time is added its part of what a run of that length learns: each time one more walk of one pass,
  with what Python does for a new table, often at first and then rarely. Short steps make the table less worth than a
  run's, which has learned from more, and draws more paths from each of its cells: what pays here pays there. Where
  light paths alone find all light they are what is guided: weights know nothing of guiding, and take from guided paths
  what camera paths might have found. Where parameters move light it is off, for low-discrepancy numbers (rule): these
  have 6 to 10 times the efficiency of guided paths in all experiments of that kind.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.config.files import in_words
from reslrb_cli.config.schema import Config
from reslrb_cli.guiding.pixels import noted_part
from reslrb_cli.integrators.plan_report import GUIDED, PATHS_FROM, PIXELS, SEQUENCE, PlanRow, with_reason
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.optimization.autotune.race import Finding, StepTrial, measured_step, sets_of, sizes
from reslrb_cli.optimization.losses import QUADRATIC
from reslrb_cli.optimization.memory import pixels_of
from reslrb_cli.optimization.moving import is_attached
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.decisions import Decision, DecisionCache, key_of
from reslrb_cli.records.manifest import versions
from reslrb_cli.scene.files import file_digests, files_of
from reslrb_cli.scene.needs import camera_finds_all, light_finds_all
from reslrb_cli.transport.film import PixelShares

#: A guided step, or one of camera paths alone, may take so many times as long as another.
GUIDING_LONGER, PATHS_LONGER = 3.0, 2.0
#: Steps' worth of time that the rounds of camera paths are planned for.
PATHS_PLANNED = 1.2
#: A race is begun where there is time for so many iterations of the run, and to compile so many times the kernels of a
#: step. Kernels of camera paths, and of both kinds, are those of the run, whichever wins.
LEAST_ITERATIONS, GUIDING_KERNELS, PATHS_KERNELS = 3.0, 2.5, 0.0
Say = Callable[[str], None]
logger = logging.getLogger(__name__)


class Tuner:
    """The decisions of a run as they are taken; `problem` has those until now, and the integrator that they make.

    `say` is told what is decided, and once that something is measured; `cache` has the decisions of earlier runs.
    """

    def __init__(self, problem: Problem, say: Say, cache: DecisionCache | None = None) -> None:
        self.problem, self.say, self._cache = problem, say, cache
        self._unmeasured: set[str] = set()
        self._times: tuple[float, float] | None = None
        self._spent_s = 0.0

    def take(self, *decisions: Decision) -> None:
        """Take these decisions, in place of earlier ones on the same settings."""
        again = {each.setting for each in decisions}
        kept = [each for each in self.problem.decisions if each.setting not in again]
        integrator = as_decided(self.problem.integrator, decisions)
        if integrator.paths != self.problem.integrator.paths:
            self._times = None  # iterations of other paths take another time
        self.problem = replace(self.problem, decisions=[*kept, *decisions], integrator=integrator)

    def set_aside(self, size: int) -> None:
        """Expect so many more bytes in all steps, where a memory budget is kept."""
        if (memory := self.problem.memory) is not None:
            expected = replace(memory.expected_bytes, fixed=memory.expected_bytes.fixed + size)
            self.problem = replace(self.problem, memory=replace(memory, expected_bytes=expected))

    def tell(self) -> None:
        """Say the decisions; all that there was no time to measure are one line."""
        verbose, found = logger.isEnabledFor(logging.DEBUG), self.problem.decisions
        brief = [each for each in found if each.setting in self._unmeasured and not verbose]
        if brief:
            self.say(f"{self._too_dear()}: {', '.join(f'{each.setting} {each.value}' for each in brief)}")
        for each in found:
            if each not in brief:
                self.say(each.line(cost=verbose))

    def race(self, otherwise: Decision, of: Any, kernels: float, measure: Callable[[float], Decision]) -> Decision:
        """Return the decision of an earlier run, or what `measure` finds in the seconds that it is given.

        The decision is `otherwise` where time is left neither for LEAST_ITERATIONS nor to compile so many `kernels`. It
        depends on the situation and `of`. All races together take `run.measuring` of the run's expected seconds.
        """
        key = ""
        if self._cache is not None:
            key = key_of({"setting": otherwise.setting, "of": of, **situation(self.problem)})
            if (kept := self._cache.get(key)) is not None:
                return replace(kept, cached=True)
        run = self.problem.config.run
        compile_s, iteration_s = self._measured_times()
        left_s = run.measuring * (compile_s + run.iterations * iteration_s) - self._spent_s
        if kernels * compile_s + LEAST_ITERATIONS * iteration_s > left_s:
            self._unmeasured.add(otherwise.setting)
            return replace(otherwise, why=f"{self._too_dear()}; {otherwise.why}")
        if not self._spent_s:
            self.say("measuring what pays here, before the first iteration")
        begin = time.perf_counter()
        decision = measure(left_s)
        seconds = time.perf_counter() - begin
        self._spent_s += seconds
        decision = replace(decision, seconds=seconds)
        if self._cache is not None:
            self._cache.put(key, decision)
        return decision

    def _too_dear(self) -> str:
        return f"not measured (over {100 * self.problem.config.run.measuring:.3g} % of this run)"

    def _measured_times(self) -> tuple[float, float]:
        """Seconds that kernels of a step take to compile, and those of an iteration, by two first steps of few samples,
        which the run would take as well."""
        if self._times is None:
            problem, unit, clock = self.problem, sets_of(self.problem.config), StepClock()
            own = problem.integrator.to_measure().with_options(samples_per_pass=None, freeze=False)
            first, second = (measured_step(problem, own, clock, 0, unit) for _ in range(2))
            compile_ms = max(first.wall_ms + first.compile_ms - second.wall_ms, 0.0)
            iteration_ms = second.beside_ms + second.kernel_ms * problem.config.run.spp / unit
            self._times = compile_ms / 1e3, iteration_ms / 1e3
        return self._times


def is_auto(config: Config, setting: str) -> bool:
    """Whether this setting of the integrator is left to a decision."""
    return bool(config.integrator.options().get(setting) == "auto")


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


# --- sequence ---------------------------------------------------------------------------------------------------------


def _sequence(tuner: Tuner) -> None:
    """Take low-discrepancy numbers, unless the configuration asks for guided paths."""
    guided = tuner.problem.integrator.preparation.guiding is not None
    tuner.take(_independent() if guided else Decision(
        setting="sequence", value="low_discrepancy", why="evenly spread numbers have been no loss in any scene"
    ))  # fmt: skip


def _independent() -> Decision:
    return Decision(setting="sequence", value="independent", why="guided paths gain little by evenly spread numbers")


# --- paths ------------------------------------------------------------------------------------------------------------

#: The share of light paths; both kinds have the share that the configuration says.
SHARES = {"light": 1.0, "camera": 0.0, "both": None}


def _paths(tuner: Tuner) -> None:
    """Have camera paths alone where they find all light, and pay."""
    problem = tuner.problem
    if problem.paths != "both":
        return
    both = Decision(setting="paths", value="both", why="half of them cost little anywhere")
    if not camera_finds_all(problem.scene, problem.integrator.max_depth):
        tuner.take(replace(both, why="camera paths do not find all light here"))
        return

    def measure(limit_s: float) -> Decision:
        trial = StepTrial(problem, "paths", problem.integrator.afresh(), problem.integrator.afresh(light_share=0.0))
        found = trial.race(sizes(problem, PATHS_LONGER, PATHS_PLANNED), limit_s, sure=True)
        return _found(both, found, "camera" if found.other else "both", "camera paths have ")

    tuner.take(tuner.race(both, None, PATHS_KERNELS, measure))


def _found(otherwise: Decision, found: Finding, value: str, whose: str = "") -> Decision:
    """The decision that a race came to."""
    gain, low, high = found.gain
    why = found.why() if gain is None else whose + found.why()
    return replace(otherwise, value=value, why=why, gain=gain, low=low, high=high)


# --- pixels -----------------------------------------------------------------------------------------------------------


def _pixels(tuner: Tuner) -> None:
    """Decide whether camera paths are shared out over the pixels: the loss is l2 alone, and the run has so many paths
    that the noted ones, and their kernel, take a small part of it.

    A mirror room by relative_l2 has twice the variance with shares in some of its colours (docs/method.md).
    """
    problem = tuner.problem
    if problem.integrator.paths == "light":
        return
    even = Decision(setting="pixels", value="even", why="left alone where the loss is not l2 alone")
    if any(loss.type != "l2" for loss in problem.config.losses):
        tuner.take(even)
        return
    run, films = problem.config.run, pixels_of(problem.scene, [view.sensor for view in problem.trained])
    each = run.iterations * run.spp * len(problem.drawn(0)) / len(films)
    part = noted_part(each * sum(films), each)
    if part is None:
        tuner.take(replace(even, why="a run as short as this has no time for it"))
        return
    why = f"where noise weighs most, by {100 * part:.2g} % of this run's samples"
    tuner.take(replace(even, value="measured", why=why))


def _share_out(tuner: Tuner) -> None:
    """Note how camera paths are to be shared out over the pixels, by the parameters' values at the start."""
    problem, tracer = tuner.problem, tuner.problem.integrator
    if not isinstance(tracer, Tracer) or not tracer.preparation.shares_out or tracer.paths == "light":
        return
    problem.apply()
    scene, params = problem.scene, problem.selection.params
    jobs = {view.sensor: Job(scene, scene.sensors()[view.sensor], mi.UInt32(0), 0, params) for view in problem.trained}
    known = all(loss.type in QUADRATIC for loss in problem.config.losses)
    curvatures = {view.sensor: view.curvature(known) for view in problem.trained}
    noted = {str(sensor): tracer.note_pixels(job, curvatures[sensor]) for sensor, job in jobs.items()}
    tuner.problem = replace(problem, integrator=tracer.shared_out(noted))
    tuner.set_aside(sum(map(PixelShares.bytes, pixels_of(scene, list(jobs)))))


# --- guiding ----------------------------------------------------------------------------------------------------------


def _guiding(tuner: Tuner) -> None:
    """Guide light paths where that pays, in place of camera paths where they find all light alone."""
    problem, config = tuner.problem, tuner.problem.config
    alone = _guides_light_alone(problem)
    if problem.integrator.paths == "camera" and not alone:
        return  # no path begins at a light
    off = Decision(setting="guiding", value="off", why="it pays in long runs")
    if problem.memory is not None:
        free, needed = problem.memory.budget_bytes - problem.memory.expected_bytes.total, table_bytes(problem)
        if needed > free:
            tuner.take(replace(off, why=f"run.memory_budget has no room for tables of {in_words(needed)}"))
            return
    even = False if is_auto(config, "sequence") else None
    if even is not None and is_attached(problem):
        tuner.take(replace(off, why="of what moves light, evenly spread numbers say most"))
        return
    plan = sizes(problem, GUIDING_LONGER)

    def measure(limit_s: float) -> Decision:
        plain, share = problem.integrator.afresh(), 1.0 if alone else None
        guided = problem.integrator.afresh(guided=True, light_share=share, low_discrepancy=even)
        found = StepTrial(problem, "guiding", plain, guided).race(plan, limit_s, guides=True)
        if alone and found.other and not found.images and plan.alone:
            found = replace(found, other=False, note="images would have less")
        return _found(off, found, ("on" if found.images else "gradients") if found.other else "off")

    # Learning is a larger part of a short run, where tables learn most often at first.
    of = [plan.lessons, problem.integrator.paths, problem.integrator.light_share]
    decision = tuner.race(off, of, GUIDING_KERNELS, measure)
    if decision.value == "off":
        tuner.take(decision)
        return
    if alone:
        why = f"guided, they have {decision.gain:.2g} times the efficiency"
        tuner.take(Decision(setting="paths", value="light", why=why))
    tuner.take(*([] if even is None else [_independent()]), decision)
    tuner.set_aside(table_bytes(tuner.problem))


def table_bytes(problem: Problem) -> int:
    """Bytes of the tables of all sensors, if `problem.integrator` is guided, or were."""
    made = problem.integrator.afresh(guided=True, light_share=1.0 if _guides_light_alone(problem) else None)
    if made.paths == "camera":
        return 0
    made.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # cuts the grid
    return int(made.preparation.guiding.bytes(len(problem.sensors)))


def _guides_light_alone(problem: Problem) -> bool:
    """Whether it is light paths alone that guiding is tried with, where there are camera paths beside or in place of
    them, by a decision."""
    if not any(each.setting == "paths" and each.value != "light" for each in problem.decisions):
        return False
    sensors = [problem.scene.sensors()[sensor] for sensor in problem.sensors]
    return light_finds_all(problem.scene, sensors, problem.integrator.hide_emitters)


# --- all of them ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Option:
    """A setting of the integrator that may be `auto`.

    `decide` takes the decision, or none where the setting has no effect. `apply` returns an integrator with a value
    that was decided. `feature` is the row of the plan that shows the reason, if there is one.
    """

    decide: Callable[[Tuner], None]
    apply: Callable[[Any, str], Any]
    feature: str = ""


#: By setting, in the order of the decisions.
OPTIONS = {
    "sequence": Option(
        _sequence, lambda tracer, value: tracer.afresh(low_discrepancy=value == "low_discrepancy"), SEQUENCE
    ),
    "paths": Option(_paths, lambda tracer, value: tracer.afresh(light_share=SHARES[value]), PATHS_FROM),
    "pixels": Option(_pixels, lambda tracer, value: tracer.afresh(shares_out=value == "measured"), PIXELS),
    "guiding": Option(
        _guiding, lambda tracer, value: tracer.afresh(guided=value != "off", images=value == "on"), GUIDED
    ),
}


def settle(problem: Problem, say: Say, cache: DecisionCache | None = None) -> Problem:
    """Return `problem` with all decisions that are left to `auto`, and the integrator that they make.

    Needs the targets. `say` is given a line of each decision, and `cache` holds the measurements of earlier runs.
    """
    tuner = Tuner(problem, say, cache)
    for setting, option in OPTIONS.items():
        if setting == "guiding":  # whose race is of steps with their camera paths shared out
            _share_out(tuner)
        if is_auto(problem.config, setting):
            option.decide(tuner)
    tracer = tuner.problem.integrator
    if isinstance(tracer, Tracer) and tracer.paths == "camera":  # of which none is drawn from the sequence
        decisions = [each for each in tuner.problem.decisions if each.setting != "sequence"]
        tuner.problem = replace(tuner.problem, decisions=decisions)
    tuner.tell()
    return tuner.problem


def decided(config: Config, decisions: Iterable[Decision]) -> list[Decision]:
    """Return the decisions on settings that `config` leaves to `auto`."""
    return [each for each in decisions if each.setting in OPTIONS and is_auto(config, each.setting)]


def as_decided(integrator: Any, decisions: Iterable[Decision]) -> Any:
    """Return `integrator` with the values that were decided."""
    for each in decisions:
        integrator = OPTIONS[each.setting].apply(integrator, each.value)
    return integrator


def explained(rows: list[PlanRow], decisions: Iterable[Decision]) -> list[PlanRow]:
    """Return the rows of a plan with the reasons of decisions."""
    for each in decisions:
        rows = with_reason(rows, OPTIONS[each.setting].feature, f"{each.setting}: auto, {each.why}")
    return rows
