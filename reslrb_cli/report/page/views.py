"""What of every view counts: its share of the loss, its exposure, and the pixels that are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from reslrb_cli.optimization.masking import WORDS
from reslrb_cli.report.page.markup import soft, table, text
from reslrb_cli.report.words import number


def view_table(views: Sequence[Mapping[str, Any]] | None, results: Mapping[str, Any]) -> str:
    """A row for each view, and the loss of those that are held out.

    Nothing where there is but one, of which every pixel counts alike as it is.
    """
    if not views or (len(views) == 1 and not _is_special(views[0])):
        return ""
    cells = [
        [
            text(view["sensor"]),
            "held out" if view["held_out"] else text(number(view["share"])),
            text(_exposure(view, results)),
            text(f"{view['left_out']} of {view['pixels']}"),
            text("; ".join(_kinds(view))),
        ]
        for view in views
    ]
    held_out = results.get("held_out") or {}
    losses = " → ".join(number(held_out[moment]) for moment in ("initial", "final") if moment in held_out)
    words = soft(f"Loss of the views that are held out: {losses}.") if losses else ""
    return table(("sensor", "share of the loss", "exposure", "pixels left out", "of which"), cells) + words


def _is_special(view: Mapping[str, Any]) -> bool:
    return bool(view["left_out"] or view["kinds"] or view["counted"] or view["exposure"] != 1)


def _exposure(view: Mapping[str, Any], results: Mapping[str, Any]) -> str:
    """The number, or what was recovered."""
    exposure = view["exposure"]
    if not isinstance(exposure, str):
        return number(exposure)
    final = ((results.get("parameters") or {}).get(exposure) or {}).get("final") or {}
    value = final.get("value")
    values = value if isinstance(value, list) else [value]
    return "recovered" if value is None else f"{', '.join(map(number, values))} (recovered)"


def _kinds(view: Mapping[str, Any]) -> list[str]:
    left_out = [f"{count} {WORDS[kind]}" for kind, count in view["kinds"].items()]
    return left_out + [f"{count} {WORDS[kind]} and stay" for kind, count in view["counted"].items()]
