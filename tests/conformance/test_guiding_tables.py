"""What tables of guided emission are made of: slots, densities, what has been heard."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conformance.gradient_cases import CASES

from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.transport.guide import UNIFORM, Grid, Table, apportion, even_table, make_grid

pytestmark = pytest.mark.usefixtures("llvm")

SCENES = {case.name: case.scene for case in CASES}
GRIDS = {
    "one": make_grid([True] * 4, [1.0]),
    "directions": make_grid([False, False, True, True], [1.0]),
    "nothing": make_grid([False] * 4, [1.0, 1.0]),
    "unequal": make_grid([True] * 4, [1.0, 1e-6, 0.0, 2.0, 0.5]),
    "many": make_grid([True] * 4, [1.0] * 3000),
}


@pytest.mark.parametrize("name", GRIDS)
def test_slots_are_all_shared_out_and_a_quarter_evenly(name: str) -> None:
    grid = GRIDS[name]
    density = np.random.default_rng(1).gamma(0.02, size=grid.cells) * grid.measures()
    counts = apportion(grid, density)
    even = grid.measures() * grid.slots
    assert counts.sum() == grid.slots
    assert (counts >= UNIFORM * even - 1e-3).all()
    assert (counts[even > 0] > 0).all()
    assert (counts[even == 0] == 0).all()
    weights = np.array(Table.of(grid, counts).weights, np.float64)
    assert weights.max() <= 1 / UNIFORM * (1 + 1e-3)
    assert np.sum(weights * counts) / grid.slots == pytest.approx(1, abs=1e-6)
    assert np.isclose(np.diff(grid.edges).sum(), 1)
    assert grid.cells <= 2**17


@pytest.mark.parametrize("name", ["one", "directions"])
def test_who_has_learned_nothing_draws_evenly(name: str) -> None:
    np.testing.assert_array_equal(np.array(even_table(GRIDS[name]).weights), 1)


@pytest.mark.parametrize(
    ("name", "bits"),
    [("point", (0, 0, 8, 8)), ("directional", (8, 8, 0, 0)), ("envmap", (4, 4, 4, 4)), ("two_emitters", (4, 4, 4, 4))],
)
def test_numbers_that_emission_does_not_use_are_not_cut(name: str, bits: tuple[int, ...]) -> None:
    scene = Case(SCENES[name](), [])
    ours = integrator("reslrb", guiding="on")
    grid = ours.plan(scene.scene, scene.scene.sensors()[0]).grid
    assert grid is not None
    assert grid.bits == bits
    assert grid.emitters == len(scene.scene.emitters())


def test_emitters_that_nobody_draws_have_a_grid() -> None:
    for weights in ([], [0.0, 0.0]):
        grid = make_grid([True] * 4, weights)
        assert apportion(grid, grid.measures()).sum() == grid.slots


def test_scenes_without_emitters_are_traced() -> None:
    scene = Case({key: value for key, value in SCENES["texture"]().items() if key != "lamp"}, [])
    assert not scene.image(integrator("reslrb", guiding="on"), 1, 4).any()


def test_roulette_does_not_see_the_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths that are drawn often would else end for being many: a hundredth of the weight leaves just that."""
    import mitsuba as mi

    from reslrb_cli.transport import guide

    right, factor = guide.Table.of, [1.0]

    def weighed(grid: Grid, counts: np.ndarray) -> Table:
        table = right(grid, counts)
        return Table(table.slots, mi.Float(np.array(table.weights) * np.float32(factor[0])), table.edges)

    monkeypatch.setattr(guide.Table, "of", staticmethod(weighed))
    scene, images = Case(SCENES["roulette"](), []), []
    for factor[0] in (1.0, 0.01):
        images.append(scene.image(integrator("reslrb", 6, 1, guiding="on"), 5, 16) / factor[0])
    assert images[0].any()
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5 * images[0].max())


SMALL = Grid((1, 1, 1, 1), (0.0, 0.25, 1.0))


def heard(*rows: Any) -> np.ndarray:
    return np.stack([np.broadcast_to(np.asarray(row, np.float64), (SMALL.cells,)) for row in rows])


def test_no_voice_drowns_another_and_none_that_is_not_finite_is_heard() -> None:
    from reslrb_cli.integrators.guiding import Learned, Purpose

    draws, first, other = np.ones(SMALL.cells), np.zeros(SMALL.cells), np.zeros(SMALL.cells)
    first[:16], other[16:] = 1, 1
    quiet = Learned.nothing(SMALL, 4).with_more(SMALL, heard(first, 1e-12 * other, 0, 1), draws)
    density = quiet.density(SMALL, Purpose.GRADIENT)
    # Mean squares 1 / 0.25 and 1 / 0.75, each all over its emitter; the density is their root times the measure.
    assert density[:16].sum() / density[16:].sum() == pytest.approx((4**0.5 * 0.25) / ((4 / 3) ** 0.5 * 0.75))
    assert quiet.density(SMALL, Purpose.IMAGE) == pytest.approx(SMALL.measures())
    both = quiet.density(SMALL, Purpose.BOTH)
    assert both == pytest.approx((density + SMALL.measures()) / 2, rel=1e-6)
    for wrong in (np.inf, np.nan, 0.0):
        louder = Learned.nothing(SMALL, 3).with_more(SMALL, heard(first, wrong, 1), draws)
        only = Learned.nothing(SMALL, 2).with_more(SMALL, heard(first, 1), draws)
        np.testing.assert_array_equal(louder.density(SMALL, Purpose.GRADIENT), only.density(SMALL, Purpose.GRADIENT))
    silent = Learned.nothing(SMALL, 2).with_more(SMALL, heard(0, np.nan), draws)
    for purpose in Purpose:
        assert silent.density(SMALL, purpose) == pytest.approx(SMALL.measures())


def test_what_was_heard_long_ago_counts_for_little() -> None:
    from reslrb_cli.integrators.guiding import Learned, Purpose

    draws, before, now = np.ones(SMALL.cells), np.zeros(SMALL.cells), np.zeros(SMALL.cells)
    before[:16], now[16:] = 1, 1
    learned = Learned.nothing(SMALL, 2).with_more(SMALL, heard(before, 1), draws)
    for _ in range(12):
        learned = learned.with_more(SMALL, heard(now, 1), draws)
    assert learned.density(SMALL, Purpose.GRADIENT)[:16].sum() < 0.02


def test_tables_of_any_number_of_sensors_take_64_mib() -> None:
    from reslrb_cli.integrators.guiding import Guiding

    for grid in GRIDS.values():
        guiding = Guiding()
        guiding.grid = grid
        assert guiding.bytes(1) <= guiding.bytes(1000) <= 2**26
        numbers = {guiding._shared(number) for number in range(1000)}
        assert len(numbers) * guiding.bytes(1) == guiding.bytes(1000)
