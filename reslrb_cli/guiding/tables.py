"""Tables that guide where light paths start, for each sensor. The contributions of earlier steps update the tables for
later steps.

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

Each cell is sampled according to the contributions of the paths that started in the cell. `collect.py` defines these
contributions. The variance of a sum over paths depends on the mean square contribution in each cell. The variance is
smallest if each cell is sampled in proportion to the square root of its mean square contribution. Each quantity is
scaled to a total of 1, so that no parameter dominates another.

The resolution of the cells depends on the number of recorded paths. After a few thousand paths, hundreds of cells are
merged. As more paths are recorded, merged cells are divided again, down to the cells of the grid.

`Guiding` holds the tables of one scene. If samples are used for both image and gradient, half of the samples are drawn
for the image and half for the gradient.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.guiding.collect import Collected
from reslrb_cli.transport.aim import AIM_SLOTS, BLOCKS, Aim, Blocks
from reslrb_cli.transport.emission import used_numbers
from reslrb_cli.transport.plan import Grid
from reslrb_cli.transport.samples import Samples, Table

Array = np.ndarray[Any, Any]

GUIDE_UNIFORM = 0.25  # minimum share of paths with uniform starts
KEEP = 0.75  # weight of the past relative to the newest walk
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
    measures = grid.measures()
    least = np.where(measures > 0, np.maximum(np.ceil(GUIDE_UNIFORM * grid.slots * measures - 1e-6), 1), 0)
    # Rounded along the order of the cells, so that neighbours balance.
    ends = np.cumsum(density, dtype=np.float64)
    ends *= (grid.slots - least.sum()) / ends[-1]
    np.rint(ends, out=ends)
    least[0] += ends[0]
    least[1:] += ends[1:]
    least[1:] -= ends[:-1]
    return least.astype(np.int64)


#: Blur over neighbouring cells along each number. With 1/4 instead of 1/20, a cell keeps a sixteenth of its value, and
#: second moments in rooms grow by 1.3 to 1.4; without blur, cells with few paths are trusted too much.
BLUR = (0.05, 0.9, 0.05)
FINE = 2.0  # maximum number of cells per recorded path


def most_cells(paths: int) -> float:
    """Return an upper limit for the number of distinguishable cells. Each learning walk has `paths` paths.

    The weights of past walks form a geometric series. The total weight of all recorded paths stays below the sum of the
    series.
    """
    return FINE * paths / (1 - KEEP) * (1 - 1e-6)


@dataclass
class Learned:
    """Contributions of the paths of one sensor.

    `sums` (2, cells) are the sums for gradient and image, and `draws` the number of paths that started in each cell.
    Arrays are float32, and never modified.

    - `calls` is the number of gradients so far. The count restarts when a table is found to be wrong.
    - `worse` is the mean square contribution of the newest paths divided by the mean square contribution of uniform
        paths. If `worse` is far above 1, the table is harmful, for example after a change of the scene.
    - `film` (2, blocks) has the sums of squares for each block of the film (`transport/aim.py`). There are no blocks if
        no path is aimed.
    """

    sums: Array
    draws: Array
    calls: int = 0
    film: Array = field(default_factory=lambda: np.zeros((2, 0), np.float32))
    worse: float = 1.0
    _densities: tuple[Grid, list[Array]] | None = field(default=None, init=False, repr=False, compare=False)

    @staticmethod
    def nothing(grid: Grid) -> Learned:
        """Return the state before the first gradient."""
        return Learned(np.zeros((2, grid.cells), np.float32), np.zeros(grid.cells, np.float32))

    def with_more(self, grid: Grid, newer: Array, draws: Array, film: Array | None = None) -> Learned:
        """Return the state after newer paths.

        `newer` (quantities, cells) holds the contributions of the newer paths, with the image last. `draws` (cells)
        holds the number of newer paths per cell. Each quantity is scaled to a total of 1.
        """
        sums = np.float32(KEEP) * self.sums
        means = np.zeros(grid.cells, np.float32)
        np.divide(grid.measures(), draws, out=means, where=draws > 0, casting="same_kind")
        guided = _add(sums, newer, means)
        started = np.float32(KEEP) * self.draws
        started += draws
        worse = float(draws.sum() * np.mean(guided)) if guided else 1.0
        return Learned(sums, started, self.calls, self._places(film), worse)

    def _places(self, newer: Array | None) -> Array:
        """Return `film`, updated with the newer contributions to each block (quantities, blocks). The last row belongs
        to the image.
        """
        if newer is None:
            return self.film
        shape = 2, newer.shape[1]
        film = np.float32(KEEP) * self.film if self.film.shape == shape else np.zeros(shape, np.float32)
        _add(film, newer, np.ones(shape[1], np.float32))
        return film

    def on(self, grid: Grid, before: Grid) -> Learned:
        """Return the contributions, distributed evenly over the cells of another grid."""
        sums = np.stack([grid.shared_out(row, before) for row in self.sums])
        draws = grid.shared_out(self.draws, before).astype(np.float32)
        return Learned(sums.astype(np.float32), draws, self.calls, self.film)

    def density(self, grid: Grid, share: float) -> Array:
        """Return the normalised density of the cells (cells,), before the uniform part is added.

        `share` is the weight of the gradient. 1 - `share` is the weight of the image. Cells with few recorded paths are
        merged.
        """
        if self._densities is None:
            self._densities = self._both(grid)
        coarser, (gradient, image) = self._densities
        return grid.shared_out(np.float32(share) * gradient + np.float32(1 - share) * image, coarser)

    def _both(self, grid: Grid) -> tuple[Grid, list[Array]]:
        """Return a grid, and the float32 densities on this grid for gradient and image."""
        coarser = grid.coarser(FINE * self.draws.sum(dtype=np.float64))
        measures, found = coarser.measures().astype(np.float32), []
        draws = _blurred(coarser, grid.summed(self.draws, coarser))
        for row in self.sums:
            square, density = _blurred(coarser, grid.summed(row, coarser)), np.zeros(coarser.cells, np.float32)
            np.divide(square, draws, out=density, where=draws > 0)
            np.sqrt(density, out=density)
            density *= measures
            total = density.sum()
            found.append(density / total if np.isfinite(total) and total > 0 else measures / measures.sum())
        return coarser, found


def _add(sums: Array, newer: Array, means: Array) -> list[float]:
    """Add the contributions `newer` (quantities, n) to `sums` (2, n). The last row of `newer` belongs to the image.
    Each quantity is first scaled to a total of 1.

    `means` (n) holds the weight of each place in a quantity's total. Returns the mean of `means` for each quantity. A
    quantity without a finite total is left out.
    """
    found = []
    for k, row in enumerate(newer.astype(np.float32, copy=False)):
        total = row @ means
        if np.isfinite(total) and total > 0:
            sums[int(k == len(newer) - 1)] += row / total
            found.append(float(row @ np.square(means)) / float(total))
    return found


def _blurred(grid: Grid, values: Array) -> Array:
    """Return weighted sums over neighbouring cells. Cells of different emitters are not neighbours."""
    from scipy import ndimage  # imported here: few commands learn, and all import this module

    result = values.reshape(grid.shape)
    for axis in range(1, result.ndim):
        if result.shape[axis] > 1:
            result = ndimage.convolve1d(result, BLUR, axis, mode="nearest")
    return result.ravel()


EVERY = 16  # gradients of a sensor between two updates of its table; the first updates come after 1, 2, 4 and 8
WRONG = 1.5  # `Learned.worse` of a harmful table; a useless but correct table has 1
LEAST_BITS = 16  # log2 of the number of cells, for any number of sensors
MOST_BYTES = 2**26  # of all tables together; sensors beyond it share
NOW = 0.2  # share of the paths of a gradient that use its own dL/dI, if known; the others use the recorded values
LEARNING_STREAM = 0x1EA2  # seeds of the samples that tables learn from

#: Names of the arrays of each sensor in the learned state.
KNOWN = ("sums", "draws", "film")


class Purpose(enum.Enum):
    """Purpose of samples. The value is the weight of the gradient in the table. 1 minus the value is the weight of the
    image.
    """

    IMAGE = 0.0
    GRADIENT = 1.0
    BOTH = 0.5


def sensor_bytes(grid: Grid, aims: bool = True) -> int:
    """Return the bytes for one sensor: a table for each purpose, the recorded contributions and, with `aims`, the
    aiming table.
    """
    emission = len(Purpose) * (grid.slots + 2 * grid.cells) + 3 * grid.cells
    aim = (len(Purpose) + 1) * (AIM_SLOTS + BLOCKS) + 2 * BLOCKS
    return 4 * (emission + (aim if aims else 0))


def grid_for(used: Sequence[bool], weights: Sequence[float], sensors: int, paths: int | None = None) -> Grid:
    """Return a grid whose tables fit into memory for `sensors` sensors. Additional sensors share tables.

    The grid is not finer than walks of `paths` paths can resolve. `paths` is None if the number of paths is unknown.
    """
    grids = (make_grid(used, weights, bits) for bits in range(CELL_BITS, LEAST_BITS, -1))
    fitting = (grid for grid in grids if sensors * sensor_bytes(grid) <= MOST_BYTES)
    grid = next(fitting, make_grid(used, weights, LEAST_BITS))
    return grid if paths is None else grid.coarser(most_cells(paths))


class Guiding:
    """Grid and tables of one scene, for a light tracer.

    Tables that are `held` do not learn. `lessons` counts the updates of all tables together.
    """

    def __init__(self) -> None:
        self.held, self.lessons = False, 0
        self.grid: Grid | None = None
        self._emission: tuple[list[bool], list[float], int] | None = None  # scene data that `grid_for` needs
        self.learned: dict[int, Learned] = {}  # by the number of the sensor
        self.films: dict[int, Blocks] = {}  # of sensors with paths that may be aimed
        self._tables: dict[tuple[int, Purpose], tuple[Table, Array]] = {}

    def clear(self) -> None:
        """Clear everything, for a new scene."""
        self.grid = self._emission = None
        self.films.clear()
        self.forget()

    def forget(self) -> None:
        """Clear all recorded contributions."""
        self.learned.clear()
        self._tables.clear()

    def grid_of(self, samples: Samples, paths: int | None) -> Grid:
        """Return the grid for the scene of `samples`, and for walks of `paths` paths.

        A coarser grid is replaced by a finer one, and keeps its recorded contributions. A grid for an unknown number of
        paths is replaced if it has not learned yet.
        """
        if self._emission is None:
            weights = [float(emitter.sampling_weight()) for emitter in samples.scene.emitters()]
            self._emission = used_numbers(samples), weights, len(samples.scene.sensors())
        before, self.grid = self.grid, grid_for(*self._emission, paths)
        if before is not None and before != self.grid:
            kept = {number: one for number, one in self.learned.items() if number == self._shared(number)}
            self.learned = {number: one.on(self.grid, before) for number, one in kept.items()}
            self._tables.clear()
        return self.grid

    def table(self, number: int, purpose: Purpose, delta: mi.TensorXf | None = None) -> Table:
        """Return the table for samples of sensor `number`.

        `delta` (H, W, C) is dL/dI, if dL/dI is known before the samples. `delta` then selects some of the film
        positions that paths are aimed at.
        """
        table = self._table(number, purpose)[0]
        if delta is None or table.aim is None:
            return table
        number = self._shared(number)
        return replace(table, aim=self._aim(number, purpose, self.learned.get(number), delta))

    def counts(self, number: int, purpose: Purpose) -> Array:
        """Return the table's slot count for each cell."""
        return self._table(number, purpose)[1]

    def _table(self, number: int, purpose: Purpose) -> tuple[Table, Array]:
        assert self.grid is not None
        number = self._shared(number)
        if (number, purpose) not in self._tables:
            learned = self.learned.get(number)
            density = self.grid.measures() if learned is None else learned.density(self.grid, purpose.value)
            counts = apportion(self.grid, density).astype(np.uint32)
            aim = self._aim(number, purpose, learned)
            self._tables[number, purpose] = Table.of(self.grid, counts, aim), counts
        return self._tables[number, purpose]

    def aims(self, number: int, film: Blocks) -> bool:
        """Whether the paths of a sensor with this film are aimed. Paths are not aimed if the sensor shares its tables
        with other sensors.
        """
        assert self._emission is not None
        if max(number + 1, self._emission[2]) > self._apart:
            return False
        self.films[number] = film
        return True

    def _aim(
        self, number: int, purpose: Purpose, learned: Learned | None, delta: mi.TensorXf | None = None
    ) -> Aim | None:
        """Return the film positions that a sensor's paths are aimed at. Recorded contributions and the current dL/dI
        determine the positions.
        """
        if number not in self.films:
            return None
        film, sums = self.films[number], np.zeros((2, 0)) if learned is None else learned.film
        even = film.areas() / film.areas().sum()
        rows = list(np.sqrt(sums, dtype=np.float64)) if sums.shape == (2, film.count) else [even, even]
        gradient, image = (_shares(row, even) for row in rows)
        if delta is not None:
            gradient = (1 - NOW) * gradient + NOW * _shares(film.root_means(delta), even)
        return Aim.of(film, purpose.value * gradient + (1 - purpose.value) * image)

    def _shared(self, number: int) -> int:
        """Return the number of the sensor whose tables this sensor uses."""
        return number % self._apart

    @property
    def _apart(self) -> int:
        """Number of sensors with their own tables."""
        assert self.grid is not None
        return max(MOST_BYTES // sensor_bytes(self.grid), 1)

    def state(self) -> tuple[dict[str, int], dict[str, Array]]:
        """Return the learned state: the gradient count of each sensor, and a mapping from `<sensor>/<what>` to
        arrays.
        """
        arrays: dict[str, Array] = {}
        for number, learned in self.learned.items():
            arrays |= {f"{number}/{name}": getattr(learned, name) for name in KNOWN}
        return {str(number): learned.calls for number, learned in self.learned.items()}, arrays

    def restore(self, calls: Mapping[str, int], take: Callable[[str], Array]) -> str | None:
        """Restore the result of `state`. `take(name)` returns the array that is called `name`.

        If an array does not fit this scene's grid, the method returns the array's name and leaves the state unchanged.
        """
        assert self.grid is not None
        found = {}
        for number, count in calls.items():
            arrays = {name: take(f"{number}/{name}") for name in KNOWN}
            shapes = {"sums": (2, self.grid.cells), "draws": (self.grid.cells,), "film": (2, arrays["film"].size // 2)}
            for name, shape in shapes.items():
                if arrays[name].shape != shape or not (np.isfinite(arrays[name]) & (arrays[name] >= 0)).all():
                    return f"{number}/{name}"
            sums, draws, film = (arrays[name].astype(np.float32) for name in shapes)
            found[int(number)] = Learned(sums, draws, count, film)
        self.learned, self._tables = found, {}
        return None

    def due(self, number: int) -> bool:
        """Count one more gradient of a sensor. Return true if the sensor's table should learn from this gradient."""
        if self.held:
            return False
        learned = self.learned.get(self._shared(number))
        calls = 1 if learned is None else learned.calls + 1
        if learned is not None:
            learned.calls = calls
        return learned is None or learns_after(calls)

    def learn(self, number: int, paths: int, collected: Collected) -> None:
        """Update a sensor's table with the contributions of `paths` paths (`collect.py`).

        These paths are drawn from the table for BOTH, and are used for nothing else.
        """
        assert self.grid is not None
        counts, number = self.counts(number, Purpose.BOTH), self._shared(number)
        before = self.learned.get(number)
        if before is None:
            before = Learned.nothing(self.grid)
            before.calls = 1
        newer, draws = np.array(collected.starts).reshape(-1, self.grid.cells), paths * (counts / self.grid.slots)
        film = np.array(collected.places[0]).reshape(len(newer), -1) if collected.places else None
        learned = before.with_more(self.grid, newer, draws, film)
        if learned.worse > WRONG and learned.calls % EVERY == 0:
            learned.calls = 0  # the scene has changed, so it learns as often as at the start
        self.learned[number] = learned
        self.lessons += 1
        for purpose in Purpose:
            self._tables.pop((number, purpose), None)


def _shares(row: Array, even: Array) -> Array:
    """Return each entry divided by the total, or `even` if the total is zero."""
    return row / row.sum() if row.sum() > 0 else even


def learns_after(gradients: int) -> bool:
    """True if a table learns from gradient number `gradients`. Gradients are counted from 1.

    At first, the number of recorded paths doubles each time. Later, the table must check regularly whether the scene
    has changed. After a change, counting starts again.
    """
    return gradients % EVERY == 0 or (gradients < EVERY and gradients.bit_count() == 1)


def learnings(gradients: int) -> int:
    """Return the number of table updates after the sensor's first `gradients` gradients."""
    return min(gradients, EVERY - 1).bit_length() + gradients // EVERY


def learning_seed(seed: mi.UInt32 | int) -> mi.UInt32:
    """Return the seed of the samples that update a table. The seed is independent of the gradient's seed."""
    result = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(LEARNING_STREAM))[0]
    dr.make_opaque(result)
    return result
