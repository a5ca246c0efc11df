"""The parts of the page that one run has: what it came to, what ran, on what, how long, and what it had measured."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from markupsafe import Markup
from pydantic import TypeAdapter

from reslrb_cli.config.files import duration
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.clock import SharedTime
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.images import load_image
from reslrb_cli.records.measurements import incomplete_records
from reslrb_cli.records.run_folder import FABRICATION_FILE, SOLID_PICTURE
from reslrb_cli.report.format import count, number
from reslrb_cli.report.page.images import image_rows, seen_tables, show, view_table
from reslrb_cli.report.page.layout import lay_out, soft
from reslrb_cli.report.page.values import convergence, parameter_table, texture_pictures
from reslrb_cli.report.run_summary import error_line, warnings
from reslrb_cli.report.sources import Run

#: Steps that are left out of medians: the first ones compile kernels.
WARM_UP = 5


@dataclass(frozen=True)
class StepParts:
    """Milliseconds of an iteration: medians without the first ones. Where image and gradient are one kernel, or cannot
    be told apart, `image` and `gradient` are None.

    `update` is what an iteration takes beside its step, on the average.
    """

    step: float
    image: float | None
    gradient: float | None
    update: float

    @classmethod
    def of(cls, records: Sequence[Mapping[str, Any]]) -> StepParts | None:
        """Of a run's records; None where there is none."""
        if not records:
            return None
        steady = records[WARM_UP:] or records
        outside = 1e3 * records[-1]["elapsed_s"] - sum(record["step_ms"] for record in records)
        return cls(
            _median(steady, "step_ms") or 0.0, _median(steady, "primal_ms"), _median(steady, "adjoint_ms"),
            max(outside / len(records), 0.0),
        )  # fmt: skip

    def words(self) -> str:
        """In a line."""
        named = ((self.image, "up to image and loss"), (self.gradient, "for the gradient"))
        parts = [f"{duration(part / 1e3)} {what}" for part, what in named if part is not None]
        return f"{duration(self.step / 1e3)} (median){': ' if parts else ''}{', '.join(parts)}"

    def by_place(self) -> dict[int, float]:
        """Milliseconds by the place of the part's name in `PARTS`."""
        if self.image is None or self.gradient is None:
            return {2: self.step, 3: self.update}
        return {0: self.image, 1: self.gradient, 3: self.update}


def _median(records: Sequence[Mapping[str, Any]], name: str) -> float | None:
    known = [record[name] for record in records if record.get(name) is not None]
    return statistics.median(known) if known else None


#: The parts of an iteration, by place.
PARTS = ("image and loss", "gradient", "whole step, not told apart", "update")


def bars(runs: Sequence[Run]) -> Markup:
    """An iteration of each run as a bar of its parts, all on one scale; nothing where none has an iteration."""
    known = [(run.name, step.by_place()) for run in runs if (step := StepParts.of(run.records)) is not None]
    longest = max((sum(parts.values()) for _, parts in known), default=0) or 1.0
    rows = [
        (name, sum(parts.values()) / 1e3, [(k, f"{100 * ms / longest:.3g}", ms / 1e3) for k, ms in parts.items()])
        for name, parts in known
    ]
    used = {place for _, parts in known for place, value in parts.items() if value > 0}
    return lay_out("run.bars", rows, PARTS, [name if place in used else "" for place, name in enumerate(PARTS)])


def _wall(manifest: Mapping[str, Any]) -> str:
    try:
        start, end = (datetime.fromisoformat(str(manifest.get(key))) for key in ("started", "ended"))
    except ValueError:
        return ""
    pauses = ", and the time in which it was not at work" if manifest.get("resumed") else ""
    return f"{duration((end - start).total_seconds())}, with its images and files{pauses}"


def workers(shared: Mapping[str, Any] | None, elapsed_s: float | None) -> Markup:
    """What the shards took that workers computed, by part and by worker, of all iterations; nothing without any."""
    if not shared:
        return Markup()
    time = TypeAdapter(SharedTime).validate_python(shared)
    parts = {
        "computing, the mean of the workers": time.computing_s,
        "waiting for the worker that had most": time.waiting_s,
        "sending and handing out": time.sending_s,
    }
    if elapsed_s is not None:
        parts["the rest of the iterations, here"] = max(elapsed_s - time.wall_s, 0.0)
    return lay_out("run.workers", time, parts, sum(parts.values()) or 1.0)


#: Bytes of a configuration that is shown, at most.
MOST_CONFIG = 2**20
DAMAGED = "This part cannot be shown: what was recorded of it is damaged."


def fabrication(run: Run) -> Markup:
    """The solid that a run shapes: what it throws, its measures, what was found where things are off, and a picture;
    nothing where there is none."""
    text = _read(run.path / FABRICATION_FILE)
    if not text:
        return Markup()
    numbers = json.loads(text)
    image = load_image(run.path / "images" / f"{SOLID_PICTURE}.exr")
    caption = lay_out("titled", f"the {numbers['kind']}", ", its first face in grazing light")
    shown = [] if image is None else [show(image, f"the solid of the {numbers['kind']}", caption)]
    return (
        lay_out("gallery", shown)
        + lay_out("run.fabrication", numbers)
        + lay_out("run.tolerances", numbers.get("tolerances") or {})
        + lay_out("note", numbers.get("warnings") or [])
    )


def header(run: Run) -> Markup:
    """The run's name, how it ended, what it came to, and what went wrong."""
    seconds, loss = run.last("elapsed_s"), run.results.get("loss")
    parts = (
        "" if seconds is None else f"{count(len(run.records), 'iteration')} in {duration(seconds)}",
        "" if loss is None else f"loss {number(loss)}",
        error_line(run.results),
    )
    lead = ", ".join(part for part in parts if part)
    return lay_out("header", run.name, run.manifest.get("status", "unknown"), lead) + problems(run)


def problems(run: Run) -> Markup:
    """What went wrong in a run, and what of its records could not be read."""
    lines, error = warnings(run.results, "±"), run.manifest.get("error")
    if run.damaged:
        where = f"{count(len(run.damaged), 'line')} of metrics.jsonl (the first is line {run.damaged[0]})"
        lines.append(f"{where} could not be read.")
    return lay_out("note", [error] if error else [], "failed") + lay_out("note", lines)


def run_parts(run: Run) -> dict[str, Markup]:
    """By title, what there is to show of a run beside its header, in order; what it does not have is empty."""
    results = run.results
    parts: dict[str, Callable[[], Markup]] = {
        "Parameters": lambda: (
            parameter_table(results, "now" if run.at_work else "end", notes=True)
            + Markup().join(soft(found.line()) for found in incomplete_records(run.manifest.get("incomplete") or ()))
            + lay_out("run.certainty", results.get("certainty") or {})
        ),
        "Images": lambda: image_rows(run),
        "Fabrication": lambda: fabrication(run),
        "Views": lambda: view_table(run.manifest.get("views"), results),
        "Errors as people see them": lambda: seen_tables([run]),
        "Textures": lambda: texture_pictures(run),
        "Convergence": lambda: convergence(run),
    }
    return {title: guarded(make) for title, make in parts.items()} | record_parts(run)


def record_parts(run: Run) -> dict[str, Markup]:
    """By title, those of the parts that tell how a run was done, of which nothing can be laid beside another run's."""
    results, manifest = run.results, run.manifest
    parts: dict[str, Callable[[], Markup]] = {
        "Not finite": lambda: lay_out("run.not_finite", results.get("nonfinite") or {}),
        "Clamped gradients": lambda: lay_out("run.clamped", results.get("clamped") or {}),
        "Regularizers": lambda: lay_out("run.regularized", results.get("regularized") or {}),
        "Run": lambda: lay_out("run.run", run, StepParts.of(run.records), _wall(manifest)),
        "Plan": lambda: lay_out("run.plan", plan["rows"]) if (plan := manifest.get("plan")) else Markup(),
        "Choice of the samples": lambda: Markup().join(
            soft(Decision.from_json(each).line(cost=True)) for each in manifest.get("decisions") or ()
        ),
        "Scale of the parameters": lambda: lay_out("run.scaling", manifest.get("scaling") or []),
        "Memory budget": lambda: lay_out("run.memory", kept) if (kept := manifest.get("memory")) else Markup(),
        "Workers": lambda: workers(manifest.get("shared"), run.last("elapsed_s")),
        "Configuration": lambda: lay_out("pre", _read(run.path / "config.yaml")),
    }
    return {title: guarded(make) for title, make in parts.items()}


def guarded(make: Callable[[], Markup]) -> Markup:
    """What `make` makes; where what it reads is damaged, or another version's, a line that says so.

    Whatever stands in a manifest comes from a file, and one part that cannot be shown is not to keep the others away.
    """
    try:
        return make()
    except Exception:
        return lay_out("note", [DAMAGED])


def _read(path: Path) -> str:
    from reslrb_cli.config.files import read_file

    try:
        return read_file(path, MOST_CONFIG).decode("utf-8", errors="replace")
    except ConfigError:
        return ""
