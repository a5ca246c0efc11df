"""Edges of shapes: curves where a shape can start or stop to block a ray.

A table of edges (`EdgeTable`) has one row per edge, of three kinds.

- `SEGMENT`: an edge of a mesh or of a rectangle, or a chord of the rim of a disk or a cylinder.
- `SPHERE`: a sphere. Its outline is the circle where rays from a viewpoint touch it.
- `TUBE`: the side of a cylinder. Its outline is the two lines where rays from a viewpoint touch it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.scene.graph import interpolates_normals

Array = np.ndarray[Any, Any]

SEGMENT, SPHERE, TUBE = range(3)
#: Number of chords that approximate a circle. The distance between a chord and its arc is at most 2e-5 of the radius.
CHORDS = 512
#: Vertices count as one vertex if their distance, divided by the size of the mesh, is below this value.
WELD = 1e-6


@dataclass
class EdgeTable:
    """Current edges of moving shapes, one per row. A recording takes the arrays as inputs.

    - `kind` is `SEGMENT`, `SPHERE` or `TUBE`.
    - `a` and `b` are the ends of a segment, or of a cylinder's axis. For a sphere, `a` is the centre.
    - `c` and `d` are the third corners of the two faces at a segment. They are equal if the segment has one face.
    - `radius` is the radius of a sphere or a cylinder, otherwise 0.
    - `shape` is the index of the shape's pointer.
    - `crease` is the angle between the normals of the two faces, divided by pi. It is 0 if the edge has only one face,
        or if the shape interpolates its normals across the edge.
    - `lamp`, `sensor` and `anywhere` are cumulative sampling weights: for outlines and creases seen from lamps, and for
        outlines seen from the sensor and from all directions.
    """

    kind: mi.UInt32
    a: mi.Point3f
    b: mi.Point3f
    c: mi.Point3f
    d: mi.Point3f
    radius: mi.Float
    shape: mi.UInt32
    crease: mi.Float
    lamp: mi.Float
    sensor: mi.Float
    anywhere: mi.Float


@dataclass
class _Mesh:
    """Edges of a mesh, as vertex indices (`welded_edges`)."""

    shape: mi.Shape
    corners: list[mi.UInt32]

    def rows(self) -> list[mi.Point3f]:
        """Return the current a, b, c and d of all edges."""
        positions = dr.detach(self.shape.vertex_positions_buffer())
        return [dr.gather(mi.Point3f, positions, index) for index in self.corners[:4]]

    def creases(self, rows: list[mi.Point3f]) -> mi.Float:
        """Return the angle between the normals of the two faces at each edge, divided by pi. If normals are
        interpolated, it is the angle between the shading normals.
        """
        a, b, c, d = rows
        angle = dr.pi - turned(b - a, c - a, d - a)
        if interpolates_normals(self.shape):
            buffer = dr.detach(self.shape.vertex_normals_buffer())
            i, j, _, _, i_2, j_2 = (dr.normalize(dr.gather(mi.Vector3f, buffer, index)) for index in self.corners)
            angle = dr.maximum(angle_between(i, i_2), angle_between(j, j_2))
        single = self.corners[2] == self.corners[3]
        return dr.select(single | ~dr.isfinite(angle), 0, angle * dr.inv_pi)


@dataclass
class _Curves:
    """Edges of an analytic shape. `corners` are the points a, b, c and d of each edge, in the shape's coordinates."""

    shape: mi.Shape
    corners: list[mi.Point3f]

    def rows(self) -> list[mi.Point3f]:
        """Return the current a, b, c and d of all edges."""
        to_world = dr.detach(mi.traverse(self.shape)["to_world"])
        return [to_world @ corner for corner in self.corners]


def has_edges(shape: mi.Shape) -> bool:
    """True if this module knows the edges of this kind of shape. The edges of lamps are left out."""
    known = shape.is_mesh() or shape.class_name() in ("Rectangle", "Disk", "Sphere", "Cylinder")
    return known and not shape.is_emitter()


def edge_kinds(shapes: Iterable[mi.Shape]) -> frozenset[int]:
    """Return the kinds of edges that these shapes have."""
    kinds = {"Sphere": {SPHERE}, "Cylinder": {SEGMENT, TUBE}}
    return frozenset(kind for shape in shapes for kind in kinds.get(shape.class_name(), {SEGMENT}))


class EdgeSet:
    """Edges of the given shapes of a scene. Shapes without known edges are ignored.

    The topology of meshes is read once. `now` returns a table of the current places.
    """

    def __init__(self, shapes: Iterable[mi.Shape]) -> None:
        self._parts: list[_Mesh | _Curves] = []
        self._round: list[tuple[int, mi.Shape]] = []
        for shape in shapes:
            name = shape.class_name()
            if name == "Sphere":
                self._round.append((SPHERE, shape))
            elif name == "Cylinder":
                self._round.append((TUBE, shape))
                self._parts += [_Curves(shape, _rim(z, 1.0, 0.5)) for z in (0.0, 1.0)]
            elif name == "Disk":
                self._parts.append(_Curves(shape, _rim(0.0, 0.0, 0.0)))
            elif name == "Rectangle":
                self._parts.append(_Curves(shape, _frame()))
            elif shape.is_mesh():
                positions = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
                edges = welded_edges(positions, np.array(shape.faces_buffer()).reshape(-1, 3))
                self._parts.append(_Mesh(shape, [own_memory(mi.UInt32, np.ascontiguousarray(e)) for e in edges.T]))

    def now(self) -> EdgeTable:
        """Return the current edges. All their sampling weights are lengths, and not cumulative."""
        with dr.suspend_grad():
            corners: list[list[mi.Point3f]] = []
            kinds, radii, shapes, creases = [], [], [], []
            for part in self._parts:
                rows = part.rows()
                n = dr.width(rows[0])
                corners.append(rows)
                creases.append(part.creases(rows) if isinstance(part, _Mesh) else dr.zeros(mi.Float, n))
                kinds.append(dr.full(mi.UInt32, SEGMENT, n))
                radii.append(dr.zeros(mi.Float, n))
                shapes.append(dr.full(mi.UInt32, _index(part.shape), n))
            for kind, shape in self._round:
                to_world = dr.detach(mi.traverse(shape)["to_world"])
                a, b = to_world @ mi.Point3f(0), to_world @ mi.Point3f(0, 0, 1)
                corners.append([a, b, a, a])
                creases.append(mi.Float(0))
                kinds.append(dr.full(mi.UInt32, kind, 1))
                radii.append(dr.norm(to_world @ mi.Vector3f(1, 0, 0)))
                shapes.append(dr.full(mi.UInt32, _index(shape), 1))
            a, b, c, d = (mi.Point3f(*(dr.concat([p[axis] for p in points]) for axis in range(3)))
                          for points in zip(*corners, strict=True))  # fmt: skip
            kind, radius = dr.concat(kinds), dr.concat(radii)
            length = dr.select(kind == SPHERE, dr.two_pi * radius, 2 * dr.norm(b - a))
            length = dr.select(kind == SEGMENT, dr.norm(b - a), length)
            return EdgeTable(kind, a, b, c, d, radius, dr.concat(shapes), dr.concat(creases), length, length, length)


def _index(shape: mi.Shape) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def across(along: mi.Vector3f, corner: mi.Vector3f) -> mi.Vector3f:
    """Return the unit vector from an edge to a corner, perpendicular to the edge."""
    return dr.normalize(corner - along * (dr.dot(along, corner) / dr.squared_norm(along)))


def turned(along: mi.Vector3f, c: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    """Return the angle in [0, pi] between the faces with the corners `c` and `d` at an edge."""
    return angle_between(across(along, c), across(along, d))


def angle_between(first: mi.Vector3f, second: mi.Vector3f) -> mi.Float:
    """Return the angle between unit vectors."""
    return 2 * dr.atan2(dr.norm(first - second), dr.norm(first + second))


def welded_edges(positions: Array, faces: Array) -> Array:
    """Return the edges of a mesh as vertex indices (E, 6).

    The columns are both ends, the third corners of the first and of the second face, and both ends in the second face.
    Vertices at the same place are one vertex. An edge with one face repeats the first face. An edge with more than two
    faces has a row for each pair of them. `positions` is (V, 3), and `faces` is (F, 3).
    """
    size = float(np.ptp(positions, axis=0).max()) or 1.0
    _, vertex = np.unique(np.round(positions / (WELD * size)), axis=0, return_inverse=True)
    vertex = vertex.ravel()
    corners = np.concatenate([faces[:, [0, 1, 2]], faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
    ends = np.sort(vertex[corners[:, :2]], axis=1)
    corners, ends = corners[ends[:, 0] != ends[:, 1]], ends[ends[:, 0] != ends[:, 1]]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    corners, ends = corners[order], ends[order]
    begins = np.r_[True, np.any(ends[1:] != ends[:-1], axis=1)]
    number = np.arange(len(ends)) - np.maximum.accumulate(np.where(begins, np.arange(len(ends)), 0))
    odd = number % 2 == 1
    # The second face is that of the next row, if it has the same ends.
    second = np.where(np.r_[odd[1:], False][:, None], np.roll(corners, -1, 0), corners)
    same = vertex[second[:, 0]] == vertex[corners[:, 0]]
    other_ends = np.where(same[:, None], second[:, :2], second[:, 1::-1])
    return np.column_stack([corners, second[:, 2], other_ends])[~odd].astype(np.uint32)


def _rim(z: float, inner_radius: float, inner_z: float) -> list[mi.Point3f]:
    """Return chords of the unit circle at height `z`. The face at each chord extends to the circle of radius
    `inner_radius` at height `inner_z`.
    """
    angle = np.linspace(0, 2 * np.pi, CHORDS + 1)
    points = np.stack([np.cos(angle), np.sin(angle), np.full_like(angle, z)], 1)
    inner = np.stack([inner_radius * np.cos(angle), inner_radius * np.sin(angle), np.full_like(angle, inner_z)], 1)
    return _corners(points[:-1], points[1:], inner[:-1])


def _frame() -> list[mi.Point3f]:
    """Return the edges of a rectangle."""
    points = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return _corners(points, np.roll(points, -1, 0), np.zeros((4, 3)))


def _corners(a: Array, b: Array, c: Array) -> list[mi.Point3f]:
    return [mi.Point3f(*(own_memory(mi.Float, np.ascontiguousarray(column, np.float32)) for column in points.T))
            for points in (a, b, c, c)]  # fmt: skip
