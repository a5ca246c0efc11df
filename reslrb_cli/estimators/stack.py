"""Every connection of a path, at no extra variance and in one traversal: push vertices, then walk back over them.

Walking back, the sum over all later connections is at hand when a vertex is reached:

    A_k = 0,   A_{j-1} = A_j + delta_j C_j
    dS  = A_0 dE/E + sum_j [ A_j ds_j/s_j + delta_j C_j dc_j/c_j ]

Only vertices with something to differentiate are pushed, each with the contributions since the last one. The stack is
thread-local memory, about 90 bytes a vertex, of at most `stack_size` vertices. What lies beyond is summed on the way,
and a second walk takes that sum apart as `gather` does: no vertex is left out. With delta known before the paths are
traced, image and gradient are one kernel; otherwise they are traced again for it, without shadow rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators import attached
from reslrb_cli.estimators.base import (
    STACK_SIZE,
    Estimator,
    Pass,
    PathAdjoint,
    VertexHooks,
    adjoint_of_connection,
    allocate,
    at_least_one,
    contribution,
    differentiate_emission,
    entry_bytes,
    places,
    read,
    vertices,
    write,
)
from reslrb_cli.estimators.gather import Gather, GatherState, Taking, Visibility
from reslrb_cli.estimators.kept import AdjointSum, PlainSum, SurfacePoint, event
from reslrb_cli.estimators.kept import lobe as kept_lobe
from reslrb_cli.transport.bsdf import Scattering, tracked_factors
from reslrb_cli.transport.connection import Connection, Seen
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Splat, Vertex


@dataclass
class Frame:
    """One vertex on the stack.

    `weight_c` is d(objective)/df of its connection, (C,), 0 where the sensor is not seen; `f_s` is f of its scattering;
    `own` is what the vertex adds to A: its delta C, and those of the vertices since the one below it on the stack.
    """

    point: SurfacePoint
    wo_c: mi.Vector3f
    wo_s: mi.Vector3f
    weight_c: mi.Spectrum
    f_s: mi.Spectrum
    own: mi.Spectrum
    # Where zeros are tracked: correction / pdf of the scattering, and `own` behind a zero factor.
    zeros: list[mi.Float | mi.Spectrum]
    lobe: list[mi.UInt32 | mi.Float | mi.Point2f]

    @staticmethod
    def blank(plan: Plan) -> Frame:
        """A frame of zeros with the members that the plan needs."""
        zeros = [mi.Float(0), mi.Spectrum(0)] if plan.track_zeros else []
        wo = mi.Vector3f(0)
        point, lobe = SurfacePoint.blank(plan), kept_lobe(plan, None)
        return Frame(point, wo, wo, mi.Spectrum(0), mi.Spectrum(0), mi.Spectrum(0), zeros, lobe)


@dataclass
class Pushed:
    """Loop state of the way out."""

    stack: list[dr.Local]  # thread-local arrays, one for each member of a frame
    height: mi.UInt32
    since: AdjointSum  # contributions since the last vertex that was pushed
    tail: AdjointSum  # contributions from vertex `first` on
    first: mi.UInt32  # the first vertex that found the stack full; 0: none
    last: mi.UInt32  # last vertex with a visible connection; 0: none


@dataclass
class StackState:
    """What is left to do after the sweep: emission, and the vertices that found the stack full."""

    S: AdjointSum
    tail: AdjointSum
    first: mi.UInt32
    last: mi.UInt32


class Pushing(VertexHooks):
    """The way out: splat, and push vertices; what is not pushed goes where nobody reads."""

    def __init__(self, p: Pass, visibility: Visibility | None, stack_size: int) -> None:
        super().__init__(p)
        self.visibility, self.size = visibility, places(p.plan, stack_size)

    def start(self, product: Product) -> Pushed:
        plan = self.p.plan
        since, tail = PlainSum.zero(plan.track_zeros), AdjointSum.zero(plan.track_zeros)
        # Three zeros: state variables may not be one object.
        return Pushed(allocate(Frame.blank(plan), self.size), mi.UInt32(0), since, tail, mi.UInt32(0), mi.UInt32(0))

    def concerned(self, state: Pushed) -> mi.Bool:
        return state.height > 0

    def seen(self, vertex: Vertex) -> Seen | None:
        return None if self.visibility is None else self.visibility.seen(vertex.depth, vertices(self.p.plan))

    def goes_on(self, state: Pushed, vertex: Vertex) -> mi.Bool:
        return mi.Bool(True) if self.visibility is None else vertex.depth < self.visibility.last

    def vertex(
        self, state: Pushed, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Pushed:  # fmt: skip
        p, plan, connected = self.p, self.p.plan, connection.active
        C = contribution(p, vertex, connection)
        p.splat(connection.u, C.value(), connected)
        delta = p.delta(connection.u, connected)
        own = PathAdjoint(dr.select(connected, delta * C.nonzero, 0), C)
        useful = vertex.active & plan.differentiates(vertex.bsdf)
        # Beyond the stack a second walk has the derivatives, those of masks before the sensor among them.
        if plan.differentiate_null and vertices(plan) > self.size:
            connected = connected & (state.first == 0) & ~(useful & (state.height >= self.size))
        weight_c = adjoint_of_connection(p, vertex, connection, connected, own)
        connected = connection.active
        return push(
            plan, state, self.size, vertex, useful, connection.wo, weight_c, scattering, [(delta, C, connected)]
        )


def push(
    plan: Plan, state: Pushed, size: int, vertex: Vertex, useful: mi.Bool, wo_c: mi.Vector3f, weight_c: mi.Spectrum,
    scattering: Scattering, found: list[tuple[mi.Spectrum, Product, mi.Bool]],
) -> Pushed:  # fmt: skip
    """The state with a vertex on the stack, where it is `useful` and there is room, and what it has `found`: delta, C,
    and the lanes."""
    depth, bounded = vertex.depth, vertices(plan) > size
    fits, first = useful, state.first
    if bounded:
        full = state.height >= size
        fits = useful & ~full
        first = dr.select((first == 0) & useful & full, depth, first)
    since, tail, last = state.since, state.tail, state.last
    for delta, C, active in found:
        since = since.plus(delta, C, depth, active & (first == 0))
        tail = tail.plus(delta, C, depth, active & (first != 0)) if bounded else tail
        last = dr.select(active, depth, last)
    zeros = []
    if plan.track_zeros:
        rest_s = dr.select(scattering.active, scattering.correction / scattering.pdf, 0)
        zeros = [rest_s, since.behind_zero[0]]
    frame = Frame(
        point=SurfacePoint.of(plan, vertex),
        wo_c=wo_c,
        wo_s=scattering.wo,
        weight_c=weight_c,
        f_s=dr.select(scattering.active, scattering.f, 0),
        own=since.value,
        zeros=zeros,
        lobe=kept_lobe(plan, scattering),
    )
    write(state.stack, frame, dr.select(fits, state.height, size), fits)
    height = state.height + dr.select(fits, mi.UInt32(1), 0)
    since = dr.select(fits, PlainSum.zero(plan.track_zeros), since)
    return Pushed(state.stack, height, since, tail, first, last)


def walk_back(p: Pass, pushed: Pushed) -> AdjointSum:
    """Pop all vertices, differentiate both factors of each, and return S_0. Traces no ray."""
    plan, form = p.plan, Frame.blank(p.plan)

    def body(height: mi.UInt32, A: AdjointSum, stack: list[dr.Local]) -> tuple[mi.UInt32, AdjointSum, list[dr.Local]]:
        frame = read(stack, form, height - 1)
        si, bsdf = frame.point.interaction(plan)
        rest_s = frame.zeros[0] if frame.zeros else 1
        weight_s = A.adjoint_of_factor(frame.f_s, Product.one(plan.track_zeros), rest_s)
        connected, scattered = dr.any(frame.weight_c != 0), dr.any(weight_s != 0)
        with dr.resume_grad():
            sampled = event(frame.wo_s, frame.lobe)
            f_c, f_s = tracked_factors(plan, si, bsdf, frame.wo_c, connected, sampled, scattered)
            dr.backward_from(dr.select(connected, frame.weight_c * f_c, 0) + dr.select(scattered, weight_s * f_s, 0))
        behind_zero = [A.behind_zero[0] + frame.zeros[1], A.behind_zero[1]] if frame.zeros else []
        return height - 1, PlainSum(A.value + frame.own, A.rest, behind_zero), stack

    since, tail = pushed.since, pushed.tail
    behind_zero = [sum(tail.behind_zero, since.behind_zero[0]), mi.Spectrum(0)] if tail.behind_zero else []
    A = PlainSum(tail.value + tail.rest + since.value, mi.Spectrum(0), behind_zero)
    _, A, _ = dr.while_loop(
        state=(pushed.height, A, pushed.stack),
        cond=lambda height, A, stack: height > 0,
        body=body,
        labels=("height", "A", "stack"),
        label="walk back",
    )
    return A


class Stack(Estimator):
    """Exact, like `gather`, without tracing the paths a second time."""

    exact = True
    attaches = True

    OPTIONS: ClassVar[dict[str, Any]] = {"stack_size": STACK_SIZE}

    def __init__(self, stack_size: int = STACK_SIZE) -> None:
        at_least_one("stack_size", stack_size)
        self.stack_size, self.gather = stack_size, Gather()

    def forward(self, p: Pass) -> Any:
        if p.plan.attached:
            if p.adjoint is not None:
                return attached.sweep(p, self.stack_size)
            assert p.block is not None
            return p.walk(Splat(p.samples, p.block))  # nothing is kept of a path: it is traced again
        if p.adjoint is None or not p.plan.differentiate_bsdfs:
            return self.gather.forward(p)
        return self._sweep(p, None)

    def backward(self, p: Pass, state: Any) -> None:
        if p.plan.attached:
            adjoint = state if isinstance(state, attached.Adjoint) else attached.sweep(p, self.stack_size)
            attached.differentiate_start(p, adjoint)
            return
        if isinstance(state, GatherState):
            if not p.plan.differentiate_bsdfs:
                self.gather.backward(p, state)
                return
            state = self._sweep(p, state.visibility)
            dr.eval(state)
        differentiate_emission(p, state.S.adjoint_of_emission)
        if vertices(p.plan) > self.stack_size:
            beyond = Visibility([], state.last)
            p.walk(Taking(p, beyond, state.tail, state.first), (state.first > 0) & (state.first <= state.last))

    def kept(self, plan: Plan) -> Any:
        if plan.attached:
            return []
        # Visibility is there from an image pass that did not know delta; the sweep's own state comes beside it.
        S = AdjointSum.zero(plan.track_zeros)
        return [Visibility.none(vertices(plan)), StackState(S, S, mi.UInt32(0), mi.UInt32(0))]

    def scratch_bytes(self, plan: Plan) -> int:
        if plan.attached:
            return attached.scratch_bytes(plan, self.stack_size)
        if not plan.differentiate_bsdfs:
            return 0
        return sum(entry_bytes(Frame.blank(plan))) * (places(plan, self.stack_size) + 1)

    def _sweep(self, p: Pass, visibility: Visibility | None) -> StackState:
        active = True if visibility is None else visibility.last > 0
        pushed = p.walk(Pushing(p, visibility, self.stack_size), active)
        return StackState(walk_back(p, pushed), pushed.tail, pushed.first, pushed.last)
