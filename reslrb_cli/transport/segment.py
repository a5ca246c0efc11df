"""One segment of a light path: from the ray that reaches a vertex to the connection from there, the scattering event,
and the next ray.

A segment depends on nothing but the ray, what it hits, the segment's random numbers and the scene. So it can be done
again, wherever these are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.connection import Connection, connect
from reslrb_cli.transport.numbers import Numbers
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering, scatter, tracked_factor


@dataclass
class Segment:
    """What follows from a vertex. Visibility is not known here: `connection.c` is not set, and `connection.active` says
    where the sensor would be seen if nothing stood in the way."""

    si: mi.SurfaceInteraction3f
    connection: Connection
    scattering: Scattering

    def next_ray(self) -> mi.Ray3f:
        """The ray that leaves in the sampled direction; no derivative goes with it."""
        return dr.detach(self.si.spawn_ray(self.scattering.d))


def find_vertex(
    ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr]:
    """The surface interaction where `ray` hits what `pi` says, and its BSDF."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    return si, si.bsdf()


def segment(
    plan: Plan,
    sensor: mi.Sensor,
    ray: mi.Ray3f,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    numbers: Numbers,
    connected: mi.Bool,
    scattered: mi.Bool,
    evaluates: bool = True,
    tracked: bool = False,
) -> Segment:
    """The segment from the vertex `si`, which `ray` reaches: connected in some lanes, scattered in some.

    Without `evaluates` the BSDF is not evaluated towards the sensor. With `tracked` the scattering weight carries the
    derivatives of the scene's parameters, where gradients are enabled, and the connection is left to be evaluated where
    it turns out to be visible; directions, densities and film positions have no derivatives here.
    """
    connection = connect(plan, sensor, si, ray, numbers.aperture, connected)
    wanted = connection.active if evaluates and not tracked else None
    scattering, connection.f = scatter(
        plan, si, bsdf, ray, numbers.bsdf_1d, numbers.bsdf_2d, scattered, connection.wo, wanted
    )
    if tracked:
        f = tracked_factor(plan, si, bsdf, scattering, scattering.active)
        scattering.weight = dr.replace_grad(scattering.weight, f * (scattering.correction / scattering.pdf))
    return Segment(si, connection, scattering)
