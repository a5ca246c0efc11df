"""Rays through a face, traced one by one. The formulas differ from the formulas that shaped the face."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from reslrb_cli.lens.surface import Surface

Array = NDArray[np.float64]


def turned(vector: list[float], degrees: float) -> Array:
    """Return `vector` rotated about y, from z towards x."""
    a = np.radians(degrees)
    x, y, z = vector
    return np.array([x * np.cos(a) + z * np.sin(a), y, z * np.cos(a) - x * np.sin(a)])


def bent(d: Array, normal: Array, ratio: float) -> tuple[Array, Array]:
    """Return directions (3, n) after Snell's law, and the transmitted fraction. `ratio` is the index before over the
    index behind.

    The tangential part of a direction grows by `ratio`. The transmitted fraction follows from the angles.
    """
    along = np.sum(d * normal, axis=0)
    tangent = ratio * (d - along * normal)
    sine2 = np.sum(tangent**2, axis=0)
    out = tangent + np.sqrt(1 - sine2) * normal
    i, t = np.arccos(np.clip(along, -1, 1)), np.arcsin(np.sqrt(sine2))
    i, t = np.maximum(i, 1e-6), np.maximum(t, 1e-6 * ratio)
    s = (np.sin(i - t) / np.sin(i + t)) ** 2
    p = (np.tan(i - t) / np.tan(i + t)) ** 2
    return out, 1 - (s + p) / 2


def caustic(made: Surface, shape: tuple[int, int], rays: int = 400, wider: float = 1.0) -> Array:
    """Return the picture (rows, columns) that light casts on the receiver, as an observer sees the receiver. Values are
    light per pixel.

    With `wider`, the receiver is larger by this factor and is divided into `shape` pixels.
    """
    s = made.setting
    width, height = s.size
    ny, nx = made.heights.shape
    x = ((np.arange(nx) + 0.5) / nx - 0.5) * width
    y = ((np.arange(ny) + 0.5) / ny - 0.5) * height
    face = RectBivariateSpline(y, x, made.heights)

    lens = s.kind == "lens"
    toward = turned([0, 0, 1], s.incidence) if lens else turned([0, 0, -1], -s.incidence)
    first = -s.thickness if lens else made.heights.max() + 5  # a plane that all rays cross before the face
    spread = 1.3
    at = (np.arange(rays) + 0.5) / rays - 0.5
    px, py = (a.ravel() for a in np.meshgrid(at * width * spread, at * height * spread))
    if np.isfinite(s.light_distance):
        source = -toward * s.light_distance - (np.array([0, 0, s.thickness]) if lens else 0)
        points = np.stack([px, py, np.full_like(px, first)])
        way = points - source[:, None]
        far = np.sqrt((way**2).sum(0))
        d = way / far
        light = np.abs(d[2]) / far**2
    else:
        shift = first * toward / toward[2]
        points = np.stack([px + shift[0], py + shift[1], np.full_like(px, first)])
        d = np.repeat(toward[:, None], px.size, 1)
        light = np.ones(px.size)
    if lens:
        d, passes = bent(d, np.repeat(np.array([[0.0], [0], [1]]), px.size, 1), 1 / s.ior)
        light = light * passes
    t = (0 - points[2]) / d[2]
    for _ in range(8):  # finds the point where the ray meets the face
        p = points + t * d
        t = t + (face.ev(p[1], p[0]) - p[2]) / d[2]
    p = points + t * d
    if s.outline == "round":
        meets = (p[0] / width) ** 2 + (p[1] / height) ** 2 < 0.25
    else:
        meets = (abs(p[0]) < width / 2) & (abs(p[1]) < height / 2)
    p, d, light = p[:, meets], d[:, meets], light[meets]
    normal = np.stack([-face.ev(p[1], p[0], dy=1), -face.ev(p[1], p[0], dx=1), np.ones(p.shape[1])])
    normal /= np.sqrt((normal**2).sum(0))
    if lens:
        d, passes = bent(d, normal, s.ior)
        light = light * passes
        forward = turned([0, 0, 1], s.incidence)
    else:
        d = d - 2 * np.sum(d * normal, axis=0) * normal
        forward = turned([0, 0, 1], s.incidence)
    if lens and np.isfinite(s.light_distance):
        assert s.incidence == 0
    # The receiver's frame looks along the central ray, nodded and turned
    right, up = -turned([1, 0, 0], s.incidence), np.array([0.0, 1, 0])
    nod, turn = np.radians(s.tilt)
    up, ahead = np.cos(nod) * up + np.sin(nod) * forward, np.cos(nod) * forward - np.sin(nod) * up
    right, ahead = np.cos(turn) * right + np.sin(turn) * ahead, np.cos(turn) * ahead - np.sin(turn) * right
    offset = p - (forward * s.distance)[:, None]
    landed = offset - (ahead @ offset) / (ahead @ d) * d
    columns, rows = right @ landed, -(up @ landed)
    w, h = s.picture_size[0] * wider, s.picture_size[1] * wider
    column, row = (columns / w + 0.5) * shape[1] - 0.5, (rows / h + 0.5) * shape[0] - 0.5
    result = np.zeros((shape[0] + 2, shape[1] + 2))  # rays are a pixel wide, and a border takes light just outside
    seen = (column > -0.5) & (column < shape[1] - 0.5) & (row > -0.5) & (row < shape[0] - 0.5)
    column, row, light = column[seen] + 1, row[seen] + 1, light[seen]
    i, j = column.astype(int), row.astype(int)
    for dj, down in ((0, 1 - row + j), (1, row - j)):
        for di, across in ((0, 1 - column + i), (1, column - i)):
            np.add.at(result, (j + dj, i + di), light * down * across)
    for axis in (0, 1):  # light in the border is added to the edge pixels
        result = np.moveaxis(result, axis, 0)
        result[1] += result[0]
        result[-2] += result[-1]
        result = np.moveaxis(result[1:-1], 0, axis)
    return result
