"""Those that take steps: the methods compared, what errors are taken from, and what biases are judged by."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config import Config
from reslrb_cli.measure.contestant import Contestant
from reslrb_cli.records.convergence import Method

#: Steps after the first until no new kernel comes, at most.
MAX_WARM_UPS = 4
#: A turn of one that compares is as long as a step of the slowest, but no longer than so many seconds.
TURN_S = 2.0
#: Steps of less than so many seconds are taken at least two a turn: the first makes good what others did to the caches.
SHORT_S = 1.0
#: The most steps of one turn.
MOST_STEPS = 8
#: Turns of references, in those of all that are compared together.
SHARES = {"reference": 0.5, "independent": 0.35}
#: Steps of a turn where their number is not to depend on time.
FIXED = {"case": 2, "reference": 8, "independent": 4}
#: The most steps of a reference's turn.
MOST_REFERENCE_STEPS = 64


class Role(str, enum.Enum):
    """What a member is there for."""

    CASE = "case"
    REFERENCE = "reference"
    INDEPENDENT = "independent"


@dataclass(kw_only=True)
class Member(Contestant):
    """One process, the steps that it is to take, and those that it has taken.

    `rows` are samples (P,), `turns` says in which round each was taken, `seconds` are those of one step in each turn.
    `count` is the number of steps of a turn, `taken` of all that were ever asked for, whose numbers make the seeds.
    """

    role: Role
    method: Method
    config: Config
    spp: int
    out: Path
    count: int = 1
    taken: int = 0
    cold: dict[str, Any] | None = None
    step_s: float = 0.0
    rows: list[np.ndarray] = field(default_factory=list)
    turns: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    message: str = ""

    @property
    def label(self) -> str:
        """What it is called."""
        return self.method.label

    @property
    def cold_s(self) -> float | None:
        """Seconds of the first step, which compiles."""
        return None if self.cold is None else self.cold["step_ms"][0] / 1e3

    def warm_up(self, tight: bool, stop: Callable[[], bool], over: Callable[[], bool]) -> bool:
        """Take steps until nothing is compiled any more; whether it came to that."""
        self.cold = self._steps(1, 0, True, False, stop, over)
        answer = self.cold
        for _ in range(MAX_WARM_UPS):
            if answer is None:
                return False
            answer = self._steps(1, 0, False, tight, stop, over)
            if answer is not None:
                self.step_s = answer["step_ms"][0] / 1e3
                if not answer["new_kernels"]:
                    return True
        return answer is not None

    def turn(self, round: int, tight: bool, stop: Callable[[], bool]) -> None:
        """Take a turn's steps and keep them. Raises Stopped."""
        answer = self._steps(self.count, round, False, tight, stop)
        if answer is None:
            return
        rows = np.load(self.out)
        if not np.isfinite(rows).all() and not self.message:
            self.message = f"{np.count_nonzero(~np.isfinite(rows))} entries of step {len(self.rows) + 1} are not finite"
        self.rows += list(rows)
        self.turns += [round] * len(rows)
        times = answer["step_ms"]
        self.seconds.append(float(np.mean(times[1:] if len(times) > 1 else times)) / 1e3)

    def _steps(
        self, count: int, image: int, cold: bool, release: bool, stop: Callable[[], bool],
        over: Callable[[], bool] = lambda: False,
    ) -> dict[str, Any] | None:  # fmt: skip
        question = {"start": self.taken, "count": count, "spp": self.spp, "image": image, "out": str(self.out)}
        self.taken += count
        return self.ask(question | {"cold": cold, "release": release}, stop, over)

    def means(self, key: slice, groups: int | None = None) -> np.ndarray:
        """Means over turns, or over every so many-th of them together, of some entries: (K, P)."""
        turns, rows = np.array(self.turns), np.stack(self.rows)[:, key].astype(np.float64)
        if groups is not None:
            turns = turns % groups
        return np.stack([rows[turns == turn].mean(0) for turn in np.unique(turns)])


def share_turns(members: list[Member], fixed: bool) -> None:
    """Set how many steps each takes in a turn: about equal times, since what is fast has steps to spare.

    With `fixed`, so many whatever time they take.
    """
    for member in members if fixed else ():
        member.count = FIXED[member.role.value]
    if fixed:
        return
    cases = [member for member in members if member.role is Role.CASE]
    turn_s = min(max((member.step_s for member in cases), default=0.0), TURN_S)
    for member in cases:
        least = 2 if member.step_s < SHORT_S else 1
        member.count = _fitting(turn_s, member.step_s, least, MOST_STEPS)
    together = sum(member.count * member.step_s for member in cases)
    for member in members:
        if member.role is not Role.CASE:
            member.count = _fitting(SHARES[member.role.value] * together, member.step_s, 1, MOST_REFERENCE_STEPS)


def _fitting(turn_s: float, step_s: float, least: int, most: int) -> int:
    return min(max(round(turn_s / max(step_s, 1e-4)), least), most)
