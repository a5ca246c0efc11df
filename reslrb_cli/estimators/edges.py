"""Derivatives of the light that moving edges cover and uncover.

The other estimators differentiate light along paths whose vertices move with the surfaces. They lack the light that a
moving edge starts to block or to let through. This light is an integral over outlines (`transport/edges.py`). Here, p
is a point on an outline, seen from a viewpoint y. x is the point behind p on the ray from y. n is the normal of the
outline, and points away from the shape. v_p is the velocity of p, and w is the weight of the sample: the light or the
importance that the edge covers per unit of <v_p, n>, divided by the density.

At the start of a light path, y is a place on a lamp, and rays from y keep their direction relative to the lamp. W_p and
W_x are the contributions to the objective of light that continues from p and from x. A light walk estimates them. u_p
is the velocity of the ray at p. It is 0 unless the lamp moves.

    dL/dtheta  +=  w (W_p - W_x) <v_p - u_p, n>

Creases need this term, too. A crease is an edge between two flat-shaded faces that are both lit. The contribution of
the light jumps there, because the faces have different normals. At a crease, x is a point on the second face.

At the end of a light path, y is a place on the sensor, and x moves with the light that reaches it. L_x is the radiance
from x. A camera walk selects one contribution to L_x. Light that reaches x from a lamp over a specular chain does not
count here. This light moves x in another way, and `chain_edges.py` has its edges.

    dL/dtheta  -=  w delta(u) L_x <v_p - s v_x, n>,    s = |p - y| / |x - y|

Between two surfaces, light goes from y on the first surface past p to x on the second. L_y is the radiance from y, and
W_x the contribution of L_y after it continues from x. A camera walk selects one contribution to L_y, and a light walk
estimates W_x.

    dL/dtheta  -=  w W_x <v_p - s v_x - (1 - s) v_y, n>

A point that light reaches directly from a lamp slides along the direction l of this light, and moves with the ray.
Other points move with their surface. v is the velocity of the surface, and n_x its normal.

    v_x = u_x + l <v - u_x, n_x> / <l, n_x>   if light arrives directly from a lamp,   otherwise   v_x = v

v_y is defined in the same way. x in the last formula always moves with its surface.

A share h of the light between two near surfaces is differentiated with fixed directions (`Plan.near`). A fixed ray from
y jumps between p and x, and moves with y. The last formula then becomes

    dL/dtheta  +=  w h_p W_p <v_p - v_y, n>  -  w W_x <v_p - s (1 - h_x) v_x - (1 - s (1 - h_x)) v_y, n>

The light of p also counts if the ray past p leaves the scene. At a crease, W_p and W_x have the factor h_p, and s is 0.
A point x or y that this light reaches from a point z slides along the direction d of the light.

    v_x = (1 - h) v  +  h (v_z + d <v - v_z, n_x> / <d, n_x>)

If a shape touches the surface behind it, lamps and the sensor lose x at the same time. This light counts once, as seen
from the lamps. If both surfaces end there, as at the corner of a room, each has an edge, and each edge counts half.

Sources: Zhang et al. 2020, "Path-Space Differentiable Rendering"; Li et al. 2018, "Differentiable Monte Carlo Ray
Tracing through Edge Sampling".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import near_share
from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.outline_rays import (
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
from reslrb_cli.scene.graph import interpolates_normals, is_one_of
from reslrb_cli.scene.rays import ray_offset
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, camera_walk
from reslrb_cli.transport.connection import Connection, shading_correction
from reslrb_cli.transport.edges import sample_outline, view_from_lamps, view_from_sensor
from reslrb_cli.transport.emission import Emission
from reslrb_cli.transport.factors import MAY_LACK, Product, showing
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Hooks, Vertex, walk

#: Streams of random numbers, mixed into the seed.
LAMP_EDGES, SENSOR_EDGES, OTHER_EDGES = 0xED6E1, 0xED6E2, 0xED6E3


def differentiate_edges(p: Pass) -> None:
    """Add the derivatives of the light that edges of moving shapes cover and uncover. dL/dI must be known."""
    sides = {LAMP_EDGES: _from_lamps}
    # Other light that camera paths find has its edges there (`camera_edges.py`).
    if not p.plan.by_class or p.plan.finding_beams().beams:
        sides[SENSOR_EDGES] = _from_sensor
        if p.plan.stays:
            sides[OTHER_EDGES] = _between
    for stream, side in sides.items():
        samples = edge_samples(p.samples, stream)
        side(Pass(samples, None, p.adjoint), samples.stream(stream))


def _carried(
    samples: Samples, emitter: mi.EmitterPtr, to_lamp: mi.Ray3f, adjoint: mi.Vector3f, active: mi.Bool
) -> mi.Float:  # fmt: skip
    """Return <q, `adjoint`>. The point q of a light ray moves with the ray, as the ray's lamp moves. `to_lamp` leads
    from q to the lamp. Call the function under `dr.resume_grad()`.
    """
    p, plan = to_lamp.o, samples.plan
    q = p
    shapes = {lamp.emitter: lamp.shape for lamp in plan.needs.lamps}
    for moving in plan.moving_emitters:
        here = active & (emitter == mi.EmitterPtr(moving))
        if (shape := shapes.get(moving)) is not None:
            with dr.suspend_grad():
                pi = samples.scene.ray_intersect_preliminary(to_lamp, coherent=False, active=here)
                here &= pi.is_valid() & (pi.shape == mi.ShapePtr(shape))
            si = pi.compute_surface_interaction(to_lamp, mi.RayFlags.All | mi.RayFlags.FollowShape, here)
            n = mi.Vector3f(si.sh_frame.n if interpolates_normals(shape) else si.n)
            d = mi.Frame3f(n).to_world(mi.Frame3f(dr.detach(n)).to_local(-to_lamp.d))
            there = si.p + d * dr.detach(si.t)
        elif moving.class_name() == "PointLight":
            place = mi.traverse(moving)["position"]
            there = p + (place - dr.detach(place))
        elif moving.class_name() == "DirectionalEmitter":
            assert plan.horizon is not None
            to_world, center = mi.traverse(moving)["to_world"], mi.Point3f(*plan.horizon.center)
            there = center + to_world @ (dr.detach(to_world).inverse() @ mi.Vector3f(p - center))
        else:
            to_world = mi.traverse(moving)["to_world"]
            there = to_world @ (dr.detach(to_world).inverse() @ p)
        q = dr.select(here, there, q)
    return dr.select(active, dr.dot(q, adjoint), 0)


# ---- Seen from lamps ----


class Contribution(Hooks):
    """Contribution of a light path to the objective. `first` is the number of the path's first vertex.

    In the lanes `smooth`, this vertex lies on the outline of a mesh with interpolated normals. The correction for
    shading normals has no limit there, so it is left out at this vertex. The other estimators leave out its derivative
    (`shading_correction`).
    """

    def __init__(self, p: Pass, smooth: mi.Bool | None = None, first: mi.UInt32 | int = 1) -> None:
        self.p, self.smooth, self.first = p, smooth, first

    def start(self, product: Product) -> list[mi.Float]:
        return [mi.Float(0)] if self.smooth is None else [mi.Float(0), mi.Float(1)]

    def vertex(
        self, state: list[mi.Float], vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> list[mi.Float]:  # fmt: skip
        C = vertex.product.times(connection.c, vertex.depth).value()
        own = dr.select(connection.active, dr.dot(C, self.p.delta(connection.u, connection.active, self.colours)), 0)
        if self.smooth is None:
            return [state[0] + own]
        here = self.smooth & (vertex.depth == self.first)
        si = vertex.si
        correction, _ = shading_correction(self.p.plan, si, -vertex.ray.d, si.to_world(connection.wo), connection.wo)
        own = own * dr.select(here, _inverse(correction), state[1])
        return [state[0] + own, dr.select(here, _inverse(scattering.correction), state[1])]


def _inverse(correction: mi.Float) -> mi.Float:
    return dr.select(correction != 0, dr.rcp(correction), 0)


def on_smooth(shape: mi.ShapePtr, shapes: Sequence[mi.Shape], over: mi.Bool) -> mi.Bool | None:
    """Return the lanes `over` in which `shape`, one of `shapes`, interpolates normals. Return None if no shape does."""
    smooth = [each for each in shapes if interpolates_normals(each)]
    return is_one_of(shape, smooth) & over if smooth else None


def _from_lamps(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of outlines and creases seen from lamps. Half of the lanes continue from p, the others from
    x.
    """
    samples = p.samples
    assert samples.edges is not None
    over, chances = halves(samples, numbers)
    view = view_from_lamps(samples, chances.viewpoint, chances.wavelengths)
    outline = sample_outline(samples, samples.edges.lamp, view, chances, creases=True)
    beside = both_sides(samples, outline, creases=True)
    ray = dr.select(over, beside.over, beside.past)
    share = share_of(samples, outline, beside)
    emission = Emission(ray, (2 * share) * outline.weight, outline.view.emitter)
    moves = samples.plan.moving_emission
    shapes = samples.plan.edged + (samples.plan.occluders if moves else ())
    W = walk(samples, Contribution(p, on_smooth(outline.shape, shapes, over)), beside.active, emission)[0] * p.scale
    weight = showing(W) * dr.select(over, 1, -1)
    with dr.resume_grad(), dr.isolate_grad():
        adjoint, active = weight * outline.normal, beside.active & (weight != 0)
        moved = moved_by(beside.pi, beside.over, adjoint, active)
        if moves:
            to_lamp = mi.Ray3f(beside.past.o, outline.view.to_y)  # not from p, which may lie behind a surface
            moved -= _carried(samples, outline.view.emitter, to_lamp, adjoint, active)
        dr.backward_from(moved, flags=MAY_LACK)


# ---- Seen from the sensor ----


@dataclass
class Pick:
    """One contribution to the radiance from a point a, selected in proportion to its size (the largest channel).

    `L` (C,) is the radiance of the contribution divided by its size, and `total` is the sum of all sizes. `segments` is
    the number of segments from the lamp `emitter` to a. `towards` is the direction to the lamp at the vertex next to
    it. `n` is the normal at a, and `counts` is 0 if a is specular. z is the surface point from which other light
    arrives at a: intersection `pi_z` of `ray_z`, with the normal `n_z`. `near` is the share of the light between z and
    a that is differentiated with fixed directions (`Plan.near`). If `excludes`, light that arrives over a specular
    chain does not count. `chain` is then 1 at a and behind a specular chain that begins at a.
    """

    L: mi.Spectrum
    total: mi.Float
    segments: mi.UInt32
    towards: mi.Vector3f
    emitter: mi.EmitterPtr
    n: mi.Vector3f
    counts: mi.Float
    numbers: mi.PCG32
    ray_z: mi.Ray3f
    pi_z: mi.PreliminaryIntersection3f
    n_z: mi.Vector3f
    near: mi.Float
    chain: list[mi.UInt32]

    def offered(
        self, L: mi.Spectrum, active: mi.Bool, segments: mi.UInt32, towards: mi.Vector3f, emitter: mi.EmitterPtr
    ) -> Pick:
        """Return the selection after another contribution."""
        size = dr.select(active, dr.max(L), 0)
        total, number = self.total + size, self.numbers.next_float32()
        takes = active & (size > 0) & (number * total < size)
        return replace(
            self,
            L=dr.select(takes, L / size, self.L),
            total=total,
            segments=dr.select(takes, segments, self.segments),
            towards=dr.select(takes, towards, self.towards),
            emitter=dr.select(takes, emitter, self.emitter),
        )


class PickLight(CameraHooks):
    """Hooks that select one contribution to the radiance from the first point. Emission of a lamp there counts if
    `emits` is true. `near` is that of the plan of the paths whose derivative lacks the edges. With `only_beams`, light
    of emitters that paths hit does not count.
    """

    def __init__(
        self, numbers: mi.PCG32, near: float = 0, emits: bool = False, excludes: bool = False, only_beams: bool = False
    ) -> None:  # fmt: skip
        self.numbers, self.near, self.emits, self.excludes = numbers, near, emits, excludes
        self.only_beams = only_beams

    def start(self, first: FilmRay) -> Pick:
        return Pick(
            L=mi.Spectrum(0), total=mi.Float(0), segments=mi.UInt32(0), towards=mi.Vector3f(0),
            emitter=dr.zeros(mi.EmitterPtr), n=mi.Vector3f(0), counts=mi.Float(1), numbers=self.numbers,
            ray_z=dr.zeros(mi.Ray3f), pi_z=dr.zeros(mi.PreliminaryIntersection3f), n_z=mi.Vector3f(0),
            near=mi.Float(0), chain=[mi.UInt32(1)] if self.excludes else [],
        )  # fmt: skip

    def vertex(
        self, state: Pick, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> Pick:  # fmt: skip
        P, first = vertex.product.value() * state.counts, vertex.depth == 1
        n = mi.Vector3f(vertex.si.n)
        if met is not None and not self.only_beams:
            L, active = P * met.Le * met.weight, met.active
            if not self.emits:
                active &= ~first
            for behind in state.chain:
                active &= (behind == 0) | (vertex.depth <= 2)
            state = state.offered(L, active, vertex.depth - 1, vertex.ray.d, met.emitter)
        state = replace(state, n=dr.select(first, n, state.n))
        if self.near > 0:
            z, share = vertex.depth == 2, near_share(self.near**2, dr.squared_norm(vertex.si.p - vertex.ray.o))
            state = replace(
                state,
                ray_z=dr.select(z, vertex.ray, state.ray_z),
                pi_z=dr.select(z, vertex.pi, state.pi_z),
                n_z=dr.select(z, n, state.n_z),
                near=dr.select(z, share, state.near),
            )
        if event is not None:
            state = state.offered(P * event.c, event.active, vertex.depth, event.ds.d, event.ds.emitter)
        chain = [dr.select(first | (behind != 0) & scattering.is_delta, behind, 0) for behind in state.chain]
        return replace(state, counts=dr.select(first & scattering.is_delta, 0, state.counts), chain=chain)


def _moved_by_light(
    samples: Samples, light: Pick, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, adjoint: mi.Vector3f,
    active: mi.Bool,
) -> mi.Float:  # fmt: skip
    """Return <a, `adjoint`> with the derivative of the point a, the intersection `pi` of `ray`. a moves as light paths
    move it with the contribution `light`. Call the function under `dr.resume_grad()`.
    """
    at_a, direct = adjoint, light.segments == 1
    place, n, arriving = ray(pi.t), light.n, adjoint
    moved = mi.Float(0)
    if samples.plan.near > 0:
        follows = light.segments > 1
        at_z = dr.select(follows, light.near * (adjoint - slid(adjoint, light.n, light.ray_z.d)), 0)
        at_a, near = adjoint - at_z, follows & (light.segments == 2)
        place, n = dr.select(near, light.ray_z(light.pi_z.t), place), dr.select(near, light.n_z, n)
        arriving, direct = dr.select(near, at_z, adjoint), direct | near
        at_z = dr.select(near, slid(at_z, n, light.towards), at_z)
        moved += moved_by(light.pi_z, light.ray_z, at_z, active & follows & light.pi_z.is_valid())
    at_a = dr.select(light.segments == 1, slid(adjoint, light.n, light.towards), at_a)
    moved += moved_by(pi, ray, at_a, active)
    if samples.plan.moving_emission:
        there = mi.Ray3f(place + dr.mulsign(n, dr.dot(n, light.towards)) * ray_offset(place), light.towards)
        carried = arriving - slid(arriving, n, light.towards)
        moved += _carried(samples, light.emitter, there, carried, active & direct)
    return moved


def _from_sensor(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of outlines seen from the sensor."""
    samples = for_camera(p.samples)
    assert samples.edges is not None
    chances = chances_of(samples, numbers)
    outline = sample_outline(samples, samples.edges.sensor, view_from_sensor(samples, chances.viewpoint), chances)
    beside = both_sides(samples, outline)
    x, n = beside.x, outline.normal
    # If the shape touches the surface behind it, lamps and the sensor lose the point x at the same time. It counts
    # once, as seen from the lamps.
    touches = touches_behind(outline, beside)
    beside.active = beside.active & ~touches
    plan = samples.plan
    excludes = bool(plan.needs.has_delta_lobes) and not plan.moving_emission
    hooks = PickLight(numbers, p.plan.near, emits=True, excludes=excludes, only_beams=plan.only_beams)
    _, light = camera_walk(samples, hooks, beside.active, FilmRay(beside.past, outline.view.u, mi.Spectrum(1)))
    weight = p.delta(outline.view.u, beside.active, hooks.colours) * outline.weight * p.scale
    size = showing(dr.dot(weight, light.L) * light.total)
    active = beside.active & (size != 0)
    s = outline.view.distance / dr.norm(beside.past.o + beside.past.d * x.t - outline.view.y)
    behind = active & x.is_valid()
    at_x = dr.select(behind, (s * size) * n, 0)  # s is NaN if the ray leaves the scene
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, -size * n, active)
        moved += _moved_by_light(samples, light, x, beside.past, at_x, behind)
        dr.backward_from(moved, flags=MAY_LACK)


# ---- Between two surfaces ----


def _between(p: Pass, numbers: mi.PCG32) -> None:
    """Add the derivatives of outlines and creases on segments between two surfaces. The first surface is not specular.
    Light continues from p or from x.
    """
    samples, near = p.samples, p.plan.near
    between = sample_between(samples, numbers)
    outline, beside, back, y = between.outline, between.beside, between.back, between.y
    n, x, active = outline.normal, beside.x, between.active
    hooks = PickLight(numbers, near, only_beams=p.plan.only_beams)
    _, light = camera_walk(for_camera(samples), hooks, active, FilmRay(back, mi.Point2f(0), mi.Spectrum(1)))
    side = between.side(near, numbers)
    weight = outline.weight * light.L * (light.total * share_of(samples, outline, beside)) * side.weight
    emission = Emission(side.ray, weight, dr.zeros(mi.EmitterPtr))
    walked = walk(samples, Contribution(p), active & (light.total > 0), emission, light.segments + 1)
    W = showing(walked[0] * p.scale) * dr.select(side.over, -1, 1)
    active = active & (W != 0)
    at_x, at_y = (dr.select(active, (W * part) * n, 0) for part in (side.s, 1 - side.s))
    with dr.resume_grad(), dr.isolate_grad():
        moved = moved_by(beside.pi, beside.over, -W * n, active)
        moved += moved_by(x, beside.past, at_x, active & x.is_valid())
        moved += _moved_by_light(samples, light, y, back, at_y, active)
        dr.backward_from(moved, flags=MAY_LACK)
