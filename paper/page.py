"""Write docs/paper.md, which shows the paper's figures beside ours.

The text comes from docs/paper/page.md, and our figures come from the records in docs/paper/. None of our figures is
typed by hand.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import benchmarks_page as tables
from benchmarks_measure import PAPER, ROOT

from reslrb_cli.errors import ConfigError

Row = Mapping[str, Any]
IMAGES, PAGE, TEMPLATE = ROOT / "docs" / "images", ROOT / "docs" / "paper.md", PAPER / "page.md"
MEANS = "The next table compares the means of the gradients in standard errors."


def write(folder: Path | None = None) -> int:
    """Copy records and pictures from `folder`, if given, and write the page. Return the exit code. Raises
    ConfigError.
    """
    names = [f"figure{number}.{ending}" for number in (1, 5, 6) for ending in ("json", "jsonl", "png")]
    found = [] if folder is None else [folder / name for name in names if (folder / name).exists()]
    if folder is not None and not found:
        raise ConfigError(folder, "", "holds no figure1.json, figure5.json or figure6.jsonl")
    for file in found:
        shutil.copy(file, IMAGES if file.suffix == ".png" else PAPER)
    PAGE.write_text(page(), encoding="utf-8")
    return 0


def page() -> str:
    """Return the text of docs/paper.md."""

    def made(match: re.Match[str]) -> str:
        [file] = PAPER.glob(f"{match[1]}.json*")
        text = file.read_text(encoding="utf-8")
        record = json.loads(text) if file.suffix == ".json" else [json.loads(line) for line in text.splitlines()]
        return FIGURES[match[1]](record)

    return tables.PLACE.sub(made, TEMPLATE.read_text(encoding="utf-8"))


def _figure1(record: Row) -> str:
    fall, plan = record["noise"], record["plan"]
    few, many, lack = plan["few_spp"], plan["many_spp"], record["naive_at_many_spp_mib"] / 1024
    ratio, low, high, expected = (f"{fall[name]:.2f}" for name in ("ratio", "low", "high", "expected"))
    about = f"Each process may use {plan['limit'] / 2**30:g} GiB of address space."
    noise = (
        f"From {few} to {many} spp, the noise falls by {ratio} ({low} to {high}). We expect {expected}.\n"
        f"Naive AD would take about {lack:.1f} GiB at {many} spp, extrapolated from fewer samples."
    )
    return "\n\n".join([_gradients(record, about), MEANS, _comparisons(record["comparisons"]), noise])


def _figure5(record: Row) -> str:
    film, left_out = "{}x{}".format(*record["film"]), f"dL/dI is 0 in {record['left_out']:.1%} of the pixels"
    about = f"The film has {film} pixels, and the paths have length {record['max_depth']}. {left_out}."
    means = f"{MEANS} The exact estimators are compared at equal seeds, by their\nrelative L2 distance."
    return "\n\n".join([_gradients(record, about), means, _comparisons(record["comparisons"])])


def _figure6(lines: Sequence[Row]) -> str:
    [origin], rows = ([row for row in lines if (row.get("kind") == "origin") is wanted] for wanted in (True, False))
    film = "{width}x{height} pixels with {spp} samples each".format_map(rows[0])
    about = (
        f"The film has {film}, and the steps use no Russian roulette. The first table has\n"
        "the time of a step, divided by that of naive AD (`ptracer`)."
    )
    made = tables.Record(origin, rows)
    ratios = tables.bench_ratios(made, "depth", "step_ms")
    return "\n\n".join([_origin(origin), about, ratios, tables.bench_details(made, "depth")])


#: What a figure says, by its record.
FIGURES: dict[str, Callable[[Any], str]] = {"figure1": _figure1, "figure5": _figure5, "figure6": _figure6}


def _origin(origin: Row) -> str:
    where = f"{origin['device']}, {origin['variant']}, at {tables.commit_of(origin)}"
    return f"    {shlex.join(origin['command'])}\n\n{where}."


def _gradients(record: Row, about: str) -> str:
    """Return the origin of a record, and its table of gradients."""
    rows = []
    for row in record["gradients"]:
        spp = row.get("spp", record["plan"].get("spp"))
        memory, ended = row["arrays_mib"], str(row.get("status")).replace("_", " ")
        cells = [row["gradient"], str(spp), str(row["seeds"] or ""), tables.figure(row["relative_noise"])]
        rows.append([*cells, ended if memory is None else f"{memory:.1f}"])
    table = tables.table(["gradient", "spp", "seeds", "relative noise", "arrays, MiB"], rows)
    return "\n\n".join([_origin(record["origin"]), about, table])


def _comparisons(rows: Sequence[Row]) -> str:
    def cell(row: Row, name: str, form: str) -> str:
        value, limit = row[name], row[f"{name}_limit"]
        return "" if value is None else format(value, form) + ("" if limit is None else f" ({limit:{form}})")

    lines = []
    for row in rows:
        cells = [cell(row, name, form) for name, form in (("relative_l2", ".1e"), ("z_rms", ".2f"), ("z_max", ".2f"))]
        seen, verdict = tables.figure(row["detectable"], 2), str(row["verdict"]).replace("_", " ")
        lines.append([f"{row['gradient']} - {row['reference']}", *cells, seen, verdict])
    head = ["compared", "relative L2 (limit)", "z rms (limit)", "max abs z (limit)", "a fault seen", "verdict"]
    return tables.table(head, lines)
