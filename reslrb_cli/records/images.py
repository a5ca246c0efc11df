"""Images as EXR (linear, 32-bit) and PNG (8-bit sRGB, to look at)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np


def write_image(stem: Path, image: np.ndarray[Any, Any]) -> None:
    """Write an (H, W, C) image of linear values as `<stem>.exr` and `<stem>.png`.

    `stem` is appended to rather than given a new suffix: keys of parameters have dots of their own.
    """
    write_file(Path(f"{stem}.exr"), image, linear=True)
    write_file(Path(f"{stem}.png"), image, linear=False)


def write_file(path: Path, image: np.ndarray[Any, Any], linear: bool) -> None:
    """Write an (H, W, C) image of linear values in the format that the suffix of `path` names.

    `linear` writes it as it is; else it becomes 8-bit sRGB, clipped to [0, 1], and of four channels or more, and of
    two, only the first are shown: three and one.
    """
    if linear:
        mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32)).write(str(path))
        return
    channels = 3 if image.shape[2] >= 3 else 1
    shown = np.clip(np.nan_to_num(image[:, :, :channels], nan=0.0), 0.0, 1.0).astype(np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(shown))
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(path))


def read_exr(path: Path) -> np.ndarray[Any, Any]:
    """Read an image of linear values that `write_image` wrote; (H, W, C) float32. Raises OSError or RuntimeError."""
    with path.open("rb"):  # else the exception is Mitsuba's
        pass
    array = np.array(mi.Bitmap(str(path)), dtype=np.float32)
    return array if array.ndim == 3 else array[:, :, None]
