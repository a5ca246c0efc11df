"""Numbers, times and keys in words, as the terminal and the page have them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from reslrb_cli.errors import printable

#: What stands in place of the middle of a shortened key.
ELLIPSIS = "..."

#: What is said of a comparison of paths from the camera with paths from the lights.
WITHOUT_BORDER = "without the film's border, where light paths lose what camera paths see"


def number(value: float | None, digits: int = 4) -> str:
    """A number with so many significant digits; empty for None."""
    return "" if value is None else f"{value:.{digits}g}"


def with_error(value: float, error: float, sign: str = "+-") -> str:
    """A value and its standard error, both to the error's first digit: `0.0131 +- 0.0004`."""
    if not (error > 0 and math.isfinite(error) and math.isfinite(value)):
        return number(value)
    exponent = math.floor(math.log10(max(abs(value), error)))
    scale = 0 if -4 <= exponent < 5 else exponent
    last = math.floor(math.log10(error)) - scale  # the place of the error's first digit
    value, error, decimals = value / 10.0**scale, error / 10.0**scale, max(-last, 0)
    text = f"{value:.{decimals}f} {sign} {error:.{decimals}f}"
    return text if scale == 0 else f"({text})e{scale:+03d}"


def interval(value: float, low: float, high: float, digits: int | str) -> str:
    """A value with the ends of its interval; `digits` significant ones, or a format."""
    spec = digits if isinstance(digits, str) else f".{digits}g"
    return f"{value:{spec}} [{low:{spec}}, {high:{spec}}]"


def count(amount: int, what: str) -> str:
    """An amount of things whose plural ends in s."""
    return f"{amount} {what}" if amount == 1 else f"{amount} {what}s"


def shorten(text: str, width: int) -> str:
    """`text` in at most `width` characters, on one line: what is too long loses its middle, since keys differ at both
    ends."""
    text = printable(text)
    if len(text) <= width:
        return text
    kept = width - len(ELLIPSIS)
    if kept < 2:
        return text[: max(width, 0)]
    return text[: kept - kept // 2] + ELLIPSIS + text[-(kept // 2) :]


def line(cells: Sequence[str], widths: Sequence[int], align: str = "<") -> str:
    """Cells that stand below those of other lines, in columns of `widths`; those that are left out are the last.

    `align` has a letter for each column, `<` for flush left, `>` for flush right; its last goes for all that follow.
    """
    sides = align.ljust(len(cells), align[-1])
    return "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(cells, sides, widths, strict=False)).rstrip()


@dataclass(frozen=True)
class Columns:
    """Columns of a table whose lines are told one by one: their titles and widths, and `align` as of `line`."""

    titles: Sequence[str]
    widths: Sequence[int]
    align: str

    def head(self) -> str:
        """The first line."""
        return self.line(self.titles)

    def line(self, cells: Sequence[str]) -> str:
        """The line of these cells; those that are left out are the last."""
        return line(cells, self.widths, self.align)


def table(rows: Sequence[Sequence[str]], align: str = "<") -> list[str]:
    """The lines of a table, whose columns are as wide as what stands in them; `align` is as in `line`."""
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    return [line(row, widths, align) for row in rows]
