"""Where an image differs from its target: |I - T| as a file, and as a picture whose colours have a scale."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.images import write_file

Array = np.ndarray[Any, Any]

#: Matplotlib's map: dark where the images agree.
COLORS = "inferno"
#: So large a share of the pixels lies within the scale; beyond are fireflies.
WITHIN = 0.99


def write_error_map(stem: Path, image: Array, target: Array) -> dict[str, float]:
    """Write |I - T| of two images (H, W, C) as `<stem>.exr`, and its mean over the channels in colours as `<stem>.png`.

    Channels of the image that the target does not have are left out. Returns where the colours' scale ends (`end`; all
    that is above has the last colour) and the `mean` of |I - T|; where that is not finite, as the largest number.
    """
    error = np.nan_to_num(np.abs(image[:, :, : target.shape[2]].astype(np.float64) - target), nan=np.inf)
    error = np.minimum(error, np.finfo(np.float32).max)
    write_file(Path(f"{stem}.exr"), error.astype(np.float32), linear=True)
    grey = error.mean(axis=2)
    end = scale_end(grey)
    png = colored(grey / end)
    write_atomically(Path(f"{stem}.png"), lambda file: file.write(png))
    return {"end": end, "mean": float(error.mean())}


def scale_end(values: Array) -> float:
    """A number with one digit that 99 % of the values are below; 1 where all are 0."""
    most = float(np.quantile(values, WITHIN)) or float(values.max())
    if most <= 0:
        return 1.0
    unit = 10.0 ** math.floor(math.log10(most))
    return float(f"{math.ceil(most / unit - 1e-9) * unit:.0e}")


def colored(values: Array) -> bytes:
    """Values (H, W) from 0 to 1 in the colours of the scale, as a PNG."""
    from matplotlib import colormaps
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, colormaps[COLORS](np.clip(values, 0.0, 1.0), bytes=True), format="png")
    return buffer.getvalue()


def color_stops(count: int) -> list[str]:
    """Colours of the scale from its beginning to its end, as `#rrggbb`."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps[COLORS](place)) for place in np.linspace(0.0, 1.0, count)]
