"""How the time of a sweep is spent: so much for each depth, and as many rounds there as fit."""

from __future__ import annotations

import time
from collections.abc import Callable

MIN_ROUNDS = 3
MAX_ROUNDS = 25
#: How much more of the time is for the next depth, whose kernels take longer to compile and to run.
GROWTH = 1.3
#: What is said of what a budget did not suffice for.
NO_TIME = "the budget was spent; allow more with --budget"


class Pace:
    """Divides the time among depths, each of which gets GROWTH times as much as the one before it.

    What a depth leaves is for the others. None gets fewer than MIN_ROUNDS rounds while there is time at all, whatever
    its own share, nor more than `most`. With `rounds` time does not count. Rounds of earlier sessions count.
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
        self._start = self._rounds_start = self._depth_start = self._depth_end = now()
        self._before = 0

    @property
    def spent_s(self) -> float:
        """Seconds since the beginning."""
        return self._now() - self._start

    @property
    def depth_s(self) -> float:
        """Seconds since the depth began."""
        return self._now() - self._depth_start

    def over(self) -> bool:
        """Whether the time is up."""
        return self._rounds is None and self._now() >= self._end

    def fits(self, seconds: float) -> bool:
        """Whether there is so much time left."""
        return self._rounds is not None or self._now() + seconds <= self._end

    def begin_depth(self) -> None:
        """A depth begins."""
        now = self._depth_start = self._now()
        self._depth_end = now + (self._end - now) / sum(GROWTH**k for k in range(self._left))
        self._left -= 1

    def begin_rounds(self, before: int = 0) -> None:
        """Its processes are warm; `before` rounds were done by earlier sessions."""
        self._rounds_start, self._before = self._now(), before

    def another(self, done: int) -> bool:
        """Whether there is time for another round after `done` of them in this session."""
        if self._rounds is not None:
            return self._before + done < self._rounds
        if self._before + done >= self._most:
            return False
        if done == 0:
            return True
        now = self._now()
        return now + (now - self._rounds_start) / done <= (self._end if done < MIN_ROUNDS else self._depth_end)
