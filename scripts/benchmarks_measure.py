"""Takes the measurements of docs/benchmarks/, and lists the records that are older than the code that they measure.

A record is what `reslrb` wrote, or the figures of a run. Its first line says where it comes from: the commit, whether
all changes were committed (`clean`; null where that is not known), the device, versions and the command.
"""

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "docs" / "benchmarks"
PAPER = ROOT / "docs" / "paper"
#: The page that `gradcheck --suite extreme` writes. Its record only counts the comparisons, which are thousands.
EXTREME = ROOT / "docs" / "extreme.md"
#: The code that every figure depends on, and the code that the figures of a command depend on besides.
CODE = tuple(f"reslrb_cli/{name}" for name in ("backend", "scene", "transport", "estimators", "guiding", "integrators"))
MEASURED_BY = {
    "bench": ("reslrb_cli/measure",),
    "gradcheck": ("reslrb_cli/measure",),
    "optimize": ("reslrb_cli/optimization",),
    "figure1": ("reslrb_cli/measure", "configs/paper/figure1.yaml"),
    "figure5": ("reslrb_cli/measure",),
    "figure6": ("reslrb_cli/measure",),
}
#: Changes of these change no figure.
WRITTEN = (":!docs", ":!README.md", ":!CHANGELOG.md")
#: Of the experiments in configs/, in the order of the README's table.
EXPERIMENTS = ("cornell_floor", "mixed_room", "caustic_slab", "grey_room", "furnace", "lens_pose", "caustic_heightmap",
               "paper/figure1", "stiff/lamp", "stiff/plate", "stiff/wall")  # fmt: skip
#: Whole runs by other integrators: the record's name, what the README calls the run, and its command.
OTHERS = {
    f"optimize_cornell_floor_{name}": (
        f"`cornell_floor` by {words}",
        f"optimize configs/cornell_floor.yaml --set integrator.type={name}",
    )
    for name, words in {"ptracer": "`ptracer` under naive AD", "prb": "`prb`"}.items()
}
CHECKED = ("furnace", "caustic_slab", "cornell_floor", "grey_room")
_GLASS = (
    "bench configs/caustic_heightmap.yaml --integrators ptracer,reslrb:reservoir,reslrb:stack --max-depth 16 "
    "--budget 180 --set parameters.0.heightmap.resolution=[128,128] --set run.spp=16 --set target.render.spp=64"
)


@dataclass(frozen=True)
class Measurement:
    """One measurement: the words of `reslrb` that make it, without where it is written. Its record is NAME.jsonl."""

    name: str
    words: tuple[str, ...]

    @property
    def file(self) -> Path:
        """Where its record lies."""
        return RECORDS / f"{self.name}.jsonl"

    @property
    def command(self) -> list[str]:
        """What a user types."""
        return ["reslrb", *self.words]


def experiment_record(experiment: str) -> str:
    """The name of the measurement of a whole run of configs/EXPERIMENT.yaml."""
    return f"optimize_{experiment.replace('/', '_')}"


def _all() -> list[Measurement]:
    commands = {
        "depth": "bench --max-depth 128",
        "spp": "bench --sweep spp --values 1,4,16,64 --integrators ptracer,reslrb:reservoir,reslrb:stack --budget 120",
        "moving": _GLASS,
    }
    commands["extreme"] = f"gradcheck --suite extreme --markdown {EXTREME.relative_to(ROOT)}"
    commands |= {f"gradcheck_{name}": f"gradcheck configs/{name}.yaml --seeds 16" for name in CHECKED}
    for name in EXPERIMENTS:
        commands[experiment_record(name)] = f"optimize configs/{name}.yaml"
    commands |= {name: command for name, (_, command) in OTHERS.items()}
    return [Measurement(name, tuple(shlex.split(command))) for name, command in commands.items()]


MEASUREMENTS = {measurement.name: measurement for measurement in _all()}

#: What of a run's manifest is kept: figures, not what the page of the run is for.
RESULTS = ("iterations", "loss", "elapsed_s", "rmse", "parameter_rmse", "relative_error", "worse")
#: Iterations that the median step is taken without: they compile.
COLD = 5


def code_state() -> dict[str, Any]:
    """Return the commit of the code, and whether nothing was changed since; None for what git does not know."""
    commit = _git("rev-parse", "--short=12", "HEAD")
    if commit is None:
        return {"commit": None, "clean": None}
    return {"commit": commit, "clean": not _git("status", "--porcelain", "--", ".", *WRITTEN)}


def _git(*words: str) -> str | None:
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return None if done.returncode else done.stdout.strip()


def origins() -> dict[str, Mapping[str, Any]]:
    """Return where each record in docs/benchmarks/ and docs/paper/ comes from."""
    found = {}
    for file in sorted([*RECORDS.glob("*.jsonl"), *PAPER.glob("figure*.json*")]):
        text = file.read_text(encoding="utf-8")
        found[file.stem] = (
            json.loads(text.partition("\n")[0]) if file.suffix == ".jsonl" else json.loads(text)["origin"]
        )
    return found


def measures(command: list[str]) -> list[str]:
    """Return the files and folders that the figures of a command depend on."""
    found = [*CODE, *MEASURED_BY[command[1]]]
    for config in (word for word in found + command if word.endswith(".yaml")):
        scene = yaml.safe_load((ROOT / config).read_text(encoding="utf-8"))["scene"]["file"]
        found += [config, os.path.relpath((ROOT / config).parent / Path(scene).parent, ROOT)]
    return list(dict.fromkeys(found))


def stale() -> list[str]:
    """Return a line for each record that is older than the code that it measures."""
    lines = []
    for name, origin in origins().items():
        commit = origin.get("commit")
        if not commit or _git("cat-file", "-e", f"{commit}^{{commit}}") is None:
            lines.append(f"{name}: the commit that it was measured at is not known")
            continue
        since = {
            place: _git("rev-list", "--count", f"{commit}..", "--", place) for place in measures(origin["command"])
        }
        changed = [f"{place} ({count})" for place, count in since.items() if count != "0"]
        if changed:
            lines.append(f"{name}: measured at {commit}; commits since then change {', '.join(changed)}")
        elif origin["clean"] is False:
            lines.append(f"{name}: measured at {commit} with changes that were not committed")
    return lines


def measure(measurement: Measurement) -> None:
    """Run the command and write its record; a record that there was stays where the command fails.

    Raises SystemExit.
    """
    tree = code_state()
    with tempfile.TemporaryDirectory(prefix="reslrb-benchmarks-") as name:
        folder = Path(name)
        record = folder / "record.jsonl"
        kind = measurement.words[0]
        files = ["--set", f"run.output={folder}", "--set", "run.name=run"] if kind == "optimize" else ["--json", record]
        print(f"== {shlex.join(measurement.command)}", flush=True)
        start = time.monotonic()
        command = [sys.executable, "-m", "reslrb_cli", *measurement.words, *map(str, files)]
        # As on a new machine: no kernels of Dr.Jit, which lie below HOME, and no decisions.
        environment = os.environ | {"HOME": name, "RESLRB_CACHE": name}
        code = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
        seconds = time.monotonic() - start
        if code:
            raise SystemExit(f"benchmarks: {measurement.name}: exit code {code}; its record is left as it was")
        lines = run_lines(folder / "run") if kind == "optimize" else _read(record)
        lines[0] |= {"command": measurement.command, "seconds": round(seconds, 1)} | tree
        if measurement.name == "extreme":
            holds = [line["holds"] for line in lines if "verdict" in line]
            counts = {"comparisons": len(holds), "hold": holds.count(True), "fail": holds.count(False)}
            lines = [lines[0], {"kind": "suite"} | counts]
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
    warm = steps[COLD:] or steps
    figures = {
        "kind": "run",
        **results,
        "spp": steps[-1]["spp"],
        "step_ms": statistics.median(step["step_ms"] for step in warm),
        "peak_mib": max(step["peak_mib"] for step in steps),
        "estimator": (manifest.get("plan") or {}).get("estimator"),
        **traced(manifest),
    }
    return [origin | {"written": manifest["started"]}, figures]


def traced(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Of a run by `reslrb`: its `paths`, which share of them are light paths, and whether these are guided."""
    rows = {row["feature"]: row for row in (manifest.get("plan") or {}).get("rows") or ()}
    camera = rows.get("camera paths")
    if camera is None:
        return {"paths": None, "light_share": None, "guided": None}
    paths = re.match(r"paths: (\w+)", camera["reason"])[1] if camera["needed"] else "light"
    share = {"light": 1.0, "camera": 0.0}.get(paths)  # of both kinds the configuration says it
    return {"paths": paths, "light_share": share, "guided": rows["guided emission"]["needed"]}


def _read(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
