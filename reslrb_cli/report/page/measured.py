"""What a page shows of a file of measurements, by the command that wrote it, and of a folder of maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from reslrb_cli.records.gradcheck import Verdict
from reslrb_cli.records.measured import gradcheck_record, missing_record
from reslrb_cli.report.gradcheck_table import HEAD, cells, failure_line, summary_lines
from reslrb_cli.report.page.bench import bench
from reslrb_cli.report.page.convergence import convergence
from reslrb_cli.report.page.facts import origin_facts
from reslrb_cli.report.page.maps import gradient_maps
from reslrb_cli.report.page.markup import breakable, note, soft, table, text
from reslrb_cli.report.sources import Maps, Measurements
from reslrb_cli.report.words import count

#: What stands above a source, before its name.
HEADINGS = {"bench": "Cost of a step", "gradcheck": "Gradients against references",
            "convergence": "Error against run time", "maps": "Maps of gradients"}  # fmt: skip
#: Verdicts that are told as a failure is.
_BAD = (Verdict.FAILS,)


def measured(source: Measurements | Maps) -> str:
    """Everything that there is to show of it."""
    if isinstance(source, Maps):
        return gradient_maps(source.files)
    makers: dict[str, Callable[[Sequence[Mapping[str, Any]]], tuple[str, int]]] = {
        "bench": bench, "gradcheck": gradcheck, "convergence": convergence,
    }  # fmt: skip
    markup, unknown = makers[source.kind](source.objects)
    words = [f"{count(len(source.damaged), 'line')} could not be read (the first is line {source.damaged[0]})."] if (
        source.damaged) else []  # fmt: skip
    words += [f"{count(unknown, 'line')} of other kinds, or damaged, left out."] if unknown else []
    return markup + "".join(map(soft, words)) + "".join(map(origin_facts, source.origins))


def gradcheck(objects: Sequence[Mapping[str, Any]]) -> tuple[str, int]:
    """The comparisons as a table, what fails first, and what is missing; and how many lines are neither."""
    records = [record for entry in objects if (record := gradcheck_record(entry)) is not None]
    missing = [found for entry in objects if (found := missing_record(entry)) is not None]
    several = len({record.case for record in records}) > 1
    head = ["case"] * several + list(HEAD)
    rows = []
    for record in sorted(records, key=lambda record: record.verdict not in _BAD):
        first, *rest = cells(record)
        row = [breakable(record.case)] * several + [breakable(first), *map(text, rest)]
        rows.append([*row[:-1], f'<span class="worse">{row[-1]}</span>' if record.verdict in _BAD else row[-1]])
    lines = (
        [f"<p>{text(line)}</p>" for line in summary_lines(records) if not line.startswith("FAILS")] if records else []
    )
    failed = [text(failure_line(record)) for record in records if record.verdict in _BAD]
    lines += [f"<p>{text(found.line())}</p>" for found in missing]
    markup = note(*failed, kind="failed") + "".join(lines) + table(head, rows, "dense")
    return markup, len(objects) - len(records) - len(missing)
