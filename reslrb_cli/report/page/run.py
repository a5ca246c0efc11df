"""The parts of the page that one run has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from reslrb_cli.errors import ConfigError
from reslrb_cli.records.paid import GuidedRecord, SequenceRecord
from reslrb_cli.report.certainty import certainty_words, paid_line, rival_line
from reslrb_cli.report.page import facts
from reslrb_cli.report.page.curves import convergence
from reslrb_cli.report.page.images import image_rows
from reslrb_cli.report.page.markup import note, soft, text
from reslrb_cli.report.page.seen import seen_tables
from reslrb_cli.report.page.values import parameter_table, texture_pictures
from reslrb_cli.report.page.views import view_table
from reslrb_cli.report.run_table import units_differ
from reslrb_cli.report.sources import Run
from reslrb_cli.report.verdict import error_line, warnings
from reslrb_cli.report.words import count, duration, number

#: Bytes of a configuration that is shown, at most.
MOST_CONFIG = 2**20
DAMAGED = "This part cannot be shown: what was recorded of it is damaged."


def header(run: Run) -> str:
    """The run's name, how it ended, what it came to, and what went wrong."""
    status, results, records = str(run.manifest.get("status", "unknown")), run.results, run.records
    parts = [f"{count(len(records), 'iteration')} in {duration(records[-1]['elapsed_s'])}"] if records else []
    parts += [f"loss {number(results['loss'])}"] if results.get("loss") is not None else []
    parts += [line for line in [error_line(results)] if line]
    lead = f'<p class="lead">{text(", ".join(parts))}</p>' if parts else ""
    title = f'<header><h1>{text(run.name)}</h1><span class="status {text(status)}">{text(status)}</span></header>'
    return title + lead + problems(run)


def problems(run: Run) -> str:
    """What went wrong in a run, and what of its records could not be read."""
    failed = note(text(run.manifest["error"]), kind="failed") if run.manifest.get("error") else ""
    lines = [f"{number_} could not be read." for number_ in [_lines(run)] if number_]
    return failed + note(*map(text, [*warnings(run.results, "±"), *lines]))


def _lines(run: Run) -> str:
    if not run.damaged:
        return ""
    return f"{count(len(run.damaged), 'line')} of metrics.jsonl (the first is line {run.damaged[0]})"


def run_parts(run: Run) -> dict[str, str]:
    """By title, what there is to show of a run beside its header, in order; what it does not have is empty."""
    results = run.results
    parts: dict[str, Callable[[], str]] = {
        "Parameters": lambda: (
            parameter_table(results, "now" if run.at_work else "end")
            + _over_what(results)
            + soft(certainty_words(results))
        ),
        "Images": lambda: image_rows(run),
        "Views": lambda: view_table(run.manifest.get("views"), results),
        "Errors as people see them": lambda: seen_tables([run]),
        "Textures": lambda: texture_pictures(run.path / "parameters", results, run.current),
        "Convergence": lambda: convergence(run),
    }
    return {title: guarded(make) for title, make in parts.items()} | record_parts(run)


def record_parts(run: Run) -> dict[str, str]:
    """By title, those of the parts that tell how a run was done, of which nothing can be laid beside another run's."""
    results, manifest = run.results, run.manifest
    parts: dict[str, Callable[[], str]] = {
        "Not finite": lambda: facts.not_finite(results.get("nonfinite")),
        "Clamped gradients": lambda: facts.clamped(results.get("clamped")),
        "Run": lambda: facts.run_facts(run),
        "Plan": lambda: facts.plan_table(manifest.get("plan")),
        "Choice of the estimator": lambda: (
            facts.pilot_table(manifest.get("pilot"))
            + soft(paid_line(GuidedRecord, manifest.get("guided")))
            + soft(paid_line(SequenceRecord, manifest.get("sequence")))
            + soft(rival_line(manifest.get("rival")))
        ),
        "Bias of correlated samples": lambda: facts.correlated_bias_table(manifest.get("correlated_bias")),
        "Scale of the parameters": lambda: facts.scaling_table(manifest.get("scaling")),
        "Memory budget": lambda: facts.memory_table(manifest.get("memory")),
        "Configuration": lambda: f"<pre>{text(_read(run.path / 'config.yaml'))}</pre>",
    }
    return {title: guarded(make) for title, make in parts.items()}


def guarded(make: Callable[[], str]) -> str:
    """What `make` makes; where what it reads is damaged, or another version's, a line that says so.

    Whatever stands in a manifest comes from a file, and one part that cannot be shown is not to keep the others away.
    """
    try:
        return make()
    except Exception:
        return note(DAMAGED)


def _over_what(results: Mapping[str, Any]) -> str:
    """What the errors are taken over."""
    if not results.get("parameter_rmse"):
        return ""
    words = "Errors are root mean squares over the entries that light and sensor reach, in the parameter's unit"
    words += "; relative ones are shares of the root mean square of the truth." if units_differ(results) else "."
    return soft(words)


def _read(path: Path) -> str:
    from reslrb_cli.config.files import read_file

    try:
        return read_file(path, MOST_CONFIG).decode("utf-8", errors="replace")
    except ConfigError:
        return ""
