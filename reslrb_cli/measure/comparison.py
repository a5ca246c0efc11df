"""Comparisons of Monte Carlo estimates of gradients and images with a reference.

Samples are (N, P): N seeds, P entries. Gradients are compared over many seeds by z scores (`compare_expectations`), or
at equal seeds by relative L2, of all entries together and of each entry (`compare_equal_seeds`).

Welch's test of each entry compares two means over N and M independent samples. With equal seeds on both sides, the test
uses the differences a - b. It is then valid for any noise that both sides share, and shared noise makes it stronger.

    t = (mean_a - mean_b) / sqrt(s_a^2 / N + s_b^2 / M + floor^2)

z is the standard normal deviate with the same probability as t, so few samples do not look like a bias. A deviation
must be significant with and without the rounding error `floor`, because few samples can have a variance that is too
small by chance. A known error of the reference is no noise: it is subtracted from the deviation.

A small parameter is compared entry by entry. A texel that few paths reach has noise far from normal, so a large texture
is compared by sums over tiles, per channel, and other large parameters by runs of entries. Errors that cancel within a
tile show up in projections of all entries on random signs. Small errors add up in the sum of all entries.

Two criteria must hold. The largest |z| must be below Sidak's threshold for all entries of all rows of a table. The root
mean square of z over a row's noisy entries must be below a limit for nu normal deviates. nu is the effective number of
independent noisy entries (Satterthwaite), with the mean squared correlation r^2 between the samples of two entries,
corrected for chance.

    nu = E / (1 + (E - 1) r^2)

If the tails of a row are too heavy for z scores, or unknown because there are fewer than `TAIL_SEEDS` samples, only
entries without noise are judged. The row fails if they deviate, and is open otherwise.

`detectable` is the deviation that the first criterion finds with the probability `POWER`. t then has a noncentral t
distribution.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.records.measurements import Comparison, Verdict
from reslrb_cli.statistics import special

#: Probability that a comparison of two equal expectations fails, for each of its two criteria. Seeds are fixed, so a
#: test that passes once always passes.
ALPHA = 1e-4

#: Probability of detecting a deviation of the size `detectable`.
POWER = 0.9

#: Degrees of freedom from which Student's t counts as normal.
MOST_FREEDOM = 1000


@dataclass(frozen=True)
class Deviation:
    """Difference of two means for each entry. `var` is its variance, and 2 `spread` is the variance of `var`.

    `floor` is the absolute rounding error, which is certain.
    """

    mean: np.ndarray
    var: np.ndarray
    spread: np.ndarray
    floor: np.ndarray

    @staticmethod
    def of(a: np.ndarray, b: np.ndarray, rounding: float) -> Deviation:
        """Return mean(a) - mean(b). Means are taken along axis 0, and the other axes hold the entries. `rounding` is
        relative to the means.
        """
        mean_a, mean_b = a.mean(0), b.mean(0)
        var_a, var_b = a.var(0, ddof=1) / len(a), b.var(0, ddof=1) / len(b)
        spread = var_a**2 / (len(a) - 1) + var_b**2 / (len(b) - 1)
        floor = rounding * np.maximum(np.abs(mean_a), np.abs(mean_b))
        return Deviation(mean_a - mean_b, var_a + var_b, spread, floor)

    @staticmethod
    def paired(difference: np.ndarray, floor: Any = 0.0) -> Deviation:
        """Return the mean of a difference (N, ...) along axis 0. Both sides have equal seeds, and may share noise."""
        mean, var = difference.mean(0), difference.var(0, ddof=1) / len(difference)
        return Deviation(mean, var, var**2 / (len(difference) - 1), np.broadcast_to(floor, mean.shape))

    @property
    def noisy(self) -> np.ndarray:
        """Entries whose noise exceeds the rounding error."""
        return np.asarray(self.var > np.square(self.floor))

    def _distribution(self, floor: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the standard error with the rounding error `floor`, and its degrees of freedom."""
        total = self.var + np.square(floor)
        with np.errstate(divide="ignore", invalid="ignore"):
            freedom = np.where(self.spread > 0, total**2 / self.spread, np.inf)
        return np.sqrt(total), freedom

    def z(self, bias: Any = 0.0) -> np.ndarray:
        """Return standard normal scores against zero, with or without the rounding error, whichever is nearer to 0.

        `bias` bounds a known error, such as truncation. The absolute value of the mean is reduced by it, down to 0.
        """
        mean, scores = np.sign(self.mean) * np.maximum(np.abs(self.mean) - bias, 0.0), []
        for floor in (0.0, self.floor):
            error, freedom = self._distribution(floor)
            with np.errstate(divide="ignore", invalid="ignore"):
                scores.append(_normal_scores(np.where(mean == 0, 0.0, mean / error), freedom))
        plain, rounded = scores
        return np.where(np.abs(plain) < np.abs(rounded), plain, rounded)

    def detectable(self, limit: float) -> np.ndarray:
        """Return the deviation of each entry whose |z| exceeds `limit` with the probability `POWER`."""
        error, freedom = self._distribution(self.floor)
        found, at = np.unique(np.clip(np.floor(freedom), 1, MOST_FREEDOM), return_inverse=True)
        needed = np.array([_needed(each, limit) for each in found])
        return np.asarray(error * needed[at.reshape(error.shape)])


@functools.lru_cache(maxsize=MOST_FREEDOM)
def _needed(freedom: float, limit: float) -> float:
    """Return the deviation, in estimated standard errors, whose |z| exceeds `limit` with the probability `POWER`.

    t = (normal deviate + deviation) / s has a noncentral t distribution, where s is the error of an estimated standard
    error. The standard error that is known here is another estimate with the same `freedom`, so its error counts too.
    """
    functions, chances = special(), (np.arange(64) + 0.5) / 64
    critical = -functions.stdtrit(freedom, functions.ndtr(-limit))
    s = np.sqrt(functions.chdtri(freedom, chances) / freedom)
    low, high = 0.0, 10 * critical
    for _ in range(50):
        middle = 0.5 * (low + high)
        found = functions.ndtr(middle * s[:, None] - critical * s).mean()
        low, high = (middle, high) if found < POWER else (low, middle)
    return float(high)


def _normal_scores(t: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return the standard normal z that has the same probability as Student's t."""
    z = -np.sign(t) * special().ndtri(special().stdtr(np.minimum(freedom, 1e6), -np.abs(t)))
    # Beyond the resolution of doubles, the t distribution decides.
    return np.where(np.isfinite(z), z, t)


def sidak(count: int, alpha: float = ALPHA) -> float:
    """Return the |z| that the largest of `count` independent normal deviates exceeds with probability `alpha`."""
    return float(-special().ndtri(-np.expm1(np.log1p(-alpha) / count) / 2))


def combined_z_rms(z: np.ndarray) -> float:
    """Return the root mean square of z scores: 1 if the two estimators agree, and 0 without scores. NaN stays NaN."""
    return float(np.sqrt(np.mean(np.square(z)))) if z.size else 0.0


def z_rms_limit(count: float, alpha: float = ALPHA) -> float:
    """Return a limit for the root mean square of `count` independent normal deviates. They exceed it with probability
    `alpha`.
    """
    return float(np.sqrt(special().chdtri(count, alpha) / count))


def effective_entries(samples: np.ndarray) -> float:
    """Return the effective number of independent entries of (N, E) samples: between 1 and E."""
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


#: Tiles of a texture along each side, the finest first.
TILES = (8, 4, 2, 1)

#: Largest number of entries that are compared one by one.
FEW = 48

#: Number of projections of a larger parameter.
PROJECTIONS = 16


def divisions(shape: tuple[int, ...]) -> list[int]:
    """Return the divisions of a parameter of this shape, the finest first.

    A division is given as the number of tiles along each side, or as 0 for single entries.
    """
    size = int(np.prod(shape, dtype=int))
    if size <= 4:
        return [0]
    coarser = [tiles for tiles in TILES if parts(np.zeros((1, size)), shape, tiles).shape[1] < size]
    return [0, *coarser] if size <= FEW else coarser


def parts(samples: np.ndarray, shape: tuple[int, ...], tiles: int) -> np.ndarray:
    """Return the sums (N, E) of gradients (N, P) over the parts of one division. The parameter has the given
    `shape`.
    """
    if tiles == 0:
        return samples
    height, width, channels = shape if len(shape) == 3 else (1, samples.shape[1], 1)
    down = min(tiles, height)
    across = min(tiles if len(shape) == 3 else tiles * tiles, width)
    grid = samples.reshape(len(samples), height, width, channels)
    rows, columns = (np.arange(n) * size // n for n, size in ((down, height), (across, width)))
    sums = np.add.reduceat(np.add.reduceat(grid, rows, axis=1), columns, axis=2)
    return sums.reshape(len(samples), -1)


def overall(samples: np.ndarray) -> np.ndarray:
    """Return the entries (N, E) that include all P values. The entries are the sum and, for many values, projections on
    random signs.
    """
    size = samples.shape[1]
    if size == 1:
        return samples[:, :0]
    total = samples.sum(1, keepdims=True)
    if size <= FEW:
        return total
    random = np.random.default_rng(size)
    # One by one: together they would take more memory than the samples.
    projections = [samples @ (2.0 * random.integers(0, 2, size) - 1.0) for _ in range(PROJECTIONS)]
    return np.concatenate([np.stack(projections, 1), total], 1)


def entry_count(shape: tuple[int, ...]) -> int:
    """Return the largest number of entries that a comparison uses for a parameter of the given `shape`."""
    none = np.zeros((1, int(np.prod(shape, dtype=int))))
    return parts(none, shape, divisions(shape)[0]).shape[1] + overall(none).shape[1]


#: Relative error of single precision in a sum over many samples, which is added to the standard error.
ROUNDING = 1e-4

#: Relative difference of a stock integrator on the same paths: it rounds the visibility of points differently.
STOCK_ROUNDING = 1e-3

#: If a deviation by this fraction of the gradient, such as that of a missing gradient, would not be detected, the
#: comparison is open.
RESOLUTION = 1.0

#: Tails are too heavy for z scores if the mean kurtosis of the entries' samples exceeds this fraction of the way from
#: normal deviates to the largest value of N samples, which is that of one outlier.
TAIL = 0.5

#: Only divisions into tiles with lighter tails are used: z scores of skewed samples are too large.
TILE_TAIL = 0.12

#: Tails do not matter if the noise is less than this many times the rounding error, or this many times smaller than the
#: error of the reference: no z score becomes large.
NOISY = 10

#: Entries below this fraction of the largest one may be rounding errors.
NEGLIGIBLE = 1e-6

#: Fewer seeds tell nothing about tails.
TAIL_SEEDS = 8


@dataclass(frozen=True)
class Family:
    """Comparisons that share one correction: a table with `rows` rows and `entries` entries in total."""

    rows: int = 1
    entries: int = 1
    alpha: float = ALPHA

    @property
    def z_max_limit(self) -> float:
        """Limit for the largest |z| of a table. A correct table exceeds the limit with probability `alpha`."""
        return sidak(self.entries, self.alpha)

    def z_rms_limit(self, independent: float) -> float:
        """Return the limit of the root mean square of a row's z. The probability that at least one row of a correct
        table exceeds the limit is `alpha`.
        """
        return z_rms_limit(independent, float(-np.expm1(np.log1p(-self.alpha) / self.rows)))


def compare_expectations(
    ours: np.ndarray, reference: np.ndarray, family: Family, *, shape: tuple[int, ...] | None = None,
    paired: bool = True, bias: Any = 0.0, rounding: float = ROUNDING, reference_error: float = 0.0,
) -> Comparison:  # fmt: skip
    """Compare the means of (N, P) samples with the means of a reference.

    If `paired`, `reference` is (N, P) at the same seeds. Otherwise `reference` is (M, P) at other seeds, or (P,) for
    exact values. If the parameter's `shape` is given, z scores belong to parts of the parameter (`entries`) instead of
    single values. `bias` is the possible error of the reference, in the reference's units: one number, or a number for
    each entry. `reference_error` is another one, relative to the reference. Only larger differences count. `rounding`
    is relative to the entries. The rounding error is added to the standard error in quadrature.
    """
    problem = _problem(ours, reference)
    if problem is not None:
        return problem
    exact = reference.ndim == 1
    joined = exact or paired
    a, b = _entries(ours, np.atleast_2d(reference), shape, joined, rounding)
    mean, expected = a.mean(0), b.mean(0)
    floor, bias = rounding * np.maximum(np.abs(mean), np.abs(expected)), bias + reference_error * np.abs(expected)
    sides = [a - b] if joined else [a, b]
    deviation = Deviation.paired(sides[0], floor) if joined else Deviation.of(a, b, rounding)
    z, noisy = deviation.z(bias), deviation.noisy
    independent = min(effective_entries(side[:, noisy]) for side in sides) if noisy.any() else 1.0
    z_max, z_rms = float(np.abs(z).max()), combined_z_rms(z[noisy])
    rms_limit = family.z_rms_limit(independent)
    # The smallest relative error of the whole gradient that the most sensitive entry would detect.
    needed, seen = deviation.detectable(family.z_max_limit) + bias, np.abs(expected) > 0
    detectable = float((needed[seen] / np.abs(expected[seen])).min()) if seen.any() else np.inf
    counts = deviation.var > np.maximum(NOISY * floor, bias / NOISY) ** 2
    heavy = any(tail_weight(side[:, counts]) > TAIL for side in sides)
    few = len(ours) < TAIL_SEEDS
    judged = ~counts if heavy or few else np.ones_like(counts)
    our_mean, its_mean = ours.mean(0), np.atleast_2d(reference).mean(0)
    far = _ratio(np.linalg.norm(our_mean - its_mean), np.linalg.norm(its_mean))
    verdict, message = Verdict.HOLDS, ""
    if not np.all(np.abs(z[judged]) < family.z_max_limit) or (judged.all() and not z_rms < rms_limit):
        verdict = Verdict.FAILS
    elif heavy:
        verdict = Verdict.HEAVY_TAILED
        message = "single seeds dominate the variance: use more samples per pixel, or more seeds"
    elif few:
        verdict = Verdict.UNRESOLVED
        message = f"{len(ours)} seeds are too few to know the noise: use at least {TAIL_SEEDS}"
    elif detectable > RESOLUTION:
        verdict = Verdict.UNRESOLVED
        message = f"a deviation of {detectable:.0%} could hide in the noise: use more seeds"
    return Comparison(
        verdict, relative_l2=far, z_rms=z_rms, z_rms_limit=rms_limit, z_max=z_max, z_max_limit=family.z_max_limit,
        detectable=detectable, message=message, **_alikeness(ours, reference),
    )  # fmt: skip


def compare_equal_seeds(ours: np.ndarray, reference: np.ndarray, limit: float = ROUNDING) -> Comparison:
    """Compare (N, P) samples with reference samples at the same seeds, by the relative L2 distance of all samples
    together.

    Dim entries hardly count in this distance. The comparison therefore also fails if entries differ by their own size.
    The mean square of these relative distances must be below `limit`, too: at most this share of the entries may be
    zero by mistake.
    """
    problem = _problem(ours, reference)
    if problem is not None:
        return problem
    distance = float(np.linalg.norm(ours - reference) / np.linalg.norm(reference)) if reference.any() else np.inf
    sizes, differences = np.linalg.norm(reference, axis=0), np.linalg.norm(ours - reference, axis=0)
    with np.errstate(over="ignore"):
        own = differences / np.maximum(sizes, max(NEGLIGIBLE * sizes.max(), np.finfo(float).tiny))
    verdict, message = Verdict.HOLDS if distance < limit else Verdict.FAILS, ""
    if verdict is Verdict.HOLDS and not np.mean(np.square(own)) < limit:
        wrong = np.count_nonzero(own > np.sqrt(limit))
        message = f"{wrong} of {own.size} entries differ by up to {own.max():.2g} times their own size"
        verdict = Verdict.FAILS
    return Comparison(
        verdict, distance, relative_l2_limit=limit, detectable=limit, message=message, **_alikeness(ours, reference)
    )


def _alikeness(ours: np.ndarray, reference: np.ndarray) -> dict[str, float | None]:
    """Return the cosine of the angle between the means, and the ratio of the summed variances, or None for 0 / 0."""
    a, b = ours.mean(0), np.atleast_2d(reference).mean(0)
    cosine, varies = _ratio(a @ b, np.linalg.norm(a) * np.linalg.norm(b)), reference.ndim > 1 and len(ours) > 1
    ratio = _ratio(ours.var(0, ddof=1).sum(), reference.var(0, ddof=1).sum()) if varies else None
    return {"cosine": cosine if a.size > 1 else None, "variance_ratio": ratio}


def tail_weight(samples: np.ndarray) -> float:
    """Return the normalised mean kurtosis of the entries of (N, E) samples.

    The value is 0 for normal deviates, and 1 if each entry has one outlier and all other samples are equal. The value
    is negative for lighter tails. With fewer than `TAIL_SEEDS` samples or without variance, the value is 0.
    """
    count = len(samples)
    squares = np.square(samples - samples.mean(0))
    squares = squares[:, squares.sum(0) > 0]
    if squares.shape[1] == 0 or count < TAIL_SEEDS:
        return 0.0
    kurtosis = float((count * np.square(squares).sum(0) / squares.sum(0) ** 2).mean())
    normal, greatest = 3 * (count - 1) / (count + 1), count - 2 + 1 / (count - 1)
    return (kurtosis - normal) / (greatest - normal)


def _entries(
    ours: np.ndarray, reference: np.ndarray, shape: tuple[int, ...] | None, joined: bool, rounding: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return both sides (N, E) in the parameter's finest division whose samples are close enough to normal."""
    if shape is None:
        return ours, reference
    for tiles in divisions(shape):
        a, b = parts(ours, shape, tiles), parts(reference, shape, tiles)
        sides = [a - b] if joined else [a, b]
        floor = rounding * np.maximum(np.abs(a.mean(0)), np.abs(b.mean(0)))
        noisy = sum(side.var(0, ddof=1) / len(side) for side in sides) > floor**2
        if all(tail_weight(side[:, noisy]) <= TILE_TAIL for side in sides):
            break
    whole = overall(ours), overall(reference)
    return np.concatenate([a, whole[0]], 1), np.concatenate([b, whole[1]], 1)


def _problem(ours: np.ndarray, reference: np.ndarray) -> Comparison | None:
    """Return why samples cannot be compared at all, or None."""
    for name, samples in (("gradient", ours), ("reference", reference)):
        bad = int(np.count_nonzero(~np.isfinite(samples)))
        if bad:
            return Comparison(Verdict.FAILS, message=f"the {name} has {bad} entries that are not finite")
    if not ours.any() and not reference.any():
        return Comparison(Verdict.UNREACHED, message="gradient and reference are zero: no light path reaches it")
    return None


def _ratio(numerator: Any, denominator: Any) -> float | None:
    return float(numerator / denominator) if denominator > 0 else None
