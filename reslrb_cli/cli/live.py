"""The page of a run while it is at work."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

logger = logging.getLogger(__name__)

#: Seconds between two pages, at least; and the times as long as the last page took: pages take a twentieth of a run.
PAGE_SECONDS, PAGE_SHARE = 5.0, 20.0


class LivePage:
    """Has `write` write the page anew, at once and then now and then. It is called outside of iterations.

    A page that cannot be written ends no run, and is not tried again: the last one, at the run's end, says why.
    """

    def __init__(self, write: Callable[[], object]) -> None:
        self._write = write
        self._next: float | None = 0.0

    def refresh(self) -> None:
        """Write the page if it is time to."""
        start = time.monotonic()
        if self._next is None or start < self._next:
            return
        try:
            self._write()
        except Exception as error:
            logger.debug("the page of the run is not kept current: %s", error)
            self._next = None
        else:
            end = time.monotonic()
            self._next = end + max(PAGE_SECONDS, PAGE_SHARE * (end - start))
