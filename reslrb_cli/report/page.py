"""`report.html`: one page about one run, complete in itself."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.metrics import read_metrics
from reslrb_cli.report.curves import draw_curves

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem }
svg { max-width: 100%; height: auto } figure { display: inline-block; margin: 0 1rem 1rem 0; vertical-align: top }
figure img { width: 256px; image-rendering: pixelated; border: 1px solid #ccc } figcaption { color: #555 }
table { border-collapse: collapse } td, th { text-align: left; padding: .15rem 1rem .15rem 0; vertical-align: top }
th { font-weight: 500; color: #555 } pre { background: #f5f5f5; padding: .8rem; overflow-x: auto }
"""


def write_report(folder: Path) -> Path:
    """Write `report.html` into a run folder from what the folder holds; return its path.

    Images are embedded, so the page can be moved away from the run.
    """
    manifest = read_manifest(folder) or {}
    parts = [
        f"<h1>{html.escape(folder.name)}</h1>",
        _summary(manifest),
        "<h2>Convergence</h2>",
        draw_curves(read_metrics(folder)) or "<p>No iteration was completed.</p>",
        _gallery("Images", folder / "images", sorted((folder / "images").glob("*.png"), key=_image_order)),
        _gallery("Parameters", folder / "parameters", _parameter_images(folder / "parameters")),
        "<h2>Run</h2>",
        _table(_flat(manifest)),
        "<h2>Configuration</h2>",
        f"<pre>{html.escape(_text(folder / 'config.yaml'))}</pre>",
    ]
    page = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(folder.name)}</title>'
        f"<style>{STYLE}</style></head>\n<body>{''.join(parts)}</body></html>\n"
    )
    path = folder / "report.html"
    write_atomically(path, lambda file: file.write(page.encode()))
    return path


def _summary(manifest: Mapping[str, Any]) -> str:
    error = f": {html.escape(manifest['error'])}" if manifest.get("error") else ""
    line = f"<p>Status: <b>{html.escape(str(manifest.get('status', 'unknown')))}</b>{error}</p>"
    results = manifest.get("results", {})
    line += _not_finite(results.get("nonfinite", {})) + _clamped(results.get("clamped", {}))
    errors = results.get("parameter_rmse", {})
    rows = "".join(
        f"<tr><td>{html.escape(key)}</td><td>{_number(entry['initial'])}</td><td>{_number(entry['final'])}</td></tr>"
        for key, entry in errors.items()
    )
    head = "<tr><th>parameter</th><th>initial RMSE</th><th>final RMSE</th></tr>"
    return line + (f"<table>{head}{rows}</table>" if rows else "")


def _not_finite(tally: Mapping[str, Any]) -> str:
    if not tally.get("iterations"):
        return ""
    rows = "".join(f"<li>{html.escape(key)}: {count}</li>" for key, count in tally["by_parameter"].items())
    text = f"{tally['values']} values were not finite, in {tally['iterations']} iterations; none reached a parameter."
    return f"<p>{text}</p><ul>{rows}</ul>"


def _clamped(tally: Mapping[str, Any]) -> str:
    if not tally.get("iterations"):
        return ""
    rows = "".join(f"<li>{html.escape(key)}: {_number(bias)}</li>" for key, bias in tally["bias"].items())
    text = f"{tally['entries']} entries of gradients were clamped, in {tally['iterations']} iterations."
    return f"<p>{text} Bias, as the share of the gradient that this took over the run:</p><ul>{rows}</ul>"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _image_order(path: Path) -> tuple[int, str]:
    """The initial image first, the target last, those in between by name."""
    kind = path.stem.split("-")[0]
    return {"initial": 0, "final": 2, "target": 3}.get(kind, 1), path.stem


def _parameter_images(folder: Path) -> list[Path]:
    """Of each texture the initial value, the final one, the true one where it is known, and the mask."""
    stems = sorted(path.stem for path in folder.glob("*.png") if not path.stem.endswith(".mask"))
    names = (name for stem in stems for name in (f"initial/{stem}", stem, f"true/{stem}", f"{stem}.mask"))
    return [path for name in names if (path := folder / f"{name}.png").exists()]


def _gallery(title: str, folder: Path, paths: list[Path]) -> str:
    figures = "".join(
        f'<figure><img src="data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}" alt="">'
        f"<figcaption>{html.escape(str(path.relative_to(folder).with_suffix('')))}</figcaption></figure>"
        for path in paths
    )
    return f"<h2>{title}</h2>{figures}" if figures else ""


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = " ".join(map(str, value)) if isinstance(value, list) else value
    return flat


def _table(values: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>{html.escape(key)}</th><td>{html.escape(str(value))}</td></tr>"
        for key, value in values.items()
        if value is not None
    )
    return f"<table>{rows}</table>"


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
