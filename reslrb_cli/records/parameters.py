"""`parameters/`: what was optimised, in formats that other tools read."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config import HEIGHTMAP
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.file_names import file_stem
from reslrb_cli.records.images import finite_range, write_bitmap, write_image

Array = np.ndarray[Any, Any]

#: Of all values as they are.
FILE_NAME = "parameters.npz"


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
            shown = _relief(value) if key.endswith(f".{HEIGHTMAP}") else None
            write_image(folder / file_stem(key), value, shown)
            entry["file"] = file_stem(key) + ".exr"
        elif value.size <= 64:
            entry["value"] = value.tolist()
        summary[key] = entry
    arrays: dict[str, Any] = dict(values)
    text = json.dumps(summary, indent=2)
    write_atomically(folder / "parameters.json", lambda file: file.write(text.encode() + b"\n"))
    write_atomically(folder / FILE_NAME, lambda file: np.savez(file, **arrays))


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
        with np.load(folder / FILE_NAME) as arrays:
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


def _relief(heights: Array) -> Array:
    """Heights, which may be negative and far below 1, over the range that they have."""
    low, high = finite_range([heights])
    return (heights - low) / ((high - low) or 1.0)
