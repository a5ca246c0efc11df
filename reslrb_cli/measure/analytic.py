"""Scenes whose images are known in closed form, with the derivatives of every pixel.

An image is what a box filter gives: the mean radiance over each pixel. All parameters here are colours, and each
channel of the image depends on the same channel of a parameter alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """An image (H, W, 3), and its derivative with respect to each parameter, (H, W, 3), by a name of its own."""

    image: Array
    derivatives: dict[str, Array]

    def gradient(self, weights: ArrayLike) -> dict[str, Array]:
        """Gradient (3,) of sum(image * weights) for each parameter; `weights` are (H, W, 3)."""
        return {name: np.sum(np.asarray(weights, np.float64) * d, (0, 1)) for name, d in self.derivatives.items()}


def furnace(albedo: ArrayLike, emission: ArrayLike, max_depth: int, size: int) -> Known:
    """A closed surface that emits `emission` and reflects `albedo` (3,) diffusely, everywhere the same, from inside.

    Radiance is the same everywhere, since the cosine-weighted directions of a hemisphere integrate to pi, and the
    Neumann series of the rendering equation (J. T. Kajiya, The Rendering Equation, SIGGRAPH 1986) is geometric:

        L = Le (1 + rho + ... + rho^(D-1)),   D = max_depth;   its limit is Le / (1 - rho)

    `max_depth` -1 is the limit. Raises ValueError where that does not exist.
    """
    rho, Le = (np.broadcast_to(np.asarray(value, np.float64), 3) for value in (albedo, emission))
    if max_depth == -1:
        if np.any(rho >= 1):
            raise ValueError("light in a furnace of albedo 1 grows without bound: give max_depth")
        series, derivative = 1 / (1 - rho), 1 / (1 - rho) ** 2
    else:
        powers = np.arange(max_depth)[:, None]
        series = np.sum(rho**powers, 0)
        derivative = np.sum(powers * rho ** np.maximum(powers - 1, 0), 0)
    image = np.ones((size, size, 1))
    return Known(image * (Le * series), {"albedo": image * (Le * derivative), "emission": image * series})


def point_over_plane(
    albedo: ArrayLike, intensity: ArrayLike, light: ArrayLike, camera_height: float, fov: float, size: int
) -> Known:
    """A point light at `light` (3,) over the diffuse plane y = 0, seen from straight above the origin.

        L(x) = rho / pi * I cos(theta) / d^2

    Inverse square and cosine law, J. H. Lambert, Photometria, 1760. The camera is that of `plane_points`.
    """
    points, weights = plane_points(camera_height, fov, size)
    to_light = np.asarray(light, np.float64) - points
    distance = np.linalg.norm(to_light, axis=-1)
    irradiance = _pixels(to_light[..., 1] / distance**3, weights)
    return _lit_plane(albedo, intensity, irradiance, "intensity")


def point_through_surface(
    albedo: ArrayLike, intensity: ArrayLike, transmittance: ArrayLike, ior: float, light: ArrayLike, depth: float,
    camera_height: float, fov: float, size: int,
) -> Known:  # fmt: skip
    """A point light at `light` (3,) over a medium of index `ior` whose flat surface is at y = `depth`, seen refracted
    once on the diffuse bottom, y = 0, by a camera in the medium, straight above the origin.

    Light that leaves at an angle theta_1 from the vertical meets the bottom at x = h tan(theta_1) + depth tan(theta_2)
    from below the light, sin(theta_1) = ior sin(theta_2). What passes through a ring of directions lands in a ring:

        E = I (1 - R(theta_1)) tau sin(theta_1) / (x dx/dtheta_1),   L = rho / pi * E

    Snell's law, Fresnel's equations, conservation of flux (M. Born, E. Wolf, Principles of Optics, Sections 1.5, 3.1).
    Light that the surface sends back to the bottom is left out, as with max_depth 3.
    """
    points, weights = plane_points(camera_height, fov, size)
    light = np.asarray(light, np.float64)
    height = light[1] - depth
    offset = np.hypot(points[..., 0] - light[0], points[..., 2] - light[2])
    theta = _refracted_angle(offset, height, depth, ior)
    sin_2 = np.sin(theta) / ior
    cos_1, cos_2 = np.cos(theta), np.sqrt(1 - sin_2**2)
    slope = height / cos_1**2 + depth * cos_1 / (ior * cos_2**3)  # dx/dtheta_1
    # sin(theta_1) / x, which is finite below the light
    ratio = 1 / (height / cos_1 + depth / (ior * cos_2))
    passed = 1 - fresnel(theta, ior)
    known = _lit_plane(albedo, intensity, _pixels(passed * ratio / slope, weights), "intensity")
    tau = np.broadcast_to(np.asarray(transmittance, np.float64), 3)
    derivatives = {name: d * tau for name, d in known.derivatives.items()} | {"transmittance": known.image}
    return Known(known.image * tau, derivatives)


def beam_through_slab(
    albedo: ArrayLike, radiance: ArrayLike, transmittance: ArrayLike, reflectance: ArrayLike, ior: float, angle: float,
    max_depth: int, size: int,
) -> Known:  # fmt: skip
    """Parallel light through a parallel slab of index `ior`, on a diffuse plane parallel to it, away from its edges.

    `angle` is that of incidence in radians, `radiance` what the beam carries through a plane across it. With the
    reflectance R of one surface, factors tau of each refraction and r of each reflection, K pairs of inner reflections,

        T = tau^2 (1 - R)^2 (1 + q + ... + q^K),   q = (r R)^2;   the limit is tau^2 (1 - R)^2 / (1 - q)
        L = rho / pi * E cos(theta) T

    Incoherent sum of M. Born, E. Wolf, Principles of Optics, Section 7.6, of intensities, with the mean of both
    polarisations at each surface, as renderers take it. A path of K pairs has 4 + 2 K edges. The plane is so far away
    that what it sends back to the slab is nothing.
    """
    rho, E, tau, r = (np.broadcast_to(np.asarray(v, float), 3) for v in (albedo, radiance, transmittance, reflectance))
    R = float(fresnel(np.array(angle), ior))
    powers = np.arange((max_depth - 4) // 2 + 1)[:, None]
    q = (r * R) ** 2
    series, d_series = np.sum(q**powers, 0), np.sum(powers * q ** np.maximum(powers - 1, 0), 0) * 2 * r * R**2
    L = rho / np.pi * E * np.cos(angle) * (tau * (1 - R)) ** 2 * series
    pixel = np.ones((size, size, 1))
    return Known(
        pixel * L,
        {
            "albedo": pixel * (L / rho),
            "radiance": pixel * (L / E),
            "transmittance": pixel * (2 * L / tau),
            "reflectance": pixel * (L * d_series / series),
        },
    )


def fresnel(theta: Array, ior: float) -> Array:
    """Reflectance of unpolarised light at a flat surface of relative index `ior`, from the outside; Fresnel 1823."""
    sin_2, cos_1 = np.sin(theta) / ior, np.cos(theta)
    cos_2 = np.sqrt(1 - sin_2**2)
    s = (cos_1 - ior * cos_2) / (cos_1 + ior * cos_2)
    p = (ior * cos_1 - cos_2) / (ior * cos_1 + cos_2)
    return (s**2 + p**2) / 2


def plane_points(height: float, fov: float, size: int, order: int = 8) -> tuple[Array, Array]:
    """Points of the plane y = 0 that a camera above it sees, for quadrature over pixels: (H, W, order^2, 3), weights.

    The camera stands at (0, `height`, 0), looks down, and has -z at its upper edge; `fov` is in degrees. The film
    position of a point is linear in x and z. Gauss-Legendre nodes; the weights (order^2,) sum to 1.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order)
    half = height * np.tan(np.deg2rad(fov) / 2)
    film = (np.arange(size)[:, None] + (nodes + 1) / 2) / size  # (size, order)
    at = half * (2 * film - 1)
    x, z = np.broadcast_arrays(at[None, :, None, :], at[:, None, :, None])
    points = np.stack([x, np.zeros_like(x), z], -1).reshape(size, size, order * order, 3)
    return points, np.outer(weights, weights).ravel() / 4


def _refracted_angle(offset: Array, height: float, depth: float, ior: float) -> Array:
    """theta_1 of the light that reaches the bottom at `offset`: bisection, to double precision."""
    low, high = np.zeros_like(offset), np.full_like(offset, np.pi / 2 - 1e-9)
    for _ in range(60):
        middle = (low + high) / 2
        sin_2 = np.sin(middle) / ior
        beyond = height * np.tan(middle) + depth * sin_2 / np.sqrt(1 - sin_2**2) > offset
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return (low + high) / 2


def _pixels(values: Array, weights: Array) -> Array:
    """Means over pixels of (H, W, nodes) values: (H, W, 1)."""
    return np.sum(values * weights, -1)[..., None]


def _lit_plane(albedo: ArrayLike, power: ArrayLike, irradiance: Array, name: str) -> Known:
    """Radiance of a diffuse plane that light of unit power gives `irradiance` (H, W, 1)."""
    rho, power = (np.broadcast_to(np.asarray(value, np.float64), 3) for value in (albedo, power))
    per_pi = irradiance / np.pi
    return Known(per_pi * (rho * power), {"albedo": per_pi * power, name: per_pi * rho})
