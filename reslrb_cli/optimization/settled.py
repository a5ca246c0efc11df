"""What an earlier process has settled for a run: where it began, estimator, passes, masks, how samples are drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypeVar

from reslrb_cli.optimization import guiding_choice, sequence_choice
from reslrb_cli.optimization.budget import Estimate, MemoryPlan
from reslrb_cli.optimization.choice import Option, is_auto
from reslrb_cli.optimization.pilot_records import Outcome
from reslrb_cli.optimization.stored import Stored, is_number
from reslrb_cli.records.paid import GuidedRecord, PaidRecord, SequenceRecord

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Paid = TypeVar("Paid", bound=PaidRecord)


@dataclass(frozen=True)
class Settled:
    """By `stored`, a run's state; its parts are taken up as a problem is assembled again, in the same order."""

    stored: Stored

    def begin(self, problem: Problem) -> None:
        """Give the parameters the values that the run began with."""
        keys = problem.selection.keys
        found = [name for name in self.stored.archive.names("parameter/") if name not in keys]
        if found:
            raise self.stored.wrong(f"parameter/{found[0]}", "is no parameter of this run")
        values = {key: self.stored.scene_value(problem, "initial", key) for key in keys}
        problem.selection.set_arrays({key: problem.selection.shown(key, value) for key, value in values.items()})
        for key in keys:
            problem.optimizer.set_value(key, values[key])
        problem.apply()

    def settle(self, problem: Problem, options: Sequence[Option]) -> None:
        """Choose what the run had chosen: the pilot's estimator, the samples of a pass, and how samples are drawn."""
        self._estimator(problem, options)
        if is_auto(problem.config, "guiding"):
            problem.guided = self._paid(GuidedRecord, "guided", "guiding")
            guiding_choice.take_up(problem)
        if is_auto(problem.config, "sequence"):
            problem.sequence = self._paid(SequenceRecord, "sequence", "the sequence")
            sequence_choice.take_up(problem)

    def _paid(self, kind: type[Paid], name: str, what: str) -> Paid | None:
        """What was measured, where it was."""
        try:
            return None if self.stored.value(name) is None else kind.from_json(self.stored.value(name))
        except (TypeError, AttributeError):
            raise self.stored.wrong(name, f"is not what measuring whether {what} pays finds") from None

    def _estimator(self, problem: Problem, options: Sequence[Option]) -> None:
        chosen = options[0] if options else None
        if self.stored.value("pilot") is not None:
            problem.pilot = self._outcome()
            chosen = next((option for option in options if option.options == problem.pilot.chosen), None)
            if chosen is None:
                raise self.stored.wrong("pilot.chosen", "is nothing that this run can choose")
        if chosen is None:
            return
        problem.integrator, problem.memory = chosen.integrator, chosen.memory
        if chosen.memory is not None:
            problem.memory = memory = self._memory(problem, chosen.memory)
            problem.samples_per_pass = memory.samples_per_pass
            size = memory.samples_per_pass if memory.passes > 1 else None
            problem.integrator = chosen.integrator.with_options(samples_per_pass=size, freeze=chosen.integrator.freeze)

    def reach(self, problem: Problem) -> None:
        """Take up what light and sensor reach, of the parameters whose true value is known."""
        for key in problem.truth:
            shape = problem.selection.array(key).shape
            name = f"mask/{key}"
            problem.masks[key] = self.stored.archive.array(name, shape[:2] if len(shape) == 3 else shape, "b")

    def _outcome(self) -> Outcome:
        data = self.stored.value("pilot")
        try:
            outcome = Outcome.from_json(data)
            rows = [isinstance(row.estimator, str) and isinstance(row.options, dict) for row in outcome.rows]
            if not isinstance(outcome.chosen, dict) or not isinstance(outcome.label, str) or not all(rows):
                raise TypeError
        except (TypeError, KeyError, AttributeError):
            raise self.stored.wrong("pilot", "is not what a pilot finds") from None
        return outcome

    def _memory(self, problem: Problem, now: MemoryPlan) -> MemoryPlan:
        """The plan of the run, whose passes decide in what order samples are summed up."""
        size, passes = (self.stored.count("memory", name) for name in ("samples_per_pass", "passes"))
        if size * passes != now.samples_per_pass * now.passes:
            raise self.stored.wrong("memory", f"has {passes} passes of {size} samples")
        names = [each.name for each in fields(Estimate)]
        expected = [self.stored.value("memory", "expected_bytes", name) for name in names]
        if not all(is_number(each) and math.floor(each) == each for each in expected):
            raise self.stored.wrong("memory.expected_bytes", "is no estimate")
        estimate: dict[str, Any] = dict(zip(names, expected, strict=True))
        return MemoryPlan(now.budget_bytes, size, passes, Estimate(**estimate))
