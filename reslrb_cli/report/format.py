"""Formatting of numbers, keys and tables for the terminal and the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from reslrb_cli.errors import printable

#: Replaces the middle of a shortened key.
ELLIPSIS = "..."

#: Numbers of at least this size are written with an exponent.
LEAST_WITH_EXPONENT = 1e6

#: Remark on comparisons of camera paths with light paths.
WITHOUT_BORDER = "without the film's border, where light paths lose what camera paths see"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number with `digits` significant digits. Numbers from a million on have an exponent. The result is empty
    for None.
    """
    text = "" if value is None else f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(float(text)) < LEAST_WITH_EXPONENT else text


def with_error(value: float, error: float, sign: str = "+-") -> str:
    """Return a value and its standard error, both rounded to the error's first digit: `0.0131 +- 0.0004`."""
    if not (error > 0 and math.isfinite(error) and math.isfinite(value)):
        return number(value)
    exponent = math.floor(math.log10(max(abs(value), error)))
    scale = 0 if -4 <= exponent < 5 else exponent
    last = math.floor(math.log10(error)) - scale  # the place of the error's first digit
    value, error, decimals = value / 10.0**scale, error / 10.0**scale, max(-last, 0)
    text = f"{value:.{decimals}f} {sign} {error:.{decimals}f}"
    return text if scale == 0 else f"({text})e{scale:+03d}"


#: An uncertainty is rounded to two digits below this number, times a power of ten, and to one digit from it on. This is
#: the rule of the Particle Data Group.
LEAST_WITH_ONE_DIGIT = 3.55


def rounded(value: float, low: float, high: float) -> tuple[str, str, str]:
    """Return a value and the ends of its interval, rounded to the digits that the interval supports, but to at least
    two digits each: `0.583 [0.571, 0.596]` or `420 [150, 1200]`.
    """
    half = (high - low) / 2
    if not 0 < half < math.inf:
        return number(value), number(low), number(high)
    place = math.floor(math.log10(half))
    place -= half < LEAST_WITH_ONE_DIGIT * 10.0**place
    return _at(value, place), _at(low, place), _at(high, place)


def _at(value: float, place: int) -> str:
    """Return a number, rounded at the decimal `place` or at its second digit, whichever is finer."""
    size = math.floor(math.log10(abs(value))) if value else place
    place = min(place, size - 1) if value else place
    if -4 <= size < math.log10(LEAST_WITH_EXPONENT):
        return f"{round(value, -place):.{max(-place, 0)}f}"
    return f"{value:.{size - place}e}"


def interval(value: float, low: float, high: float) -> str:
    """Return a value and its interval, as in `rounded`."""
    first, *ends = rounded(value, low, high)
    return f"{first} [{', '.join(ends)}]"


def count(amount: int, what: str) -> str:
    """Return an amount with its noun, adding `s` for the plural."""
    return f"{amount} {what}" if amount == 1 else f"{amount} {what}s"


def shorten(text: str, width: int) -> str:
    """Return `text` on one line of at most `width` characters. Long text loses its middle, because keys differ at both
    ends.
    """
    text = printable(text)
    if len(text) <= width:
        return text
    kept = width - len(ELLIPSIS)
    if kept < 2:
        return text[: max(width, 0)]
    return text[: kept - kept // 2] + ELLIPSIS + text[-(kept // 2) :]


def line(cells: Sequence[str], widths: Sequence[int], align: str = "<") -> str:
    """Return a line of cells in columns with the given `widths`. The last cells may be missing.

    `align` has one letter per column, `<` for left and `>` for right. The last letter applies to all further columns.
    """
    sides = align.ljust(len(cells), align[-1])
    return "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(cells, sides, widths, strict=False)).rstrip()


@dataclass(frozen=True)
class Columns:
    """Columns of a table that is printed line by line: titles, widths, and `align` as in `line`."""

    titles: Sequence[str]
    widths: Sequence[int]
    align: str

    def head(self) -> str:
        """Return the line of titles."""
        return self.line(self.titles)

    def line(self, cells: Sequence[str]) -> str:
        """Return a line of cells. The last cells may be missing."""
        return line(cells, self.widths, self.align)


def table(rows: Sequence[Sequence[str]], align: str = "<") -> list[str]:
    """Return the lines of a table with columns as wide as their content. `align` is as in `line`."""
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    return [line(row, widths, align) for row in rows]
