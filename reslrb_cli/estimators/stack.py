"""Every connection of a path, at no extra variance and in one traversal: push each vertex, then walk back over them.

Walking back, the sum over all later connections is at hand when a vertex is reached:

    A_k = 0,   A_{j-1} = A_j + delta_j C_j
    dS  = A_0 dE/E + sum_j [ A_j ds_j/s_j + delta_j C_j dc_j/c_j ]

The stack is thread-local memory, about 60 bytes a vertex, of at most `stack_size` vertices. What lies beyond is summed
on the way, and a second walk takes that sum apart as `gather` does: no vertex is left out. With delta known before the
paths are traced, image and gradient are one kernel; otherwise they are traced again for it, without shadow rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import (
    Pass,
    PathAdjoint,
    VertexHooks,
    adjoint_of_factor,
    at_least_one,
    differentiate_emission,
    differentiate_passage,
)
from reslrb_cli.estimators.gather import Gather, GatherState, Taking, Visibility, contribution, vertices
from reslrb_cli.estimators.sums import AdjointSum, PlainSum
from reslrb_cli.transport.connection import Connection, Seen, connect, stand_in
from reslrb_cli.transport.factors import NO_ZERO, Product
from reslrb_cli.transport.scattering import Scattering, attached_factors
from reslrb_cli.transport.walk import Vertex

STACK_SIZE = 64  # vertices


@dataclass
class Frame:
    """One vertex on the stack: enough to find its surface interaction again, and what its connection contributes.

    `adjoint` is delta times the product of the nonzero factors of C, (C,); 0 where the sensor is not seen. What only
    some scenes need is empty in the others.
    """

    t: Any
    prim_uv: Any
    prim_index: Any
    shape: Any
    o: Any
    d: Any
    adjoint: Any
    zero: list[Any]  # tracked zeros of C, a channel each, then correction / pdf
    lobe: list[Any]  # scenes with delta lobes or masks: which lobe was sampled (1 delta, 2 null), with which numbers
    lens: list[Any]  # thin lenses: the sample of the aperture
    instance: list[Any]  # scenes with instances


def write(stack: list[Any], frame: Frame, index: Any, active: Any) -> None:
    """Write a frame, one thread-local array for each of its members."""
    for array, value in zip(stack, _members(frame), strict=True):
        array.write(value, index, active)


def read(stack: list[Any], like: Frame, index: Any) -> Frame:
    """Read a frame that has the same members as `like`."""
    values = iter([array.read(index) for array in stack])
    plain = [next(values) for _ in range(7)]
    lists = [[next(values) for _ in part] for part in (like.zero, like.lobe, like.lens, like.instance)]
    return Frame(*plain, *lists)


def _members(frame: Frame) -> list[Any]:
    plain = [frame.t, frame.prim_uv, frame.prim_index, frame.shape, frame.o, frame.d, frame.adjoint]
    return plain + frame.zero + frame.lobe + frame.lens + frame.instance


@dataclass
class Pushed:
    """Loop state of the way out: the stack, how high it is, and what did not fit."""

    stack: list[Any]
    height: Any
    d: Any  # direction in which the path left the top of the stack
    tail: AdjointSum  # contributions of the vertices beyond it
    last: Any  # last vertex with a visible connection; 0: none


@dataclass
class StackState:
    """What is left to do after the sweep: emission, and the vertices that did not fit."""

    S: AdjointSum
    tail: AdjointSum
    last: Any


class Pushing(VertexHooks):
    """The way out: splat, and push each vertex."""

    def __init__(self, p: Pass, visibility: Visibility | None, stack_size: int) -> None:
        super().__init__(p)
        self.visibility, self.size = visibility, min(stack_size, vertices(p))
        self.tall = vertices(p) > self.size
        self.instances = any(shape.class_name() == "Instance" for shape in p.scene.shapes())

    def start(self, product: Product) -> Pushed:
        stack = [dr.alloc_local(type(member), self.size) for member in _members(self.blank())]
        tail = AdjointSum.zero(self.p.plan.track_zeros)
        return Pushed(stack, mi.UInt32(0), mi.Vector3f(0), tail, mi.UInt32(0))

    def blank(self) -> Frame:
        """A frame with the members that this scene needs."""
        plan = self.p.plan
        zero = [mi.Int32(0) for _ in mi.Spectrum(0)] + [mi.Float(0)] if plan.track_zeros else []
        lobes = plan.needs.has_delta_lobes or plan.needs.has_null
        return Frame(
            mi.Float(0), mi.Point2f(0), mi.UInt32(0), mi.UInt32(0), mi.Point3f(0), mi.Vector3f(0), mi.Spectrum(0), zero,
            [mi.UInt32(0), mi.Float(0), mi.Point2f(0)] if lobes else [],
            [mi.Point2f(0)] if plan.needs.thin_lens else [],
            [mi.UInt32(0)] if self.instances else [],
        )  # fmt: skip

    def seen(self, vertex: Vertex) -> Seen | None:
        return None if self.visibility is None else self.visibility.seen(vertex.depth, vertices(self.p))

    def goes_on(self, state: Pushed, vertex: Vertex) -> Any:
        return mi.Bool(True) if self.visibility is None else vertex.depth < self.visibility.last

    def scattering(self, state: Pushed, vertex: Vertex, connection: Connection, scattering: Scattering) -> Pushed:
        p = self.p
        C = contribution(p, vertex, connection)
        p.splat(connection.u, C.value(), connection.active)
        delta = p.adjoint.lookup(connection.u, connection.active)
        adjoint = dr.select(connection.active, delta * C.nonzero, 0)

        frame, pi = self.blank(), vertex.pi
        frame.t, frame.prim_uv, frame.prim_index = pi.t, pi.prim_uv, pi.prim_index
        frame.shape = dr.reinterpret_array(mi.UInt32, pi.shape)
        frame.o, frame.d, frame.adjoint = vertex.ray.o, vertex.ray.d, adjoint
        if frame.zero:
            frame.zero = [*C.zero, dr.select(scattering.active, scattering.correction / scattering.pdf, 0)]
        if frame.lobe:
            kind = dr.select(scattering.is_delta, mi.UInt32(1), 0) + dr.select(scattering.is_null, mi.UInt32(2), 0)
            frame.lobe = [kind, scattering.sample_1, scattering.sample_2]
        if frame.lens:
            frame.lens = [connection.sample]
        if frame.instance:
            frame.instance = [dr.reinterpret_array(mi.UInt32, pi.instance)]

        fits = vertex.active & (vertex.depth <= self.size)
        write(state.stack, frame, vertex.depth - 1, fits)
        tail = state.tail
        if self.tall:
            tail = tail.plus(delta, C, vertex.depth, connection.active & ~fits)
        return Pushed(
            state.stack,
            dr.select(fits, vertex.depth, state.height),
            dr.select(fits, scattering.d, state.d),
            tail,
            dr.select(connection.active, vertex.depth, state.last),
        )


def walk_back(p: Pass, pushed: Pushed, like: Frame) -> AdjointSum:
    """Pop all vertices, differentiate both factors of each, and return S_0. Traces no ray but through masks."""
    plan = p.plan

    def body(height: Any, d_next: Any, A: AdjointSum, stack: list[Any]) -> tuple[Any, Any, AdjointSum, list[Any]]:
        index, frame = height, read(stack, like, height - 1)
        ray = mi.Ray3f(frame.o, frame.d)
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = mi.Bool(True)  # not on the stack: a masked write of booleans to thread-local memory ends the process
        pi.t, pi.prim_uv, pi.prim_index = frame.t, frame.prim_uv, frame.prim_index
        pi.shape = dr.reinterpret_array(mi.ShapePtr, frame.shape)
        if frame.instance:
            pi.instance = dr.reinterpret_array(mi.ShapePtr, frame.instance[0])
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, True)
        connected = dr.any(frame.adjoint != 0)
        aperture = frame.lens[0] if frame.lens else mi.Point2f(0.5)
        connection = connect(plan, p.sensor, si, ray, aperture, connected)
        event = _event(si.to_local(d_next), frame)
        scattered = A.alive()
        with dr.resume_grad():
            f_c, f_s = attached_factors(plan, si, si.bsdf(), connection.wo, connected, event, scattered)
            own = PathAdjoint(frame.adjoint, Product(frame.adjoint, frame.zero[:-1]))
            rest_c = dr.rcp(stand_in(connection)[0])
            if plan.needs.has_null:
                # No index of a path is negative: only connections without a zero factor count.
                rest_c = rest_c * differentiate_passage(
                    p, si, index, connection, connected, lambda t: adjoint_of_factor(own, mi.Int32(NO_ZERO), t, 0)
                )
            weight_c = adjoint_of_factor(own, index, f_c, rest_c)
            rest_s = frame.zero[-1] if frame.zero else 1
            weight_s = A.adjoint_of_factor(f_s, Product.one(plan.track_zeros), rest_s)
            objective = dr.select(connected, weight_c * f_c, 0) + dr.select(scattered, weight_s * f_s, 0)
            dr.backward_from(objective)
        return height - 1, frame.d, A.plus_product(frame.adjoint, frame.zero[:-1], index), stack

    tail = pushed.tail
    A = PlainSum(tail.value + tail.rest, mi.Spectrum(0), [mi.Spectrum(z) for z in tail.behind_zero])
    _, _, A, _ = dr.while_loop(
        state=(pushed.height, pushed.d, A, pushed.stack),
        cond=lambda height, d_next, A, stack: height > 0,
        body=body,
        labels=("height", "d_next", "A", "stack"),
        label="walk back",
    )
    return A


def _event(wo: Any, frame: Frame) -> Scattering:
    """The sampled event of a frame, as far as its factor needs it."""
    kind, sample_1, sample_2 = frame.lobe or [mi.UInt32(0), None, None]
    return Scattering(
        weight=None, wo=wo, d=None, pdf=None, eta=None, correction=None,
        is_delta=kind == 1, is_null=kind == 2, sample_1=sample_1, sample_2=sample_2, active=None,
    )  # fmt: skip


class Stack(Gather):
    """Exact, like `gather`, without tracing the paths a second time."""

    OPTIONS: ClassVar[dict[str, Any]] = {"stack_size": STACK_SIZE}

    def __init__(self, stack_size: int = STACK_SIZE) -> None:
        at_least_one("stack_size", stack_size)
        self.stack_size = stack_size

    def forward(self, p: Pass) -> GatherState | StackState:
        if p.adjoint is None or not p.plan.differentiate_bsdfs:
            return super().forward(p)
        return self._sweep(p, None)

    def backward(self, p: Pass, state: GatherState | StackState) -> None:
        if not p.plan.differentiate_bsdfs:
            super().backward(p, state)
            return
        if isinstance(state, GatherState):
            state = self._sweep(p, state.visibility)
            dr.eval(state)
        differentiate_emission(p, state.S.adjoint_of_emission)
        if vertices(p) > self.stack_size:
            beyond = Visibility([], state.last)
            p.walk(Taking(p, beyond, state.tail, first=self.stack_size + 1), state.last > self.stack_size)

    def _sweep(self, p: Pass, visibility: Visibility | None) -> StackState:
        hooks = Pushing(p, visibility, self.stack_size)
        active = True if visibility is None else visibility.last > 0
        pushed = p.walk(hooks, active)
        return StackState(walk_back(p, pushed, hooks.blank()), pushed.tail, pushed.last)
