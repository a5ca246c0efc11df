"""Curves in the diagrams of pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

#: Colours that are easy to distinguish on light and dark pages. Further curves repeat them with dashes.
COLORS = ("#3b7ddd", "#e07b39", "#2f9e62", "#d0517e", "#8b6fd6", "#b08900", "#1f9eb3", "#9c6b4f")

#: Maximum number of points of a curve. In a longer curve, each point is the mean of several.
MOST_POINTS = 600

#: An axis is logarithmic if its values span more than the first factor, and has minor tick labels up to the second.
LEAST_LOG, MOST_LABELLED = 5.0, 300.0


@dataclass(frozen=True)
class Curve:
    """Curve of points (x, y). Points that are None or not finite are left out.

    `place` selects the colour and the dashes. `band` holds the ends of each point's interval, if any. `points` adds
    markers.
    """

    name: str
    xs: Sequence[float | None]
    ys: Sequence[float | None]
    place: int = 0
    band: tuple[Sequence[float | None], Sequence[float | None]] | None = None
    points: bool = False

    def known(self) -> Array:
        """Return the points as (N, 2)."""
        array = np.array([self.xs, self.ys], dtype=np.float64).T  # None is NaN
        return array[np.isfinite(array).all(axis=1)]


def draw(axis: Any, curves: Sequence[Curve], log_x: float | None = None) -> None:
    """Draw curves, each with at least one point.

    The y axis is logarithmic if positive values span a large factor. The x axis is logarithmic with base `log_x` if
    `log_x` is given and all values are positive.
    """
    for curve in curves:
        _draw(axis, curve)
    values = np.concatenate([curve.known() for curve in curves])
    low, high = values.min(axis=0), values.max(axis=0)
    if low[1] > 0 and high[1] > LEAST_LOG * low[1]:
        axis.set_yscale("log")
        _mark_decades(axis.yaxis, high[1] / low[1])
    if log_x is not None and low[0] > 0 and high[0] > low[0]:
        axis.set_xscale("log", base=log_x)
        if log_x == 2:
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set_xticks(sorted(set(values[:, 0])))
        else:
            _mark_decades(axis.xaxis, high[0] / low[0])


def points_together(count: int) -> int:
    """Return how many of `count` points are averaged into one drawn point."""
    return -(-count // MOST_POINTS)


def _draw(axis: Any, curve: Curve) -> None:
    points = curve.known()
    xs, ys = _thinned(points, points_together(len(points)))
    marker = "o" if curve.points or len(xs) == 1 else ""
    again, place = divmod(curve.place, len(COLORS))
    style = "--" if again else "-"
    axis.plot(xs, ys, linewidth=1.5, color=COLORS[place], marker=marker, markersize=4, linestyle=style,
              label=curve.name)  # fmt: skip
    if curve.band is not None:
        band = (np.array(end, dtype=np.float64) for end in (curve.xs, *curve.band))  # None is NaN
        axis.fill_between(*band, color=COLORS[place], alpha=0.18, linewidth=0)


def _mark_decades(axis: Any, span: float) -> None:
    """Label a logarithmic axis with plain text, which is much faster than formulas."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(plain)
    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axis.set_minor_formatter(plain if span < MOST_LABELLED else NullFormatter())


def _thinned(points: Array, together: int) -> tuple[Any, Any]:
    """Return the means of groups of `together` points. The last group has the remaining points."""
    starts = np.arange(0, len(points), together)
    sums = np.add.reduceat(points, starts, axis=0)
    counts = np.diff([*starts, len(points)])
    xs, ys = (sums / counts[:, None]).T
    return xs, ys
