"""Lamps that samples hardly find, or not at all, and whose images are known: specks, and those with black texels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reslrb_cli.measure.analytic import Array, Known, plane_points
from reslrb_cli.measure.analytic_scenes import KnownScene, camera
from reslrb_cli.measure.small_scenes import SIZE, diffuse, rgb, transform

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
