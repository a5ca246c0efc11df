"""Measured sensitivities, the units derived from them, and their effect on a stiff problem."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.identifiability import find_reached
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.sensitivity import (
    measure_curvatures,
    measure_sensitivities,
    own_length,
    rescale,
    scale_line,
)
from reslrb_cli.optimization.state import standing
from reslrb_cli.optimization.variables import Variable, make_transform
from reslrb_cli.records.decisions import Scaled

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "stiff" / "lamp.yaml"
TINY = ["scene.options={resx: 12, resy: 12}", "integrator.max_depth=2", "integrator.paths=light", "run.spp=32",
        "target.render.integrator.max_depth=2", "target.render.spp=256"]  # fmt: skip
FLOOR, LAMP = "floor.reflectance.value", "lamp.intensity.value"


def measured(*sets, samples=4):
    return {row.key: row for row in measure_sensitivities(assemble(load(CONFIG, [*TINY, *sets])), samples)}


def relative_errors(problem):
    truth = problem.truth
    return [np.linalg.norm(problem.selection.array(key) - truth[key]) / np.linalg.norm(truth[key]) for key in truth]


def test_a_planted_ratio_is_found():
    """A lamp has values and light a million times as large. Relative to the image, its sensitivity per unit falls by a
    million, and the floor's sensitivity stays.
    """
    before = measured()
    after = measured("parameters[1].initial=3e12", f"target.render.parameters.{LAMP}=[1.2e13, 1.0e13, 0.6e13]")
    assert before[LAMP].change / after[LAMP].change == pytest.approx(1e6, rel=1e-3)
    assert after[LAMP].length / before[LAMP].length == pytest.approx(1e6, rel=1e-3)
    # The loss grows with the square of the image
    assert after[LAMP].gradient / before[LAMP].gradient == pytest.approx(1e6, rel=1e-3)
    assert after[FLOOR].gradient / before[FLOOR].gradient == pytest.approx(1e12, rel=1e-3)
    assert after[FLOOR].change == pytest.approx(before[FLOOR].change, rel=1e-3)
    assert after[FLOOR].length == pytest.approx(before[FLOOR].length, rel=1e-3)


def test_the_length_of_a_single_lamp_is_its_intensity():
    found = measured("parameters[1].initial=1e7", f"target.render.parameters.{LAMP}=1e7",
                     f"target.render.parameters.{FLOOR}=0.5", "run.spp=512")  # fmt: skip
    assert found[LAMP].length == pytest.approx(1e7, rel=0.05)
    assert found[LAMP].change == pytest.approx(1e-7, rel=0.05)
    assert (found[LAMP].entries, found[LAMP].value) == (3, 1e7)
    # In a part of the image, direct light is proportional to the albedo of the surface that it hits
    assert found[FLOOR].length == pytest.approx(0.5, rel=0.05)
    assert found[FLOOR].change < 1 / 0.5


@pytest.mark.parametrize("start", [1e6, 4e7])
def test_a_length_uses_the_brighter_of_image_and_target(start):
    found = measured(f"parameters[1].initial={start:g}", f"target.render.parameters.{LAMP}=1e7",
                     f"target.render.parameters.{FLOOR}=0.5", "run.spp=512")  # fmt: skip
    assert found[LAMP].length == pytest.approx(max(start, 1e7), rel=0.05)


def test_noise_belongs_to_one_step():
    few, many = measured(samples=16), measured("run.spp=512", samples=16)
    for key in (FLOOR, LAMP):
        assert few[key].noise / many[key].noise == pytest.approx(4, rel=0.5)


def test_measuring_changes_nothing():
    problem = assemble(load(CONFIG, TINY))
    before = problem.values()
    measure_sensitivities(problem, 2)
    for key, value in before.items():
        np.testing.assert_array_equal(problem.selection.array(key), value)
        assert not np.array(problem.optimizer.gradient(key)).any()


def test_parameters_without_effect_are_not_scaled():
    """At depth 1, only emitters are visible, and a point emitter has no size."""
    problem = assemble(load(CONFIG, [*TINY, "integrator={estimator: gather, max_depth: 1}", "run.iterations=1"]))
    problem = replace(problem, truth={})
    state, _ = loop.step(problem, standing(problem))
    for row in state.scaling:
        assert (row.change, row.length, row.gradient) == (None, None, 0.0)
        assert problem.optimizer.variable(row.key).length == 1.0


def test_own_lengths():
    value = mi.Color3f(0.5, 1.0, 4.0)
    assert own_length(None, None, value, 3.0) == 3.0
    assert own_length(make_transform("log", None), None, value, 3.0) == pytest.approx(
        np.mean(np.log1p(3 / np.array([0.5, 1, 4]))), rel=1e-5
    )
    sigmoid = make_transform("sigmoid", (0.0, 1.0))
    for x, length, moved in ((0.5, 0.1, 0.6), (0.2, 5.0, 0.6), (0.9, 5.0, 0.45), (0.9, 0.1, 0.8)):
        expected = abs(np.log(moved / (1 - moved)) - np.log(x / (1 - x)))
        assert own_length(sigmoid, (0.0, 1.0), mi.Float(x), length) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("type", ["adam", "sgd"])
def test_in_its_own_units_no_scale_remains(type):
    """The same problem in units of 1e6 and 1, and with its loss times 1e-12, takes equal steps in spite of
    `epsilon`.
    """

    def descend(unit, loss):
        optimizer = Optimizer(type, 0.02, {}, {"p": mi.TensorXf(np.array([0.3, 0.7], np.float32) * unit)},
                              {"p": None}, {"p": None})  # fmt: skip
        optimizer.set_variable("p", Variable(None, None, unit, gain=1 / (loss / unit) / unit))
        for _ in range(20):
            dr.backward(dr.sum(dr.square(optimizer["p"] / unit - 0.9) * loss, axis=None))
            optimizer.step(1.0)
        return np.array(optimizer["p"]) / unit

    expected = descend(1.0, 1.0)
    assert (np.abs(expected - 0.9) < np.abs(np.array([0.3, 0.7]) - 0.9)).all()
    np.testing.assert_allclose(descend(1e6, 1.0), expected, rtol=1e-4)
    np.testing.assert_allclose(descend(1.0, 1e-12), expected, rtol=1e-4)


@pytest.mark.long
def test_a_stiff_problem_is_solved_with_one_learning_rate():
    """An albedo is recovered together with an intensity of 1e7. The error is below a tenth of that of plain Adam at its
    best learning rate.
    """

    def error(*sets):
        problem = assemble(load(CONFIG, [*TINY, "run.iterations=100", "run.spp=16", "run.adjoint=independent", *sets]))
        problem = find_reached(problem)
        records = list(optimize(problem))
        assert len(records) == 100
        return np.sqrt(np.mean(np.square(relative_errors(problem))))

    plain = [error("optimizer.scale=none", f"optimizer.learning_rate={rate:g}")
             for rate in (0.003, 0.03, 0.3, 30, 3e3, 3e5, 3e6)]  # fmt: skip
    assert error("optimizer.learning_rate=0.1") < 0.1 * min(plain)


@pytest.mark.parametrize(
    "transforms",
    [("none", "none"), ("sigmoid", "log")],
)
def test_the_optimiser_gets_gradients_of_order_one(transforms):
    sets = [f"parameters[{i}].transform={name}" for i, name in enumerate(transforms)]
    problem = assemble(load(CONFIG, [*TINY, *sets]))
    for row in rescale(problem):
        variable, value = problem.optimizer.variable(row.key), dr.detach(problem.optimizer[row.key])
        handed = variable.chain(variable.from_scene(value), type(value)(np.hypot(row.gradient, row.noise)))
        assert np.sqrt(np.mean(np.square(np.array(handed)))) == pytest.approx(1, rel=1e-4)
        if variable.transform is None:
            assert variable.length == row.length
        np.testing.assert_allclose(problem.selection.array(row.key), row.value, rtol=1e-6)


@pytest.mark.parametrize("transform", a_few(["none", "sigmoid", "log"], ["none", "log"]))
def test_the_first_step_matches_the_printed_line(transform):
    """Adam's first step is one learning rate in the variable that Adam moves."""
    sets = [f"parameters[1].transform={transform}", "parameters[1].bounds=[0, 1e8]", "run.iterations=1"]
    problem = assemble(load(CONFIG, [*TINY, *sets]))
    problem = replace(problem, truth={})
    before = problem.selection.array(LAMP)
    state, _ = loop.step(problem, standing(problem))
    moved = problem.selection.array(LAMP) / before
    row = next(row for row in state.scaling if row.key == LAMP)
    step = float(scale_line(row).partition("moves by about ")[2].removesuffix(" at first"))
    # The line reports the larger of the changes up and down
    assert np.all(np.abs(moved - 1) * before <= 1.01 * step)
    assert np.abs((moved - 1) * before).max() > 0.7 * step
    if transform == "none":
        rate = problem.config.optimizer.learning_rate
        assert (row.own_length, step) == (row.length, pytest.approx(rate * row.length, rel=0.01))


def test_the_line_of_an_unscaled_parameter_gives_the_reason():
    row = Scaled("lamp.intensity.value", 3, 1.0, 0.0, 0.0)
    assert scale_line(row) == "lamp.intensity.value has no effect on the image at its start; it is not scaled"
    row = Scaled("lamp.intensity.value", 3, 1.0, 0.0, 0.0, change=1.0, length=1.0)
    assert "no gradient" in scale_line(row)


# --- units of curvature -----------------------------------------------------------------------------------------------

LAMP_ALONE = ["parameters=[{key: lamp.intensity.value, initial: [2e6, 4e6, 1e6]}]", "run.measuring=0",
              "optimizer={type: sgd, scale: curvature}"]  # fmt: skip


def test_the_curvature_of_a_lamp_matches_its_image():
    """The image is I_c = x_c a_c. The mean of (I - T)^2 therefore has the curvature 2 mean(a_c^2) / 3 along
    channel c.
    """
    problem = assemble(load(CONFIG, [*TINY, *LAMP_ALONE]))
    x = problem.selection.array(LAMP).astype(np.float64)
    before = np.array(problem.optimizer[LAMP])
    (row,) = measure_curvatures(problem)
    a = np.array(problem.render(0, 512, 0, "test"), dtype=np.float64) / x
    assert row.curvature == pytest.approx(2 * np.mean(a**2, axis=(0, 1)).max() / 3, rel=0.1)
    np.testing.assert_array_equal(np.array(problem.optimizer[LAMP]), before)
    assert scale_line(row) == f"{LAMP} moves by about {row.first_step:.3g} at first"


@pytest.mark.parametrize(("rate", "ends"), [(1.0, "below"), (3.0, "above")])
def test_a_rate_of_one_converges_and_a_rate_of_three_diverges(rate, ends):
    sets = [*TINY, *LAMP_ALONE, "run.iterations=12", f"optimizer.learning_rate={rate}"]
    problem = assemble(load(CONFIG, sets))
    problem = find_reached(problem)
    losses = [record.loss for record in optimize(problem)]
    assert losses[-1] < 0.2 * losses[0] if ends == "below" else losses[-1] > losses[0]


def test_only_gradient_descent_uses_curvature():
    with pytest.raises(ConfigError, match=r"optimizer\.scale: curvature needs type: sgd"):
        load(CONFIG, ["optimizer={type: adam, scale: curvature}"])
    assert load(CONFIG, ["optimizer={type: sgd, scale: curvature}"]).optimizer.learning_rate == 0.5


def test_parameters_that_cannot_be_smoothed_are_refused_with_a_location():
    config = load(CONFIG, [*TINY, "parameters=[{key: lamp.intensity.value, precondition: 0.1}]"])
    with pytest.raises(ConfigError, match=r"parameters\[0\].precondition: smooths textures and heightmaps, but not"):
        assemble(config)
