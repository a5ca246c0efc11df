"""The optimization loop, with tests of its records and its treatment of non-finite values and outliers."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from optimization.toy import make_problem

from reslrb_cli.errors import NonFinite
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.nonfinite import PATIENCE, count_nonfinite, finite_square_norm
from reslrb_cli.optimization.optimizers import DECAY, clamp_gradients
from reslrb_cli.optimization.stages import Stages
from reslrb_cli.optimization.state import standing
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.metrics import ClampTally
from reslrb_cli.records.tree import entries

# The loop on a problem whose image is its parameter, and the records of the loop.


def test_records_follow_gradient_descent(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path)
    records = list(loop.optimize(problem))
    expected, value = [], 0.5
    for record in records:
        expected.append((value - 0.8) ** 2)
        value -= record.lr * 2 * (value - 0.8) / 12
    np.testing.assert_allclose([record.loss for record in records], expected, rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(np.array(problem.selection.params["albedo"]), value, rtol=1e-3)
    first = records[0]
    assert first.parameter_rmse == pytest.approx(0.3, rel=1e-5)
    assert first.parameter_errors == {"albedo": pytest.approx(0.3, rel=1e-5)}
    assert first.grad_norm == pytest.approx(0.6 / 12 * 12**0.5, rel=1e-5)
    assert (first.iteration, first.spp, first.nonfinite, first.lr) == (0, 3, 0, 2.0)
    assert records[-1].lr == pytest.approx(0.02)
    assert all(record.step_ms > 0 and record.peak_mib > 0 for record in records)
    assert all(a.elapsed_s < b.elapsed_s for a, b in itertools.pairwise(records))
    assert (first.primal_ms, first.adjoint_ms) == (None, None)


def test_the_time_limit_ends_a_run_and_its_schedule(tmp_path, steps, monkeypatch):
    """Each reading of the clock advances time by one second, so that all iterations after the first take equally
    long.
    """
    seconds = itertools.count()
    monkeypatch.setattr("time.perf_counter", lambda: float(next(seconds)))

    def run(*sets):
        problem = steps.problem = make_problem(tmp_path, sets=["run.iterations=50", *sets])
        return list(loop.iterate(Stages(problem), standing(problem)))

    ends = [state.elapsed_s for state, _ in run()]
    length = ends[-1] - ends[-2]
    assert np.diff(ends) == pytest.approx([length] * 49)
    for done in (2, 7):
        limit = ends[done - 1] + 0.5 * length
        found = run(f"run.max_seconds={limit}")
        assert len(found) == done
        assert [bool(state.stopped) for state, _ in found] == [False] * (done - 1) + [True]
        shares = [0.0, *((end - ends[0]) / (limit - ends[0]) for end in ends[: done - 1])]
        rates = [
            2.0 * loop.learning_rate_factor("cosine", number, 50, 0.01, share) for number, share in enumerate(shares)
        ]
        assert [record.lr for _, record in found] == pytest.approx(rates)
    assert len(run("run.max_seconds=0.5")) == 1  # the first iteration is always completed
    # The schedule follows the iterations if they are further along than the time
    last = run("run.max_seconds=1000000", "run.iterations=4")[-1]
    assert (last[1].lr, last[0].stopped) == (pytest.approx(0.02), "")


def test_a_step_with_an_intermediate_image_is_split(tmp_path, steps):
    steps.has_image = True
    problem = steps.problem = make_problem(tmp_path, views=2)
    for record in loop.optimize(problem):
        assert 0 < record.primal_ms < record.step_ms
        assert record.primal_ms + record.adjoint_ms == pytest.approx(record.step_ms)


def test_time_between_records_is_not_counted(tmp_path, steps):
    import time

    problem = steps.problem = make_problem(tmp_path, sets=["run.iterations=4"])
    elapsed = []
    for record in loop.optimize(problem):
        time.sleep(0.2)
        elapsed.append(record.elapsed_s)
    assert elapsed[-1] < 0.6


def test_each_view_and_iteration_has_its_own_seed(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path, views=3)
    list(loop.optimize(problem))
    assert [call.sensor for call in steps.calls[:3]] == [0, 1, 2]
    assert len({call.seed for call in steps.calls}) == 60
    assert {call.adjoint for call in steps.calls} == {"independent"}  # 3 samples do not divide into four batches


def test_equal_states_have_equal_successors(tmp_path, steps):
    """A step depends only on its state. An earlier state can be restored, and a step leaves its input state
    unchanged.
    """
    sets = ["optimizer.clamp_gradient=1.1", "optimizer.type=adam"]
    problem = steps.problem = make_problem(tmp_path, sets=sets, keys=("albedo", "other"))
    begun = standing(problem)
    second, _ = loop.step(problem, loop.step(problem, begun)[0])
    [first_time, again] = [loop.step(problem, second) for _ in range(2)]
    for state in (begun, second):
        loop.step(problem, state)
    arrays, values = zip(*(entries(state) for state, _ in (first_time, again)), strict=True)
    assert {name: array.tobytes() for name, array in arrays[0].items()} == {
        name: array.tobytes() for name, array in arrays[1].items()
    }
    assert {name for name in values[0] if values[0][name] != values[1][name]} <= {"elapsed_s", "first_s", "peak_mib"}
    assert values[0]["clamp"] == {"albedo": 3, "other": 3}
    np.testing.assert_array_equal(np.array(begun.values["albedo"]), 0.5)


def test_the_loss_is_the_mean_over_the_views(tmp_path, steps):
    one = steps.problem = make_problem(tmp_path)
    losses = [record.loss for record in loop.optimize(one)]
    three = steps.problem = make_problem(tmp_path, views=3)
    np.testing.assert_allclose([record.loss for record in loop.optimize(three)], losses, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(np.array(three.optimizer["albedo"]), np.array(one.optimizer["albedo"]), rtol=1e-5)


def test_a_clock_detects_new_kernels():
    clock, new = StepClock(), []
    for factor in (2.0, 2.0, 3.0):
        with clock.step() as times:
            dr.eval(dr.arange(mi.Float, 7) * factor)
        new.append(times.new_kernels)
    assert new == [1, 0, 1]


def test_counting_does_not_change_finite_entries():
    value = mi.TensorXf(np.array([3.0, np.nan, 4.0, np.inf], dtype=np.float32))
    assert int(count_nonfinite(value)[0]) == 2
    assert float(finite_square_norm(value)[0]) == pytest.approx(25.0)
    color = mi.Color3f(1.0, np.nan, 2.0)
    assert int(count_nonfinite(color)[0]) == 1
    assert float(finite_square_norm(color)[0]) == pytest.approx(5.0)


# How the loop treats values that are not finite, by policy.


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_non_finite_gradient_reaches_no_parameter(tmp_path, steps, bad):
    problem = steps.problem = make_problem(tmp_path, sets=["run.iterations=6"], keys=("albedo", "other"))
    steps.spoil = lambda call, key: bad if key == "other" and call in (1, 2) else 1.0
    seen = {key: [] for key in problem.selection.keys}
    records = []
    for record in loop.optimize(problem):
        records.append(record)
        for key, values in seen.items():
            values.append(float(np.array(problem.optimizer[key]).mean()))
    assert [record.nonfinite for record in records] == [0, 12, 12, 0, 0, 0]
    assert all(np.isfinite(record.grad_norm) for record in records)
    assert all(np.isfinite(values).all() for values in seen.values())
    assert seen["other"][0] == seen["other"][1] == seen["other"][2] != seen["other"][3]
    assert seen["albedo"][0] != seen["albedo"][1]


def test_a_non_finite_loss_stops_every_update(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path, sets=["run.iterations=3"])
    problem.views[0].made = dr.full(mi.TensorXf, np.nan, (2, 2, 3))
    records = list(loop.optimize(problem))
    assert all(record.nonfinite == 13 for record in records)
    np.testing.assert_array_equal(np.array(problem.optimizer["albedo"]), 0.5)


def test_it_gives_up_if_everything_is_non_finite(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path)
    steps.spoil = lambda call, key: float("nan") if call >= 2 else 1.0
    records = []
    iterator = loop.optimize(problem)
    with pytest.raises(NonFinite, match="albedo was not finite in 10 iterations in a row"):  # noqa: PT012
        while True:
            records.append(next(iterator))
    assert len(records) == 2 + PATIENCE
    assert np.isfinite(np.array(problem.optimizer["albedo"])).all()


def run(problem, found=None):
    """Return all records, the mean of each parameter after each record, and the error. A run that ends early ends both
    lists.
    """
    records, values, error = [], {key: [] for key in problem.selection.keys}, None
    try:
        for record in loop.optimize(problem, (found if found is not None else []).append):
            records.append(record)
            for key, means in values.items():
                means.append(float(np.array(problem.optimizer[key]).mean()))
    except NonFinite as raised:
        error = str(raised)
    assert all(np.isfinite(means).all() for means in values.values())
    return records, values, error


def one_entry(value):
    """Return a gradient factor that is `value` in one entry and 1 elsewhere."""
    factor = np.ones((2, 2, 3), np.float32)
    factor[1, 0, 2] = value
    return mi.TensorXf(factor)


def nan_pixel(call, calls):
    """Return a dL/dI of zeros that has NaN in one entry in the given calls."""
    derivative = np.zeros((2, 2, 3), np.float32)
    derivative[1, 0, 1] = np.nan if call in calls else 0
    return mi.TensorXf(derivative)


def test_each_parameter_has_its_own_count(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.iterations=4"], keys=("albedo", "other"))
    steps.spoil = lambda call, key: one_entry(np.nan) if call == 1 or (call == 2 and key == "other") else 1.0
    records, _, _ = run(problem)
    expected = [{}, {"albedo": 1, "other": 1}, {"other": 1}, {}]
    assert [record.nonfinite_by_parameter for record in records] == expected
    assert [record.nonfinite for record in records] == [0, 2, 1, 0]


def test_stop_ends_at_the_first_fault_without_an_update(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.on_nonfinite=stop"], keys=("albedo", "other"))
    steps.spoil = lambda call, key: one_entry(np.inf) if call == 2 and key == "other" else 1.0
    records, values, error = run(problem)
    assert len(records) == 3
    assert "iteration 2" in error
    assert "the gradient of other in 1 entry" in error
    for means in values.values():
        assert means[0] != means[1] == means[2]


def test_zero_updates_the_rest(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.on_nonfinite=zero", "run.iterations=3"])
    steps.spoil = lambda call, key: one_entry(np.nan)
    before = np.array(problem.optimizer["albedo"])
    records, _, error = run(problem)
    moved = np.array(problem.optimizer["albedo"]) - before
    assert error is None
    assert moved[1, 0, 2] == 0
    moved[1, 0, 2] = moved[0, 0, 0]
    assert (moved > 0).all()
    assert [record.nonfinite for record in records] == [1, 1, 1]


def test_zero_does_not_update_a_parameter_without_finite_entries(tmp_path, steps):
    sets = ["run.on_nonfinite=zero", "optimizer.momentum=0.9", "optimizer.learning_rate=0.02"]
    problem = make_problem(tmp_path, sets=sets, keys=("albedo", "other"))
    steps.spoil = lambda call, key: np.nan if call >= 3 and key == "other" else 1.0
    records, values, error = run(problem)
    assert len(records) == 3 + PATIENCE
    assert "other was not finite in 10 iterations in a row" in error
    assert len(set(values["other"][2:])) == 1, "its momentum does not move it either"
    assert len(set(values["albedo"])) == len(records)


def test_zero_continues_while_something_moves(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.on_nonfinite=zero", f"run.iterations={PATIENCE + 5}"])
    steps.spoil = lambda call, key: one_entry(np.nan)
    records, _, error = run(problem)
    assert (len(records), error) == (PATIENCE + 5, None)


@pytest.mark.parametrize("kind", ["stop", "skip", "zero"])
def test_a_derivative_of_the_loss_is_refused_by_each_policy(tmp_path, steps, kind):
    """The step replaces the non-finite entry by 0. The policy decides about the rest of the iteration."""
    problem = make_problem(tmp_path, views=2, sets=[f"run.on_nonfinite={kind}", "run.iterations=4"])
    steps.derivative = lambda call: nan_pixel(call, (3,))  # the second view of iteration 1
    records, values, error = run(problem)
    moved = [a != b for a, b in zip(values["albedo"], values["albedo"][1:], strict=False)]
    assert [record.nonfinite for record in records] == [0, 1, 0, 0][: len(records)]
    assert [record.nonfinite_by_parameter for record in records] == [{}] * len(records)
    if kind == "stop":
        assert moved == [False]
        assert "dL/dI in 1 entry, the first at pixel (0, 1), channel 1, of sensor 1" in error
    else:
        assert moved == [kind == "zero", True, True]
        assert error is None


@pytest.mark.parametrize("kind", ["skip", "zero"])
def test_a_run_without_updates_ends(tmp_path, steps, kind):
    problem = make_problem(tmp_path, sets=[f"run.on_nonfinite={kind}"])
    problem.views[0].made = dr.full(mi.TensorXf, np.nan, (2, 2, 3))
    records, values, error = run(problem)
    assert len(records) == PATIENCE
    assert "the loss was not finite in 10 iterations in a row" in error
    assert set(values["albedo"]) == {0.5}


def test_a_fault_is_reported_before_the_update(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.iterations=4"], keys=("albedo", "other"))
    steps.spoil = lambda call, key: np.nan if call == 2 and key == "other" else 1.0
    seen = []

    class Found(list):
        def append(self, found):
            seen.append((found.iteration, float(np.array(problem.selection.params["albedo"]).mean())))

    _, values, _ = run(problem, Found())
    assert seen == [(2, pytest.approx(values["albedo"][1]))]


def test_an_overflowing_update_is_counted_and_undone(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.iterations=2", "optimizer.learning_rate=1e30"])
    problem.optimizer._bounds = {"albedo": None}
    steps.spoil = lambda call, key: 1e30
    records, values, _ = run(problem)
    assert [record.nonfinite_by_parameter for record in records] == [{"albedo": 12}] * 2
    assert values["albedo"] == [0.5, 0.5]


@pytest.mark.parametrize("kind", ["skip", "zero"])
def test_after_a_non_finite_loss_nothing_moves(tmp_path, steps, kind):
    problem = make_problem(tmp_path, sets=[f"run.on_nonfinite={kind}", "run.iterations=3"])
    steps.loss = lambda call: np.inf if call == 1 else 0.0
    records, values, _ = run(problem)
    assert [record.nonfinite for record in records] == [0, 1, 0]
    assert values["albedo"][0] == values["albedo"][1] != values["albedo"][2]


# The clamp against outliers in gradients: which entries it clamps, and what it reports.


def leaf(kind, shape):
    value = dr.zeros(kind, shape)
    dr.enable_grad(value)
    return value


def clamp_all(factor, gradients, kind=None):
    """Clamp gradients (T, ...) in turn. Return the clamped gradients and the report on each."""
    parameter = leaf(mi.TensorXf, gradients[0].shape) if kind is None else leaf(kind, 1)
    clamped, said, known = [], [], ({}, {})
    for gradient in gradients:
        shaped = mi.TensorXf(gradient) if kind is None else kind(*gradient[:, 0].tolist())
        dr.set_grad(parameter, shaped)
        found, *known = clamp_gradients(factor, {"x": parameter}, *known)
        said.append(found)
        clamped.append(np.array(dr.grad(parameter)).reshape(gradient.shape))
    return np.array(clamped), said


def reference(gradients, k):
    """Clamp the gradients in NumPy."""
    m, result = np.zeros(gradients[0].shape), []
    for number, g in enumerate(gradients):
        usual = m / (1 - DECAY**number) if number else np.inf
        limit = k * np.maximum(usual, np.mean(usual))
        result.append(np.clip(g, -limit, limit))
        m = DECAY * m + (1 - DECAY) * np.abs(result[-1])
    return np.array(result)


@pytest.fixture
def heavy_tailed():
    """Gradients (50, 4, 5, 3) of a Pareto distribution with random signs. One entry is 0 in all gradients but one."""
    random = np.random.default_rng(3)
    gradients = random.pareto(1.5, (50, 4, 5, 3)) * random.choice([-1, 1], (50, 4, 5, 3))
    gradients[:, 0, 0, 0] = 0
    gradients[20, 0, 0, 0] = 2
    return gradients.astype(np.float32)


def test_the_clamp_matches_its_docstring(heavy_tailed):
    clamped, said = clamp_all(4.0, heavy_tailed)
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


def test_symmetric_outliers_are_no_bias():
    """Outliers alternate in sign. Clamping each outlier removes a share of its gradient, and together these changes
    nearly cancel.
    """
    gradients = np.ones((41, 1, 1, 3), np.float32)
    gradients[1::2, 0, 0, 1] = np.where(np.arange(20) % 2, 1000, -1000)
    _, said = clamp_all(3.0, gradients)
    assert min(entry.share["x"] for entry in said[1::2]) > 0.9
    assert said[-1].bias["x"] < 0.2, "not 0: what is usual grows with each of them"


def test_outliers_of_one_sign_are_a_bias():
    gradients = np.ones((40, 1, 1, 3), np.float32)
    gradients[5::10, 0, 0, 1] = 1000
    _, said = clamp_all(3.0, gradients)
    removed = 4 * 1000
    assert said[-1].bias["x"] == pytest.approx(removed / (removed + 120), rel=0.02)


def test_colours_and_numbers_are_clamped_too():
    for kind, channels in ((mi.Color3f, 3), (mi.Float, 1)):
        gradients = np.ones((10, channels, 1), np.float32)
        gradients[9, 0] = 1e30  # its square would overflow
        clamped, said = clamp_all(5.0, gradients, kind)
        assert clamped[9, 0, 0] == pytest.approx(5)
        assert said[9].entries == 1
        assert said[9].share["x"] == pytest.approx(1)


def test_large_gradients_do_not_switch_it_off():
    gradients = np.full((10, 1, 1, 3), 1e25, np.float32)
    gradients[9, 0, 0, 0] = 1e27
    clamped, _ = clamp_all(5.0, gradients)
    assert clamped[9].max() == pytest.approx(5e25)


def test_later_iterations_compile_nothing():
    parameter, known, clock, new = leaf(mi.TensorXf, (2, 2, 3)), ({}, {}), StepClock(), []
    for iteration in range(5):
        gradient = dr.full(mi.TensorXf, 1.0, (2, 2, 3)) + dr.opaque(mi.Float, iteration)
        dr.eval(gradient)
        dr.set_grad(parameter, gradient)
        with clock.step() as times:
            _, *known = clamp_gradients(3.0, {"x": parameter}, *known)
        new.append(times.new_kernels)
    assert new[2:] == [0, 0, 0]


def outlier(call, key):
    """Return a factor of 1000 in one entry of the third gradient, and 1 elsewhere."""
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
    # The sum is 12 equal gradients over 5 iterations plus 999 of the outlier, from which the clamp takes 997
    assert tally.bias["albedo"] == pytest.approx(997 / (60 + 999), rel=0.01)
    assert "1 entries of gradients clamped in 1 iterations: a bias of 94 % of that of albedo" in str(tally)
    assert '"bias": {"albedo": ' in records[2].to_json()


def test_the_clamp_is_off_by_default(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.iterations=5"])
    steps.spoil = outlier
    tally = ClampTally()
    for record in loop.optimize(problem):
        assert record.clamped is None
        tally.add(record)
    assert str(tally) == ""


def test_a_skipped_parameter_is_not_clamped(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["optimizer.clamp_gradient=3", "run.iterations=4"], keys=("albedo", "other"))
    steps.spoil = lambda call, key: np.nan if call == 1 and key == "other" else outlier(call, key)
    records = list(loop.optimize(problem))
    assert set(records[1].clamped.share) == {"albedo"}
    assert records[2].clamped.entries == 2
    assert all(np.isfinite(value) for record in records for value in record.clamped.bias.values())
