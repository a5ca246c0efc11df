"""What the loop does with values that are not finite, by each policy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from optimization.toy import make_problem

from reslrb_cli.errors import NonFinite
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.nonfinite import PATIENCE


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_reaches_no_parameter(tmp_path, steps, bad):
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


def test_a_loss_that_is_not_finite_stops_every_update(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path, sets=["run.iterations=3"])
    problem.views[0].made = dr.full(mi.TensorXf, np.nan, (2, 2, 3))
    records = list(loop.optimize(problem))
    assert all(record.nonfinite == 13 for record in records)
    np.testing.assert_array_equal(np.array(problem.optimizer["albedo"]), 0.5)


def test_it_gives_up_when_nothing_is_finite_any_more(tmp_path, steps):
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
    """All records, and the mean of each parameter after each of them; a run that ends early ends both."""
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
    """A factor of a gradient that leaves all but one entry as they are."""
    factor = np.ones((2, 2, 3), np.float32)
    factor[1, 0, 2] = value
    return mi.TensorXf(factor)


def nan_pixel(call, calls):
    """A derivative of the loss that is NaN in one entry in some calls."""
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


def test_stop_ends_at_the_first_and_updates_nothing(tmp_path, steps):
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


def test_zero_leaves_a_parameter_alone_when_nothing_is_left(tmp_path, steps):
    sets = ["run.on_nonfinite=zero", "optimizer.momentum=0.9", "optimizer.learning_rate=0.02"]
    problem = make_problem(tmp_path, sets=sets, keys=("albedo", "other"))
    steps.spoil = lambda call, key: np.nan if call >= 3 and key == "other" else 1.0
    records, values, error = run(problem)
    assert len(records) == 3 + PATIENCE
    assert "other was not finite in 10 iterations in a row" in error
    assert len(set(values["other"][2:])) == 1, "its momentum does not move it either"
    assert len(set(values["albedo"])) == len(records)


def test_zero_goes_on_as_long_as_something_moves(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.on_nonfinite=zero", f"run.iterations={PATIENCE + 5}"])
    steps.spoil = lambda call, key: one_entry(np.nan)
    records, _, error = run(problem)
    assert (len(records), error) == (PATIENCE + 5, None)


@pytest.mark.parametrize("kind", ["stop", "skip", "zero"])
def test_a_derivative_of_the_loss_is_refused_by_each_policy(tmp_path, steps, kind):
    """The step takes it for 0: what becomes of the rest is the policy's."""
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
def test_a_run_that_stands_still_ends(tmp_path, steps, kind):
    problem = make_problem(tmp_path, sets=[f"run.on_nonfinite={kind}"])
    problem.views[0].made = dr.full(mi.TensorXf, np.nan, (2, 2, 3))
    records, values, error = run(problem)
    assert len(records) == PATIENCE
    assert "the loss was not finite in 10 iterations in a row" in error
    assert set(values["albedo"]) == {0.5}


def test_it_is_told_of_before_the_update(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.iterations=4"], keys=("albedo", "other"))
    steps.spoil = lambda call, key: np.nan if call == 2 and key == "other" else 1.0
    seen = []

    class Found(list):
        def append(self, found):
            seen.append((found.iteration, float(np.array(problem.selection.params["albedo"]).mean())))

    _, values, _ = run(problem, Found())
    assert seen == [(2, pytest.approx(values["albedo"][1]))]


def test_an_update_that_overflows_is_counted_and_taken_back(tmp_path, steps):
    problem = make_problem(tmp_path, sets=["run.iterations=2", "optimizer.learning_rate=1e30"])
    problem.optimizer._bounds = {"albedo": None}
    steps.spoil = lambda call, key: 1e30
    records, values, _ = run(problem)
    assert [record.nonfinite_by_parameter for record in records] == [{"albedo": 12}] * 2
    assert values["albedo"] == [0.5, 0.5]


@pytest.mark.parametrize("kind", ["skip", "zero"])
def test_after_a_loss_nothing_moves_even_if_its_gradient_is_finite(tmp_path, steps, kind):
    problem = make_problem(tmp_path, sets=[f"run.on_nonfinite={kind}", "run.iterations=3"])
    steps.loss = lambda call: np.inf if call == 1 else 0.0
    records, values, _ = run(problem)
    assert [record.nonfinite for record in records] == [0, 1, 0]
    assert values["albedo"][0] == values["albedo"][1] != values["albedo"][2]
