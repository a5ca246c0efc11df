"""Guiding of a scene's emission: tables for each sensor, learned from steps that are done, for those to come.

What the variance of a sum over paths is made of is the mean square of what those of a cell say; it is least where cells
are drawn in proportion to its root (`hearing.py` says what is heard). Each voice is scaled to a total of 1, so that no
parameter drowns another. Samples that serve image and gradient both are drawn half for the one, half for the other.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from reslrb_cli.integrators.hearing import MOST_VOICES, hear, voices
from reslrb_cli.integrators.probing import used_numbers
from reslrb_cli.transport.guide import Grid, Table, apportion, make_grid
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.splat import AdjointImage

Array = np.ndarray[Any, Any]

FIRST = (1, 2, 4)  # gradients of a sensor after which its table learns, and then
EVERY = 7  # after every so many
KEEP = 0.5  # what of the past counts beside the newest, each time that a table learns
BLUR = (0.25, 0.5, 0.25)  # along each number, of neighbouring cells
MOST_BYTES = 2**26  # of all tables together; sensors for which there is no room share
LEARNING_STREAM = 0x1EA2  # seeds of the samples that tables learn from


class Purpose(enum.Enum):
    """What samples are for; the value is the gradient's share in what they are drawn by, the rest is the image's."""

    IMAGE = 0.0
    GRADIENT = 1.0
    BOTH = 0.5


@dataclass
class Learned:
    """What the paths for one sensor have said: sums of squares (voices, cells), and how many started in each cell.

    `calls` is the number of gradients so far. Arrays are float32, and never changed.
    """

    sums: Array
    draws: Array
    calls: int = 0

    @staticmethod
    def nothing(grid: Grid, count: int) -> Learned:
        """Before the first gradient."""
        return Learned(np.zeros((count, grid.cells), np.float32), np.zeros(grid.cells, np.float32))

    def with_more(self, grid: Grid, heard: Array, draws: Array) -> Learned:
        """With what newer paths have said (voices, cells), `draws` (cells) of them."""
        sums = KEEP * self.sums.astype(np.float64)
        means = np.divide(heard, draws, out=np.zeros_like(heard), where=draws > 0)
        totals = means @ grid.measures()
        audible = np.isfinite(totals) & (totals > 0)
        sums[audible] += heard[audible] / totals[audible, None]
        return Learned(sums.astype(np.float32), (KEEP * self.draws + draws).astype(np.float32), self.calls)

    def density(self, grid: Grid, purpose: Purpose) -> Array:
        """How cells are to be drawn (cells,), normalised, before any are shared out evenly."""
        measures = grid.measures()
        draws = _blurred(grid, self.draws)
        result = np.zeros(grid.cells)
        for share, rows in ((purpose.value, self.sums[:-1]), (1 - purpose.value, self.sums[-1:])):
            square = _blurred(grid, rows.sum(0, dtype=np.float64))
            loud = np.sqrt(np.divide(square, draws, out=np.zeros(grid.cells), where=draws > 0)) * measures
            total = loud.sum()
            result += share * (loud / total if np.isfinite(total) and total > 0 else measures / measures.sum())
        return result


def _blurred(grid: Grid, values: Array) -> Array:
    """Sums over neighbouring cells, weighted; the cells of one emitter are none of another's neighbours."""
    result = values.astype(np.float64).reshape(grid.shape)
    for axis in range(1, result.ndim):
        if result.shape[axis] > 1:
            result = ndimage.convolve1d(result, BLUR, axis, mode="nearest")
    return result.ravel()


def sensor_bytes(grid: Grid) -> int:
    """Bytes for one sensor: a table for each purpose, and what has been learned."""
    return 4 * (len(Purpose) * (grid.slots + grid.cells) + (MOST_VOICES + 1) * grid.cells)


class Guiding:
    """Grid and tables of one scene, as a light tracer keeps them.

    `images` says whether samples that serve an image alone are guided. Tables that are `held` learn no more.
    """

    def __init__(self) -> None:
        self.images, self.held = True, False
        self.grid: Grid | None = None
        self.learned: dict[int, Learned] = {}  # by the number of their sensor
        self._tables: dict[tuple[int, Purpose], tuple[Table, Array]] = {}

    def clear(self) -> None:
        """Forget everything, for a new scene."""
        self.grid = None
        self.learned.clear()
        self._tables.clear()

    def grid_of(self, samples: Samples) -> Grid:
        """The grid of the samples' scene, found out once."""
        if self.grid is None:
            weights = [float(emitter.sampling_weight()) for emitter in samples.scene.emitters()]
            self.grid = make_grid(used_numbers(samples), weights)
        return self.grid

    def serves(self, purpose: Purpose) -> bool:
        """Whether samples for this are guided."""
        return self.images or purpose is not Purpose.IMAGE

    def table(self, number: int, purpose: Purpose) -> Table:
        """What samples for sensor `number` are drawn from."""
        return self._table(number, purpose)[0]

    def counts(self, number: int, purpose: Purpose) -> Array:
        """Slots of each cell of that table."""
        return self._table(number, purpose)[1]

    def _table(self, number: int, purpose: Purpose) -> tuple[Table, Array]:
        assert self.grid is not None
        number = self._shared(number)
        if (number, purpose) not in self._tables:
            learned = self.learned.get(number)
            density = self.grid.measures() if learned is None else learned.density(self.grid, purpose)
            counts = apportion(self.grid, density)
            self._tables[number, purpose] = Table.of(self.grid, counts), counts
        return self._tables[number, purpose]

    def _shared(self, number: int) -> int:
        """The number of the sensor that the tables are kept under."""
        return number % max(MOST_BYTES // self._each, 1)

    @property
    def _each(self) -> int:
        assert self.grid is not None
        return sensor_bytes(self.grid)

    def bytes(self, sensors: int) -> int:
        """What the tables for so many sensors take."""
        return min(sensors, max(MOST_BYTES // self._each, 1)) * self._each

    def state(self) -> tuple[dict[str, int], dict[str, Array]]:
        """What has been learned: the number of gradients of each sensor, and arrays by `<sensor>/<what>`."""
        arrays: dict[str, Array] = {}
        for number, learned in self.learned.items():
            arrays |= {f"{number}/sums": learned.sums, f"{number}/draws": learned.draws}
        return {str(number): learned.calls for number, learned in self.learned.items()}, arrays

    def restore(self, calls: Mapping[str, int], take: Callable[[str], Array]) -> str | None:
        """Go on from what `state` said, and nothing else; `take(name)` is the array of a name.

        Returns the name of an array that is not of this scene's grid; then nothing has changed.
        """
        assert self.grid is not None
        found = {}
        for number, count in calls.items():
            sums, draws = (take(f"{number}/{name}") for name in ("sums", "draws"))
            for name, array, dimensions in (("sums", sums, 2), ("draws", draws, 1)):
                fits = array.ndim == dimensions and array.shape[-1] == self.grid.cells
                if not fits or array.size == 0 or array.min() < 0:
                    return f"{number}/{name}"
            found[int(number)] = Learned(sums.astype(np.float32), draws.astype(np.float32), count)
        self.learned, self._tables = found, {}
        return None

    def due(self, number: int) -> bool:
        """Count one more gradient for a sensor, and say whether its table is to learn from that."""
        if self.held:
            return False
        learned = self.learned.get(self._shared(number))
        calls = 1 if learned is None else learned.calls + 1
        if learned is not None:
            learned.calls = calls
        return learned is None or calls in FIRST or calls % EVERY == 0

    def learn(self, number: int, samples: Samples, adjoint: AdjointImage) -> None:
        """Have the table of a sensor learn from samples, drawn from its table for BOTH, which serve nothing else."""
        assert self.grid is not None
        counts, number = self.counts(number, Purpose.BOTH), self._shared(number)
        before = self.learned.get(number)
        if before is None or len(before.sums) != voices(samples.plan):
            before = Learned.nothing(self.grid, voices(samples.plan))
            before.calls = 1 if number not in self.learned else self.learned[number].calls
        draws = samples.width * (counts / self.grid.slots)
        self.learned[number] = before.with_more(self.grid, hear(samples, adjoint), draws)
        for purpose in Purpose:
            self._tables.pop((number, purpose), None)


def learning_seed(seed: mi.UInt32 | int) -> mi.UInt32:
    """The seed of the samples that are learned from, beside those of a gradient."""
    result = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(LEARNING_STREAM))[0]
    dr.make_opaque(result)
    return result
