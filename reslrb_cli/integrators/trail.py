"""The vertices of a path, kept until it ends: only then is it known what it went on to say behind each of them.

They lie in thread-local memory, the first PLACES of them; what later ones say is summed. From the last one back the sum
over all later vertices is at hand when a vertex is reached, as in `estimators/stack.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.transport.survival import CELLS

Array = np.ndarray[Any, Any]

PLACES = 32  # vertices


@dataclass
class Trail:
    """Loop state. Of each vertex: what it says, by voice (C,), and about the image; the cell that its ray leaves by;
    one over its throughput, 0 where none leaves; the weight of roulette.

    No place of thread-local memory can be written twice; what finds no room goes to one more, which nobody reads.
    """

    parts: list[dr.Local]
    image: dr.Local
    cell: dr.Local
    inverse: dr.Local
    weight: dr.Local
    count: mi.UInt32  # vertices so far
    later: list[mi.Spectrum]  # what those said that found no room
    later_image: mi.Float

    @staticmethod
    def begin(voices: int) -> Trail:
        """An empty one, for so many voices beside the image."""
        parts = [dr.alloc_local(mi.Spectrum, PLACES + 1) for _ in range(voices)]
        floats = [dr.alloc_local(mi.Float, PLACES + 1) for _ in range(3)]
        cell = dr.alloc_local(mi.UInt32, PLACES + 1)
        later = [mi.Spectrum(0) for _ in range(voices)]
        return Trail(parts, floats[0], cell, floats[1], floats[2], mi.UInt32(0), later, mi.Float(0))

    def said(self, parts: list[mi.Spectrum], image: mi.Float) -> Trail:
        """With one more vertex, and what it says."""
        fits, place = self._place(self.count)
        for array, part in zip(self.parts, parts, strict=True):
            array.write(part, place, fits)
        self.image.write(image, place, fits)
        later = [a + dr.select(fits, 0, part) for a, part in zip(self.later, parts, strict=True)]
        later_image = self.later_image + dr.select(fits, 0, image)
        return replace(self, count=self.count + 1, later=later, later_image=later_image)

    def leaves(self, cell: mi.UInt32, inverse: mi.Float) -> None:
        """Write how the ray of the vertex that was named last leaves it."""
        fits, place = self._place(self.count - 1)
        self.cell.write(cell, place, fits)
        self.inverse.write(inverse, place, fits)

    def survives(self, weight: mi.Float) -> None:
        """Write the weight of roulette there."""
        fits, place = self._place(self.count - 1)
        self.weight.write(weight, place, fits)

    @staticmethod
    def _place(number: mi.UInt32) -> tuple[mi.Bool, mi.UInt32]:
        fits = number < PLACES
        return fits, dr.select(fits, number, PLACES)


@dataclass
class Onwards:
    """Sums over all paths, by the cell that a ray leaves a vertex by (`transport/survival.py`): the squares of what
    paths still said at a throughput of 1 (voices * CELLS), voice by voice, the image last; the vertices that followed
    (CELLS); the rays that left (CELLS)."""

    squares: mi.Float
    followed: mi.Float
    left: mi.Float

    def arrays(self, voices: int) -> tuple[Array, Array, Array]:
        """The same in NumPy's arrays, the first of shape (voices, CELLS)."""
        return np.array(self.squares).reshape(voices, CELLS), np.array(self.followed), np.array(self.left)


def walk_back(trail: Trail) -> Onwards:
    """What all paths went on to say; what is not finite does not count.

    What roulette lets live it weights up by 1 / q: of all rays that leave, whether it lets them live or not, q times
    such a square and 1 / q times such a number of vertices have the means that they would have without it.
    """
    voices = len(trail.parts) + 1
    squares, followed, left = (dr.zeros(mi.Float, rows * CELLS) for rows in (voices, 1, 1))

    def add(target: mi.Float, value: mi.Float, cell: mi.UInt32, active: mi.Bool) -> None:
        dr.scatter_reduce(dr.ReduceOp.Add, target, value, cell, active & dr.isfinite(value) & (value > 0))

    def body(height: mi.UInt32, after: list[mi.Spectrum], image: mi.Float, trail: Trail) -> Any:
        place = height - 1
        cell, inverse, weight = (array.read(place) for array in (trail.cell, trail.inverse, trail.weight))
        leaves = inverse > 0
        q = dr.rcp(weight)
        for voice, still in enumerate(after):
            add(squares, dr.squared_norm(still * inverse) * q, cell + voice * CELLS, leaves)
        add(squares, image * dr.square(inverse) * q, cell + len(after) * CELLS, leaves)
        add(followed, mi.Float(trail.count - height) * weight, cell, leaves)
        add(left, mi.Float(1), cell, leaves)
        after = [still + array.read(place) for still, array in zip(after, trail.parts, strict=True)]
        return place, after, image + trail.image.read(place), trail

    dr.while_loop(
        state=(dr.minimum(trail.count, PLACES), trail.later, trail.later_image, trail),
        cond=lambda height, after, image, trail: height > 0,
        body=body,
        labels=("height", "after", "image", "trail"),
        label="walk back over what is heard",
    )
    return Onwards(squares, followed, left)
