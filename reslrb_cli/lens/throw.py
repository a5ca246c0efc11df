"""A face of any scene that throws a picture: light by planes wherever they stand, heights by `transport.py`.

What `surface.py` knows of its own `Setting`, for a face, a lamp, glass and a receiver in any position. Coordinates are
the face's: z = h(x, y) about its plane z = 0, about its middle; lengths are in any unit, and best such that the face is
about 100 of them wide, since the solver's steps by differences are made for that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import least_squares

from reslrb_cli.errors import ConfigError
from reslrb_cli.lens import transport
from reslrb_cli.lens.surface import transmitted

Array = NDArray[np.float64]

#: What a lamp sends from places (3, ...) in directions (3, ...): 1 where most, 0 where nothing.
Beam = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Interface:
    """A plane through `point` (3,), `normal` (3,), beyond which glass is `eta` times as dense as before it."""

    point: Array
    normal: Array
    eta: float


@dataclass(frozen=True)
class Receiver:
    """A rectangle of `size` about `middle` (3,), its axes `across` and `up`."""

    middle: Array
    across: Array
    up: Array
    size: tuple[float, float]

    @property
    def normal(self) -> Array:
        return np.cross(self.across, self.up)


@dataclass(frozen=True)
class Throw:
    """What light does: the `transport.Optics` of a face of `size`.

    Light comes along `toward` (3,), or, where that is None, from `lamp` (3,), through `before` where there is such a
    plane; the face is a mirror, `eta` None, or glass behind it is `eta` times as dense as before it; light leaves
    through `after`, where that is. `beam` says what of the light there is; `ellipse`: the face is that in its size.
    """

    size: tuple[float, float]
    eta: float | None
    receiver: Receiver
    toward: Array | None = None
    lamp: Array | None = None
    before: Interface | None = None
    after: Interface | None = None
    beam: Beam | None = None
    ellipse: bool = False

    def incoming(self, x: Array, y: Array, h: Array) -> tuple[Array, Array]:
        """Direction (3, ...) of light that comes to (x, y, h), and light on a plane z = h; NaN where none comes."""
        place = np.stack(np.broadcast_arrays(x, y, h)).astype(np.float64)
        if self.toward is not None:
            out = d = _like(self.toward, place)
            source, light = place, np.abs(d[2])
            if self.before is not None:
                d = _bent(out, self.before.normal, self.before.eta)
                source = place - d * _reach(place, d, self.before, back=True)
                light = np.abs(d[2]) * transmitted(np.abs(_dot(out, self.before.normal)), self.before.eta)
        elif self.before is None:
            assert self.lamp is not None
            way = place - _like(self.lamp, place)
            length = np.linalg.norm(way, axis=0)
            out = d = way / length
            source, light = _like(self.lamp, place), np.abs(d[2]) / length**2
        else:
            out, d, source, light = self._through(place, self.before)
        if self.beam is not None:
            light = light * self.beam(source, out)
        return d, light

    def _through(self, place: Array, plane: Interface) -> tuple[Array, Array, Array, Array]:
        """Direction before the plane and after it, places on it, and light on a plane z = h, of rays from the lamp.

        They pass the plane at a radius r about the lamp's foot, by Newton's method.
        """
        assert self.lamp is not None
        m, eta = plane.normal, plane.eta
        gap = float(m @ (plane.point - self.lamp))
        deep = _dot(place - _like(plane.point, place), m)
        foot = self.lamp + gap * m
        side = place - _like(foot, place)
        side = side - _like(m, place) * _dot(side, m)
        radius = np.maximum(np.linalg.norm(side, axis=0), 1e-9)
        r = radius * gap / (gap + deep / eta)
        for _ in range(8):
            sine = r / np.hypot(r, gap) / eta
            tangent = sine / np.sqrt(1 - sine**2)
            growth = 1 + deep * gap**2 / np.hypot(r, gap) ** 3 / eta / (1 - sine**2) ** 1.5
            r = r - (r + deep * tangent - radius) / growth
        cosine = np.sqrt(1 - sine**2)
        light = gap / np.hypot(r, gap) ** 3 * (r / radius) / growth * transmitted(gap / np.hypot(r, gap), eta)
        along, out = side / radius, np.hypot(r, gap)
        d = sine * along + cosine * _like(m, place)
        first = (r * along + gap * _like(m, place)) / out
        return first, d, _like(foot, place) + r * along, light / cosine * np.abs(d[2])

    def outgoing(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        """Direction (3, ...) of the light that leaves the face; NaN where it is totally reflected."""
        d, _ = self.incoming(x, y, h)
        normal = np.stack(np.broadcast_arrays(-gx, -gy, 1.0)) / np.sqrt(1 + gx * gx + gy * gy)
        if self.eta is None:
            return d - 2 * np.sum(d * normal, axis=0) * normal
        return _bent(d, normal, self.eta)

    def hit(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        """T: see `transport.Optics`."""
        d = self.outgoing(x, y, h, gx, gy)
        place = np.stack(np.broadcast_arrays(x, y, h)).astype(np.float64)
        if self.after is not None:
            place = place + d * _reach(place, d, self.after)
            d = _bent(d, self.after.normal, self.after.eta)
        r = self.receiver
        from_middle = place - _like(r.middle, place)
        facing = _dot(d, r.normal)
        t = -_dot(from_middle, r.normal) / np.where(np.abs(facing) > 1e-3, facing, np.nan)
        landed = from_middle + np.where(t > 0, t, np.nan) * d
        return np.stack([_dot(landed, r.across), _dot(landed, r.up)])

    def arriving(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        """mu: see `transport.Optics`."""
        d, plane = self.incoming(x, y, h)
        meets = (d[2] - d[0] * gx - d[1] * gy) / d[2]  # of a sloped face more or less than of a plane
        light = plane * np.maximum(meets, 0)
        if self.eta is not None:
            light = light * transmitted(np.abs(d[2] * meets) / np.sqrt(1 + gx * gx + gy * gy), self.eta)
        inside = (2 * x / self.size[0]) ** 2 + (2 * y / self.size[1]) ** 2 <= 1 if self.ellipse else True
        return np.where(inside, light, 0.0)


def _like(vector: Array, like: Array) -> Array:
    """`vector` (3,), everywhere where `like` (3, ...) is."""
    return np.broadcast_to(vector.reshape(3, *[1] * (like.ndim - 1)), like.shape)


def _dot(d: Array, vector: Array) -> Array:
    return np.tensordot(vector, d, 1)


def _bent(d: Array, normal: Array, eta: float) -> Array:
    """Directions d (3, ...) beyond a face with `normal` (3,) or (3, ...); NaN where light is totally reflected."""
    normal = _like(normal, d) if normal.ndim == 1 else normal
    cosine = np.sum(d * normal, axis=0)
    left = 1 - (1 - cosine**2) / eta**2
    beyond = np.sign(cosine) * np.where(left > 0, np.sqrt(np.maximum(left, 0)), np.nan)
    return d / eta + (beyond - cosine / eta) * normal


def _reach(place: Array, d: Array, plane: Interface, back: bool = False) -> Array:
    """How far it is along d to a plane; NaN where it lies on the other side."""
    t = -_dot(place - _like(plane.point, place), plane.normal) / _dot(d, plane.normal)
    return -t if back else np.where(t > 0, t, np.nan)


@dataclass
class Thrown:
    """A face that throws a picture: `heights` (ny, nx) at the centres of a grid's cells, and what it is worth."""

    heights: Array
    floor: float
    relief: float
    misplaced: float
    transport: transport.Transport

    def at(self, xs: Array, ys: Array, size: tuple[float, float]) -> Array:
        """Heights (y, x) at places on the face: cubic between cells, and parabolas on to the edges."""
        h = self.heights
        for axis in (0, 1):
            h = np.moveaxis(h, axis, 0)
            h = np.concatenate([[3 * h[0] - 3 * h[1] + h[2]], h, [3 * h[-1] - 3 * h[-2] + h[-3]]])
            h = np.moveaxis(h, 0, axis)
        ny, nx = self.heights.shape
        spline = RectBivariateSpline(np.arange(ny + 2), np.arange(nx + 2), h)
        return np.asarray(spline((ys / size[1] + 0.5) * ny + 0.5, (xs / size[0] + 0.5) * nx + 0.5))


def throw_picture(throw: Throw, picture: Array, cells: int, floor: float | Literal["auto"] = "auto") -> Thrown:
    """The face that throws `picture` (rows along `receiver.up`, columns along `across`), `cells` along its longer side.

    Raises ConfigError without a place where there is none, and what would do.
    """
    size, target = throw.size, throw.receiver.size
    with np.errstate(invalid="ignore", divide="ignore"):  # of trials that send light nowhere
        start, chosen = even_start(throw), floor == "auto"
        if floor == "auto":
            found = transport.least_floor(throw, picture, size, target, start)
            if found is None:
                raise ConfigError("", "", "has too much contrast for this face: even with a floor of "
                                  f"{transport.FLOORS[-1]:g} of its maximum light would have to be torn apart; "
                                  "a larger distance or lifted dark parts may do")  # fmt: skip
            floor = found
        longer = max(size)
        shape = (max(8, round(cells * size[1] / longer)), max(8, round(cells * size[0] / longer)))
        made = transport.solve(throw, transport.lifted(picture, floor), size, target, shape, start)
        if chosen and floor < transport.FOR_LINES and made.residual > transport.UNSOLVED:
            floor = transport.FOR_LINES  # of dark lines that the trials' grid does not see
            made = transport.solve(throw, transport.lifted(picture, floor), size, target, shape, start)
    if not made.converged:
        raise ConfigError("", "", "finds no face that throws this picture; a larger distance or a higher floor may do")
    h = made.h
    return Thrown(h, floor, float(np.ptp(h)), made.error / 2, made)


def even_start(throw: Throw) -> Array:
    """The polynomial of degree 2 (`transport.solve`) that sends the face about evenly to the receiver.

    Raises ConfigError where some light gets to no such place.
    """
    s, target = throw.size, throw.receiver.size
    x, y = transport.grid((9, 9), s)
    wanted = np.stack([x * (target[0] / s[0]), y * (target[1] / s[1])])
    first = _central_slope(throw)

    def hits(c: Array) -> Array:
        h = c[0] * x + c[1] * y + c[2] * x * x + c[3] * x * y + c[4] * y * y
        return throw.hit(x, y, h, c[0] + 2 * c[2] * x + c[3] * y, c[1] + c[3] * x + 2 * c[4] * y)

    def misses(c: Array) -> Array:
        return np.nan_to_num(hits(c) - wanted, nan=1e3 * max(target)).ravel()

    fit = least_squares(misses, np.array([*first, 0.0, 0.0, 0.0]), x_scale=[1, 1, *[1 / max(s)] * 3])
    off = hits(fit.x) - wanted
    if not np.all(np.isfinite(off)):
        raise ConfigError("", "", "cannot be: light is totally reflected, or does not reach all of the picture; "
                          "a receiver farther away or a smaller picture may do")  # fmt: skip
    if np.sqrt(np.mean(off**2)) > 0.25 * max(target):
        raise ConfigError("", "", "finds no face that lights the picture evenly; a receiver farther away may do")
    return np.concatenate([[0.0], fit.x])


def _central_slope(throw: Throw) -> tuple[float, float]:
    """The slopes with which the face's middle sends its light to the receiver's. Raises ConfigError where none does.

    The normal lies along d_in - eta d_out, of a mirror along d_out - d_in; of refracted light that is on the right side
    only while d_in . d_out is more than the lesser of eta and 1 / eta.
    """
    zero = np.zeros(())
    d, _ = throw.incoming(zero, zero, zero)
    if not np.all(np.isfinite(d)):
        raise ConfigError("", "", "cannot be: light is totally reflected before it comes to the face")
    out = throw.receiver.middle / np.linalg.norm(throw.receiver.middle)
    if throw.eta is None:
        normal = out - d
    else:
        least = min(throw.eta, 1 / throw.eta)
        if throw.after is None and float(d @ out) <= least:
            raise ConfigError("", "", f"cannot be: glass bends light by at most {np.degrees(np.arccos(least)):.0f} "
                              "degrees before it is totally reflected, and the receiver is "
                              f"{np.degrees(np.arccos(np.clip(d @ out, -1, 1))):.0f} degrees off")  # fmt: skip
        normal = d - throw.eta * out if throw.after is None else np.array([0.0, 0.0, 1.0])
    if abs(normal[2]) < 0.05 * np.linalg.norm(normal):
        raise ConfigError("", "", "cannot be: the face would stand upright on its plane to reach the receiver")
    return float(-normal[0] / normal[2]), float(-normal[1] / normal[2])
