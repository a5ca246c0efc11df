"""Regularizers: costs of a parameter's value, and their gradients, in double precision.

Regularizers are integrals over the surface, in the scene's unit. Integrals hardly depend on the resolution. A map h (H,
W, C) has texels of dx by dy. The map's mesh covers a range of texture coordinates, independent of the texels.
Differences are taken between neighbouring texels. The integration weights sum to the whole surface.

    curvature        k = Hm + sqrt(Hm² - K) in the inner texels, by central differences; positive in hollows
                     2 Hm = ((1 + hy²) hxx - 2 hx hy hxy + (1 + hx²) hyy) / w³,  K = (hxx hyy - hxy²) / w⁴,
                     w² = 1 + hx² + hy²     (do Carmo, Differential Geometry of Curves and Surfaces, 3.3)
    total variation  the mean over the four pairs of differences (hx below or above, hy left or right) between four
                     texels, so that no chequerboard is overlooked
    thickness        thickness + h
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.config.parameters import Curvature, Regularizer, Thickness, TotalVariation

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
    if isinstance(regularizer, Curvature):
        function = _hollows(1 / regularizer.radius, spans)
    elif isinstance(regularizer, TotalVariation):
        function = _variation(regularizer.epsilon, spans)
    elif isinstance(regularizer, Thickness):
        function = _thin(regularizer.least - regularizer.thickness, spans)
    else:
        raise TypeError(f"{regularizer.type} is not a cost of a map")
    return _weighed(function, regularizer.weight)


def _weighed(cost: Cost, weight: float) -> Cost:
    def weighed(value: Array) -> tuple[float, Array]:
        total, gradient = cost(np.asarray(value, np.float64))
        return weight * total, weight * gradient

    return weighed


def _hinge(value: Array, limit: float) -> tuple[Array, Array]:
    over = np.maximum(value - limit, 0)
    return over**2, 2 * over


def _thin(lowest: float, spans: Spans) -> Cost:
    def cost(h: Array) -> tuple[float, Array]:
        area = _area(spans, h.shape, 0.5)
        value, slope = _hinge(-h, -lowest)
        return float(np.sum(area * value)), -area * slope

    return cost


def _area(spans: Spans, shape: tuple[int, ...], first: float) -> Array:
    """Return the area of each node of a map with shape `shape`, as (h, w, 1). The first node is `first` texels from the
    edge.
    """
    wide, high = (span.weights(n, first, n - first) for span, n in zip(spans, (shape[1], shape[0]), strict=True))
    return np.asarray(high[:, None, None] * wide[None, :, None])


def _variation(epsilon: float, spans: Spans) -> Cost:
    """Return the integral of sqrt(g² + epsilon²) - epsilon, where g is the gradient's norm over all channels."""

    def cost(h: Array) -> tuple[float, Array]:
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

    return cost


#: Central differences about a texel: neighbours (row, column), their coefficients, and the powers of dx and dy.
_STENCILS: tuple[tuple[dict[tuple[int, int], float], int, int], ...] = (
    ({(0, 1): 0.5, (0, -1): -0.5}, 1, 0),
    ({(1, 0): 0.5, (-1, 0): -0.5}, 0, 1),
    ({(0, 1): 1.0, (0, 0): -2.0, (0, -1): 1.0}, 2, 0),
    ({(1, 1): 0.25, (-1, -1): 0.25, (1, -1): -0.25, (-1, 1): -0.25}, 1, 1),
    ({(1, 0): 1.0, (0, 0): -2.0, (-1, 0): 1.0}, 0, 2),
)


def _hollows(limit: float, spans: Spans) -> Cost:
    """Return the integral of max(0, k - limit)² over the inner texels of a map."""

    def cost(h: Array) -> tuple[float, Array]:
        gradient = np.zeros_like(h)
        if min(h.shape[:2]) < 3:
            return 0.0, gradient
        dx, dy = spans[0].pitch(h.shape[1]), spans[1].pitch(h.shape[0])
        area = _area(spans, h.shape, 1.5)

        def at(place: tuple[int, int]) -> tuple[slice, slice]:
            (y, x), (rows, columns) = place, (h.shape[0] - 2, h.shape[1] - 2)
            return slice(1 + y, 1 + y + rows), slice(1 + x, 1 + x + columns)

        units = [dx**i * dy**j for _, i, j in _STENCILS]
        derivatives = [
            sum(c * h[at(place)] for place, c in stencil.items()) / unit
            for (stencil, _, _), unit in zip(_STENCILS, units, strict=True)
        ]
        value, slopes = _hollow(derivatives, limit)  # type: ignore[arg-type]  # sums of arrays, none of them empty
        for (stencil, _, _), unit, slope in zip(_STENCILS, units, slopes, strict=True):
            for place, c in stencil.items():
                gradient[at(place)] += (c / unit) * area * slope
        return float(np.sum(area * value)), gradient

    return cost


def _hollow(d: list[Array], limit: float) -> tuple[Array, list[Array]]:
    """Return max(0, k - limit)² and its derivatives with respect to hx, hy, hxx, hxy and hyy."""
    hx, hy, hxx, hxy, hyy = d
    w = np.sqrt(1 + hx**2 + hy**2)
    sum_ = (1 + hy**2) * hxx - 2 * hx * hy * hxy + (1 + hx**2) * hyy
    det = hxx * hyy - hxy**2
    mean, gauss = sum_ / (2 * w**3), det / w**4
    root = np.sqrt(np.maximum(mean**2 - gauss, 0))
    value, over = _hinge(mean + root, limit)
    # At an umbilic k has a kink: there its derivative is that of the mean.
    steep = np.where(root > 1e-12 * np.abs(mean), 1 / np.maximum(root, 1e-300), 0.0)
    by_mean, by_gauss = over * (1 + mean * steep), -over * steep / 2

    def through(by_sum: Array | float, by_det: Array | float, by_w: Array | float) -> Array:
        change = by_sum / (2 * w**3) - 3 * mean / w * by_w
        return np.asarray(by_mean * change + by_gauss * (by_det / w**4 - 4 * gauss / w * by_w))

    return value, [
        through(2 * (hx * hyy - hy * hxy), 0, hx / w),
        through(2 * (hy * hxx - hx * hxy), 0, hy / w),
        through(1 + hy**2, hyy, 0),
        through(-2 * hx * hy, -2 * hxy, 0),
        through(1 + hx**2, hxx, 0),
    ]


def spans_of(positions: Array, texcoords: Array) -> Spans:
    """Return the axes of a map over a mesh with vertex `positions` (N, 3) and texture coordinates `texcoords` (N, 2).

    The best affine map from texture coordinates to positions defines the unit of each axis.
    """
    matrix = np.column_stack([texcoords, np.ones(len(texcoords))]).astype(np.float64)
    slopes = np.linalg.lstsq(matrix, positions.astype(np.float64), rcond=None)[0]
    low, high = np.clip(texcoords.min(axis=0), 0, 1), np.clip(texcoords.max(axis=0), 0, 1)
    x, y = (Span(float(np.linalg.norm(slopes[k])), float(low[k]), float(high[k])) for k in range(2))
    return x, y
