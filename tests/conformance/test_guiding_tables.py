"""Guided emission: what the tables contain, how they learn, their state, and their cost."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.drawing import SPP, guided, learn, sample
from conformance.gradient_cases import CASES
from conformance.operations import LARGE, even_table
from conformance.test_kernels import Kernels
from turns import a_few

from reslrb_cli.guiding.tables import (
    BLUR,
    FINE,
    GUIDE_UNIFORM,
    KEEP,
    Guiding,
    Learned,
    Purpose,
    _blurred,
    apportion,
    grid_for,
    learnings,
    make_grid,
    most_cells,
    sensor_bytes,
)
from reslrb_cli.integrators import freezing
from reslrb_cli.measure.gradients import Case, integrator, relative
from reslrb_cli.transport import samples as drawing
from reslrb_cli.transport.plan import Grid
from reslrb_cli.transport.samples import Guide, Table

pytestmark = pytest.mark.usefixtures("llvm")

# The parts of the tables of guided emission: slots, densities, recorded contributions.

SCENES = {case.name: case.scene for case in CASES}
GRIDS = {
    "one": make_grid([True] * 4, [1.0]),
    "directions": make_grid([False, False, True, True], [1.0]),
    "nothing": make_grid([False] * 4, [1.0, 1.0]),
    "unequal": make_grid([True] * 4, [1.0, 1e-6, 0.0, 2.0, 0.5]),
    "many": make_grid([True] * 4, [1.0] * 3000),
}


@pytest.mark.parametrize("name", GRIDS)
def test_all_slots_are_assigned_and_a_quarter_uniformly(name: str) -> None:
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
def test_an_untrained_table_is_uniform(name: str) -> None:
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
def test_numbers_unused_by_emission_are_not_cut(name: str, bits: tuple[int, ...]) -> None:
    scene = Case(SCENES[name](), [])
    ours = integrator("reslrb", guiding="on")
    grid = ours.plan(scene.scene, scene.scene.sensors()[0]).grid
    assert grid is not None
    assert grid.bits == bits
    assert grid.emitters == len(scene.scene.emitters())


def test_emitters_without_samples_have_a_grid() -> None:
    for weights in ([], [0.0, 0.0]):
        grid = make_grid([True] * 4, weights)
        assert apportion(grid, grid.measures()).sum() == grid.slots


def test_scenes_without_emitters_are_traced() -> None:
    scene = Case({key: value for key, value in SCENES["texture"]().items() if key != "lamp"}, [])
    assert not scene.image(integrator("reslrb", guiding="on"), 1, 4).any()


def test_roulette_ignores_the_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Roulette must not end paths only because they are drawn often. With weights scaled to a hundredth, the image
    changes only by this factor.
    """
    right, factor = drawing.Table.of, [1.0]

    def weighed(grid: Grid, counts: np.ndarray, *rest: Any) -> Table:
        table = right(grid, counts, *rest)
        return replace(table, weights=mi.Float(np.array(table.weights) * np.float32(factor[0])))

    monkeypatch.setattr(drawing.Table, "of", staticmethod(weighed))
    scene, images = Case(SCENES["roulette"](), []), []
    for factor[0] in (1.0, 0.01):
        images.append(scene.image(integrator("reslrb", 6, 1, guiding="on"), 5, 16) / factor[0])
    assert images[0].any()
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5 * images[0].max())


SMALL = Grid((1, 1, 1, 1), (0.0, 0.25, 1.0))


def newer(*rows: Any) -> np.ndarray:
    return np.stack([np.broadcast_to(np.asarray(row, np.float64), (SMALL.cells,)) for row in rows])


def test_no_group_dominates_and_non_finite_values_are_dropped() -> None:
    draws, first, other = np.ones(SMALL.cells), np.zeros(SMALL.cells), np.zeros(SMALL.cells)
    first[:16], other[16:] = 1, 1
    quiet = Learned.nothing(SMALL).with_more(SMALL, newer(first, 1e-12 * other, 0, 1), draws)
    density = quiet.density(SMALL, Purpose.GRADIENT.value)
    # The mean squares are 1 / 0.25 and 1 / 0.75, each over its whole emitter. The density is their root times the
    # measure.
    assert density[:16].sum() / density[16:].sum() == pytest.approx((4**0.5 * 0.25) / ((4 / 3) ** 0.5 * 0.75))
    assert quiet.density(SMALL, Purpose.IMAGE.value) == pytest.approx(SMALL.measures())
    both = quiet.density(SMALL, Purpose.BOTH.value)
    assert both == pytest.approx((density + SMALL.measures()) / 2, rel=1e-6)
    for wrong in (np.inf, np.nan, 0.0):
        louder = Learned.nothing(SMALL).with_more(SMALL, newer(first, wrong, 1), draws)
        only = Learned.nothing(SMALL).with_more(SMALL, newer(first, 1), draws)
        np.testing.assert_array_equal(
            louder.density(SMALL, Purpose.GRADIENT.value), only.density(SMALL, Purpose.GRADIENT.value)
        )
    silent = Learned.nothing(SMALL).with_more(SMALL, newer(0, np.nan), draws)
    for purpose in Purpose:
        assert silent.density(SMALL, purpose.value) == pytest.approx(SMALL.measures())


@pytest.mark.parametrize("name", GRIDS)
def test_cells_partition_the_cube_and_merge_into_coarser_ones(name: str) -> None:
    """Each cell lies in one coarser cell. All cells of a coarser cell are sampled alike."""
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
def test_cells_are_sampled_by_weight(weights: list[float]) -> None:
    """With three lanes for each slot, a cell is sampled exactly three times as often as it has slots. The probability p
    is the cell's share of slots, without rounding.
    """
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


def test_cells_are_as_fine_as_the_paths_allow() -> None:
    """A few paths give no information about single cells. With many paths, one cell's contributions reach only its
    direct neighbours.
    """
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


def test_old_samples_count_little() -> None:
    draws, before, now = np.ones(SMALL.cells), np.zeros(SMALL.cells), np.zeros(SMALL.cells)
    before[:16], now[16:] = 1, 1
    learned = Learned.nothing(SMALL).with_more(SMALL, newer(before, 1), draws)
    for _ in range(20):
        learned = learned.with_more(SMALL, newer(now, 1), draws)
    assert learned.density(SMALL, Purpose.GRADIENT.value)[:16].sum() < 0.02


def test_tables_of_any_number_of_sensors_use_64_mib() -> None:
    for emitters, sensors in ((1, 1), (1, 3), (2, 1), (3, 2), (3000, 1), (3, 1000)):
        guiding = Guiding()
        guiding.grid = grid_for([True] * 4, [1.0] * emitters, sensors)
        assert guiding.grid.cells <= 2**19
        numbers = {guiding._shared(number) for number in range(1000)}
        assert len(numbers) * sensor_bytes(guiding.grid) <= 2**26
        assert len(numbers) >= min(sensors, 3)


# How the tables of guided emission learn: from recorded walks as from plain ones, with cells that passes can resolve.

SIDE = 16  # film width in pixels


def taught(name: str, steps: int, **options: Any) -> Any:
    """Return the tracer of a case after `steps` gradients. Its tables have learned from each of these gradients."""
    scene, ours, _ = guided(name, 0, **options)
    ours.preparation.guiding.due = lambda number: True
    for seed in range(steps):
        sample(scene, ours, seed)
    return ours


@pytest.mark.parametrize("name", a_few(["two_emitters", "envmap"], ()))
def test_a_recorded_walk_collects_the_same_as_a_plain_one(name: str) -> None:
    """With one thread, as in the tests, both walks agree bit by bit. Changed tables do not cause a new recording."""
    plain, recorded = (taught(name, 7, freeze=freeze) for freeze in (False, True))
    for one, other in zip(*(each.preparation.guiding.learned.values() for each in (plain, recorded)), strict=True):
        assert relative(one.sums, other.sums) < 1e-3
        assert relative(one.draws, other.draws) < 1e-3
        assert dr.thread_count() > 1 or np.array_equal(one.sums, other.sums)
        assert dr.thread_count() > 1 or np.array_equal(one.draws, other.draws)
    counts = recorded.preparation.recordings.counts()
    assert 1 <= counts["collect"] <= 2
    assert counts["fused"] <= 2


def test_walks_of_many_paths_are_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(freezing, "MOST_PATHS_APART", 1)
    counts = taught("two_emitters", 2, freeze=True).preparation.recordings.counts()
    assert "collect" not in counts
    assert counts["fused"] > 0


def test_tables_have_the_same_alignment_in_every_kernel() -> None:
    """Dr.Jit aligns the memory of the tables, wherever NumPy stores the arrays that the tables are made from."""
    grid, kept = make_grid([True] * 4, [1.0, 2.0], 8), []
    for number in range(20):
        counts = apportion(grid, np.random.default_rng(number).random(grid.cells))
        table = Table.of(grid, counts.astype(np.uint32))
        kept.append((table, np.zeros(number)))
        for array in (table.slots, table.weights, table.edges):
            assert array.numpy().ctypes.data % 32 == 0


def test_tables_learn_often_at_first_and_regularly_later() -> None:
    """The number of updates that `learnings` returns equals the actual number."""
    scene, ours, _ = guided("two_emitters", 0)
    guiding = ours.preparation.guiding
    del guiding.due
    scene.gradient(ours, 1, 1, adjoint="correlated")
    learned = [1, *(gradient for gradient in range(2, 101) if guiding.due(0))]
    assert learned == [1, 2, 4, 8, 16, 32, 48, 64, 80, 96]
    assert [learnings(k) for k in range(1, 101)] == [sum(one <= k for one in learned) for k in range(1, 101)]


@pytest.mark.long
@pytest.mark.parametrize("worse", [1.0, 3.0])
def test_harmful_tables_learn_as_often_as_at_first(worse: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables that remain harmful do not learn more often than at first. The schedule restarts only when tables learn
    rarely.
    """
    scene, ours, _ = guided("two_emitters", 0)
    guiding, right = ours.preparation.guiding, Learned.with_more
    del guiding.due
    monkeypatch.setattr(Learned, "with_more", lambda *given: replace(right(*given), worse=worse))
    learned = []
    for seed in range(1, 49):
        before = guiding.lessons
        scene.gradient(ours, seed, 1, adjoint="correlated")
        learned += [seed] * (guiding.lessons - before)
    anew = [17, 18, 20, 24, 32, 33, 34, 36, 40, 48] if worse > 1 else [32, 48]
    assert learned == [1, 2, 4, 8, 16, *anew]


@pytest.mark.parametrize("weight", [0.5, 1.0, 4.0])
def test_the_worth_of_a_table_is_its_effect_on_the_second_moment(weight: float) -> None:
    """A quantity from paths with equal weights has this weight as its effect. A second quantity, from paths with
    weights close to 1, makes the effect the mean of both.
    """
    grid, paths = make_grid([True] * 4, [1.0], 8), 1e4
    rare = np.arange(grid.cells) < 8
    others = (1 - (rare * grid.measures()).sum() / weight) / (~rare * grid.measures()).sum()
    draws = paths * grid.measures() * np.where(rare, 1 / weight, others)
    assert draws.sum() == pytest.approx(paths)
    newer = np.stack([rare * draws, ~rare * draws])
    alone = Learned.nothing(grid).with_more(grid, newer[[0, 0]], draws)
    assert alone.worse == pytest.approx(weight, rel=1e-5)
    assert Learned.nothing(grid).with_more(grid, newer, draws).worse == pytest.approx(
        (weight + 1 / others) / 2, rel=1e-5
    )
    assert Learned.nothing(grid).with_more(grid, 0 * newer, draws).worse == 1


@pytest.mark.parametrize("paths", [100, 4096, 20_000, 10**7])
@pytest.mark.parametrize("weights", [[1.0], [1.0, 1e-3, 2.0]])
def test_a_grid_is_as_fine_as_its_walks_can_resolve(paths: int, weights: list[float]) -> None:
    finest = grid_for([True] * 4, weights, 1)
    grid = grid_for([True] * 4, weights, 1, paths)
    assert finest.coarser(grid.cells) == grid  # made of the same cuts
    newer, used = 0.0, []
    for _ in range(200):
        newer = KEEP * newer + paths
        used.append(finest.coarser(min(FINE * newer, most_cells(paths))).cells)
    assert max(used) == grid.cells <= finest.cells


def test_a_coarse_grid_agrees_with_the_finest() -> None:
    """Both grids learn from the same paths. Each coarse cell is sampled as often as the fine cells that it
    consists of.
    """
    finest, paths = make_grid([True] * 4, [1.0, 3.0], 14), 500
    grid = finest.coarser(most_cells(paths))
    assert grid.cells < finest.cells
    random, both = np.random.default_rng(7), [Learned.nothing(each) for each in (finest, grid)]
    for _ in range(3):
        newer, draws = random.gamma(0.1, size=(3, finest.cells)), paths * finest.measures()
        both[0] = both[0].with_more(finest, newer, draws)
        few = np.stack([finest.summed(row, grid) for row in newer])
        both[1] = both[1].with_more(grid, few, finest.summed(draws, grid))
        for share in (0.0, 0.5, 1.0):
            expected = finest.summed(both[0].density(finest, share), grid)
            np.testing.assert_allclose(both[1].density(grid, share), expected, rtol=1e-4)
    again = both[1].on(finest, grid)  # a finer grid keeps what was learned
    np.testing.assert_allclose(again.density(finest, 0.2), both[0].density(finest, 0.2), rtol=1e-4)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("bits", [(3, 2, 4, 3), (0, 1, 0, 2), (2, 0, 0, 0), (0, 0, 0, 0)])
def test_cells_are_smoothed_over_their_neighbours(bits: Any, kind: Any) -> None:
    """Cells are smoothed with the weights of `BLUR` along each number. The last cell counts again beyond the end.
    Nothing passes from one emitter to another, and sums do not change.
    """
    grid = Grid(bits, (0.0, 0.3, 1.0))
    values = np.random.default_rng(5).gamma(0.1, size=grid.cells).astype(kind)
    expected, before = values.reshape(grid.shape), values.copy()
    for axis in range(1, 5):
        wide = np.pad(np.moveaxis(expected, axis, -1), [(0, 0)] * 4 + [(1, 1)], mode="edge")
        expected = np.moveaxis(
            sum(weight * wide[..., k : k + wide.shape[-1] - 2] for k, weight in enumerate(BLUR)), -1, axis
        )
    found = _blurred(grid, values)
    assert found.dtype == kind
    np.testing.assert_allclose(found, expected.ravel(), rtol=1e-6)
    np.testing.assert_allclose(found.reshape(2, -1).sum(1), values.reshape(2, -1).sum(1), rtol=1e-5)
    assert np.array_equal(values, before)


def cells_after(*calls: Any, told: int | None = None) -> list[Grid]:
    """Return the grid after each of some calls on a tracer. The tracer may expect `told` samples in its passes."""
    scene, ours, _ = guided("two_emitters", 0)
    del ours.preparation.guiding.due
    if told is not None:
        ours.expect(told)
    found = []
    for spp, differentiated in calls:
        if differentiated:
            scene.gradient(ours, 1, spp, adjoint="correlated")
        else:
            scene.image(ours, 1, spp)
        found.append(ours.preparation.guiding.grid)
        gradients = [one[0] for one in calls[: len(found)] if one[1]]
        for learned in ours.preparation.guiding.learned.values():
            assert learned.draws.size == found[-1].cells
            assert learned.calls == len(gradients)
            # The table has learned from the first two gradients, or from fewer if there were fewer.
            assert learned.draws.sum() > 0.99 * KEEP * SIDE * SIDE * sum(gradients[:2])
        assert (ours.preparation.guiding.learned == {}) == (gradients == [])
    return found


def test_the_first_pass_fixes_the_grid_and_larger_gradients_refine_it() -> None:
    small, image, large, again = cells_after((1, True), (64, False), (64, True), (1, True))
    assert small == image
    assert 16 * small.cells <= large.cells <= 128 * small.cells
    assert large.coarser(small.cells) == small
    assert again == large
    first, gradient = cells_after((64, False), (1, True))
    assert first == gradient == large


def test_a_run_with_a_sample_count_has_the_same_grid() -> None:
    grids = [*cells_after((SPP, False), (4, True), (SPP, True), told=4), *cells_after((4, True), (64, True), told=4)]
    assert len(set(grids)) == 1
    assert grids[0] == cells_after((4, True))[0]


# The learned tables of guided emission in the state of a run: they are restored exactly, and wrong data are rejected.

GRID = make_grid([True] * 4, [1.0, 3.0], 9)


def learned() -> Guiding:
    """Return `Guiding` with different learned contributions for two sensors."""
    guiding, random = Guiding(), np.random.default_rng(1)
    guiding.grid = GRID
    for number in (0, 3):
        draws = random.random(GRID.cells) * 100
        newer, film = (random.random((4, count)) for count in (GRID.cells, 6))
        learned = Learned.nothing(GRID).with_more(GRID, newer, draws, film)
        guiding.learned[number] = replace(learned, calls=5 + number)
    return guiding


def blank() -> Guiding:
    guiding = Guiding()
    guiding.grid = GRID
    return guiding


def test_learned_state_is_restored() -> None:
    before, after = learned(), blank()
    calls, arrays = before.state()
    assert after.restore(calls, arrays.__getitem__) is None
    assert list(after.learned) == [0, 3]
    for number, one in before.learned.items():
        assert after.learned[number].calls == one.calls
        for share in (0.0, 0.5, 1.0):
            np.testing.assert_array_equal(
                after.learned[number].density(GRID, share), one.density(GRID, share)
            )  # bit for bit
        assert one.film.any()
        np.testing.assert_array_equal(after.learned[number].film, one.film)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("0/sums", lambda sums: np.concatenate([sums, sums])),  # twice the rows, as in an older format
        ("0/sums", lambda sums: sums[:, ::2]),
        ("3/draws", lambda draws: draws[:-1]),
        ("0/draws", lambda draws: -draws),
        ("3/draws", lambda draws: draws * np.inf),
        ("0/film", lambda film: film[:1]),
        ("3/film", lambda film: film * np.nan),
    ],
)
def test_state_of_other_cells_is_refused_without_effect(name: str, wrong: Any) -> None:
    calls, arrays = learned().state()
    arrays[name] = wrong(arrays[name])
    after = learned()
    kept = dict(after.learned)
    assert after.restore(calls, arrays.__getitem__) == name
    assert after.learned == kept


# The cost of guided emission per step: nothing if it is off, and no new compilation of a kernel when it learns.


def test_later_steps_compile_nothing() -> None:
    """Later steps learn, but compile no large kernel. Neither tables nor seeds reach such a kernel as literals."""
    scene, ours, _ = guided("two_emitters", 0)
    kernels = Kernels()
    kernels.new(lambda: learn(scene, ours, 0))
    for seed in (1, 2):
        found = kernels.new(lambda: learn(scene, ours, seed))  # noqa: B023
        # Small kernels that copy a table depend on the address of the NumPy array.
        assert [kernel["operation_count"] for kernel in found if kernel["operation_count"] >= LARGE] == []


def test_a_step_stays_recorded_while_its_tables_learn() -> None:
    """If each new table caused a new recording, the step would no longer be recorded after a few tables."""
    scene, ours, _ = guided("two_emitters", 0, freeze=True)
    for seed in range(2):
        learn(scene, ours, seed)
    recordings = ours.preparation.recordings
    counts = recordings.counts()
    assert counts["fused"] > 0
    for seed in range(2, 12):
        learn(scene, ours, seed)
    assert recordings.counts() == counts
