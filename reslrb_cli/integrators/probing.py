"""Which of emission's random numbers the emitters of a scene make anything of."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.transport.emission import emission_of
from reslrb_cli.transport.samples import Samples

PROBES = 1024  # light paths that are looked at


def used_numbers(samples: Samples) -> list[bool]:
    """Which of the four numbers (place, direction) the emission of any emitter depends on."""
    random = np.random.default_rng(1)
    first, other = (random.random((4, PROBES), np.float32) for _ in range(2))
    choice = random.random(PROBES, np.float32)
    # All cases are lanes of one call, which has the code of every emitter in it: as they are, and one number changed.
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
