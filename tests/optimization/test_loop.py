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
from reslrb_cli.optimization.losses import make_loss
from reslrb_cli.optimization.nonfinite import PATIENCE, count_nonfinite, finite_square_norm
from reslrb_cli.optimization.state import standing
from reslrb_cli.records.clock import StepClock
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


def test_the_time_limit_ends_a_run_and_its_schedule(tmp_path, steps, monkeypatch):
    """Each reading of the clock advances time by one second, so that all iterations after the first take equally
    long.
    """
    seconds = itertools.count()
    monkeypatch.setattr("time.perf_counter", lambda: float(next(seconds)))

    def run(*sets):
        problem = steps.problem = make_problem(tmp_path, sets=["run.iterations=50", *sets])
        return list(loop.iterate(problem, standing(problem)))

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


@pytest.mark.parametrize("shift", [0.0, -0.3, -50.0, 4.0])
@pytest.mark.parametrize(("target", "is_large"), [(0.05, True), (0.8, False)])
def test_moments_of_a_large_first_loss_are_dropped_as_the_loss_falls(tmp_path, steps, target, is_large, shift):
    """The value starts at 0.5. For a target of 0.05, the image is worse than a black one. Adam's moments then contain
    only the steps since the loss last fell to a tenth. A constant in the loss changes nothing.
    """
    problem = steps.problem = make_problem(tmp_path, sets=["optimizer={type: adam, learning_rate: 0.02}"])
    problem.views[0].made = dr.full(mi.TensorXf, target, (2, 2, 3))
    problem.views[0].loss = lambda *images: make_loss("l2")(*images) + shift
    found = list(loop.iterate(problem, standing(problem)))
    losses = [record.loss - shift for _, record in found]
    assert losses[-1] < 0.1 * losses[0]
    level, since, expected = losses[0] if is_large else 0, 0, []
    for loss in losses:
        level, since = (loss, 1) if loss < 0.1 * level else (level, since + 1)
        expected.append((pytest.approx(level, abs=1e-5), since))
    steps_since = [int(np.array(state.moments["albedo"]["0"]).item()) for state, _ in found]
    assert [(state.level, count) for (state, _), count in zip(found, steps_since, strict=True)] == expected
    assert (steps_since[-1] < len(losses)) is is_large


@pytest.mark.parametrize(("kind", "rate"), [("-PSNR", 0.005), ("log-likelihood", 0.005), ("-correlation", 0.02)])
def test_negative_losses_keep_their_moments(kind, rate, tmp_path, steps):
    """The loss falls in each iteration. At the target, it is not finite, or below 0, or not the smallest one."""

    def loss(image, target):
        square = make_loss("l2")(image, target)
        product = dr.mean(image * target, axis=None).array
        return {"-PSNR": 10 * dr.log2(square), "log-likelihood": 50 * square - 30, "-correlation": -product}[kind]

    problem = steps.problem = make_problem(tmp_path, sets=[f"optimizer={{type: adam, learning_rate: {rate}}}"])
    problem.views[0].loss = loss
    found = list(loop.iterate(problem, standing(problem)))
    losses = [record.loss for _, record in found]
    assert max(losses) < 0
    assert np.all(np.diff(losses) < 0)
    assert [int(np.array(state.moments["albedo"]["0"]).item()) for state, _ in found] == [*range(1, 21)]


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


@pytest.mark.parametrize("kind", ["adam", "auto"])
def test_equal_states_have_equal_successors(tmp_path, steps, kind):
    """A step depends only on its state. An earlier state can be restored, and a step leaves its input state
    unchanged.
    """
    sets = [f"optimizer={{type: {kind}}}"]
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
