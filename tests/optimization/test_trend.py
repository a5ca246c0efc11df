"""Trend of losses with heavy tails: frequency of errors of the test, over many simulated runs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from turns import a_few

from reslrb_cli.optimization.trend import Change, find_trend, window
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


def frequencies(curve: Callable[[Array], Array], iterations: int, kind: str = "normal, 10 %") -> dict[Change, float]:
    """Return the frequency of each verdict for 300 runs whose losses are `curve` of the iteration, times noise."""
    noise = NOISE[kind](np.random.default_rng(6), (300, iterations))
    found = [trend.change for row in noise if (trend := find_trend(curve(np.arange(iterations)) * row)) is not None]
    return {change: found.count(change) / len(found) for change in Change}


#: The tails of t are like those of fireflies.
FEW = [("normal, 10 %", 20), ("fireflies", 20), ("wandering", 100)]


@pytest.mark.parametrize(
    ("kind", "iterations"),
    [pytest.param(kind, count, marks=() if (kind, count) in FEW else pytest.mark.long)
     for kind in NOISE for count in (20, 100, 400)],
)  # fmt: skip
def test_flat_losses_rarely_fall_or_rise(kind: str, iterations: int) -> None:
    found = frequencies(np.ones_like, iterations, kind)
    tolerance = 3 * np.sqrt(0.05 * 0.95 / 300) if (kind, iterations) == ("wandering", 20) else 0
    assert max(found[Change.FELL], found[Change.ROSE]) <= 0.05 + tolerance
    assert iterations < 400 or found[Change.FLAT] > 0.6
    if kind == "normal, 10 %":
        assert found[Change.FLAT] > (0.7 if iterations == 20 else 0.95)
        assert max(found[Change.FELL], found[Change.ROSE]) < 0.04


def test_the_second_half_of_a_run_is_judged_separately() -> None:
    fading = (0.3 + 26 * 0.5 ** (np.arange(200) / 10)) * NOISE["normal, 10 %"](np.random.default_rng(7), (1, 200))[0]
    found = [find_trend(series) for series in (fading, 0.5 ** (np.arange(200) / 50), fading[:30])]
    assert [(each.change, each.late) for each in found if each is not None] == [
        (Change.FELL, Change.FLAT),
        (Change.FELL, Change.FELL),
        (Change.FELL, None),
    ]


@pytest.mark.parametrize(
    ("iterations", "decay"),
    [pytest.param(i, d, marks=() if (i, d) in ((20, 8), (100, 3)) else pytest.mark.long)
     for i in (20, 100, 1000) for d in (8, 3, 1)],
)  # fmt: skip
def test_a_fall_within_a_few_iterations_is_found(iterations: int, decay: int) -> None:
    """Up to nine tenths of the run's first tenth may be as low as its end."""
    found = frequencies(lambda i: 1 + 5 * np.exp(-i / decay), iterations)
    assert found[Change.FELL] > 0.95
    assert found[Change.FLAT] + found[Change.ROSE] < 0.01


@pytest.mark.parametrize("iterations", a_few([50, 200], ["50"]))
def test_fireflies_do_not_hide_a_fall(iterations: int) -> None:
    found = frequencies(lambda i: 1 + 5 * np.exp(-8 * i / len(i)), iterations, "fireflies")
    assert found[Change.FELL] > 0.8
    assert found[Change.FLAT] + found[Change.ROSE] < 0.01


def test_a_firefly_near_the_end_does_not_hide_a_fall() -> None:
    random = np.random.default_rng(4)
    values = np.concatenate([1 + 0.05 * random.normal(size=60), 0.2 + 0.02 * random.normal(size=40)])
    values[-4] = 30.0
    assert find_trend(values).change is Change.FELL


def test_a_slow_rise_is_found() -> None:
    found = frequencies(lambda i: 1 + 0.5 * i / len(i), 100)
    assert found[Change.ROSE] > 0.95


@pytest.mark.long
def test_a_slow_fall_is_rarely_missed() -> None:
    """The loss falls by a fifth over the run. A single iteration has noise of a tenth."""
    for iterations in (50, 100, 200):
        found = frequencies(lambda i: 1 - 0.2 * i / len(i), iterations)
        assert found[Change.FLAT] < 0.12
        assert found[Change.ROSE] < 0.01


def test_a_jump_that_declines_counts_as_a_rise() -> None:
    """With a rate far too large, Adam's loss jumps at once. The loss then falls slowly to a level above the start."""
    found = frequencies(lambda i: np.where(i == 0, 0.3, 1 + 20 * np.exp(-i / 10)), 100)
    assert found[Change.ROSE] > 0.95


def test_the_levels_are_the_first_and_the_last_tenth() -> None:
    values = np.concatenate([np.tile([1.0, 3.0], 10), np.full(160, 9.0), np.tile([0.4, 0.6], 10)])
    trend = find_trend(values)
    assert (trend.start.mean, trend.end.mean) == (pytest.approx(2.0), pytest.approx(0.5))
    # An interquartile mean leaves out half of the values. The kept half of these two values has the same spread as all
    # values.
    assert trend.start.error == pytest.approx(2 * np.std(values[:20], ddof=1) / np.sqrt(20))
    assert trend.to_json()["change"] == "fell"
    assert window(200) == 20


def test_a_run_without_any_change() -> None:
    trend = find_trend(np.full(30, 0.7))
    assert (trend.change, trend.start.error) == (Change.FLAT, 0.0)


def test_short_runs_and_non_finite_values() -> None:
    assert find_trend(np.linspace(0, 1, 19)) is None
    values = np.linspace(2, 1, 40)
    values[[3, 17]] = np.nan, np.inf
    assert find_trend(values).change is Change.FELL
    assert find_trend(np.full(100, np.nan)) is None
