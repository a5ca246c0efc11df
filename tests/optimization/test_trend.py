"""Trend of losses with heavy tails: frequency of errors of the test, over many simulated runs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from turns import a_few

from reslrb_cli.optimization.trend import Change, find_trend
from reslrb_cli.statistics import Array

#: A hundred consecutive losses of grey_room by light paths (48 x 36 pixels, 4 samples), divided by their trend.
REAL = np.array([
    0.92, 1.35, 0.85, 0.72, 0.95, 0.81, 0.84, 1.03, 1.12, 0.65, 1.13, 0.99, 0.81, 12.8, 1.14, 0.91, 1.5, 3.27, 1.26,
    0.79, 0.65, 1.22, 0.89, 0.81, 0.93, 0.7, 1.28, 0.66, 64.55, 1.4, 0.86, 1.54, 0.95, 300.42, 0.99, 0.69, 1.09, 1.07,
    0.64, 0.68, 1.08, 0.83, 0.86, 1.0, 0.57, 0.98, 0.68, 0.91, 1.29, 0.95, 0.8, 0.75, 1.12, 1.69, 1.01, 0.79, 0.67,
    0.81, 0.56, 1.09, 0.9, 1.49, 1.03, 0.65, 0.43, 0.82, 0.68, 0.74, 0.87, 1.04, 0.94, 0.82, 1.07, 0.74, 0.93, 1.16,
    0.48, 0.75, 0.9, 0.87, 0.9, 0.77, 0.96, 0.78, 0.69, 0.68, 0.75, 1.0, 0.87, 1.07, 1.21, 1.09, 0.94, 0.73, 0.88,
    0.86, 1.01, 0.99, 1.62, 0.94,
])  # fmt: skip


def bright(random: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Return losses with noise of a tenth. One iteration in twenty is up to ten times as bright."""
    firefly = np.where(random.random(shape) < 0.05, random.uniform(1, 10, shape), 1)
    return (1 + 0.1 * random.normal(size=shape)) * firefly


def real(random: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Return pieces of ten consecutive losses of the real run."""
    first = random.integers(0, REAL.size - 10, (shape[0], shape[1] // 10))
    return REAL[first[..., None] + np.arange(10)].reshape(shape)


def wandering(random: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Return losses that each share half of their deviation with the previous loss."""
    drawn = 0.1 * random.normal(size=shape)
    for i in range(1, shape[1]):
        drawn[:, i] = 0.5 * drawn[:, i - 1] + np.sqrt(0.75) * drawn[:, i]
    return 1 + drawn


NOISE: dict[str, Callable[[np.random.Generator, tuple[int, int]], Array]] = {
    "normal, 10 %": lambda random, shape: 1 + 0.1 * random.normal(size=shape),
    "normal, 30 %": lambda random, shape: 1 + 0.3 * random.normal(size=shape),
    "t of 3 degrees": lambda random, shape: 1 + 0.1 * random.standard_t(3, size=shape),
    "fireflies": bright,
    "grey_room": real,
    "wandering": wandering,
}


#: test_verdicts.py has normal noise of a tenth. The tails of t are like those of fireflies.
FEW = ["fireflies", "wandering"]


@pytest.mark.parametrize("kind", a_few(NOISE, FEW))
@pytest.mark.parametrize("iterations", a_few([20, 100, 400], ["100"]))
def test_flat_losses_rarely_fall_or_rise(kind: str, iterations: int) -> None:
    flat = NOISE[kind](np.random.default_rng(6), (300, iterations))
    found = [found.change for series in flat if (found := find_trend(series)) is not None]
    tolerance = 3 * np.sqrt(0.05 * 0.95 / len(flat)) if (kind, iterations) == ("wandering", 20) else 0
    for change in (Change.FELL, Change.ROSE):
        assert found.count(change) / len(flat) <= 0.05 + tolerance, change
    assert iterations < 400 or found.count(Change.FLAT) > 0.6 * len(flat)


def test_the_second_half_of_a_run_is_judged_separately() -> None:
    fading = (0.3 + 26 * 0.5 ** (np.arange(200) / 10)) * NOISE["normal, 10 %"](np.random.default_rng(7), (1, 200))[0]
    found = [find_trend(series) for series in (fading, 0.5 ** (np.arange(200) / 50), fading[:30])]
    assert [(each.change, each.late) for each in found if each is not None] == [
        (Change.FELL, Change.FLAT),
        (Change.FELL, Change.FELL),
        (Change.FELL, None),
    ]
