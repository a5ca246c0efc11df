"""Second, independent computation of the densities whose ratios are the weights of paths from both sides.

Two walks record their vertices, and the weight that the kernel gave to each contribution. `Densities` uses these
vertices and the scene's own shapes and numbers. It computes how many paths of each kind would find the same path.

- H is a camera path that meets the light.
- N is a camera path whose last vertex samples the light.
- L is a light path that connects to the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.transport.camera import CameraHooks, film_ray
from reslrb_cli.transport.connection import connect
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.walk import Hooks

DEPTH = 6
#: `OFF` is the offset of rays from a surface, relative to its largest coordinate plus 1. Weights are compared for
#: segments longer than `STEADY` offsets at a right angle, and for cosines above `GRAZING`. Rounding affects all others.
OFF, STEADY, GRAZING = 1500 * 2**-24, 500, 0.01
WAYS = ("H", "N", "L")


# Notes of a walk. For each vertex, hooks scatter each component into a buffer of shape (lanes * DEPTH,).

#: Position, geometric normal, and directions of the incoming ray, the outgoing ray and the connection. For the latter
#: two: densities for camera paths (`f`) and light paths (`b`), and whether light paths take the direction. The flags of
#: the BSDF, and how far the scattering is from that of a plane mirror. For light: the emitter, the place and the
#: weight.
FIELDS = {"p": 3, "n": 3, "come": 3, "go": 3, "f": 1, "b": 1, "ok": 1, "to": 3, "to_f": 1, "to_b": 1, "to_ok": 1,
          "flags": 1, "mirror": 1, "N": 1, "N_id": 1, "N_p": 3, "N_n": 3, "N_uv": 2,
          "H": 1, "H_id": 1, "H_n": 3, "H_uv": 2, "L": 1}  # fmt: skip


class Notes:
    """Buffers for each field of a walk's vertices. The buffers also show which vertices exist."""

    def __init__(self, samples: Any) -> None:
        self.samples, self.lanes = samples, samples.width
        self.buffers = {
            (name, k): dr.full(mi.Float, -1 if name in WAYS else 0, self.lanes * DEPTH)
            for name, n in FIELDS.items()
            for k in range(n)
        }
        dr.make_opaque(self.buffers)

    def note(self, lane: Any, depth: Any, active: Any, **values: Any) -> None:
        for name, value in values.items():
            for k, one in enumerate([value] if FIELDS[name] == 1 else value):
                if dr.is_mask_v(one):
                    one = dr.select(one, mi.Float(1), 0)
                dr.scatter(self.buffers[name, k], mi.Float(one), lane * DEPTH + (depth - 1), active)

    def event(self, vertex: Any, wo: Any, camera: bool) -> tuple[Any, Any, Any]:
        """Return the densities of a local direction of this walk for camera paths and for light paths, and whether
        light paths take it. Light paths take the direction if the shading normal and the surface's own normal agree
        about the side of both directions at the vertex.
        """
        si, bsdf = vertex.si, vertex.bsdf
        turned = mi.SurfaceInteraction3f(si)
        turned.wi = wo
        here, there = (si, wo), (turned, si.wi)
        (f_si, f_wo), (b_si, b_wo) = (here, there) if camera else (there, here)
        f = bsdf.pdf(mi.BSDFContext(mi.TransportMode.Radiance), f_si, f_wo)
        b = bsdf.pdf(mi.BSDFContext(mi.TransportMode.Importance), b_si, b_wo)
        if self.samples.plan.needs.has_perturbed_normals:  # a fifth of light paths are cosine-distributed
            b = 0.8 * b + 0.2 * dr.select(si.wi.z * wo.z > 0, dr.abs(b_wo.z) / dr.pi, 0)
        side = dr.dot(si.n, si.sh_frame.n)
        ok = mi.Bool(True)
        for local in (si.wi, wo):
            ok &= dr.dot(si.n, si.to_world(local)) * side * local.z > 0
        return f, b, ok

    def scattered(self, lane: Any, vertex: Any, scattering: Any, camera: bool) -> None:
        si, wo = vertex.si, scattering.wo
        f, b, ok = self.event(vertex, wo, camera)
        mirror = dr.norm(wo - type(wo)(-si.wi.x, -si.wi.y, si.wi.z))
        self.note(lane, vertex.depth, vertex.active, p=si.p, n=si.n, come=vertex.ray.d, go=scattering.d, f=f, b=b,
                  ok=ok, flags=vertex.bsdf.flags(), mirror=mirror)  # fmt: skip

    def taken(self) -> dict[str, np.ndarray]:
        """Return the fields, with shape (lanes, DEPTH) or (lanes, DEPTH, n)."""
        dr.eval(self.buffers)
        found = {}
        for name, n in FIELDS.items():
            columns = [np.array(self.buffers[name, k], np.float64).reshape(-1, DEPTH) for k in range(n)]
            found[name] = columns[0] if n == 1 else np.stack(columns, -1)
        return found


def emitter_number(emitter: Any) -> int:
    """Return the number of one emitter."""
    return int(number(mi.EmitterPtr(emitter))[0])


def number(emitter: Any) -> Any:
    """Return the emitters' numbers in Dr.Jit's registry."""
    return dr.reinterpret_array(mi.UInt32, emitter)


class CameraNotes(CameraHooks, Notes):
    """Records of the vertices and light that camera paths meet."""

    def start(self, first: Any) -> Any:
        return dr.arange(mi.UInt32, self.lanes)

    def vertex(self, lane: Any, vertex: Any, met: Any, event: Any, scattering: Any) -> Any:
        self.scattered(lane, vertex, scattering, True)
        if met is not None:
            at = lane, vertex.depth, met.active & dr.any(met.Le > 0)
            self.note(*at, H=met.weight, H_id=number(met.emitter), H_n=met.si.n, H_uv=met.si.uv)
        if event is not None:
            ds, at = event.ds, (lane, vertex.depth, event.active)
            f, b, ok = self.event(vertex, event.wo, True)
            self.note(*at, to=ds.d, to_f=f, to_b=b, to_ok=ok, N=event.scale * ds.pdf, N_id=number(ds.emitter),
                      N_p=ds.p, N_n=ds.n, N_uv=ds.uv)  # fmt: skip
        return lane


class LightNotes(Hooks, Notes):
    """Records of the vertices that light paths meet."""

    def start(self, product: Any) -> Any:
        return dr.arange(mi.UInt32, self.lanes)

    def vertex(self, lane: Any, vertex: Any, connection: Any, scattering: Any, numbers: list[Any]) -> Any:
        s, si = self.samples, vertex.si
        alone = connect(replace(s.plan, paths="light"), s.sensor, si, vertex.ray, connection.sample, connection.active)
        f, b, ok = self.event(vertex, connection.wo, False)
        self.note(lane, vertex.depth, connection.active, L=connection.rest[0] / alone.rest[0],
                  to=si.to_world(connection.wo), to_f=f, to_b=b, to_ok=ok)  # fmt: skip
        self.scattered(lane, vertex, scattering, False)
        return lane


#: Wavelengths between which their density is interpolated. More would be too close to each other for single precision.
NODES = 2000


@dataclass
class Emission:
    """Rays that left emitters, with shape (lanes,) or (lanes, n). Each ray has its emitter's number, its origin with
    normal and texture coordinates, its direction, and its weight. `light` is the light of one channel along each
    ray, without the cosine at a lamp. In spectral variants, it is divided by the density of the ray's wavelength.
    """

    id: np.ndarray
    z: np.ndarray
    nz: np.ndarray
    uv: np.ndarray
    d: np.ndarray
    weight: np.ndarray
    light: np.ndarray

    @staticmethod
    def of(samples: Any) -> Emission:
        """Return the emitted rays of these light paths."""
        e, scene = sample_emission(samples, samples.sampler()), samples.scene
        ray, emitter = e.ray, e.emitter
        # The rays start slightly off the lamp, above the sampled point.
        above = scene.ray_intersect(mi.Ray3f(ray.o + 0.01 * ray.d, -ray.d))
        si = scene.ray_intersect(mi.Ray3f(ray.o + 0.01 * above.n, -above.n), above.is_valid())
        on_lamp = si.is_valid() & (si.t < 0.02) & (si.emitter(scene) == emitter)
        z, nz, uv = (dr.select(on_lamp, a, b) for a, b in ((si.p, ray.o), (si.n, 0), (si.uv, 0)))
        si.wi = dr.select(emitter.is_environment(), ray.d, si.to_local(ray.d))
        si.wavelengths = ray.wavelengths
        light = emitter.eval(si, on_lamp | emitter.is_environment())
        before = dr.zeros(mi.SurfaceInteraction3f, samples.width)
        before.p, before.wavelengths = ray.o + ray.d, ray.wavelengths
        delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)
        light += emitter.sample_direction(before, mi.Point2f(0.5), delta)[1]
        which, d = number(emitter) + dr.zeros(mi.UInt32, samples.width), dr.normalize(ray.d)
        values = which, z, nz, uv, d, e.E[0], light[0]
        dr.eval(values)
        result = Emission(*(np.array(value, np.float64).T for value in values))
        for each in scene.emitters() if mi.is_spectral else ():
            here = result.id == emitter_number(each)
            result.light[here] /= density_of_wavelengths(each, np.array(ray.wavelengths[0], np.float64)[here])
        return result


def density_of_wavelengths(emitter: Any, wavelengths: np.ndarray) -> np.ndarray:
    """Return the density with which the emitter's rays have these wavelengths: the inverse of the wavelength's
    derivative by the random number. Maps of the environment have the density of a white lamp.
    """
    if emitter.class_name() == "EnvironmentMapEmitter":
        return np.array(mi.pdf_rgb_spectrum(mi.Spectrum(mi.Float(wavelengths.astype(np.float32))))[0], np.float64)
    u = (np.arange(NODES) + 0.5) / NODES
    drawn, _ = emitter.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f, NODES), mi.Float(u.astype(np.float32)))
    drawn = np.array(drawn[0], np.float64)
    order = np.argsort(drawn)
    return np.interp(wavelengths, drawn[order], np.abs(np.gradient(u, drawn))[order])


# Paths, in order from the sensor to the light, and their densities.


@dataclass
class Paths:
    """Paths that one way has found, from the sensor on and without null events. Shapes are (P,) or (P, DEPTH), and
    `count` is the number of vertices.

    `x`, `n`, `f`, `b` and `ok` come from the walk's fields. `delta` shows whether a vertex is delta, and `come` is the
    direction of the segment before the vertex. The last segment ends at `z` on an emitter (number `id`, normal `nz`,
    coordinates `uv`). `d` is the direction of `z` from the last vertex.
    """

    way: str
    weight: np.ndarray
    count: np.ndarray
    x: np.ndarray
    n: np.ndarray
    f: np.ndarray
    b: np.ndarray
    ok: np.ndarray
    delta: np.ndarray
    come: np.ndarray
    id: np.ndarray
    z: np.ndarray
    nz: np.ndarray
    uv: np.ndarray
    d: np.ndarray

    def patterns(self) -> list[tuple[bool, ...]]:
        """Return which vertices of each path are delta."""
        return [tuple(bool(x) for x in row[:m]) for row, m in zip(self.delta, self.count, strict=True)]


def paths_of(way: str, notes: dict[str, np.ndarray], emission: Emission | None = None) -> Paths:
    """Return the paths that ended in the way `way`, from the notes of their walk."""
    lane, last = np.nonzero(notes[way] >= 0)
    index = np.arange(DEPTH)
    length = last if way == "H" else last + 1
    order = last[:, None] - index if way == "L" else np.broadcast_to(index, (len(lane), DEPTH))  # order in the walk
    at = lane[:, None], order.clip(0)
    own = {name: notes[name][at] for name in ("p", "n", "f", "b", "ok", "come", "go", "flags", "mirror")}
    ends = (order == last[:, None]) if way != "H" else np.zeros(order.shape, bool)
    for name in ("f", "b", "ok"):
        own[name] = np.where(ends, notes["to_" + name][lane, last][:, None], own[name])
    delta, null = singular(own)
    delta, null = delta & ~ends, null & ~ends
    there = index < length[:, None]
    keep = np.argsort(~(there & ~null), axis=1, kind="stable")
    count = (there & ~null).sum(1)
    x, n = (np.take_along_axis(own[name], keep[..., None], 1) for name in ("p", "n"))
    f, b, ok, delta = (np.take_along_axis(v, keep, 1) for v in (own["f"], own["b"], own["ok"], delta))
    come = np.take_along_axis(own["come"], keep[..., None], 1)
    if way == "L":
        assert emission is not None
        come = np.concatenate([-notes["to"][lane, last][:, None], -come[:, :-1]], 1)
        d = -emission.d[lane]
        ident, z, nz, uv = (values[lane] for values in (emission.id, emission.z, emission.nz, emission.uv))
    else:
        d = notes["to" if way == "N" else "come"][lane, last]
        ident, nz, uv = (notes[f"{way}_{name}"][lane, last] for name in ("id", "n", "uv"))
        z = notes["N_p" if way == "N" else "p"][lane, last]
    return Paths(way, notes[way][lane, last], count, x, n, f, b, ok > 0, delta, come, ident, z, nz, uv, d)


def singular(own: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return which events are delta, and which events pass straight through. The BSDF's flags and the resulting
    direction decide.
    """
    flags = own["flags"].astype(np.int64)
    straight = np.linalg.norm(own["go"] - own["come"], axis=-1) < 1e-4
    null = (flags & int(mi.BSDFFlags.Null) > 0) & straight
    can = flags & int(mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission) > 0
    must = flags & int(mi.BSDFFlags.Smooth) == 0
    return can & (must | (own["mirror"] < 1e-4)) & ~null, null


def length(v: np.ndarray) -> np.ndarray:
    return np.linalg.norm(v, axis=-1)


def cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs((a * b).sum(-1))


def brightness(texels: np.ndarray) -> np.ndarray:
    """Return the numbers (H, W) to which Mitsuba samples texels (H, W, 3) in proportion: the luminance of colours, or
    the mean of the spectra with these coefficients at 16 wavelengths.
    """
    if not mi.is_spectral:
        return texels @ np.array([0.212671, 0.715160, 0.072169])
    wavelengths = np.linspace(mi.MI_CIE_MIN, mi.MI_CIE_MAX, 16)
    v = (texels[..., :1] * wavelengths + texels[..., 1:2]) * wavelengths + texels[..., 2:]
    return np.asarray((0.5 + 0.5 * v / np.sqrt(1 + v**2)).mean(-1))


class Densities:
    """Number of paths of each kind that find a given path, for one scene, one sensor and given numbers of samples.
    `cutoff` and `fov` are the angles of the scene's spots and projectors, in degrees.
    """

    def __init__(self, samples: Any, camera: Any, cutoff: float, fov: float) -> None:
        self.cutoff, self.fov = np.radians(cutoff), np.radians(fov)
        self.samples, self.scene = samples, samples.scene
        sensor = samples.sensor
        crop = int(np.prod(sensor.film().crop_size()))
        # Number of all light paths, and number of camera paths in each pixel.
        self.light, self.camera = samples.width if samples is not camera else 0, camera.width / crop
        params = mi.traverse(sensor)
        to_world = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)
        self.axis = to_world[:3, 2] / length(to_world[:3, 2])
        self.origin = to_world[:3, 3]
        # Area of a pixel at a distance of 1: the film position moves the rays through the aperture's centre by this
        # area.
        rays = sensor.sample_ray(0, 0.5, mi.Point2f([0.2, 0.7, 0.2], [0.3, 0.3, 0.9]), mi.Point2f(0.5), True)[0]
        d = np.array(rays.d, np.float64).T
        there = d / (d @ self.axis)[:, None]
        edges = (there[1:] - there[0]) / (np.array([0.5, 0.6]) * np.array(sensor.film().crop_size()))[:, None]
        self.pixel = length(np.cross(*edges))
        size = np.array(sensor.film().crop_size(), np.int64)
        self.size, self.corner = size, there[0] - edges.T @ (np.array([0.2, 0.3]) * size)
        self.edges = edges
        self.counts = None
        if camera.shares is not None:  # counts of drawn samples
            with dr.suspend_grad():
                drawn = np.floor(np.array(film_ray(camera, camera.sampler()).u)).astype(int)
            self.counts = np.bincount(drawn[1] * size[0] + drawn[0], minlength=crop)
        sphere = self.scene.bbox().bounding_sphere()
        self.disk = 1 / (np.pi * float(sphere.radius) ** 2)
        weights = np.array([float(np.ravel(e.sampling_weight())[0]) for e in self.scene.emitters()])
        self.choice = weights / weights.sum()

    def of(self, paths: Paths) -> dict[str, np.ndarray]:
        """Return H, N and L of each path with more than 0 vertices, and `fit`. `fit` is true if rounding does not
        affect the path's weight.
        """
        rows, last = np.arange(len(paths.count)), paths.count - 1
        x_m, n_m = paths.x[rows, last], paths.n[rows, last]
        # Paths start on the aperture, which is the plane through the sensor's origin.
        x_1, cos, cos_axis = paths.x[:, 0], cosine(paths.n[:, 0], paths.come[:, 0]), paths.come[:, 0] @ self.axis
        d = (x_1 - self.origin) @ self.axis / cos_axis
        begun = cos / d**2 / (self.pixel * cos_axis**3)
        least = STEADY * OFF * (1 + np.abs(paths.x).max(initial=0))
        fit = d * cos > least
        camera = self.camera
        if self.counts is not None:
            # Place of a direction on the film: the direction meets the plane that `edges` span at a distance of 1.
            there = (x_1 - self.origin) / d[:, None] / cos_axis[:, None] - self.corner
            u = np.linalg.lstsq(self.edges.T, there.T, rcond=None)[0].T
            inside = np.all((u >= 0) & (u < self.size), axis=1)
            pixel = np.clip(np.floor(u).astype(int), 0, self.size - 1)
            camera = self.counts[pixel[:, 1] * self.size[0] + pixel[:, 0]]
            fit &= inside & np.all(np.abs(u - np.rint(u)) > 1e-3, axis=1)
        from_camera, from_light, sides = camera * begun, np.full(len(rows), float(self.light)), paths.ok[:, 0]
        for i in range(1, DEPTH):
            here = i < paths.count
            d = np.where(here, length(paths.x[:, i] - paths.x[:, i - 1]), 1)
            cos, cos_before = (cosine(paths.n[:, k], paths.come[:, i]) for k in (i, i - 1))
            f = np.where(paths.delta[:, i - 1], 1, paths.f[:, i - 1])
            b = np.where(paths.delta[:, i], 1, paths.b[:, i])
            from_camera = np.where(here, from_camera * f * cos / d**2, from_camera)
            from_light = np.where(here, from_light * b * cos_before / d**2, from_light)
            sides = np.where(here, sides & paths.ok[:, i], sides)
            fit &= ~here | (d * np.minimum(cos, cos_before) > least)
        end = self.ends(paths, x_m, paths.d)
        cos = cosine(n_m, paths.d)
        f = np.where(paths.delta[rows, last], 1, paths.f[rows, last])
        fit &= (end["near"] * np.minimum(cos, end["cos"]) > least) & (cos > GRAZING)
        return {
            "H": from_camera * f * end["met"],
            "N": from_camera * end["sampled"] * ~paths.delta[rows, last],
            "L": from_light * end["sent"] * cos * sides * ~paths.delta[:, 0],
            "fit": fit,
        }

    def ends(self, light: Paths | Emission, x: np.ndarray, d: np.ndarray) -> dict[str, np.ndarray]:
        """Return quantities of the light's end, for vertices `x` from which the light lies in the direction `d`.

        - `met` converts a density of directions to the measure of the other densities. That measure is area on lamps,
            solid angle for surrounding emitters, or points.
        - `sampled` is the density of next-event estimation.
        - `sent` is the density of the emitted rays, converted to `x` without the cosine at `x`.
        """
        z = np.zeros(len(x))
        result = {"met": z, "sampled": z, "sent": z, "near": z + 1e9, "cos": z + 1}
        for k, emitter in enumerate(self.scene.emitters()):
            here = light.id == emitter_number(emitter)
            if here.any():
                own = self.end(emitter, light.z[here], light.nz[here], light.uv[here], d[here], x[here])
                for name, value in own.items():
                    scale = self.choice[k] if name in ("sampled", "sent") else 1
                    result[name] = result[name].copy()
                    result[name][here] = value * scale
        return result

    def end(
        self, emitter: Any, z: np.ndarray, nz: np.ndarray, uv: np.ndarray, d: np.ndarray, x: np.ndarray
    ) -> dict[str, Any]:
        """Return the quantities of `ends` for one emitter, without the probability of choosing the emitter."""
        kind, far = emitter.class_name(), length(z - x)
        if kind == "ConstantBackgroundEmitter":
            return {"met": 1, "sampled": 1 / (4 * np.pi), "sent": self.disk / (4 * np.pi)}
        if kind in ("EnvironmentMapEmitter", "SunskyEmitter"):
            ds = dr.zeros(mi.DirectionSample3f)
            ds.d = mi.Vector3f(d.T.astype(np.float32))
            p = np.array(emitter.pdf_direction(dr.zeros(mi.Interaction3f), ds, True), np.float64)
            evened = 0.9 * p + 0.1 / (4 * np.pi) if self.samples.plan.differentiate_emission and kind[0] == "E" else p
            return {"met": 1, "sampled": p, "sent": evened * self.disk}
        if kind == "DirectionalEmitter":
            return {"met": 0, "sampled": 1, "sent": self.disk}
        params = mi.traverse(emitter)
        if kind == "DirectionalArea":
            return {"met": 0, "sampled": 0, "sent": 1}
        if kind != "AreaLight":
            return {"met": 0, "sampled": 1, "near": far, "sent": self.beam(emitter, kind, -d) / far**2}
        shape, cos = emitter.get_shape(), cosine(nz, d)
        area = float(np.ravel(shape.surface_area())[0])  # for textured lamps, area per unit of texture coordinates
        own = sampled = np.ones(len(x))
        if "radiance.data" in params:  # sampled over equal-area texels
            texels = brightness(np.array(params["radiance.data"], np.float64))
            rows, columns = texels.shape
            row, column = ((uv[:, k] * n).astype(int).clip(0, n - 1) for k, n in ((1, rows), (0, columns)))
            sampled = own = texels[row, column] / texels.mean()
            if self.samples.plan.evened_lamps:
                own = 0.9 * own + 0.1
            stretch = {"Sphere": np.pi / 2 * np.sin(np.pi * uv[:, 1]), "Disk": 2 * uv[:, 0]}
            area = np.maximum(area * stretch.get(shape.class_name(), np.ones(len(x))), 1e-9)
        elif shape.class_name() == "Sphere":  # the cone around the sphere
            ball = shape.bbox()
            center, r = np.array(ball.center(), np.float64).ravel(), float(ball.extents().x) / 2
            outside = length(x - center)
            cone = 2 * np.pi * (1 - np.sqrt(1 - (r / np.maximum(outside, r)) ** 2))
            sampled = np.where(outside > r * 1.001, cos / far**2 / np.maximum(cone, 1e-9) * area, 1)
        sent = own / area * cos / np.pi / far**2
        return {"met": cos / far**2, "sampled": sampled / area, "sent": sent, "near": far, "cos": cos}

    def beam(self, emitter: Any, kind: str, d: np.ndarray) -> Any:
        """Return the density of ray directions for a light at a point."""
        params = mi.traverse(emitter)
        if kind == "PointLight":
            return 1 / (4 * np.pi)
        if kind == "SpotLight":
            return 1 / (2 * np.pi * (1 - np.cos(self.cutoff)))
        frame = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)[:3, :3]
        frame = frame / length(frame.T)
        cos = d @ frame[:, 2]
        half, picture = np.tan(self.fov / 2), brightness(np.array(params["irradiance.data"], np.float64))
        rows, columns = picture.shape
        column = ((d @ frame[:, 0]) / cos / half * -0.5 + 0.5) * columns
        row = ((d @ frame[:, 1]) / cos / (half * rows / columns) * -0.5 + 0.5) * rows
        there = picture[row.astype(int).clip(0, rows - 1), column.astype(int).clip(0, columns - 1)]
        return there / picture.mean() / (4 * half**2 * rows / columns * cos**3)
