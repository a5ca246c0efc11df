"""The measuring engine: methods take turns, each in its own process, and answer draws.

`bench` and `convergence` are lists of requests to this engine, and functions of the draws. Only one process computes at
a time, so drift of the machine affects all methods alike. Draws on file are not drawn again (`DrawsFile`).
"""

from __future__ import annotations

import enum
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.backend.doctor import memory_bytes
from reslrb_cli.backend.installation import python_command
from reslrb_cli.config.schema import Config
from reslrb_cli.measure.draws import Draws, DrawsFile
from reslrb_cli.measure.methods import Measurement, NamedIntegrator
from reslrb_cli.measure.processes import CannotStart, Ended, Process, Stopped
from reslrb_cli.records.measurement_files import LivePage
from reslrb_cli.records.measurements import BenchStatus, Method

#: If all processes together hold more than this share of the memory, each releases its own after a step.
MEMORY_SHARE = 0.7

#: Maximum number of steps after the cold one until no new kernel is compiled.
MAX_WARM_UPS = 4

MIN_ROUNDS = 3

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
        self, budget_s: float, depths: int, rounds: int | None, most: int, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._now, self._end, self._left, self._rounds = now, now() + budget_s, depths, rounds
        self.most = most if rounds is None else rounds
        self._rounds_start, self._depth_end = now(), self._end

    def over(self) -> bool:
        """Whether the time is up."""
        return not self.fits(0.0)

    def fits(self, seconds: float) -> bool:
        """Whether this many seconds are left."""
        return self._rounds is not None or self._now() + seconds < self._end

    def begin_depth(self) -> None:
        """Start a depth."""
        now = self._now()
        self._depth_end = now + (self._end - now) / sum(GROWTH**k for k in range(self._left))
        self._left -= 1

    def begin_rounds(self) -> None:
        """Start the rounds after the warm-up."""
        self._rounds_start = self._now()

    def another(self, round: int, done: int) -> bool:
        """Whether there is time for a round, after `done` rounds that took time."""
        if round >= self.most or self._rounds is not None or done == 0:
            return round < self.most
        now = self._now()
        return now + (now - self._rounds_start) / done <= (self._end if done < MIN_ROUNDS else self._depth_end)


class Role(str, enum.Enum):
    """Role of a method in a measurement: compared, reference of errors, or independent reference of biases."""

    CASE = "case"
    REFERENCE = "reference"
    INDEPENDENT = "independent"


@dataclass(frozen=True, kw_only=True)
class Request:
    """A method, and the draws that are requested from its process.

    - `quantity`, `spp`, `purpose`: as in `steps.Sampler`.
    - `count`: steps of a turn. The time of the first step does not count, because it refills caches. If `repeats` is
        True, all steps of a turn have one seed, and only the last one is kept.
    - `may_refuse`: the method is left out if it does not support the scene. Otherwise, a refusal ends the measurement.
    - `about`: the situation that determines the draws (`DrawsFile`).
    - `method`: the description for records, if a measurement needs one.
    """

    case: NamedIntegrator
    config: Config
    label: str
    quantity: str
    spp: int
    purpose: str
    about: Mapping[str, Any]
    count: int = 2
    repeats: bool = False
    may_refuse: bool = False
    role: Role = Role.CASE
    method: Method | None = None

    def numbers(self, turn: int) -> list[int]:
        """Return the numbers of a turn's steps, which select the seeds."""
        return [turn] * self.count if self.repeats else [*range(turn * self.count, (turn + 1) * self.count)]


@dataclass(kw_only=True)
class Member:
    """A request with its draws so far, which are in `file`, and with its process, or None if no process runs.

    - `end` is the reason why the process ended before it was closed. It is Stopped if the budget was spent.
    - `opening` is the process's first message, and `step_s` the time of its last step of the warm-up.
    - `kept` are the turns whose draws are kept.
    """

    request: Request
    file: DrawsFile
    process: Any = None
    end: Ended | CannotStart | Stopped | None = None
    opening: Mapping[str, Any] = field(default_factory=dict)
    step_s: float = 0.0
    kept: set[int] = field(init=False)

    def __post_init__(self) -> None:
        self.kept = set(self.turns.tolist())

    @property
    def name(self) -> str:
        """The label, with the role if the member is a reference."""
        role, label = self.request.role, self.request.label
        return label if role is Role.CASE else f"{role.value} {label}"

    @property
    def draws(self) -> Draws:
        """All draws of the request."""
        found = self.file.draws(self.request.about)
        return Draws.of(self.request.label, (), ()) if found is None else found

    @property
    def turns(self) -> np.ndarray:
        """The turn of each draw."""
        return self.draws.seeds if self.request.repeats else self.draws.seeds // self.request.count

    @property
    def seconds(self) -> np.ndarray:
        """The mean time of a step in each turn."""
        turns, at = np.unique(self.turns, return_inverse=True)
        return np.array([np.nanmean(self.draws.step_ms[at == turn]) for turn in range(len(turns))]) / 1e3

    @property
    def failure(self) -> Ended | None:
        """The reason why the process failed, or None if it did not."""
        return self.end if isinstance(self.end, Ended) else None

    @property
    def status(self) -> BenchStatus:
        """Status for records."""
        return BenchStatus.OK if self.failure is None else self.failure.status

    @property
    def late(self) -> bool:
        """True if the budget was spent before the first turn."""
        return isinstance(self.end, Stopped)

    @property
    def refusal(self) -> CannotStart | None:
        """The reason why the scene is not supported, or None."""
        return self.end if isinstance(self.end, CannotStart) else None

    @property
    def alive(self) -> bool:
        """True if the process can answer more questions."""
        return self.process is not None

    def ask(self, numbers: Sequence[int], turn: int, cold: bool, release: bool) -> None:
        """Ask for the steps of a turn, or for some of them."""
        self.process.ask({"numbers": numbers, "image": turn, "spp": self.request.spp, "cold": cold, "release": release})

    def keep(self, numbers: Sequence[int], answer: Mapping[str, Any]) -> None:
        """Keep the draws of an answer. A cold step leaves only its figures."""
        request, first = self.request, dict[str, Any]()
        if "peak_mib" in answer:
            numbers = numbers[:0]
            first = {"peak_mib": answer["peak_mib"], "scratch_bytes": answer["scratch_bytes"]}
            first["cold_ms"] = answer["step_ms"][0]
        count = 1 if request.repeats and numbers else len(numbers)
        start = len(numbers) - count
        times: dict[str, Any] = {
            name: np.array(answer[name][start : len(numbers)]) for name in ("step_ms", "kernel_ms", "codegen_ms")
        }
        for row in times.values() if count > 1 else ():
            row[0] = np.nan
        values = answer["values"][start : len(numbers)]
        found = Draws.of(request.label, values, numbers[start:], options=request.case.options, **times, **first)
        self.file.add(request.about, found)

    def close(self) -> None:
        """End the process, if one is running."""
        if self.process is not None:
            self.process.close()
            self.process = None


#: Starts a process from its first message and the place of its function (`processes.run`).
Start = Callable[[dict[str, Any], str], Any]

#: The functions that processes run.
STEPS = "reslrb_cli.measure.steps"


def start_process(first: dict[str, Any], does: str) -> Process:
    """Start a process that runs `processes.run` with `does`. `first` is its first message."""
    return Process(first, python_command(f"from reslrb_cli.measure.processes import run\nrun({does!r})"))


class Engine:
    """Members of a measurement, and their turns.

    `spent_s` is the part of the budget that is already spent. `depths` is the number of parts that share the budget,
    and `most` the maximum number of rounds.
    """

    def __init__(
        self, plan: Measurement, stop: Callable[[], bool], say: Callable[[str], None], start: Start = start_process,
        now: Callable[[], float] = time.monotonic, spent_s: float = 0.0, file: DrawsFile | None = None,
        depths: int = 1, most: int = 256,
    ) -> None:  # fmt: skip
        self.measurement, self.file = plan, DrawsFile() if file is None else file
        self.members: list[Member] = []
        self.pace = Pace(max(plan.budget_s - spent_s, 0.0), depths, plan.rounds, most, now)
        self._stop, self.say, self._start = stop, say, start
        self._said: set[str] = set()
        self._live = LivePage(self.file.save, "the file of draws")

    def measure(self) -> Iterator[Any]:
        """Measure, as `run` does. `run` ends the processes."""
        raise NotImplementedError

    def run(self) -> Iterator[Any]:
        """Measure. Yields an item after each round. Ends early, with the finished results, after `stop()`. Then all
        processes have ended, and all draws are on file. Raises CannotStart if a required process cannot start.
        """
        try:
            yield from self.measure()
        except Stopped:
            return
        finally:
            for member in self.members:
                member.close()
            self.file.save()

    def launch(self, config: Config, does: str, **more: Any) -> Any:
        """Return a new process for `config` that runs the function `does` of `steps`. `more` are further entries of its
        first message.
        """
        return self._start(self.measurement.first(config) | more, f"{STEPS}:{does}")

    def begin(self, members: Sequence[Member], arrays: Mapping[str, np.ndarray]) -> Iterator[Member]:
        """Start the processes of these members, load their scenes, and warm up until nothing is compiled. Yields each
        member after its warm-up, or after its end.
        """
        for member in members:
            own = member.request
            given = {"quantity": own.quantity, "purpose": own.purpose, "arrays": arrays}
            member.process = self.launch(own.config, "begin", **given)
        for member in members:
            member.opening = self.open(member) or {}
        for member in members:
            if member.alive:
                self._warm_up(member)
            yield member

    def open(self, member: Member) -> dict[str, Any] | None:
        """Return the first message of a process that has loaded its scene, and print its new warnings. Returns None if
        the process ended, or if the time was up.
        """
        opening = self._answer(member, self.pace.over)
        for line in (opening or {}).pop("warnings", ()):
            if line not in self._said:  # every process loads the same scene
                self._said.add(line)
                self.say(line)
        return opening

    def take_rounds(self) -> Iterator[int]:
        """Take the turns that are not on file. Yields the number of completed rounds after each round."""
        tight, done = self._tight(), 0
        self.pace.begin_rounds()
        for round in range(self.pace.most):
            workers = [member for member in self.members if member.alive]
            if not workers or not self.pace.another(round, done):
                return
            lacking = [worker for worker in workers if round not in worker.kept]
            start = round % max(len(lacking), 1)  # the first one changes from round to round
            for worker in [*lacking[start:], *lacking[:start]]:
                numbers = worker.request.numbers(round)
                worker.ask(numbers, round, False, tight)
                answer = self._answer(worker)
                if answer is not None:
                    worker.keep(numbers, answer)
                    worker.kept.add(round)
            if lacking:
                done += 1
                self._live.refresh()
                yield round + 1

    def _tight(self) -> bool:
        """True if processes together use so much memory that each must release memory after each step."""
        mib = sum(member.draws.peak_mib or 0.0 for member in self.members if member.alive)
        return mib * 2**20 > MEMORY_SHARE * memory_bytes(self.measurement.variant)

    def _answer(self, member: Member, over: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """Wait for a process's next answer. Returns None if the process ended, or if the time was up (`over`)."""
        try:
            result: dict[str, Any] = member.process.answer(lambda: self._stop() or over())
            return result
        except (Ended, CannotStart, Stopped) as end:
            required = isinstance(end, CannotStart) and not member.request.may_refuse
            if required or (isinstance(end, Stopped) and self._stop()):
                raise
            member.end = end
        member.close()  # releases its resources for the others
        return None

    def _warm_up(self, member: Member) -> None:
        """Take a cold step, then more steps until nothing is compiled."""
        for attempt in range(1 + MAX_WARM_UPS):
            cold, numbers = attempt == 0, member.request.numbers(0)
            numbers = numbers[:1] if cold or not member.request.repeats else numbers
            member.ask(numbers, 0, cold, not cold and self._tight())
            answer = self._answer(member, self.pace.over)
            if answer is None:
                return
            member.step_s = answer["step_ms"][-1] / 1e3
            if cold:
                member.keep(numbers, answer)
            elif not answer["new_kernels"]:
                return
