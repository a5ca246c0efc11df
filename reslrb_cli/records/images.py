"""Images as EXR (linear, 32-bit) and PNG (8-bit sRGB, to look at)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.records.atomic import write_atomically

#: Mitsuba's name of the format of each suffix.
FORMATS = {".exr": "OpenEXR", ".hdr": "RGBE", ".pfm": "PFM", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


def write_image(stem: Path, image: np.ndarray[Any, Any], shown: np.ndarray[Any, Any] | None = None) -> None:
    """Write an (H, W, C) image of linear values as `<stem>.exr`, and it or what is `shown` of it as `<stem>.png`.

    `stem` is appended to rather than given a new suffix: keys of parameters have dots of their own.
    """
    write_file(Path(f"{stem}.exr"), image, linear=True)
    write_file(Path(f"{stem}.png"), image if shown is None else shown, linear=False)


def finite_range(arrays: Iterable[np.ndarray[Any, Any]]) -> tuple[float, float]:
    """The least and the greatest finite value in any of the arrays; 0 and 0 where there is none."""
    known = [values for array in arrays if (values := array[np.isfinite(array)]).size]
    if not known:
        return 0.0, 0.0
    return min(float(values.min()) for values in known), max(float(values.max()) for values in known)


def write_file(path: Path, image: np.ndarray[Any, Any], linear: bool) -> None:
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


def read_exr(path: Path) -> np.ndarray[Any, Any]:
    """Read an image of linear values that `write_image` wrote; (H, W, C) float32. Raises OSError or RuntimeError."""
    with path.open("rb"):  # else the exception is Mitsuba's
        pass
    array = np.array(mi.Bitmap(str(path)), dtype=np.float32)
    return array if array.ndim == 3 else array[:, :, None]


def load_image(path: Path) -> np.ndarray[Any, Any] | None:
    """The same; None where there is no image, or what is there is damaged."""
    try:
        return read_exr(path)
    except (OSError, RuntimeError, ValueError):
        return None
