"""What scripts/gpu_check found, as a section of docs/benchmarks.md."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
RECORDS, FILE_NAME = ROOT / "docs" / "benchmarks", "gpu.json"
#: The parts whose results the section shows.
SHOWN = ("steps", "figure 6")
STEPS_HEAD = [
    "Single steps. Thread-local memory: bytes of one thread as its kernel declares them, and by what the device's free",
    "memory fell beyond what arrays take (code is in it too).",
    "",
    "| experiment | estimator | depth | first ms | step ms | kernels ms | peak MiB | of a thread, B | device MiB |",
    "|---|---|---|---|---|---|---|---|---|",
]
#: Lines that are kept of the output of a part that failed.
KEPT = 25


@dataclass
class Part:
    """What came of one part: `status` is ok, failed, timed out or skipped; `output` is the end of a failure's log."""

    name: str
    command: list[str]
    status: str
    seconds: float
    reason: str = ""
    output: list[str] = field(default_factory=list)
    results: Any = None


def tail(log: Path) -> list[str]:
    """The last lines of a log."""
    return log.read_text(encoding="utf-8", errors="replace").splitlines()[-KEPT:]


def section(found: dict[str, Any]) -> str:
    """The section, in Markdown: the parts, then time and memory of steps, then those against depth."""
    results = {part["name"]: part["results"] for part in found["parts"]}
    options = f"--variant {found['variant']}" + (" --quick" if found["quick"] else "")
    lines = [f"### {found['device']}", "", f"`scripts/gpu_check {options}`, {found['variant']}:", ""]
    lines += ["| part | | s |", "|---|---|---|"]
    for part in found["parts"]:
        reason = f": {part['reason']}" if part["reason"] else ""
        lines.append(f"| {part['name']} | {part['status']}{reason} | {part['seconds']:.0f} |")
    steps = (results.get("steps") or {}).get("steps", [])
    if steps:
        lines += ["", *STEPS_HEAD]
        lines += [_step(row) for row in steps]
    rows = results.get("figure 6") or []
    if rows:
        lines += ["", "Time of kernels in ms, and peak of arrays in MiB, against depth (Figure 6):", "", *_depths(rows)]
    return "\n".join(lines) + "\n"


def _step(row: dict[str, Any]) -> str:
    device = "" if row["device_mib"] is None else f"{row['device_mib']:.1f}"
    times = f"{row['cold_ms']:.0f} | {row['step_ms']:.2f} | {row['kernel_ms']:.2f}"
    memory = f"{row['peak_mib']:.1f} | {row['scratch_bytes']} | {device}"
    return f"| {row['config']} | `{row['estimator']}` | {row['max_depth']} | {times} | {memory} |"


def _depths(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each integrator, a column for each depth."""
    depths = sorted({row["max_depth"] for row in rows})
    lines = ["| | " + " | ".join(str(depth) for depth in depths) + " |", "|---" * (len(depths) + 1) + "|"]
    for name in dict.fromkeys((row["integrator"], row["estimator"]) for row in rows):
        cells = []
        for depth in depths:
            of = [r for r in rows if (r["integrator"], r["estimator"]) == name and r["max_depth"] == depth]
            cells.append("" if not of else _cell(of[0]))
        lines.append(f"| `{':'.join(part for part in name if part)}` | " + " | ".join(cells) + " |")
    return lines


def _cell(row: dict[str, Any]) -> str:
    if row["status"] != "ok":
        return str(row["status"]).replace("_", " ")
    return f"{row['kernel_ms']['median']:.2f}, {row['peak_mib']:.1f}"


def record(found: dict[str, Any], folder: Path = RECORDS) -> None:
    """Keep what the section needs of what was found, for `scripts/benchmarks write`."""
    parts = [
        part | {"output": [], "results": part["results"] if part["name"] in SHOWN else None} for part in found["parts"]
    ]
    text = json.dumps(found | {"parts": parts}, indent=1) + "\n"
    (folder / FILE_NAME).write_text(text, encoding="utf-8")


def gpu_section(folder: Path = RECORDS) -> str:
    """The section from the record that is kept; where there is none, a line that says so."""
    file = folder / FILE_NAME
    if not file.exists():
        return "No figure on this page is from a GPU so far."
    return section(json.loads(file.read_text(encoding="utf-8"))).rstrip("\n")
