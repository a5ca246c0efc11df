"""What a run does about values that are not finite (`run.on_nonfinite`). None of them ever reaches a parameter.

stop    the first iteration that has any ends the run, and updates nothing
skip    a parameter whose gradient has any sits the iteration out; after a loss, or a derivative of the loss, all do
zero    entries of gradients and of the loss's derivative that are not finite count as 0, and the update goes on; a
        parameter of whose gradient nothing is left sits it out, and after a loss all do

A run in which something sits out `PATIENCE` iterations in a row has come to a standstill, and ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import drjit as dr

OnNonFinite = Literal["stop", "skip", "zero"]

#: Iterations in a row in which something sat out, after which a run ends.
PATIENCE = 10


@dataclass
class RefusedAt:
    """Entries of one view's dL/dI that were not finite: how many, and the first, as (x, y, channel)."""

    count: int
    first: tuple[int, int, int]


@dataclass
class Findings:
    """What of one iteration was not finite: its loss, entries of dL/dI by sensor, and entries of gradients and of
    updates by parameter, of those that had any. `lost` are the gradients without one finite entry, `own` the losses
    that the user has written."""

    iteration: int
    loss: bool = False
    refused: dict[int, RefusedAt] = field(default_factory=dict)
    gradients: dict[str, int] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)
    updates: dict[str, int] = field(default_factory=dict)
    own: str = ""

    def __bool__(self) -> bool:
        return bool(self.loss or self.refused or self.gradients or self.updates)

    @property
    def total(self) -> int:
        """All of it, a loss counting as one."""
        return int(self.loss) + sum(at.count for at in self.refused.values()) + sum(self.by_parameter.values())

    @property
    def by_parameter(self) -> dict[str, int]:
        """What belongs to a parameter: its gradient's entries, or its update's."""
        return {**self.gradients, **self.updates}  # what has no finite gradient is not updated

    @property
    def whose_loss(self) -> str:
        """The loss in words, by the user's own name."""
        return f"the loss (your own {self.own})" if self.own else "the loss"

    def __str__(self) -> str:
        parts = [self.whose_loss] if self.loss else []
        for sensor, at in self.refused.items():
            x, y, channel = at.first
            place = f"the first at pixel ({x}, {y}), channel {channel}, of sensor {sensor}"
            parts.append(f"dL/dI in {_entries(at.count)}, {place}")
        parts += [f"the gradient of {key} in {_entries(count)}" for key, count in self.gradients.items()]
        parts += [f"the update of {key} in {_entries(count)}" for key, count in self.updates.items()]
        return f"not finite in iteration {self.iteration}: {'; '.join(parts)}"


def _entries(count: int) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def held_back(kind: OnNonFinite, found: Findings, keys: list[str]) -> list[str]:
    """Of all parameters, `keys`, those that are not to be updated."""
    if found.loss or (found and kind == "stop") or (found.refused and kind == "skip"):
        return keys
    return found.lost if kind == "zero" else list(found.gradients)


def why_end(kind: OnNonFinite, found: Findings, standstill: int) -> str:
    """Why a run is to end after an iteration, the last of `standstill` in a row in which something sat out; "" where it
    goes on."""
    if found and kind == "stop":
        return f"{found}; run.on_nonfinite: stop"
    if standstill < PATIENCE:
        return ""
    where = found.whose_loss if found.loss else "dL/dI" if found.refused else ", ".join(found.by_parameter)
    return (
        f"{where} was not finite in {standstill} iterations in a row (up to iteration {found.iteration}); "
        "no parameter was given such a value; check the scene for extreme values, or lower the learning rate"
    )


def zero_nonfinite(parameter: Any) -> None:
    """Set the entries of a parameter's gradient that are not finite to 0."""
    gradient = dr.grad(parameter)
    dr.set_grad(parameter, dr.select(dr.isfinite(gradient), gradient, 0))


def flat(value: Any) -> Any:
    """All entries of a tensor or a (nested) array in a row."""
    return value.array if dr.is_tensor_v(value) else dr.ravel(value)


def count_nonfinite(value: Any) -> Any:
    """The number of NaN and infinite entries of a tensor or a (nested) array, as a width-1 array."""
    return dr.count(~dr.isfinite(flat(value)))


def finite_square_norm(value: Any) -> Any:
    """The sum of squares of the finite entries, as a width-1 array."""
    entries = flat(value)
    return dr.sum(dr.select(dr.isfinite(entries), dr.square(entries), 0.0))
