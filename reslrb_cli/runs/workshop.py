"""Figures and pictures of the sheet for the workshop that makes a lens or a mirror (`report/page/workshop.py`).

`OpticalBench` and `tolerances` render images with errors of light, position or glass. For each error, a stock
integrator of Mitsuba renders the scene with the changed part. If a rotation shifts the whole picture, the shift is
reported, and removed before images are compared. `setup_of` measures the set-up in its scene: distances, direction of
the light, orientation of the picture. Lengths are in mm. Directions are unit vectors in the axes of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.ndimage

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.errors import ConfigError
from reslrb_cli.glasses import Glass
from reslrb_cli.lens.solid import Sheet
from reslrb_cli.lens.surface import similarity
from reslrb_cli.records.images import luminance
from reslrb_cli.scene.graph import is_one_of
from reslrb_cli.scene.images import read_image
from reslrb_cli.scene.rays import brightness

Array = np.ndarray[Any, Any]

#: Loss of SSIM that counts as still acceptable.
ALLOWED_LOSS = 0.05

#: Errors that a careful workshop keeps: distance in mm, rotations in degrees, index of refraction.
TOLERANCES = {"distance": 1.0, "light turned": 0.5, "solid turned": 0.5, "index": 0.002}

#: Assumed errors of the distance, of the index, and of rotations in degrees.
DISTANCE, INDEX, TURN = 0.02, 0.005, 1.0

#: Rays for the shares of lost light, which are 0.1 % to 5 %, and the maximum number of faces that each ray meets.
SHARE_RAYS, BOUNCES = 2**19, 8

#: Directions within a light as wide as the sun, in units of its radius: the centre, and six on a circle with the mean
#: squared distance of an even disc (one half).
_DIRECTIONS = [(0.0, 0.0), *((np.cos(a) * (7 / 12) ** 0.5, np.sin(a) * (7 / 12) ** 0.5)
                             for a in np.arange(6) * np.pi / 3)]  # fmt: skip


def figures(image: Array, target: Array) -> dict[str, float]:
    """Compare luminances (H, W) within the picture: SSIM, L1 and contrast (standard deviation over mean).

    Also returns the target's `contrast`, and the share of the film's light that falls into the picture. The picture is
    the bounding rectangle of the target's nonzero pixels. Each image is divided by its mean within the picture.
    """
    inside = picture_within(target)
    seen, wanted = image[inside], target[inside]
    seen, wanted = seen / max(float(seen.mean()), 1e-30), wanted / wanted.mean()
    return {
        "ssim": similarity(seen, wanted),
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
    si, light, left, met = _ends(scene, plan, SHARE_RAYS)
    ds, importance = sensor.sample_direction(si, mi.Point2f(0.5), left)
    on_film = left & met & (dr.max(importance) > 0)
    inside = on_film & (ds.uv.x >= columns.start) & (ds.uv.x < columns.stop)
    inside &= (ds.uv.y >= rows.start) & (ds.uv.y < rows.stop)
    parts = {"inside": inside, "beside": on_film & ~inside, "beyond": left & ~on_film}
    totals = {name: float(dr.sum(dr.select(part, light, 0))[0]) for name, part in parts.items()}
    whole = sum(totals.values())
    return {name: total / max(whole, 1e-30) for name, total in totals.items()}


def _ends(
    scene: mi.Scene, plan: Fabrication, count: int, refracted: bool = False
) -> tuple[mi.SurfaceInteraction3f, mi.Float, mi.Bool, mi.Bool]:
    """Trace `count` rays from the lamps to the first surface beyond the solid. Return this surface, the light of each
    ray, the rays that left the solid by its front face, and the rays that met the receiver.

    The surface is invalid if the ray leaves the scene. With `refracted`, no ray is reflected in the glass.
    """
    shapes = {shape.id(): shape for shape in scene.shapes()}
    solid = [shapes[name] for name in (plan.face, "back") if name in shapes]
    sampler, ray, light = _from_lamps(scene, count)
    context, end = mi.BSDFContext(mi.TransportMode.Importance), dr.zeros(mi.SurfaceInteraction3f, count)
    left, active = dr.zeros(mi.Bool, count), light > 0
    dr.make_opaque(ray, light, left, active)  # so that each bounce launches one kernel
    for _ in range(BOUNCES):
        si = scene.ray_intersect(ray, active)
        again = active & si.is_valid() & is_one_of(si.shape, solid)
        end = dr.select(active & ~again, si, end)
        # The largest number below 1 chooses refraction.
        lobe = mi.Float(1 - 2**-24) if refracted else sampler.next_1d(again)
        bs, factor = si.bsdf(ray).sample(context, si, lobe, sampler.next_2d(again), again)
        towards = si.to_world(bs.wo)
        ray = dr.select(again, si.spawn_ray(towards), ray)
        light = dr.select(again, light * (mi.luminance(factor) if mi.is_rgb else dr.mean(factor)), light)
        outward = (si.shape == mi.ShapePtr(shapes[plan.face])) & (dr.dot(towards, si.n) * dr.sign(si.n.z) > 0)
        left, active = dr.select(again, outward, left), again & (light > 0)
        dr.eval(ray, light, active, left, end)
        if not dr.any(active):
            break
    return end, light, left & ~active, end.shape == mi.ShapePtr(shapes[plan.receiver])


def _from_lamps(scene: mi.Scene, count: int) -> tuple[mi.Sampler, mi.Ray3f, mi.Float]:
    """Return a sampler for `count` rays, rays from the lamps, and the light of each ray."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    ray, weight, _ = scene.sample_emitter_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True)
    return sampler, ray, brightness(weight, ray.wavelengths)


def shift_between(image: Array, reference: Array) -> Array:
    """Return the shift (rows, columns) of `image` relative to `reference`, to a tenth of a pixel."""
    from skimage.registration import phase_cross_correlation

    return -np.asarray(phase_cross_correlation(reference, image, upsample_factor=10)[0])


class OpticalBench:
    """Scene of a lens or mirror whose parts can be changed. `plan` describes the lens or mirror. `params` are the
    scene's parameters.
    """

    def __init__(
        self, scene: mi.Scene, params: mi.SceneParameters, plan: Fabrication, integrator: mi.Integrator, sensor: int
    ) -> None:
        self.scene, self.params, self.plan, self.sensor = scene, params, plan, sensor
        self._integrator = integrator
        self.lamps = [shape.id() for shape in scene.shapes() if shape.is_emitter()]
        self.camera = scene.sensors()[sensor].id()
        if f"{plan.receiver}.to_world" not in params.properties:
            raise ConfigError("", "fabrication.receiver", f"there is no `{plan.receiver}` in the scene with a to_world")

    def render(self, spp: int, seed: int = 0) -> Array:
        """Render the luminance (H, W)."""
        image = np.array(mi.render(self.scene, integrator=self._integrator, sensor=self.sensor, spp=spp, seed=seed))
        return luminance(image.reshape(*image.shape[:2], -1))

    @contextmanager
    def _changed(self, values: dict[str, Any]) -> Iterator[None]:
        before = {key: type(self.params[key])(self.params[key]) for key in values}
        try:
            for key, value in values.items():
                self.params[key] = value
            self.params.update()
            yield
        finally:
            for key, value in before.items():
                self.params[key] = value
            self.params.update()

    def moved(self, ids: Sequence[str], by: mi.ScalarTransform4f) -> dict[str, Any]:
        """Return the parameters of the objects with these ids, moved by `by`."""
        values: dict[str, Any] = {}
        for id in ids:
            if (key := f"{id}.vertex_positions") in self.params.properties and f"{id}.to_world" not in (
                self.params.properties
            ):
                points = np.array(self.params[key]).reshape(-1, 3)
                matrix = np.array(by.matrix)
                values[key] = mi.Float((points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32).ravel())
            elif (key := f"{id}.to_world") in self.params.properties:
                values[key] = type(self.params[key])(by.matrix) @ self.params[key]
        return values

    def turned(self, ids: Sequence[str], axis: Sequence[float], degrees: float) -> dict[str, Any]:
        """Return the parameters of the objects with these ids, rotated about an axis through the face's centre."""
        return self.moved(ids, mi.ScalarTransform4f().rotate(list(axis), degrees))

    def farther(self, part: float) -> dict[str, Any]:
        """Return the parameters of receiver and camera after a move away from the origin. The move is the fraction
        `part` of the receiver's distance.
        """
        key = f"{self.plan.receiver}.to_world"
        middle = np.ravel(self.params[key] @ mi.Point3f(0)).astype(float)
        way = mi.ScalarTransform4f().translate((part * middle).tolist())
        return self.moved([self.plan.receiver, self.camera], way)

    def denser(self, by: float) -> dict[str, Any]:
        """Return the refractive index of the glass, changed by `by`."""
        found = {}
        for key in self.params.properties:
            if key.endswith(".eta"):
                with suppress(TypeError, ValueError):
                    value = float(np.ravel(self.params[key])[0])
                    if abs(value - self.plan.index) < 1e-4:
                        found[key] = type(self.params[key])(value + by)
        return found

    def landings(self, values: dict[str, Any]) -> tuple[Array, Array]:
        """Return points (n, 3) where refracted light meets the receiver with these values, and a mask (n,) of hits."""
        with self._changed(values):
            si, light, left, met = _ends(self.scene, self.plan, RAYS, refracted=True)
            return np.array(si.p, dtype=float).reshape(3, -1).T, np.array(left & met & (light > 0))

    def spread(self, glass: Glass) -> float:
        """Return the mean distance in mm between the places where blue and red light of the same rays land."""
        lands = [self.landings(self.denser(by)) for by in glass.ends]
        both = lands[0][1] & lands[1][1]
        return float(np.linalg.norm((lands[0][0] - lands[1][0])[both], axis=1).mean()) if both.any() else 0.0

    def solid_parts(self) -> list[str]:
        """Return the ids of the face and of the flat back."""
        return [self.plan.face, "back"]

    def image(self, values: dict[str, Any], spp: int, seed: int = 0) -> Array:
        """Render the scene with these parameters."""
        with self._changed(values):
            return self.render(spp, seed)

    def sun(self, spp: int) -> Array:
        """Render light with the angular diameter `plan.sun` as the mean over several directions."""
        half, images = self.plan.sun / 2, []
        for i, (x, y) in enumerate(_DIRECTIONS):  # each has its own noise, so that it averages out
            angle = float(np.hypot(x, y))
            turned = {} if angle == 0 else self.turned(self.lamps, (x / angle, y / angle, 0), half * angle)
            images.append(self.image(turned, max(1, spp // len(_DIRECTIONS)), i))
        return np.asarray(np.mean(images, axis=0))


def tolerances(
    bench: OpticalBench,
    planned: Array,
    target: Array,
    spp: int,
    say: Callable[[str], None] = lambda _: None,
    keep: Callable[[str, Array], None] = lambda name, image: None,
) -> dict[str, dict[str, Any]]:
    """Return `figures` by name, for the image `planned` and for the image of each error. `target` (H, W) is the
    luminance for comparison.

    A rotation shifts the whole picture by `shift` (columns, rows) in pixels. The shift is removed before the
    comparison. `keep` receives the name and the luminance (H, W) of each image.
    """
    plan, both = bench.plan, bench.solid_parts()
    found: dict[str, dict[str, Any]] = {}

    def tell(name: str, image: Array, turned: bool = False) -> None:
        entry: dict[str, Any] = {}
        keep(name, image)
        if turned:
            rows, columns = (float(value) for value in shift_between(image, planned))
            image = scipy.ndimage.shift(image, (-rows, -columns), order=1)
            entry["shift"] = [columns + 0.0, rows + 0.0]  # no -0
        found[name] = figures(image, target) | {"spp": spp} | entry
        moved = f", shifted by {np.hypot(*entry['shift']):.2g} pixels" if turned else ""
        say(f"{name}: SSIM {found[name]['ssim']:.3f}, {100 * found[name]['inside']:.3g} % of the light inside{moved}")

    tell("as planned", planned)
    if not bench.lamps:
        say("the lamp is a point light: its width (fabrication.sun) and its rotations are left out")
    if plan.sun > 0 and bench.lamps:
        tell(f"light of {plan.sun:g} degrees", bench.sun(spp))
    for sign in (1, -1):
        tell(f"distance {sign * 100 * DISTANCE:+g} %", bench.image(bench.farther(sign * DISTANCE), spp))
    if plan.kind == "lens":
        for sign in (1, -1):
            tell(f"index {sign * INDEX:+g}", bench.image(bench.denser(sign * INDEX), spp))
        ends = () if plan.glass is None else plan.glass.ends
        for name, by in zip(("blue light (486 nm)", "red light (656 nm)"), ends, strict=False):
            tell(name, bench.image(bench.denser(by), spp))
    for what, ids in (("light", bench.lamps), (plan.kind, both)):
        for name, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0))):
            if ids:
                turned = bench.image(bench.turned(ids, axis, TURN), spp)
                tell(f"{what} turned by {TURN:g} degree about {name}", turned, turned=True)
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
        for name, image in (("ssim_of_picture", thrown), ("ssim_of_target", wanted)):
            numbers["thrown"][name] = figures(image, original)["ssim"]
    if {plan.face, plan.receiver} <= {shape.id() for shape in scene.shapes()}:
        numbers["light"] = where_light_goes(scene, scene.sensors()[sensor], plan, wanted)
        numbers["setup"] = setup_of(scene, scene.sensors()[sensor], plan, sheet, wanted)
    shown = wanted if original is None else original
    inside = picture_within(wanted)
    return {"picture": as_picture(shown, shown, inside), "caustic": as_picture(thrown, shown, inside)}


def add_tolerances(
    numbers: dict[str, Any],
    bench: OpticalBench,
    planned: Array,
    wanted: Array,
    spp: int,
    say: Callable[[str], None],
) -> dict[str, Array]:
    """Add measured tolerances and allowed errors to `numbers`. Returns the picture of each deviation by name."""
    original, inside = original_of(bench.plan, wanted), picture_within(wanted)
    shown = wanted if original is None else original
    pictures: dict[str, Array] = {}

    def keep(name: str, image: Array) -> None:
        pictures[name] = as_picture(image, shown, inside)

    found = tolerances(bench, planned, wanted, spp, say, keep)
    setup = numbers.get("setup")
    deviations = {"turn": TURN, "index": INDEX}
    if setup is not None:
        deviations["distance"] = DISTANCE * setup["receiver_distance"]
    numbers["tolerances"] = found
    if bench.plan.kind == "lens" and bench.plan.glass is not None:
        numbers["colour_spread"] = bench.spread(bench.plan.glass)
        say(f"colour: blue and red light land {numbers['colour_spread']:.2g} mm apart on average")
    numbers["allowed_errors"] = allowed_errors(found, bench.plan.kind, deviations)
    return pictures


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


# --- allowed errors ---------------------------------------------------------------------------------------------------


def allowed_errors(
    found: Mapping[str, Mapping[str, Any]], kind: str, deviations: Mapping[str, float]
) -> dict[str, dict[str, Any]]:
    """Return the deviation at which SSIM has fallen by `ALLOWED_LOSS`, for each measured kind of deviation.

    `found` holds the figures of each image, by image name, as returned by `tolerances`. `kind` is `lens` or `mirror`.
    `deviations` are the measured amounts: `distance` in mm, `index`, and `turn` in degrees. The result has the keys of
    `TOLERANCES`.

    Each entry has the `value`, its `unit` and the stated `tolerance`. `at_least` is true if SSIM falls by less than
    `ALLOWED_LOSS` even at the measured deviation. `passes` tells whether the tolerance is met. `passes` is None if the
    answer is unknown. The answer is unknown if the measured deviation is below the tolerance and SSIM falls by less
    than `ALLOWED_LOSS`.
    """
    planned = found.get("as planned")
    if planned is None:
        return {}
    kinds = {
        "distance": ("distance ", "mm", deviations.get("distance")),
        "light turned": ("light turned", "degrees", deviations["turn"]),
        "solid turned": (f"{kind} turned", "degrees", deviations["turn"]),
        "index": ("index ", "", deviations["index"]),
    }
    allowed = {}
    for name, (prefix, unit, deviation) in kinds.items():
        entries = [entry for key, entry in found.items() if key.startswith(prefix)]
        if entries and deviation:
            fall = max(planned["ssim"] - entry["ssim"] for entry in entries)
            value, tolerance = allowed_error(fall, deviation), TOLERANCES[name]
            at_least = fall < ALLOWED_LOSS
            passes = None if at_least and value < tolerance else value >= tolerance
            allowed[name] = {"value": value, "unit": unit, "tolerance": tolerance, "at_least": at_least,
                             "passes": passes}  # fmt: skip
    return allowed


def allowed_error(fall: float, deviation: float) -> float:
    """Return the deviation at which SSIM has fallen by `ALLOWED_LOSS`, at most `deviation`.

    The function assumes that SSIM falls linearly, and that SSIM has fallen by `fall` at `deviation`. Nothing larger was
    measured.
    """
    return deviation * min(1.0, ALLOWED_LOSS / fall) if fall > 0 else deviation


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
    kept = np.ravel(np.array((light > 0) & si.is_valid() & is_one_of(si.shape, solid))).astype(bool)
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
