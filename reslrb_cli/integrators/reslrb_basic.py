"""Reservoir light replay backpropagation in one file: the detached method of the ResLRB paper and nothing else.

`ReslrbBasic` is the plugin `reslrb_basic`, and is to `reslrb` what Mitsuba's `prb_basic` is to `prb`. Read `primal` and
`adjoint` beside Section 2 and Figure 4 of the paper. Symbols of the paper:

    x_i         vertex of the light path, i >= 1
    C_i, u_i    flux of the connection of x_i to the sensor, and its film position
    w_i, W      weight of this connection, luminance(C_i), and the sum of the weights
    I           index of the kept connection, or 0 if no connection contributes
    f_s         BSDF times cosine
    δ           derivative of the loss with respect to the image at u_I, through the pixel filter (`delta_L`)

The paper writes f_i for a splat through the pixel filter. Symbols that it does not have:

    E           emitted radiance times cosine, divided by the density of the sampled ray
    β           throughput, E times the weights of the BSDF samples at x_1 ... x_{i-1}
    A           δ C_I W / w_I, constant during the replay

Figure 4 differs from this file as follows.

- It stops a path whose connection is not kept, because `trace(v)` belongs to the `if`. Here every path continues.
- Its `adjoint` has `trace(v)` behind the loop. It belongs into the loop.
- Its `adjoint` lacks the factor W / w_I of Equation 3. Its `primal` returns neither this factor nor C_I.
- It does not say that f_s is evaluated towards the sensor at x_I, nor that the emitter's E has a derivative.
- It splats the kept connection only. Here the image has all connections. They need no graph, and have less noise.
- It has `max_depth` vertices. Here `max_depth` counts segments, as in Mitsuba: there are `max_depth` - 1 vertices.
- It leaves out the light of emitters in view. `visible_emitters` adds it.

Limits: no Russian roulette, no forward mode, and one pass. Where a factor is 0, as in a black channel, C_I / f_s is
not defined, and its derivative is silently 0. `reslrb` has none of these limits.
"""

# ruff: noqa: E741 (the paper calls the index I)
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.transport.film import AdjointImage, Colours, Film

#: The variant of this module's classes. `plugin.py` loads the module again for another variant.
VARIANT = mi.variant()
#: Context of BSDFs in light tracing. BSDFs of refraction and of shading normals are not symmetric.
IMPORTANCE = mi.BSDFContext(mi.TransportMode.Importance)
#: The values of a path are the channels of the film: there are no wavelengths.
CHANNELS = Colours(mi.Color0f(), [])


class ReslrbBasic(mi.ad.integrators.common.ADIntegrator):
    """Light tracer with a reservoir of one connection. Options: `max_depth` (6) and `hide_emitters` (false)."""

    def render(self, scene: mi.Scene, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0, spp: int = 0,
               develop: bool = True, evaluate: bool = True) -> mi.TensorXf:  # fmt: skip
        """Return the image (H, W, C). Raises UnsupportedScene."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        check(scene, sensor)
        with dr.suspend_grad():
            sampler, _ = self.prepare(sensor, seed, spp)
            film = Film(sensor)
            self.primal(scene, sensor, sampler, film, block := film.block())
            image = film.develop(block)
            if evaluate:
                dr.eval(image)
            return image

    def render_backward(self, scene: mi.Scene, params: Any, grad_in: mi.TensorXf, sensor: mi.Sensor | int = 0,
                        seed: mi.UInt32 | int = 0, spp: int = 0) -> None:  # fmt: skip
        """Add the gradient for dL/dI = `grad_in` (H, W, C) to the scene's parameters. Raises UnsupportedScene."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        check(scene, sensor)
        with dr.suspend_grad():
            film = Film(sensor)
            adjoint_image = film.adjoint(grad_in)
            sampler, _ = self.prepare(sensor, seed, spp)
            replay_sampler = sampler.clone()  # the same random numbers again: PRNG replay, Section 2.4
            I, u, A = self.primal(scene, sensor, sampler, film)
            A *= adjoint_image.lookup(u, I > 0, CHANNELS)
            # One traversal of the graph beyond the scene's parameters, after all local ones have reached them.
            with dr.isolate_grad():
                self.adjoint(scene, sensor, replay_sampler, adjoint_image, I, A)

    def render_forward(self, scene: mi.Scene, params: Any, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0,
                       spp: int = 0) -> mi.TensorXf:  # fmt: skip
        """Raise UnsupportedScene: the replay has no forward mode."""
        raise UnsupportedScene("reslrb_basic has no forward mode; use reslrb")

    @dr.syntax
    def primal(
        self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, film: Film, block: mi.ImageBlock | None = None
    ) -> tuple[mi.UInt32, mi.Point2f, mi.Spectrum]:
        """Trace one light path per lane, keep one of its connections, and splat all of them if there is a `block`.

        Returns I, u_I (pixels, relative to the crop window) and C_I W / w_I (C,), in units of the image.
        """
        per_path = int(dr.prod(film.size)) / sampler.wavefront_size()  # pixels per light path
        u, Le, valid = self.visible_emitters(scene, sensor, sampler)
        ray, β = sample_emitter_ray(scene, sensor, sampler)
        if block is not None:
            film.put(block, u, Le * per_path, valid, CHANNELS)

        depth = mi.UInt32(1)  # i, the index of the vertex. The path to the sensor has i + 1 segments
        active = mi.Bool(depth < self.max_depth) & dr.any(β != 0)
        I, u, C, w, W = mi.UInt32(0), mi.Point2f(0), mi.Spectrum(0), mi.Float(0), mi.Float(0)  # empty_reservoir()
        while dr.hint(active, label="light path, primal"):
            si = scene.ray_intersect(ray, active)
            active &= si.is_valid()

            # ---- Connect to the sensor: C_i and its weight, Section 2.2 ----
            ds, wo, importance = connect_to_sensor(sensor, sampler, si, ray, active)
            visible = active & (ds.pdf > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p), active)
            C_i = dr.select(visible, β * importance * si.bsdf(ray).eval(IMPORTANCE, si, wo, visible), 0)
            w_i = dr.abs(mi.luminance(C_i) if dr.hint(mi.is_rgb, mode="scalar") else C_i[0])
            if dr.hint(block is not None, mode="scalar"):
                film.put(block, ds.uv, C_i * per_path, visible, CHANNELS)

            # ---- Keep it with probability w_i / W. In the end Pr(I = i) = w_i / W_k, Equation 2 ----
            W += w_i
            kept = sampler.next_1d(active) * W < w_i
            I = dr.select(kept, depth, I)
            u = dr.select(kept, ds.uv, u)
            C = dr.select(kept, C_i, C)
            w = dr.select(kept, w_i, w)

            # ---- Continue, whether the connection was kept or not (in Figure 4, only if it was) ----
            _, weight, ray = sample_bsdf(sampler, si, ray, active)
            β *= weight
            depth += 1
            active &= (depth < self.max_depth) & dr.any(β != 0)

        # Equation 3. It is 0 for a path without connections, whose W / w_I would be 0 / 0.
        return I, u, C * dr.select(I > 0, W / w, 0) * per_path

    @dr.syntax
    def adjoint(
        self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, adjoint_image: AdjointImage, I: mi.UInt32,
        A: mi.Spectrum,
    ) -> None:  # fmt: skip
        """Replay the paths up to x_I, and add the derivative of each of their factors to the scene's parameters.

        `sampler` has the state with which `primal` began, and A (C,) is δ C_I W / w_I. By ∇f = f ∇log f (Section 2.4),
        one path contributes

            A [∇E / E + sum_{i<=I} ∇f_s(x_i) / f_s(x_i)],    with one AD scope for each term.

        Averaged over I, this is the gradient of all connections (Equations 1, 4 and 5).
        """
        with dr.resume_grad():
            u, Le, valid = self.visible_emitters(scene, sensor, sampler)
            per_path = int(dr.prod(adjoint_image.film.size)) / sampler.wavefront_size()
            backward(Le, dr.detach(adjoint_image.lookup(u, valid, CHANNELS)) * per_path)
            ray, E = sample_emitter_ray(scene, sensor, sampler)
            backward(E, dr.select(E != 0, A / dr.detach(E), 0))
        ray = dr.detach(ray)

        depth, active = mi.UInt32(1), mi.Bool(I > 0)
        while dr.hint(active, label="light path, adjoint"):
            # ---- Replay: the calls of `primal` in the same order, with the same random numbers ----
            si = scene.ray_intersect(ray, active)  # valid, because x_I was
            bsdf = si.bsdf(ray)
            _, to_sensor, _ = connect_to_sensor(sensor, sampler, si, ray, active)
            sampler.next_1d(active)  # consume_reservoir_rng()
            to_next, _, ray = sample_bsdf(sampler, si, ray, active)

            # ---- Local AD scope: f_s towards the next vertex, or at x_I towards the sensor ----
            with dr.resume_grad():
                f_s = bsdf.eval(IMPORTANCE, si, dr.select(depth == I, to_sensor, to_next), active)
                backward(f_s, dr.select(f_s != 0, A / dr.detach(f_s), 0))

            depth += 1  # in the loop (in Figure 4, `trace(v)` stands behind it)
            active &= depth <= I

    def visible_emitters(
        self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler
    ) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
        """Return film positions, radiance (C,) of emitters in view, and which lanes' primary rays meet a surface."""
        time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
        position = sampler.next_2d()
        ray, weight = sensor.sample_ray(time, sampler.next_1d(), position, sampler.next_2d())
        with dr.suspend_grad():
            si = scene.ray_intersect(ray)
        valid = si.is_valid() & (not self.hide_emitters and self.max_depth > 0)
        return position * mi.Vector2f(sensor.film().crop_size()), weight * si.emitter(scene).eval(si, valid), valid


def sample_emitter_ray(scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler) -> tuple[mi.Ray3f, mi.Spectrum]:
    """Sample a ray from a random emitter. Returns the ray and E (C,)."""
    time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
    ray, E, _ = scene.sample_emitter_ray(time, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True)
    return ray, E


def connect_to_sensor(
    sensor: mi.Sensor, sampler: mi.Sampler, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Vector3f, mi.Spectrum]:
    """Sample a point of the sensor. Returns the sample, its local direction, and importance times geometry (C,)."""
    ds, importance = sensor.sample_direction(si, sampler.next_2d(active), active)
    wo = si.to_local(ds.d)
    return ds, wo, importance * shading_correction(si, ray, wo)


def sample_bsdf(
    sampler: mi.Sampler, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Ray3f]:
    """Sample the BSDF. Returns the local direction, the weight of the sample (C,) and the next ray."""
    sample, weight = si.bsdf(ray).sample(IMPORTANCE, si, sampler.next_1d(active), sampler.next_2d(active), active)
    weight *= shading_correction(si, ray, sample.wo)
    return sample.wo, weight, si.spawn_ray(si.to_world(sample.wo))


def shading_correction(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, wo: mi.Vector3f) -> mi.Float:
    """Return Veach's factor for shading normals (thesis, p. 155), or 0 where they and the surface contradict."""
    wi_n, wo_n = dr.dot(si.n, -ray.d), dr.dot(si.n, si.to_world(wo))
    cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
    valid = (wi_n * cos_i > 0) & (wo_n * cos_o > 0)
    return dr.select(valid, dr.abs((cos_i * wo_n) / (cos_o * wi_n)), 0)


def backward(f: mi.Spectrum, adjoint: mi.Spectrum) -> None:
    """Add the derivatives of f (C,) times `adjoint` (C,) to the gradients of the scene's parameters, if it has any."""
    dr.backward_from(dr.dot(adjoint, f), flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)


def check(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Raise UnsupportedScene if the image, or the derivative of a differentiated parameter, would be wrong."""

    def refuse(reason: str) -> None:
        raise UnsupportedScene(f"{reason}; use reslrb")

    if mi.is_spectral or mi.is_polarized:
        refuse("reslrb_basic needs an RGB or mono variant")
    if sensor.class_name() not in ("PerspectiveCamera", "ThinLensCamera"):
        refuse(f"reslrb_basic supports perspective and thinlens, not sensor {sensor.id()}")
    for emitter in scene.emitters():
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite | mi.EmitterFlags.DeltaDirection):
            refuse(f"reslrb_basic supports area and point lamps, not {emitter.id()}")
    for shape in scene.shapes():
        if shape.is_medium_transition() or shape.class_name() == "Instance":
            refuse(f"reslrb_basic supports neither participating media nor instances, as in shape {shape.id()}")
    params = mi.traverse(scene)
    for key, (_, _, node, *_) in params.properties.items():
        if dr.grad_enabled(params[key]) and not isinstance(node, (mi.BSDF, mi.Texture)):
            refuse(f"{key}: reslrb_basic has derivatives of BSDFs and of emission only")
    for bsdf in (node for node in params.hierarchy if isinstance(node, mi.BSDF)):
        if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null):
            refuse(f"bsdf {bsdf.id()} is transparent to shadow rays")
        if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) and dr.grad_enabled([own for _, own in mi.traverse(bsdf)]):
            refuse(f"reslrb_basic has no derivatives of smooth specular BSDFs such as {bsdf.id()}")
