"""Weighted reservoir sampling of a path's connections (Chao 1982), and replays towards those that were chosen.

slot k keeps candidate i with probability w_i / W,   W = sum_i w_i

Of the choice an `Event` is kept, a single factor of a path, so that its derivative needs no replay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Pass, PathAdjoint, VertexHooks, adjoint_of_factor, differentiate_passage
from reslrb_cli.estimators.kept import SurfacePoint, event, lobe
from reslrb_cli.transport.bsdf import Scattering, tracked_factor
from reslrb_cli.transport.connection import Connection, connect, stand_in
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex

S = TypeVar("S")
SHARE = 0.01  # the least share of a candidate in the weights up to it


class Chosen(Protocol):
    """What any slot holds of its connection: selection weight (0: it holds none), contribution, film position."""

    w: mi.Float
    C: Product
    u: mi.Point2f


def selection_weight(p: Pass, weight: str, connection: Connection, C: Product) -> mi.Float:
    """w of a connection: `luminance` of C, or `adjoint`, sum_c |delta_c C_c|.

    Raises ValueError where the latter is asked for and delta is not known.
    """
    value = C.weight()
    if weight == "luminance":
        return mi.luminance(mi.Color3f(value)) if len(value) == 3 else mi.Float(value[0])
    if p.adjoint is None:
        raise ValueError('weight "adjoint" needs dL/dI before the paths are traced, which correlated samples lack')
    return dr.sum(dr.abs(p.delta(connection.u, connection.active) * value))


def is_taken(number: mi.Float, w: mi.Float, W: mi.Float) -> mi.Bool:
    """Whether a candidate of weight `w` takes the slot, `W` being the sum up to it: with probability w / W.

    A weight that is not finite is always taken, and so is all that follows: what is wrong must not be lost.
    """
    return (w != 0) & ((number * W < w) | ~dr.isfinite(W))


def at_least_share(w: mi.Float, W: mi.Float) -> mi.Float:
    """A candidate's weight, raised to SHARE of all before it, W, unless it is 0.

    What comes after a heavy connection may be all that some parameter has: it is chosen with a probability of SHARE at
    least, where its own weight may be a millionth. What comes before needs no such care, since its parameters have a
    part in the heavy one too.
    """
    least = SHARE * W
    return dr.select((w != 0) & (w < least), least, w)  # a comparison: what is not a number stays


def inverse_probability(W: mi.Float, slot: Chosen, capacity: int) -> mi.Float:
    """W / (m w): 1 over the probability of a slot's selection, shared among the slots; 0 where it holds nothing."""
    return dr.select(slot.w != 0, W / (capacity * slot.w), 0)


def slot_adjoint(p: Pass, W: mi.Float, slot: Chosen, capacity: int) -> PathAdjoint:
    """Sensitivity of the objective to what a slot holds, standing for all that it was chosen from."""
    delta = p.delta(slot.u, slot.w != 0)
    return PathAdjoint(delta * slot.C.nonzero * inverse_probability(W, slot, capacity), slot.C)


def chosen_by(numbers: list[mi.Float], w: mi.Float, W: mi.Float, this: S, slots: list[S]) -> list[S]:
    """The slots behind one more candidate, `this`, each of which has a number to choose by."""
    return [dr.select(is_taken(number, w, W), this, slot) for number, slot in zip(numbers, slots, strict=True)]


class SlotReplay(VertexHooks):
    """A replay up to the last vertex, `last`, that any slot has anything to differentiate at."""

    replaying = True
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
    """One factor of a path: f towards local direction `wo`; `index` is its vertex, 0 for emission.

    `rest` times f is the factor as a whole, but for the transmittance of masks; it is kept where zero factors are
    tracked, beside which alone it is of use. `own` holds whether the event is a connection's own, and the sample of the
    aperture, where masks may stand between it and the sensor.
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
        """The event before the first vertex."""
        rest, wo, f = [mi.Float(0)] if plan.track_zeros else [], mi.Vector3f(0), mi.Spectrum(0)
        return Event(mi.UInt32(0), SurfacePoint.blank(plan), wo, f, rest, lobe(plan, None), _own(plan, None))

    @staticmethod
    def of_connection(plan: Plan, vertex: Vertex, connection: Connection) -> Event:
        """The BSDF of the vertex towards the sensor; index 0 where there is nothing to differentiate."""
        useful = mi.Bool(True) if plan.passage_in_gradient else plan.differentiates(vertex.bsdf)
        index, point = dr.select(useful, mi.UInt32(vertex.depth), 0), SurfacePoint.of(plan, vertex)
        rest = [dr.rcp(stand_in(connection)[0])] if plan.track_zeros else []
        return Event(index, point, connection.wo, connection.f, rest, lobe(plan, None), _own(plan, connection))

    @staticmethod
    def of_scattering(plan: Plan, vertex: Vertex, scattering: Scattering) -> Event:
        """The BSDF of the vertex along the path."""
        rest = [scattering.correction / scattering.pdf] if plan.track_zeros else []
        index, point, wo = mi.UInt32(vertex.depth), SurfacePoint.of(plan, vertex), scattering.wo
        return Event(index, point, wo, scattering.f, rest, lobe(plan, scattering), _own(plan, None))


def _own(plan: Plan, connection: Connection | None) -> list[mi.Bool | mi.Point2f]:
    """`Event.own` of an event that is a connection's, or of another."""
    if not plan.passage_in_gradient:
        return []
    return [mi.Bool(False), mi.Point2f(0)] if connection is None else [mi.Bool(True), connection.sample]


def differentiate_event(p: Pass, kept: Event, adjoint: PathAdjoint, active: mi.Bool) -> None:
    """Add the derivative of an event, of a connection with this adjoint, in `active` lanes that hold one."""
    plan, active = p.plan, active & (kept.index > 0)
    si, bsdf = kept.point.interaction(plan, active)
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
        dr.backward_from(dr.select(active, dr.dot(weight, f), 0))
