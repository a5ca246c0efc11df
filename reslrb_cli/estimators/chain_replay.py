"""The replay of connections that were kept with chains of Jacobians: the adjoint of a path's first ray, taken on.

With delta, what `estimators.chain` keeps makes the adjoint of the first ray (W / (m w_I), which stands before all of
it, is left out here),

    a_0 = <d delta/du, C_I> du_I/dp_I J_{0->I} + delta C_I (dlog c_I/dp_I J_{0->I} + G_I)

A replay takes it to every vertex through the inverse of what it passes, and differentiates each segment on its own:

    a_{j+1} = (a_j - delta C_I dlog s_j/dp_j) J_j^{-1}
    dS     += a_{j+1} dp_{j+1}/dtheta + delta C_I ds_j/s_j          at I:   d<delta(u_I), C_I> by c_I and u_I

This is J_{j+1->I} = J_{0->I} J_{0->j+1}^{-1} of the paper's Section 2.5, one factor of the inverse after the other.
Both chain and replay compute the same J_j to the last bit, so that the inverse undoes it however badly conditioned it
is.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import Adjoint, differentiate_start
from reslrb_cli.estimators.base import Pass, PathAdjoint, VertexHooks, adjoint_of_factor
from reslrb_cli.estimators.chain import Blocks, Slot, begins, numbers_of
from reslrb_cli.estimators.jacobian import row_times, segment_jacobian, spread
from reslrb_cli.estimators.staying import Before, is_staying, reach
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.hooks import Vertex
from reslrb_cli.transport.numbers import Numbers
from reslrb_cli.transport.scattering import Scattering
from reslrb_cli.transport.segment import segment


@dataclass
class Kept:
    """A slot in a replay.

    `share` is W / (m w_I), `adjoint` the sensitivity of the objective to its connection, `A` = delta C_I (C,) what of
    it is left where factors are zero, `row` a_0; each with `share` in it.
    """

    slot: Slot
    share: mi.Float
    adjoint: PathAdjoint
    A: mi.Spectrum
    row: mi.Vector4d

    @staticmethod
    def of(p: Pass, slot: Slot, share: mi.Float) -> Kept:
        """That of a slot, dL/dI being known."""
        assert p.adjoint is not None
        C = slot.C.value() * share
        with dr.resume_grad():
            u = mi.Point2f(slot.u)
            dr.enable_grad(u)
            delta = p.adjoint.lookup(u, slot.w != 0, p.plan.attached_normalization)
            dr.backward_from(dr.dot(delta, C))
            by_u = dr.grad(u)
        delta = dr.detach(delta)
        A, row = delta * C, mi.Vector4d(0)
        for weight, one in zip([*by_u, *A], [*slot.u_rows, *slot.C_rows], strict=True):
            row += mi.Float64(weight) * one
        return Kept(slot, share, PathAdjoint(delta * slot.C.nonzero * share, slot.C), A, row)

    def part(self, blocks: list[Blocks]) -> tuple[mi.Bool, mi.Float64]:
        """Where a ray belongs to the block that the chain begins with, and what stands for all other blocks."""
        if not blocks:
            return mi.Bool(True), mi.Float64(1)
        chosen, count = self.slot.block
        return blocks[0].number == chosen, mi.Float64(count)


@dataclass
class ReplayState:
    """Loop state of a replay: a_j of each slot, and whether the path has met anything to differentiate."""

    rows: list[mi.Vector4d]
    begun: mi.Bool
    blocks: list[Blocks]
    before: list[Before]


class ChainReplay(VertexHooks):
    """Replay up to the last vertex with anything to differentiate, and differentiate each segment's ray and factors."""

    replaying = True
    connects = False

    def __init__(self, p: Pass, kept: list[Kept], damping: float) -> None:
        super().__init__(p)
        self.kept, self.damping = kept, damping
        self.last = kept[0].slot.last
        for other in kept[1:]:
            self.last = dr.maximum(self.last, other.slot.last)

    def start(self, product: Product) -> ReplayState:
        plan = self.p.plan
        return ReplayState(
            [one.row for one in self.kept],
            mi.Bool(plan.differentiate_emission or plan.moving_emission),
            Blocks.of(plan),
            Before.start(plan),
        )

    def goes_on(self, state: ReplayState, vertex: Vertex) -> mi.Bool:
        return vertex.depth <= self.last

    def is_followed(self, state: ReplayState, vertex: Vertex) -> mi.Bool:
        return vertex.depth < self.last

    def scattering(
        self, state: ReplayState, vertex: Vertex, connection: Connection, scattering: Scattering
    ) -> ReplayState:
        plan, depth = self.p.plan, vertex.depth
        begun = state.begun | begins(plan, vertex)
        numbers, on = numbers_of(connection, scattering), scattering.active & begun
        jacobian = segment_jacobian(plan, self.p.samples.sensor, vertex, state.before, numbers, None, on, self.damping)
        blocks = state.blocks
        entered = mi.Bool(False)
        if blocks:
            passed, entered = blocks[0].past(jacobian.damped)
            blocks = [passed]
        inverse, rows, weighted = dr.rcp(jacobian.ray), [], []
        for row, kept in zip(state.rows, self.kept, strict=True):
            ahead = row - sum(mi.Float64(kept.A[c]) * log for c, log in enumerate(jacobian.log_s))
            inside, weight = kept.part(blocks)
            rows.append(dr.select(on & inside & ~entered & (depth < kept.slot.number), row_times(ahead, inverse), row))
            weighted.append(dr.select(inside, rows[-1] * weight, 0))
        self._differentiate(vertex, state.before, numbers, scattering, weighted)
        return ReplayState(rows, begun, blocks, Before.of(plan, vertex, scattering))

    def _differentiate(
        self, vertex: Vertex, before: list[Before], numbers: Numbers, scattering: Scattering, rows: list[mi.Vector4d]
    ) -> None:
        """Add the derivatives of the vertex's segment; `rows` are the adjoints of the ray that it ends in."""
        p, plan, depth = self.p, self.p.plan, vertex.depth
        here = vertex.active & begins(plan, vertex)
        connected, scattered = mi.Bool(False), mi.Bool(False)
        after = Before.of(plan, vertex, scattering)
        origin, direction, by_s, by_c = mi.Vector3f(0), mi.Vector3f(0), mi.Spectrum(0), mi.Spectrum(0)
        for row, kept in zip(rows, self.kept, strict=True):
            on, own = here & (depth < kept.slot.number), here & (depth == kept.slot.number)
            by_o, by_d = spread(scattering.d, row, is_staying(after))
            origin, direction = origin + dr.select(on, by_o, 0), direction + dr.select(on, by_d, 0)
            by_s += dr.select(on, adjoint_of_factor(kept.adjoint, depth, scattering.weight, 1), 0)
            by_c += dr.select(own, kept.slot.prefix * (kept.share * p.scale), 0)
            connected, scattered = connected | own, scattered | (on & scattering.active)
        assert p.adjoint is not None
        with dr.resume_grad():
            si, bsdf, ray, reached = reach(plan, before, vertex.ray, vertex.pi, connected | scattered)
            this = segment(plan, p.samples.sensor, ray, si, bsdf, numbers, connected, scattered, attached=True)
            there, following = this.connection, this.next_ray(attached=True)
            delta = p.adjoint.lookup(there.u, connected, plan.attached_normalization)
            own_part = dr.select(connected, dr.dot(by_c, reached * delta * there.f * there.weight), 0)
            moved = dr.dot(origin, following.o) + dr.dot(direction, following.d)
            later = dr.select(scattered, moved + dr.dot(by_s, reached * this.scattering.weight), 0)
            dr.backward_from(own_part + later)


def differentiate(p: Pass, kept: list[Kept], damping: float) -> None:
    """Add the derivatives of the kept connections."""
    if p.plan.differentiate_emission or p.plan.moving_emission:
        emission = p.emission()
        B, origin, direction = mi.Spectrum(0), mi.Vector3f(0), mi.Vector3f(0)
        for one in kept:
            inside, weight = one.part(Blocks.of(p.plan))
            by_o, by_d = spread(emission.ray.d, dr.select(inside, one.row * weight, 0), mi.Bool(False))
            B, origin, direction = (
                B + adjoint_of_factor(one.adjoint, mi.Int32(0), dr.detach(emission.weight), 1),
                origin + by_o,
                direction + by_d,
            )
        differentiate_start(p, dr.detach(Adjoint(origin, direction, B)))
    if p.plan.moving_shapes or p.plan.differentiate_bsdfs:  # else no segment has a parameter, and Dr.Jit refuses it
        replay = ChainReplay(p, kept, damping)
        p.walk(replay, replay.last > 0)
