"""The loop on a problem whose image is its parameter: what it records, and what it does with non-finite values."""

from __future__ import annotations

import itertools
import types

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.config import load
from reslrb_cli.errors import NonFinite
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.constraints import PATIENCE, count_nonfinite, finite_square_norm
from reslrb_cli.optimization.losses import make_loss
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.problem import Problem

CONFIG = """
scene: {file: scene.xml}
target: {render: {}}
parameters: [{key: albedo}]
optimizer: {type: sgd, learning_rate: 2.0, schedule: cosine}
run: {iterations: 20, spp: 3, seed: 5}
"""


class Params(dict):
    """Stands in for `mi.SceneParameters` without a scene."""

    @property
    def properties(self):
        return dict.fromkeys(self, (None, None, None, 0))

    def update(self):
        pass


def make_problem(tmp_path, views=1, sets=(), keys=("albedo",)):
    path = tmp_path / "config.yaml"
    path.write_text(CONFIG)
    config = load(path, list(sets))
    values = {key: dr.full(mi.TensorXf, 0.5, (2, 2, 3)) for key in keys}
    optimizer = Optimizer(
        config.optimizer.type,
        config.optimizer.learning_rate,
        config.optimizer.own_options(),
        values,
        dict.fromkeys(keys),
        dict.fromkeys(keys, (0.0, 1.0)),
    )
    params = Params(values)
    problem = Problem(
        config=config,
        scene=None,
        sensors=list(range(views)),
        selection=types.SimpleNamespace(keys=list(keys), params=params, array=lambda key: np.array(params[key])),
        integrator=None,
        loss=make_loss("l2"),
        optimizer=optimizer,
        targets=[dr.full(mi.TensorXf, 0.8, (2, 2, 3))] * views,
        truth={key: np.full((2, 2, 3), 0.8) for key in keys},
        masks={key: np.array([[True, False], [True, True]]) for key in keys},
    )
    problem.apply()
    return problem


@pytest.fixture
def steps(monkeypatch, request):
    """Replaces the gradient step by one whose image is the mean of the parameters; returns its calls.

    `steps.spoil(call, key)` says what to multiply into a gradient.
    """
    calls = []
    state = types.SimpleNamespace(calls=calls, problem=None, has_image=False, spoil=lambda call, key: 1.0)

    def gradient_step(integrator, scene, sensor, objective, *, seed, spp, adjoint, params, on_image):
        number = len(calls)
        calls.append(types.SimpleNamespace(sensor=sensor, seed=seed, spp=spp, adjoint=adjoint))
        factors = {key: state.spoil(number, key) for key in params}
        image = sum((dr.replace_grad(dr.detach(value), value * factors[key]) for key, value in params.items()), 0.0)
        image = image / len(params)
        loss = objective(image)
        if state.has_image:
            on_image()
        dr.backward(loss)
        return types.SimpleNamespace(image=dr.detach(image), loss=dr.detach(loss))

    monkeypatch.setattr(loop, "gradient_step", gradient_step)
    return state


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
    assert {call.adjoint for call in steps.calls} == {"correlated"}


def test_the_loss_is_the_mean_over_the_views(tmp_path, steps):
    one = steps.problem = make_problem(tmp_path)
    losses = [record.loss for record in loop.optimize(one)]
    three = steps.problem = make_problem(tmp_path, views=3)
    np.testing.assert_allclose([record.loss for record in loop.optimize(three)], losses, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(np.array(three.optimizer["albedo"]), np.array(one.optimizer["albedo"]), rtol=1e-5)


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
    problem.targets = [dr.full(mi.TensorXf, np.nan, (2, 2, 3))]
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


def test_a_clock_knows_new_kernels():
    clock, new = loop.StepClock(), []
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


def test_errors_are_taken_over_the_mask(tmp_path):
    problem = make_problem(tmp_path)
    problem.truth["albedo"] = np.array(problem.optimizer["albedo"]) + np.array([[[1.0], [50.0]], [[2.0], [3.0]]])
    assert problem.parameter_errors()["albedo"] == pytest.approx(np.sqrt((1 + 4 + 9) / 3), rel=1e-5)
    assert problem.parameter_rmse() == pytest.approx(np.sqrt((1 + 4 + 9) / 3), rel=1e-5)
    problem.masks["albedo"][:] = False
    assert problem.parameter_rmse() is None
