"""Reaction of a run to values that are not finite (`run.on_nonfinite`). They never reach a parameter.

- `stop`: the first iteration with a non-finite value ends the run, and updates nothing.
- `skip`: a parameter with a non-finite value in its gradient is not updated. If the loss or its derivative has a
    non-finite value, no parameter is updated.
- `zero`: non-finite entries of gradients and of the loss's derivative count as 0, and the update continues. A parameter
    without a finite gradient entry is not updated. If the loss is not finite, no parameter is updated.

The run ends if updates are skipped in `PATIENCE` consecutive iterations.

Images and gradients that only measure something, such as the curvature for `auto`, update no parameter. Their
non-finite entries are left out of the measurement, and counted (`Problem.left_out`). With `stop`, they end the run.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import drjit as dr
import numpy as np

from reslrb_cli.backend.memory import flat
from reslrb_cli.statistics import Array

OnNonFinite = Literal["stop", "skip", "zero"]

#: Consecutive iterations with skipped updates after which a run ends.
PATIENCE = 10


@dataclass
class Findings:
    """Values of one iteration that were not finite.

    Non-finite values can be the iteration's loss, entries of dL/dI for each sensor, or entries of gradients and updates
    for each parameter. `refused` has the number of entries of dL/dI, and the first one as (x, y, channel). `lost` lists
    the parameters whose gradient has no finite entry. `own` names the user's losses. `measured` has the numbers of
    entries that measurements left out, with the name of their image or gradient.
    """

    iteration: int
    loss: bool = False
    refused: dict[int, tuple[int, tuple[int, int, int]]] = field(default_factory=dict)
    gradients: dict[str, int] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)
    updates: dict[str, int] = field(default_factory=dict)
    measured: dict[str, int] = field(default_factory=dict)
    own: str = ""

    def __bool__(self) -> bool:
        return bool(self.loss or self.refused or self.gradients or self.updates or self.measured)

    @property
    def total(self) -> int:
        """Number of all non-finite values. A non-finite loss counts as one value."""
        refused = sum(count for count, _ in self.refused.values())
        return int(self.loss) + refused + sum(self.by_parameter.values()) + sum(self.measured.values())

    @property
    def by_parameter(self) -> dict[str, int]:
        """Number of non-finite entries in gradients and updates, for each parameter."""
        return {**self.gradients, **self.updates}  # entries without a finite gradient are not updated

    @property
    def whose_loss(self) -> str:
        """Description of the loss for messages. For a custom loss, the description includes the user's name for the
        loss.
        """
        return f"the loss (your own {self.own})" if self.own else "the loss"

    def __str__(self) -> str:
        parts = [self.whose_loss] if self.loss else []
        for sensor, (count, (x, y, channel)) in self.refused.items():
            place = f"the first at pixel ({x}, {y}), channel {channel}, of sensor {sensor}"
            parts.append(f"dL/dI in {_entries(count)}, {place}")
        parts += [f"the gradient of {key} in {_entries(count)}" for key, count in self.gradients.items()]
        parts += [f"the update of {key} in {_entries(count)}" for key, count in self.updates.items()]
        parts += [f"{name} in {_entries(count)}" for name, count in self.measured.items()]
        return f"not finite in iteration {self.iteration}: {'; '.join(parts)}"


def _entries(count: int) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def held_back(kind: OnNonFinite, found: Findings, keys: list[str]) -> list[str]:
    """Return the parameters among `keys` that are not updated."""
    if found.loss or (found and kind == "stop") or (found.refused and kind == "skip"):
        return keys
    return found.lost if kind == "zero" else list(found.gradients)


def why_end(kind: OnNonFinite, found: Findings, standstill: int) -> str:
    """Return why a run ends after an iteration, or "" if it continues.

    `standstill` is the number of consecutive iterations with skipped updates.
    """
    if found and kind == "stop":
        return f"{found}; run.on_nonfinite: stop"
    if standstill < PATIENCE:
        return ""
    where = found.whose_loss if found.loss else "dL/dI" if found.refused else ", ".join(found.by_parameter)
    return (
        f"{where} was not finite in {standstill} iterations in a row (up to iteration {found.iteration}); no parameter "
        "received such a value; check the scene for extreme values, or lower the learning rate"
    )


def zero_nonfinite(parameter: Any) -> None:
    """Set the entries of a parameter's gradient that are not finite to 0."""
    gradient = dr.grad(parameter)
    dr.set_grad(parameter, dr.select(dr.isfinite(gradient), gradient, 0))


def count_nonfinite(value: Any) -> Any:
    """Return the number of NaN and infinite entries of a tensor or a (nested) array, as an array of width 1."""
    return dr.count(~dr.isfinite(flat(value)))


def finite(values: Array) -> Array:
    """Return the values, with non-finite values replaced by 0."""
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def fill_gaps(rows: Array) -> Array:
    """Return K samples (K, ...), with each non-finite value replaced by the mean of the finite values of its entry. The
    mean of the samples is then the mean of the finite ones. It is 0 if there are none.
    """
    known = np.isfinite(rows)
    means = np.where(known, rows, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known, rows, means)


def finite_square_norm(value: Any) -> Any:
    """Return the sum of squares of the finite entries, as an array of width 1."""
    entries = flat(value)
    return dr.sum(dr.select(dr.isfinite(entries), dr.square(entries), 0.0))
