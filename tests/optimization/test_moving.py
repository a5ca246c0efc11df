"""Parameters that move light: gradients, recorded steps, and located errors for unsupported parameters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from optimization import glass
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.step import known_step, render_image
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.identifiability import find_reached
from reslrb_cli.optimization.loop import optimize

SEED, SPP = 3, 64
MOTIONS = "parameters=[{motion: {of: slab, free: [translation, rotation, scale], pivot: [0.2, 1.5, 0.1]}}, "
MOTIONS += "{heightmap: {mesh: slab, resolution: [5, 4]}}, {motion: {of: lamp}}]"
NO_TRUTH = "target.render.parameters={}"
FLOOR = "parameters=[{key: floor.bsdf.reflectance.value}]"
#: Step of central differences for each kind of parameter.
STEPS = {"translation": 1e-2, "rotation": 0.3, "scale": 1e-2, "heightmap": 2e-3}


def weights() -> mi.TensorXf:
    """Return a smooth dL/dI that vanishes at the film's border."""
    y, x = (np.mgrid[0:24, 0:24] + 0.5) / 24
    inside = np.clip((np.minimum.reduce([x, 1 - x, y, 1 - y]) - 0.05) / 0.2, 0, 1)
    image = np.stack([np.sin(5 * x) * np.cos(4 * y) + 1.5, np.cos(3 * x + 2 * y) + 1.2, x + y], -1)
    result = mi.TensorXf((image * (inside**2 * (3 - 2 * inside))[..., None]).astype(np.float32))
    dr.make_opaque(result)
    return result


def gradients(problem: Any, spp: int = SPP) -> dict[str, np.ndarray]:
    known_step(problem.integrator, problem.scene, 0, weights(), seed=SEED, spp=spp, params=problem.selection.params)
    found = {key: np.array(value).reshape(-1) for key, value in problem.gradients().items()}
    for key in found:
        problem.optimizer.clear_gradient(key)
    return found


def objective(problem: Any, values: dict[str, np.ndarray]) -> float:
    problem.selection.set_arrays(values)
    image = np.array(render_image(problem.integrator, problem.scene, 0, SEED, SPP), np.float64)
    return float((image * np.array(weights(), np.float64)).sum())


def differences(problem: Any, key: str, directions: list[np.ndarray]) -> list[float]:
    h, base = STEPS[key.rpartition(".")[2]], problem.selection.array(key)
    found = []
    for direction in directions:
        shift = (h * direction).reshape(base.shape).astype(np.float32)
        found.append((objective(problem, {key: base + shift}) - objective(problem, {key: base - shift})) / (2 * h))
    problem.selection.set_arrays({key: base})
    return found


def test_gradients_match_finite_differences(tmp_path):
    problem = glass.assemble(tmp_path, MOTIONS, NO_TRUTH)
    # The slab stays flat. On a bent slab, the correction for shading normals jumps between triangles. Differences
    # include these jumps, and derivatives do not.
    start = {"slab.rotation": np.array([3, -4, 2], np.float32), "slab.scale": np.array(1.1, np.float32),
             "lamp.rotation": np.array([1, 2, -1], np.float32)}  # fmt: skip
    problem = glass_at(problem, start)
    found = gradients(problem)
    random = np.random.default_rng(0)
    for key in problem.selection.keys:
        size = problem.selection.array(key).size
        directions = list(np.eye(size)) if size <= 3 else [random.normal(size=size) for _ in range(3)]
        expected = differences(problem, key, directions)
        scale = max(map(abs, expected))
        assert np.allclose([found[key] @ d for d in directions], expected, atol=0.005 * scale), key


def glass_at(problem: Any, values: dict[str, np.ndarray]) -> Any:
    """Give the problem other values, from which the optimiser continues, and return the problem."""
    for key, value in values.items():
        kind = type(problem.optimizer[key])
        new = kind(np.ascontiguousarray(value)) if value.ndim else kind(float(value))
        dr.make_opaque(new)
        problem.optimizer._own[key][key] = new
    problem.apply()
    return problem


def test_a_recorded_step_follows_moving_parameters(tmp_path):
    frozen = glass.assemble(tmp_path, MOTIONS, NO_TRUTH)
    plain = glass.assemble(tmp_path, MOTIONS, NO_TRUTH)
    plain = replace(plain, integrator=plain.integrator.with_options(samples_per_pass=None, freeze=False))
    assert frozen.integrator.freeze
    before = gradients(frozen, 16)
    moved = {"slab.translation": np.array([0.2, -0.3, 0.1], np.float32), "slab.scale": np.array(0.8, np.float32),
             "lamp.translation": np.array([0.1, -0.5, 0.2], np.float32)}  # fmt: skip
    after, expected = gradients(glass_at(frozen, moved), 16), gradients(glass_at(plain, moved), 16)
    assert frozen.integrator.preparation.recordings.counts()["fused"] > 0
    for key, value in expected.items():
        scale = np.abs(value).max()
        assert np.allclose(after[key], value, atol=1e-3 * scale), key
        assert not np.allclose(before[key], value, atol=1e-2 * scale), key


@pytest.fixture(scope="module")
def norm_of_all_samples(llvm, tmp_path_factory) -> float:
    """Norm of the gradient of a step with more samples, in one pass."""
    path = glass.write_experiment(tmp_path_factory.mktemp("all"))
    one = assemble(load(path, ["run.adjoint=independent", "run.iterations=1", "run.spp=64"]))
    one = find_reached(one)
    [reference] = list(optimize(one))
    return float(reference.grad_norm)


@pytest.mark.parametrize(
    "options",
    a_few(
        ["run.adjoint=independent", "run.adjoint=batched", "integrator.samples_per_pass=4"],
        (),  # test_passes_have_the_gradient_of_all_samples
    ),
)
def test_steps_of_several_backward_passes_add_up(tmp_path, options, norm_of_all_samples):
    """Batches and passes propagate gradients several times through the moving parameters, from one set of values."""
    path = glass.write_experiment(tmp_path)
    problem = assemble(load(path, [options, "run.iterations=1"]))
    problem = find_reached(problem)
    [record] = list(optimize(problem))
    assert record.grad_norm > 0
    assert record.grad_norm == pytest.approx(norm_of_all_samples, rel=0.5)


def test_passes_have_the_gradient_of_all_samples(tmp_path):
    whole = gradients(glass.assemble(tmp_path, MOTIONS, NO_TRUTH), 64)
    parts = gradients(glass.assemble(tmp_path, MOTIONS, NO_TRUTH, "integrator.samples_per_pass=32", "run.spp=32"), 64)
    for key, value in whole.items():
        assert np.linalg.norm(parts[key] - value) < 0.3 * np.linalg.norm(value), key


@pytest.mark.long
def test_a_lamp_is_found(tmp_path):
    config = load(glass.write_experiment(tmp_path), ["run.iterations=25", "run.spp=32", "integrator.estimator=auto"])
    problem = assemble(config)
    assert type(problem.integrator.estimator).__name__ == "Stack"
    problem = find_reached(problem)
    records = list(optimize(problem))
    assert records[0].parameter_rmse == pytest.approx(np.sqrt(0.015 / 3), rel=1e-3)
    assert records[-1].parameter_rmse < 0.4 * records[0].parameter_rmse


def test_roughness_stays_detached_by_default(tmp_path):
    path = glass.write_experiment(tmp_path)
    scene = (tmp_path / "scene.xml").read_text()
    rough = '<bsdf type="roughdielectric" id="glass"><float name="alpha" value="0.1"/></bsdf>'
    (tmp_path / "scene.xml").write_text(scene.replace('<bsdf type="dielectric" id="glass"/>', rough))
    for key, attached, plans in (("alpha.value", "auto", False), ("alpha.value", "true", True), ("eta", "true", True)):
        sets = [f"parameters=[{{key: glass.{key}}}]", NO_TRUTH, f"integrator.attached={attached}"]
        problem = assemble_scene(load(path, sets))
        plan = problem.integrator.plan(problem.scene, problem.scene.sensors()[0], problem.selection.params)
        assert plan.attached is plans
        assert np.isfinite(gradients(problem, 16)[f"glass.{key}"]).all()


#: Settings, the location of the error, and a part of its text.
REFUSED = {
    "estimator": (["integrator.estimator=event"], "integrator.estimator", "use reservoir, stack"),
    "detached": (["integrator.attached=false"], "integrator.attached", "use auto"),
    "prb": (["integrator={type: prb}"], "integrator.type", "prb has no derivatives of moving light"),
    "trajectory": (["integrator={type: trajectory}"], "integrator.type", "trajectory has no derivatives"),
    "box filter": (["scene.options.filter=box"], "scene.file", "camera has a box filter"),
    "box filter, ptracer": (
        ["scene.options.filter=box", "integrator={type: ptracer}"], "scene.file", "camera has a box filter",
    ),
    "alpha by gather": (
        [FLOOR, NO_TRUTH, "integrator={estimator: gather, attached: true}"],
        "integrator.estimator", "use reservoir, stack",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_unsupported_attached_parameters_are_refused(case, tmp_path):
    sets, key, what = REFUSED[case]
    with pytest.raises(ConfigError) as error:
        glass.assemble(tmp_path, *sets)
    assert error.value.key == key
    assert what in error.value.message
