"""Statistics of convergence: the error of averages of n steps, its slope, efficiency, and the time for a given error.

Samples x are (R, P): R steps, P entries. The reference r is the mean of rows (K, P), other steps, each an independent
estimate of the same mean. Sums over entries of variances are traces, written tr:

    noise   = tr Var(r)                                  the reference's own squared standard error
    signal  = |r|^2 - noise                              the squared size of the estimated quantity
    MSE(n)  = mean over blocks of n steps |mean of a block - r|^2 - noise
    RMSE(n) = sqrt(MSE(n) / signal)                      relative
    bias^2  = |mean(x) - r|^2 - tr Var(x) / R - noise

All are unbiased, so single values may be negative. Intervals are those of the jackknife: one turn of steps after the
other is left out of the samples, one row after the other of the reference, and the two variances are added.
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
    """An estimate with its standard error and the degrees of freedom of that."""

    value: float
    error: float
    freedom: float

    def interval(self, confidence: float = CONFIDENCE) -> Range:
        """By Student's t."""
        half = float(stats.t.isf((1 - confidence) / 2, self.freedom)) * self.error
        return Range(self.value, self.value - half, self.value + half)

    def exponential(self, confidence: float = CONFIDENCE) -> Range:
        """The interval of the exponential, where this is of a logarithm."""
        own = self.interval(confidence)
        low, value, high = np.exp(np.clip([own.low, own.value, own.high], -700, 700))
        return Range(float(value), float(low), float(high))


@dataclass(frozen=True)
class Point:
    """The error of the average of `steps` steps, over `repeats` such; None where it drowns in the reference's own."""

    steps: int
    elapsed_s: float
    relative_rmse: float | None
    repeats: int


class ReferenceMean:
    """What errors are taken from: the mean of (K, P) rows, K at least 2."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows.astype(np.float64)
        self.mean = self.rows.mean(0)
        self.noise = float(self.rows.var(0, ddof=1).sum() / len(self.rows))
        self.signal = float(self.mean @ self.mean) - self.noise

    @property
    def floor(self) -> float | None:
        """Its own relative standard error; None where nothing stands out of its noise."""
        return float(np.sqrt(self.noise / self.signal)) if self.signal > 0 else None

    @cached_property
    def without(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """With one row after the other left out: what that adds to the mean (K, P), noise (K,) and signal (K,)."""
        count, deviations = len(self.rows), self.rows - self.mean
        moved = -deviations / (count - 1)
        squares = np.square(deviations).sum(1)
        # Leaving out a row lowers the sum of squares about the mean by K / (K - 1) times its own square.
        left = squares.sum() - squares * count / (count - 1)
        noise = left / max(count - 2, 1) / (count - 1)
        signal = np.square(self.mean + moved).sum(1) - noise
        return moved, noise, signal


class MethodSamples:
    """Steps (R, P) of one method beside a reference; `turns` (R,) says in which turn each was taken.

    `seconds` (T,) are those of one step in each turn.
    """

    def __init__(self, values: np.ndarray, turns: np.ndarray, seconds: np.ndarray, reference: ReferenceMean) -> None:
        self.reference, self.seconds = reference, np.asarray(seconds, np.float64)
        self.deviations = values.astype(np.float64) - reference.mean
        self.turns = np.unique(turns, return_inverse=True)[1]
        self.count = len(values)

    @property
    def step_s(self) -> float:
        """Seconds of a step, the mean over turns."""
        return float(self.seconds.mean())

    @cached_property
    def variance(self) -> float:
        """Trace of the variance of one step, relative to the signal."""
        return float(self.deviations.var(0, ddof=1).sum() / self.reference.signal)

    @cached_property
    def squared_bias(self) -> float:
        """Relative to the signal; 0 where the estimate is negative."""
        mean, variance = self.deviations.mean(0), self.variance * self.reference.signal
        return max(0.0, float(mean @ mean - variance / self.count - self.reference.noise)) / self.reference.signal

    def points(self) -> list[Point]:
        """Errors of averages of 1, 2, 4, ... steps, as far as there is one of them."""
        found, averages, steps = [], self.deviations, 1
        while len(averages):
            squared = float(np.square(averages).sum(1).mean()) - self.reference.noise
            error = float(np.sqrt(squared / self.reference.signal)) if squared > 0 else None
            found.append(Point(steps, steps * self.step_s, error, len(averages)))
            averages, steps = _halved(averages), 2 * steps
        return found

    def slope(self) -> JackknifeEstimate | None:
        """d log RMSE / d log time: -1/2 where steps are independent and unbiased. None where there are too few.

        Averages are over steps of one group. Their errors are weighted by how many averages there are of each length.
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
        """Logarithm of 1 / (relative variance * seconds of a step), with squared bias + variance where `biased`.

        None where there are too few turns, or no noise at all.
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
        """Seconds until the relative error is so small, and whether that lies beyond the steps that were taken.

        None where a bias keeps it from ever being so small. One step is the least.
        """
        room = error**2 - (self.squared_bias if biased else 0.0)
        if room <= 0:
            return None, False
        steps = max(self.variance / room, 1.0)
        floor = self.reference.floor
        return steps * self.step_s, bool(steps > self.count or floor is None or error < floor)


def _halved(averages: np.ndarray) -> np.ndarray:
    """Averages over pairs of (N, ...) neighbours; an odd last one is left out."""
    pairs = len(averages) // 2
    return 0.5 * (averages[0 : 2 * pairs : 2] + averages[1 : 2 * pairs : 2])


def _fit(lengths: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """What gives the slope of half the logarithm of (levels, ...) squared errors over that of the lengths."""
    weights = 1 / lengths
    at = np.log(lengths) - np.average(np.log(lengths), weights=weights)
    coefficients = weights * at / (weights * at**2).sum()
    return lambda squared: 0.5 * np.tensordot(coefficients, np.log(squared), 1)


def _error(squares: np.ndarray, sums: np.ndarray, counts: np.ndarray | int, noise: float, biased: bool) -> np.ndarray:
    """Variance of a step, and squared bias where `biased`, from |deviation|^2 added up and |sum of deviations|^2."""
    variance = (squares - sums / counts) / (counts - 1)
    if not biased:
        return np.asarray(variance)
    return np.asarray(np.maximum(sums / np.square(counts) - variance / counts - noise, 0.0) + variance)


def _joined(value: float, left: np.ndarray, right: np.ndarray) -> JackknifeEstimate:
    """With the jackknife's variances of both sides, by Welch and Satterthwaite."""
    sides = [side for side in (left, right) if len(side) > 1]
    variances = [float(jackknife_variance(side)) for side in sides]
    total = sum(variances)
    spread = sum(v**2 / (len(side) - 1) for v, side in zip(variances, sides, strict=True))
    return JackknifeEstimate(value, float(np.sqrt(total)), total**2 / spread if spread > 0 else float(len(left) - 1))
