"""Image files, read as images to compare with or as textures.

`_FORMATS` is the table of formats. Each reader finds the size in the header, so that a wrong image is refused before
its pixels are decoded. Mitsuba decodes PNG, EXR and HDR. Its other decoders ignore the byte order and the maximum of
PPM, the palette of BMP, and missing data of JPEG.

Cameras and phones store pixels in the sensor's orientation and in the sensor's colours. JPEG and PNG files store the
rotation to an upright image as EXIF metadata, and the colours as an ICC profile.
"""

from __future__ import annotations

import functools
import io
import logging
import math
import re
import struct
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import mitsuba as mi
import numpy as np

from reslrb_cli.config.files import PIXELS, open_file
from reslrb_cli.config.response import Response
from reslrb_cli.errors import ConfigError, is_out_of_memory, one_line
from reslrb_cli.records.images import read_planes
from reslrb_cli.scene.response import LINEAR, SRGB, clipped_level, decode

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

logger = logging.getLogger(__name__)
FORMATS = "EXR, PNG, JPG, HDR, PFM, PPM or BMP"
_NO_IMAGE = f"is not a readable image ({FORMATS}): damaged, truncated, or in another format, such as CMYK"
#: EXIF's tag of the camera's orientation.
_ORIENTATION = 0x0112
#: Bytes that hold the header of an EXR, HDR, PPM or PFM file.
_HEADER = 2**16
Size = tuple[int, int]
Image = np.ndarray[Any, Any]

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


@dataclass(frozen=True)
class StoredImage:
    """Pixels (H, W, C) as the file `path` stores them, and the names of their channels.

    `white` is the maximum of a file of integers, or None for floats. `profile` are the bytes of an ICC profile, or b"".
    """

    path: Path
    pixels: Image
    names: tuple[str, ...]
    white: int | None
    profile: bytes = b""

    @property
    def size(self) -> Size:
        """(width, height) in pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def colours(self) -> Image:
        """Return the pixels' red, green and blue (H, W, 3), or their luminance (H, W, 1). Raises ConfigError."""
        return self.pixels[:, :, self._colours()]

    def alpha(self) -> Image | None:
        """Return the alpha (H, W) that belongs to `colours`, or None. Raises ConfigError."""
        layer = self.names[self._colours()[0]].rpartition(".")[0]
        name = f"{layer}.A" if layer else "A"
        return self.pixels[:, :, self.names.index(name)] if name in self.names else None

    def only(self, names: Sequence[str]) -> Image:
        """Return the channels with these names, in this order. Raises ConfigError if one is missing."""
        if missing := [name for name in names if name not in self.names]:
            reason = f"has the channels {', '.join(self.names)}; the film also needs {', '.join(missing)}"
            raise ConfigError(self.path, "", reason)
        return self.pixels[:, :, [self.names.index(name) for name in names]]

    def _colours(self) -> list[int]:
        try:
            return find_colours(self.names)
        except ValueError as error:
            raise ConfigError(self.path, "", str(error)) from None

    def in_srgb(self) -> StoredImage:
        """Return the image with colours of sRGB in place of those of its ICC profile. Raises ConfigError."""
        if not self.profile or (name := foreign_profile(self.profile)) is None:
            return self
        if self.white != 255:
            advice = "convert it to sRGB, or set response: linear if its values are linear"
            raise ConfigError(self.path, "", f"has the colour profile {name} in 16 bits; {advice}")
        colours, alpha = self.colours(), self.alpha()
        converted = _converted(colours, self.profile)
        # A clipped channel stays clipped, so that it is found.
        converted = np.where(colours == 255, np.uint8(255), converted)
        if alpha is not None:
            converted = np.concatenate([converted, alpha[:, :, None]], axis=2)
        return StoredImage(self.path, converted, tuple("RGB" if alpha is None else "RGBA"), 255)


def find_colours(names: Sequence[str]) -> list[int]:
    """Return the places of the channels R, G and B, or of a single channel.

    Channels without a layer come first. Otherwise, the only layer with R, G and B is read, or the one that renderers
    name `Combined`. Raises ValueError if there is none, or more than one.
    """
    layers: dict[str, dict[str, int]] = {}
    for place, name in enumerate(names):
        layer, _, letter = name.rpartition(".")
        layers.setdefault(layer, {})[letter.upper()] = place
    found = {layer: [places[letter] for letter in "RGB"] for layer, places in layers.items() if {*"RGB"} <= {*places}}
    if "" in found:
        return found[""]
    if len(found) > 1:
        whole = {layer: places for layer, places in found.items() if layer.rpartition(".")[2].lower() in _WHOLE}
        if len(whole) != 1:
            raise ValueError(f"has the layers {', '.join(sorted(found))}; save the one of the image alone")
        found = whole
    if found:
        return next(iter(found.values()))
    if "Y" in layers.get("", {}):
        return [layers[""]["Y"]]
    if len(names) == 1:
        return [0]
    raise ValueError(f"has the channels {', '.join(names)}; use an image with R, G and B, or with Y")


#: Names of the layer with the image itself, in lower case.
_WHOLE = ("combined", "beauty", "rgba", "rgb", "color")


def read_stored(path: Path, size: Size | None = None, upright: bool = False) -> StoredImage:
    """Decode the image file `path`. `size` is the required (width, height), or None for any.

    Pixels are as stored. If `upright`, pixels and size are rotated or mirrored by EXIF (`TURNS`). Raises a ConfigError
    that names the file if the file is unreadable, no image, too large, of another size, damaged or truncated.
    """
    with _opened(path) as header:
        orientation = header.orientation if upright else 1
        width, height = header.size if orientation < 5 else header.size[::-1]
        if size is not None and (width, height) != size:
            turned = f", {TURNS[orientation]} as its EXIF orientation says" if orientation > 1 else ""
            raise ConfigError(path, "", f"is {width}x{height} pixels{turned}; it must be {size[0]}x{size[1]}")
        if width * height > PIXELS:
            raise ConfigError(path, "", f"is {width}x{height} pixels; an image has at most {PIXELS} pixels")
        found = header.decode()
        if found.size != header.size:
            raise ConfigError(path, "", _NO_IMAGE)
    return replace(found, pixels=turn(found.pixels, orientation), profile=header.profile)


def turn(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return a view of an image (H, W, ...), rotated or mirrored upright according to its EXIF `orientation`."""
    if orientation >= 5:  # rows of the file are columns of the view
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


# --- the table of formats ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Header:
    """Size of an image file, (width, height), and a function that decodes its pixels.

    `wrong` is the reason why Mitsuba's own textures would show other values, or "".
    """

    size: Size
    decode: Callable[[], StoredImage]
    orientation: int = 1
    profile: bytes = b""
    wrong: str = ""


@contextmanager
def _opened(path: Path) -> Iterator[_Header]:
    """Read the header of an image file. The file stays open for `decode`. Raises ConfigError for a file that is no
    image, also from `decode`.
    """
    with open_file(path) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged EXIF data rotates nothing
        try:
            start = file.read(8)
            reader = next(reader for begin, reader in _FORMATS.items() if start.startswith(begin))
            file.seek(0)
            header = reader(path, file)
            if min(header.size) < 1:
                raise ConfigError(path, "", f"is {header.size[0]}x{header.size[1]} pixels, so it is empty")
            yield header
        except Exception as error:
            if is_out_of_memory(error) or isinstance(error, ConfigError):
                raise
            raise ConfigError(path, "", _NO_IMAGE) from None


def _pillow(path: Path, file: BinaryIO) -> _Header:
    """Read PNG, JPEG and BMP files. JPEG files may have further images or a video after their image."""
    from PIL import Image  # late, because few commands read such files

    try:
        image = Image.open(file, formats=("PNG", "JPEG", "BMP"))
    except Image.DecompressionBombError:
        raise ConfigError(path, "", f"has too many pixels; an image has at most {PIXELS} pixels") from None
    decode = (
        functools.partial(_by_mitsuba, path, file)
        if image.format == "PNG"
        else functools.partial(_by_pillow, path, file, image)
    )
    is_palette = image.format == "BMP" and image.mode == "P"
    wrong = "has a palette, which Mitsuba's textures ignore; save it as PNG" if is_palette else ""
    return _Header(image.size, decode, _orientation(image), image.info.get("icc_profile") or b"", wrong)


def _orientation(image: ImageFile) -> int:
    from PIL.Image import Exif

    exif, orientation = Exif(), None
    with suppress(SyntaxError, ValueError, struct.error):
        exif.load(image.info.get("exif", b""))
        orientation = exif.get(_ORIENTATION)
    return orientation if orientation in TURNS else 1


def _by_pillow(path: Path, file: BinaryIO, image: ImageFile) -> StoredImage:
    if image.format != "BMP":
        file.seek(0)
        if not _ends(file.read()):  # Pillow fills missing data with grey
            raise ConfigError(path, "", "is truncated: the image has no end")
    mode = {"1": "L", "P": "RGB"}.get(image.mode, image.mode)
    return StoredImage(path, _as_pixels(np.array(image.convert(mode))), tuple(_NAMES[mode]), 255)


#: Names of the channels by Pillow's mode or Mitsuba's pixel format.
_NAMES = {"L": "Y", "LA": "YA", "RGB": "RGB", "RGBA": "RGBA", "Y": "Y", "YA": "YA"}
#: Marker in a JPEG file. Zeros follow other bytes 0xff.
_MARKER = re.compile(rb"\xff+([^\x00\xff])")


def _ends(jpeg: bytes) -> bool:
    """Whether the first image of a JPEG file has an end. Other images or a video may follow."""
    place = 2
    while (marker := _MARKER.search(jpeg, place)) is not None:
        place, kind = marker.end(), marker[1][0]
        if kind == 0xD9:
            return True
        if not 0xD0 <= kind <= 0xD7:  # restarts have no content
            place += int.from_bytes(jpeg[place : place + 2], "big")
    return False


def _by_mitsuba(path: Path, file: BinaryIO) -> StoredImage:
    bitmap = mi.Bitmap(str(path))
    pixels, kind = _as_pixels(np.array(bitmap)), bitmap.pixel_format().name
    if kind == "XYZ":
        pixels, kind = _from_xyz(pixels), "RGB"
    names = tuple(_NAMES[kind]) if kind in _NAMES else tuple(field.name for field in bitmap.struct_())
    return StoredImage(path, pixels, names, np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else None)


def _exr(path: Path, file: BinaryIO) -> _Header:
    head = file.read(_HEADER)
    [window] = re.findall(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", head, re.DOTALL)[:1]
    left, top, right, bottom = struct.unpack("<4i", window)

    def decode() -> StoredImage:
        found = _by_mitsuba(path, file)  # refuses truncated files
        has_parts = head[5] & 0x10
        if not has_parts and {*found.names} <= {*"RGBAY"}:
            return found
        # Mitsuba reads one part, converts all channels to one type, and leaves primaries of layers.
        planes = {name: plane for name, plane in read_planes(path).items() if plane.shape == found.pixels.shape[:2]}
        names = tuple(planes)
        pixels = np.stack(list(planes.values()), axis=-1)
        primaries = re.search(rb"chromaticities\0chromaticities\0 \0\0\0(.{32})", head, re.DOTALL)
        with suppress(ValueError):  # no colours, but channels of a film
            colours = find_colours(names)
            if primaries is not None and len(colours) == 3:
                to_xyz = _to_xyz(struct.unpack("<8f", primaries[1]))
                pixels[:, :, colours] = _from_xyz(pixels[:, :, colours] @ to_xyz.T)
        return StoredImage(path, pixels, names, None)

    return _Header((right - left + 1, bottom - top + 1), decode)


def _to_xyz(primaries: Sequence[float]) -> Image:
    """Return the matrix from linear RGB to CIE XYZ. `primaries` are x and y of red, green, blue and white."""
    columns = [[x / y, 1.0, (1 - x - y) / y] for x, y in zip(primaries[::2], primaries[1::2], strict=True)]
    red_green_blue, white = np.array(columns[:3]).T, np.array(columns[3])
    return np.asarray(red_green_blue * np.linalg.solve(red_green_blue, white))


def _from_xyz(pixels: Image) -> Image:
    """Convert pixels (H, W, 3) from CIE XYZ to linear Rec. 709."""
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32), mi.Bitmap.PixelFormat.XYZ)
    return np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB))


def _hdr(path: Path, file: BinaryIO) -> _Header:
    [(height, width)] = re.findall(rb"\n-Y\s+(\d+)\s+\+X\s+(\d+)\n", file.read(_HEADER))[:1]
    return _Header((int(width), int(height)), functools.partial(_by_mitsuba, path, file))


_SPACE = rb"(?:\s|#[^\n]*\n)+"
_FLOAT = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NETPBM = re.compile(rb"P([2356fF])(?:" + 2 * (_SPACE + rb"(\d+)") + _SPACE + rb"(" + _FLOAT + rb")\s)?")


def _netpbm(path: Path, file: BinaryIO) -> _Header:
    """Read PGM, PPM and PFM files. PGM and PPM files of more than 8 bits have the most significant byte first."""
    found = _NETPBM.match(file.read(_HEADER))
    assert found is not None
    kind, is_float = found[1], found[1] in b"fF"
    if found[2] is None:
        last = "scale" if is_float else "maximum"
        raise ConfigError(path, "", f"has a damaged header: P{kind.decode()} must precede width, height and {last}")
    width, height, limit = int(found[2]), int(found[3]), float(found[4])
    shape = height, width, 1 if kind in b"25f" else 3
    names = tuple("Y" if shape[2] == 1 else "RGB")
    if limit == 0 or math.isinf(limit) if is_float else limit not in range(1, 65536):
        right = "a scale other than 0" if is_float else "a maximum of 1 to 65535"
        raise ConfigError(path, "", f"has {found[4].decode()} in its header in place of {right}")
    coded = np.dtype(("<f4" if limit < 0 else ">f4") if is_float else ">u2" if limit > 255 else "u1")

    def decode() -> StoredImage:
        file.seek(found.end())
        count = math.prod(shape)
        if kind in b"23":
            words = file.read().split()[:count]
            if strange := [word for word in words if not word.isdigit()]:
                raise ConfigError(path, "", f"has {one_line(strange[0].decode('latin-1'), 30)} in place of a value")
            values = np.array(words, dtype=np.int64)
        else:
            data = file.read(coded.itemsize * count)
            values = np.frombuffer(data, coded, len(data) // coded.itemsize)
        if values.size < count:
            raise ConfigError(path, "", f"is truncated: it has {values.size} of {count} values")
        if is_float:
            pixels = values.reshape(shape)[::-1] * np.float32(abs(limit))
            return StoredImage(path, pixels.astype(np.float32), names, None)
        if values.max() > limit:
            raise ConfigError(path, "", f"has the value {values.max()}, but its maximum is {limit:.0f}")
        return StoredImage(path, values.reshape(shape).astype(coded.newbyteorder("=")), names, int(limit))

    is_other = not is_float and (kind != b"6" or limit != 255)
    wrong = "is no binary PPM file with a maximum of 255, the only kind that Mitsuba's textures read; save it as PNG"
    return _Header((width, height), decode, wrong=wrong if is_other else "")


#: Readers of the formats, by the first bytes of a file.
_FORMATS: dict[bytes, Callable[[Path, BinaryIO], _Header]] = {
    b"\x89PNG\r\n\x1a\n": _pillow,
    b"\xff\xd8\xff": _pillow,
    b"BM": _pillow,
    b"\x76\x2f\x31\x01": _exr,
    b"#?": _hdr,
    b"P": _netpbm,
}


def _as_pixels(array: Image) -> Image:
    return array if array.ndim == 3 else array[:, :, None]


# --- colours ----------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=8)
def foreign_profile(profile: bytes) -> str | None:
    """Return the name of an ICC profile, or None if its colours are those of sRGB, or if it is damaged."""
    from PIL import ImageCms

    levels = np.arange(0, 256, 51, dtype=np.uint8)
    probes = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(1, -1, 3)
    try:
        opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if opened.profile.xcolor_space.strip() == "GRAY":
            probes = np.arange(256, dtype=np.uint8).reshape(1, -1, 1)
        moved = _converted(probes, profile).astype(int) - probes
        name = ImageCms.getProfileDescription(opened).strip()
    except (OSError, ImageCms.PyCMSError):
        return None
    return (one_line(name, 60) or "without a name") if np.abs(moved).max() > _ROUNDING else None


#: Difference of two profiles of sRGB, which round differently, in steps of 8 bits.
_ROUNDING = 1


def _converted(colours: Image, profile: bytes) -> Image:
    """Convert bytes (H, W, 3 or 1) from the colours of an ICC profile to those of sRGB, (H, W, 3)."""
    from PIL import Image, ImageCms

    opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    is_grey = opened.profile.xcolor_space.strip() == "GRAY"
    pixels = colours[:, :, 0] if is_grey else np.broadcast_to(colours, (*colours.shape[:2], 3))
    image = ImageCms.profileToProfile(
        Image.fromarray(np.ascontiguousarray(pixels)), opened, ImageCms.createProfile("sRGB"),
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC, outputMode="RGB",
    )  # fmt: skip
    return np.array(image)


def image_size(path: Path) -> Size:
    """Return the stored (width, height) of an image. Raises a ConfigError that names the file if the file is not an
    image.
    """
    with _opened(path) as header:
        return header.size


def orientation_of(path: Path) -> int:
    """Return the EXIF orientation (1 to 8) of an image file, or 1 if the file has none. Raises ConfigError if the file
    is not an image.
    """
    with _opened(path) as header:
        return header.orientation


def texture_problems(path: Path) -> tuple[str, str]:
    """Return the reason why Mitsuba's textures cannot show an image file, or "", and the name of its ICC profile, which
    they ignore, or "". Files of other formats are left to Mitsuba.
    """
    with suppress(ConfigError), _opened(path) as header:
        return header.wrong, (foreign_profile(header.profile) if header.profile else None) or ""
    return "", ""


def photo_lines(path: Path, upright: bool = True, response: Response | None = None) -> list[str]:
    """Return lines for the user about the EXIF orientation and the ICC profile of an image.

    `upright` tells whether the image is read upright or as stored. With a linear response, the profile is ignored.
    """
    with _opened(path) as header:
        turned = TURNS.get(header.orientation)
        profile = foreign_profile(header.profile) if header.profile else None
    lines = []
    if turned is not None and upright:
        lines.append(f"{path}: {turned}, as its EXIF orientation says")
    elif turned is not None:
        lines.append(f"{path}: not {turned} as its EXIF orientation says: cameras of files use the stored orientation")
    if profile is not None and response == LINEAR:
        lines.append(f"{path}: its colour profile {profile} is ignored, as the response is linear")
    elif profile is not None:
        lines.append(f"{path}: colours are converted from its profile {profile} to sRGB")
    return lines


@dataclass(frozen=True)
class Photo:
    """Image file as linear Rec. 709, (H, W, 3) float32, or with the channels that were asked for. Booleans (H, W) mark
    the defects of the pixels.

    `clipped` pixels have a channel at the maximum value of a file of integers, or so close to it that the response does
    not determine the light (`response.clipped_level`). `transparent` pixels have alpha 0.
    `nonfinite` pixels have a non-finite channel. `alpha` (H, W) is in [0, 1], or None. Files of floats store colours
    that are multiplied by it.
    """

    image: Image
    clipped: np.ndarray
    transparent: np.ndarray
    nonfinite: np.ndarray
    alpha: np.ndarray | None
    is_integer: bool


def read_image(path: Path, color_space: str = "auto", size: Size | None = None, signed: bool = False) -> Image:
    """Read an EXR, PNG, JPG, HDR, PFM, PPM or BMP file as linear Rec. 709: (H, W, 3) float32.

    `color_space` is the encoding of the file's values: `linear`, `srgb`, or `auto` (integers srgb, floats linear).
    Alpha is dropped. A single channel is copied into three channels. `size` is the required (width, height). Pixels are
    as stored, as in Mitsuba's textures. If EXIF metadata would rotate the pixels, the function prints a warning.

    Raises a ConfigError that names the file if the file is missing, no image, damaged, truncated, too large or of
    another size. Raises ConfigError also for non-finite values, and for negative values unless `signed` is true.
    """
    response = None if color_space == "auto" else Response.model_validate({"encoding": color_space})
    image = read_photo(path, response, size, upright=False, signed=signed).image
    orientation = orientation_of(path)
    if orientation > 1:
        logger.warning("%s: the stored orientation is used, not %s as its EXIF says", path, TURNS[orientation])
    return image


def read_photo(
    path: Path,
    response: Response | None = None,
    size: Size | None = None,
    upright: bool = True,
    signed: bool = False,
    nonfinite: bool = False,
    channels: Sequence[str] = (),
) -> Photo:
    """Read an image file like `read_image`, and mark unreliable pixels.

    `response` decodes the values. None is sRGB for integers, and linear for floats.
    `upright` rotates the image by its EXIF orientation. `size` then refers to the upright image. `signed` allows
    negative values, and `nonfinite` allows non-finite values. `channels` are the names of the channels to read, if the
    image is not RGB. Raises ConfigError, located in the file.
    """
    stored = read_stored(path, size, upright)
    is_integer = stored.white is not None
    response = response or (SRGB if is_integer else LINEAR)
    if not channels and response != LINEAR:
        stored = stored.in_srgb()
    colours = stored.only(channels) if channels else stored.colours()
    alpha = None if channels else stored.alpha()
    image = decode(response, colours.astype(np.float32) / np.float32(stored.white or 1))
    if not channels:
        image = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image
    clipped: Image = np.zeros(image.shape[:2], dtype=bool)
    if stored.white is not None:
        clipped = np.any(colours >= clipped_level(response, stored.white), axis=2)
    finite = np.isfinite(image)
    for bad, what in ((~finite & (not nonfinite), "not finite"), (finite & (image < 0) & (not signed), "negative")):
        if bad.any():
            y, x, channel = (int(n) for n in np.argwhere(bad)[0])
            value, count = f"{image[y, x, channel]:g}", int(bad.any(axis=2).sum())
            where = f"pixel ({x}, {y}), channel {(channels or 'RGB')[channel]}"
            raise ConfigError(path, "", f"{where}, is {value}: {what} ({count} pixels in all)")
    return Photo(
        np.ascontiguousarray(image),
        clipped=clipped,
        transparent=np.zeros(image.shape[:2], dtype=bool) if alpha is None else alpha == 0,
        nonfinite=np.logical_not(finite.all(axis=2)),
        alpha=None if alpha is None else np.clip(alpha / np.float32(stored.white or 1), 0.0, 1.0),
        is_integer=is_integer,
    )
