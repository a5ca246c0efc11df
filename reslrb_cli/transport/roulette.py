"""Russian roulette on throughput, as in `ptracer`, and learned roulette. Learned roulette depends on the direction of a
path.

The learned roulette ends paths in directions where earlier paths contributed little. The bounding box of the scene is
divided into cubes, and the directions in each cube into octants. A path leaves a vertex with throughput w, the largest
channel including emission and earlier roulette. The path survives with probability q, and its weight is then divided by
q. The vertex and the new direction select a cell, and s is this cell's value.

    q = min(1, max(LEAST, w s))

Roulette does not change the expected value if s does not depend on the random numbers with which s is used.
`guiding/collect.py` explains how s is learned.

Paths with larger weights have a larger w, and so a larger q. If q is below 1, it is at least w s. Therefore no
throughput is raised beyond 1 / s_0, where s_0 is the smallest s. Roulette on throughput also applies from `rr_depth`
on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.transport.plan import Plan

Array = np.ndarray[Any, Any]
LIMIT = 0.95  # largest survival probability by throughput, as in `ptracer`
DIMMEST = 1e-30  # smallest emission for roulette, well above values that single precision rounds to zero
BITS = 4  # cubes along each axis of the box, log2
OCTANTS = 8
CELLS = OCTANTS << (3 * BITS)
SHAPE = (1 << BITS, 1 << BITS, 1 << BITS, OCTANTS)  # of an array of all cells
LEAST = 0.5  # smallest survival probability


@dataclass
class Survival:
    """Learned roulette. `chances` (CELLS) are s of all cells.

    `corner` is the lower corner of the box, and `cubes` the number of cubes per unit length along each axis. Both are
    opaque.
    """

    chances: mi.Float
    corner: mi.Point3f
    cubes: mi.Vector3f

    @staticmethod
    def of(box: Array, chances: Array) -> Survival:
        """Return the roulette for a box (2, 3), given by its lower and its upper corner."""
        cubes = (1 << BITS) / np.where(box[1] > box[0], box[1] - box[0], np.inf)
        own = own_memory(mi.Float, chances.astype(np.float32))
        corner, per_unit = (
            kind(*(dr.opaque(mi.Float, float(x)) for x in values))
            for kind, values in ((mi.Point3f, box[0]), (mi.Vector3f, cubes))
        )
        return Survival(own, corner, per_unit)

    @staticmethod
    def certain() -> Survival:
        """Return a roulette that ends no path."""
        return Survival.of(np.zeros((2, 3)), np.full(CELLS, np.inf))

    def cell(self, o: mi.Point3f, d: mi.Vector3f) -> mi.UInt32:
        """Return the cell of a ray that leaves `o`. Positions outside of the box belong to the nearest cube."""
        place, most = dr.detach((o - self.corner) * self.cubes), (1 << BITS) - 1
        result = mi.UInt32(0)
        for k in range(3):
            # A second bound in integers: the conversion of NaN is undefined, and the index must stay in the table.
            result = (result << BITS) | dr.minimum(mi.UInt32(dr.clip(place[k], 0, most)), most)
        for k in range(3):
            result = (result << 1) | dr.select(d[k] > 0, mi.UInt32(1), 0)
        return result

    def probability(self, o: mi.Point3f, d: mi.Vector3f, throughput: mi.Float) -> mi.Float:
        """Return the detached q of a ray that leaves `o` along `d`."""
        # A throughput of NaN has q = LEAST, so that it stays visible.
        chance = dr.gather(mi.Float, self.chances, self.cell(o, d))
        return dr.fmin(dr.fmax(dr.detach(throughput) * chance, LEAST), 1)


def box_of(scene: mi.Scene) -> Array:
    """Return the box (2, 3) of a scene's shapes, float32. Without shapes, its size is 0."""
    bounds = scene.bbox()
    box = np.array([np.array(bounds.min).ravel(), np.array(bounds.max).ravel()], np.float32)
    return box if np.isfinite(box).all() and (box[1] >= box[0]).all() else np.zeros((2, 3), np.float32)


def first_eta(light: mi.Float, guided: mi.Float | None) -> mi.Float:
    """Return a path's initial index of refraction for roulette. The index is larger if the emission `light` is dim.

    With an initial index of 1, roulette would end paths of small lamps at once, or all paths if the unit of light is
    large. `guided` is the weight of a guide, and is excluded. If the guide's weight were included, roulette would end
    paths that the guide samples often.
    """
    if guided is None:
        return dr.rsqrt(dr.clip(light, DIMMEST, 1))
    return dr.rsqrt(dr.clip(light / guided, DIMMEST, 1)) * dr.rsqrt(guided)


def play(
    plan: Plan, survival: Survival | None, depth: mi.UInt32, throughput: mi.Float, eta: mi.Float, o: mi.Point3f,
    d: mi.Vector3f, number: mi.Float,
) -> tuple[mi.Bool, mi.Float]:  # fmt: skip
    """Return whether a path survives at vertex `depth`, and the path's roulette weight. The path leaves the vertex with
    the ray (o, d).
    """
    q, playing = mi.Float(1), mi.Bool(False)
    if plan.roulette:
        q = dr.minimum(throughput * dr.square(eta), LIMIT)
        playing = depth + 1 > plan.rr_depth
    if survival is not None:
        learned = survival.probability(o, d, throughput)
        q, playing = dr.minimum(dr.select(playing, q, 1), learned), mi.Bool(True)
    return ~playing | (number < q), dr.select(playing, dr.rcp(q), 1)
