"""Regularizers: costs of a parameter's value, and their gradients, in double precision.

Regularizers are integrals over the surface, in the scene's unit. Integrals hardly depend on the resolution. A map h (H,
W, C) has texels of dx by dy. The map's mesh covers a range of texture coordinates, independent of the texels.
Differences are taken between neighbouring texels. The integration weights sum to the whole surface.

    total variation  the mean over the four pairs of differences (hx below or above, hy left or right) between four
                     texels, so that no chequerboard is overlooked
    thickness        thickness + h
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.config.parameters import Regularizer, Thickness, TotalVariation

Array = np.ndarray[Any, Any]

#: Takes a parameter's value as an array; returns the cost and its derivative, of the same shape.
Cost = Callable[[Array], tuple[float, Array]]


@dataclass(frozen=True)
class Span:
    """One axis of a map: the length per unit of texture coordinate, and the surface's coordinate range."""

    unit: float = 1.0
    low: float = 0.0
    high: float = 1.0

    def pitch(self, count: int) -> float:
        """Return the distance between neighbouring texels on an axis with `count` texels."""
        return self.unit / count

    def weights(self, count: int, first: float, last: float) -> Array:
        """Return the length that each node represents. The nodes lie at first, first + 1, ..., last, in texels, on an
        axis with `count` texels.

        Two neighbouring nodes share their distance evenly. The outermost nodes also get the length up to the surface's
        ends. The sum is the length of the surface.
        """
        nodes = np.arange(first, last + 0.5) / count
        middles = (nodes[:-1] + nodes[1:]) / 2
        ends = np.clip(np.concatenate([[-np.inf], middles, [np.inf]]), self.low, self.high)
        return np.asarray(np.diff(ends) * self.unit)


#: The axes x and y of a map.
Spans = tuple[Span, Span]


def make_cost(regularizer: Regularizer, spans: Spans) -> Cost:
    """Return the cost of a map (H, W, C): `weight` times the integral. Raises TypeError for a regularizer that does not
    apply to maps.
    """
    if not isinstance(regularizer, Thickness | TotalVariation):
        raise TypeError(f"{regularizer.type} is not a cost of a map")

    def cost(value: Array) -> tuple[float, Array]:
        h = np.asarray(value, np.float64)
        if isinstance(regularizer, Thickness):
            total, gradient = _thin(h, regularizer.least - regularizer.thickness, spans)
        else:
            total, gradient = _variation(h, regularizer.epsilon, spans)
        return regularizer.weight * total, regularizer.weight * gradient

    return cost


def _thin(h: Array, lowest: float, spans: Spans) -> tuple[float, Array]:
    """Return the integral of max(0, lowest - h)², and its derivative."""
    area, lacking = _area(spans, h.shape, 0.5), np.maximum(lowest - h, 0)
    return float(np.sum(area * lacking**2)), -area * (2 * lacking)


def _area(spans: Spans, shape: tuple[int, ...], first: float) -> Array:
    """Return the area of each node of a map with shape `shape`, as (h, w, 1). The first node is `first` texels from the
    edge.
    """
    wide, high = (span.weights(n, first, n - first) for span, n in zip(spans, (shape[1], shape[0]), strict=True))
    return np.asarray(high[:, None, None] * wide[None, :, None])


def _variation(h: Array, epsilon: float, spans: Spans) -> tuple[float, Array]:
    """Return the integral of sqrt(g² + epsilon²) - epsilon, where g is the gradient's norm over all channels. Also
    return its derivative.
    """
    dx, dy = spans[0].pitch(h.shape[1]), spans[1].pitch(h.shape[0])
    area, total, gradient = _area(spans, h.shape, 1.0) / 4, 0.0, np.zeros_like(h)
    across, along = np.diff(h, axis=1) / dx, np.diff(h, axis=0) / dy
    for row in (0, 1):
        for column in (0, 1):
            rows, columns = slice(row, row + len(along)), slice(column, column + across.shape[1])
            gx, gy = across[rows], along[:, columns]
            norm = np.sqrt(np.sum(gx**2 + gy**2, axis=2, keepdims=True))
            root = np.sqrt(norm**2 + epsilon**2)
            total += float(np.sum(area * (norm**2 / (root + epsilon))))
            share = area * (norm / root) / np.maximum(norm, 1e-300)
            back_x, back_y = share * gx / dx, share * gy / dy
            gradient[rows, 1:] += back_x
            gradient[rows, :-1] -= back_x
            gradient[1:, columns] += back_y
            gradient[:-1, columns] -= back_y
    return total, gradient


def spans_of(positions: Array, texcoords: Array) -> Spans:
    """Return the axes of a map over a mesh with vertex `positions` (N, 3) and texture coordinates `texcoords` (N, 2).

    The best affine map from texture coordinates to positions defines the unit of each axis.
    """
    matrix = np.column_stack([texcoords, np.ones(len(texcoords))]).astype(np.float64)
    slopes = np.linalg.lstsq(matrix, positions.astype(np.float64), rcond=None)[0]
    low, high = np.clip(texcoords.min(axis=0), 0, 1), np.clip(texcoords.max(axis=0), 0, 1)
    x, y = (Span(float(np.linalg.norm(slopes[k])), float(low[k]), float(high[k])) for k in range(2))
    return x, y
