#!/usr/bin/env python3
"""Writes docs/benchmarks.md and the README's results from the records in docs/benchmarks/.

`scripts/benchmarks` runs it. Prose comes from docs/benchmarks/page.md, figures from the records: no figure in these
tables is typed. The tables in Markdown that docs/paper.md is made of are here too.
"""

from __future__ import annotations

import difflib
import json
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

from benchmarks_measure import (
    CHECKED,
    EXPERIMENTS,
    EXTREME,
    MEASUREMENTS,
    OTHERS,
    RECORDS,
    ROOT,
    experiment_record,
    measure,
    stale,
)

Row = Mapping[str, Any]
PAGE, README, TEMPLATE = ROOT / "docs" / "benchmarks.md", ROOT / "README.md", "page.md"
#: Where a table stands in the template, in a line of its own, and between what in the README.
PLACE = re.compile(r"^\{\{ (\w+) \}\}$", re.MULTILINE)
BLOCK = re.compile(r"<!-- benchmarks: (\w+) -->\n.*?<!-- end -->", re.DOTALL)
#: Columns of the README's text.
WIDTH = 120
#: What the README says of each experiment.
ABOUT = {
    "cornell_floor": "a carpet of 64 x 64 texels",
    "caustic_slab": "a print below rippled glass",
    "grey_room": "a furnished room lit through windows",
    "furnace": "the walls of a closed sphere",
    "lens_pose": "a lens's place, and its tilt in degrees",
    "caustic_heightmap": "the relief of a glass face",
    "mixed_room": "the printed wall of a room with a caustic and a mirror, and a sofa",
    "paper/figure1": "the relief of a glass face, finely",
    "stiff/lamp": "albedo, and intensity",
    "stiff/plate": "roughness, and radiance",
    "stiff/wall": "73,728 texels, and one number",
}


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


def commit_of(origin: Row) -> str:
    """Return the commit that a record was measured at, and what is not certain about it."""
    if origin.get("commit") is None:
        return "a commit that is not known"
    changed = {True: "", False: " with changes that were not committed", None: " (not recorded; from the history)"}
    return f"commit `{origin['commit']}`{changed[origin.get('clean')]}"


def measured_at(origins: Mapping[str, Row]) -> str:
    """Return a sentence that says at which commit the records of these names were measured."""
    names: dict[str, list[str]] = {}
    for name, origin in origins.items():
        names.setdefault(commit_of(origin), []).append(f"`{name}`")
    parts = [commit if len(names) == 1 else f"{commit}: {', '.join(of)}" for commit, of in names.items()]
    return fill(f"Measured at {'; '.join(parts)}.", WIDTH, break_long_words=False, break_on_hyphens=False)


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


def paths_of(record: Record) -> str:
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


class Blocks:
    """The pieces that are made of the records in a folder, by their names."""

    def __init__(self, folder: Path = RECORDS) -> None:
        self.folder = folder
        self.makers: dict[str, Callable[[], str]] = {
            "machine": self.machine,
            "depth": lambda: self._bench("depth", "max_depth"),
            "depth_ratios": lambda: self._ratios("depth", "max_depth"),
            "spp": lambda: self._bench("spp", "spp"),
            "spp_ratios": lambda: self._ratios("spp", "spp"),
            "moving": lambda: self._bench("moving", "max_depth"),
            "moving_ratios": lambda: self._ratios("moving", "max_depth"),
            "gradcheck": self.gradcheck,
            "extreme": self.extreme,
            "experiments": self.experiments,
            "others": self.others,
            "runs": self.runs,
            "gpu": self.gpu,
        }

    def make(self, name: str) -> str:
        """A piece, in Markdown; where nothing of it is recorded, a line that says so. Raises KeyError, OSError."""
        try:
            return self.makers[name]()
        except FileNotFoundError as error:
            return f"Not recorded so far; `scripts/benchmarks measure {Path(error.filename).stem}` does that."

    def record(self, name: str) -> Record:
        """The record of a measurement."""
        return read(self.folder / MEASUREMENTS[name].file.name)

    def about(self, name: str, conditions: str = "") -> str:
        """The command that was measured, how long it took, and under what conditions."""
        record = self.record(name)
        took = f"This took {record.origin['seconds']:.0f} s at {commit_of(record.origin)}"
        return f"    {record.command}\n\n{took}{conditions and f'; {conditions}'}:"

    def gpu(self) -> str:
        """Return what `scripts/gpu_check` recorded on a GPU."""
        file = self.folder / "gpu.md"
        if not file.exists():
            return "No figure on this page is from a GPU so far."
        return file.read_text(encoding="utf-8").rstrip()

    def machine(self) -> str:
        """What all records were measured on."""
        found = []
        for file in sorted(self.folder.glob("*.jsonl")):
            origin = read(file).origin
            versions = ", ".join(f"{package} {version}" for package, version in origin["versions"].items())
            found.append(f"{origin['device']}, {origin['variant']}; {versions}; {origin['platform']}")
        return "\n".join(f"- {words}" for words in dict.fromkeys(found))

    def gradcheck(self) -> str:
        """A line for each scene whose gradients were compared."""
        head = ("command", "seeds", "hold", "fail", "z rms (limit)", "max abs z (limit)", "equal seeds, relative L2")
        records = {
            name: self.record(f"gradcheck_{name}")
            for name in CHECKED if (self.folder / f"gradcheck_{name}.jsonl").exists()
        }  # fmt: skip
        rows = [[f"`{record.command}`", *gradcheck_line(record)] for record in records.values()]
        return self._with_commits(table(head, rows), records)

    def extreme(self) -> str:
        """Return what the extreme suite comes to, by its page, and by its record where there is one."""
        rows = [line for line in EXTREME.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
        notes = [" ".join(re.findall(r"\*\*(.*?)\*\*", row)) for row in rows]
        kinds = (": roughness", ": image", "no reference: expectation")
        roughness, image, left_out = (sum(kind in note for note in notes) for kind in kinds)
        found, origin = f"{len(rows)} scenes: none fails", {}
        if (self.folder / MEASUREMENTS["extreme"].file.name).exists():
            record = self.record("extreme")
            counts, origin = record.rows[0], record.origin
            hold, compared, fail = (counts[name] for name in ("hold", "comparisons", "fail"))
            found = f"{len(rows)} scenes: {hold} of {compared} comparisons hold, {fail} fail"
        text = (
            "`reslrb gradcheck --suite extreme` ([docs/extreme.md](docs/extreme.md)) compares every estimator, and "
            f"`stack` on both kinds of paths and on camera paths alone, in {found}. The roughness of `principled` "
            f"stays open in {roughness} scenes, because its lobes are chosen. An image of camera paths stays open in "
            f"{image}. "
            f"Camera paths are left out of {left_out} scenes, whose light they do not find, or too rarely. "
            f"Measured at {commit_of(origin)}."
        )
        return fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)

    def experiments(self) -> str:
        """The README's table of whole runs."""
        return self._ends({experiment_record(name): f"`{name}`: {ABOUT[name]}" for name in self.recorded()})

    def others(self) -> str:
        """The README's table of whole runs by other integrators."""
        return self._ends({name: words for name, (words, _) in OTHERS.items()})

    def _ends(self, runs: Mapping[str, str]) -> str:
        """Errors at the start and at the end of runs, by the names of their records, and what they are called."""
        head = ("experiment", "parameter RMSE, start", "end", "time", "command that prints it")
        rows, records = [], {name.removeprefix("optimize_"): self.record(name) for name in runs}
        for words, record in zip(runs.values(), records.values(), strict=True):
            errors = [run_errors(record, moment) for moment in ("initial", "final")]
            rows.append([words, *errors, took(record), f"`{record.command}`"])
        return self._with_commits(table(head, rows), records)

    def _with_commits(self, text: str, records: Mapping[str, Record]) -> str:
        return f"{text}\n\n{measured_at({name: record.origin for name, record in records.items()})}"

    def runs(self) -> str:
        """Time and memory of whole runs, and the paths that they have."""
        head = ("run", "iterations", "spp", "a step, ms", "iterations in all, s", "with everything, s", "peak, MiB",
                "estimator", "paths")  # fmt: skip
        rows, records = [], {name: self.record(experiment_record(name)) for name in self.recorded()}
        for name, record in records.items():
            row, paths = record.rows[0], paths_of(record)
            rows.append([
                f"`{name}`", str(row["iterations"]), str(row["spp"]),
                figure(row["step_ms"]), figure(row["elapsed_s"]), f"{record.origin['seconds']:.0f}",
                f"{row['peak_mib']:.1f}", f"`{row['estimator']}`" if row["estimator"] else "", paths,
            ])  # fmt: skip
        return self._with_commits(table(head, rows), records)

    def recorded(self) -> list[str]:
        """The experiments that have been recorded: those of many minutes may come later."""
        return [name for name in EXPERIMENTS if (self.folder / f"{experiment_record(name)}.jsonl").exists()]

    def _bench(self, name: str, swept: str) -> str:
        record = self.record(name)
        about = self.about(name, bench_conditions(record, swept))
        return f"{about}\n\n{bench_details(record, swept)}"

    def _ratios(self, name: str, swept: str) -> str:
        record = self.record(name)
        return self._with_commits(bench_ratios(record, swept), {name: record})


def page(blocks: Blocks) -> str:
    """docs/benchmarks.md."""
    text = (RECORDS / TEMPLATE).read_text(encoding="utf-8")
    return PLACE.sub(lambda match: blocks.make(match[1]), text)


def readme(blocks: Blocks, text: str) -> str:
    """The README with its tables made anew."""

    def made(match: re.Match[str]) -> str:
        return f"<!-- benchmarks: {match[1]} -->\n{blocks.make(match[1])}\n<!-- end -->"

    return BLOCK.sub(made, text)


def write() -> None:
    """Write the page and the README's  Raises OSError."""
    blocks = Blocks()
    PAGE.write_text(page(blocks), encoding="utf-8")
    README.write_text(readme(blocks, README.read_text(encoding="utf-8")), encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Do what the first argument says; the exit code."""
    what, *names = arguments
    if what != "measure" and names:
        print(f"benchmarks: {what} takes no names", file=sys.stderr)
        return 2
    for name in names:
        if name not in MEASUREMENTS:
            near = difflib.get_close_matches(name, MEASUREMENTS, n=1, cutoff=0)[0]
            print(f"benchmarks: there is no measurement `{name}`; did you mean {near}?", file=sys.stderr)
            return 2
    if what == "list":
        for measurement in MEASUREMENTS.values():
            print(f"{measurement.name:28} {shlex.join(measurement.command)}")
        return 0
    if what == "stale":
        lines = stale()
        print("\n".join(lines) or "no record is older than the code that it measures")
        return 1 if lines else 0
    if what == "measure":
        for name in names or MEASUREMENTS:
            measure(MEASUREMENTS[name])
    write()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
