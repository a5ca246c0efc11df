"""docs/paper.md: the paper's figures beside ours, prose from docs/paper/page.md, figures from the records there."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import benchmarks_page as tables

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "docs" / "paper"
#: Published for Figure 6, on an RTX 5080: milliseconds of a step by naive AD and by ResLRB, by depth.
PUBLISHED_MS: dict[int, tuple[int | None, int | None]] = {4: (63, 93), 16: (260, 132), 128: (None, 197)}
#: The depth at which both take the same time in the paper.
PARITY = 8
TEMPLATE, PLACE = "page.md", re.compile(r"^\{\{ (\w+) \}\}$", re.MULTILINE)


def page(folder: Path = RECORDS) -> str:
    """The page."""
    made = {"figure1": _figure1, "figure5": _figure5, "figure6": _figure6}
    return PLACE.sub(lambda match: made[match[1]](folder), (RECORDS / TEMPLATE).read_text(encoding="utf-8"))


def _figure1(folder: Path) -> str:
    record = json.loads((folder / "figure1.json").read_text(encoding="utf-8"))
    limit = record["plan"]["limit"] / 2**30
    about = f"Each process under {limit:g} GiB of address space:"
    means = "Means of the gradients, compared in standard errors:"
    compared = _comparisons(record["comparisons"])
    return "\n\n".join([_origin(record["origin"]), about, _gradients(record), means, compared, _fall(record)])


def _figure5(folder: Path) -> str:
    record = json.loads((folder / "figure5.json").read_text(encoding="utf-8"))
    width, height = record["film"]
    about = f"Film {width}x{height}, paths of length {record['max_depth']}"
    if record.get("left_out") is not None:
        about += f"; dL/dI is 0 in {record['left_out']:.1%} of the pixels"
    about += ":"
    means = "Means of the gradients, compared in standard errors; the exact estimators at equal seeds, in relative L2:"
    compared = _comparisons(record["comparisons"])
    return "\n\n".join([_origin(record["origin"]), about, _gradients(record), means, compared])


def _figure6(folder: Path) -> str:
    text = (folder / "figure6.jsonl").read_text(encoding="utf-8")
    lines = [json.loads(line) for line in text.splitlines()]
    rows = [line for line in lines if line.get("kind") != "origin"]
    depths = sorted({row["max_depth"] for row in rows})
    width, height, spp = rows[0]["width"], rows[0]["height"], rows[0]["spp"]
    cells = []
    for number, name in enumerate(("published, naive AD", "published, ResLRB")):
        known = [PUBLISHED_MS.get(depth, (None, None))[number] for depth in depths]
        cells.append([name, *("" if value is None else f"{value} ms" for value in known)])
    names = list(dict.fromkeys(map(tables.name_of, rows)))
    found = {(tables.name_of(row), row["max_depth"]): row for row in rows}
    cells += [[name, *(_cell(found.get((name, depth))) for depth in depths)] for name in names]
    over = [["published", *(_published_ratio(depth) for depth in depths)]]
    over += [[name, *(_over(found, name, depth) for depth in depths)] for name in names[1:]]
    origins = list(dict.fromkeys(_origin(line) for line in lines if line.get("kind") == "origin"))
    head = ["depth", *map(str, depths)]
    about = f"Film {width}x{height}, {spp} spp, no roulette; milliseconds of a step, and MiB of arrays at their most:"
    ratios = f"A step over one of naive AD ({names[0]}):"
    return "\n\n".join([*origins, about, tables.table(head, cells), ratios, tables.table(head, over)])


def _over(found: Mapping[tuple[str, int], Mapping[str, Any]], name: str, depth: int) -> str:
    first = next(iter(found))[0]
    pair = [found.get((which, depth)) for which in (name, first)]
    if any(row is None or row["status"] != "ok" for row in pair):
        return ""
    ours, theirs = (row["step_ms"]["median"] for row in pair if row is not None)
    return f"{ours / theirs:.2f}"


def _published_ratio(depth: int) -> str:
    naive, ours = PUBLISHED_MS.get(depth, (None, None))
    if depth == PARITY:
        return "about 1"
    return "" if naive is None or ours is None else f"{ours / naive:.2f}"


def _origin(origin: Mapping[str, Any]) -> str:
    where = f"{origin['device']}, {origin['variant']}, at {tables.commit_of(origin)}"
    return f"    {shlex.join(origin['command'])}\n\n{where}."


def _gradients(record: Mapping[str, Any]) -> str:
    rows = []
    for row in record["gradients"]:
        spp = row.get("spp", record["plan"].get("spp"))
        noise, memory = tables.figure(row["relative_noise"]), row["arrays_mib"]
        ended = str(row.get("status", "ok")).replace("_", " ")
        cells = [row["gradient"], str(spp), str(row["seeds"] or ""), noise]
        rows.append([*cells, ended if memory is None else f"{memory:.1f}"])
    return tables.table(["gradient", "spp", "seeds", "relative noise", "arrays, MiB"], rows)


def _comparisons(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = []
    for row in rows:
        pairs = [(row["relative_l2"], row["relative_l2_limit"], ".1e"), (row["z_rms"], row["z_rms_limit"], ".2f"),
                 (row["z_max"], row["z_max_limit"], ".2f")]  # fmt: skip
        cells = ["" if value is None else format(value, form) + ("" if limit is None else f" ({limit:{form}})")
                 for value, limit, form in pairs]  # fmt: skip
        detectable = "" if row["detectable"] is None else tables.figure(row["detectable"], 2)
        verdict = str(row["verdict"]).replace("_", " ")
        lines.append([f"{row['gradient']} - {row['reference']}", *cells, detectable, verdict])
    head = ["compared", "relative L2 (limit)", "z rms (limit)", "max abs z (limit)", "a fault seen", "verdict"]
    return tables.table(head, lines)


def _fall(record: Mapping[str, Any]) -> str:
    fall, plan = record["noise"], record["plan"]
    few, many, lack = plan["few_spp"], plan["many_spp"], record["naive_at_many_spp_mib"] / 1024
    ratio, low, high, expected = (f"{fall[name]:.2f}" for name in ("ratio", "low", "high", "expected"))
    return (
        f"From {few} to {many} spp noise falls by {ratio} ({low} to {high}), expected {expected}.\n"
        f"By its growth naive AD would take about {lack:.1f} GiB at {many} spp."
    )


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    if row["status"] != "ok":
        return str(row["status"]).replace("_", " ")
    return f"{row['step_ms']['median']:.0f} ms, {row['peak_mib']:.0f}"
