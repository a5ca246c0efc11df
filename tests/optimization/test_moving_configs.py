"""The shipped configurations whose parameters move light recover them to a tenth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.identifiability import find_reached
from reslrb_cli.optimization.loop import optimize

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def slopes(heights: np.ndarray) -> np.ndarray:
    return np.concatenate([np.diff(heights[..., 0], axis=axis).ravel() for axis in (0, 1)])


@pytest.mark.long
@pytest.mark.parametrize("name", ["lens_pose", "caustic_heightmap"])
def test_it_is_recovered_to_a_tenth(name):
    problem = assemble(load(CONFIGS / f"{name}.yaml"))
    start = problem.values()
    problem = find_reached(problem)
    for _ in optimize(problem):
        pass
    for key, value in problem.values().items():
        measure = slopes if key.endswith(".heightmap") else np.ravel
        true = measure(problem.truth[key])
        assert np.linalg.norm(measure(value) - true) < 0.1 * np.linalg.norm(measure(start[key]) - true), key
