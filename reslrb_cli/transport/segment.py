"""One segment of a light path: from the ray that reaches a vertex to the connection from there, the scattering event,
and the next ray.

A segment depends on nothing but the ray, what it hits, the segment's random numbers and the scene. So it can be done
again, wherever these are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.aim import Aimed
from reslrb_cli.transport.connection import Connection, connect
from reslrb_cli.transport.numbers import Numbers
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering, scatter
from reslrb_cli.transport.tracked import tracked_factor


@dataclass
class Segment:
    """What follows from a vertex. Visibility is not known here: `connection.c` is not set, and `connection.active` says
    where the sensor would be seen if nothing stood in the way."""

    si: mi.SurfaceInteraction3f
    connection: Connection
    scattering: Scattering

    def next_ray(self, attached: bool = False) -> mi.Ray3f:
        """The ray that leaves in the sampled direction; its derivatives go with it if `attached`."""
        ray = self.si.spawn_ray(self.scattering.d)
        return ray if attached else dr.detach(ray)


def find_vertex(
    ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr]:
    """The surface interaction where `ray` hits what `pi` says, and its BSDF."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    return si, si.bsdf()


def find_following_vertex(
    ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Ray3f, mi.Float]:
    """The surface interaction of a vertex that stays where it is on its surface, and moves with that alone.

    Also the ray that reaches it, whose direction turns with both ends, and by what factor (1, with a derivative) a
    measure of directions at its origin becomes one of places on the surface: |cos| / distance^2 times the surface's
    own stretching.
    """
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    there = si.p - ray.o
    distance = dr.norm(there)
    reaching = mi.Ray3f(ray)
    reaching.d = there / distance
    si.t = distance
    si.wi = si.to_local(-reaching.d)
    measure = dr.abs(dr.dot(si.n, reaching.d)) / dr.square(distance) * dr.norm(dr.cross(si.dp_du, si.dp_dv))
    return si, reaching, dr.select(active & (measure > 0), measure / dr.detach(measure), 1)


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
    attached: bool = False,
    aimed: Aimed | None = None,
) -> Segment:
    """The segment from the vertex `si`, which `ray` reaches: connected in some lanes, scattered in some.

    Without `evaluates` the BSDF is not evaluated towards the sensor. With `tracked` the scattering weight carries the
    derivatives of the scene's parameters, where gradients are enabled, and the connection is left to be evaluated where
    it turns out to be visible; directions, densities and film positions have no derivatives then. With `attached` they
    have, and so has everything else. Lanes that are `aimed` scatter to their points.
    """
    connection = connect(plan, sensor, si, ray, numbers.aperture, connected, attached)
    wanted = connection.active if evaluates and not tracked else None
    scattering, connection.f = scatter(
        plan, si, bsdf, ray, numbers.bsdf_1d, numbers.bsdf_2d, scattered, connection.wo, wanted, attached, aimed
    )
    if tracked and not attached:
        f = tracked_factor(plan, si, bsdf, scattering, scattering.active)
        scattering.weight = dr.replace_grad(scattering.weight, f * (scattering.correction / scattering.pdf))
    return Segment(si, connection, scattering)
