"""Derivatives of what moves light: each segment is done again on a walk back over the stack, in an AD scope of its own.

Segment i maps the ray v_i that reaches vertex i to the next one, v_{i+1}, to a factor s_i and to a connection (c_i,
u_i). Let P_i be the path's throughput before vertex i, r_i the weight of its roulette, and B_i what all later
connections contribute to the objective per unit of throughput behind it, all of them detached. Then, from the last
vertex to the first,

    S_i     = <P_i, delta(u_i) c_i + r_i s_i B_i> + <a_{i+1}, v_{i+1}>
    a_i     = dS_i/dv_i,   B_{i-1} = delta(u_i) c_i + r_i s_i B_i         a_{k+1} = 0,   B_k = 0 behind the last one
    dS     += dS_i/dtheta

and at the emitter dS += <a_1, dv_1/dtheta> + <B_0, dE/dtheta>. Nothing is divided and nothing is inverted: factors that
are zero, and chains of any conditioning, need no care.

Vertices are pushed from the first on that a parameter moves, or gives its BSDF; what comes before depends on no
parameter but those of the emitter. The stack holds `stack_size` vertices, the last ones: where a path has more, it is
traced again for those before, block by block, the last block first.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Pass, VertexHooks, allocate, entry_bytes, places, read, vertices, write
from reslrb_cli.estimators.kept import Before, SurfacePoint, segment_again
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Numbers
from reslrb_cli.transport.walk import Vertex


@dataclass
class Frame:
    """One vertex on the stack: all that its segment is done again from, and P_i.

    `connected` is 1 where the sensor was seen. `aperture` holds the sample of the aperture where the sensor has one,
    `before` the vertex before where vertices stay on their surfaces.
    """

    point: SurfacePoint
    sample_1: mi.Float
    sample_2: mi.Point2f
    prefix: mi.Spectrum
    connected: mi.UInt32
    aperture: list[mi.Point2f]
    before: list[Before]

    @staticmethod
    def blank(plan: Plan) -> Frame:
        """A frame of zeros with the members that the plan needs."""
        aperture = [mi.Point2f(0)] if plan.needs.thin_lens else []
        zeros = mi.Float(0), mi.Point2f(0), mi.Spectrum(0), mi.UInt32(0)
        return Frame(SurfacePoint.blank(plan), *zeros, aperture, Before.start(plan))


def blank_roulette(plan: Plan) -> list[mi.Float]:
    """Return a blank weight of a vertex's roulette; nothing where light paths play none."""
    return [mi.Float(0)] if plan.plays_roulette else []


@dataclass
class Pushed:
    """Loop state of the way out.

    `count` is the number of vertices that were to be pushed so far, `needed` what it was after the last visible
    connection. `stack` are thread-local arrays, one for each member of a frame, `roulette` is one more of r_i, where
    roulette is played; `place` is where in them the current vertex stands, `before` is what the next one asks for.
    """

    count: mi.UInt32
    needed: mi.UInt32
    place: mi.UInt32
    stack: list[dr.Local]
    roulette: list[dr.Local]
    before: list[Before]


class Pushing(VertexHooks):
    """The way out: splat, and push vertices into a ring, so that it holds the last ones.

    Of vertices from number `end` on (from 0) none is pushed, and the path is not followed farther. None: no such end.
    """

    def __init__(self, p: Pass, size: int, end: mi.UInt32 | None = None) -> None:
        super().__init__(p)
        self.size, self.end = size, end

    def start(self, product: Product) -> Pushed:
        plan = self.p.plan
        stack, roulette = allocate(Frame.blank(plan), self.size), allocate(blank_roulette(plan), self.size)
        return Pushed(mi.UInt32(0), mi.UInt32(0), mi.UInt32(0), stack, roulette, Before.start(plan))

    def wants(self, state: Pushed, vertex: Vertex) -> mi.Bool:
        """Where there is no image to splat into, connections behind something that is differentiated."""
        return mi.Bool(True) if self.p.block is not None else self._useful(state, vertex)

    def goes_on(self, state: Pushed, vertex: Vertex) -> mi.Bool:
        return mi.Bool(True) if self.end is None else state.count < self.end

    def vertex(
        self, state: Pushed, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Pushed:  # fmt: skip
        p, plan, seen = self.p, self.p.plan, connection.active
        if p.block is not None:
            C = vertex.product.times(connection.c, vertex.depth).scaled(p.scale)
            p.splat(connection.u, C.value(), seen)
        pushed = vertex.active & self._useful(state, vertex)
        if self.end is not None:
            pushed = pushed & (state.count < self.end)
        frame = Frame(
            point=SurfacePoint.of(plan, vertex),
            sample_1=scattering.sample_1,
            sample_2=scattering.sample_2,
            prefix=vertex.product.value(),
            connected=dr.select(seen, mi.UInt32(1), 0),
            aperture=[connection.sample] if plan.needs.thin_lens else [],
            before=state.before,
        )
        place = dr.select(pushed, state.count % self.size, self.size)  # what is not pushed goes where nobody reads
        write(state.stack, frame, place, pushed)
        count = state.count + dr.select(pushed, mi.UInt32(1), 0)
        needed, before = dr.select(seen & pushed, count, state.needed), Before.of(plan, vertex, scattering)
        return Pushed(count, needed, place, state.stack, state.roulette, before)

    def survived(self, state: Pushed, weight: mi.Float) -> Pushed:
        for array in state.roulette:
            array.write(weight, state.place, state.place < self.size)
        return state

    def _useful(self, state: Pushed, vertex: Vertex) -> mi.Bool:
        """Lanes in which the vertex, or one before it, depends on a parameter."""
        plan = self.p.plan  # where B_0 is asked for, all of them
        return (state.count > 0) | (mi.Bool(True) if concerns_emission(plan) else begins(plan, vertex))


@dataclass
class Adjoint:
    """What the walk back carries: a = dS/dv of the ray's origin and direction, and B (C,)."""

    origin: mi.Vector3f
    direction: mi.Vector3f
    B: mi.Spectrum

    @staticmethod
    def where(mask: mi.Bool, origin: mi.Point3f, direction: mi.Vector3f, B: mi.Spectrum) -> Adjoint:
        """These in the lanes of the mask, zero in the others."""
        values = mi.Vector3f(origin), direction, B
        return Adjoint(*(dr.select(mask, value, 0) for value in values))

    @staticmethod
    def zero() -> Adjoint:
        """Behind the last vertex."""
        return Adjoint(mi.Vector3f(0), mi.Vector3f(0), mi.Spectrum(0))


def sweep(p: Pass, stack_size: int) -> Adjoint:
    """Trace the paths, splat them where there is an image, and walk back: the adjoint at the emitter.

    dL/dI is known.
    """
    size, longest = places(p.plan, stack_size), vertices(p.plan)
    pushed: Pushed = p.walk(Pushing(p, size))
    bottom = dr.select(pushed.count > size, pushed.count - size, 0)  # the first vertex that the ring still holds
    adjoint = walk_back(p, size, pushed, pushed.needed, bottom, Adjoint.zero())
    if longest <= size:
        return adjoint

    again = Pass(p.samples, None, p.adjoint)

    def block(left: mi.UInt32, adjoint: Adjoint) -> tuple[mi.UInt32, Adjoint]:
        pushed = again.walk(Pushing(again, size, left), left > 0)
        bottom = dr.select(left > size, left - size, 0)
        return bottom, walk_back(again, size, pushed, left, bottom, adjoint)

    _, adjoint = dr.while_loop(
        state=(dr.minimum(bottom, pushed.needed), adjoint),
        cond=lambda left, adjoint: left > 0,
        body=block,
        labels=("left", "adjoint"),
        label="blocks of the stack",
    )
    return adjoint


def walk_back(p: Pass, size: int, pushed: Pushed, top: mi.UInt32, bottom: mi.UInt32, adjoint: Adjoint) -> Adjoint:
    """Differentiate the segments of the vertices number top - 1 to bottom, in this order. Traces no ray."""
    plan, form = p.plan, Frame.blank(p.plan)
    assert p.adjoint is not None
    image = p.adjoint

    def body(
        number: mi.UInt32, adjoint: Adjoint, stack: list[dr.Local], roulette: list[dr.Local]
    ) -> tuple[mi.UInt32, Adjoint, list[dr.Local], list[dr.Local]]:
        place = (number - 1) % size
        frame = read(stack, form, place)
        r = roulette[0].read(place) if roulette else mi.Float(1)
        connected = frame.connected != 0
        scattered = dr.any(adjoint.B != 0) | dr.any(adjoint.origin != 0) | dr.any(adjoint.direction != 0)
        aperture = frame.aperture[0] if frame.aperture else mi.Point2f(0.5)
        numbers = Numbers(aperture, frame.sample_2, frame.sample_1)
        pi, ray = frame.point.hit()
        P, B = frame.prefix, adjoint.B
        with dr.resume_grad():
            ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(ray.o, ray.d)
            this, reached = segment_again(p.samples, frame.before, ray, pi, numbers, connected, scattered)
            there, following = this.connection, this.next_ray(attached=True)
            seen = connected & there.active
            delta = image.lookup(there.u, seen, plan.attached_normalization) * p.scale
            own = dr.select(seen, delta * there.f * there.weight, 0)
            later = dr.select(scattered, this.scattering.weight * (r * B), 0)
            moved = dr.dot(following.o, adjoint.origin) + dr.dot(following.d, adjoint.direction)
            dr.backward_from(dr.dot(P, reached * (own + later)) + dr.select(scattered, moved, 0))
            # What a lane without light computes may be no number: none of it goes on to the vertices before.
            before = Adjoint.where(connected | scattered, dr.grad(ray.o), dr.grad(ray.d), dr.detach(own + later))
        return number - 1, before, stack, roulette

    _, adjoint, _, _ = dr.while_loop(
        state=(mi.UInt32(top), adjoint, pushed.stack, pushed.roulette),
        cond=lambda number, *_: number > bottom,
        body=body,
        labels=("number", "adjoint", "stack", "roulette"),
        label="attached walk back",
    )
    return adjoint


def begins(plan: Plan, vertex: Vertex) -> mi.Bool:
    """Lanes in which the vertex itself depends on a parameter."""
    return plan.moves(vertex.si.shape) | plan.differentiates(vertex.bsdf)


def concerns_emission(plan: Plan) -> bool:
    """Whether a parameter has a part in the rays that leave the emitters, or in E."""
    return plan.differentiate_emission or plan.moving_emission


def differentiate_start(p: Pass, adjoint: Adjoint) -> None:
    """Add the derivatives of the rays that leave the emitters, and of E, where a parameter has a part in either."""
    plan = p.plan
    if not concerns_emission(plan):
        return
    with dr.resume_grad(), dr.isolate_grad():
        emission = p.emission()
        objective = dr.dot(adjoint.B, emission.weight)
        if plan.moving_emission:
            objective += dr.dot(adjoint.origin, emission.ray.o) + dr.dot(adjoint.direction, emission.ray.d)
        dr.backward_from(objective, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)


def scratch_bytes(plan: Plan, stack_size: int) -> int:
    """Thread-local bytes of each path that is being traced."""
    return sum(entry_bytes([Frame.blank(plan), blank_roulette(plan)])) * (places(plan, stack_size) + 1)
