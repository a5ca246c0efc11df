"""Guided emission: light paths start where earlier paths contributed.

The start of a path is a point of the four-dimensional unit cube, and a number that selects an emitter. Two coordinates
of the point give a place or a position on a disk. The two other coordinates give a direction. The cube is divided into
cells, separately for each emitter. A cell k with measure v_k is sampled with probability p_k. Random numbers are
uniform within the cell k, and the path's weight is multiplied by v_k / p_k. Guiding does not change the expected
contribution of a path under two conditions. Every cell can be sampled, and p does not depend on the random numbers with
which p is used.

Sampling takes one lookup. Cell k has m_k of the M slots, and p_k is exactly m_k / M. Lanes are stratified. The slots
are divided into n equal parts for n lanes, and lane i samples from part i. Only the noise within cells remains, and
similar paths are traced side by side. At least a share GUIDE_UNIFORM of all slots is distributed evenly. Therefore no
weight is larger than 1 / GUIDE_UNIFORM.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.transport.aim import Aim
from reslrb_cli.transport.factors import Survival
from reslrb_cli.transport.plan import Grid, least_slots

Array = np.ndarray[Any, Any]
CELL_BITS = 19  # cells of all emitters together, log2
MOST_EMITTERS = 1024  # with their own cells; among more emitters, neighbours share cells


def make_grid(used: Sequence[bool], weights: Sequence[float], cell_bits: int = CELL_BITS) -> Grid:
    """Return a grid of at most 2^cell_bits cells for emitters with these sampling weights. Only the used numbers are
    divided.
    """
    if not sum(weights) > 0:
        weights = [1.0] * max(len(weights), 1)  # no emitter emits; the grid has no use, and no effect
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
    """Return the slots of each cell (int64). Each cell has at least the slots that correspond to GUIDE_UNIFORM times
    its measure. The remaining slots are proportional to `density`.
    """
    least = least_slots(grid)
    # Rounded along the order of the cells, so that neighbours balance.
    ends = np.cumsum(density, dtype=np.float64)
    ends *= (grid.slots - least.sum()) / ends[-1]
    np.rint(ends, out=ends)
    counts = least.copy()
    counts[0] += ends[0]
    counts[1:] += ends[1:]
    counts[1:] -= ends[:-1]
    return counts.astype(np.int64)


@dataclass
class Table:
    """Table for sampling.

    `slots` holds the cell of each slot, `weights` holds v / p of each cell, and `edges` holds the edges of the grid.
    `survival` and `aim` hold data for roulette and aiming.
    """

    slots: mi.UInt32
    weights: mi.Float
    edges: mi.Float
    survival: Survival
    aim: Aim | None = None

    @staticmethod
    def of(grid: Grid, counts: Array, survival: Survival | None = None, aim: Aim | None = None) -> Table:
        """Return the table in which cell k has `counts[k]` slots. The total is `grid.slots`."""
        weights = grid.measures() * grid.slots  # 0 without a slot
        weights /= np.maximum(counts, 1)
        return Table(
            own_memory(mi.UInt32, np.repeat(np.arange(grid.cells, dtype=np.uint32), counts)),
            own_memory(mi.Float, weights.astype(np.float32)),
            own_memory(mi.Float, np.array(grid.edges, np.float32)),
            survival or Survival.certain(),
            aim,
        )


@dataclass
class Drawn:
    """Random numbers of emission that a guide has drawn. `cell` is the cell of these numbers, and `weight` is the
    cell's v / p.
    """

    choice: mi.Float
    position: mi.Point2f
    direction: mi.Point2f
    cell: mi.UInt32
    weight: mi.Float


@dataclass
class Guide:
    """Table, and the number of lanes that share the table. The number is opaque."""

    table: Table
    lanes: mi.UInt64

    @staticmethod
    def of(table: Table, width: int) -> Guide:
        """Return a guide for a pass of `width` light paths."""
        return Guide(table, dr.opaque(mi.UInt64, width))

    def draw(
        self, grid: Grid, width: int, stream: mi.PCG32, choice: mi.Float, position: mi.Point2f, direction: mi.Point2f,
    ) -> Drawn:  # fmt: skip
        """Draw the start of each of `width` lanes. The random numbers `choice`, `position` and `direction` determine
        the start's place within its cell.
        """
        lane, jitter = mi.UInt64(dr.arange(mi.UInt32, width)), mi.UInt64(stream.next_uint32())
        slot = ((lane << 32) | jitter) // self.lanes >> (32 - (grid.slots.bit_length() - 1))
        cell = dr.gather(mi.UInt32, self.table.slots, mi.UInt32(slot))
        weight = dr.gather(mi.Float, self.table.weights, cell)
        numbers, shift, below = [position.x, position.y, direction.x, direction.y], 0, dr.one_minus_epsilon(mi.Float)
        for k, bits in enumerate(grid.bits):
            if bits > 0:
                index = (cell >> shift) & ((1 << bits) - 1)
                # Rounding may reach the next cell, but must not leave the cube.
                numbers[k] = dr.minimum((mi.Float(index) + numbers[k]) * 2.0**-bits, below)
                shift += bits
        if grid.emitters > 1:
            emitter = cell >> shift
            begin, end = (dr.gather(mi.Float, self.table.edges, emitter + k) for k in (0, 1))
            choice = dr.minimum(dr.fma(choice, end - begin, begin), end * below)
        return Drawn(choice, mi.Point2f(numbers[0], numbers[1]), mi.Point2f(numbers[2], numbers[3]), cell, weight)
