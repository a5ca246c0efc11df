"""Start of light paths: rays from the emitters, sampled by Mitsuba or by `lamps.py`.

`used_numbers` returns which random numbers of emission a scene's emitters use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.transport.lamps import DEFENSIVE, lamp_ray
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import NumberStream, Samples

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
        ray, weight = _environment_ray(plan, scene.environment(), time, sample_2, sample_3)
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


def _environment_ray(
    plan: Plan, environment: mi.Emitter, time: mi.Float, disk: mi.Point2f, direction: mi.Point2f
) -> tuple[mi.Ray3f, mi.Spectrum]:
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
    if plan.differentiate_emission:
        ds, weight = _any_direction(environment, reference, direction)
    else:
        ds, weight = environment.sample_direction(reference, direction, True)
    d = -dr.detach(ds.d)
    offset = mi.warp.square_to_uniform_disk_concentric(disk)
    perpendicular = mi.Frame3f(d).to_world(mi.Vector3f(offset.x, offset.y, 0))
    ray = mi.Ray3f(center + (perpendicular - d) * radius, d, time, [])
    return ray, weight * (dr.pi * radius**2)


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
        seen.wi = -ds.d  # `eval_direction` uses texture coordinates, which sampled directions lack
    return ds, environment.eval(seen, True) / pdf
