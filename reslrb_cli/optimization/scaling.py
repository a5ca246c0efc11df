"""Units in which one learning rate serves parameters of any sensitivity (`scale: auto`).

Step lengths from `Sensitivity.length` make all parameters equally fast, and dividing gradients by the root mean square
of a sample keeps an absolute epsilon, as Adam has it, out of the matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from reslrb_cli.optimization.sensitivity import Sensitivity, measure_sensitivities, rms
from reslrb_cli.optimization.transforms import Bounds, Transform, Variable

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

#: Gradient samples that a run takes.
SAMPLES = 4
#: What the optimiser moves in place of a parameter x, by transform.
_MOVED = {
    "none": "",
    "log": " in its logarithm",
    "sigmoid": " in its logit between the bounds",
    "softplus": " in log(exp(x) - 1)",
}


@dataclass(frozen=True)
class Scaled(Sensitivity):
    """What was measured of a parameter, and what was made of it.

    `own_length` is `length` in what the optimiser moves, its variable, and `first_step`, in the scene's units, how far
    one learning rate of that moves the value where it starts; both are None where the parameter was not scaled.
    """

    own_length: float | None = None
    first_step: float | None = None


def rescale(problem: Problem) -> list[Scaled]:
    """Measure, and let the optimiser move each parameter in units of what was found; return that.

    A parameter without an effect on the image stays as it is.
    """
    optimizer = problem.optimizer
    measured = [Scaled(**row.to_json()) for row in measure_sensitivities(problem, SAMPLES)]
    for place, row in enumerate(measured):
        size = math.hypot(row.gradient, row.noise)  # of what one step hands the optimiser
        if row.length is None or size == 0:
            continue
        variable, value = optimizer.variable(row.key), dr.detach(optimizer[row.key])
        length = own_length(variable.transform, variable.bounds, value, row.length)
        unit = Variable(variable.transform, variable.bounds, length)
        slope = np.array(unit.chain(unit.from_scene(value), type(value)(size)), dtype=np.float64)
        unit.gain = 1 / rms(slope)
        optimizer.set_variable(row.key, unit)
        rate = problem.selection.spec(row.key).learning_rate or problem.config.optimizer.learning_rate
        measured[place] = replace(row, own_length=length, first_step=_first_step(unit, value, rate))
    problem.apply()
    return measured


def _first_step(unit: Variable, value: Any, rate: float) -> float:
    """How far a step of `rate` moves the scene's `value`, upwards or downwards, whichever is farther."""
    v = unit.from_scene(value)
    up, down = (dr.abs(unit.to_scene(v + side * rate) - value) for side in (1, -1))
    return rms(np.array(dr.maximum(up, down)))


def own_length(transform: Transform | None, bounds: Bounds, value: Any, length: float) -> float:
    """What `length`, of the scene's `value`, is in the optimiser's variable: a mean over the entries."""
    if transform is None:
        return length
    low, high = bounds or (-math.inf, math.inf)
    if math.isfinite(low) and math.isfinite(high):  # half way to the farther bound, at most
        room = dr.select(value < 0.5 * (low + high), high - value, low - value)
        moved = value + dr.clip(room, -2 * length, 2 * length) / 2
    else:
        moved = value + length
    distance = np.array(dr.abs(transform.inverse(moved) - transform.inverse(value)), dtype=np.float64)
    return float(distance.mean())


def step_line(row: Scaled, transform: str, learning_rate: float) -> str:
    """What the user is told of one parameter; `transform` and `learning_rate` are those of its configuration.

    A step is in units of what the optimiser moves; what that is of the parameter itself is told for the first one.
    """
    if row.own_length is None:
        lacks = "no effect on the image" if row.length is None else "no gradient"
        return f"{row.key} has {lacks} where it starts; it is not scaled"
    first = f"about {row.first_step or 0.0:.3g}"
    if transform == "log":
        first = f"a factor of {math.exp(min(row.own_length * learning_rate, 700.0)):.3g}, up or down"
    steps = f"{row.own_length:.3g} times the learning rate{_MOVED[transform]}"
    return f"{row.key} moves in steps of {steps}, at first by {first}"
