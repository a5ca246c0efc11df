"""What light paths for one sensor have said, by the cell that they started in, and how cells are drawn by that.

What the variance of a sum over paths is made of is the mean square of what those of a cell say; it is least where cells
are drawn in proportion to its root (`hearing.py` says what is heard). Each voice is scaled to a total of 1, so that no
parameter drowns another.

Cells are as fine as there are paths to tell them apart: of a few thousand paths they are put together by hundreds. The
more have been heard, the finer they are, up to the grid's own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.integrators.onward import KEEP, Onward
from reslrb_cli.transport.guide import Grid

Array = np.ndarray[Any, Any]

#: Of neighbouring cells, along each number. A quarter in place of the twentieth leaves a cell a sixteenth of what was
#: heard of it, and rooms 1.3 to 1.4 times the squares; with none, cells that few paths have met count for what these
#: few said.
BLUR = (0.05, 0.9, 0.05)
FINE = 2.0  # cells, at most, for each path that has been heard


def most_cells(paths: int) -> float:
    """More cells than can ever be told apart where each walk that is learned from has so many paths: what counts of all
    of them stays below the sum of the past's geometric series."""
    return FINE * paths / (1 - KEEP) * (1 - 1e-6)


@dataclass
class Learned:
    """What the paths for one sensor have said: sums of squares (2, cells), about the gradient and about the image, and
    how many started in each cell.

    `calls` is the number of gradients so far, or since what was learned was found to be wrong. Arrays are float32, and
    never changed. `onward` is what paths went on to say from where they were; None where nothing of that is known.
    `worse` is the mean square of what the newest paths said, in that of evenly drawn ones: far above 1 the table that
    they were drawn from did harm, as it does where a scene has changed. `film` (2, blocks) are sums of squares too, by
    where on the film paths said it (`transport/aim.py`); without blocks where none is aimed.
    """

    sums: Array
    draws: Array
    calls: int = 0
    onward: Onward | None = None
    film: Array = field(default_factory=lambda: np.zeros((2, 0), np.float32))
    worse: float = 1.0
    _densities: tuple[Grid, list[Array]] | None = field(default=None, init=False, repr=False, compare=False)

    @staticmethod
    def nothing(grid: Grid) -> Learned:
        """Before the first gradient."""
        return Learned(np.zeros((2, grid.cells), np.float32), np.zeros(grid.cells, np.float32))

    def with_more(
        self, grid: Grid, heard: Array, draws: Array, onward: Onward | None = None, film: Array | None = None
    ) -> Learned:
        """With what newer paths have said (voices, cells), the image last, `draws` (cells) of them.

        Each voice is scaled to a total of 1. `onward` has learned from the same paths already.
        """
        sums = np.float32(KEEP) * self.sums
        means = np.zeros(grid.cells, np.float32)
        np.divide(grid.measures(), draws, out=means, where=draws > 0, casting="same_kind")
        guided = _add(sums, heard, means)
        started = np.float32(KEEP) * self.draws
        started += draws
        worse = float(draws.sum() * np.mean(guided)) if guided else 1.0
        return Learned(sums, started, self.calls, onward, self._places(film), worse)

    def _places(self, heard: Array | None) -> Array:
        """`film` with what newer paths have said by block (voices, blocks), the image last."""
        if heard is None:
            return self.film
        shape = 2, heard.shape[1]
        film = np.float32(KEEP) * self.film if self.film.shape == shape else np.zeros(shape, np.float32)
        _add(film, heard, np.ones(shape[1], np.float32))
        return film

    def on(self, grid: Grid, before: Grid) -> Learned:
        """The same about the cells of another grid, of which those of the one before are made, spread evenly."""
        sums = np.stack([grid.shared_out(row, before) for row in self.sums])
        draws = grid.shared_out(self.draws, before).astype(np.float32)
        return Learned(sums.astype(np.float32), draws, self.calls, self.onward, self.film)

    def density(self, grid: Grid, share: float) -> Array:
        """How cells are to be drawn (cells,), normalised, before any are shared out evenly: `share` of them by what was
        said about the gradient, the others by what was said about the image.

        Cells that few paths have been heard of are put together, all of them alike.
        """
        if self._densities is None:
            self._densities = self._both(grid)
        coarser, (gradient, image) = self._densities
        return grid.shared_out(np.float32(share) * gradient + np.float32(1 - share) * image, coarser)

    def _both(self, grid: Grid) -> tuple[Grid, list[Array]]:
        """The densities by the gradient and by the image, float32, and the cells that they are of."""
        coarser = grid.coarser(FINE * self.draws.sum(dtype=np.float64))
        measures, found = coarser.measures().astype(np.float32), []
        draws = _blurred(coarser, grid.summed(self.draws, coarser))
        for row in self.sums:
            square, loud = _blurred(coarser, grid.summed(row, coarser)), np.zeros(coarser.cells, np.float32)
            np.divide(square, draws, out=loud, where=draws > 0)
            np.sqrt(loud, out=loud)
            loud *= measures
            total = loud.sum()
            found.append(loud / total if np.isfinite(total) and total > 0 else measures / measures.sum())
        return coarser, found


def _add(sums: Array, heard: Array, means: Array) -> list[float]:
    """Add to `sums` (2, n), about the gradient and about the image, what each of the voices (voices, n) has said, the
    image last, scaled to a total of 1; `means` (n) are what a thing said at each counts for in the total.

    Returns the mean of `means` over what each voice has said; a voice without a finite total is left out.
    """
    found = []
    for voice, said in enumerate(heard.astype(np.float32, copy=False)):
        total = said @ means
        if np.isfinite(total) and total > 0:
            sums[int(voice == len(heard) - 1)] += said / total
            found.append(float(said @ np.square(means)) / float(total))
    return found


def _blurred(grid: Grid, values: Array) -> Array:
    """Sums over neighbouring cells, weighted; the cells of one emitter are none of another's neighbours."""
    from scipy import ndimage  # here: few commands ever learn, and all import this module

    result = values.reshape(grid.shape)
    for axis in range(1, result.ndim):
        if result.shape[axis] > 1:
            result = ndimage.convolve1d(result, BLUR, axis, mode="nearest")
    return result.ravel()
