"""What of every view counts: its share of the loss, and the pixels that are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from reslrb_cli.optimization.masking import WORDS
from reslrb_cli.report.page.markup import table, text
from reslrb_cli.report.words import number


def view_table(views: Sequence[Mapping[str, Any]] | None) -> str:
    """A row for each view; nothing where there is but one, of which every pixel counts alike."""
    if not views or (len(views) == 1 and not _has_mask(views[0])):
        return ""
    cells = [
        [text(view["sensor"]), text(number(view["share"])), text(_left_out(view)), text("; ".join(_kinds(view)))]
        for view in views
    ]
    return table(("sensor", "share of the loss", "pixels left out", "of which"), cells)


def _has_mask(view: Mapping[str, Any]) -> bool:
    return bool(view["left_out"] or view["kinds"] or view["counted"])


def _left_out(view: Mapping[str, Any]) -> str:
    return f"{view['left_out']} of {view['pixels']}"


def _kinds(view: Mapping[str, Any]) -> list[str]:
    left_out = [f"{count} {WORDS[kind]}" for kind, count in view["kinds"].items()]
    return left_out + [f"{count} {WORDS[kind]} and stay" for kind, count in view["counted"].items()]
