"""OpenEXR files of named layers: several arrays of one size in one file, so that a viewer flips between them."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.atomic import write_atomically

Array = np.ndarray[Any, Any]

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
