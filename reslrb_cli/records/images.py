"""Files of images and parameters, in formats that other tools read.

Images are written as EXR (linear, 32-bit) and PNG (8-bit sRGB, for viewing). EXR files with named layers hold several
arrays of one size, so that a viewer can flip between them. The folder `parameters/` holds the recovered parameters.
File names are made from parameter keys, which can be of any length.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config.parameters import HEIGHTMAP
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.checkpoint import PARAMETERS_FILE

Array = np.ndarray[Any, Any]


def luminance(image: Array) -> Array:
    """Return the luminance (H, W) of linear values (H, W, C), with Mitsuba's weights. A single channel is unchanged."""
    wide = image.astype(np.float64)
    return wide[:, :, :3] @ [0.212671, 0.715160, 0.072169] if image.shape[2] >= 3 else wide[:, :, 0]


#: Maximum length of a file stem in bytes. File systems allow 255; the rest is for suffixes and temporary names.
MOST_BYTES = 180


def file_stem(key: str) -> str:
    """Return a unique file name of limited length for the parameter `key`.

    Characters that file systems do not accept become `_`. A hash is then added to keep the name unique.
    """
    stem = re.sub(r"[^\w.\-]", "_", key)
    return bounded(stem) if stem == key else _numbered(stem, key)


def bounded(stem: str) -> str:
    """Return `stem`. If `stem` is too long for a file name, return its beginning and a hash."""
    return stem if len(stem.encode()) <= MOST_BYTES else _numbered(stem, stem)


def _numbered(stem: str, whole: str) -> str:
    """Return `stem`, shortened if necessary, with a hash of `whole`."""
    digest = hashlib.blake2b(whole.encode(errors="surrogatepass"), digest_size=6).hexdigest()
    return f"{stem.encode(errors='replace')[: MOST_BYTES - 13].decode(errors='ignore')}-{digest}"


#: Mitsuba's format name for each suffix.
FORMATS = {".exr": "OpenEXR", ".hdr": "RGBE", ".pfm": "PFM", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


def write_image(stem: Path, image: Array, shown: Array | None = None) -> None:
    """Write an (H, W, C) image of linear values as `<stem>.exr`. Write `shown` as `<stem>.png`, or the image if `shown`
    is None.

    The function appends the suffix to the whole `stem`, because parameter keys contain dots.
    """
    write_file(Path(f"{stem}.exr"), image, linear=True)
    write_file(Path(f"{stem}.png"), image if shown is None else shown, linear=False)


def finite_range(arrays: Iterable[Array]) -> tuple[float, float]:
    """Return the minimum and maximum of all finite values in the arrays. Return 0 and 0 if no value is finite."""
    known = [values for array in arrays if (values := array[np.isfinite(array)]).size]
    if not known:
        return 0.0, 0.0
    return min(float(values.min()) for values in known), max(float(values.max()) for values in known)


def write_file(path: Path, image: Array, linear: bool) -> None:
    """Write an (H, W, C) image of linear values atomically, in the format given by the suffix of `path`.

    With `linear`, values are written unchanged. Without `linear`, values are clipped to [0, 1] and converted to 8-bit
    sRGB. Without `linear`, the file gets the first three channels, or only the first channel if there are fewer than
    three. Raises OSError if writing fails, and RuntimeError if the format does not support the channels.
    """
    if linear:
        write_bitmap(path, mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32)))
        return
    write_bitmap(path, _as_srgb(image))


def as_bytes(image: Array) -> Array:
    """Return an (H, W, C) image of linear values as sRGB bytes, (H, W, 3) or (H, W, 1), as `write_file` writes it."""
    pixels = np.array(_as_srgb(image))
    return pixels if pixels.ndim == 3 else pixels[:, :, None]


def _as_srgb(image: Array) -> mi.Bitmap:
    channels = 3 if image.shape[2] >= 3 else 1
    shown = np.clip(np.nan_to_num(image[:, :, :channels], nan=0.0), 0.0, 1.0).astype(np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(shown))
    return bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)


def write_bitmap(path: Path, bitmap: mi.Bitmap) -> None:
    """Write a bitmap unchanged and atomically, in the format given by the suffix of `path`. Raises the same errors as
    `write_file`.

    The bitmap is encoded in memory, because Mitsuba would leave a partial file if the process ends.
    """
    stream = mi.MemoryStream()
    bitmap.write(stream, getattr(mi.Bitmap.FileFormat, FORMATS[path.suffix.lower()]))
    write_atomically(path, lambda file: file.write(stream.raw_buffer()))


def load_image(path: Path) -> Array | None:
    """Return an image written by `write_image`, as linear float32 (H, W, C). Return None if the file is missing or
    damaged.
    """
    if not path.is_file():
        return None
    try:
        array = np.array(mi.Bitmap(str(path)), dtype=np.float32)
    except (OSError, RuntimeError, ValueError):
        return None
    return array if array.ndim == 3 else array[:, :, None]


#: Channel names of a layer by channel count. For other counts, the channels are numbered.
_CHANNELS = {1: "Y", 3: "RGB", 4: "RGBA"}


def write_layers(path: Path, layers: Mapping[str, Array]) -> None:
    """Write arrays (H, W) or (H, W, C) of linear values atomically as one EXR with 32 bits per channel.

    Each array becomes a layer with channels such as `image.R`. All have the same height and width. Raises OSError.
    """
    import OpenEXR

    channels: dict[str, Array] = {}
    for name, array in layers.items():
        planes = array[:, :, None] if array.ndim == 2 else array
        letters = _CHANNELS.get(planes.shape[2]) or [str(number) for number in range(planes.shape[2])]
        for place, letter in enumerate(letters):
            channels[f"{name}.{letter}"] = np.ascontiguousarray(planes[:, :, place], dtype=np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()  # in memory, because OpenEXR would leave a partial file if the process ends
    OpenEXR.File(header, channels).write(stream)
    write_atomically(path, lambda file: file.write(stream.getbuffer()))


def read_planes(path: Path) -> dict[str, Array]:
    """Return the channels of all parts of an EXR by name, each (H, W) float32. Raises the errors of `read_layers`."""
    import OpenEXR

    content = io.BytesIO(path.read_bytes())
    planes: dict[str, Array] = {}
    try:
        file = OpenEXR.File(content, separate_channels=True)
        file.channels()  # raises an error if no part could be read
        for part in file.parts:
            for name, channel in part.channels.items():
                planes.setdefault(name, np.asarray(channel.pixels, dtype=np.float32))
    except Exception as error:  # damaged files raise many types
        raise ValueError(f"{path}: {error}") from None
    return planes


def read_layers(path: Path) -> dict[str, Array]:
    """Return the layers of an EXR by name, each (H, W, C) float32. Channels without a layer form the layer "".

    Raises OSError if there is no file, and ValueError if the file is damaged or not an EXR.
    """
    groups: dict[str, dict[str, Array]] = {}
    for full, pixels in read_planes(path).items():
        name, _, letter = full.rpartition(".")
        groups.setdefault(name, {})[letter] = pixels
    return {
        name: np.stack([group[letter] for letter in sorted(group, key=_place)], -1) for name, group in groups.items()
    }


def _place(letter: str) -> tuple[int, int, str]:
    """Return a sort key for channels. R, G, B, A come first, in this order. Numbers follow by value. Other names count
    as 0, and are sorted by name.
    """
    if letter in tuple("RGBA"):
        return 0, "RGBA".index(letter), ""
    return 1, int(letter) if letter.isdecimal() else 0, letter


def write_parameters(folder: Path, values: Mapping[str, Array]) -> None:
    """Write parameter values into `folder`.

    - `<key>.exr` and `<key>.png`: each texture (H, W, C). The EXR can replace the original texture in the scene file.
        The PNG is for viewing. In the PNG of a heightmap, black is the lowest point and white the highest.
    - `parameters.json`: the shape of every parameter, and the values of small parameters that are not textures.
    - `parameters.npz`: the values of all parameters.
    """
    folder.mkdir(exist_ok=True)
    summary: dict[str, Any] = {}
    for key, value in values.items():
        entry: dict[str, Any] = {"shape": list(value.shape)}
        if value.ndim == 3:
            shown = in_range(value, *finite_range([value])) if key.endswith(f".{HEIGHTMAP}") else None
            write_image(folder / file_stem(key), value, shown)
            entry["file"] = file_stem(key) + ".exr"
        elif value.size <= 64:
            entry["value"] = value.tolist()
        summary[key] = entry
    arrays: dict[str, Any] = dict(values)
    text = json.dumps(summary, indent=2)
    write_atomically(folder / "parameters.json", lambda file: file.write(text.encode() + b"\n"))
    write_atomically(folder / PARAMETERS_FILE, lambda file: np.savez(file, **arrays))


def write_mask(folder: Path, key: str, mask: Array) -> None:
    """Write the mask of the entries that light and sensor reach. The files are `<key>.mask.npy` and, for textures,
    `<key>.mask.png`.

    `mask` is boolean. Its shape is (H, W) for a texture, otherwise the parameter's shape.
    """
    stem = file_stem(key) + ".mask"
    write_atomically(folder / f"{stem}.npy", lambda file: np.save(file, mask))
    if mask.ndim == 2:
        bitmap = mi.Bitmap(np.ascontiguousarray(mask[:, :, None] * np.uint8(255)))
        write_bitmap(folder / f"{stem}.png", bitmap)


def read_parameters(folder: Path) -> dict[str, Array]:
    """Return the values that `write_parameters` wrote into `folder`, by key. The result is empty if the values are
    missing or damaged.
    """
    try:
        with np.load(folder / PARAMETERS_FILE) as arrays:
            return {key: arrays[key] for key in arrays.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return {}


def read_mask(folder: Path, key: str) -> Array | None:
    """Return the mask that `write_mask` wrote for the parameter `key`, or None if it is missing or damaged."""
    try:
        mask: Array = np.load(folder / f"{file_stem(key)}.mask.npy")
    except (OSError, ValueError, EOFError):
        return None
    return mask if mask.dtype == bool else None


def in_range(heights: Array, low: float, high: float) -> Array:
    """Map heights linearly, so that `low` becomes 0 and `high` becomes 1."""
    return (heights - low) / ((high - low) or 1.0)
