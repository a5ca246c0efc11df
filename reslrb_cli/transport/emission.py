"""Where light paths start: rays from the emitters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.plan import Plan

DEFENSIVE = 0.1  # share of directions that are drawn uniformly from an environment map


@dataclass
class Emission:
    """A ray that leaves an emitter. `weight` is E of the design notes: radiance over the density of the ray, (C,).

    `weight` tracks derivatives of emission where they are enabled; ray and density do where emitters move.
    """

    ray: Any
    weight: Any


def sample_time(plan: Plan, sensor: Any, sampler: Any) -> Any:
    """A time within the shutter interval; draws a number only where the shutter is open for some time."""
    time = mi.Float(sensor.shutter_open())
    if plan.needs.moving_shutter:
        time += sampler.next_1d() * sensor.shutter_open_time()
    return time


def sample_emission(plan: Plan, scene: Any, sensor: Any, sampler: Any) -> Emission:
    """Sample a ray from a random emitter of the scene. Draws as many numbers, in the same order, as `ptracer`."""
    time = sample_time(plan, sensor, sampler)
    wavelength_sample, sample_2, sample_3 = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
    environment = scene.environment() if plan.environment_map else None
    if environment is None:
        ray, weight, _ = scene.sample_emitter_ray(time, wavelength_sample, sample_2, sample_3, True)
        return Emission(ray if plan.moving_emission else dr.detach(ray), weight)

    index, index_weight, reused = scene.sample_emitter(wavelength_sample, True)
    is_environment = index == plan.needs.environment
    ray, weight = _environment_ray(plan, scene, environment, time, sample_2, sample_3)
    if len(plan.needs.emitters) > 1:
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index)
        ray_2, weight_2 = emitter.sample_ray(time, reused, sample_2, sample_3, ~is_environment)
        ray = dr.select(is_environment, ray, ray_2)
        weight = dr.select(is_environment, weight, weight_2)
    return Emission(ray if plan.moving_emission else dr.detach(ray), weight * dr.detach(index_weight))


def _environment_ray(plan: Plan, scene: Any, environment: Any, time: Any, disk: Any, direction: Any) -> tuple[Any, Any]:
    """A ray from an environment map, on a disk perpendicular to it that covers the scene's bounding sphere.

    Stock `envmap.sample_ray` places the disk in the map's local frame, which is wrong where `to_world` rotates it.
    Directions are drawn in proportion to the map's radiance, and, where that is differentiated, some uniformly: texels
    that are black beside a sun have derivatives as large as any.
    """
    sphere = scene.bbox().bounding_sphere()
    radius = sphere.radius * (1 + 1e-4)
    reference = dr.zeros(mi.Interaction3f)
    reference.p, reference.time = mi.Point3f(sphere.center), time
    if plan.differentiate_emission:
        ds, weight = _any_direction(environment, reference, direction)
    else:
        ds, weight = environment.sample_direction(reference, direction, True)
    d = -dr.detach(ds.d)
    offset = mi.warp.square_to_uniform_disk_concentric(disk)
    perpendicular = mi.Frame3f(d).to_world(mi.Vector3f(offset.x, offset.y, 0))
    ray = mi.Ray3f(sphere.center + (perpendicular - d) * radius, d, time, [])
    return ray, weight * (dr.pi * radius**2)


def _any_direction(environment: Any, reference: Any, sample: Any) -> tuple[Any, Any]:
    """A direction from a mixture of the environment's own density and the uniform one; radiance over density."""
    with dr.suspend_grad():
        uniform = sample.x < DEFENSIVE
        x = dr.select(uniform, sample.x / DEFENSIVE, (sample.x - DEFENSIVE) / (1 - DEFENSIVE))
        sample = mi.Point2f(x, sample.y)
        ds, _ = environment.sample_direction(reference, sample, True)
        ds.d = dr.select(uniform, mi.warp.square_to_uniform_sphere(sample), ds.d)
        own = environment.pdf_direction(reference, ds, True)
        pdf = (1 - DEFENSIVE) * own + DEFENSIVE * dr.inv_four_pi
        seen = dr.zeros(mi.SurfaceInteraction3f)
        seen.wi = -ds.d  # `eval_direction` goes by texture coordinates, which those drawn here do not have
    return ds, environment.eval(seen, True) / pdf
