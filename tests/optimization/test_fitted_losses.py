"""Losses that ignore brightness, with tests of values, gradients, noise and runs."""

from __future__ import annotations

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from cli.tiny import KEY, done, read_metrics, reslrb, scene_seen, settings, write_experiment
from optimization.test_losses import EPSILON, REFERENCES, images, options

from reslrb_cli.config.loader import load
from reslrb_cli.integrators.protocol import whole_of
from reslrb_cli.integrators.step import gradient_step, known_step, render_image, sample_sets
from reslrb_cli.measure.comparison import sidak
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.optimization.views import View, make_loss, slope, to_tensor

# Fitted scales, compared with double precision.


def plain_in_numpy(function, image, target, weights):
    return (weights / weights.mean() * function(image, target)).mean()


def fitted_in_numpy(function, image, target, weights):
    scale = (weights * image * target).sum() / (weights * image**2).sum()
    return plain_in_numpy(function, scale * image, target, weights)


def view_of(name, target, weights):
    view = View(0, make_loss(name, **options(name)), fits=True)
    view.see(target.astype(np.float32), weights)
    return view


@pytest.mark.parametrize("fits", [True, False, "across"])
@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("name", REFERENCES)
def test_scaled_losses_and_gradients_match_finite_differences(name, masked, fits):
    image, target = images((6, 7, 3))
    image, target = 3 * image + 0.1, target + 0.1
    weights = np.ones((6, 7))
    if masked:
        weights[1:4, 2], weights[0, 5:], weights[4:, 0] = 0, 0.5, 0
    view = view_of(name, target, weights)
    view.fits, view.across = bool(fits), fits == "across"
    full = np.broadcast_to(weights[:, :, None], image.shape)
    of = fitted_in_numpy if fits else plain_in_numpy
    given = np.where(full > 0, image, np.nan).astype(np.float32)
    leaf = mi.TensorXf(given)
    dr.enable_grad(leaf)
    loss = view.objective(leaf)
    assert float(loss[0]) == pytest.approx(of(REFERENCES[name][0], image, target, full), rel=1e-5)
    dr.backward(loss)
    found, expected = np.array(leaf.grad), np.zeros(image.shape)
    for place in np.ndindex(image.shape):
        step = np.zeros(image.shape)
        step[place] = 1e-6
        up, down = (of(REFERENCES[name][0], image + side * step, target, full) for side in (1, -1))
        expected[place] = (up - down) / 2e-6
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=5e-3 * np.abs(expected).max() * 0.1)


@pytest.mark.parametrize("name", REFERENCES)
def test_a_fitted_loss_ignores_brightness(name):
    image, target = images((6, 7, 3))
    view = view_of(name, target, None)
    once, thrice = (view.objective(mi.TensorXf((k * image).astype(np.float32)))[0] for k in (1, 3))
    assert once == pytest.approx(thrice, rel=1e-5)
    leaf = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(leaf)
    dr.backward(view.objective(leaf))
    along, size = (np.array(leaf.grad) * image).sum(), np.abs(np.array(leaf.grad) * image).sum()
    assert abs(along) < 1e-5 * size


# Effect of noise on fitted gradients and scales.


def slopes_along(view, images, directions):
    """Return dL/dI of noisy images (N, 2, H, W, C) along directions (K, H, W, C), with the shape (N, K)."""
    found = [slope(view.objective, pair).reshape(-1, *directions.shape[1:]).sum(axis=0) for pair in images]
    return np.einsum("nhwc,khwc->nk", np.array(found, dtype=np.float64), directions)


@pytest.mark.parametrize("name", ["l2", "relative_l2"])
def test_noise_leaves_a_fitted_gradient_unbiased(name):
    """The mean of dL/dI over noisy halves equals dL/dI of the noise-free image. With one image in place of halves,
    noise biases dL/dI.
    """
    rng = np.random.default_rng(4)
    image, target = (each + 0.3 for each in images((24, 24, 1)))
    view = view_of(name, target, None)
    directions = image * np.stack([np.cos(k * np.arange(24) / 8)[:, None, None] for k in range(1, 7)])
    expected = slopes_along(view, image[None], directions)[0]
    noisy = image * rng.gamma(4, 0.25, (400, 2, *image.shape))

    def z_of(rows):
        return np.abs(rows.mean(axis=0) - expected) / (rows.std(axis=0) / len(rows) ** 0.5)

    assert z_of(slopes_along(view, noisy, directions)).max() < sidak(6)
    assert z_of(slopes_along(view, noisy.mean(axis=1), directions)).max() > 2 * sidak(6)


@pytest.mark.parametrize("size", [8, 32])
def test_the_bias_of_the_scale_matches_the_docs(size):
    """Let v be the relative variance of a half's n pixels. Then s is too large by 2 v / n to 3 v / n. From one image, s
    would be too small by v / (2 + v).
    """
    rng, noise = np.random.default_rng(5), 0.25
    image = rng.uniform(0.3, 2, (size, size, 1))
    view = view_of("l2", image, None)
    found = [view.scale(to_tensor(image * rng.gamma(1 / noise, noise, (2, *image.shape)))) for _ in range(600)]
    error = np.std(found) / len(found) ** 0.5
    assert abs(np.mean(found) - 1) < 5 * noise / size**2 + 3 * error
    alone = view.scale(to_tensor(image * rng.gamma(1 / noise, noise, (2, *image.shape)).mean(axis=0)))
    assert alone < 1 - 0.3 * noise


# Steps and runs.


@pytest.fixture
def folder(tmp_path):
    write_experiment(tmp_path)
    return tmp_path


def make(folder, *sets):
    problem = assemble(load(folder / "tiny.yaml", ["loss.scale=fitted", *sets]))
    rng = np.random.default_rng(6)
    problem.selection.set_arrays({KEY: rng.uniform(0.3, 0.7, problem.selection.array(KEY).shape).astype(np.float32)})
    return problem.afresh(problem.values())


@pytest.mark.parametrize("name", ["l2", "l1", "relative_l2"])
@pytest.mark.parametrize("fits", ["fitted", "none"])
def test_a_rendered_parameter_at_equal_seeds(folder, name, fits):
    epsilon = f", epsilon: {EPSILON}" if name == "relative_l2" else ""
    problem = make(folder, f"loss={{type: {name}{epsilon}, scale: {fits}}}", "run.adjoint=correlated")
    [view], base = problem.views, problem.selection.array(KEY)
    direction = np.random.default_rng(7).uniform(-1, 1, base.shape).astype(np.float32)
    problem.apply()
    gradient_step(
        problem.integrator, problem.scene, 0, view.objective, seed=3, spp=64, adjoint="correlated",
        params=problem.selection.params,
    )  # fmt: skip
    found = float((take_gradient(problem)[KEY] * direction.ravel()).sum())
    sides = []
    for side in (1, -1):
        problem.selection.set_arrays({KEY: base + side * 0.1 * direction})
        sides.append(np.array(render_image(problem.integrator, problem.scene, 0, 3, 64), dtype=np.float64))
    image, change = 0.5 * (sides[0] + sides[1]), (sides[0] - sides[1]) / 0.2  # linear, because light scatters once
    target, weights = np.array(view.target, dtype=np.float64), np.ones(image.shape)
    of = fitted_in_numpy if fits == "fitted" else plain_in_numpy
    up, down = (of(REFERENCES[name][0], image + side * 1e-6 * change, target, weights) for side in (1, -1))
    assert found == pytest.approx((up - down) / 2e-6, rel=5e-3)


@pytest.mark.parametrize("adjoint", ["batched", "independent", "correlated"])
def test_a_step_is_unbiased_through_halves(folder, adjoint):
    problem = make(folder, f"run.adjoint={adjoint}", "run.spp=32")
    [view] = problem.views
    image = problem.render(0, 2**16, 0, "mean image")
    gradient = to_tensor(slope(view.objective, image))
    problem.apply()
    rows, expected = [], []
    for number in range(100):
        sample_gradient(problem, problem.integrator, number, "test", 32)
        rows.append(take_gradient(problem)[KEY])
        known_step(
            problem.integrator,
            problem.scene,
            0,
            gradient,
            seed=10**6 + number,
            spp=256,
            params=problem.selection.params,
        )
        expected.append(take_gradient(problem)[KEY])
    assert compare(np.array(rows), np.array(expected), block=None)


@pytest.mark.parametrize(("type", "adjoint"), [
    ("reslrb", "batched"), ("reslrb", "independent"),
    ("reslrb", "correlated"), ("walk_ad", "correlated"), ("ptracer", "correlated"),
])  # fmt: skip
def test_halves_are_the_samples_of_a_step(folder, type, adjoint):
    """For a loss that depends only on the image, gradients of a step with halves agree with gradients of any other
    step.
    """
    problem = make(folder, f"integrator={{type: {type}, max_depth: 3}}", "loss.scale=none")
    [view], rows, images = problem.views, {True: [], False: []}, []
    problem.apply()
    for halves, found in rows.items():
        for number in range(24):
            step = gradient_step(
                problem.integrator, problem.scene, 0, view.objective, seed=number + 100 * halves, spp=64,
                adjoint=adjoint, params=problem.selection.params, halves=halves,
            )  # fmt: skip
            found.append(take_gradient(problem)[KEY])
            images.append(np.array(step.image))
    assert {image.shape for image in images} == {(8, 8, 3)}
    assert compare(np.array(rows[True]), np.array(rows[False]), block=None)


def test_a_run_is_resumed_to_the_same_end(folder, monkeypatch):
    monkeypatch.chdir(folder)
    sets = settings("loss.scale=fitted", "run.spp=32", "optimizer.learning_rate=0.1")
    done("optimize", "tiny.yaml", *sets, "--set", "run.name=whole")
    done("optimize", "tiny.yaml", *sets, "--set", "run.name=parts", "--set", "run.iterations=3")
    done("optimize", "--resume", "runs/parts", "--set", "run.iterations=5")
    whole, parts = (read_metrics(f"runs/{name}") for name in ("whole", "parts"))
    assert [line["loss"] for line in whole] == [line["loss"] for line in parts]
    results = json.loads((folder / "runs/whole/manifest.json").read_text())["results"]
    assert results["fitted_scale"]["0"] > 0
    assert results["image_loss"]["final"] < results["image_loss"]["initial"]


@pytest.mark.parametrize(("sets", "line"), [
    (["loss.scale=fitted", "target.exposure=auto"], "loss.scale: cannot be fitted while target.exposure"),
    (["loss.scale=fitted", "run.spp=3"], "run.spp: must be a multiple of 2"),
    (["loss.scale=fitted", "run.spp=4", "run.adjoint=batched"], "run.spp: must be a multiple of 8"),
])  # fmt: skip
def test_impossible_settings_are_refused_in_one_line(folder, sets, line):
    result = reslrb("optimize", folder / "tiny.yaml", *settings(*sets))
    assert result.exit_code == 2
    assert line in result.output.splitlines()[-1]


def test_unused_options_are_not_written(folder):
    config = load(folder / "tiny.yaml", [])
    assert config.model_dump()["loss"] == {"type": "l2"}
    assert "halves" not in config.step_options()
    assert load(folder / "tiny.yaml", ["loss.scale=fitted", "run.spp=8"]).step_options()["halves"] is True


def test_a_whole_image_is_the_mean_of_its_halves():
    image = np.arange(24, dtype=np.float32).reshape(2, 2, 2, 3)
    np.testing.assert_array_equal(np.array(whole_of(to_tensor(image))), image.mean(axis=0))


def test_each_view_including_held_out_ones_has_its_own_factor(folder):
    """Light is scattered once, so that half the reflectance gives half the image. No loss detects this change."""
    write_experiment(folder, scene_seen("0, 0, 4", "1, 0, 4"))
    problem = make(folder, "views=[{sensor: 0}, {sensor: 1}]", "run.held_out=[1]", "run.spp=16")
    values, found = problem.values(), []
    for factor in (1.0, 0.5):
        problem.selection.set_arrays({KEY: np.float32(factor) * values[KEY]})
        scales = [view.scale(problem.see(view, 256, 0, "test")) for view in problem.views]
        found.append([problem.held_out_loss(), *scales])
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-4)
    np.testing.assert_allclose(np.array(found[1][1:]), 2 * np.array(found[0][1:]), rtol=1e-4)


def test_a_measuring_run_uses_halves(folder, monkeypatch):
    monkeypatch.chdir(folder)
    done("optimize", "tiny.yaml", *settings(
        "loss.scale=fitted", "run.spp=16", "run.iterations=4", "run.measuring=1", "integrator.guiding=auto",
    ))  # fmt: skip
    assert len(read_metrics("runs/tiny")) == 4


@pytest.mark.parametrize("adjoint", ["batched", "independent", "correlated"])
def test_sample_sets_match_the_halves_of_a_step(folder, adjoint):
    problem = make(folder, f"run.adjoint={adjoint}", "run.spp=16")
    [view], given = problem.views, problem.config.step_options()
    problem.apply()
    step = gradient_step(
        problem.integrator, problem.scene, 0, view.objective, seed=3, params=problem.selection.params, **given
    )
    take_gradient(problem)
    sets = sample_sets(3, given)
    assert [spp for _, _, spp in sets] == [problem.config.set_spp] * len(sets)
    rendered = [np.array(render_image(problem.integrator, problem.scene, 0, int(at[0]), spp)) for _, at, spp in sets]
    expected = np.mean(rendered if adjoint == "batched" else rendered[:2], axis=0)
    np.testing.assert_allclose(np.array(step.image), expected, rtol=1e-4, atol=1e-5)
