"""What `convergence --runs` measured: whole optimisations against run time, medians and bands over the seeds."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from reslrb_cli.report.page.drawing import Curve, diagram, diagrams, legend
from reslrb_cli.report.page.markup import breakable, soft, table, text
from reslrb_cli.report.words import duration, number

Entry = Mapping[str, Any]
Naming = Callable[[Entry], str]

#: What is drawn against time: its name in the records, and in words.
_DRAWN = {"loss": "loss", "parameter_error": "parameter error"}


def whole_runs(points: Sequence[Entry], methods: Sequence[Entry], naming: Naming) -> str:
    """A diagram of the loss, one of the parameters' error where that is known, and a table; `naming` names a method."""
    labels = list(dict.fromkeys(map(naming, [*methods, *points])))
    parts = [legend([Curve(title, (), (), place) for place, title in enumerate(labels)])]
    parts.append(diagrams(*(_diagram(points, labels, of, naming) for of in _DRAWN)))
    if points:
        parts.append(soft("Whole optimisations at equal wall time, all costs counted. Medians over the seeds; bands "
                          "and brackets go from the least to the greatest."))  # fmt: skip
    return "".join([*parts, _table(methods, naming)])


def _diagram(points: Sequence[Entry], labels: Sequence[str], of: str, naming: Naming) -> str:
    curves = []
    for place, name in enumerate(labels):
        found: dict[float, list[float]] = {}
        for entry in points:
            if naming(entry) == name and _is_number(entry.get(of)) and _is_number(entry.get("elapsed_s")):
                found.setdefault(float(entry["elapsed_s"]), []).append(float(entry[of]))
        times = sorted(found)
        medians = [statistics.median(found[time]) for time in times]
        band = [min(found[time]) for time in times], [max(found[time]) for time in times]
        curves.append(Curve(name, times, medians, place, band, points=True))
    markup = diagram(curves, "time of a run (s)", _DRAWN[of])
    return f"<div><h3>{text(_DRAWN[of])}</h3>{markup}</div>" if markup else ""


def _table(methods: Sequence[Entry], naming: Naming) -> str:
    rows = []
    for entry in methods:
        name = breakable(naming(entry))
        if entry.get("status", "ok") != "ok":
            name += f' <span class="worse">{text(str(entry["status"]).replace("_", " "))}</span>'
        seconds = entry.get("elapsed_s")
        rows.append([
            name, text(number(entry["runs"])) if _is_number(entry.get("runs")) else "",
            text(duration(float(seconds))) if isinstance(seconds, int | float) else "",
            *(_band(entry.get(what)) for what in ("iterations", "first_s", "loss", "parameter_error")),
        ])  # fmt: skip
    return table(["method", "runs", "time of each", "iterations", "s to the first", "final loss", "final error"], rows,
                 "dense")  # fmt: skip


def _band(value: Any) -> str:
    """A median, and the least and the greatest."""
    if not isinstance(value, Mapping) or not all(_is_number(value.get(end)) for end in ("median", "low", "high")):
        return ""
    ends = ", ".join(number(value[end], 3) for end in ("low", "high"))
    return text(number(value["median"], 3)) + f' <span class="soft small">[{text(ends)}]</span>'


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
