"""Layout of a page: pieces made by the templates in `report/templates`, and SVG diagrams in the colours of the page.

The pieces take plain text and numbers. Only the templates escape text; their output is `Markup`.
"""

from __future__ import annotations

import base64
import hashlib
import io
import re
import shlex
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from reslrb_cli.config.files import duration
from reslrb_cli.report.format import count, number, rounded
from reslrb_cli.report.plots import COLORS, Panel, draw

if TYPE_CHECKING:
    from jinja2 import Environment


def key(text: object) -> Markup:
    """Return a key or a path that can wrap after separators such as dots."""
    return lay_out("key", str(text))


def soft(line: str) -> Markup:
    """Return a remark. The result is empty for an empty line."""
    return lay_out("soft", line)


def lay_out(piece: str, *values: object) -> Markup:
    """Render the template macro `piece` with `values`. `FILE.MACRO` names a macro in `FILE.html.j2`, and `MACRO` a
    macro in `pieces.html.j2`.
    """
    file, _, macro = piece.rpartition(".")
    made = getattr(_environment().get_template(f"{file or 'pieces'}.html.j2").module, macro)(*values)
    return Markup(made).strip()


def document(title: str, head: Markup, parts: Iterable[tuple[str, Markup]], refresh_s: int | None = None) -> str:
    """Return a whole page of the sections that are not empty.

    With `refresh_s`, the page reloads itself after this number of seconds. Control characters, which a page must not
    contain, become replacement characters.
    """
    page = _environment().get_template("page.html.j2")
    names = {"title": title, "head": head, "parts": parts, "refresh_s": refresh_s, "script": _script(),
             "policy": Markup(policy())}  # fmt: skip
    text = page.render(names) + "\n"
    return text.translate({ord(c): "\ufffd" for c in set(text) if not c.isprintable() and c not in "\n\t"})


@cache
def policy() -> str:
    """Return the content policy of a page. A page may load only its own content and run only its own script, so that
    markup injected through a name has no effect.
    """
    digest = base64.b64encode(hashlib.sha256(_script().encode()).digest()).decode()
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"


@cache
def _script() -> Markup:
    """Return the script of the page, which compares and enlarges pictures."""
    return Markup((Path(__file__).parents[1] / "templates" / "page.js").read_text(encoding="utf-8"))


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("reslrb_cli.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, auto_reload=False,
    )  # fmt: skip
    made.filters |= {
        "number": number,
        "rounded": lambda figures: rounded(*figures),
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


#: Sizes in inches of a diagram, of the label at its left, and of a letter of its tick labels. They are fixed here,
#: because Matplotlib would draw everything twice to find them.
WIDTH, HEIGHT, LABEL, LETTER = 4.2, 2.6, 0.34, 0.078

#: Colour of text and lines in Matplotlib's output, which is then replaced by the colour of the page.
_INK = "#010203"

_CURVES = {
    "svg.fonttype": "none", "svg.hashsalt": "reslrb", "font.size": 10, "axes.linewidth": 0.6,
    "text.color": _INK, "axes.edgecolor": _INK, "axes.labelcolor": _INK, "xtick.color": _INK, "ytick.color": _INK,
    "grid.color": _INK, "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none",
    "lines.linewidth": 1.5, "lines.markersize": 4, "text.parse_math": False,
}  # fmt: skip


def diagram(panel: Panel) -> Markup:
    """Return a diagram without its title. The result is empty if no curve has a point."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    if not panel.shown():
        return Markup()
    with matplotlib.rc_context(_CURVES):
        # Without pyplot, which would choose a backend for the whole process.
        figure = Figure(figsize=(WIDTH, HEIGHT))
        FigureCanvasSVG(figure)
        axis = figure.subplots()
        draw(axis, panel, _INK)
        axis.grid(True, which="both", axis="y", alpha=0.16, linewidth=0.6)
        axis.grid(True, axis="x", alpha=0.16, linewidth=0.6)
        room = LABEL + LETTER * max(map(len, _labels(axis.yaxis)), default=0)
        figure.subplots_adjust(left=room / WIDTH, right=1 - LETTER / WIDTH, bottom=0.46 / HEIGHT, top=1 - 0.2 / HEIGHT)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    drawing = buffer.getvalue()
    drawing = drawing[drawing.index("<svg") :].replace(_INK, "currentColor")
    about = escape(f"{panel.y} against {panel.x}")
    return Markup(drawing.replace("<svg ", f'<svg role="img" aria-label="{about}" ', 1))


def _labels(axis: Any) -> list[str]:
    """Return the tick labels of an axis."""
    low, high = sorted(axis.get_view_interval())
    found: list[str] = []
    for formatter, places in (
        (axis.get_major_formatter(), axis.get_majorticklocs()),
        (axis.get_minor_formatter(), axis.get_minorticklocs()),
    ):
        found += formatter.format_ticks([place for place in places if low <= place <= high])
    return found
