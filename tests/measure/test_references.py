"""Comparisons of two methods, and the choice of the reference for errors."""

from __future__ import annotations

import numpy as np
import pytest
from cli.test_optimize import KEY
from measure import pretended_steps

from reslrb_cli.measure.methods import REFERENCE, parse_cases
from reslrb_cli.optimization.autotune import race


def samples(sd, count, seed, entries=200):
    random = np.random.default_rng(seed)
    return [{KEY: (1 + sd * random.normal(size=entries)).astype(np.float32)} for _ in range(count)]


@pytest.mark.parametrize("entries", [3, 200])
def test_the_interval_has_its_coverage(entries):
    """The first method has four times the variance at half the time. Without the allowance for timing errors, the
    interval has its nominal level.
    """
    inside = 0
    for seed in range(200):
        own, other = samples(2.0, 8, 2 * seed, entries), samples(1.0, 8, 2 * seed + 1, entries)
        value, low, high = race.compare(own, [2.0] * 8, other, [4.0] * 8)
        low, high = low * race.TIMING_NOISE, high / race.TIMING_NOISE
        assert low < value < high
        inside += low < 2.0 < high
    # Of 200 intervals, 190 are expected. A count below 176 has a probability of 1e-4.
    assert inside >= 176


def test_equal_methods_are_rarely_called_better():
    better = sum(
        race.compare(samples(1.0, 8, 2 * seed), [3.0] * 8, samples(1.0, 8, 2 * seed + 1), [3.0] * 8)[1] > 1
        for seed in range(200)
    )
    assert better <= 13  # 5 are expected on this side without the allowance for times


def test_zero_noise_cannot_be_compared():
    still = [{KEY: np.ones(4, np.float32)}] * 6
    assert race.compare(still, [1.0] * 6, samples(1.0, 6, 1, 4), [1.0] * 6) is None


def test_gradients_without_light_are_undecided():
    none = [{KEY: np.zeros(3, dtype=np.float32)} for _ in range(8)]
    assert race.compare(none, [1.0] * 8, none, [1.0] * 8) is None


@pytest.mark.parametrize(
    ("paths", "label", "share"),
    [("light", "reslrb:stack", None), ("camera", "reslrb:stack(paths=camera)", None),
     ("both", "reslrb:stack(paths=both,light_share=0.5)", 0.5)],
)  # fmt: skip
def test_errors_refer_to_all_light_of_the_scene(paths: str, label: str, share: float | None) -> None:
    """Methods of the default list that need paths the scene lacks are left out, and a message names them."""
    stage = pretended_steps.Stage(facts={"paths": paths})
    usual = pretended_steps.plan(
        "reslrb:stack,reslrb:stack(paths=both)", rounds=3, reference=parse_cases(REFERENCE)[0], default=True
    )
    session, results, said = pretended_steps.play(stage, usual)
    method = results.references[0].method
    assert (method.label, method.options["paths"]) == (label, paths)
    assert share in (None, method.options["light_share"])
    assert session.of("reference")[0].config.integrator.options()["paths"] == paths
    left_out = "left out: reslrb:stack(paths=both): this scene has only light paths"
    assert (left_out in said) == (paths == "light")
