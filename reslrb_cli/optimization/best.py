"""The best parameters that a run has had, beside the last.

The loss of an iteration is noise for the most part, so that the least of all would be the luckiest. Where views are
held out, the best parameters are those of the least loss of these, which always has the same samples; otherwise those
at the end of the WINDOW iterations whose losses have the least mean.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from reslrb_cli.records.metrics import Record

#: Iterations over which losses are averaged.
WINDOW = 10


class Best:
    """The best so far: after how many updates it was, its `loss`, and the values; None where there is none yet."""

    def __init__(self, held_out: bool) -> None:
        self.held_out = held_out
        self.iteration: int | None = None
        self.loss = math.inf
        self.values: dict[str, Any] = {}
        self._recent: deque[float] = deque(maxlen=WINDOW)

    def see(self, record: Record, values: Mapping[str, Any]) -> None:
        """Take one iteration, and the values that it began with, by key; they are kept, not copied."""
        if self.held_out:
            loss = math.inf if record.held_out is None else record.held_out
        else:
            self._recent.append(record.loss)
            loss = sum(self._recent) / WINDOW if len(self._recent) == WINDOW else math.inf
        if loss < self.loss:  # which what is not finite is not
            self.iteration, self.loss, self.values = record.iteration, loss, dict(values)

    def recall(self, records: list[Record]) -> None:
        """Take note of the losses before, those of `records`, of a run that goes on."""
        self._recent.extend(record.loss for record in records[-WINDOW:])

    def restore(self, iteration: int, loss: float, values: Mapping[str, Any]) -> None:
        """Go on from what was the best."""
        self.iteration, self.loss, self.values = iteration, loss, dict(values)

    def to_json(self) -> dict[str, Any] | None:
        """For the manifest; None where there is none."""
        if self.iteration is None:
            return None
        kind = "held_out" if self.held_out else f"mean of {WINDOW} iterations"
        return {"iteration": self.iteration, "loss": self.loss, "loss_is": kind}
