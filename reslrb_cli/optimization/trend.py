"""Whether a run moved anything: its loss and its errors at the start and at the end, told from their noise.

Compared are the first and the last tenth of the iterations, since a single loss is noise for the most part. Nothing is
said of a run that is too short or too noisy: whoever reads that the loss did not fall has to be able to rely on it.

- It fell, if the last tenth is surely below the first, by its mean or by its median. A fall is often over within a few
  iterations of the first tenth, so that its spread is no noise; the noise of one iteration is taken from the
  differences between neighbours instead, by their median: s = median |x_{i+1} - x_i| / (√2 Φ⁻¹(3/4)).
- It rose, if the last tenth is surely above the first, by mean and median, of which the latter does not know of single
  outliers (fireflies); or surely above the very first value, from where some runs leap before they come down again.
- It was flat, if it did neither, and surely fell by no more than `MOST_FALL`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

#: A run of fewer iterations is not judged, and so many are the least that are averaged.
LEAST_ITERATIONS, LEAST_WINDOW = 20, 5
#: How sure a difference has to be (one-sided).
CONFIDENCE = 0.99
#: A fall by no more than this share of the start is none, where noise hides it.
MOST_FALL = 0.25
#: An error has to rise by this share to be called worse, and in a run that is too short to know its wandering.
WORSE, WORSE_IF_SHORT = 0.01, 0.1
#: √2 Φ⁻¹(3/4): the median difference of two values from a normal distribution of standard deviation 1.
_MEDIAN_DIFFERENCE = 0.9539
#: The standard error of a median over that of a mean, for a normal distribution.
_MEDIAN_ERROR = 1.2533


@dataclass(frozen=True)
class Level:
    """The mean of some iterations, and its standard error."""

    mean: float
    error: float


class Change(str, enum.Enum):
    """What became of a series, as far as its noise tells."""

    FELL = "fell"
    ROSE = "rose"
    FLAT = "flat"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Trend:
    """A series at its start and at its end."""

    start: Level
    end: Level
    change: Change

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return {**asdict(self), "change": self.change.value}


def find_trend(values: Sequence[float]) -> Trend | None:
    """The trend of a value per iteration; those that are not finite are left out. None where there are too few."""
    series = np.array([value for value in values if math.isfinite(value)], dtype=np.float64)
    if series.size < LEAST_ITERATIONS:
        return None
    width = window(series.size)
    first, last = series[:width], series[-width:]
    start, end = _level(first), _level(last)
    sure = _quantile(2 * (width - 1))
    noise = sure * math.hypot(_noise(first), _noise(last)) / math.sqrt(width)
    spread = sure * math.hypot(start.error, end.error)
    mean, median = end.mean - start.mean, float(np.median(last) - np.median(first))
    above_first = _quantile(width - 1) * end.error * math.sqrt(width + 1)
    if end.mean - series[0] > above_first:
        return Trend(Level(float(series[0]), end.error * math.sqrt(width)), end, Change.ROSE)
    if mean > spread and median > _MEDIAN_ERROR * noise:
        change = Change.ROSE
    elif mean < -noise or median < -_MEDIAN_ERROR * noise:
        change = Change.FELL
    else:
        change = Change.FLAT if spread - mean < MOST_FALL * start.mean else Change.UNCLEAR
    return Trend(start, end, change)


def got_worse(errors: Sequence[float], final: float) -> bool:
    """Whether an error ended above its start: the last one, `final`, and all of the last tenth before it.

    Errors are known exactly, but wander with the noise of the gradients: a short run has to end well above its start.
    """
    if not errors:
        return False
    if len(errors) < LEAST_ITERATIONS:
        return final > (1 + WORSE_IF_SHORT) * errors[0]
    limit = (1 + WORSE) * errors[0]
    return min(final, *errors[-window(len(errors)) :]) > limit


def window(iterations: int) -> int:
    """How many of the first and of the last iterations are averaged."""
    return max(iterations // 10, LEAST_WINDOW)


def _noise(values: Array) -> float:
    return float(np.median(np.abs(np.diff(values)))) / _MEDIAN_DIFFERENCE


def _level(values: Array) -> Level:
    return Level(float(values.mean()), float(np.std(values, ddof=1)) / math.sqrt(len(values)))


def _quantile(freedom: int) -> float:
    from scipy.special import stdtrit  # late: only a run that ends needs it

    return float(stdtrit(freedom, CONFIDENCE))
