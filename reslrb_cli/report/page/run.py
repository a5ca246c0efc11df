"""The parts of the page that one run has.

- `bars`: what an iteration takes, by part, in words and as bars.
- `run_facts`, and the tables after it: what ran, on what, how long, and what was measured before it.
- `run_parts`: all parts of a run, by title.
"""

from __future__ import annotations

import shlex
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from markupsafe import Markup

from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.correlated_bias import CorrelatedBias, share_words
from reslrb_cli.records.decisions import EstimatorRecord, GuidedRecord, RivalRecord, SequenceRecord
from reslrb_cli.records.measurement_files import Origin
from reslrb_cli.report.format import count, duration, number
from reslrb_cli.report.page.images import image_rows, seen_tables, view_table
from reslrb_cli.report.page.layout import Words, facts, key, lay_out, soft, table
from reslrb_cli.report.page.values import convergence, parameter_table, texture_pictures
from reslrb_cli.report.run_summary import certainty_words, error_line, measured_line, units_differ, warnings
from reslrb_cli.report.sources import Run

#: Steps that are left out of medians: the first ones compile kernels.
WARM_UP = 5


@dataclass(frozen=True)
class StepParts:
    """Milliseconds of an iteration: medians without the first ones. Where image and gradient are one kernel, or cannot
    be told apart, `image` and `gradient` are None.

    `update` is what an iteration takes beside its step, on the average; `compile_s` all seconds in which kernels were
    generated and compiled.
    """

    step: float
    image: float | None
    gradient: float | None
    update: float
    compile_s: float

    @classmethod
    def of(cls, records: Sequence[Mapping[str, Any]]) -> StepParts | None:
        """Of a run's records; None where there is none."""
        if not records:
            return None
        steady = records[WARM_UP:] or records
        outside = 1e3 * records[-1]["elapsed_s"] - sum(record["step_ms"] for record in records)
        return cls(
            statistics.median(record["step_ms"] for record in steady),
            _median(steady, "primal_ms"),
            _median(steady, "adjoint_ms"),
            max(outside / len(records), 0.0),
            sum(record["codegen_ms"] for record in records) / 1e3,
        )

    def words(self) -> str:
        """In a line."""
        words = f"{duration(self.step / 1e3)} (median)"
        parts = [
            f"{duration(part / 1e3)} {what}"
            for part, what in ((self.image, "up to image and loss"), (self.gradient, "for the gradient"))
            if part is not None
        ]
        return f"{words}: {', '.join(parts)}" if parts else words


#: The parts of an iteration, by place.
PARTS = ("image and loss", "gradient", "whole step, not told apart", "update")


def bars(runs: Sequence[Run]) -> Markup:
    """An iteration of each run as a bar of its parts, all on one scale; nothing where none has an iteration."""
    known = [(run.name, _parts(parts)) for run in runs if (parts := StepParts.of(run.records)) is not None]
    if not known:
        return Markup()
    longest = max(sum(parts.values()) for _, parts in known) or 1.0
    rows = [
        (name, duration(sum(parts.values()) / 1e3), [
            (place, f"{100 * value / longest:.3g}", f"{PARTS[place]}: {duration(value / 1e3)}")
            for place, value in parts.items()
        ])
        for name, parts in known
    ]  # fmt: skip
    used = {place for _, parts in known for place, value in parts.items() if value > 0}
    return lay_out("bars", rows, {place: PARTS[place] for place in sorted(used)})


def _parts(parts: StepParts) -> dict[int, float]:
    """Milliseconds by the place of the part's name."""
    if parts.image is None or parts.gradient is None:
        return {2: parts.step, 3: parts.update}
    return {0: parts.image, 1: parts.gradient, 3: parts.update}


def _median(records: Sequence[Mapping[str, Any]], name: str) -> float | None:
    known = [record[name] for record in records if record.get(name) is not None]
    return statistics.median(known) if known else None


def run_facts(run: Run) -> Markup:
    """When, on what and how the run was, what it took, what it came to, and the commands that do it again."""
    manifest, records = run.manifest, run.records
    losses = (manifest.get("results") or {}).get("image_loss") or {}
    spp = f"{records[-1]['spp']} samples per pixel" if records else ""
    command, step = manifest.get("command_line") or [], StepParts.of(records)
    again = ["reslrb", "optimize", str(run.path.absolute() / "config.yaml")] if manifest.get("config") else []
    return facts(
        {
            "started": _moment(manifest.get("started")),
            "took": _wall(manifest),
            "iterations": ", ".join(part for part in (str(len(records)), spp) if part),
            "time in iterations": _total(records),
            "an iteration": "" if step is None else step.words(),
            "loss of the saved images": " → ".join(number(loss) for loss in losses.values() if loss is not None),
            "peak memory": f"{max(record['peak_mib'] for record in records):.4g} MiB" if records else "",
            **_hardware(manifest.get("device"), manifest.get("variant")),
            "seed": str(manifest.get("seed", "")),
            "configuration": key(manifest["config"]) if manifest.get("config") else "",
            "command line": key(shlex.join(map(str, command))) if command else "",
            **_again(again),
            **_software(manifest.get("versions") or {}, manifest.get("platform")),
        }
    )


def origin_facts(origin: Origin) -> Markup:
    """When and on what a file of measurements was made, the command that does it again, and versions."""
    return facts(
        {
            "written": _moment(origin.written),
            **_hardware(origin.device, origin.variant),
            **_again(origin.command),
            **_software(origin.versions, origin.platform),
        }
    )


def _hardware(device: object, variant: object) -> dict[str, Words]:
    return {"device": str(device or ""), "variant": str(variant or "")}


def _again(command: Sequence[str]) -> dict[str, Words]:
    return {"to do it again": key(shlex.join(command)) if command else ""}


def _software(versions: Mapping[str, str], platform: object) -> dict[str, Words]:
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    return {"versions": named, "platform": str(platform or "")}


def _moment(started: Any) -> str:
    return str(started).replace("T", " ").replace("+00:00", " UTC") if started else ""


def _wall(manifest: Mapping[str, Any]) -> str:
    try:
        start, end = (datetime.fromisoformat(str(manifest[key])) for key in ("started", "ended"))
    except (KeyError, ValueError):
        return ""
    pauses = ", and the time in which it was not at work" if manifest.get("resumed") else ""
    return f"{duration((end - start).total_seconds())}, with its images and files{pauses}"


def _total(records: Sequence[Mapping[str, Any]]) -> str:
    if not records:
        return ""
    codegen = sum(record["codegen_ms"] for record in records) / 1e3
    return f"{duration(records[-1]['elapsed_s'])}, of which {duration(codegen)} to generate and compile kernels"


def plan_table(plan: Mapping[str, Any] | None) -> Markup:
    """What a step is made of, and what the scene does not need of it."""
    if not plan:
        return Markup()
    rows = sorted(plan["rows"], key=lambda row: not row["needed"])
    cells = [[row["feature"], "yes" if row["needed"] else "left out", row["reason"]] for row in rows]
    return table(("part of a step", "needed", "why"), cells)


def pilot_table(pilot: Mapping[str, Any] | None) -> Markup:
    """What the pilot measured of each estimator, the most efficient first, and what it chose."""
    try:
        outcome = EstimatorRecord.from_json(dict(pilot or {}))
    except TypeError:  # there was none, or another version's
        return Markup()
    rows = sorted(outcome.rows, key=lambda row: -(row.efficiency or 0.0))
    best = rows[0].efficiency or 1.0 if rows else 1.0
    cells = []
    for row in rows:
        name = ", ".join([row.estimator, *(f"{key} {value}" for key, value in row.options.items())])
        share = None if row.efficiency is None else row.efficiency / best
        time = "" if row.kernel_ms is None else duration(row.kernel_ms / 1e3)
        cells.append([name, number(share, 3), number(row.variance, 3), time, str(row.rounds), row.note])
    head = ("estimator", "efficiency over the best", "variance", "kernels", "rounds", "note")
    return lay_out("paragraph", outcome.line(cost=True)) + table(head, cells)


def correlated_bias_table(measured: Mapping[str, Any] | None) -> Markup:
    """What was measured of the bias of `adjoint: correlated`, by parameter."""
    try:
        bias = CorrelatedBias.from_json(dict(measured or {}))
    except (TypeError, KeyError):  # there was none, or another version's
        return Markup()
    rows: list[list[Words]] = []
    for row in bias.parameters:
        what = "larger than the gradient" if row.exceeds else "of the gradient" if row.along else "not seen"
        rows.append([key(row.key), share_words(row, "±"), what])
    line = f"Measured at the start, in {bias.rounds} rounds of {bias.spp} samples per pixel."
    return lay_out("paragraph", bias.line() or line) + table(("parameter", "share of the gradient", "bias"), rows)


def scaling_table(scaling: Sequence[Mapping[str, Any]] | None) -> Markup:
    """What `scale: auto` measured of each parameter."""
    head = ("parameter", "value", "gradient", "noise of a step", "image change per unit", "curvature", "length",
            "first step")  # fmt: skip
    names = ("value", "gradient", "noise", "change", "curvature", "length", "first_step")
    return table(head, [[key(row["key"]), *(number(row.get(name), 3) for name in names)] for row in scaling or ()])


def memory_table(memory: Mapping[str, Any] | None) -> Markup:
    """How the memory budget was kept."""
    if not memory:
        return Markup()
    expected = sum(memory["expected_bytes"].values())
    return facts(
        {
            "budget": _mib(memory["budget_bytes"]),
            "passes": f"{memory['passes']} of {memory['samples_per_pass']} samples per pixel",
            "expected": _mib(expected),
            "used": f"{memory['peak_mib']:.4g} MiB" if memory.get("peak_mib") is not None else "",
            "kept": "no" if memory.get("exceeded") else "yes",
        }
    )


def _mib(count: float) -> str:
    return f"{count / 2**20:.4g} MiB"


def not_finite(tally: Mapping[str, Any] | None) -> Markup:
    """Values that were not finite, by parameter."""
    if not tally or not tally.get("iterations"):
        return Markup()
    rows: list[list[Words]] = [[key(name), str(amount)] for name, amount in tally["by_parameter"].items()]
    line = f"{tally['values']} values were not finite, in {tally['iterations']} iterations; none reached a parameter."
    return lay_out("paragraph", line) + table(("parameter", "values of gradients and updates"), rows)


def clamped(tally: Mapping[str, Any] | None) -> Markup:
    """Gradients that were clamped, and the bias that this made."""
    if not tally or not tally.get("iterations"):
        return Markup()
    rows: list[list[Words]] = [[key(name), number(bias)] for name, bias in tally["bias"].items()]
    line = f"{tally['entries']} entries of gradients were clamped, in {tally['iterations']} iterations."
    return lay_out("paragraph", line) + table(
        ("parameter", "bias, as the share of the gradient taken over the run"), rows
    )


#: Bytes of a configuration that is shown, at most.
MOST_CONFIG = 2**20
DAMAGED = "This part cannot be shown: what was recorded of it is damaged."


def header(run: Run) -> Markup:
    """The run's name, how it ended, what it came to, and what went wrong."""
    status, results, records = str(run.manifest.get("status", "unknown")), run.results, run.records
    parts = [f"{count(len(records), 'iteration')} in {duration(records[-1]['elapsed_s'])}"] if records else []
    parts += [f"loss {number(results['loss'])}"] if results.get("loss") is not None else []
    parts += [line for line in [error_line(results)] if line]
    return lay_out("header", run.name, status, ", ".join(parts)) + problems(run)


def problems(run: Run) -> Markup:
    """What went wrong in a run, and what of its records could not be read."""
    lines = warnings(run.results, "±")
    if run.damaged:
        where = f"{count(len(run.damaged), 'line')} of metrics.jsonl (the first is line {run.damaged[0]})"
        lines.append(f"{where} could not be read.")
    error = run.manifest.get("error")
    return lay_out("note", [error] if error else [], "failed") + lay_out("note", lines)


def run_parts(run: Run) -> dict[str, Markup]:
    """By title, what there is to show of a run beside its header, in order; what it does not have is empty."""
    results = run.results
    parts: dict[str, Callable[[], Markup]] = {
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


def record_parts(run: Run) -> dict[str, Markup]:
    """By title, those of the parts that tell how a run was done, of which nothing can be laid beside another run's."""
    results, manifest = run.results, run.manifest
    parts: dict[str, Callable[[], Markup]] = {
        "Not finite": lambda: not_finite(results.get("nonfinite")),
        "Clamped gradients": lambda: clamped(results.get("clamped")),
        "Run": lambda: run_facts(run),
        "Plan": lambda: plan_table(manifest.get("plan")),
        "Choice of the estimator": lambda: (
            pilot_table(manifest.get("pilot"))
            + soft(measured_line(GuidedRecord, manifest.get("guided")))
            + soft(measured_line(SequenceRecord, manifest.get("sequence")))
            + soft(measured_line(RivalRecord, manifest.get("rival")))
        ),
        "Bias of correlated samples": lambda: correlated_bias_table(manifest.get("correlated_bias")),
        "Scale of the parameters": lambda: scaling_table(manifest.get("scaling")),
        "Memory budget": lambda: memory_table(manifest.get("memory")),
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


def _over_what(results: Mapping[str, Any]) -> Markup:
    """What the errors are taken over."""
    words = "Errors are root mean squares over the entries that light and sensor reach, in the parameter's unit"
    words += "; relative ones are shares of the root mean square of the truth." if units_differ(results) else "."
    return soft(words if results.get("parameter_rmse") else "")


def _read(path: Path) -> str:
    from reslrb_cli.config.files import read_file

    try:
        return read_file(path, MOST_CONFIG).decode("utf-8", errors="replace")
    except ConfigError:
        return ""
