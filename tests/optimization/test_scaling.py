"""Units of curvature for gradient descent, and the refusal of `precondition` for a colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from optimization.toy import make_problem

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization import loop, sensitivity
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.identifiability import find_reached
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.sensitivity import measure_curvatures, scale_line
from reslrb_cli.optimization.state import standing

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "stiff" / "lamp.yaml"
TINY = ["scene.options={resx: 12, resy: 12}", "integrator.max_depth=2", "integrator.paths=light", "run.spp=32",
        "target.render.integrator.max_depth=2", "target.render.spp=256"]  # fmt: skip
LAMP = "lamp.intensity.value"
DESCENT = "optimizer={type: sgd, scale: curvature}"


def test_parameters_without_effect_are_not_scaled():
    """At depth 1, only emitters are visible, and a point emitter has no size."""
    sets = [*TINY, "integrator={estimator: gather, max_depth: 1}", "run.iterations=1", DESCENT]
    problem = replace(assemble(load(CONFIG, sets)), truth={})
    state, _ = loop.step(problem, standing(problem))
    for row in state.scaling:
        assert (row.curvature, row.first_step, row.gradient) == (None, None, 0.0)
        assert problem.optimizer.variable(row.key).gain == 1.0
        assert scale_line(row) == f"{row.key} has no effect on the image at its start; it is not scaled"


LAMP_ALONE = ["parameters=[{key: lamp.intensity.value, initial: [2e6, 4e6, 1e6]}]", "run.measuring=0", DESCENT]


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


def test_the_size_of_the_images_is_measured_once(monkeypatch):
    """The search for a step compares changes of the images with their L2 norm at the start."""
    problem, sizes, rendered = assemble(load(CONFIG, [*TINY, DESCENT])), [], []
    see_images = sensitivity.see_images

    def seen(problem, spp):
        rendered.append(spp)
        return see_images(problem, spp)

    monkeypatch.setattr(sensitivity, "see_images", seen)
    monkeypatch.setattr(sensitivity, "_steepest", lambda *given: sizes.append(given[-1]) or 0.0)
    rows = measure_curvatures(problem)
    assert rendered == [4]  # two halves of 32 / 16 samples
    expected = np.sqrt(sum(np.square(image, dtype=np.float64).sum() for image in see_images(problem, 4)))
    assert sizes == pytest.approx([expected] * len(rows), rel=1e-4)
    assert len(rows) > 1


@pytest.mark.parametrize(("rate", "ends"), [(1.0, "below"), (3.0, "above")])
def test_a_rate_of_one_converges_and_a_rate_of_three_diverges(rate, ends):
    sets = [*TINY, *LAMP_ALONE, "run.iterations=12", f"optimizer.learning_rate={rate}"]
    problem = assemble(load(CONFIG, sets))
    problem = find_reached(problem)
    losses = [record.loss for record in optimize(problem)]
    assert losses[-1] < 0.2 * losses[0] if ends == "below" else losses[-1] > losses[0]


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (0.499, 0.501), (0.0, np.inf)])
@pytest.mark.parametrize("start", ["inside", "low", "high", "mixed"])
@pytest.mark.parametrize("target", [0.1, 0.8])
def test_the_curvature_is_the_same_at_bounds(start, bounds, target, llvm, tmp_path, steps, monkeypatch):
    """The loss is quadratic, so its curvature depends neither on the start nor on the direction of the gradient."""
    problem = make_problem(tmp_path, sets=[DESCENT])
    low, high = bounds[0], min(bounds[1], 1.0)
    values = {"inside": 0.5 * (low + high), "low": low, "high": high,
              "mixed": np.where(np.arange(12).reshape(2, 2, 3) % 2, low, high)}  # fmt: skip
    problem.optimizer._bounds["albedo"] = bounds
    problem.optimizer.set_value("albedo", mi.TensorXf(np.full((2, 2, 3), values[start], np.float32)))
    problem.views[0].made = dr.full(mi.TensorXf, target, (2, 2, 3))
    problem.apply()
    monkeypatch.setattr(sensitivity, "gradient_step", loop.gradient_step)
    shown = lambda *given: dr.detach(mi.TensorXf(problem.selection.params["albedo"]))  # noqa: E731
    monkeypatch.setattr(sensitivity, "render_image", shown)
    (row,) = measure_curvatures(problem)
    assert row.curvature == pytest.approx(2 / 12, rel=0.01)
    np.testing.assert_array_equal(np.array(problem.optimizer["albedo"]), np.float32(values[start]))


@pytest.mark.parametrize(("size", "noise", "most"), [
    (1, 0.02, 4), (1, 0.6, 32), (400, 0.02, 4), (400, 0.6, 4), (400, 1.2, 16), (400, 3.0, 32),
])  # fmt: skip
def test_the_samples_of_a_curvature_follow_from_its_noise(noise, most, size, llvm, tmp_path, monkeypatch):
    """The noise of H d is `noise` / sqrt(spp). One half of a difference starts with 4 of 64 samples. In at least 18 of
    20 measurements, the curvature of 1 is within twice the tolerance, unless all samples are too few.
    """
    problem = make_problem(tmp_path, sets=[DESCENT, "run.spp=64", "run.adjoint=correlated"])
    problem.optimizer.set_value("albedo", dr.full(mi.TensorXf, 0.5, (1, 1, size)))
    problem.apply()
    curved, found, counts = np.r_[1.0, 0.5 * np.ones(size - 1)], [], []

    def gradients(problem, key, v, spp, rounds):
        counts[-1].append(spp)
        errors = [np.random.default_rng([spp, round, len(found)]).normal(size=size) for round in rounds]
        moved = np.array(v, dtype=np.float64).ravel() - 0.5
        # H d has this noise at both ends of d, with opposite signs.
        side = np.sign(moved @ np.r_[1.0, np.zeros(size - 1)]) * np.linalg.norm(moved)
        return np.array([curved * moved + side * noise / np.sqrt(spp * size) * error for error in errors])

    monkeypatch.setattr(sensitivity, "_gradients_at", gradients)
    monkeypatch.setattr(sensitivity, "see_images", lambda problem, spp: [np.array(problem.selection.params["albedo"])])
    for _ in range(20):
        counts.append([])
        problem.apply()
        start = np.r_[1.0, np.full(size - 1, 0.02)]
        size_of_image = float(np.linalg.norm(np.array(problem.selection.params["albedo"])))
        found.append(sensitivity._steepest(problem, "albedo", problem.optimizer["albedo"], start, size_of_image))
    assert np.median([max(each) for each in counts]) == most
    assert all(each == sorted(each) and each[0] == 4 for each in counts)
    if most < 32:
        close = np.abs(np.array(found) - 1) < 2 * sensitivity.TOLERANCE
        assert close.sum() >= 18


@pytest.mark.parametrize(("sets", "counts"), [
    (["run.spp=64", "run.adjoint=batched"], [4, 8, 16, 32]), (["run.spp=64", "run.adjoint=correlated"], [4, 8, 16, 32]),
    (["run.spp=16", "run.adjoint=batched"], [4, 8]), (["run.spp=12", "run.adjoint=batched"], [12]),
    (["run.spp=12", "run.adjoint=correlated"], [3, 6]), (["run.spp=3", "run.adjoint=correlated"], [3]),
])  # fmt: skip
def test_a_part_of_the_samples_has_whole_batches_and_passes(sets, counts, llvm, tmp_path):
    problem = make_problem(tmp_path, sets=[DESCENT, *sets])
    assert sensitivity._sample_counts(problem) == counts


def test_only_gradient_descent_uses_curvature():
    with pytest.raises(ConfigError, match=r"optimizer\.scale: curvature needs type: sgd"):
        load(CONFIG, ["optimizer={type: adam, scale: curvature}"])
    assert load(CONFIG, ["optimizer={type: sgd, scale: curvature}"]).optimizer.learning_rate == 0.5


def test_parameters_that_cannot_be_smoothed_are_refused_with_a_location():
    config = load(CONFIG, [*TINY, DESCENT, "parameters=[{key: lamp.intensity.value, precondition: 0.1}]"])
    with pytest.raises(ConfigError, match=r"parameters\[0\].precondition: smooths textures and heightmaps, but not"):
        assemble(config)
