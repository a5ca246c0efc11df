"""Reparameterisations: there and back, the chain rule, where values end, and what the optimiser makes of them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.optimization.optimizers import OPTIMIZERS, Optimizer, Variable, make_transform
from reslrb_cli.records.clock import StepClock

#: Transform, bounds, values.
CASES = [
    ("sigmoid", (0.0, 1.0), [1e-5, 0.01, 0.3, 0.5, 0.99]),
    ("sigmoid", (-2.0, 6.0), [-1.99, 0.1, 2.0, 5.5]),
    ("log", None, [1e-12, 1e-6, 0.5, 3.0, 1e7]),
    ("log", (0.01, 1e3), [0.011, 1.0, 900.0]),
    ("softplus", None, [1e-12, 1e-3, 0.4, 7.0, 100.0, 1e6]),
]
#: The same functions, written down in double precision.
REFERENCE = {
    "sigmoid": lambda u, low, high: low + (high - low) / (1 + np.exp(-u)),
    "log": lambda u, low, high: np.exp(u),
    "softplus": lambda u, low, high: np.logaddexp(0, u),
}


def numbers(values):
    return mi.TensorXf(np.array(values, dtype=np.float32))


@pytest.mark.parametrize(("name", "bounds", "values"), CASES)
@pytest.mark.parametrize("length", [1.0, 37.0])
def test_there_and_back(name, bounds, values, length):
    variable = Variable(make_transform(name, bounds), bounds, length)
    v = variable.from_scene(numbers(values))
    np.testing.assert_allclose(np.array(variable.to_scene(v)), values, rtol=2e-5)
    expected = REFERENCE[name](np.array(v, dtype=np.float64) * length, *(bounds or (0, 0)))
    np.testing.assert_allclose(np.array(variable.to_scene(v)), expected, rtol=2e-5)


@pytest.mark.parametrize(("name", "bounds", "values"), CASES)
def test_the_chain_rule_against_finite_differences(name, bounds, values):
    """L = sum of x², so that dL/dx = 2 x; the difference is taken in double precision."""
    variable = Variable(make_transform(name, bounds), bounds, length=0.5, gain=3.0)
    v = variable.from_scene(numbers(values))
    found = np.array(variable.chain(v, 2 * variable.to_scene(v)))

    def loss(v):
        return REFERENCE[name](v * 0.5, *(bounds or (0, 0))) ** 2

    at, h = np.array(v, dtype=np.float64), 1e-4
    np.testing.assert_allclose(found, 3.0 * (loss(at + h) - loss(at - h)) / (2 * h), rtol=1e-4)


@pytest.mark.parametrize("length", [1.0, 1e-3, 1e6])
def test_without_a_transform_a_variable_is_a_unit(length):
    variable = Variable(None, (0.0, 0.8), length, gain=4.0)
    v = variable.from_scene(numbers([0.3, 0.8]))
    np.testing.assert_allclose(np.array(v), np.array([0.3, 0.8]) / length, rtol=1e-6)
    np.testing.assert_allclose(np.array(variable.chain(v, numbers([1.0, 2.0]))), [4 * length, 8 * length], rtol=1e-6)
    np.testing.assert_allclose(np.array(variable.to_scene(variable.clamp(v * 2))), [0.6, 0.8], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "bounds", "low", "high"),
    [
        ("sigmoid", (0.2, 0.9), 0.2, 0.9),
        ("log", (0.05, 2.0), 0.05, 2.0),
        ("softplus", (0.05, 2.0), 0.05, 2.0),
        ("log", (-1.0, np.inf), 1e-36, 1e36),
        ("softplus", None, 1e-36, 1e36),
    ],
)
def test_values_end_at_the_bounds_and_come_back(name, bounds, low, high):
    optimizer = Optimizer("sgd", 1.0, {}, {"p": numbers([0.5, 0.5])}, {"p": None}, {"p": bounds},
                          {"p": make_transform(name, bounds)})  # fmt: skip
    for gradient, end in ((-1e30, high), (1e30, low)):
        dr.backward(dr.sum(optimizer["p"] * gradient, axis=None))
        assert optimizer.step(1.0) == {}
        value = np.array(optimizer["p"])
        assert (value <= high).all()
        assert (value >= low).all()
        if bounds is not None and np.isfinite(end) and 1e-30 < end < 1e30:
            np.testing.assert_allclose(value, end, rtol=1e-5)
    assert (np.array(optimizer["p"]) > 0).all()


def adam_in_u(name, bounds, target, steps, rate):
    """Adam on (x - target)², by its formula, in double precision."""
    transform = {
        "sigmoid": lambda u: (1 / (1 + np.exp(-u)), np.exp(-u) / (1 + np.exp(-u)) ** 2),
        "log": lambda u: (np.exp(u), np.exp(u)),
        "softplus": lambda u: (np.logaddexp(0, u), 1 / (1 + np.exp(-u))),
    }[name]
    u = {"sigmoid": 0.0, "log": np.log(0.5), "softplus": np.log(np.expm1(0.5))}[name]
    m = v = 0.0
    for t in range(1, steps + 1):
        x, slope = transform(u)
        g = 2 * (x - target) * slope
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        u -= rate * np.sqrt(1 - 0.999**t) / (1 - 0.9**t) * m / (np.sqrt(v) + 1e-8)
    return transform(u)[0]


@pytest.mark.parametrize("name", ["sigmoid", "log", "softplus"])
@pytest.mark.parametrize("kind", ["texture", "colour", "number"])
def test_the_optimiser_moves_the_variable(name, kind):
    value = {
        "texture": lambda: dr.full(mi.TensorXf, 0.5, (2, 3, 3)),
        "colour": lambda: mi.Color3f(0.5, 0.5, 0.5),
        "number": lambda: mi.Float(0.5),
    }[kind]()
    bounds = (0.0, 1.0)
    optimizer, clock = Optimizer("adam", 0.05, {}, {"p": value}, {"p": None}, {"p": bounds},
                                 {"p": make_transform(name, bounds)}), StepClock()  # fmt: skip
    compiled = []
    for _ in range(30):
        with clock.step() as times:
            dr.backward(dr.sum(dr.square(optimizer["p"] - 0.8), axis=None))
            optimizer.step(1.0)
        compiled.append(times.new_kernels)
    np.testing.assert_allclose(np.array(optimizer["p"]), adam_in_u(name, bounds, 0.8, 30, 0.05), rtol=1e-4)
    assert type(optimizer["p"]) is type(value)
    assert sum(compiled[2:]) == 0, "later steps compile nothing"


@pytest.mark.parametrize("type", OPTIMIZERS)
def test_a_parameter_that_sits_out_keeps_value_and_state(type):
    def make():
        return Optimizer(
            type, 0.05, {}, {"p": numbers([0.5])}, {"p": None}, {"p": None}, {"p": make_transform("log", None)}
        )

    def descend(optimizer, factor=1.0):
        dr.backward(dr.sum(dr.square(optimizer["p"] - 0.8) * factor, axis=None))

    one, other = make(), make()
    for step in range(6):
        descend(one)
        one.step(1.0)
        if step == 3:
            descend(other, float("nan"))
            assert other.step(1.0, skip=["p"]) == {}
        descend(other)
        other.step(1.0)
    np.testing.assert_array_equal(np.array(one["p"]), np.array(other["p"]))


def test_an_update_that_overflows_is_taken_back():
    optimizer = Optimizer("sgd", 1e30, {}, {"p": numbers([1.0])}, {"p": None}, {"p": None},
                          {"p": make_transform("softplus", None)})  # fmt: skip
    dr.backward(dr.sum(optimizer["p"] * -3e30, axis=None))
    assert optimizer.step(1.0) == {"p": 1}
    np.testing.assert_array_equal(np.array(optimizer["p"]), [1.0])
    dr.backward(dr.sum(optimizer["p"] * 1e-30, axis=None))
    assert optimizer.step(1.0) == {}
    # v = log(e - 1), T' = 1 - 1/e: from there, by the second gradient alone
    np.testing.assert_allclose(np.array(optimizer["p"]), np.logaddexp(0, np.log(np.e - 1) - (1 - 1 / np.e)), rtol=1e-5)


def test_the_state_holds_the_variable():
    optimizer = Optimizer(
        "sgd", 0.1, {}, {"p": numbers([0.5])}, {"p": None}, {"p": None}, {"p": make_transform("log", None)}
    )
    state = optimizer.state()
    np.testing.assert_allclose(state["p/variable"], np.log(0.5), rtol=1e-6)
    assert state["p/length"] == 1.0
