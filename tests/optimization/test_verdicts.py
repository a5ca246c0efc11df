"""Rules of verdicts, the posterior on which verdicts are based, and the test whether a loss fell."""

from __future__ import annotations

import collections
from dataclasses import replace

import numpy as np
import pytest
from turns import a_few, taking_turns

from reslrb_cli.optimization.results import got_worse
from reslrb_cli.optimization.trend import Change, find_trend, window
from reslrb_cli.optimization.uncertainty import posterior
from reslrb_cli.optimization.uncertainty.curvature import ParameterDirection, smooth
from reslrb_cli.optimization.uncertainty.posterior import Entries, Measured, Posterior, alone, joint
from reslrb_cli.optimization.uncertainty.verdicts import (
    ParameterVerdict,
    judge,
    noise_covariance,
    shares,
    summarise,
    weigh,
)

# The rules of verdicts, one by one. The posterior behind the verdicts is compared with runs of the model itself.


def judged(*entries: dict[str, float | bool]) -> list[ParameterVerdict]:
    """Return the verdicts of entries that are settled except for the given changes. Each entry has two gradients with
    noise of opposite sign.
    """
    usual = {"value": 0.5, "low": 0.0, "high": 1.0, "touched": True, "gradient": 0.0, "error": 1.0, "step": 0.01}
    usual |= {"start": 0.5, "spread": 0.01, "alone": 0.01, "to_go": 0.0, "to_go_error": 0.01}
    every = [usual | changes for changes in entries]
    e = {name: np.array([each[name] for each in every]) for name in usual}
    of_run = np.array([each.get("of_run", each["spread"]) for each in every])
    gradients = np.array([e["gradient"] + sign * e["error"] for sign in (1, -1)]) * e["touched"]
    own = Measured(
        e["value"], (e["low"][0], e["high"][0]), 0.5, gradients, e["step"] / e["error"] / 2**0.5, [1.0], False,
        start=e["start"],
    )  # fmt: skip
    np.testing.assert_array_equal(own.touched, e["touched"])
    return judge(own, e["spread"], of_run, e["alone"], e["to_go"], e["to_go_error"])


@pytest.mark.parametrize(("changes", "verdict"), [
    ({}, ParameterVerdict.SETTLED),
    ({"spread": 0.049}, ParameterVerdict.SETTLED),
    ({"spread": 0.051, "alone": 0.05}, ParameterVerdict.BELOW_NOISE),
    ({"spread": 0.2, "alone": 0.2, "to_go": 0.19, "to_go_error": 0.05}, ParameterVerdict.STILL_MOVING),
    ({"spread": 0.2, "alone": 0.2, "to_go": -0.19, "to_go_error": 0.05}, ParameterVerdict.STILL_MOVING),
    # The value is as near to the optimum of its noisy target as noise permits. This optimum differs from the true
    # value.
    ({"spread": 0.2, "alone": 0.2, "of_run": 0.049, "to_go": 0.045}, ParameterVerdict.BELOW_NOISE),
    ({"spread": 0.2, "alone": 0.2, "of_run": 0.051, "to_go": 0.045}, ParameterVerdict.STILL_MOVING),
    ({"spread": 0.2, "alone": 0.2, "to_go": 0.09, "to_go_error": 0.05}, ParameterVerdict.BELOW_NOISE),
    ({"spread": 0.2, "alone": 0.02, "to_go": 0.01, "to_go_error": 0.2}, ParameterVerdict.NOT_DETERMINED),
    ({"touched": False, "spread": 0.2}, ParameterVerdict.NO_EFFECT),
    # The first two values ran to a bound, where no gradient is left. The third value began at its bound and never had a
    # gradient.
    ({"touched": False, "value": 0.0}, ParameterVerdict.AT_BOUND),
    ({"touched": False, "value": 1.0}, ParameterVerdict.AT_BOUND),
    ({"touched": False, "value": 0.0, "start": 0.0}, ParameterVerdict.NO_EFFECT),
    # The run moved the value to a place where the whole parameter has no gradient.
    ({"touched": False, "start": 0.3}, ParameterVerdict.EFFECT_LOST),
    # The value is at a bound, and the gradient holds it there: L falls downwards where dL/dx > 0.
    ({"value": 0.0, "gradient": 5.0, "spread": 0.2}, ParameterVerdict.AT_BOUND),
    ({"value": 0.0, "gradient": 0.5, "spread": 0.2}, ParameterVerdict.AT_BOUND),
    ({"value": 0.0, "gradient": -5.0}, ParameterVerdict.SETTLED),
    ({"value": 1.0, "gradient": -5.0, "spread": 0.2}, ParameterVerdict.AT_BOUND),
    ({"value": 1.0, "gradient": 5.0}, ParameterVerdict.SETTLED),
    # Noise moved the value off the bound, by less than a few steps.
    ({"value": 0.02, "gradient": 5.0, "spread": 0.2}, ParameterVerdict.AT_BOUND),
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


def simulate(H, response, scale, noise, samples, rates, runs, random, fixed=None):
    """Return offsets (runs, M) at the end of runs of the model itself, and the gradients (runs, M) measured there.

    `fixed` is the covariance of the part that all gradients of a run share.
    """
    root = np.linalg.cholesky(noise)
    offset = random.normal(size=(runs, len(scale))) * scale
    shared = 0.0 if fixed is None else random.normal(size=offset.shape) @ np.linalg.cholesky(fixed).T
    for rate in rates:
        offset = offset - rate * response * (offset @ H + shared + random.normal(size=offset.shape) @ root.T)
    gradient = offset @ H + shared + random.normal(size=offset.shape) @ root.T / np.sqrt(samples)
    return offset, gradient


@taking_turns("iterations", [5, 60, 600], "target", [0.0, 0.7, 5.0])
def test_offsets_of_the_model_are_as_wide_as_stated(iterations, target):
    """Coverage over many runs is correct. The estimated way to go is right on average, and the actual error equals the
    stated error.

    This also holds with noise of the target, which all gradients of a run share. The remaining offset contains this
    noise.
    """
    H = np.array([[2.0, 1.2, 0.0], [1.2, 1.0, 0.3], [0.0, 0.3, 4.0]])
    response, scale = np.array([0.02, 0.1, 0.01]), np.array([1.0, 3.0, 0.5])
    sd = np.array([0.5, 0.8, 2.0])
    noise = np.outer(sd, sd) * np.array([[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]])
    rates = np.linspace(1, 0.2, iterations)
    runs = 4000
    fixed = target**2 * noise if target else None
    offset, gradient = simulate(H, response, scale, noise, 5, rates, runs, np.random.default_rng(3), fixed)
    found = [joint(Entries(response, scale, unit, 5, rates), H, noise, fixed) for unit in np.eye(3)]
    assert bool(target) is bool(np.all(found[0].of_target > 0))
    to_go = gradient @ np.array([each.to_go for each in found])  # the estimate is linear in the gradient
    left = offset - to_go
    # A standard deviation from n normal deviates has a relative standard error of 1 / sqrt(2 n).
    z = (left.std(axis=0) / found[0].error - 1) * np.sqrt(2 * runs)
    assert np.abs(z).max() < 4.5, z
    z = left.mean(axis=0) / found[0].error * np.sqrt(runs)
    assert np.abs(z).max() < 4.5, z
    spread = np.sqrt(np.mean(np.square(to_go), axis=0) + np.square(found[0].error))
    assert np.abs(np.sqrt(np.mean(np.square(offset), axis=0)) / spread - 1).max() < 0.05


@pytest.mark.parametrize("last", [1, 30])
def test_the_last_steps_locate_the_values(last):
    """Coverage is correct if a run's end is known only from its last steps and a few gradients there."""
    random, runs = np.random.default_rng(8), 500
    H, sd = np.array([[2.0, 1.2], [1.2, 1.0]]), np.array([0.5, 0.8])
    response, scale, noise, rates, few = np.array([0.02, 0.1]), np.array([1.0, 3.0]), np.diag(sd**2), [1.0] * 60, 3
    z = []
    for _ in range(runs):
        offset, _ = (each[0] for each in simulate(H, response, scale, noise, 1, rates[:-last], 1, random))
        values, gradients = [], []
        for rate in rates[-last:]:
            values.append(offset)
            gradients.append(H @ offset + random.normal(size=2) * sd)
            offset = offset - rate * response * gradients[-1]
        end = H @ offset + random.normal(size=2) * sd / np.sqrt(few)
        pull = np.mean(gradients, axis=0) + H @ (offset - np.mean(values, axis=0))
        mean = (few * end + last * pull) / (few + last)
        entries = Entries(response, scale, mean, np.full(2, few + last), rates[:-last], offset - values[0])
        found = joint(entries, H, noise)
        z.append((offset - found.to_go) / found.error)
    assert np.abs(np.mean(z, axis=0)).max() * np.sqrt(runs) < 4, np.mean(z, axis=0)
    assert np.abs(np.std(z, axis=0) - 1).max() * np.sqrt(2 * runs) < 4, np.std(z, axis=0)


def test_unforeseen_gradients_are_believed():
    """According to the model, nothing of the start is left. A pull of ten standard errors contradicts the model."""
    H, few = np.diag([2.0, 3.0]), 4

    def of(gradient: list[float]) -> Posterior:
        entries = Entries(np.full(2, 0.2), np.ones(2), np.array(gradient), few, [1.0] * 100)
        return joint(entries, H, np.diag([0.01, 0.01]))

    foreseen = of([0.02, 0.0])
    assert np.abs(foreseen.to_go).max() < 0.02
    found = of([0.5, 0.0])
    assert found.to_go[0] == pytest.approx(0.25, rel=0.02)
    assert found.error[0] == pytest.approx(0.05 / 2, rel=0.02)
    assert found.error[1] == pytest.approx(foreseen.error[1], rel=1e-6)
    far = of([50.0, 0.0])  # farther than any parameter at the start
    assert far.to_go[0] < 26


def test_marginal_equals_joint_without_shared_parts():
    H, rates = np.array([0.5, 2.0]), [1.0] * 40
    noise, gradient = np.array([0.2, 0.5]), np.array([0.1, -0.4])
    entries = Entries(np.array([0.03, 0.05]), np.array([2.0, 0.3]), gradient, 4, rates)
    for fixed in (np.zeros(2), np.array([0.3, 2.0])):
        each = alone(entries, H, noise, fixed)
        both = joint(entries, np.diag(H), np.diag(noise), np.diag(fixed))
        for name in ("to_go", "error", "of_target"):
            np.testing.assert_allclose(getattr(each, name), getattr(both, name), rtol=1e-5)


def test_noise_of_the_target_remains_after_convergence():
    """The spread H^-1 b remains, because all gradients at the end contain the target's noise b."""
    entries = Entries(np.array([0.1]), np.ones(1), np.zeros(1), 9, [1.0] * 300)
    found = joint(entries, np.array([[4.0]]), np.array([[1e-8]]), np.array([[0.04]]))
    assert found.spread == pytest.approx([0.2 / 4], rel=1e-3)
    assert found.of_target == pytest.approx([0.2 / 4], rel=1e-3)


def test_a_value_unknown_to_the_view_stays():
    """Two lamps light the view alike. Their sum is known, and their difference is as uncertain as at the start."""
    H = np.full((2, 2), 5.0)
    entries = Entries(np.full(2, 0.1), np.ones(2), np.zeros(2), 5, [1.0] * 200)
    found = joint(entries, H, np.eye(2) * 1e-4)
    assert found.error == pytest.approx(np.full(2, np.sqrt(0.5)), rel=0.02)
    total, difference = (np.sqrt(v @ found.covariance @ v) for v in (np.array([1, 1]), np.array([1, -1])))
    assert total < 0.02
    assert difference == pytest.approx(np.sqrt(2), rel=0.02)
    known = alone(entries, np.full(2, 5.0), np.full(2, 1e-4))
    assert known.error[0] < 0.02


def test_an_entry_that_no_step_moves_stays():
    entries = Entries(np.array([0.1, 0.0]), np.array([1.0, 7.0]), np.zeros(2), 5, [1.0] * 50)
    found = joint(entries, np.diag([2.0, 0.0]), np.eye(2))
    assert found.error[1] == pytest.approx(7, rel=1e-3)
    assert found.error[0] < 0.5


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
    x, m, v, seen = start.astype(float), np.zeros(2), np.zeros(2), int(0.8 * iterations)
    values, gradients, responses = [], [], []
    for i, rate in enumerate(rates):
        values.append(x)
        gradients.append(g := gradient(x))
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        responses.append(RATE / np.sqrt(v / (1 - 0.999 ** (i + 1))))
        x = x - rate * responses[-1] * m / (1 - 0.9 ** (i + 1))
    few = np.array([gradient(x) for _ in range(max(iterations // 40, 3))])
    return x, {
        name: Measured(
            value=x[at : at + 1] + 0.6,
            bounds=(0.0, 1.0),
            scale=0.6,
            gradients=few[:, at : at + 1],
            response=responses[-1][at : at + 1],
            rates=rates.tolist(),
            is_small=True,
            recent=np.mean(np.square(gradients[seen:]), axis=0)[at : at + 1],
            last=np.stack([np.array(gradients), np.array(values) + 0.6], axis=1)[seen:, :, at : at + 1],
            pace=np.array(responses)[:, at] / responses[-1][at],
        )
        for at, name in enumerate(("wall", "ceiling"))
    }


def told_of(measured):
    """Return the verdicts on wall and ceiling, whose curvature is known."""
    directions = [ParameterDirection(name, np.ones(1), None, 0) for name in measured]
    return {name: each.verdict for name, each in
            weigh(measured, directions, ROOM, {}, {}, np.zeros((2, 2)), {}).items()}  # fmt: skip


def test_a_value_that_depends_on_a_moving_one_is_not_settled():
    """An exposure and a colour compensate each other. The exposure is not known before the colour is known."""
    H, random = np.array([[1.0, 0.3], [0.3, 0.1]]), np.random.default_rng(1)

    def told(scale, shared):
        measured = {
            key: Measured(
                np.full(1, 0.5), (-np.inf, np.inf), size, mean + 0.002 * random.normal(size=(4, 1)), np.full(1, 0.05),
                [1.0] * 30, True,
            )
            for key, size, mean in (("exposure", scale, 0.06), ("colour", 0.5, 0.02))
        }  # fmt: skip
        directions = [ParameterDirection(key, np.ones(1), None, 0) for key in measured]
        found = weigh(measured, directions, H * (np.eye(2) + shared * (1 - np.eye(2))), {}, {}, np.zeros((2, 2)), {})
        return {key: each.verdict for key, each in found.items()}

    assert told(5.0, 0.95) == {"exposure": "still moving", "colour": "still moving"}
    assert told(5.0, 0.0) == {"exposure": "settled", "colour": "still moving"}


def test_a_creeping_value_under_heavy_tailed_noise_is_not_settled(monkeypatch):
    """The wall, off at first, drives the ceiling the wrong way. Large gradients then make steps short. Judged by the
    steps of the end alone, nothing of the ceiling's error would be left.
    """
    random, off, told, before = np.random.default_rng(11), 0, [], 0
    for _ in range(200):
        x, measured = recover(random, 100)
        if abs(x[1]) < 2 * CLOSE:
            continue
        off += 1
        told.append(told_of(measured)["ceiling"])
        with monkeypatch.context() as patch:  # uses only the measurements at the end
            patch.setattr(posterior, "SURPRISE", np.inf)
            bare = {key: replace(own, last=None, pace=None) for key, own in measured.items()}
            before += told_of(bare)["ceiling"] == "settled"
    assert off > 25
    assert before > 0.4 * off
    assert told.count("settled") <= 0.03 * off
    assert told.count("still moving") >= 0.5 * off


@pytest.mark.parametrize("iterations", [100, 400])
def test_a_resting_value_under_heavy_tailed_noise_is_settled(iterations):
    random, found, right = np.random.default_rng(12), collections.Counter(), 0
    for _ in range(50):
        x, measured = recover(random, iterations, np.array([0.01, -0.02]))
        right += np.abs(x[1]) < CLOSE
        found.update([told_of(measured)["ceiling"]])
    assert right > 47
    assert found["settled"] > 47


def test_noise_has_the_correlations_of_the_curvature():
    random, H = np.random.default_rng(5), np.array([[4.0, 1.8], [1.8, 1.0]])
    root = np.linalg.cholesky(H)
    found = noise_covariance(root @ random.normal(size=(2, 400)), np.diag(H), H)
    assert found[0, 1] == pytest.approx(1.8, rel=0.1)
    apart = noise_covariance(random.normal(size=(2, 400)), np.ones(2), H)
    assert abs(apart[0, 1]) < 0.15
    np.testing.assert_array_equal(np.diag(apart), 1)


def test_curvature_is_averaged_over_entries_of_similar_noise():
    random = np.random.default_rng(6)
    noise = np.concatenate([np.full(320, 1.0), np.full(320, 9.0)]) * random.uniform(0.9, 1.1, 640)
    order = random.permutation(640)
    truth = np.where(noise < 4, 2.0, 50.0)
    measured = truth * random.normal(size=640) * random.normal(size=640) + truth
    found = smooth(measured[order], noise[order])
    assert np.abs(found / truth[order] - 1).max() < 0.6
    assert smooth(np.full(3, -1.0), np.ones(3)).tolist() == [0, 0, 0]
    few = np.array([-2.0, 1.0, 1.0, 2.0])
    assert smooth(few, np.ones(4), 1.0) == pytest.approx(0.5 + few.std() / 2)


def test_entries_of_a_motion_have_their_own_noise():
    """Across the light and along it, the gradients of a lens differ by orders of magnitude. A run's mean squares show
    this difference.
    """
    sizes = np.array([1.0, 0.01, 0.3])
    gradients = np.random.default_rng(0).normal(size=(3, 3)) * sizes
    given = {"value": sizes, "bounds": (-np.inf, np.inf), "scale": 1.0, "gradients": gradients, "is_small": True}
    own, shared = (Measured(**given, response=sizes, rates=[1.0], recent=each) for each in (sizes**2, None))
    assert np.all(own.noise < 9 * sizes**2)
    assert np.all(shared.noise > 0.05)  # with only three samples, all entries share their noise


# Whether a loss fell beyond its noise: how often the verdict is right, and which verdicts never occur.

ROUNDS = 400


def shares_of_verdicts(make, iterations, seed=3):
    """Return the frequency of each verdict for noisy series."""
    random = np.random.default_rng(seed)
    found = collections.Counter(find_trend(make(random, np.arange(iterations))).change for _ in range(ROUNDS))
    return {change: found[change] / ROUNDS for change in Change}


def noisy(curve, noise=0.1):
    return lambda random, i: curve(i) * (1 + noise * random.normal(size=len(i)))


def fireflies(curve):
    """Return a function that makes noisy series. About one iteration in fifty has up to 50 added to its value."""

    def make(random, i):
        bright = (random.random(len(i)) < 0.02) * 50 * random.random(len(i))
        return curve(i) * (1 + 0.1 * random.normal(size=len(i))) + bright

    return make


@pytest.mark.parametrize("iterations", a_few([20, 100, 1000], ["20", "100"]))
def test_pure_noise_is_flat(iterations):
    found = shares_of_verdicts(noisy(lambda i: np.ones(len(i))), iterations)
    assert found[Change.FLAT] > (0.75 if iterations == 20 else 0.95)
    assert max(found[Change.FELL], found[Change.ROSE]) < 0.04


@pytest.mark.parametrize(
    ("iterations", "decay"),
    [pytest.param(i, d, marks=() if (i, d) in ((20, 8), (100, 3)) else pytest.mark.long)
     for i in (20, 100, 1000) for d in (8, 3, 1)],
)  # fmt: skip
def test_a_fall_within_a_few_iterations_is_found(iterations, decay):
    """Up to nine tenths of the run's first tenth may be as low as its end."""
    found = shares_of_verdicts(noisy(lambda i: 1 + 5 * np.exp(-i / decay)), iterations)
    assert found[Change.FELL] > 0.95
    assert found[Change.FLAT] + found[Change.ROSE] < 0.01


@pytest.mark.parametrize("iterations", [50, 200])
def test_fireflies_do_not_hide_a_fall(iterations):
    found = shares_of_verdicts(fireflies(lambda i: 1 + 5 * np.exp(-8 * i / len(i))), iterations)
    assert found[Change.FELL] > 0.8
    assert found[Change.FLAT] + found[Change.ROSE] < 0.01


def test_a_firefly_near_the_end_does_not_hide_a_fall():
    random = np.random.default_rng(4)
    values = np.concatenate([1 + 0.05 * random.normal(size=60), 0.2 + 0.02 * random.normal(size=40)])
    values[-4] = 30.0
    assert find_trend(values).change is Change.FELL


@pytest.mark.parametrize("iterations", a_few([50, 200, 1000], ["50", "200"]))
def test_fireflies_do_not_count_as_a_rise(iterations):
    assert shares_of_verdicts(fireflies(lambda i: np.ones(len(i))), iterations)[Change.ROSE] < 0.04


def test_a_slow_rise_is_found():
    found = shares_of_verdicts(noisy(lambda i: 1 + 0.5 * i / len(i)), 100)
    assert found[Change.ROSE] > 0.95


def test_a_slow_fall_is_rarely_missed():
    """The loss falls by a fifth over the run. A single iteration has noise of a tenth."""
    for iterations in (50, 100, 200):
        found = shares_of_verdicts(noisy(lambda i: 1 - 0.2 * i / len(i)), iterations)
        assert found[Change.FLAT] < 0.12
        assert found[Change.ROSE] < 0.01


def test_a_jump_that_declines_counts_as_a_rise():
    """With a rate far too large, Adam's loss jumps at once. The loss then falls slowly to a level above the start."""
    found = shares_of_verdicts(noisy(lambda i: np.where(i == 0, 0.3, 1 + 20 * np.exp(-i / 10))), 100)
    assert found[Change.ROSE] > 0.95


def test_the_levels_are_the_first_and_the_last_tenth():
    values = np.concatenate([np.tile([1.0, 3.0], 10), np.full(160, 9.0), np.tile([0.4, 0.6], 10)])
    trend = find_trend(values)
    assert (trend.start.mean, trend.end.mean) == (pytest.approx(2.0), pytest.approx(0.5))
    # An interquartile mean leaves out half of the values. The kept half of these two values has the same spread as all
    # values.
    assert trend.start.error == pytest.approx(2 * np.std(values[:20], ddof=1) / np.sqrt(20))
    assert trend.to_json()["change"] == "fell"
    assert window(200) == 20


def test_a_run_without_any_change():
    trend = find_trend(np.full(30, 0.7))
    assert (trend.change, trend.start.error) == (Change.FLAT, 0.0)


def test_short_runs_and_non_finite_values():
    assert find_trend(np.linspace(0, 1, 19)) is None
    values = np.linspace(2, 1, 40)
    values[[3, 17]] = np.nan, np.inf
    assert find_trend(values).change is Change.FELL
    assert find_trend(np.full(100, np.nan)) is None


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
