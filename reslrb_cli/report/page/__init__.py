"""`report.html`: one page about one run, complete in itself: no script, no network, no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.metrics import read_metrics
from reslrb_cli.report.page import facts
from reslrb_cli.report.page.curves import convergence
from reslrb_cli.report.page.images import image_rows
from reslrb_cli.report.page.markup import note, section, text
from reslrb_cli.report.page.style import STYLE
from reslrb_cli.report.page.values import parameter_table, texture_pictures
from reslrb_cli.report.run_table import units_differ
from reslrb_cli.report.verdict import error_line, warnings
from reslrb_cli.report.words import count, duration, number

#: What the page may load: nothing but what it holds. Were markup to slip in by a name, it could do nothing.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def write_report(folder: Path) -> Path:
    """Write `report.html` into a run folder from what the folder holds; return its path.

    Images are embedded, so the page can be moved away from the run. What the folder lacks, as that of a run that failed
    does, is left out.
    """
    page = render_page(folder)
    path = folder / "report.html"
    write_atomically(path, lambda file: file.write(page.encode("utf-8", "replace")))
    return path


def render_page(folder: Path) -> str:
    """The page of a run folder as HTML."""
    manifest, records = read_manifest(folder) or {}, read_metrics(folder)
    results = manifest.get("results") or {}
    scales = {key: about.get("scale") for key, about in (results.get("parameters") or {}).items()}
    body = [
        _header(folder.name, manifest, records),
        section("Parameters", parameter_table(results), _over_what(results)),
        section("Images", image_rows(folder / "images", results)),
        section("Textures", texture_pictures(folder / "parameters", results)),
        section("Convergence", convergence(records, scales, units_differ(results))),
        section("Not finite", facts.not_finite(results.get("nonfinite"))),
        section("Clamped gradients", facts.clamped(results.get("clamped"))),
        section("Run", facts.run_facts(manifest, records)),
        section("Choice of the estimator", facts.pilot_table(manifest.get("pilot"))),
        section("Bias of correlated samples", facts.correlated_bias_table(manifest.get("correlated_bias"))),
        section("Scale of the parameters", facts.scaling_table(manifest.get("scaling"))),
        section("Memory budget", facts.memory_table(manifest.get("memory"))),
        section("Configuration", f"<pre>{text(_read(folder / 'config.yaml'))}</pre>"),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        f"<title>{text(folder.name)}</title><style>{STYLE}</style></head>\n"
        f"<body>{''.join(body)}</body></html>\n"
    )


def _header(name: str, manifest: Mapping[str, Any], records: Sequence[Mapping[str, Any]]) -> str:
    """The run's name, how it ended, what it came to, and what went wrong."""
    status, results = str(manifest.get("status", "unknown")), manifest.get("results") or {}
    parts = [f"{count(len(records), 'iteration')} in {duration(records[-1]['elapsed_s'])}"] if records else []
    parts += [f"loss {number(results['loss'])}"] if results.get("loss") is not None else []
    parts += [line for line in [error_line(results)] if line]
    lead = f'<p class="lead">{text(", ".join(parts))}</p>' if parts else ""
    head = f'<header><h1>{text(name)}</h1><span class="status {text(status)}">{text(status)}</span></header>'
    failed = note(text(manifest["error"]), kind="failed") if manifest.get("error") else ""
    return head + lead + failed + note(*map(text, warnings(results, "±")))


def _over_what(results: Mapping[str, Any]) -> str:
    """What the errors are taken over."""
    if not results.get("parameter_rmse"):
        return ""
    words = "Errors are root mean squares over the entries that light and sensor reach, in the parameter's unit"
    words += "; relative ones are shares of the root mean square of the truth." if units_differ(results) else "."
    return f'<p class="soft small">{text(words)}</p>'


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
