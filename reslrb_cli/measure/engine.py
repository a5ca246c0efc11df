"""The measuring engine: methods take turns, each in its own process, and answer draws.

`bench` and `convergence` are lists of members of this engine, and functions of their draws. Only one process computes
at a time, so drift of the machine affects all methods alike. Draws on file are not drawn again (`DrawsFile`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from reslrb_cli.backend.doctor import memory_bytes
from reslrb_cli.backend.installation import python_command
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.draws import Draws, DrawsFile, StoredResults
from reslrb_cli.measure.methods import MeasurementPlan, NamedIntegrator, first_message
from reslrb_cli.measure.processes import CannotStart, Ended, Process, Stopped
from reslrb_cli.records.measurement_files import LivePage
from reslrb_cli.records.measurements import BenchStatus, Method

#: If all processes together hold more than this share of the memory, each releases its own after a step.
MEMORY_SHARE = 0.7

#: Maximum number of steps after the cold one until no new kernel is compiled.
MAX_WARM_UPS = 4

#: Message about measurements that exceed the budget.
NO_TIME = "the budget was spent; allow more with --budget"

#: Role of a method in a measurement: compared, reference of errors, or independent reference of biases.
Role = Literal["case", "reference", "independent"]


@dataclass(kw_only=True)
class Member:
    """A method, its draws so far in `file`, and its process, which is None if it does not run.

    - `quantity`, `spp`, `purpose`: as in `steps.Sampler`.
    - `about`: the situation that determines the draws (`DrawsFile`).
    - `count`: steps of a turn. The time of the first step does not count, because it refills caches.
    - `may_refuse`: the method is left out if it does not support the scene. Otherwise, a refusal ends the measurement.
    - `status`: the way in which the process ended, and `reason` in words.
    - `step_s`: the time of the last step of the warm-up.
    - `kept`: the turns whose draws are kept.
    """

    case: NamedIntegrator
    config: Config
    label: str
    quantity: str
    spp: int
    purpose: str
    about: Mapping[str, Any]
    file: DrawsFile
    count: int = 2
    may_refuse: bool = False
    role: Role = "case"
    process: Any = None
    status: BenchStatus = BenchStatus.OK
    reason: str = ""
    step_s: float = 0.0
    kept: set[int] = field(init=False)

    def __post_init__(self) -> None:
        self.kept = set(self.turns.tolist())

    @property
    def name(self) -> str:
        """The label, with the role if the member is a reference."""
        return self.label if self.role == "case" else f"{self.role} {self.label}"

    @property
    def method(self) -> Method:
        """The description for records."""
        options = {"type": self.case.type} | self.config.integrator.options()
        adjoint = self.config.adjoint if self.quantity == "loss" else None
        return Method(self.label, options, self.spp, options.pop("max_depth"), adjoint)

    @property
    def draws(self) -> Draws:
        """All draws of the method."""
        found = self.file.draws(self.about)
        return Draws.of(self.label, (), ()) if found is None else found

    @property
    def turns(self) -> np.ndarray:
        """The turn of each draw."""
        return self.draws.seeds // self.count

    @property
    def seconds(self) -> np.ndarray:
        """The mean time of a step in each turn."""
        return np.asarray(np.nanmean(self.draws.step_ms.reshape(-1, self.count), axis=1)) / 1e3

    def ask(self, turn: int, steps: int, release: bool, cold: bool = False) -> None:
        """Ask for the first `steps` steps of a turn. Their numbers select the seeds."""
        first = turn * self.count
        self.process.ask({"numbers": [*range(first, first + steps)], "image": turn, "spp": self.spp, "cold": cold,
                          "release": release})  # fmt: skip

    def keep(self, answer: Mapping[str, Any], turn: int | None = None) -> None:
        """Keep the draws of a whole turn. Without a `turn`, keep the figures of the first step of the process."""
        if turn is None:
            values, numbers, figures = (), range(0), {name: answer[name] for name in ("peak_mib", "scratch_bytes")}
            figures["cold_ms"] = answer["step_ms"][0]
        else:
            values, numbers = answer["values"], range(turn * self.count, (turn + 1) * self.count)
            figures = {name: np.array([np.nan, *answer[name][1:]]) for name in ("step_ms", "kernel_ms", "codegen_ms")}
            self.kept.add(turn)
        self.file.add(self.about, Draws.of(self.label, values, numbers, options=self.case.options, **figures))

    def close(self) -> None:
        """End the process, if one is running."""
        if self.process is not None:
            self.process.close()
            self.process = None


def start_process(first: dict[str, Any]) -> Process:
    """Start a process that works for `steps.begin`. `first` is its first message."""
    return Process(
        first, python_command("from reslrb_cli.measure.processes import run\nrun('reslrb_cli.measure.steps')")
    )


class Engine:
    """Members of a measurement, and their turns. `spent_s` is the part of the budget that is already spent.

    `most` is the number of rounds. The budget ends the measurement earlier, unless the user gave the number of rounds.
    `sizes` are the sizes of film and textures that a process has reported.
    """

    def __init__(
        self, plan: MeasurementPlan, stop: Callable[[], bool], say: Callable[[str], None], usual_rounds: int,
        start: Callable[[dict[str, Any]], Any] = start_process, now: Callable[[], float] = time.monotonic,
        spent_s: float = 0.0, file: DrawsFile | None = None,
    ) -> None:  # fmt: skip
        self.plan, self.file = plan, DrawsFile() if file is None else file
        self.members: list[Member] = []
        self.sizes: dict[str, Any] = {}
        self.most = plan.rounds or usual_rounds
        self._now, self._end = now, math.inf if plan.rounds else now() + plan.budget_s - spent_s
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

    def is_late(self) -> bool:
        """Whether the budget is spent."""
        return self._now() >= self._end

    @property
    def unmeasured(self) -> list[str]:
        """The labels of the members without draws whose processes did not fail."""
        return [member.label for member in self.members if member.status is BenchStatus.OK and not member.kept]

    def launch(self, config: Config, **more: Any) -> Any:
        """Return a new process for `config` (`steps.begin`). `more` are further entries of its first message."""
        return self._start(first_message(config, self.plan.variant, self.plan.memory_limit, **more))

    def begin(self, members: Sequence[Member], arrays: Mapping[str, np.ndarray]) -> Iterator[Member]:
        """Start the processes of these members, load their scenes, and warm up until nothing is compiled. Yields each
        member after its warm-up, or after its end.
        """
        for member in members:
            given = {"quantity": member.quantity, "purpose": member.purpose, "arrays": arrays}
            member.process = self.launch(member.config, **given)
        for member in members:
            self.sizes |= self._answer(member) or {}
        for member in members:
            if member.process is not None:
                self._warm_up(member)
            yield member

    def take_rounds(self) -> Iterator[int]:
        """Take the turns that are not on file. Yields the number of completed rounds after each round."""
        tight = self._is_tight()
        for turn in range(self.most):
            lacking = [member for member in self.members if member.process is not None and turn not in member.kept]
            start = turn % max(len(lacking), 1)  # the first one changes from round to round
            for member in [*lacking[start:], *lacking[:start]]:
                member.ask(turn, member.count, tight)
                answer = self._answer(member)
                if answer is not None:
                    member.keep(answer, turn)
            if self.is_late():
                return
            if lacking:
                self._live.refresh()
                yield turn + 1

    def hear(self, process: Any) -> dict[str, Any]:
        """Wait for the next answer of a process, and print its new warnings. Raises Ended and CannotStart. Raises
        Stopped after `stop()`, or if the budget is spent.
        """
        answer: dict[str, Any] = process.answer(lambda: self._stop() or self.is_late())
        for line in answer.pop("warnings", ()):
            if line not in self._said:  # every process loads the same scene
                self._said.add(line)
                self.say(line)
        return answer

    def _is_tight(self) -> bool:
        """True if processes together use so much memory that each must release memory after each step."""
        mib = sum(member.draws.peak_mib or 0.0 for member in self.members if member.process is not None)
        return mib * 2**20 > MEMORY_SHARE * memory_bytes(self.plan.variant)

    def _answer(self, member: Member) -> dict[str, Any] | None:
        """Wait for the next answer of a member. Returns None if its process ended, or if the budget is spent. Remembers
        that a method does not support the scene.
        """
        try:
            return self.hear(member.process)
        except Ended as end:
            member.status, member.reason = end.status, end.reason
        except CannotStart as refusal:
            if not member.may_refuse:
                raise
            member.status, member.reason = BenchStatus.REFUSED, str(refusal)
            if refusal.exit_code == ExitCode.USAGE:
                self.file.store(member.about, StoredResults({"refusal": member.reason}, {}))
        except Stopped:
            if self._stop():
                raise
        member.close()  # releases its resources for the others
        return None

    def _warm_up(self, member: Member) -> None:
        """Take a cold step, then more steps until nothing is compiled."""
        for attempt in range(1 + MAX_WARM_UPS):
            cold = attempt == 0
            member.ask(0, 1, not cold and self._is_tight(), cold)
            answer = self._answer(member)
            if answer is None:
                return
            member.step_s = answer["step_ms"][-1] / 1e3
            if cold:
                member.keep(answer)
            elif not answer["new_kernels"]:
                return
