"""Parameters in a few numbers, and results that are there whenever a run ends."""

from __future__ import annotations

import json

import numpy as np
import pytest
from optimization.toy import make_problem
from records.test_metrics import make_record

from reslrb_cli.optimization import loop
from reslrb_cli.optimization.results import Results, summary


def test_small_parameters_are_told_by_all_their_numbers():
    assert summary(np.array(0.25)) == {"value": 0.25}
    assert summary(np.array([0.5, 1.0, 0.25])) == {"value": [0.5, 1.0, 0.25]}
    assert summary(np.arange(8.0)) == {"mean": [3.5], "min": 0.0, "max": 7.0}


def test_textures_are_told_by_mean_and_range_of_what_is_reached():
    value = np.zeros((2, 2, 3))
    value[0, 0], value[0, 1], value[1] = (1, 2, 3), (3, 4, 5), 100
    mask = np.array([[True, True], [False, False]])
    assert summary(value, mask) == {"mean": [2.0, 3.0, 4.0], "min": 1.0, "max": 5.0}
    assert summary(value, np.zeros((2, 2), dtype=bool))["max"] == 100  # nothing is reached: all counts
    finer = np.repeat(np.repeat(mask, 3, axis=0), 2, axis=1)
    assert summary(value, finer) == summary(value, mask)


def test_results_of_a_run(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path)
    results = Results(problem)
    assert results.to_json()["parameters"]["albedo"]["initial"] is None
    results.begin()
    for record in loop.optimize(problem):
        results.add(record)
    halfway = results.to_json()
    assert halfway["parameter_rmse"]["albedo"] == {"initial": pytest.approx(0.3), "final": None}
    assert halfway["rmse"]["final"] is None
    results.end()
    found = results.to_json()
    assert found["parameter_rmse"]["albedo"]["final"] < 0.1
    assert found["relative_error"]["albedo"]["initial"] == pytest.approx(0.3 / 0.8)
    assert found["parameters"]["albedo"]["reached"] == 0.75
    assert found["loss_trend"]["change"] == "fell"
    assert found["worse"] == []
    assert found["image_loss"] == {"initial": None, "final": None}
    image = np.full((2, 2, 4), 0.6, dtype=np.float32)
    results.see("final", problem.views[0], image)
    results.see("iteration-000002", problem.views[0], image)
    assert results.to_json()["image_loss"] == {"initial": None, "final": pytest.approx(0.04, rel=1e-4)}
    assert json.dumps(found, allow_nan=False)


@pytest.mark.parametrize(("iterations", "worse"), [(3, ["albedo"]), (4, [])])
def test_a_short_run_is_called_worse_once_it_is_over(tmp_path, iterations, worse):
    """Pages of a run that goes on ask from its first iterations on."""
    problem = make_problem(tmp_path, sets=[f"run.iterations={iterations}"])
    results = Results(problem)
    results.begin()
    for iteration in range(3):
        results.add(make_record(iteration=iteration, parameter_errors={"albedo": 1e-3}))
    results.end()
    assert results.to_json()["worse"] == worse


def test_a_truth_that_is_not_finite_is_null(tmp_path):
    """The manifest is JSON, which has no such numbers."""
    problem = make_problem(tmp_path)
    problem.truth["albedo"][0, 0, 0] = np.nan
    results = Results(problem)
    results.begin()
    results.end()
    found = json.loads(json.dumps(results.to_json(), allow_nan=False))
    assert found["parameter_rmse"]["albedo"] == {"initial": None, "final": None}


def test_an_image_of_each_sensor_is_asked_for(tmp_path):
    problem = make_problem(tmp_path, views=2)
    results = Results(problem)
    image = np.full((2, 2, 3), 0.6, dtype=np.float32)
    results.see("final", problem.views[0], image)
    assert results.to_json()["image_loss"]["final"] is None
    results.see("final", problem.views[1], image)
    assert results.to_json()["image_loss"]["final"] == pytest.approx(0.04, rel=1e-4)
