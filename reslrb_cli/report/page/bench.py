"""What `bench` measured: time and memory of a step against what was varied, and all of it as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from reslrb_cli.report.page.drawing import Curve, diagram, diagrams, legend
from reslrb_cli.report.page.markup import breakable, soft, table, text
from reslrb_cli.report.words import duration, number

Entry = Mapping[str, Any]

#: What can be varied: its name in the records, in words, and what they are called where they are fixed.
SWEPT = {"max_depth": "path depth", "spp": "samples per pixel", "pixels": "pixels of the film", "texels": "texels"}
_ENDED = {"out_of_memory": "out of memory", "failed": "failed"}


def bench(objects: Sequence[Entry]) -> tuple[str, int]:
    """Diagrams and a table; and how many lines are no records of a bench."""
    entries = [_with_sizes(entry) for entry in objects if "integrator" in entry and "status" in entry]
    labels = list(dict.fromkeys(map(label, entries)))
    varied = [name for name in SWEPT if len({entry[name] for entry in entries if entry.get(name)}) > 1] or ["max_depth"]
    parts = [legend([Curve(name, (), (), place) for place, name in enumerate(labels)])]
    for name in varied:
        chosen = [
            entry for entry in entries if all(_is_usual(entry, other, entries) for other in varied if other != name)
        ]
        curves = [_curves(chosen, labels, name, what) for what in ("step_ms", "peak_mib")]
        drawn = zip(curves, ("time of a step (ms)", "peak memory (MiB)"), strict=True)
        parts.append(diagrams(*(diagram(made, SWEPT[name], axis, log_x=2) for made, axis in drawn)))
        others = [f"{SWEPT[other]} {number(_usual(other, entries))}" for other in varied if other != name]
        parts.append(soft(f"At {', '.join(others)}." if others else ""))
    parts += [soft(_conditions(entries, varied)), _table(entries, labels, varied)]
    return "".join(parts), len(objects) - len(entries)


def label(entry: Entry) -> str:
    """What names an integrator with what makes it another than by default, `reslrb:reservoir, capacity 4`."""
    parts = ":".join(str(entry[name]) for name in ("integrator", "estimator") if entry.get(name))
    return parts + (f", capacity {entry['capacity']}" if entry.get("capacity") not in (None, 1) else "")


def _with_sizes(entry: Entry) -> dict[str, Any]:
    width, height = entry.get("width"), entry.get("height")
    pixels = width * height if isinstance(width, int) and isinstance(height, int) else None
    return {"pixels": pixels, "texels": entry.get("texels")} | dict(entry)


def _usual(name: str, entries: Sequence[Entry]) -> Any:
    """The value that most of the records have."""
    values = [entry[name] for entry in entries if entry.get(name)]
    return max(dict.fromkeys(values), key=values.count) if values else None


def _is_usual(entry: Entry, name: str, entries: Sequence[Entry]) -> bool:
    return bool(entry.get(name) == _usual(name, entries))


def _curves(entries: Sequence[Entry], labels: Sequence[str], abscissa: str, what: str) -> list[Curve]:
    curves = []
    for place, name in enumerate(labels):
        rows = [entry for entry in entries if label(entry) == name and entry.get("step_ms") and entry.get(abscissa)]
        rows.sort(key=lambda entry: entry[abscissa])
        xs = [entry[abscissa] for entry in rows]
        if what == "peak_mib":
            curves.append(Curve(name, xs, [entry.get(what) for entry in rows], place, points=True))
        else:
            low, median, high = ([entry[what][end] for entry in rows] for end in ("min", "median", "max"))
            curves.append(Curve(name, xs, median, place, (low, high), points=True))
    return curves


def _conditions(entries: Sequence[Entry], varied: Sequence[str]) -> str:
    fixed = [f"{SWEPT[name]} {number(_usual(name, entries))}" for name in SWEPT
             if name not in varied and _usual(name, entries)]  # fmt: skip
    words = f"Fixed: {', '.join(fixed)}. " if fixed else ""
    return f"{words}Medians; bands and brackets go from the least to the greatest."


def _table(entries: Sequence[Entry], labels: Sequence[str], varied: Sequence[str]) -> str:
    head = (
        ["integrator"] + [SWEPT[name] for name in varied] + ["step", "kernels", "first step", "peak memory", "scratch"]
    )
    rows = []
    for entry in sorted(entries, key=lambda entry: [entry.get(name) or 0 for name in varied]):
        cells = [breakable(label(entry)), *(text(number(entry.get(name), 6)) for name in varied)]
        if entry["status"] in _ENDED:
            rows.append([*cells, f'<span class="worse">{_ENDED[entry["status"]]}</span>', "", "", "", ""])
            continue
        cold, scratch = entry.get("cold_ms"), entry.get("scratch_bytes")
        rows.append([
            *cells, _spread(entry.get("step_ms")), _spread(entry.get("kernel_ms")),
            "" if cold is None else text(duration(cold / 1e3)),
            "" if entry.get("peak_mib") is None else text(f"{entry['peak_mib']:.4g} MiB"),
            "" if scratch is None else text(f"{scratch} B"),
        ])  # fmt: skip
    return table(head, rows, "dense")


def _spread(times: Mapping[str, float] | None) -> str:
    if not times:
        return ""
    ends = f"[{number(times['min'], 3)}, {number(times['max'], 3)}]"
    return f'{text(number(times["median"], 3))} ms <span class="soft small">{text(ends)}</span>'
