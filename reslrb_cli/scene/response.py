"""From the values of a camera's file to the light that they show.

A value V of a file is 1 at white. A response maps V to linear light. Each channel has the same curve.

A `curve` is a correction of sRGB. Let T be the value decoded as sRGB, and g(T) the light. The contrasts s_k are the
derivative d ln g / d ln T at the knots, and are interpolated in V:

    ln g(T) = ln T + sum of (s_k - 1) B_k(T),   B_k(T) = integral of hat_k from ln `MIDDLE` to ln T

Below `DARKEST`, g is proportional to T, because files have few different values there. A gamma has the same form, with
T = V^`START_GAMMA`, a single B = ln V, and the exponent in place of s.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from reslrb_cli.config.response import KNOTS, START_GAMMA, Response

Array = np.ndarray[Any, Any]

SRGB, LINEAR = Response(encoding="srgb"), Response(encoding="linear")
#: Linear value at which a curve equals sRGB. Value of a file, and linear value, below which a curve is proportional to
#: sRGB.
MIDDLE, DARKEST_VALUE, DARKEST = 0.18, 0.04045, 0.04045 / 12.92
#: Bounds of recovered numbers. Noise would move numbers that hardly any pixel shows without limit.
LIMITS = 0.1, 30.0
#: Relative change of the light by one step of a file of integers. Values with larger steps count as clipped.
COARSE = 0.05


def decode(response: Response, encoded: Array) -> Array:
    """Return the linear light of the values of a file, an array of any shape, with the precision of the input.

    The response must not be one that is recovered.
    """
    if response.is_linear:
        return encoded
    if isinstance(response.gamma, float | int):
        wide = encoded.astype(np.float64)
        return np.asarray(np.sign(wide) * np.abs(wide) ** response.gamma, dtype=encoded.dtype)
    decoded = decode_srgb(encoded)
    if isinstance(response.curve, list):
        wide = decoded.astype(np.float64)
        correction = np.tensordot(np.array(response.curve) - 1, basis("curve", wide), 1)
        decoded = (wide * np.exp(correction)).astype(encoded.dtype)
    return decoded


def decode_srgb(encoded: Array) -> Array:
    """Return the linear values of sRGB-encoded values (IEC 61966-2-1), with the precision of the input."""
    wide = encoded.astype(np.float64)
    curve = ((np.maximum(wide, 0) + 0.055) / 1.055) ** 2.4
    return np.where(wide <= 0.04045, wide / 12.92, curve).astype(encoded.dtype)


def clipped_level(response: Response, white: int) -> int:
    """Return the smallest value of a file of integers, up to `white`, that counts as clipped.

    A film curve compresses highlights. If a step of the file changes the light by more than `COARSE`, the value says
    little about the light. Files that have large steps anyway, as sRGB would have, are not concerned.
    """
    levels = np.arange(white // 2, white + 1, dtype=np.float64)
    steps = []
    for each in (response, SRGB):
        light = decode(each, levels / white)
        steps.append(1 - light[:-1] / np.maximum(light[1:], 1e-300))
    coarse = steps[0] > np.maximum(COARSE, 2 * steps[1])
    return int(levels[1:][coarse][0]) if coarse.any() else white


# --- curves -----------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=1)
def _table() -> tuple[Array, Array]:
    """Return logarithms of decoded values (N,), in increasing order, and the B_k at them (KNOTS, N)."""
    values = np.geomspace(DARKEST_VALUE, 6.0, 4001)
    logs = np.log(decode_srgb(values))
    hats = np.array([np.interp(values, np.linspace(0, 1, KNOTS), row) for row in np.eye(KNOTS)])
    parts = 0.5 * (hats[:, 1:] + hats[:, :-1]) * np.diff(logs)
    sums = np.concatenate([np.zeros((KNOTS, 1)), np.cumsum(parts, axis=1)], axis=1)
    middle = np.array([np.interp(np.log(MIDDLE), logs, row) for row in sums])
    return logs, sums - middle[:, None]


def basis(kind: str, decoded: Array) -> Array:
    """Return the B_k (K, ...) at decoded values of any shape. `kind` is `gamma` or `curve`."""
    logs = np.log(np.maximum(decoded, DARKEST))
    if kind == "gamma":
        return np.asarray(logs[None] / START_GAMMA)
    grid, table = _table()
    return np.stack([np.interp(logs, grid, row) for row in table])


def start(kind: str) -> Array:
    """Return the numbers (K,) at which the recovery of `gamma` or `curve` starts. The correction is 0 there."""
    return np.full(1, START_GAMMA) if kind == "gamma" else np.ones(KNOTS)


def shown(kind: str, numbers: Array, light: Array) -> Array:
    """Return the decoded values T of linear light, at which g(T) is the light, for recovered numbers (K,).

    The values are those that the camera's file would have after the decoding with which the recovery starts.
    """
    logs, _ = _table()
    curve = logs + np.tensordot(np.ravel(numbers) - start(kind), basis(kind, np.exp(logs)), 1)
    wide = light.astype(np.float64)
    known = np.log(np.maximum(wide, 1e-300))
    # In proportion to the light beyond both ends.
    inside = np.clip(known, curve[0], curve[-1])
    return np.asarray(np.sign(wide) * np.exp(np.interp(inside, curve, logs) + known - inside), dtype=light.dtype)
