"""Detection of a flat loss, and the time limit of a run (`run.max_seconds`).

A flat loss ends a run early (`run.stop`). The losses are divided into windows of `patience` iterations, and tested at
the end of each window. A loss is flat if the test shows a fall of less than `relative` per window (`trend.stands`). If
views are held out, the held-out loss is tested. The held-out loss has fewer values than the training loss. All held-out
values use the same samples.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.optimization.state import State
from reslrb_cli.optimization.trend import SPANS, levels_of, line, stands
from reslrb_cli.records.metrics import Record

#: Prefix of `State.stopped` if `run.max_seconds` ended the run.
OUT_OF_TIME = "the time is up"


def time_share(limit_s: float | None, state: State) -> float:
    """Return the elapsed share of a run's time, or 0 without a limit. The first iteration does not count, because it
    compiles kernels.
    """
    if limit_s is None or not state.iteration:
        return 0.0
    return min((state.elapsed_s - state.first_s) / max(limit_s - state.first_s, 1e-9), 1.0)


def out_of_time(limit_s: float | None, state: State) -> str:
    """Return a message if one more iteration of mean duration would exceed the limit, otherwise "". The mean excludes
    the first iteration.
    """
    mean_s = (state.elapsed_s - state.first_s) / max(state.iteration - 1, 1)
    if limit_s is None or state.elapsed_s + mean_s <= limit_s:
        return ""
    return f"{OUT_OF_TIME}, after {state.elapsed_s:.3g} s of iterations"


class Watch:
    """Losses of a run so far, iteration by iteration. Equal losses lead to equal decisions."""

    def __init__(self, config: Config) -> None:
        self.config, self.held_out = config, bool(config.run.held_out)
        self._values: dict[int, float] = {}

    def add(self, record: Record) -> None:
        """Add the record of one iteration. Earlier iterations of a resumed run must be added, too."""
        loss = record.held_out if self.held_out else record.loss
        if loss is not None and math.isfinite(loss):
            self._values[record.iteration] = loss

    def after(self, state: State, record: Record) -> State:
        """Add the record. Return the state after the iteration, with the decision about stopping."""
        self.add(record)
        said = self._stands(state.iteration)
        return replace(state, stopped=said) if said else state

    def _stands(self, done: int) -> str:
        """Return a message about a flat loss after `done` iterations. The message is "" if the loss is not flat, or if
        `done` iterations do not end a window.
        """
        if (rule := self.config.run.stop) is None or done % rule.patience:
            return ""
        span = rule.patience
        levels: list[float] = []
        for end in range(done, 0, -span)[: SPANS[-1]]:
            values = [self._values[each] for each in range(end - span, end) if each in self._values]
            if len(values) < 2:
                break
            levels.insert(0, float(levels_of(np.array(values))))
        if not (count := int(stands(np.array(levels), rule.relative, done // span))):
            return ""
        last = np.array(levels[-count:])
        fall, error = (float(each) / max(abs(float(np.median(last))), 1e-300) for each in line(last))
        kind = "loss of held-out views" if self.held_out else "loss"
        share = f"{-100 * fall:.2g} +- {100 * error:.1g} %"
        return f"the {kind} has stopped falling: over the last {count * span} iterations it fell by {share} in {span}"
