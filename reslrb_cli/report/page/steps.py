"""What an iteration takes, by part, in words and as bars."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from reslrb_cli.report.page.drawing import COLORS, mark
from reslrb_cli.report.page.markup import breakable, text
from reslrb_cli.report.sources import Run
from reslrb_cli.report.words import duration

#: Steps that are left out of medians: the first ones compile kernels.
WARM_UP = 5


@dataclass(frozen=True)
class StepParts:
    """Milliseconds of an iteration: medians without the first ones. Where image and gradient are one kernel, or cannot
    be told apart, `image` and `gradient` are None.

    `update` is what an iteration takes beside its step, on the average; `compile_s` all seconds in which kernels were
    generated and compiled.
    """

    step: float
    image: float | None
    gradient: float | None
    update: float
    compile_s: float

    @classmethod
    def of(cls, records: Sequence[Mapping[str, Any]]) -> StepParts | None:
        """Of a run's records; None where there is none."""
        if not records:
            return None
        steady = records[WARM_UP:] or records
        outside = 1e3 * records[-1]["elapsed_s"] - sum(record["step_ms"] for record in records)
        return cls(
            statistics.median(record["step_ms"] for record in steady),
            _median(steady, "primal_ms"),
            _median(steady, "adjoint_ms"),
            max(outside / len(records), 0.0),
            sum(record["codegen_ms"] for record in records) / 1e3,
        )

    def words(self) -> str:
        """In a line."""
        words = f"{duration(self.step / 1e3)} (median)"
        parts = [
            f"{duration(part / 1e3)} {what}"
            for part, what in ((self.image, "up to image and loss"), (self.gradient, "for the gradient"))
            if part is not None
        ]
        return f"{words}: {', '.join(parts)}" if parts else words


def bars(runs: Sequence[Run]) -> str:
    """An iteration of each run as a bar of its parts, all on one scale; nothing where none has an iteration."""
    known = [(run, parts) for run in runs if (parts := StepParts.of(run.records)) is not None]
    if not known:
        return ""
    names = ("image and loss", "gradient", "whole step, not told apart", "update")
    rows, used = [], set()
    longest = max(sum(_parts(parts).values()) for _, parts in known) or 1.0
    for run, parts in known:
        pieces = _parts(parts)
        used |= {place for place, value in pieces.items() if value > 0}
        drawn = "".join(
            f'<i style="width:{100 * value / longest:.3g}%;background:{COLORS[place]}" '
            f'title="{names[place]}: {text(duration(value / 1e3))}"></i>'
            for place, value in pieces.items()
        )
        total = text(duration(sum(pieces.values()) / 1e3))
        rows.append(
            f'<li>{breakable(run.name)} <span class="soft small">{total}</span><div class="bar">{drawn}</div></li>'
        )
    legend = "".join(f"<li>{mark(place)}{names[place]}</li>" for place in sorted(used))
    return f'<ul class="bars">{"".join(rows)}</ul><ul class="legend">{legend}</ul>'


def _parts(parts: StepParts) -> dict[int, float]:
    """Milliseconds by the place of the part's name."""
    if parts.image is None or parts.gradient is None:
        return {2: parts.step, 3: parts.update}
    return {0: parts.image, 1: parts.gradient, 3: parts.update}


def _median(records: Sequence[Mapping[str, Any]], name: str) -> float | None:
    known = [record[name] for record in records if record.get(name) is not None]
    return statistics.median(known) if known else None
