"""Lamps that move and are seen directly: the derivative of C_0 by where they are.

C_0 is sampled by primary rays, along which a lamp is hit or not: that has no derivative. So what is differentiated is
the same light as points of the lamp send it,

    C_0 = Le(x) |n . w| W(x) / p(x)        at film position u(x)

whose film position, normal and density move with the lamp. Its own outline needs no care then: the points at the rim
move, too. What stands before the lamp is missing, and so is what it covers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.lamps import Lamp
from reslrb_cli.transport.connection import connect
from reslrb_cli.transport.emission import sample_time
from reslrb_cli.transport.lamps import lamp_point

if TYPE_CHECKING:
    from reslrb_cli.transport.samples import Samples


def moving_splats(samples: Samples) -> Iterator[tuple[mi.Point2f, mi.Spectrum, mi.Bool]]:
    """For each lamp that moves and can be seen: film position u, C_0 (C,), and the active lanes.

    u and C_0 have their derivatives where gradients are enabled; what they sum up to is already in the image.
    """
    for lamp in samples.plan.visible_moving_lamps:
        yield _splat(samples, lamp)


def _splat(samples: Samples, lamp: Lamp) -> tuple[mi.Point2f, mi.Spectrum, mi.Bool]:
    plan, sensor, numbers = samples.plan, samples.sensor, samples.lamp_numbers(lamp)
    time = sample_time(plan, sensor, numbers)
    position, aperture = numbers.next_2d(), numbers.next_2d()
    emitter = dr.gather(mi.EmitterPtr, samples.scene.emitters_dr(), mi.UInt32(lamp.index))
    areas = samples.areas(lamp)

    def point(
        self: mi.Emitter, time: mi.Float, position: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        if self != lamp.emitter:  # of this scene, or of another one
            return dr.zeros(mi.SurfaceInteraction3f), mi.Float(0)
        return lamp_point(lamp, areas, time, position, active)

    si, weight = dr.dispatch(emitter, point, time, position, mi.Bool(True))  # as in `sample_emission`
    si.time = time
    connection = connect(plan, sensor, si, None, aperture, mi.Bool(True), attached=True)
    cos = dr.dot(si.n, si.to_world(connection.wo))
    active = connection.active & (cos > 0)
    si.wi = connection.wo
    radiance = emitter.eval(si, active)
    with dr.suspend_grad():
        active = active & ~samples.scene.ray_test(si.spawn_ray_to(connection.target), active)
    C = dr.select(active, radiance * (cos * weight) * connection.weight * samples.scale, 0)
    return connection.u, C, active
