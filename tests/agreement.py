"""Comparison of two sets of renders by Welch's test for each block of pixels, corrected for the number of blocks.

The mean of the whole image is tested as well, because it shows a small bias in all blocks. Two criteria must hold:

- max |z| is below Sidak's threshold for all blocks and channels.
- The root mean square of z is below the limit for as many independent normal deviates as there are blocks. Channels may
    be fully correlated.

Entry by entry, this limit uses the effective number of independent entries.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import stats

from reslrb_cli.measure.comparison import ALPHA, Deviation, combined_z_rms, effective_entries, sidak, z_rms_limit

#: Relative rounding error of means.
ROUNDING = 1e-5


@dataclass(frozen=True)
class Agreement:
    """Result of a comparison. `z` has the shape (blocks, C), and the last row belongs to the whole image. `difference`
    is mean_a / mean_b - 1.
    """

    z: np.ndarray
    threshold: float
    z_rms: float
    z_rms_threshold: float
    difference: float
    relative_error: float
    worst: str

    @property
    def holds(self) -> bool:
        """True if both criteria hold. NaN fails them."""
        return bool(np.abs(self.z).max() < self.threshold and self.z_rms < self.z_rms_threshold)

    def __bool__(self) -> bool:
        return self.holds

    def __str__(self) -> str:
        verdict = "agree" if self.holds else "DISAGREE"
        return (
            f"{verdict}: max |z| {np.abs(self.z).max():.2f} (limit {self.threshold:.2f}), z rms {self.z_rms:.2f} "
            f"(limit {self.z_rms_threshold:.2f}), {len(self.z) - 1} blocks, "
            f"mean differs by {self.difference:+.3%}, "
            f"standard error of the mean {self.relative_error:.2%}; worst: {self.worst}"
        )

    __repr__ = __str__


def is_same(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two results are equal to the bit. On a GPU, sums have no fixed order and may differ slightly."""
    return np.array_equal(a, b) or (mi.variant().startswith("cuda") and np.allclose(a, b, rtol=1e-4, atol=1e-6))


def renders(render: Callable[[int], Any], seeds: Iterable[int]) -> np.ndarray:
    """Return `render(seed)` for all seeds, stacked as float64: (N, ...)."""
    return np.stack([np.array(render(seed), dtype=np.float64) for seed in seeds])


def blocks(samples: np.ndarray, size: int) -> np.ndarray:
    """Return the means over blocks of `size` x `size` pixels of (N, H, W, C) samples, as (N, blocks, C). Incomplete
    blocks at the edges count too.
    """
    _, height, width, _ = samples.shape
    rows, columns = range(0, height, size), range(0, width, size)
    return np.stack([samples[:, y : y + size, x : x + size].mean((1, 2)) for y in rows for x in columns], axis=1)


def compare(a: np.ndarray, b: np.ndarray, block: int | None = 8, alpha: float = ALPHA) -> Agreement:
    """Compare (N, H, W, C) renders with (M, H, W, C) renders block by block. With `block=None`, compare (N, ...)
    renders entry by entry.

    Assert on the result with `assert agreement, agreement`. A failure of `assert compare(...)` prints the result as
    well.
    """
    if a.shape[1:] != b.shape[1:]:
        raise ValueError(f"renders of different shapes: {a.shape[1:]} and {b.shape[1:]}")
    if block is None:
        parts_a, parts_b = (x.reshape(len(x), -1, 1) for x in (a, b))
    else:
        parts_a, parts_b = blocks(a, block), blocks(b, block)
    all_a, all_b = (np.concatenate([x, x.mean(1, keepdims=True)], 1) for x in (parts_a, parts_b))
    deviation = Deviation.of(all_a, all_b, ROUNDING)
    z = deviation.z()

    index, channel = np.unravel_index(np.argmax(np.where(np.isfinite(z), np.abs(z), np.inf)), z.shape)
    in_a, in_b = all_a[:, index, channel].mean(), all_b[:, index, channel].mean()
    where = "whole" if index == len(z) - 1 else f"block {index}"
    total_a, total_b = parts_a.mean((1, 2)), parts_b.mean((1, 2))
    scale = abs(total_b.mean()) or 1.0
    noisy = deviation.noisy[:-1]
    count: float = max(int(noisy.any(1).sum()), 1)
    if block is None and noisy.any():
        count = min(effective_entries(x.reshape(len(x), -1)[:, noisy[:, 0]]) for x in (a, b))
    return Agreement(
        z=z,
        threshold=sidak(z.size, alpha),
        z_rms=combined_z_rms(z[:-1][noisy]),
        z_rms_threshold=z_rms_limit(count, alpha),
        difference=float((total_a.mean() - total_b.mean()) / scale),
        relative_error=float(np.hypot(stats.sem(total_a), stats.sem(total_b)) / scale),
        worst=f"{where}, channel {channel}: {in_a:.5g} against {in_b:.5g}",
    )
