"""Parts of a page about files of measurements, and of a page about several sources."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from markupsafe import Markup

from reslrb_cli.records.measurements import GradcheckRecord, MissingRecord, SummaryRecord, Verdict, record_of
from reslrb_cli.report.format import number
from reslrb_cli.report.page.layout import diagram, key, lay_out
from reslrb_cli.report.page.run import guarded, outcome, run_parts
from reslrb_cli.report.page.sweep import sweep_parts
from reslrb_cli.report.plots import Curve
from reslrb_cli.report.sources import Measurements, ShownRun, Source, SweepRuns
from reslrb_cli.report.tables import HEAD, cells, failure_line, summary_lines

Entry = Mapping[str, Any]
Naming = Callable[[Entry], str]

#: Quantities that `bench` varies, by field name, in words.
SWEPT = {"max_depth": "path depth", "spp": "samples per pixel"}


def bench(objects: Sequence[Entry]) -> Markup:
    """Return diagrams and a table of a bench."""
    entries = [entry for entry in objects if "integrator" in entry and "status" in entry]
    labels = list(dict.fromkeys(map(label, entries)))
    name = next((name for name in SWEPT if len({entry.get(name) for entry in entries}) > 1), "max_depth")
    drawn = [
        ("", diagram(curves_of(entries, labels, label, name, what), SWEPT[name], words, log_x=2))
        for what, words in (("step_ms", "time of a step (ms)"), ("peak_mib", "peak memory (MiB)"))
    ]
    entries.sort(key=lambda entry: entry.get(name) or 0)
    fixed = [f"{SWEPT[other]} {number(entries[0].get(other))}" for other in SWEPT if other != name and entries]
    rows = [{"label": label(entry), "entry": entry} for entry in entries]
    parts = lay_out("legend", labels) + lay_out("diagrams", drawn)
    return parts + lay_out("measured.bench", rows, name, SWEPT[name], fixed)


def label(entry: Entry) -> str:
    """Return an integrator's name as the user wrote it. Records of older versions lack it: return the integrator, the
    estimator, and the capacity if it differs from the default.
    """
    if entry.get("label"):
        return str(entry["label"])
    parts = ":".join(str(entry[name]) for name in ("integrator", "estimator") if entry.get(name))
    return parts + (f", capacity {entry['capacity']}" if entry.get("capacity") not in (None, 1) else "")


def curves_of(entries: Sequence[Entry], labels: Sequence[str], naming: Naming, x: str, y: str) -> list[Curve]:
    """Return a curve of `y` over `x` for each label. For spreads, the curve shows medians with a band."""
    curves = []
    for place, name in enumerate(labels):
        rows = sorted((row for row in entries if naming(row) == name and row.get(x)), key=lambda row: float(row[x]))
        figures = [row.get(y) for row in rows]
        spreads = [value for value in figures if isinstance(value, Mapping)]
        if spreads:
            rows = [row for row in rows if isinstance(row.get(y), Mapping)]
            low, figures, high = ([value[end] for value in spreads] for end in ("min", "median", "max"))
        xs, band = [row[x] for row in rows], (low, high) if spreads else None
        curves.append(Curve(name, xs, figures, place, band, points=True))
    return curves


#: Maximum number of drawn quantities: all parameters together, the image, then single parameters.
MOST_DRAWN = 8


def convergence(objects: Sequence[Entry]) -> Markup:
    """Return the summary of a convergence, a diagram for each quantity, and a table of the methods."""
    points, methods = ([entry for entry in objects if entry.get("kind") == kind] for kind in ("point", "method"))
    spps = len({entry.get("spp") for entry in [*points, *methods] if entry.get("status", "ok") == "ok"})
    name = partial(method_label, with_spp=spps > 1)
    said = [lay_out("paragraph", entry["line"]) for entry in objects if entry.get("kind") == SummaryRecord.KIND]
    labels = list(dict.fromkeys(map(name, [*methods, *points])))
    quantities = list(dict.fromkeys(map(quantity, [*points, *methods])))
    quantities.sort(key=lambda what: {"all": 0, "image": 1}.get(what, 2))
    drawn = [_error_diagram([entry for entry in points if quantity(entry) == what], labels, what, name)
             for what in quantities[:MOST_DRAWN]]  # fmt: skip
    rows = [
        {"name": name(entry), "of": what, "place": quantities.index(what), "entry": entry}
        for entry in methods
        if (what := quantity(entry)) in quantities
    ]
    return Markup().join(said) + lay_out("legend", labels) + lay_out("diagrams", drawn) + lay_out(
        "measured.methods", rows, bool(points), len(quantities), MOST_DRAWN)  # fmt: skip


def quantity(entry: Entry) -> str:
    """Return the quantity of an error: a parameter key, `all` or `image`."""
    return str(entry.get("parameter") or "all")


def method_label(entry: Entry, with_spp: bool = False) -> str:
    """Return a method's name, and its sampling if known."""
    parts = [label(entry), str(entry.get("adjoint") or "")]
    parts += [f"{entry['spp']} spp"] if with_spp and entry.get("spp") else []
    return ", ".join(part for part in parts if part)


def _error_diagram(points: Sequence[Entry], labels: Sequence[str], what: str, naming: Naming) -> tuple[str, Markup]:
    floors = sorted(value for entry in points if (value := entry.get("reference_rmse") or 0) > 0)
    curves = curves_of(points, labels, naming, "elapsed_s", "relative_rmse")
    drawing = diagram(curves, "time (s)", "relative error", 10, floors[len(floors) // 2 :][:1])
    return {"all": "all parameters", "image": "the image"}.get(what, key(what)), drawing


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
