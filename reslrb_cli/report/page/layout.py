"""The layout of a page: its pieces, which the templates in `report/templates` make of plain text and numbers, and its
diagrams of curves, as SVG in the page's own colours.

What comes from outside is escaped by the templates, and nowhere else. `Markup` is what they made.
"""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from reslrb_cli.config.files import duration
from reslrb_cli.report.format import count, number
from reslrb_cli.report.plots import COLORS, Curve, draw

if TYPE_CHECKING:
    from jinja2 import Environment


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
        "amount": count,
        "mib": lambda size: f"{number(size / 2**20)} MiB",
        "moment": lambda time: str(time or "").replace("T", " ").replace("+00:00", " UTC"),
        "command": lambda words: shlex.join(map(str, words or ())),
        "versions": lambda known: ", ".join(f"{name} {version}" for name, version in (known or {}).items()),
        "breakable": lambda text: re.split(r"(?<=[._\-/])", text),
    }
    made.globals["colors"] = COLORS
    return made


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

    known = [curve for curve in curves if len(curve.known())]
    if not known:
        return Markup()
    with matplotlib.rc_context(_CURVES):
        # A figure and canvas of our own: pyplot would pick a backend for the whole process.
        figure = Figure(figsize=(WIDTH, HEIGHT))
        FigureCanvasSVG(figure)
        axis = figure.subplots()
        draw(axis, known, log_x)
        for floor in floors:
            axis.axhline(floor, color=_INK, linewidth=1.0, linestyle=":")
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
