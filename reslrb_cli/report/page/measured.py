"""Parts of a page about files of measurements, and of a page about several sources."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from markupsafe import Markup

from reslrb_cli.records.measurements import (
    GradcheckRecord,
    MethodRecord,
    MissingRecord,
    PointRecord,
    ReferenceRecord,
    SummaryRecord,
    Verdict,
    record_of,
)
from reslrb_cli.report.format import number
from reslrb_cli.report.page.layout import diagram, key, lay_out
from reslrb_cli.report.page.run import guarded, outcome, run_parts
from reslrb_cli.report.page.sweep import sweep_parts
from reslrb_cli.report.panels import (
    MOST_DRAWN,
    SWEPT,
    Entry,
    bench_entries,
    bench_panels,
    convergence_panels,
    label,
    method_naming,
    of_kind,
    quantities,
    quantity,
)
from reslrb_cli.report.sources import Measurements, ShownRun, Source, SweepRuns
from reslrb_cli.report.tables import HEAD, cells, failure_line, reference_line, summary_lines


def bench(objects: Sequence[Entry]) -> Markup:
    """Return diagrams and a table of a bench."""
    entries, name = bench_entries(objects)
    panels = bench_panels(objects)
    entries.sort(key=lambda entry: entry.get(name) or 0)
    fixed = [f"{SWEPT[other]} {number(entries[0].get(other))}" for other in SWEPT if other != name and entries]
    rows = [{"label": label(entry), "entry": entry} for entry in entries]
    parts = lay_out("legend", [curve.name for curve in panels[0].curves])
    parts += lay_out("diagrams", [("", diagram(panel)) for panel in panels])
    return parts + lay_out("measured.bench", rows, name, SWEPT[name], fixed)


def convergence(objects: Sequence[Entry]) -> Markup:
    """Return the summary of a convergence, a diagram for each quantity, the references, and a table of the methods."""
    points, methods = of_kind(objects, PointRecord), of_kind(objects, MethodRecord)
    said = [lay_out("paragraph", entry["line"]) for entry in of_kind(objects, SummaryRecord)]
    lines = of_kind(objects, ReferenceRecord)
    references = [found for line in lines if (found := record_of(ReferenceRecord, line)) is not None]
    differing = [reference_line(record) for record in references if record.biased]
    agreeing = [reference_line(record) for record in references if not record.biased]
    name, shown = method_naming([*methods, *points]), quantities([*points, *methods])
    panels = convergence_panels(objects)
    titles = {title for panel in panels if (title := panel.title) not in shown}  # words, which are no keys
    drawn = [(panel.title if panel.title in titles else key(panel.title), diagram(panel)) for panel in panels]
    rows = [
        {"name": name(entry), "of": quantity(entry), "place": shown.index(quantity(entry)), "entry": entry}
        for entry in methods
    ]
    parts = Markup().join(said) + lay_out("note", differing, "failed")
    parts += lay_out("legend", [curve.name for curve in panels[0].curves] if panels else [])
    parts += lay_out("diagrams", drawn) + Markup().join(lay_out("soft", line) for line in agreeing)
    return parts + lay_out("measured.methods", rows, bool(points), len(shown), MOST_DRAWN)


#: Maximum number of names in the title of a page.
MOST_NAMED = 3
Parts = list[tuple[str, Markup]]


def several_parts(sources: Sequence[Source]) -> tuple[str, Markup, Parts]:
    """Return three results for a page about `sources`, one after the other: title, header, and parts as titles and
    markup.
    """
    names = [source.name for source in sources]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    title, parts = ", ".join(names[:MOST_NAMED]) + more, []
    for source in sources:
        if isinstance(source, ShownRun):
            own = {"Outcome": guarded(partial(outcome, source)), **run_parts(source)}
        elif isinstance(source, SweepRuns):
            own = sweep_parts(source)
        else:
            own = {HEADINGS[source.kind]: guarded(partial(measured, source))}
        named = len(sources) > 1 or isinstance(source, Measurements)
        parts += [(f"{part}: {source.name}" if named else part, markup) for part, markup in own.items()]
    return title, lay_out("header", title), parts


#: Heading of a source, before its name.
HEADINGS = {"bench": "Cost of a step", "gradcheck": "Gradients against references",
            "convergence": "Error against run time"}  # fmt: skip


def measured(source: Measurements) -> Markup:
    """Return the whole content of a file of measurements."""
    make = {"bench": bench, "gradcheck": gradcheck, "convergence": convergence}[source.kind]
    return make(source.objects) + Markup().join(lay_out("run.origin", origin) for origin in source.origins)


def gradcheck(objects: Sequence[Entry]) -> Markup:
    """Return a table of the comparisons. Failures come first. Incomplete derivatives are listed, too."""
    records = [record for entry in objects if (record := record_of(GradcheckRecord, entry)) is not None]
    missing = [found for entry in objects if (found := record_of(MissingRecord, entry)) is not None]
    failed = [failure_line(record) for record in records if record.verdict is Verdict.FAILS]
    ordered = sorted(records, key=lambda record: record.verdict is not Verdict.FAILS)
    lines = [line for line in summary_lines(records) if not line.startswith("FAILS")] if records else []
    lines += [found.line() for found in missing]
    several = len({record.case for record in records}) > 1
    rows = [{"case": record.case, "cells": cells(record)} for record in ordered]
    return lay_out("measured.gradcheck", failed, lines, list(HEAD), several, rows)
