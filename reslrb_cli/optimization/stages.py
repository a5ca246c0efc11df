"""The stages of a run (`run.stages`): which problem its iterations work on, and what goes from one to the next.

A stage that has a resolution or a film of its own works on a problem of its own, made of the run's (`at_stage`), in
which the run's values stand resampled. The last one, the run as it is configured, works on the run's own problem.
Where the problem changes, the optimiser begins anew: its moments are of other maps, and what a step may be depends on
how fine they are.

What a coarse stage does to the run's values x is the change of its own ones c, with R and P between the two maps:

    x = x0 + P (c - R x0)      x0 the run's values when the stage began

so that what is too fine for the stage stays as it was (Brandt 1977, the full approximation scheme).
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
    """The problems of one run's stages, one of which is kept at a time beside the run's own, `whole`.

    `State.stage` says of which stage a state is; before the first iteration it is of the run's own problem.
    """

    def __init__(self, whole: Problem) -> None:
        integrator = whole.integrator
        if isinstance(integrator, LightTracer) and any(stage.grain != (1, 1) for stage in whole.config.run.stages):
            # A recording knows of one scene alone, and two live side by side.
            kept = integrator.with_options(samples_per_pass=integrator.samples_per_pass, freeze=False)
            whole = replace(whole, integrator=kept)
        self.whole, self._number, self._now = whole, len(whole.config.run.stages), whole
        guiding = guiding_of(whole)
        #: What guided emission of `whole` knew before the first iteration.
        self._learned = None if guiding is None else guiding.state()
        #: The state with which the iteration that is at work began.
        self.begun: State | None = None
        #: The state at whose values `whole` stands, of those that are of another problem.
        self._brought: State | None = None

    @property
    def now(self) -> Problem:
        """The problem that is at work."""
        return self._now

    @property
    def last(self) -> int:
        """The number of the stage in which the run is as it is configured."""
        return len(self.whole.config.run.stages)

    def is_whole(self, number: int) -> bool:
        """Whether a stage works on the run's own problem."""
        return self.whole.config.stage(number).grain == self.whole.config.stage(self.last).grain

    def at(self, number: int) -> Problem:
        """The problem of a stage; one that was not at work just before has the values that `whole` has."""
        if number == self._number:
            return self._now
        if self.is_whole(number):
            self._now = self.whole
        elif self.whole.config.stage(self._number).grain != self.whole.config.stage(number).grain:
            self._now = self.whole
            gc.collect()  # another scene takes part in all that is traced, until it is gone
            self._now = at_stage(self.whole, number)
        self._number = number
        return self._now

    def enter(self, state: State) -> tuple[Problem, State]:
        """The problem that the iteration after `state` works on, and the state as that begins with it."""
        problem, self.begun = self._entered(state)
        return problem, self.begun

    def _entered(self, state: State) -> tuple[Problem, State]:
        if not self.last:
            return self.whole, state
        number = self.whole.config.stage_number(state.iteration / self.whole.config.run.iterations)
        if state.iteration:
            number = max(number, state.stage)  # a run that goes on for longer does not go back
        if number == state.stage:
            return self.at(number), state
        if self.whole.config.stage(number).grain == self.whole.config.stage(state.stage).grain:
            return self.at(number), replace(state, stage=number)
        self.bring(state)
        problem = self.at(number)
        base = {} if self.is_whole(number) else {key: np.array(value) for key, value in self.whole.values().items()}
        began = replace(state, stage=number, base=base, clamp={}, clamp_sums={}, scaling=None)
        began = standing(problem, began)
        if number == self.last and self._learned is not None:  # whatever images it has rendered since
            began = replace(began, guiding=self._learned[0], learned=self._learned[1])
            problem.optimizer.stands_at = None
        return problem, began

    def values(self, state: State) -> dict[str, Array]:
        """The values of a state as the run has them, as `Problem.values` does."""
        whole, now = self.whole, self.at(state.stage)
        shown = {key: now.selection.shown(key, value) for key, value in state.values.items()}
        for key, before in state.base.items():
            change = resized(whole, key, shown[key] - resized(now, key, before))
            shown[key] = bounded(whole, key, before + change)
        return shown

    def bring(self, state: State) -> None:
        """Have the run's own problem stand at the values of a state, which is the newest."""
        if self.is_whole(state.stage) or self._brought is state:
            return
        self.whole.selection.set_arrays(self.values(state))
        for key in self.whole.selection.keys:
            self.whole.optimizer.set_value(key, self.whole.selection.value(key))
        self.whole.apply()
        self._brought = state
