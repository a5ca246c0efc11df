"""What `convergence` measured: error against run time, by method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from reslrb_cli.report.page.bench import label
from reslrb_cli.report.page.drawing import Curve, diagram, diagrams, legend
from reslrb_cli.report.page.markup import breakable, soft, table, text
from reslrb_cli.report.page.whole_runs import whole_runs
from reslrb_cli.report.words import duration, number

Entry = Mapping[str, Any]
Naming = Callable[[Entry], str]

#: Quantities that are drawn, at most: all parameters together, the image, then single ones.
MOST_DRAWN = 8
_SHARES = {"0.1": "to 10 %", "0.03": "to 3 %", "0.01": "to 1 %"}


def convergence(objects: Sequence[Entry]) -> tuple[str, int]:
    """All that was measured of gradients, of whole runs, and in words; and how many lines are none of that."""
    kinds = {kind: [entry for entry in objects if entry.get("kind") == kind]
             for kind in ("point", "method", "reference", "run_point", "run_method")}  # fmt: skip
    said = [entry for entry in objects if entry.get("kind") not in kinds and isinstance(entry.get("line"), str)]
    known = [entry for entries in kinds.values() for entry in entries]
    spps = len({entry.get("spp") for entry in known if entry.get("status", "ok") == "ok"})
    name = partial(method_label, with_spp=spps > 1)
    markup = "".join(f"<p>{text(entry['line'])}</p>" for entry in said)
    if kinds["point"] or kinds["method"]:
        markup += _steps(kinds["point"], kinds["method"], name)
    if kinds["run_point"] or kinds["run_method"]:
        markup += whole_runs(kinds["run_point"], kinds["run_method"], name)
        markup += "".join(soft(f"{name(entry)}: {entry['message']}") for entry in kinds["run_method"]
                          if entry.get("message"))  # fmt: skip
    return markup, len(objects) - len(known) - len(said)


def _steps(points: Sequence[Entry], methods: Sequence[Entry], name: Naming) -> str:
    """A diagram for each quantity, and a table of the methods."""
    labels = list(dict.fromkeys(map(name, [*methods, *points])))
    quantities = list(dict.fromkeys(map(quantity, [*points, *methods])))
    quantities.sort(key=lambda what: {"all": 0, "image": 1}.get(what, 2))
    if len(quantities) == 2 and quantities[0] == "all":  # the only parameter is all of them
        del quantities[0]
    drawn = [_diagram(points, labels, what, name) for what in quantities[:MOST_DRAWN]]
    parts = [legend([Curve(title, (), (), place) for place, title in enumerate(labels)]), diagrams(*drawn)]
    if points:
        parts.append(soft("Dots across: the standard error of the reference itself, below which nothing can be told."))
    if len(quantities) > MOST_DRAWN:
        parts.append(soft(f"{len(quantities) - MOST_DRAWN} more parameters are in the table alone."))
    told = [entry for entry in methods if quantity(entry) in quantities]
    parts.append(_table(told, quantities, name))
    parts += [soft(f"{name(entry)}: {entry['message']}") for entry in told if entry.get("message")]
    return "".join(parts)


def quantity(entry: Entry) -> str:
    """What the error is of: a parameter's key, `all` or `image`."""
    return str(entry.get("parameter") or "all")


def method_label(entry: Entry, with_spp: bool = False) -> str:
    """A method's name as the user wrote it, or its integrator and estimator; and how it takes its samples, if known."""
    parts = [str(entry.get("label") or label(entry)), str(entry.get("adjoint") or "")]
    parts += [f"{entry['spp']} spp"] if with_spp and entry.get("spp") else []
    return ", ".join(part for part in parts if part)


def _diagram(points: Sequence[Entry], labels: Sequence[str], what: str, naming: Naming) -> str:
    of_it = [entry for entry in points if quantity(entry) == what]
    curves = []
    for place, name in enumerate(labels):
        rows = sorted((entry for entry in of_it if naming(entry) == name and _time(entry)), key=_time)
        curves.append(Curve(name, [_time(entry) for entry in rows], [entry.get("relative_rmse") for entry in rows],
                            place, points=True))  # fmt: skip
    floors = [value for entry in of_it if isinstance(value := entry.get("reference_rmse"), int | float) and value > 0]
    markup = diagram(curves, "time (s)", "relative error", 10, sorted(floors)[len(floors) // 2 :][:1])
    words = {"all": "all parameters", "image": "the image"}.get(what)
    title = text(words) if words else breakable(what)
    return f"<div><h3>{title}</h3>{markup}</div>" if markup else ""


def _time(entry: Entry) -> float:
    return float(entry.get("elapsed_s") or 0.0)


def _table(methods: Sequence[Entry], quantities: Sequence[str], naming: Naming) -> str:
    several = len(quantities) > 1
    head = ["method", *["of"] * several, "slope", "efficiency", "bias, z", *_SHARES.values()]
    rows = []
    for entry in sorted(methods, key=lambda entry: quantities.index(quantity(entry))):
        biased = ' <span class="worse">biased</span>' if entry.get("biased") else ""
        name = [breakable(naming(entry)) + biased, *[breakable(quantity(entry))] * several]
        if entry.get("status", "ok") != "ok":
            ended = f'<span class="worse">{text(str(entry["status"]).replace("_", " "))}</span>'
            rows.append([*name, ended, *[""] * (len(head) - len(name) - 1)])
            continue
        seconds, beyond = entry.get("seconds_to") or {}, entry.get("extrapolated") or ()
        rows.append([
            *name, figure_of(entry.get("slope")), figure_of(entry.get("efficiency")), _bias(entry),
            *(seconds_of(seconds.get(share), share in beyond) for share in _SHARES),
        ])  # fmt: skip
    return table(head, rows, "dense")


def _bias(entry: Entry) -> str:
    """The largest deviation in standard errors, and the limit that it keeps or exceeds."""
    z, limit = entry.get("bias_z"), entry.get("bias_z_limit")
    if not isinstance(z, int | float) or not isinstance(limit, int | float):
        return figure_of(z)
    return text(f"{abs(z):.2g} {'<' if abs(z) < limit else '>'} {limit:.2g}")


def figure_of(value: Any) -> str:
    """A figure, and its interval where it has one: a number, or `{value, low, high}`."""
    if isinstance(value, Mapping):
        ends = [number(value.get(end), 3) for end in ("low", "high")]
        interval = f' <span class="soft small">[{text(", ".join(ends))}]</span>' if all(ends) else ""
        return text(number(value.get("value"), 3)) + interval
    return text(number(value, 3)) if isinstance(value, int | float) else ""


def seconds_of(value: Any, extrapolated: bool) -> str:
    """A time; one that was extrapolated is marked, one that is never reached is a dash."""
    if not isinstance(value, int | float):
        return "—"
    return text(duration(value)) + (' <span class="soft small">extrapolated</span>' if extrapolated else "")
