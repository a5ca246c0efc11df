"""What scripts/gpu_check found, as a section of docs/benchmarks.md."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGE = "docs/benchmarks.md"
BEGIN, END = "<!-- gpu_check: begin -->", "<!-- gpu_check: end -->"
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


def record(text: str, page: Path = ROOT / PAGE) -> None:
    """Put the section between its marks in the page, at its end where there are none."""
    old = page.read_text(encoding="utf-8")
    block = f"{BEGIN}\n{text}{END}\n"
    if BEGIN in old and END in old:
        before, after = old[: old.index(BEGIN)], old[old.index(END) + len(END) :].lstrip("\n")
        page.write_text(before + block + after, encoding="utf-8")
    else:
        page.write_text(old.rstrip("\n") + "\n\n" + block, encoding="utf-8")
