"""Automatic decisions about the sampling of a run, taken before its first iteration.

`AUTOMATIC` has one entry for each setting of the integrator that may be `auto`. To add a setting, add its entry here,
and the setting to `ReslrbConfig` in `config/integrators.py`, marked `Plain` with its plain value. `Plan.on` contains
the settings that have another value. All other code (Mitsuba's plugin, the printed line, manifest, checkpoints, page,
`inspect`, resumed runs) reads these tables and the list of `Decision`s.

A decision follows a rule or a race. A rule uses facts of the scene and the configuration. A race compares steps of both
ways (`race.py`), with dL/dI fixed at one image.

- `sequence` (rule): low-discrepancy numbers, unless paths are guided. Guided paths start in their own cells, which
    leave little to spread evenly (docs/sequences.md has the figures).
- `paths` (race): camera paths alone against both kinds, if camera paths find all light. They may be a thousand times as
    efficient. Even a run of one second then gains, and a few small steps decide. Otherwise both kinds (rule).
- `pixels` (rule): whether camera paths are distributed over the pixels by their noise. The distribution itself is then
    measured (`guiding/pixels.py`).
- `guiding` (race): guided paths with independent numbers against the run without guiding. The table learns first and
    then stays fixed. The time of a guided step includes the step's share of the run's learning: one more walk per
    lesson, and the Python code for a new table. Short steps underestimate the table of a run, because the run's table
    has learned from more paths. If light paths find all light, the guided steps use light paths only. With both kinds
    of paths, the weights ignore guiding and take away most of its benefit. If a parameter moves light and all paths are
    light paths, guiding is off (rule), because low-discrepancy numbers help most there. If a shape moves and there are
    both kinds, guiding is on (rule), because light paths then have only the light that mirrors and glass bundle.
- `blur` (rule): images are blurred at first if the run recovers a motion. This is a setting of the run, which the
    integrator does not know, so it has no entry in `AUTOMATIC`.
- `edges` (measured after all others, by `measure/missing.py`): on if the derivative lacks a significant share without
    them.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.config.integrators import AUTO_VALUES
from reslrb_cli.config.schema import Config
from reslrb_cli.guiding.pixels import noted_part
from reslrb_cli.guiding.tables import sensor_bytes
from reslrb_cli.integrators.plans import PlanRow, scene_rows, without_light
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.optimization.autotune.race import Finding, StepTrial, measured_step, sizes
from reslrb_cli.optimization.losses import QUADRATIC
from reslrb_cli.optimization.memory import pixels_of
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.decisions import Decision, DecisionCache, key_of
from reslrb_cli.records.manifest import versions
from reslrb_cli.scene.files import file_digests, files_of
from reslrb_cli.scene.needs import camera_finds_all, light_finds_all
from reslrb_cli.transport.plan import Plan

#: Maximum time of a guided step, and of a step of camera paths alone, relative to another.
GUIDING_LONGER, PATHS_LONGER = 3.0, 2.0
#: Time for the planned rounds of the race of camera paths, in steps.
PATHS_PLANNED = 1.2
#: A race needs time for this many iterations of the run, and to compile the kernels of this many steps. The run needs
#: the kernels of camera paths and of both kinds, whichever wins.
LEAST_ITERATIONS, GUIDING_KERNELS, PATHS_KERNELS = 3.0, 2.5, 0.0
Say = Callable[[str], None]
logger = logging.getLogger(__name__)


class Tuner:
    """Decisions before a run. `problem` is the given problem, with the decisions so far.

    `say` is called with the decisions, and once before a measurement. `cache` has decisions of earlier runs.
    """

    def __init__(self, problem: Problem, say: Say, cache: DecisionCache | None = None) -> None:
        self.problem, self.say, self._cache = problem, say, cache
        self._times: tuple[float, float] | None = None
        self._spent_s = 0.0

    def take(self, *decisions: Decision) -> None:
        """Add decisions to the problem, and change its integrator. They replace earlier decisions on the same
        settings.
        """
        again = {each.setting for each in decisions}
        kept = [each for each in self.problem.decisions if each.setting not in again]
        integrator = as_decided(self.problem.integrator, decisions)
        if integrator.paths != self.problem.integrator.paths:
            self._times = None  # iterations with other paths take another time
        self.problem = replace(self.problem, decisions=[*kept, *decisions], integrator=integrator)

    def tell(self) -> None:
        """Print the decisions in one line, or each with its reason in verbose runs."""
        found = self.problem.decisions
        if logger.isEnabledFor(logging.DEBUG):
            for each in found:
                self.say(each.line(cost=True))
        elif found:
            chosen = ", ".join(f"{each.setting} {each.value}" for each in found)
            how = "by measurement" if any(each.seconds for each in found) else "without measuring"
            self.say(f"chosen {how}: {chosen} (`reslrb --debug` gives the reasons)")

    def race(
        self, otherwise: Decision, other: str, of: Any, kernels: float, measure: Callable[[float], Finding],
        whose: str = "",
    ) -> Decision:  # fmt: skip
        """Return the decision of an earlier run, or that of a race.

        `measure` races the value `other`, and takes the time limit in seconds. A race that the limit ended undecided is
        not kept for later runs. `whose` names the other way in the reason.

        The result is `otherwise` if the time does not suffice for LEAST_ITERATIONS and for the compilation of the
        kernels of `kernels` steps. `of` has the conditions of the decision that `situation` does not contain. All races
        together take at most the fraction `run.measuring` of the run's expected time.
        """
        key = ""
        if self._cache is not None:
            key = key_of({"setting": otherwise.setting, "of": of, **situation(self.problem)})
            kept = self._cache.get(key)
            if kept is not None and kept.value in AUTO_VALUES[otherwise.setting]:
                return replace(kept, setting=otherwise.setting, cached=True)
        share = self.problem.config.run.measuring
        if not share or (left_s := self._left_s(kernels)) is None:
            return replace(otherwise, why=f"not measured (over {100 * share:.3g} % of this run); {otherwise.why}")
        if not self._spent_s:
            self.say("measuring which sampling is most efficient")
        begin = time.perf_counter()
        found = measure(left_s)
        seconds = time.perf_counter() - begin
        self._spent_s += seconds
        gain, low, high = found.gain or (None, None, None)
        decision = replace(
            otherwise, value=other if found.other else otherwise.value,
            why=found.why() if gain is None else whose + found.why(), gain=gain, low=low, high=high, seconds=seconds,
        )  # fmt: skip
        if self._cache is not None and not found.is_open:
            self._cache.put(key, decision)
        return decision

    def _left_s(self, kernels: float) -> float | None:
        """Return the remaining seconds for races, or None if they do not suffice for one more race."""
        run = self.problem.config.run
        compile_s, iteration_s = self._measured_times()
        run_s = min(compile_s + run.iterations * iteration_s, run.max_seconds or math.inf)
        left_s = run.measuring * run_s - self._spent_s
        return left_s if left_s >= kernels * compile_s + LEAST_ITERATIONS * iteration_s else None

    def _measured_times(self) -> tuple[float, float]:
        """Return the seconds to compile the kernels of a step, and the seconds of an iteration. Two first steps with
        few samples determine them. The run would take these steps as well, so they do not count as spent.
        """
        if self._times is None:
            problem, config, clock = self.problem, self.problem.config, StepClock()
            unit = config.run.spp // config.set_spp  # a sample for each set
            own = problem.integrator.to_measure().with_options(samples_per_pass=None, freeze=False)
            first, second = (measured_step(problem, own, clock, 0, unit) for _ in range(2))
            compile_ms = max(first.wall_ms + first.compile_ms - second.wall_ms, 0.0)
            iteration_ms = second.beside_ms + second.kernel_ms * config.run.spp / unit
            self._times = compile_ms / 1e3, iteration_ms / 1e3
        return self._times


def is_auto(config: Config, setting: str) -> bool:
    """Whether this setting of the integrator is left to a decision."""
    return bool(config.integrator.options().get(setting) == "auto")


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
        "run": config.step_options(),
        "versions": versions(),
        "variant": mi.variant(),
        "device": device_name(mi.variant()),
    }


# --- sequence ---------------------------------------------------------------------------------------------------------


def _sequence(tuner: Tuner) -> None:
    """Use low-discrepancy numbers, unless the configuration asks for guided paths."""
    if tuner.problem.integrator.preparation.guiding is not None:
        tuner.take(_independent())
    else:
        why = "evenly spread numbers have been no loss in any scene"
        tuner.take(Decision(setting="sequence", value="low_discrepancy", why=why))


def _independent() -> Decision:
    why = "guided paths gain little from evenly spread numbers"
    return Decision(setting="sequence", value="independent", why=why)


# --- paths ------------------------------------------------------------------------------------------------------------

#: The share of light paths of each kind. With both kinds, the configuration gives the share.
SHARES = {"light": 1.0, "camera": 0.0, "both": None}


def _paths(tuner: Tuner) -> None:
    """Use camera paths alone if they find all light and pay."""
    problem = tuner.problem
    both = Decision(setting="paths", value="both", why="half of each costs little in any scene")
    if not camera_finds_all(problem.scene, problem.integrator.max_depth):
        tuner.take(replace(both, why="camera paths do not find all light here"))
        return

    def measure(limit_s: float) -> Finding:
        trial = StepTrial(problem, "paths", problem.integrator.afresh(), problem.integrator.afresh(light_share=0.0))
        return trial.race(sizes(problem, PATHS_LONGER, PATHS_PLANNED), limit_s)

    tuner.take(tuner.race(both, "camera", None, PATHS_KERNELS, measure, "camera paths have "))


# --- pixels -----------------------------------------------------------------------------------------------------------


def _pixels(tuner: Tuner) -> None:
    """Distribute camera paths over the pixels if the loss is l2 and the measurement is a small part of the run.

    With relative_l2, a mirror room had twice the variance in some colours (docs/notes/method.md).
    """
    problem = tuner.problem
    if problem.moves:
        tuner.take(Decision(setting="pixels", value="even", why="the noise of moving shapes is not measured"))
        return
    even = Decision(setting="pixels", value="even", why="unchanged, because not every loss is l2")
    if any(loss.type != "l2" for loss in problem.config.losses):
        tuner.take(even)
        return
    run, films = problem.config.run, pixels_of(problem.scene, [view.sensor for view in problem.trained])
    each = run.iterations * run.spp * len(problem.drawn(0)) / len(films)
    part = noted_part(each * sum(films), each)
    if part is None:
        tuner.take(replace(even, why="the run is too short for it"))
    else:
        why = f"by noise, measured with {100 * part:.2g} % of this run's samples"
        tuner.take(replace(even, value="measured", why=why))


def _measure_pixels(tuner: Tuner) -> None:
    """Measure the distribution of camera paths over the pixels at the initial values of the parameters, if the run
    distributes them.
    """
    problem, tracer = tuner.problem, tuner.problem.integrator
    if problem.moves or not isinstance(tracer, Tracer) or tracer.paths == "light":
        return
    if "pixels" not in tracer.preparation.sampling.on:
        return
    problem.apply()
    scene, params = problem.scene, problem.selection.params
    jobs = {view.sensor: Job(scene, scene.sensors()[view.sensor], mi.UInt32(0), 0, params) for view in problem.trained}
    known = all(loss.type in QUADRATIC for loss in problem.config.losses)
    curvatures = {view.sensor: view.curvature(known) for view in problem.trained}
    noted = {str(sensor): tracer.note_pixels(job, curvatures[sensor]) for sensor, job in jobs.items()}
    tuner.problem = replace(problem, integrator=tracer.shared_out(noted))


# --- guiding ----------------------------------------------------------------------------------------------------------


def _guiding(tuner: Tuner) -> None:
    """Guide light paths if that pays. If light paths find all light, they also replace camera paths."""
    problem, config = tuner.problem, tuner.problem.config
    alone = _guides_light_alone(problem)
    if problem.integrator.paths == "camera" and not alone:
        return  # no path starts at an emitter
    off = Decision(setting="guiding", value="off", why="it pays in long runs")
    if problem.integrator.preparation.sampling.lit:
        tuner.take(replace(off, why="views with different lamps cannot share its tables"))
        return
    independent = {"sequence": "independent"} if is_auto(config, "sequence") else {}
    if independent and problem.moves:
        if problem.integrator.paths == "light":
            tuner.take(replace(off, why="for moving light, low-discrepancy numbers help most"))
        else:
            why = "only light paths that meet mirrors or glass first contribute"
            tuner.take(_independent(), replace(off, value="on", why=why))
        return
    plan = sizes(problem, GUIDING_LONGER)

    def measure(limit_s: float) -> Finding:
        plain, share = problem.integrator.afresh(), 1.0 if alone else None
        guided = problem.integrator.afresh(guiding="on", light_share=share, **independent)
        return StepTrial(problem, "guiding", plain, guided).race(plan, limit_s, guides=True)

    # Learning is a larger part of a short run, because tables learn most often at the start.
    of = [plan.lessons, problem.integrator.paths, problem.integrator.light_share]
    decision = tuner.race(off, "on", of, GUIDING_KERNELS, measure)
    if decision.value == "off":
        tuner.take(decision)
        return
    others = [_independent()] if independent else []
    if alone:
        why = f"guided, they have {decision.gain:.2g} times the efficiency"
        others += [replace(each, value="light", why=why, gain=None, low=None, high=None)
                   for each in problem.decisions if each.setting == "paths"]  # fmt: skip
    tuner.take(*others, decision)


def _guides_light_alone(problem: Problem) -> bool:
    """True if guiding is tried with light paths only, instead of with the decided camera paths."""
    if not any(each.setting == "paths" and each.value != "light" for each in problem.decisions):
        return False
    sensors = [problem.scene.sensors()[sensor] for sensor in problem.sensors]
    return light_finds_all(problem.scene, sensors, problem.integrator.hide_emitters)


# --- all decisions ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Automatic:
    """Automatic setting of the integrator. `AUTO_VALUES` has its values.

    - `decide` takes the decision.
    - `paths` are the kinds of paths that leave the setting open: those that can render the scene (`Problem.paths`).
    - `row` returns the row of a plan that shows whether the setting has an effect, and why.
    - `prepare` measures what the value needs, decided or configured.
    """

    decide: Callable[[Tuner], None]
    paths: tuple[str, ...]
    row: Callable[[Plan], PlanRow]
    prepare: Callable[[Tuner], None] = lambda tuner: None


def _tables(plan: Plan) -> str:
    if plan.grid is None:
        return ""
    size = f"{plan.grid.cells} cells, {sensor_bytes(plan.grid, plan.aims) / 2**20:.1f} MiB of tables"
    return f"light paths start and continue where earlier ones contributed: {size}"


#: The automatic settings, in the order of the decisions.
AUTOMATIC = {
    "sequence": Automatic(_sequence, ("light", "both"), lambda plan: PlanRow.of(
        "low-discrepancy numbers", plan.sequence is not None,
        "origins and first directions of paths are evenly distributed", without_light(plan) or "sequence: independent",
    )),
    "paths": Automatic(_paths, ("both",), lambda plan: PlanRow(
        "camera paths", plan.paths != "light", f"paths: {plan.paths}",
    )),
    "pixels": Automatic(_pixels, ("camera", "both"), lambda plan: PlanRow.of(
        "camera paths by pixel", "pixels" in plan.on, "most where noise affects the gradient most",
        "no camera paths" if plan.paths == "light" else "pixels: even",
    ), _measure_pixels),
    "guiding": Automatic(_guiding, ("light", "both"), lambda plan: PlanRow.of(
        "guided emission", plan.grid is not None, _tables(plan), without_light(plan) or "guiding: off",
    )),
    "edges": Automatic(lambda tuner: None, (), lambda plan: PlanRow.of(
        "edges of moving shapes", plan.has_edges, "the light that they cover and uncover has a derivative",
        "nothing moves, edges: off, or edges: auto before a run decides",
    )),
}  # fmt: skip


def decide(problem: Problem, say: Say, cache: DecisionCache | None = None) -> Problem:
    """Return `problem` with all decisions on settings that are `auto`, and with the resulting integrator.

    The problem needs its targets. `say` receives lines about the decisions. `cache` has decisions of earlier runs.
    """
    tuner = Tuner(problem, say, cache)
    for setting, automatic in AUTOMATIC.items():
        if setting in open_settings(problem.config, problem.paths):
            automatic.decide(tuner)
        automatic.prepare(tuner)
    # The chosen paths may leave a setting without effect.
    unused = {"camera": "sequence", "light": "pixels"}.get(getattr(tuner.problem.integrator, "paths", ""))
    decisions = [each for each in tuner.problem.decisions if each.setting != unused]
    tuner.problem = replace(tuner.problem, decisions=[*blur_decision(problem), *decisions])
    tuner.tell()
    return tuner.problem


def blur_decision(problem: Problem) -> list[Decision]:
    """Return the decision on `run.blur: auto`, or nothing if images stay sharp."""
    widest = max(problem.first_blur(view) for view in problem.trained) if problem.config.run.blur == "auto" else 0.0
    why = "shapes that move also attract each other from a distance in blurred images"
    return [Decision(setting="blur", value=f"{widest:.3g} px", why=why)] if widest else []


def open_settings(config: Config, paths: str) -> list[str]:
    """Return the settings that a run decides. `paths` are the kinds of paths that can render the scene."""
    return [setting for setting, its in AUTOMATIC.items() if is_auto(config, setting) and paths in its.paths]


def decided(config: Config, decisions: Iterable[Decision]) -> list[Decision]:
    """Return the decisions on settings that `config` leaves to `auto`. Raises TypeError for an unknown value."""
    found = [each for each in decisions if each.setting in AUTOMATIC and is_auto(config, each.setting)]
    for each in found:
        if each.value not in (values := AUTO_VALUES[each.setting]):
            raise TypeError(f"{each.setting} is `{each.value}`; possible are {', '.join(values)}")
    return found


def as_decided(integrator: Any, decisions: Iterable[Decision]) -> Any:
    """Return `integrator` with the decided values."""
    for each in decisions:
        change = {"light_share": SHARES[each.value]} if each.setting == "paths" else {each.setting: each.value}
        integrator = integrator.afresh(**change)
    return integrator


def plan_rows(plan: Plan, decisions: Iterable[Decision]) -> list[PlanRow]:
    """Return all features of a plan, including those that it leaves out, with the reasons of decisions."""
    rows = {setting: automatic.row(plan) for setting, automatic in AUTOMATIC.items()}
    for each in decisions:
        row = rows.get(each.setting) or PlanRow("blurred images", True, each.value)
        why = f"{each.setting}: auto, {each.why}"
        rows[each.setting] = replace(row, reason=f"{row.reason}; {why}" if row.needed else why)
    return [*scene_rows(plan), *rows.values()]
