"""Linear values and errors as pictures for a screen.

Linear values get a suitable exposure and are encoded in sRGB (`exposure_for`, `encode`). The difference between an
image and its target is written as layers of a file and as a picture with a colour scale (`write_error_map`, `colored`).
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
from reslrb_cli.report.format import number

Array = np.ndarray[Any, Any]

#: If the level of an image is in this range, the exposure is 1; otherwise the level is scaled to `BRIGHT`.
LEAST_BRIGHT, MOST_BRIGHT, BRIGHT = 0.25, 1.6, 0.8

#: The level is the value below which these shares of the pixels and of their light lie, not counting FIREFLIES' light.
MOST_PIXELS, MOST_LIGHT = 0.99, 0.9

#: Share of the brightest pixels whose light does not count.
FIREFLIES = 1e-3

#: Pixels that see a lamp count if they raise the level by at most this factor, or if the share of others is too small.
LAMPS, LEAST_OTHERS = 3.0, 0.05

#: Clipped pixels are mentioned if their share exceeds this value.
LEAST_CLIPPED = 0.005


def exposure_for(image: Array | None, lamps: Array | None = None) -> float:
    """Return the exposure, rounded to two digits, that makes an image (H, W, C) visible, or 1 if none is needed.

    `lamps` (H, W), boolean, marks the pixels that see a lamp. Pixels that see a lamp can be thousands of times brighter
    than the rest of the image. The exposure clips these pixels. Without clipping, the rest of the image would be nearly
    black. The level has two criteria. The pixel share alone would clip a caustic, because a caustic concentrates much
    of the light in few pixels. The share of light alone, with fireflies included, would make a noisy image too dark.
    """
    level = 0.0 if image is None else _level(image)
    if image is not None and lamps is not None and lamps.shape == image.shape[:2] and (~lamps).mean() >= LEAST_OTHERS:
        others = _level(image[~lamps][:, None])
        level = others if 0 < LAMPS * others < level else level
    if not 0 < level < math.inf or LEAST_BRIGHT <= level <= MOST_BRIGHT:
        return 1.0
    return float(f"{BRIGHT / level:.1e}")


def _level(image: Array) -> float:
    """Return the level of an image. Most of the image's pixels, and most of its light, lie below the level."""
    values = _brightest(image).astype(np.float64)
    values = np.sort(np.maximum(values[np.isfinite(values)], 0))
    if not values.size:
        return 0.0
    light = np.cumsum(values[: values.size - int(FIREFLIES * values.size)])
    by_light = values[min(int(np.searchsorted(light, MOST_LIGHT * light[-1])), light.size - 1)]
    return max(float(np.quantile(values, MOST_PIXELS)), float(by_light))


def _brightest(image: Array) -> Array:
    """Return the maximum over the channels of each pixel (H, W), without alpha."""
    return np.asarray(image[:, :, : 3 if image.shape[2] >= 3 else 1].max(axis=2))


def shown_exposures(views: Sequence[Mapping[str, Any]] | None) -> dict[str, float]:
    """Return the exposure of each of a manifest's `views`. The keys are the suffixes of the image names."""
    found = {}
    for view in views or ():
        exposure = view.get("shown")
        if isinstance(exposure, int | float) and 0 < exposure < math.inf:
            found["" if len(views or ()) == 1 else f"-{view.get('sensor')}"] = float(exposure)
    return found


def exposure_words(exposure: float, target: Array | None = None) -> str:
    """Return a remark on an exposure. The result is empty for an exposure of 1, unless the exposure clips many pixels
    of `target`.
    """
    words = []
    if exposure != 1:
        times = f"{number(exposure, 2)} times brighter" if exposure > 1 else f"{number(1 / exposure, 2)} times darker"
        words.append(f"shown {times}")
    if target is not None and target.size:
        clipped = float((_brightest(target) * exposure > 1).mean())
        if clipped > LEAST_CLIPPED:
            words.append(f"{100 * clipped:.2g} % of the target is brighter than white, and clipped")
    return "; ".join(words)


def encode(values: Array) -> Array:
    """Convert linear values in [0, 1] to sRGB."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)


#: Colour map of errors: dark where the images agree.
COLORS = "inferno"

#: Colour map of signed values: blue for negative, grey for zero, red for positive.
SIGNED = ("#053061", "#4393c3", "#bdbdbd", "#d6604d", "#67001f")

#: Share of the pixels within the scale; the rest are fireflies.
WITHIN = 0.99


def write_error_map(folder: Path, suffix: str, image: Array, target: Array, gradient: Array | None = None
                    ) -> dict[str, float]:  # fmt: skip
    """Write an image and its target (H, W, C) as layers, and the channel mean of |I - T| as a picture.

    `comparison<suffix>.exr` holds the layers `image`, `target`, `difference` (I - T) and, if given, `gradient` (dL/dI).
    `error<suffix>.png` is the picture. Channels that the target lacks are left out. The function returns the `end` of
    the colour scale and the `mean` of |I - T|. Values above `end` have the last colour. Differences that are not finite
    count as the largest float32 number.
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
    """Return the layers that `write_error_map` wrote. The result is empty if the values are missing or damaged."""
    try:
        return read_layers(folder / f"comparison{suffix}.exr")
    except (OSError, ValueError):
        return {}


def scale_end(values: Array) -> float:
    """Return a number with one digit that is above 99 % of the values, or 1 if all values are 0."""
    most = float(np.quantile(values, WITHIN)) or float(values.max())
    if most <= 0:
        return 1.0
    unit = 10.0 ** math.floor(math.log10(most))
    return float(f"{math.ceil(most / unit - 1e-9) * unit:.0e}")


def signed_end(values: Array) -> float:
    """Return the end of a symmetric scale that contains 99 % of the signed values."""
    return scale_end(np.abs(np.nan_to_num(values)))


def colored(values: Array, signed: bool = False) -> bytes:
    """Return a PNG of values (H, W) in the colours of their scale. The values are in [0, 1], or in [-1, 1] if
    `signed`.
    """
    places = np.nan_to_num(values)
    return as_png(color_map(signed)(np.clip((places + 1) / 2 if signed else places, 0.0, 1.0), bytes=True))


def as_png(pixels: Array) -> bytes:
    """Return a PNG of the bytes `pixels` (H, W, C)."""
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, np.ascontiguousarray(pixels), format="png")
    return buffer.getvalue()


def color_stops(count: int, signed: bool = False) -> list[str]:
    """Return `count` colours of the scale from its start to its end, as `#rrggbb`."""
    from matplotlib.colors import to_hex

    return [to_hex(color_map(signed)(place)) for place in np.linspace(0.0, 1.0, count)]


def color_map(signed: bool) -> Any:
    """Return Matplotlib's map from [0, 1] to colours."""
    from matplotlib import colormaps
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("signed", SIGNED) if signed else colormaps[COLORS]
