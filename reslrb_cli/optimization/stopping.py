"""When a loss stands: what ends a run early (`run.stop`), and lowers its rate (`optimizer.schedule: plateau`); and the
time of a run (`run.max_seconds`).

A loss has windows of `patience` iterations, one after another, and is tested at the end of each: it stands where it is
shown to fall by less than `relative` a window (`trend.stands`). Where views are held out, the test takes their loss,
which has fewer values, always of the same samples. Windows begin once the run is as it is configured (`run.stages`),
and anew where the rate is lowered. A run with a plateau ends only at its least rate.
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

#: The factor by which a plateau lowers the learning rate.
FACTOR = 0.5


def lowered(optimizer: AnyOptimizer, drops: int) -> float:
    """Return the factor of the rate after so many drops of a plateau; 1 with other schedules."""
    if optimizer.schedule != "plateau":
        return 1.0
    return max(FACTOR**drops, optimizer.final_fraction)


#: How `State.stopped` begins where `run.max_seconds` ended the run.
OUT_OF_TIME = "the time is up"


def time_share(limit_s: float | None, state: State) -> float:
    """Return the share of a run's time that has passed since its first iteration, which compiles; 0 without a limit."""
    if limit_s is None or not state.iteration:
        return 0.0
    return min((state.elapsed_s - state.first_s) / max(limit_s - state.first_s, 1e-9), 1.0)


def out_of_time(limit_s: float | None, state: State) -> str:
    """Say that an iteration as long as the mean of those after the first would exceed the limit; "" if it would not."""
    mean_s = (state.elapsed_s - state.first_s) / max(state.iteration - 1, 1)
    if limit_s is None or state.elapsed_s + mean_s <= limit_s:
        return ""
    return f"{OUT_OF_TIME}, after {state.elapsed_s:.3g} s of iterations"


class Watch:
    """The losses of a run so far, which is told of each iteration in turn; from equal ones equal decisions follow."""

    def __init__(self, config: Config) -> None:
        self.config, self.held_out = config, bool(config.run.held_out)
        self._values: dict[int, float] = {}

    def add(self, record: Record) -> None:
        """Take an iteration, of a run that goes on as well."""
        loss = record.held_out if self.held_out else record.loss
        if loss is not None and math.isfinite(loss):
            self._values[record.iteration] = loss

    def after(self, state: State, record: Record) -> State:
        """The state that an iteration leaves, with what is decided after it. Takes the record."""
        self.add(record)
        stop, optimizer, done = self.config.run.stop, self.config.optimizer, state.iteration
        began = max(self._first, state.since)
        if optimizer.schedule == "plateau" and lowered(optimizer, state.drops) > optimizer.final_fraction:
            if self._stands(stop or StopRule(), began, done):
                return replace(state, drops=state.drops + 1, since=done)
        elif stop is not None and (said := self._stands(stop, began, done)):
            return replace(state, stopped=said)
        return state

    @property
    def _first(self) -> int:
        """The first iteration of the run as it is configured."""
        stages, iterations = self.config.run.stages, self.config.run.iterations
        return math.ceil(stages[-1].until * iterations) + 1 if stages else 0

    def _stands(self, asked: StopRule, began: int, done: int) -> str:
        """Say how the loss stands after `done` iterations; "" where that is not shown, or no window is at its end."""
        span = asked.patience
        if (done - began) % span:
            return ""
        levels: list[float] = []
        for end in range(done, began, -span)[: SPANS[-1]]:
            values = [self._values[each] for each in range(end - span, end) if each in self._values]
            if len(values) < 2:
                break
            levels.insert(0, float(levels_of(np.array(values))))
        if not (count := int(stands(np.array(levels), asked.relative, (done - self._first) // span))):
            return ""
        last = np.array(levels[-count:])
        fall, error = (float(each) / max(abs(float(np.median(last))), 1e-300) for each in line(last))
        kind = "loss of held-out views" if self.held_out else "loss"
        share = f"{-100 * fall:.2g} +- {100 * error:.1g} %"
        return f"the {kind} stands: over the last {count * span} iterations it fell by {share} in {span}"
