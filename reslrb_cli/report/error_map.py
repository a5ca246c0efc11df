"""Where an image differs from its target: as layers of a file, and as a picture whose colours have a scale."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.images import load_image
from reslrb_cli.records.layers import read_layers, write_layers

Array = np.ndarray[Any, Any]

#: Matplotlib's map: dark where the images agree.
COLORS = "inferno"
#: Of what has a sign: blue where it is negative, grey at zero, red where it is positive.
SIGNED = ("#053061", "#4393c3", "#bdbdbd", "#d6604d", "#67001f")
#: So large a share of the pixels lies within the scale; beyond are fireflies.
WITHIN = 0.99


def write_error_map(folder: Path, suffix: str, image: Array, target: Array, gradient: Array | None = None
                    ) -> dict[str, float]:  # fmt: skip
    """Write an image and its target (H, W, C) as layers, and |I - T|, the mean over the channels, as a picture.

    `comparison<suffix>.exr` has the layers `image`, `target`, `difference` (I - T) and, where there is one, `gradient`,
    dL/dI; `error<suffix>.png` the picture. Channels of the image that the target does not have are left out. Returns
    where the colours' scale ends (`end`; all that is above has the last colour) and the `mean` of |I - T|; where that
    is not finite, as the largest number.
    """
    image, most = image[:, :, : target.shape[2]], float(np.finfo(np.float32).max)
    difference = np.clip(np.nan_to_num(image.astype(np.float64) - target, nan=np.inf), -most, most)
    layers = {"image": image, "target": target, "difference": difference}
    write_layers(folder / f"comparison{suffix}.exr", layers | ({} if gradient is None else {"gradient": gradient}))
    error = np.abs(difference)
    grey = error.mean(axis=2)
    end = scale_end(grey)
    png = colored(grey / end)
    write_atomically(folder / f"error{suffix}.png", lambda file: file.write(png))
    return {"end": end, "mean": float(error.mean())}


def read_comparison(folder: Path, suffix: str) -> dict[str, Array]:
    """The layers that `write_error_map` wrote; of what an older version wrote `difference` alone, without its sign.

    Nothing where there are none, or they are damaged.
    """
    try:
        return read_layers(folder / f"comparison{suffix}.exr")
    except (OSError, ValueError):
        error = load_image(folder / f"error{suffix}.exr")
        return {} if error is None else {"difference": error}


def scale_end(values: Array) -> float:
    """A number with one digit that 99 % of the values are below; 1 where all are 0."""
    most = float(np.quantile(values, WITHIN)) or float(values.max())
    if most <= 0:
        return 1.0
    unit = 10.0 ** math.floor(math.log10(most))
    return float(f"{math.ceil(most / unit - 1e-9) * unit:.0e}")


def signed_end(values: Array) -> float:
    """Where the scale of values with a sign ends, on both sides: 99 % of them are within."""
    return scale_end(np.abs(np.nan_to_num(values)))


def colored(values: Array, signed: bool = False) -> bytes:
    """Values (H, W) from 0 to 1, or if `signed` from -1 to 1, in the colours of their scale, as a PNG."""
    from matplotlib.image import imsave

    places = np.nan_to_num(values)
    buffer = io.BytesIO()
    imsave(
        buffer, color_map(signed)(np.clip((places + 1) / 2 if signed else places, 0.0, 1.0), bytes=True), format="png"
    )
    return buffer.getvalue()


def color_stops(count: int, signed: bool = False) -> list[str]:
    """Colours of the scale from its beginning to its end, as `#rrggbb`."""
    from matplotlib.colors import to_hex

    return [to_hex(color_map(signed)(place)) for place in np.linspace(0.0, 1.0, count)]


def color_map(signed: bool) -> Any:
    """Matplotlib's map from [0, 1] to colours."""
    from matplotlib import colormaps
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("signed", SIGNED) if signed else colormaps[COLORS]
