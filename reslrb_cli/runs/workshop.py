"""Figures and pictures of the sheet for the workshop that makes a lens or a mirror (`report/page/workshop.py`).

`setup_of` measures the set-up in its scene: distances, direction of
the light, orientation of the picture. Lengths are in mm. Directions are unit vectors in the axes of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.lens.solid import Sheet
from reslrb_cli.records.images import luminance
from reslrb_cli.scene.images import read_image

Array = np.ndarray[Any, Any]

#: Rays for the shares of lost light, which are 0.1 % to 5 %, and the maximum number of faces that each ray meets.
SHARE_RAYS, BOUNCES = 2**19, 8


def figures(image: Array, target: Array) -> dict[str, float]:
    """Compare luminances (H, W) within the picture: SSIM, L1 and contrast (standard deviation over mean).

    Also returns the target's `contrast`, and the share of the film's light that falls into the picture. The picture is
    the bounding rectangle of the target's nonzero pixels. Each image is divided by its mean within the picture. SSIM is
    computed by scikit-image, with the target's maximum as data_range.
    """
    from skimage.metrics import structural_similarity

    inside = picture_within(target)
    seen, wanted = image[inside], target[inside]
    seen, wanted = seen / max(float(seen.mean()), 1e-30), wanted / wanted.mean()
    return {
        "ssim": float(structural_similarity(seen, wanted, data_range=float(wanted.max()))),
        "l1": float(np.abs(seen - wanted).mean()),
        "inside": float(image[inside].sum() / max(float(image.sum()), 1e-30)),
        "contrast": float(seen.std()),
        "target_contrast": float(wanted.std()),
    }


def picture_within(target: Array) -> tuple[slice, slice]:
    """Return rows and columns of the picture in a target (H, W): the bounding rectangle of its nonzero pixels."""
    rows, columns = (np.flatnonzero(np.any(target > 0, axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def where_light_goes(scene: mi.Scene, sensor: mi.Sensor, plan: Fabrication, target: Array) -> dict[str, float]:
    """Return three shares of the light from the front face. The light goes `inside` the picture, `beside` the picture
    on the film, or `beyond`.

    `beyond` is light that lands elsewhere on the receiver, or misses the receiver. The shares are estimated with
    `SHARE_RAYS` rays from the lamps. Mitsuba samples the BSDFs, and reflections in the glass are included. The picture
    consists of the nonzero pixels of the luminance `target` (H, W). Light reflected back to the lamp, and light past
    the lens, do not count. If no light leaves the lens, all shares are 0.
    """
    rows, columns = picture_within(target)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    front, receiver = mi.ShapePtr(shapes[plan.face]), mi.ShapePtr(shapes[plan.receiver])
    solid = [shape for name, shape in shapes.items() if name in (plan.face, "back")]
    sampler, ray, light = _from_lamps(scene, SHARE_RAYS)
    context = mi.BSDFContext(mi.TransportMode.Importance)
    left, active = dr.zeros(mi.Bool, SHARE_RAYS), light > 0
    dr.make_opaque(ray, light, left, active)  # so that each round launches one kernel
    totals = dict.fromkeys(("inside", "beside", "beyond"), 0.0)
    for _ in range(BOUNCES):
        si = scene.ray_intersect(ray, active)
        again = active & si.is_valid() & _is_any(si.shape, solid)
        ended = active & left & ~again
        ds, importance = sensor.sample_direction(si, mi.Point2f(0.5), ended)
        on_film = ended & (si.shape == receiver) & (dr.max(importance) > 0)
        inside = on_film & (ds.uv.x >= columns.start) & (ds.uv.x < columns.stop)
        inside &= (ds.uv.y >= rows.start) & (ds.uv.y < rows.stop)
        parts = {"inside": inside, "beside": on_film & ~inside, "beyond": ended & ~on_film}
        sums = {name: dr.sum(dr.select(part, light, 0)) for name, part in parts.items()}
        bs, factor = si.bsdf(ray).sample(context, si, sampler.next_1d(again), sampler.next_2d(again), again)
        towards = si.to_world(bs.wo)
        ray = si.spawn_ray(towards)
        light = dr.select(again, light * mi.Float(mi.luminance(factor) if mi.is_rgb else factor.x), 0)
        active = again & (light > 0)
        left = active & (si.shape == front) & (dr.dot(towards, si.n) * dr.sign(si.n.z) > 0)
        dr.eval(ray, light, active, left, sums)
        for name, part in sums.items():
            totals[name] += float(part[0])
        if not dr.any(active):
            break
    whole = sum(totals.values())
    return {name: total / max(whole, 1e-30) for name, total in totals.items()}


def _from_lamps(scene: mi.Scene, count: int) -> tuple[mi.Sampler, mi.Ray3f, mi.Float]:
    """Return a sampler for `count` rays, rays from the lamps, and the light of each ray."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    ray, weight, _ = scene.sample_emitter_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True)
    return sampler, ray, mi.Float(mi.luminance(weight) if mi.is_rgb else weight.x)


def _is_any(shape: mi.ShapePtr, others: Sequence[mi.Shape]) -> mi.Bool:
    found = mi.Bool(False)
    for other in others:
        found = found | (shape == mi.ShapePtr(other))
    return found


# --- the sheet --------------------------------------------------------------------------------------------------------


def add_sheet(
    numbers: dict[str, Any],
    plan: Fabrication,
    scene: mi.Scene,
    sensor: int,
    sheet: Sheet,
    thrown: Array,
    wanted: Array,
) -> dict[str, Array]:
    """Add quality, light and set-up of a solid to `numbers`. Returns the original picture and the caustic.

    `thrown` (H, W) is the luminance of the image of the sensor with index `sensor`. `wanted` (H, W) is the luminance of
    the sensor's target.
    """
    original = original_of(plan, wanted)
    numbers["thrown"] = figures(thrown, wanted)
    if original is not None:
        numbers["thrown"]["ssim_of_picture"] = figures(thrown, original)["ssim"]
    if {plan.face, plan.receiver} <= {shape.id() for shape in scene.shapes()}:
        numbers["light"] = where_light_goes(scene, scene.sensors()[sensor], plan, wanted)
        numbers["setup"] = setup_of(scene, scene.sensors()[sensor], plan, sheet, wanted)
    shown = wanted if original is None else original
    inside = picture_within(wanted)
    return {"picture": as_picture(shown, shown, inside), "caustic": as_picture(thrown, shown, inside)}


def original_of(plan: Fabrication, wanted: Array) -> Array | None:
    """Return the luminance (H, W) of the picture before its dark parts were raised. Return None if the picture is
    unknown, or does not have the size of `wanted`.
    """
    if plan.picture is None:
        return None
    picture = luminance(read_image(plan.picture))
    # Nonzero in the same rectangle as in the target.
    return np.where(wanted > 0, np.maximum(picture, 1e-9), 0) if picture.shape == wanted.shape else None


def as_picture(image: Array, original: Array, inside: tuple[slice, slice]) -> Array:
    """Crop an image (H, W) to the picture. Return the crop (H, W, 1), scaled to the mean brightness of the `original`.

    A value of 1 is the brightest part of the original.
    """
    seen, wanted = image[inside], original[inside]
    scaled = seen / max(float(seen.mean()), 1e-30) * (wanted.mean() / max(float(wanted.max()), 1e-30))
    return np.asarray(scaled, dtype=np.float32)[:, :, None]


# --- the set-up -------------------------------------------------------------------------------------------------------

#: Rays from the lamps. A lamp farther away than this multiple of the face's size counts as parallel light.
RAYS, FAR = 2**14, 500.0


def setup_of(
    scene: mi.Scene, sensor: mi.Sensor, plan: Fabrication, sheet: Sheet, target: Array
) -> dict[str, Any] | None:
    """Return the set-up of the solid in `scene`, or None if no light reaches the solid, or `sensor` sees no receiver.

    `sheet` is the front face. `target` (H, W) is the luminance that `sensor` should see. The result has these entries.

    - `kind` is `lens` or `mirror`. `face_size` and `picture_size` are widths and heights.
    - `receiver_distance` is the distance from the centre of the face (x = y = z = 0) to the centre of the receiver.
    - `light_distance` is the distance of a point lamp from the side that faces the lamp. For parallel light, the entry
        is `parallel`.
    - `lit_side` is `front` or `back`, the side of the solid that faces the lamp.
    - `light_direction` is the direction in which the light travels. `receiver` is the receiver's centre.
        `receiver_normal` is the receiver's normal towards the solid. `picture_up` and `picture_right` are directions on
        the receiver.
    - `through` tells whether the picture reads correctly for a viewer behind the receiver.
    """
    shapes = {shape.id(): shape for shape in scene.shapes()}
    if plan.receiver not in shapes:
        return None
    center = np.ravel(shapes[plan.receiver].bbox().center()).astype(float)
    normal = _normal(scene, sensor, shapes[plan.receiver])
    light = _light(scene, [shapes[name] for name in (plan.face, "back") if name in shapes])
    if normal is None or light is None:
        return None
    points, directions = light
    toward, lamp = beam(points, directions, max(sheet.half) * 2)
    front = toward[2] < 0
    entrance = np.array([0.0, 0.0, 0.0 if front else -plan.thickness])
    normal = normal if normal @ center < 0 else -normal
    camera = np.array(sensor.world_transform().matrix, dtype=float).reshape(4, 4)
    mirrored, behind = np.linalg.det(camera[:3, :3]) < 0, (camera[:3, 3] - center) @ normal < 0
    left, top, right, bottom = _middles(sensor, target, center, normal)
    return {
        "kind": plan.kind,
        "face_size": [2 * half for half in sheet.half],
        "picture_size": [float(np.linalg.norm(right - left)), float(np.linalg.norm(top - bottom))],
        "receiver_distance": float(np.linalg.norm(center)),
        "light_distance": "parallel" if lamp is None else float(np.linalg.norm(lamp - entrance)),
        "lit_side": "front" if front else "back",
        "light_direction": _unit(toward),
        "receiver": [float(value) for value in center],
        "receiver_normal": _unit(normal),
        "picture_up": _unit(top - bottom),
        "picture_right": _unit(right - left),
        "through": bool(mirrored != behind),
    }


def _unit(vector: Array) -> list[float]:
    return [round(float(value), 9) + 0.0 for value in vector / np.linalg.norm(vector)]  # no -0


def _normal(scene: mi.Scene, sensor: mi.Sensor, receiver: mi.Shape) -> Array | None:
    """Return the normal (3,) of the receiver in the middle of the film, or None if `sensor` sees another object
    there.
    """
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    si = scene.ray_intersect(mi.Ray3f(ray))
    if not bool(np.all(np.array(si.is_valid() & (si.shape == mi.ShapePtr(receiver))))):
        return None
    return np.ravel(np.array(si.n)).astype(float)


def _middles(sensor: mi.Sensor, target: Array, center: Array, normal: Array) -> list[Array]:
    """Return the points (3,) on the receiver's plane that appear at the middles of the picture's four edges.

    The order is left, top, right, bottom, as on the film. The picture consists of the nonzero pixels of `target` (H,
    W).
    """
    rows, columns = picture_within(target)
    height, width = target.shape
    u, v = [columns.start / width, columns.stop / width], [rows.start / height, rows.stop / height]
    places = []
    for x, y in ((u[0], sum(v) / 2), (sum(u) / 2, v[0]), (u[1], sum(v) / 2), (sum(u) / 2, v[1])):
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
        origin, direction = (np.ravel(np.array(each)).astype(float) for each in (ray.o, ray.d))
        places.append(origin + (center - origin) @ normal / (direction @ normal) * direction)
    return places


def _light(scene: mi.Scene, solid: list[mi.Shape]) -> tuple[Array, Array] | None:
    """Return the points (n, 3) where light from the lamps first meets the solid's shapes. Also return the light's
    directions (n, 3).

    Returns None if no ray meets them.
    """
    _, ray, light = _from_lamps(scene, RAYS)
    si = scene.ray_intersect(ray, light > 0)
    kept = np.ravel(np.array((light > 0) & si.is_valid() & _is_any(si.shape, solid))).astype(bool)
    points, directions = (np.array(each, dtype=float).reshape(3, -1).T[kept] for each in (si.p, ray.d))
    return (points, directions) if len(points) > 8 else None


def beam(points: Array, directions: Array, size: float) -> tuple[Array, Array | None]:
    """Return the mean direction (3,) of the rays, and the position (3,) of their lamp. For parallel light, the position
    is None.

    Rays go through `points` (n, 3) along unit `directions` (n, 3). `size` (mm) is the size of the face. The light of a
    wide and distant lamp, such as the sun, counts as parallel, because the mean direction is the same all over the
    face.
    """
    toward = directions.mean(axis=0)
    toward /= np.linalg.norm(toward)
    along = directions @ toward
    slopes = directions / along[:, None] - toward
    across = points - points.mean(axis=0)
    across -= (across @ toward)[:, None] * toward
    spread = float(np.sum(across**2))
    growth = float(np.sum(across * slopes)) / max(spread, 1e-30)  # 1 / distance of a point lamp
    if growth * size < 1 / FAR:
        return toward, None
    # The point nearest to all rays.
    cut = np.eye(3)[None] - directions[:, :, None] * directions[:, None, :]
    return toward, np.linalg.solve(cut.sum(axis=0), np.einsum("nij,nj->i", cut, points))
