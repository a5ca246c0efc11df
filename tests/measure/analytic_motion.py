"""Motions whose derivatives are known in closed form: a tilted glass surface, a ball lens, and a lamp over a plane.

The receiver is the plane y = 0 of `moving_light.setting`. Its camera sees the range -1 to 1 of x and z. Each path that
lands in this range contributes to the sum over all pixels:

    sum_p A I_p = rho / pi * flux          A: area of a pixel on the receiver

This holds at every position. The reason is that the cosines and the distance to a pinhole that looks straight down
cancel. The mean position of the landing light is therefore the image's centre of gravity. Geometrical optics gives its
derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from measure.differenced import SIZE, attached
from measure.moving_light import point, setting
from numpy.typing import NDArray

from reslrb_cli.measure.gradients import smooth_weights
from reslrb_cli.measure.scenes.analytic import fresnel
from reslrb_cli.measure.scenes.case import SceneCase
from reslrb_cli.measure.scenes.moving import FILTER, pose
from reslrb_cli.measure.scenes.small import glass, lit_square, rectangle, rgb, transform

Array = NDArray[np.float64]

#: Reflectance of the receiver, as in `setting`.
RHO = np.array([0.8, 0.7, 0.6])

#: Area of a pixel on the receiver.
PIXEL = (2 / SIZE) ** 2


@dataclass(frozen=True)
class KnownMotion:
    """A scene, dL/dI `weights` (H, W, 3), and the derivatives of the objective by each amplitude (K,).

    `tolerance` is the error of the formula, relative to the largest derivative.
    """

    scene: SceneCase
    weights: Array
    derivatives: Array
    tolerance: float


def centre_of_gravity() -> Array:
    """Return weights (H, W, 3) for which the objective is the integral of x over the light that lands."""
    x = 2 * (np.arange(SIZE) + 0.5) / SIZE - 1
    return np.broadcast_to(PIXEL * x[None, :, None], (SIZE, SIZE, 3)).copy()


def parallel(half: float, x: float, y: float, radiance: float) -> dict:
    """Return a lamp with parallel light straight down from a square around (x, 0). Its flux is `radiance` * (2
    half)^2.
    """
    place = transform(translate=[x, y, 0], rotate=([1, 0, 0], 90), scale=half)
    return lit_square(rgb(radiance, radiance, radiance), place, "directionalarea")


def tilted_surface(tilt: float = 0.3, ior: float = 1.5, height: float = 1.4, half: float = 0.2) -> KnownMotion:
    """Return the motion of a flat glass surface under parallel light. The surface is tilted by `tilt` about z, and the
    receiver is inside the glass.

    A ray that hits the surface at (0, height) leaves at the angle a = tilt - arcsin(sin(tilt) / ior) from the vertical.
    It lands at height * tan(a). The mean of a beam lands there too, since the distances of the other rays cancel. By
    Snell and Fresnel,

        objective = rho / pi * flux * (1 - R(tilt)) * height * tan(a)
    """

    def objective(angle: float) -> float:
        away = angle - np.arcsin(np.sin(angle) / ior)
        return float((1 - fresnel(np.array(angle), ior)) * height * np.tan(away))

    flux, h = 50.0 * (2 * half) ** 2, 1e-5
    slope = (objective(tilt + h) - objective(tilt - h)) / (2 * h)
    place = transform(translate=[0, height, 0]) @ transform(rotate=([0, 0, 1], float(np.rad2deg(tilt))))
    surface = rectangle(glass(ior), place @ transform(rotate=([1, 0, 0], -90), scale=2))
    scene = attached(
        "tilted_surface", "parallel light on a tilted surface of glass",
        lambda: setting(lamp=parallel(half, 0, 3, 50.0), top=surface),
        lambda scene: [pose("top.to_world", ("rz",), (0, height, 0))], options={"max_depth": 3},
    )  # fmt: skip
    known = np.array([RHO.sum() / np.pi * flux * slope])
    return KnownMotion(scene, centre_of_gravity(), known, 1e-3)


def ball_lens(radius: float = 2.4, ior: float = 1.5, offset: float = 0.04, half: float = 0.016) -> KnownMotion:
    """Return the motion of a glass ball with its focus on the receiver, and a thin parallel beam near the axis.

    A ray at x from the axis lands at x (1 - d / f). Here, d is the distance from the ball's centre, and f = n R / (2 (n
    - 1)) (E. Hecht, Optics, Section 5.2). The ball moves by t across the axis and by s along the axis, and grows by 1 +
    g. At d = f:

        dx/dt = d / f = 1        dx/ds = -x / f        dx/dg = x d / f
    """
    f = ior * radius / (2 * (ior - 1))
    passed = (1 - ((ior - 1) / (ior + 1)) ** 2) ** 2
    flux = 5e4 * (2 * half) ** 2
    slopes = np.array([1.0, -offset / f, offset])
    scene = attached(
        "ball_lens", "a thin beam through a ball of glass with its focus on the receiver",
        lambda: setting(lamp=parallel(half, offset, f + radius + 1, 5e4),
                        lens={"type": "sphere", "center": [0, f, 0], "radius": radius,
                              "bsdf": glass(ior)}),
        lambda scene: [pose("lens.to_world", ("tx", "ty", "s"), (0, f, 0))],
    )  # fmt: skip
    return KnownMotion(scene, centre_of_gravity(), RHO.sum() / np.pi * flux * passed * slopes, 2e-3)


def lamp_over_plane(position: tuple[float, float, float] = (0.1, 0.7, 0.2), nodes: int = 8) -> KnownMotion:
    """Return the motion of a point light over the receiver along each axis. Lambert's laws give E = I h / d^3.

    The objective is the integral of the light reflected from E, times g(u) = sum_p filter_p(u) G_p. A quadrature over
    the film computes the integral.
    """
    G = smooth_weights(SIZE, SIZE)
    at, weight = np.polynomial.legendre.leggauss(nodes)
    u = (np.arange(SIZE)[:, None] + (at + 1) / 2).ravel()  # in pixels
    g = np.einsum("ip,jq,pqc->ijc", _filter(u), _filter(u), G, optimize=True)
    x = 2 * u / SIZE - 1
    dx, dz, h = position[0] - x[None, :], position[2] - x[:, None], position[1]
    d = np.sqrt(dx**2 + dz**2 + h**2)
    intensity = np.array([3.0, 2.0, 4.0])
    slopes = np.stack([-3 * h * dx / d**5, 1 / d**3 - 3 * h**2 / d**5, -3 * h * dz / d**5])
    area = np.outer(np.tile(weight, SIZE), np.tile(weight, SIZE)) / 4
    known = np.einsum("kij,ij,ijc,c->k", slopes, area, g, RHO / np.pi * intensity)
    scene = attached(
        "lamp_over_plane", "a point light over a plane", lambda: setting(lamp=point(position)),
        lambda scene: [pose("lamp.position", ("tx", "ty", "tz"))], options={"max_depth": 2},
    )  # fmt: skip
    return KnownMotion(scene, G, known, 1e-3)


def _filter(u: Array) -> Array:
    """Return the film filter's weights (N, SIZE) of a row of pixels for film positions (N,).

    The filter is a Gaussian that ends at four standard deviations without a step. The weights are normalised over all
    pixels, including pixels off the film.
    """
    sigma = float(str(FILTER["stddev"]))
    pixels = np.arange(-8, SIZE + 8) + 0.5
    distance = u[:, None] - pixels
    value = np.maximum(np.exp(-(distance**2) / (2 * sigma**2)) - np.exp(-8.0), 0)
    return np.asarray(value / value.sum(1, keepdims=True))[:, 8:-8]
