"""What ran, on what, how long, and what was measured before it, as tables."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from reslrb_cli.optimization.correlated_bias import CorrelatedBias, share_words
from reslrb_cli.optimization.pilot_records import Outcome
from reslrb_cli.records.origin import Origin
from reslrb_cli.report.page.markup import breakable, facts, table, text
from reslrb_cli.report.page.steps import StepParts
from reslrb_cli.report.sources import Run
from reslrb_cli.report.words import duration, number


def run_facts(run: Run) -> str:
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
            "iterations": text(", ".join(part for part in (str(len(records)), spp) if part)),
            "time in iterations": _total(records),
            "an iteration": "" if step is None else text(step.words()),
            "loss of the saved images": text(" → ".join(number(loss) for loss in losses.values() if loss is not None)),
            "peak memory": text(f"{max(record['peak_mib'] for record in records):.4g} MiB") if records else "",
            **_hardware(manifest.get("device"), manifest.get("variant")),
            "seed": text(manifest.get("seed", "")),
            "configuration": breakable(manifest.get("config") or ""),
            "command line": breakable(shlex.join(map(str, command))) if command else "",
            **_again(again),
            **_software(manifest.get("versions") or {}, manifest.get("platform")),
        }
    )


def origin_facts(origin: Origin) -> str:
    """When and on what a file of measurements was made, the command that does it again, and versions."""
    return facts(
        {
            "written": _moment(origin.written),
            **_hardware(origin.device, origin.variant),
            **_again(origin.command),
            **_software(origin.versions, origin.platform),
        }
    )


def _hardware(device: object, variant: object) -> dict[str, str]:
    return {"device": text(device or ""), "variant": text(variant or "")}


def _again(command: Sequence[str]) -> dict[str, str]:
    return {"to do it again": breakable(shlex.join(command)) if command else ""}


def _software(versions: Mapping[str, str], platform: object) -> dict[str, str]:
    named = ", ".join(f"{name} {version}" for name, version in versions.items())
    return {"versions": text(named), "platform": text(platform or "")}


def _moment(started: Any) -> str:
    return text(str(started).replace("T", " ").replace("+00:00", " UTC")) if started else ""


def _wall(manifest: Mapping[str, Any]) -> str:
    try:
        start, end = (datetime.fromisoformat(str(manifest[key])) for key in ("started", "ended"))
    except (KeyError, ValueError):
        return ""
    pauses = ", and the time in which it was not at work" if manifest.get("resumed") else ""
    return text(f"{duration((end - start).total_seconds())}, with its images and files{pauses}")


def _total(records: Sequence[Mapping[str, Any]]) -> str:
    if not records:
        return ""
    codegen = sum(record["codegen_ms"] for record in records) / 1e3
    return text(f"{duration(records[-1]['elapsed_s'])}, of which {duration(codegen)} to generate and compile kernels")


def plan_table(plan: Mapping[str, Any] | None) -> str:
    """What a step is made of, and what the scene does not need of it."""
    if not plan:
        return ""
    rows = sorted(plan["rows"], key=lambda row: not row["needed"])
    cells = [[text(row["feature"]), "yes" if row["needed"] else "left out", text(row["reason"])] for row in rows]
    return table(("part of a step", "needed", "why"), cells)


def pilot_table(pilot: Mapping[str, Any] | None) -> str:
    """What the pilot measured of each estimator, the most efficient first, and what it chose."""
    try:
        outcome = Outcome.from_json(dict(pilot or {}))
    except (TypeError, KeyError):  # there was none, or another version's
        return ""
    rows = sorted(outcome.rows, key=lambda row: -(row.efficiency or 0.0))
    best = rows[0].efficiency or 1.0 if rows else 1.0
    cells = []
    for row in rows:
        name = ", ".join([row.estimator, *(f"{key} {value}" for key, value in row.options.items())])
        share = None if row.efficiency is None else row.efficiency / best
        time = "" if row.kernel_ms is None else duration(row.kernel_ms / 1e3)
        cells.append([text(name), *map(text, (number(share, 3), number(row.variance, 3), time, row.rounds, row.note))])
    head = ("estimator", "efficiency over the best", "variance", "kernels", "rounds", "note")
    return f"<p>{text(outcome.line())}</p>" + table(head, cells)


def correlated_bias_table(measured: Mapping[str, Any] | None) -> str:
    """What was measured of the bias of `adjoint: correlated`, by parameter."""
    try:
        bias = CorrelatedBias.from_json(dict(measured or {}))
    except (TypeError, KeyError):  # there was none, or another version's
        return ""
    rows = []
    for row in bias.parameters:
        what = "larger than the gradient" if row.exceeds else "of the gradient" if row.along else "not seen"
        rows.append([breakable(row.key), text(share_words(row, "±")), text(what)])
    line = f"Measured at the start, in {bias.rounds} rounds of {bias.spp} samples per pixel."
    return f"<p>{text(bias.line() or line)}</p>" + table(("parameter", "share of the gradient", "bias"), rows)


def scaling_table(scaling: Sequence[Mapping[str, Any]] | None) -> str:
    """What `scale: auto` measured of each parameter."""
    head = (
        "parameter",
        "value",
        "gradient",
        "noise of a step",
        "image change per unit",
        "curvature",
        "length",
        "first step",
    )
    names = ("value", "gradient", "noise", "change", "curvature", "length", "first_step")
    rows = [[breakable(row["key"]), *(text(number(row.get(name), 3)) for name in names)] for row in scaling or ()]
    return table(head, rows)


def memory_table(memory: Mapping[str, Any] | None) -> str:
    """How the memory budget was kept."""
    if not memory:
        return ""
    expected = sum(memory["expected_bytes"].values())
    return facts(
        {
            "budget": _mib(memory["budget_bytes"]),
            "passes": text(f"{memory['passes']} of {memory['samples_per_pass']} samples per pixel"),
            "expected": _mib(expected),
            "used": text(f"{memory['peak_mib']:.4g} MiB") if memory.get("peak_mib") is not None else "",
            "kept": "no" if memory.get("exceeded") else "yes",
        }
    )


def _mib(count: float) -> str:
    return text(f"{count / 2**20:.4g} MiB")


def not_finite(tally: Mapping[str, Any] | None) -> str:
    """Values that were not finite, by parameter."""
    if not tally or not tally.get("iterations"):
        return ""
    rows = [[breakable(key), text(count)] for key, count in tally["by_parameter"].items()]
    line = f"{tally['values']} values were not finite, in {tally['iterations']} iterations; none reached a parameter."
    return f"<p>{text(line)}</p>" + table(("parameter", "values of gradients and updates"), rows)


def clamped(tally: Mapping[str, Any] | None) -> str:
    """Gradients that were clamped, and the bias that this made."""
    if not tally or not tally.get("iterations"):
        return ""
    rows = [[breakable(key), text(number(bias))] for key, bias in tally["bias"].items()]
    line = f"{tally['entries']} entries of gradients were clamped, in {tally['iterations']} iterations."
    return f"<p>{text(line)}</p>" + table(("parameter", "bias, as the share of the gradient taken over the run"), rows)
