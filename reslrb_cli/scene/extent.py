"""Checks for scenes or parts whose position or size loses light through single precision or clip planes."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.scene.graph import (
    SceneGraph,
    bent_faces,
    bounds,
    emitted_rays,
    face_normals,
    grid,
    sensor_rays,
    triangles,
)
from reslrb_cli.scene.xml.read import quoted

#: Largest ray offset, as a fraction of the scene's size, without visible loss of light: that of a room of size 3 at
#: about 150 from the origin, or of a room a fiftieth in size.
LARGEST_OFFSET = 5e-3
#: Rays per side of a grid, from each sensor and from the lights, that search for coincident faces.
_RAYS = 128
#: Sensors that send such rays.
_SENSORS = 8
#: Maximum number of named pairs of shapes.
_NAMED = 2


def doubts(scene: Any) -> list[str]:
    """Return descriptions of problems with the place or the size of a scene or its parts."""
    return [loss for loss in (_lost_light(scene), _thin_glass(scene), _coincident(scene)) if loss is not None]


def _lost_light(scene: Any) -> str | None:
    """Return the problem of a scene that is far from the origin or tiny, with a remedy, or None.

    Mitsuba offsets the origins of rays from their surface by RayEpsilon (1 + max |p|), in the scene's units. Rays skip
    surfaces that are closer together than the offset. Light is then lost in corners, in all integrators.
    """
    low, high = bounds(scene)
    size = float(np.linalg.norm(high - low))
    reach = float(np.maximum(np.abs(low), np.abs(high)).max())
    offset = mi.math.RayEpsilon * (1 + reach)
    if not np.isfinite(size) or offset <= LARGEST_OFFSET * size:
        return None
    centre = float(np.linalg.norm((low + high) / 2))
    if centre > size:
        place, advice = f"is {centre:.3g} from the origin and {size:.3g} wide", "move it to the origin"
    else:
        place, advice = f"measures {size:.3g} across", "scale it to about 1"
    return f"the scene {place}: Mitsuba starts rays {offset:.2g} away from surfaces there, and light is lost; {advice}"


def clipped(scene: Any, sensor: Any) -> tuple[bool, bool]:
    """Return whether objects may lie between a sensor and its near clip plane, and whether objects may lie beyond its
    far clip plane.

    The sensor is perspective or thin-lens. Between the sensor and its near plane, only objects in the sensor's view
    count. The test uses bounding boxes, and triangles near the sensor. A result of false is certain, and a result of
    true may be wrong.
    """
    params = mi.traverse(sensor)
    near, far, radius, focus = (
        float(np.ravel(params[key])[0]) if key in params else default
        for key, default in (("near_clip", 0), ("far_clip", np.inf), ("aperture_radius", 0), ("focus_distance", np.inf))
    )
    to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    axes, eye = to_world[:3, :3], to_world[:3, 3]
    corners = np.array(list(product(*zip(*bounds(scene), strict=True))))
    beyond = bool(((corners - eye) @ axes[:, 2]).max() > far)

    # The box, in sensor coordinates, that contains everything between the aperture and the near plane.
    width, height = (int(n) for n in sensor.film().size())
    shift = max((float(np.abs(value).max()) for key, value in params if key.startswith("principal_point")), default=0.0)
    tangent = np.tan(np.deg2rad(float(params["x_fov"][0])) / 2) * max(1, height / width) * (1 + 2 * shift)
    side = near * tangent + radius * (1 + near / focus if focus > 0 else 1)
    half, middle = np.array([side, side, near / 2]), np.array([0, 0, near / 2])
    return any(_touches(shape, axes, eye, middle, half) for shape in scene.shapes()), beyond


def _touches(shape: Any, axes: np.ndarray, eye: np.ndarray, middle: np.ndarray, half: np.ndarray) -> bool:
    """Whether a shape may touch a box. `middle` and `half` are the box's centre and half sizes in the coordinates of
    `axes` (columns) and `eye`.
    """
    low, high = bounds(shape)
    centre, extent = (low + high) / 2, (high - low) / 2
    apart = centre - (eye + axes @ middle)
    beside = (np.abs(apart) > extent + np.abs(axes) @ half) | (np.abs(apart @ axes) > half + extent @ np.abs(axes))
    if beside.any():
        return False
    if shape.class_name() == "Sphere":  # a sensor may be inside it
        return bool(np.linalg.norm(apart) + np.linalg.norm(half) > extent.min() * 0.999)
    if not shape.is_mesh():
        return True
    corners = (triangles(shape) - eye) @ axes - middle
    corners = corners[((corners.min(1) <= half) & (corners.max(1) >= -half)).all(1)]
    normals = face_normals(corners)
    return bool((np.abs((normals * corners[:, 0]).sum(1)) <= np.abs(normals) @ half).any())


def _coincident(scene: Any) -> str | None:
    """Return the problem of a scene in which rays of a sensor or a light meet two coincident faces, or None.

    Rounding decides which face a ray meets. For two faces with one BSDF and no emission, the choice of the face does
    not matter in two cases. Either the faces face the same way, or the BSDF is `twosided` and the shading normals are
    the faces' normals. Otherwise, light paths and camera paths show different scenes. The test detects triangles with
    three common corners.
    """
    shapes = scene.shapes()
    twins = _twin_faces(shapes)
    if not twins:
        return None
    pairs = {twins[key]: None for key in _met(scene, shapes) if key in twins}
    if not pairs:  # as between two boxes side by side
        return None
    named = [" and ".join(quoted(shapes[index].id()) for index in dict.fromkeys(pair)) for pair in sorted(pairs)]
    more = f" (and {len(named) - _NAMED} more pairs)" if len(named) > _NAMED else ""
    return (
        f"faces of {', of '.join(named[:_NAMED])}{more} coincide and differ: rounding decides which of them a ray "
        "meets, differently for light paths and camera paths; remove one of each pair, or move them apart (`twosided` "
        "shows a face from both sides)"
    )


def _twin_faces(shapes: Sequence[Any]) -> dict[tuple[int, int], tuple[int, int]]:
    """Return the coincident triangles where it matters which triangle a ray meets.

    The result maps a mesh's number in `scene.shapes()` and a face's number to the numbers of the two meshes.
    """
    meshes = [index for index, shape in enumerate(shapes) if shape.is_mesh() and shape.face_count()]
    if not meshes:
        return {}
    corners = [triangles(shapes[index]).astype(np.float32) for index in meshes]
    owner = np.repeat(meshes, [len(part) for part in corners])
    number = np.concatenate([np.arange(len(part)) for part in corners])
    faces = np.concatenate(corners) + np.float32(0)  # -0 is 0
    # Sums of hashes of corners, which do not depend on the order.
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    hashes = (faces.view(np.uint32) * factors).sum(2, dtype=np.uint64)
    hashes = (hashes ^ (hashes >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (hashes ^ (hashes >> np.uint64(32))).sum(1, dtype=np.uint64)
    order = np.argsort(keys)
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    first, second = order[same], order[same + 1]
    a, b = faces[first].astype(np.float64), faces[second].astype(np.float64)
    facing = (face_normals(a) * face_normals(b)).sum(1)
    flipped = np.array([shape.has_flipped_normals() for shape in shapes])
    same = np.flatnonzero((np.sort(a, 1) == np.sort(b, 1)).all((1, 2)) & (facing != 0))
    first, second = first[same], second[same]
    turned = (facing[same] < 0) ^ (flipped[owner[first]] != flipped[owner[second]])
    bends = np.zeros(len(number), bool)  # shading normals differ from the geometric one
    for index in np.union1d(owner[first], owner[second]).tolist():
        bends[owner == index] = bent_faces(shapes[index], 0.999)
    kinds = np.stack([owner[first], owner[second], turned, bends[first] | bends[second]], 1)
    found: dict[tuple[int, int], tuple[int, int]] = {}
    for kind in np.unique(kinds, axis=0):
        one, other = sorted(kind[:2].tolist())
        if _differ(shapes[one], shapes[other], bool(kind[2]), bool(kind[3])):
            these = (kinds == kind).all(1)
            both = np.concatenate([first[these], second[these]])
            found |= dict.fromkeys(zip(owner[both].tolist(), number[both].tolist(), strict=True), (one, other))
    return found


def _differ(one: Any, other: Any, turned: bool, bent: bool) -> bool:
    """True if it matters which of two coincident faces a ray meets.

    It matters if a face emits, if the BSDFs differ, or if the normals are opposite (`turned`). Opposite normals do not
    matter for a `twosided` BSDF, unless a face's shading normals differ from its normal (`bent`).
    """
    if one.is_emitter() or other.is_emitter() or one.bsdf() != other.bsdf():
        return True
    return turned and (bent or one.bsdf().class_name() != "TwoSidedBRDF")


def _met(scene: Any, shapes: Sequence[Any]) -> set[tuple[int, int]]:
    """Return the numbers of the shapes and faces that rays from sensors and lights meet first."""
    place, lane = grid(_RAYS), dr.arange(mi.UInt32, _RAYS**2)
    numbers = [mi.Float(mi.sample_tea_float32(lane, mi.UInt32(k))) for k in range(3)]
    rays = [
        sensor_rays(sensor, sensor.shutter_open(), place, mi.Point2f(*numbers[:2]))[0]
        for sensor in scene.sensors()[:_SENSORS]
    ]
    with contextlib.suppress(UnsupportedScene):  # a warning if light paths are used
        rays.append(emitted_rays(scene, numbers[0], mi.Point2f(*numbers[1:]), place)[0])
    index = {int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]): k for k, shape in enumerate(shapes)}
    met: set[tuple[int, int]] = set()
    for ray in rays:
        hit = scene.ray_intersect_preliminary(ray)
        shape = np.array(dr.select(hit.is_valid(), dr.reinterpret_array(mi.UInt32, hit.shape), 0))
        for number, face in np.unique(np.stack([shape, np.array(hit.prim_index)]), axis=1).T.tolist():
            if number in index:
                met.add((index[number], face))
    return met


#: Minimum distance of a ray's origin from the next surface, in offsets, without a warning.
LEAST_OFFSETS = 10
#: Share of crossings that may be closer: at edges, and at grazing incidence on a sphere.
SHARE = 0.01
#: Maximum distance, by rounding, between the points where two rays meet one surface: in offsets, and relative to the
#: longer ray.
ROUNDING, FAR = 0.1, 1e-5
#: Number of traced paths, and surfaces along each.
_PATHS, _SURFACES = 4096, 8


def _thin_glass(scene: mi.Scene) -> str | None:
    """Return the problem of a scene in which light passes two surfaces that nearly touch, or None.

    Rays from the lights go straight through transparent surfaces. The distance of two surfaces is measured from both
    sides. A ray that leaves the first surface may miss the second surface.
    """
    passing = int(mi.BSDFFlags.Transmission)
    if not any(int(bsdf.flags()) & passing for bsdf in SceneGraph.of(scene).surface_bsdfs()):
        return None
    index = dr.arange(mi.UInt32, _PATHS)
    numbers = [mi.Float(mi.sample_tea_float32(index, mi.UInt32(k))) for k in range(5)]
    try:
        ray, _ = emitted_rays(scene, numbers[0], mi.Point2f(*numbers[1:3]), mi.Point2f(*numbers[3:5]))
    except UnsupportedScene:  # a warning if light paths are used
        return None
    # Each shape adds code to every surface interaction, so thousands of shapes compile slowly. The loop is therefore
    # symbolic, and the return ray, of which only the distance is needed, computes no interaction.
    first = scene.ray_intersect_preliminary(ray)
    si = first.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    gaps = dr.full(mi.Float, dr.nan, _PATHS * _SURFACES)
    passing_on = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Transmission)
    d = ray.d

    def goes_on(k: mi.UInt32, o: mi.Point3f, p: mi.Point3f, active: mi.Mask) -> mi.Mask:
        return active & (k < _SURFACES)

    def cross(k: mi.UInt32, o: mi.Point3f, p: mi.Point3f, active: mi.Mask) -> tuple[Any, ...]:
        """Return the next surface after `p`, for rays that start at `o`."""
        ray = mi.Ray3f(o, d)
        hit = scene.ray_intersect_preliminary(ray, active=active)
        following = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        onward = active & following.is_valid()
        # From the next surface back, on the line through p, to this surface or to one that the onward ray has skipped.
        # Rays are offset along the normal, so they run beside that line and hit oblique surfaces elsewhere.
        own = mi.math.RayEpsilon * (1 + dr.max(dr.abs(following.p)))
        behind = p + (dr.dot(following.p - p, d) - own) * d
        back = scene.ray_intersect_preliminary(mi.Ray3f(behind, -d), active=onward)
        offset = mi.math.RayEpsilon * (1 + dr.max(dr.abs(p)))
        jumped = dr.dot(behind - p, d) - back.t
        apart = dr.select(
            onward & back.is_valid() & (jumped > offset * ROUNDING + FAR * following.t),
            jumped,
            dr.norm(following.p - p),
        )
        dr.scatter(gaps, apart / offset, k * _PATHS + index, onward)
        is_passed = onward & mi.has_flag(following.bsdf().flags(), mi.BSDFFlags.Transmission)
        return k + 1, following.spawn_ray(d).o, following.p, is_passed

    state = (dr.zeros(mi.UInt32, _PATHS), si.spawn_ray(d).o, si.p, passing_on)
    dr.while_loop(state, goes_on, cross, labels=("k", "o", "p", "active"), label="thin glass")
    found = np.array(gaps)
    found = found[np.isfinite(found)]
    near = found[found < LEAST_OFFSETS]
    if len(near) <= SHARE * len(found) or len(near) == 0:
        return None
    return (
        f"light passes through surfaces that are {np.median(near):.2g} ray offsets apart (a ray starts "
        f"{mi.math.RayEpsilon:.2g} (1 + max |p|) away from the surface at p): it may jump over glass thinner than "
        f"{LEAST_OFFSETS}; make the glass thicker, or the scene larger"
    )
