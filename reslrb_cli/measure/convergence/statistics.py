"""Statistics of convergence: the error of averages of n steps, its slope, efficiency, and the time for a given error.

Samples x are (R, P): R steps, P entries. The reference r is the mean of K rows (K, P). The rows are independent
estimates of the same mean, from other steps. tr is the trace of a covariance, which is the sum of all entries'
variances.

    noise   = tr Var(r)                                  the reference's own squared standard error
    signal  = |r|^2 - noise                              the squared size of the estimated quantity
    MSE(n)  = mean over blocks of n steps |mean of a block - r|^2 - noise
    RMSE(n) = sqrt(MSE(n) / signal)                      relative
    bias^2  = |mean(x) - r|^2 - tr Var(x) / R - noise

All these estimates are unbiased, so single values may be negative. Intervals come from the jackknife. The jackknife
leaves out one turn of steps at a time from the samples. For the reference, the jackknife leaves out one row at a time.
The two variances are added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

from reslrb_cli.records.measurements import Range
from reslrb_cli.statistics import jackknife_variance

#: Confidence level of all intervals.
CONFIDENCE = 0.95

#: Fewer turns, or rows of a reference, give no useful standard error.
FEWEST = 3

#: Minimum number of steps, and number of groups for the interval of a slope; the longest average is as long as a group.
#: The logarithms of errors of shorter averages, for example of a single colour, are so skewed that intervals are too
#: narrow.
GROUPS = {32: 8, 16: 4}

#: Fewer steps give no slope.
FEWEST_FOR_SLOPE = min(GROUPS)


@dataclass(frozen=True)
class JackknifeEstimate:
    """An estimate with its standard error, and the degrees of freedom of the standard error."""

    value: float
    error: float
    freedom: float

    def interval(self, confidence: float = CONFIDENCE) -> Range:
        """Return the interval by Student's t."""
        half = float(stats.t.isf((1 - confidence) / 2, self.freedom)) * self.error
        return Range(self.value, self.value - half, self.value + half)

    def exponential(self, confidence: float = CONFIDENCE) -> Range:
        """Return the interval of exp(value). The value of this estimate is a logarithm."""
        own = self.interval(confidence)
        low, value, high = np.exp(np.clip([own.low, own.value, own.high], -700, 700))
        return Range(float(value), float(low), float(high))


@dataclass(frozen=True)
class Point:
    """Error of averages of `steps` steps, computed from `repeats` averages. The error is None if the reference's own
    error is larger.
    """

    steps: int
    elapsed_s: float
    relative_rmse: float | None
    repeats: int


class ReferenceMean:
    """The reference of errors: the mean of (K, P) rows, with K at least 2."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows.astype(np.float64)
        self.mean = self.rows.mean(0)
        self.noise = float(self.rows.var(0, ddof=1).sum() / len(self.rows))
        self.signal = float(self.mean @ self.mean) - self.noise

    @property
    def floor(self) -> float | None:
        """The reference's own relative standard error, or None if its signal is not significant."""
        return float(np.sqrt(self.noise / self.signal)) if self.signal > 0 else None

    @cached_property
    def without(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Leave-one-out results for each row: the change of the mean (K, P), the noise (K,) and the signal (K,)."""
        count, deviations = len(self.rows), self.rows - self.mean
        moved = -deviations / (count - 1)
        squares = np.square(deviations).sum(1)
        # Leaving out a row lowers the sum of squares about the mean by K / (K - 1) times its own square.
        left = squares.sum() - squares * count / (count - 1)
        noise = left / max(count - 2, 1) / (count - 1)
        signal = np.square(self.mean + moved).sum(1) - noise
        return moved, noise, signal


class MethodSamples:
    """Steps (R, P) of one method and their reference. `turns` (R,) is the turn of each step.

    `seconds` (T,) has the time of one step in each turn.
    """

    def __init__(self, values: np.ndarray, turns: np.ndarray, seconds: np.ndarray, reference: ReferenceMean) -> None:
        self.reference, self.seconds = reference, np.asarray(seconds, np.float64)
        self.deviations = values.astype(np.float64) - reference.mean
        self.turns = np.unique(turns, return_inverse=True)[1]
        self.count = len(values)

    @property
    def step_s(self) -> float:
        """Seconds per step, averaged over turns."""
        return float(self.seconds.mean())

    @cached_property
    def variance(self) -> float:
        """Trace of the variance of one step, relative to the signal."""
        return float(self.deviations.var(0, ddof=1).sum() / self.reference.signal)

    @cached_property
    def squared_bias(self) -> float:
        """Squared bias relative to the signal, or 0 if the estimate is negative."""
        mean, variance = self.deviations.mean(0), self.variance * self.reference.signal
        return max(0.0, float(mean @ mean - variance / self.count - self.reference.noise)) / self.reference.signal

    def points(self) -> list[Point]:
        """Return the errors of averages of 1, 2, 4, ... steps, up to the number of steps."""
        found, averages, steps = [], self.deviations, 1
        while len(averages):
            squared = float(np.square(averages).sum(1).mean()) - self.reference.noise
            error = float(np.sqrt(squared / self.reference.signal)) if squared > 0 else None
            found.append(Point(steps, steps * self.step_s, error, len(averages)))
            averages, steps = _halved(averages), 2 * steps
        return found

    def slope(self) -> JackknifeEstimate | None:
        """Return d log RMSE / d log time, or None if there are too few steps. The slope is -1/2 for independent,
        unbiased steps.

        Averages are over steps of one group. The fit weights the error for each average length by the number of
        averages of that length.
        """
        groups = next((groups for steps, groups in GROUPS.items() if self.count >= steps), None)
        if groups is None:
            return None
        size = self.count // groups
        averages, levels, errors = self.deviations[: groups * size].reshape(groups, size, -1), [], []
        while averages.shape[1]:
            levels.append(size // averages.shape[1])
            errors.append(np.square(averages).sum(2).mean(1))
            averages = _halved(averages.swapaxes(0, 1)).swapaxes(0, 1)
        lengths = 2.0 ** np.arange(len(levels))
        raw, noise = np.array(errors), self.reference.noise  # (levels, groups)
        all_but_one = (raw.sum(1, keepdims=True) - raw) / (groups - 1) - noise
        moved, noises, _ = self.reference.without
        shift = np.square(moved).sum(1) - 2 * moved @ self.deviations.mean(0) - noises
        shifted = raw.mean(1)[:, None] + shift
        whole = raw.mean(1) - noise
        usable = (whole > 0) & (all_but_one > 0).all(1) & (shifted > 0).all(1)
        if usable.sum() < 2:
            return None
        fit = _fit(lengths[usable])
        value, left, right = fit(whole[usable]), fit(all_but_one[usable]), fit(shifted[usable])
        corrected = groups * value - (groups - 1) * left.mean()  # the logarithm of few averages is biased
        return _joined(float(corrected), left, right)

    def efficiency(self, biased: bool = False) -> JackknifeEstimate | None:
        """Return the logarithm of 1 / (relative variance * seconds of a step). Without noise or with too few turns,
        return None.

        If `biased`, the squared bias is added to the variance.
        """
        turns, reference = int(self.turns.max()) + 1, self.reference
        if turns < FEWEST or len(self.seconds) != turns or self.variance <= 0 or reference.signal <= 0:
            return None
        sums = np.zeros((turns, self.deviations.shape[1]))
        np.add.at(sums, self.turns, self.deviations)
        squares = np.bincount(self.turns, np.square(self.deviations).sum(1), turns)
        counts = self.count - np.bincount(self.turns, minlength=turns)
        if counts.min() < 2:
            return None
        total = sums.sum(0)
        left_sums = total @ total - 2 * sums @ total + np.square(sums).sum(1)
        seconds = (self.seconds.sum() - self.seconds) / (turns - 1)
        own = _error(squares.sum() - squares, left_sums, counts, reference.noise, biased)
        whole = _error(squares.sum(), total @ total, self.count, reference.noise, biased)
        moved, noises, signals = reference.without
        if min(float(own.min()), float(whole), float(signals.min())) <= 0:
            return None
        other = np.full(len(moved), float(whole))
        if biased:
            variance = self.variance * reference.signal
            distance = np.square(total / self.count - moved).sum(1) - variance / self.count - noises
            other = np.maximum(distance, 0.0) + variance
        value = np.log(reference.signal) - np.log(float(whole)) - np.log(self.step_s)
        left = np.log(reference.signal) - np.log(own) - np.log(seconds)
        right = np.log(signals) - np.log(other) - np.log(self.step_s)
        return _joined(float(value), left, right)

    def seconds_to(self, error: float, biased: bool) -> tuple[float | None, bool]:
        """Return the seconds until the relative error is `error`. Also return a boolean that is true if the seconds are
        extrapolated.

        The seconds are None if a bias keeps the error above `error`. At least one step is needed. The boolean is true
        if more steps are needed than were measured. The boolean is also true if the reference's own error (`floor`) is
        unknown or larger than `error`. If the seconds are None, the boolean is false.
        """
        room = error**2 - (self.squared_bias if biased else 0.0)
        if room <= 0:
            return None, False
        steps = max(self.variance / room, 1.0)
        floor = self.reference.floor
        return steps * self.step_s, bool(steps > self.count or floor is None or error < floor)


def _halved(averages: np.ndarray) -> np.ndarray:
    """Return the average of each pair of neighbours along the first axis of (N, ...). An odd last one is left out."""
    pairs = len(averages) // 2
    return 0.5 * (averages[0 : 2 * pairs : 2] + averages[1 : 2 * pairs : 2])


def _fit(lengths: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that fits the slope of log(squared errors) / 2 over log(lengths), for squared errors (levels,
    ...).
    """
    weights = 1 / lengths
    at = np.log(lengths) - np.average(np.log(lengths), weights=weights)
    coefficients = weights * at / (weights * at**2).sum()
    return lambda squared: 0.5 * np.tensordot(coefficients, np.log(squared), 1)


def _error(squares: np.ndarray, sums: np.ndarray, counts: np.ndarray | int, noise: float, biased: bool) -> np.ndarray:
    """Return the variance of a step and, if `biased`, the squared bias.

    `squares` are sums of |deviation|^2, and `sums` are |sum of deviations|^2.
    """
    variance = (squares - sums / counts) / (counts - 1)
    if not biased:
        return np.asarray(variance)
    return np.asarray(np.maximum(sums / np.square(counts) - variance / counts - noise, 0.0) + variance)


def _joined(value: float, left: np.ndarray, right: np.ndarray) -> JackknifeEstimate:
    """Return an estimate with the jackknife variances of the samples and of the reference. Welch and Satterthwaite's
    rule combines the two variances.
    """
    sides = [side for side in (left, right) if len(side) > 1]
    variances = [float(jackknife_variance(side)) for side in sides]
    total = sum(variances)
    spread = sum(v**2 / (len(side) - 1) for v, side in zip(variances, sides, strict=True))
    return JackknifeEstimate(value, float(np.sqrt(total)), total**2 / spread if spread > 0 else float(len(left) - 1))
