"""The layout of a page: its pieces, which the templates in `report/templates` make of plain text and numbers, and its
diagrams of curves, as SVG in the page's own colours.

What comes from outside is escaped by the templates, and nowhere else. `Markup` is what they made.
"""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup, escape

from reslrb_cli.report.format import duration, number

if TYPE_CHECKING:
    from jinja2 import Environment

#: Colours that can be told apart, on light and on dark. Further curves have them again, in dashes.
COLORS = ("#3b7ddd", "#e07b39", "#2f9e62", "#d0517e", "#8b6fd6", "#b08900", "#1f9eb3", "#9c6b4f")


def key(text: object) -> Markup:
    """A key or a path, which may be broken after its dots and the like."""
    return lay_out("key", str(text))


def soft(line: str) -> Markup:
    """A remark; nothing where it is empty."""
    return lay_out("soft", line)


def lay_out(piece: str, *values: object) -> Markup:
    """A piece of a page: `FILE.MACRO` is the macro in the template `FILE.html.j2`, `MACRO` that in `pieces.html.j2`."""
    file, _, macro = piece.rpartition(".")
    made = getattr(_environment().get_template(f"{file or 'pieces'}.html.j2").module, macro)(*values)
    return Markup(made).strip()


def document(title: str, head: Markup, parts: Iterable[tuple[str, Markup]], refresh_s: int | None = None) -> str:
    """A whole page of sections, without those that are empty; with `refresh_s` it loads itself again after so many
    seconds. Control characters, which a page must not hold, become replacement characters."""
    page = _environment().get_template("page.html.j2")
    text = page.render(title=title, head=head, parts=parts, refresh_s=refresh_s) + "\n"
    return text.translate({ord(c): "\ufffd" for c in set(text) if not c.isprintable() and c not in "\n\t"})


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("reslrb_cli.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, auto_reload=False,
    )  # fmt: skip
    made.filters |= {
        "number": number,
        "duration": lambda seconds: "" if seconds is None else duration(seconds),
        "mib": lambda size: f"{number(size / 2**20)} MiB",
        "moment": lambda time: str(time or "").replace("T", " ").replace("+00:00", " UTC"),
        "command": lambda words: shlex.join(map(str, words or ())),
        "versions": lambda known: ", ".join(f"{name} {version}" for name, version in (known or {}).items()),
        "breakable": lambda text: re.split(r"(?<=[._\-/])", text),
    }
    made.globals["colors"] = COLORS
    return made


Array = np.ndarray[Any, Any]

#: Points of a curve, at most; of a longer one each is the mean of some.
MOST_POINTS = 600

#: An axis is logarithmic where its values span more than this factor, and has ticks between its decades up to that one.
LEAST_LOG, MOST_LABELLED = 5.0, 300.0

#: Inches of a diagram; at its left, those of the axis's label and of a letter at its marks. Matplotlib would find out
#: by drawing everything twice.
WIDTH, HEIGHT, LABEL, LETTER = 5.2, 2.9, 0.34, 0.078

#: What matplotlib is told to draw text and lines in, and is then replaced by the page's own colour.
_INK = "#010203"

_CURVES = {
    "svg.fonttype": "none", "svg.hashsalt": "reslrb", "font.size": 10, "axes.linewidth": 0.6,
    "text.color": _INK, "axes.edgecolor": _INK, "axes.labelcolor": _INK, "xtick.color": _INK, "ytick.color": _INK,
    "grid.color": _INK, "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none",
}  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """One curve: points (x, y), those that are None or not finite left out. `place` chooses its colour and its dashes.

    `band` has the ends of each point's interval, where there are such. `points`: each point has a mark.
    """

    name: str
    xs: Sequence[float | None]
    ys: Sequence[float | None]
    place: int = 0
    band: tuple[Sequence[float | None], Sequence[float | None]] | None = None
    points: bool = False

    def known(self) -> Array:
        """Its points as (N, 2)."""
        array = np.array([self.xs, self.ys], dtype=np.float64).T  # None is NaN
        return array[np.isfinite(array).all(axis=1)]


def diagrams(*drawn: tuple[str, Markup]) -> Markup:
    """Diagrams beside each other, each below its title, if it has one; nothing where none of them shows anything."""
    return lay_out("diagrams", drawn)


def diagram(
    curves: Sequence[Curve], caption: str, label: str, log_x: float | None = None, floors: Sequence[float] = ()
) -> Markup:
    """The curves over an axis that `caption` names; nothing where none has a point.

    The y axis is logarithmic where values differ much, the x axis, to the base `log_x`, where that is given and all are
    above 0. `floors` are values that are drawn across, as dashes. Both labels are text of the page's own: matplotlib
    takes $ for a formula.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    known = [(curve, points) for curve in curves if len(points := curve.known())]
    if not known:
        return Markup()
    with matplotlib.rc_context(_CURVES):
        # A figure and canvas of our own: pyplot would pick a backend for the whole process.
        figure = Figure(figsize=(WIDTH, HEIGHT))
        FigureCanvasSVG(figure)
        axis = figure.subplots()
        for curve, points in known:
            _draw(axis, curve, points)
        values = np.concatenate([points for _, points in known])
        low, high = values.min(axis=0), values.max(axis=0)
        for floor in floors:
            axis.axhline(floor, color=_INK, linewidth=1.0, linestyle=":")
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
        axis.set_xlabel(caption)
        axis.set_ylabel(label)
        axis.grid(True, which="both", axis="y", alpha=0.16, linewidth=0.6)
        axis.grid(True, axis="x", alpha=0.16, linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        room = LABEL + LETTER * max(map(len, _labels(axis.yaxis)), default=0)
        figure.subplots_adjust(left=room / WIDTH, right=1 - LETTER / WIDTH, bottom=0.46 / HEIGHT, top=1 - 0.2 / HEIGHT)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    drawing = buffer.getvalue()
    drawing = drawing[drawing.index("<svg") :].replace(_INK, "currentColor")
    about = escape(f"{label} against {caption}")
    return Markup(drawing.replace("<svg ", f'<svg role="img" aria-label="{about}" ', 1))


def legend(names: Sequence[str]) -> Markup:
    """What the colours stand for; without a name, a place is left out."""
    return lay_out("legend", names)


def points_together(count: int) -> int:
    """How many of `count` points make one that is drawn."""
    return -(-count // MOST_POINTS)


def _labels(axis: Any) -> list[str]:
    """What stands at the marks of an axis."""
    low, high = sorted(axis.get_view_interval())
    found: list[str] = []
    for formatter, places in (
        (axis.get_major_formatter(), axis.get_majorticklocs()),
        (axis.get_minor_formatter(), axis.get_minorticklocs()),
    ):
        found += formatter.format_ticks([place for place in places if low <= place <= high])
    return found


def _draw(axis: Any, curve: Curve, points: Array) -> None:
    xs, ys = _thinned(points, points_together(len(points)))
    marker = "o" if curve.points or len(xs) == 1 else ""
    again, place = divmod(curve.place, len(COLORS))
    style = "--" if again else "-"
    axis.plot(xs, ys, linewidth=1.5, color=COLORS[place], marker=marker, markersize=4, linestyle=style)
    if curve.band is not None:
        low, high = ([np.nan if value is None else value for value in end] for end in curve.band)
        places = [np.nan if value is None else value for value in curve.xs]
        axis.fill_between(places, low, high, color=COLORS[place], alpha=0.18, linewidth=0)


def _mark_decades(axis: Any, span: float) -> None:
    """Mark a logarithmic axis in plain text, which takes a fraction of the time of formulas."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(plain)
    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axis.set_minor_formatter(plain if span < MOST_LABELLED else NullFormatter())


def _thinned(points: Array, together: int) -> tuple[Any, Any]:
    """Means of so many points each; the last is of what is left."""
    starts = np.arange(0, len(points), together)
    sums = np.add.reduceat(points, starts, axis=0)
    counts = np.diff([*starts, len(points)])
    xs, ys = (sums / counts[:, None]).T
    return xs, ys
