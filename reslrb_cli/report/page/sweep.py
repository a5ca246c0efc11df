"""Parts of a page about a sweep: its table, curves of medians with bands, and final images side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from reslrb_cli.records.images import load_image
from reslrb_cli.records.manifest import Status
from reslrb_cli.records.sweeps import Combination, in_words, label, run_name, short_keys
from reslrb_cli.report.format import count, number, shorten
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.layout import diagram, lay_out, soft
from reslrb_cli.report.page.run import guarded
from reslrb_cli.report.plots import COLORS, MOST_POINTS, Curve
from reslrb_cli.report.run_summary import units_differ
from reslrb_cli.report.sources import ShownRun, SweepRuns
from reslrb_cli.report.sweep import (
    RATIOS,
    RATIOS_LINE,
    best_records,
    figures_of,
    notes,
    row_figures,
    row_records,
    run_records,
)
from reslrb_cli.report.tonemap import exposure_for, exposure_words, shown_exposures

Array = np.ndarray[Any, Any]

#: Maximum numbers of combinations with curves, and of combinations with pictures.
MOST_CURVES, MOST_PICTURES = 2 * len(COLORS), 24

#: Maximum width of a combination below a picture, and of a setting's value in the table.
CAPTION_WIDTH, VALUE_WIDTH = 80, 60


def sweep_parts(source: SweepRuns) -> dict[str, Markup]:
    """Return the parts of a sweep, by title and in order. Parts that do not apply are empty."""
    sweep, runs = source.sweep, run_records(source)
    figures, short = figures_of(runs), short_keys(sweep.keys)
    drawn = sweep.combinations[:MOST_CURVES]

    def settings() -> Markup:
        records = row_records(sweep, runs)
        rows = [
            {"place": place if place < len(drawn) else None, "record": record,
             "values": [shorten(in_words(value), VALUE_WIDTH) for value in record.settings.values()]
             or [label(record.settings)]}
            for place, record in enumerate(records)
        ]  # fmt: skip
        done = sum(run.is_done for run in runs)
        told = f"{count(len(sweep.combinations), 'combination')} with {count(len(sweep.seeds), 'seed')}: "
        told += f"{done} of {count(len(runs), 'run')} finished"
        lines = [f"{told}.", *(f"{best.line}." for best in best_records(sweep, runs))]
        columns = row_figures(records, runs)
        remarks = notes(sweep, runs) + ([f"{RATIOS_LINE}."] if RATIOS.keys() & columns.keys() else [])
        return lay_out("sweep.rows", rows, [short[name] for name in sweep.keys], columns, lines, remarks)

    parts: dict[str, Callable[[], Markup]] = {
        "Settings": settings,
        "Convergence": lambda: _curves(source, drawn),
        "Images": lambda: _images(source),
        "Runs of the sweep": lambda: lay_out("sweep.runs", runs, figures),
    }
    return {title: guarded(make) for title, make in parts.items()}


# --- curves -----------------------------------------------------------------------------------------------------------


def _curves(source: SweepRuns, drawn: Sequence[Combination]) -> Markup:
    """Return diagrams of the loss and, if known, the parameter error. Medians with bands are drawn over iteration and
    time.
    """
    own = [_runs(source, combination) for combination in drawn]
    if not any(run.records for runs in own for run in runs):
        return Markup()
    parts = lay_out("legend", [label(each.settings) if runs else "" for each, runs in zip(drawn, own, strict=True)])
    kinds = {"loss": "loss"}
    if not any(units_differ(run.results) for runs in own for run in runs):
        kinds["parameter_rmse"] = "parameter RMSE"
    for name, title in kinds.items():
        both = []
        for against, caption in ((_by_iteration, "iteration"), (_by_time, "time in steps and updates (s)")):
            curves = [_median(label(each.settings), place, *against(runs, name))
                      for place, (each, runs) in enumerate(zip(drawn, own, strict=True)) if runs]  # fmt: skip
            both.append(("", diagram(curves, caption, title)))
        parts += lay_out("diagrams", both)
    more = len(source.sweep.combinations) - len(drawn)
    return parts + soft(f"{more} more combinations are not drawn." if more else "")


def _runs(source: SweepRuns, combination: Combination) -> list[ShownRun]:
    """Return the runs of a combination that have at least one iteration."""
    names = [run_name(combination, seed) for seed in source.sweep.seeds]
    return [run for name in names if (run := source.runs.get(name)) is not None and run.records]


def _by_iteration(runs: Sequence[ShownRun], name: str) -> tuple[Array, Array]:
    """Return the iterations (N,) and the values of each run (runs, N), NaN where unknown."""
    most = max(len(run.records) for run in runs)
    values = np.full((len(runs), most), np.nan)
    for row, run in zip(values, runs, strict=True):
        row[: len(run.records)] = run.column(name)
    return np.arange(most), values


def _by_time(runs: Sequence[ShownRun], name: str) -> tuple[Array, Array]:
    """Return times in seconds (N,), and for each run its latest value at each time (runs, N).

    The first time is the earliest one at which all runs have completed an iteration. A run that has ended keeps its
    last value.
    """
    ends = [np.array(run.column("elapsed_s"), dtype=np.float64) for run in runs]
    times = np.unique(np.concatenate(ends))
    times = times[times >= max(end[0] for end in ends)]
    times = times[:: -(-len(times) // MOST_POINTS)]
    values = np.full((len(runs), len(times)), np.nan)
    for row, run, end in zip(values, runs, ends, strict=True):
        row[:] = np.array(run.column(name), dtype=np.float64)[np.searchsorted(end, times, side="right") - 1]
    return times, values


def _median(title: str, place: int, xs: Array, values: Array) -> Curve:
    """Return the curve of medians at the places where all runs have a value. The band shows minimum and maximum."""
    known = np.isfinite(values).all(axis=0)
    xs, values = xs[known], values[:, known]
    if not len(xs):
        return Curve(title, [], [], place)
    band = (values.min(axis=0), values.max(axis=0)) if len(values) > 1 else None
    return Curve(title, xs.tolist(), np.median(values, axis=0).tolist(), place, band)


# --- pictures ---------------------------------------------------------------------------------------------------------


def _images(source: SweepRuns) -> Markup:
    """Return the target, and the final image of the first sensor of each combination's first finished run. All images
    have one exposure.
    """
    shown = []
    for combination in source.sweep.combinations:
        done = [run for run in _runs(source, combination) if run.manifest.get("status") == Status.FINISHED]
        shown += [(combination, done[0])] if done else []
    if not shown:
        return Markup()
    first, more = shown[0][1], len(shown) - MOST_PICTURES
    names = ("", "-0")  # the first of several sensors has the suffix -0
    suffix = next((end for end in names if (first.path / "images" / f"target{end}.exr").exists()), "")
    target = load_image(first.path / "images" / f"target{suffix}.exr")
    exposure = shown_exposures(first.manifest.get("views")).get(suffix) or exposure_for(target)
    pictures = [] if target is None else [show(target * exposure, "target", lay_out("titled", "target", ""))]
    for combination, run in shown[:MOST_PICTURES]:
        image, loss = load_image(run.path / "images" / f"final{suffix}.exr"), run.results.get("image_loss") or {}
        if image is not None:
            title = shorten(label(combination.settings), CAPTION_WIDTH)
            said = "" if loss.get("final") is None else f"loss {number(loss['final'])}"
            pictures.append(show(image * exposure, title, lay_out("titled", title, ""), said))
    line = "Of each combination the first seed that is finished."
    line += f" {more} more combinations are not shown." if more > 0 else ""
    return soft(line) + lay_out("gallery", pictures, "", exposure_words(exposure, target))
