"""What can be said of a final value, by rules on what was measured. Nothing here knows of scenes.

The first rule that holds of an entry decides; `spread` is the standard deviation of its final value about the optimum,
`alone` the same with all other parameters known, `to_go` the estimated way to the optimum, and tau `TOLERANCE` of the
entry's scale. All but `spread` are of the optimum of the loss with the target as it is, noise and all.

| verdict          | holds where |
|---|---|
| `not seen`       | it is a texel that no view shows, whatever light by way of it reaches the images |
| `no effect`      | every gradient sample was exactly 0 |
| `at its bound`   | the value is within a step of a bound, and the gradient does not pull it back |
| `settled`        | spread <= tau |
| `still moving`   | `to_go` is told from its error (`SURE` of them), and spread > tau without the target's noise |
| `not determined` | `alone` <= `OTHERS` of `spread`: others make up for it; the most correlated one is named |
| `below the noise`| otherwise: the gradients do not tell within tau where the value should be |

A parameter of several entries is what `SETTLED_SHARE` of those that are seen and have an effect are, if that is
`settled`; otherwise what most of the others are.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

#: A value that is known to this share of its scale is settled.
TOLERANCE = 0.1
#: A way to go of so many standard errors is no accident; and so are gradients.
SURE = 2.0
#: Where the others are known, what is left of the spread of a value that they make up for.
OTHERS = 0.5
#: A value within this share of its scale of a bound is at it, however small the steps are.
AT_BOUND = 1e-3
#: Steps that a value at its bound may have been driven off it by noise.
STEPS_OFF = 3.0
#: Of the entries that have an effect, so many have to be settled.
SETTLED_SHARE = 0.8


class Verdict(str, enum.Enum):
    """What is known of a final value; of equally many entries the first one here names the parameter."""

    STILL_MOVING = "still moving"
    AT_BOUND = "at its bound"
    NOT_DETERMINED = "not determined"
    BELOW_NOISE = "below the noise"
    NO_EFFECT = "no effect"
    NOT_SEEN = "not seen"
    SETTLED = "settled"


@dataclass(frozen=True)
class Evidence:
    """What was measured of the entries of a parameter: arrays (N,), in its unit but for gradients, loss per unit.

    `touched` says whether any gradient sample was not 0, `gradient` and `error` are their mean and its standard error,
    `step` how far noise moved the entry in the last iteration; `of_run` is the spread without the target's noise. `low`
    and `high` may be infinite.
    """

    value: Array
    low: Array
    high: Array
    scale: Array
    touched: Array
    gradient: Array
    error: Array
    step: Array
    spread: Array
    of_run: Array
    alone: Array
    to_go: Array
    to_go_error: Array


def at_bound(value: Array, low: Array, high: Array, scale: Array, gradient: Array, error: Array, step: Array) -> Array:
    """Which entries stand at a bound; the arguments are those of `Evidence`.

    The gradient of the loss points upwards: at the lower bound one above 0 holds the value there.
    """
    near = np.maximum(AT_BOUND * scale, STEPS_OFF * step)
    back = SURE * error
    lower = (value - low <= near) & (gradient >= np.where(value <= low, -back, back))
    upper = (high - value <= near) & (gradient <= np.where(value >= high, back, -back))
    result: Array = lower | upper
    return result


def judge(e: Evidence) -> list[Verdict]:
    """The verdict of each entry."""
    tolerance = TOLERANCE * e.scale
    bound = at_bound(e.value, e.low, e.high, e.scale, e.gradient, e.error, e.step)
    rules = [
        (~e.touched, Verdict.NO_EFFECT),
        (bound, Verdict.AT_BOUND),
        (e.spread <= tolerance, Verdict.SETTLED),
        ((np.abs(e.to_go) > SURE * e.to_go_error) & (e.of_run > tolerance), Verdict.STILL_MOVING),
        (e.alone <= OTHERS * e.spread, Verdict.NOT_DETERMINED),
        (np.ones(e.value.shape, dtype=bool), Verdict.BELOW_NOISE),
    ]
    first = np.argmax([holds for holds, _ in rules], axis=0)
    return [rules[place][1] for place in first]


def shares(verdicts: Sequence[Verdict]) -> dict[Verdict, float]:
    """The share of the entries that each verdict has, of those that occur."""
    return {verdict: verdicts.count(verdict) / len(verdicts) for verdict in Verdict if verdict in verdicts}


def summarise(found: Mapping[Verdict, float]) -> Verdict:
    """The verdict of a parameter whose entries have these shares."""
    without = (Verdict.NO_EFFECT, Verdict.NOT_SEEN)
    effective = {verdict: share for verdict, share in found.items() if verdict not in without}
    if not effective:
        return max(without, key=lambda verdict: found.get(verdict, 0.0))
    if effective.get(Verdict.SETTLED, 0.0) >= SETTLED_SHARE * sum(effective.values()):
        return Verdict.SETTLED
    others = [verdict for verdict in Verdict if verdict not in (Verdict.SETTLED, *without)]
    return max(others, key=lambda verdict: found.get(verdict, 0.0))
