"""Edges of shapes: curves where a shape can start or stop to block a ray.

A table of edges (`EdgeTable`) has one row per edge. The edges of moving shapes come first. The edges of shapes that do
not move follow, because these shapes can hide a moving surface. A row has one of three kinds.

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
#: Number of chords that approximate a circle. The distance between a chord and its arc is at most 1.2e-6 of the radius.
#: This must be smaller than `BESIDE` in `estimators/outline_rays.py`, the distance of the rays beside an edge.
CHORDS = 2048
#: Vertices count as one vertex if their distance, divided by the size of the mesh, is below this value.
WELD = 1e-6
#: Number of random rays that test whether light passes an edge, and maximum number of edges that are tested.
RAYS, MOST_TESTED = 64, 2**15
#: Distance of these rays from the edge, relative to the coordinates, and the length below which a ray hits something
#: soon, in units of this distance.
BESIDE, SOON = 3e-6, 300.0
#: Faces are parallel if the angle between their normals, divided by pi, is below this value.
FLAT = 1e-4
#: Maximum number of balls around moving shapes. More shapes share one ball.
MOST_BALLS = 8


@dataclass
class Ball:
    """A ball that contains a moving shape. Both members have one entry."""

    center: mi.Point3f
    radius: mi.Float

    @staticmethod
    def around(points: mi.Point3f, radius: mi.Float) -> Ball:
        """Return a ball around balls of the given radii at `points`."""
        center = mi.Point3f(*(0.5 * (dr.min(axis) + dr.max(axis)) for axis in points))
        return Ball(center, 1.01 * dr.max(dr.norm(points - center) + radius))

    def cosine(self, p: mi.Point3f) -> mi.Float:
        """Return the cosine of half the opening angle of the cone from `p` around the ball, or -1 inside the ball."""
        ratio = dr.square(self.radius) / dr.squared_norm(self.center - p)
        return dr.select(ratio < 1, dr.sqrt(1 - ratio), -1)

    def frame(self, p: mi.Point3f) -> mi.Frame3f:
        """Return a frame whose normal leads from `p` to the centre of the ball."""
        return mi.Frame3f(dr.normalize(self.center - p))


@dataclass
class _Rows:
    """Edges, one per row.

    - `kind` is `SEGMENT`, `SPHERE` or `TUBE`.
    - `a` and `b` are the ends of a segment, or of a cylinder's axis. For a sphere, `a` is the centre.
    - `c` and `d` are the third corners of the two faces at a segment. They are equal if the segment has one face.
    - `radius` is the radius of a sphere or a cylinder, otherwise 0.
    - `shape` is the index of the shape's pointer.
    - `crease` is the angle between the normals of the two faces, divided by pi. It is negative if the shape
        interpolates its normals across the edge. It is 0 if it would be below `FLAT`, or if the edge has only one
        face.
    """

    kind: mi.UInt32
    a: mi.Point3f
    b: mi.Point3f
    c: mi.Point3f
    d: mi.Point3f
    radius: mi.Float
    shape: mi.UInt32
    crease: mi.Float


@dataclass
class FaceTable:
    """Faces of meshes with interpolated normals (`transport/faces.py`).

    The corners `p` have the normals `n`. `shape` is the index of the shape's pointer. `rims` are cumulative sampling
    weights of the faces for rims. `folds` are those of the table's edges for folds.
    """

    p: list[mi.Point3f]
    n: list[mi.Vector3f]
    shape: mi.UInt32
    rims: mi.Float
    folds: mi.Float


@dataclass
class EdgeTable(_Rows):
    """Current edges with sampling weights. A recording takes the arrays as inputs.

    - `moves` is true if the shape moves.
    - `lamp`, `sensor` and `anywhere` are cumulative sampling weights: for outlines and creases seen from lamps, and for
        outlines seen from the sensor and from all directions.

    `balls` contain the moving shapes. If the scene has mirrors or glass, `chains` has cumulative sampling weights of
    specular chains (`estimators/chain_edges.py`). `faces` has the faces of moving meshes with interpolated normals, if
    there are any.
    """

    moves: mi.Bool
    lamp: mi.Float
    sensor: mi.Float
    anywhere: mi.Float
    balls: list[Ball]
    chains: list[mi.Float]
    faces: list[FaceTable]


def number_of(shape: mi.Shape) -> int:
    """Return the index of the shape's pointer."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _rows(shape: mi.Shape, corners: list[mi.Point3f], kind: int = SEGMENT, radius: Any = 0, crease: Any = 0) -> _Rows:
    n, wide = dr.width(corners[0]), dr.zeros(mi.Float, dr.width(corners[0]))
    shapes = dr.full(mi.UInt32, number_of(shape), n)
    a, b, c, d = corners
    return _Rows(dr.full(mi.UInt32, kind, n), a, b, c, d, wide + radius, shapes, wide + crease)


@dataclass
class _Mesh:
    """Edges of a mesh, as vertex indices (`welded_edges`)."""

    shape: mi.Shape
    corners: list[mi.UInt32]

    def rows(self) -> _Rows:
        """Return the current rows."""
        positions = dr.detach(self.shape.vertex_positions_buffer())
        corners = [dr.gather(mi.Point3f, positions, index) for index in self.corners[:4]]
        return _rows(self.shape, corners, crease=self.creases(corners))

    def creases(self, corners: list[mi.Point3f]) -> mi.Float:
        """Return the angle between the normals of the two faces at each edge, divided by pi. If normals are
        interpolated, it is the angle between the shading normals, or, if there is none, minus that of the faces.
        """
        a, b, c, d = corners
        angle = dr.pi - turned(b - a, c - a, d - a)
        if interpolates_normals(self.shape):
            buffer = dr.detach(self.shape.vertex_normals_buffer())
            i, j, _, _, i_2, j_2 = (dr.normalize(dr.gather(mi.Vector3f, buffer, index)) for index in self.corners)
            shading = dr.maximum(angle_between(i, i_2), angle_between(j, j_2))
            angle = dr.select(shading > FLAT * dr.pi, shading, -angle)
        single = self.corners[2] == self.corners[3]
        return dr.select(single | ~(dr.abs(angle) > FLAT * dr.pi), 0, angle * dr.inv_pi)


@dataclass
class _Curves:
    """Edges of an analytic shape. `corners` are the points a, b, c and d of each edge, in the shape's coordinates."""

    shape: mi.Shape
    corners: list[mi.Point3f]

    def rows(self) -> _Rows:
        """Return the current rows."""
        to_world = dr.detach(mi.traverse(self.shape)["to_world"])
        return _rows(self.shape, [to_world @ corner for corner in self.corners])


@dataclass
class _Round:
    """The outline of a sphere, or of the side of a cylinder."""

    shape: mi.Shape
    kind: int

    def rows(self) -> _Rows:
        """Return the current row."""
        to_world = dr.detach(mi.traverse(self.shape)["to_world"])
        a, b = to_world @ mi.Point3f(0), to_world @ mi.Point3f(0, 0, 1)
        return _rows(self.shape, [a, b, a, a], self.kind, dr.norm(to_world @ mi.Vector3f(1, 0, 0)))


def _edges_of(shape: mi.Shape) -> list[_Mesh | _Curves | _Round]:
    """Return the edges of a shape for which `has_edges` is true."""
    name = shape.class_name()
    if name == "Sphere":
        return [_Round(shape, SPHERE)]
    if name == "Cylinder":
        return [_Round(shape, TUBE), *(_Curves(shape, _rim(z, 1.0, 0.5)) for z in (0.0, 1.0))]
    if name == "Disk":
        return [_Curves(shape, _rim(0.0, 0.0, 0.0))]
    if name == "Rectangle":
        return [_Curves(shape, _frame())]
    positions = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    edges = welded_edges(positions, np.array(shape.faces_buffer()).reshape(-1, 3))
    return [_Mesh(shape, [own_memory(mi.UInt32, np.ascontiguousarray(column)) for column in edges.T])]


def joined_points(arrays: Iterable[mi.Point3f]) -> mi.Point3f:
    """Return the points of all arrays in one array."""
    return mi.Point3f(*(dr.concat([*axis]) for axis in zip(*arrays, strict=True)))


def _joined(parts: list[_Rows]) -> _Rows:
    columns = {name: [getattr(part, name) for part in parts] for name in vars(parts[0])}
    return _Rows(**{name: joined_points(each) if name in "abcd" else dr.concat(each) for name, each in columns.items()})


def _ball(parts: list[_Rows]) -> Ball:
    rows = _joined(parts)
    ends = [rows.a, dr.select(rows.kind == SPHERE, rows.a, rows.b)]
    return Ball.around(joined_points(ends), dr.concat([rows.radius, rows.radius]))


def _are_open(rows: _Rows, scene: mi.Scene, balls: list[Ball]) -> mi.Bool:
    """True if an edge can hide a surface from another surface, from a lamp, or from a sensor, or one of the `balls`
    from the sky.

    At a corner of a room, for example, all rays beside the edge of a wall soon hit the other wall. Rays in `RAYS`
    random directions decide.
    """
    if dr.width(rows.a) > MOST_TESTED:
        return mi.Bool(True)
    lane = dr.arange(mi.UInt32, dr.width(rows.a) * RAYS)
    a, b, c, d = (dr.gather(mi.Point3f, corner, lane // RAYS) for corner in (rows.a, rows.b, rows.c, rows.d))
    numbers = mi.PCG32(dr.width(lane))
    p = dr.lerp(a, b, numbers.next_float32())
    along = dr.normalize(b - a)
    to_y, _ = outline_direction(along, c - p, d - p, mi.Point2f(numbers.next_float32(), numbers.next_float32()))
    passes = _passes(scene, p, along, c - p, to_y, None)
    here = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
    here.p = p
    views = [sensor.sample_direction(here, mi.Point2f(0.5))[0] for sensor in scene.sensors()]
    for emitter in scene.emitters():
        sample = mi.Point2f(numbers.next_float32(), numbers.next_float32())
        if emitter.is_environment():
            views += [_sky_before(ball, here, sample) for ball in balls]
        elif not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):  # lamps with a surface count as surfaces
            views.append(emitter.sample_direction(here, sample)[0])
    for ds in views:
        raw = dr.cross(along, ds.d)
        seen = (ds.pdf > 0) & (dr.dot(raw, c - p) * dr.dot(raw, d - p) > 0)
        passes |= seen & _passes(scene, p, along, c - p, ds.d, ds.dist)
    found = dr.block_reduce(dr.ReduceOp.Max, dr.select(passes, mi.UInt32(1), 0), RAYS) != 0
    return found | (rows.kind != SEGMENT)


def _sky_before(ball: Ball, si: mi.SurfaceInteraction3f, sample: mi.Point2f) -> mi.DirectionSample3f:
    """Return a direction from `si` to the sky. The opposite direction leads to the ball."""
    ds = dr.zeros(mi.DirectionSample3f, dr.width(si.p))
    cone = mi.warp.square_to_uniform_cone(sample, ball.cosine(si.p))
    ds.d, ds.dist, ds.pdf = -ball.frame(si.p).to_world(cone), mi.Float(1e30), mi.Float(1)
    return ds


def _passes(
    scene: mi.Scene, p: mi.Point3f, along: mi.Vector3f, corner: mi.Vector3f, to_y: mi.Vector3f, distance: Any
) -> mi.Bool:  # fmt: skip
    """True if a ray beside the point `p` of an edge passes. It must hit surfaces on both sides, or reach a sensor or a
    lamp at `distance` on one side.
    """
    raw = dr.cross(along, -to_y)
    offset = BESIDE * (1 + dr.max(dr.abs(p)))
    start = p - dr.mulsign(raw, dr.dot(raw, corner)) * (offset / dr.norm(raw))
    ahead, back = (scene.ray_intersect_preliminary(mi.Ray3f(start, way), False, mi.Bool(True)) for way in (to_y, -to_y))
    reaches = ahead.is_valid() & (ahead.t > SOON * offset)
    if distance is not None:
        # A sensor may see through lamps.
        reaches = (ahead.t > 0.999 * distance) | (reaches & ahead.shape.is_emitter())
    return reaches & back.is_valid() & (back.t > SOON * offset)


def has_edges(shape: mi.Shape) -> bool:
    """True if this module knows the edges of this kind of shape."""
    return shape.is_mesh() or shape.class_name() in ("Rectangle", "Disk", "Sphere", "Cylinder")


def edge_kinds(shapes: Iterable[mi.Shape]) -> frozenset[int]:
    """Return the kinds of edges that these shapes have."""
    kinds = {"Sphere": {SPHERE}, "Cylinder": {SEGMENT, TUBE}}
    return frozenset(kind for shape in shapes for kind in kinds.get(shape.class_name(), {SEGMENT}))


class EdgeSet:
    """Edges of the `moving` shapes, and of other shapes that can hide a moving shape (`occluders`).

    If `lamps_move` is true, all other shapes with edges are occluders, because their shadows move. The topology of
    meshes and the edges of occluders are read once. `now` returns a table of the current places.
    """

    def __init__(self, moving: tuple[mi.Shape, ...], scene: mi.Scene, lamps_move: bool = False) -> None:
        self.moving = moving
        self._moving = [_edges_of(shape) for shape in moving]
        still = [shape for shape in scene.shapes() if shape not in moving and has_edges(shape)]
        self._still: list[_Rows] = []
        self.occluders: tuple[mi.Shape, ...] = ()
        if not still:
            return
        with dr.suspend_grad():
            rows = _joined([part.rows() for shape in still for part in _edges_of(shape)])
            wanted = mi.Bool(True)
            if not lamps_move:
                wanted = _are_open(rows, scene, [_ball([part.rows() for part in parts]) for parts in self._moving])
            parallel = turned(rows.b - rows.a, rows.c - rows.a, rows.d - rows.a) > dr.pi * (1 - FLAT)
            kept = dr.compress(wanted & ((rows.kind != SEGMENT) | ~parallel))
            if dr.width(kept) > 0:
                rows = dr.gather(_Rows, rows, kept)
                dr.make_opaque(rows)
                self._still = [rows]
                present = set(np.array(rows.shape).tolist())
                self.occluders = tuple(shape for shape in still if number_of(shape) in present)

    def now(self) -> EdgeTable:
        """Return the current edges. The sampling weights are not cumulative yet. They are lengths for lamps and sensor.
        For all directions, they are lengths times the solid angle of the directions that see the edge as an outline.
        """
        with dr.suspend_grad():
            moving = [[part.rows() for part in parts] for parts in self._moving]
            balls = [_ball(rows) for rows in moving]
            if len(balls) > MOST_BALLS:
                centers = joined_points([ball.center for ball in balls])
                balls = [Ball.around(centers, dr.concat([ball.radius for ball in balls]))]
            parts = [rows for each in moving for rows in each]
            moves = [dr.full(mi.Bool, True, dr.width(rows.a)) for rows in parts]
            moves += [dr.full(mi.Bool, False, dr.width(rows.a)) for rows in self._still]
            rows = _joined(parts + self._still)
            length = dr.select(rows.kind == SPHERE, dr.two_pi * rows.radius, 2 * dr.norm(rows.b - rows.a))
            length = dr.select(rows.kind == SEGMENT, dr.norm(rows.b - rows.a), length)
            free = 4 * (dr.pi - turned(rows.b - rows.a, rows.c - rows.a, rows.d - rows.a))
            free = dr.select(rows.kind == SEGMENT, dr.select(dr.isfinite(free), free, 0), 4 * dr.pi)
            return EdgeTable(**vars(rows), moves=dr.concat(moves), lamp=length, sensor=length, anywhere=length * free,
                             balls=balls, chains=[], faces=[])  # fmt: skip


def across(along: mi.Vector3f, corner: mi.Vector3f) -> mi.Vector3f:
    """Return the unit vector from an edge to a corner, perpendicular to the edge."""
    return dr.normalize(corner - along * (dr.dot(along, corner) / dr.squared_norm(along)))


def turned(along: mi.Vector3f, c: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    """Return the angle in [0, pi] between the faces with the corners `c` and `d` at an edge."""
    return angle_between(across(along, c), across(along, d))


def angle_between(first: mi.Vector3f, second: mi.Vector3f) -> mi.Float:
    """Return the angle between unit vectors."""
    return 2 * dr.atan2(dr.norm(first - second), dr.norm(first + second))


def outline_direction(
    along: mi.Vector3f, c: mi.Vector3f, d: mi.Vector3f, numbers: mi.Point2f, creases: Any = 0
) -> tuple[mi.Vector3f, mi.Float]:  # fmt: skip
    """Return a random direction from a point of a segment, and its density per solid angle.

    The share `creases` of the directions sees both faces of the segment, or none. The others see it as an outline.
    `along` is the direction of the segment. `c` and `d` lead from the point to the third corners of the two faces.
    """
    angle, x = turned(along, c, d), across(along, c)
    y = dr.cross(along, x)
    y = dr.mulsign(y, dr.dot(y, d))  # the second face is on this side
    outlines = numbers.y >= creases
    share = dr.select(outlines, 1 - creases, creases)
    number = 2 * (numbers.y - dr.select(outlines, creases, 0)) / share
    # The four ranges end at the faces' directions 0 and `angle`, and at the opposite ones.
    opposite, first = number >= 1, dr.select(outlines, angle, 0)
    width = dr.select(outlines, dr.pi - angle, angle)
    turn = first + dr.select(opposite, dr.pi, 0) + width * (number - dr.select(opposite, 1, 0))
    cos = 2 * numbers.x - 1
    sin, (s, t) = dr.safe_sqrt(1 - dr.square(cos)), dr.sincos(turn)
    return along * cos + sin * (x * t + y * s), share / (4 * width)


def edge_normal(
    pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, has_instances: bool, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float]:  # fmt: skip
    """Return the normal of the edge next to an intersection, and the distance of the ray from the edge. The edge
    belongs to the primitive that the ray hits. The normal is perpendicular to the ray.

    Meshes, rectangles, disks and cylinders have edges. Outlines of other shapes, and of the side of a cylinder, have
    the normal of the surface.
    """
    si, d = pi.compute_surface_interaction(ray, mi.RayFlags.All, active), ray.d
    kind, n = si.shape.shape_type(), mi.Vector3f(si.n)
    normal, nearest = dr.normalize(n - d * dr.dot(n, d)), mi.Float(0)
    is_mesh, is_flat, is_disk, is_tube = (
        active & (kind == int(each))
        for each in (mi.ShapeType.Mesh, mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Cylinder)
    )
    # The outline of the side of a cylinder is nearer than a rim if the ray is nearer to it.
    axis = dr.normalize(si.dp_dv)
    across_it = dr.normalize(d - axis * dr.dot(d, axis))
    depth = 1 - dr.safe_sqrt(1 - dr.square(dr.dot(n, across_it)))
    nearest = dr.select(is_tube, dr.norm(si.dp_du) * dr.inv_two_pi * depth, dr.inf)

    # Points `a` of edges, their directions, and the shapes that have them.
    u, v = (part - dr.select(part < 0.5, 0, 1) for part in (si.uv.x, si.uv.y))
    edges = [
        (si.dp_du * u, si.dp_dv, is_flat),
        (si.dp_dv * v, si.dp_du, is_flat | is_tube),
        (mi.Vector3f(0), si.dp_dv, is_disk),
    ]
    corners = _triangle(pi, has_instances, is_mesh)
    edges += [(si.p - a, b - a, is_mesh) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]
    for there, along, has_it in edges:
        raw = dr.cross(along, d)
        raw /= dr.maximum(dr.norm(raw), 1e-30)
        distance = dr.abs(dr.dot(raw, there))
        better = has_it & (distance < nearest)
        normal, nearest = dr.select(better, raw, normal), dr.select(better, distance, nearest)
    return normal, dr.select(dr.isfinite(nearest), nearest, 0)


def _triangle(pi: mi.PreliminaryIntersection3f, has_instances: bool, active: mi.Bool) -> list[mi.Point3f]:
    """Return the corners of the triangles at intersections with meshes."""
    mesh = mi.MeshPtr(pi.shape)
    face = mesh.face_indices(pi.prim_index, active)
    corners = [mi.Point3f(mesh.vertex_position(index, active)) for index in face]
    if not has_instances:
        return corners

    def placed(self: mi.Shape, a: mi.Point3f, b: mi.Point3f, c: mi.Point3f, any_: mi.Bool) -> tuple[mi.Point3f, ...]:
        to_world = mi.traverse(self)["to_world"] if self.class_name() == "Instance" else mi.AffineTransform4f()
        return to_world @ a, to_world @ b, to_world @ c

    has_one = active & (pi.instance != dr.zeros(mi.ShapePtr))
    moved = dr.dispatch(pi.instance, placed, *corners, has_one)
    return [dr.select(has_one, there, corner) for there, corner in zip(moved, corners, strict=True)]


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
