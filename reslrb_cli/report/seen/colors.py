"""How far recovered colours are from the true ones, as a person sees it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from reslrb_cli.optimization.errors import comparison_grid, nearest, on_grid
from reslrb_cli.report.seen.difference import Array, ciede2000, itp, told
from reslrb_cli.report.tone import exposure_for

#: Parameters of three numbers that are no colours to look at.
NO_COLORS = ("eta", "k")
#: What is no light and no colour, but where something is.
PLACES = ("length", "degrees", "scale")


def is_color(key: str, quantity: str) -> bool:
    """Whether three channels of a parameter are those of a colour."""
    return quantity not in PLACES and not any(part in NO_COLORS for part in key.split(".")[-2:])


def color_errors(moments: Mapping[str, Array], true: Array, mask: Array | None, quantity: str) -> dict[str, Any]:
    """Differences of a parameter's colours at each of `moments` from the true ones, over the entries in `mask`.

    Arrays are colours (3,) or textures (H, W, 3); where resolutions differ, they are compared on the finer grid.
    What surfaces reflect (`quantity` is empty) is told in CIEDE2000, what lamps emit in ΔE_ITP, at an `exposure` that
    shows it. Empty where these are no such arrays, or the mask is.
    """
    found: dict[str, Any] = {}
    exposure = exposure_for(_texture(true)) if quantity and _is_told(true) else 1.0
    for moment, value in moments.items():
        pair = _entries(value, true, mask)
        if pair is not None and pair[0].size:
            difference = itp(*(exposure * array for array in pair)) if quantity else ciede2000(*pair)
            found[moment] = told(difference)
    if not found:
        return {}
    return {"measure": "itp" if quantity else "ciede2000", "exposure": exposure} | found


def _is_told(array: Array) -> bool:
    return array.shape == (3,) or (array.ndim == 3 and array.shape[2] == 3)


def _texture(array: Array) -> Array:
    return array.reshape(1, 1, 3) if array.ndim == 1 else array


def _entries(value: Array, true: Array, mask: Array | None) -> tuple[Array, Array] | None:
    """The colours (N, 3) to be compared, of both."""
    if value.ndim != true.ndim or not (_is_told(value) and _is_told(true)):
        return None
    value, true = _texture(value), _texture(true)
    grid = comparison_grid(value.shape, true.shape)
    if mask is None or mask.shape != value.shape[:2]:
        mask = np.ones(value.shape[:2], dtype=bool)
    if grid is not None:
        value, true, mask = on_grid(value, grid), on_grid(true, grid), nearest(mask, grid)
    return np.nan_to_num(value[mask]), np.nan_to_num(true[mask])
