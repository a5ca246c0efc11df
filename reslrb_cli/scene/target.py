"""Images to compare with, and images as textures."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import ConfigError
from .image_file import TURNS, orientation_of, read_bitmap, read_upright

logger = logging.getLogger(__name__)

Image = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Photo:
    """An image file as linear Rec. 709, (H, W, 3) float32, and what is wrong with its pixels, each boolean (H, W).

    `clipped`: at the greatest value that a file of 8 or 16 bits holds, in any channel; `transparent`: of alpha 0;
    `nonfinite`: not finite in some channel.
    """

    image: Image
    clipped: np.ndarray
    transparent: np.ndarray
    nonfinite: np.ndarray


def turned_line(path: Path, upright: bool = True) -> str | None:
    """What the user is told of an image with an EXIF orientation, which is read `upright` or not; None of others."""
    orientation = orientation_of(path)
    if orientation == 1:
        return None
    if upright:
        return f"{path}: {TURNS[orientation]}, as its EXIF orientation says"
    return f"{path}: not {TURNS[orientation]} as its EXIF orientation says: cameras of files see pixels as they lie"


def read_image(
    path: Path, color_space: str = "auto", size: tuple[int, int] | None = None, signed: bool = False
) -> Image:
    """Read an EXR, PNG, JPG, HDR, PFM, PPM or BMP file as linear Rec. 709: (H, W, 3) float32.

    `color_space` says how the file's values are encoded: `linear`, `srgb`, or `auto` (integers srgb, floats linear).
    Alpha is dropped; one channel becomes three. `size` is the (width, height) that the image must have. Pixels are as
    they lie in the file, as Mitsuba reads textures; a warning says where EXIF would have them turned. Raises
    ConfigError, located in the file, where it is missing or no image, damaged, cut off, too large or of another size,
    or holds a value that is not finite or, unless `signed`, negative.
    """
    photo = read_photo(path, color_space, size, upright=False)
    _check_values(Path(path), photo.image, signed)
    orientation = orientation_of(Path(path))
    if orientation > 1:
        logger.warning("%s: is read as it lies in the file, not %s as its EXIF says", path, TURNS[orientation])
    return photo.image


def read_photo(
    path: Path,
    color_space: str = "auto",
    size: tuple[int, int] | None = None,
    gamma: float | None = None,
    upright: bool = True,
) -> Photo:
    """Read an image file like `read_image`, and mark pixels that are not to be trusted; values are not checked.

    `gamma`, if any, decodes integers in place of `color_space`. `upright` turns the image as its EXIF orientation says,
    to how a person sees it; `size` is that of the image then. Raises ConfigError, located in the file, also where
    `gamma` is given for a file of floats.
    """
    path = Path(path)
    bitmap = read_upright(path, size) if upright else read_bitmap(path, size)
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        raise ConfigError(path, "", f"has {bitmap.channel_count()} channels; give one with R, G, B or Y only")
    width, height = (int(n) for n in bitmap.size())
    raw = np.array(bitmap).reshape(height, width, -1)
    alpha = raw[:, :, -1] if bitmap.has_alpha() else None
    colors = raw if alpha is None else raw[:, :, :-1]
    is_integer = raw.dtype.kind in "ui"
    if gamma is not None and not is_integer:
        raise ConfigError(path, "", "holds floats, which are linear: gamma decodes files of 8 and 16 bits")
    bitmap.set_srgb_gamma(False)  # values as they stand in the file; decoded below
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    image = np.array(bitmap, dtype=np.float32).reshape(height, width, 3)
    if gamma is not None:
        image = image**gamma
    elif color_space == "srgb" or (color_space == "auto" and is_integer):
        image = decode_srgb(image)
    nothing = np.zeros((height, width), dtype=bool)
    return Photo(
        image,
        clipped=(colors == np.iinfo(raw.dtype).max).any(axis=2) if is_integer else nothing,
        transparent=nothing if alpha is None else alpha == 0,
        nonfinite=np.logical_not(np.isfinite(image).all(axis=2)),
    )


def check_photo(path: Path, photo: Photo, allow_nonfinite: bool) -> None:
    """Raise ConfigError, located in the file, where a photo holds negative values, or such that are not finite."""
    _check_values(path, np.nan_to_num(photo.image, posinf=0, neginf=0) if allow_nonfinite else photo.image, False)


def read_weights(path: Path, size: tuple[int, int], upright: bool = True) -> Image:
    """Read an image of weights, float32 (H, W): values as they stand in the file, the mean of several channels.

    Those of 8 and 16 bits are shares of the greatest; alpha is dropped. `upright` turns it by its own EXIF orientation,
    like the photograph that it belongs to by that one's. Raises ConfigError, located in the file, like `read_image`.
    """
    photo = read_photo(path, "linear", size, upright=upright)
    _check_values(Path(path), photo.image, False)
    return photo.image.mean(axis=2)


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
