"""Detection of a flat loss, and the time limit of a run (`run.max_seconds`).

A flat loss ends a run early (`run.stop`) or lowers its learning rate (`optimizer.schedule: plateau`). The losses are
divided into windows of `patience` iterations, and tested at the end of each window. A loss is flat if the test shows a
fall of less than `relative` per window (`trend.stands`). If views are held out, the held-out loss is tested. The
held-out loss has fewer values than the training loss. All held-out values use the same samples. Windows start after the
stages of `run.stages`, and start again after each reduction of the learning rate. A flat loss ends a `plateau` run only
at the lowest learning rate.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from reslrb_cli.config.optimizers import AnyOptimizer, StopRule
from reslrb_cli.config.schema import Config
from reslrb_cli.optimization.state import State
from reslrb_cli.optimization.trend import SPANS, levels_of, line, stands
from reslrb_cli.records.metrics import Record

#: Factor on the learning rate at a plateau.
FACTOR = 0.5


def lowered(optimizer: AnyOptimizer, drops: int) -> float:
    """Return the factor on the learning rate after `drops` reductions at a plateau. The factor is 1 with other
    schedules.
    """
    if optimizer.schedule != "plateau":
        return 1.0
    return max(FACTOR**drops, optimizer.final_fraction)


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
        """Add the record. Return the state after the iteration, with the current decisions about stopping and the
        learning rate.
        """
        self.add(record)
        stop, optimizer, done = self.config.run.stop, self.config.optimizer, state.iteration
        if state.stage < len(self.config.run.stages):
            return state
        began = max(state.stage_began, state.since)
        if optimizer.schedule == "plateau" and lowered(optimizer, state.drops) > optimizer.final_fraction:
            if self._stands(stop or StopRule(), began, state):
                return replace(state, drops=state.drops + 1, since=done)
        elif stop is not None and (said := self._stands(stop, began, state)):
            return replace(state, stopped=said)
        return state

    def _stands(self, asked: StopRule, began: int, state: State) -> str:
        """Return a message about a flat loss in windows that start after `began` iterations. The message is "" if the
        loss is not flat, or if the state does not end a window.
        """
        span, done = asked.patience, state.iteration
        if (done - began) % span:
            return ""
        levels: list[float] = []
        for end in range(done, began, -span)[: SPANS[-1]]:
            values = [self._values[each] for each in range(end - span, end) if each in self._values]
            if len(values) < 2:
                break
            levels.insert(0, float(levels_of(np.array(values))))
        if not (count := int(stands(np.array(levels), asked.relative, (done - state.stage_began) // span))):
            return ""
        last = np.array(levels[-count:])
        fall, error = (float(each) / max(abs(float(np.median(last))), 1e-300) for each in line(last))
        kind = "loss of held-out views" if self.held_out else "loss"
        share = f"{-100 * fall:.2g} +- {100 * error:.1g} %"
        return f"the {kind} has stopped falling: over the last {count * span} iterations it fell by {share} in {span}"
