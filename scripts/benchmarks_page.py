#!/usr/bin/env python3
"""Measure the figures of docs/benchmarks.md and of the README's results, and write these tables from the records in
docs/benchmarks/.

The text comes from docs/benchmarks/page.md, and the figures come from the records. No figure in these tables is typed
by hand. Measure on a machine that does nothing else. This script also makes the Markdown tables of docs/paper.md.
"""

from __future__ import annotations

import argparse
import difflib
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
    MEASUREMENTS,
    OTHERS,
    RECORDS,
    ROOT,
    experiment_record,
    gallery_picture,
    measure,
    open_comparisons,
    read_lines,
    stale,
    table,
)

Row = Mapping[str, Any]
PAGE, README, TEMPLATE = ROOT / "docs" / "benchmarks.md", ROOT / "README.md", "page.md"
GALLERY = ROOT / "docs" / "gallery.md"
#: The place of a table, in a line of its own of the template, and between two comments of the README.
PLACE = re.compile(r"^\{\{ (\w+) \}\}$", re.MULTILINE)
BLOCK = re.compile(r"<!-- benchmarks: (\w+) -->\n.*?<!-- end -->", re.DOTALL)
#: Columns of the README's text.
WIDTH = 120
#: The setting that each `reslrb bench` varies: its name in the records, and its heading.
SWEPT = {"depth": ("max_depth", "depth"), "spp": ("spp", "spp"), "moving": ("max_depth", "depth")}


@dataclass(frozen=True)
class Record:
    """File of measurements: its origin, and its other lines."""

    origin: Row
    rows: Sequence[Row]

    @property
    def command(self) -> str:
        """Command as a user types it into a shell."""
        return shlex.join(self.origin["command"])


def read(file: Path) -> Record:
    """Return the record in a file. The first line of the file contains the origin. Raises OSError."""
    origin, *rows = read_lines(file)
    return Record(origin, [row for row in rows if row.get("kind") != "origin"])


def commit_of(origin: Row) -> str:
    """Return the commit at which a record was measured, with a note if the state of the code is uncertain."""
    if origin.get("commit") is None:
        return "a commit that is not known"
    changed = {True: "", False: " with changes that were not committed", None: " (not recorded; from the history)"}
    return f"commit `{origin['commit']}`{changed[origin.get('clean')]}"


def measured_at(origins: Mapping[str, Row]) -> str:
    """Return a sentence that lists the commits at which the records with these names were measured."""
    names: dict[str, list[str]] = {}
    for name, origin in origins.items():
        names.setdefault(commit_of(origin), []).append(f"`{name}`")
    parts = [commit if len(names) == 1 else f"{commit}: {', '.join(of)}" for commit, of in names.items()]
    return _filled(f"Measured at {'; '.join(parts)}.")


def _filled(text: str) -> str:
    return fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def name_of(row: Row) -> str:
    """Return the name of an integrator. For an estimator of `reslrb`, this is the name of the estimator alone."""
    return f"`{row['label'].removeprefix('reslrb:')}`"


def figure(value: float | None, digits: int = 3) -> str:
    """Return a figure with this number of significant digits. Figures below 1e6 have no positive exponent. Without a
    figure, the text is empty.
    """
    if value is None:
        return ""
    whole = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in whole and abs(value) < 1e6 else whole


def bench_ratios(record: Record, swept: str, times: str = "kernel_ms") -> str:
    """Return a table of kernel times, or of other `times`, divided by those of `ptracer`. The table has a column for
    each value of the sweep, and a column with the range of the peaks.
    """
    key, head = SWEPT[swept]
    values = sorted({row[key] for row in record.rows})
    found: dict[str, dict[int, Row]] = {}
    for row in record.rows:
        found.setdefault(name_of(row), {})[row[key]] = row
    base = {row[key]: row for row in record.rows if row["label"] == "ptracer"}
    lines = []
    for name, of in found.items():
        peaks = sorted(row["peak_mib"] for row in of.values() if row["status"] == "ok")
        ends = " to ".join(dict.fromkeys(f"{peak:.1f}" for peak in (*peaks[:1], *peaks[-1:])))
        lines.append([name, *(ratio(of.get(value), base.get(value), times) for value in values), ends])
    return table([head, *map(str, values), "peak memory, MiB"], lines)


def ratio(row: Row | None, base: Row | None, times: str) -> str:
    """Return the ratio of two medians. If a row has no median, return how the row ended. If there is nothing to
    compare, return an empty text.
    """
    if row is None or row["status"] != "ok":
        return "" if row is None else row["status"].replace("_", " ")
    if base is None or base["status"] != "ok":
        return ""
    return f"{row[times]['median'] / base[times]['median']:.2f}"


def bench_details(record: Record, swept: str) -> str:
    """Return a table of all lines of a bench: memory, and times with their minimum and maximum."""
    key, first = SWEPT[swept]
    head = (first, "", "step, ms", "kernels, ms", "first step, s", "peak, MiB", "scratch of a path, B", "n")

    def spread(times: Row) -> str:
        return f"{times['median']:.1f} [{times['min']:.1f}, {times['max']:.1f}]"

    lines = []
    for row in record.rows:
        if row["status"] == "ok":
            cells = [spread(row["step_ms"]), spread(row["kernel_ms"]), f"{row['cold_ms'] / 1e3:.2f}",
                     f"{row['peak_mib']:.1f}", str(row["scratch_bytes"]), str(row["repeats"])]  # fmt: skip
        else:
            cells = [row["status"].replace("_", " "), "", "", "", "", ""]
        lines.append([str(row[key]), name_of(row), *cells])
    return table(head, lines)


def gradcheck_line(record: Record) -> list[str]:
    """Return the verdicts of a gradcheck, and the figures that are closest to their limits."""
    rows = [row for row in record.rows if "verdict" in row]
    of_means = [row for row in rows if row["kind"] == "expectation" and row["z_rms"] is not None]
    equal = [row["relative_l2"] for row in rows if row["kind"] == "equal_seeds" and row["relative_l2"] is not None]
    cells = [str(max(row["seeds"] for row in rows)), f"{sum(row['holds'] is True for row in rows)} of {len(rows)}"]
    cells.append(str(sum(row["holds"] is False for row in rows)))
    for what in ("z_rms", "z_max"):
        row = max(of_means, key=lambda row: row[what] / row[f"{what}_limit"], default=None)
        cells.append("" if row is None else f"{row[what]:.2f} ({row[f'{what}_limit']:.2f})")
    return [*cells, f"{max(equal):.1e}" if equal else ""]


def run_errors(record: Record, moment: str) -> str:
    """Return the parameters' errors at the moment `initial` or `final`, each in its own unit. If there are several
    parameters, the text contains their names.
    """
    errors = record.rows[0]["parameter_rmse"]
    if len(errors) == 1:
        return figure(next(iter(errors.values()))[moment])
    names = [key.split(".")[0] for key in errors]
    if len(set(names)) < len(names):  # several of one object
        names = [".".join(key.split(".")[:2]) for key in errors]
    return "; ".join(f"{name} {figure(of[moment])}" for name, of in zip(names, errors.values(), strict=True))


def paths_of(record: Record) -> str:
    """Return a description of the paths of a run by `reslrb`. For other runs, return an empty text."""
    row = record.rows[0]
    name, share = row.get("paths"), row.get("light_share")
    if name is None:
        return ""
    words = name if share in (None, 0, 1) else f"{share:.0%} light"
    return words + ", guided" * bool(row["guided"])


class Blocks:
    """Parts of the pages that are made from the records in a folder. Each part has a name."""

    def __init__(self, folder: Path = RECORDS) -> None:
        self.folder = folder
        self.makers: dict[str, Callable[[], str]] = {
            "machine": self.machine,
            "gradcheck": self.gradcheck,
            "extreme": self.extreme,
            "experiments": self.experiments,
            "runs": self.runs,
            "gpu": self.gpu,
        }
        for name in SWEPT:
            self.makers |= {name: lambda of=name: self.bench(of), f"{name}_ratios": lambda of=name: self.ratios(of)}

    def make(self, name: str) -> str:
        """Return a part in Markdown. If its record does not exist, return a line that reports this. Raises KeyError,
        OSError.
        """
        try:
            return self.makers[name]()
        except FileNotFoundError as error:
            return f"Not recorded so far; `scripts/benchmarks measure {Path(error.filename).stem}` does that."

    def record(self, name: str) -> Record:
        """Return the record of a measurement."""
        return read(self.folder / f"{name}.jsonl")

    def recorded(self, names: Mapping[str, str]) -> dict[str, tuple[str, Record]]:
        """Return the description and the record for each name whose record exists. Other records may be measured
        later.
        """
        return {name: (words, self.record(name)) for name, words in names.items()
                if (self.folder / f"{name}.jsonl").exists()}  # fmt: skip

    def gpu(self) -> str:
        """Return the summary that `scripts/gpu_check` wrote on a GPU, or a sentence about its absence."""
        file = self.folder / "gpu.md"
        found = file.read_text(encoding="utf-8").rstrip() if file.exists() else ""
        return found or "No figure on this page is from a GPU so far."

    def machine(self) -> str:
        """Return a list of the machines of all records."""
        found = []
        for file in sorted(self.folder.glob("*.jsonl")):
            origin = read(file).origin
            versions = ", ".join(f"{package} {version}" for package, version in origin["versions"].items())
            found.append(f"- {origin['device']}, {origin['variant']}; {versions}; {origin['platform']}")
        return "\n".join(dict.fromkeys(found))

    def bench(self, name: str) -> str:
        """Return the command of a bench, its duration, the conditions that all its lines share, and all its lines."""
        record = self.record(name)
        row = next((row for row in record.rows if row["status"] == "ok"), record.rows[0])
        parts = {"spp": f"{row['spp']} spp", "max_depth": f"depth {row['max_depth']}"}
        conditions = [f"film {row['width']}x{row['height']}"]
        conditions += [words for key, words in parts.items() if key != SWEPT[name][0]]
        conditions += [f"{row['texels']} texels"] if row.get("texels") else []
        took = (
            f"This took {record.origin['seconds']:.0f} s at {commit_of(record.origin)}. Fixed: {', '.join(conditions)}."
        )
        return f"    {record.command}\n\n{took}\n\n{bench_details(record, name)}"

    def ratios(self, name: str) -> str:
        """Return the table of a bench's ratios."""
        record = self.record(name)
        return _with_commits(bench_ratios(record, name), {name: record})

    def gradcheck(self) -> str:
        """Return a table with a line for each scene whose gradients were compared."""
        head = ("command", "seeds", "hold", "fail", "z rms (limit)", "max abs z (limit)", "equal seeds, relative L2")
        found = dict(self.recorded({f"gradcheck_{name}": name for name in CHECKED}).values())
        rows = [[f"`{record.command}`", *gradcheck_line(record)] for record in found.values()]
        return _with_commits(table(head, rows), found)

    def extreme(self) -> str:
        """Return the result of the extreme suite: its counts, and what stays open."""
        record = self.record("extreme")
        counts = record.rows[0]
        left = counts["comparisons"] - counts["hold"] - counts["fail"]
        opened = f", {left} stay open: {'; '.join(open_comparisons(record.rows))}" if left else ""
        return _filled(
            "`reslrb gradcheck --suite extreme` compares the gradients of every estimator with references in "
            f"{counts['cases']} difficult scenes ([The extreme suite](docs/extreme.md)): {counts['hold']} of "
            f"{counts['comparisons']} comparisons hold, {counts['fail']} fail{opened}. "
            f"Measured at {commit_of(record.origin)}."
        )

    def experiments(self) -> str:
        """Return the README's table of complete runs: the experiments in `configs/`, and runs by other integrators."""
        shipped = {experiment_record(name): f"`{name}`: {words}" for name, words in EXPERIMENTS.items()}
        return self._ends(shipped | {name: words for name, (words, _) in OTHERS.items()})

    def _ends(self, names: Mapping[str, str]) -> str:
        """Return a table of errors at the start and at the end of runs. `names` maps the names of records to their
        descriptions.
        """
        head = ("experiment", "parameter RMSE, start", "end", "time", "command that prints it")
        rows, found = [], self.recorded(names)
        for words, record in found.values():
            errors = [run_errors(record, moment) for moment in ("initial", "final")]
            took = f"{max(record.rows[0]['elapsed_s'], 1):.0f} s"
            rows.append([words, *errors, took, f"`{record.command}`"])
        return _with_commits(table(head, rows), {name.removeprefix("optimize_"): of for name, (_, of) in found.items()})

    def runs(self) -> str:
        """Return a table of the time, memory and paths of complete runs."""
        head = ("run", "iterations", "spp", "a step, ms", "iterations in all, s", "with everything, s", "peak, MiB",
                "estimator", "paths")  # fmt: skip
        found = dict(self.recorded({experiment_record(name): name for name in EXPERIMENTS}).values())
        rows = []
        for name, record in found.items():
            row = record.rows[0]
            rows.append([
                f"`{name}`", str(row["iterations"]), str(row["spp"]), figure(row["step_ms"]), figure(row["elapsed_s"]),
                f"{record.origin['seconds']:.0f}", f"{row['peak_mib']:.1f}",
                f"`{row['estimator']}`" if row["estimator"] else "", paths_of(record),
            ])  # fmt: skip
        return _with_commits(table(head, rows), found)


def _with_commits(text: str, records: Mapping[str, Record]) -> str:
    return f"{text}\n\n{measured_at({name: record.origin for name, record in records.items()})}"


def page(blocks: Blocks) -> str:
    """Return the text of docs/benchmarks.md."""
    return PLACE.sub(lambda match: blocks.make(match[1]), (RECORDS / TEMPLATE).read_text(encoding="utf-8"))


def gallery(blocks: Blocks) -> str:
    """Return the text of docs/gallery.md: the picture, errors, costs and command of each experiment that has a
    picture.
    """
    parts = [
        "# Gallery\n\n"
        "This page shows every shipped experiment in `configs/`. Each picture has three images: the target,\n"
        "the image at the start of the run, and the image at its end. Copy an experiment with `reslrb example NAME`.\n"
    ]
    found = blocks.recorded({experiment_record(name): name for name in EXPERIMENTS if gallery_picture(name).exists()})
    for name, record in found.values():
        row, picture = record.rows[0], gallery_picture(name)
        start, end = (run_errors(record, moment) for moment in ("initial", "final"))
        parts.append(
            f"## `{name}`: {EXPERIMENTS[name]}\n\n"
            f"![Target, image at the start, image at the end]({picture.relative_to(GALLERY.parent).as_posix()})\n\n"
            f"- Parameter RMSE at the start: {start}. At the end: {end}.\n"
            f"- {row['iterations']} iterations of {row['spp']} samples per pixel in {max(row['elapsed_s'], 1):.0f} s, "
            f"{row['peak_mib']:.0f} MiB at most, on {record.origin['device']}.\n"
            f"- `{record.command}`\n"
        )
    return "\n".join([*parts, measured_at({name: record.origin for name, record in found.values()}) + "\n"])


def readme(blocks: Blocks, text: str) -> str:
    """Return the text of the README with new tables."""

    def made(match: re.Match[str]) -> str:
        return f"<!-- benchmarks: {match[1]} -->\n{blocks.make(match[1])}\n<!-- end -->"

    return BLOCK.sub(made, text)


def main(arguments: list[str]) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(prog="scripts/benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="the measurements, and the command of each")
    commands.add_parser("stale", help="records that are older than the code that they measure; exit code 1 if any")
    commands.add_parser("write", help="write README tables, docs/benchmarks.md and docs/gallery.md from the records")
    measuring = commands.add_parser("measure", help="all, or these, into docs/benchmarks/; then write")
    measuring.add_argument("names", nargs="*", metavar="NAME")
    options = parser.parse_args(arguments)
    if options.command == "list":
        print("\n".join(f"{name:28} {shlex.join(['reslrb', *words])}" for name, words in MEASUREMENTS.items()))
        return 0
    if options.command == "stale":
        lines = stale()
        print("\n".join(lines) or "no record is older than the code that it measures")
        return 1 if lines else 0
    if options.command == "measure":
        for name in [name for name in options.names if name not in MEASUREMENTS]:
            near = difflib.get_close_matches(name, MEASUREMENTS, n=1, cutoff=0)[0]
            print(f"benchmarks: there is no measurement `{name}`; did you mean {near}?", file=sys.stderr)
            return 2
        for name in options.names or MEASUREMENTS:
            measure(name, MEASUREMENTS[name])
    blocks = Blocks()
    PAGE.write_text(page(blocks), encoding="utf-8")
    GALLERY.write_text(gallery(blocks), encoding="utf-8")
    README.write_text(readme(blocks, README.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
