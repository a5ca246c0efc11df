"""Takes the measurements of docs/benchmarks/: runs `reslrb`, and keeps what it wrote, or of a run what it came to."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks_list import RECORDS, ROOT, Measurement

#: What of a run's manifest is kept: figures, not what the page of the run is for.
RESULTS = ("iterations", "loss", "elapsed_s", "rmse", "parameter_rmse", "relative_error", "worse")
PILOT = ("label", "advantage", "next_label", "measure_s", "compile_s", "share")
#: Iterations that the median step is taken without: they compile.
COLD = 5


def measure(measurement: Measurement) -> None:
    """Run the command and write its record; a record that there was stays where the command fails.

    Raises SystemExit.
    """
    with tempfile.TemporaryDirectory(prefix="reslrb-benchmarks-") as name:
        folder = Path(name)
        record = folder / "record.jsonl"
        kind = measurement.words[0]
        files = ["--set", f"run.output={folder}", "--set", "run.name=run"] if kind == "optimize" else ["--json", record]
        print(f"== {shlex.join(measurement.command)}", flush=True)
        start = time.monotonic()
        command = [sys.executable, "-m", "reslrb_cli", *measurement.words, *map(str, files)]
        # As on a new machine: no kernels of Dr.Jit, which lie below HOME, and no pilots have been kept.
        environment = os.environ | {"HOME": name, "RESLRB_CACHE": name}
        code = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
        seconds = time.monotonic() - start
        if code:
            raise SystemExit(f"benchmarks: {measurement.name}: exit code {code}; its record is left as it was")
        lines = run_lines(folder / "run") if kind == "optimize" else _read(record)
        lines[0] |= {"command": measurement.command, "seconds": round(seconds, 1)}
        RECORDS.mkdir(exist_ok=True)
        text = "".join(json.dumps(line) + "\n" for line in lines)
        measurement.file.write_text(text, encoding="utf-8")
        picture = record.with_suffix(".png")
        if measurement.name == "depth" and picture.exists():
            shutil.copy(picture, ROOT / "docs" / "images" / "bench.png")


def run_lines(folder: Path) -> list[dict[str, Any]]:
    """What a run came to, as the lines of a record: where it comes from, then its figures."""
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    steps = _read(folder / "metrics.jsonl")
    origin = {"kind": "origin"} | {name: manifest[name] for name in ("device", "variant", "versions", "platform")}
    results = {name: manifest["results"].get(name) for name in RESULTS}
    pilot = manifest.get("pilot")
    warm = steps[COLD:] or steps
    figures = {
        "kind": "run",
        **results,
        "spp": steps[-1]["spp"],
        "step_ms": statistics.median(step["step_ms"] for step in warm),
        "peak_mib": max(step["peak_mib"] for step in steps),
        "estimator": (manifest.get("plan") or {}).get("estimator"),
        **traced(manifest),
        "pilot": pilot and {name: pilot.get(name) for name in PILOT},
    }
    return [origin | {"written": manifest["started"]}, figures]


def traced(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Of a run by `reslrb`: its `paths`, which share of them are light paths, and whether these are guided."""
    rows = {row["feature"]: row for row in (manifest.get("plan") or {}).get("rows") or ()}
    camera = rows.get("camera paths")
    if camera is None:
        return {"paths": None, "light_share": None, "guided": None}
    paths = re.match(r"paths: (\w+)", camera["reason"])[1] if camera["needed"] else "light"
    chosen = (manifest.get("paths") or {}).get("light_share")
    share = {"light": 1.0, "camera": 0.0}.get(paths, chosen)
    return {"paths": paths, "light_share": share, "guided": rows["guided emission"]["needed"]}


def _read(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
