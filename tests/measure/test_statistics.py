"""The statistics that the conformance tests rest on: they hold for equal expectations, and see a small bias."""

from __future__ import annotations

import numpy as np
import pytest
from agreement import blocks, compare

from reslrb_cli.measure.comparison import combined_z_rms, effective_entries, sidak, z_rms_limit, z_scores


def noise(seed: int, shape=(12, 32, 32, 3), mean: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).gamma(0.5, 2 * mean, shape)


def test_z_is_standard_normal_even_for_few_renders():
    rng = np.random.default_rng(1)
    z = z_scores(rng.normal(size=(5, 20000)), 3 * rng.normal(size=(7, 20000)))
    assert z.mean() == pytest.approx(0, abs=0.03)
    assert z.std() == pytest.approx(1, abs=0.03)
    assert (np.abs(z) > 3).mean() < 0.005


def test_equal_expectations_agree():
    assert all(compare(noise(seed), noise(seed + 100)) for seed in range(20))


def test_small_bias_everywhere_is_seen():
    shape = (50, 32, 32, 3)
    assert not compare(noise(1, shape), noise(2, shape, mean=1.1))


def test_bias_in_one_block_is_seen():
    a = noise(1)
    a[:, 8:16, 24:32] *= 1.6
    assert not compare(a, noise(2))


def test_entries_without_noise_are_compared_too():
    a = np.ones((4, 16, 16, 1))
    assert compare(a, a * (1 + 1e-7))
    assert not compare(a, a * 1.001)


def test_not_a_number_never_agrees():
    a = noise(1)
    a[3, 5, 5, 0] = np.nan
    assert not compare(a, noise(2))


def test_blocks_keep_remainders():
    parts = blocks(np.ones((2, 10, 17, 3)), 8)
    assert parts.shape == (2, 6, 3)
    assert (parts == 1).all()


def test_entry_by_entry():
    a, b = noise(1, (100, 4, 6)), noise(2, (100, 4, 6))
    assert compare(a, b, block=None).z.shape == (25, 1)
    b[:, 2, 3] *= 6
    assert not compare(a, b, block=None)


def test_thresholds():
    assert sidak(1, 0.05) == pytest.approx(1.96, abs=0.01)
    assert sidak(1000) > sidak(10)
    assert z_rms_limit(10000) == pytest.approx(1, abs=0.03)
    assert combined_z_rms(np.array([3.0, -4.0])) == pytest.approx(np.sqrt(12.5))


def test_effective_entries():
    noise = np.random.default_rng(0).normal(size=(40, 90))
    assert effective_entries(noise) > 60
    assert effective_entries(np.repeat(noise[:, :30], 3, axis=1)) == pytest.approx(30, rel=0.3)
    assert effective_entries(np.repeat(noise[:, :1], 90, axis=1)) == pytest.approx(1, rel=0.01)


def test_correlated_entries_are_not_counted_each():
    """Sixty entries that are five: their z rms scatters as that of five, and a bias of one of them still shows."""
    rng, failed = np.random.default_rng(3), 0
    for _ in range(200):
        a, b = (np.repeat(rng.normal(size=(64, 5)), 12, axis=1) for _ in range(2))
        result = compare(a, b, block=None, alpha=1e-2)
        assert result.z_rms_threshold > 1.35 * z_rms_limit(60, 1e-2)
        failed += not result
        assert not compare(a + np.repeat([0.0, 0, 1.6, 0, 0], 12), b, block=None)
    assert failed <= 9  # of 200, at 1 % for either criterion: more in one of 60 cases
