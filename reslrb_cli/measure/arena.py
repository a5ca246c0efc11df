"""Workers that take turns, from the workers' start to their end. `bench` and `convergence` share this code.

Only one worker computes at a time, so drift of the machine affects all workers alike. An additional worker, the
referee, can make the common reference. If the referee fails, nothing is measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from reslrb_cli.backend.installation import python_command
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.methods import Case, Measurement, Plan
from reslrb_cli.measure.processes import Contestant, Pace, Process, Refused, Stepping, Stopped
from reslrb_cli.measure.resume_store import Earlier
from reslrb_cli.measure.workers import Begin
from reslrb_cli.records.measurements import BenchStatus

#: If all processes together hold more than this share of the memory, each releases its own after a step.
MEMORY_SHARE = 0.7
MIB = 2**20

#: Starts a process from its first message and the name of its task.
Start = Callable[[dict[str, Any], str], Any]
Worker = TypeVar("Worker", bound=Contestant)
Item = TypeVar("Item")
Measured = TypeVar("Measured", bound=Measurement)


def in_turn(workers: Sequence[Item], round: int) -> list[Item]:
    """Return the workers in the order of a round; the first one changes from round to round."""
    start = round % max(len(workers), 1)
    return [*workers[start:], *workers[:start]]


def start_process(first: dict[str, Any], does: str) -> Process:
    """Start a process. The process runs the function that `load` returns for the name `does`. `first` is its first
    message.
    """
    imports = "from reslrb_cli.measure.arena import load\nfrom reslrb_cli.measure.workers import run"
    return Process(first, python_command(f"{imports}\nrun(lambda: load({does!r}))"))


class Arena(Generic[Measured, Worker]):
    """Running workers, `members`. The workers write files to `folder`, which the caller removes.

    `facts` come from the referee. `spent_s` is the part of the budget that is already spent. Measurements of an
    `earlier` session count, and the new session continues them. Raises ConfigError if the earlier measurements belong
    to another measurement.
    """

    #: Maximum number of rounds.
    MOST_ROUNDS = 256

    #: Share of the budget, and seconds, that are reserved for the statistics and the plot.
    AFTERWARDS, AFTERWARDS_S = 0.03, 2.0

    def __init__(
        self,
        plan: Measured,
        folder: Path,
        stop: Callable[[], bool],
        say: Callable[[str], None],
        start: Start = start_process,
        now: Callable[[], float] = time.monotonic,
        spent_s: float = 0.0,
        earlier: Earlier | None = None,
    ) -> None:
        self.plan, self.folder, self.settings, self._earlier = plan, folder, plan.settings(), earlier
        self.members: list[Worker] = []
        self.facts: dict[str, Any] = {}
        self._stop, self._say, self._start, self._now, self._began = stop, say, start, now, now() - spent_s
        self._referee: Contestant | None = None
        self._said: set[str] = set()
        if earlier is not None:
            earlier.check(self.settings)
        depths = self._set_up(earlier)
        budget_s = max((1 - self.AFTERWARDS) * plan.budget_s - self.AFTERWARDS_S - spent_s, 0.0)
        self._pace = Pace(budget_s, depths, plan.rounds, now, self.MOST_ROUNDS)

    def _set_up(self, earlier: Earlier | None) -> int:
        """Set up the parts that are specific to one kind of session. The parts start from the data of an earlier
        session.

        Returns the number of depths among which the time is divided. Raises ConfigError.
        """
        raise NotImplementedError

    def _taking_turns(self, course: Iterator[Item]) -> Iterator[Item]:
        """Yield the items of `course` until `course` ends or `stop()` returns true. Then all workers have ended."""
        try:
            yield from course
        except Stopped:
            return
        finally:
            for member in self.members:
                member.close()
            if self._referee is not None:
                self._referee.close()

    def _alive(self) -> list[Worker]:
        """Return the workers that can take more steps."""
        return [member for member in self.members if member.alive]

    def _tight(self) -> bool:
        """True if workers together use so much memory that each worker must release memory after each step."""
        return sum(member.peak_mib for member in self._alive()) * MIB > MEMORY_SHARE * self.plan.memory

    def _take_rounds(self, workers: Callable[[], Sequence[Stepping]], first: int, before: int) -> Iterator[int]:
        """Yield the number of completed rounds after each round. Rounds start at number `first`. Earlier sessions
        completed `before` rounds.
        """
        tight, done = self._tight(), 0
        self._pace.begin_rounds(before)
        while workers() and self._pace.another(done):
            for worker in in_turn(workers(), first + done):
                worker.turn(first + done, tight, self._stop)
            done += 1
            yield first + done

    def _budget_for(self, seconds: float) -> float:
        """Return the total budget that leaves `seconds` seconds for measuring."""
        return (seconds + self.AFTERWARDS_S) / (1 - self.AFTERWARDS)

    def _ask_referee(self, plan: Plan, question: dict[str, Any] | None = None) -> dict[str, Any] | None:
        """Return the referee's answer to `question`. Without a question, return the referee's first message. Returns
        None if the budget is spent. Raises Refused if the referee ended.
        """
        assert self._referee is not None, "it is started first"
        if question is not None:
            self._referee.process.ask(question)
        answer, end = self._open(self._referee), self._referee.end
        if end is not None:
            memory = end.status is BenchStatus.OUT_OF_MEMORY
            code = ExitCode.OUT_OF_MEMORY if memory else ExitCode.CHECK_FAILED
            raise Refused(f"--reference {plan.reference.label}: {end.reason}", code)
        return answer

    def _open(self, member: Contestant) -> dict[str, Any] | None:
        """Return the first message of a worker that has loaded its scene. Returns None if the worker ended, or if the
        time was up.
        """
        opening = member.answer(self._stop, self._pace.over)
        self._warn(opening or {})
        return opening

    # --- messages
    # ---------------------------------------------------------------------------------------------------------

    def _first(self, config: Config, arrays: str) -> dict[str, Any]:
        """Return the first message to a worker. The message holds the file of the referee's arrays under the name
        `arrays`.
        """
        return self.plan.first(config) | {arrays: str(self.folder / f"{arrays}.npz")}

    def _warn(self, opening: dict[str, Any]) -> None:
        """Print warnings about loading only once, because every process loads the same scene."""
        for line in opening.get("warnings", ()):
            self._once(line)

    def _once(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._say(line)

    def _say_end(self, member: Worker, label: str, more: str = "") -> None:
        """Print how a worker ended, if it did."""
        if member.refusal is not None:
            self._say(f"left out: {label}: {member.refusal}")
        elif member.end is not None:
            self._say(f"{label}{more}: {member.end.status.value}: {member.end.reason}")

    def _say_left_out(self) -> None:
        """Print the methods of the default list that do not support the scene."""
        for case in self.plan.cases:
            reason = self._without(case)
            if reason is not None:
                self._say(f"left out: {case.label}: {reason}")

    def _takes_part(self, case: Case) -> bool:
        """Whether a method is measured."""
        return self._without(case) is None

    def _without(self, case: Case) -> str | None:
        """Return why a method of the default list is left out, or None if it takes part."""
        if not self.plan.default:
            return None
        if self.facts.get("paths") == "light" and case.options.get("paths", "light") != "light":
            return "this scene has only light paths"
        reason: str | None = self.facts["without"].get(case.type)
        return reason


def load(does: str) -> Begin:
    """Return the function, selected by `does`, that starts a process. `load` and the returned function import their
    modules themselves.
    """
    if does == "measured_steps":
        from reslrb_cli.measure.stepper import begin_steps

        return begin_steps
    from reslrb_cli.measure.convergence.setup import begin_sampling, begin_survey

    return begin_survey if does == "surveyed" else begin_sampling
