"""Faces of meshes with interpolated normals, and rims on them.

A rim is a curve on a face along which the shading normal is perpendicular to the view. Behind it, the face still faces
the viewer, but its shading normal does not. A surface with one side is therefore black there.

The cosine between shading normal and view is 0 on a rim. Without its normalization, it is a quadratic function along
each line through a face. `sample_rim` finds a root of this function. The line is parallel to a random side of the face.
"""

from __future__ import annotations

from functools import reduce
from operator import or_

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.edges import EdgeTable, FaceTable, joined_points, number_of
from reslrb_cli.scene.graph import interpolates_normals
from reslrb_cli.transport.edges import UNLIKELY, Chances, Outline, Viewer, is_outline, pick, view_from_sensor
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples


def smooth_meshes(plan: Plan) -> list[mi.Shape]:
    """Return the moving meshes with interpolated normals that are not specular."""
    return [
        shape
        for shape in plan.edged
        if interpolates_normals(shape) and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Smooth)
    ]


def weigh_faces(samples: Samples, table: EdgeTable) -> list[FaceTable]:
    """Return the faces of the `smooth_meshes`, if there are any and the `samples` are camera paths. The weights favour
    what the sensor probably sees. `table` has edges whose sampling weights are not cumulative yet.
    """
    shapes = smooth_meshes(samples.plan) if samples.plan.camera else []
    if not shapes:
        return []
    with dr.suspend_grad():
        view = view_from_sensor(samples, mi.Point2f(0.5))
        corners = [joined_points(each) for each in zip(*(_corners(shape) for shape in shapes), strict=True)]
        p, n = corners[:3], [mi.Vector3f(each) for each in corners[3:]]
        numbers = [dr.full(mi.UInt32, number_of(shape), shape.face_count()) for shape in shapes]
        cosines = [dr.dot(normal, view(corner, mi.Bool(True)).to_y) for corner, normal in zip(p, n, strict=True)]
        has_rim = (cosines[0] * cosines[1] < 0) | (cosines[1] * cosines[2] < 0)
        size = dr.sqrt(dr.norm(dr.cross(p[1] - p[0], p[2] - p[0])))
        outlines = is_outline(table, view(dr.lerp(table.a, table.b, 0.5), mi.Bool(True)))
        folded = reduce(or_, (table.shape == number_of(shape) for shape in shapes))
        folds = dr.select(folded, dr.maximum(-table.crease, 0), 0) * table.sensor
        result = FaceTable(
            p, n, dr.concat(numbers), rims=dr.cumsum(size * dr.select(has_rim, 1, UNLIKELY)),
            folds=dr.cumsum(folds * dr.select(outlines, UNLIKELY, 1)),
        )  # fmt: skip
        dr.make_opaque(result)
    return [result]


def _corners(shape: mi.Shape) -> list[mi.Point3f]:
    """Return the three corners of all faces, and the three normals there."""
    first = 3 * dr.arange(mi.UInt32, shape.face_count())
    corners = [dr.gather(mi.UInt32, shape.faces_buffer(), first + k) for k in range(3)]
    buffers = dr.detach(shape.vertex_positions_buffer()), dr.detach(shape.vertex_normals_buffer())
    return [dr.gather(mi.Point3f, buffer, each) for buffer in buffers for each in corners]


def sample_rim(table: FaceTable, viewer: Viewer, chances: Chances) -> Outline:
    """Return a random point on a rim for each lane. `normal` points away from the side on which the shading normal
    faces the viewer. `weight` refers to the velocity of the cosine, not to that of the rim.
    """
    row, probability = pick(table.rims, chances.edge)
    number = 6 * chances.place
    choice = mi.UInt32(number)
    t, side, prefers_second = number / 2 - mi.Float(choice // 2), choice // 2, choice % 2 == 1

    def turned(corners: list[mi.Point3f]) -> list[mi.Vector3f]:
        own = [mi.Vector3f(dr.gather(type(each), each, row)) for each in corners]
        return [
            dr.select(side == 0, own[k], dr.select(side == 1, own[(k + 1) % 3], own[(k + 2) % 3])) for k in range(3)
        ]

    # ---- The line t p[0] + s p[1] + (1 - t - s) p[2] of the face, and the root s ----
    p, n = turned(table.p), turned(table.n)
    y = mi.Vector3f(viewer(mi.Point3f(p[0]), mi.Bool(True)).y)
    start, along, normal, bend = t * p[0] + (1 - t) * p[2], p[1] - p[2], t * n[0] + (1 - t) * n[2], n[1] - n[2]
    a, b, c = -dr.dot(bend, along), dr.dot(bend, y - start) - dr.dot(normal, along), dr.dot(normal, y - start)
    q = -0.5 * (b + dr.mulsign(dr.safe_sqrt(dr.square(b) - 4 * a * c), b))
    roots = q / a, c / q
    valid = [(dr.square(b) >= 4 * a * c) & (s >= 0) & (s <= 1 - t) for s in roots]
    s = dr.select(valid[1] & (prefers_second | ~valid[0]), roots[1], roots[0])
    place, normal = start + s * along, normal + s * bend
    view = viewer(mi.Point3f(place), (valid[0] | valid[1]) & (probability > 0))

    # ---- Slopes of the cosine along the three sides of the face, and its gradient for rays ----
    back, d = y - place, -view.to_y
    slopes = [dr.dot(n[j] - n[i], back) - dr.dot(normal, p[j] - p[i]) for i, j in ((0, 1), (1, 2), (2, 0))]
    face = dr.cross(p[1] - p[0], p[2] - p[0])
    area = dr.norm(face)
    gradient = slopes[0] * dr.cross(p[2] - p[0], face) + slopes[2] * dr.cross(p[1] - p[0], face)
    cos = dr.dot(d, face) / area
    gradient = gradient - face * (dr.dot(gradient, d) / (area * cos))
    # Each of the three sides has the share slope^2 of the rim. The derivative of the cosine has the normalization.
    share = dr.square(slopes[1]) / (dr.square(slopes[0]) + dr.square(slopes[1]) + dr.square(slopes[2]))
    count = 3 * dr.select(valid[0] & valid[1], 2, 1)
    weight = count * share * area * dr.abs(cos) * dr.norm(normal) * dr.norm(back) / (dr.abs(slopes[1]) * probability)
    active = view.active & (weight > 0) & dr.isfinite(weight) & (dr.abs(cos) > 1e-6)
    shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, table.shape, row, active))
    return Outline(
        mi.Point3f(place), -dr.normalize(gradient), view, view.weight * dr.select(active, weight, 0), shape, active,
        crease=mi.Bool(True), radius=mi.Float(0), wavelengths=chances.wavelengths,
    )  # fmt: skip
