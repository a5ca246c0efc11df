"""Pieces of HTML: the page's look, text and tables, and diagrams.

What comes from outside is escaped here, and nowhere else: `text`, `breakable` and the rest yield markup, and take plain
text where their arguments are not called `markup`.

The look (`STYLE`) is for a phone and a wide screen, for light and dark, and for paper. Diagrams of curves are SVG, in
the page's own colours (`diagram`).
"""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


#: A table on a screen that is too narrow for its columns: each row is a block, with a line for each column.
_BLOCKS = """
  .rows, .rows tbody, .rows tr, .rows th, .rows td { display: block; border: 0; padding: 0 }
  .rows thead { display: none }
  .rows tr { border-bottom: 1px solid var(--line); padding: .55rem 0 }
  .rows td { display: grid; grid-template-columns: 7.5rem minmax(0, 1fr); gap: .6rem; padding: .08rem 0 }
  .rows td::before { content: attr(data-label); color: var(--soft); font-size: .85rem }
  .rows td:empty { display: none }
"""


_STYLE = """
:root {
  color-scheme: light dark;
  --page: #fff; --ink: #1c1f23; --soft: #5d6570; --line: #dde1e6; --box: #f5f6f8; --edge: #c9ced6;
  --good: #17703a; --warn: #8a4b00; --warn-box: #fff4e0; --bad: #a3141f; --bad-box: #fdecec; --link: #2458c5;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #15181c; --ink: #e6e8eb; --soft: #a0a8b3; --line: #2d333b; --box: #1d2127; --edge: #444c56;
    --good: #5fd38d; --warn: #ffc368; --warn-box: #33260f; --bad: #ff8f8f; --bad-box: #3a1a1c; --link: #8ab4ff;
  }
}
* { box-sizing: border-box }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100% }
body {
  margin: 0 auto; padding: 1.5rem clamp(.9rem, 3vw, 2.5rem) 3rem; max-width: 78rem;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", "DejaVu Sans", sans-serif;
  color: var(--ink); background: var(--page); overflow-wrap: anywhere;
}
h1 { font-size: 1.65rem; line-height: 1.2; margin: 0 }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .7rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line) }
h3 { font-size: 1rem; margin: 1.4rem 0 .5rem; font-weight: 600 }
p { margin: .4rem 0; max-width: 60rem }
code, pre { font-family: ui-monospace, "SF Mono", Menlo, Consolas, "Liberation Mono", "DejaVu Sans Mono", monospace }
code { font-size: .9em }
pre {
  font-size: .82rem; line-height: 1.45; background: var(--box); padding: .9rem 1rem; border-radius: .5rem; margin: 0;
  white-space: pre-wrap; overflow-wrap: anywhere;
}
.soft { color: var(--soft) } .small { font-size: .875rem } .worse { color: var(--bad); font-weight: 600 }
header { display: flex; flex-wrap: wrap; gap: .4rem .8rem; align-items: baseline }
.status {
  font-size: .85rem; font-weight: 600; padding: .1rem .65rem; border: 1px solid currentColor; border-radius: 1rem;
}
.status.finished { color: var(--good) } .status.failed { color: var(--bad) } .status { color: var(--warn) }
.lead { font-size: 1.05rem }
.note {
  border-left: 4px solid var(--warn); background: var(--warn-box); padding: .5rem .9rem; border-radius: .3rem;
  margin: .8rem 0;
}
.note.failed { border-color: var(--bad); background: var(--bad-box) }
.note p { margin: .15rem 0 }

table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .925rem; max-width: 100% }
th, td { text-align: left; vertical-align: top; padding: .32rem 1.4rem .32rem 0; border-bottom: 1px solid var(--line) }
thead th { color: var(--soft); font-weight: 500; font-size: .85rem }
tbody th { font-weight: 500 }
.rows td, thead th { overflow-wrap: break-word }
.facts th { color: var(--soft); font-weight: 500; white-space: nowrap; overflow-wrap: normal }
.facts td { overflow-wrap: anywhere }
.number { white-space: nowrap }
.dense { font-size: .85rem } .dense th, .dense td { padding-right: .8rem }
.swatch {
  display: inline-block; width: 1.05em; height: 1.05em; border: 1px solid var(--edge); border-radius: .2em;
  vertical-align: -.17em; margin-right: .45em; print-color-adjust: exact; -webkit-print-color-adjust: exact;
}
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(13rem, 1fr)); gap: 1rem 1.1rem }
figure { margin: 0; min-width: 0; break-inside: avoid }
figure img {
  display: block; width: 100%; height: auto; border: 1px solid var(--line); background: #000; border-radius: .25rem;
}
.pixels { image-rendering: pixelated }
figcaption { font-size: .85rem; color: var(--soft); margin-top: .3rem }
figcaption b { color: var(--ink); font-weight: 600 }
.scale { height: .6rem; border-radius: .15rem; margin-top: .35rem; print-color-adjust: exact;
  -webkit-print-color-adjust: exact }
.ends { display: flex; justify-content: space-between }

.curves { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 22rem), 1fr)); gap: .4rem 1.5rem }
.curves > * { max-width: 40rem }
.curves svg { display: block; width: 100%; height: auto }
.curves text { font-family: inherit }
.legend { list-style: none; display: flex; flex-wrap: wrap; gap: .15rem 1.2rem; margin: .2rem 0 .8rem; padding: 0;
  font-size: .875rem }
.mark { display: inline-block; width: 1.4em; height: 0; border-top: 3px solid; vertical-align: .25em;
  margin-right: .45em; print-color-adjust: exact; -webkit-print-color-adjust: exact }
.bars { list-style: none; padding: 0; margin: 0 0 .6rem }
.bar { display: flex; height: 1.1rem; margin: .1rem 0 .5rem; background: var(--box) }
.bar i { display: block; print-color-adjust: exact; -webkit-print-color-adjust: exact }
details { margin: .7rem 0 }
summary { cursor: pointer; font-weight: 600 }
summary + * { margin-top: .5rem }
footer { margin-top: 2.5rem; color: var(--soft); font-size: .85rem }

@media (max-width: 68rem) {
  @DENSE@
}
@media (max-width: 46rem) {
  .figures { grid-template-columns: repeat(2, minmax(0, 1fr)); gap: .8rem }
  @BLOCKS@
  .facts th { white-space: normal; padding-right: .9rem }
  .facts td { padding-right: 0 }
}
@media print {
  :root { --page: #fff; --ink: #000; --soft: #444; --line: #bbb; --box: #fff; --edge: #888; --good: #17703a;
    --warn: #8a4b00; --warn-box: #fff; --bad: #a3141f; --bad-box: #fff }
  body { padding: 0; max-width: none; font-size: 10pt }
  .figures { grid-template-columns: repeat(4, minmax(0, 1fr)) }
  pre { border: 1px solid var(--line) }
  h2, h3 { break-after: avoid }
  tr, .curves > * { break-inside: avoid }
}
"""


STYLE = _STYLE.replace("@BLOCKS@", _BLOCKS).replace("@DENSE@", _BLOCKS.replace(".rows", ".dense"))


#: What the page may load: nothing but what it holds. Were markup to slip in by a name, it could do nothing.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


#: Characters after which a key may go on in the next line.
_BREAKS = "._-/"


def document(title: str, markup: str, refresh_s: int | None = None) -> str:
    """A whole page; with `refresh_s` it loads itself again after so many seconds."""
    again = "" if refresh_s is None else f'<meta http-equiv="refresh" content="{refresh_s}">'
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">{again}'
        f"<title>{text(title)}</title><style>{STYLE}</style></head>\n"
        f"<body>{markup}</body></html>\n"
    )


def text(value: object) -> str:
    """Plain text as markup; control characters, which a page must not hold, as replacement characters."""
    shown = "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in str(value))
    return html.escape(shown)


def breakable(key: object) -> str:
    """A key or a path, which may be broken after its dots and the like."""
    shown = text(key)
    if not shown:
        return ""
    for character in _BREAKS:
        shown = shown.replace(character, f"{character}<wbr>")
    return f"<code>{shown}</code>"


def section(title: str, *markup: str) -> str:
    """A section with a heading; nothing where all of its content is empty."""
    body = "".join(markup)
    return f"<section><h2>{text(title)}</h2>{body}</section>\n" if body else ""


def folded(title: str, *markup: str) -> str:
    """A part that is shown when its title is clicked; nothing where all of its content is empty."""
    body = "".join(markup)
    return f"<details><summary>{text(title)}</summary>{body}</details>\n" if body else ""


def soft(words: str) -> str:
    """A remark in plain text; nothing where it is empty."""
    return f'<p class="soft small">{text(words)}</p>' if words else ""


def table(head: Sequence[str], markup: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table whose cells are markup, with a heading for each column; nothing where it has no rows.

    Each cell also carries its column's heading, for narrow screens, on which a row becomes a block; there a cell lies
    beside its heading as one piece. `kind` is a class.
    """
    rows = [
        "".join(
            f'<td data-label="{text(title)}">{cell and f"<div>{cell}</div>"}</td>'
            if column
            else f'<th scope="row">{cell}</th>'
            for column, (title, cell) in enumerate(zip(head, row, strict=True))
        )
        for row in markup
    ]
    if not rows:
        return ""
    titles = "".join(f'<th scope="col">{text(title)}</th>' for title in head)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f'<table class="rows {text(kind)}"><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table>'


def facts(markup: Mapping[str, str]) -> str:
    """A table of names and what is known of them, as markup; empty ones are left out."""
    rows = "".join(f"<tr><th>{text(name)}</th><td>{value}</td></tr>" for name, value in markup.items() if value)
    return f'<table class="facts">{rows}</table>' if rows else ""


def figure(uri: str, size: tuple[int, int], alt: str, markup: str, smooth: bool) -> str:
    """A picture of `size` (width, height) with its caption, which is markup; not `smooth`, its pixels stay squares."""
    kind = "smooth" if smooth else "pixels"
    return (
        f'<figure><img class="{kind}" src="{html.escape(uri)}" width="{size[0]}" height="{size[1]}" alt="{text(alt)}">'
        f"<figcaption>{markup}</figcaption></figure>"
    )


def figures(markup: Iterable[str]) -> str:
    """Figures beside each other, as many as there is room for."""
    row = "".join(markup)
    return f'<div class="figures">{row}</div>' if row else ""


def note(*markup: str, kind: str = "") -> str:
    """Paragraphs in a box; nothing where there are none."""
    lines = "".join(f"<p>{line}</p>" for line in markup)
    return f'<div class="note {text(kind)}">{lines}</div>' if lines else ""


#: Points of a curve, at most; of a longer one each is the mean of some.
MOST_POINTS = 600


#: An axis is logarithmic where its values span more than this factor, and has ticks between its decades up to that one.
LEAST_LOG, MOST_LABELLED = 5.0, 300.0


#: Colours that can be told apart, on light and on dark. Further curves have them again, in dashes.
COLORS = ("#3b7ddd", "#e07b39", "#2f9e62", "#d0517e", "#8b6fd6", "#b08900", "#1f9eb3", "#9c6b4f")


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

    @property
    def color(self) -> str:
        """As `#rrggbb`."""
        return COLORS[self.place % len(COLORS)]

    @property
    def dashed(self) -> bool:
        """Whether its colour has been used by another one before."""
        return self.place >= len(COLORS)

    def known(self) -> Array:
        """Its points as (N, 2)."""
        array = np.array([self.xs, self.ys], dtype=np.float64).T  # None is NaN
        return array[np.isfinite(array).all(axis=1)]


def diagrams(*markup: str) -> str:
    """Diagrams beside each other, as many as there is room for; nothing where there are none."""
    drawn = "".join(markup)
    return f'<div class="curves">{drawn}</div>' if drawn else ""


def diagram(
    curves: Sequence[Curve], caption: str, label: str, log_x: float | None = None, floors: Sequence[float] = ()
) -> str:
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
        return ""
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
    return drawing.replace("<svg ", f'<svg role="img" aria-label="{text(f"{label} against {caption}")}" ', 1)


def legend(curves: Sequence[Curve]) -> str:
    """What the colours stand for."""
    rows = "".join(f"<li>{mark(curve.place)}{breakable(curve.name)}</li>" for curve in curves)
    return f'<ul class="legend">{rows}</ul>' if rows else ""


def mark(place: int) -> str:
    """A short line in the colour and dashes of a place."""
    dashes = ";border-top-style:dashed" if place >= len(COLORS) else ""
    return f'<i class="mark" style="border-color:{COLORS[place % len(COLORS)]}{dashes}"></i>'


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
    style = "--" if curve.dashed else "-"
    axis.plot(xs, ys, linewidth=1.5, color=curve.color, marker=marker, markersize=4, linestyle=style)
    if curve.band is not None:
        low, high = ([np.nan if value is None else value for value in end] for end in curve.band)
        places = [np.nan if value is None else value for value in curve.xs]
        axis.fill_between(places, low, high, color=curve.color, alpha=0.18, linewidth=0)


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
