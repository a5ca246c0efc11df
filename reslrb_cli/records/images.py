"""Images and recovered parameters on the disk, in formats that other tools read.

Names of files are made from the keys of parameters, which are as long as a scene's author likes. Images are written as
EXR (linear, 32-bit) and PNG (8-bit sRGB, to look at). OpenEXR files of named layers hold several arrays of one size, so
that a viewer flips between them. `parameters/` holds what was optimised.
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

Array = np.ndarray[Any, Any]


def luminance(image: Array) -> Array:
    """Return the luminance (H, W) of linear values (H, W, C), by Mitsuba's weights; of one channel, that channel."""
    wide = image.astype(np.float64)
    return wide[:, :, :3] @ [0.212671, 0.715160, 0.072169] if image.shape[2] >= 3 else wide[:, :, 0]


#: Bytes of such a name. File systems take 255, of which some are for suffixes and for files that are being written.
MOST_BYTES = 180


def file_stem(key: str) -> str:
    """A file name for the parameter `key`, not too long, and another for every key.

    Where file systems mind something of it that is `_` in its place, and a number tells it from others like it.
    """
    stem = re.sub(r"[^\w.\-]", "_", key)
    return bounded(stem) if stem == key else _numbered(stem, key)


def bounded(stem: str) -> str:
    """`stem`, or where it is too long for a file's name its beginning, and a number that tells it from others."""
    return stem if len(stem.encode()) <= MOST_BYTES else _numbered(stem, stem)


def _numbered(stem: str, whole: str) -> str:
    """`stem`, or its beginning, and a number made from `whole`."""
    digest = hashlib.blake2b(whole.encode(errors="surrogatepass"), digest_size=6).hexdigest()
    return f"{stem.encode(errors='replace')[: MOST_BYTES - 13].decode(errors='ignore')}-{digest}"


#: Mitsuba's name of the format of each suffix.
FORMATS = {".exr": "OpenEXR", ".hdr": "RGBE", ".pfm": "PFM", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


def write_image(stem: Path, image: Array, shown: Array | None = None) -> None:
    """Write an (H, W, C) image of linear values as `<stem>.exr`, and it or what is `shown` of it as `<stem>.png`.

    `stem` is appended to rather than given a new suffix: keys of parameters have dots of their own.
    """
    write_file(Path(f"{stem}.exr"), image, linear=True)
    write_file(Path(f"{stem}.png"), image if shown is None else shown, linear=False)


def finite_range(arrays: Iterable[Array]) -> tuple[float, float]:
    """The least and the greatest finite value in any of the arrays; 0 and 0 where there is none."""
    known = [values for array in arrays if (values := array[np.isfinite(array)]).size]
    if not known:
        return 0.0, 0.0
    return min(float(values.min()) for values in known), max(float(values.max()) for values in known)


def write_file(path: Path, image: Array, linear: bool) -> None:
    """Write an (H, W, C) image of linear values in the format that the suffix of `path` names, atomically.

    `linear` writes it as it is; else it becomes 8-bit sRGB, clipped to [0, 1], and of four channels or more, and of
    two, only the first are shown: three and one. Raises OSError, and RuntimeError for channels that a format lacks.
    """
    if linear:
        write_bitmap(path, mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32)))
        return
    channels = 3 if image.shape[2] >= 3 else 1
    shown = np.clip(np.nan_to_num(image[:, :, :channels], nan=0.0), 0.0, 1.0).astype(np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(shown))
    write_bitmap(path, bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True))


def write_bitmap(path: Path, bitmap: mi.Bitmap) -> None:
    """Write a bitmap as it is, atomically, in the format that the suffix of `path` names; raises as `write_file`.

    By way of memory: Mitsuba would open the file itself, and leave it empty or cut short where the process ends.
    """
    stream = mi.MemoryStream()
    bitmap.write(stream, getattr(mi.Bitmap.FileFormat, FORMATS[path.suffix.lower()]))
    write_atomically(path, lambda file: file.write(stream.raw_buffer()))


def load_image(path: Path) -> Array | None:
    """An image of linear values that `write_image` wrote, (H, W, C) float32; None where none is, or it is damaged."""
    if not path.is_file():
        return None
    try:
        array = np.array(mi.Bitmap(str(path)), dtype=np.float32)
    except (OSError, RuntimeError, ValueError):
        return None
    return array if array.ndim == 3 else array[:, :, None]


#: Names of the channels of a layer, by their number. A layer of another number has them counted.
_CHANNELS = {1: "Y", 3: "RGB", 4: "RGBA"}


def write_layers(path: Path, layers: Mapping[str, Array]) -> None:
    """Write arrays (H, W) or (H, W, C) of linear values as one EXR at `path`, atomically, 32 bits a channel.

    Each is a layer of its name, with channels such as `image.R`; all have one height and width. Raises OSError.
    """
    import OpenEXR

    channels: dict[str, Array] = {}
    for name, array in layers.items():
        planes = array[:, :, None] if array.ndim == 2 else array
        letters = _CHANNELS.get(planes.shape[2]) or [str(number) for number in range(planes.shape[2])]
        for place, letter in enumerate(letters):
            channels[f"{name}.{letter}"] = np.ascontiguousarray(planes[:, :, place], dtype=np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()  # by way of memory: OpenEXR would leave half a file where the process ends
    OpenEXR.File(header, channels).write(stream)
    write_atomically(path, lambda file: file.write(stream.getbuffer()))


def read_layers(path: Path) -> dict[str, Array]:
    """The layers of an EXR by name, each (H, W, C) float32; what has no layer's name is the layer "".

    Raises OSError where there is no file, ValueError where it is no EXR, or damaged.
    """
    import OpenEXR

    content = io.BytesIO(path.read_bytes())
    try:
        planes = {
            name: channel.pixels for name, channel in OpenEXR.File(content, separate_channels=True).channels().items()
        }
    except Exception as error:  # of many kinds, for files that are damaged
        raise ValueError(f"{path}: {error}") from None
    groups: dict[str, dict[str, Array]] = {}
    for full, pixels in planes.items():
        name, _, letter = full.rpartition(".")
        groups.setdefault(name, {})[letter] = np.asarray(pixels, dtype=np.float32)
    return {
        name: np.stack([group[letter] for letter in sorted(group, key=_place)], -1) for name, group in groups.items()
    }


def _place(letter: str) -> tuple[int, int, str]:
    """Where a channel stands in its layer: colours as R, G, B, A, numbers by their value, the rest by name."""
    if letter in "RGBA":
        return 0, "RGBA".index(letter), ""
    return 1, int(letter) if letter.isdecimal() else 0, letter


def read_layer_names(path: Path) -> set[str]:
    """The names of the layers of an EXR, from its head alone; none where there is no file, or it is no EXR."""
    import OpenEXR

    try:
        head = OpenEXR.File(str(path), header_only=True).header()
        return {channel.name.rpartition(".")[0] for channel in head["channels"]}
    except Exception:  # of many kinds, for files that are damaged
        return set()


#: Of all values as they are.
PARAMETERS_FILE = "parameters.npz"


def write_parameters(folder: Path, values: Mapping[str, Array]) -> None:
    """Write parameter values into `folder`.

    Textures (H, W, C) as `<key>.exr`, which can stand in the scene file in place of the texture that it began with,
    and `<key>.png` to look at (a heightmap from its lowest point in black to its highest in white); the shape of every
    parameter, and the values of those that are no textures, in `parameters.json`; everything in `parameters.npz`.
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
    """Write the mask of the entries that light and sensor reach: `<key>.mask.npy`, and for textures `<key>.mask.png`.

    `mask` is boolean, (H, W) for a texture and of the parameter's own shape otherwise.
    """
    stem = file_stem(key) + ".mask"
    write_atomically(folder / f"{stem}.npy", lambda file: np.save(file, mask))
    if mask.ndim == 2:
        bitmap = mi.Bitmap(np.ascontiguousarray(mask[:, :, None] * np.uint8(255)))
        write_bitmap(folder / f"{stem}.png", bitmap)


def read_parameters(folder: Path) -> dict[str, Array]:
    """The values that `write_parameters` wrote into `folder`, by key; nothing where they are missing or damaged."""
    try:
        with np.load(folder / PARAMETERS_FILE) as arrays:
            return {key: arrays[key] for key in arrays.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return {}


def read_mask(folder: Path, key: str) -> Array | None:
    """The mask that `write_mask` wrote for the parameter `key`; None where there is none, or it is damaged."""
    try:
        mask: Array = np.load(folder / f"{file_stem(key)}.mask.npy")
    except (OSError, ValueError, EOFError):
        return None
    return mask if mask.dtype == bool else None


def in_range(heights: Array, low: float, high: float) -> Array:
    """Heights, which may be negative and far below 1, from 0 at `low` to 1 at `high`."""
    return (heights - low) / ((high - low) or 1.0)
