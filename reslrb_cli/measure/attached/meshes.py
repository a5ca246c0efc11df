"""Smooth meshes, and fields that displace their vertices smoothly."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Waves of a surface: wave vectors, phases, and amplitudes for a mean slope of about 0.1.
WAVES = (((5.1, 2.3), 0.4, 0.0135), ((-3.7, 5.9), 1.9, 0.012), ((7.9, -4.6), 4.1, 0.0062), ((2.2, -8.8), 2.7, 0.0055))


def waves(x: Array, z: Array) -> Array:
    """Heights of a surface with smooth waves."""
    return sum((a * np.sin(kx * x + kz * z + phase) for (kx, kz), phase, a in WAVES), np.zeros_like(x))


def mesh(positions: Array, faces: Array, bsdf: dict, texcoords: Array | None = None) -> Any:
    """A mesh with interpolated normals, of vertices (V, 3) and triangles (F, 3)."""
    import mitsuba as mi

    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh("mesh", len(positions), len(faces), has_vertex_normals=True,
                    has_vertex_texcoords=texcoords is not None, props=properties)  # fmt: skip
    params = mi.traverse(shape)
    params["vertex_positions"] = np.ravel(positions).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    if texcoords is not None:
        params["vertex_texcoords"] = np.ravel(texcoords).astype(np.float32)
    params.update()
    shape.recompute_vertex_normals()
    return shape


def grid(cells: int, height: Callable[[Array, Array], Array], half: float = 1.0, wide: float = 0.0
         ) -> tuple[Array, Array, Array]:  # fmt: skip
    """A sheet over [-half, half]^2 in x and z that faces up: vertices, triangles, texture coordinates.

    With `wide` cells grow towards the rim, by the hyperbolic sine of up to so much: fine in the middle, and far out.
    """
    at = np.linspace(-1, 1, cells + 1)
    axis = half * (np.sinh(wide * at) / np.sinh(wide) if wide else at)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    u, v = np.meshgrid((at + 1) / 2, (at + 1) / 2, indexing="ij")
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, c, b), (a, d, c))])
    return np.stack([x, height(x, z), z], -1).reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2)


def ball(radius: float, center: tuple[float, float, float], levels: int = 4, inward: bool = False
         ) -> tuple[Array, Array]:  # fmt: skip
    """A sphere of 20 * 4^levels triangles that faces outward, or `inward`: vertices and triangles."""
    golden = (1 + 5**0.5) / 2
    corners = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    points = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners], float)
    points /= np.linalg.norm(points[0])
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 1.1
    faces = np.array([(a, b, c) for a in range(12) for b in range(a) for c in range(b)
                      if near[a, b] and near[b, c] and near[a, c]])  # fmt: skip
    for _ in range(levels):
        points, faces = _divided(points, faces)
    p, q, r = (points[faces[:, k]] for k in range(3))
    outward = np.sum(np.cross(q - p, r - p) * p, 1) > 0
    faces = np.where((outward != inward)[:, None], faces, faces[:, ::-1])
    return points * radius + np.array(center), faces


def _divided(points: Array, faces: Array) -> tuple[Array, Array]:
    """Each triangle divided into four, all vertices on the unit sphere."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    unique, number = np.unique(edges, axis=0, return_inverse=True)
    middles = points[unique].sum(1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = np.split(number.ravel() + len(points), 3)
    a, b, c = faces.T
    divided = [np.stack(corners, 1) for corners in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([points, middles]), np.concatenate(divided)


def smooth_fields(positions: Array, count: int, span: float, seed: int = 5) -> Array:
    """Random smooth displacements of unit size in all three directions: (count, V, 3).

    Each is a wave, a few of which have room in `span`, along a random direction.
    """
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        direction, wave = random.normal(size=3), random.normal(size=3)
        wave *= random.uniform(1.5, 5.0) / span / np.linalg.norm(wave)
        field = np.cos(positions @ wave + random.uniform(0, 2 * np.pi))
        found.append(field[:, None] * direction / np.linalg.norm(direction))
    return np.stack(found)
