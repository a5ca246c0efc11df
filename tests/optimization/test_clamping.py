"""The clamp against outliers in gradients: what it takes, and what it says of that."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from optimization.toy import make_problem

from reslrb_cli.optimization import loop
from reslrb_cli.optimization.optimizers import DECAY, GradientClamp
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.metrics import ClampTally


def leaf(kind, shape):
    value = dr.zeros(kind, shape)
    dr.enable_grad(value)
    return value


def clamp_all(clamp, gradients, kind=None):
    """Clamp gradients (T, ...) in turn; the clamped ones, and what was said of each."""
    parameter = leaf(mi.TensorXf, gradients[0].shape) if kind is None else leaf(kind, 1)
    clamped, said = [], []
    for gradient in gradients:
        shaped = mi.TensorXf(gradient) if kind is None else kind(*gradient[:, 0].tolist())
        dr.set_grad(parameter, shaped)
        said.append(clamp.apply({"x": parameter}))
        clamped.append(np.array(dr.grad(parameter)).reshape(gradient.shape))
    return np.array(clamped), said


def reference(gradients, k):
    """The same in NumPy."""
    m, result = np.zeros(gradients[0].shape), []
    for number, g in enumerate(gradients):
        usual = m / (1 - DECAY**number) if number else np.inf
        limit = k * np.maximum(usual, np.mean(usual))
        result.append(np.clip(g, -limit, limit))
        m = DECAY * m + (1 - DECAY) * np.abs(result[-1])
    return np.array(result)


@pytest.fixture
def heavy_tailed():
    """Gradients (50, 4, 5, 3) of a Pareto law, of either sign, one entry of which is always 0 but once."""
    random = np.random.default_rng(3)
    gradients = random.pareto(1.5, (50, 4, 5, 3)) * random.choice([-1, 1], (50, 4, 5, 3))
    gradients[:, 0, 0, 0] = 0
    gradients[20, 0, 0, 0] = 2
    return gradients.astype(np.float32)


def test_it_is_what_its_docstring_says(heavy_tailed):
    clamped, said = clamp_all(GradientClamp(4.0), heavy_tailed)
    expected = reference(heavy_tailed.astype(np.float64), 4.0)
    np.testing.assert_allclose(clamped, expected, rtol=1e-4)
    assert clamped[20, 0, 0, 0] == 2, "an entry without a past is judged by the others"
    removed = heavy_tailed - expected
    assert (said[0].entries, said[0].share, said[0].bias) == (0, {"x": 0.0}, {"x": 0.0})
    for t in (7, 49):
        assert said[t].entries == (np.abs(removed[t]) > 1e-5).sum()
        assert said[t].share["x"] == pytest.approx(np.abs(removed[t]).sum() / np.abs(heavy_tailed[t]).sum(), rel=1e-3)
        bias = np.abs(removed[: t + 1].sum(0)).sum() / np.abs(heavy_tailed[: t + 1].sum(0)).sum()
        assert said[t].bias["x"] == pytest.approx(bias, rel=1e-3)


def test_what_cancels_is_no_bias():
    """Outliers of both signs in turn: each takes a share of its gradient, and together they take nothing."""
    gradients = np.ones((41, 1, 1, 3), np.float32)
    gradients[1::2, 0, 0, 1] = np.where(np.arange(20) % 2, 1000, -1000)
    _, said = clamp_all(GradientClamp(3.0), gradients)
    assert min(entry.share["x"] for entry in said[1::2]) > 0.9
    assert said[-1].bias["x"] < 0.2, "not 0: what is usual grows with each of them"


def test_outliers_of_one_sign_are_a_bias():
    gradients = np.ones((40, 1, 1, 3), np.float32)
    gradients[5::10, 0, 0, 1] = 1000
    _, said = clamp_all(GradientClamp(3.0), gradients)
    removed = 4 * 1000
    assert said[-1].bias["x"] == pytest.approx(removed / (removed + 120), rel=0.02)


def test_colours_and_numbers_are_clamped_too():
    for kind, channels in ((mi.Color3f, 3), (mi.Float, 1)):
        gradients = np.ones((10, channels, 1), np.float32)
        gradients[9, 0] = 1e30  # whose square would overflow
        clamped, said = clamp_all(GradientClamp(5.0), gradients, kind)
        assert clamped[9, 0, 0] == pytest.approx(5)
        assert said[9].entries == 1
        assert said[9].share["x"] == pytest.approx(1)


def test_large_gradients_do_not_switch_it_off():
    gradients = np.full((10, 1, 1, 3), 1e25, np.float32)
    gradients[9, 0, 0, 0] = 1e27
    clamped, _ = clamp_all(GradientClamp(5.0), gradients)
    assert clamped[9].max() == pytest.approx(5e25)


def test_later_iterations_compile_nothing():
    parameter, clamp, clock, new = leaf(mi.TensorXf, (2, 2, 3)), GradientClamp(3.0), StepClock(), []
    for iteration in range(5):
        gradient = dr.full(mi.TensorXf, 1.0, (2, 2, 3)) + dr.opaque(mi.Float, iteration)
        dr.eval(gradient)
        dr.set_grad(parameter, gradient)
        with clock.step() as times:
            clamp.apply({"x": parameter})
        new.append(times.new_kernels)
    assert new[2:] == [0, 0, 0]


def outlier(call, key):
    """A factor of 1000 in one entry of the third gradient."""
    factor = np.ones((2, 2, 3), np.float32)
    factor[0, 1, 2] = 1000 if call == 2 else 1
    return mi.TensorXf(factor)


def test_a_run_clamps_and_says_so(tmp_path, steps):
    sets = ["optimizer.clamp_gradient=3", "run.iterations=5", "optimizer.learning_rate=0.02"]
    problem = make_problem(tmp_path, sets=sets)
    steps.spoil = outlier
    records, tally, values = [], ClampTally(), []
    for record in loop.optimize(problem):
        records.append(record)
        values.append(np.array(problem.optimizer["albedo"])[0, 1, 2])
        tally.add(record)
    assert [record.clamped.entries for record in records] == [0, 0, 1, 0, 0]
    steps_taken = np.diff(values)
    assert steps_taken[1] / steps_taken[0] == pytest.approx(3 * records[2].lr / records[1].lr, rel=0.05)
    assert (tally.iterations, tally.entries) == (1, 1)
    # of 12 gradients of the same size over 5 iterations, 997 of another one
    assert tally.bias["albedo"] == pytest.approx(997 / (60 + 999), rel=0.01)
    assert "1 entries of gradients clamped in 1 iterations: a bias of 94 % of that of albedo" in str(tally)
    assert '"bias": {"albedo": ' in records[2].to_json()


def test_it_is_off_unless_asked_for(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.iterations=5"])
    steps.spoil = outlier
    tally = ClampTally()
    for record in loop.optimize(problem):
        assert record.clamped is None
        tally.add(record)
    assert str(tally) == ""


def test_a_parameter_that_sits_out_is_not_clamped(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["optimizer.clamp_gradient=3", "run.iterations=4"], keys=("albedo", "other"))
    steps.spoil = lambda call, key: np.nan if call == 1 and key == "other" else outlier(call, key)
    records = list(loop.optimize(problem))
    assert set(records[1].clamped.share) == {"albedo"}
    assert records[2].clamped.entries == 2
    assert all(np.isfinite(value) for record in records for value in record.clamped.bias.values())
