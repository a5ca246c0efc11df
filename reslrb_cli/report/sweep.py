"""Results of a sweep: a record of each run and of each combination, the best combination, and the table.

Losses are those of the final images, with `run.final_spp` samples. Runs with the same seed use the same random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from reslrb_cli.config.files import duration
from reslrb_cli.records.measurements import Band, Range
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
from reslrb_cli.report.run_summary import units_differ
from reslrb_cli.report.sources import ShownRun, SweepRuns

#: Settings that make losses, or errors, incomparable if they vary.
OTHER_LOSS = ("loss", "views", "target", "scene", "parameters", "run.final_spp", "run.held_out")
OTHER_ERROR = ("scene", "parameters")
#: Settings that change the noise and the paths of images. If they vary, losses are compared only if errors are unknown.
OTHER_IMAGE = ("integrator",)
OTHERS = {"loss": OTHER_LOSS, "error": OTHER_ERROR}

#: Maximum width of a setting's value in the table, and of a combination in a line.
VALUE_WIDTH, LABEL_WIDTH = 32, 60

#: Maximum number of combinations named in a line.
MOST_NAMED = 4

#: Titles of the columns of results.
FIGURES = {"loss": "final loss", "error": "parameter RMSE", "elapsed_s": "time", "peak_mib": "peak memory"}


def run_records(source: SweepRuns) -> list[SweepRunRecord]:
    """Return the result of each run, in order. Runs that have not started are `waiting`."""
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
        (results.get("image_loss") or {}).get("final"), _error(run, relative), relative, results.get("elapsed_s"),
        max((record["peak_mib"] for record in run.records), default=None),
        str(run.manifest.get("error") or ""),
    )  # fmt: skip


def _error(run: ShownRun, relative: bool) -> float | None:
    """Return the final error of all parameters. If `relative`, return the root mean square of their relative errors."""
    if not relative:
        return (run.results.get("rmse") or {}).get("final")
    pairs = (run.results.get("relative_error") or {}).values()
    known = [pair["final"] for pair in pairs if pair.get("final") is not None]
    return math.sqrt(sum(error**2 for error in known) / len(known)) if known else None


def row_records(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[SweepRowRecord]:
    """Return the results of the finished runs of each combination."""
    ratios = {of: _ratios(sweep, runs, of) for of in OTHERS}
    return [
        _row(each, [run for run in runs if run.settings == each.settings],
             ratios["loss"].get(each.name), ratios["error"].get(each.name))
        for each in sweep.combinations
    ]  # fmt: skip


def _row(
    combination: Combination, runs: Sequence[SweepRunRecord], loss_ratio: Range | None, error_ratio: Range | None
) -> SweepRowRecord:
    done, failed = [run for run in runs if run.is_done], [run for run in runs if run.status == "failed"]

    def band(name: str) -> Band | None:
        return Band.of([value for run in done if (value := getattr(run, name)) is not None])

    return SweepRowRecord(
        combination.name, combination.settings, len(done), len(runs), len(failed), band("iterations"), band("loss"),
        band("error"), band("elapsed_s"), band("peak_mib"), loss_ratio, error_ratio,
        f"seed {failed[0].seed}: {failed[0].message}" if failed else "",
    )  # fmt: skip


# --- the best combination ---------------------------------------------------------------------------------------------


def best_records(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[SweepBestRecord]:
    """Return the best combination by loss and the best by error, if the combinations can be compared. The result is
    empty for a single combination.

    Combinations with a run that failed or lacks the value are left out, because their other runs are a biased sample.
    """
    found = []
    for of in OTHERS:
        groups = _groups(sweep, _paired(sweep, runs, of))
        if len(groups) > 1:
            found.append(_best(of, groups, {each.name: label(each.settings) for each in sweep.combinations}))
    return found


def incomparable(sweep: SweepPlan, others: Sequence[str]) -> str:
    """Return the first varied setting that is in `others`, or below a setting in `others`. Learning rates do not count.
    Return "" if there is none.
    """
    keys = [key for key in sweep.keys if not is_rate(key)]
    return next((key for key in keys if any(f"{key}.".startswith((f"{o}.", f"{o}[")) for o in others)), "")


def _paired(sweep: SweepPlan, runs: Sequence[SweepRunRecord], of: str) -> dict[str, list[float]]:
    """Return each combination's values by the combination's name. Each value belongs to one seed. The values use only
    seeds that all combinations have.

    Combinations that failed or lack values are left out. The result is empty if the combinations cannot be compared.
    """
    errors_known = any(run.error is not None for run in runs)
    if incomparable(sweep, OTHERS[of]) or (of == "loss" and errors_known and incomparable(sweep, OTHER_IMAGE)):
        return {}
    found: dict[str, dict[int, float]] = {}
    for combination in sweep.combinations:
        own = [run for run in runs if run.settings == combination.settings]
        values = {run.seed: getattr(run, of) for run in own if run.is_done}
        if values and None not in values.values() and not any(run.status == "failed" for run in own):
            found[combination.name] = values
    seeds = [seed for seed in sweep.seeds if all(seed in values for values in found.values())]
    return {name: [values[seed] for seed in seeds] for name, values in found.items()} if seeds else {}


def _groups(sweep: SweepPlan, values: Mapping[str, list[float]]) -> dict[str, list[list[float]]]:
    """Group combinations that differ only in learning rates. Return the values of each group by the name of the group's
    best combination.

    The best combination of a group comes first. If only learning rates are varied, each combination is a group.
    """
    others = [key for key in sweep.keys if not is_rate(key)] or sweep.keys
    found: dict[str, list[str]] = {}
    for each in sweep.combinations:
        if each.name in values:
            found.setdefault(label({key: each.settings[key] for key in others}), []).append(each.name)
    ordered = [sorted(names, key=lambda name: float(np.median(values[name]))) for names in found.values()]
    return {names[0]: [values[name] for name in names] for names in ordered}


def is_rate(key: str) -> bool:
    """Whether a setting is a learning rate."""
    return key.endswith("learning_rate")


def _ratios(sweep: SweepPlan, runs: Sequence[SweepRunRecord], of: str) -> dict[str, Range]:
    """Return each other group's ratio to the first group, by the name of the group's best combination."""
    groups = _groups(sweep, _paired(sweep, runs, of))
    first = next(iter(groups.values()), [])
    found = {name: ratio(rows, first) for name, rows in list(groups.items())[1:]}
    return {name: each for name, each in found.items() if each is not None}


def _best(of: str, groups: Mapping[str, list[list[float]]], labels: dict[str, str]) -> SweepBestRecord:
    best, second = sorted(groups, key=lambda name: float(np.median(groups[name][0])))[:2]
    one, other = groups[best][0], groups[second][0]
    apart, seeds = ratio(groups[best], groups[second]), count(len(one), "seed")
    lower = sum(a < b for a, b in zip(one, other, strict=True))
    line = f"lowest median {FIGURES[of]}: {shorten(labels[best], LABEL_WIDTH)}; lower than the next, "
    line += f"{shorten(labels[second], LABEL_WIDTH)}, with {lower} of {seeds}"
    if apart is not None:
        line += f", {interval(apart.value, apart.low, apart.high, 3)} times that (95 %, bootstrap over the seeds)"
    elif len(one) < LEAST_SEEDS:
        line += f" (--seeds {LEAST_SEEDS} or more give an interval of the ratio)"
    return SweepBestRecord(of, best, second, len(one), apart, line)


#: Minimum number of seeds for an interval of a median.
LEAST_SEEDS = 5

#: Number of bootstrap resamples, and their random seed, which is fixed so that the interval is reproducible.
RESAMPLES, RESAMPLED_BY = 4000, 15

#: Confidence level of an interval.
CONFIDENCE = 0.95


def ratio(own: Sequence[Sequence[float]], base: Sequence[Sequence[float]]) -> Range | None:
    """Return the ratio of `own` to `base` with its interval. For each of `own` and `base`, the ratio uses the row with
    the best median over seeds.

    Rows are learning rates, and columns are seeds. All rows have the same seeds. The 95 % interval comes from a
    bootstrap. The bootstrap resamples the same seeds in all rows. Each resample selects the best rates anew, so the
    interval includes the selection effect. Returns None for fewer than LEAST_SEEDS seeds, and if a median is 0 or not
    finite.
    """
    seeds = min((len(values) for values in (*own, *base)), default=0)
    if seeds < LEAST_SEEDS or not (own and base):
        return None
    drawn = np.random.default_rng(RESAMPLED_BY).integers(seeds, size=(RESAMPLES, seeds))
    sides = [np.array([values[:seeds] for values in side], dtype=np.float64) for side in (own, base)]
    found = [float(np.median(side, axis=1).min()) for side in sides]
    if not all(math.isfinite(value) and value > 0 for value in found):
        return None
    lowest = [np.median(side[:, drawn], axis=2).min(axis=0) for side in sides]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = lowest[0] / lowest[1]
    if np.isnan(ratios).any():
        return None
    low, high = np.quantile(ratios, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="nearest")
    return Range(found[0] / found[1], float(low), float(high))


def notes(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[str]:
    """Return remarks on the table: what is not compared, and what failed."""
    lines = []
    if key := incomparable(sweep, OTHER_LOSS):
        lines.append(f"losses of different `{key}` are not of the same, and not compared")
    elif key := incomparable(sweep, OTHER_IMAGE):
        known = any(run.error is not None for run in runs)
        advice = "not compared" if known else "raise run.final_spp until that makes no difference"
        lines.append(f"losses of different `{key}` have each one's own noise, and what its paths lack: {advice}")
    lines += _outermost(sweep, runs)
    failed = [run for run in runs if run.status == "failed"]
    lines += [f"{run.name} failed: {run.message}" for run in failed[:MOST_NAMED]]
    if len(failed) > MOST_NAMED:
        lines.append(f"and so did {len(failed) - MOST_NAMED} more")
    return lines


def _outermost(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[str]:
    """Return one line for each best learning rate that lies at an end of the tried range. A better rate may lie
    beyond.
    """
    found: dict[str, None] = {}
    rates = [key for key in sweep.keys if is_rate(key)]
    for of in OTHERS if rates else ():
        bests = list(_groups(sweep, _paired(sweep, runs, of)))
        if rates == sweep.keys:
            bests = [record.best for record in best_records(sweep, runs) if record.of == of]
        for key, each in ((key, each) for key in rates for each in sweep.combinations if each.name in bests):
            tried = [other.settings[key] for other in sweep.combinations]
            if all(isinstance(value, int | float) for value in tried) and each.settings[key] in (
                min(tried),
                max(tried),
            ):
                best = shorten(label(each.settings), LABEL_WIDTH)
                found[f"{best}: this {key} is the best by {of}, and the outermost that was tried"] = None
    return list(found)


# --- the table on the terminal ----------------------------------------------------------------------------------------


def figures_of(runs: Sequence[SweepRunRecord]) -> dict[str, str]:
    """Return the titles of the columns of results, by field name. If no error is known, there is no column for
    errors.
    """
    found = {
        name: title for name, title in FIGURES.items() if name != "error" or any(run.error is not None for run in runs)
    }
    if any(run.relative for run in runs):
        found["error"] = "relative error"
    return found


#: Titles of the columns of ratios.
RATIOS = {"loss_ratio": "loss ratio", "error_ratio": "error ratio"}
RATIOS_LINE = "ratios: medians over that of the first line that can be compared, with 95 % intervals (bootstrap)"


def row_figures(records: Sequence[SweepRowRecord], runs: Sequence[SweepRunRecord]) -> dict[str, str]:
    """Return the titles of the columns for combinations. A column for iterations exists only if the numbers of
    iterations differ. A column for ratios exists only if a ratio is known.
    """
    found = {"iterations": "iterations"} if len({run.iterations for run in runs if run.is_done}) > 1 else {}
    ratios = {name: title for name, title in RATIOS.items() if any(getattr(record, name) for record in records)}
    return found | figures_of(runs) | ratios


def lines(sweep: SweepPlan, runs: Sequence[SweepRunRecord]) -> list[str]:
    """Return the table with one line per combination, the best combinations, and remarks."""
    records = row_records(sweep, runs)
    keys, figures, short = sweep.keys, row_figures(records, runs), short_keys(sweep.keys)
    rows: list[tuple[str, ...]] = [(*(short[key] for key in keys), "runs", *figures.values())]
    for row in records:
        values = [shorten(in_words(row.settings[key]), VALUE_WIDTH) for key in keys]
        bands = [cell(name, getattr(row, name)) for name in figures]
        rows.append((*values, f"{row.runs} of {row.of}" + (f", {row.failed} failed" if row.failed else ""), *bands))
    told = table(rows)
    told.append("medians over the seeds, in brackets the least and the greatest")
    told += [RATIOS_LINE] if RATIOS.keys() & figures.keys() else []
    return [*told, *(best.line for best in best_records(sweep, runs)), *notes(sweep, runs)]


def cell(name: str, band: Band | Range | None) -> str:
    """Return a median or a ratio as text. The ends of its band or interval follow if the ends differ."""
    if band is None:
        return ""
    write = {"elapsed_s": duration, "peak_mib": lambda size: f"{number(size)} MiB"}.get(name, lambda v: number(v, 4))
    middle = band.median if isinstance(band, Band) else band.value
    return write(middle) if band.low == band.high else \
        f"{write(middle)} [{write(band.low)}, {write(band.high)}]"  # fmt: skip
