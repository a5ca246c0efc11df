"""How one segment of a light path answers when the ray that reaches it is shifted and turned: its Jacobians.

A ray has four coordinates, p = (q, w): q shifts its origin across it, w turns its direction, both in the two axes s,
t of a frame about the ray. Of one that leads to a vertex that stays where it is (`kept.py`) the direction is of no
account, and that its origin is shifted along it is: the third coordinate is that shift, and the fourth is not used. A
segment maps p_i of the ray that reaches vertex i to p_{i+1} of the next one, to its scattering factor s_i, and to its
connection, c_i at film position u_i. (The ResLRB paper, Section 2.5, takes the coordinates of both ends of a segment.
Where these stand on planes that do not move, they are a change of coordinates, which the chain of Jacobians and its
inverse cancel.)

Derivatives are taken in forward mode, one propagation for each of the four, with gradients resumed for p alone: where
those of the scene's parameters are resumed too, Dr.Jit 1.5 cannot propagate through the indirect calls of a loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.kept import Before, is_staying, segment_again
from reslrb_cli.transport.samples import Numbers, Samples
from reslrb_cli.transport.walk import Vertex

AXES = 4


@dataclass
class SegmentJacobian:
    """Derivatives by p_i, in double precision: products of many of them have to be inverted.

    `ray` is dp_{i+1}/dp_i, and `damped` says where `damping` has a part in it; `log_s` and `log_c` have a row for
    each channel, 0 where the factor is 0, and `u` one for each film coordinate (in pixels).
    """

    ray: mi.Matrix4d
    damped: mi.Bool
    log_s: list[mi.Vector4d]
    u: list[mi.Vector4d]
    log_c: list[mi.Vector4d]


def row_times(row: mi.Vector4d, matrix: mi.Matrix4d) -> mi.Vector4d:
    """row @ matrix."""
    return mi.Vector4d(matrix.T @ row)


def coordinates(d: mi.Vector3f, o_change: mi.Vector3f, d_change: mi.Vector3f, stays: mi.Bool) -> list[mi.Float]:
    """The coordinates of a small change of a ray's origin and direction, `d` being its direction."""
    frame = mi.Frame3f(d)
    return [
        dr.dot(frame.s, o_change),
        dr.dot(frame.t, o_change),
        dr.select(stays, dr.dot(d, o_change), dr.dot(frame.s, d_change)),
        dr.select(stays, 0, dr.dot(frame.t, d_change)),
    ]


def spread(d: mi.Vector3f, row: mi.Vector4d, stays: mi.Bool) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The derivatives by a ray's origin and by its direction `d` that a row of derivatives by p stands for."""
    frame = mi.Frame3f(d)
    q_s, q_t, third, fourth = (mi.Float(value) for value in row)
    along = d * dr.select(stays, third, 0)
    return frame.s * q_s + frame.t * q_t + along, dr.select(stays, 0, frame.s * third + frame.t * fourth)


def segment_jacobian(
    samples: Samples, vertex: Vertex, before: list[Before], numbers: Numbers, connected: mi.Bool | None,
    scattered: mi.Bool, damping: float,
) -> SegmentJacobian:  # fmt: skip
    """The Jacobians of a vertex's segment; without `connected` (a mask) none of the connection's.

    Where a diffuse surface scatters, the next ray does not depend on the direction of the one before, so that the
    Jacobian has no inverse; and nor has that of a vertex that stays on its surface. `damping` makes one of it: behind
    a vertex that is not specular the ray turns by `damping` with the one before, and behind one that stays it is also
    shifted with it, to either side with probability 1/2. What stands in a chain before its inverse depends on each of
    these terms linearly, so that its mean is what it is without them.
    """
    p = [mi.Float(0) for _ in range(AXES)]
    frame, stays = mi.Frame3f(vertex.ray.d), is_staying(before)
    evaluates = connected is not None
    if connected is None:
        connected = mi.Bool(False)
    with dr.resume_grad(*p):
        dr.enable_grad(p)
        ray = mi.Ray3f(vertex.ray)
        ray.o = ray.o + frame.s * p[0] + frame.t * p[1] + vertex.ray.d * dr.select(stays, p[2], 0)
        ray.d = dr.normalize(ray.d + dr.select(stays, 0, frame.s * p[2] + frame.t * p[3]))
        this, reached = segment_again(
            samples, before, ray, vertex.pi, numbers, connected, scattered, evaluates, parameters=False
        )
        following, scattering, connection = this.next_ray(attached=True), this.scattering, this.connection
        factors = [reached * scattering.weight]
        if evaluates:
            factors.append(reached * connection.f * connection.weight)
        # Selected: no other of these hangs on what that makes, which would be cleared on the way.
        outputs = [dr.select(scattered, value, 0) for value in (following.o, following.d, factors[0])]
        if evaluates:
            outputs += [dr.select(connected, value, 0) for value in (factors[1], connection.u)]
        changes = []
        for axis in p:
            dr.forward_from(axis, flags=dr.ADFlag.ClearInterior | dr.ADFlag.AllowNoGrad)
            changes.append([dr.detach(dr.grad(value)) for value in outputs])
            dr.clear_grad([axis, *outputs])
    after = Before.of(samples.plan, vertex, scattering)
    damped = scattered & (stays | ~scattering.is_delta)
    turned = dr.select(damped, damping * sign(numbers), 0)
    columns = []
    for axis, change in enumerate(changes):
        column = coordinates(dr.detach(following.d), change[0], change[1], is_staying(after))
        column[axis] = column[axis] + (turned if axis >= 2 else dr.select(stays, turned, 0))
        columns.append([mi.Float64(value) for value in column])
    log_s = _logarithmic(factors[0], [change[2] for change in changes], scattered)
    if not evaluates:
        return SegmentJacobian(_matrix(columns), damped, log_s, [], [])
    log_c = _logarithmic(factors[1], [change[3] for change in changes], connected)
    u = [mi.Vector4d(*(mi.Float64(change[4][axis]) for change in changes)) for axis in range(2)]
    return SegmentJacobian(_matrix(columns), damped, log_s, u, log_c)


def sign(numbers: Numbers) -> mi.Float:
    """1 or -1, with probability 1/2 each: the last bit of a number that the BSDF draws by.

    It has no part in where light goes, and a replay finds it again.
    """
    return dr.select((mi.UInt32(numbers.bsdf_2d.x * float(1 << 23)) & 1) == 0, mi.Float(1), -1)


def _matrix(columns: list[list[mi.Float64]]) -> mi.Matrix4d:
    return mi.Matrix4d(*([columns[c][r] for c in range(AXES)] for r in range(AXES)))


def _logarithmic(value: mi.Spectrum, changes: list[mi.Spectrum], active: mi.Bool) -> list[mi.Vector4d]:
    """Rows of the derivatives of log(value), one for each channel."""
    value = dr.detach(value)
    used = active & (value != 0)
    rows = [dr.select(used, change / value, 0) for change in changes]
    return [mi.Vector4d(*(mi.Float64(row[c]) for row in rows)) for c in range(len(value))]
