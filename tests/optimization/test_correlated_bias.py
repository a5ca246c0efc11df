"""The bias of `run.adjoint: correlated`: seen where it was planted and where it is, and nowhere else."""

from __future__ import annotations

import types
from pathlib import Path

import numpy as np
import pytest

from reslrb_cli.config.loader import load
from reslrb_cli.integrators.step import cross_step, gradient_step, make_integrator, second_seed
from reslrb_cli.measure.gradients import Case, relative
from reslrb_cli.measure.scenes.small import room
from reslrb_cli.optimization import correlated_bias
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.correlated_bias import Bias, CorrelatedBias, find_bias, measure_correlated_bias
from reslrb_cli.seeds import seed

ROUNDS, ENTRIES = 8, 200
FLOOR = "floor.brdf_0.reflectance.value"


def rounds(random: np.random.Generator, gradient: np.ndarray, bias: np.ndarray, noise: float = 1.0) -> Bias:
    """What is found where gradient and bias are these, and every round has noise in each entry."""
    shape = (ROUNDS, ENTRIES)
    h = gradient + noise * random.normal(size=shape)
    d = bias + noise * random.normal(size=shape) - 0.5 * (h - gradient)  # both have the noise of h
    return find_bias("a", list(d), list(h))


@pytest.mark.parametrize("share", [-0.4, 0.3, 2.0])
def test_a_planted_bias_is_found(share: float) -> None:
    random = np.random.default_rng(3)
    gradient = random.normal(size=ENTRIES)
    found = [rounds(random, gradient, share * gradient, 0.7) for _ in range(40)]
    assert all(row.along for row in found)
    shares, errors = (np.array([getattr(row, name) for row in found]) for name in ("share", "error"))
    assert abs(shares.mean() - share) < 4 * shares.std() / np.sqrt(len(found))
    assert 0.6 < np.sqrt(np.mean(errors**2)) / shares.std() < 1.7
    assert [row.exceeds for row in found] == [abs(share) > 1] * 40


def test_none_is_found_where_there_is_none() -> None:
    random = np.random.default_rng(4)
    for size in (0.0, 0.1, 3.0):
        gradient = size * random.normal(size=ENTRIES)
        found = [rounds(random, gradient, np.zeros(ENTRIES)) for _ in range(200)]
        assert sum(row.along or row.exceeds for row in found) <= 3


def test_a_bias_is_seen_where_the_gradient_vanishes() -> None:
    random = np.random.default_rng(5)
    found = rounds(random, np.zeros(ENTRIES), np.ones(ENTRIES))
    assert (found.share, found.along, found.exceeds) == (None, False, True)
    line = CorrelatedBias(ROUNDS, 4, [found]).line()
    assert line is not None
    assert "its bias is larger than the gradient of `a` itself; `batched` has none of it" in line


def test_a_parameter_without_effect_has_none() -> None:
    nothing = [np.zeros(3)] * ROUNDS
    assert find_bias("a", nothing, nothing) == Bias("a", None, None, along=False, exceeds=False)


def test_the_line_names_the_largest() -> None:
    rows = [
        Bias("wall", -0.382, 0.061, True, False),
        Bias("rug", 0.12, 0.01, True, False),
        Bias("sofa", 0.9, 0.5, False, False),
    ]
    bias = CorrelatedBias(8, 4, rows)
    assert bias.line() == (
        "run.adjoint: correlated: at the start its bias is -38 % +- 6 % of the gradient of `wall` (1 more has one); "
        "`batched` has none of it"
    )
    assert CorrelatedBias(8, 4, rows[2:]).line() is None
    assert CorrelatedBias.from_json(bias.to_json()) == bias


@pytest.mark.parametrize("type", ["reslrb", "ptracer", "prb"])
def test_a_cross_step_is_the_step_of_its_seeds(type: str) -> None:
    import drjit as dr
    import mitsuba as mi

    scene, integrator = Case(room(), [FLOOR]), make_integrator(type, max_depth=3, rr_depth=1000)
    target = dr.full(mi.TensorXf, 0.1, scene.weights.shape)

    def objective(image: mi.TensorXf) -> mi.Float:
        return dr.mean(dr.square(image - target), axis=None)

    def gradient(adjoint: str) -> np.ndarray:
        return scene.gradient(integrator, 3, 4, objective, gradient_step, adjoint=adjoint)

    def crossed(image_seed: int, own: int) -> np.ndarray:
        def step(*arguments: object, seed: int, **options: object) -> None:
            cross_step(*arguments, image_seed=image_seed, seed=own, **options)

        return scene.gradient(integrator, 3, 4, objective, step)

    second = int(second_seed(mi.UInt32(3))[0])
    assert relative(crossed(3, 3), gradient("correlated")) < 1e-4
    assert relative(crossed(3, second), gradient("independent")) < 1e-4
    assert relative(crossed(3, second), gradient("correlated")) > 1e-3


# ---- A scene ----

SCENE = Path(__file__).resolve().parents[2] / "scenes/cornell_floor/scene.xml"
CONFIG = f"""
scene: {{file: {SCENE}, options: {{resx: 24, resy: 24}}}}
target: {{render: {{spp: 256}}}}
parameters: [{{key: floor.reflectance.data, initial: 0.5, resolution: [2, 2]}}]
integrator: {{type: reslrb, max_depth: 4, estimator: stack}}
loss: {{type: relative_l2}}
run: {{iterations: 100, spp: 16, adjoint: correlated}}
"""


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory, llvm: str):
    path = tmp_path_factory.mktemp("bias") / "a.yaml"
    path.write_text(CONFIG)
    return assemble(load(path, []))


@pytest.mark.long
def test_the_bias_of_a_scene_is_that_of_many_steps(problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measured with a quarter of the samples; compared with the bias of many steps of all of them."""
    before = problem.values()
    found = measure_correlated_bias(problem)
    assert (found.rounds, found.spp) == (8, 4)
    [row] = found.parameters
    assert row.along
    monkeypatch.setattr(correlated_bias, "PART", 1)
    monkeypatch.setattr(correlated_bias, "SHARE", 10.0)
    monkeypatch.setattr(correlated_bias, "ROUNDS", 40)
    [expected] = measure_correlated_bias(problem).parameters
    assert expected.error < row.error
    assert abs(row.share - expected.share) < 4 * np.hypot(row.error, expected.error)
    assert all(np.array_equal(value, before[key]) for key, value in problem.values().items())
    assert all(not np.any(np.array(problem.optimizer.gradient(key))) for key in problem.selection.keys)


def test_batched_has_none(problem) -> None:
    """The same statistic, of `batched` in place of `correlated`."""
    from reslrb_cli.optimization.sensitivity import take_gradient

    def gradient(number: int, adjoint: str, purpose: str) -> np.ndarray:
        problem.apply()
        gradient_step(
            problem.integrator, problem.scene, 0, problem.views[0].compare, spp=8, adjoint=adjoint,
            seed=seed(0, number, 0, purpose), params=problem.selection.params,
        )  # fmt: skip
        return take_gradient(problem)["floor.reflectance.data"]

    unbiased = [gradient(number, "independent", "a") for number in range(24)]
    for adjoint, seen in (("batched", False), ("correlated", True)):
        others = [gradient(number, adjoint, "b") for number in range(24)]
        found = find_bias("a", [a - b for a, b in zip(others, unbiased, strict=True)], unbiased)
        assert (found.along or found.exceeds) is seen


@pytest.mark.parametrize("setting", ["run.adjoint=batched", "run.adjoint=auto", "run.iterations=20"])
def test_other_runs_pay_nothing(setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.yaml").write_text(CONFIG)
    monkeypatch.setattr(correlated_bias, "cross_step", None)
    config = load(tmp_path / "a.yaml", [setting])
    assert measure_correlated_bias(types.SimpleNamespace(config=config, samples_per_pass=None)) is None
