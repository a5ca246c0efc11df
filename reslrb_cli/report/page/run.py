"""Parts of the page of one run: its results, its settings, its machine, its times and its measurements."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from markupsafe import Markup

from reslrb_cli.config.files import duration
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.images import load_image
from reslrb_cli.records.measurements import incomplete_records
from reslrb_cli.records.run_folder import FABRICATION_FILE, workshop_file
from reslrb_cli.report.format import count, number
from reslrb_cli.report.page.images import image_rows, seen_table, view_table
from reslrb_cli.report.page.layout import lay_out, soft
from reslrb_cli.report.page.values import convergence, parameter_table, texture_pictures
from reslrb_cli.report.page.workshop import CAPTIONS, VIEWS, workshop
from reslrb_cli.report.run_summary import error_line, free_command, outcome_of, warnings
from reslrb_cli.report.sources import ShownRun
from reslrb_cli.report.spread import misfit_lines

#: Number of first steps left out of medians, because they compile kernels.
WARM_UP = 5


def step_words(records: Sequence[Mapping[str, Any]]) -> str:
    """Return the median time of a step in words. The first steps do not count. The result is empty if unknown."""
    known = [record["step_ms"] for record in records[WARM_UP:] or records if record.get("step_ms") is not None]
    return f"{duration(statistics.median(known) / 1e3)} (median)" if known else ""


def _wall(manifest: Mapping[str, Any]) -> str:
    try:
        start, end = (datetime.fromisoformat(str(manifest.get(key))) for key in ("started", "ended"))
    except ValueError:
        return ""
    pauses = ", and the time in which it was not at work" if manifest.get("resumed") else ""
    return f"{duration((end - start).total_seconds())}, with its images and files{pauses}"


DAMAGED = "This part cannot be shown: what was recorded of it is damaged."


def fabrication(run: ShownRun) -> Markup:
    """Return the workshop sheet for the run's solid. The result is empty without one."""
    text = read_text(run.path / FABRICATION_FILE)
    if not text:
        return Markup()
    numbers = json.loads(text)
    files = {name: run.path / "images" / f"{workshop_file(name)}.exr" for name in (*CAPTIONS, *VIEWS)}
    pictures = {name: image for name, file in files.items() if (image := load_image(file)) is not None}
    return workshop(numbers, pictures)


def header(run: ShownRun) -> Markup:
    """Return the run's name, its outcome in a sentence, what to do next, its results and its warnings."""
    found = outcome_of(run.manifest, run.results, str(run.path))
    status = run.manifest.get("status", "unknown")
    return (
        lay_out("header", run.name, status, found.grade, found.sentence)
        + lay_out("next_step", found.proposal, found.command)
        + outcome(run)
    )


def outcome(run: ShownRun) -> Markup:
    """Return the results, the error and the warnings of a run."""
    seconds, loss = run.last("elapsed_s"), run.results.get("loss")
    parts = (
        "" if seconds is None else f"{count(run.iterations, 'iteration')} in {duration(seconds)}",
        "" if loss is None else f"loss {number(loss)}",
        error_line(run.results),
    )
    lines, error = warnings(run.results, "±"), run.manifest.get("error")
    lead = lay_out("paragraph", ", ".join(part for part in parts if part))
    return lead + lay_out("note", [error] if error else [], "failed") + lay_out("note", lines)


def run_parts(run: ShownRun) -> dict[str, Markup]:
    """Return the parts of a run below its header, by title and in order. Parts that do not apply are empty."""
    results, manifest = run.results, run.manifest
    parts: dict[str, Callable[[], Markup]] = {
        "Images": lambda: image_rows(run),
        "Parameters": lambda: (
            parameter_table(results, "now" if run.at_work else "end")
            + Markup().join(soft(found.line()) for found in incomplete_records(run.manifest.get("incomplete") or ()))
            + lay_out("run.certainty", results.get("certainty") or {})
            + lay_out("run.misfit", misfit_lines(results), free_command(manifest, str(run.path)))
        ),
        "Fabrication": lambda: fabrication(run),
        "Views": lambda: view_table(run.manifest.get("views"), results),
        "Errors as people see them": lambda: seen_table(results),
        "Textures": lambda: texture_pictures(run),
        "Convergence": lambda: convergence(run),
        "Not finite": lambda: lay_out("run.not_finite", results.get("nonfinite") or {}),
        "Regularizers": lambda: lay_out("run.regularized", results.get("regularized") or {}),
        "Run": lambda: lay_out("run.run", run, step_words(run.records), _wall(manifest)),
        "Plan": lambda: lay_out("run.plan", plan["rows"]) if (plan := manifest.get("plan")) else Markup(),
        "Choice of the samples": lambda: Markup().join(
            soft(Decision.from_json(each).line(cost=True)) for each in manifest.get("decisions") or ()
        ),
        "Scale of the parameters": lambda: lay_out("run.scaling", manifest.get("scaling") or []),
        "Configuration": lambda: lay_out("pre", read_text(run.path / "config.yaml")),
    }
    return {title: guarded(make) for title, make in parts.items()}


def guarded(make: Callable[[], Markup]) -> Markup:
    """Return the result of `make`. If `make` raises an exception, return a line that says that data are damaged.

    A manifest can be damaged or of another version. One damaged part must not prevent the display of the other parts.
    """
    try:
        return make()
    except Exception:
        return lay_out("note", [DAMAGED])


def read_text(path: Path) -> str:
    """Return the text of a file. The result is empty without one."""
    from reslrb_cli.config.files import read_file

    try:
        return read_file(path).decode("utf-8", errors="replace")
    except ConfigError:
        return ""
