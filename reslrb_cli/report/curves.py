"""Curves of a run against iterations and time, as SVG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

#: One curve's name, its y values (None where there is none), and its unit.
QUANTITIES = (("loss", "loss"), ("parameter_rmse", "parameter RMSE (parameter's units)"))
ABSCISSAE = (("iteration", "iteration"), ("elapsed_s", "time in steps and updates (s)"))


def draw_curves(records: Sequence[dict[str, Any]]) -> str:
    """Loss, and parameter RMSE where it is known, against iterations and against time; an `<svg>` element.

    Returns the empty string where there are no records.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    rows = [(key, label) for key, label in QUANTITIES if any(record.get(key) is not None for record in records)]
    if not rows:
        return ""
    # A figure and canvas of our own: pyplot would pick a backend for the whole process.
    figure = Figure(figsize=(10.0, 3.2 * len(rows)), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.subplots(len(rows), len(ABSCISSAE), squeeze=False, sharey="row")
    for row, (key, label) in enumerate(rows):
        known = [record for record in records if record.get(key) is not None]
        for column, (abscissa, caption) in enumerate(ABSCISSAE):
            axis = axes[row][column]
            axis.plot([record[abscissa] for record in known], [record[key] for record in known], linewidth=1.2)
            if all(record[key] > 0 for record in known):
                axis.set_yscale("log")
            axis.set_xlabel(caption)
            axis.grid(True, which="both", alpha=0.25)
        axes[row][0].set_ylabel(label)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
