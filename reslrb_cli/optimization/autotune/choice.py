"""The integrator of a run, settled before its first iteration: the estimator by a pilot, the passes by a budget."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import mitsuba as mi

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.config.integrators import Reslrb as ReslrbConfig
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.optimization.autotune.efficiency import ITERATIONS, Allowance, Candidate, Measured, Outcome
from reslrb_cli.optimization.autotune.estimators import SHARE, Pilot
from reslrb_cli.optimization.decisions import Cache, MemoryPlan
from reslrb_cli.optimization.loading import pass_spp
from reslrb_cli.optimization.memory import check_baseline, check_memory, choose_samples, standing
from reslrb_cli.optimization.moving import ATTACHED, is_attached
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.records.clock import MIB, StepClock
from reslrb_cli.records.decisions import GuidedRecord, RivalRecord, SequenceRecord, key_of
from reslrb_cli.records.manifest import versions

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


#: What measurements take at least that say anything: kernels to compile, in those of one step, and iterations' worth of
#: work. Compiling is that of both kinds of steps, and of walks that are learned from.
ESTIMATOR_NEEDS, GUIDING_NEEDS, SEQUENCE_NEEDS = (4.0, 4.0), (2.5, 3.0), (2.5, 1.0)


LATER = {"guiding": GUIDING_NEEDS, "sequence": SEQUENCE_NEEDS}  # once the estimator is settled


Say = Callable[[str], None]


Kept = TypeVar("Kept", GuidedRecord, SequenceRecord, RivalRecord)


@dataclass
class Option:
    """A candidate, ready to run; `memory` where there is a budget."""

    options: dict[str, Any]
    integrator: Tracer
    memory: MemoryPlan | None


def find_options(problem: Problem) -> list[Option]:
    """What the run may use in place of `problem.integrator`, where that is left to measurement; else nothing.

    Needs no targets. Raises ConfigError where no estimator keeps the memory budget.
    """
    config = problem.config
    if not isinstance(config.integrator, ReslrbConfig):
        check_baseline(problem)
        return []
    if config.integrator.estimator == "auto":
        choices = [{"estimator": ATTACHED}] if is_attached(problem) else candidates(config)
        return _fitting(problem, config.integrator, choices)
    if config.run.memory_budget is None:
        check_memory(problem, problem.integrator)
        return []
    return _fitting(problem, config.integrator, [{}])


def settle_integrator(problem: Problem, options: list[Option], say: Say, cache: Cache | None = None) -> None:
    """Replace `problem.integrator` by the best of the options, where there are any; of several a pilot finds it.

    What moves light leaves one estimator, which needs no pilot.
    """
    if not options:
        return
    chosen = options[0]
    if len(options) > 1 and chosen.options:
        problem.pilot = _outcome(problem, options, say, cache)
        chosen = next(option for option in options if option.options == problem.pilot.chosen)
        say(problem.pilot.line())
    problem.integrator, problem.memory = chosen.integrator, chosen.memory
    if chosen.memory is not None:
        problem.samples_per_pass = chosen.memory.samples_per_pass


def candidates(config: Config) -> list[dict[str, Any]]:
    """Options of all estimators that apply, those first that others are judged by."""
    found: list[dict[str, Any]] = [{"estimator": "stack"}, {"estimator": "gather"}]
    found += [{"estimator": name, "capacity": m} for m in (1, 4) for name in ("reservoir", "event")]
    if config.adjoint != "correlated":
        found += [{"estimator": "reservoir", "capacity": m, "weight": "adjoint"} for m in (1, 4)]
    return found


# --- memory -----------------------------------------------------------------------------------------------------------


def _fitting(problem: Problem, integrator: ReslrbConfig, choices: list[dict[str, Any]]) -> list[Option]:
    """The candidates that keep the budget, each with the samples of its passes."""
    run, budget, least, options = problem.config.run, problem.config.run.budget_bytes, [], []
    fixed = 0 if budget is None else standing()
    for choice in choices:
        own = (integrator.chosen(**choice) if choice else integrator.undecided_off()).options()
        made = Tracer.of(**own)
        made.expect(pass_spp(problem.config))
        check_memory(problem, made)
        if budget is None:
            options.append(Option(choice, made, None))
            continue
        samples = run.spp // run.batches if problem.config.adjoint == "batched" else run.spp
        size, expected = choose_samples(problem, made, samples, budget, fixed)
        if size == 0:
            least.append(expected.total)
            continue
        if size < samples:
            made = made.with_options(samples_per_pass=size, freeze=made.freeze)
        options.append(Option(choice, made, MemoryPlan(budget, size, samples // size, expected)))
    if not options:
        mib = -(-min(least) // MIB)
        reason = f"one sample per pixel takes about {mib:.0f} MiB (scene, targets, images of a step, parameters, paths)"
        reason += f"; allow at least {mib:.0f} MiB, beside which Python, libraries and kernels are not counted"
        raise ConfigError(problem.config.source, "run.memory_budget", reason)
    return options


# --- pilot ------------------------------------------------------------------------------------------------------------


def _outcome(problem: Problem, options: list[Option], say: Say, cache: Cache | None) -> Outcome:
    """The cached outcome of an earlier pilot, or that of a new one."""
    key = key_of(situation(problem)) if cache is not None else ""
    if cache is not None:
        try:
            outcome = Outcome.from_json(cache.get(key) or {})
            outcome.cached = True
            if any(option.options == outcome.chosen for option in options):
                return outcome
        except (TypeError, KeyError):
            pass  # nothing there, or nothing that this version wrote
    allowance = allowance_of(problem, options[0].integrator)
    if not allowance.affords(ESTIMATOR_NEEDS, *(LATER[option] for option in _later(problem.config))):
        return _usual(options, allowance)
    say("estimator auto: measuring")
    with allowance.counted():
        outcome = run_pilot(problem, options)
    if cache is not None:
        cache.put(key, outcome.to_json())
    return outcome


def _usual(options: list[Option], allowance: Allowance) -> Outcome:
    """The candidate that others are judged by, where there is no time to judge them: it has been the best, or within a
    few percent of it, wherever that was measured (docs/benchmarks.md)."""
    found = _candidate(options[0])
    note = f"{allowance.note()}; every connection, in one traversal"
    return Outcome(found.options, found.label, [], note=note)


def run_pilot(problem: Problem, options: list[Option]) -> Outcome:
    """Measure the options, and say which is the most efficient."""
    run = problem.config.run
    batches = run.batches if problem.config.adjoint == "batched" else 1
    integrators: dict[str, Tracer] = {}
    made = [_candidate(option) for option in options]
    for candidate, option in zip(made, options, strict=True):
        integrators[candidate.label] = option.integrator.to_measure()
    clock = StepClock()

    def step(candidate: Candidate, round: int, spp: int) -> Measured:
        integrator = integrators[candidate.label]
        samples = integrator.samples_per_pass if candidate.passes == 1 else spp // (batches * candidate.passes)
        # Few steps of each sample count: a recording would cost more than it saves.
        integrator = integrator.with_options(samples_per_pass=samples, freeze=False)
        return measured_step(problem, integrator, clock, round, spp)

    unit = batches * max(candidate.passes for candidate in made)
    if problem.samples_per_pass is not None:  # the user's own passes
        unit = batches * min(problem.samples_per_pass, run.spp // batches)
    # What is measured later has its part of what it may cost; guiding leaves some of its own for the sequence.
    later, shares = _later(problem.config), {"guiding": GUIDING_SHARE, "sequence": SEQUENCE_SHARE}
    reserved = max((shares[option] for option in later), default=0.0)
    if problem.allowance is None:
        return Pilot(made, step, run.spp, unit, SHARE - reserved).run()
    began, allowance = time.perf_counter(), problem.allowance
    kernels = sum(LATER[option][0] for option in later)
    share = min(SHARE, allowance.iterations_left(ESTIMATOR_NEEDS[0] + kernels) / ITERATIONS) - reserved

    def compiles() -> bool:
        """Whether there is time for the kernels of one more candidate, with those of what is measured later."""
        spent = replace(allowance, spent_s=allowance.spent_s + time.perf_counter() - began)
        return spent.affords((1 + kernels, reserved * ITERATIONS))

    return Pilot(made, step, run.spp, unit, share, compiles).run()


def _candidate(option: Option) -> Candidate:
    """As the pilot sees it: with two passes where the run has more, which take as many traversals."""
    options = option.options
    name, slots, parent = options["estimator"], options.get("capacity", 1) > 1, None
    if slots or "weight" in options:
        parent = Candidate({"estimator": name, "capacity": 1}, exact=False).label
    elif name in ("gather", "reservoir"):  # which trace their paths twice, where `event` traces them once
        parent = Candidate({"estimator": "event", "capacity": 1}, exact=False).label
    several = option.memory is not None and option.memory.passes > 1
    return Candidate(options, ESTIMATORS[name].exact, 2 if several else 1, parent, slots and "weight" not in options)


def measured_step(problem: Problem, integrator: Any, clock: StepClock, round: int, spp: int) -> Measured:
    """One step of all views, with seeds of the pilot's own; leaves neither gradient nor change behind."""
    start = time.perf_counter()
    problem.apply()
    with clock.step() as times:
        sample_gradient(problem, integrator, round, "pilot", spp)
    gradients = take_gradient(problem)
    wall_ms = 1e3 * (time.perf_counter() - start)
    # Kernels are compiled side by side: their times can add up to more than was waited for.
    return Measured(gradients, times.kernel_ms, max(wall_ms - times.codegen_ms, times.kernel_ms), times.codegen_ms)


def is_auto(config: Config, option: str) -> bool:
    """Whether this option of the integrator is left to measurement."""
    return bool(config.integrator.options().get(option) == "auto")


def _later(config: Config) -> list[str]:
    """The options that are measured once the estimator is settled."""
    return [option for option in LATER if is_auto(config, option)]


def share_left(problem: Problem, reserved: float = 0.0, kernels: float = 0.0) -> float:
    """What earlier measurements left of the share of 200 iterations that all of them may cost, but for what is
    `reserved`, and no more than there is time for in a run as short as this, with `kernels` to compile."""
    spent = sum(each.share for each in (problem.pilot, problem.guided) if each is not None)
    left = max(SHARE - spent - reserved, 0.0)
    if problem.allowance is None:
        return left
    return min(left, max(problem.allowance.iterations_left(kernels) / ITERATIONS - reserved, 0.0))


def allowance_of(problem: Problem, integrator: Tracer) -> Allowance:
    """What may be spent on measuring: as begun before, or by two first steps of `integrator` now, of few samples."""
    if problem.allowance is None:
        run = problem.config.run
        unit = run.batches if problem.config.adjoint == "batched" else 1
        own = integrator.to_measure().with_options(samples_per_pass=None, freeze=False)
        clock = StepClock()
        first, second = (measured_step(problem, own, clock, 0, unit) for _ in range(2))
        compile_ms = max(first.wall_ms + first.compile_ms - second.wall_ms, 0.0)
        beside = max(second.wall_ms - second.kernel_ms, 0.0)
        iteration_ms = beside + second.kernel_ms * run.spp / unit
        run_ms = compile_ms + run.iterations * iteration_ms
        problem.allowance = Allowance(run.measuring, run_ms / 1e3, compile_ms / 1e3, iteration_ms / 1e3)
    return problem.allowance


def suits_even_numbers(problem: Problem) -> str | None:
    """Why evenly spread numbers are likely to do better here than guided paths, by what the scene has; None where it is
    not known. docs/sequences.md has what this was seen on."""
    if is_attached(problem):
        return "of what moves light, evenly spread numbers say most"
    for emitter in problem.scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta) and emitter.class_name() != "DirectionalArea":
            return None
    return "of light from points and beams, evenly spread numbers say most"


def recall(kind: type[Kept], cache: Cache | None, key: str) -> Kept | None:
    """What an earlier run measured and kept by this key; None where it kept nothing."""
    try:
        return None if cache is None else replace(kind.from_json(cache.get(key) or {}), cached=True)
    except TypeError:  # nothing there, or nothing that this version wrote
        return None


def situation(problem: Problem) -> dict[str, Any]:
    """All that the choice of an estimator depends on, as plain values."""
    config = problem.config
    dump = config.model_dump(mode="json")
    run = config.step_options() | {"memory_budget": dump["run"]["memory_budget"]}
    return {
        "scene": hashlib.blake2b(Path(config.scene.file).read_bytes()).hexdigest(),
        "options": dump["scene"]["options"],
        "cameras": config.scene.cameras and hashlib.blake2b(config.scene.cameras.read_bytes()).hexdigest(),
        "sensors": problem.sensors,
        "views": [view.situation() for view in problem.views],
        "parameters": {key: list(problem.selection.array(key).shape) for key in problem.selection.keys},
        "integrator": dump["integrator"],
        "loss": dump["loss"],
        "run": run,
        "versions": versions(),
        "variant": mi.variant(),
        "device": device_name(mi.variant()),
    }


#: Share of a run of ITERATIONS that this is planned for, compilation apart; where it is not clear by then, it may take
#: what a pilot has left of its own.
GUIDING_SHARE = 0.025


#: Share of a run of ITERATIONS that is left for this by what is measured before, compilation apart.
SEQUENCE_SHARE = 0.005
