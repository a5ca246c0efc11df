"""Edges of shapes, and points on outlines: the curves at which a shape starts to block rays from a viewpoint.

`EdgeSet` finds the edges of shapes once. `EdgeSet.now` returns a table of their current places, with the weights by
which edges are sampled. `sample_outline` samples points on outlines, as a lamp, the sensor, or any direction sees them.
A table has one row per edge. There are three kinds of edges.

- `SEGMENT`: an edge of a mesh or of a rectangle, or a chord of the rim of a disk or a cylinder. A segment belongs to
    the outline if, seen from the viewpoint, both of its faces lie on the same side of it. A segment with one face
    always belongs to the outline.
- `SPHERE`: the circle at which rays from the viewpoint touch a sphere.
- `TUBE`: the two lines at which rays from the viewpoint touch a cylinder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.scene.graph import interpolates_normals
from reslrb_cli.transport.camera import sample_lamp
from reslrb_cli.transport.connection import connect
from reslrb_cli.transport.samples import EdgeTable, Samples

Array = np.ndarray[Any, Any]

SEGMENT, SPHERE, TUBE = range(3)
#: Number of chords that approximate a circle. The distance between a chord and its arc is at most 2e-5 of the radius.
CHORDS = 512
#: Sampling weight of an edge that no probe sees as an outline, relative to an outline of the same length.
UNLIKELY = 0.02
#: An edge is a crease if the angle between the normals of its faces, divided by pi, exceeds this value.
FLAT = 1e-4
#: Number of points on the lamps that probe whether an edge is an outline.
PROBES = 4
#: Stream of random numbers, mixed into the seed.
SPREAD_STREAM = 0x5B4EAD
#: Vertices count as one vertex if their distance, divided by the size of the mesh, is below this value.
WELD = 1e-6


@dataclass
class View:
    """View of a point from a viewpoint `y`: a place on a lamp or on the sensor's aperture.

    `weight` (C,) is the radiance or the importance that arrives at the point, divided by the density of the viewpoint.
    Occlusion is not included. `to_y` is the unit vector to the viewpoint, and `distance` is the distance of the
    viewpoint. If `parallel` is true, the viewpoint is infinitely far away. `surface` is the lamp's normal if the
    viewpoint lies on a surface, otherwise zero. `u` is the film position if the viewpoint is the sensor.
    """

    y: mi.Point3f
    to_y: mi.Vector3f
    distance: mi.Float
    parallel: mi.Bool
    weight: mi.Spectrum
    surface: mi.Normal3f
    u: mi.Point2f
    active: mi.Bool


@dataclass
class Outline:
    """Point `p` on a shape's outline, seen from a viewpoint.

    `normal` is perpendicular to the edge and to the ray from the viewpoint, and points away from the shape. `weight`
    (C,) is the light or the importance that the edge covers per unit of its velocity along the normal, divided by the
    density of the sample. Occlusion is not included. In `crease` lanes, the edge is a crease and not an outline, and
    `normal` points away from its first face.
    """

    p: mi.Point3f
    normal: mi.Vector3f
    view: View
    weight: mi.Spectrum
    shape: mi.ShapePtr
    active: mi.Bool
    crease: mi.Bool


Viewer = Callable[[Any, Any], View]  # (point, active lanes) -> view


def view_from_lamps(samples: Samples, numbers: mi.Point2f) -> Viewer:
    """Return the view from lamps. The random `numbers` select the lamp and the place on the lamp."""

    def view(p: mi.Point3f, active: mi.Bool) -> View:
        here = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        here.p = p
        ds, weight = sample_lamp(samples, here, numbers, active)
        parallel = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        surface = dr.select(ds.delta | parallel, mi.Normal3f(0), ds.n)
        seen = active & (ds.pdf > 0) & dr.isfinite(ds.pdf) & dr.any(weight > 0)
        return View(ds.p, ds.d, ds.dist, parallel, weight, surface, mi.Point2f(0), seen)

    return view


def view_from_sensor(samples: Samples, aperture: mi.Point2f) -> Viewer:
    """Return the view from the sensor, through the point `aperture` of its aperture."""

    def view(p: mi.Point3f, active: mi.Bool) -> View:
        here = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        here.p = p
        seen = connect(samples.plan, samples.sensor, here, None, aperture, active)
        ds, _ = samples.sensor.sample_direction(here, aperture, active)
        none = mi.Normal3f(0)
        return View(ds.p, ds.d, ds.dist, mi.Bool(False), seen.weight, none, seen.u, active & seen.active)

    return view


@dataclass
class Chances:
    """Random numbers of an outline: the edge, the place on it, and the viewpoint. They are spread evenly over lanes."""

    edge: mi.Float
    place: mi.Float
    viewpoint: mi.Point2f

    @staticmethod
    def spread(numbers: mi.PCG32, seed: mi.UInt32, index: mi.UInt32, count: mi.UInt32) -> Chances:
        """Return the numbers of points with an `index` below `count`. `count` is opaque.

        They are Hammersley points and a Kronecker sequence (Roberts 2018), with a random offset for each seed.
        """
        edge = (mi.Float(index) + numbers.next_float32()) / mi.Float(count)
        first, second = mi.sample_tea_32(seed, mi.UInt32(SPREAD_STREAM))
        third, _ = mi.sample_tea_32(seed, mi.UInt32(SPREAD_STREAM + 1))
        words = dr.brev(index) + first, index * 3242174889 + second, index * 2447445414 + third
        place, x, y = (mi.Float(word >> 8) * 2.0**-24 for word in words)
        return Chances(dr.minimum(edge, dr.one_minus_epsilon(mi.Float)), place, mi.Point2f(x, y))


def sample_outline(
    samples: Samples, weights: mi.Float, view: Viewer | None, chances: Chances, creases: bool = False
) -> Outline:  # fmt: skip
    """Return a random point on an outline for each lane. `weights` are cumulative sampling weights of the edges.

    If `view` is None, each outline is seen from a random direction. If `creases` is true, points may also lie on
    creases, where `normal` points away from the first face of the edge. Code for spheres and cylinders is compiled only
    if the moving shapes contain any.
    """
    table, kinds = samples.edges, edge_kinds(samples.plan.edged)
    assert table is not None
    row_number, place = chances.edge, chances.place
    rows = dr.width(weights)
    total = dr.gather(mi.Float, weights, rows - 1)
    row = dr.binary_search(0, rows - 1, lambda i: dr.gather(mi.Float, weights, i) <= row_number * total)
    below = dr.select(row > 0, dr.gather(mi.Float, weights, dr.maximum(row, 1) - 1), 0)
    probability = (dr.gather(mi.Float, weights, row) - below) / total
    kind = dr.gather(mi.UInt32, table.kind, row)
    a, b = dr.gather(mi.Point3f, table.a, row), dr.gather(mi.Point3f, table.b, row)
    along = b - a
    length = dr.norm(along)
    along = along / dr.maximum(length, 1e-30)

    # ---- Choose a point on the edge. On a segment, it does not depend on the viewpoint ----
    p, density, active = a + (b - a) * place, dr.rcp(length), probability > 0
    is_round, is_crease = mi.Bool(False), mi.Bool(False)
    if SPHERE in kinds or TUBE in kinds:
        is_round = kind != SEGMENT
        p = dr.select(kind == SPHERE, a, dr.select(kind == TUBE, dr.lerp(a, b, 0.5), p))
    view = _view_from_anywhere(table, kinds, row, kind, along, p, chances) if view is None else view
    seen = view(p, active)
    normal = mi.Vector3f(0)
    if SPHERE in kinds or TUBE in kinds:
        radius, y = dr.gather(mi.Float, table.radius, row), seen.y
        if SPHERE in kinds:
            cos = dr.select(seen.parallel, 0, radius / seen.distance)
            sin, frame = dr.safe_sqrt(1 - dr.square(cos)), mi.Frame3f(seen.to_y)
            s, c = dr.sincos(dr.two_pi * place)
            out = cos * seen.to_y + sin * (c * frame.s + s * frame.t)
            here = kind == SPHERE
            normal, p = dr.select(here, out, normal), dr.select(here, a + radius * out, p)
            density = dr.select(here, dr.rcp(dr.two_pi * radius * sin), density)
            active &= ~here | (sin > 0) & (cos < 1)
        if TUBE in kinds:
            to_y = dr.select(seen.parallel, seen.to_y, y - a)
            across = to_y - along * dr.dot(along, to_y)
            distance = dr.norm(across)
            first = across / distance
            cos = dr.select(seen.parallel, 0, radius / distance)
            sin = dr.safe_sqrt(1 - dr.square(cos)) * dr.select(place < 0.5, 1, -1)
            out = cos * first + sin * dr.cross(along, first)
            here = kind == TUBE
            axis = a + (b - a) * (2 * place - dr.floor(2 * place))
            normal, p = dr.select(here, out, normal), dr.select(here, axis + radius * out, p)
            density = dr.select(here, dr.rcp(2 * length), density)
            active &= ~here | (distance > 0) & (cos < 1)
        seen = _from(seen, p, view(p, active & is_round), is_round)

    # ---- Test whether the edge is an outline, and on which side of it the shape lies ----
    d = -seen.to_y
    raw = dr.cross(along, d)
    sine = dr.norm(raw)
    if SEGMENT in kinds:
        c, other = dr.gather(mi.Point3f, table.c, row), dr.gather(mi.Point3f, table.d, row)
        side, across_it = dr.dot(raw, c - p), dr.dot(raw, other - p)
        outlines = is_round | (side * across_it > 0)
        if creases:
            is_crease = ~outlines & (dr.gather(mi.Float, table.crease, row) > FLAT)
        active &= outlines | is_crease
        normal = dr.select(is_round, normal, -dr.mulsign(raw, side) / dr.maximum(sine, 1e-30))
    if SPHERE in kinds:
        sine = dr.select(kind == SPHERE, 1, sine)
    active &= seen.active & (sine > 1e-6)
    weight = seen.weight * dr.select(active, sine / (density * probability), 0)
    shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, table.shape, row, active))
    return Outline(p, normal, seen, weight, shape, active, is_crease)


def _from(first: View, p: mi.Point3f, again: View, moved: mi.Bool) -> View:
    """Return the view of `p` from the viewpoint of `first`, in the lanes `moved`. `again` is the view of `p` with the
    same random numbers.

    The same random numbers may select another place on a lamp for another point `p`. If the lamp has a surface, the
    place of `first` is used, and the weight is multiplied by the ratio of the solid angles of this place.
    """
    on_surface = dr.any(first.surface != 0)
    there = first.y - p
    distance = dr.norm(there)
    to_y = there / distance
    before = -dr.dot(first.surface, first.to_y) / dr.square(first.distance)
    solid = dr.maximum(-dr.dot(first.surface, to_y), 0) / dr.square(distance) / before
    keeps = moved & on_surface
    return View(
        y=dr.select(moved & ~on_surface, again.y, first.y),
        to_y=dr.select(keeps, to_y, dr.select(moved, again.to_y, first.to_y)),
        distance=dr.select(keeps, distance, dr.select(moved, again.distance, first.distance)),
        parallel=first.parallel,
        weight=dr.select(keeps, first.weight * solid, dr.select(moved, again.weight, first.weight)),
        surface=first.surface,
        u=dr.select(moved, again.u, first.u),
        active=first.active & (~moved | on_surface | again.active),
    )


# ---- The edges of shapes ----


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
        angle = dr.pi - _turned(b - a, c - a, d - a)
        if interpolates_normals(self.shape):
            buffer = dr.detach(self.shape.vertex_normals_buffer())
            i, j, _, _, i_2, j_2 = (dr.normalize(dr.gather(mi.Vector3f, buffer, index)) for index in self.corners)
            angle = dr.maximum(_angle(i, i_2), _angle(j, j_2))
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
    """True if this module knows the edges of this kind of shape."""
    return shape.is_mesh() or shape.class_name() in ("Rectangle", "Disk", "Sphere", "Cylinder")


def edge_kinds(shapes: Iterable[mi.Shape]) -> frozenset[int]:
    """Return the kinds of edges that these shapes have."""
    kinds = {"Sphere": {SPHERE}, "Cylinder": {SEGMENT, TUBE}}
    return frozenset(kind for shape in shapes for kind in kinds.get(shape.class_name(), {SEGMENT}))


class EdgeSet:
    """Edges of the given shapes of a scene. Shapes without known edges are ignored."""

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

    def now(self, samples: Samples) -> EdgeTable:
        """Return the current edges with their sampling weights for the lamps and the sensor of `samples`."""
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
            zero = mi.Float(0)
            table = EdgeTable(
                dr.concat(kinds), a, b, c, d, dr.concat(radii), dr.concat(shapes), dr.concat(creases), zero, zero, zero
            )
            lengths = dr.select(
                table.kind == SEGMENT, dr.norm(b - a), dr.select(
                    table.kind == SPHERE, dr.two_pi * table.radius, 2 * dr.norm(b - a)))  # fmt: skip
            table.lamp = dr.cumsum(lengths * _seen_from_lamps(samples, table))
            table.sensor = dr.cumsum(lengths * _seen_from_sensor(samples, table))
            free = mi.Float(4 * dr.pi)  # solid angle of the directions that see the edge as an outline
            if SEGMENT in {*np.array(table.kind)}:
                free = dr.select(table.kind == SEGMENT, 4 * (dr.pi - _turned(table.b - a, c - a, d - a)), free)
            table.anywhere = dr.cumsum(dr.select(dr.isfinite(free), lengths * free, 0))
            dr.make_opaque(table)
            return table


def _across(along: mi.Vector3f, corner: mi.Vector3f) -> mi.Vector3f:
    """Return the unit vector from an edge to a corner, perpendicular to the edge."""
    return dr.normalize(corner - along * (dr.dot(along, corner) / dr.squared_norm(along)))


def _turned(along: mi.Vector3f, c: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    """Return the angle in [0, pi] between the faces with the corners `c` and `d` at an edge."""
    return _angle(_across(along, c), _across(along, d))


def _angle(first: mi.Vector3f, second: mi.Vector3f) -> mi.Float:
    """Return the angle between unit vectors."""
    return 2 * dr.atan2(dr.norm(first - second), dr.norm(first + second))


def _view_from_anywhere(
    table: EdgeTable, kinds: frozenset[int], row: mi.UInt32, kind: mi.UInt32, along: mi.Vector3f, p: mi.Point3f,
    chances: Chances,
) -> Viewer:  # fmt: skip
    """Return the view of an edge from a random direction, uniform in solid angle. For a segment, the directions are
    limited to those that see the segment as an outline.
    """
    first, second = chances.viewpoint
    to_y, density = mi.warp.square_to_uniform_sphere(chances.viewpoint), mi.Float(dr.inv_four_pi)
    if SEGMENT in kinds:
        c, d = dr.gather(mi.Point3f, table.c, row) - p, dr.gather(mi.Point3f, table.d, row) - p
        angle, x = _turned(along, c, d), _across(along, c)
        y = dr.cross(along, x)
        y = dr.mulsign(y, dr.dot(y, d))  # the second face is on this side
        rest = dr.pi - angle
        turn = 2 * rest * second
        turn += dr.select(turn < rest, angle, 2 * angle)
        cos = 2 * first - 1
        sin, (s, t) = dr.safe_sqrt(1 - dr.square(cos)), dr.sincos(turn)
        here = kind == SEGMENT
        to_y = dr.select(here, along * cos + sin * (x * t + y * s), to_y)
        density = dr.select(here, dr.rcp(4 * rest), density)

    def view(p: mi.Point3f, active: mi.Bool) -> View:
        seen = active & dr.isfinite(density)
        weight = mi.Spectrum(dr.select(seen, dr.rcp(density), 0))
        return View(p, to_y, mi.Float(1), mi.Bool(True), weight, mi.Normal3f(0), mi.Point2f(0), seen)

    return view


def _index(shape: mi.Shape) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def _seen_from_lamps(samples: Samples, table: EdgeTable) -> mi.Float:
    found = mi.Bool(False)
    for number in range(PROBES):
        numbers = mi.Point2f((number + 0.5) / PROBES, (0.5 + 0.618034 * number) % 1)
        view = view_from_lamps(samples, numbers)(dr.lerp(table.a, table.b, 0.5), mi.Bool(True))
        found |= _is_outline(table, view) & view.active
    return dr.select(found | (table.kind != SEGMENT), 1.0, dr.maximum(table.crease, UNLIKELY))


def _seen_from_sensor(samples: Samples, table: EdgeTable) -> mi.Float:
    view = view_from_sensor(samples, mi.Point2f(0.5))(dr.lerp(table.a, table.b, 0.5), mi.Bool(True))
    return dr.select(_is_outline(table, view) | (table.kind != SEGMENT), 1.0, UNLIKELY)


def _is_outline(table: EdgeTable, view: View) -> mi.Bool:
    raw = dr.cross(table.b - table.a, view.to_y)
    return dr.dot(raw, table.c - table.a) * dr.dot(raw, table.d - table.a) > 0


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
