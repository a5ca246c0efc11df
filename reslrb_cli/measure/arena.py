"""Workers that take turns: what `bench` and `convergence` have in common, from their start to their end.

As they take turns, one computing at a time, a drift of the machine hits all alike. One more worker may be there for all
of them, the referee: it makes what they are compared by, and nothing is measured where it fails.
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

#: Where all together hold more than this share of the memory, each releases its own after a step.
MEMORY_SHARE = 0.7
MIB = 2**20

#: Starts a process by its first message and the name of what it does.
Start = Callable[[dict[str, Any], str], Any]
Worker = TypeVar("Worker", bound=Contestant)
Item = TypeVar("Item")
Measured = TypeVar("Measured", bound=Measurement)


def in_turn(workers: Sequence[Item], round: int) -> list[Item]:
    """The workers in the order of a round: who begins changes from round to round."""
    start = round % max(len(workers), 1)
    return [*workers[start:], *workers[:start]]


def start_process(first: dict[str, Any], does: str) -> Process:
    """A process that does what `load` finds by this name; `first` is its first message."""
    imports = "from reslrb_cli.measure.arena import load\nfrom reslrb_cli.measure.workers import run"
    return Process(first, python_command(f"{imports}\nrun(lambda: load({does!r}))"))


class Arena(Generic[Measured, Worker]):
    """Workers under way, `members`; what they write goes to `folder`, which is the caller's to remove.

    `facts` are the referee's; of the budget `spent_s` have gone before. What an `earlier` session has measured counts,
    and is gone on from. Raises ConfigError where that is of another measurement.
    """

    #: The most rounds.
    MOST_ROUNDS = 256

    #: Share of the budget, and seconds beside it, that are left for the statistics and the picture.
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
        self._budget_s = max((1 - self.AFTERWARDS) * plan.budget_s - self.AFTERWARDS_S - spent_s, 0.0)
        self._pace = Pace(self._budget_s, depths, plan.rounds, now, self.MOST_ROUNDS)
        self._end = now() + self._budget_s

    def _set_up(self, earlier: Earlier | None) -> int:
        """Begin what a kind of session has beside all this, with what it has of an earlier one.

        Returns how many depths there are to share the time. Raises ConfigError.
        """
        raise NotImplementedError

    def _taking_turns(self, course: Iterator[Item]) -> Iterator[Item]:
        """What `course` yields, until it ends or `stop()`; no worker is left then."""
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
        """Those that can be asked for more."""
        return [member for member in self.members if member.alive]

    def _tight(self) -> bool:
        """Whether workers that hold so much together have to release what they can after a step."""
        return sum(member.peak_mib for member in self._alive()) * MIB > MEMORY_SHARE * self.plan.memory

    def _take_rounds(self, workers: Callable[[], Sequence[Stepping]], first: int, before: int) -> Iterator[int]:
        """The number of rounds after each of them, from number `first` on, of which `before` are known already."""
        tight, done = self._tight(), 0
        self._pace.begin_rounds(before)
        while workers() and self._pace.another(done):
            for worker in in_turn(workers(), first + done):
                worker.turn(first + done, tight, self._stop)
            done += 1
            yield first + done

    def _budget_for(self, seconds: float) -> float:
        """The budget that leaves so many seconds for measuring, from the beginning on."""
        return (seconds + self.AFTERWARDS_S) / (1 - self.AFTERWARDS)

    def _ask_referee(self, plan: Plan, question: dict[str, Any] | None = None) -> dict[str, Any] | None:
        """An answer, or what it says first; None where the budget was spent over it. Raises Refused where it ended."""
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
        """What a worker says first, its scene loaded; None where it ended over that, or time was up."""
        opening = member.answer(self._stop, self._pace.over)
        self._warn(opening or {})
        return opening

    # --- what is said -------------------------------------------------------------------------------------------------

    def _first(self, config: Config, arrays: str) -> dict[str, Any]:
        """A worker's first message, with the file of the referee's arrays by the name `arrays`."""
        return self.plan.first(config) | {arrays: str(self.folder / f"{arrays}.npz")}

    def _warn(self, opening: dict[str, Any]) -> None:
        """Say what loading warned of, once: every process loads the same scene."""
        for line in opening.get("warnings", ()):
            self._once(line)

    def _once(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._say(line)

    def _say_end(self, member: Worker, label: str, more: str = "") -> None:
        """Say how a worker came to its end, if it did."""
        if member.refusal is not None:
            self._say(f"left out: {label}: {member.refusal}")
        elif member.end is not None:
            self._say(f"{label}{more}: {member.end.status.value}: {member.end.reason}")

    def _say_left_out(self) -> None:
        """Name what nobody named and cannot do the scene: of the default list alone."""
        for case in self.plan.cases:
            reason = self._without(case)
            if reason is not None:
                self._say(f"left out: {case.label}: {reason}")

    def _takes_part(self, case: Case) -> bool:
        """Whether a method is measured."""
        return self._without(case) is None

    def _without(self, case: Case) -> str | None:
        """Why a method of the default list is left out; None where it takes part."""
        if not self.plan.default:
            return None
        if self.facts.get("paths") == "light" and case.options.get("paths", "light") != "light":
            return "this scene has light paths alone"
        reason: str | None = self.facts["without"].get(case.type)
        return reason


def load(does: str) -> Begin:
    """What begins a process, by the name of what it does. Whatever is imported for it is, here and in that function."""
    if does == "measured_steps":
        from reslrb_cli.measure.stepper import begin_steps

        return begin_steps
    from reslrb_cli.measure.convergence.setup import begin_sampling, begin_survey

    return begin_survey if does == "surveyed" else begin_sampling
