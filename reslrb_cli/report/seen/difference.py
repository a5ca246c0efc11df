"""Differences between colours, by colour-science, and what is told of many of them.

Colours are linear sRGB (BT.709 primaries, D65), as Mitsuba's RGB variants have them. Arrays are (..., 3).
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

#: Luminance of a linear value of 1 in cd/m², for what needs absolute units: the reference white of ITU-R BT.2408.
WHITE = 203.0
#: Percentiles that are told.
PERCENTILES = (50, 95, 99)


def ciede2000(first: Array, second: Array) -> Array:
    """CIEDE2000 between colours of surfaces, or of a picture as a screen shows it: clipped to [0, 1].

    Some 1 is just noticeable side by side, some 10 at a glance.
    """
    return ciede2000_of_lab(*(to_lab(np.clip(values, 0.0, 1.0)) for values in (first, second)))


def ciede2000_of_lab(first: Array, second: Array) -> Array:
    """The same of CIE L*a*b* colours."""
    return np.asarray(_colour().delta_E(first, second, method="CIE 2000"))


def to_lab(values: Array) -> Array:
    """CIE L*a*b* under D65, the white of linear sRGB."""
    colour = _colour()
    space = colour.RGB_COLOURSPACES["sRGB"]
    xyz = values.astype(np.float64) @ space.matrix_RGB_to_XYZ.T
    return np.asarray(colour.XYZ_to_Lab(xyz, space.whitepoint))


def itp(first: Array, second: Array) -> Array:
    """ΔE_ITP (ITU-R BT.2124), for high dynamic range: nothing is clipped but what is negative, or beyond 10,000 cd/m².

    A value of 1 is taken for `WHITE`. 1 is just noticeable to the most critical eye.
    """
    colour = _colour()
    to_bt2020 = colour.matrix_RGB_to_RGB("sRGB", "ITU-R BT.2020")
    encoded = []
    for values in (first, second):
        light = np.clip(WHITE * (values.astype(np.float64) @ to_bt2020.T), 0.0, 1e4)
        encoded.append(colour.RGB_to_ICtCp(light))
    return np.asarray(colour.delta_E(*encoded, method="ITP"))


def told(values: Array) -> dict[str, float]:
    """`mean`, the percentiles as `p50` and so on, and `max` of differences, of at least one."""
    found = {"mean": float(np.mean(values))}
    found |= {
        f"p{share}": float(value) for share, value in zip(PERCENTILES, np.percentile(values, PERCENTILES), strict=True)
    }
    return found | {"max": float(np.max(values))}


def _colour() -> Any:
    """The package, which takes a second to be imported, and warns then of packages that nothing here needs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour
