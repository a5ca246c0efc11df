"""Results of a sweep: a record of each run and of each combination, the best combination, the table, and the page.

Losses are those of the final images, with `run.final_spp` samples. Runs with the same seed use the same random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from markupsafe import Markup

from reslrb_cli.config.files import duration
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.records.images import load_image
from reslrb_cli.records.manifest import Status
from reslrb_cli.records.measurements import Band
from reslrb_cli.records.sweeps import (
    Combination,
    SweepBestRecord,
    SweepPlan,
    SweepRowRecord,
    SweepRunRecord,
    in_words,
    label,
    run_name,
    short_keys,
)
from reslrb_cli.report.format import count, interval, number, shorten, table
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.layout import diagram, lay_out, soft
from reslrb_cli.report.page.run import guarded
from reslrb_cli.report.panels import run_panels
from reslrb_cli.report.plots import COLORS
from reslrb_cli.report.run_summary import total_error, units_differ
from reslrb_cli.report.sources import ShownRun, SweepRuns
from reslrb_cli.report.tonemap import exposure_words, shown_exposures

Array = np.ndarray[Any, Any]

#: Settings that make losses, or errors, incomparable if they vary.
OTHERS = {
    "loss": ("loss", "views", "target", "scene", "parameters", "run.final_spp", "run.held_out", "variant",
             "integrator.max_depth", "integrator.hide_emitters"),
    "error": ("scene", "parameters"),
}  # fmt: skip

#: Maximum width of a setting's value in the table, and of a combination in a line.
VALUE_WIDTH, LABEL_WIDTH = 32, 60

#: Maximum number of combinations named in a line.
MOST_NAMED = 4

#: Maximum number of trials of a search in the table on the terminal.
MOST_TRIALS = 20

#: Titles of the columns of results.
FIGURES = {"loss": "final loss", "error": "parameter RMSE", "elapsed_s": "time", "peak_mib": "peak memory"}


def run_records(source: SweepRuns) -> list[SweepRunRecord]:
    """Return the result of each run, in order. Runs that have not started are `waiting`."""
    return [run_record(source, combination, seed) for combination, seed in source.sweep.runs]


def run_record(source: SweepRuns, combination: Combination, seed: int) -> SweepRunRecord:
    """Return the result of one run."""
    name = run_name(combination, seed)
    run, failure = source.runs.get(name), source.sweep.failures.get(name)
    if run is None or failure is not None:
        status, line = ("failed", failure.line) if failure is not None else ("waiting", "")
        done = 0 if run is None else run.iterations
        return SweepRunRecord(name, combination.settings, seed, status, done, message=line)
    results, relative = run.results, units_differ(run.results)
    status = str(run.manifest.get("status", ""))
    return SweepRunRecord(
        name, combination.settings, seed, status, run.iterations,
        (results.get("image_loss") or {}).get("final"), total_error(results, "final"), relative,
        results.get("elapsed_s"),
        max((record["peak_mib"] for record in run.records), default=None),
        str(run.manifest.get("error") or ""),
    )  # fmt: skip


def row_records(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[SweepRowRecord]:
    """Return the results of the finished runs of each combination."""
    return [_row(each, [run for run in runs if run.settings == each.settings]) for each in sweep.combinations]


def _row(combination: Combination, runs: Sequence[SweepRunRecord]) -> SweepRowRecord:
    done, failed = [run for run in runs if run.is_done], [run for run in runs if run.status == "failed"]

    def band(name: str) -> Band | None:
        return Band.of([value for run in done if (value := getattr(run, name)) is not None])

    return SweepRowRecord(
        combination.name, combination.settings, len(done), len(runs), len(failed), band("iterations"), band("loss"),
        band("error"), band("elapsed_s"), band("peak_mib"),
        f"seed {failed[0].seed}: {failed[0].message}" if failed else "",
    )  # fmt: skip


def best_records(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[SweepBestRecord]:
    """Return the best combination by loss and the best by error, if the combinations can be compared. The result is
    empty for a single combination.

    Only seeds that all combinations have are compared. Combinations with a run that failed or lacks the value are left
    out, because their other runs are a biased sample. Losses of several integrators are left out if errors are known.
    """
    found = []
    for of in OTHERS:
        if of == "loss" and varies_integrator(sweep) and any(run.error is not None for run in runs):
            continue
        values = {} if incomparable(sweep, of) else _paired(sweep, runs, of)
        if len(values) > 1:
            best, second = sorted(values, key=lambda name: float(np.median(values[name])))[:2]
            pairs = list(zip(values[best], values[second], strict=True))
            found.append(SweepBestRecord(of, best, second, len(pairs), sum(one < other for one, other in pairs)))
    return found


def objective(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> str:
    """Return the figure that the best combination of a search has the lowest of: `error` if the true values are known,
    otherwise `loss`. The result is empty if neither can be compared, or if no run has finished.
    """
    done = [run for run in runs if run.is_done]
    known = (of for of in reversed(OTHERS) if not incomparable(sweep, of))
    return next((of for of in known if done and all(getattr(run, of) is not None for run in done)), "")


def trial_values(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> dict[str, float | None]:
    """Return the figure of each finished trial of a search by its name, the median over its seeds. The figure is
    infinite if a run diverged, and None if a run failed for another reason.
    """
    of, found = objective(sweep, runs), dict[str, float | None]()
    for combination in sweep.combinations:
        done = [run for run in runs if run.settings == combination.settings and run.is_done]
        names = [run_name(combination, seed) for seed in sweep.seeds]
        if failures := [sweep.failures[name] for name in names if name in sweep.failures]:
            diverged = any(each.code == ExitCode.NON_FINITE for each in failures)
            found[combination.name] = math.inf if diverged else None
        elif of and len(done) == len(names):
            found[combination.name] = float(np.median([getattr(run, of) for run in done]))
    return found


def ranked(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> SweepPlan:
    """Return the plan of a search with its best trials first. Other sweeps keep their order."""
    if sweep.search is None:
        return sweep
    values = trial_values(sweep, runs)

    def rank(combination: Combination) -> float:
        value = values.get(combination.name)
        return math.inf if value is None else value

    return replace(sweep, combinations=sorted(sweep.combinations, key=rank))


def incomparable(sweep: SweepPlan, of: str) -> str:
    """Return the first varied setting that changes the meaning of the loss or the error. The result is empty if there
    is none. Learning rates change neither.
    """
    given: dict[str, Any] = {key: [each.settings[key] for each in sweep.combinations] for key in sweep.keys}
    if sweep.search:
        given = sweep.search.space
    found = (leaf for key, values in given.items() for leaf in _leaves(key, values))
    keys = [key for key in found if not key.endswith("learning_rate")]
    return next((key for key in keys if any(f"{key}.".startswith((f"{o}.", f"{o}[")) for o in OTHERS[of])), "")


def _leaves(key: str, values: Any) -> Iterator[str]:
    """Yield a varied setting, or the settings of a section in which the section's `values` differ."""
    if key == "integrator" and isinstance(values, list):
        values = [dict(parse_cases(value)[0].options) if isinstance(value, str) else value for value in values]
    if not isinstance(values, list) or not all(isinstance(value, Mapping) for value in values):
        yield key
        return
    for name in dict.fromkeys(name for value in values for name in value):
        own = [value.get(name) for value in values]
        if any(value != own[0] for value in own):
            yield from _leaves(f"{key}.{name}", own)


def varies_integrator(sweep: SweepPlan) -> bool:
    """Whether a setting of the integrator varies. The final images of the runs then differ in noise, and perhaps in the
    light that they contain.
    """
    return any(key.partition(".")[0] == "integrator" for key in sweep.keys)


def _paired(sweep: SweepPlan, runs: Sequence[SweepRunRecord], of: str) -> dict[str, list[float]]:
    """Return the values of each combination by its name, one for each seed that all combinations have."""
    found: dict[str, dict[int, float]] = {}
    for combination in sweep.combinations:
        own = [run for run in runs if run.settings == combination.settings]
        values = {run.seed: getattr(run, of) for run in own if run.is_done}
        if values and None not in values.values() and not any(run.status == "failed" for run in own):
            found[combination.name] = values
    seeds = [seed for seed in sweep.seeds if all(seed in values for values in found.values())]
    return {name: [values[seed] for seed in seeds] for name, values in found.items()} if seeds else {}


def notes(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[str]:
    """Return lines about the table: the best combinations, what is not compared, and what failed."""
    labels = {each.name: shorten(label(each.settings), LABEL_WIDTH) for each in sweep.combinations}
    lines = [
        f"lowest median {FIGURES[best.of]}: {labels[best.best]}; lower than the next, {labels[best.second]}, with "
        f"{best.lower} of {count(best.seeds, 'seed')}"
        for best in best_records(sweep, runs)
    ]
    if key := incomparable(sweep, "loss"):
        lines.append(f"losses of different `{key}` are not of the same, and not compared")
    elif varies_integrator(sweep):
        known = any(run.error is not None for run in runs)
        remedy = "compare the errors" if known else "raise run.final_spp until that makes no difference"
        lines.append(f"the loss of each integrator has its own noise, and what its paths lack: {remedy}")
    failed = [run for run in runs if run.status == "failed"]
    lines += [f"{run.name} failed: {run.message}" for run in failed[:MOST_NAMED]]
    if len(failed) > MOST_NAMED:
        lines.append(f"and so did {len(failed) - MOST_NAMED} more")
    return lines


def figures_of(runs: Sequence[SweepRunRecord]) -> dict[str, str]:
    """Return the titles of the columns of results, by field name. Columns for unknown errors, and for equal numbers of
    iterations, are left out.
    """
    differ = len({run.iterations for run in runs if run.is_done}) > 1
    found = ({"iterations": "iterations"} if differ else {}) | FIGURES
    if not any(run.error is not None for run in runs):
        del found["error"]
    elif any(run.relative for run in runs):
        found["error"] = "relative error"
    return found


# --- the table on the terminal ----------------------------------------------------------------------------------------


def lines(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[str]:
    """Return the table with one line per combination, and the notes. The table of a search has its best trials."""
    keys, figures, short = sweep.keys, figures_of(runs), short_keys(sweep.keys)
    rows: list[tuple[str, ...]] = [(*(short[key] for key in keys), "runs", *figures.values())]
    for row in row_records(ranked(sweep, runs), runs)[: MOST_TRIALS if sweep.search else None]:
        values = [shorten(in_words(row.settings[key]), VALUE_WIDTH) for key in keys]
        bands = [_cell(name, getattr(row, name)) for name in figures]
        rows.append((*values, f"{row.runs} of {row.of}" + (f", {row.failed} failed" if row.failed else ""), *bands))
    more = len(sweep.combinations) - len(rows) + 1
    rest = [f"and {more} more trials, on the page"] if more > 0 else []
    return [*table(rows), *rest, "medians over the seeds, in brackets the least and the greatest", *notes(sweep, runs)]


def _cell(name: str, band: Band | None) -> str:
    """Return a median as text. The ends of its band follow if they differ."""
    if band is None:
        return ""
    if band.low == band.high or name == "elapsed_s":
        write = {"elapsed_s": duration, "peak_mib": lambda size: f"{number(size)} MiB"}.get(name, number)
        ends = "" if band.low == band.high else f" [{write(band.low)}, {write(band.high)}]"
        return write(band.median) + ends
    return interval(band.median, band.low, band.high) + (" MiB" if name == "peak_mib" else "")


# --- the page ---------------------------------------------------------------------------------------------------------

#: Maximum numbers of combinations with curves, and of combinations with pictures.
MOST_CURVES, MOST_PICTURES = 2 * len(COLORS), 24

#: Maximum width of a combination below a picture, and of a setting's value in the table of the page.
CAPTION_WIDTH, PAGE_WIDTH = 80, 60


def sweep_parts(source: SweepRuns) -> dict[str, Markup]:
    """Return the parts of a sweep, by title and in order. Parts that do not apply are empty."""
    runs = run_records(source)
    sweep = ranked(source.sweep, runs)
    source = replace(source, sweep=sweep)
    figures, short = figures_of(runs), short_keys(sweep.keys)
    drawn = sweep.combinations[:MOST_CURVES]

    def settings() -> Markup:
        rows = [
            {"place": place if place < len(drawn) else None, "record": record,
             "values": [shorten(in_words(value), PAGE_WIDTH) for value in record.settings.values()]
             or [label(record.settings)]}
            for place, record in enumerate(row_records(sweep, runs))
        ]  # fmt: skip
        done = sum(run.is_done for run in runs)
        of = f"{len(sweep.combinations)} of {count(sweep.search.trials, 'trial')}" if sweep.search else ""
        told = f"{of or count(len(sweep.combinations), 'combination')} with {count(len(sweep.seeds), 'seed')}: "
        told += f"{done} of {count(len(runs), 'run')} finished."
        return lay_out("sweep.rows", rows, [short[name] for name in sweep.keys], figures, told, notes(sweep, runs))

    parts: dict[str, Callable[[], Markup]] = {
        "Settings": settings,
        "Convergence": lambda: _curves(source, drawn),
        "Images": lambda: _images(source),
        "Runs of the sweep": lambda: lay_out(
            "sweep.runs", runs, {name: title for name, title in figures.items() if name != "iterations"}
        ),
    }
    return {title: guarded(make) for title, make in parts.items()}


def _curves(source: SweepRuns, drawn: Sequence[Combination]) -> Markup:
    """Return the diagrams of the first combinations."""
    own = [runs_of(source, combination) for combination in drawn]
    more = len(source.sweep.combinations) - len(drawn)
    line = soft(f"{more} more combinations are not drawn." if more else "")
    parts = curves([label(each.settings) for each in drawn], own)
    return parts + line if parts else parts


def curves(titles: Sequence[str], own: Sequence[Sequence[ShownRun]]) -> Markup:
    """Return diagrams of the loss and, if known, the parameter error, over iteration and time. Each title has a curve,
    the median of its runs with a band. Runs have at least one iteration.
    """
    if not any(own):
        return Markup()
    panels = iter(run_panels(titles, own))
    parts = lay_out("legend", [title if runs else "" for title, runs in zip(titles, own, strict=True)])
    for pair in zip(panels, panels, strict=True):
        parts += lay_out("diagrams", [("", diagram(panel)) for panel in pair])
    return parts


def runs_of(source: SweepRuns, combination: Combination) -> list[ShownRun]:
    """Return the runs of a combination that have at least one iteration."""
    names = [run_name(combination, seed) for seed in source.sweep.seeds]
    return [run for name in names if (run := source.runs.get(name)) is not None and run.records]


def _images(source: SweepRuns) -> Markup:
    """Return the target, and the final image of the first sensor of each combination's first finished run. All images
    have one exposure.
    """
    shown = []
    for combination in source.sweep.combinations:
        done = [run for run in runs_of(source, combination) if run.manifest.get("status") == Status.FINISHED]
        shown += [(combination, done[0])] if done else []
    if not shown:
        return Markup()
    first, more = shown[0][1], len(shown) - MOST_PICTURES
    suffix, exposure = next(iter(shown_exposures(first.manifest.get("views")).items()))
    target = load_image(first.path / "images" / f"target{suffix}.exr")
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
