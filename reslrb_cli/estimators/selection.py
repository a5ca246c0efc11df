"""Weighted reservoir sampling of a path's connections (Chao 1982), and path replays up to the selected connections.

    slot k keeps candidate i with probability w_i / W,   W = sum_i w_i

An `Event` stores a single factor of a path. Its derivative needs no replay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.config.files import CAPACITY
from reslrb_cli.estimators.base import (
    Estimator,
    Pass,
    PathAdjoint,
    SurfacePoint,
    VertexHooks,
    adjoint_of_factor,
    at_least_one,
    differentiate_passage,
    event,
    lobe,
    one_of,
)
from reslrb_cli.transport.bsdf import Scattering, tracked_factor
from reslrb_cli.transport.connection import Connection, connect, stand_in
from reslrb_cli.transport.factors import MAY_LACK, Product, showing
from reslrb_cli.transport.film import Colours
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex

S = TypeVar("S")
SHARE = 0.01  # minimum share of a candidate in the weights up to it


class Selecting(Estimator):
    """Estimator that keeps `capacity` slots of each path, with selection weight `luminance` or `adjoint`."""

    OPTIONS: ClassVar[dict[str, Any]] = {"capacity": 1, "weight": "luminance"}

    def __init__(self, capacity: int = 1, weight: str = "luminance") -> None:
        one_of("weight", weight, ("luminance", "adjoint"))
        at_least_one("capacity", capacity, CAPACITY)
        self.capacity, self.weight = capacity, weight


class Chosen(Protocol):
    """Common data of slots: selection weight (0 if empty), contribution, and film position."""

    w: mi.Float
    C: Product
    u: mi.Point2f


def selection_weight(p: Pass, weight: str, connection: Connection, C: Product, colours: Colours) -> mi.Float:
    """Return w of a connection: the luminance of C for `luminance`, or sum_c |delta_c C_c| for `adjoint`. It is
    infinite if it is not finite, so that the connection is selected.

    Raises ValueError for `adjoint` if delta is not known.
    """
    value = C.magnitude()
    if weight == "luminance":
        if mi.is_spectral:
            return showing(dr.sum(colours.seen(value)))
        return showing(mi.luminance(mi.Color3f(value)) if len(value) == 3 else mi.Float(value[0]))
    if p.adjoint is None:
        raise ValueError('weight "adjoint" needs dL/dI before the paths are traced, which correlated samples lack')
    return showing(dr.sum(dr.abs(p.delta(connection.u, connection.active, colours) * value)))


def is_taken(number: mi.Float, w: mi.Float, W: mi.Float) -> mi.Bool:
    """Return True if a candidate of weight `w` takes the slot. The probability is w / W. The sum `W` includes `w`.

    If the weight sum is not finite, the current candidate and all later candidates are taken. Errors are therefore not
    lost.
    """
    return (w != 0) & ((number * W < w) | ~dr.isfinite(W))


def at_least_share(w: mi.Float, W: mi.Float) -> mi.Float:
    """Return the candidate's weight, raised to at least SHARE times the sum W of all earlier weights. A weight of 0
    stays 0.

    Connections after a heavy one may be the only ones that depend on some parameter. The weights of connections after a
    heavy connection may be a millionth of the heavy connection's weight. The minimum weight gives these later
    connections a selection probability of at least SHARE. Connections before a heavy connection need no minimum weight,
    because the heavy connection depends on their parameters, too.
    """
    least = SHARE * W
    return dr.select((w != 0) & (w < least), least, w)  # a comparison, so that NaN is kept


def inverse_probability(W: mi.Float, slot: Chosen, capacity: int) -> mi.Float:
    """Return W / (m w), the inverse probability of a slot's selection divided by the number of slots. It is 0 for an
    empty slot.
    """
    return dr.select(slot.w != 0, W / (capacity * slot.w), 0)


def slot_adjoint(p: Pass, W: mi.Float, slot: Chosen, capacity: int) -> PathAdjoint:
    """Return the objective's sensitivity to a slot's connection. The sensitivity is multiplied by the slot's inverse
    selection probability.
    """
    assert p.colours is not None
    delta = p.delta(slot.u, slot.w != 0, p.colours)
    return PathAdjoint(delta * slot.C.nonzero * inverse_probability(W, slot, capacity), slot.C)


def chosen_by(numbers: list[mi.Float], w: mi.Float, W: mi.Float, this: S, slots: list[S]) -> list[S]:
    """Return the slots after offering the candidate `this` to each slot. Each slot has its own random number."""
    return [dr.select(is_taken(number, w, W), this, slot) for number, slot in zip(numbers, slots, strict=True)]


class SlotReplay(VertexHooks):
    """Replay up to the vertex `last`, which is the last vertex that any slot differentiates."""

    needs_product = False
    connects = False

    def __init__(self, p: Pass, last: list[mi.UInt32]) -> None:
        super().__init__(p)
        self.last = last[0]
        for other in last[1:]:
            self.last = dr.maximum(self.last, other)

    def goes_on(self, state: Any, vertex: Vertex) -> mi.Bool:
        return vertex.depth <= self.last

    def is_followed(self, state: Any, vertex: Vertex) -> mi.Bool:
        return vertex.depth < self.last


@dataclass
class Event:
    """One factor of a path: the BSDF value f towards the local direction `wo`. `index` is the vertex of the factor.
    `index` is 0 for emission.

    Apart from the transmittance of masks, the whole factor is `rest` times f. `rest` is stored only if zero factors are
    tracked. `own` is stored only if masks may stand between vertex and sensor. `own` holds True for a connection's
    event, and the sample of the sensor's aperture.
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
        """Return the emission event, which precedes the first vertex."""
        rest, wo, f = [mi.Float(0)] if plan.track_zeros else [], mi.Vector3f(0), mi.Spectrum(0)
        return Event(mi.UInt32(0), SurfacePoint.blank(plan), wo, f, rest, lobe(plan, None), _own(plan, None))

    @staticmethod
    def of_connection(plan: Plan, vertex: Vertex, connection: Connection) -> Event:
        """Return an event for the vertex's BSDF towards the sensor. The event's index is 0 if nothing is
        differentiated.
        """
        useful = mi.Bool(True) if plan.passage_in_gradient else plan.differentiates(vertex.bsdf)
        index, point = dr.select(useful, mi.UInt32(vertex.depth), 0), SurfacePoint.of(plan, vertex)
        rest = [dr.rcp(stand_in(connection)[0])] if plan.track_zeros else []
        return Event(index, point, connection.wo, connection.f, rest, lobe(plan, None), _own(plan, connection))

    @staticmethod
    def of_scattering(plan: Plan, vertex: Vertex, scattering: Scattering) -> Event:
        """Return an event for the vertex's BSDF along the path."""
        rest = [scattering.correction / scattering.pdf] if plan.track_zeros else []
        index, point, wo = mi.UInt32(vertex.depth), SurfacePoint.of(plan, vertex), scattering.wo
        return Event(index, point, wo, scattering.f, rest, lobe(plan, scattering), _own(plan, None))


def _own(plan: Plan, connection: Connection | None) -> list[mi.Bool | mi.Point2f]:
    """Return `Event.own` for a connection. None stands for a scattering event."""
    if not plan.passage_in_gradient:
        return []
    return [mi.Bool(False), mi.Point2f(0)] if connection is None else [mi.Bool(True), connection.sample]


def differentiate_event(p: Pass, kept: Event, adjoint: PathAdjoint, active: mi.Bool) -> None:
    """Add an event's derivative in `active` lanes that hold an event. `adjoint` is the adjoint of the event's
    connection.
    """
    plan, active = p.plan, active & (kept.index > 0)
    si, bsdf = kept.point.interaction(plan, p.wavelengths, active)
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
        dr.backward_from(dr.select(active, dr.dot(weight, f), 0), flags=MAY_LACK)
