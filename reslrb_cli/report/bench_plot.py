"""Step time and peak memory against path depth, as in the paper's Figure 6, or against what else was swept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reslrb_cli.records.bench import BenchRecord, BenchStatus

_MARKERS = "osD^vPX*<>"


#: What one curve is drawn from: a label, and records by the value of what was swept.
Series = tuple[str, Sequence[tuple[int, BenchRecord]]]


def plot_bench(series: Sequence[Series], path: Path, title: str, abscissa: str = "path depth") -> None:
    """Write a PNG with one curve for each of the series; bars span from the least to the greatest step time.

    Where a case ran out of memory or failed, a cross stands above the diagram of memory at that value.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    time_axis, memory_axis = figure.subplots(1, 2)
    for k, (label, records) in enumerate(series):
        style = {"color": f"C{k % 10}", "marker": _MARKERS[k % len(_MARKERS)], "markersize": 5, "linewidth": 1.3}
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
    figure.suptitle(title, fontsize="medium", parse_math=False)  # a path may hold a $
    figure.savefig(path, format="png", dpi=150)


def _mark_ends(axis: Any, depths: list[int], color: Any, row: int) -> None:
    """Crosses above the diagram, a little apart where several cases ended at one depth."""
    for depth in depths:
        place = axis.get_xaxis_transform()
        axis.plot([depth * 2 ** (0.06 * row)], [1.025], "x", color=color, markersize=8, transform=place, clip_on=False)
