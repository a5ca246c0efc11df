"""The parameters of a finished run in a few aligned lines, for a terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

from reslrb_cli.report.certainty import noise_line, spread_words, verdict_words
from reslrb_cli.report.words import count, number, shorten

#: Parameters that are listed; a run with more says so, and its page has them all.
MOST_LISTED = 12
#: A key in the table has at most so many characters, and at least.
WIDEST_KEY, NARROWEST_KEY = 48, 24
#: Columns where there is no terminal.
NO_TERMINAL = 200
#: What stands over the keys, and between two columns.
HEAD, GAP = "parameter", "  "
#: Columns of values: what stands above each, and its name in the results.
MOMENTS = (("start", "initial"), ("end", "final"), ("true", "true"))


def terminal_width() -> int:
    """Columns of standard output; what stands in a file or a pipe may be wider than most terminals."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else NO_TERMINAL


def parameter_lines(results: Mapping[str, Any], width: int) -> list[str]:
    """Values at start and end, true values, errors, spreads and verdicts, in lines of at most `width` characters.

    Textures are told by mean and range. A table where that fits, else a block for each parameter. `results` is what
    `Results.to_json` made.
    """
    parameters = results.get("parameters") or {}
    shown = [key for key, about in parameters.items() if about.get("initial")]
    listed = shown[:MOST_LISTED]
    if not listed:
        return []
    relative = units_differ(results)
    titles = [title for title, moment in MOMENTS if any(parameters[key].get(moment) for key in listed)]
    rows = [[_value(parameters[key].get(moment)) for title, moment in MOMENTS if title in titles] for key in listed]
    errors = {key: error_words(results, key, relative) for key in listed}
    if any(errors.values()):
        titles.append("relative error" if relative else "RMSE")
        rows = [[*row, errors[key]] for row, key in zip(rows, listed, strict=True)]
    verdicts = {key: verdict_words(results, key) for key in listed}
    if any(verdicts.values()):
        titles += ["spread", "verdict"]
        rows = [[*row, spread_words(results, key), verdicts[key]] for row, key in zip(rows, listed, strict=True)]
    lines = _table(listed, titles, rows, width) or _blocks(listed, titles, rows, width)
    if len(shown) > len(listed):
        lines.append(shorten(f"and {count(len(shown) - len(listed), 'more parameter')}, on the page", width))
    return [*lines, *wrap(noise_line(results), width)]


def units_differ(results: Mapping[str, Any]) -> bool:
    """Whether the errors of a run have no common unit, so that they compare as shares of the truth alone."""
    return bool(results.get("parameter_rmse")) and (results.get("rmse") or {}).get("initial") is None


def error_words(results: Mapping[str, Any], key: str, relative: bool) -> str:
    """The error of one parameter at start and end, `0.189 to 0.222`; empty where it is not known."""
    pair = (results.get("relative_error" if relative else "parameter_rmse") or {}).get(key)
    if pair is None or pair.get("initial") is None:
        return ""
    worse = ", worse" if key in (results.get("worse") or ()) else ""
    return f"{number(pair['initial'], 3)} to {number(pair.get('final'), 3)}{worse}"


def _value(about: Mapping[str, Any] | None) -> str:
    """All numbers of a small parameter; mean and range of a large one."""
    if not about:
        return ""
    if "value" in about:
        values = about["value"] if isinstance(about["value"], list) else [about["value"]]
        return " ".join(number(value, 3) for value in values)
    if about["min"] == about["max"]:
        return number(about["min"], 3)
    mean = " ".join(number(value, 3) for value in about["mean"])
    return f"{mean} ({number(about['min'], 3)} to {number(about['max'], 3)})"


def _table(keys: Sequence[str], titles: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """One line a parameter; nothing where that does not fit."""
    widths = [max(len(title), *(len(row[column]) for row in rows)) for column, title in enumerate(titles)]
    left = width - sum(widths) - len(GAP) * len(widths)
    first = min(max(map(len, (HEAD, *keys))), WIDEST_KEY, left)
    if first < min(max(map(len, keys)), NARROWEST_KEY):
        return []
    lines = []
    for key, row in [(HEAD, titles), *zip(keys, rows, strict=True)]:
        cells = [shorten(key, first).ljust(first), *(cell.ljust(size) for cell, size in zip(row, widths, strict=True))]
        lines.append(GAP.join(cells).rstrip())
    return lines


def _blocks(keys: Sequence[str], titles: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """A line for the key, and one for each value; long ones go on below their beginning."""
    lines, indent = [], max(map(len, titles)) + 2 * len(GAP)
    for key, row in zip(keys, rows, strict=True):
        lines.append(shorten(key, width))
        for title, cell in zip(titles, row, strict=True):
            head = f"{GAP}{title}".ljust(indent)
            lines += wrap(cell, max(width, indent + 20), initial_indent=head, subsequent_indent=" " * indent)
    return lines
