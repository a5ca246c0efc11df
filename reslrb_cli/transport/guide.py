"""Guided emission and guided roulette: light paths start and go on where earlier ones had something to say.

Roulette: paths that go where earlier ones had little left to say end early. The scene's bounding box is cut into cubes,
and the directions of each cube into octants. A path that leaves a vertex with throughput w (the largest channel,
emission and the weights of earlier roulette included) goes on with probability

    q = min(1, max(LEAST, w s))        s: the number of the cell that the vertex and the new direction lie in

and counts for 1 / q if it does. The mean of whatever is computed from paths stays what it was for any s that does not
depend on the random numbers that it is used with. How s is learned says `guiding/collect.py`.

The more a path has been weighted up, the larger is its w, and so its q: since q is at least w s where it is below 1, no
throughput is raised beyond 1 / s_0, where s is nowhere below s_0. Roulette on throughput alone is played beside it from
`rr_depth` on, so that paths end that nothing else would end.

Emission: a path's start is a point of the unit cube in four dimensions (two numbers for a place or a disk, two for a
direction) and a number that chooses an emitter. The cube is cut into cells, for each emitter its own. A cell k of
measure v_k is drawn with probability p_k; within it numbers stay evenly spread, and the path's weight is multiplied by
v_k / p_k. Whatever an emitter makes of its numbers, the mean of what a path contributes stays what it was, as long as
every cell can be drawn and p does not depend on the numbers that it is used with.

Drawing takes one look-up: of M slots, cell k owns m_k, and p_k = m_k / M exactly. Lanes draw stratified, lane i of n
from the i-th n-th of all slots: what is left of the noise is that within cells, and paths that start alike are traced
side by side. At least GUIDE_UNIFORM of all slots are shared out evenly, so that no table makes a weight larger than
1 / GUIDE_UNIFORM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.transport.film import Blocks
from reslrb_cli.transport.plan import Grid, least_slots

Array = np.ndarray[Any, Any]
BITS = 4  # cubes along each axis of the box, log2
OCTANTS = 8
CELLS = OCTANTS << (3 * BITS)
SHAPE = (1 << BITS, 1 << BITS, 1 << BITS, OCTANTS)  # of an array of all cells
LEAST = 0.5  # the smallest probability of going on


@dataclass
class Survival:
    """`chances` (CELLS) are s of all cells; `corner` is where the box begins, `cubes` how many there are to a unit of
    length along each axis. The latter two are opaque."""

    chances: mi.Float
    corner: mi.Point3f
    cubes: mi.Vector3f

    @staticmethod
    def of(box: Array, chances: Array) -> Survival:
        """For a box (2, 3), its lower and its upper corner."""
        cubes = (1 << BITS) / np.where(box[1] > box[0], box[1] - box[0], np.inf)
        own = own_memory(mi.Float, chances.astype(np.float32))
        corner, per_unit = (
            kind(*(dr.opaque(mi.Float, float(x)) for x in values))
            for kind, values in ((mi.Point3f, box[0]), (mi.Vector3f, cubes))
        )
        return Survival(own, corner, per_unit)

    @staticmethod
    def certain() -> Survival:
        """That of somebody who has learned nothing: all paths go on."""
        return Survival.of(np.zeros((2, 3)), np.full(CELLS, np.inf))

    def cell(self, o: mi.Point3f, d: mi.Vector3f) -> mi.UInt32:
        """The cell of a ray that leaves `o`; what lies outside of the box counts to the nearest cube."""
        place, most = dr.detach((o - self.corner) * self.cubes), (1 << BITS) - 1
        result = mi.UInt32(0)
        for k in range(3):
            # A second bound in integers: what NaN becomes is not defined, and may not leave the table.
            result = (result << BITS) | dr.minimum(mi.UInt32(dr.clip(place[k], 0, most)), most)
        for k in range(3):
            result = (result << 1) | dr.select(d[k] > 0, mi.UInt32(1), 0)
        return result

    def probability(self, o: mi.Point3f, d: mi.Vector3f, throughput: mi.Float) -> mi.Float:
        """q of a ray that leaves `o` along `d`; detached."""
        # A throughput that is not a number has q = LEAST: it is to be seen, not to vanish.
        chance = dr.gather(mi.Float, self.chances, self.cell(o, d))
        return dr.fmin(dr.fmax(dr.detach(throughput) * chance, LEAST), 1)


def box_of(scene: mi.Scene) -> Array:
    """The box (2, 3) of a scene's shapes, float32; of size 0 where it has none."""
    bounds = scene.bbox()
    box = np.array([np.array(bounds.min).ravel(), np.array(bounds.max).ravel()], np.float32)
    return box if np.isfinite(box).all() and (box[1] >= box[0]).all() else np.zeros((2, 3), np.float32)


CELL_BITS = 19  # cells of all emitters together, log2
MOST_EMITTERS = 1024  # that have cells of their own; of more, neighbours share theirs


def make_grid(used: Sequence[bool], weights: Sequence[float], cell_bits: int = CELL_BITS) -> Grid:
    """A grid of at most 2^cell_bits cells for emitters of these sampling weights, cut along the used numbers."""
    if not sum(weights) > 0:
        weights = [1.0] * max(len(weights), 1)  # nothing shines; the grid is of no use, and does no harm
    total = np.append(0.0, np.cumsum(np.asarray(weights, np.float64)))
    groups = min(len(weights), MOST_EMITTERS)
    edges = (total / total[-1])[np.round(np.linspace(0, len(weights), groups + 1)).astype(int)]
    bits = [0, 0, 0, 0]
    budget = cell_bits - (groups - 1).bit_length()
    along = [k for k in range(4) if used[k]]
    for k in range(budget if along else 0):
        bits[along[k % len(along)]] += 1
    return Grid((bits[0], bits[1], bits[2], bits[3]), tuple(float(np.float32(edge)) for edge in edges))


def apportion(grid: Grid, density: Array) -> Array:
    """Slots of each cell (int64), at least UNIFORM of its measure, the others in proportion to `density`."""
    least = least_slots(grid)
    # Rounded along the cells' order, so that what one loses a neighbour gains.
    ends = np.cumsum(density, dtype=np.float64)
    ends *= (grid.slots - least.sum()) / ends[-1]
    np.rint(ends, out=ends)
    counts = least.copy()
    counts[0] += ends[0]
    counts[1:] += ends[1:]
    counts[1:] -= ends[:-1]
    return counts.astype(np.int64)


@dataclass
class Aim:
    """Where on the film paths are sent: the block of each slot (SLOTS), and the density of each block's positions,
    relative to an even one."""

    slots: mi.UInt32
    density: mi.Float

    @staticmethod
    def of(blocks: Blocks, wanted: NDArray[np.float64]) -> Aim:
        """Blocks in proportion to `wanted` (rows * columns), nowhere negative, and UNIFORM of them evenly."""
        even = blocks.areas() / blocks.areas().sum()
        total = wanted.sum()
        density = AIM_UNIFORM * even + (1 - AIM_UNIFORM) * (
            wanted / total if np.isfinite(total) and total > 0 else even
        )
        # One each, so that there is none that no path is sent to; the others rounded along the blocks' order.
        ends = np.rint(np.cumsum(density) * ((AIM_SLOTS - len(even)) / density.sum()))
        counts = 1 + np.diff(ends, prepend=0).astype(np.int64)
        return Aim(
            own_memory(mi.UInt32, np.repeat(np.arange(len(counts), dtype=np.uint32), counts)),
            own_memory(mi.Float, (counts / AIM_SLOTS / even).astype(np.float32)),
        )


@dataclass
class Table:
    """What is drawn from: of each slot its cell, of each cell v / p, and the grid's edges; which paths go on, and
    where those that scatter are sent."""

    slots: mi.UInt32
    weights: mi.Float
    edges: mi.Float
    survival: Survival
    aim: Aim | None = None

    @staticmethod
    def of(grid: Grid, counts: Array, survival: Survival | None = None, aim: Aim | None = None) -> Table:
        """The table in which cell k has `counts[k]` slots, all of them together `grid.slots`."""
        weights = grid.measures() * grid.slots  # 0 where there is no slot
        weights /= np.maximum(counts, 1)
        return Table(
            own_memory(mi.UInt32, np.repeat(np.arange(grid.cells, dtype=np.uint32), counts)),
            own_memory(mi.Float, weights.astype(np.float32)),
            own_memory(mi.Float, np.array(grid.edges, np.float32)),
            survival or Survival.certain(),
            aim,
        )


def even_table(grid: Grid, film: Blocks | None = None) -> Table:
    """The table of somebody who has learned nothing; paths are aimed at all of the `film`, if any."""
    aim = None if film is None else Aim.of(film, film.areas())
    return Table.of(grid, apportion(grid, grid.measures()), aim=aim)


@dataclass
class Drawn:
    """Numbers that were drawn with a guide: those of emission, the cell they lie in, and v / p of it."""

    choice: mi.Float
    position: mi.Point2f
    direction: mi.Point2f
    cell: mi.UInt32
    weight: mi.Float


@dataclass
class Guide:
    """A table, and how many lanes share it (opaque)."""

    table: Table
    lanes: mi.UInt64

    @staticmethod
    def of(table: Table, width: int) -> Guide:
        """For a pass of `width` light paths."""
        return Guide(table, dr.opaque(mi.UInt64, width))

    def draw(
        self,
        grid: Grid,
        width: int,
        stream: mi.PCG32,
        choice: mi.Float,
        position: mi.Point2f,
        direction: mi.Point2f,
    ) -> Drawn:
        """Where each of `width` lanes starts; `choice`, `position` and `direction` say where within its cell."""
        lane, jitter = mi.UInt64(dr.arange(mi.UInt32, width)), mi.UInt64(stream.next_uint32())
        slot = ((lane << 32) | jitter) // self.lanes >> (32 - (grid.slots.bit_length() - 1))
        cell = dr.gather(mi.UInt32, self.table.slots, mi.UInt32(slot))
        weight = dr.gather(mi.Float, self.table.weights, cell)
        numbers, shift, below = [position.x, position.y, direction.x, direction.y], 0, dr.one_minus_epsilon(mi.Float)
        for k, bits in enumerate(grid.bits):
            if bits > 0:
                index = (cell >> shift) & ((1 << bits) - 1)
                # Rounding may have it meet the next cell, but not leave the cube.
                numbers[k] = dr.minimum((mi.Float(index) + numbers[k]) * 2.0**-bits, below)
                shift += bits
        if grid.emitters > 1:
            emitter = cell >> shift
            begin, end = (dr.gather(mi.Float, self.table.edges, emitter + k) for k in (0, 1))
            choice = dr.minimum(dr.fma(choice, end - begin, begin), end * below)
        return Drawn(choice, mi.Point2f(numbers[0], numbers[1]), mi.Point2f(numbers[2], numbers[3]), cell, weight)


AIM_UNIFORM = 0.2  # of these, how many are sent to places drawn evenly on the film, at least
AIM_SLOTS = 1 << 17
