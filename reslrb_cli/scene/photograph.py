"""A photograph at the size of a film: what it is, and a copy of it with fewer pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..records.images import write_bitmap
from .image_file import read_upright
from .target import Image, decode_srgb


@dataclass(frozen=True)
class Photograph:
    """An image file: its (width, height) in pixels, and whether it holds integers, which clip what is bright.

    It is as a person sees it, turned as its EXIF orientation says.
    """

    path: Path
    size: tuple[int, int]
    is_integer: bool
    bitmap: mi.Bitmap


def open_photograph(path: Path) -> Photograph:
    """Read an image file. Raises ConfigError, located in it, where it is none."""
    bitmap = read_upright(path)
    width, height = (int(n) for n in bitmap.size())
    return Photograph(path, (width, height), np.array(bitmap).dtype.kind in "ui", bitmap)


def write_smaller(photo: Photograph, size: tuple[int, int], path: Path) -> None:
    """Write the photograph with fewer pixels, `size` (width, height), to `path`: the means of linear values.

    Integers become PNG of 16 bits, in which a pixel stays marked as what any part of it is: clipped where it was at the
    greatest value, transparent of alpha 0. Floats become EXR, in which what is not finite stays so. Raises OSError.
    """
    raw = np.array(photo.bitmap)
    raw = raw.reshape(*raw.shape[:2], -1)
    if not photo.is_integer:
        write_bitmap(path, mi.Bitmap(np.ascontiguousarray(_means(raw, size))))
        return
    greatest = float(np.iinfo(raw.dtype).max)
    colours, alpha = (raw[:, :, :-1], raw[:, :, -1:]) if photo.bitmap.has_alpha() else (raw, None)
    linear = _means(decode_srgb(colours.astype(np.float32) / np.float32(greatest)), size)
    clipped = _means(colours == greatest, size) > 0
    encoded = mi.Bitmap(np.ascontiguousarray(linear, dtype=np.float32)).convert(
        component_format=mi.Struct.Type.UInt16, srgb_gamma=True
    )
    pixels = np.where(clipped, np.uint16(65535), np.array(encoded).reshape(linear.shape)).astype(np.uint16)
    if alpha is not None:
        opaque = (_means(alpha == 0, size) == 0) * np.uint16(65535)
        pixels = np.concatenate([pixels, opaque.astype(np.uint16)], axis=2)
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels))
    bitmap.set_srgb_gamma(True)
    write_bitmap(path, bitmap)


def _means(image: Image, size: tuple[int, int]) -> Image:
    """The means of an (H, W, C) image over the pixels of one of `size` (width, height), shares of its own included."""
    (height, width, channels), (columns, rows) = image.shape, size
    values = image.astype(np.float32)
    known = np.isfinite(values)
    if not known.all():  # which would reach whole rows
        lost = _means(~known, size) > 0
        return np.where(lost, np.float32(np.nan), _means(np.where(known, values, 0), size))
    lower = (_shares(height, rows) @ values.reshape(height, -1)).reshape(rows, width, channels)
    return np.asarray(_shares(width, columns) @ lower, dtype=np.float32)


def _shares(old: int, new: int) -> Image:
    """How much of each of `new` intervals each of `old` intervals of the same line takes: (new, old), rows sum to 1."""
    edges = np.arange(new + 1) * (old / new)
    low = np.maximum(edges[:-1, None], np.arange(old)[None, :])
    high = np.minimum(edges[1:, None], np.arange(1, old + 1)[None, :])
    shares = np.maximum(high - low, 0)
    # Rounding leaves slivers, by which what is clipped, or not a number, would reach pixels that it is no part of.
    shares[shares < 1e-6] = 0
    return np.asarray(shares / shares.sum(axis=1, keepdims=True), dtype=np.float32)
