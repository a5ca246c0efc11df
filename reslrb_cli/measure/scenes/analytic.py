"""Scenes whose images are known in closed form, with the derivatives of every pixel.

An image is what a box filter gives: the mean radiance over each pixel. All parameters here are colours, and each
channel of the image depends on the same channel of a parameter alone.

- `KnownScene`: a scene, as `mi.load_dict` takes it, beside its reference: `furnace_scene` and those after it.
- `speck_in_view`, `texels_over_plane`: lamps that samples hardly find, or not at all, and whose images are known:
  specks, and those with black texels.
- `furnace`, `point_over_plane`, `point_through_surface`, `beam_through_slab`: the images, in closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reslrb_cli.measure.scenes.small import SIZE, diffuse, rgb, transform

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """An image (H, W, 3), and its derivative with respect to each parameter, (H, W, 3), by a name of its own."""

    image: Array
    derivatives: dict[str, Array]

    def gradient(self, weights: ArrayLike) -> dict[str, Array]:
        """Gradient (3,) of sum(image * weights) for each parameter; `weights` are (H, W, 3)."""
        return {name: np.sum(np.asarray(weights, np.float64) * d, (0, 1)) for name, d in self.derivatives.items()}


@dataclass(frozen=True)
class KnownScene:
    """A scene, its image, and which parameter key each derivative of the image belongs to."""

    scene: Callable[[], dict]
    known: Known
    keys: dict[str, str]
    max_depth: int

    def gradient(self, weights: Any) -> np.ndarray:
        """Gradient of sum(image * weights) in a row, parameters in the order of `keys`."""
        gradients = self.known.gradient(weights)
        return np.concatenate([gradients[name] for name in self.keys])


def camera(origin: list, target: list, up: list, fov: float, size: int = SIZE) -> dict:
    """A pinhole camera whose image is a box filter's."""
    import mitsuba as mi

    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=up),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }


def _plane(bsdf: dict, y: float = 0) -> dict:
    """A horizontal square of side 4 that faces up."""
    return {"type": "rectangle", "bsdf": bsdf, "to_world": transform(translate=[0, y, 0], rotate=([1, 0, 0], -90),
                                                                     scale=2)}  # fmt: skip


def furnace_scene(albedo: tuple, emission: tuple, max_depth: int, size: int = SIZE) -> KnownScene:
    """The inside of a cube: Mitsuba's `path` is a quarter of a percent off in a sphere that it samples from inside."""

    def scene() -> dict:
        walls = {"type": "cube", "flip_normals": True, "bsdf": diffuse(*albedo),
                 "emitter": {"type": "area", "radiance": rgb(*emission)}}  # fmt: skip
        return {"type": "scene", "camera": camera([0, 0.1, 0.4], [0.2, 0, -1], [0, 1, 0], 60, size), "walls": walls}

    keys = {"albedo": "walls.bsdf.reflectance.value", "emission": "walls.emitter.radiance.value"}
    return KnownScene(scene, furnace(albedo, emission, max_depth, size), keys, max_depth)


def plane_scene(albedo: tuple = (0.7, 0.5, 0.3), intensity: tuple = (2, 3, 4), size: int = SIZE) -> KnownScene:
    """A point light over a plane, off the camera's axis."""
    light = (0.4, 0.8, -0.3)

    def scene() -> dict:
        return {
            "type": "scene",
            "camera": camera([0, 1.5, 0], [0, 0, 0], [0, 0, -1], 50, size),
            "light": {"type": "point", "position": list(light), "intensity": rgb(*intensity)},
            "plane": _plane(diffuse(*albedo)),
        }

    keys = {"albedo": "plane.bsdf.reflectance.value", "intensity": "light.intensity.value"}
    return KnownScene(scene, point_over_plane(albedo, intensity, light, 1.5, 50, size), keys, 2)


def refraction_scene(
    albedo: tuple = (0.7, 0.5, 0.3), intensity: tuple = (9, 6, 5), tau: tuple = (0.9, 0.8, 0.6), ior: float = 1.5,
    light: tuple = (0.3, 1.6, -0.2), size: int = SIZE,
) -> KnownScene:  # fmt: skip
    """A point light over a pool, whose bottom a camera sees from inside of it."""

    def scene() -> dict:
        glass = {"type": "dielectric", "int_ior": ior, "ext_ior": 1.0, "specular_transmittance": rgb(*tau)}
        return {
            "type": "scene",
            "camera": camera([0, 0.9, 0], [0, 0, 0], [0, 0, -1], 60, size),
            "light": {"type": "point", "position": list(light), "intensity": rgb(*intensity)},
            "plane": _plane(diffuse(*albedo)),
            "surface": _plane(glass, 1.0),
        }

    keys = {
        "albedo": "plane.bsdf.reflectance.value",
        "intensity": "light.intensity.value",
        "transmittance": "surface.bsdf.specular_transmittance.value",
    }
    known = point_through_surface(albedo, intensity, tau, ior, light, 1.0, 0.9, 60, size)
    return KnownScene(scene, known, keys, 3)


def slab_scene(
    albedo: tuple = (0.7, 0.5, 0.3), radiance: tuple = (2, 3, 4), tau: tuple = (0.9, 0.8, 0.7),
    reflectance: tuple = (0.9, 0.6, 0.8), ior: float = 1.5, degrees: float = 40, max_depth: int = 6, size: int = SIZE,
) -> KnownScene:  # fmt: skip
    """A parallel beam through a slab on a plane far below it, seen from the side."""
    distance, angle = 40.0, np.deg2rad(degrees)
    direction = np.array([np.sin(angle), -np.cos(angle), 0])
    start = -3 * direction

    def scene() -> dict:
        import mitsuba as mi

        glass = {"type": "dielectric", "int_ior": ior, "ext_ior": 1.0, "specular_transmittance": rgb(*tau),
                 "specular_reflectance": rgb(*reflectance)}  # fmt: skip
        toward = mi.ScalarTransform4f().look_at(origin=start.tolist(), target=[0, 0, 0], up=[0, 0, 1])
        below = [distance * np.tan(angle), -distance, 0.0]
        beside = [below[0] - 1.5, -distance + 3, 2.0]
        return {
            "type": "scene",
            "camera": camera(beside, below, [0, 1, 0], 12, size),
            "lamp": {"type": "rectangle", "to_world": toward, "bsdf": diffuse(0, 0, 0),
                     "emitter": {"type": "directionalarea", "radiance": rgb(*radiance)}},
            # The lower surface faces down: the glass is between them.
            "top": {"type": "rectangle", "bsdf": glass | {"id": "glass"},
                    "to_world": transform(translate=[0, 0.025, 0], rotate=([1, 0, 0], -90), scale=3)},
            "bottom": {"type": "rectangle", "bsdf": {"type": "ref", "id": "glass"},
                       "to_world": transform(translate=[0, -0.025, 0], rotate=([1, 0, 0], 90), scale=3)},
            "plane": {"type": "rectangle", "bsdf": diffuse(*albedo),
                      "to_world": transform(translate=below, rotate=([1, 0, 0], -90), scale=6)},
        }  # fmt: skip

    keys = {
        "albedo": "plane.bsdf.reflectance.value",
        "radiance": "lamp.emitter.radiance.value",
        "transmittance": "top.bsdf.specular_transmittance.value",
        "reflectance": "top.bsdf.specular_reflectance.value",
    }
    known = beam_through_slab(albedo, radiance, tau, reflectance, ior, float(angle), max_depth, size)
    return KnownScene(scene, known, keys, max_depth)


FOV = 50


RADIANCE = "lamp.emitter.radiance"


#: Where the lamp over the plane is, beside what the camera sees: middle and half of its side.
MIDDLE, HALF = (1.0, 0.8, -0.2), 0.3


#: The plane's albedo.
ALBEDO = (0.7, 0.5, 0.3)


def covered(center: tuple[float, float], side: float, distance: float, size: int) -> Array:
    """The share of each pixel, (H, W, 1), that a square of `side` covers, parallel to the film and so far away.

    Its `center` is in world units, x to the right and y upwards. Similar triangles.
    """
    pixel = 2 * distance * np.tan(np.deg2rad(FOV) / 2) / size
    edges = np.arange(size + 1)

    def shares(middle: float) -> Array:
        low, high = (size / 2 + (middle + sign * side / 2) / pixel for sign in (-1, 1))
        return np.clip(np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1]), 0, None)

    return np.outer(shares(-center[1]), shares(center[0]))[..., None]


def speck_in_view(side: float, radiance: tuple = (3, 2, 4), size: int = SIZE) -> KnownScene:
    """A square lamp across the border of two pixels, before a wall that it does not light."""
    distance = 2.0
    pixel = 2 * distance * np.tan(np.deg2rad(FOV) / 2) / size
    center = (pixel + 0.2 * side, 0.6 * pixel)  # 0.7 of it to the right of a border
    share = covered(center, side, distance, size)

    def scene() -> dict[str, Any]:
        # The camera looks along -z: x goes to the right, and the lamp faces it.
        lamp = {"type": "rectangle", "to_world": transform(translate=[*center, -distance], scale=side / 2),
                "bsdf": diffuse(0, 0, 0), "emitter": {"type": "area", "radiance": rgb(*radiance)}}  # fmt: skip
        wall = {"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5), "to_world": transform(translate=[0, 0, -4],
                                                                                           scale=6)}  # fmt: skip
        return {"type": "scene", "camera": camera([0, 0, 0], [0, 0, -1], [0, 1, 0], FOV, size), "lamp": lamp,
                "wall": wall}  # fmt: skip

    known = Known(share * np.array(radiance), {"radiance": np.repeat(share, 3, axis=-1)})
    return KnownScene(scene, known, {"radiance": f"{RADIANCE}.value"}, 4)


def texels_over_plane(texels: ArrayLike, size: int = SIZE) -> KnownScene:
    """A square lamp with these texels, (N, N, 3), over a diffuse plane that a camera sees without the lamp.

        L(x) = rho / pi * sum_t Le_t int_t h^2 / d^4 dA

    Lambert's law, with both surfaces horizontal, h apart; Gauss-Legendre nodes in pixels and in texels.
    """
    radiance = np.asarray(texels, np.float64)
    count = len(radiance)
    points, weights = plane_points(1.5, FOV, size, order=4)
    nodes, own = np.polynomial.legendre.leggauss(4)
    at = HALF * (2 * (np.arange(count)[:, None] + (nodes + 1) / 2) / count - 1)  # along a side, (N, 4)
    area = np.outer(own, own) / 4 * (2 * HALF / count) ** 2
    factors = np.zeros((count, count, size, size, 1))
    for row in range(count):
        for column in range(count):
            x, z = MIDDLE[0] + at[column][None, :], MIDDLE[2] + at[row][:, None]
            aside = (points[..., 0, None, None] - x) ** 2 + (points[..., 2, None, None] - z) ** 2
            received = np.sum(area * MIDDLE[1] ** 2 / (aside + MIDDLE[1] ** 2) ** 2, (-2, -1))
            factors[row, column] = np.sum(received * weights, -1)[..., None] / np.pi

    def scene() -> dict[str, Any]:
        import mitsuba as mi

        texture = {"type": "bitmap", "bitmap": mi.Bitmap(radiance.astype(np.float32)), "raw": True,
                   "format": "variant", "filter_type": "nearest"}  # fmt: skip
        down = transform(translate=list(MIDDLE), rotate=([1, 0, 0], 90), scale=HALF)
        plane = {"type": "rectangle", "bsdf": diffuse(*ALBEDO), "to_world": transform(rotate=([1, 0, 0], -90),
                                                                                      scale=4)}  # fmt: skip
        return {
            "type": "scene",
            "camera": camera([0, 1.5, 0], [0, 0, 0], [0, 0, -1], FOV, size),
            "lamp": {"type": "rectangle", "to_world": down, "bsdf": diffuse(0, 0, 0),
                     "emitter": {"type": "area", "radiance": texture}},
            "plane": plane,
        }  # fmt: skip

    flat = factors.reshape(-1, size, size, 1)
    by_albedo = np.tensordot(radiance.reshape(-1, 3), flat[..., 0], (0, 0)).transpose(1, 2, 0)
    derivatives = {"albedo": by_albedo} | {f"texel {k}": factor * np.array(ALBEDO) for k, factor in enumerate(flat)}
    keys = {"albedo": "plane.bsdf.reflectance.value"} | {f"texel {k}": f"{RADIANCE}.data" for k in range(len(flat))}
    return KnownScene(scene, Known(by_albedo * np.array(ALBEDO), derivatives), keys, 2)


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
