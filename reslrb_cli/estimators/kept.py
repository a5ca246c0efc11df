"""The memory of a path that estimators keep, in few words: sums over its connections, vertices, and single factors.

AdjointSum: sums of delta_i C_i over the connections of a path, to which contributions are added, and from which they
are taken. Each channel is a pair (value, rest): what rounding loses is kept beside the value (Knuth's two-sum), so that
taking off what was added leaves zero also after a thousand vertices. Contributions whose prefix holds exactly one zero
factor are summed apart, without it: their value is nothing, and their derivative with respect to that factor is the
sum.

SurfacePoint: a surface interaction, kept of a vertex whose BSDF will be evaluated again.

Before: what is kept of the vertex before the current one where vertices stay where they are on their surfaces, instead
of going where a turned direction meets them. Behind a vertex i-1 that is not specular, light goes to all places.
`follow` has the sampled direction turn with surface i-1, so that x_i slides over whatever it meets. `stay` integrates
over places instead: x_i moves with its own surface alone, and the factor of the scattering carries what that changes,

    s_{i-1} = f_{i-1}(x_{i-2}, x_{i-1}, x_i) |cos_i| / |x_i - x_{i-1}|^2 dA_i / (the same density, detached)

with dA_i the area that a piece of surface i takes. All of it but what f_{i-1} changes with x_{i-1} is differentiated at
vertex i, whose adjoint then hands to i-1 a derivative by its place and none by its direction.

Source: Worchel et al. 2025, "Radiative Backpropagation with Non-Static Geometry", whose surface-integral form this
is. Edges at rest are not swept over, so that their part in the derivative is not lost; visibility's part is, in
either form.

Event: a single factor of a path, kept so that its derivative needs no replay.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Pass, PathAdjoint, adjoint_of_factor, differentiate_passage
from reslrb_cli.transport.bsdf import Hit, Scattering, evaluate, stays_behind, tracked_factor
from reslrb_cli.transport.connection import Connection, connect, stand_in
from reslrb_cli.transport.factors import NO_ZERO, Product, showing
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Numbers, Samples
from reslrb_cli.transport.walk import Segment, Vertex, find_following_vertex, find_vertex, segment


@dataclass
class AdjointSum:
    """sum_i delta_i C_i, (C,), as `value` + `rest`.

    `behind_zero` is the same pair for what lies behind a zero factor of the prefix, without that factor; it is empty
    where zeros are not tracked.
    """

    value: mi.Spectrum
    rest: mi.Spectrum
    behind_zero: list[mi.Spectrum]

    @classmethod
    def zero(cls, track_zeros: bool) -> AdjointSum:
        """The empty sum."""
        behind_zero = [mi.Spectrum(0), mi.Spectrum(0)] if track_zeros else []
        return cls(mi.Spectrum(0), mi.Spectrum(0), behind_zero)

    def plus(self, delta: mi.Spectrum, C: Product, index: mi.UInt32, active: mi.Bool) -> AdjointSum:
        """The sum with delta C of one more connection, that of vertex `index`."""
        delta = dr.select(active, delta, 0)
        value, rest = self._add(self.value, self.rest, delta * C.value())
        if not self.behind_zero:
            return type(self)(value, rest, [])
        term = delta * C.nonzero
        for c, zero in enumerate(C.zero):
            # A connection whose own factor is the zero one has a derivative there, and none in the prefix.
            term[c] = dr.select((zero >= 0) & (zero != mi.Int32(index)), term[c], 0)
        return type(self)(value, rest, list(self._add(self.behind_zero[0], self.behind_zero[1], term)))

    def minus(self, delta: mi.Spectrum, C: Product, index: mi.UInt32, active: mi.Bool) -> AdjointSum:
        """The sum without delta C of a connection that is in it."""
        return self.plus(-delta, C, index, active)

    def adjoint_of_factor(self, f: mi.Spectrum, prefix: Product, rest: mi.Float | float) -> mi.Spectrum:
        """d(sum)/df (C,), for a factor `f * rest` of the path with this prefix, before all connections in the sum."""
        f, total = dr.detach(f), self.value + self.rest
        result = dr.select(f != 0, total / f, 0)
        if self.behind_zero:
            behind = (self.behind_zero[0] + self.behind_zero[1]) * rest
            for c, zero in enumerate(prefix.zero):
                result[c] = dr.select((f[c] == 0) & (zero == NO_ZERO), behind[c], result[c])
        return showing(result)

    def adjoint_of_emission(self, E: mi.Spectrum) -> mi.Spectrum:
        """d(sum)/dE (C,)."""
        return self.adjoint_of_factor(E, Product.one(bool(self.behind_zero)), 1)

    @staticmethod
    def _add(value: mi.Spectrum, rest: mi.Spectrum, term: mi.Spectrum) -> tuple[mi.Spectrum, mi.Spectrum]:
        """value + rest + term, as the rounded sum and what it lost (Knuth 1969, 4.2.2, theorem B)."""
        total = value + term
        part = total - value
        return total, rest + ((value - (total - part)) + (term - part))


class PlainSum(AdjointSum):
    """The same for sums that are only ever added to, where nothing cancels: `rest` stays zero."""

    @staticmethod
    def _add(value: mi.Spectrum, rest: mi.Spectrum, term: mi.Spectrum) -> tuple[mi.Spectrum, mi.Spectrum]:
        return value + term, rest


@dataclass
class SurfacePoint:
    """What of a vertex its BSDF reads, as plain numbers (pointers are their indices).

    Where BSDFs read texture coordinates and directions alone, these are `[uv, wi, bsdf]`, without `bsdf` where just one
    is differentiated; otherwise what the shape needs to find the interaction again: `[t, prim_uv, prim_index, shape,
    instance, o, d]`.
    """

    numbers: list[dr.ArrayBase]

    @staticmethod
    def of(plan: Plan, vertex: Vertex) -> SurfacePoint:
        """That of a walk's current vertex."""
        if not plan.keep_geometry:
            pointer = [] if plan.sole_bsdf is not None else [_index(vertex.bsdf)]
            return SurfacePoint([vertex.si.uv, vertex.si.wi, *pointer])
        pi, ray = vertex.pi, vertex.ray
        pointers = [_index(pi.shape), _index(pi.instance)]
        return SurfacePoint([pi.t, pi.prim_uv, pi.prim_index, *pointers, ray.o, ray.d])

    @staticmethod
    def blank(plan: Plan) -> SurfacePoint:
        """One of zeros, of the same form."""
        if not plan.keep_geometry:
            pointer = [] if plan.sole_bsdf is not None else [mi.UInt32(0)]
            return SurfacePoint([mi.Point2f(0), mi.Vector3f(0), *pointer])
        indices = [mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)]
        return SurfacePoint([mi.Float(0), mi.Point2f(0), *indices, mi.Point3f(0), mi.Vector3f(0)])

    def ray(self) -> mi.Ray3f:
        """The ray that reached the vertex; kept in scenes in which BSDFs read geometry."""
        return mi.Ray3f(*self.numbers[-2:])

    def hit(self) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
        """What was hit, and the ray that hit it; kept in scenes in which BSDFs read geometry."""
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = mi.Bool(True)  # not kept: a masked write of booleans to thread-local memory ends the process
        pi.t, pi.prim_uv, pi.prim_index, shape, instance, o, d = self.numbers
        pi.shape = dr.reinterpret_array(mi.ShapePtr, shape)
        pi.instance = dr.reinterpret_array(mi.ShapePtr, instance)
        return pi, mi.Ray3f(o, d)

    def interaction(self, plan: Plan, active: mi.Bool | bool = True) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr]:
        """The surface interaction, as far as BSDFs read it, and the BSDF."""
        if not plan.keep_geometry:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.uv, si.wi, *pointer = self.numbers
            si.t = mi.Float(0)  # valid
            return si, dr.reinterpret_array(mi.BSDFPtr, pointer[0]) if pointer else plan.sole_bsdf
        pi, ray = self.hit()
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        return si, si.bsdf()


def event(wo: mi.Vector3f, lobe: list[mi.UInt32 | mi.Float | mi.Point2f]) -> Scattering:
    """A sampled event that was kept as its direction and `lobe`, as far as its factor needs it."""
    kind, sample_1, sample_2 = lobe or [mi.UInt32(0), None, None]
    return Scattering(
        weight=None, f=None, wo=wo, d=None, pdf=None, eta=None, correction=None,
        is_delta=kind == 1, is_null=kind == 2, sample_1=sample_1, sample_2=sample_2, active=None,
    )  # fmt: skip


def _index(pointer: mi.BSDFPtr | mi.ShapePtr) -> mi.UInt32:
    return dr.reinterpret_array(mi.UInt32, pointer)


def lobe(plan: Plan, scattering: Scattering | None) -> list[mi.UInt32 | mi.Float | mi.Point2f]:
    """Which lobe was sampled (1: delta, 2: null), with which numbers; nothing where just smooth ones matter.

    Of no event (None) zeros of the same form.
    """
    if not (plan.differentiate_delta or plan.differentiate_null):
        return []
    if scattering is None:
        return [mi.UInt32(0), mi.Float(0), mi.Point2f(0)]
    kind = dr.select(scattering.is_delta, mi.UInt32(1), 0) + dr.select(scattering.is_null, mi.UInt32(2), 0)
    return [kind, scattering.sample_1, scattering.sample_2]


@dataclass
class Before:
    """The vertex before the current one; `stays` is 1 where it is not specular, so that the current one stays."""

    point: SurfacePoint
    stays: mi.UInt32

    @staticmethod
    def start(plan: Plan) -> list[Before]:
        """At the beginning of a path; nothing where no vertex stays."""
        return [Before(SurfacePoint.blank(plan), mi.UInt32(0))] if plan.stays else []

    @staticmethod
    def of(plan: Plan, vertex: Vertex, scattering: Scattering) -> list[Before]:
        """What the vertex is to the next one."""
        if not plan.stays:
            return []
        stays = stays_behind(plan, vertex.bsdf, scattering.is_delta)
        return [Before(SurfacePoint.of(plan, vertex), dr.select(stays, mi.UInt32(1), 0))]


def is_staying(before: list[Before]) -> mi.Bool:
    """Lanes in which the vertex behind `before` stays where it is."""
    return before[0].stays != 0 if before else mi.Bool(False)


def reach(
    plan: Plan, before: list[Before], ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool,
    parameters: bool = True,
) -> tuple[Hit, mi.Spectrum]:  # fmt: skip
    """The vertex where `ray` hits what `pi` says, and a factor (C,) of value 1 that carries the derivatives of s_{i-1}
    which belong to it.

    Call under `dr.resume_grad()`, the ray being differentiable; without `parameters`, where it is resumed for the ray
    alone.
    """
    if not before:
        return find_vertex(ray, pi, active), mi.Spectrum(1)
    stays = active & is_staying(before)
    slid = find_vertex(ray, pi, active & ~stays).si
    stayed, reaching, factor = find_following_vertex(ray, pi, stays)
    with dr.suspend_grad():
        other, other_bsdf = before[0].point.interaction(plan, stays)
    # What f changes by its own parameters belongs to the vertex before: where they are resumed, the direction alone
    # is. (A variable that is made under one selective scope counts as suspended under another.)
    with dr.suspend_grad(when=parameters), dr.resume_grad(reaching.d, when=parameters):
        f = evaluate(plan, other, other_bsdf, other.to_local(reaching.d), stays)
    changed = dr.select(stays & (f != 0), dr.replace_grad(mi.Spectrum(1), f / dr.detach(f)), 1) * factor
    si = dr.select(stays, stayed, slid)
    there = mi.Ray3f(ray)
    there.d = dr.select(stays, reaching.d, ray.d)
    return Hit(si, si.bsdf(), there), dr.select(stays, changed, 1)


def segment_again(
    samples: Samples, before: list[Before], ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, numbers: Numbers,
    connected: mi.Bool, scattered: mi.Bool, evaluates: bool = True, parameters: bool = True,
) -> tuple[Segment, mi.Spectrum]:  # fmt: skip
    """The segment from there, with attached derivatives, and that factor."""
    hit, factor = reach(samples.plan, before, ray, pi, connected | scattered, parameters)
    return segment(samples, hit, numbers, connected, scattered, evaluates, attached=True), factor


@dataclass
class Event:
    """One factor of a path: f towards local direction `wo`; `index` is its vertex, 0 for emission.

    `rest` times f is the factor as a whole, but for the transmittance of masks; it is kept where zero factors are
    tracked, beside which alone it is of use. `own` holds whether the event is a connection's own, and the sample of the
    aperture, where masks may stand between it and the sensor.
    """

    index: mi.UInt32
    point: SurfacePoint
    wo: mi.Vector3f
    f: mi.Spectrum
    rest: list[mi.Float]
    lobe: list[mi.UInt32 | mi.Float | mi.Point2f]
    own: list[mi.Bool | mi.Point2f]

    @staticmethod
    def emission(plan: Plan) -> Event:
        """The event before the first vertex."""
        rest, wo, f = [mi.Float(0)] if plan.track_zeros else [], mi.Vector3f(0), mi.Spectrum(0)
        return Event(mi.UInt32(0), SurfacePoint.blank(plan), wo, f, rest, lobe(plan, None), _own(plan, None))

    @staticmethod
    def of_connection(plan: Plan, vertex: Vertex, connection: Connection) -> Event:
        """The BSDF of the vertex towards the sensor; index 0 where there is nothing to differentiate."""
        useful = mi.Bool(True) if plan.passage_in_gradient else plan.differentiates(vertex.bsdf)
        index, point = dr.select(useful, mi.UInt32(vertex.depth), 0), SurfacePoint.of(plan, vertex)
        rest = [dr.rcp(stand_in(connection)[0])] if plan.track_zeros else []
        return Event(index, point, connection.wo, connection.f, rest, lobe(plan, None), _own(plan, connection))

    @staticmethod
    def of_scattering(plan: Plan, vertex: Vertex, scattering: Scattering) -> Event:
        """The BSDF of the vertex along the path."""
        rest = [scattering.correction / scattering.pdf] if plan.track_zeros else []
        index, point, wo = mi.UInt32(vertex.depth), SurfacePoint.of(plan, vertex), scattering.wo
        return Event(index, point, wo, scattering.f, rest, lobe(plan, scattering), _own(plan, None))


def _own(plan: Plan, connection: Connection | None) -> list[mi.Bool | mi.Point2f]:
    """`Event.own` of an event that is a connection's, or of another."""
    if not plan.passage_in_gradient:
        return []
    return [mi.Bool(False), mi.Point2f(0)] if connection is None else [mi.Bool(True), connection.sample]


def differentiate_event(p: Pass, kept: Event, adjoint: PathAdjoint, active: mi.Bool) -> None:
    """Add the derivative of an event, of a connection with this adjoint, in `active` lanes that hold one."""
    plan, active = p.plan, active & (kept.index > 0)
    si, bsdf = kept.point.interaction(plan, active)
    rest = mi.Spectrum(kept.rest[0] if kept.rest else 0)
    if plan.passage_in_gradient:
        own, sample = kept.own
        connection = connect(plan, p.samples.sensor, si, kept.point.ray(), sample, active & own)
        passed = differentiate_passage(p, si, kept.index, connection, active & own, adjoint)
        rest = dr.select(own, rest * passed, rest)
    weight = adjoint_of_factor(adjoint, kept.index, kept.f, rest)
    active &= plan.differentiates(bsdf)
    with dr.resume_grad():
        f = tracked_factor(plan, si, bsdf, event(kept.wo, kept.lobe), active)
        dr.backward_from(dr.select(active, dr.dot(weight, f), 0))
