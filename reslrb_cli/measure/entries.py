"""The entries in which a gradient is compared: those of a small parameter, tiles and projections of a large one.

A texel that few paths meet has a gradient whose noise is far from normal, and z scores of thousands of them raise false
alarms. So a large texture is compared in tiles, each the sum over its texels, per channel; any other large parameter in
runs of consecutive entries. What sums hide, an error that cancels within a tile, shows in projections on random signs,
which take every texel in, and whose noise is nearer to normal than a texel's. The sum of all comes last, where small
errors of all entries add up.
"""

from __future__ import annotations

import numpy as np

#: Tiles of a texture along each side, the finest division first.
TILES = (8, 4, 2, 1)
#: Parameters with no more entries than these may be compared entry by entry.
FEW = 48
#: Projections of a parameter that has more.
PROJECTIONS = 16


def divisions(shape: tuple[int, ...]) -> list[int]:
    """How a parameter of this shape can be divided, the finest first: tiles along each side, 0 for every entry."""
    size = int(np.prod(shape, dtype=int))
    if size <= 4:
        return [0]
    coarser = [tiles for tiles in TILES if _parts(np.zeros((1, size)), shape, tiles).shape[1] < size]
    return [0, *coarser] if size <= FEW else coarser


def parts(samples: np.ndarray, shape: tuple[int, ...], tiles: int) -> np.ndarray:
    """Sums over the parts of one division: (N, E) of the (N, P) gradients of a parameter of this shape."""
    return samples if tiles == 0 else _parts(samples, shape, tiles)


def overall(samples: np.ndarray) -> np.ndarray:
    """What takes all P entries in: projections on random signs where there are many, and the sum; (N, E)."""
    size = samples.shape[1]
    if size == 1:
        return samples[:, :0]
    total = samples.sum(1, keepdims=True)
    if size <= FEW:
        return total
    random = np.random.default_rng(size)
    # One after the other: together they would take more memory than the samples.
    projections = [samples @ (2.0 * random.integers(0, 2, size) - 1.0) for _ in range(PROJECTIONS)]
    return np.concatenate([np.stack(projections, 1), total], 1)


def entry_count(shape: tuple[int, ...]) -> int:
    """The most entries in which a parameter of this shape is compared."""
    none = np.zeros((1, int(np.prod(shape, dtype=int))))
    return parts(none, shape, divisions(shape)[0]).shape[1] + overall(none).shape[1]


def _parts(samples: np.ndarray, shape: tuple[int, ...], tiles: int) -> np.ndarray:
    height, width, channels = shape if len(shape) == 3 else (1, samples.shape[1], 1)
    down = min(tiles, height)
    across = min(tiles if len(shape) == 3 else tiles * tiles, width)
    grid = samples.reshape(len(samples), height, width, channels)
    rows, columns = (np.arange(n) * size // n for n, size in ((down, height), (across, width)))
    sums = np.add.reduceat(np.add.reduceat(grid, rows, axis=1), columns, axis=2)
    return sums.reshape(len(samples), -1)
