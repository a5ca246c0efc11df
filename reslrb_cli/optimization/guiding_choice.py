"""Whether a run's emission is guided, settled before its first iteration where that is left to measurement."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from reslrb_cli.config.files import in_words
from reslrb_cli.optimization.choice import (
    GUIDING_NEEDS,
    SEQUENCE_NEEDS,
    Cache,
    Say,
    allowance_of,
    is_auto,
    recall,
    share_left,
    situation,
    suits_even_numbers,
)
from reslrb_cli.optimization.guiding_pilot import LONGER, GuidingPilot
from reslrb_cli.optimization.sequence_pilot import SHARE as SEQUENCE_SHARE
from reslrb_cli.optimization.step_trial import StepTrial, sizes
from reslrb_cli.records.paid import GuidedRecord
from reslrb_cli.records.pilot_cache import key_of

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


def settle_guiding(problem: Problem, say: Say, cache: Cache | None = None) -> StepTrial | None:
    """Have `problem.integrator`, whose estimator is settled, guided where that is left to measurement, and pays.

    Needs the targets. `problem.guided` is what was measured. Returns what it was measured on, where it was now.
    """
    if not is_auto(problem.config, "guiding"):
        return None
    problem.guided, trial = _record(problem, say, cache)
    say(problem.guided.line())
    if take_up(problem) and problem.memory is not None:
        plan = problem.memory
        expected = replace(plan.expected_bytes, fixed=plan.expected_bytes.fixed + table_bytes(problem))
        problem.memory = replace(plan, expected_bytes=expected)
    return trial


def take_up(problem: Problem) -> bool:
    """Do as `problem.guided` says; whether that makes `problem.integrator` a guided one."""
    if problem.guided is None or not problem.guided.guided:
        return False
    problem.integrator = problem.integrator.afresh(guided=True, images=problem.guided.images)
    return True


def table_bytes(problem: Problem) -> int:
    """Bytes of the tables of all sensors, if `problem.integrator` is guided, or were."""
    made = problem.integrator.afresh(guided=True)
    made.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # cuts the grid
    return int(made.preparation.guiding.bytes(len(problem.sensors)))


def _record(problem: Problem, say: Say, cache: Cache | None) -> tuple[GuidedRecord, StepTrial | None]:
    """What an earlier run measured, or what is measured now."""
    if problem.memory is not None:
        free, needed = problem.memory.budget_bytes - problem.memory.expected_bytes.total, table_bytes(problem)
        if needed > free:
            note = f"run.memory_budget has no room for tables of {in_words(needed)}"
            return GuidedRecord(guided=False, note=note), None
    chosen = None if problem.pilot is None else problem.pilot.chosen
    plan = sizes(problem, LONGER)
    # Learning is a larger part of a short run, where tables learn most often at first.
    of = {"guiding": 4, "of": chosen, "lessons": plan.lessons}
    key = "" if cache is None else key_of({**of, **situation(problem)})
    known = recall(GuidedRecord, cache, key)
    if known is not None:
        return known, None
    allowance = allowance_of(problem, problem.integrator)
    sequence = is_auto(problem.config, "sequence")
    why = suits_even_numbers(problem) if sequence else None
    # Where these are likely to do better, to measure guiding alone would mislead.
    if not allowance.affords(GUIDING_NEEDS, *([] if why is None else 2 * [SEQUENCE_NEEDS])):
        note = f"{allowance.note()}; {why or 'it pays in long runs'}"
        return GuidedRecord(guided=False, note=note), None
    say("guiding auto: measuring")
    with allowance.counted():
        plain, guided = (problem.integrator.afresh(guided=on) for on in (False, True))
        trial = StepTrial(problem, "guiding", plain, guided)
        share = share_left(problem, SEQUENCE_SHARE if sequence else 0.0, GUIDING_NEEDS[0])
        record = GuidingPilot(trial, plan, trial.part_of_views(), share).run()
    if cache is not None:
        cache.put(key, record.to_json())
    return record, trial
