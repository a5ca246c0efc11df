"""Select single scattering events of each path by two nested reservoirs, and differentiate them without a replay.

The gradient of a path is a double sum over its connections i and over the events of each connection. The events are
emission, the scattering events j < i, and the connection's own BSDF (j = i). The inner reservoir selects one event. An
event has weight q_j = 1, or 0 if the event has no parameter. The outer reservoir selects a connection with weight w_i
Q_i, where Q_i is the sum of the q_j.

    the pair (i, j) is kept with probability w_i q_j / W,   W = sum_i w_i Q_i
    dS ~ 1/m sum_slots W / (w_i q_j) delta_i C_i df_j/f_j

Reservoir sampling: Chao 1982. A stored event contains enough data to evaluate its BSDF again, and takes about 50 bytes.
One random number at a vertex makes two selections: the event of the vertex's own connection, and the event of the
prefix. A path stores only one of the two selected events, so the two selections may depend on each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import (
    Pass,
    VertexHooks,
    adjoint_of_factor,
    contribution,
    differentiate_emission,
)
from reslrb_cli.estimators.selection import (
    Event,
    Selecting,
    at_least_share,
    differentiate_event,
    is_taken,
    selection_weight,
    slot_adjoint,
)
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex


@dataclass
class EventSlot:
    """Selected pair of a connection and an event."""

    w: mi.Float  # selection weight of the connection; 0 if none is kept
    C: Product
    u: mi.Point2f
    event: Event

    @staticmethod
    def empty(plan: Plan) -> EventSlot:
        """Return an empty slot."""
        return EventSlot(mi.Float(0), Product.none(plan.track_zeros), mi.Point2f(0), Event.emission(plan))


@dataclass
class EventState:
    """Stored data of a path: W, and the selected pair of each slot. During the walk, the state also holds Q and, for
    each slot, the event selected from the path prefix.
    """

    Q: list[mi.Float]
    W: mi.Float
    prefix: list[Event]
    slots: list[EventSlot]


class EventSelection(VertexHooks):
    """Image pass: splat, and select events."""

    def __init__(self, p: Pass, capacity: int, weight: str) -> None:
        super().__init__(p)
        self.numbers, self.capacity, self.weight = 2 * capacity, capacity, weight

    def start(self, product: Product) -> EventState:
        plan = self.p.plan
        slots = [EventSlot.empty(plan) for _ in range(self.capacity)]
        prefix = [Event.emission(plan) for _ in slots]
        Q = mi.Float(1 if plan.differentiate_emission else 0)
        return EventState([Q], mi.Float(0), prefix, slots)

    def concerned(self, state: EventState) -> mi.Bool:
        return state.Q[0] > 0

    def vertex(
        self, state: EventState, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> EventState:  # fmt: skip
        p, plan = self.p, self.p.plan
        C = contribution(p, vertex, connection)
        p.splat(connection.u, C.value(), connection.active, self.colours)
        w = dr.select(connection.active, selection_weight(p, self.weight, connection, C, self.colours), 0)
        q = dr.select(plan.differentiates(vertex.bsdf), mi.Float(1), 0)
        if plan.differentiate_null:
            q = mi.Float(1)  # masks between vertex and sensor may have differentiated parameters
        Q = state.Q[0] + q
        w = at_least_share(w, state.W / dr.maximum(Q, 1))  # 1 is the smallest positive Q
        W = dr.fma(w, Q, state.W)
        this = Event.of_connection(plan, vertex, connection)
        slots = []
        for k, slot in enumerate(state.slots):
            event = state.prefix[k]
            if plan.differentiate_bsdfs:  # otherwise emission is the only event
                event = dr.select(numbers[2 * k] * Q < q, this, event)
            pair = EventSlot(w, C.stored(), connection.u, event)
            slots.append(dr.select(is_taken(numbers[2 * k + 1], w * Q, W), pair, slot))
        if not plan.differentiate_bsdfs:
            return replace(state, W=W, slots=slots)
        q = dr.select(plan.differentiates(vertex.bsdf), mi.Float(1), 0)
        Q = state.Q[0] + q
        this = Event.of_scattering(plan, vertex, scattering)
        prefix = [
            dr.select(number * Q < q, this, event) for number, event in zip(numbers[::2], state.prefix, strict=True)
        ]
        return EventState([Q], W, prefix, slots)


class EventEstimator(Selecting):
    """The estimator `event`: `capacity` independent pairs of a connection and an event."""

    def forward(self, p: Pass) -> EventState:
        return replace(p.walk(EventSelection(p, self.capacity, self.weight)), Q=[], prefix=[])

    def kept(self, plan: Plan) -> EventState:
        return EventState([], mi.Float(0), [], [EventSlot.empty(plan) for _ in range(self.capacity)])

    def backward(self, p: Pass, state: EventState) -> None:
        p = p.with_colours()
        adjoints = [slot_adjoint(p, state.W, slot, self.capacity) for slot in state.slots]

        def emission_weight(E: mi.Spectrum) -> mi.Spectrum:
            total = mi.Spectrum(0)
            for slot, adjoint in zip(state.slots, adjoints, strict=True):
                total += dr.select(slot.event.index == 0, adjoint_of_factor(adjoint, mi.Int32(0), E, 1), 0)
            return total

        differentiate_emission(p, emission_weight)
        if p.plan.differentiate_bsdfs:
            for slot, adjoint in zip(state.slots, adjoints, strict=True):
                differentiate_event(p, slot.event, adjoint, slot.w != 0)
