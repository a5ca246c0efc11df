"""Guided emission: light paths start where earlier ones had something to say, and count for less there.

A path's start is a point of the unit cube in four dimensions (two numbers for a place or a disk, two for a direction)
and a number that chooses an emitter. The cube is cut into cells, for each emitter its own. A cell k of measure v_k is
drawn with probability p_k; within it numbers stay evenly spread, and the path's weight is multiplied by v_k / p_k.
Whatever an emitter makes of its numbers, the mean of what a path contributes stays what it was, as long as every cell
can be drawn and p does not depend on the numbers that it is used with.

Drawing takes one look-up: of M slots, cell k owns m_k, and p_k = m_k / M exactly. Lanes draw stratified, lane i of n
from the i-th n-th of all slots: what is left of the noise is that within cells, and paths that start alike are traced
side by side. At least UNIFORM of all slots are shared out evenly, so that no table makes a weight larger than
1 / UNIFORM.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.own_memory import own_memory
from reslrb_cli.transport.aim import Aim
from reslrb_cli.transport.blocks import Blocks
from reslrb_cli.transport.survival import Survival

Array = np.ndarray[Any, Any]

UNIFORM = 0.25  # share of paths that start evenly, at least
CELL_BITS = 19  # cells of all emitters together, log2
MOST_EMITTERS = 1024  # that have cells of their own; of more, neighbours share theirs
SLOTS_PER_CELL = 4  # one of them is the even share
SLOTS_OF_SEVERAL = 8  # where emitters have unequal shares, which are rounded up to whole slots


@dataclass(frozen=True)
class Grid:
    """How the cube is cut: into 2^bits along each of its four numbers, those of the place first.

    `edges` (E + 1) are where the share of each emitter (or of some together) in the choosing number begins and ends.
    """

    bits: tuple[int, int, int, int]
    edges: tuple[float, ...]

    @property
    def emitters(self) -> int:
        """How many emitters, or groups of them, have cells of their own."""
        return len(self.edges) - 1

    @property
    def cells(self) -> int:
        """Cells of all emitters; those of one stand together."""
        return self.emitters << sum(self.bits)

    @property
    def slots(self) -> int:
        """Slots, a power of two."""
        each = SLOTS_PER_CELL if self.emitters == 1 else SLOTS_OF_SEVERAL
        return 1 << (each * self.cells - 1).bit_length()

    @property
    def shape(self) -> tuple[int, ...]:
        """Of an array of all cells: the emitter, then the four numbers, the last of which comes first in a cell's index
        and so last here."""
        return (self.emitters, *(1 << bits for bits in reversed(self.bits)))

    def measures(self) -> Array:
        """v_k of all cells, float64, not to be written to; they sum to 1."""
        return _measures(self)

    def coarser(self, cells: float) -> Grid:
        """The same cut into at most so many cells, or one of each emitter; each is made of this one's."""
        bits = list(self.bits)
        while sum(bits) > 0 and self.emitters << sum(bits) > cells:
            bits[3 - bits[::-1].index(max(bits))] -= 1  # the one that was cut last
        return Grid((bits[0], bits[1], bits[2], bits[3]), self.edges)

    def summed(self, values: Array, coarser: Grid) -> Array:
        """Of values for these cells (cells,) the sums over each coarser one's, of the same type."""
        result = values.reshape(self.shape)
        for axis, few in enumerate(coarser.shape):
            while result.shape[axis] > few:
                rows = np.moveaxis(result, axis, 0)
                result = np.moveaxis(rows[::2] + rows[1::2], 0, axis)
        return result.ravel()

    def shared_out(self, values: Array, coarser: Grid) -> Array:
        """Of values for coarser cells, each one's spread evenly over its own; the inverse of `summed`."""
        result = values.reshape(coarser.shape) * (coarser.cells / self.cells)
        for axis, (fine, few) in enumerate(zip(self.shape, coarser.shape, strict=True)):
            result = result.repeat(fine // few, axis)
        return result.ravel()


@functools.lru_cache(maxsize=4)
def _measures(grid: Grid) -> Array:
    # Every table that is made asks for them, several times.
    result = np.repeat(np.diff(grid.edges) / (1 << sum(grid.bits)), 1 << sum(grid.bits))
    result.setflags(write=False)
    return result


@functools.lru_cache(maxsize=4)
def _least_slots(grid: Grid) -> Array:
    """Slots that each cell has at least, float64: UNIFORM of its measure."""
    measures = grid.measures()
    result = np.where(measures > 0, np.maximum(np.ceil(UNIFORM * grid.slots * measures - 1e-6), 1), 0)
    result.setflags(write=False)
    return result


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
    least = _least_slots(grid)
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
