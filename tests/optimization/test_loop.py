"""The loop on a problem whose image is its parameter: what it records."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from optimization.toy import make_problem

from reslrb_cli.optimization import loop
from reslrb_cli.optimization.optimizers import count_nonfinite, finite_square_norm
from reslrb_cli.records.clock import StepClock


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


def test_a_step_is_split_where_it_has_an_image_in_between(tmp_path, steps):
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
    assert {call.adjoint for call in steps.calls} == {"independent"}  # four batches do not divide 3 samples


def test_the_loss_is_the_mean_over_the_views(tmp_path, steps):
    one = steps.problem = make_problem(tmp_path)
    losses = [record.loss for record in loop.optimize(one)]
    three = steps.problem = make_problem(tmp_path, views=3)
    np.testing.assert_allclose([record.loss for record in loop.optimize(three)], losses, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(np.array(three.optimizer["albedo"]), np.array(one.optimizer["albedo"]), rtol=1e-5)


def test_a_clock_knows_new_kernels():
    clock, new = StepClock(), []
    for factor in (2.0, 2.0, 3.0):
        with clock.step() as times:
            dr.eval(dr.arange(mi.Float, 7) * factor)
        new.append(times.new_kernels)
    assert new == [1, 0, 1]


def test_counting_leaves_finite_entries_alone():
    value = mi.TensorXf(np.array([3.0, np.nan, 4.0, np.inf], dtype=np.float32))
    assert int(count_nonfinite(value)[0]) == 2
    assert float(finite_square_norm(value)[0]) == pytest.approx(25.0)
    color = mi.Color3f(1.0, np.nan, 2.0)
    assert int(count_nonfinite(color)[0]) == 1
    assert float(finite_square_norm(color)[0]) == pytest.approx(5.0)
