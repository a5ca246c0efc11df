"""Smooth gradient steps ("large steps"). The parameter is a smoothed version of the optimiser's variable, and a
Laplacian defines the smoothing.

    x = S v,   S = (1 - l^2 Δ)^-1,   dL/dv = S dL/dx            Nicolet, Jacobson and Jakob 2021, eq. 9 to 12

S is symmetric, and a step of gradient descent is S^2 dL/dx. A step therefore moves details finer than l by a smaller
amount. The reduction factor is the fourth power of the ratio of the detail's size to l. Refracting surfaces need this.
The light from refracting surfaces depends on the surface's second derivatives. The curvature of a loss therefore grows
with the fourth power of the spatial frequency. Without S, the map's finest ripple limits the step. The length l is a
fraction of the longer side, so l does not depend on the resolution.

    maps, textures      Δ by differences of neighbours, no flow through the edges: diagonal in the cosine transform
    vertices of a mesh  Δ of its graph, in units of its mean edge: a sparse LU decomposition, made once
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import scipy.fft
import scipy.sparse as sparse
import scipy.sparse.linalg as linalg
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Smoother:
    """Smoothing operator S of one parameter, and the inverse of S, on Dr.Jit arrays of the parameter's type.

    The diagonal of S^2 is each entry's response to a gradient of the entry alone. `gain` is the mean of this response
    over the entries.
    """

    gain: float

    def smooth(self, value: Any) -> Any:
        """Return S `value`, evaluated."""
        return _through(self.smoothed, value)

    def roughen(self, value: Any) -> Any:
        """Return the inverse of `smooth`."""
        return _through(self.roughened, value)

    def adjoint(self, gradient: Any) -> Any:
        """Return the gradient with respect to v, given the gradient with respect to S v."""
        return _through(self.transposed, gradient)

    def smoothed(self, value: Array) -> Array:
        """Return S `value`."""
        raise NotImplementedError

    def roughened(self, value: Array) -> Array:
        """Return the inverse of S, times `value`."""
        raise NotImplementedError

    def transposed(self, gradient: Array) -> Array:
        """Return the transpose of S, times `gradient`. S is symmetric, unless several vertices share a position."""
        return self.smoothed(gradient)


def _through(function: Callable[[Array], Array], value: Any) -> Any:
    array = np.array(dr.detach(value), dtype=np.float64)
    return type(value)(function(array).astype(np.float32))


class MapSmoother(Smoother):
    """S for textures and heightmaps (height, width, channels) with at least two texels. `length` is l."""

    def __init__(self, shape: tuple[int, ...], length: float) -> None:
        texels = length * max(shape[:2])  # l in texels, which are square
        along = [2 - 2 * np.cos(np.pi * np.arange(size) / size) for size in shape[:2]]
        self.shape = shape
        self.eigenvalues = 1 + texels**2 * (along[0][:, None] + along[1])[:, :, None]
        self.gain = float(np.mean(self.eigenvalues**-2.0))

    def smoothed(self, value: Array) -> Array:
        return self._scaled(value, 1 / self.eigenvalues)

    def roughened(self, value: Array) -> Array:
        return self._scaled(value, self.eigenvalues)

    def _scaled(self, value: Array, factors: Array) -> Array:
        spectrum = scipy.fft.dctn(value.reshape(self.shape), axes=(0, 1), norm="ortho")
        return np.asarray(scipy.fft.idctn(spectrum * factors, axes=(0, 1), norm="ortho")).reshape(value.shape)


class MeshSmoother(Smoother):
    """S for the vertex positions (3 n) of a mesh with `faces` (3 m indices), computed from the mesh's graph. `length`
    is l.

    Vertices at one position with different indices count as one vertex, for example along texture seams.
    """

    def __init__(self, positions: Array, faces: NDArray[Any], length: float) -> None:
        points = positions.reshape(-1, 3)
        _, self._one, self._sizes = np.unique(points, axis=0, return_inverse=True, return_counts=True)
        self._one = self._one.ravel()
        corners = self._one[faces.reshape(-1, 3).astype(np.int64)]
        edges = np.unique(np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])), axis=0)
        edges = edges[edges[:, 0] != edges[:, 1]]
        n = len(self._sizes)
        first = np.zeros(n, np.int64)
        first[self._one[::-1]] = np.arange(len(points))[::-1]
        ends = points[first][edges]
        mean = float(np.mean(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
        extent = float(np.max(points.max(axis=0) - points.min(axis=0)))
        rows, columns = edges.T
        joined = sparse.coo_matrix((np.ones(len(edges)), (rows, columns)), shape=(n, n))
        joined = joined + joined.T
        laplacian = sparse.diags(np.asarray(joined.sum(axis=1)).ravel()) - joined
        self._matrix = (sparse.identity(n) + (length * extent / mean) ** 2 * laplacian).tocsc()
        self._solve = linalg.splu(self._matrix)
        self.gain = self._mean_square()

    def smoothed(self, value: Array) -> Array:
        return self._spread(self._solve.solve(self._gathered(value) / self._sizes[:, None]), value)

    def transposed(self, gradient: Array) -> Array:
        """Return the gradient with respect to v. Vertices at one position receive equal shares of the position's
        gradient.
        """
        return self._spread(self._solve.solve(self._gathered(gradient)) / self._sizes[:, None], gradient)

    def roughened(self, value: Array) -> Array:
        return self._spread(self._matrix @ (self._gathered(value) / self._sizes[:, None]), value)

    def _gathered(self, value: Array) -> Array:
        """Return, for each distinct position, the sum of the values over all vertices at the position."""
        total = np.zeros((len(self._sizes), 3))
        np.add.at(total, self._one, value.reshape(-1, 3))
        return total

    def _spread(self, value: Any, like: Array) -> Array:
        return np.asarray(value[self._one]).reshape(like.shape)

    def _mean_square(self) -> float:
        """Return the mean of the diagonal of S^2, estimated from 8 fixed sign vectors (Hutchinson)."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(self._sizes), 8))
        return float(np.mean(self._solve.solve(signs) ** 2))


def make_smoother(value: NDArray[Any], faces: NDArray[Any] | None, length: float) -> Smoother:
    """Return S for a map (height, width, channels), or for vertex positions (3 n) of a mesh with `faces`."""
    return MapSmoother(value.shape, length) if faces is None else MeshSmoother(value, faces, length)
