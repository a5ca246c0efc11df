"""Linear values and errors as a screen shows them.

Linear values have an exposure that suits them, and are encoded in sRGB (`exposure_for`, `encode`). Where an image
differs from its target is shown as layers of a file, and as a picture whose colours have a scale (`write_error_map`,
`colored`).
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.images import read_layers, write_layers

Array = np.ndarray[Any, Any]

#: The level of an image is shown as it is where it lies in this range, else brought to `BRIGHT`.
LEAST_BRIGHT, MOST_BRIGHT, BRIGHT = 0.25, 1.6, 0.8

#: The level is that below which so many of the pixels are, and so much of their light but for that of FIREFLIES.
MOST_PIXELS, MOST_LIGHT = 0.99, 0.9

#: The share of the pixels, the brightest, whose light does not count.
FIREFLIES = 1e-3

#: Pixels that see a lamp count where they raise the level by no more than this factor, or where the others are too few.
LAMPS, LEAST_OTHERS = 3.0, 0.05

#: What is clipped of an image is said where it is a larger share of it.
LEAST_CLIPPED = 0.005


def exposure_for(image: Array | None, lamps: Array | None = None) -> float:
    """The factor, of two digits, that makes the linear values of an image (H, W, C) visible; 1 where they are, or there
    is none.

    `lamps` (H, W), boolean, are the pixels that see a lamp, which may be thousands of times as bright as all that it
    lights: they are clipped, rather than that the others are shown nearly black. Two levels are looked at, since a
    caustic that takes few pixels holds much of the light: it would be clipped by the first alone. And an image of few
    samples has pixels that hold much of the light, and are wrong: they would darken it by the second alone.
    """
    level = 0.0 if image is None else _level(image)
    if image is not None and lamps is not None and lamps.shape == image.shape[:2] and (~lamps).mean() >= LEAST_OTHERS:
        others = _level(image[~lamps][:, None])
        level = others if 0 < LAMPS * others < level else level
    if not 0 < level < math.inf or LEAST_BRIGHT <= level <= MOST_BRIGHT:
        return 1.0
    return float(f"{BRIGHT / level:.1e}")


def _level(image: Array) -> float:
    """What is to be shown of an image: the value below which most of its pixels, and most of their light, are."""
    values = _brightest(image).astype(np.float64)
    values = np.sort(np.maximum(values[np.isfinite(values)], 0))
    if not values.size:
        return 0.0
    light = np.cumsum(values[: values.size - int(FIREFLIES * values.size)])
    by_light = values[min(int(np.searchsorted(light, MOST_LIGHT * light[-1])), light.size - 1)]
    return max(float(np.quantile(values, MOST_PIXELS)), float(by_light))


def _brightest(image: Array) -> Array:
    """The greatest of a pixel's colours (H, W), alpha left out."""
    return np.asarray(image[:, :, : 3 if image.shape[2] >= 3 else 1].max(axis=2))


def shown_exposures(views: Sequence[Mapping[str, Any]] | None) -> dict[str, float]:
    """The exposures that a manifest has of its `views`, by what their images' names end in; none of older runs."""
    found = {}
    for view in views or ():
        exposure = view.get("shown")
        if isinstance(exposure, int | float) and 0 < exposure < math.inf:
            found["" if len(views or ()) == 1 else f"-{view.get('sensor')}"] = float(exposure)
    return found


def exposure_words(exposure: float, target: Array | None = None) -> str:
    """What has to be said of an exposure: nothing of 1, unless much of `target` is brighter than white with it."""
    words = []
    if exposure != 1:
        times = f"{exposure:.2g} times brighter" if exposure > 1 else f"{1 / exposure:.2g} times darker"
        words.append(f"shown {times}")
    if target is not None and target.size:
        clipped = float((_brightest(target) * exposure > 1).mean())
        if clipped > LEAST_CLIPPED:
            words.append(f"{100 * clipped:.2g} % of the target is brighter than white, and clipped")
    return "; ".join(words)


def encode(values: Array) -> Array:
    """Linear values in [0, 1] as sRGB."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)


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
    """The layers that `write_error_map` wrote; nothing where there are none, or they are damaged."""
    try:
        return read_layers(folder / f"comparison{suffix}.exr")
    except (OSError, ValueError):
        return {}


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
    places = np.nan_to_num(values)
    return as_png(color_map(signed)(np.clip((places + 1) / 2 if signed else places, 0.0, 1.0), bytes=True))


def as_png(pixels: Array) -> bytes:
    """A PNG of `pixels` (H, W, C), bytes."""
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, np.ascontiguousarray(pixels), format="png")
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
