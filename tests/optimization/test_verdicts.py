"""Rules of verdicts, the posterior on which verdicts are based, and the test whether a parameter got worse."""

from __future__ import annotations

import collections
from dataclasses import replace

import numpy as np
import pytest

from reslrb_cli.optimization.results import got_worse
from reslrb_cli.optimization.uncertainty.curvature import EntryCurvature, ParameterDirection
from reslrb_cli.optimization.uncertainty.posterior import Measured, Posterior, joint, noise_covariance, pooled
from reslrb_cli.optimization.uncertainty.verdicts import (
    Estimate,
    Judged,
    ParameterVerdict,
    _limit_of_all,
    judge,
    shares,
    summarise,
    weigh,
)
from reslrb_cli.statistics import rms

# The rules of verdicts, one by one. Calibration over whole runs: test_calibration.py.


def judged(*entries: dict[str, float | bool]) -> list[ParameterVerdict]:
    """Return the verdicts of entries that are settled except for the given changes. The tolerance is 0.05. Each entry
    has two gradients with noise of opposite sign.
    """
    usual = {"value": 0.5, "low": 0.0, "high": 1.0, "touched": True, "gradient": 0.0, "error": 1.0, "step": 0.01}
    usual |= {"start": 0.5, "limit": 0.01, "spread": 0.01, "alone": 0.01, "pulled": False}
    every = [usual | changes for changes in entries]
    e = {name: np.array([each[name] for each in every]) for name in usual}
    of_run = np.array([each.get("of_run", each["limit"]) for each in every])
    gradients = np.array([e["gradient"] + sign * e["error"] for sign in (1, -1)]) * e["touched"]
    own = Measured(
        e["value"], (e["low"][0], e["high"][0]), 0.5, gradients, e["step"] / e["error"] / 2**0.5, False, e["start"]
    )
    np.testing.assert_array_equal(own.touched, e["touched"])
    found = Estimate(e["limit"], of_run, e["spread"], e["alone"], e["pulled"])
    return judge(own, found, np.full(len(entries), 0.05))


FAR = {"limit": 0.2, "spread": 0.2, "alone": 0.2}


@pytest.mark.parametrize(("changes", "verdict"), [
    ({}, ParameterVerdict.SETTLED),
    ({"limit": 0.049}, ParameterVerdict.SETTLED),
    ({"limit": 0.051}, ParameterVerdict.BELOW_NOISE),
    (FAR | {"pulled": True}, ParameterVerdict.STILL_MOVING),
    # The value is as near to the optimum of its noisy target as noise permits. This optimum differs from the true
    # value.
    (FAR | {"of_run": 0.049, "pulled": True}, ParameterVerdict.BELOW_NOISE),
    (FAR | {"of_run": 0.051, "pulled": True}, ParameterVerdict.STILL_MOVING),
    (FAR, ParameterVerdict.BELOW_NOISE),
    (FAR | {"alone": 0.02}, ParameterVerdict.NOT_DETERMINED),
    ({"touched": False, "limit": 0.2}, ParameterVerdict.NO_EFFECT),
    # The first two values ran to a bound, where no gradient is left. The third value began at its bound and never had a
    # gradient.
    ({"touched": False, "value": 0.0}, ParameterVerdict.AT_BOUND),
    ({"touched": False, "value": 1.0}, ParameterVerdict.AT_BOUND),
    ({"touched": False, "value": 0.0, "start": 0.0}, ParameterVerdict.NO_EFFECT),
    # The run moved the value to a place where the whole parameter has no gradient.
    ({"touched": False, "start": 0.3}, ParameterVerdict.EFFECT_LOST),
    # The value is at a bound, and the gradient holds it there: L falls downwards where dL/dx > 0.
    (FAR | {"value": 0.0, "gradient": 5.0}, ParameterVerdict.AT_BOUND),
    (FAR | {"value": 0.0, "gradient": 0.5}, ParameterVerdict.AT_BOUND),
    ({"value": 0.0, "gradient": -5.0}, ParameterVerdict.SETTLED),
    (FAR | {"value": 1.0, "gradient": -5.0}, ParameterVerdict.AT_BOUND),
    ({"value": 1.0, "gradient": 5.0}, ParameterVerdict.SETTLED),
    # Noise moved the value off the bound, by less than a few steps.
    (FAR | {"value": 0.02, "gradient": 5.0}, ParameterVerdict.AT_BOUND),
    ({"value": 0.02, "gradient": 0.5}, ParameterVerdict.SETTLED),
    ({"value": 0.2, "gradient": 5.0}, ParameterVerdict.SETTLED),
    ({"value": 3.0, "low": -np.inf, "high": np.inf}, ParameterVerdict.SETTLED),
])  # fmt: skip
def test_the_rules(changes, verdict):
    assert judged(changes) == [verdict]


def test_entries_are_judged_one_by_one():
    assert judged({}, {"touched": False}) == [ParameterVerdict.SETTLED, ParameterVerdict.NO_EFFECT]
    assert judged({}, {"touched": False, "start": 0.3})[1] is ParameterVerdict.NO_EFFECT
    lost, resting = {"touched": False, "start": 0.3}, {"touched": False}
    assert judged(lost, resting) == [ParameterVerdict.EFFECT_LOST, ParameterVerdict.NO_EFFECT]


def test_the_tolerance_is_a_tenth_of_the_value_or_of_a_share_of_the_scale():
    own = Measured(np.zeros(1), (0.0, 1.0), 0.5, np.zeros((3, 1)), np.ones(1), True, np.zeros(1))
    np.testing.assert_allclose(own.tolerance(np.array([0.8, -0.3, 0.1, 0.0])), [0.08, 0.03, 0.02, 0.02])


@pytest.mark.parametrize(("entries", "verdict"), [
    ("sssss", ParameterVerdict.SETTLED),
    ("ssssm", ParameterVerdict.SETTLED),
    ("sss", ParameterVerdict.SETTLED),
    ("ssb", ParameterVerdict.AT_BOUND),
    ("ssssssmmb", ParameterVerdict.STILL_MOVING),
    ("ssbbm", ParameterVerdict.AT_BOUND),
    ("nnn", ParameterVerdict.NO_EFFECT),
    ("nnnnnnnns", ParameterVerdict.SETTLED),
    ("nnnnnnnnm", ParameterVerdict.STILL_MOVING),
    ("uuu", ParameterVerdict.NOT_SEEN),
    ("uun", ParameterVerdict.NOT_SEEN),
    ("uuuuuuuus", ParameterVerdict.SETTLED),
    ("uuuunnssm", ParameterVerdict.STILL_MOVING),
])  # fmt: skip
def test_a_parameter_combines_its_entries(entries, verdict):
    named = ParameterVerdict
    kinds = {
        "s": named.SETTLED,
        "m": named.STILL_MOVING,
        "b": named.AT_BOUND,
        "n": named.NO_EFFECT,
        "u": named.NOT_SEEN,
    }
    found = shares([kinds[entry] for entry in entries])
    assert sum(found.values()) == pytest.approx(1)
    assert summarise(found) is verdict


# The distance from the optimum, over many runs of the model itself.

H, SCALE, SD = (
    np.array([[2.0, 1.2, 0.0], [1.2, 1.0, 0.3], [0.0, 0.3, 4.0]]), np.array([1.0, 3.0, 0.5]), np.array([0.5, 0.8, 2.0]),
)  # fmt: skip


@pytest.mark.parametrize("target", [0.0, 0.3])
def test_offsets_are_as_wide_as_stated(target):
    """Over many runs, the estimated distance is right on average, and its errors are as large as stated. The values
    move during the run. Noise of the target, which all gradients of a run share, is a part of the spread.
    """
    random, runs, count, z, found = np.random.default_rng(3), 1000, 60, [], []
    B = target**2 * np.diag(SD**2)
    for _ in range(runs):
        final = random.normal(size=3) * SCALE
        offsets = 0.3 * SCALE * np.linspace(1, 0, count)[:, None] * random.normal(size=3)
        gradients = (final + offsets) @ H + random.normal(size=(count, 3)) * SD + target * SD * random.normal(size=3)
        found.append(joint(gradients, offsets, SCALE, H, B))
        z.append((final - found[-1].to_go) / np.hypot(found[-1].error, found[-1].of_target))
    assert bool(target) is bool(np.all(found[0].of_target > 0))
    assert np.abs(np.mean(z, axis=0)).max() * np.sqrt(runs) < 4
    # Each error comes from twelve blocks, which makes z wider than 1: the variance of Student's t.
    assert np.sqrt(np.mean(np.square(z), axis=0)) == pytest.approx(np.full(3, 1 if target else 1.1), abs=0.15)


def test_a_wrong_curvature_makes_moving_values_less_certain():
    """The values move by 1. With a curvature that is twice too large, the measured pull drifts."""
    random, offsets = np.random.default_rng(4), np.linspace(1, 0, 60)[:, None]
    gradients = 2 * offsets + 0.01 * random.normal(size=(60, 1))
    right, wrong = (joint(gradients, offsets, np.ones(1), np.array([[h]]), np.zeros((1, 1))) for h in (2.0, 4.0))
    assert wrong.error[0] > 20 * right.error[0]
    assert wrong.limit[0] > np.abs(wrong.to_go[0]) > 0.2


def test_values_that_only_fluctuate_are_not_pulled():
    random = np.random.default_rng(5)
    noise, one = 1e-4 * random.normal(size=(60, 1)), np.ones((1, 1))
    moving, resting = np.linspace(-1, 0, 60)[:, None], np.tile([[0.2], [-0.2]], (30, 1)) - 0.1
    assert joint(moving - 0.5 + noise, moving, np.ones(1), one, 0 * one).is_pulled[0]
    found = joint(resting + 0.1 + noise, resting, np.ones(1), one, 0 * one)
    assert found.to_go[0] == pytest.approx(0.1, abs=1e-3)
    assert not found.is_pulled[0]


def test_a_value_unknown_to_the_view_stays():
    """Two lamps light the view alike. Their sum is known, and their difference is as uncertain as at the start."""
    random, twin = np.random.default_rng(6), np.full((2, 2), 5.0)
    found = joint(0.01 * random.normal(size=(50, 2)), np.zeros((50, 2)), np.ones(2), twin, np.zeros((2, 2)))
    assert found.error == pytest.approx(np.full(2, np.sqrt(0.5)), rel=0.02)
    total, difference = (np.sqrt(v @ found.covariance @ v) for v in (np.array([1, 1]), np.array([1, -1])))
    assert total < 0.02
    assert difference == pytest.approx(np.sqrt(2), rel=0.02)
    assert found.alone[0] < 0.02


def test_the_pooled_square_is_unbiased():
    """Single texels are lost in noise. Their mean square offset is known."""
    random, h, runs = np.random.default_rng(7), 3.0, 300
    offsets = 0.1 * random.normal(size=400)
    found = np.array([pooled(offsets + random.normal(size=(3, 400)) / h) for _ in range(runs)])
    left = found[:, 0] - np.mean(offsets**2)
    assert np.abs(left.mean()) < 4 * left.std() / np.sqrt(runs)
    assert left.std() == pytest.approx(found[:, 1].mean(), rel=0.15)


def of_texture(offset, noise, start=0.8):
    """Return the certainty of a texture of 4,096 texels of the value 0.5, whose errors are `offset`."""
    random, size = np.random.default_rng(8), 4096
    gradients = 2.0 * offset + noise * random.normal(size=(3, size))
    step = np.full(size, 1e-3)
    own = Measured(np.full(size, 0.5), (0.0, 1.0), 0.5, gradients, step, False, np.full(size, start))
    by_entry = EntryCurvature(np.full(size, 2.0), None)
    return weigh({"t": own}, [], np.zeros((0, 0)), np.zeros((0, 0)), {"t": by_entry})["t"]


def test_a_texture_that_is_too_bright_as_a_whole_is_not_settled():
    """All texels are 22 % too bright. Noise hides this in each texel."""
    off, right = (of_texture(offset, 0.4) for offset in (0.11, 0.0))
    assert (off.verdict, right.verdict) == ("still moving", "settled")
    assert off.spread[0] == pytest.approx(0.11, rel=0.2)
    assert right.spread[0] < 0.06
    assert of_texture(0.0, 2.0).verdict == "below the noise"
    assert of_texture(0.11, 0.4, start=0.4).verdict == "below the noise"  # the values have passed the optimum


def test_a_texture_without_a_measured_curvature_is_below_the_noise():
    gradients = np.random.default_rng(12).normal(size=(3, 100))
    own = Measured(np.full(100, 0.5), (0, 1), 0.5, gradients, np.full(100, 1e-3), False, np.full(100, 0.8))
    found = weigh({"t": own}, [], np.zeros((0, 0)), np.zeros((0, 0)), {})["t"]
    assert (found.verdict, found.spread, found.to_go) == ("below the noise", None, None)


NOT_SEEN, AT_BOUND = ParameterVerdict.NOT_SEEN.value, ParameterVerdict.AT_BOUND.value


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("curvature", ["none", "unknown", "known"])
@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("seen", ["none", "one", "all"])
@pytest.mark.parametrize("touched", ["none", "one", "all"])
@pytest.mark.parametrize("held", ["none", "one", "all"])
def test_every_state_of_a_texture_has_a_verdict(seen, touched, held, recorded, curvature):
    """A mirror may show texels that no view shows directly, and all texels may be at a bound. A lamp is judged beside
    the texture in each state.
    """
    random, size = np.random.default_rng(3), 12
    count = {"none": 0, "one": 1, "all": size}
    which = {name: np.arange(size) < count[state] for name, state in (("t", touched), ("s", seen), ("h", held))}
    value = np.where(which["h"], 0.0, 0.5)

    def gradients(number):
        pulled = np.where(which["h"], 5.0, random.normal(size=(number, size)))
        return np.where(which["t"], pulled, 0.0)

    rows = np.stack([gradients(30), np.tile(value, (30, 1))], axis=1)
    texture = Measured(
        value, (0.0, 1.0), 0.5, gradients(4), np.full(size, 1e-3), False, np.full(size, 0.8),
        seen=which["s"], rows=rows if recorded else None,
    )  # fmt: skip
    lamp = Measured(np.ones(1), (0, np.inf), 1.0, random.normal(size=(4, 1)), np.full(1, 1e-3), True, np.full(1, 2.0))
    places = [ParameterDirection("lamp", np.ones(1), None, 0), ParameterDirection("texture", value, 0)]
    places = places if value.any() else places[:1]
    diagonal = np.full(size, 50.0 if curvature == "known" else -1.0)
    by_entry = {} if curvature == "none" else {"texture": EntryCurvature(diagonal, diagonal)}
    many = len(places)
    found = weigh({"lamp": lamp, "texture": texture}, places, 100 * np.eye(many), np.zeros((many, many)), by_entry)
    shares = found["texture"].shares
    assert sum(shares.values()) == pytest.approx(1)
    assert shares.get(NOT_SEEN, 0.0) == pytest.approx(np.mean(~which["s"]))
    assert shares.get(AT_BOUND, 0.0) == pytest.approx(np.mean(which["s"] & which["h"]))  # their way ended at the bound
    if not any(which["s"] & which["t"] & ~which["h"]):
        assert found["texture"].spread is None
    assert found["lamp"].verdict == "settled"
    assert np.isfinite(found["lamp"].spread).all()


def blurred(width, side=24):
    """Return an image of a texture under a Gaussian filter of `width` texels, and probes of the curvature."""
    random, at = np.random.default_rng(9), np.arange(side)
    line = np.exp(-0.5 * (np.subtract.outer(at, at) / width) ** 2)
    image = np.kron(line, line) / np.sqrt(np.sum(np.exp(-(((at - side // 2) / width) ** 2))) ** 2)
    probes = []
    for _ in range(4):
        signs = random.choice([-1.0, 1.0], side**2)
        probes.append(tuple(image @ signs + 0.3 * random.normal(size=(2, side**2))))
    return image, EntryCurvature(np.ones(side**2), None, probes, (side, side, 1))


def test_offsets_are_found_through_a_blur():
    """The filter couples the texels. The diagonal of the curvature alone would find wrong offsets."""
    image, curvature = blurred(0.5)
    d = np.random.default_rng(10).normal(size=len(image))
    gradient = (image.T @ image @ d)[None]
    [offsets], h, undetermined = curvature.solve(gradient, [np.arange(len(d))])
    np.testing.assert_array_equal(h, 1)
    assert undetermined == 0
    assert rms(offsets - d) < 0.3
    assert rms(gradient - d) > 0.5
    alone, _, _ = replace(curvature, probes=()).solve(gradient, [np.arange(100)])
    np.testing.assert_allclose(alone[0], np.where(np.arange(len(d)) < 100, gradient[0], 0))


def test_images_that_do_not_show_single_texels_do_not_determine_them():
    image, curvature = blurred(0.9)
    size = len(image)
    own = Measured(
        np.full(size, 0.5), (0.0, 1.0), 0.5, 1e-3 * np.random.default_rng(11).normal(size=(3, size)),
        np.full(size, 1e-3), False, np.full(size, 0.8),
    )  # fmt: skip
    found = weigh({"t": own}, [], np.zeros((0, 0)), np.zeros((0, 0)), {"t": curvature})["t"]
    assert (found.verdict, found.partner) == ("not determined", None)
    assert found.spread[0] > 0.1


#: A wall that fills most of the image, and a ceiling that fills little of it. Each receives light from the other.
ROOM, START, RATE = np.array([[1.0, 0.11], [0.11, 0.075]]), np.array([0.3, -0.3]), 0.03
#: A tenth of the scale of either parameter.
CLOSE = 0.06


def recover(random, iterations, start=START, tails=3.0):
    """Run Adam on `ROOM`, and return the end values and the measurements there. The noise has heavy tails, and is
    larger while the wall is off.
    """

    def gradient(x):
        size = 0.006 + 0.6 * np.abs(x[0])
        return ROOM @ x + size * random.standard_t(tails, size=2) / np.sqrt(tails / (tails - 2))

    rates = 0.5 * (1 + np.cos(np.pi * np.arange(iterations) / (iterations - 1)))
    x, m, v, last = start.astype(float), np.zeros(2), np.zeros(2), []
    for i, rate in enumerate(rates):
        g = gradient(x)
        last.append([g, x + 0.6])
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        response = RATE / np.sqrt(v / (1 - 0.999 ** (i + 1)))
        x = x - rate * response * m / (1 - 0.9 ** (i + 1))
    few = np.array([gradient(x) for _ in range(max(iterations // 40, 3))])
    return x, {
        name: Measured(
            value=x[at : at + 1] + 0.6,
            bounds=(0.0, 1.0),
            scale=0.6,
            gradients=few[:, at : at + 1],
            step=response[at : at + 1] * rates[-1],
            is_small=True,
            start=start[at : at + 1] + 0.6,
            last=np.array(last)[iterations // 2 :, :, at : at + 1],
        )
        for at, name in enumerate(("wall", "ceiling"))
    }


def told_of(measured):
    """Return the verdicts on wall and ceiling, whose curvature is known."""
    directions = [ParameterDirection(name, np.ones(1), None, 0) for name in measured]
    found = weigh(measured, directions, ROOM, np.zeros((2, 2)), {})
    return {name: each.verdict for name, each in found.items()}


def test_a_value_that_depends_on_a_moving_one_is_not_settled():
    """An exposure and a colour compensate each other. The exposure is not known before the colour is known."""
    H, random = np.array([[1.0, 0.3], [0.3, 0.1]]), np.random.default_rng(1)

    def told(shared):
        measured = {
            key: Measured(
                np.full(1, 0.5), (-np.inf, np.inf), size, mean + 0.002 * random.normal(size=(20, 1)), np.full(1, 0.05),
                True, np.full(1, 0.2),
            )
            for key, size, mean in (("exposure", 5.0, 0.06), ("colour", 0.5, 0.02))
        }  # fmt: skip
        directions = [ParameterDirection(key, np.ones(1), None, 0) for key in measured]
        H_ = H * (np.eye(2) + shared * (1 - np.eye(2)))
        return {key: each.verdict for key, each in weigh(measured, directions, H_, np.zeros((2, 2)), {}).items()}

    assert told(0.95) == {"exposure": "still moving", "colour": "still moving"}
    assert told(0.0) == {"exposure": "settled", "colour": "still moving"}


def test_a_creeping_value_under_heavy_tailed_noise_is_not_settled():
    """The wall, off at first, drives the ceiling the wrong way. Large gradients then make steps short."""
    random, told = np.random.default_rng(11), []
    for _ in range(200):
        x, measured = recover(random, 100)
        if abs(x[1]) > 2 * CLOSE:
            told.append(told_of(measured)["ceiling"])
    assert len(told) > 25
    assert told.count("settled") <= 0.03 * len(told)
    assert told.count("still moving") >= 0.3 * len(told)


@pytest.mark.parametrize("iterations", [100, 400])
def test_a_resting_value_under_heavy_tailed_noise_is_settled(iterations):
    random, found, right = np.random.default_rng(12), collections.Counter(), 0
    for _ in range(50):
        x, measured = recover(random, iterations, np.array([0.01, -0.02]))
        right += np.abs(x[1]) < CLOSE
        found.update([told_of(measured)["ceiling"]])
    assert right > 47
    assert found["settled"] > 43


def test_noise_has_the_correlations_of_the_curvature():
    random, H = np.random.default_rng(5), np.array([[4.0, 1.8], [1.8, 1.0]])
    root = np.linalg.cholesky(H)
    found = noise_covariance(root @ random.normal(size=(2, 400)), np.diag(H), H)
    assert found[0, 1] == pytest.approx(1.8, rel=0.1)
    apart = noise_covariance(random.normal(size=(2, 400)), np.ones(2), H)
    assert abs(apart[0, 1]) < 0.15
    np.testing.assert_array_equal(np.diag(apart), 1)


def test_curvature_is_averaged_over_entries_with_similar_steps():
    random = np.random.default_rng(6)
    step = np.concatenate([np.full(320, 1.0), np.full(320, 9.0)]) * random.uniform(0.9, 1.1, 640)
    truth = np.where(step < 4, 50.0, 2.0)
    own = Measured(np.zeros(640), (0, 1), 1.0, np.zeros((3, 640)), step, False, np.zeros(640))
    found = EntryCurvature(truth * random.normal(size=640) * random.normal(size=640) + truth, truth)
    groups = own.groups_of_curvature(np.ones(640, dtype=bool), found.diagonal)
    assert sorted(np.concatenate(groups).tolist()) == list(range(640))
    offsets, h, _ = found.solve(np.ones((1, 640)), groups)
    assert rms(np.log(h / truth)) < 0.4
    np.testing.assert_allclose(offsets[0], 1 / h)
    few = EntryCurvature(np.full(3, -1.0), np.array([-2.0, 1.0, 4.0]))
    assert not few.solve(np.ones((1, 3)), [np.arange(3)])[1].any()
    assert few.mean_of_target(np.arange(3)) == pytest.approx(1 + np.std([-2, 1, 4]) / np.sqrt(3))


@pytest.mark.parametrize(("correlated", "is_map"), [(False, True), (True, True), (False, False)])
def test_a_tiny_texture_is_settled_if_its_texels_are_within_the_tolerance_on_average(correlated, is_map):
    """The error of each texel is 0.03 on average, so single texels may exceed the tolerance of 0.05. Errors in the
    brightness of the whole texture do not average out. The entries of other parameters have verdicts of their own.
    """
    random, size, count, verdicts, spreads = np.random.default_rng(4), 16, 44, [], []
    covariance = 0.03**2 * (0.99 * np.ones((size, size)) + 0.01 * np.eye(size) if correlated else np.eye(size))
    H, value = 1e-3 * np.linalg.inv(covariance), np.full(size, 0.5)
    noise = 1e-3 * count**0.5 * np.linalg.cholesky(np.linalg.inv(covariance))  # the mean is off by `covariance`
    places = [ParameterDirection("t", unit, None, k) for k, unit in enumerate(np.eye(size))]
    for _ in range(20):
        gradients = random.normal(size=(count, size)) @ noise.T
        last = np.stack([gradients[4:], np.tile(value, (count - 4, 1))], axis=1)
        own = Measured(value, (0.0, 1.0), 0.5, gradients[:4], np.full(size, 1e-3), True, value - 0.1, last,
                       is_map=is_map)  # fmt: skip
        found = weigh({"t": own}, places, H, np.zeros_like(H), {})["t"]
        verdicts.append(found.verdict)
        spreads.append(np.mean([spread for spread in found.spread if spread is not None]))
        assert len(found.spread) == (1 if is_map else size)
    assert 0.02 < np.mean(spreads) < 0.08
    if not is_map:
        return
    assert verdicts.count("settled") >= 16 or correlated, verdicts
    assert verdicts.count("settled") <= 1 or not correlated, verdicts


def test_correlated_offsets_do_not_average_out():
    """The limit exceeds the root mean square of 85 % of all draws of the offsets. It needs all entries."""
    random, size, places = np.random.default_rng(6), 16, dict(zip(range(16), range(16), strict=True))
    own = Measured(np.ones(size), (0.0, 2.0), 1.0, np.ones((3, size)), np.ones(size), True, np.zeros(size))
    limits = []
    for alike in (0.0, 0.5, 0.99):
        covariance = 0.1**2 * (alike * np.ones((size, size)) + (1 - alike) * np.eye(size))
        error, zero = np.sqrt(np.diag(covariance)), np.zeros(size)
        found = Judged(Posterior(zero, error, zero, zero, error, covariance, 1.0), places, [None] * size)
        limits.append(_limit_of_all(own, range(size), found, np.ones(size, dtype=bool)))
        draws = [rms(row) for row in random.multivariate_normal(zero, covariance, 2000)]
        assert 0.85 < np.mean(np.less(draws, limits[-1])) <= 1
        short = replace(found, places={0: 0})
        assert _limit_of_all(own, range(size), short, np.ones(size, dtype=bool)) == np.inf
    assert limits[0] < 1.4 * 0.1 < limits[2]


@pytest.mark.parametrize("size", [16, 48, 400])
def test_dim_texels_are_as_uncertain_as_they_are(size):
    """The curvature falls by a factor of 10,000 from the middle of a highlight to its border. The mean over all texels
    would hide that the texels at the border are not determined.
    """
    random, ratios, settled = np.random.default_rng(2), [], 0
    truth, noise = np.geomspace(1e4, 1, size), 0.8
    for _ in range(20):
        errors = random.normal(size=size) / np.sqrt(truth / noise**2 + 1 / 0.15**2)
        gradients = truth * errors + 2 * noise * np.sqrt(truth) * random.normal(size=(4, size))
        value = np.full(size, 0.5)
        own = Measured(value, (0.0, 1.0), 0.5, gradients, 1 / np.sqrt(truth), False, value - 0.1)
        probes = []
        for _ in range(4):
            both, own_noise = random.normal(size=size), random.normal(size=(2, size))
            probes.append(tuple(np.sqrt(truth) * (both + 0.5 * own_noise)))
        by_entry = EntryCurvature(np.mean([a * b for a, b in probes], axis=0), None)
        found = weigh({"t": own}, [], np.zeros((0, 0)), np.zeros((0, 0)), {"t": by_entry})["t"]
        ratios.append(rms(errors) / found.spread[0])
        settled += found.verdict == "settled"
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.4, ratios
    assert settled <= 1


def test_entries_of_a_motion_have_their_own_noise():
    """Across the light and along it, the gradients of a lens differ by orders of magnitude."""
    sizes, random = np.array([1.0, 0.01, 0.3]), np.random.default_rng(0)
    last = np.stack([random.normal(size=(40, 3)) * sizes, np.zeros((40, 3))], axis=1)
    few = random.normal(size=(3, 3)) * sizes
    own = Measured(sizes, (-np.inf, np.inf), 1.0, few, sizes, True, sizes, last)
    np.testing.assert_allclose(own.noise, sizes**2, rtol=0.6)


def test_worse_parameters():
    rising, random = np.linspace(0.2, 0.3, 50), np.random.default_rng(1)
    assert got_worse(list(rising), 0.3)
    assert not got_worse(list(rising[::-1]), 0.2)
    assert not got_worse(list(rising[:19]), 0.21)  # too short for a verdict
    assert got_worse(list(rising[:19]), 0.3)
    assert not got_worse([], 0.3)
    assert not got_worse([0.2] * 50, 0.2)
    assert not got_worse([0.2] * 50, 0.2019)  # too small to report
    # The values wander about their start, and some of the last are below it
    assert not got_worse(list(0.2 + 0.01 * random.normal(size=100)), 0.21)
    # The values return to the start at the end
    assert not got_worse([*rising, *rising[::-1]], 0.2)
