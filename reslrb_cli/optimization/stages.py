"""Stages of a run (`run.stages`): the problem of each iteration, and the transition from one stage to the next.

A stage with its own resolution or film has its own problem. The stage's own problem is made from the run's problem
(`at_stage`), with resampled values. The last stage is the run as configured, with the run's own problem. When the
problem changes, the optimiser restarts. The old moments belong to other maps, and the suitable step length depends on
the resolution.

A coarse stage has its own values c, and adds their change to the run's values x. R converts from the run's resolution
to the stage's resolution, and P converts back. x0 are the run's values at the start of the stage.

    x = x0 + P (c - R x0)

Details too fine for the stage therefore stay unchanged. The method is the full approximation scheme (Brandt 1977).
"""

from __future__ import annotations

import gc
from dataclasses import replace
from typing import Any

import numpy as np

from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.optimization.assemble import at_stage, bounded, resized
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.state import State, guiding_of, standing

Array = np.ndarray[Any, Any]


class Stages:
    """Problems of one run's stages. Only one stage problem is kept at a time, besides the run's own problem `whole`.

    `State.stage` is the stage of a state. Before the first iteration, a state belongs to the run's own problem.
    """

    def __init__(self, whole: Problem) -> None:
        integrator = whole.integrator
        if isinstance(integrator, LightTracer) and any(stage.grain != (1, 1) for stage in whole.config.run.stages):
            # A recording holds one scene, and here two are in use.
            kept = integrator.with_options(samples_per_pass=integrator.samples_per_pass, freeze=False)
            whole = replace(whole, integrator=kept)
        self.whole, self._number, self._now = whole, len(whole.config.run.stages), whole
        guiding = guiding_of(whole)
        #: State of guided emission of `whole` before the first iteration.
        self._learned = None if guiding is None else guiding.state()
        #: The state at the start of the current iteration.
        self.begun: State | None = None
        #: The state of another problem at whose values `whole` is.
        self._brought: State | None = None

    @property
    def now(self) -> Problem:
        """Current problem."""
        return self._now

    @property
    def last(self) -> int:
        """Number of the last stage, which is the run as configured."""
        return len(self.whole.config.run.stages)

    def is_whole(self, number: int) -> bool:
        """Whether a stage uses the run's own problem."""
        return self.whole.config.stage(number).grain == self.whole.config.stage(self.last).grain

    def at(self, number: int) -> Problem:
        """Return the problem of a stage. If the stage's problem was not current before, the problem gets the values of
        `whole`.
        """
        if number == self._number:
            return self._now
        if self.is_whole(number):
            self._now = self.whole
        elif self.whole.config.stage(self._number).grain != self.whole.config.stage(number).grain:
            self._now = self.whole
            gc.collect()  # another scene takes part in all tracing until it is freed
            self._now = at_stage(self.whole, number)
        self._number = number
        return self._now

    def enter(self, state: State) -> tuple[Problem, State]:
        """Return the problem of the iteration after `state`, and the state in which the iteration starts."""
        problem, self.begun = self._entered(state)
        return problem, self.begun

    def _entered(self, state: State) -> tuple[Problem, State]:
        if not self.last:
            return self.whole, state
        number = self.whole.config.stage_number(state.iteration / self.whole.config.run.iterations)
        if state.iteration:
            number = max(number, state.stage)  # a continued run does not return to an earlier stage
        if number == state.stage:
            return self.at(number), state
        if self.whole.config.stage(number).grain == self.whole.config.stage(state.stage).grain:
            return self.at(number), replace(state, stage=number, stage_began=state.iteration)
        self.bring(state)
        problem = self.at(number)
        base = {} if self.is_whole(number) else {key: np.array(value) for key, value in self.whole.values().items()}
        began = replace(
            state, stage=number, stage_began=state.iteration, base=base, clamp={}, clamp_sums={}, scaling=None
        )
        began = standing(problem, began)
        if number == self.last and self._learned is not None:  # independent of the images rendered since
            began = replace(began, guiding=self._learned[0], learned=self._learned[1])
            problem.optimizer.stands_at = None
        return problem, began

    def values(self, state: State) -> dict[str, Array]:
        """Return a state's values in the run's resolution, in the form of `Problem.values`."""
        whole, now = self.whole, self.at(state.stage)
        shown = {key: now.selection.shown(key, value) for key, value in state.values.items()}
        for key, before in state.base.items():
            change = resized(whole, key, shown[key] - resized(now, key, before))
            shown[key] = bounded(whole, key, before + change)
        return shown

    def bring(self, state: State) -> None:
        """Set the run's own problem to the values of the newest state."""
        if self.is_whole(state.stage) or self._brought is state:
            return
        self.whole.selection.set_arrays(self.values(state))
        for key in self.whole.selection.keys:
            self.whole.optimizer.set_value(key, self.whole.selection.value(key))
        self.whole.apply()
        self._brought = state
