"""The entries in which a gradient is compared: those of a small parameter, tiles and projections of a large one.

A texel that few paths meet has a gradient whose noise is far from normal, and z scores of thousands of them raise false
alarms. So a texture of more than TILES x TILES texels is compared in as many tiles, each the sum over its texels, per
channel; any other large parameter in runs of consecutive entries. What sums hide, an error that cancels within a tile,
shows in projections on random signs, which take every texel in. The sum of all comes last, where small errors of all
entries add up.
"""

from __future__ import annotations

import numpy as np

#: Tiles of a texture along each side.
TILES = 8
#: Parameters with no more entries than these are compared entry by entry.
FEW = 48
#: Projections of a parameter that is not.
PROJECTIONS = 16


def entries(samples: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Turn (N, P) gradients of a parameter of this shape into (N, E): each entry or tile, projections, the sum."""
    size = samples.shape[1]
    if size == 1:
        return samples
    total = samples.sum(1, keepdims=True)
    if size <= FEW:
        return np.concatenate([samples, total], 1)
    signs = np.random.default_rng(size).choice([-1.0, 1.0], (size, PROJECTIONS))
    return np.concatenate([_tiles(samples, shape), samples @ signs, total], 1)


def _tiles(samples: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    height, width, channels = shape if len(shape) == 3 else (1, samples.shape[1], 1)
    down = min(TILES, height)
    across = min(TILES * TILES // down, width) if len(shape) != 3 else min(TILES, width)
    grid = samples.reshape(len(samples), height, width, channels)
    rows, columns = (np.arange(n) * size // n for n, size in ((down, height), (across, width)))
    sums = np.add.reduceat(np.add.reduceat(grid, rows, axis=1), columns, axis=2)
    return sums.reshape(len(samples), -1)


def entry_count(shape: tuple[int, ...]) -> int:
    """How many entries `entries` makes of a parameter of this shape."""
    return entries(np.zeros((1, int(np.prod(shape, dtype=int)))), shape).shape[1]
