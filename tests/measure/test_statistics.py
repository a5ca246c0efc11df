"""Statistics that decide whether two gradients agree, and the differences that they detect."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from agreement import blocks, compare
from turns import taking_turns

from reslrb_cli.measure.comparison import (
    TAIL_SEEDS,
    Deviation,
    Family,
    combined_z_rms,
    compare_equal_seeds,
    compare_expectations,
    divisions,
    effective_entries,
    entry_count,
    overall,
    parts,
    sidak,
    tail_weight,
    z_rms_limit,
)
from reslrb_cli.records.measurements import GradcheckRecord, Kind, Reference, Verdict, record_of

# Statistics of the conformance tests: they hold for equal expectations, and detect a small bias.


def noise(seed: int, shape=(12, 32, 32, 3), mean: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).gamma(0.5, 2 * mean, shape)


def test_z_is_standard_normal_even_for_few_renders():
    rng = np.random.default_rng(1)
    z = Deviation.of(rng.normal(size=(5, 20000)), 3 * rng.normal(size=(7, 20000)), 1e-5).z()
    assert z.mean() == pytest.approx(0, abs=0.03)
    assert z.std() == pytest.approx(1, abs=0.03)
    assert (np.abs(z) > 3).mean() < 0.005


@pytest.mark.parametrize("paired", [True, False])
@pytest.mark.parametrize("rounding", [0.03, 0.1])
def test_rounding_does_not_make_the_variance_of_three_samples_certain(rounding, paired):
    """The floor's size is certain, but the noise's is not: the smallest variance of many entries is far too small."""
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 3, 200_000))
    a = a + 1
    b = b + 1 if not paired else np.zeros_like(b)
    z = (Deviation.paired(a - 1, rounding) if paired else Deviation.of(a, b, rounding)).z()
    assert (np.abs(z) > 4).sum() <= 30  # 13 are expected of normal deviates
    assert np.abs(z).max() < 5.5


DISTRIBUTIONS = {
    "normal": lambda random, shape: 1 + random.normal(size=shape),
    "heavy": lambda random, shape: 1 + random.standard_t(3, size=shape),
    "skewed": lambda random, shape: random.gamma(0.5, 2, size=shape),
    "fireflies": lambda random, shape: np.where(random.random(shape) < 0.02, 50, 1) * random.random(shape),
}


@taking_turns("kind", [*DISTRIBUTIONS], "paired", [True, False])
def test_equal_expectations_seldom_fail(kind, paired):
    """Some entries have no noise. A row of a correct table fails with a probability of at most 1e-3, for any number of
    seeds.
    """
    random, failed = np.random.default_rng(4), 0
    for count in (3, 4, 8, 16, 64):
        for entries in (3, 100):
            for _ in range(50):
                a, b = (DISTRIBUTIONS[kind](random, (count, entries)) for _ in range(2))
                a[:, ::3] = b[:, ::3] = 1
                result = compare_expectations(a, b, Family(1, entries), paired=paired)
                assert (result.verdict is Verdict.UNRESOLVED) or count >= TAIL_SEEDS
                failed += result.verdict is Verdict.FAILS
    assert failed <= 2  # of 500; at 1e-3, three have a probability of 0.014


@taking_turns("count", [8, 16, 64], "paired", [True, False])
def test_the_detectable_deviation_is_detected(count, paired):
    """One entry. Where several entries deviate, more deviations are detected."""
    random = np.random.default_rng(5)

    def result(deviation):
        a, b = 1 + 0.2 * random.normal(size=(2, count, 1))
        return compare_expectations(a + deviation, b, Family(), paired=paired)

    stated = np.median([result(0.0).detectable for _ in range(100)])
    found, twice = (np.mean([result(k * stated).verdict is Verdict.FAILS for _ in range(300)]) for k in (1, 2))
    assert 0.87 < found < 0.98
    assert twice > 0.96


@pytest.mark.parametrize("count", [3, 4, 8, 16, 64])
@pytest.mark.parametrize("factor", [0.0, 0.9])
def test_a_wrong_factor_holds_only_if_it_is_not_detectable(count, factor):
    random = np.random.default_rng(6)
    for _ in range(20):
        a, b = 1 + 0.02 * random.normal(size=(2, count, 30))
        result = compare_expectations(factor * a, b, Family(1, 30))
        assert result.verdict is not Verdict.HOLDS or result.detectable > 1 - factor


def test_entries_without_noise_do_not_dilute_the_root_mean_square():
    """Every lit tile is wrong by two standard errors."""
    random = np.random.default_rng(7)
    noise, lit = 0.5 * random.normal(size=(2, 64, 192)), np.arange(192) < 48
    a, b = (np.where(lit, 1 + each, 0) for each in noise)
    assert compare_expectations(a, b, Family(1, 192), paired=False).verdict is Verdict.HOLDS
    a = np.where(lit, a + 2 * 0.5 * np.sqrt(2 / 64), 0)
    assert compare_expectations(a, b, Family(1, 192), paired=False).verdict is Verdict.FAILS
    assert not compare(a[:, :, None], b[:, :, None], block=None)


def test_a_wrong_entry_without_noise_fails_beside_fireflies():
    random = np.random.default_rng(8)
    a, b = DISTRIBUTIONS["fireflies"](random, (2, 16, 5))
    a[:, 0], b[:, 0], a[3, 1:] = 2, 1, 1e4
    assert compare_expectations(a, b, Family(1, 5), paired=False).verdict is Verdict.FAILS
    a[:, 0] = 1
    assert compare_expectations(a, b, Family(1, 5), paired=False).verdict is Verdict.HEAVY_TAILED


def scaled(seed: int, place: Any, factor: float) -> np.ndarray:
    a = noise(seed)
    a[place] *= factor
    return a


@pytest.mark.parametrize(
    ("a", "b", "agree"),
    [
        *((noise(seed), noise(seed + 100), True) for seed in range(20)),
        (noise(1, (50, 32, 32, 3)), noise(2, (50, 32, 32, 3), mean=1.1), False),  # a small bias everywhere
        (scaled(1, np.s_[:, 8:16, 24:32], 1.6), noise(2), False),  # a bias in one block
        (np.ones((4, 16, 16, 1)), np.full((4, 16, 16, 1), 1 + 1e-7), True),  # entries without noise
        (np.ones((4, 16, 16, 1)), np.full((4, 16, 16, 1), 1.001), False),
        (scaled(1, np.s_[3, 5, 5, 0], np.nan), noise(2), False),
    ],
)
def test_renders_agree_if_their_expectations_do(a: np.ndarray, b: np.ndarray, agree: bool):
    assert bool(compare(a, b)) is agree


def test_blocks_include_remainders():
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


def test_correlated_entries_do_not_count_separately():
    """The sixty entries are copies of five. Their z rms scatters like the z rms of five entries, and a bias in one of
    the five is still detected.
    """
    rng, failed = np.random.default_rng(3), 0
    for _ in range(200):
        a, b = (np.repeat(rng.normal(size=(64, 5)), 12, axis=1) for _ in range(2))
        result = compare(a, b, block=None, alpha=1e-2)
        assert result.z_rms_threshold > 1.35 * z_rms_limit(60, 1e-2)
        failed += not result
        assert not compare(a + np.repeat([0.0, 0, 1.6, 0, 0], 12), b, block=None)
    assert failed <= 9  # of 200, at 1 % per criterion, with more in one of 60 cases


# Whether two gradients agree: equal gradients hold, different gradients fail, and undecided cases do not count as
# passed.

FAMILY = Family(rows=20, entries=400, alpha=1e-4)
TRUTH = np.linspace(-2, 3, 24)


def noisy(seed: int, count: int = 16, size: float = 0.2, truth: np.ndarray = TRUTH) -> np.ndarray:
    return truth + size * np.random.default_rng(seed).normal(size=(count, len(truth)))


@pytest.mark.parametrize("paired", [True, False])
def test_equal_expectations_hold(paired: bool):
    results = [compare_expectations(noisy(k), noisy(k + 100), FAMILY, paired=paired) for k in range(50)]
    assert {result.verdict for result in results} == {Verdict.HOLDS}
    assert np.mean([result.z_rms for result in results]) == pytest.approx(1, abs=0.05)
    assert results[0].cosine == pytest.approx(1, abs=0.01)
    assert np.mean([result.variance_ratio for result in results]) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("paired", [True, False])
def test_a_detectable_deviation_is_found(paired: bool):
    seen = []
    for k in range(100):
        reference = noisy(k + 100)
        size = compare_expectations(noisy(k), reference, FAMILY, paired=paired).detectable
        seen.append(compare_expectations(noisy(k) + size * TRUTH, reference, FAMILY, paired=paired).verdict)
    assert seen.count(Verdict.FAILS) >= 85  # 90 of 100 are expected, and more by z rms


def test_shared_noise_sharpens_a_paired_comparison():
    reference = noisy(1)
    close = reference + 1e-3 * np.random.default_rng(2).normal(size=reference.shape)
    assert compare_expectations(close, reference, FAMILY).detectable < 0.01
    assert compare_expectations(close * 1.01, reference, FAMILY).verdict is Verdict.FAILS
    assert compare_expectations(close * 1.01, reference, FAMILY, paired=False).verdict is Verdict.HOLDS


def test_the_side_with_fewer_independent_entries_decides():
    """All entries of one side have the same noise. Either side may be that one."""
    count, entries = 16, len(TRUTH)
    for seed in range(5):
        random = np.random.default_rng(seed)
        common = TRUTH + 0.2 * random.normal(size=(count, 1)) * np.ones(entries)
        for ours, reference in ((common, noisy(seed)), (noisy(seed), common)):
            limit = compare_expectations(ours, reference, FAMILY, paired=False).z_rms_limit
            assert limit == pytest.approx(FAMILY.z_rms_limit(1), rel=0.05)


ZERO, OUTLIER = np.zeros((16, 24)), 100 * (np.arange(16) == 3)[:, None]
FLAT = np.ones((16, 24))


@pytest.mark.parametrize(
    ("ours", "reference", "options", "verdict"),
    [
        (noisy(1), TRUTH, {}, Verdict.HOLDS),  # exact values, and their errors
        (noisy(1), TRUTH + 0.5, {}, Verdict.FAILS),
        (noisy(1), TRUTH + 0.5, {"bias": 0.5}, Verdict.HOLDS),
        (noisy(1), TRUTH + 1.0, {"bias": 0.5}, Verdict.FAILS),
        (1.0024 * FLAT, FLAT, {"paired": False, "reference_error": 1e-3}, Verdict.FAILS),
        (1.0024 * FLAT, FLAT, {"paired": False, "reference_error": 2.5e-3}, Verdict.HOLDS),
        (noisy(1, size=20), noisy(2, size=20), {}, Verdict.UNRESOLVED),
        (noisy(1) + OUTLIER, noisy(2), {}, Verdict.HEAVY_TAILED),
        (ZERO, noisy(1), {}, Verdict.FAILS),
        (noisy(1), ZERO, {}, Verdict.FAILS),
        (ZERO, ZERO, {}, Verdict.UNREACHED),
    ],
)
def test_verdicts(ours: np.ndarray, reference: np.ndarray, options: dict[str, Any], verdict: Verdict):
    result = compare_expectations(ours, reference, FAMILY, **options)
    assert result.verdict is verdict
    assert (result.detectable or 0) > (1 if verdict is Verdict.UNRESOLVED else options.get("reference_error", -1))
    if not reference.any() and ours.any():
        assert compare_equal_seeds(ours, reference).verdict is Verdict.FAILS


def test_tails_of_negligible_noise_do_not_matter():
    reference = np.ones((16, 4))
    ours = reference + 1e-4
    ours[3] += 3e-2  # one seed causes the variance, with a standard error of 2e-3
    assert compare_expectations(ours, reference, FAMILY, bias=5e-3).verdict is Verdict.HEAVY_TAILED
    assert compare_expectations(ours, reference, FAMILY, bias=5e-2).verdict is Verdict.HOLDS
    assert compare_expectations(ours + 0.1, reference, FAMILY, bias=5e-2).verdict is Verdict.FAILS
    assert tail_weight(ours) > 0.9
    assert abs(tail_weight(noisy(3, 30))) < 0.1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_values_fail(value: float):
    ours = noisy(1)
    ours[2, 3] = value
    for result in (compare_expectations(ours, noisy(2), FAMILY), compare_equal_seeds(ours, noisy(2))):
        assert result.verdict is Verdict.FAILS
        assert result.message == "the gradient has 1 entries that are not finite"


def test_equal_seeds_are_compared_by_relative_l2():
    ours = noisy(1)
    assert compare_equal_seeds(ours * (1 + 1e-5), ours).verdict is Verdict.HOLDS
    result = compare_equal_seeds(ours * (1 + 1e-3), ours)
    assert (result.verdict, result.relative_l2) == (Verdict.FAILS, pytest.approx(1e-3))


@pytest.mark.parametrize(("wrong", "entries"), [(90, 100), (1, 100), (1, 5000)])
def test_dim_entries_count_at_equal_seeds(wrong: int, entries: int):
    """Entries that are zero by mistake are too dim for the distance of all entries together."""
    reference = np.random.default_rng(5).normal(size=(16, entries)) * np.where(np.arange(entries) < wrong, 1e-5, 1)
    ours = np.where(np.arange(entries) < wrong, 0, reference)
    result = compare_equal_seeds(ours, reference)
    assert result.relative_l2 < 1e-4
    assert (result.verdict, result.detectable) == (Verdict.FAILS, 1e-4)
    assert result.message == f"{wrong} of {entries} entries differ by up to 1 times their own size"


@pytest.mark.parametrize("seeds", [1, 4, 16])
def test_rounding_is_no_fault_of_dim_entries_at_equal_seeds(seeds: int):
    """Entries of all sizes have a relative rounding error. Entries that are zero have a rounding error of others."""
    random = np.random.default_rng(seeds)
    for _ in range(200):
        reference = random.normal(size=(seeds, 300)) * 10.0 ** random.uniform(-12, 0, 300)
        ours = reference * (1 + 1e-5 * random.normal(size=reference.shape))
        reference[:, :20], ours[:, :20] = 0, 1e-9 * random.normal(size=(seeds, 20))
        assert compare_equal_seeds(ours, reference).verdict is Verdict.HOLDS


def test_limits_grow_with_the_table():
    assert Family(1, 1, 0.05).z_max_limit == pytest.approx(1.96, abs=0.01)
    assert Family(50, 1000).z_max_limit > Family(1, 10).z_max_limit
    assert Family(50, 1000).z_rms_limit(10) > Family(1, 10).z_rms_limit(10)


def test_tiles_and_projections_of_a_texture():
    shape, rng = (20, 30, 3), np.random.default_rng(0)
    gradient = rng.normal(size=(2, 20 * 30 * 3))
    tiles, whole = parts(gradient, shape, 8), overall(gradient)
    assert tiles.shape == (2, 8 * 8 * 3)
    assert whole.shape == (2, 17)
    assert whole[:, -1] == pytest.approx(gradient.sum(1))
    assert tiles.sum(1) == pytest.approx(gradient.sum(1))
    grid = gradient.reshape(2, 20, 30, 3)
    assert tiles[1, 0] == pytest.approx(grid[1, :2, :3, 0].sum())
    # Two texels of a tile swap places. Sums stay the same, but projections change.
    swapped = grid.copy()
    swapped[:, 0, 0], swapped[:, 0, 1] = grid[:, 0, 1], grid[:, 0, 0]
    assert parts(swapped.reshape(2, -1), shape, 8) == pytest.approx(tiles)
    assert np.abs(overall(swapped.reshape(2, -1)) - whole)[:, :-1].max() > 0.1


@pytest.mark.parametrize(
    ("shape", "count", "finest"),
    [((), 1, 0), ((3,), 4, 0), ((4, 4, 3), 49, 0), ((1, 500, 1), 8 + 17, 8), ((1000,), 64 + 17, 8)],
)
def test_entry_count(shape: tuple[int, ...], count: int, finest: int):
    assert (entry_count(shape), divisions(shape)[0]) == (count, finest)


def test_a_rarely_hit_texture_is_compared_in_larger_tiles():
    """Every texel has rare, skewed samples. The expectations are equal, but the distribution in single tiles is far
    from normal.
    """
    shape, tiled, coarser = (16, 16, 3), [], []
    for k in range(30):
        rng = np.random.default_rng(k)
        ours, reference = (rng.exponential(1, (20, 768)) * (rng.random((20, 768)) < p) / p for p in (0.05, 1))
        coarser.append(compare_expectations(ours, reference, FAMILY, shape=shape).verdict)
        tiled.append(compare_expectations(parts(ours, shape, 8), parts(reference, shape, 8), FAMILY).verdict)
    assert tiled.count(Verdict.FAILS) > 10
    assert coarser.count(Verdict.HOLDS) == 30
    assert compare_expectations(ours * 4, reference, FAMILY, shape=shape).verdict is Verdict.FAILS


def record(**changes) -> GradcheckRecord:
    values = {"case": "a.yaml", "parameter": "floor.data", "label": "reslrb:stack", "options": {},
              "reference": Reference.PTRACER, "kind": Kind.EXPECTATION, "seeds": 16, "verdict": Verdict.FAILS,
              "relative_l2": 0.0312, "z_rms": 3.2, "z_rms_limit": 1.5, "z_max": 9.1, "z_max_limit": 5.2,
              "detectable": 0.02}  # fmt: skip
    return GradcheckRecord(**values | changes)


def test_a_record_survives_a_round_trip() -> None:
    found = record(verdict=Verdict.UNRESOLVED, parameter=None)
    line = json.loads(found.to_json())
    assert {"case", "parameter", "label", "options", "reference", "seeds", "relative_l2", "z_rms", "z_max",
            "cosine", "variance_ratio", "holds"} <= set(line)  # fmt: skip
    assert (line["reference"], line["verdict"], line["holds"]) == ("ptracer", "unresolved", None)
    assert json.loads(record(relative_l2=float("inf")).to_json())["relative_l2"] is None
    assert json.loads(record().to_json())["holds"] is False
    assert record_of(GradcheckRecord, json.loads(json.dumps(asdict(found)))) == found
    assert record_of(GradcheckRecord, {"case": "a", "colour": 3}) is None
