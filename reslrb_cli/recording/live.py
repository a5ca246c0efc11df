"""What is written of a run or a measurement while it is at work: its page, its file."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

logger = logging.getLogger(__name__)

#: Seconds between two pages, at least; and the times as long as the last page took: pages take a twentieth of a run.
PAGE_SECONDS, PAGE_SHARE = 5.0, 20.0


class LivePage:
    """Has `write` write the page, or `what` else, anew, at once and then now and then; called outside of iterations.

    A page that cannot be written ends no run, and is not tried again: the last one, at the run's end, says why.
    """

    def __init__(self, write: Callable[[], object], what: str = "the page of the run") -> None:
        self._write, self._what = write, what
        self._next: float | None = 0.0

    def refresh(self) -> None:
        """Write the page if it is time to."""
        start = time.monotonic()
        if self._next is None or start < self._next:
            return
        try:
            self._write()
        except Exception as error:
            logger.debug("%s is not kept current: %s", self._what, error)
            self._next = None
        else:
            end = time.monotonic()
            self._next = end + max(PAGE_SECONDS, PAGE_SHARE * (end - start))
