"""The sampling of a run, settled before its first iteration: guided emission, and the sequence of numbers.

Each is settled where it is left to measurement, guiding first. Steps drawn one way take turns with steps drawn the
other:

- `GuidingPilot`: whether guided emission pays here. A table is learned, and held; then steps with it take turns with
  steps without. To a guided step's time is added its part of what a run of that length learns: each time one more walk
  of one pass, with what Python does for a new table, often at first and then rarely. Short steps make the table less
  worth than a run's, which has learned from more, and draws more paths from each of its cells. So the gain is rather
  more than what is found here, and what pays here pays there.
- `SequencePilot`: whether low-discrepancy numbers pay here. Steps with them take turns with steps without, guided if
  the run's are; then both draw from one table. What a run goes on learning takes both the same time; it is left out,
  which makes more of the time that such numbers take. Noise of evenly spread numbers falls faster than with one over
  the samples, or as fast. So short steps find less of the gain than whole ones have, and what pays here pays there.
- `InsteadPilot`: whether low-discrepancy numbers pay in place of guided emission.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from reslrb_cli.config.files import in_words
from reslrb_cli.optimization.autotune.choice import (
    GUIDING_NEEDS,
    SEQUENCE_NEEDS,
    SEQUENCE_SHARE,
    Say,
    allowance_of,
    is_auto,
    recall,
    share_left,
    situation,
    suits_even_numbers,
)
from reslrb_cli.optimization.autotune.efficiency import ITERATIONS
from reslrb_cli.optimization.autotune.steps import PLANNED, StepPilot, StepTrial, sizes
from reslrb_cli.optimization.decisions import Cache
from reslrb_cli.records.decisions import GuidedRecord, SequenceRecord, key_of

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


#: A guided step may take so many times as long as another.
GUIDING_LONGER = 3.0


class GuidingPilot(StepPilot[GuidedRecord]):
    """One decision: guided, or not."""

    @property
    def _apart(self) -> bool:
        return self._sizes.alone

    def _more_ms(self) -> float:
        """What learning adds, in the mean over the run."""
        sizes = self._sizes
        kernel = self._walk.kernel_ms * sizes.part / sizes.learning
        return (kernel + self._walk.beside_ms) * sizes.lessons * sizes.trial / sizes.call

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> GuidedRecord:
        return GuidedRecord(guided=other, images=images, **found)


#: A step with such numbers may take so many times as long as another.
SEQUENCE_LONGER = 1.25


#: What of the share the rounds are planned for; the first step takes a part too, and is no round.
ROUNDS_SHARE = 0.8


def planned(share: float) -> float:
    """Steps' worth of time that the rounds are planned for: the longer they are, the more of the gain is seen."""
    return min(ROUNDS_SHARE * share * ITERATIONS, PLANNED)


class SequencePilot(StepPilot[SequenceRecord]):
    """One decision: low-discrepancy numbers, or independent ones."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> SequenceRecord:
        return SequenceRecord(low_discrepancy=other, **found)


class InsteadPilot(SequencePilot):
    """One decision: low-discrepancy numbers in place of guided emission, or that with independent ones."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> SequenceRecord:
        return replace(super()._decide(other, images, found), alone=True)


def settle_guiding(problem: Problem, say: Say, cache: Cache | None = None) -> StepTrial | None:
    """Have `problem.integrator`, whose estimator is settled, guided where that is left to measurement, and pays.

    Needs the targets. `problem.guided` is what was measured. Returns what it was measured on, where it was now.
    """
    if not is_auto(problem.config, "guiding"):
        return None
    problem.guided, trial = _guided_record(problem, say, cache)
    say(problem.guided.line())
    if take_up_guiding(problem) and problem.memory is not None:
        plan = problem.memory
        expected = replace(plan.expected_bytes, fixed=plan.expected_bytes.fixed + table_bytes(problem))
        problem.memory = replace(plan, expected_bytes=expected)
    return trial


def take_up_guiding(problem: Problem) -> bool:
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


def _guided_record(problem: Problem, say: Say, cache: Cache | None) -> tuple[GuidedRecord, StepTrial | None]:
    """What an earlier run measured, or what is measured now."""
    if problem.memory is not None:
        free, needed = problem.memory.budget_bytes - problem.memory.expected_bytes.total, table_bytes(problem)
        if needed > free:
            note = f"run.memory_budget has no room for tables of {in_words(needed)}"
            return GuidedRecord(guided=False, note=note), None
    chosen = None if problem.pilot is None else problem.pilot.chosen
    plan = sizes(problem, GUIDING_LONGER)
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


def settle_sampling(problem: Problem, say: Say, cache: Cache | None = None) -> None:
    """Have `problem.integrator`, whose estimator is settled, draw samples as pays here, as far as that is left to
    measurement: guided or not; then from which sequence, in place of being guided, or else as the integrator is then.

    Needs the targets. `problem.guided` and `problem.sequence` are what was measured.
    """
    memory = problem.memory
    earlier = settle_guiding(problem, say, cache)
    if not is_auto(problem.config, "sequence"):
        return
    problem.sequence = _sequence_record(problem, say, cache, earlier)
    say(problem.sequence.line())
    if problem.guided is not None and problem.sequence.alone and problem.sequence.low_discrepancy:
        note = f"low-discrepancy numbers without it have {problem.sequence.gain:.2g} times that"
        problem.guided = replace(problem.guided, guided=False, images=False, note=note)
        problem.integrator, problem.memory = problem.integrator.afresh(guided=False), memory
    take_up_sequence(problem)


def take_up_sequence(problem: Problem) -> None:
    """Do as `problem.sequence` says."""
    if problem.sequence is not None and problem.sequence.low_discrepancy:
        problem.integrator = problem.integrator.afresh(low_discrepancy=True)


def _sequence_record(problem: Problem, say: Say, cache: Cache | None, earlier: StepTrial | None) -> SequenceRecord:
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
    return kind(trial, sizes(problem, SEQUENCE_LONGER, planned(share)), trial.part_of_views(), share).run(), trial


def _added(record: SequenceRecord, before: SequenceRecord) -> SequenceRecord:
    """A record with what was measured before it counted in its cost."""
    names = ("measure_s", "compile_s", "share")
    return replace(record, **{name: getattr(record, name) + getattr(before, name) for name in names})
