"""What a page shows of several runs and measurements: what can be compared in one picture, then each by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from reslrb_cli.report.page.curves import convergence_of_all
from reslrb_cli.report.page.drawing import mark
from reslrb_cli.report.page.images import image_rows
from reslrb_cli.report.page.markup import breakable, folded, table, text
from reslrb_cli.report.page.measured import HEADINGS, measured
from reslrb_cli.report.page.run import guarded, problems, record_parts
from reslrb_cli.report.page.seen import seen_tables
from reslrb_cli.report.page.steps import StepParts, bars
from reslrb_cli.report.page.values import parameter_table, texture_pictures
from reslrb_cli.report.sources import Run, Source
from reslrb_cli.report.verdict import worst
from reslrb_cli.report.words import duration, number

#: Names in the title of a page.
MOST_NAMED = 3


Parts = list[tuple[str, str]]


def several_parts(sources: Sequence[Source]) -> tuple[str, str, Parts]:
    """The title of a page about `sources`, its head, and its parts: titles and markup."""
    names = [source.name for source in sources]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    title = ", ".join(names[:MOST_NAMED]) + more
    runs = [source for source in sources if isinstance(source, Run)]
    parts = run_comparison(runs) if runs else []
    for source in sources:
        if not isinstance(source, Run):
            parts.append((f"{HEADINGS[source.kind]}: {source.name}", guarded(partial(measured, source))))
    for run in runs:
        own = record_parts(run)
        facts = own.pop("Run")
        folds = [folded(name, markup) for name, markup in own.items()]
        parts.append((f"Run {run.name}", guarded(partial(problems, run)) + facts + "".join(folds)))
    return title, f"<header><h1>{text(title)}</h1></header>", parts


def run_comparison(runs: Sequence[Run]) -> Parts:
    """The parts in which runs lie beside each other."""
    made: dict[str, Callable[[], str]] = {
        "Runs": lambda: overview(runs),
        "Convergence": lambda: convergence_of_all(runs),
        "Time of an iteration": lambda: bars(runs),
        "Images": lambda: _each(runs, image_rows),
        "Errors as people see them": lambda: seen_tables(runs),
        "Parameters": lambda: _each(runs, lambda run: parameter_table(run.results)),
        "Textures": lambda: _each(runs, lambda run: texture_pictures(run.path / "parameters", run.results)),
    }
    return [(title, guarded(make)) for title, make in made.items()]


def overview(runs: Sequence[Run]) -> str:
    """A line for each run: how it ended, what it came to, and what an iteration took."""
    head = (
        "run",
        "status",
        "estimator",
        "iterations",
        "time",
        "loss",
        "parameter error",
        "an iteration",
        "peak memory",
    )
    return table(head, [_line(run, place) for place, run in enumerate(runs)], "overview")


def _line(run: Run, place: int) -> list[str]:
    records, results, step = run.records, run.results, StepParts.of(run.records)
    losses = [record["loss"] for record in records if record["loss"] is not None]
    loss = results["loss"] if results.get("loss") is not None else losses[-1] if losses else None
    cells: list[Any] = [
        run.manifest.get("status", "unknown"),
        _estimator(run),
        len(records),
        duration(records[-1]["elapsed_s"]) if records else "",
        number(loss),
        _error(run),
        "" if step is None else duration(step.step / 1e3),
        f"{max(record['peak_mib'] for record in records):.4g} MiB" if records else "",
    ]
    return [mark(place) + breakable(run.name), *map(text, cells)]


def _estimator(run: Run) -> str:
    """What computed the gradients, as far as the manifest says."""
    pilot, plan = run.manifest.get("pilot"), run.manifest.get("plan")
    if isinstance(pilot, dict):
        return str(pilot.get("label", ""))
    return str(plan.get("estimator") or plan.get("integrator") or "") if isinstance(plan, dict) else ""


def _error(run: Run) -> str:
    """The error of all parameters at the end; where their units differ, that of the worst as a share of the truth."""
    total = run.results.get("rmse") or {}
    if total.get("final") is not None:
        return f"RMSE {number(total['final'], 3)}"
    key = worst(run.results)
    if key is not None:
        return f"{number(run.results['relative_error'][key]['final'], 3)} of the truth at worst"
    known = [record["parameter_rmse"] for record in run.records if record["parameter_rmse"] is not None]
    return f"RMSE {number(known[-1], 3)}" if known else ""


def _each(runs: Sequence[Run], make: Callable[[Run], str]) -> str:
    """What is made of each run, below its name; where that is damaged, a line that says so."""
    made = [(run, guarded(partial(make, run))) for run in runs]
    return "".join(f"<h3>{breakable(run.name)}</h3>{markup}" for run, markup in made if markup)
