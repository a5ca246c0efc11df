"""Figure 5 as it is shown: its picture, its table, and its figures as JSON, from `paper_figure5_measure.py`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from paper_figure1_report import write
from paper_figure5_measure import Result
from paper_noise import relative_noise

from reslrb_cli.records.metrics import finite
from reslrb_cli.report.tonemap import encode

#: Inches: a panel's width, what is between two, and above one.
PANEL, GAP, TITLE = 3.6, 0.08, 0.24
DPI = 100

#: As in the paper: blue negative, grey zero, red positive.
COLORS = ("#0a2fb0", "#8a8a8a", "#c01818")

#: Of the texels, so many go beyond the scale; and so many standard errors are its end in the z map.
BEYOND, FAR = 0.01, 5.0


def table(result: Result) -> str:
    """The figures in lines, as they are printed."""
    config, plan = result.config, result.plan
    height, width = result.pictures["initial"].shape[:2]
    rows, columns = result.ours.samples.shape[1:3]  # type: ignore[union-attr]
    lines = [
        f"{config.source}: film {width}x{height}, {result.key} {columns}x{rows}, max_depth "
        f"{config.integrator.max_depth}, {plan.spp} spp, dL/dI held at an image of {plan.reference_spp} spp",
        f"left out: {result.left_out:.1%} of the pixels: they see glass, mirrors or coats, or lie at the film's border",
        "",
        f"{'gradient':24} {'seeds':>6} {'relative noise':>15} {'arrays MiB':>11}",
    ]
    for kind in result.kinds:
        noise = relative_noise(kind.rows, _mean(result))
        lines.append(f"{kind.name:24} {len(kind.rows):6} {noise:15.3f} {kind.arrays_mib:11.1f}")
    lines += ["", f"{'compared':34} {'rel. L2':>9} {'z rms':>6} {'limit':>6} {'max |z|':>8} {'limit':>6}"]
    for (one, other), figures in result.comparisons.items():
        numbers = (figures.z_rms, figures.z_rms_limit, figures.z_max, figures.z_max_limit)
        cells = ["" if value is None else f"{value:.2f}" for value in numbers]
        lines.append(
            f"{f'{one} - {other}':34} {figures.relative_l2 or 0.0:9.1e} {cells[0]:>6} {cells[1]:>6} {cells[2]:>8} "
            f"{cells[3]:>6}  {figures.verdict.value}{': ' if figures.message else ''}{figures.message}"
        )
    return "\n".join(lines)


def to_json(result: Result) -> dict[str, Any]:
    """The same, to be read by programs."""
    return {
        "config": str(result.config.source),
        "parameter": result.key,
        "plan": dataclasses.asdict(result.plan),
        "film": list(result.pictures["initial"].shape[1::-1]),
        "max_depth": result.config.integrator.max_depth,
        "left_out": result.left_out,
        "gradients": [
            {
                "gradient": kind.name,
                "seeds": len(kind.rows),
                "relative_noise": relative_noise(kind.rows, _mean(result)),
                "arrays_mib": kind.arrays_mib,
            }
            for kind in result.kinds
        ],
        "comparisons": [
            {"gradient": one, "reference": other, **finite(vars(figures))}
            for (one, other), figures in result.comparisons.items()
        ],
        "holds": result.holds,
    }


def draw(result: Result, path: Path) -> None:
    """Write the picture: the room, one gradient of each kind, and the z map of their means."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    assert result.z is not None, "made when the result was checked"
    colors = LinearSegmentedColormap.from_list("sign", COLORS)
    shown = [kind.samples[0].sum(-1) for kind in (result.naive, result.ours) if kind.samples is not None]
    end = float(np.quantile(np.abs(shown[0]), 1 - BEYOND)) or 1.0
    image = result.pictures["initial"]
    white = float(np.quantile(image, 0.9)) or 1.0
    heights = [PANEL * image.shape[0] / image.shape[1], PANEL * shown[0].shape[0] / shown[0].shape[1]]
    size = 2 * PANEL + GAP, max(heights) + min(heights) + 2 * TITLE
    figure = Figure(figsize=size, dpi=DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    of_rows = [max(heights), min(heights)]

    def panel(row: int, column: int, title: str) -> Any:
        top = size[1] - sum(of_rows[: row + 1]) - (row + 1) * TITLE
        left = column * (PANEL + GAP)
        made = figure.add_axes((left / size[0], top / size[1], PANEL / size[0], of_rows[row] / size[1]))
        made.set_title(title, fontsize=8, pad=3, parse_math=False)
        made.set(xticks=[], yticks=[])
        return made

    depth = result.config.integrator.max_depth
    panel(0, 0, f"the room, paths of length {depth}").imshow(encode(np.clip(image / white, 0, 1)))
    limits = {"cmap": colors, "interpolation": "nearest"}
    worst = result.comparisons[result.ours.name, result.naive.name]
    words = f"z of their means, {result.plan.seeds} seeds each: rms {worst.z_rms or math.nan:.2f} in gradcheck's tiles"
    panel(0, 1, words).imshow(result.z, vmin=-FAR, vmax=FAR, **limits)
    for column, kind in enumerate((result.naive, result.ours)):
        title = f"dL/d floor, {kind.label}, {kind.arrays_mib:.0f} MiB"
        panel(1, column, title).imshow(shown[column], vmin=-end, vmax=end, **limits)
    canvas.draw()
    write(np.asarray(canvas.buffer_rgba())[:, :, :3].copy(), path)


def _mean(result: Result) -> np.ndarray:
    """The gradient as both kinds together show it, (P,)."""
    return np.asarray((result.naive.rows.mean(0) + result.ours.rows.mean(0)) / 2)
