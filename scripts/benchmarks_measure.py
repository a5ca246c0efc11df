"""Take the measurements of docs/benchmarks/, and list the records that are older than the code that they measure.

A record contains the lines that `reslrb` wrote, or the figures of a run. The first line of a record contains its
origin: the commit, whether all changes were committed (`clean`), the device, versions and the command. `clean` is null
if this is not known.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "docs" / "benchmarks"
PAPER = ROOT / "docs" / "paper"
#: The page of the extreme suite. Its record only counts the comparisons, which are thousands.
EXTREME = ROOT / "docs" / "extreme.md"
#: The code that every figure depends on: sampling, the defaults of the settings, seeds, and the timer.
CODE = tuple(
    f"reslrb_cli/{name}" for name in (
        "backend", "scene", "transport", "estimators", "guiding", "integrators", "config", "optimization",
        "colorimetry.py", "glasses.py", "lens/transport.py", "seeds.py", "statistics.py", "records/clock.py",
        "records/decisions.py", "records/images.py",
    )
)  # fmt: skip
#: The code that the figures of a command depend on besides.
MEASURE = ("reslrb_cli/measure",)
PAPERS = (*MEASURE, "paper", "reslrb_cli/report/tonemap.py")
MEASURED_BY = {
    "optimize": (),
    "figure1": (*PAPERS, "configs/paper/figure1.yaml"),
    "figure5": PAPERS,
    "figure6": PAPERS,
}
#: Changes of these change no figure.
WRITTEN = (":!docs", ":!README.md", ":!CHANGELOG.md")
#: The experiments in configs/ in the order of the README's table, and its words for them.
EXPERIMENTS = {
    "cornell_floor": "a carpet of 64 x 64 texels",
    "mixed_room": "the printed wall of a room with a caustic and a mirror, and a sofa",
    "caustic_slab": "a print below rippled glass",
    "grey_room": "a furnished room lit through windows",
    "furnace": "the walls of a closed sphere",
    "lens_pose": "a lens's place, and its tilt in degrees",
    "moved_box": "a box's place, and its turn in degrees, from its outline and its shadow",
    "table": "the places of a vase and a lump of glass, their turns in degrees, and the vase's radius",
    "prism": "the index of a prism's glass, and its Abbe number, from a rainbow",
    "caustic_heightmap": "the relief of a glass face",
    "paper/figure1": "the relief of a glass face, finely",
    "stiff/lamp": "albedo, and intensity",
    "stiff/plate": "roughness, and radiance",
    "stiff/wall": "73,728 texels, and one number",
}
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


def experiment_record(experiment: str) -> str:
    """Return the name of the measurement of a complete run of configs/EXPERIMENT.yaml."""
    return f"optimize_{experiment.replace('/', '_')}"


def gallery_picture(experiment: str) -> Path:
    """Return the file of an experiment's picture in the gallery."""
    return ROOT / "docs" / "images" / "gallery" / f"{experiment.replace('/', '_')}.jpg"


#: The words of `reslrb` that make each measurement, without the file of its record, which is NAME.jsonl.
MEASUREMENTS = {
    name: shlex.split(command)
    for name, command in {
        "depth": "bench --max-depth 128",
        "spp": "bench --sweep spp --values 1,4,16,64 --integrators ptracer,reslrb:reservoir,reslrb:stack --budget 120",
        "moving": _GLASS,
        "extreme": "gradcheck --suite extreme",
        **{f"gradcheck_{name}": f"gradcheck configs/{name}.yaml --seeds 16" for name in CHECKED},
        **{experiment_record(name): f"optimize configs/{name}.yaml" for name in EXPERIMENTS},
        **{name: command for name, (_, command) in OTHERS.items()},
    }.items()
}
#: The figures of a run's manifest that are kept.
RESULTS = ("iterations", "loss", "elapsed_s", "rmse", "parameter_rmse", "relative_error", "worse")
#: The first iterations compile, and do not count for the median step.
COLD = 5


def code_state() -> dict[str, Any]:
    """Return the commit of the code (`commit`), and whether nothing has changed since that commit (`clean`). A value is
    None if git does not know it.
    """
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
    """Return the origin of each record in docs/benchmarks/ and docs/paper/."""
    found = {}
    for file in sorted([*RECORDS.glob("*.jsonl"), *PAPER.glob("figure*.json*")]):
        text = file.read_text(encoding="utf-8")
        found[file.stem] = (
            json.loads(text.partition("\n")[0]) if file.suffix == ".jsonl" else json.loads(text)["origin"]
        )
    return found


def measures(command: list[str]) -> list[str]:
    """Return the files and folders that the figures of a command depend on."""
    found = [*CODE, *MEASURED_BY.get(command[1], MEASURE)]
    for config in (word for word in found + command if word.endswith(".yaml")):
        scene = yaml.safe_load((ROOT / config).read_text(encoding="utf-8"))["scene"]["file"]
        found += [config, os.path.relpath((ROOT / config).parent / Path(scene).parent, ROOT)]
    return list(dict.fromkeys(found))


def stale() -> list[str]:
    """Return a line for each record whose code has changed since, was not committed, or has no known commit."""
    lines = []
    for name, origin in origins().items():
        commit = origin.get("commit")
        if not commit or _git("cat-file", "-e", f"{commit}^{{commit}}") is None:
            lines.append(f"{name}: the commit that it was measured at is not known")
            continue
        changed = {place: _changed(commit, place) for place in measures(origin["command"])}
        places = [f"{place} ({count})" for place, count in changed.items() if count]
        if places:
            lines.append(f"{name}: measured at {commit}; files changed since then: {', '.join(places)}")
        elif origin["clean"] is False:
            lines.append(f"{name}: measured at {commit} with changes that were not committed")
    return lines


def _changed(commit: str, place: str) -> int:
    """Return how many files of a folder have changed since a commit. Changes of comments, docstrings and messages do
    not count.
    """
    files = (_git("diff", "--name-only", "--no-renames", commit, "HEAD", "--", place) or "").splitlines()
    return sum(_differs(commit, file) for file in files)


def _differs(commit: str, file: str) -> bool:
    """Return whether a file that has changed since a commit may lead to other figures."""
    read = {".py": _syntax, ".yaml": yaml.safe_load}.get(Path(file).suffix)
    if read is None:
        return True
    old, new = (_git("show", f"{each}:{file}") for each in (commit, "HEAD"))
    return old is None or new is None or read(old) != read(new)


def _syntax(text: str) -> str:
    """Return the syntax tree of a Python file without docstrings and messages.

    Messages are texts of at least two words on one line. No figure depends on messages, nor on the statements that
    prepare the message of an error.
    """
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
            del node.body[0]
    return ast.dump(_WithoutMessages(_seeding(ROOT)).visit(tree))


@functools.cache
def _seeding(root: Path) -> frozenset[str]:
    """Return the functions whose arguments contain the purpose of a seed. A seed depends on this text."""
    texts = (file.read_text(encoding="utf-8") for file in (root / "reslrb_cli").rglob("*.py"))
    found = (re.findall(r"def (\w+)\([^()]*\bpurpose: str", text) for text in texts)
    return frozenset({"seed", "_seed"}.union(*found))


#: A word of a message.
_WORD = re.compile(r"[a-z]{2,}", re.IGNORECASE)


class _WithoutMessages(ast.NodeTransformer):
    """Transformer that replaces all messages of a syntax tree by the same text, and leaves out the statements that
    prepare an error: those before a `raise` in the same branch of an `if`. Purposes of seeds are no messages: the
    arguments of the functions `seeding`, and values of variables whose names contain `purpose`.
    """

    def __init__(self, seeding: frozenset[str]) -> None:
        self._seeding = seeding

    def visit_Call(self, node: ast.Call) -> ast.Call:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name not in self._seeding:
            self.generic_visit(node)
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        if not any("purpose" in getattr(target, "id", "").lower() for target in node.targets):
            self.generic_visit(node)
        return node

    def visit_If(self, node: ast.If) -> ast.If:
        self.generic_visit(node)
        for branch in (node.body, node.orelse):
            if branch and isinstance(branch[-1], ast.Raise):
                branch[:] = branch[-1:]
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.expr:
        return self._without(
            "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values), node
        )

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return self._without(node.value, node)

    @staticmethod
    def _without(text: object, node: ast.expr) -> ast.expr:
        is_message = isinstance(text, str) and "\n" not in text and " " in text and len(_WORD.findall(text)) > 1
        return ast.Constant("message") if is_message else node


def record_file(name: str) -> Path:
    """Return the file that contains the record of a measurement."""
    return RECORDS / f"{name}.jsonl"


def measure(name: str, words: Sequence[str]) -> None:
    """Run `reslrb` with these arguments and write the record. If the command fails, an earlier record stays unchanged.

    Raises SystemExit.
    """
    from make_figures import image_panels, write_panels  # imports Mitsuba

    tree, is_run = code_state(), words[0] == "optimize"
    with tempfile.TemporaryDirectory(prefix="reslrb-benchmarks-") as temporary:
        folder, record = Path(temporary), Path(temporary) / "record.jsonl"
        files = ["--set", f"run.output={folder}", "--set", "run.name=run"] if is_run else ["--json", str(record)]
        print(f"== {shlex.join(['reslrb', *words])}", flush=True)
        # As on a new machine: Dr.Jit's kernels, which lie below HOME, and measured decisions are not there.
        environment, start = os.environ | {"HOME": temporary, "RESLRB_CACHE": temporary}, time.monotonic()
        command = [sys.executable, "-m", "reslrb_cli", *words, *files]
        code = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
        seconds = round(time.monotonic() - start, 1)
        if code:
            raise SystemExit(f"benchmarks: {name}: exit code {code}; its record is left as it was")
        lines = run_lines(folder / "run") if is_run else read_lines(record)
        pictures = {experiment_record(experiment): gallery_picture(experiment) for experiment in EXPERIMENTS}
        if name in pictures:
            write_panels([image_panels(folder / "run")], pictures[name])
        lines[0] |= {"command": ["reslrb", *words], "seconds": seconds} | tree
        if name == "extreme":  # the page has the thousands of comparisons
            EXTREME.write_text(extreme_page(lines), encoding="utf-8")
            lines = [lines[0], *suite_summary(lines)]
        record_file(name).write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
        if name == "depth":
            draw(record_file(name), ROOT / "docs" / "images" / "bench.png")


def draw(record: Path, picture: Path) -> None:
    """Draw the figure of a record of `reslrb bench`."""
    from reslrb_cli.report.publish import write
    from reslrb_cli.report.sources import read_sources

    write(read_sources([record]), picture, "draw")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with a heading for each column."""
    lines = ["|".join(f" {cell} " if cell else " " for cell in cells) for cells in [head, *rows]]
    lines.insert(1, "|".join("---" for _ in head))
    return "\n".join(f"|{line}|" for line in lines)


def suite_summary(lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the lines of the record of a suite: the counts, and the open comparisons by parameter and reason."""
    from reslrb_cli.records.measurements import GradcheckRecord, record_of
    from reslrb_cli.report.tables import open_reasons

    records = [record for line in lines if (record := record_of(GradcheckRecord, line)) is not None]
    holds = [record.holds for record in records]
    counts = {"cases": len({record.case for record in records}), "comparisons": len(holds), "hold": holds.count(True),
              "fail": holds.count(False)}  # fmt: skip
    return [{"kind": "suite"} | counts] + [
        {"kind": "open", "parameter": parameter, "reason": reason,
         "cases": list(dict.fromkeys(record.case for record in group))}
        for (parameter, reason), group in open_reasons(records).items()
    ]  # fmt: skip


def open_comparisons(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a text for each reason why comparisons of a suite stay open, from the lines of `suite_summary`."""
    return [
        f"{row['parameter'].removesuffix('.value').removesuffix('.data')} in "
        f"{', '.join(f'`{case}`' for case in row['cases'])} ({row['reason']})"
        for row in rows if row["kind"] == "open"
    ]  # fmt: skip


def extreme_page(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the page of the extreme suite, made from the lines of its file. The page has a row for each case and a
    column for each estimator.
    """
    from reslrb_cli.measure.scenes.catalogue import CASES

    origin, records = lines[0], [line for line in lines if "verdict" in line]
    z, distance = (max(record[limit] or 0.0 for record in records) for limit in ("z_max_limit", "relative_l2_limit"))
    labels = list(dict.fromkeys(record["label"] for record in records))
    names = [label.removeprefix("reslrb:") for label in labels]
    rows = []
    for case in dict.fromkeys(record["case"] for record in records):
        own = [record for record in records if record["case"] == case]
        kinds = {image: dict.fromkeys(record["reference"] for record in own if (record["kind"] == "image") is image)
                 for image in (False, True)}  # fmt: skip
        references = [*kinds[False], *(f"image: {name}" for name in kinds[True])]
        cells = [_suite_cell([record for record in own if record["label"] == label]) for label in labels]
        named = ", ".join(references).replace("finite_difference", "differences")
        rows.append([f"`{case}`", CASES[case].about, named, str(own[0]["seeds"]), *cells])
    opened = "".join(f"- {text}\n" for text in open_comparisons(suite_summary(lines))) or "None.\n"
    return (
        "# The extreme suite\n\n"
        "Scenes in which gradients of light paths often fail, each with its own reference. This command measures\n"
        "all cases and writes this page.\n\n"
        "    scripts/benchmarks measure extreme\n\n"
        f"The figures are from {origin['device']}, {origin['variant']}.\n\n"
        "The columns of the estimators contain two figures. The first is the largest deviation in standard errors\n"
        f"over many seeds (limit at most {z:.1f}). The second is the largest relative L2 distance at equal seeds\n"
        f"(limit {distance:.0e}). Comparisons that fail or stay open are in bold.\n"
        "[Check gradients](gradcheck.md) explains references and verdicts.\n\n"
        f"## Open comparisons\n\n{opened}\n"
        f"## Cases\n\n{table(('case', 'subject', 'references', 'seeds', *names), rows)}\n"
    )


def _suite_cell(records: Sequence[Mapping[str, Any]]) -> str:
    """Return the largest figures of an estimator in one case, and all verdicts other than `holds`."""
    if not records:
        return "-"
    held = [record["z_max"] for record in records if record["z_max"] is not None and record["verdict"] == "holds"]
    equal = [record["relative_l2"] or 0.0 for record in records if record["relative_l2_limit"] is not None]
    parts = ([f"{max(held):.1f}"] if held else []) + ([f"{max(equal):.0e}"] if equal else [])
    for record in records:
        if record["verdict"] != "holds":
            which = (record["parameter"] or record["kind"]).split(".")
            name = which[-2] if len(which) > 1 and which[-1] in ("value", "data") else which[-1]
            parts.append(f"**{record['verdict'].replace('_', ' ')}: {name}**")
    return ", ".join(dict.fromkeys(parts)) or "exact"


def run_lines(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of a run's record. The first line has the origin, and the second line has the figures."""
    manifest, steps = json.loads((folder / "manifest.json").read_text("utf-8")), read_lines(folder / "metrics.jsonl")
    origin = {"kind": "origin"} | {name: manifest[name] for name in ("device", "variant", "versions", "platform")}
    figures = {
        "kind": "run",
        **{name: manifest["results"].get(name) for name in RESULTS},
        "spp": steps[-1]["spp"],
        "step_ms": statistics.median(step["step_ms"] for step in steps[COLD:] or steps),
        "peak_mib": max(step["peak_mib"] for step in steps),
        "estimator": (manifest.get("plan") or {}).get("estimator"),
        **traced(manifest),
    }
    return [origin | {"written": manifest["started"]}, figures]


def traced(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `paths` of a run by `reslrb`, the share of light paths, and whether light paths are guided. Other runs
    have None.
    """
    rows = {row["feature"]: row for row in (manifest.get("plan") or {}).get("rows") or ()}
    camera = rows.get("camera paths")
    if camera is None:
        return {"paths": None, "light_share": None, "guided": None}
    found = re.match(r"paths: (\w+)", camera["reason"]) if camera["needed"] else None
    paths = found[1] if found else "light"
    share = {"light": 1.0, "camera": 0.0}.get(paths)  # with both kinds, the configuration has the share
    return {"paths": paths, "light_share": share, "guided": rows["guided emission"]["needed"]}


def read_lines(file: Path) -> list[dict[str, Any]]:
    """Return the objects of a JSON Lines file."""
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
