"""What tables of guided emission are made of: slots, densities, what has been heard."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conformance.gradient_cases import CASES

from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.transport.guide import Guide, Table, apportion, even_table, make_grid
from reslrb_cli.transport.plan import GUIDE_UNIFORM, Grid

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
    assert (counts >= GUIDE_UNIFORM * even - 1e-3).all()
    assert (counts[even > 0] > 0).all()
    assert (counts[even == 0] == 0).all()
    weights = np.array(Table.of(grid, counts).weights, np.float64)
    assert weights.max() <= 1 / GUIDE_UNIFORM * (1 + 1e-3)
    assert np.sum(weights * counts) / grid.slots == pytest.approx(1, abs=1e-6)
    assert np.isclose(np.diff(grid.edges).sum(), 1)
    assert grid.cells <= 2**19


@pytest.mark.parametrize("name", ["one", "directions"])
def test_who_has_learned_nothing_draws_evenly(name: str) -> None:
    np.testing.assert_array_equal(np.array(even_table(GRIDS[name]).weights), 1)


@pytest.mark.parametrize(
    ("name", "bits"),
    [
        ("point", (0, 0, 10, 9)),
        ("directional", (10, 9, 0, 0)),
        ("envmap", (5, 5, 5, 4)),
        ("two_emitters", (5, 4, 4, 4)),
    ],
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

    def weighed(grid: Grid, counts: np.ndarray, *rest: Any) -> Table:
        table = right(grid, counts, *rest)
        return replace(table, weights=mi.Float(np.array(table.weights) * np.float32(factor[0])))

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
    from reslrb_cli.guiding.tables import Learned, Purpose

    draws, first, other = np.ones(SMALL.cells), np.zeros(SMALL.cells), np.zeros(SMALL.cells)
    first[:16], other[16:] = 1, 1
    quiet = Learned.nothing(SMALL).with_more(SMALL, heard(first, 1e-12 * other, 0, 1), draws)
    density = quiet.density(SMALL, Purpose.GRADIENT.value)
    # Mean squares 1 / 0.25 and 1 / 0.75, each all over its emitter; the density is their root times the measure.
    assert density[:16].sum() / density[16:].sum() == pytest.approx((4**0.5 * 0.25) / ((4 / 3) ** 0.5 * 0.75))
    assert quiet.density(SMALL, Purpose.IMAGE.value) == pytest.approx(SMALL.measures())
    both = quiet.density(SMALL, Purpose.BOTH.value)
    assert both == pytest.approx((density + SMALL.measures()) / 2, rel=1e-6)
    for wrong in (np.inf, np.nan, 0.0):
        louder = Learned.nothing(SMALL).with_more(SMALL, heard(first, wrong, 1), draws)
        only = Learned.nothing(SMALL).with_more(SMALL, heard(first, 1), draws)
        np.testing.assert_array_equal(
            louder.density(SMALL, Purpose.GRADIENT.value), only.density(SMALL, Purpose.GRADIENT.value)
        )
    silent = Learned.nothing(SMALL).with_more(SMALL, heard(0, np.nan), draws)
    for purpose in Purpose:
        assert silent.density(SMALL, purpose.value) == pytest.approx(SMALL.measures())


@pytest.mark.parametrize("name", GRIDS)
def test_cells_part_the_cube_and_coarser_ones_are_made_of_them(name: str) -> None:
    """Each cell lies in one coarser cell, and all that do are drawn alike."""
    grid = GRIDS[name]
    values = np.random.default_rng(2).random(grid.cells)
    for cells in (grid.cells, grid.cells / 3, 5000, 300, 1):
        coarser = grid.coarser(cells)
        assert coarser.cells <= max(cells, grid.emitters)
        assert coarser.cells > min(cells, grid.cells) / 2 or coarser.cells == grid.emitters
        owner = np.zeros(grid.cells, np.int64)
        rest, below, there = np.arange(grid.cells), 0, 0
        for fine, few in zip(grid.bits, coarser.bits, strict=True):
            owner += (((rest >> below) & ((1 << fine) - 1)) >> (fine - few)) << there
            below, there = below + fine, there + few
        owner += (rest >> below) << there
        summed = grid.summed(values, coarser)
        np.testing.assert_allclose(summed, np.bincount(owner, values, coarser.cells), rtol=1e-9)
        np.testing.assert_allclose(grid.summed(grid.measures(), coarser), coarser.measures(), rtol=1e-9)
        shared = grid.shared_out(summed, coarser)
        np.testing.assert_allclose(shared, summed[owner] * coarser.cells / grid.cells, rtol=1e-9)
        assert shared.sum() == pytest.approx(values.sum())


@pytest.mark.parametrize("weights", [[1.0], [1.0, 0.0, 2.0, 0.5]])
def test_each_cell_is_drawn_as_often_as_its_weight_says_and_numbers_lie_in_it(weights: list[float]) -> None:
    """Of three lanes for each slot a cell has exactly three times its slots; p is that share, with no rounding."""
    import mitsuba as mi

    grid = make_grid([True, True, False, True], weights, 10)
    counts = apportion(grid, np.random.default_rng(4).gamma(0.1, size=grid.cells) * grid.measures())
    table, lanes = Table.of(grid, counts), 3 * grid.slots
    random = np.random.default_rng(5)
    own = [mi.Float(random.uniform(0.01, 0.99, lanes).astype(np.float32)) for _ in range(5)]
    drawn = Guide.of(table, lanes).draw(
        grid, lanes, mi.PCG32(lanes, 1), own[0], mi.Point2f(own[1], own[2]), mi.Point2f(own[3], own[4])
    )
    cell = np.array(drawn.cell)
    np.testing.assert_array_equal(np.bincount(cell, minlength=grid.cells), 3 * counts)
    p = counts[cell] / grid.slots
    np.testing.assert_allclose(np.array(drawn.weight), grid.measures()[cell] / p, rtol=1e-6)
    numbers = [drawn.position.x, drawn.position.y, drawn.direction.x, drawn.direction.y]
    index = [(np.array(number) * 2**bits).astype(int) for number, bits in zip(numbers, grid.bits, strict=True)]
    emitter = np.searchsorted(grid.edges, np.array(drawn.choice), "right") - 1 if grid.emitters > 1 else 0 * cell
    lies_in = np.ravel_multi_index([emitter, *reversed(index)], grid.shape)
    np.testing.assert_array_equal(lies_in, cell)


def test_cells_are_as_fine_as_there_are_paths_to_tell_them_apart() -> None:
    """A few paths say nothing of single cells; what many say of one is not spread over others."""
    from reslrb_cli.guiding.tables import FINE, Learned

    grid = GRIDS["one"]
    loud = np.zeros(grid.cells, np.float32)
    loud[np.ravel_multi_index([size // 2 for size in grid.shape], grid.shape)] = 1
    found = []
    for paths in (100, 4000, 10**6):
        draws = paths * grid.measures()
        learned = Learned.nothing(grid).with_more(grid, np.stack([loud, loud]), draws)
        density = learned.density(grid, 1.0)
        assert density.sum() == pytest.approx(1)
        found.append(int((density > 0).sum()))
        alike = max(grid.cells / (FINE * paths), 1)
        assert 3**4 * 2 * alike >= found[-1] >= alike
    assert found[0] > found[1] > found[2] == 3**4


def test_what_was_heard_long_ago_counts_for_little() -> None:
    from reslrb_cli.guiding.tables import Learned, Purpose

    draws, before, now = np.ones(SMALL.cells), np.zeros(SMALL.cells), np.zeros(SMALL.cells)
    before[:16], now[16:] = 1, 1
    learned = Learned.nothing(SMALL).with_more(SMALL, heard(before, 1), draws)
    for _ in range(20):
        learned = learned.with_more(SMALL, heard(now, 1), draws)
    assert learned.density(SMALL, Purpose.GRADIENT.value)[:16].sum() < 0.02


def test_tables_of_any_number_of_sensors_take_64_mib() -> None:
    from reslrb_cli.guiding.tables import Guiding, grid_for

    for emitters, sensors in ((1, 1), (1, 3), (2, 1), (3, 2), (3000, 1), (3, 1000)):
        guiding = Guiding()
        guiding.grid = grid_for([True] * 4, [1.0] * emitters, sensors)
        assert guiding.grid.cells <= 2**19
        assert guiding.bytes(1) <= guiding.bytes(1000) <= 2**26
        if sensors <= 3:
            assert guiding.bytes(sensors) == sensors * guiding.bytes(1)
        numbers = {guiding._shared(number) for number in range(1000)}
        assert len(numbers) * guiding.bytes(1) == guiding.bytes(1000)
