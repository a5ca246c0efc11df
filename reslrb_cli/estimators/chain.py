"""Attached derivatives of a reservoir's connections, by chains of Jacobians: constant memory, no stack.

Chain: p_i are the coordinates of the ray that reaches vertex i, and J_i = dp_{i+1}/dp_i. J_{0->i} is the product of
these matrices, starting at the first vertex that depends on a parameter. Each channel also carries the logarithmic
derivative of the factors so far.

    G_i = sum_{m<i} dlog s_m/dp_m J_{0->m}

A selected connection I stores du_I/dp_I J_{0->I} and dlog c_I/dp_I J_{0->I} + G_I. The stored rows and delta give the
adjoint a_0 of the first ray, up to the factor W / (m w_I).

    a_0 = <d delta/du, C_I> du_I/dp_I J_{0->I} + delta C_I (dlog c_I/dp_I J_{0->I} + G_I)

Damping (`segment_jacobian`) makes singular Jacobians invertible. Damping reduces the precision at every nonspecular
vertex. Paths are therefore divided into blocks of BLOCK nonspecular vertices. A chain starts with one of the blocks
before the connection. All these blocks are equally probable. The replay propagates the adjoint only through the chosen
block, and multiplies the adjoint by the block count. Radiometric derivatives need no chain, and are added at every
vertex.

Replay: the replay carries a_0 to every vertex. At each vertex, the adjoint is multiplied by the inverse of the passed
Jacobian, and the segment is differentiated.

    a_{j+1} = (a_j - delta C_I dlog s_j/dp_j) J_j^{-1}
    dS     += a_{j+1} dp_{j+1}/dtheta + delta C_I ds_j/s_j          at I:   d<delta(u_I), C_I> by c_I and u_I

The product of the inverses is the ResLRB paper's J_{j+1->I} = J_{0->I} J_{0->j+1}^{-1}. Chain and replay compute
bitwise equal J_j. The inverse therefore cancels the Jacobian for any conditioning.

Source: the ResLRB paper, Section 2.5. The paper uses neither G nor blocks. The paper regularises the inverse at
nonspecular vertices. Here, the regularisation has a random sign, which avoids a bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import (
    Adjoint,
    Before,
    begins,
    concerns_emission,
    differentiate_start,
    is_staying,
    reach,
    segment_again,
)
from reslrb_cli.estimators.base import Pass, PathAdjoint, VertexHooks, adjoint_of_factor, contribution
from reslrb_cli.estimators.selection import (
    Selecting,
    SlotReplay,
    at_least_share,
    chosen_by,
    inverse_probability,
    selection_weight,
)
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Numbers, Samples
from reslrb_cli.transport.walk import Vertex, segment

#: Nonspecular vertices in one block of a chain.
BLOCK = 10

#: Rotation of a ray with the previous one, if its Jacobian would be singular (`segment_jacobian`).
JACOBIAN_DAMPING = 0.1


@dataclass
class ChainSlot:
    """Selected connection.

    `number` is the vertex of the selected connection. `last` is the last differentiated vertex up to vertex `number`,
    or 0 if there is none. `prefix` (C,) is the path's throughput before vertex `number`. `u_rows` and `C_rows` are
    du_I/dp_I J_{0->I} and dlog c_I/dp_I J_{0->I} + G_I. If there may be several blocks, `block` holds two numbers: the
    block with which J starts, and the block count so far.
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
class ChainBlocks:
    """Position of a path in its blocks.

    `passed` is the number of non-specular vertices passed. `chosen` is the block with which the chain starts.
    """

    passed: mi.UInt32
    chosen: mi.UInt32

    @staticmethod
    def of(plan: Plan) -> list[ChainBlocks]:
        """Return the position at the start. The result is empty if a path cannot have more than one block."""
        return [ChainBlocks(mi.UInt32(0), mi.UInt32(0))] if plan.max_depth - 2 > BLOCK else []

    @property
    def number(self) -> mi.UInt32:
        """Number of the current ray's block, starting at 0."""
        return self.passed // BLOCK

    def past(self, damped: mi.Bool) -> tuple[ChainBlocks, mi.Bool]:
        """Return the position behind a vertex, and True if a block starts at this position."""
        passed = self.passed + dr.select(damped, mi.UInt32(1), 0)
        return ChainBlocks(passed, self.chosen), damped & (passed % BLOCK == 0)


@dataclass
class ChainState:
    """State of a path in the image pass.

    `latest` is the latest differentiated vertex, or 0 if there is none. `J` is J_{0->i}, and `G` has a row for each
    channel. These lists exist only during the walk.
    """

    W: mi.Float
    slots: list[ChainSlot]
    latest: list[mi.UInt32]
    J: list[mi.Matrix4d]
    G: list[mi.Vector4d]
    blocks: list[ChainBlocks]
    before: list[Before]

    @staticmethod
    def empty(plan: Plan, capacity: int) -> ChainState:
        """Return the empty state."""

        def rows(count: int) -> list[mi.Vector4d]:
            return [mi.Vector4d(0) for _ in range(count)]

        channels = len(mi.Spectrum(0))
        slots = [
            ChainSlot(mi.Float(0), mi.UInt32(0), mi.UInt32(0), Product.none(plan.track_zeros), mi.Point2f(0),
                 mi.Spectrum(0), rows(2), rows(channels), [mi.UInt32(0) for _ in 2 * ChainBlocks.of(plan)])
            for _ in range(capacity)
        ]  # fmt: skip
        latest, J, blocks = [mi.UInt32(0)], [mi.Matrix4d(1)], ChainBlocks.of(plan)
        return ChainState(mi.Float(0), slots, latest, J, rows(channels), blocks, Before.start(plan))

    def stored(self) -> ChainState:
        """Return the part of the state that is stored at the end of a path."""
        return ChainState(self.W, self.slots, [], [], [], [], [])


def numbers_of(connection: Connection, scattering: Scattering) -> Numbers:
    """Return the random numbers of a segment."""
    return Numbers(scattering.sample_2, scattering.sample_1, connection.sample)


class ChainSelection(VertexHooks):
    """Image pass: splat, multiply Jacobians, and select connections by a reservoir."""

    def __init__(self, p: Pass, capacity: int, weight: str, damping: float) -> None:
        super().__init__(p)
        self.capacity, self.weight, self.damping = capacity, weight, damping
        self.numbers = capacity + len(ChainBlocks.of(p.plan))

    def start(self, product: Product) -> ChainState:
        return ChainState.empty(self.p.plan, self.capacity)

    def concerned(self, state: ChainState) -> mi.Bool:
        return mi.Bool(True) if concerns_emission(self.p.plan) else state.latest[0] > 0

    def wants(self, state: ChainState, vertex: Vertex) -> mi.Bool:
        if self.p.block is not None:
            return mi.Bool(True)
        return self.concerned(state) | begins(self.p.plan, vertex)

    def vertex(
        self, state: ChainState, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> ChainState:  # fmt: skip
        p, plan = self.p, self.p.plan
        C = contribution(p, vertex, connection)
        p.splat(connection.u, C.value(), connection.active, self.colours)
        here = begins(plan, vertex)
        on = self.concerned(state) | here
        latest = dr.select(here & vertex.active, vertex.depth, state.latest[0])
        candidate = connection.active & on
        jacobian = segment_jacobian(
            p.samples, vertex, state.before, numbers_of(connection, scattering), candidate, scattering.active & on,
            self.damping,
        )  # fmt: skip
        w = at_least_share(selection_weight(p, self.weight, connection, C, self.colours), state.W)
        w = dr.select(candidate, w, 0)
        W = state.W + w
        [J], G = state.J, state.G
        this = ChainSlot(
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
        slots = chosen_by(numbers[: self.capacity], w, W, this, state.slots)
        on &= scattering.active
        G = [dr.select(on, before + row_times(row, J), before) for row, before in zip(jacobian.log_s, G, strict=True)]
        after = replace(state, W=W, slots=slots, latest=[latest], J=[dr.select(on, jacobian.ray @ J, J)], G=G)
        before = Before.of(plan, vertex, scattering)
        return replace(self._begun_anew(after, jacobian.damped, numbers[-1]), before=before)

    def _begun_anew(self, state: ChainState, damped: mi.Bool, number: mi.Float) -> ChainState:
        """Where a block begins, restart the chain with probability 1 / (number of blocks so far)."""
        if not state.blocks:
            return state
        blocks, begins = state.blocks[0].past(damped)
        anew = begins & (number * (blocks.number + 1) < 1)
        J = dr.select(anew, mi.Matrix4d(1), state.J[0])
        G = [dr.select(anew, mi.Vector4d(0), row) for row in state.G]
        chosen = dr.select(anew, blocks.number, blocks.chosen)
        return replace(state, J=[J], G=G, blocks=[ChainBlocks(blocks.passed, chosen)])


@dataclass
class KeptConnection:
    """Selected connection in a replay.

    `share` is W / (m w_I). `adjoint` is the sensitivity of the objective to the connection. `A` (C,) is the nonzero
    part of delta C_I, and `row` is a_0. The last three include `share`.
    """

    slot: ChainSlot
    share: mi.Float
    adjoint: PathAdjoint
    A: mi.Spectrum
    row: mi.Vector4d

    @staticmethod
    def of(p: Pass, slot: ChainSlot, share: mi.Float) -> KeptConnection:
        """Return the connection of a slot. dL/dI must be known."""
        assert p.adjoint is not None
        assert p.colours is not None
        C = slot.C.value() * share
        with dr.resume_grad():
            u = mi.Point2f(slot.u)
            dr.enable_grad(u)
            delta = p.adjoint.lookup(u, slot.w != 0, p.colours, p.plan.attached_normalization)
            dr.backward_from(dr.dot(delta, C))
            by_u = dr.grad(u)
        delta = dr.detach(delta)
        A, row = delta * C, mi.Vector4d(0)
        for weight, one in zip([*by_u, *A], [*slot.u_rows, *slot.C_rows], strict=True):
            row += mi.Float64(weight) * one
        return KeptConnection(slot, share, PathAdjoint(delta * slot.C.nonzero * share, slot.C), A, row)

    def part(self, blocks: list[ChainBlocks]) -> tuple[mi.Bool, mi.Float64]:
        """Return the lanes whose ray belongs to the block with which the chain starts. Also return the block count, the
        factor that accounts for all other blocks.
        """
        if not blocks:
            return mi.Bool(True), mi.Float64(1)
        chosen, count = self.slot.block
        return blocks[0].number == chosen, mi.Float64(count)


@dataclass
class ReplayState:
    """Loop state of a replay: a_j for each slot, and whether the path has met a differentiated vertex."""

    rows: list[mi.Vector4d]
    begun: mi.Bool
    blocks: list[ChainBlocks]
    before: list[Before]


class ChainReplay(SlotReplay):
    """Replay up to the last differentiated vertex, and differentiate each segment's ray and factors."""

    def __init__(self, p: Pass, kept: list[KeptConnection], damping: float) -> None:
        super().__init__(p, [one.slot.last for one in kept])
        self.kept, self.damping = kept, damping

    def start(self, product: Product) -> ReplayState:
        plan = self.p.plan
        rows, begun = [one.row for one in self.kept], mi.Bool(concerns_emission(plan))
        return ReplayState(rows, begun, ChainBlocks.of(plan), Before.start(plan))

    def vertex(
        self, state: ReplayState, vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> ReplayState:  # fmt: skip
        plan, depth = self.p.plan, vertex.depth
        begun = state.begun | begins(plan, vertex)
        drawn, on = numbers_of(connection, scattering), scattering.active & begun
        jacobian = segment_jacobian(self.p.samples, vertex, state.before, drawn, None, on, self.damping)
        blocks, entered = state.blocks, mi.Bool(False)
        if blocks:
            passed, entered = blocks[0].past(jacobian.damped)
            blocks = [passed]
        inverse, rows, weighted = dr.rcp(jacobian.ray), [], []
        for row, kept in zip(state.rows, self.kept, strict=True):
            ahead = row - sum(mi.Float64(kept.A[c]) * log for c, log in enumerate(jacobian.log_s))
            inside, weight = kept.part(blocks)
            rows.append(dr.select(on & inside & ~entered & (depth < kept.slot.number), row_times(ahead, inverse), row))
            weighted.append(dr.select(inside, rows[-1] * weight, 0))
        self._differentiate(vertex, state.before, drawn, scattering, weighted)
        return ReplayState(rows, begun, blocks, Before.of(plan, vertex, scattering))

    def _differentiate(
        self, vertex: Vertex, before: list[Before], numbers: Numbers, scattering: Scattering, rows: list[mi.Vector4d]
    ) -> None:
        """Add the derivatives of the vertex's segment. `rows` are the adjoints of the segment's outgoing ray."""
        p, plan, depth = self.p, self.p.plan, vertex.depth
        here = vertex.active & begins(plan, vertex)
        connected, scattered = mi.Bool(False), mi.Bool(False)
        after = Before.of(plan, vertex, scattering)
        origin, direction, by_s, by_c = mi.Vector3f(0), mi.Vector3f(0), mi.Spectrum(0), mi.Spectrum(0)
        for row, kept in zip(rows, self.kept, strict=True):
            on, own = here & (depth < kept.slot.number), here & (depth == kept.slot.number)
            by_o, by_d = spread(scattering.d, row, is_staying(after))
            origin, direction = origin + dr.select(on, by_o, 0), direction + dr.select(on, by_d, 0)
            by_s += dr.select(on, adjoint_of_factor(kept.adjoint, depth, scattering.s, 1), 0)
            by_c += dr.select(own, kept.slot.prefix * (kept.share * p.scale), 0)
            connected, scattered = connected | own, scattered | (on & scattering.active)
        assert p.adjoint is not None
        with dr.resume_grad():
            this, reached = segment_again(p.samples, before, vertex.ray, vertex.pi, numbers, connected, scattered)
            there, following = this.connection, this.next_ray(attached=True)
            delta = p.adjoint.lookup(there.u, connected, self.colours, plan.attached_normalization)
            own_part = dr.select(connected, dr.dot(by_c, reached * delta * there.f * there.rest), 0)
            moved = dr.dot(origin, following.o) + dr.dot(direction, following.d)
            later = dr.select(scattered, moved + dr.dot(by_s, reached * this.scattering.s), 0)
            dr.backward_from(own_part + later)


class AttachedReservoir(Selecting):
    """The estimator `reservoir` with attached derivatives."""

    OPTIONS: ClassVar[dict[str, Any]] = Selecting.OPTIONS | {"jacobian_damping": JACOBIAN_DAMPING}

    def __init__(self, jacobian_damping: float = JACOBIAN_DAMPING, **options: Any) -> None:
        super().__init__(**options)
        if not jacobian_damping > 0:
            raise ValueError(f'"jacobian_damping" must be positive, not {jacobian_damping}')
        self.damping = jacobian_damping

    def forward(self, p: Pass) -> ChainState:
        return p.walk(ChainSelection(p, self.capacity, self.weight, self.damping)).stored()

    def backward(self, p: Pass, state: ChainState) -> None:
        p = p.with_colours()
        shares = [inverse_probability(state.W, slot, self.capacity) for slot in state.slots]
        kept = [KeptConnection.of(p, slot, share) for slot, share in zip(state.slots, shares, strict=True)]
        differentiate(p, kept, self.damping)

    def kept(self, plan: Plan) -> ChainState:
        return ChainState.empty(plan, self.capacity).stored()


def differentiate(p: Pass, kept: list[KeptConnection], damping: float) -> None:
    """Add the derivatives of the selected connections."""
    if concerns_emission(p.plan):
        emission = p.emission()
        B, origin, direction = mi.Spectrum(0), mi.Vector3f(0), mi.Vector3f(0)
        for one in kept:
            inside, weight = one.part(ChainBlocks.of(p.plan))
            by_o, by_d = spread(emission.ray.d, dr.select(inside, one.row * weight, 0), mi.Bool(False))
            B += adjoint_of_factor(one.adjoint, mi.Int32(0), dr.detach(emission.E), 1)
            origin, direction = origin + by_o, direction + by_d
        differentiate_start(p, dr.detach(Adjoint(origin, direction, B)))
    if p.plan.moving_shapes or p.plan.differentiate_bsdfs:  # otherwise there is no parameter, and Dr.Jit refuses it
        replay = ChainReplay(p, kept, damping)
        p.walk(replay, replay.last > 0)


AXES = 4


@dataclass
class SegmentJacobian:
    """Derivatives of a segment with respect to p_i. Double precision is used, because products of many Jacobians are
    inverted.

    `ray` is dp_{i+1}/dp_i. `damped` is True in lanes whose Jacobian `ray` contains `damping`. `log_s` and `log_c` have
    one row for each channel. The rows are zero if the factor is 0. `u` has a row for each film coordinate, in pixels.
    """

    ray: mi.Matrix4d
    damped: mi.Bool
    log_s: list[mi.Vector4d]
    u: list[mi.Vector4d]
    log_c: list[mi.Vector4d]


def row_times(row: mi.Vector4d, matrix: mi.Matrix4d) -> mi.Vector4d:
    """Return row @ matrix."""
    return mi.Vector4d(matrix.T @ row)


def coordinates(d: mi.Vector3f, o_change: mi.Vector3f, d_change: mi.Vector3f, stays: mi.Bool) -> list[mi.Float]:
    """Return the coordinates of a small change of a ray's origin and direction `d`."""
    frame = mi.Frame3f(d)
    return [
        dr.dot(frame.s, o_change),
        dr.dot(frame.t, o_change),
        dr.select(stays, dr.dot(d, o_change), dr.dot(frame.s, d_change)),
        dr.select(stays, 0, dr.dot(frame.t, d_change)),
    ]


def spread(d: mi.Vector3f, row: mi.Vector4d, stays: mi.Bool) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Return the derivatives with respect to a ray's origin and direction `d`, given the derivatives with
    respect to p.
    """
    frame = mi.Frame3f(d)
    q_s, q_t, third, fourth = (mi.Float(value) for value in row)
    along = d * dr.select(stays, third, 0)
    return frame.s * q_s + frame.t * q_t + along, dr.select(stays, 0, frame.s * third + frame.t * fourth)


def segment_jacobian(
    samples: Samples, vertex: Vertex, before: list[Before], numbers: Numbers, connected: mi.Bool | None,
    scattered: mi.Bool, damping: float,
) -> SegmentJacobian:  # fmt: skip
    """Return the Jacobians of a vertex's segment. Lanes without `connected` have no Jacobian of the connection.

    Behind a diffuse scattering event, the next ray does not depend on the previous direction, so the Jacobian is
    singular. The Jacobian is also singular for a vertex that stays at its place on its surface. `damping` makes the
    Jacobian invertible. Behind a nonspecular vertex, damping adds the fraction `damping` of the previous ray's rotation
    to the next ray. Behind a vertex that stays at its place, damping also shifts the next ray with the previous ray.
    The sign of each damping term is random, with probability 1/2. Before the inversion, the chain is linear in each
    damping term. Damping therefore does not change the expected value.
    """
    p = [mi.Float(0) for _ in range(AXES)]
    frame, stays = mi.Frame3f(vertex.ray.d), is_staying(before)
    evaluates = connected is not None
    if connected is None:
        connected = mi.Bool(False)
    with dr.resume_grad(*p):
        dr.enable_grad(p)
        ray = mi.Ray3f(vertex.ray)
        ray.o = ray.o + frame.s * p[0] + frame.t * p[1] + vertex.ray.d * dr.select(stays, p[2], 0)
        ray.d = dr.normalize(ray.d + dr.select(stays, 0, frame.s * p[2] + frame.t * p[3]))
        hit, reached = reach(samples.plan, before, ray, vertex.pi, connected | scattered, parameters=False)
        this = segment(samples, hit, numbers, connected, scattered, evaluates, attached=True)
        following, scattering, connection = this.next_ray(attached=True), this.scattering, this.connection
        factors = [reached * scattering.s]
        if evaluates:
            factors.append(reached * connection.f * connection.rest)
        # `select` makes new variables: no other output depends on them, so clearing them on the way is harmless.
        outputs = [dr.select(scattered, value, 0) for value in (following.o, following.d, factors[0])]
        if evaluates:
            outputs += [dr.select(connected, value, 0) for value in (factors[1], connection.u)]
        changes = []
        for axis in p:
            dr.forward_from(axis, flags=dr.ADFlag.ClearInterior | dr.ADFlag.AllowNoGrad)
            changes.append([dr.detach(dr.grad(value)) for value in outputs])
            dr.clear_grad([axis, *outputs])
    after = Before.of(samples.plan, vertex, scattering)
    damped = scattered & (stays | ~scattering.is_delta)
    turned = dr.select(damped, damping * sign(numbers), 0)
    columns = []
    for axis, change in enumerate(changes):
        column = coordinates(dr.detach(following.d), change[0], change[1], is_staying(after))
        column[axis] = column[axis] + (turned if axis >= 2 else dr.select(stays, turned, 0))
        columns.append([mi.Float64(value) for value in column])
    log_s = _logarithmic(factors[0], [change[2] for change in changes], scattered)
    if not evaluates:
        return SegmentJacobian(_matrix(columns), damped, log_s, [], [])
    log_c = _logarithmic(factors[1], [change[3] for change in changes], connected)
    u = [mi.Vector4d(*(mi.Float64(change[4][axis]) for change in changes)) for axis in range(2)]
    return SegmentJacobian(_matrix(columns), damped, log_s, u, log_c)


def sign(numbers: Numbers) -> mi.Float:
    """Return 1 or -1 with probability 1/2 each. The last bit of the BSDF's random number decides.

    The last bit does not affect the sampled direction. A replay reads an equal bit.
    """
    return dr.select((mi.UInt32(numbers.bsdf_2d.x * float(1 << 23)) & 1) == 0, mi.Float(1), -1)


def _matrix(columns: list[list[mi.Float64]]) -> mi.Matrix4d:
    return mi.Matrix4d(*([columns[c][r] for c in range(AXES)] for r in range(AXES)))


def _logarithmic(value: mi.Spectrum, changes: list[mi.Spectrum], active: mi.Bool) -> list[mi.Vector4d]:
    """Return rows of the derivatives of log(value), one for each channel."""
    value = dr.detach(value)
    used = active & (value != 0)
    rows = [dr.select(used, change / value, 0) for change in changes]
    return [mi.Vector4d(*(mi.Float64(row[c]) for row in rows)) for c in range(len(value))]
