"""What `convergence` measured: error against run time, by method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from reslrb_cli.report.page.bench import label
from reslrb_cli.report.page.drawing import Curve, diagram, diagrams, legend
from reslrb_cli.report.page.markup import breakable, soft, table, text
from reslrb_cli.report.words import duration, number

Entry = Mapping[str, Any]

#: Quantities that are drawn, at most: all parameters together, the image, then single ones.
MOST_DRAWN = 8
_SHARES = {"0.1": "to 10 %", "0.03": "to 3 %", "0.01": "to 1 %"}


def convergence(objects: Sequence[Entry]) -> tuple[str, int]:
    """A diagram for each quantity, a table of the methods, what was said in words; and how many lines are neither."""
    points = [entry for entry in objects if entry.get("kind") == "point"]
    methods = [entry for entry in objects if entry.get("kind") == "method"]
    said = [entry["line"] for entry in objects if isinstance(entry.get("line"), str)]
    labels = list(dict.fromkeys(map(method_label, [*methods, *points])))
    quantities = list(dict.fromkeys(str(entry.get("parameter") or "all") for entry in [*points, *methods]))
    quantities.sort(key=lambda name: {"all": 0, "image": 1}.get(name, 2))
    drawn = [_diagram(points, labels, quantity) for quantity in quantities[:MOST_DRAWN]]
    parts = [f"<p>{text(line)}</p>" for line in said]
    parts += [legend([Curve(name, (), (), place) for place, name in enumerate(labels)]), diagrams(*drawn)]
    if points:
        parts.append(soft("Dots across: the standard error of the reference itself, below which nothing can be told."))
    if len(quantities) > MOST_DRAWN:
        parts.append(soft(f"{len(quantities) - MOST_DRAWN} more parameters are in the table alone."))
    parts.append(_table(methods, quantities))
    return "".join(parts), len(objects) - len(points) - len(methods) - len(said)


def method_label(entry: Entry) -> str:
    """A method's name: integrator, estimator, and how image and gradient share their samples, where that is said."""
    adjoint = entry.get("adjoint")
    return label(entry) + (f", {adjoint}" if adjoint else "")


def _diagram(points: Sequence[Entry], labels: Sequence[str], quantity: str) -> str:
    of_it = [entry for entry in points if str(entry.get("parameter") or "all") == quantity]
    curves = []
    for place, name in enumerate(labels):
        rows = sorted((entry for entry in of_it if method_label(entry) == name and _time(entry)), key=_time)
        curves.append(Curve(name, [_time(entry) for entry in rows], [entry.get("relative_rmse") for entry in rows],
                            place, points=True))  # fmt: skip
    floors = [value for entry in of_it if isinstance(value := entry.get("reference_rmse"), int | float) and value > 0]
    markup = diagram(curves, "time (s)", "relative error", 10, sorted(floors)[len(floors) // 2 :][:1])
    words = {"all": "all parameters", "image": "the image"}.get(quantity)
    title = text(words) if words else breakable(quantity)
    return f"<div><h3>{title}</h3>{markup}</div>" if markup else ""


def _time(entry: Entry) -> float:
    return float(entry.get("elapsed_s") or 0.0)


def _table(methods: Sequence[Entry], quantities: Sequence[str]) -> str:
    several = len(quantities) > 1
    head = ["method", *["of"] * several, "slope", "efficiency", "bias, z", *_SHARES.values()]
    rows = []
    for entry in sorted(methods, key=lambda entry: quantities.index(str(entry.get("parameter") or "all"))):
        biased = ' <span class="worse">biased</span>' if entry.get("biased") else ""
        of = [breakable(entry.get("parameter") or "all")] * several
        figures = [figure_of(entry.get(name)) for name in ("slope", "efficiency", "bias_z")]
        seconds = entry.get("seconds_to") or {}
        rows.append([breakable(method_label(entry)) + biased, *of, *figures,
                     *(seconds_of(seconds.get(share)) for share in _SHARES)])  # fmt: skip
    return table(head, rows, "dense")


def figure_of(value: Any) -> str:
    """A figure, and its interval where it has one: a number, or `{value, low, high}`."""
    if isinstance(value, Mapping):
        ends = [number(value.get(end), 3) for end in ("low", "high")]
        interval = f' <span class="soft small">[{text(", ".join(ends))}]</span>' if all(ends) else ""
        return text(number(value.get("value"), 3)) + interval
    return text(number(value, 3)) if isinstance(value, int | float) else ""


def seconds_of(value: Any) -> str:
    """A time; one that was extrapolated is marked, one that is never reached is a dash."""
    if isinstance(value, Mapping):
        found = next((value[name] for name in ("value", "seconds") if value.get(name) is not None), None)
        mark = ' <span class="soft small">extrapolated</span>' if value.get("extrapolated") else ""
        return seconds_of(found) + (mark if found is not None else "")
    return text(duration(value)) if isinstance(value, int | float) else "—"
