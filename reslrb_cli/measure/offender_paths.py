"""Looks along the paths of one set of samples for the first value that is not finite."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.measure.offender_walk import QUANTITIES, SearchHooks, Suspect, is_bad, reaches
from reslrb_cli.records.offender import Offender, PathVertex
from reslrb_cli.transport.emission import Emission, sample_emission
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.transmittance import forward_derivatives
from reslrb_cli.transport.visible import primary_ray, visible_radiance, visible_tangent
from reslrb_cli.transport.visible_lamps import small_points
from reslrb_cli.transport.walk import walk

Array = np.ndarray[Any, Any]


@dataclass
class Found:
    """The offender of the first path that has one, whether it reaches the wanted pixel, the largest contribution."""

    offender: Offender | None
    there: bool
    largest: Offender | None


def search_paths(samples: Samples, sensor: int, label: str, pixel: tuple[int, int] | None) -> Found:
    """Look at every path of these samples; those that reach `pixel` come first. Parameters have their tangents set."""
    plan = samples.plan
    with dr.suspend_grad():
        with dr.resume_grad():
            E = sample_emission(samples, samples.sampler())
            [dE] = forward_derivatives(E.weight) if plan.differentiate_emission else [mi.Spectrum(0)]
        state = walk(samples, SearchHooks(samples, Emission(E.ray, dr.detach(E.weight), E.emitter), dE, pixel))
        dr.eval(state)
    describe = Describe(samples, sensor, label)
    size = np.array(dr.max(dr.abs(state.largest.value)))
    brightest = int(np.argmax(np.where(np.isfinite(size), size, 0)))
    largest = describe(state.largest, state.largest_u, brightest) if size[brightest] > 0 else None
    lane, there = _first(np.array(state.found.kind) != 0, np.array(state.there))
    if lane is not None:
        return Found(describe(state.found, state.u, lane), there, largest)
    return _search_visible_emission(samples, describe, pixel, largest)


def _search_visible_emission(
    samples: Samples, describe: Describe, pixel: tuple[int, int] | None, largest: Offender | None
) -> Found:
    if not samples.plan.visible_emission:
        return Found(None, False, largest)
    with dr.suspend_grad():
        for seen in (_through_pixels, _on_small_lamps) if samples.plan.small_lamps else (_through_pixels,):
            suspect, tangent, u, active = seen(samples)
            there = np.array(reaches(samples.film, u, pixel))
            for name, value in (
                ("emission E towards the sensor", suspect.value),
                ("derivative of emission, dE", tangent),
            ):
                bad = np.broadcast_to(np.array(active & is_bad(value)), samples.width)
                lane, at_pixel = _first(bad, there)
                if lane is not None:
                    offender = describe(replace(suspect, value=mi.Spectrum(value)), u, lane, name)
                    return Found(offender, at_pixel, largest)
    return Found(None, False, largest)


def _through_pixels(samples: Samples) -> tuple[Suspect, mi.Spectrum, mi.Point2f, mi.Bool]:
    """What primary rays see: radiance (C,), its tangent, film positions, and the active lanes."""
    plan, tangent = samples.plan, mi.Spectrum(0)
    primary = primary_ray(samples)
    radiance = visible_radiance(plan, samples.scene, primary)
    if plan.differentiate_emission or plan.differentiate_null:
        tangent = visible_tangent(plan, samples.scene, primary)
    si = samples.scene.ray_intersect(primary.ray, primary.active)
    p, shape = dr.select(si.is_valid(), si.p, primary.ray.o), dr.reinterpret_array(mi.UInt32, si.shape)
    return Suspect(mi.UInt32(0), mi.UInt32(0), p, shape, radiance), tangent, primary.u, primary.active


def _on_small_lamps(samples: Samples) -> tuple[Suspect, mi.Spectrum, mi.Point2f, mi.Bool]:
    """The same of points on lamps that are smaller than a pixel."""
    tangent = mi.Spectrum(0)
    point = small_points(samples)
    with dr.resume_grad():
        radiance = point.radiance()
        if samples.plan.differentiate_emission:
            [tangent] = forward_derivatives(radiance)
    shape = dr.reinterpret_array(mi.UInt32, point.emitter.get_shape())
    suspect = Suspect(mi.UInt32(0), mi.UInt32(0), point.si.p, shape, dr.detach(radiance))
    return suspect, tangent, point.u, point.active


def _first(bad: Array, there: Array) -> tuple[int | None, bool]:
    """The first of the bad lanes, of those that are `there` if any are; and whether it is."""
    lanes = np.flatnonzero(bad)
    preferred = np.flatnonzero(bad & there)
    if preferred.size:
        return int(preferred[0]), True
    return (int(lanes[0]) if lanes.size else None), False


@dataclass
class Describe:
    """Makes a record of one lane's suspect."""

    samples: Samples
    sensor: int
    label: str

    def __call__(self, suspect: Suspect, u: Any, lane: int, quantity: str | None = None) -> Offender:
        def number(value: Any) -> Any:
            return np.array(value).ravel()[lane % dr.width(value)]

        where = PathVertex(
            samples=self.label,
            seed=int(self.samples.seed[0]),
            path=lane,
            paths=self.samples.width,
            vertex=int(number(suspect.vertex)),
            position=(float(number(suspect.p.x)), float(number(suspect.p.y)), float(number(suspect.p.z))),
            surface=_shape_name(self.samples.scene, int(number(suspect.shape))),
        )
        pixel = (int(np.floor(number(u.x))), int(np.floor(number(u.y))))
        value = [float(number(channel)) for channel in suspect.value]
        return Offender(self.sensor, pixel, quantity or QUANTITIES[int(number(suspect.kind))], value, where)


def _shape_name(scene: Any, index: int) -> str | None:
    for shape in scene.shapes():
        if int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) == index:
            return str(shape.id())
    return None
