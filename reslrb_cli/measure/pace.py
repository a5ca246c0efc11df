"""How a bench divides its time: among depths, and among rounds of steps."""

from __future__ import annotations

import time
from collections.abc import Callable

MIN_ROUNDS = 3
MAX_ROUNDS = 25
#: How much more of the time is for the next depth, whose kernels take longer to compile and to run.
GROWTH = 1.3


class Pace:
    """Divides the time among depths, each of which gets GROWTH times as much as the one before it.

    What a depth leaves is for the others. None gets fewer than MIN_ROUNDS rounds, whatever they cost.
    """

    def __init__(self, budget_s: float, depths: int, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._end, self._left = now, now() + budget_s, depths
        self._start = self._rounds_start = self._rounds_end = self._depth_end = now()
        self._begin_s, self._before, self._most = 0.0, 0, MAX_ROUNDS

    def begin_depth(self) -> None:
        """A depth begins."""
        self._start = self._now()
        self._depth_end = self._start + (self._end - self._start) / sum(GROWTH**k for k in range(self._left))
        self._left -= 1

    def begin_rounds(self, compile_s: float) -> None:
        """Its processes are warm, after so long a time for compiling, which new ones need not."""
        now = self._now()
        self._begin_s = max(now - self._start - compile_s, 0.0)
        self._rounds_start, self._rounds_end = now, now + (self._depth_end - now - self._begin_s) / 2
        self._before, self._most = 0, (MAX_ROUNDS + 1) // 2

    def renews(self, done: int) -> bool:
        """Whether, after `done` rounds, there is time for new processes and MIN_ROUNDS rounds of theirs."""
        now = self._now()
        return now + self._begin_s + MIN_ROUNDS * (now - self._rounds_start) / done <= self._depth_end

    def begin_rounds_again(self, done: int) -> None:
        """New processes are warm, after `done` rounds of the old ones."""
        self._rounds_start, self._rounds_end = self._now(), self._depth_end
        self._before, self._most = done, MAX_ROUNDS

    def another(self, done: int) -> bool:
        """Whether there is time for another round of these processes after `done` of them in all."""
        done_here = done - self._before
        if done_here < MIN_ROUNDS:
            return True
        if done >= self._most:
            return False
        now = self._now()
        return now + (now - self._rounds_start) / done_here <= self._rounds_end
