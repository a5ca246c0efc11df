"""Light of the emitters before the first surface: rays that leave them, and the directly visible light C_0.

Light paths start with a ray that Mitsuba or `lamps.py` samples. `used_numbers` returns which random numbers of emission
a scene's emitters use. Two kinds of samples give C_0: points on lamps that move or are small, and primary rays.

A point x on a lamp has the following contribution at its film position u(x).

    C_0 = Le(x) |n . w| W(x) / p(x)

For a moving lamp, the formula for C_0 has the derivative with respect to the lamp's position. Film position, normal and
density move with the lamp. The outline of the lamp is included, because points at its rim move, too. Occlusion of and
by the lamp is missing. Primary rays give C_0 itself, and the derivative of C_0 with respect to radiance.

Primary rays rarely hit lamps smaller than a pixel. For lamps smaller than a pixel, points on the lamps give C_0 itself.

Each light path has one primary ray, with separate random numbers. The rays are distributed evenly over the pixels, so a
constant background has no noise. `ptracer` connects random points of the emitters to the sensor. These connections have
more noise for larger emitters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.graph import Lamp
from reslrb_cli.transport.connection import connect, forward_derivatives, passage
from reslrb_cli.transport.film import AdjointImage
from reslrb_cli.transport.lamps import environment_ray, lamp_point, lamp_ray
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import LAMP_STREAM, SMALL_LAMP_STREAM, VISIBLE_STREAM, NumberStream, Samples

PROBES = 1024  # light paths for the check


def used_numbers(samples: Samples) -> list[bool]:
    """Return which of the four random numbers (place, direction) affect the emission of any emitter."""
    random = np.random.default_rng(1)
    first, other = (random.random((4, PROBES), np.float32) for _ in range(2))
    choice = random.random(PROBES, np.float32)
    # All cases are lanes of one call, which contains the code of every emitter: unchanged, and with one number changed.
    cases = np.stack([np.where(np.arange(4)[:, None] == changed, other, first) for changed in range(-1, 4)])
    x = [mi.Float(cases[:, k].ravel()) for k in range(4)]
    with dr.suspend_grad():
        chosen = mi.Float(np.tile(choice, len(cases)))
        e = emission_of(samples, mi.Float(0), chosen, mi.Point2f(x[0], x[1]), mi.Point2f(x[2], x[3]))
        dr.eval(e.ray.o, e.ray.d, e.weight)
    parts = [
        np.broadcast_to(np.array(part), (np.shape(part)[0], cases.shape[0] * PROBES))
        for part in (e.ray.o, e.ray.d, e.weight)
    ]
    found = np.concatenate(parts).reshape(-1, len(cases), PROBES)
    return [not np.array_equal(found[:, 0], found[:, case], equal_nan=True) for case in range(1, len(cases))]


@dataclass
class Emission:
    """Ray that leaves an emitter, and its weight E (C,). The weight is the radiance divided by the ray's density.

    If derivatives are enabled, `weight` tracks the derivatives of emission. If emitters move, ray and density track
    derivatives as well. `guided` is the factor of `weight` from a guide, or None without a guide. `position` contains
    the random numbers of the place.
    """

    ray: mi.Ray3f
    weight: mi.Spectrum
    emitter: mi.EmitterPtr
    guided: mi.Float | None = None
    position: mi.Point2f | None = None


def sample_time(plan: Plan, sensor: mi.Sensor, sampler: mi.Sampler | NumberStream) -> mi.Float:
    """Return a time within the shutter interval. A random number is drawn only if the shutter interval is longer than
    0.
    """
    time = mi.Float(sensor.shutter_open())
    if plan.needs.moving_shutter:
        time += sampler.next_1d() * sensor.shutter_open_time()
    return time


def sample_emission(samples: Samples, sampler: mi.Sampler) -> Emission:
    """Sample a ray from a random emitter of the scene. The function uses the same random numbers as `ptracer`, in the
    same order.
    """
    time = sample_time(samples.plan, samples.sensor, sampler)
    wavelength_sample, sample_2, sample_3 = samples.emission_numbers(sampler)
    drawn = samples.drawn(wavelength_sample, sample_2, sample_3)
    if drawn is None:
        return emission_of(samples, time, wavelength_sample, sample_2, sample_3)
    emission = emission_of(samples, time, drawn.choice, drawn.position, drawn.direction)
    return replace(emission, weight=emission.weight * drawn.weight, guided=drawn.weight)


def emission_of(
    samples: Samples, time: mi.Float, wavelength_sample: mi.Float, sample_2: mi.Point2f, sample_3: mi.Point2f
) -> Emission:
    """Return the ray of these random numbers."""
    plan, scene = samples.plan, samples.scene
    if not (plan.environment_map or plan.placed_lamps):
        ray, weight, emitter = scene.sample_emitter_ray(time, wavelength_sample, sample_2, sample_3, True)
        return Emission(ray if plan.moving_emission else dr.detach(ray), weight, emitter, position=sample_2)

    index, index_weight, reused = scene.sample_emitter(wavelength_sample, True)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index)
    if plan.environment_map:
        is_environment = index == plan.needs.environment
        ray, weight = environment_ray(plan, scene.environment(), time, sample_2, sample_3)
        if len(plan.needs.emitters) > 1:
            other = _emitter_ray(samples, emitter, time, reused, sample_2, sample_3, ~is_environment)
            ray, weight = (dr.select(is_environment, a, b) for a, b in zip((ray, weight), other, strict=True))
    else:
        ray, weight = _emitter_ray(samples, emitter, time, reused, sample_2, sample_3, mi.Bool(True))
    ray = ray if plan.moving_emission else dr.detach(ray)
    return Emission(ray, weight * dr.detach(index_weight), emitter, position=sample_2)


def _emitter_ray(
    samples: Samples, emitter: mi.EmitterPtr, time: mi.Float, number: mi.Float, position: mi.Point2f,
    direction: mi.Point2f, active: mi.Bool,
) -> tuple[mi.Ray3f, mi.Spectrum]:  # fmt: skip
    """Return a ray that leaves each lane's emitter. `lamp_ray` or Mitsuba samples the ray."""
    placed = samples.plan.placed_lamps
    lamps = {lamp.emitter: (lamp, samples.areas(lamp), lamp in samples.plan.evened_lamps) for lamp in placed}
    if samples.plan.moving_emission:
        # An indirect call, even for a single emitter: without it, the derivative by each number of a transformation is
        # a sum over all paths, which would trace them again.
        def leave(
            self: mi.Emitter, time: mi.Float, number: mi.Float, position: mi.Point2f, direction: mi.Point2f,
            active: mi.Bool,
        ) -> tuple[mi.Ray3f, mi.Spectrum]:  # fmt: skip
            if self in lamps:
                lamp, areas, evened = lamps[self]
                return lamp_ray(lamp, areas, time, number, position, direction, active, evened)
            return self.sample_ray(time, number, position, direction, active)

        return dr.dispatch(emitter, leave, time, number, position, direction, active)
    # Forward mode cannot pass an indirect call of ours.
    ray, weight = emitter.sample_ray(time, number, position, direction, active)
    for lamp, areas, evened in lamps.values():
        here = emitter == mi.EmitterPtr(lamp.emitter)
        own = lamp_ray(lamp, areas, time, number, position, direction, active & here, evened)
        ray, weight = (dr.select(here, a, b) for a, b in zip(own, (ray, weight), strict=True))
    return ray, weight


# ---- Directly visible light ----


def moving_splats(samples: Samples) -> Iterator[tuple[mi.Point2f, mi.Spectrum, mi.Bool]]:
    """Yield film position u, C_0 (C,) and the active lanes for each visible lamp that moves.

    If gradients are enabled, u and C_0 have derivatives. Primary rays have already added the light of these lamps to
    the image.
    """
    for lamp in samples.plan.visible_moving_lamps:
        point = _points(samples, (lamp,), mi.UInt32(lamp.index), samples.numbers(LAMP_STREAM + lamp.index), True)
        # Points stay at their place on the lamp, so moving parts do not affect their radiance.
        yield point.u, dr.select(point.active, dr.detach(point.radiance()) * point.weight, 0), point.active


def small_splat(samples: Samples) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
    """Return film position u, C_0 (C,) and the active lanes for lamps smaller than a pixel.

    If gradients are enabled, C_0 has its derivative with respect to radiance.
    """
    point = small_points(samples)
    return point.u, dr.select(point.active, point.radiance() * point.weight, 0), point.active


def small_points(samples: Samples) -> LampPoints:
    """Return detached points on the lamps smaller than a pixel. Successive lanes use the lamps in turn."""
    lamps, numbers = samples.plan.small_lamps, samples.numbers(SMALL_LAMP_STREAM)
    count, lane = dr.opaque(mi.UInt32, samples.width), dr.arange(mi.UInt32, samples.width)
    turn, index = lane % len(lamps), mi.UInt32(lamps[0].index)
    for number, lamp in enumerate(lamps):
        index = dr.select(turn == number, mi.UInt32(lamp.index), index)
    lanes = count // len(lamps) + dr.select(turn < count % len(lamps), mi.UInt32(1), 0)
    with dr.suspend_grad():
        point = _points(samples, lamps, index, numbers, attached=False)
    return replace(point, weight=dr.detach(point.weight) * (mi.Float(count) / mi.Float(lanes)))


@dataclass
class LampPoints:
    """Points on lamps as seen from the sensor. `weight` (C,) is C_0 / radiance, normalised for the image."""

    emitter: mi.EmitterPtr
    si: mi.SurfaceInteraction3f
    u: mi.Point2f
    weight: mi.Spectrum
    active: mi.Bool

    def radiance(self) -> mi.Spectrum:
        """Return the radiance towards the sensor (C,), with its derivative if it has one."""
        return self.emitter.eval(self.si, self.active)


def _points(
    samples: Samples, lamps: Sequence[Lamp], index: mi.UInt32, numbers: NumberStream, attached: bool
) -> LampPoints:
    """Return a point on each lane's lamp. `index` is the lamp's index in `scene.emitters()`."""
    plan, sensor = samples.plan, samples.sensor
    time = sample_time(plan, sensor, numbers)
    position, aperture = numbers.next_2d(), numbers.next_2d()
    emitter = dr.gather(mi.EmitterPtr, samples.scene.emitters_dr(), index)
    found = {lamp.emitter: (lamp, samples.areas(lamp), lamp in plan.evened_lamps) for lamp in lamps}

    def point(
        self: mi.Emitter, time: mi.Float, position: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        if self not in found:  # a shape of this scene, or of another one
            return dr.zeros(mi.SurfaceInteraction3f), mi.Float(0)
        lamp, areas, evened = found[self]
        return lamp_point(lamp, areas, time, position, active, evened)

    si, weight = dr.dispatch(emitter, point, time, position, mi.Bool(True))  # as in `sample_emission`
    si.time = time
    connection = connect(plan, sensor, si, None, aperture, mi.Bool(True), attached=attached)
    cos = dr.dot(si.n, si.to_world(connection.wo))
    connection.active = connection.active & (cos > 0)
    si.wi = connection.wo
    with dr.suspend_grad():
        active, through = passage(plan, samples.scene, si, mi.UInt32(0), connection)
    weight = through * (cos * weight) * connection.weight * samples.scale
    return LampPoints(emitter, si, connection.u, weight, active)


@dataclass
class PrimaryRay:
    """Ray through film position `u` (pixels, relative to the crop window).

    `weight` (C,) is the sensor's importance, normalised so that a sum over lanes gives the mean over each pixel's
    samples.
    """

    ray: mi.Ray3f
    u: mi.Point2f
    weight: mi.Spectrum
    active: mi.Bool


def primary_ray(samples: Samples) -> PrimaryRay:
    """Return a primary ray for each path, distributed evenly over the pixels of the crop window.

    The rays have their own stream of random numbers.
    """
    plan, sensor, width, sampler = samples.plan, samples.sensor, samples.width, samples.numbers(VISIBLE_STREAM)
    size = sensor.film().crop_size()
    n_pixels = int(size[0] * size[1])
    lane = dr.arange(mi.UInt32, width)
    pixel = lane % n_pixels
    count = dr.opaque(mi.UInt32, width)  # a literal would compile a kernel for every sample count
    per_pixel = mi.Float(count // n_pixels + dr.select(pixel < count % n_pixels, mi.UInt32(1), 0))
    time = sample_time(plan, sensor, sampler)
    u = mi.Point2f(pixel % int(size[0]), pixel // int(size[0])) + sampler.next_2d()
    aperture = sampler.next_2d() if plan.needs.thin_lens else mi.Point2f(0.5)
    ray, weight = sensor.sample_ray_differential(time, 0.5, u / mi.Vector2f(size), aperture, True)
    return PrimaryRay(mi.Ray3f(ray), u, weight * dr.rcp(dr.maximum(per_pixel, 1)), per_pixel > 0)


@dataclass
class _Look:
    """Loop state of a primary ray on its way through null surfaces.

    In forward mode, `tangents` are the derivatives of transmittance and radiance.
    """

    active: mi.Bool
    ray: mi.Ray3f
    transmittance: mi.Spectrum
    radiance: mi.Spectrum
    crossings: mi.UInt32
    tangents: list[mi.Spectrum] = field(default_factory=list)


def visible_radiance(plan: Plan, scene: mi.Scene, primary: PrimaryRay, loop_mode: str = "symbolic") -> mi.Spectrum:
    """Return the radiance (C,) that arrives along the primary ray, through null surfaces if the scene has any.

    If `loop_mode` is evaluated and derivatives are enabled, the radiance has derivatives for naive AD.
    """
    return _look(plan, scene, primary, None, loop_mode).radiance


def visible_tangent(plan: Plan, scene: mi.Scene, primary: PrimaryRay) -> mi.Spectrum:
    """Return the derivative (C,) of `visible_radiance` along the parameters' tangents (forward mode)."""
    with dr.suspend_grad():  # the loop itself tracks nothing
        return _look(plan, scene, primary, None, "symbolic", tangents=True).tangents[1]


def differentiate_visible_radiance(plan: Plan, scene: mi.Scene, primary: PrimaryRay, adjoint: mi.Spectrum) -> None:
    """Differentiate the radiance along the primary rays, times `adjoint` (C,). Add the derivatives to the parameters'
    gradients.

    The derivative with respect to a transmission needs the radiance behind the surface. A first pass measures the total
    radiance at the sensor. The total minus the radiance up to the surface is then divided by the transmission.
    """
    masks = plan.differentiate_null
    total = visible_radiance(plan, scene, primary) if masks else mi.Spectrum(0)

    def differentiate(state: _Look, Le: mi.Spectrum, radiance: mi.Spectrum, transmission: mi.Spectrum) -> None:
        weight = dr.select(state.active, adjoint * state.transmittance, 0)
        objective = weight * Le if plan.differentiate_emission else mi.Spectrum(0)
        if masks:
            behind = dr.select(transmission != 0, (total - radiance) / dr.detach(transmission), 0)
            objective += dr.select(state.active, adjoint * behind, 0) * transmission
        # The scene may have masks without differentiated parameters.
        dr.backward_from(objective, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)

    with dr.resume_grad():
        _look(plan, scene, primary, differentiate, "symbolic")


def _radiance(plan: Plan, scene: mi.Scene, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
    """Return the radiance (C,) that leaves `si`. Lamps smaller than a pixel are left out, because they have their own
    samples.
    """
    emitter = si.emitter(scene)
    for lamp in plan.small_lamps:
        active = active & (emitter != mi.EmitterPtr(lamp.emitter))
    return emitter.eval(si, active)


def _look(
    plan: Plan, scene: mi.Scene, primary: PrimaryRay,
    on_surface: Callable[[_Look, mi.Spectrum, mi.Spectrum, mi.Spectrum], None] | None, mode: str,
    tangents: bool = False,
) -> _Look:  # fmt: skip
    def look(state: _Look) -> tuple[_Look]:
        with dr.suspend_grad():  # if lamps move, `moving_splats` has the derivative
            si = scene.ray_intersect(state.ray, state.active)
        hit = state.active & si.is_valid()
        with dr.resume_grad(when=tangents):
            Le = _radiance(plan, scene, si, state.active)
            transmission = si.bsdf().eval_null_transmission(si, hit) if plan.needs.has_null else mi.Spectrum(0)
            if tangents:
                d_Le, d_transmission = forward_derivatives(Le, transmission)
                Le, transmission = dr.detach(Le), dr.detach(transmission)
        if on_surface is not None:  # derivatives are taken here, and none stays in the state
            on_surface(state, Le, state.radiance + dr.detach(Le) * state.transmittance, transmission)
            Le, transmission = dr.detach(Le), dr.detach(transmission)
        d_state = state.tangents
        if tangents:
            (dT, dL), T = d_state, state.transmittance
            d_state = [dT * transmission + T * d_transmission, dL + dT * Le + T * d_Le]
        radiance = state.radiance + Le * state.transmittance
        through = hit & dr.any(transmission != 0) & (state.crossings + 2 <= plan.max_depth)
        ray = dr.detach(si.spawn_ray(state.ray.d))
        return (_Look(through, ray, state.transmittance * transmission, radiance, state.crossings + 1, d_state),)

    d_state = [mi.Spectrum(0), mi.Spectrum(0)] if tangents else []
    state = _Look(mi.Bool(primary.active), primary.ray, mi.Spectrum(1), mi.Spectrum(0), mi.UInt32(0), d_state)
    (state,) = dr.while_loop((state,), lambda state: state.active, look, label="primary ray", mode=mode)
    return state


def splat_visible_emission(samples: Samples, block: mi.ImageBlock, loop_mode: str = "symbolic") -> None:
    """Add C_0 to the block."""
    if samples.plan.visible_emission and samples.plan.paths == "light":
        primary = primary_ray(samples)
        radiance = visible_radiance(samples.plan, samples.scene, primary, loop_mode)
        samples.film.put(block, primary.u, radiance * primary.weight * samples.fraction, primary.active)
    if samples.plan.small_lamps:
        samples.film.put(block, *small_splat(samples))


def differentiate_visible_emission(samples: Samples, adjoint: AdjointImage) -> None:
    """Add the derivatives of C_0."""
    plan = samples.plan
    if plan.visible_emission and plan.paths == "light" and (plan.differentiate_emission or plan.differentiate_null):
        primary = primary_ray(samples)
        delta = adjoint.lookup(primary.u, primary.active) * primary.weight * samples.fraction
        differentiate_visible_radiance(plan, samples.scene, primary, delta)
    if plan.small_lamps and plan.differentiate_emission:
        with dr.resume_grad():
            u, C, active = small_splat(samples)
            objective = dr.dot(adjoint.lookup(u, active), C)
            dr.backward_from(objective, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    if plan.visible_moving_lamps:
        with dr.resume_grad():
            for u, C, active in moving_splats(samples):
                dr.backward_from(dr.dot(adjoint.lookup(u, active, plan.attached_normalization), C))
