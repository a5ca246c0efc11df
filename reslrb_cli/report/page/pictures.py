"""Arrays of linear values as pictures that a page holds in itself."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.images import read_exr

Array = np.ndarray[Any, Any]

#: Pixels of a picture's longer side, at most: a page is sent around.
MOST_PIXELS = 640
#: A picture with fewer pixels at its longer side is shown with squares for pixels.
FEW_PIXELS = 256
#: What 99 % of the values are below is shown as it is where it lies in this range, else brought to `BRIGHT`.
LEAST_BRIGHT, MOST_BRIGHT, BRIGHT = 0.25, 1.6, 0.8


@dataclass(frozen=True)
class Picture:
    """A picture as a `data:` address, with its size, (width, height), in its own pixels."""

    uri: str
    size: tuple[int, int]

    @property
    def smooth(self) -> bool:
        """Whether it has pixels enough to be enlarged smoothly."""
        return max(self.size) >= FEW_PIXELS


def load_image(path: Path) -> Array | None:
    """An EXR as (H, W, C); None where there is none, or what is there is damaged."""
    try:
        return read_exr(path)
    except (OSError, RuntimeError, ValueError):
        return None


def show(values: Array, exposure: float = 1.0) -> Picture:
    """Linear values (H, W, C) times `exposure` as an sRGB picture; fewer channels than three are shown as grey."""
    values = fit(np.nan_to_num(values[:, :, :3] if values.shape[2] >= 3 else values[:, :, :1], posinf=1e30))
    encoded = np.round(255 * encode(np.clip(values * exposure, 0.0, 1.0))).astype(np.uint8)
    return embed(_png(np.broadcast_to(encoded, (*encoded.shape[:2], 3))), encoded.shape)


def embed(png: bytes, shape: tuple[int, ...]) -> Picture:
    """A PNG of an array of `shape`, (H, W, ...)."""
    return Picture(f"data:image/png;base64,{base64.b64encode(png).decode()}", (shape[1], shape[0]))


def fit(values: Array) -> Array:
    """`values` (H, W, C), shrunk to `MOST_PIXELS` where they are more."""
    together = max(values.shape[:2]) // MOST_PIXELS
    if together > 1:  # means of whole blocks first, since resampling smooths at the size that there is
        rows, columns = (max(size // together, 1) for size in values.shape[:2])
        blocks = values[: rows * together, : columns * together]
        values = blocks.reshape(rows, -1, columns, blocks.shape[1] // columns, values.shape[2]).mean(axis=(1, 3))
    longest = max(values.shape[:2])
    if longest <= MOST_PIXELS:
        return values
    from reslrb_cli.scene.values import resample

    height, width = (max(round(size * MOST_PIXELS / longest), 1) for size in values.shape[:2])
    return resample(values, (width, height))


def exposure_for(arrays: Iterable[Array | None]) -> float:
    """The factor, of two digits, that makes linear values visible; 1 where they are, or there is none."""
    brightest = [float(np.quantile(np.nan_to_num(array[:, :, :3].max(axis=2)), 0.99)) for array in arrays
                 if array is not None and array.size]  # fmt: skip
    level = max(brightest, default=0.0)
    if not 0 < level < math.inf or LEAST_BRIGHT <= level <= MOST_BRIGHT:
        return 1.0
    return float(f"{BRIGHT / level:.1e}")


def exposure_words(exposure: float) -> str:
    """What has to be said of an exposure; nothing of 1."""
    if exposure == 1:
        return ""
    return f"shown {exposure:.2g} times brighter" if exposure > 1 else f"shown {1 / exposure:.2g} times darker"


def encode(values: Array) -> Array:
    """Linear values in [0, 1] as sRGB."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)


def _png(pixels: Array) -> bytes:
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, np.ascontiguousarray(pixels), format="png")
    return buffer.getvalue()
