"""Directly visible light of lamps that move, or that are smaller than a pixel: points on these lamps.

A point x on a lamp has the following contribution at its film position u(x).

    C_0 = Le(x) |n . w| W(x) / p(x)

For a moving lamp, the formula for C_0 has the derivative with respect to the lamp's position. Film position, normal and
density move with the lamp. The outline of the lamp is included, because points at its rim move, too. Occlusion of and
by the lamp is missing. Primary rays (`emission.py`) give C_0 itself, and its derivative with respect to radiance.

Primary rays rarely hit lamps smaller than a pixel. For lamps smaller than a pixel, points on the lamps give C_0 itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.graph import Lamp
from reslrb_cli.transport.connection import connect, passage
from reslrb_cli.transport.film import Colours
from reslrb_cli.transport.lamps import lamp_point, wavelengths_of
from reslrb_cli.transport.samples import LAMP_STREAM, SMALL_LAMP_STREAM, Samples


def moving_splats(samples: Samples) -> Iterator[tuple[mi.Point2f, mi.Spectrum, mi.Bool, Colours]]:
    """Yield film position u, C_0 (C,), the active lanes and the wavelengths for each visible lamp that moves.

    If gradients are enabled, u and C_0 have derivatives. Primary rays have already added the light of these lamps to
    the image.
    """
    for lamp in samples.plan.visible_moving_lamps:
        point = _points(samples, (lamp,), mi.UInt32(lamp.index), LAMP_STREAM + lamp.index, True)
        # Points stay at their place on the lamp, so moving parts do not affect their radiance.
        C = dr.select(point.active, dr.detach(point.radiance()) * point.weight, 0)
        yield point.u, C, point.active, samples.film.colours(point.si.wavelengths)


def small_splat(samples: Samples) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool, Colours]:
    """Return film position u, C_0 (C,), the active lanes and the wavelengths for lamps smaller than a pixel.

    If gradients are enabled, C_0 has its derivative with respect to radiance.
    """
    point = small_points(samples)
    C = dr.select(point.active, point.radiance() * point.weight, 0)
    return point.u, C, point.active, samples.film.colours(point.si.wavelengths)


def small_points(samples: Samples) -> LampPoints:
    """Return detached points on the lamps smaller than a pixel. Successive lanes use the lamps in turn."""
    lamps = samples.plan.small_lamps
    count, lane = dr.opaque(mi.UInt32, samples.width), dr.arange(mi.UInt32, samples.width)
    turn, index = lane % len(lamps), mi.UInt32(lamps[0].index)
    for number, lamp in enumerate(lamps):
        index = dr.select(turn == number, mi.UInt32(lamp.index), index)
    lanes = count // len(lamps) + dr.select(turn < count % len(lamps), mi.UInt32(1), 0)
    with dr.suspend_grad():
        point = _points(samples, lamps, index, SMALL_LAMP_STREAM, attached=False)
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


def _points(samples: Samples, lamps: Sequence[Lamp], index: mi.UInt32, stream: int, attached: bool) -> LampPoints:
    """Return a point on each lane's lamp. `index` is the lamp's index in `scene.emitters()`, and `stream` names the
    stream of random numbers.
    """
    plan, sensor, next_1d = samples.plan, samples.sensor, samples.stream(stream).next_float32
    time = samples.time(next_1d)
    position, aperture = mi.Point2f(next_1d(), next_1d()), mi.Point2f(next_1d(), next_1d())
    emitter = dr.gather(mi.EmitterPtr, samples.scene.emitters_dr(), index)
    found = {lamp.emitter: (lamp, samples.areas.get(lamp), lamp in plan.evened_lamps) for lamp in lamps}

    def point(
        self: mi.Emitter, time: mi.Float, position: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        if self not in found:  # a shape of this scene, or of another one
            return dr.zeros(mi.SurfaceInteraction3f), mi.Float(0)
        lamp, areas, evened = found[self]
        return lamp_point(lamp, areas, time, position, active, evened)

    si, weight = dr.dispatch(emitter, point, time, position, mi.Bool(True))  # as in `sample_emission`
    si.time = time
    if mi.is_spectral:
        si.wavelengths, inverse = wavelengths_of(next_1d())
    connection = connect(plan, sensor, si, None, aperture, mi.Bool(True), attached=attached)
    cos = dr.dot(si.n, si.to_world(connection.wo))
    connection.active = connection.active & (cos > 0)
    si.wi = connection.wo
    with dr.suspend_grad():
        active, through = passage(plan, samples.scene, si, mi.UInt32(0), connection)
    weight = through * (cos * weight) * connection.rest * samples.scale
    if mi.is_spectral:
        weight *= inverse
    return LampPoints(emitter, si, connection.u, weight, active)
