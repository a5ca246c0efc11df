"""Image files: checked before they are decoded, and read as images to compare with or as textures.

The checks cover the stated size, the orientation, and missing data. A file of some kilobytes can claim to be an image
of gigabytes, and Mitsuba's reader fills missing data of a JPEG with grey. For compressed formats, the checks also
detect files that were truncated and padded. The checks do not detect damage in the last lines of an EXR file, because
EXR has no checksums. Cameras and phones store pixels in the sensor's orientation. JPEG and PNG files store the rotation
to an upright image as EXIF metadata. Mitsuba's reader ignores this metadata.
"""

from __future__ import annotations

import logging
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import mitsuba as mi
import numpy as np

from reslrb_cli.config.files import PIXELS, open_file
from reslrb_cli.errors import ConfigError, is_out_of_memory

logger = logging.getLogger(__name__)
FORMATS = "EXR, PNG, JPG, HDR, PFM, PPM or BMP"
_NO_IMAGE = f"is not a readable image ({FORMATS})"
#: Bytes that contain the size of an image; a preview may come first.
_HEAD = 2**20
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


class DamagedImage(ConfigError):
    """Image for which Mitsuba's reader, or another user of the image, would access memory out of bounds."""


@dataclass(frozen=True)
class _Header:
    """Header of an image, with the (width, height) of the stored pixels and the EXIF orientation."""

    size: Size
    orientation: int = 1
    is_jpeg: bool = False


def read_bitmap(path: Path, size: Size | None = None, upright: bool = False) -> mi.Bitmap:
    """Decode the image file `path`. `size` is the required (width, height), or None for any.

    Pixels are as stored. If `upright`, pixels and size are rotated or mirrored by EXIF (`TURNS`). Raises a ConfigError
    that names the file if the file is unreadable, no image, too large, of another size, damaged or truncated. The
    header is checked first.
    """
    header = _examine(path)
    orientation = header.orientation if upright else 1
    width, height = header.size[::-1] if orientation >= 5 else header.size
    if min(width, height) < 1:
        raise ConfigError(path, "", _NO_IMAGE)
    if size is not None and (width, height) != size:
        turned = f", {TURNS[orientation]} as its EXIF orientation says" if orientation > 1 else ""
        raise ConfigError(path, "", f"is {width}x{height} pixels{turned}; it must be {size[0]}x{size[1]}")
    if width * height > PIXELS:
        raise ConfigError(path, "", f"is {width}x{height} pixels; the limit is {PIXELS} pixels")
    complaints: list[str] = []
    try:
        with _heard(complaints) if header.is_jpeg else nullcontext():
            bitmap = mi.Bitmap(str(path))
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise ConfigError(
            path,
            "",
            ("is damaged or truncated, or has a format that Mitsuba does not decode, such as CMYK; save it as RGB"),
        ) from None
    for line in complaints:
        if line.startswith(("Corrupt JPEG data", "Premature end")):
            raise ConfigError(path, "", f"is damaged or truncated ({line}); copy or save it again")
        logger.warning("%s: %s", path, line)
    if (int(bitmap.width()), int(bitmap.height())) != header.size:
        raise ConfigError(path, "", f"claims {header.size[0]}x{header.size[1]} pixels, but has another size")
    if orientation == 1:
        return bitmap
    turned_bitmap = mi.Bitmap(np.ascontiguousarray(turn(np.array(bitmap), orientation)), bitmap.pixel_format())
    turned_bitmap.set_srgb_gamma(bitmap.srgb_gamma())
    turned_bitmap.set_premultiplied_alpha(bitmap.premultiplied_alpha())
    return turned_bitmap


def turn(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return a view of an image (H, W, ...), rotated or mirrored upright according to its EXIF `orientation`."""
    if orientation >= 5:  # rows of the file are columns of the view
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def orientation_of(path: Path) -> int:
    """Return the EXIF orientation (1 to 8) of an image file, or 1 if the file has none. Raises ConfigError if it is no
    image.
    """
    return _examine(path).orientation


def image_size(path: Path) -> Size:
    """Return the stored (width, height) of an image. Raises a ConfigError that names the file if the file is not an
    image.
    """
    width, height = _examine(path).size
    if min(width, height) < 1:
        raise DamagedImage(path, "", f"claims {width}x{height} pixels; save it again")
    return width, height


def _examine(path: Path) -> _Header:
    """Return the header of an image. Raises a ConfigError that names the file if the file is not an image."""
    header: _Header | None = None
    with open_file(path) as file:
        try:
            head = file.read(_HEAD) or b""
            reader = next((reader for magic, reader in _READERS.items() if head.startswith(magic)), None)
            with suppress(struct.error, ValueError):  # a truncated header does not count
                header = None if reader is None else reader(path, head, file)
        except OSError as error:
            raise ConfigError(path, "", f"cannot be read: {error.strerror}") from None
    if header is None:
        raise ConfigError(path, "", _NO_IMAGE)
    return header


# --- formats ----------------------------------------------------------------------------------------------------------

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
#: EXIF's tag of the camera's orientation.
_ORIENTATION = 0x0112


def _photograph(path: Path, head: bytes, file: BinaryIO) -> _Header | None:
    """Return the header of a PNG or JPEG file."""
    from PIL.Image import Exif  # late, because few commands read such files
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    is_jpeg, exif, orientation = head.startswith(_JPEG), Exif(), None
    file.seek(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged EXIF data rotates nothing
        try:
            image = JpegImageFile(file) if is_jpeg else PngImageFile(file)
        except (SyntaxError, OSError):
            return None
        with suppress(SyntaxError, ValueError, struct.error):
            exif.load(image.info.get("exif", b""))
            orientation = exif.get(_ORIENTATION)
    return _Header(image.size, orientation if orientation in TURNS else 1, is_jpeg)


def _exr(path: Path, head: bytes, file: BinaryIO) -> _Header | None:
    position = 8
    while True:  # attributes: a name and a type that end with a zero, the number of bytes, and the bytes
        name, _, rest = head[position : position + 600].partition(b"\0")
        kind, _, _ = rest.partition(b"\0")
        position += len(name) + len(kind) + 2
        [length] = struct.unpack_from("<i", head, position)
        if not name or length < 0:
            return None
        if name == b"dataWindow":
            left, top, right, bottom = struct.unpack_from("<4i", head, position + 4)
            return _Header((right - left + 1, bottom - top + 1))
        position += 4 + length


def _hdr(path: Path, head: bytes, file: BinaryIO) -> _Header | None:
    found = re.search(rb"\n-Y (\d{1,9}) \+X (\d{1,9})\n", head)
    if found is None:
        return None
    width, height = int(found[2]), int(found[1])
    if width * height <= PIXELS:  # larger images are refused anyway
        file.seek(found.end())
        if not _are_whole(file.read(), width, height):
            raise DamagedImage(path, "", "is damaged or truncated; copy or save it again")
    return _Header((width, height))


def _are_whole(data: bytes, width: int, height: int) -> bool:
    """True if the lines of a Radiance image fit the image's header.

    Runs must fill each of a line's four parts exactly. Either all lines consist of runs, or no line does. Mitsuba's
    reader does not check the lines, and would write out of bounds.
    """
    start = bytes((2, 2, width >> 8, width & 255)) if 8 <= width <= 0x7FFF else b""
    if not start or data[:2] != start[:2] or data[2:3] >= b"\x80":
        return len(data) >= 4 * width * height
    position, end = 0, len(data)
    for _ in range(height):
        if data[position : position + 4] != start:
            return False
        position += 4
        for _ in range(4):
            left = width
            while left > 0 and position < end and data[position]:
                code = data[position]
                length = code - 128 if code > 128 else code
                left, position = left - length, position + (2 if code > 128 else length + 1)
            if left or position > end:
                return False
    return True


def _netpbm(path: Path, head: bytes, file: BinaryIO) -> _Header | None:
    found = re.match(rb"..(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", head)
    return _Header((int(found[1]), int(found[2]))) if found else None


def _bmp(path: Path, head: bytes, file: BinaryIO) -> _Header | None:
    width, height = struct.unpack_from("<ii", head, 18)
    return _Header((width, abs(height)))


_READERS: dict[bytes, Callable[[Path, bytes, BinaryIO], _Header | None]] = {
    b"\x76\x2f\x31\x01": _exr,
    **dict.fromkeys((_PNG, _JPEG), _photograph),
    b"#?": _hdr,
    **dict.fromkeys((b"PF", b"Pf", b"P5", b"P6"), _netpbm),
    b"BM": _bmp,
}


# --- messages of C libraries ------------------------------------------------------------------------------------------


@contextmanager
def _heard(lines: list[str]) -> Iterator[None]:
    """Append the process's standard error to `lines` instead of printing it.

    If a file looks complete, libjpeg (inside Mitsuba) reports missing data only on standard error.
    """
    try:
        before = os.dup(2)
    except OSError:  # closed: no messages
        yield
        return
    listening, speaking = os.pipe()
    for end in (listening, speaking):  # messages beyond the buffer are dropped; neither end waits for the other
        os.set_blocking(end, False)
    os.dup2(speaking, 2)
    os.close(speaking)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
        with suppress(BlockingIOError):
            lines += os.read(listening, 2**16).decode(errors="replace").splitlines()
        os.close(listening)


Image = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Photo:
    """Image file as linear Rec. 709, (H, W, 3) float32. Booleans (H, W) mark the defects of the pixels.

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
) -> Photo:
    """Read an image file like `read_image`, and mark unreliable pixels.

    `upright` rotates the image by its EXIF orientation. `size` then refers to the upright image. `signed` allows
    negative values, and `nonfinite` allows non-finite values. Raises ConfigError, located in the file.
    """
    bitmap = read_bitmap(path, size, upright)
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        raise ConfigError(path, "", f"has {bitmap.channel_count()} channels; use an image with only R, G, B or Y")
    width, height = (int(n) for n in bitmap.size())
    raw = np.array(bitmap).reshape(height, width, -1)
    alpha = raw[:, :, -1] if bitmap.has_alpha() else None
    colors = raw if alpha is None else raw[:, :, :-1]
    is_integer = raw.dtype.kind in "ui"
    bitmap.set_srgb_gamma(False)  # values as stored in the file; decoded below
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    image = np.array(bitmap, dtype=np.float32).reshape(height, width, 3)
    if color_space == "srgb" or (color_space == "auto" and is_integer):
        image = decode_srgb(image)
    finite, nothing = np.isfinite(image), np.zeros((height, width), dtype=bool)
    for bad, what in ((~finite & (not nonfinite), "not finite"), (finite & (image < 0) & (not signed), "negative")):
        if bad.any():
            y, x, channel = (int(n) for n in np.argwhere(bad)[0])
            value, count = f"{image[y, x, channel]:g}", int(bad.any(axis=2).sum())
            where = f"pixel ({x}, {y}), channel {'RGB'[channel]}"
            raise ConfigError(path, "", f"{where}, is {value}: {what} ({count} pixels in all)")
    return Photo(
        image,
        clipped=(colors == np.iinfo(raw.dtype).max).any(axis=2) if is_integer else nothing,
        transparent=nothing if alpha is None else alpha == 0,
        nonfinite=np.logical_not(finite.all(axis=2)),
    )


def decode_srgb(encoded: Image) -> Image:
    """Return the linear values of sRGB-encoded values (IEC 61966-2-1), with the precision of the input."""
    wide = encoded.astype(np.float64)
    curve = ((np.maximum(wide, 0) + 0.055) / 1.055) ** 2.4
    return np.where(wide <= 0.04045, wide / 12.92, curve).astype(encoded.dtype)
