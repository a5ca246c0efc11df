"""Arrays of linear values as pictures that a page holds in itself."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.report.tone import encode

Array = np.ndarray[Any, Any]

#: Pixels of a picture's longer side, at most: a page is sent around.
MOST_PIXELS = 640
#: A picture with fewer pixels at its longer side is shown with squares for pixels.
FEW_PIXELS = 256


@dataclass(frozen=True)
class Picture:
    """A picture as a `data:` address, with its size, (width, height), in its own pixels."""

    uri: str
    size: tuple[int, int]

    @property
    def smooth(self) -> bool:
        """Whether it has pixels enough to be enlarged smoothly."""
        return max(self.size) >= FEW_PIXELS


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


def _png(pixels: Array) -> bytes:
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, np.ascontiguousarray(pixels), format="png")
    return buffer.getvalue()
