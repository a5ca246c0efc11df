"""Whether a loss fell, told from its noise: how often the verdict is right, and what it never says."""

from __future__ import annotations

import collections

import numpy as np
import pytest

from reslrb_cli.optimization.results import Change, find_trend, got_worse, window

ROUNDS = 400


def shares(make, iterations, seed=3):
    """How often each verdict is given of noisy series."""
    random = np.random.default_rng(seed)
    found = collections.Counter(find_trend(make(random, np.arange(iterations))).change for _ in range(ROUNDS))
    return {change: found[change] / ROUNDS for change in Change}


def noisy(curve, noise=0.1):
    return lambda random, i: curve(i) * (1 + noise * random.normal(size=len(i)))


def fireflies(curve):
    """One iteration in fifty has a value of up to fifty times the usual one."""

    def make(random, i):
        bright = (random.random(len(i)) < 0.02) * 50 * random.random(len(i))
        return curve(i) * (1 + 0.1 * random.normal(size=len(i))) + bright

    return make


@pytest.mark.parametrize("iterations", [20, 100, 1000])
def test_nothing_but_noise_is_flat(iterations):
    found = shares(noisy(lambda i: np.ones(len(i))), iterations)
    assert found[Change.FLAT] > (0.75 if iterations == 20 else 0.95)
    assert max(found[Change.FELL], found[Change.ROSE]) < 0.04


@pytest.mark.parametrize("iterations", [20, 100, 1000])
@pytest.mark.parametrize("decay", [1, 3, 8])
def test_a_fall_within_a_few_iterations_is_seen(iterations, decay):
    """Nine tenths of the first tenth may be as low as the end."""
    found = shares(noisy(lambda i: 1 + 5 * np.exp(-i / decay)), iterations)
    assert found[Change.FELL] > 0.95
    assert found[Change.FLAT] + found[Change.ROSE] < 0.01


@pytest.mark.parametrize("iterations", [50, 200])
def test_fireflies_do_not_turn_a_fall_into_a_failure(iterations):
    found = shares(fireflies(lambda i: 1 + 5 * np.exp(-8 * i / len(i))), iterations)
    assert found[Change.FELL] > 0.8
    assert found[Change.FLAT] + found[Change.ROSE] < 0.01


def test_a_firefly_among_the_last_does_not_hide_a_fall():
    random = np.random.default_rng(4)
    values = np.concatenate([1 + 0.05 * random.normal(size=60), 0.2 + 0.02 * random.normal(size=40)])
    values[-4] = 30.0
    assert find_trend(values).change is Change.FELL


@pytest.mark.parametrize("iterations", [50, 200, 1000])
def test_fireflies_are_no_rise(iterations):
    assert shares(fireflies(lambda i: np.ones(len(i))), iterations)[Change.ROSE] < 0.04


def test_a_slow_rise_is_seen():
    found = shares(noisy(lambda i: 1 + 0.5 * i / len(i)), 100)
    assert found[Change.ROSE] > 0.95


def test_a_slow_fall_is_hardly_ever_denied():
    """A fifth over the run, where a single iteration has a tenth of noise."""
    for iterations in (50, 100, 200):
        found = shares(noisy(lambda i: 1 - 0.2 * i / len(i)), iterations)
        assert found[Change.FLAT] < 0.12
        assert found[Change.ROSE] < 0.01


def test_what_leaps_up_and_comes_down_again_rose():
    """Adam with a rate far too large: up at once, and slowly back to a level above the start."""
    found = shares(noisy(lambda i: np.where(i == 0, 0.3, 1 + 20 * np.exp(-i / 10))), 100)
    assert found[Change.ROSE] > 0.95


def test_the_levels_are_those_of_the_first_and_the_last_tenth():
    values = np.concatenate([np.tile([1.0, 3.0], 10), np.full(160, 9.0), np.tile([0.4, 0.6], 10)])
    trend = find_trend(values)
    assert (trend.start.mean, trend.end.mean) == (pytest.approx(2.0), pytest.approx(0.5))
    assert trend.start.error == pytest.approx(np.std(values[:20], ddof=1) / np.sqrt(20))
    assert trend.to_json()["change"] == "fell"
    assert window(200) == 20


def test_a_run_in_which_nothing_moves_at_all():
    trend = find_trend(np.full(30, 0.7))
    assert (trend.change, trend.start.error) == (Change.FLAT, 0.0)


def test_short_runs_and_values_that_are_not_finite():
    assert find_trend(np.linspace(0, 1, 19)) is None
    values = np.linspace(2, 1, 40)
    values[[3, 17]] = np.nan, np.inf
    assert find_trend(values).change is Change.FELL
    assert find_trend(np.full(100, np.nan)) is None


def test_what_got_worse():
    rising, random = np.linspace(0.2, 0.3, 50), np.random.default_rng(1)
    assert got_worse(list(rising), 0.3)
    assert not got_worse(list(rising[::-1]), 0.2)
    assert not got_worse(list(rising[:19]), 0.21)  # too short to say
    assert got_worse(list(rising[:19]), 0.3)
    assert not got_worse([], 0.3)
    assert not got_worse([0.2] * 50, 0.2)
    assert not got_worse([0.2] * 50, 0.2019)  # below what is worth a word
    # wandering about its start: some of the last are below
    assert not got_worse(list(0.2 + 0.01 * random.normal(size=100)), 0.21)
    # it came back at the end
    assert not got_worse([*rising, *rising[::-1]], 0.2)
