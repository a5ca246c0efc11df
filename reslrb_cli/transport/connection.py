"""Connecting a vertex of a light path to the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import attached_factor, shading_correction
from reslrb_cli.transport.transmittance import transmittance


@dataclass
class Connection:
    """The geometry of one connection, before the BSDF is evaluated and before visibility is known.

    `weight` is everything of c_i but the BSDF and the transmittance: sensor importance, geometry, Veach's correction,
    (C,). `u` is the film position in pixels relative to the crop window, `target` the point on the aperture.
    """

    weight: Any
    u: Any
    target: Any
    wo: Any
    active: Any


def connect(plan: Plan, sensor: Any, si: Any, ray: Any, sample: Any, active: Any) -> Connection:
    """Find where the vertex `si` appears on the film. Detached: film positions do not move here."""
    with dr.suspend_grad():
        ds, importance = sensor.sample_direction(si, sample, active)
        # From the vertex itself, where `ptracer` takes the shadow ray's direction, which starts a little off it.
        wo = si.to_local(ds.d)
        correction, valid = shading_correction(plan, si, -ray.d, ds.d, wo)
        return Connection(importance * correction, ds.uv, ds.p, wo, active & valid & (ds.pdf > 0))


def connection_factor(plan: Plan, scene: Any, vertex: Any, connection: Connection) -> tuple[Any, Any]:
    """c_i (C,), with derivatives where they are enabled, and where the sensor is seen: traces the shadow ray.

    In a scene without surfaces that light passes straight through, no transmittance is computed.
    """
    si, active = vertex.si, connection.active
    if plan.needs.has_null:
        through = transmittance(scene, si, connection.target, plan.max_depth - vertex.depth - 1, active)
        active, passed = through.reached, through.value
    else:
        active, passed = active & ~scene.ray_test(si.spawn_ray_to(connection.target), active), mi.Spectrum(1)
    f = attached_factor(plan, si, vertex.bsdf, connection.wo, None, active)
    return f * passed * connection.weight, active
