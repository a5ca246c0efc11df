"""Connections of a light path's vertex to the sensor.

`connect` finds the position of a vertex on the film. `passage` traces the shadow ray, which surfaces that only mask or
filter light let through (`masks.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.rays import is_hidden
from reslrb_cli.transport.masks import transmittance
from reslrb_cli.transport.plan import Plan


def shading_correction(
    plan: Plan, si: mi.SurfaceInteraction3f, wi_world: mi.Vector3f, wo_world: mi.Vector3f, wo: mi.Vector3f
) -> tuple[mi.Float, mi.Bool]:
    """Return Veach's factor for shading normals (thesis, p. 155), and whether both directions are on consistent sides.

    Without shading normals, the factor is 1 and the sides are always consistent. The function then computes neither the
    factor nor the sides. With perturbed normals the factor is |n . wo| / |n . wi|. The exchanged BSDF contains the rest
    of the correction. The geometric normal n is taken on the side of the shading normal. A transform that mirrors a
    mesh reverses the winding of its faces. Camera paths use only the shading normal, so the winding does not affect
    them.
    """
    if not (plan.needs.has_shading_normals or plan.needs.has_perturbed_normals):
        return mi.Float(1), mi.Bool(True)
    n = dr.mulsign(si.n, dr.dot(si.n, si.sh_frame.n))
    wi_dot_n, wo_dot_n = dr.dot(n, wi_world), dr.dot(n, wo_world)
    cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
    valid = (wi_dot_n * cos_i > 0) & (wo_dot_n * cos_o > 0)
    if plan.camera:
        return mi.Float(1), valid
    if plan.needs.has_perturbed_normals:
        return dr.select(valid, dr.abs(wo_dot_n / wi_dot_n), 0), valid
    correction = dr.select(valid, dr.abs((cos_i * wo_dot_n) / (cos_o * wi_dot_n)), 0)
    # On a mesh, the correction varies about 1 within each face and jumps at the edges, however fine the mesh is. A
    # derivative with the slopes but without the jumps is wrong by several percent if faces move through the light;
    # without both it is right. `ptracer` has the slopes.
    return (dr.detach(correction) if plan.attached_normalization else correction), valid


@dataclass
class Connection:
    """Geometry of one connection, without BSDF and visibility.

    `rest` (C,) is c_i without BSDF and transmittance: sensor importance, geometry and Veach's correction. `u` is the
    film position in pixels relative to the crop window. `target` is the point on the aperture, or on the near clip
    plane if anything stands before that plane. A walk that evaluates connections sets `f` (C,) to bsdf * cos, and
    `through` (C,) to the transmittance. The walk also sets `c` to c_i (C,), and `active` to the lanes that the sensor
    sees.
    """

    rest: mi.Spectrum
    u: mi.Point2f
    target: mi.Point3f
    wo: mi.Vector3f
    active: mi.Bool
    sample: mi.Point2f  # of the aperture
    f: mi.Spectrum | None = None
    c: mi.Spectrum | None = None
    through: mi.Spectrum | None = None
    p_cam: mi.Float | None = None  # area density here of the camera paths of a pixel, if paths are weighted


def connect(
    plan: Plan, sensor: mi.Sensor, si: mi.SurfaceInteraction3f, ray: mi.Ray3f | None, sample: mi.Point2f,
    active: mi.Bool, attached: bool = False,
) -> Connection:  # fmt: skip
    """Find the film position of the vertex `si`. If `attached`, it moves with the vertex.

    `ray` is the ray that reaches the vertex. `ray` is None if the vertex lies on an emitter and light starts there.
    """
    with dr.suspend_grad(when=not attached):
        ds, importance = sensor.sample_direction(si, sample, active)
        sees, target = ds.pdf > 0, ds.p
        if plan.needs.near_clip or plan.needs.lens_clip:
            sees, target = _clip(plan, sensor, ds)
        if plan.needs.principal_point or plan.needs.lens_clip:
            importance = _importance(sensor, ds, sees)
        # From the vertex itself; the shadow ray of `ptracer` starts slightly off it.
        wo = si.to_local(ds.d)
        correction, valid = mi.Float(1), mi.Bool(True)
        if ray is not None:
            correction, valid = shading_correction(plan, si, -ray.d, ds.d, wo)
        p_cam = None
        if plan.weighs:
            cos = -dr.dot(ds.d, dr.normalize(ds.n))
            p_cam = film_density(sensor, cos) * dr.abs(dr.dot(si.n, ds.d)) / dr.square(ds.dist)
        return Connection(importance * correction, ds.uv, target, wo, active & valid & sees, sample, p_cam=p_cam)


def _clip(plan: Plan, sensor: mi.Sensor, ds: mi.DirectionSample3f) -> tuple[mi.Bool, mi.Point3f]:
    """Return whether the point is within the sensor's clip planes. Also return where the point's camera ray crosses the
    near plane.

    For thin lenses, Mitsuba ignores the clip planes. If the lens focuses outside of the clip planes, Mitsuba's sensor
    sees nothing.
    """
    params = mi.traverse(sensor)
    near, far = mi.Float(params["near_clip"]), mi.Float(params["far_clip"])
    cos = -dr.dot(ds.d, dr.normalize(ds.n))
    z, sees = cos * ds.dist, ds.pdf > 0
    if plan.needs.lens_clip:
        size = mi.Vector2f(sensor.film().crop_size())
        sees = dr.all((ds.uv >= 0) & (ds.uv <= size)) & (z >= near) & (z <= far)
    return sees, dr.detach(ds.p - ds.d * dr.select(sees, near / cos, 0)) if plan.needs.near_clip else ds.p


def _importance(sensor: mi.Sensor, ds: mi.DirectionSample3f, sees: mi.Bool) -> mi.Spectrum:
    """Return a camera's importance and geometry if the camera sees the point, otherwise 0.

    Mitsuba's own importance ignores a shift of the principal point, and is zero outside of the unshifted film.
    Mitsuba's own importance is also zero if a thin lens focuses outside of the clip planes.
    """
    pixels = int(dr.prod(sensor.film().crop_size()))
    cos = -dr.dot(ds.d, dr.normalize(ds.n))
    return mi.Spectrum(dr.select(sees, film_density(sensor, cos) / (pixels * ds.dist**2), 0))


def film_density(sensor: mi.Sensor, cos: mi.Float) -> mi.Float:
    """Return the density of camera ray directions through one pixel. `cos` is the cosine between the direction and the
    sensor's axis.
    """
    size = sensor.film().size()
    half = dr.tan(dr.deg2rad(mi.Float(mi.traverse(sensor)["x_fov"])) / 2)
    pixel = 4 * half**2 * (int(size.y) / int(size.x)) / int(dr.prod(size))
    return dr.rcp(pixel * cos**3)


@dataclass
class KnownVisibility:
    """Visibility of the sensor, found in an earlier walk. `visible` is valid in `known` lanes, or in all lanes if
    `known` is None.
    """

    visible: mi.Bool
    known: mi.Bool | None = None


def stand_in(connection: Connection) -> tuple[mi.Float, mi.Spectrum]:
    """Return replacements for zero values of bsdf * cos and of c_i (C,), used by `Product.times`. They are those of a
    white surface.
    """
    f = dr.maximum(dr.abs(mi.Frame3f.cos_theta(connection.wo)), 1e-3) * dr.inv_pi
    return f, connection.rest * f


def before_lamps(plan: Plan, scene: mi.Scene, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
    """Return the active lanes without vertices on lamps, if camera rays start behind lamps."""
    return active & (si.emitter(scene) == dr.zeros(mi.EmitterPtr)) if plan.passes_lamps else active


def passage(
    plan: Plan, scene: mi.Scene, si: mi.SurfaceInteraction3f, depth: mi.UInt32, connection: Connection,
    known: KnownVisibility | None = None, loop_mode: str = "symbolic",
) -> tuple[mi.Bool, mi.Spectrum]:  # fmt: skip
    """Trace the shadow ray. Returns the lanes that the sensor sees, and the transmittance (C,) of masks on the way.

    If visibility is `known`, no ray is traced. In scenes without null surfaces, no transmittance is computed. In scenes
    with null surfaces, `known` cannot be used. `loop_mode` is the mode of the loop, which must be evaluated for
    naive AD.
    """
    active, one = before_lamps(plan, scene, si, connection.active), mi.Spectrum(1)
    if plan.needs.has_null:
        through = transmittance(plan, scene, si, depth, connection.target, active, loop_mode=loop_mode)
        return through.reached, through.value
    if known is None or plan.passes_lamps:
        return active & ~is_hidden(scene, si, connection.target, plan.has_edges, active, plan.passes_lamps), one
    if known.known is None:
        return active & known.visible, one
    unknown = active & ~known.known
    traced = unknown & ~is_hidden(scene, si, connection.target, plan.has_edges, unknown)
    return traced | (active & known.known & known.visible), one
