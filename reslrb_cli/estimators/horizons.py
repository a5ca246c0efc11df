"""Derivatives of light at the horizons of faces with interpolated normals, for camera paths.

Light from below the plane of a face does not reach the face, because other faces of its mesh are in the way. With
interpolated normals, f = bsdf * cos need not vanish in the directions d of this plane, so the light that leaves the
face jumps as the plane passes a lamp. There are three terms. Their symbols are those of `camera_edges.py`.

Horizons: p is a point of a camera path on a face with the normal n. d is a direction in the plane of the face, with a
uniform angle. y is the point that the ray from p reaches, at the distance r. L_above and L_below are the radiances
along rays just above and just below the plane. P is the adjoint of the light that leaves p. Light of the sky has a
fixed direction, and so has the share h of the light from other surfaces (`Plan.near`). For lamps, h is 0.

    dL/dtheta  +=  2 pi P f (L_above - L_below) (<dn/dtheta, d> + (1 - h) <v_y - v_p, n> / r)

Folds: two faces with a common edge receive light from different directions, so the light that leaves them jumps at the
edge. d is a direction in the two wedges between both planes. alpha is the angle between the planes, so the wedges have
the solid angle 4 alpha. L_1 and L_2 are the radiances along rays that start on the first and on the second face.

    dL/dtheta  +=  4 alpha w delta(u) f (L_1 - L_2) <v_p, n>

Rims (`transport/faces.py`): c is the cosine between the shading normal and the direction to the sensor. It is 0 on a
rim. L_p is the radiance from the side with c > 0, and L_x from the other side. The derivative of c is that at a fixed
film position.

    dL/dtheta  +=  w delta(u) (L_p - L_x) dc/dtheta
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import near_share
from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.camera import Radiance
from reslrb_cli.estimators.outline_rays import both_sides, for_camera, halves, moved_by
from reslrb_cli.scene.edges import angle_between
from reslrb_cli.scene.graph import is_one_of
from reslrb_cli.scene.rays import ray_offset
from reslrb_cli.transport.bsdf import Scattering, evaluate
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, camera_walk
from reslrb_cli.transport.edges import sample_outline, view_from_sensor
from reslrb_cli.transport.faces import sample_rim, smooth_meshes
from reslrb_cli.transport.factors import MAY_LACK, showing
from reslrb_cli.transport.film import Colours
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Vertex

# ---- Horizons ----


@dataclass
class HorizonPoint:
    """Point of a camera path on a mesh with interpolated normals, selected in proportion to the adjoint of its light.

    `P` (C,) is this adjoint divided by its size, and `total` is the sum of the sizes of all points. `pi` is the
    intersection of `ray` at the point, and `depth` the number of the vertex.
    """

    P: mi.Spectrum
    total: mi.Float
    depth: mi.UInt32
    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    numbers: mi.PCG32


class PickPoint(CameraHooks):
    """Hooks that select a point on a mesh with interpolated normals."""

    def __init__(self, p: Pass, numbers: mi.PCG32) -> None:
        self.p, self.numbers, self.shapes = p, numbers, smooth_meshes(p.plan)
        self.delta = mi.Spectrum(0)  # assigned at the start

    def start(self, first: FilmRay) -> HorizonPoint:
        self.delta = self.p.delta(first.u, mi.Bool(True), self.colours) * first.weight
        return HorizonPoint(
            mi.Spectrum(0), mi.Float(0), mi.UInt32(0), dr.zeros(mi.Ray3f), dr.zeros(mi.PreliminaryIntersection3f),
            self.numbers,
        )  # fmt: skip

    def vertex(
        self, state: HorizonPoint, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> HorizonPoint:  # fmt: skip
        here = is_one_of(vertex.si.shape, self.shapes)
        P = self.delta * vertex.product.value()
        size = dr.select(vertex.active & here & (vertex.depth < self.p.plan.max_depth), dr.max(dr.abs(P)), 0)
        total, number = state.total + size, state.numbers.next_float32()
        takes = (size > 0) & (number * total < size)
        return HorizonPoint(
            P=dr.select(takes, P / size, state.P),
            total=total,
            depth=dr.select(takes, vertex.depth, state.depth),
            ray=dr.select(takes, vertex.ray, state.ray),
            pi=dr.select(takes, vertex.pi, state.pi),
            numbers=state.numbers,
        )


def _arriving(
    samples: Samples, si: mi.SurfaceInteraction3f, first: FilmRay, active: mi.Bool
) -> tuple[mi.Spectrum, Colours]:  # fmt: skip
    """Return the radiance that arrives at `si` along the ray `first` and continues to the sensor: f L. Also return the
    wavelengths.
    """
    f = evaluate(samples.plan, si, si.bsdf(), si.to_local(first.ray.d), active)
    hooks = Radiance(tracked=False)
    _, L = camera_walk(samples, hooks, active & dr.any(f != 0), first)
    return f * L, hooks.colours


def _horizons(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of the light at the horizons of moving faces."""
    samples = for_camera(p.samples)
    paths = replace(samples, seed=mi.sample_tea_32(samples.seed, mi.UInt32(1))[0])
    _, place = camera_walk(paths, PickPoint(Pass(samples, None, p.adjoint), numbers))
    active = place.total > 0
    si = place.pi.compute_surface_interaction(place.ray, mi.RayFlags.All, active)
    n = mi.Vector3f(si.n)
    sin, cos = dr.sincos(dr.two_pi * numbers.next_float32())
    d = mi.Frame3f(n).to_world(mi.Vector3f(cos, sin, 0))
    side = dr.select(numbers.next_float32() < 0.5, mi.Float(1), -1)
    ray = mi.Ray3f(si.p + n * (side * ray_offset(si.p)), d)
    ray.wavelengths = place.ray.wavelengths
    first = FilmRay(ray, mi.Point2f(0), mi.Spectrum(1), continues=True, depth=place.depth + 1)
    light, _ = _arriving(samples, si, first, active)
    size = showing(dr.dot(place.P, light) * place.total) * (side * 2 * dr.two_pi)
    active &= size != 0
    y = samples.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    reached = active & y.is_valid()
    there = y.compute_surface_interaction(ray, mi.RayFlags.All, reached)
    is_lamp = there.emitter(samples.scene, reached) != dr.zeros(mi.EmitterPtr)
    share = dr.select(is_lamp, 0, near_share(p.plan.near**2, dr.square(y.t)))
    across = dr.select(reached, (1 - share) * size / y.t, 0) * n
    with dr.resume_grad(), dr.isolate_grad():
        face = place.pi.compute_surface_interaction(place.ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
        moved = dr.select(active, dr.dot(face.n, d) * size, 0)
        moved += moved_by(y, ray, across, reached) - moved_by(place.pi, place.ray, across, reached)
        dr.backward_from(moved, flags=MAY_LACK)


# ---- Folds and rims ----


def _folds(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of folds seen from the sensor."""
    samples = for_camera(p.samples)
    table = samples.edges
    assert table is not None
    over, chances = halves(samples, numbers)
    view = view_from_sensor(samples, chances.viewpoint)
    samples.edges = replace(table, crease=-table.crease)
    outline = sample_outline(samples, table.faces[0].folds, view, chances, creases=True)
    outline.active = outline.active & outline.crease
    beside = both_sides(samples, outline, creases=True, everywhere=True)
    one = beside.pi.compute_surface_interaction(beside.over, mi.RayFlags.All, beside.active)
    other = beside.x.compute_surface_interaction(beside.past, mi.RayFlags.All, beside.active)

    # ---- A random direction between the planes of both faces ----
    n, n_2 = mi.Vector3f(one.n), mi.Vector3f(other.n)
    along, angle = dr.normalize(dr.cross(n, n_2)), angle_between(n, n_2)
    across = dr.cross(along, n)
    sin, cos = dr.sincos(angle * numbers.next_float32())
    z = 2 * numbers.next_float32() - 1
    radius = dr.select(numbers.next_float32() < 0.5, -1, 1) * dr.safe_sqrt(1 - dr.square(z))
    d = along * z + (across * cos + dr.cross(along, across) * sin) * radius

    si = dr.select(over, one, other)
    first = FilmRay(si.spawn_ray(d), outline.view.u, mi.Spectrum(1), continues=True, depth=2)
    light, colours = _arriving(samples, si, first, beside.active)
    weight = p.delta(outline.view.u, beside.active, colours) * outline.weight * (2 * p.scale * 4 * angle)
    change = showing(dr.dot(weight, light)) * dr.select(over, 1, -1)
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, change * outline.normal, beside.active & (change != 0))
        dr.backward_from(moved, flags=MAY_LACK)


def _rims(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of rims seen from the sensor."""
    samples = for_camera(p.samples)
    assert samples.edges is not None
    over, chances = halves(samples, numbers)
    outline = sample_rim(samples.edges.faces[0], view_from_sensor(samples, chances.viewpoint), chances)
    beside = both_sides(samples, outline, creases=True, everywhere=True)
    hooks = Radiance(tracked=False)
    ray = dr.select(over, beside.over, beside.past)
    _, L = camera_walk(samples, hooks, beside.active, FilmRay(ray, outline.view.u, mi.Spectrum(1)))
    weight = p.delta(outline.view.u, beside.active, hooks.colours) * outline.weight * (2 * p.scale)
    change = showing(dr.dot(weight, L)) * dr.select(over, 1, -1)
    active = beside.active & (change != 0)
    with dr.resume_grad(), dr.isolate_grad():
        si = beside.pi.compute_surface_interaction(beside.over, mi.RayFlags.All, active)
        dr.backward_from(dr.select(active, change * mi.Frame3f.cos_theta(si.wi), 0), flags=MAY_LACK)


#: Streams of random numbers, mixed into the seed, and the terms.
TERMS = ((0xED6E4, _horizons), (0xED6E5, _folds), (0xED6E6, _rims))
