"""Maps of a texture's gradient, of its reference, and of their difference in standard errors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.errors import one_line
from reslrb_cli.records.file_names import bounded, file_stem
from reslrb_cli.records.gradcheck import GradcheckRecord
from reslrb_cli.records.layers import write_layers
from reslrb_cli.report.error_map import color_map
from reslrb_cli.report.gradcheck_table import integrator_name, reference_name

#: z at the ends of the scale.
_MOST_Z = 5.0


def plot_maps(record: GradcheckRecord, gradient: np.ndarray, reference: np.ndarray, z: np.ndarray, folder: Path
              ) -> Path:  # fmt: skip
    """Write a PNG of `gradient` and `reference` (H, W, C), summed over channels, and `z` (H, W); return its path.

    Both gradients have one scale, whose ends 1 % of the texels go beyond. An EXR of the same name has them as they
    are: the layers `gradient`, `reference`, `difference` (of the two) and `z`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    colors = color_map(signed=True)
    sums = gradient.sum(-1), reference.sum(-1)
    end = float(np.quantile(np.abs(np.stack(sums)), 0.99)) or 1.0
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
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
