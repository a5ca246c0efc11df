"""docs/benchmarks.md and the README's results: prose from docs/benchmarks/page.md, figures from the records there."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from textwrap import fill

import benchmarks_tables as tables
from benchmarks_list import CHECKED, EXPERIMENTS, MEASUREMENTS, OTHERS, RECORDS, ROOT, experiment_record

PAGE, README, TEMPLATE = ROOT / "docs" / "benchmarks.md", ROOT / "README.md", "page.md"
#: Where a table stands in the template, in a line of its own, and between what in the README.
PLACE = re.compile(r"^\{\{ (\w+) \}\}$", re.MULTILINE)
BLOCK = re.compile(r"<!-- benchmarks: (\w+) -->\n.*?<!-- end -->", re.DOTALL)
#: When `integrator.paths: auto` became the default: runs that were recorded before are of light paths alone.
AUTO_SINCE = "2026-11-23T08:05"
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
            "experiments": self.experiments,
            "others": self.others,
            "paths": self.paths,
            "runs": self.runs,
            "gpu": self.gpu,
        }

    def make(self, name: str) -> str:
        """A piece, in Markdown; where nothing of it is recorded, a line that says so. Raises KeyError, OSError."""
        try:
            return self.makers[name]()
        except FileNotFoundError as error:
            return f"Not recorded so far; `scripts/benchmarks measure {Path(error.filename).stem}` does that."

    def record(self, name: str) -> tables.Record:
        """The record of a measurement."""
        return tables.read(self.folder / MEASUREMENTS[name].file.name)

    def about(self, name: str, conditions: str = "") -> str:
        """The command that was measured, how long it took, and under what conditions."""
        record = self.record(name)
        return f"    {record.command}\n\nThis took {record.origin['seconds']:.0f} s{conditions and f'; {conditions}'}:"

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
            origin = tables.read(file).origin
            versions = ", ".join(f"{package} {version}" for package, version in origin["versions"].items())
            found.append(f"{origin['device']}, {origin['variant']}; {versions}; {origin['platform']}")
        return "\n".join(f"- {words}" for words in dict.fromkeys(found))

    def gradcheck(self) -> str:
        """A line for each scene whose gradients were compared."""
        head = ("command", "seeds", "hold", "fail", "z rms (limit)", "max abs z (limit)", "equal seeds, relative L2")
        rows = []
        for name in CHECKED:
            if not (self.folder / f"gradcheck_{name}.jsonl").exists():
                continue
            record = self.record(f"gradcheck_{name}")
            rows.append([f"`{record.command}`", *tables.gradcheck_line(record)])
        return tables.table(head, rows)

    def experiments(self) -> str:
        """The README's table of whole runs."""
        return self._ends({experiment_record(name): f"`{name}`: {ABOUT[name]}" for name in self.recorded()})

    def others(self) -> str:
        """The README's table of whole runs by other integrators."""
        return self._ends({name: words for name, (words, _) in OTHERS.items()})

    def paths(self) -> str:
        """The README's words on which paths its runs traced."""
        text = "Which paths each run took stands in [docs/benchmarks.md](docs/benchmarks.md#whole-runs)."
        if names := [f"`{name}`" for name in self.recorded() if self._is_older(name)]:
            old = "of light paths alone, recorded before `integrator.paths: auto` became the default"
            text = f"The rows of {', '.join(names)} are {old}. {text}"
        return fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)

    def _is_older(self, experiment: str) -> bool:
        """Whether a run that chooses its estimator had no paths to choose when it was recorded."""
        record = self.record(experiment_record(experiment))
        return record.rows[0]["pilot"] is not None and record.origin["written"] < AUTO_SINCE

    def _ends(self, runs: Mapping[str, str]) -> str:
        """Errors at the start and at the end of runs, by the names of their records, and what they are called."""
        head = ("experiment", "parameter RMSE, start", "end", "time", "command that prints it")
        rows = []
        for name, words in runs.items():
            record = self.record(name)
            errors = [tables.run_errors(record, moment) for moment in ("initial", "final")]
            rows.append([words, *errors, tables.took(record), f"`{record.command}`"])
        return tables.table(head, rows)

    def runs(self) -> str:
        """Time and memory of whole runs, and what a pilot chose."""
        head = ("run", "iterations", "spp", "a step, ms", "iterations in all, s", "with everything, s", "peak, MiB",
                "estimator", "chosen by a pilot, share of the run", "paths")  # fmt: skip
        rows = []
        for name in self.recorded():
            record = self.record(experiment_record(name))
            row, paths = record.rows[0], tables.paths(record)
            pilot = "" if row["pilot"] is None else f"{row['pilot']['label']}, {row['pilot']['share']:.1%}"
            rows.append([
                f"`{name}`", str(row["iterations"]), str(row["spp"]),
                tables.figure(row["step_ms"]), tables.figure(row["elapsed_s"]), f"{record.origin['seconds']:.0f}",
                f"{row['peak_mib']:.1f}", f"`{row['estimator']}`" if row["estimator"] else "", pilot, paths,
            ])  # fmt: skip
        return tables.table(head, rows)

    def recorded(self) -> list[str]:
        """The experiments that have been recorded: those of many minutes may come later."""
        return [name for name in EXPERIMENTS if (self.folder / f"{experiment_record(name)}.jsonl").exists()]

    def _bench(self, name: str, swept: str) -> str:
        record = self.record(name)
        about = self.about(name, tables.bench_conditions(record, swept))
        return f"{about}\n\n{tables.bench_details(record, swept)}"

    def _ratios(self, name: str, swept: str) -> str:
        return tables.bench_ratios(self.record(name), swept)


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
    """Write the page and the README's tables. Raises OSError."""
    blocks = Blocks()
    PAGE.write_text(page(blocks), encoding="utf-8")
    README.write_text(readme(blocks, README.read_text(encoding="utf-8")), encoding="utf-8")
