"""Images to compare with, and images as textures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import ConfigError
from .image_file import read_bitmap

Image = np.ndarray[Any, Any]


def read_image(
    path: Path, color_space: str = "auto", size: tuple[int, int] | None = None, signed: bool = False
) -> Image:
    """Read an EXR, PNG, JPG, HDR, PFM, PPM or BMP file as linear Rec. 709: (H, W, 3) float32.

    `color_space` says how the file's values are encoded: `linear`, `srgb`, or `auto` (integers srgb, floats linear).
    Alpha is dropped; one channel becomes three. `size` is the (width, height) that the image must have. Raises
    ConfigError, located in the file, where it is missing or no image, damaged, cut off, too large or of another size,
    or holds a value that is not finite or, unless `signed`, negative.
    """
    path = Path(path)
    bitmap = read_bitmap(path, size)
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        raise ConfigError(path, "", f"has {bitmap.channel_count()} channels; give one with R, G, B or Y only")
    width, height = (int(n) for n in bitmap.size())

    is_float = bitmap.component_format() in (
        mi.Struct.Type.Float16,
        mi.Struct.Type.Float32,
        mi.Struct.Type.Float64,
    )
    decode = color_space == "srgb" or (color_space == "auto" and not is_float)
    bitmap.set_srgb_gamma(False)  # values as they stand in the file; decoded below
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    image = np.array(bitmap, dtype=np.float32).reshape(height, width, 3)
    _check_values(path, image, signed)
    return decode_srgb(image) if decode else image


def decode_srgb(image: Image) -> Image:
    """Linear values of sRGB-encoded ones."""
    from colour.models import eotf_sRGB  # late: the import takes a second

    return np.asarray(eotf_sRGB(image), dtype=np.float32)


def _check_values(path: Path, image: Image, signed: bool) -> None:
    for bad, what in ((~np.isfinite(image), "not finite"), (image < 0, "negative")):
        if bad.any() and not (signed and what == "negative"):
            y, x, channel = (int(n) for n in np.argwhere(bad)[0])
            value = f"{image[y, x, channel]:g}"
            count = int(bad.any(axis=2).sum())
            raise ConfigError(
                path, "", f"pixel ({x}, {y}), channel {'RGB'[channel]}, is {value}: {what} ({count} pixels in all)"
            )
