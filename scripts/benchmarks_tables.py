"""Tables in Markdown, made of the records that `reslrb` and `scripts/benchmarks measure` write."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Record:
    """A file of measurements: where it comes from, and its other lines."""

    origin: Row
    rows: Sequence[Row]

    @property
    def command(self) -> str:
        """The command, as it can be typed into a shell."""
        return shlex.join(self.origin["command"])


def read(file: Path) -> Record:
    """A record, whose first line says where it comes from. Raises OSError and ValueError."""
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    if not lines or lines[0].get("kind") != "origin":
        raise ValueError(f"{file} does not begin with a line that says where it comes from")
    return Record(lines[0], [line for line in lines if line.get("kind") != "origin"])


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with a heading for each column."""
    lines = ["|".join(f" {cell} " if cell else " " for cell in cells) for cells in [head, *rows]]
    lines.insert(1, "|".join("---" for _ in head))
    return "\n".join(f"|{line}|" for line in lines)


def name_of(row: Row) -> str:
    """What was measured, `reslrb`'s estimators without its name."""
    name = row["estimator"] or row["integrator"]
    return f"`{name}`" + (f" of {row['capacity']}" if row.get("capacity") not in (None, 1) else "")


def figure(value: float | None, digits: int = 3) -> str:
    """So many digits of a figure, without exponents where it is not far from 1; empty where there is none."""
    if value is None:
        return ""
    whole = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in whole and abs(value) < 1e6 else whole


def bench_ratios(record: Record, swept: str, what: str = "kernel_ms") -> str:
    """Medians over those of `ptracer`, a column for each value of what is swept, and the range of the peaks."""
    values = sorted({row[swept] for row in record.rows})
    base = {row[swept]: row for row in record.rows if row["integrator"] == "ptracer"}
    lines = []
    for name, of in _by_name(record.rows, swept).items():
        cells = [_over(of.get(value), base.get(value), what) for value in values]
        lines.append([name, *cells, _peaks([row for row in of.values() if row["status"] == "ok"])])
    words = {"max_depth": "depth", "spp": "spp"}[swept]
    return table([words, *map(str, values), "peak memory, MiB"], lines)


def bench_conditions(record: Record, swept: str) -> str:
    """What all lines of a bench have in common, but for what is swept."""
    row = next((row for row in record.rows if row["status"] == "ok"), record.rows[0])
    parts = [f"film {row['width']}x{row['height']}"]
    parts += [] if swept == "spp" else [f"{row['spp']} spp"]
    parts += [] if swept == "max_depth" else [f"depth {row['max_depth']}"]
    parts += [f"{row['texels']} texels"] if row.get("texels") else []
    return ", ".join(parts)


def bench_details(record: Record, swept: str) -> str:
    """Every line of a bench: times with their least and greatest, and memory."""
    head = ("depth" if swept == "max_depth" else swept, "", "step, ms", "kernels, ms", "first step, s", "peak, MiB",
            "scratch of a path, B", "n")  # fmt: skip
    lines = []
    for row in record.rows:
        cells = [str(row[swept]), name_of(row)]
        if row["status"] != "ok":
            lines.append([*cells, row["status"].replace("_", " "), "", "", "", "", ""])
            continue
        memory = [f"{row['peak_mib']:.1f}", str(row["scratch_bytes"]), str(row["repeats"])]
        times = [_spread(row["step_ms"]), _spread(row["kernel_ms"]), f"{row['cold_ms'] / 1e3:.2f}"]
        lines.append([*cells, *times, *memory])
    return table(head, lines)


def gradcheck_line(record: Record) -> list[str]:
    """What all comparisons of a gradcheck come to: verdicts, and the largest figures beside their limits."""
    rows = [row for row in record.rows if "verdict" in row]
    of_means = [row for row in rows if row["kind"] == "expectation" and row["z_rms"] is not None]
    equal = [row["relative_l2"] for row in rows if row["kind"] == "equal_seeds" and row["relative_l2"] is not None]
    cells = [str(max(row["seeds"] for row in rows)), f"{sum(row['holds'] is True for row in rows)} of {len(rows)}"]
    cells.append(str(sum(row["holds"] is False for row in rows)))
    for what in ("z_rms", "z_max"):  # closest to its limit
        row = max(of_means, key=lambda row: row[what] / row[f"{what}_limit"], default=None)
        cells.append("" if row is None else f"{row[what]:.2f} ({row[f'{what}_limit']:.2f})")
    return [*cells, f"{max(equal):.1e}" if equal else ""]


def run_errors(record: Record, moment: str) -> str:
    """The parameters' errors at `initial` or `final`, each in its own unit; with its name where there are several."""
    errors = record.rows[0]["parameter_rmse"]
    if len(errors) == 1:
        return figure(next(iter(errors.values()))[moment])
    names = [key.split(".")[0] for key in errors]
    if len(set(names)) < len(names):  # several of one object
        names = [".".join(key.split(".")[:2]) for key in errors]
    return "; ".join(f"{name} {figure(of[moment])}" for name, of in zip(names, errors.values(), strict=True))


def paths(record: Record) -> str:
    """The paths of a run by `reslrb`; empty where that is not recorded, as before there were others."""
    row = record.rows[0]
    name, share = row.get("paths"), row.get("light_share")
    if name is None:
        return ""
    words = name if share in (None, 0, 1) else f"{share:.0%} light"
    return words + ", guided" * bool(row["guided"])


def took(record: Record) -> str:
    """The seconds of a run's iterations, as a whole number of at least one."""
    return f"{max(record.rows[0]['elapsed_s'], 1):.0f} s"


def _by_name(rows: Sequence[Row], swept: str) -> dict[str, dict[int, Row]]:
    found: dict[str, dict[int, Row]] = {}
    for row in rows:
        found.setdefault(name_of(row), {})[row[swept]] = row
    return found


def _over(row: Row | None, base: Row | None, what: str) -> str:
    if row is None or row["status"] != "ok":
        return "" if row is None else row["status"].replace("_", " ")
    if base is None or base["status"] != "ok":
        return ""
    return f"{row[what]['median'] / base[what]['median']:.2f}"


def _peaks(rows: Sequence[Row]) -> str:
    peaks = [f"{row['peak_mib']:.1f}" for row in rows]
    return " to ".join(dict.fromkeys(pick(peaks, key=float) for pick in (min, max))) if peaks else ""


def _spread(times: Row) -> str:
    return f"{times['median']:.1f} [{times['min']:.1f}, {times['max']:.1f}]"
