"""Tests of a noisy series of losses. The tests show whether the series fell or rose over a run, or was flat.

Losses of iterations have heavy tails: one bright path can multiply a loss by ten. No test therefore uses a plain mean.

`find_trend` tests the ranks of all losses (Conover and Iman 1981). The test fits a line to the mean ranks of ten parts
of the series.

- The loss rose (or fell) if the line rises (or falls). The same holds if the last tenth of the iterations is
    significantly above (or below) the first tenth. In both cases, the levels of these tenths must agree.
- The loss also fell if the first three losses are above the second half of the losses. Many falls end within a few
    iterations.
- The loss also rose if the first loss is below all others, and significantly below the last tenth. Some runs jump at
    their first step, and then come down to a level above their start.
- Otherwise, the loss was flat if its fall is significantly less than `MOST_FALL`. The test adds `MOST_FALL` to the
    series as a gradual rise, and requires the line to rise.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from reslrb_cli.statistics import Array, special

#: Shorter series are not judged, and this is the minimum number of losses for a level at the start or the end.
LEAST_ITERATIONS, LEAST_WINDOW = 20, 5

#: Confidence for a change (one-sided).
CONFIDENCE = 0.99

#: Probability for the ends only: their losses are compared one by one, and may be correlated.
SURE_ENDS = 1e-4

#: A fall by less than this share of the start does not count.
MOST_FALL = 0.25

#: Losses at the start that can show a short fall.
EARLY = 3

#: Parts of a series for the line of `find_trend`.
PARTS = 10


@dataclass(frozen=True)
class Level:
    """Interquartile mean of some losses, and its standard error."""

    mean: float
    error: float


class Change(str, enum.Enum):
    """Significance of the change of a series."""

    FELL = "fell"
    ROSE = "rose"
    FLAT = "flat"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Trend:
    """Level of a series at its start and at its end. `late` is the change in the second half alone, or None if the half
    is too short.
    """

    start: Level
    end: Level
    change: Change
    late: Change | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the content as a mapping for JSON."""
        return {**asdict(self), "change": self.change.value, "late": None if self.late is None else self.late.value}


def find_trend(values: Sequence[float]) -> Trend | None:
    """Return the trend of a value per iteration, or None for too few values. Values that are not finite are left
    out.
    """
    series = np.array([value for value in values if math.isfinite(value)], dtype=np.float64)
    count, width = series.size, window(series.size)
    if count < LEAST_ITERATIONS:
        return None
    half_trend = find_trend(series[count // 2 :].tolist())
    late = None if half_trend is None else half_trend.change
    start, end = _level(series[:width]), _level(series[-width:])
    leap = float(special().stdtrit(width - 1, CONFIDENCE)) * end.error * math.sqrt(width + 1)
    if series[0] < min(series[1:].min(), end.mean - leap):
        return Trend(Level(float(series[0]), end.error * math.sqrt(width)), end, Change.ROSE, late)
    ranks = _ranks(series)
    ends = _apart(series[:width], series[-width:], SURE_ENDS)
    raised = series + MOST_FALL * abs(start.mean) * np.arange(count) / (count - width)
    falls = ends < 0 or _rises(_parts(-ranks))
    if _apart(series[:EARLY], series[count // 2 :]) < 0 or (falls and end.mean < start.mean):
        change = Change.FELL
    elif (ends > 0 or _rises(_parts(ranks))) and end.mean > start.mean:
        change = Change.ROSE
    else:
        change = Change.FLAT if _rises(_parts(_ranks(raised))) else Change.UNCLEAR
    return Trend(start, end, change, late)


def line(values: Array, at: Array | None = None) -> tuple[Array, Array]:
    """Return the least-squares slope of values (..., k) over `at` (default: 0 to k - 1), and its standard error."""
    count = values.shape[-1]
    x = np.arange(count) if at is None else np.asarray(at, dtype=np.float64)
    x, y = x - x.mean(), values - values.mean(axis=-1, keepdims=True)
    slope = y @ x / (x @ x)
    left = np.square(y - slope[..., None] * x).sum(axis=-1)
    return slope, np.sqrt(left / (count - 2) / (x @ x))


def window(iterations: int) -> int:
    """Return the number of iterations to average at the start and at the end."""
    return max(iterations // 10, LEAST_WINDOW)


def _rises(values: Array, at: Array | None = None, chance: float = (1 - CONFIDENCE) / 2) -> bool:
    slope, error = line(values, at)
    return bool(slope > -special().stdtrit(values.size - 2, chance) * error)


def _apart(first: Array, last: Array, chance: float = (1 - CONFIDENCE) / 2) -> int:
    """Return 1 if the last losses are significantly above the first, -1 if below, otherwise 0."""
    ranks, is_last = _ranks(np.concatenate([first, last])), np.arange(first.size + last.size) >= first.size
    return _rises(ranks, is_last, chance) - _rises(-ranks, is_last, chance)


def _parts(values: Array) -> Array:
    return np.array([part.mean() for part in np.array_split(values, PARTS)])


def _ranks(values: Array) -> Array:
    """Return the ranks of the values. Equal values share the mean of their ranks."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - count / 2)[place])


def _level(values: Array) -> Level:
    """Return the interquartile mean, with the standard error of Tukey and McLaughlin (1963)."""
    order, cut = np.sort(values), len(values) // 4
    kept = np.clip(values, order[cut], order[-1 - cut])
    share = 1 - 2 * cut / len(values)
    return Level(
        float(order[cut : values.size - cut].mean()), float(np.std(kept, ddof=1)) / share / math.sqrt(len(values))
    )
