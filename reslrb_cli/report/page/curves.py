"""Curves of a run against iterations and time, as SVG in the page's own colours."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.report.page.markup import breakable, text

#: Curves in one diagram, at most: those of the parameters that are the farthest off at the end.
MOST_CURVES = 8
#: Points of a curve, at most; of a longer run each is the mean of some iterations.
MOST_POINTS = 600
#: An axis is logarithmic where its values span more than this factor, and has ticks between its decades up to that one.
LEAST_LOG, MOST_LABELLED = 5.0, 300.0
#: Colours that can be told apart, on light and on dark.
COLORS = ("#3b7ddd", "#e07b39", "#2f9e62", "#d0517e", "#8b6fd6", "#b08900", "#1f9eb3", "#9c6b4f")
ABSCISSAE = (("iteration", "iteration"), ("elapsed_s", "time in steps and updates (s)"))
#: What matplotlib is told to draw text and lines in, and is then replaced by the page's own colour.
_INK = "#010203"
_STYLE = {
    "svg.fonttype": "none", "svg.hashsalt": "reslrb", "font.size": 10, "axes.linewidth": 0.6,
    "text.color": _INK, "axes.edgecolor": _INK, "axes.labelcolor": _INK, "xtick.color": _INK, "ytick.color": _INK,
    "grid.color": _INK, "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none",
}  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """One quantity over the iterations; None where it is not known."""

    name: str
    values: list[float | None]
    color: str


def convergence(records: Sequence[Mapping[str, Any]], scales: Mapping[str, float | None], relative: bool) -> str:
    """Loss, and errors by parameter where they are known, against iterations and against time.

    `records` are the lines of `metrics.jsonl`; errors are divided by `scales` where they are to be `relative`.
    """
    if not records:
        return "<p>No iteration was completed.</p>"
    loss = Curve("loss", [record.get("loss") for record in records], COLORS[0])
    errors = _errors(records, scales if relative else {})
    if relative:
        errors = [curve for curve in errors if scales.get(curve.name)]
    what = "relative error" if relative else "RMSE"
    left_out = len(errors) - MOST_CURVES
    errors = errors[:MOST_CURVES]
    parts = [_diagrams(records, [loss], "loss"), _diagrams(records, errors, f"{what} by parameter"), _legend(errors)]
    if left_out > 0:
        parts.append(f'<p class="soft small">The {MOST_CURVES} parameters that are the farthest off at the end; '
                     f"{left_out} more are not drawn.</p>")  # fmt: skip
    count = _points_together(len(records))
    if count > 1:
        parts.append(f'<p class="soft small">Each point is the mean of {count} iterations.</p>')
    return "".join(parts)


def _errors(records: Sequence[Mapping[str, Any]], scales: Mapping[str, float | None]) -> list[Curve]:
    """The errors of each parameter, over its scale where it has one, the largest at the end first."""
    last = records[-1].get("parameter_errors") or {}
    ends = {key: error / (scales.get(key) or 1.0) for key, error in last.items() if error is not None}
    keys = sorted(ends, key=lambda key: -ends[key])
    curves = []
    for place, key in enumerate(keys):
        values = [(record.get("parameter_errors") or {}).get(key) for record in records]
        scale = scales.get(key) or 1.0
        scaled = [None if value is None else value / scale for value in values]
        curves.append(Curve(key, scaled, COLORS[place % len(COLORS)]))
    return curves


def _diagrams(records: Sequence[Mapping[str, Any]], curves: Sequence[Curve], label: str) -> str:
    """The same curves in two diagrams beside each other, against iterations and against time."""
    known = [curve for curve in curves if any(value is not None for value in curve.values)]
    if not known:
        return ""
    drawn = [_diagram([record[name] for record in records], caption, known, label) for name, caption in ABSCISSAE]
    return f'<div class="curves">{"".join(drawn)}</div>'


def _diagram(abscissa: Sequence[float], caption: str, curves: Sequence[Curve], label: str) -> str:
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        # A figure and canvas of our own: pyplot would pick a backend for the whole process.
        figure = Figure(figsize=(5.2, 2.9), layout="constrained")
        FigureCanvasSVG(figure)
        axis = figure.subplots()
        low, high = math.inf, -math.inf
        for curve in curves:
            points = [(x, y) for x, y in zip(abscissa, curve.values, strict=True) if y is not None]
            xs, ys = _thinned(np.array(points, dtype=np.float64), _points_together(len(abscissa)))
            low, high = min(low, float(ys.min())), max(high, float(ys.max()))
            axis.plot(xs, ys, linewidth=1.5, color=curve.color, marker="o" if len(xs) == 1 else "")
        if low > 0 and high > LEAST_LOG * low:
            _scale_by_decades(axis, high / low)
        axis.set_xlabel(caption)
        axis.set_ylabel(label)
        axis.grid(True, which="both", axis="y", alpha=0.16, linewidth=0.6)
        axis.grid(True, axis="x", alpha=0.16, linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    drawing = buffer.getvalue()
    drawing = drawing[drawing.index("<svg") :].replace(_INK, "currentColor")
    return drawing.replace("<svg ", f'<svg role="img" aria-label="{text(f"{label} against {caption}")}" ', 1)


def _scale_by_decades(axis: Any, span: float) -> None:
    """A logarithmic y axis whose ticks are plain text, which takes a fraction of the time of formulas."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(plain)
    axis.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axis.yaxis.set_minor_formatter(plain if span < MOST_LABELLED else NullFormatter())


def _points_together(count: int) -> int:
    """How many iterations make one point of a curve."""
    return -(-count // MOST_POINTS)


def _thinned(points: np.ndarray[Any, Any], together: int) -> tuple[Any, Any]:
    """Means of so many points each; the last is of what is left."""
    starts = np.arange(0, len(points), together)
    sums = np.add.reduceat(points, starts, axis=0)
    counts = np.diff([*starts, len(points)])
    xs, ys = (sums / counts[:, None]).T
    return xs, ys


def _legend(curves: Sequence[Curve]) -> str:
    rows = "".join(f'<li><i style="border-color:{curve.color}"></i>{breakable(curve.name)}</li>' for curve in curves)
    return f'<ul class="legend">{rows}</ul>' if rows else ""
