"""The layout of a page: its pieces, which the templates in `report/templates` make of plain text and numbers.

What comes from outside is escaped by the templates, and nowhere else. `Markup` is what they made.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

if TYPE_CHECKING:
    from jinja2 import Environment

#: Colours that can be told apart, on light and on dark. Further curves have them again, in dashes.
COLORS = ("#3b7ddd", "#e07b39", "#2f9e62", "#d0517e", "#8b6fd6", "#b08900", "#1f9eb3", "#9c6b4f")


@dataclass(frozen=True)
class Piece:
    """Words of a kind: a class of the style sheet, or `key`, `numbers`, `below`, `mark`, `swatch` or `title`."""

    text: Any
    kind: str


#: What a cell, or a caption's line, may be.
Words = str | Piece | Sequence[str | Piece]


def key(text: object) -> Piece:
    """A key or a path, which may be broken after its dots and the like."""
    return Piece(str(text), "key")


def titled(word: str, rest: str) -> Words:
    """A line of a caption that begins with a title."""
    return [Piece(word, "title"), rest]


def table(head: Sequence[str], rows: Sequence[Sequence[Words]], kind: str = "") -> Markup:
    """A table, with a heading for each column; nothing where it has no rows. `kind` is a class."""
    return lay_out("table", head, rows, kind)


def facts(known: Mapping[str, Words]) -> Markup:
    """A table of names and what is known of them; empty ones are left out."""
    return lay_out("facts", known)


def soft(line: str) -> Markup:
    """A remark; nothing where it is empty."""
    return lay_out("soft", line)


def lay_out(piece: str, *values: object) -> Markup:
    """A piece of a page, by the macro of that name in `pieces.html.j2`."""
    return Markup(getattr(_environment().get_template("pieces.html.j2").module, piece)(*values)).strip()


def document(title: str, head: Markup, parts: Iterable[tuple[str, Markup]], refresh_s: int | None = None) -> str:
    """A whole page of sections, without those that are empty; with `refresh_s` it loads itself again after so many
    seconds."""
    page = _environment().get_template("page.html.j2")
    return page.render(title=title, head=head, parts=parts, refresh_s=refresh_s) + "\n"


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("reslrb_cli.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=_printable,
    )  # fmt: skip
    made.filters["breakable"] = lambda text: re.split(r"(?<=[._\-/])", text)
    made.globals["colors"] = COLORS
    return made


def _printable(value: object) -> object:
    """Text without control characters, which a page must not hold: they become replacement characters."""
    if isinstance(value, Markup):
        return value
    return "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in str(value))
