"""Workers that take turns, from the workers' start to their end. `bench` and `convergence` share this code.

Only one worker computes at a time, so drift of the machine affects all workers alike. `Contestant` is one worker with
its results, `Pace` divides the time, and `Arena` asks the workers in turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from reslrb_cli.backend.doctor import memory_bytes
from reslrb_cli.backend.installation import python_command
from reslrb_cli.measure.methods import Measurement
from reslrb_cli.measure.processes import CannotStart, Ended, Process, Stopped

#: If all processes together hold more than this share of the memory, each releases its own after a step.
MEMORY_SHARE = 0.7

#: Maximum number of steps after the cold one until no new kernel is compiled.
MAX_WARM_UPS = 4


@dataclass(kw_only=True)
class Contestant:
    """One of several workers that are compared. `process` is None if no worker runs. `cold` is the answer for its first
    step, which includes compilation.

    A refusal (`CannotStart`) ends the measurement, unless `may_refuse` is True.
    """

    process: Any
    may_refuse: bool
    end: Ended | None = None
    refusal: CannotStart | None = None
    late: bool = False
    cold: dict[str, Any] | None = None

    @property
    def alive(self) -> bool:
        """True if the process can answer more questions."""
        return self.process is not None and self.end is None and self.refusal is None and not self.late

    def question(self, round: int | None) -> dict[str, Any]:
        """Return the question for a round's steps. For None, the step is not counted."""
        raise NotImplementedError

    def keep(self, round: int, answer: dict[str, Any]) -> None:
        """Store the steps of a round."""
        raise NotImplementedError

    def close(self) -> None:
        """End the process, if one is running."""
        if self.process is not None:
            self.process.close()
            self.process = None


MIN_ROUNDS = 3
MAX_ROUNDS = 25

#: Factor on the time for the next depth, whose kernels take longer to compile and to run.
GROWTH = 1.3

#: Message about measurements that exceed the budget.
NO_TIME = "the budget was spent; allow more with --budget"


class Pace:
    """Divides the time among depths. Each depth gets GROWTH times as much time as the previous depth.

    Time that one depth leaves unused goes to the remaining depths. While there is time, each depth gets at least
    MIN_ROUNDS rounds. The maximum is `most` rounds. With `rounds`, time does not count.
    """

    def __init__(
        self,
        budget_s: float,
        depths: int,
        rounds: int | None = None,
        now: Callable[[], float] = time.monotonic,
        most: int = MAX_ROUNDS,
    ) -> None:
        self._now, self._end, self._left, self._rounds, self._most = now, now() + budget_s, depths, rounds, most
        self._rounds_start = now()
        self._depth_end = self._end

    def over(self) -> bool:
        """Whether the time is up."""
        return self._rounds is None and self._now() >= self._end

    def fits(self, seconds: float) -> bool:
        """Whether this many seconds are left."""
        return self._rounds is not None or self._now() + seconds <= self._end

    def begin_depth(self) -> None:
        """Start a depth."""
        now = self._now()
        self._depth_end = now + (self._end - now) / sum(GROWTH**k for k in range(self._left))
        self._left -= 1

    def begin_rounds(self) -> None:
        """Start the rounds after the warm-up."""
        self._rounds_start = self._now()

    def another(self, done: int) -> bool:
        """Whether there is time for another round after `done` rounds."""
        if self._rounds is not None:
            return done < self._rounds
        if done >= self._most:
            return False
        if done == 0:
            return True
        now = self._now()
        return now + (now - self._rounds_start) / done <= (self._end if done < MIN_ROUNDS else self._depth_end)


#: Starts a process from its first message and the place of its function (`processes.run`).
Start = Callable[[dict[str, Any], str], Any]
Worker = TypeVar("Worker", bound=Contestant)
Item = TypeVar("Item")
Measured = TypeVar("Measured", bound=Measurement)


def start_process(first: dict[str, Any], does: str) -> Process:
    """Start a process that runs `processes.run` with `does`. `first` is its first message."""
    return Process(first, python_command(f"from reslrb_cli.measure.processes import run\nrun({does!r})"))


class Arena(Generic[Measured, Worker, Item]):
    """Running workers, `members`. The workers write files to `folder`, which the caller removes.

    `spent_s` is the part of the budget that is already spent.
    """

    #: Maximum number of rounds.
    MOST_ROUNDS = 256

    def __init__(
        self,
        plan: Measured,
        folder: Path,
        stop: Callable[[], bool],
        say: Callable[[str], None],
        start: Start = start_process,
        now: Callable[[], float] = time.monotonic,
        spent_s: float = 0.0,
    ) -> None:
        self.plan, self.folder = plan, folder
        self.members: list[Worker] = []
        self._stop, self._say, self._start = stop, say, start
        self._said: set[str] = set()
        depths = self._set_up()
        self._pace = Pace(max(plan.budget_s - spent_s, 0.0), depths, plan.rounds, now, self.MOST_ROUNDS)

    def _set_up(self) -> int:
        """Set up the parts that are specific to one kind of session. Return the number of depths among which the time
        is divided.
        """
        raise NotImplementedError

    def _course(self) -> Iterator[Item]:
        """Measure, as `run` does. `run` ends the workers."""
        raise NotImplementedError

    def run(self) -> Iterator[Item]:
        """Measure. Yields an item after each round. Ends early, with the finished results, after `stop()`. Then all
        workers have ended. Raises CannotStart if a required worker cannot start.
        """
        try:
            yield from self._course()
        except Stopped:
            return
        finally:
            for member in self.members:
                member.close()

    def _alive(self) -> list[Worker]:
        """Return the workers that can take more steps."""
        return [member for member in self.members if member.alive]

    def _tight(self) -> bool:
        """True if workers together use so much memory that each worker must release memory after each step."""
        mib = sum(member.cold["peak_mib"] for member in self._alive() if member.cold is not None)
        return bool(mib * 2**20 > MEMORY_SHARE * memory_bytes(self.plan.variant))

    def _answer(self, member: Contestant, over: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """Wait for a worker's next answer. Returns None if the worker ended, or if the time was up (`over`)."""
        try:
            result: dict[str, Any] = member.process.answer(lambda: self._stop() or over())
            return result
        except Ended as end:
            member.end = end
        except CannotStart as refusal:
            if not member.may_refuse:
                raise
            member.refusal = refusal
        except Stopped:
            if self._stop():
                raise
            member.late = True
        member.close()  # releases its resources for the others
        return None

    def _warm_up(self, member: Worker) -> dict[str, Any] | None:
        """Take a cold step, then more steps until nothing is compiled. Returns the last answer, or None if the worker
        ended.
        """
        for number in range(1 + MAX_WARM_UPS):
            cold = number == 0
            member.process.ask(member.question(None) | {"cold": cold, "release": not cold and self._tight()})
            answer = self._answer(member, self._pace.over)
            if answer is None:
                return None
            if cold:
                member.cold = answer
            elif not answer["new_kernels"]:
                break
        return answer

    def _take_rounds(self) -> Iterator[int]:
        """Yield the number of completed rounds after each round."""
        tight, round = self._tight(), 0
        self._pace.begin_rounds()
        while (workers := self._alive()) and self._pace.another(round):
            start = round % len(workers)  # the first worker changes from round to round
            for worker in [*workers[start:], *workers[:start]]:
                worker.process.ask(worker.question(round) | {"cold": False, "release": tight})
                answer = self._answer(worker)
                if answer is not None:
                    worker.keep(round, answer)
            round += 1
            yield round

    def _open(self, member: Contestant) -> dict[str, Any] | None:
        """Return the first message of a worker that has loaded its scene, and print its new warnings. Returns None if
        the worker ended, or if the time was up.
        """
        opening = self._answer(member, self._pace.over)
        for line in (opening or {}).pop("warnings", ()):
            if line not in self._said:  # every process loads the same scene
                self._said.add(line)
                self._say(line)
        return opening

    def _say_end(self, member: Worker, label: str) -> None:
        """Print how a worker ended, if it did."""
        if member.refusal is not None:
            self._say(f"left out: {label}: {member.refusal}")
        elif member.end is not None:
            self._say(f"{label}: {member.end.status.value}: {member.end.reason}")
