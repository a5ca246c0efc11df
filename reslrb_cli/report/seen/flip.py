"""HDR-FLIP: how an error strikes someone who flips between two images, at all exposures that show something.

From the package `flip-evaluator`, which is an extra: `pip install reslrb[flip]`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

MISSING = "HDR-FLIP was not measured: its package is not installed (`pip install reslrb[flip]`)"
#: Exposures at most. FLIP takes one a stop between what shows the brightest pixel and what shows the median one.
MOST_EXPOSURES = 8
#: Luminance of linear sRGB, as FLIP has it.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
#: The ACES curve (a x² + b x + c) / (d x² + e x + f) that FLIP takes for its tone mapper, and the output that counts as
#: bright.
_ACES, _BRIGHT = np.array([0.36 * 2.51, 0.6 * 0.03, 0.0, 0.36 * 2.43, 0.6 * 0.59, 0.14]), 0.85


def is_installed() -> bool:
    """Whether the package can be imported."""
    try:
        import flip_evaluator  # noqa: F401
    except ImportError:
        return False
    return True


def flip_map(image: Array, target: Array) -> Array | None:
    """The error (H, W), from 0 to 1, of an image against its target, both linear (H, W, 3).

    None for a black target, which no exposure shows. Seen at FLIP's usual distance, 67 pixels a degree.
    """
    import flip_evaluator

    # The package ends the process where it does not like its input: it is given what it takes, exposures too.
    exposures = find_exposures(target)
    if exposures is None:
        return None
    low, high = exposures
    options = {"startExposure": low, "stopExposure": high, "numExposures": max(2, math.ceil(high - low))}
    pair = [
        np.ascontiguousarray(np.clip(np.nan_to_num(array), 0.0, 1e30), dtype=np.float32) for array in (target, image)
    ]
    error, _, _ = flip_evaluator.evaluate(*pair, "HDR", applyMagma=False, computeMeanError=False, parameters=options)
    return np.asarray(error)[:, :, 0]


def find_exposures(target: Array) -> tuple[float, float] | None:
    """The first and the last exposure in stops, as FLIP chooses them, of a target (H, W, 3); None for a black one.

    Where most of the image is black the median is taken of the rest: FLIP's own would be infinite.
    """
    light = np.nan_to_num(target.astype(np.float64)) @ _LUMINANCE
    shown = light[light > 0]
    if not shown.size:
        return None
    median = float(np.median(light)) or float(np.median(shown))
    a, b, c = _ACES[:3] - _BRIGHT * _ACES[3:]
    bright = -0.5 * b / a + math.sqrt((0.5 * b / a) ** 2 - c / a)
    low, high = (math.log2(bright / max(level, 1e-30)) for level in (float(shown.max()), median))
    return low, min(max(high, low + 1.0), low + MOST_EXPOSURES)
