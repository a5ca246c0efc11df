"""Whether a run's paths have low-discrepancy numbers, settled before its first iteration where that is left to
measurement; and, before that, whether they are guided."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from reslrb_cli.optimization.choice import (
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
from reslrb_cli.optimization.guiding_choice import settle_guiding
from reslrb_cli.optimization.sequence_pilot import LONGER, InsteadPilot, SequencePilot, planned
from reslrb_cli.optimization.step_trial import StepTrial, sizes
from reslrb_cli.records.paid import SequenceRecord
from reslrb_cli.records.pilot_cache import key_of

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


def settle_sampling(problem: Problem, say: Say, cache: Cache | None = None) -> None:
    """Have `problem.integrator`, whose estimator is settled, draw samples as pays here, as far as that is left to
    measurement: guided or not; then from which sequence, in place of being guided, or else as the integrator is then.

    Needs the targets. `problem.guided` and `problem.sequence` are what was measured.
    """
    memory = problem.memory
    earlier = settle_guiding(problem, say, cache)
    if not is_auto(problem.config, "sequence"):
        return
    problem.sequence = _record(problem, say, cache, earlier)
    say(problem.sequence.line())
    if problem.guided is not None and problem.sequence.alone and problem.sequence.low_discrepancy:
        note = f"low-discrepancy numbers without it have {problem.sequence.gain:.2g} times that"
        problem.guided = replace(problem.guided, guided=False, images=False, note=note)
        problem.integrator, problem.memory = problem.integrator.afresh(guided=False), memory
    take_up(problem)


def take_up(problem: Problem) -> None:
    """Do as `problem.sequence` says."""
    if problem.sequence is not None and problem.sequence.low_discrepancy:
        problem.integrator = problem.integrator.afresh(low_discrepancy=True)


def _record(problem: Problem, say: Say, cache: Cache | None, earlier: StepTrial | None) -> SequenceRecord:
    """What an earlier run measured, or what is measured now; `earlier`: what guiding was measured on."""
    chosen = None if problem.pilot is None else problem.pilot.chosen
    guided = None if problem.guided is None else [problem.guided.guided, problem.guided.images]
    key = "" if cache is None else key_of({"sequence": 1, "of": [chosen, guided], **situation(problem)})
    known = recall(SequenceRecord, cache, key)
    if known is not None:
        return known
    allowance = allowance_of(problem, problem.integrator)
    if not allowance.affords(SEQUENCE_NEEDS):
        is_guided = problem.integrator.preparation.guiding is not None
        why = "guided paths gain little by others" if is_guided else suits_even_numbers(problem)
        note = f"{allowance.note()}; {why or 'evenly spread ones have been no loss in any scene'}"
        return SequenceRecord(low_discrepancy=not is_guided, note=note)
    say("sequence auto: measuring")
    with allowance.counted():
        record = _measure(problem, earlier)
    if cache is not None:
        cache.put(key, record.to_json())
    return record


def _measure(problem: Problem, earlier: StepTrial | None) -> SequenceRecord:
    """What is measured now; `earlier`: what guiding was measured on."""
    alone = None
    if problem.guided is not None and problem.guided.guided:
        # Guided paths start in cells of their own, within which little is left to spread evenly: where numbers that are
        # say nearly all, as under a beam through glass, they do better alone.
        share = share_left(problem, kernels=2 * SEQUENCE_NEEDS[0])
        alone, earlier = _measured(problem, InsteadPilot, earlier, share / 2)
    if alone is not None and alone.low_discrepancy:
        record = alone
    else:
        spent = 0.0 if alone is None else alone.share
        record, _ = _measured(problem, SequencePilot, earlier, share_left(problem, spent, SEQUENCE_NEEDS[0]))
        record = record if alone is None else _added(record, alone)
    return record


def _measured(
    problem: Problem, kind: type[SequencePilot], earlier: StepTrial | None, share: float
) -> tuple[SequenceRecord, StepTrial]:
    """What a pilot finds in that share of the run, and on what."""
    guided = False if kind is InsteadPilot else None  # None: as the run is
    plain, even = problem.integrator, problem.integrator.afresh(guided=guided, low_discrepancy=True)
    name = "sequence alone" if kind is InsteadPilot else "sequence"
    trial = StepTrial(problem, name, plain.afresh(low_discrepancy=False), even, earlier)
    return kind(trial, sizes(problem, LONGER, planned(share)), trial.part_of_views(), share).run(), trial


def _added(record: SequenceRecord, before: SequenceRecord) -> SequenceRecord:
    """A record with what was measured before it counted in its cost."""
    names = ("measure_s", "compile_s", "share")
    return replace(record, **{name: getattr(record, name) + getattr(before, name) for name in names})
