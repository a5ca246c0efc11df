"""How much noise estimates of one vector have, and how it falls from a few samples to many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from reslrb_cli.measure.comparison import ALPHA
from reslrb_cli.records.measurements import Verdict
from reslrb_cli.statistics import jackknife_variance

#: Of the interval that is told; whether the expected ratio holds is asked at `ALPHA`.
CONFIDENCE = 0.95

#: A ratio that is known no better than by this factor, less 1, says nothing.
WIDEST = 0.2


@dataclass(frozen=True)
class Fall:
    """Noise of the one over that of the other: `ratio`, from `low` to `high` with `CONFIDENCE`, and what it should be.

    Whether it holds is asked of the interval that a right ratio leaves with probability `ALPHA`; one that is wider than
    `WIDEST` leaves the question open.
    """

    ratio: float
    low: float
    high: float
    expected: float
    verdict: Verdict


def relative_noise(samples: np.ndarray, mean: np.ndarray | None = None) -> float:
    """Standard deviation of (N, P) samples over the norm of their mean (or of a better known one), in L2."""
    norm = np.linalg.norm(samples.mean(0) if mean is None else mean)
    return float(np.sqrt(samples.var(0, ddof=1).sum()) / norm)


def fall(coarse: np.ndarray, fine: np.ndarray, expected: float) -> Fall:
    """The ratio of the noise of (N, P) samples to that of (M, P) others, and whether it is as expected.

    Its logarithm has the standard error that leaving out one sample after the other gives it (jackknife), and the
    degrees of freedom of Welch and Satterthwaite.
    """
    (a, var_a), (b, var_b) = (_log_deviation(samples) for samples in (coarse, fine))
    error = np.sqrt(var_a + var_b)
    freedom = error**4 / (var_a**2 / (len(coarse) - 1) + var_b**2 / (len(fine) - 1))
    half, most = (stats.t.isf(level / 2, freedom) * error for level in (1 - CONFIDENCE, ALPHA))
    verdict = Verdict.HOLDS if abs(a - b - np.log(expected)) <= most else Verdict.FAILS
    if verdict is Verdict.HOLDS and most > np.log1p(WIDEST):
        verdict = Verdict.UNRESOLVED
    low, ratio, high = np.exp([a - b - half, a - b, a - b + half])
    return Fall(float(ratio), float(low), float(high), expected, verdict)


def _log_deviation(samples: np.ndarray) -> tuple[float, float]:
    """Logarithm of the standard deviation of (N, P) samples, and the jackknife's variance of that."""
    count = len(samples)
    deviations = np.square(samples - samples.mean(0)).sum(1)
    total = deviations.sum()
    # Without sample k the sum of squares is smaller by N / (N - 1) of its own.
    left = 0.5 * np.log((total - deviations * count / (count - 1)) / (count - 2))
    return float(0.5 * np.log(total / (count - 1))), float(jackknife_variance(left))
