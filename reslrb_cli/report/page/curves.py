"""Loss and errors of one run, or of several in one picture, against iterations and time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from reslrb_cli.report.page.drawing import COLORS, MOST_POINTS, Curve, diagram, diagrams, legend, points_together
from reslrb_cli.report.page.markup import breakable, soft
from reslrb_cli.report.run_table import units_differ
from reslrb_cli.report.sources import Run

#: Curves in one diagram of one run, at most: those of the parameters that are the farthest off at the end.
MOST_CURVES = len(COLORS)
#: Parameters of several runs that have diagrams of their own, at most.
MOST_SHARED = 6
ABSCISSAE = (("iteration", "iteration"), ("elapsed_s", "time in steps and updates (s)"))

Record = Mapping[str, Any]


def convergence(run: Run) -> str:
    """Loss, and errors by parameter where they are known, against iterations and against time."""
    if not run.records:
        when = (
            "has been completed yet; the first one also compiles what the others use"
            if run.at_work
            else "was completed"
        )
        return f"<p>No iteration {when}.</p>"
    scales, relative = run.scales, units_differ(run.results)
    last = run.records[-1]["parameter_errors"]
    ends = {
        key: error / (scales.get(key) or 1.0 if relative else 1.0) for key, error in last.items() if error is not None
    }
    keys = [key for key in sorted(ends, key=lambda key: -ends[key]) if not relative or scales.get(key)]
    drawn = keys[:MOST_CURVES]
    errors = [(key, place, _error(key, scales.get(key) if relative else None)) for place, key in enumerate(drawn)]
    what = "relative error" if relative else "RMSE"
    parts = [
        _both([(run, "loss", 0, _loss)], "loss"),
        _both([(run, key, place, error) for key, place, error in errors], f"{what} by parameter"),
        legend([Curve(key, (), (), place) for key, place, _ in errors]),
    ]
    if len(keys) > len(drawn):
        words = f"The {MOST_CURVES} parameters that are the farthest off at the end; "
        parts.append(soft(f"{words}{len(keys) - len(drawn)} more are not drawn."))
    return "".join(parts) + _thinning([run])


def convergence_of_all(runs: Sequence[Run]) -> str:
    """Loss and error of several runs in one picture; of parameters that several have, each in a picture of its own."""
    begun = [(place, run) for place, run in enumerate(runs) if run.records]
    if not begun:
        return "<p>No iteration was completed.</p>"
    parts = [legend([Curve(run.name, (), (), place) for place, run in begun])]
    parts.append(_both([(run, run.name, place, _loss) for place, run in begun], "loss"))
    absolute = not any(units_differ(run.results) for run in runs)
    total = _total_rmse if absolute else _total_relative
    label = "parameter RMSE" if absolute else "relative error"
    parts.append(_both([(run, run.name, place, total(run)) for place, run in begun], f"{label}, all parameters"))
    counts: dict[str, int] = {}
    for _, run in begun:
        for key in run.records[-1]["parameter_errors"]:
            counts[key] = counts.get(key, 0) + 1
    shared = [key for key, count in counts.items() if count > 1] if len(counts) > 1 else []
    for key in shared[:MOST_SHARED]:
        curves = [(run, run.name, place, _error(key, None)) for place, run in begun]
        drawn = _both(curves, "RMSE")
        parts.append(f"<h3>{breakable(key)}</h3>{drawn}" if drawn else "")
    if len(shared) > MOST_SHARED:
        parts.append(soft(f"{len(shared) - MOST_SHARED} more parameters that several runs have are not drawn."))
    missing = [run.name for run in runs if not run.records]
    parts.append(soft(f"No iteration was completed by: {', '.join(missing)}." if missing else ""))
    return "".join(parts) + _thinning(runs)


def _both(curves: Sequence[tuple[Run, str, int, Callable[[Record], float | None]]], label: str) -> str:
    """The same curves in two diagrams beside each other, against iterations and against time."""
    drawn = []
    for name, caption in ABSCISSAE:
        made = [
            Curve(title, [record[name] for record in run.records], [value(record) for record in run.records], place)
            for run, title, place, value in curves
        ]
        drawn.append(diagram(made, caption, label))
    return diagrams(*drawn)


def _thinning(runs: Sequence[Run]) -> str:
    most = max((points_together(len(run.records)) for run in runs), default=1)
    if most <= 1:
        return ""
    if len(runs) == 1:
        return soft(f"Each point is the mean of {most} iterations.")
    return soft(f"Of runs with more than {MOST_POINTS} iterations each point is the mean of some, at most {most}.")


def _loss(record: Record) -> float | None:
    return record["loss"]


def _error(key: str, scale: float | None) -> Callable[[Record], float | None]:
    """The error of one parameter, over `scale` where that is given."""

    def error(record: Record) -> float | None:
        value = record["parameter_errors"].get(key)
        return None if value is None else value / (scale or 1.0)

    return error


def _total_rmse(run: Run) -> Callable[[Record], float | None]:
    return lambda record: record["parameter_rmse"]


def _total_relative(run: Run) -> Callable[[Record], float | None]:
    """The root mean square over the parameters of their errors as shares of the truth."""
    scales = run.scales

    def total(record: Record) -> float | None:
        errors = record["parameter_errors"].items()
        shares = [value / scale for key, value in errors if value is not None and (scale := scales.get(key))]
        return math.sqrt(sum(share**2 for share in shares) / len(shares)) if shares else None

    return total
