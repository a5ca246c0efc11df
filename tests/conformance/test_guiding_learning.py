"""How tables of guided emission learn: from recorded walks as from plain ones, of cells that passes can tell apart."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from conformance.test_guiding import SPP, guided, sample

from reslrb_cli.guiding.collect import KEEP
from reslrb_cli.guiding.tables import BLUR, FINE, Learned, _blurred, grid_for, learnings, most_cells
from reslrb_cli.integrators import freezing
from reslrb_cli.measure.gradients import relative
from reslrb_cli.transport.guide import Table, apportion, make_grid
from reslrb_cli.transport.plan import Grid

pytestmark = pytest.mark.usefixtures("llvm")
SIDE = 16  # pixels of the film


def taught(name: str, steps: int, **options: Any) -> Any:
    """The tracer of a case after so many gradients, each of which its tables learned from."""
    scene, ours, _ = guided(name, 0, **options)
    ours.preparation.guiding.due = lambda number: True
    for seed in range(steps):
        sample(scene, ours, seed)
    return ours


@pytest.mark.parametrize("name", ["two_emitters", "envmap"])
def test_what_a_recorded_walk_says_is_what_a_plain_one_does(name: str) -> None:
    """Bit by bit with one thread, as tests have it; and tables that have changed are no reason to record anew."""
    plain, recorded = (taught(name, 7, freeze=freeze) for freeze in (False, True))
    for one, other in zip(*(each.preparation.guiding.learned.values() for each in (plain, recorded)), strict=True):
        assert relative(one.sums, other.sums) < 1e-3
        assert relative(one.draws, other.draws) < 1e-3
        assert dr.thread_count() > 1 or np.array_equal(one.sums, other.sums)
        assert dr.thread_count() > 1 or np.array_equal(one.draws, other.draws)
    counts = recorded.preparation.recordings.counts()
    assert 1 <= counts["hear"] <= 2
    assert counts["fused"] <= 2


def test_walks_of_many_paths_are_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(freezing, "MOST_PATHS_APART", 1)
    counts = taught("two_emitters", 2, freeze=True).preparation.recordings.counts()
    assert "hear" not in counts
    assert counts["fused"] > 0


def test_tables_lie_where_every_kernel_finds_them_alike() -> None:
    """In memory that Dr.Jit aligns, wherever NumPy has what they are made of."""
    grid, kept = make_grid([True] * 4, [1.0, 2.0], 8), []
    for number in range(20):
        counts = apportion(grid, np.random.default_rng(number).random(grid.cells))
        table = Table.of(grid, counts.astype(np.uint32))
        kept.append((table, np.zeros(number)))
        for array in (table.slots, table.weights, table.edges):
            assert array.numpy().ctypes.data % 32 == 0


def test_tables_learn_often_at_first_and_soon_enough_later() -> None:
    """What a run is told that it pays for is what it has."""
    scene, ours, _ = guided("two_emitters", 0)
    guiding = ours.preparation.guiding
    del guiding.due
    scene.gradient(ours, 1, 1, adjoint="correlated")
    learned = [1, *(gradient for gradient in range(2, 101) if guiding.due(0))]
    assert learned == [1, 2, 4, 8, 16, 32, 48, 64, 80, 96]
    assert [learnings(k) for k in range(1, 101)] == [sum(one <= k for one in learned) for k in range(1, 101)]


@pytest.mark.parametrize("worse", [0.3, 1.0, 3.0])
def test_tables_that_do_harm_learn_as_often_as_at_first(worse: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """But no oftener where they go on to do harm: only what learns rarely begins anew."""
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
def test_what_a_table_does_to_those_who_speak_is_what_it_is_worth(weight: float) -> None:
    """Of a voice that speaks where paths weigh so much, and beside one that speaks where they weigh nothing of note."""
    grid, paths = make_grid([True] * 4, [1.0], 8), 1e4
    rare = np.arange(grid.cells) < 8
    others = (1 - (rare * grid.measures()).sum() / weight) / (~rare * grid.measures()).sum()
    draws = paths * grid.measures() * np.where(rare, 1 / weight, others)
    assert draws.sum() == pytest.approx(paths)
    heard = np.stack([rare * draws, ~rare * draws])
    alone = Learned.nothing(grid).with_more(grid, heard[[0, 0]], draws)
    assert alone.worse == pytest.approx(weight, rel=1e-5)
    assert Learned.nothing(grid).with_more(grid, heard, draws).worse == pytest.approx(
        (weight + 1 / others) / 2, rel=1e-5
    )
    assert Learned.nothing(grid).with_more(grid, 0 * heard, draws).worse == 1


# ---- Cells -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("paths", [100, 4096, 20_000, 10**7])
@pytest.mark.parametrize("weights", [[1.0], [1.0, 1e-3, 2.0]])
def test_a_grid_is_as_fine_as_its_walks_can_ever_tell(paths: int, weights: list[float]) -> None:
    finest = grid_for([True] * 4, weights, 1)
    grid = grid_for([True] * 4, weights, 1, paths)
    assert finest.coarser(grid.cells) == grid  # made of the same cuts
    heard, used = 0.0, []
    for _ in range(200):
        heard = KEEP * heard + paths
        used.append(finest.coarser(min(FINE * heard, most_cells(paths))).cells)
    assert max(used) == grid.cells <= finest.cells


def test_a_grid_of_few_cells_says_what_the_finest_does() -> None:
    """Of the same paths, heard by either: each of its cells is drawn as those are that it is made of."""
    finest, paths = make_grid([True] * 4, [1.0, 3.0], 14), 500
    grid = finest.coarser(most_cells(paths))
    assert grid.cells < finest.cells
    random, both = np.random.default_rng(7), [Learned.nothing(each) for each in (finest, grid)]
    for _ in range(3):
        heard, draws = random.gamma(0.1, size=(3, finest.cells)), paths * finest.measures()
        both[0] = both[0].with_more(finest, heard, draws)
        few = np.stack([finest.summed(row, grid) for row in heard])
        both[1] = both[1].with_more(grid, few, finest.summed(draws, grid))
        for share in (0.0, 0.5, 1.0):
            expected = finest.summed(both[0].density(finest, share), grid)
            np.testing.assert_allclose(both[1].density(grid, share), expected, rtol=1e-4)
    again = both[1].on(finest, grid)  # what was learned is kept where cells become finer
    np.testing.assert_allclose(again.density(finest, 0.2), both[0].density(finest, 0.2), rtol=1e-4)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("bits", [(3, 2, 4, 3), (0, 1, 0, 2), (2, 0, 0, 0), (0, 0, 0, 0)])
def test_cells_are_smoothed_over_their_neighbours(bits: Any, kind: Any) -> None:
    """With their weights along each number, the last cell counted again beyond the end; nothing goes from one emitter
    to another, and a sum stays what it was."""
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
    """The grid after each of some calls on a tracer, which may be told the samples of its passes."""
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
            # It has learned from the first two, as far as there are two.
            assert learned.draws.sum() > 0.99 * KEEP * SIDE * SIDE * sum(gradients[:2])
        assert (ours.preparation.guiding.learned == {}) == (gradients == [])
    return found


def test_the_first_pass_settles_the_grid_and_gradients_of_more_samples_refine_it() -> None:
    small, image, large, again = cells_after((1, True), (64, False), (64, True), (1, True))
    assert small == image
    assert 16 * small.cells <= large.cells <= 128 * small.cells
    assert large.coarser(small.cells) == small
    assert again == large
    first, gradient = cells_after((64, False), (1, True))
    assert first == gradient == large


def test_a_run_that_says_so_has_the_same_grid_whatever_comes_first() -> None:
    grids = [*cells_after((SPP, False), (4, True), (SPP, True), told=4), *cells_after((4, True), (64, True), told=4)]
    assert len(set(grids)) == 1
    assert grids[0] == cells_after((4, True))[0]
