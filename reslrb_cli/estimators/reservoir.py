"""ResLRB: select few connections of each path by weighted reservoir sampling, then replay the path up to them.

    slot k keeps candidate i with probability w_i / W,   W = sum_i w_i
    dS ~ 1/m sum_k (W / w_I) delta_I [ C_I dE/E + sum_{j<I} C_I ds_j/s_j + C_I dc_I/c_I ],   I = I_k

Source: the ResLRB paper, Sections 2.2 to 2.4, for m = 1 and w = luminance(C). Its conclusion proposes m > 1. Here, m
independent slots share one replay. Reservoir sampling: Chao 1982.

If delta is known before the paths are traced, w = sum_c |delta_c C_c| has less variance. If a contribution has zero
factors, its weight uses only the nonzero factors. A connection with a zero value and a nonzero derivative can then be
selected. Every weight is at least SHARE times the sum of all earlier weights.

The surface point of the selected connection is stored, too, so c_I is differentiated without a replay. The replay ends
at x_{I-1}, or earlier at the last differentiated vertex. On a path without differentiated vertices, no connection is a
candidate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import (
    Pass,
    PathAdjoint,
    VertexHooks,
    adjoint_of_factor,
    contribution,
    differentiate_emission,
)
from reslrb_cli.estimators.selection import (
    Event,
    Selecting,
    SlotReplay,
    at_least_share,
    chosen_by,
    differentiate_event,
    selection_weight,
    slot_adjoint,
)
from reslrb_cli.transport.bsdf import Scattering, tracked_factor
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import MAY_LACK, Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex


@dataclass
class Slot:
    """Selected connection, 28 bytes. If zero factors are tracked, a slot takes 12 bytes more.

    If BSDFs are differentiated, `event` stores c_I in about 50 bytes. The replay then ends one vertex earlier.
    """

    w: mi.Float  # its selection weight
    last: mi.UInt32  # the last differentiable vertex before its own; 0 if none
    C: Product  # its contribution
    u: mi.Point2f  # its film position
    event: list[Event]


@dataclass
class ReservoirState:
    """Stored data of a path."""

    W: mi.Float  # sum of the weights of all candidates
    slots: list[Slot]
    latest: list[mi.UInt32]  # during the walk: the latest differentiable vertex; 0 if none

    @staticmethod
    def empty(plan: Plan, capacity: int) -> ReservoirState:
        """Return the empty state."""

        def slot() -> Slot:
            event = [Event.emission(plan)] if plan.differentiate_bsdfs else []
            return Slot(mi.Float(0), mi.UInt32(0), Product.none(plan.track_zeros), mi.Point2f(0), event)

        return ReservoirState(mi.Float(0), [slot() for _ in range(capacity)], [mi.UInt32(0)])


class ReservoirSelection(VertexHooks):
    """Image pass: splat, and select connections."""

    def __init__(self, p: Pass, capacity: int, weight: str) -> None:
        super().__init__(p)
        self.numbers, self.weight = capacity, weight

    def start(self, product: Product) -> ReservoirState:
        return ReservoirState.empty(self.p.plan, self.numbers)

    def concerned(self, state: ReservoirState) -> mi.Bool:
        return state.latest[0] > 0

    def vertex(
        self, state: ReservoirState, vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> ReservoirState:  # fmt: skip
        C = contribution(self.p, vertex, connection)
        self.p.splat(connection.u, C.value(), connection.active, self.colours)
        plan, candidate = self.p.plan, connection.active
        if not plan.differentiate_emission:  # otherwise every connection counts
            candidate = candidate & (self.concerned(state) | plan.concerns(vertex.bsdf))
        w = selection_weight(self.p, self.weight, connection, C, self.colours)
        w = at_least_share(dr.select(candidate, w, 0), state.W)
        W = state.W + w
        event = [Event.of_connection(plan, vertex, connection)] if plan.differentiate_bsdfs else []
        this = Slot(w, state.latest[0], C.stored(), connection.u, event)
        latest = dr.select(plan.differentiates(vertex.bsdf), vertex.depth, state.latest[0])
        return ReservoirState(W, chosen_by(numbers, w, W, this, state.slots), [latest])


class ReservoirReplay(SlotReplay):
    """Replay that differentiates s_j. The replay ends at the last differentiated vertex that any slot needs. For each
    slot, the needed vertex lies before the slot's connection.
    """

    def __init__(self, p: Pass, slots: list[Slot], adjoints: list[PathAdjoint]) -> None:
        super().__init__(p, [slot.last for slot in slots])
        self.kept = list(zip(slots, adjoints, strict=True))

    def vertex(
        self, state: Any, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Any:  # fmt: skip
        plan, bsdf, depth = self.p.plan, vertex.bsdf, vertex.depth
        active = scattering.active & plan.differentiates(bsdf)
        rest, weight = mi.Spectrum(scattering.correction / scattering.pdf), mi.Spectrum(0)
        for slot, adjoint in self.kept:
            weight += dr.select(slot.last >= depth, adjoint_of_factor(adjoint, depth, scattering.f, rest), 0)
        with dr.resume_grad():
            f = tracked_factor(plan, vertex.si, bsdf, scattering, active)
            dr.backward_from(dr.select(active, weight * f, 0), flags=MAY_LACK)
        return state


class Reservoir(Selecting):
    """The estimator `reservoir`: `capacity` connections of each path."""

    def forward(self, p: Pass) -> ReservoirState:
        return replace(p.walk(ReservoirSelection(p, self.capacity, self.weight)), latest=[])

    def backward(self, p: Pass, state: ReservoirState) -> None:
        p = p.with_colours()
        adjoints = [slot_adjoint(p, state.W, slot, self.capacity) for slot in state.slots]

        def emission_weight(E: mi.Spectrum) -> mi.Spectrum:
            weights = [adjoint_of_factor(adjoint, mi.Int32(0), E, 1) for adjoint in adjoints]
            return sum(weights[1:], weights[0])

        differentiate_emission(p, emission_weight)
        if p.plan.differentiate_bsdfs:
            for slot, adjoint in zip(state.slots, adjoints, strict=True):
                differentiate_event(p, slot.event[0], adjoint, slot.w != 0)
            replay = ReservoirReplay(p, state.slots, adjoints)
            p.walk(replay, replay.last > 0)

    def kept(self, plan: Plan) -> ReservoirState:
        return replace(ReservoirState.empty(plan, self.capacity), latest=[])
