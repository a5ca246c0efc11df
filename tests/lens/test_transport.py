"""Light transport compared with known maps, its derivative, and its floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from lens.pictures import Gradient, sharp, smooth

from reslrb_cli.lens import transport
from reslrb_cli.lens.transport import grid, least_floor, resized, solve, splat, through_tent

SIZE = (2.0, 1.0)


def even(size: tuple[float, float], target: tuple[float, float]) -> np.ndarray:
    return np.array([0, 0, 0, target[0] / size[0] / 2, 0, target[1] / size[1] / 2])


def test_a_product_of_densities_uses_the_quantiles_of_each_axis() -> None:
    shape, target = (48, 96), (3.0, 2.0)
    source = 1 + 0.5 * np.sin(2 * np.linspace(-1, 1, 96))[None] * np.ones((48, 1))
    picture = (1.2 + np.sin(4 * np.linspace(-1, 1, 400)))[None] * (1.1 - np.linspace(-1, 1, 300) ** 2)[:, None]
    made = solve(Gradient(source, SIZE), picture, SIZE, target, shape, even(SIZE, target))
    assert made.converged
    assert made.folded == 0
    assert made.error < 0.03
    for axis, (mu, nu) in enumerate(((source.sum(0), picture.sum(0)), (source.sum(1), picture.sum(1)))):
        below = (np.cumsum(mu) - mu / 2) / mu.sum()
        edges = np.concatenate([[0], np.cumsum(nu)]) / nu.sum()
        exact = np.interp(below, edges, (np.linspace(0, 1, nu.size + 1) - 0.5) * target[axis])
        found = made.T[axis].mean(axis=axis)
        assert np.sqrt(np.mean((found - exact)[2:-2] ** 2)) < 0.1 * target[axis] / mu.size  # of a cell's width


def test_light_is_transported_to_the_picture() -> None:
    picture = smooth(128)
    made = solve(Gradient(np.ones((2, 2)), (1, 1)), picture, (1, 1), (1, 1), (128, 128), even((1, 1), (1, 1)))
    assert made.converged
    assert made.error < 0.03
    assert np.abs(made.pushed - through_tent(picture / picture.mean())).mean() == pytest.approx(made.error)


def test_a_round_aperture_fills_the_picture() -> None:
    x, y = grid((64, 64), (1, 1))
    light = (x * x + y * y < 0.25) * 1.0
    made = solve(Gradient(light, (1, 1)), smooth(64), (1, 1), (1, 1), (64, 64), even((1, 1), (1, 1)))
    assert made.converged
    assert made.error < 0.03


@dataclass(frozen=True)
class Turned(Gradient):
    """Optics that turn the gradient. Their derivative is not symmetric."""

    def hit(self, x: np.ndarray, y: np.ndarray, h: np.ndarray, gx: np.ndarray, gy: np.ndarray) -> np.ndarray:
        return np.stack([gx + 0.6 * gy, gy + 0.2 * gx])


@pytest.mark.parametrize("optics", [Gradient, Turned])
def test_the_derivative_of_the_equation_matches_differences(optics: type[Gradient]) -> None:
    size, target, shape = (1.0, 0.8), (1.0, 1.2), (24, 40)
    x, y = grid(shape, size)
    h, slopes = transport._even(even(size, target), shape, size)
    h = h + 4e-3 * np.cos(2 * np.pi * (x / size[0] + 0.5)) * np.cos(np.pi * (y / size[1] + 0.5))
    v = np.cos(np.pi * (x / size[0] + 0.5)) * np.cos(2 * np.pi * (y / size[1] + 0.5))
    nu = smooth(96)[:, :64]
    made = [
        transport._Equation(
            transport._State(h + e * v, slopes, size, even(size, target)), optics(np.ones((2, 2)), size), nu, target
        )
        for e in (-1e-5, 0.0, 1e-5)
    ]
    made[1].linearize()
    found = made[1].along(v) / made[1].scale
    expected = (made[2].F - made[0].F) / 2e-5
    inner = (slice(1, -1), slice(1, -1))
    # The derivative of the picture's mean over a cell assumes that all points of the cell move with its centre
    difference = (found - found.mean() - expected)[inner]
    print(np.sqrt(np.mean(difference**2)) / np.sqrt(np.mean(expected**2)))
    assert np.sqrt(np.mean(difference**2)) < 0.03 * np.sqrt(np.mean(expected**2))


@pytest.mark.parametrize(("fails", "sharp", "side"), [(16, True, 64), (32, True, 32), (32, False, 64), (64, True, 64)])
def test_a_picture_that_stays_blurred_ends_before_the_last_grid(
    monkeypatch: pytest.MonkeyPatch, fails: int, sharp: bool, side: int
) -> None:
    """Only the grid before the last one tells: a coarser one may fail although the finer ones do not."""

    def newton(state: transport._State, *_: object, blur: float = 0.0) -> None:
        state.residual = float(state.h.shape[0] == fails and blur < 2)

    monkeypatch.setattr(transport, "_newton", newton)
    square = (1.0, 1.0)
    made = solve(Gradient(np.ones((2, 2)), square), smooth(64), square, square, (64, 64), even(square, square),
                 sharp=sharp)  # fmt: skip
    assert made.h.shape == (side, side)
    assert made.converged == (side == 64)


def test_a_small_picture_that_stays_blurred_has_one_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    def newton(state: transport._State, *_: object, blur: float = 0.0) -> None:
        state.residual = float(blur < 2)

    monkeypatch.setattr(transport, "_newton", newton)
    square = (1.0, 1.0)
    made = solve(
        Gradient(np.ones((2, 2)), square), smooth(64), square, square, (21, 64), even(square, square), sharp=True
    )
    assert made.h.shape == (21, 64)


def test_the_slope_of_the_picture_is_that_between_pixels() -> None:
    size, target = (1.0, 1.0), (1.2, 0.9)
    start = even(size, target)
    state = transport._State(*transport._even(start, (9, 9), size), size, start)
    made = transport._Equation(state, Gradient(np.ones((2, 2)), size), sharp(12)[:, :10] + 0.1, target)
    made.linearize()
    middle, found = made.center, made.slope / made.scale * made.seen
    for axis, pixels in enumerate((10, 12)):
        half = np.zeros((2, 1, 1))
        half[axis] = target[axis] / pixels / 2
        ends = []
        for side in (half, -half):
            made.center = middle + side
            ends.append(made._over_cells(made.nu, target))
        np.testing.assert_allclose(found[axis], (ends[0] - ends[1]) / (2 * half[axis]), atol=1e-9)


@pytest.mark.long
def test_a_floor_is_the_smallest_without_tears() -> None:
    optics, square = Gradient(np.ones((2, 2)), (1, 1)), (1.0, 1.0)
    assert least_floor(optics, smooth(32), square, square, even(square, square)) == 0
    found = least_floor(optics, sharp(32), square, square, even(square, square))
    assert found is not None
    assert 0.02 < found <= 0.1


def test_resizing_preserves_the_light() -> None:
    picture = smooth(37)
    for shape in ((11, 20), (37, 37), (50, 90)):
        assert resized(picture, shape).mean() == pytest.approx(picture.mean(), rel=1e-12)


@pytest.mark.parametrize("side", [16, 63, pytest.param(400, marks=pytest.mark.long)])
def test_a_resized_black_and_white_picture_stays_within_black_and_white(side: int) -> None:
    at = np.arange(side)
    disc = np.hypot(*np.meshgrid(at - side / 2, at - side / 2)) < 0.4 * side
    for picture in (disc, (at[:, None] + at) % 2, np.outer(at == 5, at == 9)):
        light = picture.astype(np.float64)
        for size in (7, 45, 128, 256):
            for between in (False, True):
                made = resized(light, (size, max(2, size - 7)), between)
                assert made.min() >= 0  # -1e-16 would count as negative
                assert made.max() <= 1 + 1e-12
                if not between:
                    assert made.mean() == pytest.approx(light.mean(), rel=1e-12)


def test_more_cells_are_interpolated_on_request() -> None:
    ramp = np.arange(6.0)[None, :, None] * np.ones((4, 1, 3))
    finer = resized(ramp, (9, 24), between=True)
    assert np.allclose(finer, np.clip((np.arange(24) + 0.5) / 4 - 0.5, 0, 5)[None, :, None])


def test_uniform_splats_appear_through_a_tent_filter() -> None:
    picture, fine = smooth(16), 32
    at = (np.arange(16 * fine) + 0.5) / fine
    column, row = np.meshgrid(at, at)
    share = np.kron(picture, np.ones((fine, fine)))
    seen = splat(column.ravel(), row.ravel(), share.ravel(), (16, 16))
    np.testing.assert_allclose(seen, through_tent(picture / picture.mean()), rtol=1e-3)
