"""Whether two Monte Carlo estimators agree: Welch's test for each block of pixels, corrected for how many there are.

    t = (mean_a - mean_b) / sqrt(s_a^2 / N + s_b^2 / M)        per block and channel, over N and M independent renders

t is turned into the standard normal z of the same probability (Welch-Satterthwaite degrees of freedom), so that few
renders do not look like a bias. Beside the blocks, the mean of the whole image is tested: a bias that is everywhere
small shows there. Two sides must hold: max |z| under Sidak's threshold for all blocks and channels, and the root mean
square of z under that of as many normal deviates as there are blocks (channels may be fully correlated), or, entry by
entry, as the correlated entries are worth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

#: Probability that a comparison of two equal expectations fails, for each of its two criteria. Seeds are fixed, so that
#: a test that passes once passes always.
ALPHA = 1e-4


@dataclass(frozen=True)
class Agreement:
    """Result of a comparison; `z` is (blocks, C), the whole image's last; `difference` is mean_a / mean_b - 1."""

    z: np.ndarray
    threshold: float
    z_rms: float
    z_rms_threshold: float
    difference: float
    relative_error: float
    worst: str

    @property
    def holds(self) -> bool:
        """Whether both criteria hold; NaN does not."""
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


def renders(render: Callable[[int], Any], seeds: Iterable[int]) -> np.ndarray:
    """Stack `render(seed)` of all seeds, as float64: (N, ...)."""
    return np.stack([np.array(render(seed), dtype=np.float64) for seed in seeds])


def blocks(samples: np.ndarray, size: int) -> np.ndarray:
    """Means over blocks of `size` x `size` pixels of (N, H, W, C) samples: (N, blocks, C). Remainders count too."""
    _, height, width, _ = samples.shape
    rows, columns = range(0, height, size), range(0, width, size)
    return np.stack([samples[:, y : y + size, x : x + size].mean((1, 2)) for y in rows for x in columns], axis=1)


def z_scores(a: np.ndarray, b: np.ndarray, rounding: float = 1e-5) -> np.ndarray:
    """Standard normal scores of mean(a) - mean(b) along axis 0, for each of the other entries.

    `rounding` is the relative error that floating point alone may cause: it is added to the standard error, so that
    entries without noise (a lamp seen directly) can be compared.
    """
    mean_a, mean_b = a.mean(0), b.mean(0)
    var_a, var_b = a.var(0, ddof=1) / len(a), b.var(0, ddof=1) / len(b)
    floor = (rounding * np.maximum(np.abs(mean_a), np.abs(mean_b))) ** 2
    error = np.sqrt(var_a + var_b + floor)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(mean_a == mean_b, 0.0, (mean_a - mean_b) / error)
        # The rounding floor counts as known exactly.
        spread = var_a**2 / (len(a) - 1) + var_b**2 / (len(b) - 1)
        freedom = np.where(spread > 0, (var_a + var_b + floor) ** 2 / spread, np.inf)
    return _normal_scores(t, freedom)


def paired_z_scores(difference: np.ndarray, floor: Any = 0.0, bias: Any = 0.0) -> np.ndarray:
    """Standard normal scores of mean(difference) along axis 0 against zero, for each of the other entries.

    For estimates at equal seeds, whose noise is in part the same: `difference` is (N, ...). `floor`, what rounding may
    cause, is added to the standard error; `bias`, such as truncation, is taken off what the means differ by.
    """
    mean, var, floor = difference.mean(0), difference.var(0, ddof=1) / len(difference), np.square(floor)
    mean = np.sign(mean) * np.maximum(np.abs(mean) - bias, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(mean == 0, 0.0, mean / np.sqrt(var + floor))
        freedom = np.where(var > 0, (1 + floor / var) ** 2 * (len(difference) - 1), np.inf)
    return _normal_scores(t, freedom)


def _normal_scores(t: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """The standard normal z of the same probability as Student's t."""
    z = -np.sign(t) * stats.norm.ppf(stats.t.sf(np.abs(t), np.minimum(freedom, 1e6)))
    # Beyond what doubles resolve: as bad as t says.
    return np.where(np.isfinite(z), z, t)


def compare(a: np.ndarray, b: np.ndarray, block: int | None = 8, alpha: float = ALPHA) -> Agreement:
    """Compare (N, H, W, C) with (M, H, W, C) renders block by block; `block=None`: (N, ...) entry by entry.

    Assert on the result: `assert agreement, agreement` (or `assert compare(...)`, whose failure prints it).
    """
    if a.shape[1:] != b.shape[1:]:
        raise ValueError(f"renders of different shapes: {a.shape[1:]} and {b.shape[1:]}")
    if block is None:
        parts_a, parts_b = (x.reshape(len(x), -1, 1) for x in (a, b))
    else:
        parts_a, parts_b = blocks(a, block), blocks(b, block)
    all_a, all_b = (np.concatenate([x, x.mean(1, keepdims=True)], 1) for x in (parts_a, parts_b))
    z = z_scores(all_a, all_b)

    index, channel = np.unravel_index(np.argmax(np.where(np.isfinite(z), np.abs(z), np.inf)), z.shape)
    in_a, in_b = all_a[:, index, channel].mean(), all_b[:, index, channel].mean()
    where = "whole" if index == len(z) - 1 else f"block {index}"
    total_a, total_b = parts_a.mean((1, 2)), parts_b.mean((1, 2))
    scale = abs(total_b.mean()) or 1.0
    count: float = len(z) - 1
    if block is None:
        count = min(effective_entries(x.reshape(len(x), -1)) for x in (a, b))
    return Agreement(
        z=z,
        threshold=sidak(z.size, alpha),
        z_rms=combined_z_rms(z[:-1]),
        z_rms_threshold=z_rms_limit(count, alpha),
        difference=float((total_a.mean() - total_b.mean()) / scale),
        relative_error=float(np.hypot(stats.sem(total_a), stats.sem(total_b)) / scale),
        worst=f"{where}, channel {channel}: {in_a:.5g} against {in_b:.5g}",
    )


def sidak(count: int, alpha: float = ALPHA) -> float:
    """The |z| that the largest of `count` independent normal deviates exceeds with probability `alpha`."""
    return float(stats.norm.isf(-np.expm1(np.log1p(-alpha) / count) / 2))


def combined_z_rms(z: np.ndarray) -> float:
    """Root mean square of z scores: 1 where the two estimators agree. NaN stays NaN."""
    return float(np.sqrt(np.mean(np.square(z))))


def z_rms_limit(count: float, alpha: float = ALPHA) -> float:
    """What the root mean square of `count` independent normal deviates exceeds with probability `alpha`."""
    return float(np.sqrt(stats.chi2.isf(alpha, count) / count))


def effective_entries(samples: np.ndarray) -> float:
    """How many independent entries the correlated ones of (N, E) samples are worth: between 1 and E."""
    count, entries = samples.shape
    deviation = samples - samples.mean(0)
    size = np.linalg.norm(deviation, axis=0)
    unit = deviation[:, size > 0] / size[size > 0]
    moving = unit.shape[1]
    if moving < 2 or count < 3:
        return float(entries)
    squares = (np.square(unit.T @ unit).sum() - moving) / (moving * (moving - 1))
    chance = 1 / (count - 1)
    correlation = max(0.0, (squares - chance) / (1 - chance))
    return max(1.0, entries / (1 + (moving - 1) * correlation))
