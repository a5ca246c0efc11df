"""Errors, slopes, efficiencies and times from samples whose law is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from reslrb_cli.measure.convergence.statistics import Reference, Samples

REPETITIONS = 200
#: How many of the repetitions may cover the truth where each does with a probability of 95 %: all but one in 1000.
LEAST, MOST = (int(stats.binom.ppf(p, REPETITIONS, 0.95)) for p in (0.0005, 0.9995))
TRUTH = np.random.default_rng(2).uniform(0.5, 2.0, 40)
SIGNAL = float(TRUTH @ TRUTH)
SECONDS = 0.2


def noise(random: np.random.Generator, count: int) -> np.ndarray:
    """(count, 40) with a variance of 3 and 0.2 in each entry, the larger part common to many."""
    common = np.random.default_rng(1).standard_normal((4, 40))
    common *= np.sqrt(3.0 / np.square(common).sum(0))
    return random.standard_normal((count, 4)) @ common + np.sqrt(0.2) * random.standard_normal((count, 40))


VARIANCE = 3.2 * 40


def make(seed: int, steps: int = 48, rows: int = 24, per_row: int = 6, per_turn: int = 2, bias: float = 0.0) -> Samples:
    random = np.random.default_rng(1000 + seed)
    means = TRUTH + noise(random, rows * per_row).reshape(rows, per_row, -1).mean(1)
    values, turns = TRUTH * (1 + bias) + noise(random, steps), np.arange(steps) // per_turn
    seconds = SECONDS * random.gamma(40, 1 / 40, steps // per_turn)
    return Samples(values, turns, seconds, Reference(means))


def test_errors_are_those_of_averages_and_the_references_own_is_subtracted() -> None:
    """Of a reference as noisy as averages of 6 steps, which unsubtracted makes averages of 32 look twice as bad."""
    made = [make(seed, steps=64, rows=6, per_row=1) for seed in range(REPETITIONS)]
    for level in range(6):
        found = [samples.points()[level] for samples in made]
        assert {point.steps for point in found} == {2**level}
        assert {point.repeats for point in found} == {64 // 2**level}
        assert found[0].elapsed_s == pytest.approx(2**level * made[0].step_s)
        # A point drowns, and is None, where the estimate of its square is negative; squares are what is unbiased.
        squares = [
            float(np.square(s.deviations[: 64 // 2**level * 2**level].reshape(-1, 2**level, 40).mean(1)).sum(1).mean())
            - s.reference.noise
            for s in made
        ]
        told = [0.0 if p.relative_rmse is None else p.relative_rmse**2 * s.reference.signal
                for p, s in zip(found, made, strict=True)]  # fmt: skip
        np.testing.assert_allclose(told, np.maximum(squares, 0), rtol=1e-9, atol=1e-9)
        error = stats.sem(squares)
        assert abs(np.mean(squares) - VARIANCE / 2**level) < 4 * error
    assert VARIANCE / 32 + np.mean([s.reference.noise for s in made]) > 4 * VARIANCE / 32


def test_the_floor_and_the_signal() -> None:
    made = [make(seed).reference for seed in range(REPETITIONS)]
    for values, truth in (([r.noise for r in made], VARIANCE / 144), ([r.signal for r in made], SIGNAL)):
        assert abs(np.mean(values) - truth) < 4 * stats.sem(values)
    assert made[0].floor == pytest.approx(np.sqrt(made[0].noise / made[0].signal))
    assert Reference(np.random.default_rng(1).standard_normal((8, 5)) * 0.0).floor is None


def test_what_is_left_out_of_a_reference() -> None:
    reference = make(1, rows=5).reference
    moved, noises, signals = reference.without
    for k in range(5):
        rest = Reference(np.delete(reference.rows, k, axis=0))
        np.testing.assert_allclose(reference.mean + moved[k], rest.mean)
        assert (noises[k], signals[k]) == pytest.approx((rest.noise, rest.signal))


@pytest.mark.parametrize(("steps", "rows"), [(48, 24), (16, 8), (192, 48)])
def test_the_intervals_cover_what_they_say(steps: int, rows: int) -> None:
    """By 200 repetitions: of efficiency, which 1 / (relative variance * seconds) is, and of the slope, -1/2."""
    truth, covered, slopes = SIGNAL / VARIANCE / SECONDS, 0, 0
    for seed in range(REPETITIONS):
        samples = make(seed, steps, rows)
        estimate, slope = samples.efficiency(), samples.slope()
        assert estimate is not None
        assert slope is not None
        interval = estimate.exponential()
        covered += interval.low <= truth <= interval.high
        slopes += slope.interval().low <= -0.5 <= slope.interval().high
    assert LEAST <= covered <= MOST
    assert LEAST <= slopes <= MOST


@pytest.mark.parametrize("steps", [16, 32, 64])
def test_the_intervals_of_a_single_colour_cover_too(steps: int) -> None:
    """Its three channels deviate together, so that every error is the square of one normal number."""
    covered, slopes = 0, 0
    for seed in range(REPETITIONS):
        random = np.random.default_rng(seed)
        own, others = (1 + 0.1 * random.standard_normal((count, 1)) * np.ones(3) for count in (steps, 400))
        samples = Samples(own, np.arange(steps) // 2, np.ones(steps // 2), Reference(others.reshape(40, 10, 3).mean(1)))
        efficiency, slope = samples.efficiency(), samples.slope()
        assert efficiency is not None
        assert slope is not None
        covered += efficiency.exponential().low <= 100 <= efficiency.exponential().high
        slopes += slope.interval().low <= -0.5 <= slope.interval().high
    assert LEAST <= covered <= MOST
    assert LEAST <= slopes <= MOST


def test_the_interval_of_a_biased_method_covers_too() -> None:
    bias = 0.6
    truth, covered = SIGNAL / (VARIANCE + bias**2 * SIGNAL) / SECONDS, 0
    for seed in range(REPETITIONS):
        estimate = make(seed, bias=bias).efficiency(biased=True)
        assert estimate is not None
        covered += estimate.exponential().low <= truth <= estimate.exponential().high
    assert LEAST <= covered <= MOST
    unbiased = make(0, bias=bias).efficiency(biased=False)
    assert unbiased is not None
    assert unbiased.exponential().low > truth


def test_a_bias_flattens_the_slope() -> None:
    slope = make(3, steps=256, bias=0.5).slope()
    assert slope is not None
    assert slope.interval().low > -0.4
    assert np.sqrt(make(3, steps=256, bias=0.5).squared_bias) == pytest.approx(0.5, rel=0.2)


def test_seeds_that_repeat_flatten_the_slope() -> None:
    good = make(4, steps=64)
    values = np.repeat(good.deviations[::4] + good.reference.mean, 4, axis=0)
    slope = Samples(values, good.turns, good.seconds, good.reference).slope()
    assert slope is not None
    assert slope.interval().low > -0.45


def test_times() -> None:
    """As sqrt(variance / steps) says; beyond the steps, or below the floor, extrapolated; never less than a step."""
    samples = make(5, steps=64, rows=200)
    relative = samples.variance
    for target in (0.5, 0.2, 0.01):
        seconds, beyond = samples.seconds_to(target, biased=False)
        steps = max(relative / target**2, 1.0)
        assert seconds == pytest.approx(steps * samples.step_s)
        assert beyond is (steps > 64 or target < samples.reference.floor)
    assert [samples.seconds_to(target, False)[1] for target in (0.5, 0.01)] == [False, True]
    assert samples.seconds_to(100.0, False) == (samples.step_s, False)
    rough = make(5, steps=64, rows=3, per_row=1)
    assert rough.reference.floor > 0.3
    assert rough.seconds_to(0.3, False)[1]  # within the steps, but not to be told


def test_times_that_a_bias_forbids() -> None:
    samples = make(6, steps=256, rows=100, bias=0.2)
    size = float(np.sqrt(samples.squared_bias))
    assert samples.seconds_to(0.9 * size, biased=True) == (None, False)
    assert samples.seconds_to(0.9 * size, biased=False)[0] is not None
    seconds, _ = samples.seconds_to(2 * size, biased=True)
    assert seconds == pytest.approx(samples.variance / (3 * size**2) * samples.step_s)


def test_too_few_steps_have_no_intervals() -> None:
    assert make(7, steps=4, per_turn=2).efficiency() is None
    assert make(7, steps=6, per_turn=2).efficiency() is not None
    assert make(7, steps=15, per_turn=1).slope() is None
    assert make(7, steps=16, per_turn=1).slope() is not None
