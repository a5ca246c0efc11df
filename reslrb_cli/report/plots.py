"""Measurements as pictures: what a bench, a convergence or whole optimisations came to, and maps of gradients."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reslrb_cli.errors import one_line
from reslrb_cli.records.images import bounded, file_stem, write_layers
from reslrb_cli.records.measurements import (
    Band,
    BenchRecord,
    BenchStatus,
    GradcheckRecord,
    MethodRecord,
    PointRecord,
    RunPointRecord,
)
from reslrb_cli.report.format import shorten
from reslrb_cli.report.tables import integrator_name, reference_name
from reslrb_cli.report.tonemap import color_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKERS = "osD^vPX*<>"


def _style(place: int) -> dict[str, Any]:
    """How the curve of a place is drawn."""
    return {"color": f"C{place % 10}", "marker": _MARKERS[place % len(_MARKERS)], "markersize": 5, "linewidth": 1.3}


def _figure(inches: tuple[float, float]) -> Figure:
    """A figure with a canvas of its own: pyplot would pick a backend for the whole process."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=inches, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path, title: str) -> None:
    """Write it as a PNG."""
    figure.suptitle(title, fontsize="medium", parse_math=False)  # a path may hold a $
    figure.savefig(path, format="png", dpi=150)


#: What one curve is drawn from: a label, and records by the value of what was swept.
Series = tuple[str, Sequence[tuple[int, BenchRecord]]]


def plot_bench(series: Sequence[Series], path: Path, title: str, abscissa: str = "path depth") -> None:
    """Write a PNG with one curve for each of the series; bars span from the least to the greatest step time.

    Where a case ran out of memory or failed, a cross stands above the diagram of memory at that value.
    """
    figure = _figure((11.0, 4.6))
    time_axis, memory_axis = figure.subplots(1, 2)
    for k, (label, records) in enumerate(series):
        style = _style(k)
        done = [(x, record) for x, record in records if record.step_ms is not None and record.peak_mib is not None]
        values = [x for x, _ in done]
        steps = [record.step_ms for _, record in done if record.step_ms is not None]
        errors = [[s.median - s.min for s in steps], [s.max - s.median for s in steps]]
        time_axis.errorbar(values, [s.median for s in steps], yerr=errors, label=label, capsize=2, **style)
        memory_axis.plot(values, [max(record.peak_mib or 0, 1e-3) for _, record in done], label=label, **style)
        _mark_ends(memory_axis, [x for x, r in records if r.status is not BenchStatus.OK], style["color"], k)
    finished = any(record.status is BenchStatus.OK for _, records in series for _, record in records)
    ends = {record.status for _, records in series for _, record in records} - {BenchStatus.OK}
    words = {BenchStatus.OUT_OF_MEMORY: "out of memory", BenchStatus.FAILED: "failed"}
    for axis, label in ((time_axis, "time of a step (ms)"), (memory_axis, "peak memory (MiB)")):
        axis.set(yscale="log" if finished else "linear", xlabel=abscissa, ylabel=label)
        axis.set_xscale("log", base=2)
        axis.set_xticks(sorted({x for _, records in series for x, _ in records}))
        axis.xaxis.set_major_formatter("{x:.0f}")
        axis.grid(True, which="both", alpha=0.25)
    if ends:
        crosses = " or ".join(words[end] for end in sorted(ends))
        memory_axis.set_title(f"×: {crosses}", fontsize="small", loc="left")
    time_axis.legend(fontsize="small")
    _save(figure, path, title)


def _mark_ends(axis: Any, depths: list[int], color: Any, row: int) -> None:
    """Crosses above the diagram, a little apart where several cases ended at one depth."""
    for depth in depths:
        place = axis.get_xaxis_transform()
        axis.plot([depth * 2 ** (0.06 * row)], [1.025], "x", color=color, markersize=8, transform=place, clip_on=False)


#: Panels at most: all together, and the first parameters.
PANELS = 6
COLUMNS = 3

#: Points of fewer averages are hollow: they scatter.
FEW = 4


def plot_convergence(
    points: Sequence[PointRecord], methods: Sequence[MethodRecord], path: Path, title: str
) -> None:  # fmt: skip
    """Write a PNG; the reference's own standard error is a dashed line, and biased methods say so in the legend."""
    keys = panels([record.parameter for record in methods])
    columns = min(len(keys), COLUMNS)
    rows = -(-len(keys) // columns)
    figure = _figure((1.0 + 6.2 * columns, 1.0 + 4.4 * rows))
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    labels = list(dict.fromkeys(record.method.label for record in methods))
    for axis, key in zip(axes, keys, strict=False):
        _draw_errors(axis, key, labels, points, methods)
    for axis in axes[len(keys) :]:
        axis.set_visible(False)
    axes[0].legend(fontsize="small")
    _save(figure, path, title)


def panels(parameters: Sequence[str]) -> list[str]:
    """What is drawn: all together first; a single parameter is all there is."""
    keys = list(dict.fromkeys(parameters))
    if "all" not in keys:
        return keys[:PANELS]
    alone = [key for key in keys if key != "all"]
    return ["all"] if len(alone) == 1 else ["all", *alone][:PANELS]


def _draw_errors(
    axis: Any, key: str, labels: Sequence[str], points: Sequence[PointRecord], methods: Sequence[MethodRecord]
) -> None:
    drawn = False
    floor = next((point.reference_rmse for point in points if point.parameter == key), None)
    for k, label in enumerate(labels):
        record = next((m for m in methods if m.parameter == key and m.method.label == label), None)
        curve = [p for p in points if p.parameter == key and p.method.label == label and p.relative_rmse is not None]
        if record is None or not curve:
            continue
        drawn = True
        name = f"{label} (biased)" if record.biased else label
        style = _style(k)
        axis.plot([p.elapsed_s for p in curve], [p.relative_rmse for p in curve], label=name,
                  linestyle="--" if record.biased else "-", **style)  # fmt: skip
        few = [p for p in curve if p.repeats < FEW]
        axis.plot([p.elapsed_s for p in few], [p.relative_rmse for p in few], color=style["color"], linestyle="",
                  marker=style["marker"], markersize=5, markerfacecolor="white")  # fmt: skip
        # Where the variance of single steps says that averages lead, without a bias.
        if record.relative_rmse is not None and record.step_s is not None:
            ends = [curve[0].elapsed_s, curve[-1].elapsed_s]
            line = [record.relative_rmse * (time / record.step_s) ** -0.5 for time in ends]
            axis.plot(ends, line, color=style["color"], linewidth=0.8, linestyle=":")
    if floor is not None:
        axis.axhline(floor, color="0.4", linestyle=(0, (6, 3)), linewidth=1.0)
        axis.annotate(" standard error of the reference", (0, floor), xycoords=("axes fraction", "data"),
                      va="bottom", fontsize="x-small", color="0.4")  # fmt: skip
    if drawn:
        axis.set(xscale="log", yscale="log")
    axis.set(xlabel="seconds", ylabel="relative RMSE")
    axis.set_title(shorten(key, 48), fontsize="small", loc="left", parse_math=False)
    axis.grid(True, which="both", alpha=0.25)


def plot_runs(points: Sequence[RunPointRecord], error_of: str, path: Path, title: str) -> None:
    """Write a PNG; a second panel for the error, which `error_of` names, where it is known."""
    panels = [("loss", "loss"), ("parameter_error", error_of)] if error_of else [("loss", "loss")]
    figure = _figure((1.0 + 6.2 * len(panels), 5.2))
    axes = figure.subplots(1, len(panels), squeeze=False).ravel()
    labels = list(dict.fromkeys(point.method.label for point in points))
    for axis, (of, name) in zip(axes, panels, strict=True):
        for place, label in enumerate(labels):
            _draw_runs(axis, [point for point in points if point.method.label == label], of, label, f"C{place % 10}")
        axis.set(xlabel="seconds of a run, all costs counted", ylabel=name)
        if any(line.get_ydata()[0] > 0 for line in axis.lines):
            axis.set_yscale("log")
        axis.grid(True, which="both", alpha=0.25)
    axes[0].legend(fontsize="small")
    _save(figure, path, title)


def curve(points: Sequence[RunPointRecord], of: str) -> list[tuple[float, Band]]:
    """Times and bands of one method, over those of its runs that have a value of the field `of` at each time."""
    found: dict[float, list[float]] = {}
    for point in points:
        value = getattr(point, of)
        if value is not None:
            found.setdefault(point.elapsed_s, []).append(value)
    return [(time, band) for time in sorted(found) if (band := Band.of(found[time])) is not None]


def _draw_runs(axis: Any, points: Sequence[RunPointRecord], of: str, label: str, color: str) -> None:
    along = curve(points, of)
    if along:
        times = [time for time, _ in along]
        axis.plot(times, [band.median for _, band in along], label=label, color=color, linewidth=1.4)
        axis.fill_between(times, [band.low for _, band in along], [band.high for _, band in along],
                          color=color, alpha=0.18, linewidth=0)  # fmt: skip


#: z at the ends of the scale.
_MOST_Z = 5.0


def plot_maps(record: GradcheckRecord, gradient: np.ndarray, reference: np.ndarray, z: np.ndarray, folder: Path
              ) -> Path:  # fmt: skip
    """Write a PNG of `gradient` and `reference` (H, W, C), summed over channels, and `z` (H, W); return its path.

    Both gradients have one scale, whose ends 1 % of the texels go beyond. An EXR of the same name has them as they
    are: the layers `gradient`, `reference`, `difference` (of the two) and `z`.
    """
    colors = color_map(signed=True)
    sums = gradient.sum(-1), reference.sum(-1)
    end = float(np.quantile(np.abs(np.stack(sums)), 0.99)) or 1.0
    figure = _figure((13, 4.2))
    axes = figure.subplots(1, 3)
    titles = (integrator_name(record), reference_name(record), "difference in standard errors, z")
    for axis, image, limit, title in zip(axes, (*sums, z), (end, end, _MOST_Z), titles, strict=True):
        shown: Any = axis.imshow(image, cmap=colors, vmin=-limit, vmax=limit, interpolation="nearest")
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=7)
        figure.colorbar(shown, ax=axis, extend="both").ax.tick_params(labelsize=7)
    title = f"{record.parameter}, sum over channels, {record.seeds} seeds: {record.verdict.value}"
    figure.suptitle(one_line(title, 150), fontsize=10, parse_math=False)  # a key may hold a $
    path = folder / f"{map_name(record)}.png"
    figure.savefig(path, dpi=110)
    layers = {"gradient": gradient, "reference": reference, "difference": gradient - reference, "z": z}
    write_layers(folder / f"{map_name(record)}.exr", layers)
    return path


def map_name(record: GradcheckRecord) -> str:
    """Name of a record's file, without its suffix."""
    what = (record.integrator, record.estimator, record.reference.value)
    parts = [file_stem(record.parameter)] if record.parameter else []
    return bounded("-".join(parts + [re.sub(r"[^\w.=]+", "_", part).strip("_") for part in what if part]))
