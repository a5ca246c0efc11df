"""Linear values as a screen shows them: which exposure suits them, and their encoding in sRGB."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

#: What 99 % of the values are below is shown as it is where it lies in this range, else brought to `BRIGHT`.
LEAST_BRIGHT, MOST_BRIGHT, BRIGHT = 0.25, 1.6, 0.8


def exposure_for(arrays: Iterable[Array | None]) -> float:
    """The factor, of two digits, that makes linear values visible; 1 where they are, or there is none."""
    brightest = [float(np.quantile(np.nan_to_num(array[:, :, :3].max(axis=2)), 0.99)) for array in arrays
                 if array is not None and array.size]  # fmt: skip
    level = max(brightest, default=0.0)
    if not 0 < level < math.inf or LEAST_BRIGHT <= level <= MOST_BRIGHT:
        return 1.0
    return float(f"{BRIGHT / level:.1e}")


def exposure_words(exposure: float) -> str:
    """What has to be said of an exposure; nothing of 1."""
    if exposure == 1:
        return ""
    return f"shown {exposure:.2g} times brighter" if exposure > 1 else f"shown {1 / exposure:.2g} times darker"


def encode(values: Array) -> Array:
    """Linear values in [0, 1] as sRGB."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)
