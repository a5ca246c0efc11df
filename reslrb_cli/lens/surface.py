"""Face of a lens or mirror whose caustic shows a picture. A lens refracts rays by Snell's law, and a mirror reflects
rays. `transport.py` computes the heights.

Lengths are in millimetres. The face is z = h(x, y) near the plane z = 0, with its normal towards the receiver. Light
reaches a lens from z < 0 through a plane face at z = -thickness, and a mirror from z > 0. The central ray meets the
centre of the face. A flat face would send the central ray to the receiver's centre, at `distance`. Without tilt, the
receiver is perpendicular to the central ray. On both, y points up.

The unknown of the transport problem is h itself. T(x, y) is the receiver point that a ray reaches from the face point
(x, y, h). The face normal at this point is (-dh/dx, -dh/dy, 1). All lights, tilts and depths of relief are therefore
treated exactly and in the same way. Computing normals first would require integrating them to heights, which is not
always possible.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from reslrb_cli.errors import ConfigError
from reslrb_cli.lens import transport

Array = NDArray[np.float64]

#: Upper bound of all lengths in mm.
_FAR = 1e6


@dataclass(frozen=True)
class Setting:
    """The arrangement of light, face and receiver.

    - `size` is the width and height of the face. A round `outline` is the ellipse within this size.
    - `picture_size` is the size of the picture on the receiver.
    - `light_distance` is the distance from the light to the first face that the light meets. For an area light, the
        distance starts at the light's centre. The distance is infinite for parallel light.
    - `incidence` is the angle (degrees, about y) between the central ray and z.
    - `tilt` has the angles (degrees) of the receiver about its horizontal and its vertical axis.
    """

    kind: Literal["lens", "mirror"] = "lens"
    size: tuple[float, float] = (100.0, 100.0)
    outline: Literal["rectangle", "round"] = "rectangle"
    distance: float = 200.0
    picture_size: tuple[float, float] = (100.0, 100.0)
    ior: float = 1.49
    thickness: float = 20.0
    light_distance: float = np.inf
    incidence: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)


@dataclass
class Surface:
    """A face with its relief and floor.

    - `heights` (ny, nx) are h at the centres of a grid's cells, with row 0 at the least y. A round face has heights
        outside of its outline, too.
    - `inside` (ny, nx) marks the cells inside the outline.
    - `floor` is a fraction of the picture's maximum. Darker parts of the picture were raised to this fraction.
    - `relief` is the height between the lowest and the highest point. At twice the distance, it is about half as much.
    """

    setting: Setting
    heights: Array
    inside: NDArray[np.bool_]
    floor: float
    relief: float
    transport: transport.Transport

    @property
    def forecast(self) -> Array:
        """The caustic (rows, columns) with mean 1 according to the transport, as a picture with row 0 at the top. It
        has as many pixels as the picture, or as the grid if that is coarser.
        """
        return self.transport.pushed[::-1, ::-1]

    def summary(self) -> str:
        """Return depth, floor and errors in one line."""
        return (
            f"{self.relief:.3g} mm deep; "
            f"nothing darker than {100 * self.floor:g} % of the brightest; "
            f"{50 * self.transport.error:.2g} % of the light misplaced"
        )


class Rays:
    """Rays of a `Setting`: the `transport.Optics` of its face."""

    def __init__(self, setting: Setting) -> None:
        self.setting = s = setting
        angle = np.radians(s.incidence)
        side = 1.0 if s.kind == "lens" else -1.0
        self.toward = np.array([np.sin(angle), 0, side * np.cos(angle)])
        if np.isfinite(s.light_distance):
            self.light = -self.toward * s.light_distance - np.array([0, 0, s.thickness if s.kind == "lens" else 0])
        zero = np.zeros(())
        forward = self.outgoing(zero, zero, zero, zero, zero)
        across = np.array([forward[2], 0, -forward[0]]) / np.hypot(forward[0], forward[2])
        up = np.cross(forward, across)
        nod, turn = np.radians(s.tilt)
        up, forward_ = np.cos(nod) * up + np.sin(nod) * forward, np.cos(nod) * forward - np.sin(nod) * up
        across, normal = (
            np.cos(turn) * across - np.sin(turn) * forward_,
            np.cos(turn) * forward_ + np.sin(turn) * across,
        )
        self.middle, self.across, self.up, self.normal = forward * s.distance, across, up, normal

    def incoming(self, x: Array, y: Array, h: Array) -> tuple[Array, Array]:
        """Return the direction (3, ...) of light that arrives at (x, y, h), and the irradiance on a plane z = h.

        For a lens, the function returns the direction inside the glass.
        """
        s = self.setting
        if s.kind == "mirror":
            if not np.isfinite(s.light_distance):
                return self._everywhere(self.toward, x), np.full(np.shape(x), -self.toward[2])
            way = np.stack([x - self.light[0], y - self.light[1], h - self.light[2]])
            length = np.linalg.norm(way, axis=0)
            return way / length, -way[2] / length**3
        if not np.isfinite(s.light_distance):
            bent = self.toward / s.ior
            bent[2] = np.sqrt(1 - bent[0] ** 2 - bent[1] ** 2)
            return self._everywhere(bent, x), np.full(np.shape(x), bent[2])
        # a point light's rays cross the plane face at radius r from its foot, and meet the other face at `radius`
        gap, deep = -s.thickness - self.light[2], h + s.thickness
        dx, dy = x - self.light[0], y - self.light[1]
        radius = np.maximum(np.hypot(dx, dy), 1e-9)
        r = radius * gap / (gap + deep / s.ior)
        for _ in range(6):
            sine = r / np.hypot(r, gap) / s.ior
            tangent = sine / np.sqrt(1 - sine**2)
            growth = 1 + deep * gap**2 / np.hypot(r, gap) ** 3 / s.ior / (1 - sine**2) ** 1.5
            r = r - (r + deep * tangent - radius) / growth
        cosine = np.sqrt(1 - sine**2)
        light = gap / np.hypot(r, gap) ** 3 * (r / radius) / growth * transmitted(gap / np.hypot(r, gap), s.ior)
        return np.stack([sine * dx / radius, sine * dy / radius, cosine]), light

    def outgoing(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        """Return the direction (3, ...) of the light that leaves. Total reflection gives NaN."""
        d, _ = self.incoming(x, y, h)
        normal = np.stack([-gx, -gy, np.ones_like(gx)]) / np.sqrt(1 + gx * gx + gy * gy)
        cosine = np.sum(d * normal, axis=0)
        if self.setting.kind == "mirror":
            return d - 2 * cosine * normal
        n = self.setting.ior
        left = 1 - n * n * (1 - cosine**2)
        beyond = np.where(left > 0, np.sqrt(np.maximum(left, 0)), np.nan)
        return n * d + (beyond - n * cosine) * normal

    def hit(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        d = self.outgoing(x, y, h, gx, gy)
        place = np.stack([x, y, h])
        from_middle = place - self._everywhere(self.middle, x)
        facing = np.tensordot(self.normal, d, 1)
        t = -np.tensordot(self.normal, from_middle, 1) / np.where(facing > 1e-3, facing, np.nan)
        landed = from_middle + np.where(t > 0, t, np.nan) * d
        return np.stack([np.tensordot(self.across, landed, 1), np.tensordot(self.up, landed, 1)])

    def arriving(self, x: Array, y: Array, h: Array, gx: Array, gy: Array) -> Array:
        d, plane = self.incoming(x, y, h)
        meets = (d[2] - d[0] * gx - d[1] * gy) / d[2]  # a sloped face changes it slightly
        light = plane * np.maximum(meets, 0)
        if self.setting.kind == "lens":
            cosine = (d[2] - d[0] * gx - d[1] * gy) / np.sqrt(1 + gx * gx + gy * gy)
            light = light * transmitted(cosine, 1 / self.setting.ior)
        return np.where(within(self.setting, x, y), light, 0.0)

    @staticmethod
    def _everywhere(vector: Array, like: Array) -> Array:
        return np.broadcast_to(vector.reshape(3, *[1] * np.ndim(like)), (3, *np.shape(like)))


def transmitted(cosine: Array, eta: float) -> Array:
    """Return the transmittance for unpolarised light into a medium with relative index `eta` (Fresnel)."""
    beyond = np.sqrt(np.maximum(1 - (1 - cosine**2) / eta**2, 0))
    s = (cosine - eta * beyond) / (cosine + eta * beyond)
    p = (eta * cosine - beyond) / (eta * cosine + beyond)
    return 1 - (s * s + p * p) / 2


def within(setting: Setting, x: Array, y: Array) -> NDArray[np.bool_]:
    """Whether (x, y) is inside the outline."""
    if setting.outline == "rectangle":
        return (np.abs(x) <= setting.size[0] / 2) & (np.abs(y) <= setting.size[1] / 2)
    return (2 * x / setting.size[0]) ** 2 + (2 * y / setting.size[1]) ** 2 <= 1


def shape_surface(
    picture: Array,
    setting: Setting,
    cells: int = 256,
    floor: float | Literal["auto"] = "auto",
    tell: Callable[[str], None] = lambda stage: None,
) -> Surface:
    """Return the face whose caustic shows `picture` (rows, columns), a luminance with row 0 at the top.

    The grid has `cells` along its longer side. `tell` receives the name of each stage. Raises ConfigError if no face
    can show the picture. The error names the setting and a remedy.
    """
    _check(picture, setting)
    rays = Rays(setting)
    # Row 0 at the least y, and columns along x, which points to the left of an observer on the light's side.
    target = np.asarray(picture, np.float64)[::-1, ::-1]
    start, chosen = _start(rays), floor == "auto"
    if floor == "auto":
        with np.errstate(invalid="ignore", divide="ignore"):  # of trials that send no light
            found = transport.least_floor(rays, target, setting.size, setting.picture_size, start, tell)
        if found is None:
            near = "a more distant light, " if np.isfinite(setting.light_distance) else ""
            raise ConfigError("", "picture", f"has too much contrast for this {setting.kind}: even with a floor of "
                                             f"{transport.FLOORS[-1]:g} of its maximum, light would be torn apart; try "
                                             f"a larger distance, {near}brighter dark parts, or a crop")  # fmt: skip
        floor = found
    longer = max(setting.size)
    shape = (max(8, round(cells * setting.size[1] / longer)), max(8, round(cells * setting.size[0] / longer)))

    def solved(floor: float, sharp: bool = False) -> transport.Transport:
        lifted = transport.lifted(target, floor)
        return transport.solve(rays, lifted, setting.size, setting.picture_size, shape, start, tell, sharp)

    raises = chosen and floor < transport.FOR_LINES
    made = solved(floor, raises)
    if raises and (made.h.shape != shape or made.residual > transport.UNSOLVED):
        floor = transport.FOR_LINES  # of dark lines that are too fine for the trials' grid
        made = solved(floor)
    target = transport.lifted(target, floor)
    if not made.converged:
        raise ConfigError("", "distance", f"no face was found for this picture at {setting.distance:g} mm; try a "
                                          "larger distance or a higher floor")  # fmt: skip
    inside = within(setting, *transport.grid(shape, setting.size))
    low, high = float(made.h[inside].min()), float(made.h[inside].max())
    relief = high - low
    if setting.thickness + low <= 0:
        into = "the glass" if setting.kind == "lens" else "the mirror"
        reason = (
            f"the relief is {relief:.3g} mm deep and goes {-low:.3g} mm into {into}; thickness must be above "
            f"{-low:.3g} mm, or distance larger (the relief is about half as deep at twice the distance)"
        )
        raise ConfigError("", "thickness", reason)
    return Surface(setting, made.h, inside, floor, relief, made)


def _start(rays: Rays) -> Array:
    """Return the polynomial of degree 2 (`transport.solve`) that maps the face approximately evenly to the picture."""
    s = rays.setting
    x, y = transport.grid((9, 9), s.size)
    wanted = np.stack([x * (s.picture_size[0] / s.size[0]), y * (s.picture_size[1] / s.size[1])])

    def misses(c: Array) -> Array:
        h = c[0] * x + c[1] * y + c[2] * x * x + c[3] * x * y + c[4] * y * y
        T = rays.hit(x, y, h, c[0] + 2 * c[2] * x + c[3] * y, c[1] + c[3] * x + 2 * c[4] * y)
        return np.nan_to_num(T - wanted, nan=1e3 * max(s.picture_size)).ravel()

    fit = least_squares(misses, np.zeros(5), x_scale=[1, 1, *[1 / max(s.size)] * 3])
    return np.concatenate([[0.0], fit.x])


# ---- impossible designs


def is_even(picture: Array) -> bool:
    """Whether a picture has only one colour. Variation within one 8-bit level counts as one colour. Dithering between
    two 8-bit levels also counts as one colour.
    """
    return bool(picture.max() - picture.min() <= 0.02 * picture.max())


def contrast_line(picture: Array, floor: float) -> str:
    """Describe in one line how a floor changes a picture (H, W). The result is empty if the floor raises nothing."""
    target = transport.lifted(picture, floor)
    share = float(np.mean(picture < target))
    if not floor or not share:
        return ""
    # SSIM has a window of 7 x 7 pixels.
    alike = f"; the target has an SSIM of {similarity(target, picture):.2f} with the picture" if min(
        picture.shape) >= 7 else ""  # fmt: skip
    advice = "; a dark picture on a white ground keeps more contrast" if share > 0.5 else ""
    return (f"contrast of at most {1 / floor:.3g} to 1: {100 * share:.2g} % of the picture is darker, and becomes grey"
            f"{alike}{advice}")  # fmt: skip


def similarity(image: Array, picture: Array) -> float:
    """Return the SSIM of two luminances (H, W), each divided by its mean, by scikit-image. The maximum of the divided
    picture is data_range.
    """
    from skimage.metrics import structural_similarity

    seen, wanted = image / max(float(image.mean()), 1e-30), picture / picture.mean()
    return float(structural_similarity(seen, wanted, data_range=float(wanted.max())))


def _check(picture: Array, setting: Setting) -> None:
    s = setting
    if picture.ndim != 2 or min(picture.shape) < 2:
        raise ConfigError(
            "", "picture", f"is {' x '.join(map(str, picture.shape))}; it must have at least 2 x 2 pixels"
        )
    if not np.all(np.isfinite(picture)) or picture.min() < 0:
        raise ConfigError("", "picture", "has values that are negative or not finite")
    if is_even(picture):
        raise ConfigError("", "picture", "has only one colour; there is no picture to show")
    lengths = {"size": min(s.size), "picture_size": min(s.picture_size), "distance": s.distance,
               "thickness": s.thickness}  # fmt: skip
    if s.light_distance != np.inf:
        lengths["light_distance"] = s.light_distance
    for key, length in lengths.items():
        if not 0 < length < _FAR:
            raise ConfigError("", key, f"is {length:g} mm; it must be above 0, and below {_FAR:g}")
    if not -80 <= s.incidence <= 80:
        raise ConfigError("", "incidence", f"is {s.incidence:g} degrees; it must be between -80 and 80")
    if not max(map(abs, s.tilt)) <= 80:
        raise ConfigError("", "tilt", f"is {s.tilt[0]:g} and {s.tilt[1]:g} degrees; both must be between -80 and 80")
    if s.kind == "lens" and not 1 < s.ior <= 5:
        raise ConfigError("", "ior", f"is {s.ior:g}; glass and plastics have 1.3 to 2.0, and the limit is 5")
    if s.kind == "mirror":
        angle = np.radians(abs(s.incidence))
        beside = s.distance * np.sin(2 * angle)
        needed = s.size[0] / 2 * np.cos(angle) + s.picture_size[0] / 2 * abs(np.cos(2 * angle))
        if beside < needed:
            reason = (
                f"at {s.incidence:g} degrees the receiver blocks the mirror's light; 30 degrees suffice if the "
                "distance is at least the mirror's size"
            )
            raise ConfigError("", "incidence", reason)
    if not _reaches(s):
        enough = next((f for f in np.geomspace(1, 100, 100) if _reaches(replace(s, distance=s.distance * f))), None)
        advice = "a smaller picture or tilt" if enough is None else f"a distance of {s.distance * enough:.3g} mm"
        raise ConfigError("", "distance", f"at {s.distance:g} mm light cannot reach the whole picture: " + (
            f"an index of {s.ior:g} bends light by at most {np.degrees(np.arccos(1 / s.ior)):.0f} degrees before total "
            "reflection; " if s.kind == "lens" else "") + f"{advice} would do")  # fmt: skip


def _reaches(setting: Setting) -> bool:
    """True if the face can send light from 3 x 3 points to the corresponding points of the picture. The points are the
    corners, the midpoints of the edges, and the centre. The light must reach the receiver's front.

    For a lens, the face normal N is proportional to n_i d_i - n_t d_t. N has a positive component along the refracted
    direction d_t only if n_i d_i . d_t > n_t. Refraction therefore turns light by less than arccos(1 / n).
    """
    rays = Rays(setting)
    x, y = (a.ravel() for a in transport.grid((3, 3), (1.5 * setting.size[0], 1.5 * setting.size[1])))
    u, v = x * setting.picture_size[0] / setting.size[0], y * setting.picture_size[1] / setting.size[1]
    to = rays.middle[:, None] + rays.across[:, None] * u + rays.up[:, None] * v
    way = to - np.stack([x, y, np.zeros_like(x)])
    out = way / np.linalg.norm(way, axis=0)
    d, _ = rays.incoming(x, y, np.zeros_like(x))
    stands = bool(np.all(to[2] > 0) and np.all(rays.normal @ out > 0.05))
    return stands and (setting.kind == "mirror" or bool(np.all(setting.ior * np.sum(d * out, axis=0) > 1.02)))
