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
    choice, results = mi.Float(random.random(PROBES, np.float32)), []
    with dr.suspend_grad():
        for changed in range(-1, 4):
            x = [mi.Float(other[k] if k == changed else first[k]) for k in range(4)]
            e = emission_of(samples, mi.Float(0), choice, mi.Point2f(x[0], x[1]), mi.Point2f(x[2], x[3]))
            results.append([e.ray.o, e.ray.d, e.weight])
        dr.eval(results)
    found = [np.concatenate([np.array(part) for part in parts]) for parts in results]
    return [not np.array_equal(found[0], varied, equal_nan=True) for varied in found[1:]]
