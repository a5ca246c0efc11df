"""The state of a run's iterations: all that one of them hands on to the next.

It is this: the values of the parameters; of the optimiser its moments, and of each parameter what is moved in its
place, with its unit and gain (transforms, `scale: auto`); what the clamp knows of gradients; how long something has not
been finite; what guided emission has learned; the number of iterations done, from which seeds, views and the schedule's
factor follow; the clock and the memory's peak. Nothing else decides what the next iteration does: from equal states
equal ones follow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from reslrb_cli.integrators import Reslrb
from reslrb_cli.integrators.guiding import Guiding
from reslrb_cli.optimization.arrays import to_array
from reslrb_cli.optimization.clamping import GradientClamp
from reslrb_cli.optimization.nonfinite import NonFinitePolicy
from reslrb_cli.optimization.scaling import Scaled
from reslrb_cli.optimization.stored import Stored, stored_value
from reslrb_cli.records.clock import StepClock

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]


@dataclass
class State:
    """What the iterations of `problem` go on from; a new one is that of a run before its first.

    `iteration` is the number of those done, `scaled` says whether `scale: auto` has been measured, `peak_mib` is the
    allocator's high-water mark. The parameters and what moves them are the problem's optimiser's.
    """

    problem: Problem
    iteration: int = 0
    scaled: bool = False
    peak_mib: float = 0.0
    clock: StepClock = field(default_factory=StepClock)
    policy: NonFinitePolicy = field(init=False)
    clamp: GradientClamp | None = field(init=False)

    def __post_init__(self) -> None:
        config = self.problem.config
        limit = config.optimizer.clamp_gradient
        self.policy = NonFinitePolicy(config.run.on_nonfinite)
        self.clamp = None if limit is None else GradientClamp(limit)

    def capture(self) -> Snapshot:
        """The state as it is now; costs nothing, since no iteration changes the arrays of one before it."""
        problem = self.problem
        optimizer = problem.optimizer
        arrays = {f"optimizer/{name}": value for name, value in optimizer.state().items() if dr.is_array_v(value)}
        counts: dict[str, int] = {}
        if self.clamp is not None:
            counts, sums = self.clamp.state()
            arrays |= {f"clamp/{name}": value for name, value in sums.items()}
        variables = [optimizer.variable(key) for key in optimizer.keys()]  # noqa: SIM118 (not a mapping)
        units = {
            key: [variable.length, variable.gain]
            for key, variable in zip(optimizer.keys(), variables, strict=True)
            if f"optimizer/{key}/variable" in arrays
        }
        guiding = guiding_of(problem)
        gradients, heard = ({}, {}) if guiding is None else guiding.state()
        arrays |= {f"guiding/{name}": value for name, value in heard.items()}
        measured = problem.sensitivities if self.scaled else None
        values = {
            "elapsed_s": self.clock.elapsed_s,
            "peak_mib": self.peak_mib,
            "standstill": self.policy.standstill,
            "clamp": counts,
            "units": units,
            "scaling": None if measured is None else [row.to_json() for row in measured],
        }
        if guiding is not None:
            values["guiding"] = gradients
        moved = {key: dr.detach(optimizer[key]) for key in optimizer.keys()}  # noqa: SIM118 (not a mapping)
        return Snapshot(self.iteration, moved, arrays, values)

    def restore(self, stored: Stored) -> None:
        """Go on from what a snapshot of the same experiment left. Raises ConfigError where `stored` holds another."""
        problem, optimizer = self.problem, self.problem.optimizer
        values = {key: stored.scene_value(problem, "parameter", key) for key in problem.selection.keys}
        units = {key: stored.pair("units", key) for key in stored.keys_of("units", values)}
        for key in values:
            if optimizer.is_moved_apart(key) and key not in units:
                raise stored.wrong(f"units.{key}", "is missing")
        optimizer.restore(values, units, lambda name, like: stored.take(f"optimizer/{name}", like))
        counts = {key: stored.count("clamp", key) for key in stored.keys_of("clamp", values)}
        if self.clamp is not None:
            self.clamp.restore(counts, values, lambda name, like: stored.take(f"clamp/{name}", like))
        self.iteration = stored.count("iteration", least=0)
        self.clock.elapsed_s, self.peak_mib = stored.number("elapsed_s"), stored.number("peak_mib")
        self.policy.standstill = stored.count("standstill", least=0)
        guiding = guiding_of(problem)
        if guiding is not None:
            _restore_guiding(problem, guiding, stored)
        rows = stored.scaling(list(values))
        problem.sensitivities = None if rows is None else [Scaled(**row) for row in rows]
        self.scaled = rows is not None
        problem.apply()


def guiding_of(problem: Problem) -> Guiding | None:
    """What the run's integrator has learned of where light paths are to start; None where it does not."""
    return problem.integrator.preparation.guiding if isinstance(problem.integrator, Reslrb) else None


def restore_tables(
    problem: Problem, guiding: Guiding, calls: Mapping[str, int], take: Callable[[str], Array]
) -> str | None:
    """Have the tables of the run's integrator go on from what is stored, as `Guiding.restore` does."""
    problem.integrator.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]])  # makes the grid
    return guiding.restore(calls, take)


def _restore_guiding(problem: Problem, guiding: Guiding, stored: Stored) -> None:
    names = [str(number) for number in range(len(problem.scene.sensors()))]
    gradients = stored.value("guiding")
    if not isinstance(gradients, dict) or not all(name in names for name in gradients):
        raise stored.wrong("guiding", "does not have the gradients of sensors by their numbers")
    counts = {name: stored.count("guiding", name, least=0) for name in gradients}
    wrong = restore_tables(problem, guiding, counts, lambda name: stored.archive.array(f"guiding/{name}", kind="f"))
    if wrong is not None:
        raise stored.wrong(f"guiding/{wrong}", "is not what was learned of this scene")


@dataclass(frozen=True)
class Snapshot:
    """A state at one moment: iterations done, the scene's values and other arrays by name, and plain values."""

    iteration: int
    moved: dict[str, Any]
    arrays: dict[str, Any]
    values: dict[str, Any]

    def parameters(self, problem: Problem) -> dict[str, Array]:
        """The parameters' values, as `problem.values()` has them."""
        return {key: problem.selection.shown(key, value) for key, value in self.moved.items()}

    def others(self, problem: Problem) -> dict[str, Array]:
        """All other arrays, those of `parameters` left out."""
        found = {name: to_array(value) for name, value in self.arrays.items()}
        for key, value in self.moved.items():
            stored = stored_value(problem, "parameter", key, value)
            found |= {name: array for name, array in stored.items() if name != f"parameter/{key}"}
        return found
