"""Curves in the diagrams of pages and in figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

#: Colours that are easy to distinguish on light and dark pages, also with a colour vision deficiency. Further curves
#: repeat them with dashes.
COLORS = ("#3252cb", "#f48f02", "#107303", "#ee1549", "#0cb9c1", "#bd0865", "#5384ff", "#3e8288")

#: Markers of the points, in the order of the colours. Each has an area, so that hollow points can be told apart.
MARKERS = ("o", "s", "^", "D", "v", ">", "<", "h")

#: Maximum number of points of a curve. In a longer curve, each point is the mean of several.
MOST_POINTS = 600

#: An axis is logarithmic if its values span more than the first factor, and has minor tick labels up to the second.
LEAST_LOG, MOST_LABELLED = 5.0, 300.0


@dataclass(frozen=True)
class Curve:
    """Curve of points (x, y). Points that are None or not finite are left out.

    - `place` selects the colour, the marker and the dashes.
    - `band` holds the ends of each point's interval, if any.
    - `points` adds markers. The markers of `hollow` points are not filled.
    - `beyond` has extrapolated points. A dotted line leads to them from the last point.
    """

    name: str
    xs: Sequence[float | None]
    ys: Sequence[float | None]
    place: int = 0
    band: tuple[Sequence[float | None], Sequence[float | None]] | None = None
    points: bool = False
    hollow: Sequence[bool] = ()
    beyond: Sequence[tuple[float, float]] = ()

    def known(self) -> Array:
        """Return the points as (N, 2)."""
        points = self._all()
        return points[np.isfinite(points).all(axis=1)]

    def filled(self) -> Array:
        """Return whether each known point is filled (N,)."""
        known = np.isfinite(self._all()).all(axis=1)
        return ~np.array(self.hollow, dtype=bool)[known] if len(self.hollow) else np.ones(known.sum(), dtype=bool)

    def _all(self) -> Array:
        return np.array([self.xs, self.ys], dtype=np.float64).T  # None is NaN


@dataclass(frozen=True)
class Panel:
    """Diagram of curves: its title and the labels of its axes.

    The x axis is logarithmic with base `log_x` if `log_x` is given and all values are positive. `floor` is the error of
    the reference, drawn as a horizontal line.
    """

    title: str
    x: str
    y: str
    curves: Sequence[Curve]
    log_x: float | None = None
    floor: float | None = None

    def shown(self) -> list[Curve]:
        """Return the curves with at least one point."""
        return [curve for curve in self.curves if len(curve.known())]


#: Name and line style of the error of a reference. Extrapolations are dotted.
FLOOR, FLOOR_STYLE = "error of the reference", "-."


def draw(axis: Any, panel: Panel, ink: str = "black") -> None:
    """Draw a panel with at least one point. `ink` is the colour of lines that belong to no curve.

    The y axis is logarithmic if positive values span a large factor.
    """
    curves = panel.shown()
    for curve in curves:
        _draw(axis, curve)
    if panel.floor is not None:
        axis.axhline(panel.floor, color=ink, linewidth=1.0, linestyle=FLOOR_STYLE, label=FLOOR)
    values = np.concatenate([part for curve in curves for part in (curve.known(), _beyond(curve))])
    low, high = values.min(axis=0), values.max(axis=0)
    if low[1] > 0 and high[1] > LEAST_LOG * low[1]:
        axis.set_yscale("log")
        _mark_decades(axis.yaxis, high[1] / low[1])
    if panel.log_x is not None and low[0] > 0 and high[0] > low[0]:
        axis.set_xscale("log", base=panel.log_x)
        if panel.log_x == 2:
            axis.xaxis.set_major_formatter("{x:g}")
            axis.set_xticks(sorted(set(values[:, 0])))
        else:
            _mark_decades(axis.xaxis, high[0] / low[0])
    axis.set_xlabel(panel.x)
    axis.set_ylabel(panel.y)
    axis.spines[["top", "right"]].set_visible(False)


def points_together(count: int) -> int:
    """Return how many of `count` points are averaged into one drawn point."""
    return -(-count // MOST_POINTS)


def _beyond(curve: Curve) -> Array:
    return np.array(curve.beyond, dtype=np.float64).reshape(-1, 2)


def _draw(axis: Any, curve: Curve) -> None:
    points = curve.known()
    xs, ys = points.T if curve.points else _thinned(points, points_together(len(points)))
    again, place = divmod(curve.place, len(COLORS))
    color, style = COLORS[place], "--" if again else "-"
    marked = curve.points or len(xs) == 1
    filled = curve.filled() if marked else np.zeros(len(xs), dtype=bool)
    axis.plot(xs, ys, color=color, marker=MARKERS[place] if marked else "", linestyle=style, label=curve.name,
              markevery=filled.tolist() if marked else None)  # fmt: skip
    if marked and not filled.all():
        axis.plot(xs[~filled], ys[~filled], color=color, marker=MARKERS[place], linestyle="", fillstyle="none")
    if curve.band is not None:
        band = (np.array(end, dtype=np.float64) for end in (curve.xs, *curve.band))  # None is NaN
        axis.fill_between(*band, color=color, alpha=0.18, linewidth=0)
    if curve.beyond:
        start = points[curve.filled()] if curve.filled().any() else points
        axis.plot(*np.vstack([start[-1:], _beyond(curve)]).T, color=color, linestyle=":")


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
