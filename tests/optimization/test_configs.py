"""Recovery of shipped experiments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.identifiability import find_reached
from reslrb_cli.optimization.loop import optimize

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_each_stiff_experiment_is_listed_here():
    assert {path.stem for path in (CONFIGS / "stiff").iterdir()} == {"lamp", "plate", "wall"}


@pytest.mark.long
def test_the_mixed_room_is_recovered_if_only_the_mirror_shows_it():
    """Light paths alone keep the initial values of the mirrored part."""
    problem = assemble(load(CONFIGS / "mixed_room.yaml"))
    for _ in optimize(problem):
        pass
    key = "print.reflectance.data"
    error = (problem.values()[key] - problem.truth[key])[4:22]
    assert np.sqrt((error[:, 14:] ** 2).mean()) < 0.05
    assert np.sqrt((error[:, :10] ** 2).mean()) < 0.12  # only the mirror shows this part


# The shipped configurations whose parameters move light reduce the parameters' errors to a tenth.


def slopes(heights: np.ndarray) -> np.ndarray:
    return np.concatenate([np.diff(heights[..., 0], axis=axis).ravel() for axis in (0, 1)])


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "limit"), [("lens_pose", 0.1), ("moved_box", 0.1), ("table", 0.2), ("caustic_heightmap", 0.1)]
)
def test_the_error_falls_below_a_share_of_the_start(name, limit):
    sets = {  # as these runs decide
        "moved_box": ["integrator.edges=on"],
        "table": ["integrator.edges=on", "integrator.paths=both", "integrator.guiding=on"],
    }.get(name, [])
    problem = assemble(load(CONFIGS / f"{name}.yaml", sets))
    start = problem.values()
    problem = find_reached(problem)
    for _ in optimize(problem):
        pass
    for key, value in problem.values().items():
        measure = slopes if name == "caustic_heightmap" else np.ravel
        true = measure(problem.truth[key])
        assert np.linalg.norm(measure(value) - true) < limit * np.linalg.norm(measure(start[key]) - true), key
