"""Lamps that are seen directly by points on them, in place of primary rays, which hit them or not.

    C_0 = Le(x) |n . w| W(x) / p(x)        at film position u(x)

Lamps that move have the derivative by where they are in this form: film position, normal and density move with the
lamp. Its own outline needs no care then: the points at the rim move, too. What stands before the lamp is missing, and
so is what it covers. Their light itself, and its derivative by their radiance, is that of primary rays.

Of lamps smaller than a pixel primary rays hit few or none: there this form is the light itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.lamps import Lamp
from reslrb_cli.transport.connection import connect, passage
from reslrb_cli.transport.emission import Numbered, sample_time
from reslrb_cli.transport.lamps import lamp_point

if TYPE_CHECKING:
    from reslrb_cli.transport.samples import Samples


def moving_splats(samples: Samples) -> Iterator[tuple[mi.Point2f, mi.Spectrum, mi.Bool]]:
    """For each lamp that moves and can be seen: film position u, C_0 (C,), and the active lanes.

    u and C_0 have their derivatives where gradients are enabled; what they sum up to is already in the image.
    """
    for lamp in samples.plan.visible_moving_lamps:
        yield _splat(samples, lamp)


def small_splat(samples: Samples) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
    """Of the lamps that are smaller than a pixel: film position u, C_0 (C,), and the active lanes.

    C_0 has its derivative by their radiance where gradients are enabled.
    """
    point = small_points(samples)
    return point.u, dr.select(point.active, point.radiance() * point.weight, 0), point.active


def small_points(samples: Samples) -> Points:
    """Points on the lamps that are smaller than a pixel, which take turns; detached."""
    lamps, numbers = samples.plan.small_lamps, samples.small_lamp_numbers()
    count, lane = dr.opaque(mi.UInt32, samples.width), dr.arange(mi.UInt32, samples.width)
    turn, index = lane % len(lamps), mi.UInt32(lamps[0].index)
    for number, lamp in enumerate(lamps):
        index = dr.select(turn == number, mi.UInt32(lamp.index), index)
    lanes = count // len(lamps) + dr.select(turn < count % len(lamps), mi.UInt32(1), 0)
    with dr.suspend_grad():
        point = _points(samples, lamps, index, numbers, attached=False)
    return replace(point, weight=dr.detach(point.weight) * (mi.Float(count) / mi.Float(lanes)))


@dataclass
class Points:
    """Points on lamps as the sensor sees them: `weight` (C,) is C_0 over radiance, as a part of the image."""

    emitter: mi.EmitterPtr
    si: mi.SurfaceInteraction3f
    u: mi.Point2f
    weight: mi.Spectrum
    active: mi.Bool

    def radiance(self) -> mi.Spectrum:
        """What leaves them towards the sensor (C,), with its derivative by their radiance where there is any."""
        return self.emitter.eval(self.si, self.active)


def _splat(samples: Samples, lamp: Lamp) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
    point = _points(samples, (lamp,), mi.UInt32(lamp.index), samples.lamp_numbers(lamp), attached=True)
    # Points stay where they are on the lamp, so that nothing that moves has a part in their radiance.
    radiance = dr.detach(point.radiance())
    return point.u, dr.select(point.active, radiance * point.weight, 0), point.active


def _points(samples: Samples, lamps: Sequence[Lamp], index: mi.UInt32, numbers: Numbered, attached: bool) -> Points:
    """A point of each lane's lamp, the one of that index in `scene.emitters()`."""
    plan, sensor = samples.plan, samples.sensor
    time = sample_time(plan, sensor, numbers)
    position, aperture = numbers.next_2d(), numbers.next_2d()
    emitter = dr.gather(mi.EmitterPtr, samples.scene.emitters_dr(), index)
    found = {lamp.emitter: (lamp, samples.areas(lamp), lamp in plan.evened_lamps) for lamp in lamps}

    def point(
        self: mi.Emitter, time: mi.Float, position: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        if self not in found:  # of this scene, or of another one
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
    return Points(emitter, si, connection.u, weight, active)
