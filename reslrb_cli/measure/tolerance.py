"""Images of a finished lens or mirror: where the light goes, and how errors of light, position or glass change the
images.

For each error, a stock integrator of Mitsuba renders the scene with the changed part. If a rotation shifts the whole
picture, the shift is reported, and removed before images are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.ndimage

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.errors import ConfigError
from reslrb_cli.lens.solid import Array
from reslrb_cli.records.images import luminance

#: Assumed errors of the distance, of the index, and of rotations in degrees.
DISTANCE, INDEX, TURN = 0.02, 0.005, 1.0

#: Rays for the shares of lost light, which are 0.1 % to 5 %, and the maximum number of faces that each ray meets.
RAYS, BOUNCES = 2**19, 8

#: Directions within a light as wide as the sun, in units of its radius: the centre, and six on a circle with the mean
#: squared distance of an even disc (one half).
_DIRECTIONS = [(0.0, 0.0), *((np.cos(a) * (7 / 12) ** 0.5, np.sin(a) * (7 / 12) ** 0.5)
                             for a in np.arange(6) * np.pi / 3)]  # fmt: skip


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

    `beyond` is light that lands elsewhere on the receiver, or misses the receiver. The shares are estimated with `RAYS`
    rays from the lamps. Mitsuba samples the BSDFs, and reflections in the glass are included. The picture consists of
    the nonzero pixels of the luminance `target` (H, W). Light reflected back to the lamp, and light past the lens, do
    not count. If no light leaves the lens, all shares are 0.
    """
    rows, columns = picture_within(target)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    front, receiver = mi.ShapePtr(shapes[plan.face]), mi.ShapePtr(shapes[plan.receiver])
    solid = [mi.ShapePtr(shape) for name, shape in shapes.items() if name in (plan.face, "back")]
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, RAYS)
    ray, weight, _ = scene.sample_emitter_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True)
    light = mi.Float(mi.luminance(weight) if mi.is_rgb else weight.x)
    context = mi.BSDFContext(mi.TransportMode.Importance)
    left, active = dr.zeros(mi.Bool, RAYS), light > 0
    dr.make_opaque(ray, light, left, active)  # so that each rotation launches one kernel
    totals = dict.fromkeys(("inside", "beside", "beyond"), 0.0)
    for _ in range(BOUNCES):
        si = scene.ray_intersect(ray, active)
        again = active & si.is_valid() & _any_of(si.shape, solid)
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


def _any_of(shape: mi.ShapePtr, others: Sequence[mi.ShapePtr]) -> mi.Bool:
    found = mi.Bool(False)
    for other in others:
        found = found | (shape == other)
    return found


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
                    if abs(value - self.plan.ior) < 1e-4:
                        found[key] = type(self.params[key])(value + by)
        return found

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
    original: Array | None = None,
    keep: Callable[[str, Array], None] = lambda name, image: None,
) -> dict[str, dict[str, Any]]:
    """Return `figures` by name, for the image `planned` and for the image of each error. `target` (H, W) is the
    luminance for comparison.

    A rotation shifts the whole picture by `shift` (columns, rows) in pixels. The shift is removed before the
    comparison. `original` (H, W) is the picture before its dark parts were raised. If `original` is given,
    `ssim_of_picture` is the SSIM of the image and `original`. `keep` receives the name and the luminance (H, W) of each
    image.
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
        if original is not None:
            entry["ssim_of_picture"] = figures(image, original)["ssim"]
        found[name] = figures(image, target) | {"spp": spp} | entry
        moved = f", shifted by {np.hypot(*entry['shift']):.2g} pixels" if turned else ""
        say(f"{name}: SSIM {found[name]['ssim']:.3f}, {100 * found[name]['inside']:.3g} % of the light inside{moved}")

    tell("as planned", planned)
    if plan.sun > 0 and bench.lamps:
        tell(f"light of {plan.sun:g} degrees", bench.sun(spp))
    for sign in (1, -1):
        tell(f"distance {sign * 100 * DISTANCE:+g} %", bench.image(bench.farther(sign * DISTANCE), spp))
    if plan.kind == "lens":
        for sign in (1, -1):
            tell(f"index {sign * INDEX:+g}", bench.image(bench.denser(sign * INDEX), spp))
    for what, ids in (("light", bench.lamps), (plan.kind, both)):
        for name, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0))):
            if ids:
                turned = bench.image(bench.turned(ids, axis, TURN), spp)
                tell(f"{what} turned by {TURN:g} degree about {name}", turned, turned=True)
    return found
