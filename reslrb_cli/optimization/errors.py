"""Root mean square errors of parameters relative to true values. Each error has the unit of its parameter.

Only errors with a common unit can be combined. Reflectance and roughness have no unit, but the intensity of a lamp is
in W/sr, and the radiance of an area light in W/(m² sr). If units differ, errors are divided by the true values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.scene.values import resample
from reslrb_cli.statistics import Array, rms

#: Parameters of emission; parameters of the same quantity have the same unit.
_EMITTED = {
    "AreaLight": "radiance",
    "ConstantBackgroundEmitter": "radiance",
    "DirectionalArea": "radiance",
    "EnvironmentMapEmitter": "radiance",
    "PointLight": "intensity",
    "SpotLight": "intensity",
    "DirectionalEmitter": "irradiance",
    "Projector": "irradiance",
}


def quantity(params: Any, key: str) -> str:
    """Return the quantity of a `mi.traverse` entry: `radiance`, `irradiance`, `intensity`, `length`, or "" without a
    unit.

    Parameters of BSDFs, mesh attributes, and factors (`scale`, a spot's `texture`) have no unit.
    """
    if key.endswith((".vertex_positions", ".position")):
        return "length"
    node = own = params.properties[key][2]
    while node is not None and not isinstance(node, mi.Emitter):
        node = params.hierarchy[node][0]
    is_factor = own is node and not key.endswith(".data") and key != "data"
    if node is None or is_factor or ".texture." in f".{key}":
        return ""
    return _EMITTED.get(node.class_name(), "")


class ErrorMeter:
    """Errors of parameters relative to true values, over the entries that light and sensor reach.

    `truth` and `masks` are the fields of a `Problem`. `quantities` has the quantity of each parameter (`quantity`). If
    a texture and its true value have different resolutions, both are resampled bilinearly to the finer grid. A cell of
    the finer grid counts if the mask includes the parameter's texel at the cell's centre. The error of a coarse texture
    therefore includes detail of the true value that the coarse texture cannot show. The error of a fine texture
    includes its noise.
    """

    def __init__(
        self, truth: Mapping[str, Array], masks: Mapping[str, Array], quantities: Mapping[str, str] | None = None
    ) -> None:
        self._truth: dict[str, Array] = {}
        self._masks: dict[str, Array] = {}
        for key, true in truth.items():
            mask = masks[key]
            grid = comparison_grid(mask.shape, true.shape)
            mask = mask if grid is None else nearest(mask, grid)
            if mask.any():
                self._masks[key] = mask
                self._truth[key] = on_grid(true, grid).astype(np.float64)[mask]
        #: Root mean square of each truth over the same entries; a truth of zeros has none.
        self.scales = {key: scale for key, true in self._truth.items() if (scale := rms(true)) > 0}
        self.one_unit = len({(quantities or {}).get(key, "") for key in self._truth}) <= 1

    def errors(self, value: Callable[[str], Array]) -> dict[str, float]:
        """Return the root mean square error of each parameter with a true value. `value` returns a current value."""
        found = {}
        for key, true in self._truth.items():
            mask, array = self._masks[key], value(key)
            grid = mask.shape if array.ndim == 3 and array.shape[:2] != mask.shape else None
            found[key] = rms(on_grid(array, grid).astype(np.float64)[mask] - true)
        return found

    def total(self, errors: Mapping[str, float]) -> float | None:
        """Return the root mean square error over the entries of all parameters. Return None if units differ or nothing
        is known.

        The argument `errors` is the result of the method `errors`.
        """
        count = sum(self._truth[key].size for key in errors)
        if not count or not self.one_unit:
            return None
        return float(np.sqrt(sum(self._truth[key].size * error**2 for key, error in errors.items()) / count))

    def relative(self, errors: Mapping[str, float]) -> dict[str, float]:
        """Return each error divided by the root mean square of the true values. Parameters with true values of 0 are
        left out.
        """
        return {key: error / self.scales[key] for key, error in errors.items() if key in self.scales}


def comparison_grid(shape: tuple[int, ...], true_shape: tuple[int, ...]) -> tuple[int, int] | None:
    """Return the (height, width) for comparing a texture with its true value. Returns None if both shapes are equal, or
    if the parameter is not a texture.
    """
    if len(true_shape) != 3 or shape[:2] == true_shape[:2]:
        return None
    return max(shape[0], true_shape[0]), max(shape[1], true_shape[1])


def on_grid(array: Array, grid: tuple[int, ...] | None) -> Array:
    """Return a texture resampled bilinearly to `grid`, (height, width), or unchanged if `grid` is None."""
    return array if grid is None or array.shape[:2] == grid else resample(array, (grid[1], grid[0]))


def nearest(mask: Array, grid: tuple[int, int]) -> Array:
    """Return a mask (H, W) on a finer grid. Each cell has the mask's value at the cell's centre."""
    rows, columns = (
        ((np.arange(size) + 0.5) * own / size).astype(int) for size, own in zip(grid, mask.shape, strict=True)
    )
    return mask[rows[:, None], columns]
