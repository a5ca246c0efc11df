"""What a parameter must satisfy: finite values, within its bounds."""

from __future__ import annotations

from typing import Any

import drjit as dr


def clamp(value: Any, bounds: tuple[float, float] | None) -> Any:
    """Project `value` onto `bounds` (low, high), after an update. None, or an infinite side, is no bound."""
    return value if bounds is None else dr.clip(value, bounds[0], bounds[1])


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
