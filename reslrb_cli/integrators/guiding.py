"""Guiding of a scene's emission: tables for each sensor, learned from steps that are done, for those to come.

Cells are drawn by what their paths have said (`learned.py`). Samples that serve image and gradient both are drawn half
for the one, half for the other.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators.hearing import Said
from reslrb_cli.integrators.learned import Learned, most_cells
from reslrb_cli.integrators.onward import NAMES, Onward
from reslrb_cli.integrators.probing import used_numbers
from reslrb_cli.transport.aim import SLOTS, Aim
from reslrb_cli.transport.blocks import BLOCKS, Blocks
from reslrb_cli.transport.guide import CELL_BITS, Grid, Table, apportion, make_grid
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.survival import CELLS, Survival, box_of

Array = np.ndarray[Any, Any]

EVERY = 16  # gradients of a sensor from one time that its table learns to the next; at first after 1, 2, 4 and 8
WRONG = 1.5  # `Learned.worse` of a table that does harm; one that is worth nothing, and right, has 1
LEAST_BITS = 16  # cells, log2, however many sensors there are
MOST_BYTES = 2**26  # of all tables together; sensors for which there is no room share
NOW = 0.2  # of the paths aimed for a gradient: by its own dL/dI, where that is known; the others by what was said
LEARNING_STREAM = 0x1EA2  # seeds of the samples that tables learn from


#: Names of the arrays of each sensor in what has been learned.
KNOWN = ("sums", "draws", "film", *NAMES)


class Purpose(enum.Enum):
    """What samples are for; the value is the gradient's share in what they are drawn by, the rest is the image's."""

    IMAGE = 0.0
    GRADIENT = 1.0
    BOTH = 0.5


def sensor_bytes(grid: Grid, aims: bool = True) -> int:
    """Bytes for one sensor: a table for each purpose, and what has been learned; `aims`: where paths are sent, too, of
    which a gradient has one of its own."""
    emission = len(Purpose) * (grid.slots + 2 * grid.cells) + 3 * grid.cells
    aim = (len(Purpose) + 1) * (SLOTS + BLOCKS) + 2 * BLOCKS
    return 4 * (emission + (len(Purpose) + 4) * CELLS + (aim if aims else 0))


def grid_for(used: Sequence[bool], weights: Sequence[float], sensors: int, paths: int | None = None) -> Grid:
    """A grid of which so many sensors have tables of their own, as fine as these leave room for; of more they share.

    No finer than walks of so many `paths` can ever tell; None: nobody knows how many they will have.
    """
    grids = (make_grid(used, weights, bits) for bits in range(CELL_BITS, LEAST_BITS, -1))
    fitting = (grid for grid in grids if sensors * sensor_bytes(grid) <= MOST_BYTES)
    grid = next(fitting, make_grid(used, weights, LEAST_BITS))
    return grid if paths is None else grid.coarser(most_cells(paths))


class Guiding:
    """Grid and tables of one scene, as a light tracer keeps them.

    `images` says whether samples that serve an image alone are guided. Tables that are `held` learn no more. `lessons`
    counts how often any have learned.
    """

    def __init__(self) -> None:
        self.images, self.held, self.lessons = True, False, 0
        self.grid: Grid | None = None
        self._emission: tuple[list[bool], list[float], int] | None = None  # what `grid_for` is to know of a scene
        self.box = np.zeros((2, 3), np.float32)  # of the scene, as it was first seen
        self.learned: dict[int, Learned] = {}  # by the number of their sensor
        self.films: dict[int, Blocks] = {}  # of sensors whose paths may be aimed
        self._tables: dict[tuple[int, Purpose], tuple[Table, Array]] = {}

    def clear(self) -> None:
        """Forget everything, for a new scene."""
        self.grid = self._emission = None
        self.films.clear()
        self.forget()

    def forget(self) -> None:
        """Forget what has been learned."""
        self.learned.clear()
        self._tables.clear()

    def grid_of(self, samples: Samples, paths: int | None) -> Grid:
        """The grid of the samples' scene for walks of so many paths.

        Where it was another before, that had been made for fewer, or for nobody knew how many and nothing was learned:
        what was learned is kept.
        """
        if self._emission is None:
            weights = [float(emitter.sampling_weight()) for emitter in samples.scene.emitters()]
            self._emission = used_numbers(samples), weights, len(samples.scene.sensors())
            self.box = box_of(samples.scene)
        before, self.grid = self.grid, grid_for(*self._emission, paths)
        if before is not None and before != self.grid:
            kept = {number: one for number, one in self.learned.items() if number == self._shared(number)}
            self.learned = {number: one.on(self.grid, before) for number, one in kept.items()}
            self._tables.clear()
        return self.grid

    def serves(self, purpose: Purpose) -> bool:
        """Whether samples for this are guided."""
        return self.images or purpose is not Purpose.IMAGE

    def table(self, number: int, purpose: Purpose, delta: mi.TensorXf | None = None) -> Table:
        """What samples for sensor `number` are drawn from; of the places on the film that paths are aimed at, some are
        those of dL/dI `delta` (H, W, C), where it is known before the samples are."""
        table = self._table(number, purpose)[0]
        if delta is None or table.aim is None:
            return table
        number = self._shared(number)
        return replace(table, aim=self._aim(number, purpose, self.learned.get(number), delta))

    def counts(self, number: int, purpose: Purpose) -> Array:
        """Slots of each cell of that table."""
        return self._table(number, purpose)[1]

    def _table(self, number: int, purpose: Purpose) -> tuple[Table, Array]:
        assert self.grid is not None
        number = self._shared(number)
        if (number, purpose) not in self._tables:
            learned = self.learned.get(number)
            density = self.grid.measures() if learned is None else learned.density(self.grid, purpose.value)
            counts = apportion(self.grid, density).astype(np.uint32)
            onward = self._onward(number)
            survival = Survival.of(onward.box, onward.chances(purpose.value))
            aim = self._aim(number, purpose, learned)
            self._tables[number, purpose] = Table.of(self.grid, counts, survival, aim), counts
        return self._tables[number, purpose]

    def aims(self, number: int, film: Blocks) -> bool:
        """Have the paths for a sensor with this film be aimed; not where it shares its tables with others."""
        assert self._emission is not None
        if max(number + 1, self._emission[2]) > self._apart:
            return False
        self.films[number] = film
        return True

    def _aim(
        self, number: int, purpose: Purpose, learned: Learned | None, delta: mi.TensorXf | None = None
    ) -> Aim | None:
        """Where on the film of a sensor paths are sent, by what was said there, and where dL/dI is large now."""
        if number not in self.films:
            return None
        film, said = self.films[number], np.zeros((2, 0)) if learned is None else learned.film
        even = film.areas() / film.areas().sum()
        loud = list(np.sqrt(said, dtype=np.float64)) if said.shape == (2, film.count) else [even, even]
        gradient, image = (_shares(row, even) for row in loud)
        if delta is not None:
            gradient = (1 - NOW) * gradient + NOW * _shares(film.root_means(delta), even)
        return Aim.of(film, purpose.value * gradient + (1 - purpose.value) * image)

    def _onward(self, number: int) -> Onward:
        """What is known of where the paths for a sensor go on to, `number` being what its tables are kept under."""
        learned = self.learned.get(number)
        return Onward.nothing(self.box) if learned is None or learned.onward is None else learned.onward

    def _shared(self, number: int) -> int:
        """The number of the sensor that the tables are kept under."""
        return number % self._apart

    @property
    def _apart(self) -> int:
        """How many sensors have tables of their own."""
        return max(MOST_BYTES // self._each, 1)

    @property
    def _each(self) -> int:
        assert self.grid is not None
        return sensor_bytes(self.grid)

    def bytes(self, sensors: int) -> int:
        """What the tables for so many sensors take."""
        return min(sensors, self._apart) * self._each

    def state(self) -> tuple[dict[str, int], dict[str, Array]]:
        """What has been learned: the number of gradients of each sensor, and arrays by `<sensor>/<what>`."""
        arrays: dict[str, Array] = {}
        for number, learned in self.learned.items():
            found = {"sums": learned.sums, "draws": learned.draws, "film": learned.film}
            found |= self._onward(number).arrays()
            arrays |= {f"{number}/{name}": array for name, array in found.items()}
        return {str(number): learned.calls for number, learned in self.learned.items()}, arrays

    def restore(self, calls: Mapping[str, int], take: Callable[[str], Array]) -> str | None:
        """Go on from what `state` said, and nothing else; `take(name)` is the array of a name.

        Returns the name of an array that is not of this scene's grid; then nothing has changed.
        """
        assert self.grid is not None
        found = {}
        for number, count in calls.items():
            sums, draws = (take(f"{number}/{name}") for name in ("sums", "draws"))
            for name, array, rows in (("sums", sums, (2,)), ("draws", draws, ())):
                if array.shape != (*rows, self.grid.cells) or not (np.isfinite(array) & (array >= 0)).all():
                    return f"{number}/{name}"
            onward = Onward.taken({name: take(f"{number}/{name}") for name in NAMES})
            if isinstance(onward, str):
                return f"{number}/{onward}"
            film = take(f"{number}/film")
            if film.ndim != 2 or len(film) != 2 or not (np.isfinite(film) & (film >= 0)).all():
                return f"{number}/film"
            sums, draws, film = (array.astype(np.float32) for array in (sums, draws, film))
            found[int(number)] = Learned(sums, draws, count, onward, film)
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
        return learned is None or learns_after(calls)

    def learn(self, number: int, paths: int, said: Said) -> None:
        """Have the table of a sensor learn from what so many paths said (`hearing.py`).

        They are drawn from its table for BOTH, and serve nothing else.
        """
        assert self.grid is not None
        counts, number = self.counts(number, Purpose.BOTH), self._shared(number)
        before = self.learned.get(number)
        if before is None:
            before = Learned.nothing(self.grid)
            before.calls = 1
        onward = self._onward(number).with_more(said.walked(paths))
        draws = paths * (counts / self.grid.slots)
        heard = said.by_start(self.grid.cells)
        learned = before.with_more(self.grid, heard, draws, onward, said.by_block())
        if learned.worse > WRONG and learned.calls % EVERY == 0:
            learned.calls = 0  # the scene has changed: it learns as often as it did at first
        self.learned[number] = learned
        self.lessons += 1
        for purpose in Purpose:
            self._tables.pop((number, purpose), None)


def _shares(row: Array, even: Array) -> Array:
    """What each has of the sum of all; as much as is `even` where there is nothing."""
    return row / row.sum() if row.sum() > 0 else even


def learns_after(gradients: int) -> bool:
    """Whether a table learns from the gradient of this number, counted from 1.

    What it knows doubles each time at first. Later it has to look again soon enough for a scene that has changed; if it
    finds one, counting begins anew.
    """
    return gradients % EVERY == 0 or (gradients < EVERY and gradients.bit_count() == 1)


def learnings(gradients: int) -> int:
    """How often a table has learned after so many gradients of its sensor."""
    return min(gradients, EVERY - 1).bit_length() + gradients // EVERY


def learning_seed(seed: mi.UInt32 | int) -> mi.UInt32:
    """The seed of the samples that are learned from, beside those of a gradient."""
    result = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(LEARNING_STREAM))[0]
    dr.make_opaque(result)
    return result
