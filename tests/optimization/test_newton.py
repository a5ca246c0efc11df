"""Steps from measured curvature (`optimizer: auto`)."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import KEY, manifest, write_experiment
from optimization.toy import make_problem
from runs.going_on import begin_alone, optimize
from scipy.optimize import lsq_linear

from reslrb_cli.backend.memory import flat
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization import loop, optimizers, sensitivity
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.block import SHIFT, Block, JointState
from reslrb_cli.optimization.newton import LONGEST, _steepness, fine_part
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.state import guiding_of, standing
from reslrb_cli.optimization.uncertainty.curvature import lower_eigenvalues, raise_eigenvalues
from reslrb_cli.optimization.variables import make_transform

AUTO = "optimizer={type: auto}"
CONFIGS = Path(__file__).parents[2] / "configs"
#: The loss sum of a_i / 2 (p_i - b_i)^2.
MANY = np.array([3.0, 0.5, 20.0, 1.0, 8.0, 2.0]), np.array([0.9, 0.1, 0.4, 0.7, 0.2, 0.6])
#: A loss that bends 20 times more along p + q than along p - q: its curvature, and the optimum.
VALLEY, BEST = np.array([[21.0, 19.0], [19.0, 21.0]]), np.array([0.3, 0.6])

#: Texels of a dark floor.
DARK = np.linspace(0.2, 0.4, 16)


def make(values, bounds=(0.0, 1.0), transforms=None) -> Optimizer:
    tensors = {key: mi.TensorXf(value.astype(np.float32)) for key, value in values.items()}
    same = dict.fromkeys(tensors)
    return Optimizer("auto", 1.0, {}, tensors, same, dict.fromkeys(tensors, bounds), transforms)


def accumulate(optimizer, key, gradient):
    """Add a gradient, with the number of entries of the parameter, to the accumulated gradient."""
    given = mi.TensorXf(np.reshape(gradient, dr.shape(optimizer[key])).astype(np.float32))
    dr.backward(dr.sum(flat(optimizer[key]) * given.array))


def pull(optimizer, losses):
    """Accumulate the gradients of `losses` at the current values, and return them."""
    found = {}
    for key, (curvature, best) in losses.items():
        optimizer.clear_gradient(key)
        gradient = curvature * (np.array(optimizer[key], dtype=np.float64) - best)
        accumulate(optimizer, key, gradient)
        found[key] = gradient
    return found


def measure(optimizer, losses, seed=0):
    with optimizer.displaced(np.random.default_rng(seed)):
        pull(optimizer, losses)


def descend_many(iterations, noise=0.0, loss_unit=1.0, unit=1.0, seed=2):
    """Minimise the loss `MANY` from 0.5, with gradients that have `noise`. Loss and values can have other units.
    Returns the distances to the optimum by iteration (N, 6).
    """
    curvature, best = MANY
    loss = loss_unit / unit**2 * curvature, unit * best
    optimizer = make({"p": np.full(best.shape, 0.5 * unit)}, (-10 * unit, 10 * unit))
    random, found = np.random.default_rng(seed), []
    for iteration in range(iterations):
        pull(optimizer, {"p": loss})
        if iteration == 0:
            measure(optimizer, {"p": loss})
        accumulate(optimizer, "p", loss_unit / unit * noise * random.normal(size=best.shape))
        optimizer.step(1.0)
        found.append(np.array(optimizer["p"], dtype=np.float64) / unit - best)
    return np.array(found)


@pytest.mark.parametrize(("loss_unit", "unit"), [(1.0, 1.0), (1e-6, 1.0), (1e6, 1.0), (1.0, 1e3), (1e4, 1e-3)])
def test_a_quadratic_with_a_known_optimum_is_solved_in_any_unit(loss_unit, unit):
    """The curvatures of the entries differ by a factor of 40. No entry moves away from the optimum."""
    start, found = np.abs(0.5 - MANY[1]), np.abs(descend_many(40, loss_unit=loss_unit, unit=unit))
    assert (found < 1.05 * start).all()
    assert found[4].max() < 0.1
    assert found[12].max() < 0.02
    assert found[-1].max() < 2e-3
    np.testing.assert_allclose(found, np.abs(descend_many(40)), atol=1e-5)


def test_noise_averages_out():
    """The mean of N gradients has the error sigma / (a sqrt(N))."""
    noise, N = np.array([0.3, 0.0, 0.1, 1.0, 0.0, 0.5]), 200
    found = np.array([descend_many(N, noise, seed=seed)[-1] for seed in range(6)])
    noisy = noise > 0
    ratios = np.sqrt(np.mean(found[:, noisy] ** 2, axis=0)) / (noise / MANY[0] / np.sqrt(N))[noisy]
    assert ratios.max() < 3, ratios
    assert np.abs(found[:, ~noisy]).max() < 1e-4


def test_a_measurement_leaves_values_and_gradients_as_they_were():
    optimizer = make({"inside": np.full(6, 0.5), "outside": np.array([0.0, 1.0] * 3)})  # at the bounds
    losses = {"inside": MANY, "outside": MANY}
    pull(optimizer, losses)
    before = {key: (np.array(optimizer[key]), np.array(optimizer.gradient(key))) for key in losses}
    for seed in (0, 1):
        measure(optimizer, losses, seed)
        for key, (value, gradient) in before.items():
            np.testing.assert_array_equal(np.array(optimizer[key]), value)
            np.testing.assert_array_equal(np.array(optimizer.gradient(key)), gradient)
            bent = optimizer.moments()[key]["3"]
            np.testing.assert_allclose(np.array(bent).ravel(), losses[key][0], rtol=1e-3)


def test_a_measurement_adds_nothing_to_the_gradients_of_small_parameters():
    optimizer = make({"large": MANY[1], "small": np.full(1, 0.5), "positive": np.full(1, 0.5)}, transforms={
        "large": None, "small": None, "positive": make_transform("log", (0.0, 1.0))})  # fmt: skip
    keys, found = optimizer.keys(), []
    for within in (contextlib.nullcontext(), optimizer.displaced(np.random.default_rng(0))):
        with within:
            dr.backward(sum(dr.sum(dr.square(optimizer[key]), axis=None) for key in keys))
        found.append([np.array(optimizer.gradient(key)) for key in keys])
    for before, after in zip(*found, strict=True):
        np.testing.assert_array_equal(before, after)


def test_curvature_of_a_transformed_value_is_that_of_its_variable():
    """The loss is a quadratic of x = exp(u), far from the minimum. d2L/du2 = a x (2 x - b)."""
    curvature, best = np.full(6, 2.0), np.full(6, 10.0)
    optimizer = make({"p": np.full(6, 30.0)}, (0.0, np.inf), {"p": make_transform("log", (0.0, np.inf))})
    pull(optimizer, {"p": (curvature, best)})
    measure(optimizer, {"p": (curvature, best)})
    assert float(np.array(optimizer.moments()["p"]["3"]).ravel()[0]) == pytest.approx(2 * 30 * (60 - 10), rel=0.15)


def test_where_the_loss_is_not_convex_a_step_goes_downhill():
    optimizer, loss = make({"p": np.full(6, 0.5)}), (np.full(6, -4.0), np.full(6, 0.45))
    pull(optimizer, {"p": loss})
    measure(optimizer, {"p": loss})
    optimizer.step(1.0)
    assert float(np.array(optimizer["p"])[0]) > 0.51


def test_the_curvature_of_texels_that_share_a_pixel_is_that_of_moving_together():
    """Each texel has a curvature of 6. Forty texels of one pixel that move together have 201, and need short steps."""
    optimizer, shared = make({"p": np.full(40, 0.2)}), np.full((40, 40), 5.0) + np.eye(40)

    def pull_all():
        optimizer.clear_gradient("p")
        gradient = shared @ (np.array(optimizer["p"], dtype=np.float64) - 0.6)
        accumulate(optimizer, "p", gradient)

    pull_all()
    with optimizer.displaced(np.random.default_rng(0)):
        pull_all()
    np.testing.assert_allclose(np.array(optimizer.moments()["p"]["3"]).ravel(), 201, rtol=1e-3)


def in_the_valley(start, noise=0.0, bounds=(-2.0, 2.0), size=1.0, iterations=30, bright=(), rare=0.0, seed=5):
    """Move two parameters along `VALLEY`. The measured curvature is `size` times the true one. The gradients of the
    iterations `bright` are 1,000 times as large. One gradient in 20 is larger by `rare`, and the others are smaller, so
    that their mean is the same. Returns the values and the limits of the distance by iteration.
    """
    optimizer, random = make({"p": start[:1], "q": start[1:]}, bounds), np.random.default_rng(seed)
    optimizer.block.bend(size * VALLEY)
    values, limits = [], []
    for iteration in range(iterations):
        x = np.array([float(np.array(optimizer[key])[0]) for key in ("p", "q")])
        gradients = VALLEY @ (x - BEST) + noise * random.normal(size=2)
        gradients *= 1000.0 if iteration in bright else 1.0
        gradients += rare * ((random.random() < 0.05) - 0.05) if rare else 0.0
        for key, gradient in zip(("p", "q"), gradients, strict=True):
            optimizer.clear_gradient(key)
            # As a literal, each gradient would compile a kernel.
            dr.backward(dr.sum(optimizer[key] * dr.opaque(mi.Float, float(gradient)), axis=None))
        optimizer.step(1.0)
        values.append([float(np.array(optimizer[key])[0]) for key in ("p", "q")])
        limits.append([optimizer.to_go(key) * optimizer.extent(key) for key in ("p", "q")])
    return np.array(values), np.array(limits)


def test_small_parameters_that_compensate_for_each_other_move_together():
    values, limits = in_the_valley(np.array([0.9, 0.9]))
    np.testing.assert_allclose(values[7], BEST, atol=0.02)
    np.testing.assert_allclose(values[-1], BEST, atol=1e-3)
    assert limits[-1].max() < 0.01


def test_distrust_halves_the_number_of_gradients_in_the_mean():
    block = Block({"p": 1, "q": 1})
    block.rows[:, 6] = 5
    for expected in (2.5, 1.25, 1.0):
        block.distrust()
        assert block.averaged == expected


def test_a_rare_bright_sample_does_not_move_the_values_far():
    values, _ = in_the_valley(np.array([0.9, 0.9]), noise=0.1, bright=(12, 24), iterations=60)
    assert np.abs(values[12:] - BEST).max() < 0.6
    np.testing.assert_allclose(values[-1], BEST, atol=0.05)


@pytest.mark.parametrize("size", [0.6, 1.7])
def test_a_measured_curvature_that_is_wrong_does_not_stop_the_run(size):
    values, _ = in_the_valley(np.array([0.9, 0.9]), size=size)
    np.testing.assert_allclose(values[-1], BEST, atol=0.02)


@pytest.mark.long
def test_the_limit_of_the_distance_along_a_valley_holds_under_noise():
    """Most of the noise moves the values along the valley. The limit has a confidence of 85 %."""
    first, last, covered = [], [], []
    for seed in range(8):
        values, limits = in_the_valley(np.array([0.9, 0.9]), noise=1.0, iterations=300, seed=seed)
        errors = np.abs(values - BEST)[50:]
        first.append(errors[:50].max())
        last.append(errors[-50:].max())
        covered.append(np.mean(errors < limits[50:]))
    assert np.mean(last) < 0.5 * np.mean(first)
    assert np.mean(covered) > 0.75, covered


@pytest.mark.parametrize("rare", [3.0, 60.0])
def test_the_limit_of_the_distance_holds_if_few_gradients_have_most_of_the_noise(rare):
    """The limit has a confidence of 85 %. A gradient of 60 is longer than the longest step."""
    covered = []
    for seed in range(4):
        values, limits = in_the_valley(np.array([0.9, 0.9]), noise=0.02, rare=rare, iterations=300, seed=seed)
        covered.append(np.mean(np.abs(values - BEST)[100:] < limits[100:]))
    assert np.mean(covered) > 0.75, covered


def test_a_value_at_its_bound_does_not_lead_the_others_astray():
    """The optimum of q is beyond its bound. The best p is then that of the bound."""
    values, _ = in_the_valley(np.array([0.9, 0.2]), bounds=(-2.0, 0.5))
    best = BEST[0] + VALLEY[0, 1] / VALLEY[0, 0] * (BEST[1] - 0.5)
    np.testing.assert_allclose(values[-1], [best, 0.5], atol=5e-3)


def gap_beyond_bounds(seed: int, iterations: int, size: int = 20) -> float:
    """Return the gap between the loss and its smallest value within the bounds, relative to the first gap. A quadratic
    loss has its optimum beyond some bounds. Its condition is 300.
    """
    random = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(random.normal(size=(size, size)))
    units = np.exp(random.normal(size=size))
    H = (turn * np.geomspace(1, 1 / 300, size)) @ turn.T * np.outer(units, units)
    best = random.uniform(0.1, 0.9, size)
    beyond = random.random(size) < 0.2
    best[beyond] += random.choice([-1, 1], beyond.sum()) * random.uniform(0.2, 1.5, beyond.sum())
    root = np.linalg.cholesky(H).T
    within = lsq_linear(root, root @ best, bounds=(0, 1)).x
    smallest, *losses = (0.5 * float(np.sum(np.square(root @ (x - best)))) for x in (within, np.full(size, 0.5)))
    block, value = Block({str(at): 1 for at in range(size)}), np.full(size, 0.5)
    block.bend(H)
    for _ in range(iterations):
        now = JointState(value, H @ (value - best), np.full(size, 0.25), np.zeros(size), np.ones(size),
                         np.ones(size, bool), np.full(size, -1))  # fmt: skip
        value = np.clip(value + block.steps(now), 0, 1)
    last = 0.5 * float(np.sum(np.square(root @ (value - best))))
    return (last - smallest) / (losses[0] - smallest)


def test_coordinates_beside_others_at_their_bounds_take_the_best_steps():
    """Without it, the median after six steps is 0.01."""
    assert np.median([gap_beyond_bounds(seed, iterations=6) for seed in range(12)]) < 1e-4


def make_exposed() -> Optimizer:
    values = {"exposure": mi.Float(1.0), "floor": dr.full(mi.TensorXf, 0.8, (4, 4, 1))}
    bounds, transforms = {"exposure": None, "floor": (0.0, 1.0)}, {"exposure": make_transform("log", None)}
    optimizer = Optimizer("auto", 1.0, {}, values, dict.fromkeys(values), bounds, transforms)
    optimizer.balance("exposure", ["floor"])
    return optimizer


def pull_exposed(optimizer: Optimizer) -> np.ndarray:
    """Accumulate the gradients of a picture with 16 pixels E t_i of texels, and 16 pixels E mean(t)² of light that they
    reflect twice. Only the latter tell the exposure E. Return the derivatives of the pixels (32, 2) by the logarithms
    of E and of all texels.
    """
    E, t = float(np.array(optimizer["exposure"])[0]), np.array(optimizer["floor"], dtype=np.float64).ravel()
    once, twice = E * t, np.full(16, E * t.mean() ** 2)
    off = once - 0.6 * DARK, twice - 0.6 * DARK.mean() ** 2
    by_texel = E * off[0] + off[1].sum() * 2 * E * t.mean() / 16
    by_exposure = off[0] @ once / E + off[1] @ twice / E
    for key, gradient in (("exposure", by_exposure), ("floor", by_texel)):
        optimizer.clear_gradient(key)
        accumulate(optimizer, key, gradient)
    return np.stack([np.concatenate([once, twice]), np.concatenate([once, 2 * twice])], axis=1)


def test_a_texture_and_an_exposure_that_compensate_for_each_other_move_together():
    """The exposure is 0.6, and the texels are dark. Separate steps would creep along the valley."""
    optimizer = make_exposed()
    for iteration in range(20):
        slopes = pull_exposed(optimizer)
        optimizer.block.bend(slopes.T @ slopes)
        if iteration in (0, 2, 6, 14):
            with optimizer.displaced(np.random.default_rng(iteration)):
                pull_exposed(optimizer)
        optimizer.step(1.0)
    assert float(np.array(optimizer["exposure"])[0]) == pytest.approx(0.6, rel=0.01)
    np.testing.assert_allclose(np.array(optimizer["floor"]).ravel(), DARK, rtol=0.05)
    assert optimizer.to_go("floor") * optimizer.extent("floor") < 0.02


@pytest.mark.parametrize(
    ("settings", "has_transform"),
    [
        ("", True),
        (", bounds: [0, .inf]", True),
        (", bounds: [0, 30]", False),
        (", initial: [8, 8, 0]", False),
        (", transform: sigmoid, bounds: [0, 9]", True),
    ],
)
def test_a_lamp_without_an_upper_bound_moves_by_its_logarithm(tmp_path, settings, has_transform):
    """A value of 0 has no logarithm."""
    write_experiment(tmp_path)
    lamp = f"parameters=[{{key: lamp.emitter.radiance.value{settings}}}]"
    for kind, expected in ((AUTO, has_transform), ("optimizer={type: adam}", "sigmoid" in settings)):
        [key] = (optimizer := assemble_scene(load(tmp_path / "tiny.yaml", [lamp, kind])).optimizer).keys()
        assert (optimizer.variable(key).transform is not None) == expected


def test_noise_shortens_the_steps_and_a_steady_pull_does_not():
    """Both entries have the same gradients but for their signs. The steps of the noisy entry fall with their number."""
    random, lengths = np.random.default_rng(3), []
    optimizer = make({"p": np.full(6, 0.5)}, (-100.0, 100.0))
    loss = {"p": (np.full(6, 1.0), np.zeros(6))}
    pull(optimizer, loss)
    measure(optimizer, loss)
    for _ in range(60):
        before = np.array(optimizer["p"], dtype=np.float64)
        gradient = np.where(np.arange(6) < 3, random.choice([-1.0, 1.0], size=6), 1.0)
        optimizer.clear_gradient("p")
        accumulate(optimizer, "p", gradient)
        optimizer.step(1.0)
        lengths.append(np.abs(np.array(optimizer["p"]) - before))
    turns = np.array(optimizer.moments()["p"]["2"], dtype=np.float64).ravel()
    assert 20 < turns[:3].min() <= turns[:3].max() < 40
    assert optimizer.averaged("p") == pytest.approx(1 + turns.mean())
    first, last = (np.mean(part, axis=0) for part in (lengths[:10], lengths[-10:]))
    assert last[:3].max() < 0.25 * first[:3].min()
    assert last[3:].min() > 0.9 * first[3:].max()


def test_a_texel_that_few_paths_reach_moves_by_a_share_of_the_longest_step():
    """The last entry of 60 has a gradient in one of 10 iterations. Six gradients move it by less than L."""
    optimizer, values = make({"p": np.full(60, 0.5)}), []
    curvature, best = np.full(60, 4.0), np.full(60, 0.3)
    for iteration in range(60):
        curvature[-1], best[-1] = 0.4 * (iteration % 10 == 5), -1.0
        pull(optimizer, {"p": (curvature, best)})
        if iteration == 0:
            measure(optimizer, {"p": (curvature, best)})
        optimizer.step(1.0)
        values.append(np.array(optimizer["p"]))
    assert 0.2 * LONGEST < 0.5 - values[-1][-1] < LONGEST
    np.testing.assert_allclose(values[-1][:-1], 0.3, atol=0.02)


def test_skewed_noise_leaves_no_bias():
    """Noise of a tenth of the gradients is nine times as large as that of the others, with the opposite sign."""
    optimizer, random = make({"p": np.full(60, 0.5)}), np.random.default_rng(4)
    loss = np.full(60, 4.0), np.full(60, 0.5)
    for iteration in range(150):
        pull(optimizer, {"p": loss})
        if iteration == 0:
            measure(optimizer, {"p": loss})
        accumulate(optimizer, "p", np.where(random.random(60) < 0.1, -0.9, 0.1))
        optimizer.step(1.0)
    assert np.array(optimizer["p"]).mean() == pytest.approx(0.5, abs=0.005)


def fine_matrix(H, W):
    """Return the matrix (H W, H W) of `fine_part` for a single channel."""

    def blur(n):
        once = 0.5 * np.eye(n) + 0.25 * (np.eye(n, k=1) + np.eye(n, k=-1))
        once[0, 0] += 0.25
        once[-1, -1] += 0.25
        return once

    return np.eye(H * W) - np.kron(blur(H), blur(W))


#: Texels with details, the matrix of their fine part, and that of images whose pixels blur them.
DETAILS, FINE = np.random.default_rng(1).choice([0.3, 0.7], size=144), fine_matrix(12, 12)
BLURRED = np.eye(144) - 0.7 * FINE
#: Shapes of the parameter with and without fine steps.
SHAPES = (12, 12, 1), (144,)


def test_the_fine_part_of_texels():
    H, W, channels = 5, 4, 3
    texels = np.random.default_rng(0).normal(size=(H, W, channels)).astype(np.float32)
    found = np.array(fine_part(mi.Float(texels.ravel()), (H, W, channels))).reshape(H * W, channels)
    np.testing.assert_allclose(found, fine_matrix(H, W) @ texels.reshape(H * W, channels), atol=1e-6)
    np.testing.assert_allclose(np.array(fine_part(mi.Float(np.full(20, 0.7)), (5, 4, 1))), 0, atol=1e-6)


def pull_images(optimizer, seen, best, error=0.0):
    """Accumulate the gradient of the loss |seen (x - best) + error|^2 / 2."""
    x = np.array(optimizer["p"], dtype=np.float64).ravel()
    optimizer.clear_gradient("p")
    accumulate(optimizer, "p", seen.T @ (seen @ (x - best) + error))


def descend(seen, best, noise, shape, iterations=40):
    """Return the texels after each step. The images have `noise`."""
    random, optimizer, values = np.random.default_rng(5), make({"p": np.full(shape, 0.5)}), []
    for iteration in range(iterations):
        error = noise * random.normal(size=best.size)
        pull_images(optimizer, seen, best, error)
        if iteration in (0, 2, 6, 14, 30):
            with optimizer.displaced(np.random.default_rng(iteration)):
                pull_images(optimizer, seen, best, error)
        optimizer.step(1.0)
        values.append(np.array(optimizer["p"], dtype=np.float64).ravel())
    return np.array(values)


def test_a_measurement_shows_the_curvature_of_the_fine_part():
    """The mean over the texels is the mean of the diagonal of F S'S F. F is the fine part, and S shows the images."""
    best, found, optimizer = np.full(144, 0.45), [], make({"p": np.full((12, 12, 1), 0.5)})
    for _ in range(4):
        pull_images(optimizer, BLURRED, best)
        optimizer.step(1.0)
    for seed in range(40):
        with optimizer.displaced(np.random.default_rng(seed)):
            pull_images(optimizer, BLURRED, best)
        found.append(np.array(optimizer.moments()["p"]["9"]).mean())
    assert np.mean(found) == pytest.approx(np.trace(FINE @ BLURRED.T @ BLURRED @ FINE) / 144, rel=0.05)


def fine_errors(values, best):
    return np.sqrt(np.mean(np.square((values - best) @ FINE), axis=1))


def test_fine_steps_reach_details_that_blurred_images_show_weakly():
    """The pixels are means of 3 x 3 texels. Without fine steps, the same texels have one dimension."""
    errors = [fine_errors(descend(BLURRED, DETAILS, 0.02, shape), DETAILS) for shape in SHAPES]
    tiny = fine_errors(descend(1e-13 * BLURRED, DETAILS, 0.02e-13, SHAPES[0]), DETAILS)
    np.testing.assert_allclose(tiny, errors[0], rtol=1e-3)  # squares of these curvatures would underflow
    assert errors[0][-1] < 0.6 * errors[1][-1]


def test_fine_steps_leave_details_alone_that_no_image_shows():
    seen = np.eye(144) - FINE
    for _ in range(3):
        seen = seen @ seen  # a wide blur
    with_fine, without = (descend(seen, DETAILS, 0.02, shape)[-1] for shape in SHAPES)
    moved = [np.std(FINE @ (values - 0.5)) for values in (with_fine, without)]
    assert moved[0] < 1.1 * moved[1]


def test_texels_that_no_image_shows_stay_beside_those_that_move():
    seen = BLURRED * (np.arange(144) >= 24)
    last = descend(seen, DETAILS, 0.02, SHAPES[0])[-1]
    assert (last[:24] == 0.5).all()
    assert (last[24:] != 0.5).all()


def test_noise_shortens_fine_steps():
    """The noise of an image would move details by several times their size."""
    best = np.full(144, 0.5)
    with_fine, without = (fine_errors(descend(BLURRED, best, 0.3, shape), best)[-1] for shape in SHAPES)
    assert with_fine < without


def test_one_noisy_measurement_does_not_set_the_curvature_of_a_dim_texel():
    """One of 400 entries is dim, and its measurement is 50 times too large. 2 % of the entries share their factor."""
    size = np.linspace(0.5, 1.0, 400)
    size[0] = 0.1
    measured = 2 * size
    measured[0] *= 50
    found = np.array(_steepness(mi.Float(size), mi.Float(measured)))
    np.testing.assert_allclose(found, 2 * size, rtol=0.05)


def test_curvature_is_the_mean_of_measurements_weighted_by_their_errors():
    """Changes of the values make earlier measurements less certain. Measurements without an error replace them."""
    block = Block({"p": 2})
    assert block.doubt == np.inf
    block.bend(np.eye(2), 0.03)
    assert block.doubt == pytest.approx(0.03)
    block.bend(3 * np.eye(2), 0.03)
    np.testing.assert_allclose(block.steepness("p"), 2, rtol=1e-6)
    assert block.doubt == pytest.approx(0.03 / np.sqrt(2))
    block.bend(100 * np.eye(2), 1.0)  # with a few bright samples
    np.testing.assert_allclose(block.steepness("p"), 2, atol=0.05)
    block.rows[0, 9] = -1  # one longest step
    assert block.doubt == pytest.approx(SHIFT, rel=0.01)
    block.bend(5 * np.eye(2), 0.03)
    np.testing.assert_allclose(block.steepness("p"), 5, atol=0.05)
    block.bend(7 * np.eye(2))
    np.testing.assert_allclose(block.steepness("p"), 7, rtol=1e-6)


def test_curvature_is_measured_until_it_is_known():
    """The error must be at most a quarter of the smallest eigenvalue, which is 0.1 in units of the diagonal."""
    block = Block({"p": 2})
    assert not block.is_known
    for number in range(1, 5):
        block.bend(np.array([[4.0, 1.8], [1.8, 1.0]]), 0.04)
        assert block.is_known is (number >= 3)
    block.rows[1, 9] = 0.1
    assert not block.is_known


def test_steps_since_a_measurement_count():
    """Steps in opposite directions cancel each other. The unit is the longest step."""
    block = Block({"p": 1})
    block.bend(np.eye(1), 0.01)
    value, shifts = np.array([0.5]), []
    for gradient in (0.05, -0.05):
        now = JointState(value, np.array([gradient]), np.array([0.1]), *np.array([[0.0], [1.0]]), np.ones(1, bool),
                         np.array([-1]))  # fmt: skip
        value = value + block.steps(now)
        shifts.append((value[0] - 0.5) / 0.1)
        assert block.rows[0, 9] == pytest.approx(shifts[-1], abs=1e-5)
    assert shifts[0] < -0.3


def test_a_noisy_curvature_does_not_lead_to_long_steps():
    """Three directions change 2,000 pixels almost alike, so two eigenvalues are smaller than their noise."""
    random, common = np.random.default_rng(3), np.random.default_rng(2).normal(size=2000)
    slopes = common * np.array([[1.0], [0.9], [-1.1]]) + 0.01 * random.normal(size=(3, 2000))
    true = slopes @ slopes.T
    least = []
    for _ in range(50):
        a, b = (slopes + 0.3 * random.normal(size=slopes.shape) for _ in range(2))
        found, _ = raise_eigenvalues(a, b, np.zeros((3, 3)))
        least.append(np.linalg.eigvalsh(found)[0])
        np.testing.assert_allclose(found, true, rtol=0.15)
    assert min(least) > 3  # about the noise, 0.09 sqrt(2000)
    assert max(least) < 50
    certain = np.diag([0.0, 0.0, 1e5])
    np.testing.assert_allclose(raise_eigenvalues(slopes, slopes, certain)[0], true + certain, rtol=0.02)


def along_the_valley(found: np.ndarray, true: np.ndarray) -> float:
    """Return the curvature along the eigenvector of the smallest eigenvalue of `true` (M, M), if all other directions
    of `found` follow, in units of that eigenvalue.
    """
    values, vectors = np.linalg.eigh(true)
    valley = np.pad(vectors[:, 0], (0, len(found) - len(true)))
    return float(1 / (valley @ np.linalg.inv(found) @ valley) / values[0])


@pytest.mark.parametrize("noisy", [0, 1, 7])
def test_directions_of_noise_hide_no_small_eigenvalue(noisy: int):
    """Three directions are nearly alike. Noise hides the others. Without a reduced coupling, the curvature along the
    valley was up to 20 times too large.
    """
    random = np.random.default_rng(4)
    common = random.normal(size=4000) * np.exp(random.normal(size=4000))
    slopes = common * np.ones((3, 1))
    slopes[1:] += 0.01 * common.std() * random.normal(size=(2, 4000))
    sizes = np.array([0.1] * 3 + [0.5] * noisy)[:, None]
    slopes, found = np.vstack([slopes, 0.02 * random.normal(size=(noisy, 4000))]), []
    for _ in range(40):
        a, b = (slopes + sizes * random.normal(size=slopes.shape) for _ in range(2))
        H, error = raise_eigenvalues(a, b, np.zeros((len(a), len(a))))
        found.append(along_the_valley(H, slopes[:3] @ slopes[:3].T))
        assert error < 0.01  # that of the valley
    assert 0.5 < np.median(found) < 2
    assert np.quantile(found, 0.95) < 4


def test_a_rare_bright_sample_does_not_decouple_directions():
    """Two directions are alike in 1,000 pixels. One pixel of one sample is 60 times as bright. Without the coupling,
    steps along both would be twice as long.
    """
    random = np.random.default_rng(6)
    common = random.choice([-1.0, 1.0], size=1000)
    a, b = (common + 0.1 * random.normal(size=(2, 1000)) for _ in range(2))
    a[:, 7] *= 60
    H, _ = raise_eigenvalues(a, b, np.zeros((2, 2)))
    assert H[0, 1] > 0.95 * np.sqrt(H[0, 0] * H[1, 1])


def test_a_rare_bright_sample_couples_no_directions():
    """One pixel is a hundred times as bright as the noise of the others, in both samples of one direction."""
    random = np.random.default_rng(5)
    slopes = random.normal(size=(2, 1000)) * np.array([[1.0], [0.01]])
    a, b = (slopes + 0.3 * random.normal(size=slopes.shape) for _ in range(2))
    a[1, 7], b[1, 7], a[0, 7] = 30.0, 9.0, 30.0
    H, _ = raise_eigenvalues(a, b, np.zeros((2, 2)))
    assert abs(H[0, 1]) < 0.2 * np.sqrt(H[0, 0] * H[1, 1])
    assert H[1, 1] >= 270  # its own curvature stays


def test_noise_gives_a_combination_without_effect_no_curvature():
    """The sum of four entries has no effect on the image. The curvature of the other combinations stays."""
    random, slopes = np.random.default_rng(3), np.random.default_rng(2).normal(size=(4, 2000))
    slopes -= slopes.mean(axis=0)
    left, others = [], []
    for _ in range(200):
        a, b = (slopes + 0.3 * random.normal(size=slopes.shape) for _ in range(2))
        found = lower_eigenvalues(a, b)
        np.testing.assert_allclose(found, found.T, atol=1e-9)
        left.append(np.full(4, 0.5) @ found @ np.full(4, 0.5))
        others.append(np.linalg.eigvalsh(found)[1:])
    # One standard error is about 0.09 sqrt(2000). A normal deviate exceeds it with a probability of 16 %.
    assert np.mean(np.greater(left, 1)) < 0.25
    assert max(left) < 15
    np.testing.assert_allclose(np.mean(others, axis=0), np.linalg.eigvalsh(slopes @ slopes.T)[1:], rtol=0.1)


def test_a_run_ends_close_to_the_optimum_before_its_limit(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path, sets=[AUTO, "run.iterations=500"])
    *_, (state, record) = loop.iterate(problem, standing(problem))
    assert loop.LEAST_ITERATIONS < state.iteration < 60
    assert state.stopped == "every parameter is within about 2.5 % of the optimum"
    assert np.abs(np.array(problem.optimizer["albedo"]) - 0.8).max() < 0.02
    assert record.lr == 1


def test_a_run_goes_on_until_its_steps_are_means_of_many_gradients(tmp_path, steps, monkeypatch):
    """Gradients have a random factor between 0.5 and 1.5. The value is close to the optimum early."""
    random = np.random.default_rng(1)
    steps.spoil = lambda call, key: float(random.uniform(0.5, 1.5))
    ends = []
    for least in (1, 20):
        monkeypatch.setattr(loop, "AVERAGED", least)
        problem = steps.problem = make_problem(tmp_path, sets=[AUTO, "run.iterations=500"])
        *_, (state, _) = loop.iterate(problem, standing(problem))
        ends.append((state.iteration, float(np.abs(np.array(problem.optimizer["albedo"]) - 0.8).max())))
    assert ends[0][0] < ends[1][0] < 60
    assert ends[1][1] < 0.1 * ends[0][1]


def test_a_run_whose_gradients_are_noise_does_not_end_early(tmp_path, steps):
    """Each gradient has a random factor between -2 and 2, and the value stays far from the optimum."""
    random = np.random.default_rng(1)
    steps.spoil = lambda call, key: float(random.choice([-2.0, 2.0]))
    problem = steps.problem = make_problem(tmp_path, sets=[AUTO, "run.iterations=60"])
    *_, (state, _) = loop.iterate(problem, standing(problem))
    assert (state.iteration, state.stopped) == (60, "")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_measurements_that_are_not_finite_change_nothing(tmp_path, steps, bad):
    """The calls 8 and 9 are the iteration 6 and its measurement."""
    steps.spoil = lambda call, key: bad if call in (8, 9) else 1.0
    problem = steps.problem = make_problem(tmp_path, sets=[AUTO, "run.iterations=30"])
    bent = []
    for _ in loop.optimize(problem):
        assert np.isfinite(np.array(problem.optimizer["albedo"])).all()
        bent.append(np.array(problem.optimizer.moments()["albedo"]["3"]))
    np.testing.assert_array_equal(bent[5], bent[6])
    assert np.abs(np.array(problem.optimizer["albedo"]) - 0.8).max() < 0.02


def test_a_measurement_has_the_samples_of_its_step(tmp_path, steps):
    problem = steps.problem = make_problem(tmp_path, sets=[AUTO, "run.iterations=7"])
    list(loop.optimize(problem))
    seeds = [call.seed for call in steps.calls]
    assert len(seeds) == 7 + 3  # iterations 0, 2 and 6 measure
    assert [a == b for a, b in itertools.pairwise(seeds)].count(True) == 3


@pytest.mark.parametrize(
    ("adjoint", "shards"),
    [("batched", 1), *(pytest.param(*one, marks=pytest.mark.long)
                       for one in (("correlated", 1), ("independent", 1), ("batched", 4)))],
)  # fmt: skip
@pytest.mark.parametrize("kind", ["auto", "sgd, scale: curvature"])
def test_measurements_by_differences_have_the_same_guided_samples(kind, adjoint, shards, llvm, tmp_path, monkeypatch):
    """Without a displacement, both gradients are then equal. The tables still learn in other iterations."""
    begin_alone(tmp_path, monkeypatch)
    monkeypatch.setattr(optimizers, "DISPLACEMENT", 0.0)
    monkeypatch.setattr(sensitivity, "_like", lambda value, row: dr.zeros(type(value), dr.shape(value)))
    sets = [f"optimizer={{type: {kind}}}", "integrator.guiding=on", "integrator.paths=light", "run.spp=16",
            f"run.adjoint={adjoint}", f"run.shards={shards}"]  # fmt: skip
    problem = assemble(load("tiny.yaml", sets))
    problem.truth.clear()
    guiding, found, gradient, sample = guiding_of(problem), [], loop.gradient, sensitivity.sample_gradient
    brightness = itertools.count(1.0, 0.03)
    monkeypatch.setattr(sensitivity, "see_images", lambda *_: [np.full((8, 8, 3), next(brightness))])

    def record(function):
        def call(problem, *others):
            result = function(problem, *others)
            found.append(np.array(problem.optimizer.gradient(KEY)))
            return result

        return call

    monkeypatch.setattr(loop, "gradient", record(gradient))
    monkeypatch.setattr(sensitivity, "sample_gradient", record(sample))
    state = standing(problem)
    for lessons in (0, 1) if kind == "auto" else (1,):
        found.clear()
        state, _ = loop.step(problem, state)
        assert (guiding.lessons > 0) == (lessons > 0)
        if kind == "auto":
            assert len(found) == 2 - lessons
            ends = found[:1], found[-1:]
        else:
            assert found.pop().any()  # the gradient of the iteration
            assert len(found) == 10  # of each parameter, one at the start, and two at each end of a difference
            ends = found[1:3] + found[6:8], found[3:5] + found[8:]
        np.testing.assert_array_equal(*ends)
        assert all(gradient.any() for gradient in found)


@pytest.mark.parametrize("cost", [0.5, 4.5, 15.5, 40.0, 1e9])
@pytest.mark.parametrize("fewest", [1.0, 0.1, 1e-9])
def test_measuring_takes_at_most_its_share_of_the_samples(cost, fewest):
    """If the first measurement is too expensive, it has fewer samples, or waits."""
    least = fewest * cost
    found = {iteration: loop.joint_cost(iteration, cost, least) for iteration in range(300)}
    measured = {iteration: paid for iteration, paid in found.items() if paid is not None}
    for iteration in measured:
        total = sum(paid for earlier, paid in measured.items() if earlier <= iteration)
        assert total <= loop.MOST * (iteration + loop.LEAST_ITERATIONS)
    first = next(iter(measured), None)
    assert (first == 0) == (least <= loop.LEAST_ITERATIONS)
    assert first is None or least <= measured.pop(first) <= cost
    assert all(paid == cost for paid in measured.values())
    if cost < 5:
        assert first == 0
        assert list(measured)[:6] == [1, 2, 4, 7, 11, 17]
    elif cost < 100:
        assert len(measured) >= 0.5 * loop.MOST * 200 / cost - 1


@pytest.mark.parametrize(("directions", "samples"), [(10, 16), (39, 16), (79, 8), (400, 1), (4000, None)])
def test_the_first_measurement_fits_its_budget(directions, samples, tmp_path, monkeypatch):
    """Its two sets of images have at most the samples of 20 steps. Without time for one sample, it waits. Each
    iteration has samples of its own.
    """
    problem, used = make_problem(tmp_path, sets=[AUTO, "run.spp=64"]), []

    def measure(problem, spp, of_target, round):
        used.append((spp, round))
        raise LookupError

    monkeypatch.setattr(loop, "plan_changes", lambda *given: [None] * directions)
    monkeypatch.setattr(loop, "LossCurvature", measure)
    for iteration in (0, 1):
        with contextlib.suppress(LookupError):
            loop.measure_block(problem, iteration)
    assert used[:1] == ([] if samples is None else [(samples, 0)])
    assert [round for _, round in used] == [0, 1][: len(used)]
    assert samples is None or 2 * (directions + 1) * samples <= loop.LEAST_ITERATIONS * 64


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("rise", "distrusted"), [(0.05, 0), (0.2, loop.HALVINGS)])
def test_only_a_large_rise_of_the_loss_is_distrusted(rise, distrusted, sign, tmp_path, monkeypatch):
    """A loss may be negative."""
    problem, calls = make_problem(tmp_path, sets=[AUTO]), []
    problem.optimizer.extents = {"albedo": 1.0}
    monkeypatch.setattr(loop, "exposed_images", lambda *given: [])
    monkeypatch.setattr(loop, "blurred_losses", lambda *given: (10.0 * sign, 10.0 * (sign + rise)))
    monkeypatch.setattr(problem.optimizer.block, "distrust", lambda: calls.append(1))
    loop.update(problem, 0, 1.0, problem.optimizer.keys())
    assert len(calls) == distrusted


def test_what_needs_a_rate_is_refused(llvm, tmp_path, monkeypatch):
    begin_alone(tmp_path, monkeypatch)
    for sets, where in (
        (["optimizer={type: auto, learning_rate: 0.1}"], "optimizer.learning_rate"),
        (["optimizer={type: auto, schedule: cosine}"], "optimizer.schedule"),
        ([AUTO, "parameters[0].learning_rate=0.1"], "learning_rate"),
        ([AUTO, "parameters[0].precondition=0.1"], "precondition"),
    ):
        with pytest.raises(ConfigError) as error:
            load(tmp_path / "tiny.yaml", sets)
        assert where in str(error.value)
    for parameter, lacking in (
        ("{heightmap: {mesh: face, resolution: [6, 6]}}", "a heightmap of more than 32 texels"),
        ("{key: face.vertex_positions}", "places outside of a motion"),
    ):
        sets = [AUTO, f"parameters=[{parameter}]", "target={file: none.exr}"]
        with pytest.raises(ConfigError, match=f"auto has no steps for {lacking}, such as `face"):
            assemble_scene(load(CONFIGS / "caustic_heightmap.yaml", sets))
    sets = [AUTO, "parameters=[{key: glass.nd}]", "variant=llvm_ad_rgb"]
    with pytest.raises(ConfigError, match="auto has no steps for the refraction of a glass"):
        assemble_scene(load(CONFIGS / "prism.yaml", sets))


def test_small_heightmaps_move_together_with_motions(llvm):
    """The back is 2 wide and the face 1.61, and the bounds of the turn are closer than its extent."""
    parameters = "parameters=[{motion: {of: [back, face], free: [x, rotation, scale]}, bounds: {rotation: [-5, 5]}}, "
    parameters += "{heightmap: {mesh: face, resolution: [4, 4]}}]"
    problem = assemble_scene(load(CONFIGS / "caustic_heightmap.yaml", [AUTO, parameters, "target={file: none.exr}"]))
    optimizer = problem.optimizer
    found = {key: (at.stop - at.start, optimizer.extent(key)) for key, at in optimizer.block.at.items()}
    heights = (16, pytest.approx(1.61 / 4))
    assert found == {"back.x": (1, 2), "back.rotation": (3, 10), "back.scale": (1, 1), "face.heightmap": heights}
    assert not optimizer.has_large


def test_a_finished_run_says_why_it_ended(llvm, tmp_path, monkeypatch, capsys):
    begin_alone(tmp_path, monkeypatch)
    monkeypatch.setattr(loop, "CLOSE", 1e6)
    sets = ("--set", AUTO, "--set", "run.iterations=50", "--set", "run.certainty=false", "--set", "run.measuring=0")
    assert optimize("tiny.yaml", *sets) == 0
    assert "stopped after 21 iterations: every parameter is within" in "".join(capsys.readouterr())
    assert manifest("runs/tiny")["results"]["stopped"].startswith("every parameter is within")
    assert optimize("--resume", "runs/tiny", "--set", "run.iterations=50") == 0
    assert "is finished, after 21 of 50 iterations: every parameter is within" in "".join(capsys.readouterr())
