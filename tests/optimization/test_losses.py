"""Losses against NumPy, values and gradients."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.optimization.views import LOSSES, make_loss

EPSILON = 0.02
REFERENCES = {
    "l1": (lambda i, t: np.abs(i - t), lambda i, t: np.sign(i - t)),
    "l2": (lambda i, t: (i - t) ** 2, lambda i, t: 2 * (i - t)),
    "relative_l2": (lambda i, t: (i - t) ** 2 / (t**2 + EPSILON), lambda i, t: 2 * (i - t) / (t**2 + EPSILON)),
    "log_l2": (
        lambda i, t: np.log((i + EPSILON) / (t + EPSILON)) ** 2,
        lambda i, t: 2 * np.log((i + EPSILON) / (t + EPSILON)) / (i + EPSILON),
    ),
}


def images(shape=(5, 7, 3)):
    rng = np.random.default_rng(1)
    return rng.uniform(0, 2, shape), rng.uniform(0, 2, shape)


def options(name):
    return {"epsilon": EPSILON} if name in ("relative_l2", "log_l2") else {}


def test_every_loss_has_a_reference():
    assert set(LOSSES) == set(REFERENCES)


@pytest.mark.parametrize("name", LOSSES)
def test_values_and_gradients(name):
    image, target = images()
    value, derivative = (function(image, target) for function in REFERENCES[name])
    attached = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(attached)
    loss = make_loss(name, **options(name))(attached, mi.TensorXf(target.astype(np.float32)))
    assert np.array(loss).size == 1
    assert float(np.array(loss).item()) == pytest.approx(value.mean(), rel=1e-5)
    dr.backward(loss)
    np.testing.assert_allclose(np.array(attached.grad), derivative / image.size, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_does_not_depend_on_the_resolution(name):
    image, target = images()
    loss = make_loss(name, **options(name))
    sizes = [[np.tile(array, (n, n, 1)).astype(np.float32) for array in (image, target)] for n in (1, 3)]
    values = [float(np.array(loss(mi.TensorXf(i), mi.TensorXf(t))).item()) for i, t in sizes]
    assert values[0] == pytest.approx(values[1], rel=1e-5)


@pytest.mark.parametrize("name", LOSSES)
def test_black_and_negative_pixels_stay_finite(name):
    image = mi.TensorXf(np.array([[[0.0], [-0.3], [2.0]]], dtype=np.float32))
    dr.enable_grad(image)
    loss = make_loss(name)(image, mi.TensorXf(np.zeros((1, 3, 1), dtype=np.float32)))
    dr.backward(loss)
    assert np.isfinite(np.array(loss)).all()
    assert np.isfinite(np.array(image.grad)).all()


@pytest.mark.parametrize("name", LOSSES)
def test_a_nan_is_not_hidden(name):
    image = mi.TensorXf(np.array([[[np.nan], [1.0]]], dtype=np.float32))
    assert np.isnan(np.array(make_loss(name)(image, mi.TensorXf(np.ones((1, 2, 1), dtype=np.float32)))))
