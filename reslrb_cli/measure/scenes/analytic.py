"""Scenes with images in closed form, and with the derivatives of every pixel.

The images assume a box filter. Each pixel is the mean radiance over its area. All parameters are colours. A channel of
the image depends only on the same channel of a parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reslrb_cli.measure.scenes.small import SIZE, diffuse, glass, lit_square, look_at, pinhole, rectangle, rgb

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """An image (H, W, 3), and its derivative (H, W, 3) with respect to each parameter, by name."""

    image: Array
    derivatives: dict[str, Array]


@dataclass(frozen=True)
class KnownScene:
    """A scene with its image, and the parameter key of each derivative."""

    scene: Callable[[], dict]
    known: Known
    keys: dict[str, str]
    max_depth: int

    def gradient(self, weights: Any) -> np.ndarray:
        """Return the gradient of sum(image * weights) as a flat array, in the order of `keys`. `weights` are (H,
        W, 3).
        """
        G = np.asarray(weights, np.float64)
        return np.concatenate([np.sum(G * self.known.derivatives[name], (0, 1)) for name in self.keys])


#: The parameters of these scenes, by the names of their derivatives.
FURNACE = {"albedo": "walls.bsdf.reflectance.value", "emission": "walls.emitter.radiance.value"}
POOL = {
    "albedo": "plane.bsdf.reflectance.value",
    "intensity": "light.intensity.value",
    "transmittance": "surface.bsdf.specular_transmittance.value",
}

SLAB = {
    "albedo": "plane.bsdf.reflectance.value",
    "radiance": "lamp.emitter.radiance.value",
    "transmittance": "top.bsdf.specular_transmittance.value",
    "reflectance": "top.bsdf.specular_reflectance.value",
}

#: Albedo of all planes here.
ALBEDO = (0.7, 0.5, 0.3)
DOWN, UP = ([1, 0, 0], 90), ([1, 0, 0], -90)


def furnace_scene(albedo: tuple, emission: tuple, max_depth: int, size: int = SIZE) -> KnownScene:
    """The inside of a cube. (In a sphere sampled from inside, Mitsuba's `path` has an error of 0.25 %.)"""

    def scene() -> dict:
        walls = {"type": "cube", "flip_normals": True, "bsdf": diffuse(*albedo),
                 "emitter": {"type": "area", "radiance": rgb(*emission)}}  # fmt: skip
        return {"type": "scene", "camera": pinhole([0, 0.1, 0.4], [0.2, 0, -1], [0, 1, 0], 60, size), "walls": walls}

    return KnownScene(scene, furnace(albedo, emission, max_depth, size), FURNACE, max_depth)


def refraction_scene(ior: float = 1.5) -> KnownScene:
    """A point light over a medium of index `ior` with a flat surface at y = `depth`.

    The light refracts once and reaches the diffuse bottom at y = 0. A camera in the medium, straight above the origin,
    sees the bottom. Light that leaves at an angle theta_1 from the vertical meets the bottom at a distance x from the
    point below the light, with x = h tan(theta_1) + depth tan(theta_2) and sin(theta_1) = ior sin(theta_2). Light
    emitted into a ring of directions lands in a ring on the bottom.

        E = I (1 - R(theta_1)) tau sin(theta_1) / (x dx/dtheta_1),   L = rho / pi * E

    The formula for E follows from Snell's law, Fresnel's equations and conservation of flux. See Born and Wolf,
    Principles of Optics, Sections 1.5 and 3.1. Light that the surface reflects back to the bottom is left out, as with
    max_depth 3.
    """
    intensity, transmittance, light, depth, camera_height = (9, 6, 5), (0.9, 0.8, 0.6), (0.3, 1.6, -0.2), 1.0, 0.9

    def scene() -> dict:
        return {
            "type": "scene",
            "camera": pinhole([0, camera_height, 0], [0, 0, 0], [0, 0, -1], 60),
            "light": {"type": "point", "position": list(light), "intensity": rgb(*intensity)},
            "plane": rectangle(diffuse(*ALBEDO), translate=[0, 0, 0], rotate=UP, scale=2),
            "surface": rectangle(glass(ior, specular_transmittance=rgb(*transmittance)), translate=[0, depth, 0],
                                 rotate=UP, scale=2),
        }  # fmt: skip

    points, weights = plane_points(camera_height, 60, SIZE)
    height = light[1] - depth
    offset = np.hypot(points[..., 0] - light[0], points[..., 2] - light[2])
    low, high = np.zeros_like(offset), np.full_like(offset, np.pi / 2 - 1e-9)
    for _ in range(60):  # theta_1 of the light that arrives there, by bisection to double precision
        theta = (low + high) / 2
        sin_2 = np.sin(theta) / ior
        beyond = height * np.tan(theta) + depth * sin_2 / np.sqrt(1 - sin_2**2) > offset
        low, high = np.where(beyond, low, theta), np.where(beyond, theta, high)
    theta = (low + high) / 2
    sin_2 = np.sin(theta) / ior
    cos_1, cos_2 = np.cos(theta), np.sqrt(1 - sin_2**2)
    slope = height / cos_1**2 + depth * cos_1 / (ior * cos_2**3)  # dx/dtheta_1
    # sin(theta_1) / x, which stays finite below the light
    ratio = 1 / (height / cos_1 + depth / (ior * cos_2))
    per_pi = np.sum((1 - fresnel(theta, ior)) * ratio / slope * weights, -1)[..., None] / np.pi
    rho, power, tau = (np.array(value, np.float64) for value in (ALBEDO, intensity, transmittance))
    image = per_pi * (rho * power)
    derivatives = {"albedo": per_pi * power * tau, "intensity": per_pi * rho * tau, "transmittance": image}
    return KnownScene(scene, Known(image * tau, derivatives), POOL, 3)


def slab_scene(ior: float = 1.5, degrees: float = 40, max_depth: int = 6) -> KnownScene:
    """A parallel beam that passes a slab and lights a plane far below. The camera looks from the side."""
    radiance, tau, reflectance = (2, 3, 4), (0.9, 0.8, 0.7), (0.9, 0.6, 0.8)
    distance, angle = 40.0, np.deg2rad(degrees)
    direction = np.array([np.sin(angle), -np.cos(angle), 0])
    start = -3 * direction

    def scene() -> dict:
        bsdf = glass(ior, specular_transmittance=rgb(*tau), specular_reflectance=rgb(*reflectance), id="glass")
        below = [distance * np.tan(angle), -distance, 0.0]
        beside = [below[0] - 1.5, -distance + 3, 2.0]
        return {
            "type": "scene",
            "camera": pinhole(beside, below, [0, 1, 0], 12),
            "lamp": lit_square(rgb(*radiance), look_at(start.tolist(), [0, 0, 0]), "directionalarea"),
            # The lower surface faces down, so the glass is between them.
            "top": rectangle(bsdf, translate=[0, 0.025, 0], rotate=UP, scale=3),
            "bottom": rectangle({"type": "ref", "id": "glass"}, translate=[0, -0.025, 0], rotate=DOWN, scale=3),
            "plane": rectangle(diffuse(*ALBEDO), translate=below, rotate=UP, scale=6),
        }

    known = beam_through_slab(ALBEDO, radiance, tau, reflectance, ior, float(angle), max_depth, SIZE)
    return KnownScene(scene, known, SLAB, max_depth)


FOV = 50
RADIANCE = "lamp.emitter.radiance"

#: Position of the lamp over the plane beside the camera's view: centre and half of its side.
MIDDLE, HALF = (1.0, 0.8, -0.2), 0.3


def speck_in_view(side: float, radiance: tuple = (3, 2, 4)) -> KnownScene:
    """A square lamp on the border of two pixels. The lamp does not light the wall behind it.

    The image is the share of each pixel that the lamp covers, times its radiance. The lamp is parallel to the film, so
    the share follows from similar triangles.
    """
    distance = 2.0
    pixel = 2 * distance * np.tan(np.deg2rad(FOV) / 2) / SIZE
    center = (pixel + 0.2 * side, 0.6 * pixel)  # 0.7 of it to the right of a border
    edges = np.arange(SIZE + 1)

    def covered(middle: float) -> Array:
        low, high = (SIZE / 2 + (middle + sign * side / 2) / pixel for sign in (-1, 1))
        return np.clip(np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1]), 0, None)

    share = np.outer(covered(-center[1]), covered(center[0]))[..., None]

    def scene() -> dict[str, Any]:
        return {
            "type": "scene",
            # The camera looks along -z: x points right, towards the lamp.
            "camera": pinhole([0, 0, 0], [0, 0, -1], [0, 1, 0], FOV),
            "lamp": lit_square(rgb(*radiance), translate=[*center, -distance], scale=side / 2),
            "wall": rectangle(diffuse(0.5, 0.5, 0.5), translate=[0, 0, -4], scale=6),
        }

    known = Known(share * np.array(radiance), {"radiance": np.repeat(share, 3, axis=-1)})
    return KnownScene(scene, known, {"radiance": f"{RADIANCE}.value"}, 4)


def texels_over_plane(texels: ArrayLike) -> KnownScene:
    """A square lamp with texels (N, N, 3) over a diffuse plane. The camera sees the plane, but not the lamp.

        L(x) = rho / pi * sum_t Le_t int_t h^2 / d^4 dA

    The formula is Lambert's law for horizontal surfaces at distance h. Gauss-Legendre quadrature integrates over pixels
    and texels.
    """
    radiance = np.asarray(texels, np.float64)
    count = len(radiance)
    points, weights = plane_points(1.5, FOV, SIZE, order=4)
    nodes, own = np.polynomial.legendre.leggauss(4)
    at = HALF * (2 * (np.arange(count)[:, None] + (nodes + 1) / 2) / count - 1)  # along a side, (N, 4)
    area = np.outer(own, own) / 4 * (2 * HALF / count) ** 2
    factors = np.zeros((count, count, SIZE, SIZE, 1))
    for row in range(count):
        for column in range(count):
            x, z = MIDDLE[0] + at[column][None, :], MIDDLE[2] + at[row][:, None]
            aside = (points[..., 0, None, None] - x) ** 2 + (points[..., 2, None, None] - z) ** 2
            received = np.sum(area * MIDDLE[1] ** 2 / (aside + MIDDLE[1] ** 2) ** 2, (-2, -1))
            factors[row, column] = np.sum(received * weights, -1)[..., None] / np.pi

    def scene() -> dict[str, Any]:
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(radiance.astype(np.float32)), "raw": True,
                   "format": "variant", "filter_type": "nearest"}  # fmt: skip
        return {
            "type": "scene",
            "camera": pinhole([0, 1.5, 0], [0, 0, 0], [0, 0, -1], FOV),
            "lamp": lit_square(texture, translate=list(MIDDLE), rotate=DOWN, scale=HALF),
            "plane": rectangle(diffuse(*ALBEDO), rotate=UP, scale=4),
        }

    flat = factors.reshape(-1, SIZE, SIZE, 1)
    by_albedo = np.tensordot(radiance.reshape(-1, 3), flat[..., 0], (0, 0)).transpose(1, 2, 0)
    derivatives = {"albedo": by_albedo} | {f"texel {k}": factor * np.array(ALBEDO) for k, factor in enumerate(flat)}
    keys = {"albedo": "plane.bsdf.reflectance.value"} | {f"texel {k}": f"{RADIANCE}.data" for k in range(len(flat))}
    return KnownScene(scene, Known(by_albedo * np.array(ALBEDO), derivatives), keys, 2)


def furnace(albedo: ArrayLike, emission: ArrayLike, max_depth: int, size: int) -> Known:
    """A closed surface, seen from inside, with constant emission `emission` and diffuse reflectance `albedo` (3,).

    Radiance is constant, because the cosine-weighted directions of a hemisphere integrate to pi. The Neumann series of
    the rendering equation (Kajiya 1986) is geometric.

        L = Le (1 + rho + ... + rho^(D-1)),   D = max_depth;   its limit is Le / (1 - rho)

    A `max_depth` of -1 is the limit. Raises ValueError if the limit does not exist.
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


def beam_through_slab(
    albedo: ArrayLike, radiance: ArrayLike, transmittance: ArrayLike, reflectance: ArrayLike, ior: float, angle: float,
    max_depth: int, size: int,
) -> Known:  # fmt: skip
    """Parallel light through a parallel slab of index `ior`, on a diffuse plane that is parallel to the slab.

    `angle` is the angle of incidence in radians. `radiance` is the irradiance on a plane perpendicular to the beam. R
    is the reflectance of one surface. tau is the factor of each refraction, and r the factor of each reflection. K is
    the number of pairs of inner reflections.

        T = tau^2 (1 - R)^2 (1 + q + ... + q^K),   q = (r R)^2;   the limit is tau^2 (1 - R)^2 / (1 - q)
        L = rho / pi * E cos(theta) T

    The formula is the incoherent sum of intensities (Born and Wolf, Principles of Optics, Section 7.6). Like renderers,
    the formula uses the mean of both polarisations at each surface. A path of K pairs has 4 + 2 K edges. The plane is
    so far away that it reflects no light back to the slab, and the edges of the slab do not matter.
    """
    rho, E, tau, r = (np.broadcast_to(np.asarray(v, float), 3) for v in (albedo, radiance, transmittance, reflectance))
    R = float(fresnel(np.array(angle), ior))
    powers = np.arange((max_depth - 4) // 2 + 1)[:, None]
    q = (r * R) ** 2
    series, d_series = np.sum(q**powers, 0), np.sum(powers * q ** np.maximum(powers - 1, 0), 0) * 2 * r * R**2
    L = rho / np.pi * E * np.cos(angle) * (tau * (1 - R)) ** 2 * series
    pixel = np.ones((size, size, 1))
    slopes = {"albedo": L / rho, "radiance": L / E, "transmittance": 2 * L / tau, "reflectance": L * d_series / series}
    return Known(pixel * L, {name: pixel * slope for name, slope in slopes.items()})


def fresnel(theta: Array, ior: float) -> Array:
    """Reflectance for unpolarised light at a flat surface of relative index `ior`, from outside (Fresnel, 1823)."""
    sin_2, cos_1 = np.sin(theta) / ior, np.cos(theta)
    cos_2 = np.sqrt(1 - sin_2**2)
    s = (cos_1 - ior * cos_2) / (cos_1 + ior * cos_2)
    p = (ior * cos_1 - cos_2) / (ior * cos_1 + cos_2)
    return (s**2 + p**2) / 2


def plane_points(height: float, fov: float, size: int, order: int = 8) -> tuple[Array, Array]:
    """Return points (H, W, order^2, 3) on the plane y = 0, and their quadrature weights (order^2,). A camera above the
    plane sees the points.

    The camera is at (0, `height`, 0), looks down, and has -z at its upper edge. `fov` is in degrees. The film position
    of a point is linear in x and z. The points are Gauss-Legendre nodes of the pixels, and the weights sum to 1.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order)
    half = height * np.tan(np.deg2rad(fov) / 2)
    film = (np.arange(size)[:, None] + (nodes + 1) / 2) / size  # (size, order)
    at = half * (2 * film - 1)
    x, z = np.broadcast_arrays(at[None, :, None, :], at[:, None, :, None])
    points = np.stack([x, np.zeros_like(x), z], -1).reshape(size, size, order * order, 3)
    return points, np.outer(weights, weights).ravel() / 4
