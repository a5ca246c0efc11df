"""What light paths go on to say from where they are, and whether they are worth following by that.

Of every cell of place and direction (`transport/survival.py`) two means are learned over the rays that leave a vertex
there: the square of what the path still says behind it if its throughput is 1 (m), and how many vertices still follow
(c). A ray that leaves with throughput w goes on with probability q = min(1, max(LEAST, w s)). Of all q those make
variance times work least for which

    s = sqrt(m W / (c V))        V: the mean square of what a whole path says; W: the mean number of its vertices

(Rath et al. 2022, "EARS: efficiency-aware Russian roulette and splitting"). Here s is SURE times that: few of the paths
that a cell is known by say nearly all that it ever says, so that most cells look quieter than they are, and what ends
there too often makes for much more noise than what goes on too long makes for work.

For the same reason a cell leans on the larger cube that it lies in, with the weight of LEAN rays, that one on the next,
and so on up to the whole scene; and no cell has less than FLOOR of the scene's own m / c.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.transport.survival import BITS, CELLS, SHAPE

Array = np.ndarray[Any, Any]

NAMES = ("onward", "frame")  # of its arrays
KEEP = 0.75  # what of the past counts beside the newest walk
SURE = 16.0
LEAN = 100.0
FLOOR = 0.1
RAY = 0.2  # what a ray costs that meets nothing, in vertices


@dataclass
class Walked:
    """What one walk has shown, float64: of each cell the squares of what paths still said at a throughput of 1
    (voices, CELLS), the vertices that followed, and the rays that left there, summed over its paths.

    Means over its paths: `said`, the squares of all they said (voices); `light`, the weight they left emitters with;
    `length`, their vertices, and one for their start.
    """

    squares: Array
    followed: Array
    left: Array
    said: Array
    light: float
    length: float


@dataclass
class Onward:
    """Sums (4, CELLS), float32: of squares that concern the gradient and the image, of vertices that followed, of rays.

    Squares are in units of what whole paths said, and of `light`. `box` (2, 3) is what is cut into cubes. No array is
    ever changed.
    """

    box: Array
    sums: Array
    light: float = 0.0
    length: float = 0.0

    @staticmethod
    def nothing(box: Array) -> Onward:
        """Before the first walk."""
        return Onward(np.asarray(box, np.float32), np.zeros((4, CELLS), np.float32))

    def with_more(self, walked: Walked) -> Onward:
        """With what one more walk has shown, each voice of the gradient as much as another, the image last.

        A walk in which nothing was said about either tells nothing of where paths would say something.
        """
        heard = np.isfinite(walked.said) & (walked.said > 0)
        if not (heard[:-1].any() and heard[-1] and np.isfinite(walked.light) and walked.light > 0):
            return self
        unit = np.divide(walked.light**2, walked.said, out=np.zeros(len(heard)), where=heard)
        gradient = unit[:-1] @ walked.squares[:-1] / heard[:-1].sum()
        newest = np.stack([gradient, unit[-1] * walked.squares[-1], walked.followed, walked.left])
        old = KEEP if self.light > 0 else 0.0
        light, length = (old * a + (1 - old) * b for a, b in ((self.light, walked.light), (self.length, walked.length)))
        return Onward(self.box, (KEEP * self.sums + newest).astype(np.float32), light, length)

    def arrays(self) -> dict[str, Array]:
        """All of it, by name; the inverse of `taken`."""
        frame = np.array([*self.box.ravel(), self.light, self.length], np.float64)
        return dict(zip(NAMES, (self.sums, frame), strict=True))

    @staticmethod
    def taken(arrays: Mapping[str, Array]) -> Onward | str:
        """What had these `arrays`; the name of one that cannot be."""
        sums, frame = (arrays[name] for name in NAMES)
        if sums.shape != (4, CELLS) or not (np.isfinite(sums) & (sums >= 0)).all():
            return "onward"
        if frame.shape != (8,) or not np.isfinite(frame).all() or (frame[6:] < 0).any():
            return "frame"
        box = frame[:6].reshape(2, 3).astype(np.float32)
        return Onward(box, sums.astype(np.float32), float(frame[6]), float(frame[7]))

    def chances(self, share: float) -> Array:
        """s of all cells (CELLS); `share` is that of the gradient in what counts as said, the rest is the image's.

        Where no ray has ever left a vertex all are infinite: whatever does go on.
        """
        if not (self.light > 0 and self.sums[3].any()):
            return np.full(CELLS, np.inf)
        sums = self.sums.astype(np.float64)
        squares, followed, left = share * sums[0] + (1 - share) * sums[1], sums[2], sums[3]
        m, c = _leaning(np.stack([squares, followed]), left)
        ratio = m / (RAY + c)
        least = FLOOR * squares.sum() / (RAY * left.sum() + followed.sum())
        return np.asarray(SURE * np.sqrt(np.maximum(ratio, least) * self.length) / self.light)


def _leaning(sums: Array, counts: Array) -> Array:
    """Means (K, CELLS) of sums (K, CELLS) over counts (CELLS), each leaning on that of the larger cubes about it."""
    total = max(float(counts.sum()), 1.0)
    means = np.broadcast_to((sums.sum(1) / total)[:, None, None, None, None], (len(sums), 1, 1, 1, SHAPE[-1]))
    for level in range(BITS + 1):
        here, number = _cubes(sums, level), _cubes(counts[None], level)
        if level > 0:
            for axis in (1, 2, 3):
                means = means.repeat(2, axis)
        means = (here + LEAN * means) / (number + LEAN)
    return means.reshape(len(sums), CELLS)


def _cubes(values: Array, level: int) -> Array:
    """Sums over the cubes of a level, 2^level along each axis, octants apart: (K, 2^level, 2^level, 2^level, 8)."""
    few, each = 1 << level, 1 << (BITS - level)
    return np.asarray(values.reshape(len(values), few, each, few, each, few, each, SHAPE[-1]).sum((2, 4, 6)))
