"""Pieces of HTML. What comes from outside is escaped here, and nowhere else: `text`, `breakable` and the rest yield
markup, and take plain text where their arguments are not called `markup`."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence

from reslrb_cli.report.page.style import STYLE

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
