"""Rays from sensors and emitters, and the wavelengths of their light."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.errors import UnsupportedScene, is_machine_fault


def grid(side: int) -> mi.Point2f:
    """Return the centres of side^2 cells of the unit square, row by row."""
    lane = dr.arange(mi.UInt32, side**2)
    return (mi.Point2f(lane % side, lane // side) + 0.5) / side


def emitted_rays(
    scene: mi.Scene, wavelength: mi.Float, place: mi.Point2f, direction: mi.Point2f
) -> tuple[mi.Ray3f, mi.Spectrum]:
    """Return rays from all emitters, and their weights, from random numbers in [0, 1).

    Raises UnsupportedScene if Mitsuba cannot sample an emitter, such as a lamp or a spot with a checkerboard. The error
    names the emitter.
    """
    try:
        ray, weight, _ = scene.sample_emitter_ray(0, wavelength, place, direction, True)
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        half = mi.Point2f(0.5)
        calls = {emitter.id(): partial(emitter.sample_ray, 0, 0.5, half, half, True) for emitter in scene.emitters()}
        names = ", ".join(id for id, call in calls.items() if failure(call) is not None)
        reason = " ".join(str(error).split())
        problem = f"Mitsuba cannot sample the rays of emitter {names}: {reason}; give it a `bitmap`"
        raise UnsupportedScene(problem) from None
    return ray, weight


def visible(spacing: float = 5.0) -> np.ndarray:
    """Return evenly spaced visible wavelengths in nm. Mitsuba's colour matching functions have values every 5 nm."""
    return np.arange(360.0, 830.0 + spacing / 2, spacing)


def no_wavelengths() -> mi.Wavelength:
    """Return the wavelengths of light that has none yet: zeros in a spectral variant, otherwise an empty array."""
    return mi.Spectrum(0) if mi.is_spectral else mi.Color0f()


def brightness(value: mi.Spectrum, wavelengths: mi.Wavelength) -> mi.Float:
    """Return the luminance of light with the values (C,)."""
    if mi.is_spectral:
        return mi.luminance(value, wavelengths)
    return mi.luminance(value) if mi.is_rgb else mi.Float(value.x)


def shadow_ray(si: mi.Interaction3f, target: mi.Point3f, has_edges: bool) -> mi.Ray3f:
    """Return the ray from the vertex `si` to `target`.

    Mitsuba's ray starts above the surface. At a grazing angle, it can pass an edge that hides the vertex, so the
    derivatives of edges would lack a part of the surface. With `has_edges`, the ray starts on the line to the target.
    """
    if not has_edges:
        return si.spawn_ray_to(target)
    there = target - si.p
    distance = dr.norm(there)
    d = there / distance
    offset = ray_offset(si.p)
    ray = mi.Ray3f(si.p + d * offset, d, si.time, si.wavelengths)
    ray.maxt = (distance - offset) * (1 - mi.math.ShadowEpsilon)
    return ray


def past_lamps(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.Ray3f:
    """Return the rays. Each origin is moved behind any lamps that the ray meets first, and the end of the ray stays."""

    def body(active: mi.Bool, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Ray3f]:
        si = scene.ray_intersect(ray, active)
        lamp = active & si.is_valid() & (si.emitter(scene) != dr.zeros(mi.EmitterPtr))
        behind = si.spawn_ray(ray.d)
        behind.maxt = ray.maxt - si.t
        return lamp, dr.select(lamp, behind, ray)

    _, ray = dr.while_loop((mi.Bool(active), mi.Ray3f(ray)), lambda active, ray: active, body, label="hidden lamps")
    return ray


def is_hidden(
    scene: mi.Scene, si: mi.Interaction3f, target: mi.Point3f, has_edges: bool, active: mi.Bool,
    passes_lamps: bool = False,
) -> mi.Bool:  # fmt: skip
    """True if a surface lies between the vertex `si` and `target`. With `passes_lamps`, it is not a lamp.

    With `has_edges`, the shadow ray starts on the line to the target. A second ray finds surfaces between the vertex
    and this start, for example at a corner in which two sheets meet.
    """

    def is_blocked(ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        return scene.ray_test(past_lamps(scene, ray, active) if passes_lamps else ray, active)

    ray = shadow_ray(si, target, has_edges)
    hidden = is_blocked(ray, active)
    return hidden | is_blocked(si.spawn_ray_to(ray.o), active & ~hidden) if has_edges else hidden


def ray_offset(p: mi.Point3f) -> mi.Float:
    """Return Mitsuba's ray offset at `p`."""
    return mi.math.RayEpsilon * (1 + dr.max(dr.abs(p)))


def sensor_rays(
    sensor: mi.Sensor, time: float | mi.Float, place: mi.Point2f, aperture: mi.Point2f,
    wavelength: float | mi.Float = 0.5,
) -> tuple[mi.Ray3f, mi.Spectrum]:  # fmt: skip
    """Return rays from a sensor, and their weights. `place` on the film and `aperture` are in [0, 1)^2, and the random
    number `wavelength` is in [0, 1).

    The function uses the call that every sensor has, because an irradiance meter has no `sample_ray`.
    """
    ray, weight = sensor.sample_ray_differential(time, wavelength, place, aperture, True)
    if mi.is_spectral and (response := sensor.film().sensor_response_function()) is not None:
        # The film's response belongs to `Colours`, as in light paths.
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wavelengths = ray.wavelengths
        total = response.eval(si)
        weight = mi.Spectrum(dr.select(total > 0, weight / total, 0))
    return mi.Ray3f(ray), weight


def failure(call: Callable[[], object]) -> str | None:
    """Return, in one line, Mitsuba's reason for the failure of `call`, or None if the call succeeds."""
    try:
        with dr.suspend_grad():
            call()
    except RuntimeError as error:
        if is_machine_fault(error):
            raise
        return " ".join(str(error).split())
    return None
