"""Stages of a run: the problem of each iteration, the values passed to the next stage, and refused settings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cli import tiny
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble, assemble_scene, at_stage
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.stages import Stages
from reslrb_cli.optimization.state import State, standing
from reslrb_cli.records.images import write_file
from reslrb_cli.records.metrics import Record

ROOT = Path(__file__).parents[2]
PLAIN = ["run.iterations=10", "run.measuring=1000", "run.spp=8", "optimizer={type: sgd, learning_rate: 0.5}"]
STAGES = (
    "run.stages=[{until: 0.2, resolution: 0.5, film: 0.25}, {until: 0.4, resolution: 0.5, film: 0.5},"
    " {until: 0.6, film: 0.5}, {until: 0.8}]"
)


@pytest.fixture
def experiment(llvm: str, tmp_path: Path) -> Path:
    tiny.write_experiment(tmp_path)
    return tmp_path / "tiny.yaml"


def worked_on(problem: Problem) -> Iterator[tuple[Problem, State, Record]]:
    """Yield the problem, the state and the record of each iteration."""
    stages = Stages(problem)
    for state, record in iterate(stages, standing(problem)):
        yield stages.now, state, record


def test_each_iteration_has_the_resolution_of_its_stage(experiment: Path) -> None:
    problem = assemble(load(experiment, [*PLAIN, STAGES]), to_run=True)
    seen = []
    for now, state, record in worked_on(problem):
        array, target = now.selection.array(tiny.KEY), now.views[0].target
        assert now.scene.sensors()[0].film().crop_size()[0] == target.shape[0]
        assert next(iter(state.values.values())).shape == array.shape
        assert (record.spp, record.lr) == (8, 0.5)
        seen.append((array.shape[0], target.shape[0], state.stage))
        assert state.stage_began == 2 * state.stage
    assert seen == [(2, 2, 0)] * 2 + [(2, 4, 1)] * 2 + [(4, 4, 2)] * 2 + [(4, 8, 3)] * 2 + [(4, 8, 4)] * 2
    assert now.scene is problem.scene  # after all stages, the run uses the original problem


def test_parameters_too_fine_for_a_stage_stay_unchanged(experiment: Path) -> None:
    """The texture begins rough, and a stage of 2x2 texels moves nothing. The texture loses no roughness."""
    stages = "run.stages=[{until: 0.5, resolution: 0.5, film: 0.5}]"
    still = ["parameters[0].initial=scene", "optimizer.learning_rate=1e-12"]
    problem = assemble(load(experiment, [*PLAIN, stages, *still]), to_run=True)
    before = problem.values()[tiny.KEY]
    assert np.ptp(before) > 0.3
    found = Stages(problem)
    for state, _ in iterate(found, standing(problem)):
        if state.iteration == 5:
            assert state.stage == 0
            assert found.values(state)[tiny.KEY] == pytest.approx(before, abs=1e-6)
            found.bring(state)
            assert problem.values()[tiny.KEY] == pytest.approx(before, abs=1e-6)
            break


def test_values_are_carried_over_within_their_bounds(experiment: Path) -> None:
    """Steps of a coarse stage reach the fine texture. No value leaves its bounds."""
    sets = [*PLAIN, "run.stages=[{until: 0.9, resolution: 0.5}]", "optimizer.learning_rate=5"]
    problem = assemble(
        load(experiment, [*sets, "parameters[0].bounds=[0.2, 0.7]", "parameters[0].initial=0.2"]), to_run=True
    )
    stages, errors = Stages(problem), []
    for state, record in iterate(stages, standing(problem)):
        value = stages.values(state)[tiny.KEY]
        assert value.shape == (4, 4, 3)
        assert np.array_equal(value, np.clip(value, np.float32(0.2), np.float32(0.7)))
        errors.append(record.parameter_rmse)
    assert errors[8] < 0.9 * errors[0]
    assert errors[9] == pytest.approx(errors[8], rel=0.1)  # the fine stage starts from the coarse result


def test_a_smaller_film_sees_the_weighted_mean_of_the_target(experiment: Path) -> None:
    """With a box filter, the expectation of the smaller film's image is the mean of the whole film's image."""
    problem = assemble(load(experiment, [*PLAIN, "run.stages=[{until: 0.5, film: 0.5}]"]), to_run=True)
    rng = np.random.default_rng(3)
    target, weights = rng.uniform(size=(8, 8, 3)), rng.integers(0, 3, (8, 8)).astype(np.float32)
    weights[:2, :2] = 0
    problem.views[0].see(target, weights)
    view = at_stage(problem, 0).views[0]
    block = weights.reshape(4, 2, 4, 2).sum(axis=(1, 3))
    mean = (weights[:, :, None] * target).reshape(4, 2, 4, 2, 3).sum(axis=(1, 3)) / np.maximum(block, 1)[:, :, None]
    kept = block > 0
    assert np.array(view.target)[kept] == pytest.approx(mean[kept], rel=1e-5)
    assert np.array(view.weights)[:, :, 0] == pytest.approx(block / block.mean(), rel=1e-5)
    coarse = at_stage(problem, 0)
    images = [np.stack([each.render(0, 256, n, "image") for n in range(16)]) for each in (problem, coarse)]
    images[0] = images[0].reshape(16, 4, 2, 4, 2, -1).mean(axis=(2, 4))
    error = np.sqrt(sum(each.var(axis=0, ddof=1) / 16 for each in images))
    z = (images[0].mean(axis=0) - images[1].mean(axis=0)) / np.maximum(error, 1e-6)
    assert np.abs(z).max() < 5  # 16 pixels: once in 30,000 times, by a t distribution


def test_scale_is_measured_again_only_if_the_problem_changes(experiment: Path) -> None:
    sets = [*PLAIN, "optimizer={type: sgd, scale: curvature, learning_rate: 1}"]
    stages = "run.stages=[{until: 0.3, resolution: 0.5}, {until: 0.6, resolution: 0.5}]"
    problem = assemble(load(experiment, [*sets, stages]), to_run=True)
    found = [state.scaling for _, state, _ in worked_on(problem)]
    assert all(each is found[0] for each in found[:6])
    assert all(each is found[6] for each in found[6:])
    assert found[0][0] != found[6][0]


def test_a_run_with_more_iterations_does_not_go_back(experiment: Path) -> None:
    sets = [*PLAIN, "run.stages=[{until: 0.5, resolution: 0.5}]"]
    problem = assemble(load(experiment, sets), to_run=True)
    stages = Stages(problem)
    for state, _ in iterate(stages, standing(problem)):
        if state.iteration == 6:
            break
    longer = assemble(load(experiment, [*sets, "run.iterations=100"]), to_run=True)
    now, after = Stages(longer).enter(state)
    assert (now.scene is longer.scene, after.stage) == (True, 1)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ("[{until: 0.5, film: 0.3}]", r"run.stages\[0\].film: 0.3 of 8x8 pixels is not an integer size; 1/2, 1/4, 1/8"),
        ("[{until: 0.5, film: 0.75}]", r"run.stages\[0\].film: 0.75 of 8x8 pixels is not an integer size"),
        ("[{until: 1}]", r"run.stages\[0\].until: must be below 1"),
        ("[{until: 0.5}, {until: 0.5}]", r"run.stages\[1\].until: must be above 0.5"),
        (
            "[{until: 0.5}, {until: 0.6, film: 0.5}]",
            r"run.stages\[1\].film: must be at least 1, that of the previous stage",
        ),
    ],
)
def test_impossible_stages_are_refused(experiment: Path, stages: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        assemble_scene(load(experiment, [*PLAIN, f"run.stages={stages}"]))


def test_a_stage_without_coarsening_is_refused(experiment: Path) -> None:
    lamp = "parameters=[{key: lamp.emitter.radiance.value, initial: 1}]"
    with pytest.raises(ConfigError, match=r"run.stages\[0\].resolution: makes nothing coarser"):
        assemble_scene(load(experiment, [lamp, "run.stages=[{until: 0.5, resolution: 0.5}]"]))


@pytest.mark.parametrize("face", a_few(["face", "back"], ["back"]))
def test_a_lens_and_its_mesh_are_coarsened_together(llvm: str, tmp_path: Path, face: str) -> None:
    """The coarse lens reaches from edge to edge, and its outside stays in place. Planes stay as flat and slopes as
    steep as before.
    """
    tones = np.kron(0.3 + 0.7 * np.random.default_rng(1).uniform(size=(4, 4)), np.ones((4, 4)))
    write_file(tmp_path / "p.exr", np.repeat(tones[:, :, None], 3, 2).astype(np.float32), linear=True)
    tiny.done("lens", tmp_path / "p.exr", "--pixels", 16, "--both", "-o", tmp_path / "l")
    config = load(tmp_path / "l/lens.yaml", ["run.stages=[{until: 0.5, resolution: 0.5}]", "run.measuring=1000"])
    problem = assemble(config, to_run=True)
    key = f"{face}.heightmap"
    height, width = problem.selection.array(key).shape[:2]
    y, x = np.mgrid[:height, :width] / (width - 1)
    problem.selection.set_arrays({key: (0.3 * x - 0.2 * y)[:, :, None].astype(np.float32)})
    coarse = at_stage(problem, 0)
    assert coarse.selection.array(key).shape[:2] == (height // 2, width // 2)
    fine, small = ({shape.id(): shape for shape in each.scene.shapes()}[face] for each in (problem, coarse))
    assert small.vertex_count() == height * width // 4
    for end in ("min", "max"):
        assert np.allclose(getattr(small.bbox(), end), getattr(fine.bbox(), end), atol=1e-4)
    points = np.array(small.vertex_positions_buffer()).reshape(height // 2, width // 2, 3)
    normals = [np.cross(*(_edge(shape, n) for n in (1, 2))) for shape in (fine, small)]
    assert normals[0] @ normals[1] > 0.999 * np.linalg.norm(normals[0]) * np.linalg.norm(normals[1])
    slope = np.diff(points, axis=1)
    assert slope[..., 2] / slope[..., 0] == pytest.approx(slope[0, 0, 2] / slope[0, 0, 0], rel=1e-3)


def _edge(shape: object, number: int) -> np.ndarray:
    points = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)  # type: ignore[attr-defined]
    corners = np.array(shape.faces_buffer()).reshape(-1, 3)[0]  # type: ignore[attr-defined]
    return points[corners[number]] - points[corners[0]]
