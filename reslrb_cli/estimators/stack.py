"""Use every connection of a path without additional variance. The forward pass traces the paths and pushes their
vertices on a stack. The walk back visits the vertices in reverse order, and adds their derivatives.

P_j is the throughput before vertex j, so P_1 = E at the first vertex. s_j is the scattering factor and c_j the
connection factor at vertex j. Each of s_j and c_j is f = bsdf * cos times numbers r without a derivative. The numbers
of c_j include `Pass.scale`. delta_j is dL/dI at the film position of c_j. B_j is the contribution of all later
connections to the objective, per unit of throughput behind s_j. The recursion starts at the last vertex.

    dS     += P_j [ delta_j dc_j + B_j ds_j ]
    B_{j-1} = delta_j c_j + s_j B_j                      B = 0 behind the last vertex
    dS     += B_0 dE                                     at the emitter

If Russian roulette with probability q lets the path go on to vertex j, 1/q multiplies P_j and B_{j-1}. For example, a
path with three vertices and without roulette contributes E c_1 + E s_1 c_2 + E s_1 s_2 c_3, each weighted by its delta.

    vertex 3   dS += E s_1 s_2 [ delta_3 dc_3 ]              B_2 = delta_3 c_3
    vertex 2   dS += E s_1 [ delta_2 dc_2 + B_2 ds_2 ]       B_1 = delta_2 c_2 + s_2 B_2
    vertex 1   dS += E [ delta_1 dc_1 + B_1 ds_1 ]           B_0 = delta_1 c_1 + s_1 B_1
    emitter    dS += B_0 dE

This is like Mitsuba's `prb`, except that `prb` traces each path a second time. `prb` then knows the sum of all
contributions, subtracts those of the vertices that it passes, and divides by s_j. Here, the stack has what a vertex
needs, and B_j comes from multiplications. Nothing is divided, so zero factors need no special treatment here. Only the
walk must not end a path at a zero factor that has a derivative: `Plan.track_zeros` says that there may be one, and
`Product.alive` then ends a path at its second zero.

Paths are traced while gradients are suspended. Only `Frame.differentiate` resumes them. It evaluates both factors f of
one vertex again, and `dr.backward_from` adds their derivatives to the parameters' gradients, inside the symbolic loop.

Only differentiated vertices are pushed. If there are others, the forward pass combines the vertices between two pushed
vertices. T is the throughput, including roulette, since the last pushed vertex. D is the contribution of all vertices
since the last pushed vertex, per unit of throughput behind it. If all vertices are pushed, D is 0 and T only has
roulette's 1/q.

    B = (D + T delta_k c_k) + (T s_k) B_k                of the vertex that was pushed before k

The stack is a ring of `stack_size` places in thread-local memory. The ring holds the last vertices, in about 95 bytes
each. A longer path is traced again for its earlier vertices, block by block from the last block to the first.

With `run.adjoint: batched` or `independent`, delta is known before the paths are traced. `forward` then also walks
back, in the same kernel. With `correlated`, `backward` traces the paths again, without shadow rays, and walks back.

`attached.py` uses this recursion for parameters that move light. `camera.py` uses the recursion for camera paths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, TypeVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import (
    STACK_SIZE,
    Estimator,
    Pass,
    PathAdjoint,
    SurfacePoint,
    VertexHooks,
    at_least_one,
    contribution,
    differentiate_emission,
    differentiate_passage,
    event,
    vertices,
)
from reslrb_cli.estimators.base import lobe as lobe_of
from reslrb_cli.estimators.gather import Gathering, Visibility
from reslrb_cli.transport.bsdf import Scattering, tracked_factors
from reslrb_cli.transport.connection import Connection, KnownVisibility
from reslrb_cli.transport.factors import MAY_LACK, Product, showing
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex

A = TypeVar("A")
T = TypeVar("T")

# ---- Thread-local memory ----


def arrays(tree: Any) -> list[dr.ArrayBase]:
    """Return all arrays of a PyTree of dataclasses and lists, in order."""
    if is_dataclass(tree):
        tree = [getattr(tree, field.name) for field in fields(tree)]
    return [array for part in tree for array in arrays(part)] if isinstance(tree, (list, tuple)) else [tree]


def like(form: T, values: Iterator[dr.ArrayBase]) -> T:
    """Return a PyTree of the same form as `form`, filled with the next arrays from `values`."""
    made: Any = type(form)
    if isinstance(form, list):
        return made(like(part, values) for part in form)
    if is_dataclass(form):
        return made(*(like(getattr(form, field.name), values) for field in fields(form)))
    return next(values)


def entry_bytes(tree: Any) -> list[int]:
    """Return the entry size in bytes for each array in a PyTree."""
    found = arrays(tree)
    parts = [list(array) if dr.depth_v(array) > 1 else [] for array in found]
    return [n for array, own in zip(found, parts, strict=True) for n in (entry_bytes(own) or [dr.itemsize_v(array)])]


def allocate(form: Any, size: int) -> list[dr.Local]:
    """Return thread-local memory for `size` PyTrees like `form`, plus one place for discarded values.

    No place may be written twice, even if the first write is masked. Otherwise the second write is lost (Dr.Jit 1.5,
    LLVM).
    """
    return [dr.alloc_local(type(array), size + 1) for array in arrays(form)]


def write(stack: list[dr.Local], value: Any, place: mi.UInt32, active: mi.Bool) -> None:
    """Write a PyTree to one place of the thread-local memory."""
    for array, member in zip(stack, arrays(value), strict=True):
        array.write(member, place, active)


def read(stack: list[dr.Local], form: T, place: mi.UInt32) -> T:
    """Return the PyTree at a place."""
    return like(form, (array.read(place) for array in stack))


# ---- The stack ----


@dataclass(frozen=True)
class Ring:
    """Map from vertex numbers to places on the stack. The ring has one extra place with number `size`, which receives
    discarded values.

    `end` is the number of the first vertex that is not pushed, or None to push all. A walk with an `end` traces paths
    again for one block of vertices.
    """

    size: int
    wraps: bool
    end: mi.UInt32 | None = None

    @staticmethod
    def of(plan: Plan, stack_size: int, last: int = 0) -> Ring:
        """Return a ring of at most `stack_size` places, but at least one, for the paths of a plan. `last` is 1 if the
        end of a path on an emitter counts as a vertex, otherwise 0.
        """
        count = vertices(plan) + last
        size = min(stack_size, max(count, 1))
        return Ring(size, count > size)

    def place(self, number: mi.UInt32) -> mi.UInt32:
        """Return the place of a vertex."""
        return number % self.size if self.wraps else number

    def takes(self, number: mi.UInt32) -> mi.Bool:
        """Return the lanes in which vertex `number` is to be pushed. Paths end at the first other vertex."""
        return mi.Bool(True) if self.end is None else number < self.end

    def bottom(self, count: mi.UInt32) -> mi.UInt32:
        """Return the first vertex that is still on the stack after `count` vertices."""
        return dr.select(count > self.size, count - self.size, 0) if self.wraps else mi.UInt32(0)


@dataclass
class StackState:
    """Loop state of the forward pass.

    `count` vertices have been pushed, with the numbers 0 to `count` - 1. Only the first `useful` of them have a
    contribution at the vertex or behind it. `D` is D behind the last useful vertex. `T` is T at the current vertex, a
    Float if all vertices are pushed, because roulette's 1/q is the same for all channels. `stack` has an array for
    each member of a frame.
    """

    stack: list[dr.Local]
    count: mi.UInt32
    useful: mi.UInt32
    T: mi.Float | mi.Spectrum
    D: mi.Spectrum

    @staticmethod
    def empty(form: Any, ring: Ring, T: mi.Float | mi.Spectrum) -> StackState:
        """Return an empty stack for frames like `form`. `form` is None if no vertex is ever pushed. `T` is 1."""
        stack = [] if form is None else allocate(form, ring.size)
        return StackState(stack, mi.UInt32(0), mi.UInt32(0), T, mi.Spectrum(0))

    def D_here(self) -> mi.Spectrum:
        """Return D at the current vertex. It is 0 if the last pushed vertex is not useful so far."""
        return dr.select(self.useful == self.count, self.D, 0)

    def with_contribution(self, value: mi.Spectrum, active: mi.Bool) -> StackState:
        """Return the state after a contribution of a vertex that is not pushed. `value` is delta c_j."""
        D = dr.select(active, self.D_here() + self.T * value, self.D)
        return replace(self, useful=dr.select(active, self.count, self.useful), D=D)

    def with_factor(self, factor: mi.Float | mi.Spectrum) -> StackState:
        """Return the state behind a factor of the path, which multiplies T."""
        return replace(self, T=self.T * factor)

    def push(self, frame: Any, ring: Ring, here: mi.Bool, contributes: mi.Bool) -> StackState:
        """Return the state after pushing a vertex in lanes `here`, as far as the ring takes it. In lanes `contributes`,
        the vertex has its own contribution.
        """
        here = here & ring.takes(self.count)
        place = dr.select(here, ring.place(self.count), ring.size)
        write(self.stack, frame, place, here)
        count, contributes = self.count + dr.select(here, mi.UInt32(1), 0), here & contributes
        return StackState(
            self.stack,
            count,
            useful=dr.select(contributes, count, self.useful),
            T=dr.select(here, 1, self.T),
            D=dr.select(contributes, 0, self.D),
        )


def walk_back(p: Pass, form: Any, ring: Ring, state: StackState, adjoint: A, again: Callable[[Ring], StackState]) -> A:
    """Differentiate the useful vertices from the last to the first. Return the adjoint before the first vertex.

    `form` is a frame, such as `Frame.blank`. A frame's `differentiate(p, adjoint)` adds the derivatives of a vertex. It
    takes the adjoint behind the vertex, such as B_k, and returns the adjoint behind the vertex that was pushed before.

    `adjoint` is the adjoint behind the last useful vertex. `again(ring)` traces the paths again up to the ring's `end`.
    `again` is called only if paths may be longer than the stack.
    """
    if not state.stack:
        return adjoint
    bottom = ring.bottom(state.count)
    adjoint = differentiate_frames(p, form, ring, state, state.useful, bottom, adjoint)
    if not ring.wraps:
        return adjoint

    def block(left: mi.UInt32, adjoint: A) -> tuple[mi.UInt32, A]:
        bottom, retraced = ring.bottom(left), again(replace(ring, end=left))
        return bottom, differentiate_frames(p, form, ring, retraced, left, bottom, adjoint)

    _, adjoint = dr.while_loop(
        state=(dr.minimum(bottom, state.useful), adjoint),
        cond=lambda left, adjoint: left > 0,
        body=block,
        labels=("left", "adjoint"),
        label="blocks of the stack",
    )
    return adjoint


def differentiate_frames(
    p: Pass, form: Any, ring: Ring, state: StackState, top: mi.UInt32, bottom: mi.UInt32, adjoint: A
) -> A:
    """Differentiate the vertices on the stack from number top - 1 down to bottom. Traces no ray."""

    def body(number: mi.UInt32, adjoint: A, stack: list[dr.Local]) -> tuple[mi.UInt32, A, list[dr.Local]]:
        return number - 1, read(stack, form, ring.place(number - 1)).differentiate(p, adjoint), stack

    _, adjoint, _ = dr.while_loop(
        state=(mi.UInt32(top), adjoint, state.stack),
        cond=lambda number, *_: number > bottom,
        body=body,
        labels=("number", "adjoint", "stack"),
        label="walk back",
    )
    return adjoint


# ---- A vertex with fixed directions ----


@dataclass
class Frame:
    """Vertex k on the stack. Its BSDF is evaluated again: f_c towards the sensor and f_s along the path.

    The factors are c_k = f_c r_c and s_k = f_s r_s. `adjoint_c` (C,) is dS/df_c = P_k delta_k r_c. `adjoint_s_per_b`
    (C,) is P_k r_s, because dS/df_s = P_k r_s B_k. B of the vertex that was pushed before is `own` + `onward` B_k.
    `lobe` has the rest of the sampled event.
    """

    point: SurfacePoint
    wo_c: mi.Vector3f
    wo_s: mi.Vector3f
    adjoint_c: mi.Spectrum
    adjoint_s_per_b: mi.Spectrum
    own: mi.Spectrum
    onward: mi.Spectrum
    lobe: list[mi.UInt32 | mi.Float | mi.Point2f]

    @staticmethod
    def blank(plan: Plan) -> Frame:
        """Return a frame of zeros with the members that the plan needs."""
        wo, zero = mi.Vector3f(0), mi.Spectrum(0)
        return Frame(SurfacePoint.blank(plan), wo, wo, zero, zero, zero, zero, lobe_of(plan, None))

    @staticmethod
    def empty_stack(plan: Plan, ring: Ring) -> StackState:
        """Return the state before the first vertex."""
        T = mi.Float(1) if pushes_all(plan) else mi.Spectrum(1)
        return StackState.empty(Frame.blank(plan) if plan.differentiate_bsdfs else None, ring, T)

    def differentiate(self, p: Pass, B: mi.Spectrum) -> mi.Spectrum:
        """Add the derivatives of both factors, given B_k (C,). Returns B of the vertex that was pushed before."""
        si, bsdf = self.point.interaction(p.plan, p.wavelengths)
        adjoint_c, adjoint_s = self.adjoint_c, showing(self.adjoint_s_per_b * B)
        connected, scattered = dr.any(adjoint_c != 0), dr.any(adjoint_s != 0)
        with dr.resume_grad():
            sampled = event(self.wo_s, self.lobe)
            f_c, f_s = tracked_factors(p.plan, si, bsdf, self.wo_c, connected, sampled, scattered)
            objective = dr.select(connected, adjoint_c * f_c, 0) + dr.select(scattered, adjoint_s * f_s, 0)
            dr.backward_from(objective, flags=MAY_LACK)
        return self.own + self.onward * B


def pass_vertex(
    plan: Plan, state: StackState, ring: Ring, here: mi.Bool, vertex: Vertex, scattering: Scattering,
    connection: Connection | None, delta_r: mi.Spectrum,
) -> StackState:  # fmt: skip
    """Return the state behind a vertex. The vertex is pushed in the lanes `here`.

    `delta_r` (C,) is delta_k r_c: delta times the connection without its BSDF, or 0 if the connection does not count.
    """
    T, P, on = state.T, vertex.product.value(), scattering.active
    wo, own, visible = mi.Vector3f(0), mi.Spectrum(0), mi.Bool(False)
    if connection is not None:
        wo, own, visible = connection.wo, delta_r * connection.f, connection.active
    if not state.stack:  # no BSDF is differentiated, so only B_0 is needed
        return state.with_contribution(own, visible).with_factor(scattering.s)
    frame = Frame(
        point=SurfacePoint.of(plan, vertex),
        wo_c=wo,
        wo_s=scattering.wo,
        adjoint_c=showing(P * delta_r),
        adjoint_s_per_b=dr.select(on, P * (scattering.correction / scattering.pdf), 0),
        own=state.D_here() + T * own,
        onward=dr.select(on, T * scattering.s, 0),
        lobe=lobe_of(plan, scattering),
    )
    if not pushes_all(plan):
        state = state.with_contribution(own, visible & ~here).with_factor(scattering.s)
    return state.push(frame, ring, here, visible)


def pushes_all(plan: Plan) -> bool:
    """True if every vertex has something to differentiate, so the stack leaves out no vertex."""
    return plan.differentiate_bsdfs and not plan.only_bsdfs


# ---- Light paths ----


class LightSweep(VertexHooks):
    """Forward pass of light paths, which splats the image if there is one, and pushes the vertices. Three walks use it.

    - If delta is known beforehand, the only walk.
    - If delta is known after the image, the second walk. `visibility` is the result of the first walk (`Gathering`).
    - If paths are longer than the stack, another walk for each block, up to the `end` of its ring.
    """

    def __init__(self, p: Pass, ring: Ring, visibility: Visibility | None = None) -> None:
        super().__init__(p)
        self.ring, self.visibility = ring, visibility

    def start(self, product: Product) -> StackState:
        return Frame.empty_stack(self.p.plan, self.ring)

    def concerned(self, state: StackState) -> mi.Bool:
        return state.count > 0

    def known_visibility(self, vertex: Vertex) -> KnownVisibility | None:
        return None if self.visibility is None else self.visibility.of(vertex.depth, vertices(self.p.plan))

    def goes_on(self, state: StackState, vertex: Vertex) -> mi.Bool:
        return self.ring.takes(state.count) if self.visibility is None else vertex.depth < self.visibility.last

    def vertex(
        self, state: StackState, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> StackState:  # fmt: skip
        p, plan, visible = self.p, self.p.plan, connection.active
        C = contribution(p, vertex, connection)
        p.splat(connection.u, C.value(), visible, self.colours)
        delta = p.delta(connection.u, visible, self.colours)
        here = vertex.active & plan.differentiates(vertex.bsdf)
        if self.ring.end is None and plan.differentiate_null:
            own = PathAdjoint(dr.select(visible, delta * C.nonzero, 0), C)
            differentiate_passage(p, vertex.si, vertex.depth, connection, visible, own)
        delta_r = dr.select(visible, delta * p.scale * connection.rest * connection.through, 0)
        return pass_vertex(plan, state, self.ring, here, vertex, scattering, connection, delta_r)

    def survived(self, state: StackState, factor: mi.Float) -> StackState:
        return state.with_factor(factor)


class Stack(Estimator):
    """The estimator `stack`: exact, like `gather`. It does not trace paths a second time if delta is known."""

    exact = True

    OPTIONS: ClassVar[dict[str, Any]] = {"stack_size": STACK_SIZE}

    def __init__(self, stack_size: int = STACK_SIZE) -> None:
        at_least_one("stack_size", stack_size)
        self.stack_size = stack_size

    def forward(self, p: Pass) -> Visibility | mi.Spectrum:
        """Trace the image pass. If delta is known, add the derivatives of BSDFs, and return B_0 (C,). Otherwise, return
        the visibility of the connections.
        """
        if p.adjoint is not None:
            return self._sweep(p, None)
        return p.walk(Gathering(p)).visibility

    def backward(self, p: Pass, state: Visibility | mi.Spectrum) -> None:
        B = self._sweep(p, state) if isinstance(state, Visibility) else state
        differentiate_emission(p, lambda E: showing(B))

    def kept(self, plan: Plan) -> Any:
        return [Visibility.none(vertices(plan)), mi.Spectrum(0)]  # `forward` keeps one of them

    def _sweep(self, p: Pass, visibility: Visibility | None) -> mi.Spectrum:
        """Trace the paths and walk back, which adds the derivatives of BSDFs. Returns B_0 (C,)."""
        ring, again = Ring.of(p.plan, self.stack_size), Pass(p.samples, None, p.adjoint)
        active = True if visibility is None else visibility.last > 0
        sweep = LightSweep(p, ring, visibility)
        state: StackState = p.walk(sweep, active)

        def retrace(ring: Ring) -> StackState:
            return again.walk(LightSweep(again, ring), ring.takes(mi.UInt32(0)))

        return walk_back(p.along(sweep), Frame.blank(p.plan), ring, state, state.D, retrace)
