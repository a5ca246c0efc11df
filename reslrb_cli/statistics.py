"""Statistics and transforms of arrays that several modules share."""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


def jackknife_variance(without: Array) -> Array:
    """Return the jackknife variance (...) of an estimate. Its square root is the standard error.

    `without` (N, ...) holds N estimates. Estimate i leaves out sample i of the N independent samples. Source: Efron,
    The Jackknife, the Bootstrap and Other Resampling Plans, 1982.
    """
    count = len(without)
    return np.asarray((count - 1) / count * np.sum(np.square(without - without.mean(axis=0)), axis=0))


def squares_without(rows: Array) -> tuple[float, Array]:
    """Return the sum of the squares of rows (N, P) about their mean, and the sums (N,) without each row in turn.

    Without row i, the sum is smaller by N / (N - 1) times the squared distance of row i from the mean.
    """
    squares = np.square(rows - rows.mean(axis=0)).sum(axis=1)
    return float(squares.sum()), np.asarray(squares.sum() - squares * len(rows) / (len(rows) - 1))


def special() -> Any:
    """Return `scipy.special`. Its import takes 0.2 s, and most runs need it only at their end."""
    import scipy.special

    return scipy.special


def isotonic_regression() -> Any:
    """Return `scipy.optimize.isotonic_regression`, whose import takes 0.2 s."""
    import scipy.optimize

    return scipy.optimize.isotonic_regression


def rms(values: Array) -> float:
    """Return the root mean square of all entries, in double precision."""
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def scale_frequencies(values: Array, factors: Array) -> Array:
    """Return images (..., H, W, C) with their cosine series over rows and columns multiplied by `factors`.

    A cosine series is even at the borders.
    """
    from scipy.fft import dctn, idctn  # imported here, because it imports `scipy.special`

    spectrum = dctn(values, axes=(-3, -2), norm="ortho")
    return np.asarray(idctn(spectrum * factors, axes=(-3, -2), norm="ortho"))


def sum_of_squares(values: Array) -> float:
    """Return the sum of the squares of all entries, in double precision."""
    return float(np.sum(np.square(values, dtype=np.float64)))
