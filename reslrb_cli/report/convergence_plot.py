"""Error against run time, on logarithmic axes: one panel for all parameters together, and one for each of several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reslrb_cli.records.convergence import MethodRecord, PointRecord
from reslrb_cli.report.words import shorten

_MARKERS = "osD^vPX*<>"
#: Panels at most: all together, and the first parameters.
PANELS = 6
COLUMNS = 3
#: Points of fewer averages are hollow: they scatter.
FEW = 4


def plot_convergence(
    points: Sequence[PointRecord], methods: Sequence[MethodRecord], path: Path, title: str
) -> None:  # fmt: skip
    """Write a PNG; the reference's own standard error is a dashed line, and biased methods say so in the legend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    keys = panels([record.parameter for record in methods])
    columns = min(len(keys), COLUMNS)
    rows = -(-len(keys) // columns)
    figure = Figure(figsize=(1.0 + 6.2 * columns, 1.0 + 4.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    labels = list(dict.fromkeys(record.method.label for record in methods))
    for axis, key in zip(axes, keys, strict=False):
        _draw(axis, key, labels, points, methods)
    for axis in axes[len(keys) :]:
        axis.set_visible(False)
    axes[0].legend(fontsize="small")
    figure.suptitle(title, fontsize="medium", parse_math=False)  # a path may hold a $
    figure.savefig(path, format="png", dpi=150)


def panels(parameters: Sequence[str]) -> list[str]:
    """What is drawn: all together first; a single parameter is all there is."""
    keys = list(dict.fromkeys(parameters))
    if "all" not in keys:
        return keys[:PANELS]
    alone = [key for key in keys if key != "all"]
    return ["all"] if len(alone) == 1 else ["all", *alone][:PANELS]


def _draw(
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
        style = {"color": f"C{k % 10}", "marker": _MARKERS[k % len(_MARKERS)], "markersize": 5, "linewidth": 1.3}
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
