"""Derivatives of the light that moving edges cover and uncover, for camera paths.

The terms and their symbols are those of `edges.py`, for the flow of `attached_camera.py`. The ray through a film
position is fixed, and all other vertices keep their places on their surfaces. L_p and L_x are the radiance that leaves
p and x.

Seen from the sensor, creases count, too:

    dL/dtheta  +=  w delta(u) (L_p - L_x) <v_p, n>

Seen from a lamp at y, x moves with its surface. W_x is the contribution to the objective of light that continues from
x. Nothing is lost at p, because p moves with its surface and sees the lamp until it turns away from the lamp:

    dL/dtheta  -=  w W_x <v_p - s v_x - (1 - s) v_y, n>,    s = |p - y| / |x - y|

Between two surfaces, y is the point nearer to the sensor, W_y the contribution of light that continues from y, and L_x
the radiance from x:

    dL/dtheta  -=  w W_y L_x <v_p - s v_x - (1 - s) v_y, n>

A share h of the light between two near surfaces is differentiated with fixed directions (`Plan.near`). A fixed ray from
y jumps between p and x, and moves with y. The formula then becomes the following one. At a crease, L_p and L_x have the
factor h_p, and s is 0.

    dL/dtheta  +=  w W_y h_p L_p <v_p - v_y, n>  -  w W_y L_x <v_p - s (1 - h_x) v_x - (1 - s (1 - h_x)) v_y, n>

A point that the sensor sees directly slides along the direction d of the film's ray, and does not move with its
surface. v is the velocity of the surface, and m its normal at x. v_y is defined in the same way.

    v_x = d <v, m> / <d, m>

A point that is seen from a surface point z slides in part along the direction d from z to the point.

    v_x = (1 - h) v  +  h (v_z + d <v - v_z, m> / <d, m>)

If a shape touches the surface behind it, the sensor's ray and the light's ray lose the same point at the same time. The
light of this point counts once, as seen from the sensor's side. If the shape moves into the surface, the surface hides
the edge. The curve in which both surfaces meet takes the place of the edge. m is the normal of the surface behind, and
f a direction in the face of the shape. The velocity of the curve replaces v_p:

    v_p - f <v_p - v_x, m> / <f, m>
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import near_share
from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.camera import Radiance
from reslrb_cli.estimators.edges import LAMP_EDGES, OTHER_EDGES, SENSOR_EDGES, PickLight
from reslrb_cli.estimators.horizons import TERMS as HORIZON_TERMS
from reslrb_cli.estimators.outline_rays import (
    PATHS_PER_OUTLINE,
    Beside,
    both_sides,
    chances_of,
    edge_samples,
    for_camera,
    halves,
    moved_by,
    sample_between,
    share_of,
    slid,
    touches_behind,
)
from reslrb_cli.transport.bsdf import Scattering, begins_caustic
from reslrb_cli.transport.camera import FilmRay, camera_walk
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.edges import sample_outline, view_from_lamps, view_from_sensor
from reslrb_cli.transport.emission import Emission
from reslrb_cli.transport.factors import MAY_LACK, Product, showing
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Hooks, Vertex, walk


def differentiate_edges_of_camera_paths(p: Pass) -> None:
    """Add the derivatives of the light that edges of moving shapes cover and uncover. dL/dI must be known."""
    # The radiance on both sides of an outline is noisier than other terms, so that this term has more samples.
    terms = [(SENSOR_EDGES, _from_sensor, 1), (LAMP_EDGES, _from_lamps, PATHS_PER_OUTLINE)]
    if p.plan.max_depth > 2:
        terms.append((OTHER_EDGES, _between, PATHS_PER_OUTLINE))
    assert p.samples.edges is not None
    if p.samples.edges.faces:
        terms += [(stream, term, 1) for stream, term in HORIZON_TERMS]
    for stream, side, each in terms:
        samples = edge_samples(p.samples, stream, each)
        samples.plan = replace(samples.plan, camera=False, paths="light")
        side(Pass(samples, None, p.adjoint), samples.stream(stream))


def _of_all_classes(samples: Samples) -> Samples:
    """Return the samples for light paths of all classes."""
    return replace(samples, plan=replace(samples.plan, by_class=False))


def _at_contact(beside: Beside, adjoint: mi.Vector3f, touches: mi.Bool) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Return the adjoints of p and x for the `adjoint` of the edge's position. In the lanes `touches`, the edge is the
    curve in which both surfaces meet.
    """
    face, m = (
        mi.Vector3f(hit.compute_surface_interaction(ray, mi.RayFlags.All, touches).n)
        for hit, ray in ((beside.pi, beside.over), (beside.x, beside.past))
    )
    f = m - face * dr.dot(face, m)
    slope = dr.dot(f, m)
    at_x = dr.select(touches & (slope > 1e-4), m * (dr.dot(f, adjoint) / slope), 0)
    return adjoint - at_x, at_x


def _from_sensor(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of outlines and creases seen from the sensor."""
    samples = for_camera(p.samples)
    assert samples.edges is not None
    over, chances = halves(samples, numbers)
    view = view_from_sensor(samples, chances.viewpoint)
    outline = sample_outline(samples, samples.edges.sensor, view, chances, creases=True)
    beside = both_sides(samples, outline, creases=True, everywhere=True)
    ray = dr.select(over, beside.over, beside.past)
    first = FilmRay(ray, outline.view.u, mi.Spectrum(1))
    hooks = Radiance(tracked=False)
    _, L = camera_walk(samples, hooks, beside.active, first)
    weight = p.delta(outline.view.u, beside.active, hooks.colours) * outline.weight * (2 * p.scale)
    change = showing(dr.dot(weight, L)) * dr.select(over, 1, -1) * share_of(samples, outline, beside)
    active = beside.active & (change != 0)
    # At a crease, x lies on the shape itself.
    touches = active & touches_behind(outline, beside) & ~outline.crease
    at_p, at_x = _at_contact(beside, change * outline.normal, touches)
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, at_p, active)
        moved += moved_by(beside.x, beside.past, at_x, touches)
        dr.backward_from(moved, flags=MAY_LACK)


@dataclass
class Importance:
    """Contribution to the objective of light that continues from a point a, in three sums.

    `seen` is the contribution of light that goes from a directly to the sensor, in the direction `to_sensor`. `via` is
    that of light that goes from a to a surface point z, and from there to the sensor, in the direction `z_to_sensor`.
    `later` is that of other light. `ray_z` leads from a to z, and has the intersection `pi_z`. `n` and `n_z` are the
    normals at a and z. `near` is the share of the light between both points that is differentiated with fixed
    directions (`Plan.near`). `counts` is 0 behind a specular point.
    """

    seen: mi.Float
    via: mi.Float
    later: mi.Float
    counts: mi.Float
    n: mi.Vector3f
    to_sensor: mi.Vector3f
    ray_z: mi.Ray3f
    pi_z: mi.PreliminaryIntersection3f
    n_z: mi.Vector3f
    z_to_sensor: mi.Vector3f
    near: mi.Float

    def all(self) -> mi.Float:
        """Return the sum."""
        return self.seen + self.via + self.later

    def moved(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, adjoint: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:  # fmt: skip
        """Return <a, `adjoint`> times the contribution, with the derivative of a, the intersection `pi` of `ray`. Call
        the function under `dr.resume_grad()`.
        """
        seen, via, later = (showing(each) for each in (self.seen, self.via, self.later))
        by_z = slid(adjoint, self.n, self.ray_z.d)
        at_a = seen * slid(adjoint, self.n, self.to_sensor) + (via + later) * dr.lerp(adjoint, by_z, self.near)
        at_z = self.near * (adjoint - by_z)
        at_z = via * slid(at_z, self.n_z, self.z_to_sensor) + later * at_z
        return moved_by(pi, ray, at_a, active) + moved_by(self.pi_z, self.ray_z, at_z, active & self.pi_z.is_valid())


class ImportanceHooks(Hooks):
    """Hooks of a light path that starts with a ray to the point. `first` is the number of the path's first vertex.
    `direct` is true if the light comes directly from a lamp.
    """

    def __init__(self, p: Pass, first: mi.UInt32, direct: bool) -> None:
        self.p, self.first = p, first
        self.ends_class = direct and p.plan.by_class

    def start(self, product: Product) -> Importance:
        return Importance(
            seen=mi.Float(0), via=mi.Float(0), later=mi.Float(0), counts=mi.Float(1), n=mi.Vector3f(0),
            to_sensor=mi.Vector3f(0), ray_z=dr.zeros(mi.Ray3f), pi_z=dr.zeros(mi.PreliminaryIntersection3f),
            n_z=mi.Vector3f(0), z_to_sensor=mi.Vector3f(0), near=mi.Float(0),
        )  # fmt: skip

    def vertex(
        self, state: Importance, vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> Importance:  # fmt: skip
        C = vertex.product.times(connection.c, vertex.depth).value()
        own = dr.dot(C, self.p.delta(connection.u, connection.active, self.colours)) * state.counts
        own = dr.select(connection.active, own, 0)
        a, z, si = vertex.depth == self.first, vertex.depth == self.first + 1, vertex.si
        # Behind a caustic's first surface, the light belongs to light paths.
        ends = begins_caustic(vertex.bsdf, scattering.is_delta) if self.ends_class else scattering.is_delta
        n, to_sensor = mi.Vector3f(si.n), si.to_world(connection.wo)
        share = near_share(self.p.plan.near**2, dr.squared_norm(si.p - vertex.ray.o))
        return Importance(
            seen=dr.select(a, own, state.seen),
            via=dr.select(z, own, state.via),
            later=state.later + dr.select(a | z, 0, own),
            counts=dr.select(a & ends, 0, state.counts),
            n=dr.select(a, n, state.n),
            to_sensor=dr.select(a, to_sensor, state.to_sensor),
            ray_z=dr.select(z, vertex.ray, state.ray_z),
            pi_z=dr.select(z, vertex.pi, state.pi_z),
            n_z=dr.select(z, n, state.n_z),
            z_to_sensor=dr.select(z, to_sensor, state.z_to_sensor),
            near=dr.select(z, share, state.near),
        )


def _from_lamps(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of outlines seen from lamps."""
    samples = p.samples
    assert samples.edges is not None
    chances = chances_of(samples, numbers)
    from_lamps = view_from_lamps(samples, chances.viewpoint, chances.wavelengths)
    outline = sample_outline(samples, samples.edges.lamp, from_lamps, chances)
    n, view = outline.normal, outline.view
    beside = both_sides(samples, outline)
    x, active = beside.x, beside.active & beside.x.is_valid() & ~touches_behind(outline, beside)
    emission = Emission(beside.past, outline.weight * share_of(samples, outline, beside), dr.zeros(mi.EmitterPtr))
    W = walk(_of_all_classes(samples), ImportanceHooks(p, mi.UInt32(1), direct=True), active, emission)
    size = showing(W.all()) * p.scale
    active = active & (size != 0)
    behind = dr.norm(beside.past(x.t) - view.y)
    s = dr.select(view.parallel, 1, view.distance / behind)
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, -size * n, active)
        moved += W.moved(x, beside.past, (s * p.scale) * n, active)
        dr.backward_from(moved, flags=MAY_LACK)


def _between(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of outlines and creases on segments between two surfaces. Both surfaces are not specular.
    The radiance is that of p or x.
    """
    samples = p.samples
    between = sample_between(samples, numbers)
    outline, beside, back, y = between.outline, between.beside, between.back, between.y
    n, x, active, side = outline.normal, beside.x, between.active, between.side(p.plan.near, numbers)
    first = FilmRay(side.ray, mi.Point2f(0), mi.Spectrum(1), continues=True)
    _, found = camera_walk(for_camera(samples), PickLight(numbers), active, first)
    total = showing(found.total)
    weight = outline.weight * found.L * (total * share_of(samples, outline, beside) * side.weight)
    emission = Emission(back, weight, dr.zeros(mi.EmitterPtr))
    depth = found.segments + 1
    hooks = ImportanceHooks(p, depth, direct=False)
    W = walk(_of_all_classes(samples), hooks, active & (total > 0), emission, depth)
    sign = dr.select(side.over, -p.scale, p.scale)
    size = showing(W.all()) * sign
    active = active & (size != 0)
    at_p, at_x = _at_contact(beside, -size * n, active & touches_behind(outline, beside) & ~outline.crease)
    at_x += dr.select(active, (size * side.s) * n, 0)
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, at_p, active)
        moved += moved_by(x, beside.past, at_x, active & x.is_valid())
        moved += W.moved(y, back, ((1 - side.s) * sign) * n, active)
        dr.backward_from(moved, flags=MAY_LACK)
