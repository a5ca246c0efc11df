"""What a parameter must satisfy: finite values, within its bounds."""

from __future__ import annotations

from typing import Any

import drjit as dr

from reslrb_cli.errors import NonFinite

#: Consecutive iterations with a non-finite loss or gradient after which a run ends.
PATIENCE = 10


def clamp(value: Any, bounds: tuple[float, float] | None) -> Any:
    """Project `value` onto `bounds` (low, high), after an update. None, or an infinite side, is no bound."""
    return value if bounds is None else dr.clip(value, bounds[0], bounds[1])


def count_nonfinite(value: Any) -> Any:
    """The number of NaN and infinite entries of a tensor or a (nested) array, as a width-1 array."""
    flat = value.array if dr.is_tensor_v(value) else dr.ravel(value)
    return dr.count(~dr.isfinite(flat))


def finite_square_norm(value: Any) -> Any:
    """The sum of squares of the finite entries, as a width-1 array."""
    flat = value.array if dr.is_tensor_v(value) else dr.ravel(value)
    return dr.sum(dr.select(dr.isfinite(flat), dr.square(flat), 0.0))


class NonFiniteWatch:
    """Ends an optimisation that keeps producing non-finite values, since it no longer moves."""

    def __init__(self, patience: int = PATIENCE) -> None:
        self.patience = patience
        self._run = 0

    def see(self, iteration: int, nonfinite: int, where: str) -> None:
        """Note one iteration. Raises NonFinite at the `patience`-th one in a row that had non-finite values."""
        self._run = self._run + 1 if nonfinite else 0
        if self._run >= self.patience:
            raise NonFinite(
                f"{where} was not finite in {self._run} iterations in a row (up to iteration {iteration}); no "
                "parameter was given such a value; check the scene for extreme values, or lower the learning rate"
            )
