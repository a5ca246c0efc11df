"""Whether a run's paths have low-discrepancy numbers, settled before its first iteration where that is left to
measurement; and, before that, whether they are guided."""

from __future__ import annotations

from typing import TYPE_CHECKING

from reslrb_cli.optimization.choice import Cache, Say, is_auto, recall, share_left, situation
from reslrb_cli.optimization.guiding_choice import settle_guiding
from reslrb_cli.optimization.sequence_pilot import LONGER, SequencePilot, planned
from reslrb_cli.optimization.step_trial import StepTrial, sizes
from reslrb_cli.records.paid import SequenceRecord
from reslrb_cli.records.pilot_cache import key_of

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


def settle_sampling(problem: Problem, say: Say, cache: Cache | None = None) -> None:
    """Have `problem.integrator`, whose estimator is settled, draw samples as pays here, as far as that is left to
    measurement: guided or not, and then, of the integrator as it is then, from which sequence.

    Needs the targets. `problem.guided` and `problem.sequence` are what was measured.
    """
    earlier = settle_guiding(problem, say, cache)
    if is_auto(problem.config, "sequence"):
        problem.sequence = _record(problem, say, cache, earlier)
        say(problem.sequence.line())
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
    say("sequence auto: measuring")
    plain, even = (problem.integrator.afresh(low_discrepancy=on) for on in (False, True))
    trial = StepTrial(problem, "sequence", plain, even, earlier)
    share = share_left(problem)
    record = SequencePilot(trial, sizes(problem, LONGER, planned(share)), trial.part_of_views(), share).run()
    if cache is not None:
        cache.put(key, record.to_json())
    return record
