"""Points on lamps (shapes that emit), the rays that leave them, and the rays of environment maps.

`lamp_ray` samples light in six cases in which Mitsuba's own samples are wrong, or lack a derivative.

- Sphere: Mitsuba rotates a sphere's points with the sphere's `to_world`, but does not rotate the normals.
- `directionalarea`: Mitsuba keeps the area that the shape had when it was loaded.
- Moving mesh: Mitsuba samples a face in proportion to its area, and divides by the area of the mesh. Mitsuba treats
    both areas as constants. The density on face f is P_f / A_f(theta), and only P_f is constant.
- Textured moving mesh: Mitsuba finds points by a ray in the plane of texture coordinates. Mitsuba differentiates the
    points as if they moved along this ray.
- Textured mesh whose faces share texture coordinates: Mitsuba finds only one of the points with given coordinates.
- Differentiated texture: Mitsuba samples texels in proportion to their radiance. Mitsuba never samples black texels,
    although their derivatives are as large as any.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.graph import Lamp
from reslrb_cli.scene.rays import no_wavelengths
from reslrb_cli.transport.plan import Plan

DEFENSIVE = 0.1  # share of uniform samples, instead of samples proportional to differentiated radiance


def lamp_ray(
    lamp: Lamp, areas: mi.Float | None, time: mi.Float, wavelength_sample: mi.Float, position: mi.Point2f,
    direction: mi.Point2f, active: mi.Bool, evened: bool = False,
) -> tuple[mi.Ray3f, mi.Spectrum]:  # fmt: skip
    """Return a ray that leaves the lamp, and radiance / density (C,). The function uses the same random numbers as
    Mitsuba.

    `areas` are the cumulative areas from `sums_of_areas` for a mesh with moving faces, otherwise None. With `evened`,
    black texels of a lamp's texture are sampled, too.
    """
    si, weight = lamp_point(lamp, areas, time, position, active, evened)
    # For all lanes, because `environment_ray`'s remark on masked lookups holds here, too.
    si.wavelengths, radiance = lamp.emitter.sample_wavelengths(si, wavelength_sample, True)
    if lamp.parallel:
        d = mi.Vector3f(si.sh_frame.n)  # for a mesh the interpolated normal, as in Mitsuba
    else:
        d, weight = si.to_world(mi.warp.square_to_cosine_hemisphere(direction)), weight * dr.pi
    si.time = time
    return si.spawn_ray(d), radiance * weight


def lamp_point(
    lamp: Lamp, areas: mi.Float | None, time: mi.Float, sample: mi.Point2f, active: mi.Bool, evened: bool = False
) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
    """Return a point on the lamp, and the inverse of its density. Both move with the lamp."""
    if lamp.texture is not None and lamp.has_faces:
        return _textured_point(lamp.shape, lamp.texture, sample, active, evened)
    if lamp.texture is not None and evened:
        uv, density = _any_uv(lamp.texture, sample, active)
        there = lamp.shape.eval_parameterization(uv, mi.RayFlags.All, active)
        there.time = time
        ps, weight = mi.PositionSample3f(there), _weight(there, density, active)
    elif lamp.shared:
        ps = lamp.shape.sample_position(time, sample, active)
        weight = dr.rcp(ps.pdf)
    else:
        ps, weight = lamp.emitter.sample_position(time, sample, active)
    if lamp.is_sphere:
        center = mi.traverse(lamp.shape)["to_world"] @ mi.Point3f(0)
        outward = dr.normalize(ps.p - center)
        ps.n = mi.Normal3f(-outward if lamp.shape.has_flipped_normals() else outward)
    if areas is not None:
        face = drawn_face(areas, sample.y)
        area = face_area(lamp.shape, face)
        weight = weight * (area / dr.detach(area))
        si = mi.SurfaceInteraction3f(ps, no_wavelengths())
        si.n = lamp.shape.face_normal(face)  # rays start off the face; directions are about `ps.n`, interpolated
        return si, weight
    return mi.SurfaceInteraction3f(ps, no_wavelengths()), weight


def _textured_point(
    mesh: mi.Mesh, texture: mi.Texture, sample: mi.Point2f, active: mi.Bool, evened: bool
) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
    """Return a point that Mitsuba samples from a texture, or uniformly. If a mesh face moves, the point keeps its place
    in the face.
    """
    uv, density = _any_uv(texture, sample, active) if evened else texture.sample_position(sample, active)
    active = active & (density != 0)
    there = mesh.eval_parameterization(uv, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    si = mi.SurfaceInteraction3f(mi.PositionSample3f(there), no_wavelengths())
    si.n = there.n
    return si, _weight(there, density, active)


def _weight(there: mi.SurfaceInteraction3f, density: mi.Float, active: mi.Bool) -> mi.Float:
    """Return the inverse of a point's density per area. `density` is the point's density in texture coordinates."""
    return dr.select(active & there.is_valid(), dr.norm(dr.cross(there.dp_du, there.dp_dv)) / density, 0)


def _any_uv(texture: mi.Texture, sample: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Float]:
    """Return texture coordinates and their density. The coordinates are sampled from a mixture of the texture's density
    and the uniform density.
    """
    with dr.suspend_grad():
        even = sample.x < DEFENSIVE
        x = dr.select(even, sample.x / DEFENSIVE, (sample.x - DEFENSIVE) / (1 - DEFENSIVE))
        sample = mi.Point2f(x, sample.y)
        uv, density = texture.sample_position(sample, active)
        black = ~dr.isfinite(density)  # the whole texture is black, so there is no density to sample
        uv = dr.select(even | black, sample, uv)
        own = texture.pdf_position(uv, active)
        return uv, dr.select(black, 1, (1 - DEFENSIVE) * own + DEFENSIVE)


def drawn_face(areas: mi.Float, sample: mi.Float) -> mi.UInt32:
    """Return the face that Mitsuba selects with the random number `sample`. `areas` are the faces' cumulative areas."""
    last = dr.width(areas) - 1
    value = sample * dr.gather(mi.Float, areas, mi.UInt32(last))
    return dr.binary_search(0, last, lambda index: dr.gather(mi.Float, areas, index) < value)


def sums_of_areas(lamps: Sequence[Lamp]) -> list[mi.Float]:
    """Return the cumulative face areas (F,) of each lamp. All lamps must be meshes. The result is evaluated and
    detached.
    """
    with dr.suspend_grad():
        found = [dr.cumsum(face_area(lamp.shape, dr.arange(mi.UInt32, lamp.shape.face_count()))) for lamp in lamps]
        dr.eval(found)
        return found


def face_area(mesh: mi.Mesh, face: mi.UInt32) -> mi.Float:
    """Return the area of a face of a mesh."""
    a, b, c = (mesh.vertex_position(vertex) for vertex in mesh.face_indices(face))
    return 0.5 * dr.norm(dr.cross(b - a, c - a))


def beam_towards(
    lamp: Lamp, si: mi.Interaction3f, number: mi.Float, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:  # fmt: skip
    """Return the place on a lamp with `is_beam` whose light passes the point `si`, and irradiance / probability (C,).
    Occlusion is not tested. The random `number` selects a face of a mesh.
    """
    mesh, count, index = lamp.shape, 1, None
    if lamp.has_faces:
        count = mesh.face_count()
        index = mesh.face_indices(dr.minimum(mi.UInt32(number * count), count - 1))
        a, b, c = (dr.detach(mesh.vertex_position(vertex)) for vertex in index)
        x, y = b - a, c - a
        n = dr.normalize(dr.cross(x, y))
    else:
        to_world = dr.detach(mi.traverse(mesh)["to_world"])
        a, x, y = to_world @ mi.Point3f(0), to_world @ mi.Vector3f(1, 0, 0), to_world @ mi.Vector3f(0, 1, 0)
        n = dr.normalize(mi.Vector3f(to_world @ mi.Normal3f(0, 0, 1)))
    n = -n if mesh.has_flipped_normals() else n
    distance = dr.dot(si.p - a, n)
    there = dr.zeros(mi.SurfaceInteraction3f, dr.width(si.p))
    there.p, there.wavelengths = si.p - n * distance, si.wavelengths
    # Coordinates of the place in the plane of the lamp.
    across, offset = dr.cross(x, y), there.p - a
    u, v = (dr.dot(dr.cross(*pair), across) / dr.squared_norm(across) for pair in ((offset, y), (x, offset)))
    if index is not None:
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)
        if mesh.has_vertex_texcoords():
            corners = [mesh.vertex_texcoord(vertex) for vertex in index]
            there.uv = corners[0] * (1 - u - v) + corners[1] * u + corners[2] * v
    elif mesh.class_name() == "Disk":
        inside, turn = u**2 + v**2 <= 1, dr.atan2(v, u) * dr.inv_two_pi
        there.uv = mi.Point2f(dr.sqrt(u**2 + v**2), turn - dr.floor(turn))
    else:
        inside, there.uv = (dr.abs(u) <= 1) & (dr.abs(v) <= 1), 0.5 * mi.Point2f(u + 1, v + 1)
    inside = active & inside & (distance > 0)
    assert lamp.radiance is not None
    ds = dr.zeros(mi.DirectionSample3f, dr.width(si.p))
    ds.p, ds.n, ds.d, ds.dist, ds.uv = there.p, mi.Normal3f(n), -n, distance, there.uv
    ds.pdf, ds.delta, ds.emitter = dr.select(inside, mi.Float(1), 0), mi.Bool(True), mi.EmitterPtr(lamp.emitter)
    return ds, mi.Spectrum(dr.select(inside, lamp.radiance.eval(there, inside) * count, 0))


def wavelengths_of(number: mi.Float) -> tuple[mi.Wavelength, mi.Spectrum]:
    """Return wavelengths in proportion to the visible light of a white lamp, and the inverse of their density. The
    random `number` selects them. Without wavelengths, the density is 1.
    """
    if not mi.is_spectral:
        return no_wavelengths(), mi.Spectrum(1)
    wavelengths, inverse = mi.sample_rgb_spectrum(mi.sample_shifted(number))
    return dr.detach(wavelengths), dr.detach(inverse)


def keep_one(ray: mi.Ray3f, weight: mi.Spectrum) -> mi.Spectrum:
    """Give a ray its first wavelength in place of all, and return the weight (C,) of the ray.

    Behind a smooth boundary of glass with dispersion, only one wavelength goes on (`scene/dispersion.py`). Rays that
    carry one wavelength from the start lose no light there.
    """
    ray.wavelengths = mi.Spectrum(ray.wavelengths[0])
    return mi.Spectrum(weight[0])


# ---- Environment maps ----


def environment_ray(
    plan: Plan, environment: mi.Emitter, time: mi.Float, wavelength_sample: mi.Float, disk: mi.Point2f,
    direction: mi.Point2f,
) -> tuple[mi.Ray3f, mi.Spectrum]:  # fmt: skip
    """Return a ray from an environment map. The ray passes through a disk that is perpendicular to the ray and covers
    the scene's bounding sphere.

    Mitsuba's `envmap.sample_ray` places the disk in the local frame of the map, which is wrong if `to_world` rotates
    it. Directions are sampled in proportion to the map's radiance. If the map is differentiated, a part of the
    directions is sampled uniformly. Black texels beside a sun have derivatives as large as those of any other texel.
    """
    assert plan.horizon is not None
    center, radius = mi.Point3f(*plan.horizon.center), plan.horizon.radius * (1 + 1e-4)
    reference = dr.zeros(mi.Interaction3f)
    reference.p, reference.time = center, time
    reference.wavelengths, each = wavelengths_of(wavelength_sample)
    if plan.differentiate_emission:
        ds, weight = _any_direction(environment, reference, direction)
    else:
        # `sample_direction` also returns the weight, but from a masked texture lookup. With CUDA, Dr.Jit 1.5 ends the
        # process if it records a masked lookup outside of a call.
        ds, _ = environment.sample_direction(reference, direction, True)
        weight = dr.select(ds.pdf > 0, environment.eval_direction(reference, ds, True) / ds.pdf, 0)
    d = -dr.detach(ds.d)
    offset = mi.warp.square_to_uniform_disk_concentric(disk)
    perpendicular = mi.Frame3f(d).to_world(mi.Vector3f(offset.x, offset.y, 0))
    ray = mi.Ray3f(center + (perpendicular - d) * radius, d, time, reference.wavelengths)
    weight = weight * (dr.pi * radius**2)
    return ray, weight * each if mi.is_spectral else weight


def _any_direction(
    environment: mi.Emitter, reference: mi.Interaction3f, sample: mi.Point2f
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """Sample a direction from a mixture of the environment's own density and the uniform density.

    Also returns radiance / density.
    """
    with dr.suspend_grad():
        uniform = sample.x < DEFENSIVE
        x = dr.select(uniform, sample.x / DEFENSIVE, (sample.x - DEFENSIVE) / (1 - DEFENSIVE))
        sample = mi.Point2f(x, sample.y)
        ds, _ = environment.sample_direction(reference, sample, True)
        black = ~dr.isfinite(ds.d.y)  # the whole map is black, so there is no density to sample
        ds.d = dr.select(uniform | black, mi.warp.square_to_uniform_sphere(sample), ds.d)
        own = environment.pdf_direction(reference, ds, True)
        pdf = dr.select(black, dr.inv_four_pi, (1 - DEFENSIVE) * own + DEFENSIVE * dr.inv_four_pi)
        seen = dr.zeros(mi.SurfaceInteraction3f)
        seen.wavelengths = reference.wavelengths
        seen.wi = -ds.d  # `eval_direction` uses texture coordinates, which sampled directions lack
    return ds, environment.eval(seen, True) / pdf
