"""Optimisers, compared with their published formulas, and reparameterisations."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.config.optimizers import Adam as AdamSettings
from reslrb_cli.optimization.loop import SCHEDULES, learning_rate_factor
from reslrb_cli.optimization.optimizers import OPTIMIZERS, Optimizer
from reslrb_cli.optimization.variables import Smoother, Variable, make_transform
from reslrb_cli.records.clock import StepClock

# Optimisers, compared with their published formulas. Clamping, learning rates, and parameters that sit out a step.

RATE = 0.05
START = np.array([0.9, -0.4, 0.2, 1.5])
TARGET = np.array([0.1, 0.3, 0.8, -0.7])


def adam(p, g, s, t, beta_1=0.9, beta_2=0.999, epsilon=1e-8, rate=RATE):
    s["m"] = beta_1 * s.get("m", 0) + (1 - beta_1) * g
    s["v"] = beta_2 * s.get("v", 0) + (1 - beta_2) * g**2
    step = rate * np.sqrt(1 - beta_2**t) / (1 - beta_1**t)  # Section 2 of the paper: epsilon is not corrected for bias
    return p - step * s["m"] / (np.sqrt(s["v"]) + epsilon)


def sgd(p, g, s, t, momentum=0.0, rate=RATE):
    s["v"] = momentum * s.get("v", 0) + g
    return p - rate * s["v"]


CASES = [
    ("adam", {}, adam),
    ("adam", {"beta_1": 0.5, "beta_2": 0.9, "epsilon": 1e-2}, adam),
    ("sgd", {}, sgd),
    ("sgd", {"momentum": 0.9}, sgd),
]
KINDS = {"texture": lambda: dr.full(mi.TensorXf, 0.5, (2, 3, 3)), "colour": lambda: mi.Color3f(0.5),
         "number": lambda: mi.Float(0.5)}  # fmt: skip


def make(type="sgd", value=START, options=None, rate=None, bounds=None):
    value = mi.TensorXf(np.array(value, dtype=np.float32))
    return Optimizer(type, RATE, options or {}, {"p": value}, {"p": rate}, {"p": bounds})


def descend(optimizer, gradient=lambda p: 2 * (p - TARGET)):
    """Backpropagate the gradient of |p - TARGET|² (or `gradient`, from NumPy) into the optimiser. Return the
    optimiser's gradient.
    """
    value = optimizer["p"]
    wanted = mi.TensorXf(np.array(gradient(np.array(value)), dtype=np.float32))
    dr.backward(dr.sum(value * wanted, axis=None))
    return np.array(optimizer.gradient("p"))


def test_every_optimiser_has_a_reference():
    assert {case[0] for case in CASES} == set(OPTIMIZERS) - {"auto"}  # in test_newton.py


@pytest.mark.parametrize(("type", "options", "reference"), CASES)
def test_updates_follow_the_formula(type, options, reference):
    optimizer, expected, state = make(type, options=options), START.copy(), {}
    for step in range(1, 31):
        descend(optimizer)
        optimizer.step(1.0)
        expected = reference(expected, 2 * (expected - TARGET), state, step, **options)
        np.testing.assert_allclose(np.array(optimizer["p"]), expected, rtol=2e-3, atol=2e-3)


def test_adam_as_configured_soon_forgets_a_large_first_gradient():
    """A value starts 0.6 away from the minimum. Its first gradient is 100 times larger than the loss implies. The value
    arrives within 200 steps at a rate of 0.02. With a `beta_2` of 0.999, it takes 600 steps.
    """
    rate, value = 0.02, mi.TensorXf(np.array([0.8], dtype=np.float32))
    options = AdamSettings().own_options()
    optimizer = Optimizer("adam", rate, options, {"p": value}, {"p": None}, {"p": None})
    for step in range(200):
        descend(optimizer, lambda p, factor=1.0 if step else 100.0: 2 * factor * (p - 0.2))
        optimizer.step(1.0)
    assert abs(float(np.array(optimizer["p"])[0]) - 0.2) < 0.01


@pytest.mark.parametrize("transform", ["none", "sigmoid"])
def test_an_exposure_moves_along_the_valley_of_equal_products(transform):
    """The loss is a function f of the products of an exposure and two colours, plus a function h of the exposure. The
    exposure follows h alone, and the products stay the same. The second colour reaches its bound. Its other entry has
    no effect on the loss.
    """
    values = {"exposure": mi.Float(0.5), "one": mi.Color3f(0.2, 0.4, 0.6), "two": mi.TensorXf(np.float32([0.95, 0.7]))}
    bounds = {"exposure": None, "one": (0.0, 1.0), "two": (0.0, 1.0)}
    transforms = {"exposure": make_transform("log", None)}
    transforms |= {key: make_transform(transform, bounds[key]) for key in ("one", "two")}
    rates = {"exposure": 0.1, "one": 1e-9, "two": 1e-9}
    optimizer = Optimizer("adam", RATE, {}, values, rates, bounds, transforms)
    optimizer.balance("exposure", ["one", "two"])
    exposure = 0.5
    for slope in (-0.2, 5.0, 5.0):  # the first one is weaker than the derivative of f, and of opposite sign
        one, two, before = np.array(optimizer["one"]).ravel(), float(optimizer["two"].array[0]), exposure
        e, a, b = optimizer["exposure"], optimizer["one"], optimizer["two"].array
        f = dr.sum(dr.square(e * a - mi.Color3f(0.7, 0.1, 0.35))) + dr.square(e * dr.gather(mi.Float, b, 0))
        dr.backward(f + slope * e)
        np.testing.assert_array_equal(optimizer.step(1.0), {})
        [exposure] = np.array(optimizer["exposure"]).ravel()
        if slope < 0:  # the first step of Adam has the length of its rate
            assert exposure == pytest.approx(before * np.exp(0.1), rel=1e-4)
        np.testing.assert_allclose(exposure * np.array(optimizer["one"]).ravel(), before * one, rtol=1e-4)
        assert float(optimizer["two"].array[0]) == pytest.approx(min(before * two / exposure, 1), rel=1e-4)
    two, other = np.array(optimizer["two"].array)
    assert two > 0.999
    assert other == pytest.approx(0.7, rel=1e-5)


def test_a_skipped_colour_does_not_follow_the_exposure():
    values = {"exposure": mi.Float(0.5), "one": mi.Float(0.2), "two": mi.Float(0.4)}
    options = {"rates": dict.fromkeys(values), "bounds": dict.fromkeys(values)}
    optimizer = Optimizer("sgd", RATE, {}, values, **options)
    optimizer.balance("exposure", ["one", "two"])
    dr.backward(optimizer["exposure"] + optimizer["two"] * 1e-20 + optimizer["one"] * 1e30 * 1e30)
    optimizer.step(1.0, skip=["one"])
    exposure, one, two = (float(optimizer[key][0]) for key in values)
    assert (exposure, one) == (pytest.approx(0.45), pytest.approx(0.2))
    assert two == pytest.approx(0.4 * 0.5 / 0.45)


def test_a_parameter_has_its_own_rate_scaled_by_the_schedule():
    optimizer = make(rate=0.5)
    descend(optimizer, lambda p: np.ones_like(p))
    optimizer.step(0.1)
    np.testing.assert_allclose(np.array(optimizer["p"]), START - 0.5 * 0.1, rtol=1e-5)


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (-np.inf, 0.5), (0.25, np.inf)])
def test_values_are_clamped_after_the_update(bounds):
    optimizer = make(value=[0.3, 0.4], bounds=bounds)
    for gradient in (-100.0, 200.0):
        descend(optimizer, lambda p, gradient=gradient: np.full_like(p, gradient))
        optimizer.step(1.0)
        low, high = np.array(optimizer["p"]).min(), np.array(optimizer["p"]).max()
        assert bounds[0] <= low
        assert high <= bounds[1]
        assert (high == bounds[1]) if gradient < 0 and np.isfinite(bounds[1]) else True
        assert (low == bounds[0]) if gradient > 0 and np.isfinite(bounds[0]) else True


@pytest.mark.parametrize("type", OPTIMIZERS)
def test_a_skipped_parameter_keeps_value_and_state(type):
    one, other = make(type), make(type)
    for step in range(6):
        descend(one)
        one.step(1.0)
        if step == 3:
            descend(other, lambda p: np.full_like(p, np.nan))
            assert other.step(1.0, skip=["p"]) == {}
        descend(other)
        other.step(1.0)
    np.testing.assert_array_equal(np.array(one["p"]), np.array(other["p"]))


def test_an_overflowing_update_is_undone():
    optimizer = make(value=[1.0, 1.0])
    descend(optimizer, lambda p: np.array([3e38, 1.0]))
    assert optimizer.step(1e10) == {"p": 1}
    np.testing.assert_array_equal(np.array(optimizer["p"]), [1.0, 1.0])
    descend(optimizer, lambda p: np.ones_like(p))
    optimizer.step(1.0)
    np.testing.assert_allclose(np.array(optimizer["p"]), 1.0 - RATE, rtol=1e-6)


@pytest.mark.parametrize("type", OPTIMIZERS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_changing_rate_compiles_nothing(type, kind):
    value = KINDS[kind]()
    optimizer, clock = Optimizer(type, RATE, {}, {"p": value}, {"p": None}, {"p": (0.0, 1.0)}), StepClock()
    compiled = []
    for step in range(12):
        with clock.step() as times:
            dr.backward(dr.sum(dr.square(optimizer["p"] - 0.9), axis=None))
            dr.eval(optimizer.gradient("p"))
            optimizer.step(0.9**step)
        compiled.append(times.new_kernels)
    assert not any(compiled[2:])


def test_the_state_holds_the_moments():
    optimizer = make("adam")
    descend(optimizer)
    optimizer.step(1.0)
    moments = optimizer.moments()["p"]
    assert set(moments) == {"0", "1", "2"}
    np.testing.assert_allclose(moments["1"], 0.1 * 2 * (START - TARGET), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_schedules_run_from_one_to_the_final_fraction(schedule):
    factors = [learning_rate_factor(schedule, i, 11, 0.1) for i in range(11)]
    assert factors[0] == pytest.approx(1.0)
    assert factors[-1] == pytest.approx(1.0 if schedule == "constant" else 0.1)
    assert all(a >= b for a, b in itertools.pairwise(factors))
    assert learning_rate_factor(schedule, 0, 1, 0.1) == pytest.approx(1.0)


def test_schedules_at_half_time():
    assert learning_rate_factor("cosine", 5, 11, 0.1) == pytest.approx(0.55)
    assert learning_rate_factor("exponential", 5, 11, 0.01) == pytest.approx(0.1)


def test_step_lengths_at_given_values():
    """Step lengths are in the scene's unit, also under a transform. With plain gradient descent, the length depends on
    the gradient and is None.
    """
    start = mi.Float(2.0)
    for kind, transform, bounds, step in (
        ("adam", "none", None, RATE), ("sgd", "none", None, None),
        ("adam", "log", (0, np.inf), 2 * (np.exp(RATE) - 1)), ("sgd", "log", (0, np.inf), None),
    ):  # fmt: skip
        made = {"a": make_transform(transform, bounds)}
        optimizer = Optimizer(kind, 0.3, {}, {"a": start}, {"a": RATE}, {"a": bounds}, made)
        assert optimizer.first_step("a") == (None if step is None else pytest.approx(step, rel=1e-5))


# Reparameterisations: round trips, the chain rule, limits of values, and the effect on the optimiser.

#: Transform, bounds, values.
TRANSFORMS = [
    ("sigmoid", (0.0, 1.0), [1e-5, 0.01, 0.3, 0.5, 0.99]),
    ("sigmoid", (-2.0, 6.0), [-1.99, 0.1, 2.0, 5.5]),
    ("log", None, [1e-12, 1e-6, 0.5, 3.0, 1e7]),
    ("log", (0.01, 1e3), [0.011, 1.0, 900.0]),
]
#: The same functions in double precision.
REFERENCE = {
    "sigmoid": lambda u, low, high: low + (high - low) / (1 + np.exp(-u)),
    "log": lambda u, low, high: np.exp(u),
}


def numbers(values):
    return mi.TensorXf(np.array(values, dtype=np.float32))


@pytest.mark.parametrize(("name", "bounds", "values"), TRANSFORMS)
def test_a_transform_is_inverted(name, bounds, values):
    variable = Variable(make_transform(name, bounds), bounds)
    v = variable.from_scene(numbers(values))
    np.testing.assert_allclose(np.array(variable.to_scene(v)), values, rtol=2e-5)
    expected = REFERENCE[name](np.array(v, dtype=np.float64), *(bounds or (0, 0)))
    np.testing.assert_allclose(np.array(variable.to_scene(v)), expected, rtol=2e-5)


@pytest.mark.parametrize(("name", "bounds", "values"), TRANSFORMS)
def test_the_chain_rule_matches_finite_differences(name, bounds, values):
    """L is the sum of x², so that dL/dx = 2 x. The finite difference is computed in double precision."""
    variable = Variable(make_transform(name, bounds), bounds, gain=3.0)
    v = variable.from_scene(numbers(values))
    found = np.array(variable.chain(v, 2 * variable.to_scene(v)))

    def loss(v):
        return REFERENCE[name](v, *(bounds or (0, 0))) ** 2

    at, h = np.array(v, dtype=np.float64), 1e-4
    np.testing.assert_allclose(found, 3.0 * (loss(at + h) - loss(at - h)) / (2 * h), rtol=1e-4)


def test_without_a_transform_a_variable_has_only_a_gain():
    variable = Variable(None, (0.0, 0.8), gain=4.0)
    v = variable.from_scene(numbers([0.3, 0.8]))
    np.testing.assert_allclose(np.array(v), [0.3, 0.8], rtol=1e-6)
    np.testing.assert_allclose(np.array(variable.chain(v, numbers([1.0, 2.0]))), [4, 8], rtol=1e-6)
    np.testing.assert_allclose(np.array(variable.to_scene(variable.clamp(v * 2))), [0.6, 0.8], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "bounds", "low", "high"),
    [
        ("sigmoid", (0.2, 0.9), 0.2, 0.9),
        ("log", (0.05, 2.0), 0.05, 2.0),
        ("log", (-1.0, np.inf), 1e-36, 1e36),
    ],
)
def test_values_reach_the_bounds_and_return(name, bounds, low, high):
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
    """Return the result of Adam on (x - target)², by its formula, in double precision."""
    transform = {
        "sigmoid": lambda u: (1 / (1 + np.exp(-u)), np.exp(-u) / (1 + np.exp(-u)) ** 2),
        "log": lambda u: (np.exp(u), np.exp(u)),
    }[name]
    u = {"sigmoid": 0.0, "log": np.log(0.5)}[name]
    m = v = 0.0
    for t in range(1, steps + 1):
        x, slope = transform(u)
        g = 2 * (x - target) * slope
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        u -= rate * np.sqrt(1 - 0.999**t) / (1 - 0.9**t) * m / (np.sqrt(v) + 1e-8)
    return transform(u)[0]


@pytest.mark.parametrize("name", ["sigmoid", "log"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_optimiser_moves_the_variable(name, kind):
    value, bounds = KINDS[kind](), (0.0, 1.0)
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
def test_a_skipped_transformed_parameter_keeps_value_and_state(type):
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


def test_an_overflowing_update_of_a_parameter_in_other_units_is_undone():
    optimizer = Optimizer("sgd", 1e30, {}, {"p": numbers([1.0])}, {"p": None}, {"p": None})
    optimizer.set_variable("p", Variable(None, None, gain=2.0))
    dr.backward(dr.sum(optimizer["p"] * -3e30, axis=None))
    assert optimizer.step(1.0) == {"p": 1}
    np.testing.assert_array_equal(np.array(optimizer["p"]), [1.0])
    dr.backward(dr.sum(optimizer["p"] * 1e-30, axis=None))
    assert optimizer.step(1.0) == {}
    # Only the second gradient acts
    np.testing.assert_allclose(np.array(optimizer["p"]), 1 - 2, rtol=1e-5)


def test_the_state_holds_the_variable():
    optimizer = Optimizer(
        "sgd", 0.1, {}, {"p": numbers([0.5])}, {"p": None}, {"p": None}, {"p": make_transform("log", None)}
    )
    np.testing.assert_allclose(optimizer.moments()["p"]["variable"], np.log(0.5), rtol=1e-6)
    assert optimizer.gains() == {"p": 1.0}


# --- smooth steps -----------------------------------------------------------------------------------------------------


def test_smoothing_and_its_inverse():
    smoother, random = Smoother((12, 20, 2), 0.2), np.random.default_rng(3)
    value, g = (mi.TensorXf(random.normal(size=(12, 20, 2)).astype(np.float32)) for _ in range(2))
    np.testing.assert_allclose(smoother.smooth(smoother.roughen(value)), value, rtol=1e-4, atol=1e-5)
    v = smoother.roughen(value)
    # <S v, g> = <v, S g>, so S turns gradients by S v into gradients by v.
    left, right = (np.vdot(np.float64(a), np.float64(b)) for a, b in ((value, g), (v, smoother.smooth(g))))
    assert left == pytest.approx(right, rel=1e-4)
    assert np.std(smoother.smooth(g)) < 0.5 * np.std(g)
    one = mi.TensorXf(np.ones((12, 20, 2), np.float32))
    np.testing.assert_allclose(smoother.smooth(one), 1, rtol=1e-6)  # smoothing keeps a constant


def test_a_length_is_independent_of_the_resolution():
    """A cosine of wavelength w is damped by 1 / (1 + (2 pi l / w)^2) at any resolution of the map. The length is l."""
    damped = []
    for size in (32, 128):
        wave = np.cos(2 * np.pi * 2 * (np.arange(size) + 0.5) / size)[:, None, None] * np.ones((1, size, 1))
        smoothed = np.array(Smoother(wave.shape, 0.1).smooth(mi.TensorXf(wave.astype(np.float32))))
        damped.append(np.max(smoothed) / np.max(wave))
    assert damped == pytest.approx([1 / (1 + (2 * np.pi * 0.1 * 2) ** 2)] * 2, rel=0.01)


@pytest.mark.parametrize("type", ["adam", "sgd"])
@pytest.mark.parametrize("bounds", [None, (0.3, 0.7)])
def test_a_preconditioned_step_is_smooth_and_within_bounds(type, bounds):
    size = 32
    value = mi.TensorXf(np.full((size, size, 1), 0.5, np.float32))
    smoother = Smoother((size, size, 1), 0.1)
    optimizer = Optimizer(type, 0.2, {}, {"p": value}, {"p": None}, {"p": bounds}, smoothers={"p": smoother})
    noise = np.random.default_rng(0).normal(size=(size, size, 1)).astype(np.float32)
    for _ in range(4):
        dr.set_grad(optimizer["p"], mi.TensorXf(30 * (noise + 0.2)))
        assert optimizer.step(1.0) == {}
    moved = np.array(optimizer["p"])[:, :, 0]
    if bounds is None:
        assert 0 < np.abs(np.diff(moved, axis=0)).max() < 0.2 * np.ptp(moved)
    else:
        assert (moved.min(), moved.max()) == pytest.approx(bounds)


def test_the_response_equals_that_of_a_single_entry():
    size, rate = 64, 0.1
    value = mi.TensorXf(np.zeros((size, size, 1), np.float32))
    smoother = Smoother((size, size, 1), 0.03)
    optimizer = Optimizer("sgd", rate, {}, {"p": value}, {"p": None}, {"p": None}, smoothers={"p": smoother})
    expected = optimizer.response("p")[0]
    at = np.zeros((size, size, 1), np.float32)
    at[32, 32] = 1
    dr.set_grad(optimizer["p"], mi.TensorXf(at))
    optimizer.step(1.0)
    assert -np.array(optimizer["p"])[32, 32, 0] / rate == pytest.approx(expected, rel=0.15)  # a mean, edges included
