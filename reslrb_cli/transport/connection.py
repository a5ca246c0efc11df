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


def connection_factor(
    plan: Plan, scene: Any, vertex: Any, connection: Connection, loop_mode: str = "symbolic"
) -> tuple[Any, Any]:
    """c_i (C,), with derivatives where they are enabled, and where the sensor is seen: traces the shadow ray.

    In a scene without surfaces that light passes straight through, no transmittance is computed. `loop_mode` is that of
    its loop: naive AD needs it evaluated.
    """
    si, active = vertex.si, connection.active
    if plan.needs.has_null:
        limit = plan.max_depth - vertex.depth - 1
        through = transmittance(scene, si, connection.target, limit, active, loop_mode=loop_mode)
        active, passed = through.reached, through.value
    else:
        active, passed = active & ~scene.ray_test(si.spawn_ray_to(connection.target), active), mi.Spectrum(1)
    f = attached_factor(plan, si, vertex.bsdf, connection.wo, None, active)
    return f * passed * connection.weight, active


def stand_in(connection: Connection) -> tuple[Any, Any]:
    """What stands for bsdf * cos, and for c_i (C,), where they are zero (`Product.times`): those of a white surface."""
    f = dr.maximum(dr.abs(mi.Frame3f.cos_theta(connection.wo)), 1e-3) * dr.inv_pi
    return f, connection.weight * f
