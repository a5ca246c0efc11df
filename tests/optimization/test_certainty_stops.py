"""When nothing is measured of how certain values are: runs that are short, and those that are told to stop."""

from __future__ import annotations

import numpy as np
import pytest
from optimization.toy import make_problem

from reslrb_cli.optimization.uncertainty import measuring
from reslrb_cli.optimization.uncertainty.measuring import LEAST_ITERATIONS, Certainty


def test_short_runs_and_stopped_ones_go_without(tmp_path, monkeypatch):
    problem, asked = make_problem(tmp_path), []

    def sample(problem, integrator, number, purpose, spp):
        asked.append(number)

    monkeypatch.setattr(measuring, "sample_gradient", sample)
    certainty, before = Certainty(problem), problem.values()["albedo"].copy()
    assert certainty.measure(LEAST_ITERATIONS - 1, 1.0, lambda: False) is None
    assert certainty.measure(100, 1.0, lambda: True) is None
    assert asked == []
    assert certainty.measure(100, 1.0, lambda: len(asked) == 2) is None  # Ctrl-C in the midst of it
    assert asked == [0, 1]
    np.testing.assert_array_equal(problem.values()["albedo"], before)


def test_a_failure_leaves_no_gradient_behind(tmp_path, monkeypatch):
    import drjit as dr

    problem = make_problem(tmp_path)

    def fail(problem, *others):
        dr.set_grad(problem.optimizer["albedo"], 1.0)
        raise RuntimeError("no more memory")

    monkeypatch.setattr(measuring, "sample_gradient", fail)
    with pytest.raises(RuntimeError, match="no more memory"):
        Certainty(problem).measure(100, 1.0, lambda: False)
    assert not np.any(np.array(problem.optimizer.gradient("albedo")))
