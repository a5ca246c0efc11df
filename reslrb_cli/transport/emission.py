"""Light of the emitters before the first surface: rays that leave them, and the directly visible light C_0.

Light paths start with a ray that Mitsuba or `lamps.py` samples. `used_numbers` returns which random numbers of emission
a scene's emitters use. Primary rays give C_0, except for lamps that move or are small (`lamp_light.py`).

Each light path has one primary ray, with separate random numbers. The rays are distributed evenly over the pixels, so a
constant background has no noise. `ptracer` connects random points of the emitters to the sensor. These connections have
more noise for larger emitters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.rays import sensor_rays
from reslrb_cli.transport.factors import MAY_LACK
from reslrb_cli.transport.film import AdjointImage, Colours
from reslrb_cli.transport.lamp_light import moving_splats, small_splat
from reslrb_cli.transport.lamps import environment_ray, keep_one, lamp_ray
from reslrb_cli.transport.masks import forward_derivatives, transmission_of
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import VISIBLE_STREAM, Samples

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
        dr.eval(e.ray.o, e.ray.d, e.E)
    parts = [
        np.broadcast_to(np.array(part), (np.shape(part)[0], cases.shape[0] * PROBES))
        for part in (e.ray.o, e.ray.d, e.E)
    ]
    found = np.concatenate(parts).reshape(-1, len(cases), PROBES)
    return [not np.array_equal(found[:, 0], found[:, case], equal_nan=True) for case in range(1, len(cases))]


@dataclass
class Emission:
    """Ray that leaves an emitter, and E (C,), the radiance divided by the ray's density.

    If derivatives are enabled, `E` tracks the derivatives of emission. If emitters move, ray and density track
    derivatives as well. `guided` is the factor of `E` from a guide, or None without a guide. `position` contains
    the random numbers of the place.
    """

    ray: mi.Ray3f
    E: mi.Spectrum
    emitter: mi.EmitterPtr
    guided: mi.Float | None = None
    position: mi.Point2f | None = None


def sample_emission(samples: Samples, sampler: mi.Sampler) -> Emission:
    """Sample a ray from a random emitter of the scene. The function uses the same random numbers as `ptracer`, in the
    same order.
    """
    time = samples.time(sampler.next_1d)
    wavelength_sample, sample_2, sample_3 = samples.emission_numbers(sampler)
    drawn = samples.drawn(wavelength_sample, sample_2, sample_3)
    if drawn is None:
        return emission_of(samples, time, wavelength_sample, sample_2, sample_3)
    emission = emission_of(samples, time, drawn.choice, drawn.position, drawn.direction)
    return replace(emission, E=emission.E * drawn.weight, guided=drawn.weight)


def emission_of(
    samples: Samples, time: mi.Float, wavelength_sample: mi.Float, sample_2: mi.Point2f, sample_3: mi.Point2f
) -> Emission:
    """Return the ray of these random numbers."""
    plan, scene = samples.plan, samples.scene
    if not (plan.environment_map or plan.placed_lamps or plan.lit):
        ray, weight, emitter = scene.sample_emitter_ray(time, wavelength_sample, sample_2, sample_3, True)
        weight = _at_fixed_wavelengths(plan, ray, emitter, weight)
        return Emission(ray if plan.moving_emission else dr.detach(ray), weight, emitter, position=sample_2)

    index, index_weight, reused = samples.choose_emitter(wavelength_sample, mi.Bool(True))
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index)
    if plan.environment_map:
        is_environment = emitter == mi.EmitterPtr(scene.environment())
        ray, weight = environment_ray(plan, scene.environment(), time, reused, sample_2, sample_3)
        if len(plan.needs.emitters) > 1:
            other = _emitter_ray(samples, emitter, time, reused, sample_2, sample_3, ~is_environment)
            ray, weight = (dr.select(is_environment, a, b) for a, b in zip((ray, weight), other, strict=True))
    else:
        ray, weight = _emitter_ray(samples, emitter, time, reused, sample_2, sample_3, mi.Bool(True))
    weight = _at_fixed_wavelengths(plan, ray, emitter, weight)
    ray = ray if plan.moving_emission else dr.detach(ray)
    return Emission(ray, weight * dr.detach(index_weight), emitter, position=sample_2)


def _at_fixed_wavelengths(plan: Plan, ray: mi.Ray3f, emitter: mi.EmitterPtr, weight: mi.Spectrum) -> mi.Spectrum:
    """Detach the wavelengths of `ray`, and return radiance / density (C,) with its derivative at these wavelengths.

    Mitsuba samples the wavelengths of some spectra in proportion to their values, and returns their integral.
    """
    if not mi.is_spectral:
        return weight
    ray.wavelengths = dr.detach(ray.wavelengths)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = ray.wavelengths
    for own, spectrum in plan.sampled_spectra:
        value, mean = spectrum.eval(si), spectrum.mean()
        ratio = value / dr.detach(value) * (dr.detach(mean) / mean)
        weight = mi.Spectrum(dr.select((emitter == mi.EmitterPtr(own)) & (value != 0), weight * ratio, weight))
    return keep_one(ray, weight) if plan.needs.disperses else weight


def _emitter_ray(
    samples: Samples, emitter: mi.EmitterPtr, time: mi.Float, number: mi.Float, position: mi.Point2f,
    direction: mi.Point2f, active: mi.Bool,
) -> tuple[mi.Ray3f, mi.Spectrum]:  # fmt: skip
    """Return a ray that leaves each lane's emitter. `lamp_ray` or Mitsuba samples the ray."""
    placed = samples.plan.placed_lamps
    lamps = {lamp.emitter: (lamp, samples.areas.get(lamp), lamp in samples.plan.evened_lamps) for lamp in placed}
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


def primary_ray(samples: Samples) -> tuple[mi.Ray3f, mi.Point2f, mi.Spectrum, Colours]:
    """Return a primary ray for each path, its film position u (pixels, relative to the crop window), its weight (C,),
    and its wavelengths with the film's response. The rays are distributed evenly over the pixels of the crop window.

    The weight is the sensor's importance, normalised so that a sum over lanes gives the mean over each pixel's samples.
    """
    plan, sensor, width = samples.plan, samples.sensor, samples.width
    next_1d = samples.stream(VISIBLE_STREAM).next_float32
    size = sensor.film().crop_size()
    n_pixels = int(size[0] * size[1])
    lane = dr.arange(mi.UInt32, width)
    pixel = lane % n_pixels
    count = dr.opaque(mi.UInt32, width)  # a literal would compile a kernel for every sample count
    per_pixel = mi.Float(count // n_pixels + dr.select(pixel < count % n_pixels, mi.UInt32(1), 0))
    time = samples.time(next_1d)
    u = mi.Point2f(pixel % int(size[0]), pixel // int(size[0])) + mi.Point2f(next_1d(), next_1d())
    aperture = mi.Point2f(next_1d(), next_1d()) if plan.needs.thin_lens else mi.Point2f(0.5)
    wavelength = next_1d() if mi.is_spectral else mi.Float(0.5)
    ray, weight = sensor_rays(sensor, time, u / mi.Vector2f(size), aperture, wavelength)
    return ray, u, weight * dr.rcp(per_pixel), samples.film.colours(ray.wavelengths)


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


def visible_radiance(samples: Samples, ray: mi.Ray3f, loop_mode: str = "symbolic") -> mi.Spectrum:
    """Return the radiance (C,) that arrives along a primary ray, through null surfaces if the scene has any.

    If `loop_mode` is evaluated and derivatives are enabled, the radiance has derivatives for naive AD.
    """
    return _look(samples, ray, None, loop_mode).radiance


def visible_tangent(samples: Samples, ray: mi.Ray3f) -> mi.Spectrum:
    """Return the derivative (C,) of `visible_radiance` along the parameters' tangents (forward mode)."""
    with dr.suspend_grad():  # the loop itself tracks nothing
        return _look(samples, ray, None, "symbolic", tangents=True).tangents[1]


def differentiate_visible_radiance(samples: Samples, ray: mi.Ray3f, adjoint: mi.Spectrum) -> None:
    """Differentiate the radiance along the primary rays, times `adjoint` (C,). Add the derivatives to the parameters'
    gradients.

    The derivative with respect to a transmission needs the radiance behind the surface. A first pass measures the total
    radiance at the sensor. The total minus the radiance up to the surface is then divided by the transmission.
    """
    plan, masks = samples.plan, samples.plan.differentiate_null
    total = visible_radiance(samples, ray) if masks else mi.Spectrum(0)

    def differentiate(state: _Look, Le: mi.Spectrum, radiance: mi.Spectrum, transmission: mi.Spectrum) -> None:
        weight = dr.select(state.active, adjoint * state.transmittance, 0)
        objective = weight * Le if plan.differentiate_emission else mi.Spectrum(0)
        if masks:
            behind = mi.Spectrum(dr.select(transmission != 0, (total - radiance) / dr.detach(transmission), 0))
            objective += dr.select(state.active, adjoint * behind, 0) * transmission
        # The scene may have masks without differentiated parameters.
        dr.backward_from(objective, flags=MAY_LACK)

    with dr.resume_grad():
        _look(samples, ray, differentiate, "symbolic")


def _radiance(samples: Samples, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
    """Return the radiance (C,) that leaves `si`. Lamps smaller than a pixel are left out, because they have their own
    samples.
    """
    emitter = samples.emitter_of(si, active)
    for lamp in samples.plan.small_lamps:
        active = active & (emitter != mi.EmitterPtr(lamp.emitter))
    return emitter.eval(si, active)


def _look(
    samples: Samples, ray: mi.Ray3f,
    on_surface: Callable[[_Look, mi.Spectrum, mi.Spectrum, mi.Spectrum], None] | None, mode: str,
    tangents: bool = False,
) -> _Look:  # fmt: skip
    plan, scene = samples.plan, samples.scene

    def look(state: _Look) -> tuple[_Look]:
        with dr.suspend_grad():  # if lamps move, `moving_splats` has the derivative
            si = scene.ray_intersect(state.ray, state.active)
        hit = state.active & si.is_valid()
        with dr.resume_grad(when=tangents):
            Le = _radiance(samples, si, state.active)
            transmission = transmission_of(plan, si, hit) if plan.needs.has_null else mi.Spectrum(0)
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
    state = _Look(mi.Bool(True), ray, mi.Spectrum(1), mi.Spectrum(0), mi.UInt32(0), d_state)
    (state,) = dr.while_loop((state,), lambda state: state.active, look, label="primary ray", mode=mode)
    return state


def splat_visible_emission(samples: Samples, block: mi.ImageBlock, loop_mode: str = "symbolic") -> None:
    """Add C_0 to the block."""
    if samples.plan.visible_emission and samples.plan.paths == "light":
        ray, u, weight, colours = primary_ray(samples)
        radiance = visible_radiance(samples, ray, loop_mode)
        samples.film.put(block, u, radiance * weight * samples.fraction, mi.Bool(True), colours)
    if samples.plan.small_lamps:
        samples.film.put(block, *small_splat(samples))


def differentiate_visible_emission(samples: Samples, adjoint: AdjointImage) -> None:
    """Add the derivatives of C_0."""
    plan = samples.plan
    if plan.visible_emission and plan.paths == "light" and (plan.differentiate_emission or plan.differentiate_null):
        ray, u, weight, colours = primary_ray(samples)
        delta = adjoint.lookup(u, mi.Bool(True), colours) * weight * samples.fraction
        differentiate_visible_radiance(samples, ray, delta)
    if plan.small_lamps and plan.differentiate_emission:
        with dr.resume_grad():
            u, C, active, colours = small_splat(samples)
            objective = dr.dot(adjoint.lookup(u, active, colours), C)
            dr.backward_from(objective, flags=MAY_LACK)
    if plan.visible_moving_lamps:
        with dr.resume_grad():
            for u, C, active, colours in moving_splats(samples):
                dr.backward_from(dr.dot(adjoint.lookup(u, active, colours, plan.attached_normalization), C))
