"""Attached derivatives by `stack`: the walk back over the stack evaluates each segment again, in its own AD scope.

Segment i maps the ray v_i that reaches vertex i to the next ray v_{i+1}, to a factor s_i and to a connection (c_i,
u_i). P_i is the path's throughput before vertex i. r_i is the roulette weight at vertex i. B_i is the contribution of
all later connections to the objective, per unit of throughput behind the vertex. P_i, r_i and B_i are detached. The
recursion starts at the last vertex.

    S_i     = <P_i, delta(u_i) c_i + r_i s_i B_i> + <a_{i+1}, v_{i+1}>
    a_i     = dS_i/dv_i,   B_{i-1} = delta(u_i) c_i + r_i s_i B_i         a_{k+1} = 0,   B_k = 0 behind the last one
    dS     += dS_i/dtheta

    dS     += <a_1, dv_1/dtheta> + <B_0, dE/dtheta>                       at the emitter

Nothing is divided or inverted, so zero factors and the conditioning of the chain do not matter.

A vertex i-1 that is not specular scatters light in all directions, so light from this vertex reaches all places. There
are two ways to differentiate such a segment. With `follow`, the sampled direction rotates with surface i-1, so the hit
point x_i slides over the next surface. With `stay`, the integral is over the places x_i, and x_i moves only with its
own surface. The factor of the scattering then contains the change.

    s_{i-1} = f_{i-1}(x_{i-2}, x_{i-1}, x_i) |cos_i| / |x_i - x_{i-1}|^2 dA_i / (the same density, detached)

dA_i is the area of a piece of surface i. Vertex i differentiates this factor s_{i-1}. The dependence of the BSDF
f_{i-1} on x_{i-1} is not differentiated here. The adjoint of vertex i then gives vertex i-1 a derivative with respect
to position x_{i-1}. The adjoint gives vertex i-1 no derivative with respect to the direction. `Before` stores the
previous vertex's data for the derivative of s_{i-1} at vertex i.

The surface-integral form comes from Worchel et al. 2025, "Radiative Backpropagation with Non-Static Geometry". With the
surface-integral form, edges that do not move contribute no error. The derivative of s_{i-1} grows as 1 / r for two
vertices at a distance r. Its variance is infinite where a moving shape touches another surface, and in the corners over
which light slides. With derivatives of edges, the light between two vertices is therefore the sum of two parts. The
part near^2 / (r^2 + near^2) is differentiated with fixed directions, the other part with `stay` (`Plan.near`). Neither
form has the derivative of visibility, which `edges.py` adds for the edges of moving shapes.

The stack starts with the first vertex that moves or whose BSDF has a parameter. Earlier vertices depend only on
parameters of the emitter. The stack works as in `stack.py`. Here, T behind the last pushed vertex equals the roulette
weight r_i.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Pass, SurfacePoint, VertexHooks
from reslrb_cli.estimators.stack import Ring, Stack, StackState, walk_back
from reslrb_cli.transport.bsdf import Hit, Scattering, evaluate, stays_behind
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import MAY_LACK, Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Numbers, Samples
from reslrb_cli.transport.walk import (
    Segment,
    Splat,
    Vertex,
    find_vertex,
    segment,
)

# ---- Evaluate a segment again ----


@dataclass
class Before:
    """Vertex before the current one. `stays` is 1 if the current vertex stays at its place on its surface. It is 0 if
    the previous vertex is specular.
    """

    point: SurfacePoint
    stays: mi.UInt32  # not a Bool, which crashes the process when a stack holds it

    @staticmethod
    def start(plan: Plan) -> list[Before]:
        """Return the state at the start of a path. The result is empty if no vertex stays."""
        return [Before(SurfacePoint.blank(plan), mi.UInt32(0))] if plan.stays else []

    @staticmethod
    def of(plan: Plan, vertex: Vertex, scattering: Scattering) -> list[Before]:
        """Return the state that a vertex passes to the next one."""
        if not plan.stays:
            return []
        stays = stays_behind(plan, vertex.bsdf, scattering.is_delta)
        return [Before(SurfacePoint.of(plan, vertex), dr.select(stays, mi.UInt32(1), 0))]


def is_staying(before: Sequence[Before]) -> mi.Bool:
    """Return the lanes in which the vertex after `before` stays at its place on its surface."""
    return before[0].stays != 0 if before else mi.Bool(False)


def find_following_vertex(
    ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Ray3f, mi.Float]:
    """Return the surface interaction of a vertex that stays at its place on its surface, and moves only with the
    surface.

    Also returns the ray that reaches the vertex, and a factor. The direction of the ray changes if either end of the
    ray moves. The factor has the value 1, but also has a derivative. The factor converts a measure of directions at the
    ray's origin to a measure on the surface. Apart from its normalisation to 1, the factor is |cos| / distance^2 times
    the stretching of the surface.
    """
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    there = si.p - ray.o
    distance = dr.norm(there)
    reaching = mi.Ray3f(ray)
    reaching.d = there / distance
    si.t = distance
    si.wi = si.to_local(-reaching.d)
    measure = dr.abs(dr.dot(si.n, reaching.d)) / dr.square(distance) * dr.norm(dr.cross(si.dp_du, si.dp_dv))
    return si, reaching, dr.select(active & (measure > 0), measure / dr.detach(measure), 1)


def near_share(near: Any, squared_distance: mi.Float) -> mi.Float:
    """Return the share of the light between two vertices that is differentiated with fixed directions. `near` is the
    square of `Plan.near`.
    """
    return near / (squared_distance + near)


def reach(
    plan: Plan, before: list[Before], ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool,
    parameters: bool = True, lit: mi.Bool | None = None,
) -> tuple[Hit, mi.Spectrum]:  # fmt: skip
    """Return the vertex at the intersection `pi` of `ray`, and a factor (C,) of value 1.

    The factor carries the derivatives of s_{i-1} that belong to this vertex. Call the function under `dr.resume_grad()`
    with a differentiable ray. Set `parameters` to False if only gradients of the ray are resumed. In the lanes `lit`,
    directions are not fixed.
    """
    if not before:
        return find_vertex(ray, pi, active), mi.Spectrum(1)
    stays = active & is_staying(before)
    slid = find_vertex(ray, pi, active if plan.near > 0 else active & ~stays).si
    stayed, reaching, factor = find_following_vertex(ray, pi, stays)
    with dr.suspend_grad():
        other, other_bsdf = before[0].point.interaction(plan, ray.wavelengths, stays)
    # Derivatives of f by its own parameters belong to the previous vertex, so if parameters are resumed here, only the
    # direction is. (A variable that is made in one selective scope counts as suspended in another.)
    with dr.suspend_grad(when=parameters), dr.resume_grad(reaching.d, when=parameters):
        f = evaluate(plan, other, other_bsdf, other.to_local(reaching.d), stays)
    changed = mi.Spectrum(dr.select(stays & (f != 0), dr.replace_grad(mi.Spectrum(1), f / dr.detach(f)), 1)) * factor
    if plan.near > 0:
        near = plan.near**2 if lit is None else dr.select(lit, 0, mi.Float(plan.near**2))
        shares = [near_share(near, dr.squared_norm(place - ray.o)) for place in (stayed.p, slid.p)]
        share = dr.detach(shares[0])
        changed = 1 + (changed - 1) * (1 - share) + (shares[1] - shares[0])
        stayed = _blend(stayed, slid, share)
        reaching.d = dr.lerp(reaching.d, ray.d, share)
    si = dr.select(stays, stayed, slid)
    there = mi.Ray3f(ray)
    there.d = dr.select(stays, reaching.d, ray.d)
    return Hit(si, si.bsdf(), there), dr.select(stays, changed, 1)


def _blend(stayed: mi.SurfaceInteraction3f, slid: mi.SurfaceInteraction3f, share: mi.Float) -> mi.SurfaceInteraction3f:
    """Return a vertex whose derivatives are a weighted sum of the derivatives of both. `share` is the weight of
    `slid`. The values are equal.
    """
    si = mi.SurfaceInteraction3f(stayed)
    for name in ("t", "p", "n", "uv", "wi", "dp_du", "dp_dv", "dn_du", "dn_dv"):
        setattr(si, name, dr.lerp(getattr(stayed, name), getattr(slid, name), share))
    axes = (dr.lerp(getattr(stayed.sh_frame, axis), getattr(slid.sh_frame, axis), share) for axis in "stn")
    si.sh_frame = mi.Frame3f(*axes)
    return si


def segment_again(
    samples: Samples, before: list[Before], ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, numbers: Numbers,
    connected: mi.Bool, scattered: mi.Bool,
) -> tuple[Segment, mi.Spectrum]:  # fmt: skip
    """Return the segment from a vertex with attached derivatives, and the factor that `reach` returns."""
    hit, factor = reach(samples.plan, before, ray, pi, connected | scattered)
    return segment(samples, hit, numbers, connected, scattered, attached=True), factor


# ---- The stack of segments ----


@dataclass
class Adjoint:
    """Adjoint on the walk back.

    a = dS/dv is the adjoint of the ray's origin and direction. B (C,) is that of the throughput.
    """

    origin: mi.Vector3f
    direction: mi.Vector3f
    B: mi.Spectrum

    @staticmethod
    def none() -> Adjoint:
        """Return the adjoint behind the end of a path."""
        return Adjoint(mi.Vector3f(0), mi.Vector3f(0), mi.Spectrum(0))


@dataclass
class AttachedFrame:
    """Vertex on the stack, with P_i, r_{i-1} and the data to evaluate the vertex's segment again.

    `connected` is 1 if the sensor was visible. `aperture` holds the sample of the aperture if the sensor has one. If
    vertices can stay at their places, `before` holds the previous vertex.
    """

    point: SurfacePoint
    sample_1: mi.Float
    sample_2: mi.Point2f
    prefix: mi.Spectrum
    roulette: mi.Float
    connected: mi.UInt32
    aperture: list[mi.Point2f]
    before: list[Before]

    @staticmethod
    def blank(plan: Plan) -> AttachedFrame:
        """Return a frame of zeros with the members that the plan needs."""
        aperture = [mi.Point2f(0)] if plan.needs.thin_lens else []
        zeros = mi.Float(0), mi.Point2f(0), mi.Spectrum(0), mi.Float(0), mi.UInt32(0)
        return AttachedFrame(SurfacePoint.blank(plan), *zeros, aperture, Before.start(plan))

    def differentiate(self, p: Pass, adjoint: Adjoint) -> Adjoint:
        """Add the derivatives of the vertex's segment.

        Takes the adjoint of the segment's outgoing ray, and returns the adjoint of the ray that reaches the vertex.
        """
        assert p.adjoint is not None
        assert p.colours is not None
        plan, P, B = p.plan, self.prefix, adjoint.B
        connected = self.connected != 0
        scattered = dr.any(B != 0) | dr.any(adjoint.origin != 0) | dr.any(adjoint.direction != 0)
        numbers = Numbers(self.sample_2, self.sample_1, self.aperture[0] if self.aperture else mi.Point2f(0.5))
        pi, ray = self.point.hit(p.wavelengths)
        with dr.resume_grad():
            ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(ray.o, ray.d)
            this, reached = segment_again(p.samples, self.before, ray, pi, numbers, connected, scattered)
            there, following = this.connection, this.next_ray(attached=True)
            seen = connected & there.active
            delta = p.adjoint.lookup(there.u, seen, p.colours, plan.attached_normalization)
            own = dr.select(seen, delta * p.scale * there.f * there.rest, 0)
            later = dr.select(scattered, this.scattering.s * B, 0)
            moved = dr.dot(following.o, adjoint.origin) + dr.dot(following.d, adjoint.direction)
            dr.backward_from(dr.dot(P, reached * (own + later)) + dr.select(scattered, moved, 0))
            # A lane without light may compute NaN, which must not reach earlier vertices.
            B = dr.detach(own + later) * self.roulette
            values, here = (mi.Vector3f(dr.grad(ray.o)), dr.grad(ray.d), B), connected | scattered
            return Adjoint(*(dr.select(here, value, 0) for value in values))


@dataclass
class AttachedState:
    """Loop state of the forward pass: the stack, and the data of the current vertex that the next vertex needs."""

    stack: StackState
    before: list[Before]


class AttachedSweep(VertexHooks):
    """Forward pass. The pass splats the image if there is one, and pushes the vertices that the ring takes."""

    def __init__(self, p: Pass, ring: Ring) -> None:
        super().__init__(p)
        self.ring = ring

    def start(self, product: Product) -> AttachedState:
        plan = self.p.plan
        stack = StackState.empty(AttachedFrame.blank(plan), self.ring, mi.Float(1))
        return AttachedState(stack, Before.start(plan))

    def wants(self, state: AttachedState, vertex: Vertex) -> mi.Bool:
        """Return all lanes if there is an image. Without an image, return the lanes in which this vertex or an earlier
        vertex depends on a parameter.
        """
        return mi.Bool(True) if self.p.block is not None else self._useful(state, vertex)

    def goes_on(self, state: AttachedState, vertex: Vertex) -> mi.Bool:
        return self.ring.takes(state.stack.count)

    def vertex(
        self, state: AttachedState, vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> AttachedState:  # fmt: skip
        p, plan, seen = self.p, self.p.plan, connection.active
        if p.block is not None:
            C = vertex.product.times(connection.c, vertex.depth).scaled(p.scale)
            p.splat(connection.u, C.value(), seen, self.colours)
        here = vertex.active & self._useful(state, vertex)
        frame = AttachedFrame(
            point=SurfacePoint.of(plan, vertex),
            sample_1=scattering.sample_1,
            sample_2=scattering.sample_2,
            prefix=vertex.product.value(),
            roulette=state.stack.T,
            connected=dr.select(seen, mi.UInt32(1), 0),
            aperture=[connection.sample] if plan.needs.thin_lens else [],
            before=state.before,
        )
        stack = state.stack.push(frame, self.ring, here, seen)
        return AttachedState(stack, Before.of(plan, vertex, scattering))

    def survived(self, state: AttachedState, factor: mi.Float) -> AttachedState:
        return AttachedState(state.stack.with_factor(factor), state.before)

    def _useful(self, state: AttachedState, vertex: Vertex) -> mi.Bool:
        """Return the lanes in which the vertex, or one before it, depends on a parameter."""
        plan = self.p.plan  # if B_0 is needed, all of them
        return (state.stack.count > 0) | (mi.Bool(True) if concerns_emission(plan) else begins(plan, vertex))


class AttachedStack(Stack):
    """The estimator `stack` with attached derivatives."""

    def forward(self, p: Pass) -> Any:
        if p.adjoint is not None:
            return self._differentiate(p)
        assert p.block is not None
        return p.walk(Splat(p.samples, p.block))  # no path is kept; the path is traced again

    def backward(self, p: Pass, state: Any) -> None:
        differentiate_start(p, state if isinstance(state, Adjoint) else self._differentiate(p))

    def kept(self, plan: Plan) -> Any:
        return []

    def _differentiate(self, p: Pass) -> Adjoint:
        """Trace the paths, splat them if there is an image, and walk back. Returns the adjoint at the emitter."""
        ring, again = Ring.of(p.plan, self.stack_size), Pass(p.samples, None, p.adjoint)
        sweep = AttachedSweep(p, ring)
        state: AttachedState = p.walk(sweep)

        def retrace(ring: Ring) -> StackState:
            return again.walk(AttachedSweep(again, ring), ring.takes(mi.UInt32(0))).stack

        return walk_back(p.along(sweep), AttachedFrame.blank(p.plan), ring, state.stack, Adjoint.none(), retrace)


def begins(plan: Plan, vertex: Vertex) -> mi.Bool:
    """Return the lanes in which the vertex itself depends on a parameter."""
    return plan.moves(vertex.si.shape) | plan.differentiates(vertex.bsdf)


def concerns_emission(plan: Plan) -> bool:
    """Whether a parameter affects the rays that leave the emitters, or E."""
    return plan.differentiate_emission or plan.moving_emission


def differentiate_start(p: Pass, adjoint: Adjoint) -> None:
    """Add the derivatives of the emitters' rays and of E, if a parameter affects them."""
    plan = p.plan
    if not concerns_emission(plan):
        return
    with dr.resume_grad(), dr.isolate_grad():
        emission = p.emission()
        objective = dr.dot(adjoint.B, emission.E)
        if plan.moving_emission:
            objective += dr.dot(adjoint.origin, emission.ray.o) + dr.dot(adjoint.direction, emission.ray.d)
        dr.backward_from(objective, flags=MAY_LACK)
