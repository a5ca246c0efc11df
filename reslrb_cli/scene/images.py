"""Image files, read as images to compare with or as textures.

Cameras and phones store pixels in the sensor's orientation. JPEG and PNG files store the rotation to an upright image
as EXIF metadata. Mitsuba's reader ignores this metadata.
"""

from __future__ import annotations

import logging
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config.files import open_file, read_file
from reslrb_cli.errors import ConfigError, is_out_of_memory

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

logger = logging.getLogger(__name__)
FORMATS = "EXR, PNG, JPG, HDR, PFM, PPM or BMP"
_NO_IMAGE = f"is not a readable image ({FORMATS}): damaged, truncated, or in another format, such as CMYK"
#: EXIF's tag of the camera's orientation.
_ORIENTATION = 0x0112
Size = tuple[int, int]

#: Operations that turn the pixels upright, by EXIF's orientation number; 1 is upright.
TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "turned by 90 degrees clockwise and mirrored left to right",
    6: "turned by 90 degrees clockwise",
    7: "turned by 90 degrees counterclockwise and mirrored left to right",
    8: "turned by 90 degrees counterclockwise",
}


def read_bitmap(path: Path, size: Size | None = None, upright: bool = False) -> mi.Bitmap:
    """Decode the image file `path`. `size` is the required (width, height), or None for any.

    Pixels are as stored. If `upright`, pixels and size are rotated or mirrored by EXIF (`TURNS`). Raises a ConfigError
    that names the file if the file is unreadable, no image, of another size, damaged or truncated.
    """
    orientation = orientation_of(path) if upright else 1
    with _photograph(path) as photograph:
        try:
            if photograph is not None and photograph.format != "PNG":
                photograph.load()  # Mitsuba's reader would fill missing data of a JPEG with grey
                data = read_file(path)  # zeros in place of missing data have no end of image (FF D9) after a scan
                if data.rfind(b"\xff\xd9") <= data.rfind(b"\xff\xda"):
                    raise ConfigError(path, "", _NO_IMAGE)
            bitmap = mi.Bitmap(str(path))
        except Exception as error:
            if is_out_of_memory(error):
                raise
            raise ConfigError(path, "", _NO_IMAGE) from None
    if orientation > 1:
        turned_bitmap = mi.Bitmap(np.ascontiguousarray(turn(np.array(bitmap), orientation)), bitmap.pixel_format())
        turned_bitmap.set_srgb_gamma(bitmap.srgb_gamma())
        turned_bitmap.set_premultiplied_alpha(bitmap.premultiplied_alpha())
        bitmap = turned_bitmap
    width, height = (int(n) for n in bitmap.size())
    if min(width, height) < 1:
        raise ConfigError(path, "", _NO_IMAGE)
    if size is not None and (width, height) != size:
        turned = f", {TURNS[orientation]} as its EXIF orientation says" if orientation > 1 else ""
        raise ConfigError(path, "", f"is {width}x{height} pixels{turned}; it must be {size[0]}x{size[1]}")
    return bitmap


def turn(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return a view of an image (H, W, ...), rotated or mirrored upright according to its EXIF `orientation`."""
    if orientation >= 5:  # rows of the file are columns of the view
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


@contextmanager
def _photograph(path: Path) -> Iterator[ImageFile | None]:
    """Open a PNG or JPEG file by Pillow, which reads the head only. Yields None for a file of another format. Raises
    ConfigError if the file cannot be read.
    """
    from PIL import Image  # late, because few commands read such files

    with open_file(path) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged EXIF data rotates nothing
        try:
            found = Image.open(file, formats=("JPEG", "PNG"))
        except (OSError, ValueError, Image.DecompressionBombError):
            found = None
        yield found


def orientation_of(path: Path) -> int:
    """Return the EXIF orientation (1 to 8) of an image file, or 1 if the file has none. Raises ConfigError if the file
    cannot be read.
    """
    from PIL.Image import Exif

    exif, orientation = Exif(), None
    with _photograph(path) as photograph:
        if photograph is not None:
            with suppress(SyntaxError, ValueError, struct.error):
                exif.load(photograph.info.get("exif", b""))
                orientation = exif.get(_ORIENTATION)
    return orientation if orientation in TURNS else 1


def image_size(path: Path) -> Size:
    """Return the stored (width, height) of an image. Raises a ConfigError that names the file if the file is not an
    image.
    """
    with _photograph(path) as photograph:
        width, height = read_bitmap(path).size() if photograph is None else photograph.size
    return int(width), int(height)


Image = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Photo:
    """Image file as linear Rec. 709, (H, W, 3) float32, or with the channels that were asked for. Booleans (H, W) mark
    the defects of the pixels.

    `clipped` pixels have a channel at the maximum value of an 8-bit or 16-bit file. `transparent` pixels have alpha 0.
    `nonfinite` pixels have a non-finite channel.
    """

    image: Image
    clipped: np.ndarray
    transparent: np.ndarray
    nonfinite: np.ndarray


def turned_line(path: Path, upright: bool = True) -> str | None:
    """Return a line for the user about an image with an EXIF orientation. `upright` tells whether the image is read
    upright or as stored. For other images, return None.
    """
    turned = TURNS.get(orientation_of(path))
    if turned is None or upright:
        return None if turned is None else f"{path}: {turned}, as its EXIF orientation says"
    return f"{path}: not {turned} as its EXIF orientation says: cameras of files use the stored orientation"


def read_image(path: Path, color_space: str = "auto", size: Size | None = None, signed: bool = False) -> Image:
    """Read an EXR, PNG, JPG, HDR, PFM, PPM or BMP file as linear Rec. 709: (H, W, 3) float32.

    `color_space` is the encoding of the file's values: `linear`, `srgb`, or `auto` (integers srgb, floats linear).
    Alpha is dropped. A single channel is copied into three channels. `size` is the required (width, height). Pixels are
    as stored, as in Mitsuba's textures. If EXIF metadata would rotate the pixels, the function prints a warning.

    Raises a ConfigError that names the file if the file is missing, no image, damaged, truncated, too large or of
    another size. Raises ConfigError also for non-finite values, and for negative values unless `signed` is true.
    """
    image = read_photo(path, color_space, size, upright=False, signed=signed).image
    orientation = orientation_of(path)
    if orientation > 1:
        logger.warning("%s: the stored orientation is used, not %s as its EXIF says", path, TURNS[orientation])
    return image


def read_photo(
    path: Path,
    color_space: str = "auto",
    size: Size | None = None,
    upright: bool = True,
    signed: bool = False,
    nonfinite: bool = False,
    channels: Sequence[str] = (),
) -> Photo:
    """Read an image file like `read_image`, and mark unreliable pixels.

    `upright` rotates the image by its EXIF orientation. `size` then refers to the upright image. `signed` allows
    negative values, and `nonfinite` allows non-finite values. `channels` are the names of the channels to read, if the
    image is not RGB. Raises ConfigError, located in the file.
    """
    bitmap = read_bitmap(path, size, upright)
    if channels:
        bitmap = _choose(bitmap, channels, path)
    elif bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        raise ConfigError(path, "", f"has {bitmap.channel_count()} channels; use an image with only R, G, B or Y")
    width, height = (int(n) for n in bitmap.size())
    raw = np.array(bitmap).reshape(height, width, -1)
    alpha = raw[:, :, -1] if bitmap.has_alpha() else None
    colors = raw if alpha is None else raw[:, :, :-1]
    is_integer = raw.dtype.kind in "ui"
    bitmap.set_srgb_gamma(False)  # values as stored in the file; decoded below
    kind = bitmap.pixel_format() if channels else mi.Bitmap.PixelFormat.RGB
    bitmap = bitmap.convert(kind, mi.Struct.Type.Float32, False)
    image = np.array(bitmap, dtype=np.float32).reshape(height, width, -1)
    if color_space == "srgb" or (color_space == "auto" and is_integer):
        image = decode_srgb(image)
    finite, nothing = np.isfinite(image), np.zeros((height, width), dtype=bool)
    for bad, what in ((~finite & (not nonfinite), "not finite"), (finite & (image < 0) & (not signed), "negative")):
        if bad.any():
            y, x, channel = (int(n) for n in np.argwhere(bad)[0])
            value, count = f"{image[y, x, channel]:g}", int(bad.any(axis=2).sum())
            where = f"pixel ({x}, {y}), channel {(channels or 'RGB')[channel]}"
            raise ConfigError(path, "", f"{where}, is {value}: {what} ({count} pixels in all)")
    return Photo(
        image,
        clipped=(colors == np.iinfo(raw.dtype).max).any(axis=2) if is_integer else nothing,
        transparent=nothing if alpha is None else alpha == 0,
        nonfinite=np.logical_not(finite.all(axis=2)),
    )


def _choose(bitmap: mi.Bitmap, channels: Sequence[str], path: Path) -> mi.Bitmap:
    """Return the channels of a bitmap with these names, in this order. Raises ConfigError if one is missing."""
    names = [field.name for field in bitmap.struct_()]
    if missing := [name for name in channels if name not in names]:
        reason = f"has the channels {', '.join(names)}; the film also needs {', '.join(missing)}"
        raise ConfigError(path, "", reason)
    pixels = np.array(bitmap).reshape(*bitmap.size()[::-1], -1)[:, :, [names.index(name) for name in channels]]
    return mi.Bitmap(np.ascontiguousarray(pixels), mi.Bitmap.PixelFormat.MultiChannel)


def decode_srgb(encoded: Image) -> Image:
    """Return the linear values of sRGB-encoded values (IEC 61966-2-1), with the precision of the input."""
    wide = encoded.astype(np.float64)
    curve = ((np.maximum(wide, 0) + 0.055) / 1.055) ** 2.4
    return np.where(wide <= 0.04045, wide / 12.92, curve).astype(encoded.dtype)
