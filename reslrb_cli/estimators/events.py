"""Single factors of a path, kept so that their derivative needs no replay."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Pass, PathAdjoint, adjoint_of_factor, differentiate_passage
from reslrb_cli.estimators.surface import SurfacePoint, blank_lobe, event, lobe
from reslrb_cli.transport.connection import Connection, connect, stand_in
from reslrb_cli.transport.factors import NO_ZERO
from reslrb_cli.transport.hooks import Vertex
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering
from reslrb_cli.transport.tracked import tracked_factor


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
        own = [mi.Bool(False), mi.Point2f(0)] if plan.passage_in_gradient else []
        point = SurfacePoint.blank(plan)
        rest = [mi.Float(0)] if plan.track_zeros else []
        return Event(mi.UInt32(0), point, mi.Vector3f(0), mi.Spectrum(0), rest, blank_lobe(plan), own)

    @staticmethod
    def of_connection(plan: Plan, vertex: Vertex, connection: Connection) -> Event:
        """The BSDF of the vertex towards the sensor; index 0 where there is nothing to differentiate."""
        useful = mi.Bool(True) if plan.passage_in_gradient else plan.differentiates(vertex.bsdf)
        return Event(
            index=dr.select(useful, mi.UInt32(vertex.depth), 0),
            point=SurfacePoint.of(plan, vertex),
            wo=connection.wo,
            f=connection.f,
            rest=[dr.rcp(stand_in(connection)[0])] if plan.track_zeros else [],
            lobe=blank_lobe(plan),
            own=[mi.Bool(True), connection.sample] if plan.passage_in_gradient else [],
        )

    @staticmethod
    def of_scattering(plan: Plan, vertex: Vertex, scattering: Scattering) -> Event:
        """The BSDF of the vertex along the path."""
        return Event(
            index=mi.UInt32(vertex.depth),
            point=SurfacePoint.of(plan, vertex),
            wo=scattering.wo,
            f=scattering.f,
            rest=[scattering.correction / scattering.pdf] if plan.track_zeros else [],
            lobe=lobe(plan, scattering),
            own=[mi.Bool(False), mi.Point2f(0)] if plan.passage_in_gradient else [],
        )


def differentiate_event(p: Pass, kept: Event, adjoint: PathAdjoint, active: mi.Bool) -> None:
    """Add the derivative of an event, of a connection with this adjoint, in `active` lanes that hold one."""
    plan, active = p.plan, active & (kept.index > 0)
    si, bsdf = kept.point.interaction(plan, active)
    rest = mi.Spectrum(kept.rest[0] if kept.rest else 0)
    if plan.passage_in_gradient:
        own, sample = kept.own
        connection = connect(plan, p.samples.sensor, si, kept.point.ray(), sample, active & own)

        def adjoint_of(transmission: mi.Spectrum) -> mi.Spectrum:
            return adjoint_of_factor(adjoint, mi.Int32(NO_ZERO), transmission, 0)

        passed = differentiate_passage(p, si, kept.index, connection, active & own, adjoint_of)
        rest = dr.select(own, rest * passed, rest)
    weight = adjoint_of_factor(adjoint, kept.index, kept.f, rest)
    active &= plan.differentiates(bsdf)
    with dr.resume_grad():
        f = tracked_factor(plan, si, bsdf, event(kept.wo, kept.lobe), active)
        dr.backward_from(dr.select(active, dr.dot(weight, f), 0))
