"""Whether `prb` would have been the better choice: its gradients beside those of the run's integrator, in turns.

    advantage = (variance * time of the run's own) / (variance * time of prb)

Variance is summed over the parameters, each over its gradient's mean square, which is the same for both: steps of the
run's own loss and adjoint. The interval is that of the logarithm of the variances' quotient by the jackknife over the
rounds, and of times by what a single one may be off.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from reslrb_cli.integrators.light_tracer import LightTracer
from reslrb_cli.integrators.step import make_integrator
from reslrb_cli.measure.gradients import moves_light
from reslrb_cli.measure.references import Situation, prb_gradient
from reslrb_cli.optimization.autotune.choice import measured_step, recall, situation
from reslrb_cli.optimization.autotune.efficiency import ITERATIONS, Gradients, compare
from reslrb_cli.optimization.decisions import Cache
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.decisions import RivalRecord, key_of

RIVAL = "prb"


#: Rounds, at most, and fewer than which say nothing.
MOST_ROUNDS, LEAST_ROUNDS = 12, 6


#: Share of a run of ITERATIONS that the rounds may cost, and that LEAST_ROUNDS may where that is more.
SHARE, MOST_SHARE = 0.05, 0.1


#: What it takes at least: kernels to compile, in those of one step of the run, and iterations' worth of work.
NEEDS = (2.0, 2.0)


#: A round of both may take so many times as long as one step of the run.
LONGER = 3.0


@dataclass
class _Measured:
    """Steps of one integrator: gradients by parameter, and milliseconds of kernels."""

    gradients: list[Gradients] = field(default_factory=list)
    kernel_ms: list[float] = field(default_factory=list)


def measure_rival(problem: Problem, cache: Cache | None, say: Callable[[str], None]) -> RivalRecord | None:
    """Measure `prb` beside the estimator that a pilot chose; None where no pilot did, or `prb` does not apply.

    `say` is told what takes long, `cache` holds what earlier runs measured. Leaves neither gradient nor change behind.
    """
    # A budget of memory is kept by passes, of which `prb` has none.
    if problem.pilot is None or problem.samples_per_pass is not None or why_not(problem) is not None:
        return None
    guided, sequence = problem.guided, problem.sequence
    beside = [problem.pilot.chosen, guided and guided.guided, sequence and sequence.low_discrepancy]
    key = "" if cache is None else key_of({"rival": RIVAL, "beside": beside, **situation(problem)})
    known = recall(RivalRecord, cache, key)
    if known is not None:
        return known
    allowance = problem.allowance
    if allowance is None:
        say(f"measuring {RIVAL} beside it")
        record = _measure(problem, problem.pilot.spp or problem.config.run.spp, math.inf)
    else:
        if not allowance.affords(NEEDS):
            return RivalRecord(RIVAL, note=allowance.note())
        say(f"measuring {RIVAL} beside it")
        left = allowance.iterations_left(NEEDS[0])
        with allowance.counted():
            record = _measure(problem, problem.pilot.spp or _samples(problem, left), 1e3 * left * allowance.iteration_s)
    if cache is not None:
        cache.put(key, record.to_json())
    return record


def why_not(problem: Problem) -> str | None:
    """Why `prb` has no such gradient of some parameter, or no such image of some view; None where it has all."""
    options = problem.config.integrator.options()
    params = problem.selection.params
    moved = tuple(key for key in problem.selection.scene_keys if moves_light(params, key))
    for index in problem.sensors:
        sensor = problem.scene.sensors()[index]
        at = Situation.of(
            problem.scene, sensor, params, options["max_depth"], options["hide_emitters"], bool(moved), moved
        )
        for key in problem.selection.scene_keys:
            reason = prb_gradient(at, key)
            if reason is not None:
                return reason
    return None


def _samples(problem: Problem, iterations: float) -> int:
    """Samples per pixel of steps, with which the rounds that there are to be take so many iterations' worth of time."""
    run = problem.config.run
    unit = run.batches if problem.config.adjoint == "batched" else 1
    share = min(iterations / (LONGER * MOST_ROUNDS), 1.0)
    return max(int(share * run.spp) // unit, 1) * unit


def _measure(problem: Problem, spp: int, most_ms: float) -> RivalRecord:
    options, clock = problem.config.integrator.options(), StepClock()
    shared = {name: options[name] for name in ("max_depth", "rr_depth", "hide_emitters")}
    rival = make_integrator(RIVAL, **shared)
    own_integrator: Any = problem.integrator
    if isinstance(own_integrator, LightTracer):  # a recording would cost more than so few steps save
        own_integrator = own_integrator.to_measure().with_options(samples_per_pass=None, freeze=False)
    both = {RIVAL: (rival, _Measured()), "own": (own_integrator, _Measured())}
    compile_ms = spent_ms = 0.0
    budget_ms = math.inf
    for round in range(-1, MOST_ROUNDS):
        for name, (integrator, measured) in both.items():
            step = measured_step(problem, integrator, clock, round + 1, spp)
            compile_ms += step.compile_ms
            if round < 0:  # it compiles; what it measures stays out
                compile_ms += step.wall_ms
                continue
            spent_ms += step.wall_ms
            measured.gradients.append(step.gradients)
            measured.kernel_ms.append(step.kernel_ms)
            if name == "own":
                budget_ms = min(SHARE * ITERATIONS * step.wall_ms * problem.config.run.spp / spp, most_ms)
        done = len(both["own"][1].gradients)
        if done >= LEAST_ROUNDS and spent_ms * (done + 1) / done > budget_ms:
            break
        if done == 1 and spent_ms * LEAST_ROUNDS > min(budget_ms * MOST_SHARE / SHARE, most_ms):
            note = f"{LEAST_ROUNDS} steps of both would take {spent_ms * LEAST_ROUNDS / 1e3:.1f} s"
            return RivalRecord(RIVAL, 1, spp, measure_s=spent_ms / 1e3, compile_s=compile_ms / 1e3, note=note)
    own, other = both["own"][1], both[RIVAL][1]
    advantage, low, high = compare(own.gradients, own.kernel_ms, other.gradients, other.kernel_ms)
    rounds = len(own.gradients)
    return RivalRecord(
        RIVAL, rounds, spp, advantage, low, high, measure_s=spent_ms / 1e3, compile_s=compile_ms / 1e3,
        note="" if advantage is not None else "its gradients, or those of the run, have no noise",
    )  # fmt: skip
