"""Maps of gradients of textures: the gradient, its reference, and their difference in standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reslrb_cli.records.layers import read_layers
from reslrb_cli.report.error_map import signed_end
from reslrb_cli.report.page.images import map_figure
from reslrb_cli.report.page.markup import breakable, figures, soft

#: z at the ends of the scale.
MOST_Z = 5.0
#: Maps on a page, at most: of a folder with more, the first.
MOST_MAPS = 40


def gradient_maps(paths: Sequence[Path]) -> str:
    """A row for each file of layers; of both gradients the sum over channels, on one scale."""
    rows = []
    for path in paths[:MOST_MAPS]:
        try:
            layers = read_layers(path)
        except (OSError, ValueError):
            rows.append(f"<h3>{breakable(path.stem)}</h3>" + soft("This file is damaged."))
            continue
        sums = {name: np.nan_to_num(layers[name].astype(np.float64)).sum(-1, keepdims=True)
                for name in ("gradient", "reference", "z")}  # fmt: skip
        end = signed_end(np.stack([sums["gradient"], sums["reference"]]))
        shown = [
            map_figure(sums["gradient"], end, "gradient", "<b>gradient</b>, sum over channels", signed=True),
            map_figure(sums["reference"], end, "reference", "<b>reference</b>, sum over channels", signed=True),
            map_figure(sums["z"], MOST_Z, "z", "<b>difference</b> in standard errors", signed=True),
        ]
        rows.append(f"<h3>{breakable(path.stem)}</h3>{figures(shown)}")
    if len(paths) > MOST_MAPS:
        rows.append(soft(f"{len(paths) - MOST_MAPS} more maps are not shown."))
    return "".join(rows)
