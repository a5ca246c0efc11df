"""Reservoir light replay backpropagation in one file: the detached method of the ResLRB paper and nothing else.

`ReslrbBasic` is the plugin `reslrb_basic`, and is to `reslrb` what Mitsuba's `prb_basic` is to `prb`. Read `primal` and
`adjoint` beside Figure 4 of the paper. The symbols are those of Section 2:

    C_i = E s_1 ... s_{i-1} c_i     flux of the connection of vertex x_i to the sensor, i >= 1, at film position u_i
    w_i, W                          weight of a connection, luminance(C_i), and the sum of the weights
    I                               index of the kept connection
    δ                               dL/dI at u_I, looked up through the pixel filter

E is the emitted radiance divided by the density of the sampled ray. s_j = f_j / pdf is a scattering weight, and
c_i = f_i * (importance of the sensor, geometry, visibility) is a connection. f is bsdf * cos.

Four details differ from Figure 4.

- The figure traces the next vertex only if the reservoir keeps the connection. The path continues in any case.
- The figure's adjoint ends with the next vertex, behind the loop. It belongs into the loop.
- The figure's adjoint multiplies by C_I alone. The factor W / w_I of Equation 3 belongs to the gradient as well. At
  x_I, f is the BSDF towards the sensor, and the emitter contributes dE/E.
- The figure splats only the kept connection. Here the image contains all connections: it needs no graph, so this costs
  no memory, and has less noise.

Limits: no Russian roulette, no forward mode, one pass, and no derivative where a factor is zero, because C_I / f is
then not defined. `reslrb` has none of these limits. Unsupported scenes and parameters raise UnsupportedScene.
"""

# ruff: noqa: E741 (the paper calls the index I)
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.transport.film import Film

#: The variant of this module's classes. `plugin.py` loads the module again for another variant.
VARIANT = mi.variant()


class ReslrbBasic(mi.ad.integrators.common.ADIntegrator):
    """Light tracer with a reservoir of one connection. Options: `max_depth` (6) and `hide_emitters` (false)."""

    def render(self, scene: mi.Scene, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0, spp: int = 0,
               develop: bool = True, evaluate: bool = True) -> mi.TensorXf:  # fmt: skip
        """Return the image (H, W, C). Raises UnsupportedScene."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        check_scene(scene, sensor)
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
        check_scene(scene, sensor)
        check_parameters(params if isinstance(params, mi.SceneParameters) else mi.traverse(scene))
        with dr.suspend_grad():
            film = Film(sensor)
            δL = film.adjoint(grad_in)
            sampler, _ = self.prepare(sensor, seed, spp)
            replayed = sampler.clone()  # the same random numbers again: PRNG replay, Section 2.4
            I, u, A = self.primal(scene, sensor, sampler, film)
            # δ C_I W / w_I, the constant of the whole replay: Equation 3, and the adjoint of the splat f_I.
            A *= δL.lookup(u, I > 0, film.colours(mi.Color0f()))
            self.adjoint(scene, sensor, replayed, film, δL, I, A)

    def render_forward(self, scene: mi.Scene, params: Any, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0,
                       spp: int = 0) -> mi.TensorXf:  # fmt: skip
        """Raise UnsupportedScene: the replay has no forward mode."""
        raise UnsupportedScene("reslrb_basic has no forward mode; use reslrb")

    @dr.syntax
    def primal(
        self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, film: Film, block: mi.ImageBlock | None = None
    ) -> tuple[mi.UInt32, mi.Point2f, mi.Spectrum]:
        """Trace one light path per lane, keep one of its connections, and splat all of them if there is a `block`.

        Returns I (0 if no connection contributes), u_I (pixels, relative to the crop window) and C_I W / w_I (C,).
        """
        scale = int(dr.prod(film.size)) / sampler.wavefront_size()  # light paths per pixel
        u, Le, visible = self.look(scene, sensor, sampler)
        ray, β = emit(scene, sensor, sampler)
        splat(film, block, u, Le * scale, visible)

        depth = mi.UInt32(1)  # i, the index of the vertex; `max_depth` counts segments, and x_i needs i + 1
        active = mi.Bool(depth < self.max_depth) & dr.any(β != 0)
        I, u, C, w, W = mi.UInt32(0), mi.Point2f(0), mi.Spectrum(0), mi.Float(0), mi.Float(0)  # empty_reservoir()
        while dr.hint(active, label="light path, primal"):
            si = scene.ray_intersect(ray, active)
            active &= si.is_valid()

            # ---- Connect to the sensor: C_i and its weight, Section 2.2 ----
            ds, wo, rest = connect(sensor, sampler, si, ray, active)
            visible = active & (ds.pdf > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p), active)
            C_i = dr.select(visible, β * rest * si.bsdf(ray).eval(IMPORTANCE, si, wo, visible), 0)
            splat(film, block, ds.uv, C_i * scale, visible)
            w_i = mi.luminance(C_i) if dr.hint(mi.is_rgb, mode="scalar") else C_i[0]

            # ---- Keep it with probability w_i / W. In the end Pr(I = i) = w_i / W_k, Equation 2 ----
            W += w_i
            kept = sampler.next_1d(active) * W < w_i
            I, u, C, w = (dr.select(kept, *each) for each in ((depth, I), (ds.uv, u), (C_i, C), (w_i, w)))

            # ---- Continue, whether the connection was kept or not (in Figure 4, only if it was) ----
            _, s, ray = scatter(sampler, si, ray, active)
            β *= s
            depth += 1
            active &= (depth < self.max_depth) & dr.any(β != 0)

        # Equation 3, also for a path without connections, whose W / w_I would be 0 / 0.
        return I, u, C * dr.select(I > 0, W / w, 0) * scale

    @dr.syntax
    def adjoint(
        self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler, film: Film, δL: Any, I: mi.UInt32, A: mi.Spectrum
    ) -> None:
        """Replay the paths up to x_I, and add the derivative of each of their factors to the scene's parameters.

        `sampler` has the state with which `primal` began, `δL` is the adjoint image, and A (C,) is δ C_I W / w_I. The
        expectation over I is the gradient of all connections (Equations 4 and 5). By df = f dlog f (Section 2.4),

            dS = A [dE/E + sum_{j<I} df_j/f_j + df_I/f_I], with one AD scope for each factor.
        """
        with dr.resume_grad():
            u, Le, visible = self.look(scene, sensor, sampler)
            δ = dr.detach(δL.lookup(u, visible, film.colours(mi.Color0f())))
            backward_grad(Le, δ * dr.detach(Le) * int(dr.prod(film.size)) / sampler.wavefront_size())
            ray, E = emit(scene, sensor, sampler)
            backward_grad(E, A)
        ray = dr.detach(ray)

        depth, active = mi.UInt32(1), mi.Bool(I > 0)
        while dr.hint(active, label="light path, adjoint"):
            # ---- Replay: the calls of `primal` in the same order, with the same random numbers ----
            si = scene.ray_intersect(ray, active)
            bsdf = si.bsdf(ray)
            _, to_sensor, _ = connect(sensor, sampler, si, ray, active)
            sampler.next_1d(active)  # consume_reservoir_rng()
            wo, _, ray = scatter(sampler, si, ray, active)

            # ---- Local AD scope: f_j towards the next vertex, or at x_I towards the sensor ----
            with dr.resume_grad():
                f = bsdf.eval(IMPORTANCE, si, dr.select(depth == I, to_sensor, wo), active)
                backward_grad(f, A)

            depth += 1  # in the loop (in Figure 4, the next vertex is traced behind it)
            active &= depth <= I

    def look(self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
        """Return film position, radiance (C,) and active lanes of primary rays that meet emitters.

        The light of emitters in view, C_0, is not part of the paper's sum. Its graph does not depend on the depth.
        """
        time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
        place = sampler.next_2d()
        ray, weight = sensor.sample_ray(time, sampler.next_1d(), place, sampler.next_2d())
        with dr.suspend_grad():
            si = scene.ray_intersect(ray)
            u = place * mi.Vector2f(sensor.film().crop_size())
        seen = si.is_valid() & (not self.hide_emitters and self.max_depth > 0)
        return u, weight * si.emitter(scene).eval(si, seen), seen


#: Light carries importance: BSDFs of refraction and of shading normals are not symmetric.
IMPORTANCE = mi.BSDFContext(mi.TransportMode.Importance)


def emit(scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler) -> tuple[mi.Ray3f, mi.Spectrum]:
    """Sample a ray from a random emitter. Returns the ray and E (C,)."""
    time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
    ray, E, _ = scene.sample_emitter_ray(time, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True)
    return ray, E


def connect(
    sensor: mi.Sensor, sampler: mi.Sampler, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Vector3f, mi.Spectrum]:
    """Connect a vertex to the sensor. Returns the sample, the local direction, and c_i / f without visibility (C,)."""
    ds, importance = sensor.sample_direction(si, sampler.next_2d(active), active)
    wo = si.to_local(ds.d)
    return ds, wo, importance * shading_correction(si, ray, wo)


def scatter(
    sampler: mi.Sampler, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Ray3f]:
    """Sample the BSDF. Returns the local direction, s_i (C,) and the next ray."""
    numbers = sampler.next_1d(active), sampler.next_2d(active)
    sample, weight = si.bsdf(ray).sample(IMPORTANCE, si, *numbers, active)
    weight *= shading_correction(si, ray, sample.wo)
    return sample.wo, weight, si.spawn_ray(si.to_world(sample.wo))


def splat(film: Film, block: mi.ImageBlock | None, u: mi.Point2f, C: mi.Spectrum, active: mi.Bool) -> None:
    """Add C (C,) to the block, if there is one, through the pixel filter at film position `u`."""
    if block is not None:
        film.put(block, u, C, active, film.colours(mi.Color0f()))


def shading_correction(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, wo: mi.Vector3f) -> mi.Float:
    """Return Veach's factor for shading normals (thesis, p. 155), or 0 if they and the surface disagree on the side."""
    wi_n, wo_n = dr.dot(si.n, -ray.d), dr.dot(si.n, si.to_world(wo))
    cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
    valid = (wi_n * cos_i > 0) & (wo_n * cos_o > 0)
    return dr.select(valid, dr.abs((cos_i * wo_n) / (cos_o * wi_n)), 0)


def backward_grad(f: mi.Spectrum, A: mi.Spectrum) -> None:
    """Add A df / f (C,) to the gradients of the scene's parameters, and 0 where f is 0."""
    weight = dr.select(f != 0, A / dr.detach(f), 0)
    dr.backward_from(dr.dot(weight, f), flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)


def check_scene(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Raise UnsupportedScene if the method as it stands here would give a wrong image."""
    if mi.is_spectral or mi.is_polarized:
        raise UnsupportedScene("reslrb_basic needs an RGB or mono variant; use reslrb for spectral rendering")
    if sensor.class_name() not in ("PerspectiveCamera", "ThinLensCamera"):
        raise UnsupportedScene(f"reslrb_basic cannot connect to sensor {sensor.id()}; use perspective or thinlens")
    far = int(mi.EmitterFlags.Infinite) | int(mi.EmitterFlags.DeltaDirection)
    for emitter in scene.emitters():
        if int(emitter.flags()) & far:
            raise UnsupportedScene(f"reslrb_basic supports area and point lamps, not {emitter.id()}; use reslrb")
    for shape in scene.shapes():
        if shape.is_medium_transition():
            raise UnsupportedScene(f"shape {shape.id()}: participating media are not supported")
        if shape.bsdf() is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null):
            raise UnsupportedScene(f"bsdf {shape.bsdf().id()} is transparent to shadow rays; use reslrb")


def check_parameters(params: mi.SceneParameters) -> None:
    """Raise UnsupportedScene if the detached derivative of a differentiated parameter is zero or wrong."""
    for key, (_, _, node, *_) in params.properties.items():
        if not dr.grad_enabled(params[key]):
            continue
        if not isinstance(node, (mi.BSDF, mi.Texture)):
            raise UnsupportedScene(f"{key}: reslrb_basic has detached derivatives, of BSDFs and emission only")
        while node is not None:
            if isinstance(node, mi.BSDF) and mi.has_flag(node.flags(), mi.BSDFFlags.Delta):
                raise UnsupportedScene(f"{key}: reslrb_basic has no derivatives of smooth specular BSDFs; use reslrb")
            node = params.hierarchy[node][0]
