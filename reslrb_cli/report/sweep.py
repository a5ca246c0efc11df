"""What a sweep came to: a record of each run and of each combination, which is the best, and the table of them.

Losses are those of the runs' final images: of `run.final_spp` samples and, of one seed, the same random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from reslrb_cli.config.files import duration
from reslrb_cli.measure.optimization_benchmark.rank import Verdict, find_best, ratio
from reslrb_cli.records.measurements import Band
from reslrb_cli.records.sweeps import (
    Combination,
    Sweep,
    SweepBestRecord,
    SweepRowRecord,
    SweepRunRecord,
    in_words,
    label,
    run_name,
    short_keys,
)
from reslrb_cli.report.format import count, interval, number, shorten, table
from reslrb_cli.report.run_summary import units_differ
from reslrb_cli.report.sources import Run, SweepRuns, is_number

#: Settings by which losses become those of something else, so that they are not compared, and such for errors.
OTHER_LOSS = ("loss", "views", "target", "scene", "parameters", "run.final_spp", "run.held_out")
OTHER_ERROR = ("scene", "parameters")

#: Characters of a setting's value in the table, and of a combination in a line.
VALUE_WIDTH, LABEL_WIDTH = 32, 60

#: Combinations that a line names, at most.
MOST_NAMED = 4

#: What the columns of figures are called.
FIGURES = {"loss": "final loss", "error": "parameter RMSE", "elapsed_s": "time", "peak_mib": "peak memory"}


def run_records(source: SweepRuns) -> list[SweepRunRecord]:
    """What each run came to, in the order of the runs; `waiting` are those that have not begun."""
    return [_run_record(source, combination, seed) for combination, seed in source.sweep.runs]


def _run_record(source: SweepRuns, combination: Combination, seed: int) -> SweepRunRecord:
    name = run_name(combination, seed)
    run, failure = source.runs.get(name), source.sweep.failures.get(name)
    if run is None or failure is not None:
        status, line = ("failed", failure.line) if failure is not None else ("waiting", "")
        done = 0 if run is None else len(run.records)
        return SweepRunRecord(name, combination.settings, seed, status, done, message=line)
    results, relative = run.results, units_differ(run.results)
    status = str(run.manifest.get("status", ""))
    return SweepRunRecord(
        name, combination.settings, seed, status, len(run.records),
        _number((results.get("image_loss") or {}).get("final")), _error(run, relative), relative,
        _number(results.get("elapsed_s")), max((record["peak_mib"] for record in run.records), default=None),
        str(run.manifest.get("error") or ""),
    )  # fmt: skip


def _number(value: Any) -> float | None:
    return float(value) if is_number(value) else None


def _error(run: Run, relative: bool) -> float | None:
    """The error of all parameters at the end; where their units differ, the root mean square of the relative ones."""
    if not relative:
        return _number((run.results.get("rmse") or {}).get("final"))
    pairs = (run.results.get("relative_error") or {}).values()
    known = [pair["final"] for pair in pairs if is_number(pair.get("final"))]
    return math.sqrt(sum(error**2 for error in known) / len(known)) if known else None


def row_records(sweep: Sweep, runs: Sequence[SweepRunRecord]) -> list[SweepRowRecord]:
    """What the finished runs of each combination came to."""
    return [_row(combination, [run for run in runs if run.settings == combination.settings])
            for combination in sweep.combinations]  # fmt: skip


def _row(combination: Combination, runs: Sequence[SweepRunRecord]) -> SweepRowRecord:
    done, failed = [run for run in runs if run.is_done], [run for run in runs if run.status == "failed"]

    def band(name: str) -> Band | None:
        return Band.of([value for run in done if (value := getattr(run, name)) is not None])

    return SweepRowRecord(
        combination.name, combination.settings, len(done), len(runs), len(failed), band("loss"), band("error"),
        band("elapsed_s"), band("peak_mib"), f"seed {failed[0].seed}: {failed[0].message}" if failed else "",
    )  # fmt: skip


# --- which is the best ------------------------------------------------------------------------------------------------


def best_records(sweep: Sweep, runs: Sequence[SweepRunRecord]) -> list[SweepBestRecord]:
    """Which combination is the best by loss and by error, as far as they can be compared; none of one combination.

    Combinations with a run that failed, or has no such figure, are left out: what is left of them are the lucky ones.
    """
    found = []
    for of, others in (("loss", OTHER_LOSS), ("error", OTHER_ERROR)):
        if incomparable(sweep, others):
            continue
        values = _paired(sweep, runs, of)
        verdict = find_best(values, paired=True) if len(values) > 1 else None
        if verdict is not None:
            found.append(_best(of, verdict, values, {each.name: label(each.settings) for each in sweep.combinations}))
    return found


def incomparable(sweep: Sweep, others: Sequence[str]) -> str:
    """The first setting that is varied and one of `others`, or below one; empty where there is none."""
    return next((key for key in sweep.keys if any(f"{key}.".startswith((f"{o}.", f"{o}[")) for o in others)), "")


def _paired(sweep: Sweep, runs: Sequence[SweepRunRecord], of: str) -> dict[str, list[float]]:
    """The values of each combination by its name, one a seed, over the seeds that all have; without those that failed,
    or that have none."""
    found: dict[str, dict[int, float]] = {}
    for combination in sweep.combinations:
        own = [run for run in runs if run.settings == combination.settings]
        values = {run.seed: getattr(run, of) for run in own if run.is_done}
        if values and None not in values.values() and not any(run.status == "failed" for run in own):
            found[combination.name] = values
    seeds = [seed for seed in sweep.seeds if all(seed in values for values in found.values())]
    return {name: [values[seed] for seed in seeds] for name, values in found.items()} if seeds else {}


def _best(of: str, verdict: Verdict, values: dict[str, list[float]], labels: dict[str, str]) -> SweepBestRecord:
    second = min((name for name in values if name != verdict.best), key=lambda name: Band.of(values[name]).median)  # type: ignore[union-attr]
    seeds = len(values[verdict.best])
    apart = ratio([values[verdict.best]], [values[second]])
    what = f"lowest median {FIGURES[of]}: {shorten(labels[verdict.best], LABEL_WIDTH)}"
    pairs = f"in pairs of {count(seeds, 'seed')}"
    tied = ", ".join(shorten(labels[name], LABEL_WIDTH) for name in verdict.tied[:MOST_NAMED])
    more = len(verdict.tied) - MOST_NAMED
    tied += f" and {more} more" if more > 0 else ""
    if verdict.too_few:
        says = f"not told from the others: {pairs} no test could do that, with --seeds {verdict.enough} it could"
    elif verdict.tied:
        says = f"not told from {tied} ({pairs}, by Wilcoxon's signed ranks, 5 % over all)"
    else:
        says = f"surely lower than all others ({pairs}, by Wilcoxon's signed ranks, 5 % over all)"
    lower = sum(one < other for one, other in zip(values[verdict.best], values[second], strict=True))
    says += f"; lower than the next, {shorten(labels[second], LABEL_WIDTH)}, with {lower} of {count(seeds, 'seed')}"
    if apart is not None:
        says += f", {interval(apart.value, apart.low, apart.high, 3)} times that (95 %, bootstrap over the seeds)"
    return SweepBestRecord(of, verdict.best, second, verdict.tied, verdict.beats, seeds, apart, f"{what}; {says}")


def notes(sweep: Sweep, runs: Sequence[SweepRunRecord]) -> list[str]:
    """What a reader of the table has to know: what is not compared, and what failed."""
    lines = []
    if key := incomparable(sweep, OTHER_LOSS):
        lines.append(f"losses of different `{key}` are not of the same, and not compared")
    failed = [run for run in runs if run.status == "failed"]
    lines += [f"{run.name} failed: {run.message}" for run in failed[:MOST_NAMED]]
    if len(failed) > MOST_NAMED:
        lines.append(f"and so did {len(failed) - MOST_NAMED} more")
    return lines


# --- the table on the terminal ----------------------------------------------------------------------------------------


def figures_of(runs: Sequence[SweepRunRecord]) -> dict[str, str]:
    """What columns of figures are called, by their names in the records; without errors where none is known."""
    found = {
        name: title for name, title in FIGURES.items() if name != "error" or any(run.error is not None for run in runs)
    }
    if any(run.relative for run in runs):
        found["error"] = "relative error"
    return found


def lines(sweep: Sweep, runs: Sequence[SweepRunRecord]) -> list[str]:
    """The table, a line for each combination, which is the best, and what else is to be known."""
    keys, figures, short = sweep.keys, figures_of(runs), short_keys(sweep.keys)
    rows: list[tuple[str, ...]] = [(*(short[key] for key in keys), "runs", *figures.values())]
    for row in row_records(sweep, runs):
        values = [shorten(in_words(row.settings[key]), VALUE_WIDTH) for key in keys]
        bands = [cell(name, getattr(row, name)) for name in figures]
        rows.append((*values, f"{row.runs} of {row.of}" + (f", {row.failed} failed" if row.failed else ""), *bands))
    told = table(rows)
    told.append("medians over the seeds, in brackets the least and the greatest")
    return [*told, *(best.line for best in best_records(sweep, runs)), *notes(sweep, runs)]


def cell(name: str, band: Band | None) -> str:
    """The median of a figure, and the ends of its band, where these differ."""
    if band is None:
        return ""
    write = {"elapsed_s": duration, "peak_mib": lambda size: f"{number(size)} MiB"}.get(name, lambda v: number(v, 4))
    return write(band.median) if band.low == band.high else \
        f"{write(band.median)} [{write(band.low)}, {write(band.high)}]"  # fmt: skip
