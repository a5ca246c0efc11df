"""Loss and parameter error of whole optimisations against run time: medians, and bands over the seeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reslrb_cli.records.whole_runs import Band, RunPointRecord


def plot_runs(points: Sequence[RunPointRecord], error_of: str, path: Path, title: str) -> None:
    """Write a PNG; a second panel for the error, which `error_of` names, where it is known."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = [("loss", "loss"), ("parameter_error", error_of)] if error_of else [("loss", "loss")]
    figure = Figure(figsize=(1.0 + 6.2 * len(panels), 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(panels), squeeze=False).ravel()
    labels = list(dict.fromkeys(point.method.label for point in points))
    for axis, (of, name) in zip(axes, panels, strict=True):
        for place, label in enumerate(labels):
            _draw(axis, [point for point in points if point.method.label == label], of, label, f"C{place % 10}")
        axis.set(xlabel="seconds of a run, all costs counted", ylabel=name)
        if any(line.get_ydata()[0] > 0 for line in axis.lines):
            axis.set_yscale("log")
        axis.grid(True, which="both", alpha=0.25)
    axes[0].legend(fontsize="small")
    figure.suptitle(title, fontsize="medium", parse_math=False)  # a path may hold a $
    figure.savefig(path, format="png", dpi=150)


def curve(points: Sequence[RunPointRecord], of: str) -> list[tuple[float, Band]]:
    """Times and bands of one method, over those of its runs that have a value of the field `of` at each time."""
    found: dict[float, list[float]] = {}
    for point in points:
        value = getattr(point, of)
        if value is not None:
            found.setdefault(point.elapsed_s, []).append(value)
    return [(time, band) for time in sorted(found) if (band := Band.of(found[time])) is not None]


def _draw(axis: Any, points: Sequence[RunPointRecord], of: str, label: str, color: str) -> None:
    along = curve(points, of)
    if along:
        times = [time for time, _ in along]
        axis.plot(times, [band.median for _, band in along], label=label, color=color, linewidth=1.4)
        axis.fill_between(times, [band.low for _, band in along], [band.high for _, band in along],
                          color=color, alpha=0.18, linewidth=0)  # fmt: skip
