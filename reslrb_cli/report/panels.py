"""Diagrams of measurements, runs and sweeps, for pages and figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from reslrb_cli.records.measurements import FEWEST_AVERAGES, MethodRecord, PointRecord
from reslrb_cli.records.metrics import Line
from reslrb_cli.report.plots import MOST_POINTS, Curve, Panel
from reslrb_cli.report.run_summary import units_differ
from reslrb_cli.report.sources import ShownRun

Array = np.ndarray[Any, Any]
Entry = Mapping[str, Any]
Naming = Callable[[Entry], str]
Figure = Callable[[ShownRun], Sequence[float | None]]

#: Quantities that `bench` varies, by field name, in words.
SWEPT = {"max_depth": "path depth", "spp": "samples per pixel"}

#: Figures of a bench that are drawn, in words.
COSTS = {"step_ms": "time of a step (ms)", "peak_mib": "peak memory (MiB)"}

#: Maximum number of drawn quantities: all parameters together, the image, then single parameters.
MOST_DRAWN = 8

#: Names of a figure and the ends of its interval, in the records.
ENDS = (("value", "low", "high"), ("median", "min", "max"), ("median", "low", "high"))


# --- bench ------------------------------------------------------------------------------------------------------------


def label(entry: Entry) -> str:
    """Return an integrator's name as the user wrote it. Records of older versions may lack it."""
    return str(entry.get("label") or entry.get("integrator"))


def bench_entries(objects: Sequence[Entry]) -> tuple[list[Entry], str]:
    """Return the cases of a bench, and the field that varies."""
    entries = [entry for entry in objects if "step_ms" in entry]
    return entries, next((name for name in SWEPT if len({entry.get(name) for entry in entries}) > 1), "max_depth")


def bench_panels(objects: Sequence[Entry]) -> list[Panel]:
    """Return the diagrams of a bench: time and memory against the varied quantity."""
    entries, name = bench_entries(objects)
    names = list(dict.fromkeys(map(label, entries)))
    return [Panel("", SWEPT[name], words, _curves(entries, names, label, name, cost), 2)
            for cost, words in COSTS.items()]  # fmt: skip


def _curves(entries: Sequence[Entry], names: Sequence[str], naming: Naming, x: str, y: str) -> list[Curve]:
    """Return a curve of `y` over `x` for each name. Figures with an interval get a band."""
    curves = []
    for place, name in enumerate(names):
        rows = sorted((row for row in entries if naming(row) == name and row.get(x)), key=lambda row: float(row[x]))
        ends = [figure_with_ends(row.get(y)) for row in rows]
        figures, *band = zip(*ends, strict=True) if ends else ((), (), ())
        is_banded = any(low is not None for low in band[0])
        xs = [row[x] for row in rows]
        curves.append(Curve(name, xs, figures, place, (band[0], band[1]) if is_banded else None, points=True))
    return curves


def figure_with_ends(value: object) -> tuple[float | None, float | None, float | None]:
    """Return a figure of a record, and the ends of its interval. The ends are None if there is no interval."""
    if not isinstance(value, Mapping):
        return (value if isinstance(value, int | float) else None), None, None
    names = next((names for names in ENDS if names[0] in value and names[1] in value), ENDS[0])
    middle, low, high = (value.get(name) for name in names)
    return middle, low, high


# --- convergence ------------------------------------------------------------------------------------------------------


def of_kind(objects: Sequence[Entry], kind: type[Line]) -> list[Entry]:
    """Return the lines of records of one class."""
    return [entry for entry in objects if entry.get("kind") == kind.KIND]


def quantity(entry: Entry) -> str:
    """Return the quantity of an error: a parameter key, `all` or `image`."""
    return str(entry.get("parameter") or "all")


def quantity_words(what: str) -> str:
    """Return a quantity in words."""
    return {"all": "all parameters", "image": "the image"}.get(what, what)


def method_naming(entries: Sequence[Entry]) -> Naming:
    """Return the function that names the methods of a convergence. A name includes the samples per pixel if there are
    several.
    """
    spps = {entry.get("spp") for entry in entries if entry.get("status", "ok") == "ok"}
    return partial(_method_label, with_spp=len(spps) > 1)


def _method_label(entry: Entry, with_spp: bool) -> str:
    words, adjoint, spp = label(entry), entry.get("adjoint"), f", {entry.get('spp')} spp"
    with_spp = words.endswith(spp) or (with_spp and bool(entry.get("spp")))
    words = words.removesuffix(spp)
    words += f", {adjoint}" if adjoint and f"adjoint={adjoint}" not in words else ""
    return words + spp * with_spp


def quantities(entries: Sequence[Entry]) -> list[str]:
    """Return all quantities of a convergence: all parameters together, the image, and then single parameters."""
    found = dict.fromkeys(map(quantity, entries))
    return sorted(found, key=lambda what: {"all": 0, "image": 1}.get(what, 2))


def has_depths(objects: Sequence[Entry]) -> bool:
    """Whether the methods of a convergence have several path depths."""
    return len({entry.get("max_depth") for entry in of_kind(objects, MethodRecord)} - {None}) > 1


def convergence_panels(objects: Sequence[Entry]) -> list[Panel]:
    """Return a diagram for each quantity of a convergence: errors against run time, or, if the records have several
    path depths, the efficiency against depth.

    Hollow points are errors below the error of the reference, and errors from few averages. Dotted lines lead to times
    that are extrapolated.
    """
    points, methods = of_kind(objects, PointRecord), of_kind(objects, MethodRecord)
    naming = method_naming([*methods, *points])
    names = list(dict.fromkeys(map(naming, [*methods, *points])))
    biased = {naming(entry) for entry in methods if entry.get("biased")}
    several = has_depths(methods)
    panels = []
    for what in quantities([*points, *methods])[:MOST_DRAWN]:
        own, rows = ([entry for entry in each if quantity(entry) == what] for each in (methods, points))
        if several:
            panel = Panel(
                "", SWEPT["max_depth"], "efficiency (1/s)", _curves(own, names, naming, "max_depth", "efficiency"), 2
            )
        else:
            times = {naming(entry): _extrapolated(entry) for entry in own}
            curves = [
                _error_curve([row for row in rows if naming(row) == name], name, place, times.get(name, []))
                for place, name in enumerate(names)
            ]
            floors = sorted(value for row in rows if (value := row.get("reference_rmse") or 0) > 0)
            panel = Panel("", "time (s)", "relative error", curves, 10, floors[len(floors) // 2] if floors else None)
        marked = [replace(curve, name=f"{curve.name} (biased)" if curve.name in biased else curve.name)
                  for curve in panel.curves]  # fmt: skip
        panels.append(replace(panel, title=quantity_words(what), curves=marked))
    return panels


def _error_curve(rows: Sequence[Entry], name: str, place: int, times: Sequence[tuple[float, float]]) -> Curve:
    """Return the errors of one method against time. `times` are extrapolated times and their errors."""
    rows = sorted(rows, key=lambda row: float(row["elapsed_s"]))
    xs, ys = [row["elapsed_s"] for row in rows], [row.get("relative_rmse") for row in rows]
    hollow = [
        (y or 0.0) < (row.get("reference_rmse") or 0.0) or (row.get("repeats") or 0) < FEWEST_AVERAGES
        for y, row in zip(ys, rows, strict=True)
    ]
    last = max((x for x, y in zip(xs, ys, strict=True) if y is not None), default=math.inf)
    band = [row.get("low") for row in rows], [row.get("high") for row in rows]
    beyond = sorted((seconds, error) for seconds, error in times if seconds > last)
    return Curve(name, xs, ys, place, band if any(band[0]) else None, True, hollow, beyond)


def _extrapolated(method: Entry) -> list[tuple[float, float]]:
    """Return the extrapolated times of a method, with their errors."""
    times = method.get("seconds_to") or {}
    return [(times[error], float(error)) for error in method.get("extrapolated") or () if times.get(error)]


# --- runs and sweeps --------------------------------------------------------------------------------------------------

#: Abscissae of runs, in words.
ITERATION, TIME = "iteration", "time in steps and updates (s)"


def run_panels(titles: Sequence[str], own: Sequence[Sequence[ShownRun]]) -> list[Panel]:
    """Return diagrams of the loss and, if known, the parameter error, over iteration and time. Each title has a curve,
    the median of its runs with a band from minimum to maximum. Runs have at least one iteration.

    If the parameters of a run have no common unit, the error is the root mean square of their relative errors.
    """
    relative = any(units_differ(run.results) for runs in own for run in runs)
    kinds: dict[str, Figure] = {
        "loss": lambda run: run.column("loss"),
        "relative error of the parameters" if relative else "parameter RMSE":
            _relative_errors if relative else lambda run: run.column("parameter_rmse"),
    }  # fmt: skip
    return [
        Panel("", caption, words, [
            _median(title, place, *against(runs, figure))
            for place, (title, runs) in enumerate(zip(titles, own, strict=True)) if runs
        ])
        for words, figure in kinds.items()
        for against, caption in ((_by_iteration, ITERATION), (_by_time, TIME))
    ]  # fmt: skip


def _relative_errors(run: ShownRun) -> list[float | None]:
    """Return the root mean square of the relative errors of the parameters in each iteration, or None if unknown."""
    scales = {key: scale for key, scale in run.scales.items() if scale}

    def total(errors: Mapping[str, float | None]) -> float | None:
        known = [(error / scales[key]) ** 2 for key, error in errors.items() if error is not None and key in scales]
        return math.sqrt(sum(known) / len(known)) if known else None

    return [total(record["parameter_errors"]) for record in run.records]


def _by_iteration(runs: Sequence[ShownRun], figure: Figure) -> tuple[Array, Array]:
    """Return the iterations (N,) and the figure of each run (runs, N), NaN where unknown."""
    most = max(len(run.records) for run in runs)
    values = np.full((len(runs), most), np.nan)
    for row, run in zip(values, runs, strict=True):
        row[: len(run.records)] = figure(run)
    return np.arange(most), values


def _by_time(runs: Sequence[ShownRun], figure: Figure) -> tuple[Array, Array]:
    """Return times in seconds (N,), and for each run its latest figure at each time (runs, N).

    The first time is the earliest one at which all runs have completed an iteration. A run that has ended keeps its
    last figure.
    """
    ends = [np.array(run.column("elapsed_s"), dtype=np.float64) for run in runs]
    times = np.unique(np.concatenate(ends))
    times = times[times >= max(end[0] for end in ends)]
    times = times[:: -(-len(times) // MOST_POINTS)]
    values = np.full((len(runs), len(times)), np.nan)
    for row, run, end in zip(values, runs, ends, strict=True):
        row[:] = np.array(figure(run), dtype=np.float64)[np.searchsorted(end, times, side="right") - 1]
    return times, values


def _median(title: str, place: int, xs: Array, values: Array) -> Curve:
    """Return the curve of medians at the places where all runs have a value. The band shows minimum and maximum."""
    known = np.isfinite(values).all(axis=0)
    xs, values = xs[known], values[:, known]
    if not len(xs):
        return Curve(title, [], [], place)
    band = (values.min(axis=0).tolist(), values.max(axis=0).tolist()) if len(values) > 1 else None
    return Curve(title, xs.tolist(), np.median(values, axis=0).tolist(), place, band)
