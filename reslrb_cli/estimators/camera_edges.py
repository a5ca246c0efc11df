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

A point that the sensor sees directly slides along the direction d of the film's ray, and does not move with its
surface. v is the velocity of the surface, and m its normal at x. v_y is defined in the same way.

    v_x = d <v, m> / <d, m>

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

from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.camera import Radiance
from reslrb_cli.estimators.edges import (
    LAMP_EDGES,
    OTHER_EDGES,
    PATHS_PER_OUTLINE,
    SENSOR_EDGES,
    Beside,
    PickLight,
    both_sides,
    chances_of,
    edge_samples,
    for_camera,
    halves,
    moved_by,
    sample_between,
    share_of,
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
    """Contribution to the objective of light that continues from a point, in two sums.

    `slid` is the contribution of light that goes from the point directly to the sensor, times <v, n> / <v, m> for the
    point's velocity v. m is the normal `normal`. `rest` is the contribution of other light, and `all` is the sum
    of both contributions. `counts` is 0 behind a specular point.
    """

    all: mi.Float
    slid: mi.Float
    rest: mi.Float
    normal: mi.Vector3f
    counts: mi.Float

    def motion(self, outline: mi.Vector3f, part: mi.Float) -> mi.Vector3f:
        """Return the adjoint of the position of the point. The point counts with the factor `part`."""
        return part * (showing(self.slid) * self.normal + showing(self.rest) * outline)


class ImportanceHooks(Hooks):
    """Hooks of a light path that starts with a ray to the point. `outline` is the normal n of the outline. `first` is
    the number of the path's first vertex. `direct` is true if the light comes directly from a lamp.
    """

    def __init__(self, p: Pass, outline: mi.Vector3f, first: mi.UInt32, direct: bool) -> None:
        self.p, self.outline, self.first = p, outline, first
        self.ends_class = direct and p.plan.by_class

    def start(self, product: Product) -> Importance:
        return Importance(mi.Float(0), mi.Float(0), mi.Float(0), mi.Vector3f(0), mi.Float(1))

    def vertex(
        self, state: Importance, vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> Importance:  # fmt: skip
        C = vertex.product.times(connection.c, vertex.depth).value()
        own = dr.dot(C, self.p.delta(connection.u, connection.active, self.colours)) * state.counts
        own = dr.select(connection.active, own, 0)
        first, si = vertex.depth == self.first, vertex.si
        # Behind a caustic's first surface, the light belongs to light paths.
        ends = begins_caustic(vertex.bsdf, scattering.is_delta) if self.ends_class else scattering.is_delta
        normal = dr.select(first, mi.Vector3f(si.n), state.normal)
        to_sensor = si.to_world(connection.wo)
        cos = dr.dot(normal, to_sensor)
        slope = dr.select(cos != 0, dr.dot(self.outline, to_sensor) / cos, 0)
        return Importance(
            all=state.all + own,
            slid=state.slid + dr.select(first, own * slope, 0),
            rest=state.rest + dr.select(first, 0, own),
            normal=normal,
            counts=dr.select(first & ends, 0, state.counts),
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
    W = walk(_of_all_classes(samples), ImportanceHooks(p, n, mi.UInt32(1), direct=True), active, emission)
    size = showing(W.all) * p.scale
    active = active & (size != 0)
    behind = dr.norm(beside.past(x.t) - view.y)
    s = dr.select(view.parallel, 1, view.distance / behind)
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, -size * n, active)
        moved += moved_by(x, beside.past, W.motion(n, s * p.scale), active)
        dr.backward_from(moved, flags=MAY_LACK)


def _between(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of outlines on segments between two surfaces. Both surfaces are not specular."""
    samples = p.samples
    between = sample_between(samples, numbers)
    outline, beside, back, y = between.outline, between.beside, between.back, between.y
    n, x, s, active = outline.normal, beside.x, between.s, between.active
    first = FilmRay(beside.past, mi.Point2f(0), mi.Spectrum(1), continues=True)
    _, found = camera_walk(for_camera(samples), PickLight(numbers), active, first)
    total = showing(found.total)
    weight = outline.weight * found.L * (total * share_of(samples, outline, beside))
    emission = Emission(back, weight, dr.zeros(mi.EmitterPtr))
    depth = found.segments + 1
    hooks = ImportanceHooks(p, n, depth, direct=False)
    W = walk(_of_all_classes(samples), hooks, active & (total > 0), emission, depth)
    size = showing(W.all) * p.scale
    active = active & (size != 0)
    at_p, at_x = _at_contact(beside, -size * n, active & touches_behind(outline, beside))
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, at_p, active)
        moved += moved_by(x, beside.past, (size * s) * n + at_x, active)
        moved += moved_by(y, back, W.motion(n, (1 - s) * p.scale), active)
        dr.backward_from(moved, flags=MAY_LACK)
