"""Faults of guided emission. A function patches each fault into the code."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.guiding.collect import collect
from reslrb_cli.guiding.tables import Purpose
from reslrb_cli.integrators import reslrb
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.transport import samples as drawing


def hole(patch: pytest.MonkeyPatch) -> None:
    """The hundredth of cells with the most slots is never sampled. The cell with the fewest slots gets their slots."""
    from reslrb_cli.guiding import tables

    whole = tables.apportion

    def holed(grid: Any, density: np.ndarray) -> np.ndarray:
        counts = whole(grid, density)
        order = np.argsort(-counts, kind="stable")
        lost = order[: len(order) // 100]
        counts[order[-1]] += counts[lost].sum()
        counts[lost] = 0
        return counts

    patch.setattr(tables, "apportion", holed)


def without_weight(patch: pytest.MonkeyPatch) -> None:
    """The weight does not include the density."""
    _weigh(patch, lambda grid, counts, weights: weights * 0 + 1)


def not_normalised(patch: pytest.MonkeyPatch) -> None:
    """The weight belongs to the density before a quarter is distributed evenly."""
    _weigh(patch, lambda grid, counts, weights: 0.75 / np.maximum(1 / weights - 0.25, 0.01))


def of_the_neighbour(patch: pytest.MonkeyPatch) -> None:
    """The weight belongs to another cell."""
    _weigh(patch, lambda grid, counts, weights: np.roll(weights, 1))


def _weigh(patch: pytest.MonkeyPatch, change: Any) -> None:
    right = drawing.Table.of

    def wrong(grid: Any, counts: np.ndarray, *aim: Any) -> Any:
        table = right(grid, counts, *aim)
        weights = change(grid, counts, np.array(table.weights, np.float64))
        return replace(table, weights=mi.Float(weights.astype(np.float32)))

    patch.setattr(drawing.Table, "of", staticmethod(wrong))


def half_of_the_strata(patch: pytest.MonkeyPatch) -> None:
    """The lanes share the slots as if there were twice as many lanes."""
    right = drawing.Guide.of
    patch.setattr(drawing.Guide, "of", staticmethod(lambda table, width: right(table, 2 * width)))


def of_another_emitter(patch: pytest.MonkeyPatch) -> None:
    """The number that selects the emitter lies in an interval for emitters with other shares."""
    right = drawing.Table.of

    def wrong(grid: Any, counts: np.ndarray, *aim: Any) -> Any:
        table = right(grid, counts, *aim)
        return replace(table, edges=mi.Float(np.sqrt(np.array(table.edges))))

    patch.setattr(drawing.Table, "of", staticmethod(wrong))


def in_one_corner(patch: pytest.MonkeyPatch) -> None:
    """The numbers of the direction are squared, so that numbers within a cell are not uniform."""
    _redraw(patch, lambda drawn: replace(drawn, direction=drawn.direction * drawn.direction))


def with_its_own_weight(patch: pytest.MonkeyPatch) -> None:
    """The weight depends on the path's own numbers, as if the path had contributed to its table. Such a table samples
    expensive paths more often.
    """
    _redraw(patch, lambda drawn: replace(drawn, weight=drawn.weight * dr.minimum(1, 0.5 + drawn.direction.x)))


def _redraw(patch: pytest.MonkeyPatch, change: Any) -> None:
    right = drawing.Guide.draw
    patch.setattr(drawing.Guide, "draw", lambda self, *given: change(right(self, *given)))


def same_numbers(patch: pytest.MonkeyPatch) -> None:
    """The tables learn from the same random numbers that the step uses."""
    patch.setattr(reslrb, "learning_seed", lambda seed: seed)


def learned_in_its_midst(patch: pytest.MonkeyPatch) -> None:
    """The tables learn from an image's samples before these samples are replayed. The replay therefore uses another
    table.
    """
    right = Reslrb._differentiate

    def wrong(self: Reslrb, parts: Any, gradient: Any, params: Any, state: Any = None) -> None:
        tables = self.preparation.guiding
        assert tables is not None
        [samples] = parts
        with dr.suspend_grad():
            tables.learn(0, samples.width, collect(samples, gradient))
        again = replace(samples, guide=replace(samples.guide, table=tables.table(0, Purpose.BOTH)))
        right(self, [again], gradient, params, state)

    patch.setattr(Reslrb, "_differentiate", wrong)


#: Faults that bias the result.
FAULTS = (
    hole,
    without_weight,
    not_normalised,
    of_the_neighbour,
    half_of_the_strata,
    of_another_emitter,
    in_one_corner,
    with_its_own_weight,
)
