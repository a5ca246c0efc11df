"""Optimal transport of light from an aperture to a picture: the Monge-Ampere equation, solved on a grid by Newton's
method.

The unknown is a potential h at the centres of a grid's cells. An `Optics` maps a point of the aperture, with h and its
gradient g, to the picture: T(x, h, g). The following equation conserves light.

    nu(T(x)) det DT(x) = mu(x),                                                                                     (1)

mu is the light that arrives on the aperture, and nu the picture, with equal totals. The aperture's edges are mapped to
the picture's edges. For T = g this is optimal transport with squared distance (Brenier). With T from Snell's law, the
potential h is the surface height. No integration is needed afterwards (`surface.py`). The logarithm of (1) is solved on
grids from coarse to fine. Each Newton step uses GMRES, preconditioned by the Laplacian, which SciPy's cosine transform
inverts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.sparse.linalg as linalg
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Cells along the shorter side of the first grid.
COARSEST = 16
#: Steps on a grid, and the root mean square of (1)'s logarithm at which the grid is left.
STEPS, TOLERANCE = 12, 2e-3
#: Accepted residual of a solution, and the blur of the picture (pixels) if the sharp picture has no solution.
GOOD, BLURS = 0.05, (4.0, 2.0, 1.0, 0.5, 0.0)
#: Exponents of picture and light before the full ones, on the first grid.
CONTRASTS = (0.2, 0.4, 0.6, 0.8)
#: Light outside an aperture that does not fill its rectangle, as a fraction of the maximum inside.
DIM = 0.01
#: Number of cells over which it fades.
FADE = 0.7


class Optics(Protocol):
    """The map of light. Coordinates on the aperture and on the picture are relative to their respective centres."""

    def hit(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        """Return T (2, ...) of points (x, y) with potential h and gradient (gx, gy). T is NaN if light does not reach
        the picture.
        """

    def arriving(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        """Return mu (...), the light that arrives per area of the aperture, in any unit. It is 0 outside of the
        aperture.
        """


@dataclass
class Transport:
    """A solution of (1).

    - `h` (ny, nx) is the potential. `slopes` are the derivatives of `h` along the axes at the edges (left, right,
        bottom, top).
    - `T` (2, ny, nx) has the points of the picture to which T maps the cells' centres. `light` (ny, nx) is mu, with
        mean 1.
    - `residual` is the root mean square residual of the logarithm of (1). The mean is weighted by the light.
    - `converged` is true if the residual became small. The picture may have been blurred by a few pixels for this.
    - `pushed` is the picture that T makes, with mean 1. `error` is sum |pushed - nu| / sum nu, over the picture's
        pixels or larger cells.
    - `folded` is the share of cells that T turns over. `stretch` is the largest factor by which T lengthens a segment,
        relative to the even map.
    - `steps` is the number of Newton steps on all grids.
    """

    h: Array
    slopes: list[Array]
    size: tuple[float, float]
    T: Array
    light: Array
    residual: float
    converged: bool
    error: float = np.nan
    folded: float = 0.0
    stretch: float = 1.0
    pushed: Array = field(default_factory=lambda: np.empty(0))
    steps: int = 0


def sample(values: Array, size: tuple[float, float], x: Array, y: Array) -> Array:
    """Interpolate `values` (ny, nx) linearly at points (x, y). The values are at the cell centres of a rectangle with
    the given `size`, centred at 0.
    """
    ny, nx = values.shape
    places = np.stack([(y / size[1] + 0.5) * ny - 0.5, (x / size[0] + 0.5) * nx - 0.5])
    return scipy.ndimage.map_coordinates(values, places, order=1, mode="nearest")


def resized(values: NDArray[Any], shape: tuple[int, int], between: bool = False) -> NDArray[Any]:
    """Return `values` (ny, nx, ...) resampled to another number of rows and columns, within the range of the old
    values.

    Each new cell is the mean over its area, so the sum times the cell's area is preserved. With `between`, an axis that
    gains cells is interpolated linearly between the centres of the old cells.
    """
    for axis, (old, new) in enumerate(zip(values.shape, shape)):  # noqa: B905  # `values` may have channels as well
        if old != new:
            part = _shares(old, new, between and new > old).astype(np.result_type(values, np.float32))
            values = np.moveaxis(np.tensordot(part, values, (1, axis)), 0, axis)
    return values


def _shares(old: int, new: int, between: bool) -> Array:
    """Return weights (new, old) along one axis. A weight is the share of an old cell in a new cell. Rows sum to 1."""
    if between:
        at = np.clip((np.arange(new) + 0.5) * (old / new) - 0.5, 0, old - 1)
        return np.asarray(np.maximum(1 - np.abs(at[:, None] - np.arange(old)), 0))
    edges = np.arange(new + 1) * (old / new)
    low = np.maximum(edges[:-1, None], np.arange(old))
    shares = np.maximum(np.minimum(edges[1:, None], np.arange(1, old + 1)) - low, 0)
    # Rounding leaves slivers, through which a clipped or infinite cell would reach cells without overlap.
    shares[shares < 1e-6] = 0
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


def _shrunk(picture: Array, part: float) -> Array:
    """Return `picture` reduced to `part` of its rows and columns. If `part` is larger than 1, the function returns
    `picture` unchanged.
    """
    ny, nx = picture.shape
    return picture if part >= 1 else resized(picture, (max(2, round(ny * part)), max(2, round(nx * part))))


def grid(shape: tuple[int, int], size: tuple[float, float]) -> tuple[Array, Array]:
    """Return x and y (ny, nx) of the centres of a rectangle's cells. Row 0 has the least y."""
    ny, nx = shape
    x = ((np.arange(nx) + 0.5) / nx - 0.5) * size[0]
    y = ((np.arange(ny) + 0.5) / ny - 0.5) * size[1]
    xs, ys = np.meshgrid(x, y)
    return xs, ys


def solve(
    optics: Optics,
    picture: Array,
    size: tuple[float, float],
    target: tuple[float, float],
    shape: tuple[int, int],
    start: Array,
    tell: Callable[[str], None] = lambda stage: None,
    sharp: bool = False,
) -> Transport:
    """Solve (1) from the coarsest grid up to `shape`.

    - `picture` (my, mx) is nu, with positive values and row 0 at the least y. The picture covers a rectangle of size
        `target` (width, height), centred at 0.
    - `size` is the size of the aperture.
    - `start` (6,) is the polynomial c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2. It maps the aperture approximately
        evenly to the picture.
    - `tell` receives the name of each stage.

    If the solver finds no solution for a sharp picture, it starts with a blurred picture. If `sharp` is true, and the
    grid before the last one has a solution only for a blurred picture, the function returns that solution, which has
    not converged. The last grid has finer lines and takes most of the time.
    """
    levels = [shape]
    while min(levels[-1]) >= 2 * COARSEST:
        levels.append((-(-levels[-1][0] // 2), -(-levels[-1][1] // 2)))
    state: _State | None = None
    for n in reversed(levels):
        tell(f"grid of {n[1]}x{n[0]}")
        state = _State(*_even(start, n, size), size, start) if state is None else _finer(state, n)
        nu = _shrunk(picture, max(n[0] / picture.shape[0], n[1] / picture.shape[1]))
        nu = nu / nu.mean()
        if n == levels[-1]:  # from uniform light to the picture's contrasts
            for contrast in CONTRASTS:
                _newton(state, optics, nu, target, contrast)
        before = _copied(state)
        _newton(state, optics, nu, target)
        blurred = False
        if state.residual > GOOD:  # steps end at the picture's edges, so start with a picture without edges
            steps, state = state.steps, before
            for width in BLURS:
                trial = _copied(state)
                _newton(trial, optics, nu, target, blur=width)
                blurred = trial.residual > GOOD and state.residual < GOOD
                if blurred:
                    break
                state = trial
            state.steps += steps
        if sharp and blurred and n in levels[1:2]:  # small pictures have one grid
            break
    assert state is not None
    made = _told(state, optics, picture / picture.mean(), target)
    made.converged = made.converged and made.h.shape == shape
    return made


# ---- one grid


@dataclass
class _State:
    """Potential h on a grid, with its slopes at the edges and data for Newton steps."""

    h: Array
    slopes: list[Array]
    size: tuple[float, float]
    start: Array
    residual: float = np.inf
    steps: int = 0

    @property
    def cell(self) -> tuple[float, float]:
        return self.size[0] / self.h.shape[1], self.size[1] / self.h.shape[0]


def _padded(h: Array, slopes: list[Array], cell: tuple[float, float]) -> Array:
    """Return h (ny + 2, nx + 2) with an added ring of cells. The ring makes the derivatives at the edges equal to
    `slopes`.
    """
    left, right, bottom, top = slopes
    wide = np.concatenate([(h[:, 0] - left * cell[0])[:, None], h, (h[:, -1] + right * cell[0])[:, None]], axis=1)
    bottom, top = np.pad(bottom, 1, mode="edge"), np.pad(top, 1, mode="edge")
    return np.concatenate([(wide[0] - bottom * cell[1])[None], wide, (wide[-1] + top * cell[1])[None]], axis=0)


def _faces(p: Array, cell: tuple[float, float]) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Return (h, gx, gy) from a padded h, at the faces across x (ny, nx + 1) and at the faces across y (ny + 1, nx)."""
    row, column = p[1:-1], p[:, 1:-1]
    across_x, across_y = _slopes(p, cell)
    return ((row[:, 1:] + row[:, :-1]) / 2, *across_x), ((column[1:] + column[:-1]) / 2, *across_y)


def _slopes(p: Array, cell: tuple[float, float]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return (gx, gy) from a padded h, at the faces across x (ny, nx + 1) and at the faces across y (ny + 1, nx)."""
    dx, dy = cell
    row, column = p[1:-1], p[:, 1:-1]
    along_y, along_x = p[2:] - p[:-2], p[:, 2:] - p[:, :-2]
    return (
        ((row[:, 1:] - row[:, :-1]) / dx, (along_y[:, 1:] + along_y[:, :-1]) / (4 * dy)),
        ((along_x[1:] + along_x[:-1]) / (4 * dx), (column[1:] - column[:-1]) / dy),
    )


def _face_places(shape: tuple[int, int], size: tuple[float, float]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    ny, nx = shape
    x, y = grid(shape, size)
    xe, ye = np.linspace(-0.5, 0.5, nx + 1) * size[0], np.linspace(-0.5, 0.5, ny + 1) * size[1]
    return tuple(np.meshgrid(xe, y[:, 0])), tuple(np.meshgrid(x[0], ye))  # type: ignore[return-value]


def _derivative(optics: Optics, place: tuple[Array, Array], at: tuple[Array, Array, Array], T: Array) -> Array:
    """Return B (2, 2, ...), the derivative dT / dg by differences. B[a, b] is the derivative of T's component a with
    respect to g's component b.
    """
    h, gx, gy = at
    e = 1e-6
    return np.stack([optics.hit(*place, h, gx + e, gy) - T, optics.hit(*place, h, gx, gy + e) - T], axis=1) / e


class _Equation:
    """Equation (1) at one h: its residual, and its directional derivatives."""

    def __init__(
        self,
        state: _State,
        optics: Optics,
        nu: Array,
        target: tuple[float, float],
        contrast: float = 1.0,
        blur: float = 0.0,
    ) -> None:
        self.cell, self.optics, self.places = state.cell, optics, _face_places(state.h.shape, state.size)
        self.at = _faces(_padded(state.h, state.slopes, self.cell), self.cell)
        self.T = [optics.hit(*place, *at) for place, at in zip(self.places, self.at, strict=True)]
        self.D = self._differences(self.T)
        self.det = self.D[0, 0] * self.D[1, 1] - self.D[0, 1] * self.D[1, 0]
        self.center = self._center(self.T)
        x, y = grid(state.h.shape, state.size)
        gx = (self.at[0][1][:, 1:] + self.at[0][1][:, :-1]) / 2
        gy = (self.at[1][2][1:] + self.at[1][2][:-1]) / 2
        mu = optics.arriving(x, y, state.h, gx, gy)
        mu = _dim(mu, FADE + blur, DIM * (1 + 2 * blur))
        mu = mu**contrast
        self.mu = mu / mu.mean()
        self.fits = bool(np.all(self.det > 0) and np.all(self.D[0, 0] > 0) and np.all(np.isfinite(self.mu)))
        self.nu, self.target = (
            (scipy.ndimage.gaussian_filter(nu, blur, mode="nearest") if blur else nu) ** contrast,
            target,
        )
        if self.fits:
            even = (target[0] / state.size[0]) * (target[1] / state.size[1])
            self.seen = self._over_cells(self.nu, target)
            self.F = np.log(self.det / even * self.seen / self.mu)
            self.F -= np.mean(self.mu * self.F)
            self.merit = float(np.sqrt(np.mean(self.mu * self.F**2)))
        else:
            self.merit = np.inf

    def _differences(self, T: list[Array]) -> Array:
        return np.stack([np.diff(T[0], axis=2) / self.cell[0], np.diff(T[1], axis=1) / self.cell[1]], axis=1)

    def _center(self, T: list[Array]) -> Array:
        return (T[0][:, :, 1:] + T[0][:, :, :-1] + T[1][:, 1:] + T[1][:, :-1]) / 4

    def _over_cells(self, values: Array, size: tuple[float, float]) -> Array:
        """Return the mean of `values` (`sample`) over each cell's image under T, computed from four points."""
        total = np.zeros(self.det.shape)
        for a in (-0.25, 0.25):
            for b in (-0.25, 0.25):
                u, v = self.center + self.D[:, 0] * (a * self.cell[0]) + self.D[:, 1] * (b * self.cell[1])
                total += sample(values, size, u, v)
        return total / 4

    def linearize(self) -> None:
        """Prepare `along` and `step`."""
        self.B = [_derivative(self.optics, *of) for of in zip(self.places, self.at, self.T, strict=True)]
        inverse = (
            np.stack([np.stack([self.D[1, 1], -self.D[0, 1]]), np.stack([-self.D[1, 0], self.D[0, 0]])]) / self.det
        )
        middle = (self.B[0][..., 1:] + self.B[0][..., :-1]) / 2
        A = np.einsum("ab...,bc...->ac...", inverse, middle)  # (1) is A : D^2 v plus terms of lower order
        scale = 2 / (A[0, 0] + A[1, 1])
        self.scale, self.inverse = scale, inverse * scale
        self.weights = float(np.mean(A[0, 0] * scale)), float(np.mean(A[1, 1] * scale))
        ny, nx = self.nu.shape
        dx, dy = self.target[0] / nx, self.target[1] / ny
        wide, high = np.pad(self.nu, ((0, 0), (1, 1)), mode="edge"), np.pad(self.nu, ((1, 1), (0, 0)), mode="edge")
        self.slope = scale / self.seen * np.stack([  # from pixel to pixel, linear between the pixels' edges
            self._over_cells(np.diff(wide, axis=1) / dx, (self.target[0] + dx, self.target[1])),
            self._over_cells(np.diff(high, axis=0) / dy, (self.target[0], self.target[1] + dy)),
        ])  # fmt: skip

    def along(self, v: Array) -> Array:
        """Return the derivative of (1)'s logarithm along v (ny, nx), times `scale`. v has slopes of 0 at the edges."""
        p = np.pad(v, 1, mode="edge")
        (across_x, across_y), (dx, dy) = _slopes(p, self.cell), self.cell
        result = np.zeros_like(v)
        for a in (0, 1):  # the component of dT
            x, y = (B[a, 0] * gx + B[a, 1] * gy for B, (gx, gy) in zip(self.B, (across_x, across_y), strict=True))
            left, right, bottom, top = x[:, :-1], x[:, 1:], y[:-1], y[1:]
            result += self.inverse[0, a] / dx * (right - left) + self.inverse[1, a] / dy * (top - bottom)
            result += self.slope[a] / 4 * (left + right + bottom + top)
        return result

    def step(self, accuracy: float) -> Array:
        """Return the Newton step v (ny, nx)."""
        shape = self.F.shape
        ky, kx = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in shape)
        symbol = self.weights[0] * kx[None] / self.cell[0] ** 2 + self.weights[1] * ky[:, None] / self.cell[1] ** 2
        symbol[0, 0] = 1.0

        def potential(w: Array) -> Array:
            spectrum = -scipy.fft.dctn(w, norm="ortho", workers=-1) / symbol
            spectrum[0, 0] = 0
            return scipy.fft.idctn(spectrum, norm="ortho", workers=-1)

        def apply(w: Array) -> Array:  # (1)'s logarithm is known up to a constant, which is the mean of w
            w = w.reshape(shape)
            return (self.along(potential(w)) + self.scale * w.mean()).ravel()

        operator = linalg.LinearOperator((self.F.size, self.F.size), matvec=apply, dtype=np.float64)
        w, _ = linalg.gmres(operator, -(self.F * self.scale).ravel(), rtol=accuracy, restart=40, maxiter=2)
        return potential(w.reshape(shape))


def _dim(mu: Array, fade: float, dim: float) -> Array:
    """Return mu (ny, nx) with some light added outside of the aperture. The added light decreases with the distance
    from the aperture in cells. T is then determined there, too.
    """
    lit = mu > 0
    if lit.all():
        return mu
    away, nearest = scipy.ndimage.distance_transform_edt(~lit, return_indices=True)
    return np.where(lit, mu, mu[tuple(nearest)] * np.maximum(dim, np.exp(-away / fade)))


def _at_edges(state: _State, optics: Optics, target: tuple[float, float]) -> None:
    """Set the slopes at the edges so that light there goes to the picture's edges."""
    for _ in range(3):
        p = _padded(state.h, state.slopes, state.cell)
        for axis, place in enumerate(_face_places(state.h.shape, state.size)):
            for side, index in enumerate((0, -1)):
                cut = (slice(None), index) if axis == 0 else (index, slice(None))
                near = p[tuple(slice(None) if k is not index else slice(-3, None) if side else slice(3) for k in cut)]
                of = _faces(near, state.cell)[axis]
                edge_place, edge = (place[0][cut], place[1][cut]), (of[0][cut], of[1][cut], of[2][cut])
                T = optics.hit(*edge_place, *edge)
                B = _derivative(optics, edge_place, edge, T)
                change = ((side - 0.5) * target[axis] - T[axis]) / B[axis, axis]
                state.slopes[2 * axis + side] = state.slopes[2 * axis + side] + np.nan_to_num(change)


def _newton(
    state: _State,
    optics: Optics,
    nu: Array,
    target: tuple[float, float],
    contrast: float = 1.0,
    blur: float = 0.0,
) -> None:
    """Take at most `STEPS` Newton steps on one grid. The length of each step is chosen so that the residual falls."""
    equation = _started(state, optics, nu, target, contrast, blur)
    for _ in range(STEPS):
        if not equation.fits or equation.merit < TOLERANCE:
            break
        equation.linearize()
        v = equation.step(min(0.03, max(0.003, equation.merit / 30)))
        length = 1.0
        while length > 1 / 32:
            trial = _State(state.h + length * v, list(state.slopes), state.size, state.start)
            _at_edges(trial, optics, target)
            next_equation = _Equation(trial, optics, nu, target, contrast, blur)
            if next_equation.merit < (1 - 0.1 * length) * equation.merit:
                break
            length /= 2
        else:
            break
        state.h, state.slopes, equation = trial.h, trial.slopes, next_equation
        state.steps += 1
    state.residual = equation.merit


def _started(
    state: _State, optics: Optics, nu: Array, target: tuple[float, float], contrast: float, blur: float
) -> _Equation:
    """Return the equation at a state without folds. First, the function smooths the state and mixes it with the even
    map until T folds nowhere.

    Convex functions stay convex under smoothing and mixing. The even map moves points away from the edges.
    """
    h, slopes = state.h, list(state.slopes)
    even, even_slopes = _even(state.start, state.h.shape, state.size)
    for width, part in ((0.0, 0.0), (0.5, 0.0), (1.0, 0.02), (2.0, 0.05), (4.0, 0.2), (4.0, 0.5), (0.0, 1.0)):
        if width or part:
            ring = int(4 * width) + 1
            p = np.pad(_padded(h, slopes, state.cell), ring - 1, mode="reflect", reflect_type="odd")
            smooth = scipy.ndimage.gaussian_filter(p, width)[ring:-ring, ring:-ring]
            state.h = (1 - part) * smooth + part * (even + np.mean(smooth - even))
            state.slopes = [(1 - part) * a + part * b for a, b in zip(slopes, even_slopes, strict=True)]
        _at_edges(state, optics, target)
        equation = _Equation(state, optics, nu, target, contrast, blur)
        if equation.fits:
            break
    return equation


def _even(start: Array, shape: tuple[int, int], size: tuple[float, float]) -> tuple[Array, list[Array]]:
    """Return h and slopes of the polynomial from which `solve` starts."""
    x, y = grid(shape, size)
    h = start[0] + start[1] * x + start[2] * y + start[3] * x * x + start[4] * x * y + start[5] * y * y
    hx, hy = start[1] + 2 * start[3] * x + start[4] * y, start[2] + start[4] * x + 2 * start[5] * y
    half = (start[3] * size[0] / shape[1], start[5] * size[1] / shape[0])  # from the last centres to the edges
    return h, [hx[:, 0] - half[0], hx[:, -1] + half[0], hy[0] - half[1], hy[-1] + half[1]]


def _copied(state: _State) -> _State:
    return replace(state, slopes=list(state.slopes))


def _finer(state: _State, shape: tuple[int, int]) -> _State:
    """Return the state on a finer grid, by cubic splines, including the slopes at the edges."""
    ring = 8  # for splines, which reach over a few cells
    p = np.pad(_padded(state.h, state.slopes, state.cell), ring, mode="reflect", reflect_type="odd")
    ny, nx = state.h.shape
    places = np.meshgrid(
        (np.arange(shape[0]) + 0.5) * ny / shape[0] + 0.5 + ring,
        (np.arange(shape[1]) + 0.5) * nx / shape[1] + 0.5 + ring,
        indexing="ij",
    )
    h = scipy.ndimage.map_coordinates(p, places, order=3, mode="nearest")
    slopes = []
    for index, old in enumerate(state.slopes):
        n = shape[0] if index < 2 else shape[1]
        slopes.append(np.interp((np.arange(n) + 0.5) / n, (np.arange(old.size) + 0.5) / old.size, old))
    return replace(state, h=h, slopes=slopes, residual=np.inf)


def _told(state: _State, optics: Optics, picture: Array, target: tuple[float, float]) -> Transport:
    equation = _Equation(state, optics, picture, target)
    result = Transport(
        state.h, state.slopes, state.size, equation.center, equation.mu, equation.merit,
        equation.fits and state.residual < GOOD, steps=state.steps,
    )  # fmt: skip
    lit = equation.mu > 2 * DIM * equation.mu.max()
    D = equation.D * np.array([state.size[0] / target[0], state.size[1] / target[1]])[:, None, None, None]
    result.folded = float(np.mean((equation.det <= 0)[lit]))
    ways = np.moveaxis(D, (0, 1), (-2, -1))[lit]
    seen = bool(np.all(np.isfinite(ways)))  # otherwise light is totally reflected or misses the receiver
    result.stretch = float(np.max(np.linalg.norm(ways, 2, axis=(-2, -1)))) if seen else np.inf
    coarse = (min(picture.shape[0], state.h.shape[0]), min(picture.shape[1], state.h.shape[1]))
    picture = resized(picture, coarse)
    result.pushed = pushed(equation.center, equation.mu * lit, coarse, target)
    result.error = float(np.abs(result.pushed - through_tent(picture)).mean())
    return result


def pushed(T: Array, light: Array, shape: tuple[int, int], target: tuple[float, float], fine: int = 4) -> Array:
    """Return the picture that T makes of the light. The picture has the given `shape` and mean 1, and is filtered by a
    tent.

    `light` (ny, nx) arrives at T (2, ny, nx). Each cell sends `fine`^2 equal shares of light. T is linear between the
    cell centres. Each share of light is split over the four nearest pixels.
    """
    ny, nx = light.shape
    at = np.meshgrid(
        (np.arange(ny * fine) + 0.5) / fine - 0.5, (np.arange(nx * fine) + 0.5) / fine - 0.5, indexing="ij"
    )
    reach = [np.pad(t, 1, mode="reflect", reflect_type="odd") for t in T]
    u, v = (scipy.ndimage.map_coordinates(t, [a + 1 for a in at], order=1) for t in reach)
    share = np.repeat(np.repeat(light, fine, 0), fine, 1)
    return splat((u / target[0] + 0.5) * shape[1], (v / target[1] + 0.5) * shape[0], share, shape)


def splat(column: Array, row: Array, share: Array, shape: tuple[int, int]) -> Array:
    """Add shares of light at positions in pixels, each to the four nearest pixels. Shares outside of the picture are
    lost.

    At an edge of the picture, the outer part of the tent is folded back inside, as in `through_tent`. If nothing is
    lost, the mean is 1.
    """
    result = np.zeros(shape)
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    total = share.sum()
    column, row, share = column[inside] - 0.5, row[inside] - 0.5, share[inside]
    i, j = np.floor(column).astype(int), np.floor(row).astype(int)
    a, b = column - i, row - j
    for di, wi in ((0, 1 - a), (1, a)):
        for dj, wj in ((0, 1 - b), (1, b)):
            index = np.clip(j + dj, 0, shape[0] - 1) * shape[1] + np.clip(i + di, 0, shape[1] - 1)
            result += np.bincount(index, wi * wj * share, shape[0] * shape[1]).reshape(shape)
    return result * (result.size / total)


def through_tent(picture: Array) -> Array:
    """Return the result of `splat` for light that is constant over each pixel of `picture`."""
    for axis in (0, 1):
        picture = scipy.ndimage.convolve1d(picture, [1 / 8, 3 / 4, 1 / 8], axis=axis, mode="nearest")
    return picture


# ---- dark tones


#: Floors tried under dark tones, as fractions of the picture's maximum, on a grid with at most this many cells.
FLOORS, TRIAL = (0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3), 64
#: Stretch beyond that of uniform light that counts as a tear.
TORN = 8.0
#: Residual above which a grid has no solution as sharp as the picture, and the floor for lines finer than `TRIAL`.
UNSOLVED, FOR_LINES = 0.03, 0.1


def lifted(picture: Array, floor: float) -> Array:
    """Return `picture` with all values raised to at least `floor` times its maximum."""
    return np.maximum(picture, max(floor, 1e-3) * picture.max())


def least_floor(
    optics: Optics,
    picture: Array,
    size: tuple[float, float],
    target: tuple[float, float],
    start: Array,
    tell: Callable[[str], None] = lambda stage: None,
) -> float | None:
    """Return the lowest of `FLOORS` for which the transport neither folds nor tears, or None if the highest one
    fails. `tell` receives the name of each trial.
    """
    ratio = size[0] / size[1]
    shape = (round(TRIAL / max(ratio, 1)), round(TRIAL * min(ratio, 1)))
    small = _shrunk(picture, TRIAL / max(picture.shape))

    def good(floor: float) -> bool:
        tell(f"floor of {100 * floor:g} %")
        made = solve(optics, lifted(small, floor), size, target, shape, start)
        return made.converged and not made.folded and made.stretch < TORN

    low, high = -1, len(FLOORS)  # the highest floor known to be too low, and the lowest that suffices
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if good(FLOORS[middle]) else (middle, high)
    return FLOORS[high] if high < len(FLOORS) else None
