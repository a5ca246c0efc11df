"""Tables and figures of measurements, runs and sweeps for papers: CSV, LaTeX, arrays, PDF, SVG and PNG."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reslrb_cli.config.files import as_path
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.measurements import GradcheckRecord, MethodRecord, record_of
from reslrb_cli.records.metrics import Line
from reslrb_cli.records.sweeps import in_words, label, short_keys
from reslrb_cli.report import panels
from reslrb_cli.report.format import number, rounded, shorten
from reslrb_cli.report.page import write_page
from reslrb_cli.report.page.sweep import MOST_CURVES, figures_of, ranked, row_records, run_records, runs_of
from reslrb_cli.report.plots import Panel, draw
from reslrb_cli.report.sources import Measurements, ShownRun, Source, SweepRuns, kind_of, read_sources
from reslrb_cli.report.tables import HEAD, cells

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = np.ndarray[Any, Any]
Entry = Mapping[str, Any]
#: A cell of a table: text, a number, or a number with the ends of its interval.
Cell = str | float | tuple[float, float, float] | None

FIGURES, TABLES, PAGES = (".pdf", ".svg", ".png"), (".csv", ".tex"), (".html", ".htm", "")


def write(sources: Sequence[Source], path: Path, option: str) -> None:
    """Write a page, a table or a figure about `sources`, atomically, as the suffix of `path` says.

    Raises a ConfigError, located by `option` or by a source, if there is no such output.
    """
    suffix = path.suffix.lower()
    if suffix in PAGES:
        write_page(sources, path)
    elif suffix in FIGURES or suffix in TABLES:
        content = (
            as_latex(sources).encode() if suffix == ".tex"
            else as_csv(rows_of(sources)).encode() if suffix == ".csv"
            else drawn(panels_of(sources), suffix[1:])
        )  # fmt: skip
        write_atomically(path, lambda file: file.write(content))
    else:
        known = ", ".join((".html", *TABLES, *FIGURES))
        raise ConfigError(option, "", f"{path.name} has an unknown suffix; the suffixes are {known}")


# --- figures ----------------------------------------------------------------------------------------------------------

#: Sizes in inches: the width of a column of text, the height of a diagram, and the height of a line of the legend.
WIDTH, HEIGHT, LINE = 3.3, 2.1, 0.14

#: Maximum width of a name in the legend.
NAME_WIDTH = 52

_STYLE = {
    "font.size": 8, "axes.linewidth": 0.6, "axes.labelsize": 8, "legend.fontsize": 7, "xtick.labelsize": 7,
    "ytick.labelsize": 7, "axes.titlesize": 8, "lines.linewidth": 1.2, "lines.markersize": 3.5, "axes.axisbelow": True,
    "text.parse_math": False, "pdf.fonttype": 42, "svg.hashsalt": "reslrb",
}  # fmt: skip


def panels_of(sources: Sequence[Source]) -> list[Panel]:
    """Return the diagrams of all sources. Runs share one diagram, and so do convergences of several path depths. Raises
    ConfigError if a source has no diagram.
    """
    runs = [source for source in sources if isinstance(source, ShownRun) and source.records]
    joined = _joined(sources)
    groups = [("", _errors_over_time([run.name for run in runs], [[run] for run in runs]))] if runs else []
    groups += [("", panels.convergence_panels(joined))] if joined else []
    for source in sources:
        if isinstance(source, SweepRuns):
            sweep = ranked(source.sweep, run_records(source))
            shown = sweep.combinations[:MOST_CURVES]
            own = [runs_of(source, each) for each in shown]
            groups.append((source.name, _errors_over_time([label(each.settings) for each in shown], own)))
        elif isinstance(source, Measurements) and source.kind == "gradcheck":
            reason = "is of gradcheck, which has no figure; write a table (-o FILE.tex or FILE.csv)"
            raise ConfigError(source.path, "", reason)
        elif isinstance(source, Measurements) and not (joined and source.kind == "convergence"):
            make = panels.bench_panels if source.kind == "bench" else panels.convergence_panels
            groups.append((source.name, make(source.objects)))
    named = len(groups) > 1
    found = [replace(panel, title=": ".join(filter(None, (named * name, panel.title))))
             for name, own in groups for panel in own if panel.shown()]  # fmt: skip
    if not found:
        raise ConfigError(sources[0].path, "", "has no results to draw yet")
    return found


def _joined(sources: Sequence[Source]) -> list[Entry]:
    """Return the lines of all convergences if they have several path depths, otherwise nothing."""
    files = [source for source in sources if isinstance(source, Measurements) and source.kind == "convergence"]
    lines = [entry for file in files for entry in file.objects]
    return lines if panels.has_depths(lines) else []


def _errors_over_time(titles: Sequence[str], runs: Sequence[Sequence[ShownRun]]) -> list[Panel]:
    """Return the diagram of the parameter errors against time, or of the losses if no error is known."""
    over_time = [panel for panel in panels.run_panels(titles, runs) if panel.x == panels.TIME and panel.shown()]
    return over_time[-1:]


def figure(shown: Sequence[Panel]) -> Figure:
    """Return a figure of diagrams below each other, as wide as a column of text. The legend stands above them."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        made = Figure(figsize=(WIDTH, HEIGHT * len(shown)), layout="constrained")
        FigureCanvasAgg(made)  # without pyplot, which would choose a backend for the whole process
        handles: dict[str, Any] = {}
        for axis, panel in zip(made.subplots(len(shown), squeeze=False)[:, 0], shown, strict=True):
            draw(axis, panel)
            axis.set_title(shorten(panel.title, NAME_WIDTH) if len(shown) > 1 else "")
            axis.grid(True, which="major", alpha=0.2, linewidth=0.5)
            for handle, name in zip(*axis.get_legend_handles_labels(), strict=True):
                handles.setdefault(shorten(name, NAME_WIDTH), handle)
        if len(handles) > 1:
            _add_legend(made, handles)
    return made


def _add_legend(made: Figure, handles: Mapping[str, Any]) -> None:
    """Add a legend above all diagrams, in as many columns as fit. The figure grows by its height."""
    for columns in (3, 2, 1):
        legend = made.legend(handles.values(), handles, loc="outside upper left", ncols=columns, frameon=False,
                             borderpad=0, labelspacing=0.2, columnspacing=1.0, handlelength=1.6)  # fmt: skip
        if legend.get_window_extent().width < made.bbox.width or columns == 1:
            made.set_figheight(made.get_figheight() + LINE * -(-len(handles) // columns))
            return
        legend.remove()


def drawn(shown: Sequence[Panel], suffix: str) -> bytes:
    """Return the figure of diagrams as a file of the format `pdf`, `svg` or `png`."""
    import matplotlib

    content, date = io.BytesIO(), {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(suffix)
    with matplotlib.rc_context(_STYLE):
        figure(shown).savefig(content, format=suffix, dpi=300, metadata=date)
    return content.getvalue()


# --- tables of plain numbers ------------------------------------------------------------------------------------------


def rows_of(sources: Sequence[Source], kind: str | None = None) -> list[dict[str, Any]]:
    """Return a row of plain numbers and text for each method, case, comparison or combination, or for each record of
    `kind`. Raises ConfigError if the sources have no table in common.
    """
    kinds = {source.kind: source for source in sources if not isinstance(source, ShownRun)}
    runs = [source for source in sources if isinstance(source, ShownRun)]
    if runs:
        raise ConfigError(runs[0].path, "", "is a run, which has no table; give the folder of a sweep, or measurements")
    if len(kinds) > 1:
        first, second = list(kinds.values())[:2]
        reason = f"is of {second.kind}, and {first.path} is of {first.kind}; give files of one kind for a table"
        raise ConfigError(second.path, "", reason)
    rows = [
        ({"source": source.name} if len(sources) > 1 else {}) | _flattened(entry)
        for source in sources
        for entry in _entries(source, kind)
    ]
    if not rows:
        raise ConfigError(sources[0].path, "", f"has no results{f' of the kind {kind!r}' if kind else ''} for a table")
    return rows


def _entries(source: Source, kind: str | None) -> list[Entry]:
    if isinstance(source, SweepRuns):
        runs = run_records(source)
        records = runs if kind == "sweep_run" else row_records(ranked(source.sweep, runs), runs)
        return [json.loads(record.to_json()) for record in records]
    assert isinstance(source, Measurements), "runs have no table"
    if kind is not None:
        return [entry for entry in source.objects if entry.get("kind") == kind]
    if source.kind == "convergence":
        return panels.of_kind(source.objects, MethodRecord)
    return [entry for entry in source.objects if "status" in entry or "verdict" in entry]


def _flattened(entry: Entry) -> dict[str, Any]:
    """Return the fields of a record. The ends of an interval are `NAME_low` and `NAME_high`."""
    found: dict[str, Any] = {}
    for name, value in entry.items():
        if name == "kind":
            continue
        middle, low, high = panels.figure_with_ends(value)
        if isinstance(value, Mapping) and middle is not None:
            found |= {name: middle, f"{name}_low": low, f"{name}_high": high}
        elif isinstance(value, Mapping):
            found |= {f"{name}_{key}": each for key, each in _flattened(value).items()}
        elif isinstance(value, list):
            found[name] = " ".join(map(str, value))
        else:
            found[name] = int(value) if isinstance(value, bool) else value
    return found


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as CSV with a line of names. Unknown values are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _names(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def table(source: str | os.PathLike[str] | Sequence[Line], kind: str | None = None) -> dict[str, Array]:
    """Return records as arrays, with one array for each column of `reslrb report -o FILE.csv`.

    `source` is the list that `convergence`, `bench` or `gradcheck` returned, a file that these commands wrote with
    `--json`, or the folder of a sweep. `kind` selects the records: `"point"` has the errors of a convergence against
    time. By default, there is a row for each method and parameter, case, comparison, or combination of settings.

    Columns of numbers are float arrays, with NaN for unknown values. Other columns are arrays of text. The ends of an
    interval are in the columns `NAME_low` and `NAME_high`. Raises ConfigError.
    """
    rows = rows_of(as_sources(source), kind)
    columns = {name: [row.get(name) for row in rows] for name in _names(rows)}
    return {name: _array(values) for name, values in columns.items()}


def _array(values: Sequence[Any]) -> Array:
    if all(value is None or isinstance(value, int | float) for value in values):
        return np.array(values, dtype=np.float64)  # None is NaN
    return np.array(["" if value is None else str(value) for value in values])


def as_sources(given: object) -> list[Source]:
    """Return the sources of paths, or of records that a measurement returned. Raises ConfigError."""
    entries = list(given) if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    records = [each for each in entries if isinstance(each, Line)]
    if records and len(records) == len(entries):
        objects = [json.loads(record.to_json()) for record in records]
        kind = next((kind for entry in objects if (kind := kind_of(entry)) is not None), "bench")
        return [Measurements(Path("records"), "records", kind, objects)]
    wanted = "the path of a run folder, or of a file of measurements"
    return read_sources([as_path(each, "sources", wanted) for each in entries])


# --- LaTeX ------------------------------------------------------------------------------------------------------------


def as_latex(sources: Sequence[Source]) -> str:
    """Return the sources as a LaTeX table, which needs the package booktabs only. Comments name the commands that made
    the measurements. Raises ConfigError if the sources have no table in common.
    """
    rows_of(sources)  # raises the error
    has_depths = bool(_joined(sources))
    made = [_latex_rows(source, has_depths) for source in sources]
    head, named = made[0][0], len(sources) > 1 and not has_depths
    for source, (own, _) in zip(sources, made, strict=True):
        if own != head:
            raise ConfigError(source.path, "", f"has other columns than {sources[0].path}; write a table for each")
    names: list[list[Cell]] = [[source.name] * named for source in sources]
    body = [name + row for name, (_, rows) in zip(names, made, strict=True) for row in rows]
    head = ["source"] * named + head
    is_text = [all(isinstance(row[place], str) for row in body) for place in range(len(head))]
    texts = [*is_text, False].index(False)  # the first columns, which are aligned at the left
    origins = [origin for source in sources if isinstance(source, Measurements) for origin in source.origins]
    told = [f"{origin.device}, {origin.variant}: {' '.join(origin.command)}" for origin in origins]
    lines = [f"% {re.sub(r'[^ -~]', '?', line)}" for line in ("needs \\usepackage{booktabs}", *told)]
    lines += [f"\\begin{{tabular}}{{{'l' * texts + 'r' * (len(head) - texts)}}}", "\\toprule"]
    lines += [" & ".join(map(escaped, head)) + " \\\\", "\\midrule"]
    lines += [" & ".join(map(_latex_cell, row)) + " \\\\" for row in body]
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def _latex_rows(source: Source, has_depths: bool) -> tuple[list[str], list[list[Cell]]]:
    """Return the titles of the columns and the rows of a source. `has_depths` adds the path depth of a convergence."""
    if isinstance(source, SweepRuns):
        runs = run_records(source)
        keys, figures = short_keys(source.sweep.keys), figures_of(runs)
        units = {"elapsed_s": "time (s)", "peak_mib": "peak memory (MiB)"}
        rows = [[*map(in_words, row.settings.values()), row.runs, *(_span(getattr(row, name)) for name in figures)]
                for row in row_records(ranked(source.sweep, runs), runs)]  # fmt: skip
        return [*keys.values(), "runs", *(units.get(name, title) for name, title in figures.items())], rows
    assert isinstance(source, Measurements), "runs have no table"
    if source.kind == "gradcheck":
        records = [record for entry in source.objects if (record := record_of(GradcheckRecord, entry)) is not None]
        return list(HEAD), [list(cells(record)) for record in records]
    if source.kind == "bench":
        entries, name = panels.bench_entries(source.objects)
        head = ["integrator", panels.SWEPT[name], "step (ms)", "kernels (ms)", "peak memory (MiB)"]
        return head, [[panels.label(entry), entry.get(name), *_measured(entry, "step_ms", "kernel_ms", "peak_mib")]
                      for entry in entries]  # fmt: skip
    methods = panels.of_kind(source.objects, MethodRecord)
    naming, several = panels.method_naming(methods), len(panels.quantities(methods)) > 1
    errors = list(methods[0].get("seconds_to") or {})
    head = ["method", *["parameter"] * several, *["depth"] * has_depths]
    head += ["step (s)", "error of a step", "efficiency (1/s)", "bias"]
    head += [f"time to {float(error):.0%} (s)" for error in errors]
    rows = []
    for entry in methods:
        row: list[Cell] = [naming(entry), *[panels.quantity(entry)] * several, *[entry.get("max_depth")] * has_depths]
        row += _measured(entry, "step_s", "relative_rmse", "efficiency")
        row.append(_bias(entry))
        rows.append([*row, *(_seconds(entry, error) for error in errors)])
    return head, rows


def _measured(entry: Entry, *names: str) -> list[Cell]:
    """Return figures of a record. If nothing was measured, the first one is the reason."""
    if entry.get("status", "ok") != "ok":
        return [str(entry["status"]).replace("_", " "), *[None] * (len(names) - 1)]
    return [_span(entry.get(name)) for name in names]


def _span(value: object) -> Cell:
    """Return a figure of a record, with the ends of its interval if it has one."""
    middle, low, high = panels.figure_with_ends(value)
    return middle if middle is None or low is None or high is None else (middle, low, high)


def _bias(entry: Entry) -> Cell:
    """Return the relative bias, or a word."""
    if entry.get("relative_rmse") is None:
        return None
    biased = entry.get("biased")
    return "open" if biased is None else entry.get("bias") or "yes" if biased else "none"


def _seconds(entry: Entry, error: str) -> Cell:
    """Return a time, with `~` if it is extrapolated, or `never` if a bias keeps the error above `error`."""
    seconds = (entry.get("seconds_to") or {}).get(error)
    if seconds is None:
        return "never" if entry.get("biased") else None
    return f"~{_digits(seconds, 2)}" if error in (entry.get("extrapolated") or ()) else _digits(seconds, 2)


def _latex_cell(cell: Cell) -> str:
    if cell is None or isinstance(cell, str):
        return escaped(cell or "")
    if isinstance(cell, tuple):
        first, *ends = map(_latex_number, rounded(*cell))
        return f"{first} [{', '.join(ends)}]"
    return _latex_number(str(cell) if isinstance(cell, int) else _digits(cell, 3))


def _digits(value: float, digits: int) -> str:
    """Return a number with all of its `digits`, such as 0.150."""
    text = f"{value:#.{digits}g}"
    return number(value, digits) if "e+" in text else text.rstrip(".")


def _latex_number(text: str) -> str:
    """Return a number as a formula."""
    mantissa, _, exponent = text.partition("e")
    return f"${mantissa} \\times 10^{{{int(exponent)}}}$" if exponent else f"${text}$"


#: Characters with a meaning in LaTeX, or with another shape in its text.
_ESCAPES = {
    **{each: f"\\{each}" for each in "&%$#_{}"}, "\\": "\\textbackslash{}", "~": "$\\sim$", "^": "\\textasciicircum{}",
    "<": "$<$", ">": "$>$", "|": "$|$", "-": "{-}", '"': "''",
}  # fmt: skip


def escaped(text: str) -> str:
    """Return text as LaTeX that prints the same characters."""
    return "".join(_ESCAPES.get(each, each) for each in text)
