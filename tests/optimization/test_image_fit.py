"""Fits by differences of images: steps, their acceptance, and scans of roughnesses."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from reslrb_cli.optimization import image_fit
from reslrb_cli.optimization.image_fit import TRIED, ImageFit, fall_of, scan_roughnesses
from reslrb_cli.optimization.uncertainty.curvature import ParameterChange, ParameterDirection

Array = np.ndarray

PIXELS = 400


def made(random: np.random.Generator, at: Array, known: Array | None = None) -> ImageFit:
    """Return a fit of a colour of three channels, an exposure and a roughness, whose images have 3 channels."""
    fit = object.__new__(ImageFit)
    of = [("a.reflectance.value", 0, 0), ("a.reflectance.value", 1, 1), ("a.reflectance.value", 2, 2),
          ("exposure", 0, None), ("a.alpha", 0, None)]  # fmt: skip
    fit.directions = [ParameterDirection(key, np.ones(1), channel, entry) for key, entry, channel in of]
    fit.x, fit.low, fit.high = at, np.array([0, 0, 0, -np.inf, 0.02]), np.array([1, 1, 1, np.inf, 1])
    sees = np.array(
        [np.arange(PIXELS) % 3 == channel if channel is not None else np.ones(PIXELS) for *_, channel in of]
    )
    J = random.normal(0.3, 1.0, (5, PIXELS)) * sees if known is None else known
    fit.J = J, J * random.uniform(0.9, 1.1, PIXELS)
    fit.known = SimpleNamespace(weights=np.full(PIXELS, 1.0 / PIXELS))
    fit.residuals = np.zeros(PIXELS), np.zeros(PIXELS)
    return fit


def test_derivatives_follow_the_images_of_a_step() -> None:
    """After a step, J explains the whole change of the images (the secant condition). A colour's derivative stays 0 in
    other channels.
    """
    random = np.random.default_rng(1)
    fit = made(random, np.array([0.3, 0.4, 0.5, 1.2, 0.3]))
    before, at = fit.residuals, fit.x
    apart = [own == 0 for own in fit.J]
    after = random.normal(size=PIXELS), random.normal(size=PIXELS)
    new = at + np.array([0.1, -0.1, 0.05, 0.2, 0.1])
    fit.move(new, after)
    for own, one, other, zero in zip(fit.J, before, after, apart, strict=True):
        np.testing.assert_allclose((new - at) @ own, other - one, atol=1e-9)
        np.testing.assert_array_equal(own == 0, zero)
    assert fit.x is new


def test_a_step_reaches_the_values_of_a_linear_image() -> None:
    """One step without damping is exact within the share of noise of J, which is small here."""
    random = np.random.default_rng(2)
    fit = made(random, np.array([0.3, 0.4, 0.5, 1.0, 0.3]))
    fit.J = fit.J[0], fit.J[0]
    offset = np.array([0.05, -0.05, 0.02, 0.0, 0.1])
    fit.residuals = (-offset @ fit.J[0],) * 2
    np.testing.assert_allclose(fit.step(0.0), fit.x + offset, rtol=1e-3)
    fit.x[4] = 1.0  # at its bound: the roughness stays, and the others explain what they can
    assert fit.step(0.0)[4] == 1.0


def test_colours_make_up_for_an_exposure() -> None:
    """A step that raises the exposure by a factor lowers the colours by the same factor, as in the joint steps."""
    random = np.random.default_rng(3)
    fit = made(random, np.array([0.4, 0.4, 0.4, 1.0, 0.3]))
    fit.J = fit.J[0], fit.J[0]
    fit.residuals = (-0.3 * fit.J[0][3],) * 2
    new = fit.step(0.0)
    assert new[3] == pytest.approx(np.exp(0.3), rel=1e-3)
    np.testing.assert_allclose(new[:3], 0.4 * 1.3 * np.exp(-0.3), rtol=5e-3)


def test_a_fall_that_few_pixels_carry_is_within_its_error() -> None:
    """A rare bright sample makes the product of two residuals fall, while all other pixels get worse. A step towards
    the optimum is kept in any case.
    """
    kept, good = 0, 0
    for seed in range(100):
        random = np.random.default_rng(seed)
        weights, J = np.full(PIXELS, 1.0 / PIXELS), random.normal(size=PIXELS)
        one, other = random.standard_t(3, PIXELS), random.standard_t(3, PIXELS)
        fall, error = fall_of(weights, (one + 0.5 * J, other + 0.5 * J), (one, other))
        good += fall > error
        place = random.integers(PIXELS)
        J[place], one[place] = 1.0, -400.0  # a step along J makes the product of both fall here
        fall, error = fall_of(weights, (one, other), (one + 0.5 * J, other + 0.5 * J))
        assert fall > 0
        kept += fall > error
    assert kept <= 2
    assert good >= 95


def test_a_step_is_kept_only_if_the_loss_falls_by_more_than_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stub:
        is_complete, residuals, known, fall = True, (np.ones(1), np.ones(1)), None, 3.0

        def __init__(self, problem: float, *_: object) -> None:
            self.x, self.loss = problem, 10.0
            self.known = SimpleNamespace(see_at=lambda values: values, weights=np.ones(1))

        def step(self, damping: float) -> float:
            return self.x + damping

        def values(self, x: float) -> float:
            return x

        def move(self, x: float, residuals: object) -> None:
            self.x = x

    monkeypatch.setattr(image_fit, "ImageFit", Stub)
    monkeypatch.setattr(image_fit, "residuals_of", lambda known, images: (np.ones(1), np.ones(1)))
    monkeypatch.setattr(image_fit, "fall_of", lambda *_: (Stub.fall, 2.0))
    monkeypatch.setattr(image_fit, "set_values", lambda problem, values: values)
    assert image_fit.fit_by_differences(0.0, 1, lambda: True)[0] > 0
    Stub.fall = 1.0
    assert image_fit.fit_by_differences(0.0, 1, lambda: True) == (0.0, True)


def test_a_texture_stays_within_its_bounds() -> None:
    fit = made(np.random.default_rng(5), np.array([2.0]))
    fit.directions = [ParameterDirection("a.reflectance.data", np.ones(1))]
    fit.start, fit.bounds = {"a.reflectance.data": np.full((2, 2, 3), 0.6)}, {"a.reflectance.data": (0.0, 1.0)}
    np.testing.assert_array_equal(fit.values(np.array([2.0]))["a.reflectance.data"], 1.0)
    np.testing.assert_allclose(fit.values(np.array([0.5]))["a.reflectance.data"], 0.3)


class Images:
    """Images of a row of pixels: a floor whose highlight depends on its roughness, times a brightness."""

    def __init__(self, truth: float, noise: float) -> None:
        self.truth, random = truth, np.random.default_rng(4)
        self.noise = [noise * random.normal(size=PIXELS) for _ in range(2)]
        self.at = np.linspace(-3, 3, PIXELS)
        self.target = 0.95 * self.image(truth)
        self.weights, self.directions = np.full(PIXELS, 1.0 / PIXELS), []
        self.known = SimpleNamespace(derivatives=(self.image(0.5)[None],) * 2, weights=self.weights, spp=4)
        view = SimpleNamespace(target=self.target, kept=lambda image: image)
        selection = SimpleNamespace(
            specs={"a.alpha": SimpleNamespace(bounds=(0.02, 1.0))}, array=lambda key: np.zeros(1)
        )
        self.problem = SimpleNamespace(trained=[view], selection=selection)
        self.images = self.see_at({"a.alpha": np.full(1, 0.5)})

    def image(self, alpha: float) -> Array:
        return 0.3 + np.exp(-0.5 * (self.at / alpha) ** 2) / alpha

    def see_at(self, values: dict[str, Array]) -> list[list[Array]]:
        clean = self.image(float(values["a.alpha"][0]))
        return [[clean * (1 + noise)] for noise in self.noise]

    def along(self, changes: list[ParameterChange], go_on: Callable[[], bool]) -> None:
        seen = [(change, self.see_at(change.values)) for change in changes if go_on()]
        self.directions = [direction for change, _ in seen for direction in change.directions]
        self.derivatives = tuple(
            np.array([(images[half][0] - self.images[half][0]) / change.amount for change, images in seen])
            for half in (0, 1)
        )

    def in_a_row(self, images: list[Array]) -> Array:
        return images[0]


@pytest.mark.parametrize("truth", [0.12, 0.22, 0.41, 0.5, 0.9])
def test_a_scan_finds_a_roughness_beside_a_brightness(truth: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """From 0.5, the nearest of the tried values is found. A right roughness stays. The picture is darker too."""
    images = Images(truth, 0.02)
    monkeypatch.setattr(image_fit, "LossCurvature", lambda *args, **kwargs: images)
    found = scan_roughnesses(images.problem, ["a.alpha"], images.known, lambda: True)
    tried = [0.02 + share * 0.98 for share in TRIED]
    assert found == ({} if truth == 0.5 else {"a.alpha": min(tried, key=lambda value: abs(np.log(value / truth)))})
    assert scan_roughnesses(images.problem, ["a.alpha"], images.known, lambda: False) == {}


def test_a_scan_revises_a_value_when_another_roughness_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The best single value, a = TRIED[0], is not the best one beside b = TRIED[0]."""
    effects = {("a", 0): (1.2, 1.2), ("b", 0): (0.0, 1.5), ("a", 1): (2.0, 0.0)}
    tried = [0.02 + share * 0.98 for share in TRIED]

    def see_at(values: dict[str, Array]) -> list[list[Array]]:
        [(key, value)] = values.items()
        effect = effects.get((key, tried.index(float(value[0]))), (0.0, 0.0))
        return [[np.tile(effect, PIXELS // 2)] for _ in range(2)]

    images = Images(0.5, 0.0)
    images.see_at, images.images = see_at, [[np.zeros(PIXELS)] for _ in range(2)]
    images.known.derivatives = np.zeros((0, PIXELS)), np.zeros((0, PIXELS))
    images.problem.trained[0].target = np.tile((2.0, 2.0), PIXELS // 2)
    images.problem.selection.specs = dict.fromkeys("ab", images.problem.selection.specs["a.alpha"])
    monkeypatch.setattr(image_fit, "LossCurvature", lambda *args, **kwargs: images)
    found = scan_roughnesses(images.problem, ["a", "b"], images.known, lambda: True)
    assert found == {"a": tried[1], "b": tried[0]}


def test_known_directions_follow_a_scan() -> None:
    """What they can cause is not in the rows that remain."""
    random = np.random.default_rng(6)
    J, other = random.normal(size=(2, PIXELS)), random.normal(size=PIXELS)
    known = SimpleNamespace(derivatives=(J, J), weights=np.full(PIXELS, 1.0 / PIXELS))
    rows = np.array([3 * J[0] - J[1], other, other + 5 * J[1]])
    for left in image_fit._beside(known, rows, rows):
        np.testing.assert_allclose(left[0], 0, atol=1e-9)
        np.testing.assert_allclose(left[2], left[1], atol=1e-9)
        assert np.corrcoef(left[1], other)[0, 1] > 0.98
