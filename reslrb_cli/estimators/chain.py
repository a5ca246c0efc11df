"""Attached derivatives of the connections that a reservoir keeps, by chains of Jacobians: constant memory, no stack.

Let p_i be the coordinates of the ray that reaches vertex i (`estimators.jacobian`), J_i = dp_{i+1}/dp_i, and J_{0->i}
their product from the first vertex on that a parameter has a part in. Beside it each channel carries what the factors
so far change by,

    G_i = sum_{m<i} dlog s_m/dp_m J_{0->m}

Of a connection I that is kept, so are du_I/dp_I J_{0->I} and dlog c_I/dp_I J_{0->I} + G_I; with delta they make the
adjoint of the first ray, which the replay takes to every other (`estimators.chain_replay`).

Damping (`segment_jacobian`) makes an inverse of what has none, at the price of digits: one for every vertex that is not
specular. So such paths are taken in blocks of BLOCK of these vertices. A chain begins with one block, chosen with equal
probability among those that are there when a connection is met, and replaying takes the adjoint through this one alone,
times their number. Radiometric derivatives, which need no chain, are taken at every vertex of a path all the same.

Source: the ResLRB paper, Section 2.5, which has neither G nor blocks, and says of vertices that are not specular that
the inverse is regularised. With a random sign in the regularisation there is no bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Pass, VertexHooks, contribution
from reslrb_cli.estimators.jacobian import row_times, segment_jacobian
from reslrb_cli.estimators.staying import Before
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.hooks import Vertex
from reslrb_cli.transport.numbers import Numbers
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering

#: Vertices that are not specular in one block of a chain.
BLOCK = 10


@dataclass
class Slot:
    """One kept connection. `last` is the last vertex up to its own, `number`, with anything to differentiate; 0: none.

    `prefix` (C,) is the path's throughput before its vertex. `u_rows` and `C_rows` are du_I/dp_I J_{0->I} and
    dlog c_I/dp_I J_{0->I} + G_I. `block` holds the number of the block that J begins with, and that of all up to here,
    where there may be several.
    """

    w: mi.Float
    number: mi.UInt32
    last: mi.UInt32
    C: Product
    u: mi.Point2f
    prefix: mi.Spectrum
    u_rows: list[mi.Vector4d]
    C_rows: list[mi.Vector4d]
    block: list[mi.UInt32]


@dataclass
class Blocks:
    """Where a path stands in its blocks: vertices passed that are not specular, and which block the chain begins
    with."""

    passed: mi.UInt32
    chosen: mi.UInt32

    @staticmethod
    def of(plan: Plan) -> list[Blocks]:
        """At the beginning; nothing where a path cannot have more than one."""
        return [Blocks(mi.UInt32(0), mi.UInt32(0))] if plan.max_depth - 2 > BLOCK else []

    @property
    def number(self) -> mi.UInt32:
        """Of the block that the ray from here on belongs to, from 0."""
        return self.passed // BLOCK

    def past(self, damped: mi.Bool) -> tuple[Blocks, mi.Bool]:
        """Behind a vertex, and where a block begins with it."""
        passed = self.passed + dr.select(damped, mi.UInt32(1), 0)
        return Blocks(passed, self.chosen), damped & (passed % BLOCK == 0)


@dataclass
class ChainState:
    """What is kept of a path; what is in a list is there on the way alone.

    `latest` is the latest vertex with anything to differentiate (0: none), `J` is J_{0->i}, `G` has a row for each
    channel, and `numbers` are those to select the current connection by.
    """

    W: mi.Float
    slots: list[Slot]
    latest: list[mi.UInt32]
    J: list[mi.Matrix4d]
    G: list[mi.Vector4d]
    blocks: list[Blocks]
    before: list[Before]
    numbers: list[mi.Float]

    @staticmethod
    def empty(plan: Plan, capacity: int) -> ChainState:
        """Nothing kept yet."""

        def rows(count: int) -> list[mi.Vector4d]:
            return [mi.Vector4d(0) for _ in range(count)]

        channels = len(mi.Spectrum(0))
        slots = [
            Slot(mi.Float(0), mi.UInt32(0), mi.UInt32(0), Product.none(plan.track_zeros), mi.Point2f(0),
                 mi.Spectrum(0), rows(2), rows(channels), [mi.UInt32(0) for _ in 2 * Blocks.of(plan)])
            for _ in range(capacity)
        ]  # fmt: skip
        return ChainState(
            mi.Float(0),
            slots,
            [mi.UInt32(0)],
            [mi.Matrix4d(1)],
            rows(channels),
            Blocks.of(plan),
            Before.start(plan),
            [],
        )

    def stored(self) -> ChainState:
        """What is left of it at the end of a path."""
        return ChainState(self.W, self.slots, [], [], [], [], [], [])


def begins(plan: Plan, vertex: Vertex) -> mi.Bool:
    """Lanes in which the vertex itself has anything to differentiate."""
    return plan.moves(vertex.si.shape) | plan.differentiates(vertex.bsdf)


def numbers_of(connection: Connection, scattering: Scattering) -> Numbers:
    """The numbers that a segment was made from."""
    return Numbers(connection.sample, scattering.sample_2, scattering.sample_1)


class ChainSelection(VertexHooks):
    """Image pass: splat, chain Jacobians, and keep connections as `choose` says."""

    def __init__(
        self,
        p: Pass,
        capacity: int,
        damping: float,
        splat: bool,
        weigh: Callable[[Connection, Product, mi.Float], mi.Float],
        is_taken: Callable[[mi.Float, mi.Float, mi.Float], mi.Bool],
    ) -> None:
        """`weigh(connection, C, W)` is the selection weight w of a connection, W the sum before it; `is_taken(number,
        w, W)` whether it takes a slot, W being the sum with it."""
        super().__init__(p)
        self.capacity, self.damping, self.splat = capacity, damping, splat
        self.numbers = capacity + len(Blocks.of(p.plan))
        self.weigh, self.is_taken = weigh, is_taken

    def start(self, product: Product) -> ChainState:
        return ChainState.empty(self.p.plan, self.capacity)

    def concerned(self, state: ChainState) -> mi.Bool:
        plan = self.p.plan
        return mi.Bool(True) if plan.differentiate_emission or plan.moving_emission else state.latest[0] > 0

    def wants(self, state: ChainState, vertex: Vertex) -> mi.Bool:
        if self.p.block is not None:
            return mi.Bool(True)
        return self.concerned(state) | begins(self.p.plan, vertex)

    def connection(
        self, state: ChainState, vertex: Vertex, connection: Connection, numbers: list[mi.Float]
    ) -> ChainState:
        return replace(state, numbers=numbers)

    def scattering(
        self, state: ChainState, vertex: Vertex, connection: Connection, scattering: Scattering
    ) -> ChainState:
        p, plan = self.p, self.p.plan
        C = contribution(p, vertex, connection)
        if self.splat:
            p.splat(connection.u, C.value(), connection.active)
        here = begins(plan, vertex)
        on = self.concerned(state) | here
        latest = dr.select(here & vertex.active, vertex.depth, state.latest[0])
        candidate = connection.active & on
        numbers = numbers_of(connection, scattering)
        jacobian = segment_jacobian(
            plan, p.samples.sensor, vertex, state.before, numbers, candidate, scattering.active & on, self.damping
        )
        w = dr.select(candidate, self.weigh(connection, C, state.W), 0)
        W = state.W + w
        [J], G = state.J, state.G
        this = Slot(
            w=w,
            number=vertex.depth,
            last=latest,
            C=C.stored(),
            u=connection.u,
            prefix=vertex.product.value(),
            u_rows=[row_times(row, J) for row in jacobian.u],
            C_rows=[row_times(row, J) + before for row, before in zip(jacobian.log_c, G, strict=True)],
            block=[number for blocks in state.blocks for number in (blocks.chosen, blocks.number + 1)],
        )
        chosen_by = state.numbers[: self.capacity]
        slots = [
            dr.select(self.is_taken(number, w, W), this, slot)
            for number, slot in zip(chosen_by, state.slots, strict=True)
        ]
        on &= scattering.active
        G = [dr.select(on, before + row_times(row, J), before) for row, before in zip(jacobian.log_s, G, strict=True)]
        after = replace(state, W=W, slots=slots, latest=[latest], J=[dr.select(on, jacobian.ray @ J, J)], G=G)
        before = Before.of(plan, vertex, scattering)
        return replace(self._begun_anew(after, jacobian.damped), before=before, numbers=[])

    def _begun_anew(self, state: ChainState, damped: mi.Bool) -> ChainState:
        """The chain begins anew with a block, instead of any before it, with one over their number as probability."""
        if not state.blocks:
            return state
        blocks, begins = state.blocks[0].past(damped)
        anew = begins & (state.numbers[-1] * (blocks.number + 1) < 1)
        J = dr.select(anew, mi.Matrix4d(1), state.J[0])
        G = [dr.select(anew, mi.Vector4d(0), row) for row in state.G]
        chosen = dr.select(anew, blocks.number, blocks.chosen)
        return replace(state, J=[J], G=G, blocks=[Blocks(blocks.passed, chosen)])
