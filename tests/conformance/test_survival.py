"""Learned roulette: the learned table, and unchanged means."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from conformance.attached_cases import CASES as MOVING
from conformance.drawing import SPP, by_harsh_table, guided, harsh

from reslrb_cli.estimators.attached import AttachedSweep
from reslrb_cli.guiding import collect as collecting
from reslrb_cli.guiding.collect import BINS, FLOOR, LEAN, SURE, Collected, Onward, collect
from reslrb_cli.guiding.tables import Purpose, learning_seed
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.transport.factors import BITS, CELLS, LEAST, SHAPE, Survival
from reslrb_cli.transport.walk import Hooks, walk

pytestmark = pytest.mark.usefixtures("llvm")


# Roulette by the expected later contributions of a path. test_drawing.py compares means of whole steps.

BOX = np.array([[-1.0, -2.0, 0.0], [3.0, 2.0, 0.0]], np.float32)  # flat in z


#: The parameter of the lamp lies before the moving slab. The parameters of the texture and the shell lie behind it.
BOUNCES = next(case for case in MOVING if case.name == "bounces")


@pytest.mark.long
@pytest.mark.parametrize("rr_depth", [2, 5, 1000])
@pytest.mark.parametrize("table", ["harsh", "learned"])
@pytest.mark.parametrize("estimator", ["stack", "reservoir"])
def test_means_hold_with_moving_light(estimator: str, table: str, rr_depth: int) -> None:
    """Guided and unguided means agree for parameters before and behind the moving object. Roulette on throughput is on
    (`rr_depth` 2) or off (5).
    """
    assert moving_means_hold(estimator, table, rr_depth, *((8, 16) if table == "harsh" else (24, 32)))


def moving_means_hold(estimator: str, table: str, rr_depth: int, count: int, spp: int) -> bool:
    """Return True if guided and unguided gradients agree for each parameter. The comparison projects both onto the
    unguided mean gradient.
    """
    moving, holds = BOUNCES.moving(), True
    ours, plain = (
        integrator("reslrb", 6, rr_depth, estimator=estimator, guiding=guiding, hide_emitters=True)
        for guiding in ("on", "off")
    )
    for lesson in seeds(1 if table == "harsh" else 8, 2):
        moving.gradient(ours, lesson, spp)
    ours.preparation.guiding.held = True
    if table == "harsh":
        by_harsh_table(ours.preparation.guiding)
    tracers = enumerate((ours, plain))
    sides = [[moving.gradient(each, seed, spp) for seed in seeds(count, block)] for block, each in tracers]
    for key in BOUNCES.start:
        guided_rows, rows = (np.stack([gradient[key] for gradient in side]) for side in sides)
        direction = rows.mean(0) / np.linalg.norm(rows.mean(0))
        result = compare((guided_rows @ direction)[:, None], (rows @ direction)[:, None], block=None)
        print(estimator, table, rr_depth, key, result)
        holds = holds and bool(result)
    return holds


def test_a_lost_weight_of_learned_roulette_is_found_with_moving_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fault applies the weights of learned roulette only together with roulette on throughput."""
    right = AttachedSweep.survived

    def survived(self: AttachedSweep, state: Any, weight: Any) -> Any:
        return right(self, state, weight) if self.p.plan.roulette else state

    monkeypatch.setattr(AttachedSweep, "survived", survived)
    assert not moving_means_hold("stack", "harsh", 5, 8, 16)


# What roulette learns about the later vertices and contributions of paths: compared with sums in NumPy.


def test_cells_are_indexed_by_position_and_octant() -> None:
    random = np.random.default_rng(2)
    o = random.uniform(-3, 4, (3, 1000)).astype(np.float32)
    d = random.normal(size=(3, 1000)).astype(np.float32)
    o[:, 0], o[0, 1], o[1, 2] = np.nan, np.inf, -np.inf
    cell = np.array(Survival.of(BOX, np.ones(CELLS)).cell(mi.Point3f(*o), mi.Vector3f(*d)))
    assert (cell < CELLS).all()
    size = np.where(BOX[1] > BOX[0], BOX[1] - BOX[0], np.inf)
    cube = np.clip(np.floor((o.T[3:] - BOX[0]) / size * 2**BITS), 0, 2**BITS - 1).astype(int)
    octant = (d.T[3:] > 0) @ np.array([4, 2, 1])
    expected = np.ravel_multi_index((*cube.T, octant), (2**BITS, 2**BITS, 2**BITS, 8))
    assert (cell[3:] != expected).mean() < 0.01  # rounding at the borders of cells
    assert len(np.unique(cell)) > 500


def test_the_probability_is_bounded_on_both_sides() -> None:
    """The bounds also hold for NaN, which gets the lower bound."""
    throughput = mi.Float([0.0, 1e-30, 0.1, 0.5, 1e30, np.inf, np.nan])
    for chance, expected in (
        (1.0, [LEAST, LEAST, LEAST, 0.5, 1, 1, LEAST]),
        (0.0, [LEAST] * 7),
        (np.inf, [LEAST, 1, 1, 1, 1, 1, LEAST]),
    ):
        survival = Survival.of(BOX, np.full(CELLS, chance))
        q = survival.probability(mi.Point3f(0), mi.Vector3f(1), throughput)
        np.testing.assert_allclose(np.array(q), expected)
        raised = np.array(throughput)[:5] / np.array(q)[:5]
        assert (raised <= np.maximum(np.array(throughput)[:5], 1 / chance if chance else np.inf)).all()


def walked(totals: tuple[float, float] = (4.0, 9.0), light: float = 2.0, **changes: Any) -> Collected:
    """Return the result of a walk of one path with two later vertices, which contributed `totals`."""
    whole, zeros = np.zeros((4, BINS)), np.zeros(CELLS)
    whole[:, 0] = [*totals, light, 2.0]
    return replace(Collected(None, np.zeros((2, CELLS)), zeros, zeros, whole, []), **changes)


def cell_of(x: int, y: int, z: int) -> int:
    return int(np.ravel_multi_index((x, y, z, 3), SHAPE))


def test_cells_share_with_their_neighbours_and_none_is_zero() -> None:
    """A well-sampled cell has the value of the formula in the docstring. A cell without samples has the value of its
    neighbours.
    """
    left = np.zeros(CELLS)
    loud, near, quiet, far = (cell_of(*cube) for cube in ((10, 10, 10), (10, 10, 11), (1, 1, 1), (1, 14, 1)))
    left[[loud, quiet]] = 1e6
    squares = np.zeros((2, CELLS))
    squares[0, loud], squares[1, loud] = 1e6 * 0.25 * 4, 1e6 * 0.5 * 9
    onward = Onward.nothing(BOX).with_more(walked(squares=squares, followed=2.0 * left, left=left), 1)
    for share, square in ((1.0, 0.25), (0.0, 0.5), (0.5, 0.375)):
        s = onward.chances(share)
        # (squared contributions relative to whole paths, times light squared) / (later vertices plus the cost of a ray)
        assert s[loud] == pytest.approx(SURE * np.sqrt(square * 4 / 2.2 * 3) / 2, rel=2e-3)
        assert s[quiet] == pytest.approx(SURE * np.sqrt(FLOOR * square / 2 * 4 / 2.2 * 3) / 2, rel=2e-3)
        assert (s >= s[quiet] * (1 - 1e-6)).all()
        assert s[near] == pytest.approx(s[loud], rel=1e-3)  # in the same larger cube as loud
        assert s[far] == pytest.approx(s[loud] / np.sqrt(2), rel=1e-3)  # near neither
    assert 1e6 > 1e3 * LEAN


def test_walks_without_contributions_change_nothing() -> None:
    onward = Onward.nothing(BOX)
    assert np.isinf(onward.chances(1.0)).all()
    for totals, light in (((0.0, 1.0), 1.0), ((1.0, 0.0), 1.0), ((np.nan, 1.0), 1.0), ((1.0, 1.0), 0.0)):
        assert onward.with_more(walked(totals, light), 1) is onward


def test_without_data_all_paths_survive() -> None:
    """No table ends paths in a scene whose paths do not continue beyond the first surface."""
    known = Onward.nothing(BOX).with_more(walked(), 1)
    assert known.light > 0
    for share in (0.0, 0.5, 1.0):
        assert np.isposinf(known.chances(share)).all()


def test_learned_state_does_not_depend_on_the_unit_of_light() -> None:
    """Throughputs are proportional to the light. The learned s is therefore inversely proportional to the light."""
    random = np.random.default_rng(3)
    squares, left = random.gamma(0.2, size=(2, CELLS)), random.integers(0, 300, CELLS).astype(float)
    sums = {"squares": squares, "followed": 2 * left, "left": left}
    s = Onward.nothing(BOX).with_more(walked(**sums), 1).chances(0.5)
    for unit in (1e-12, 1e12):
        brighter = walked((4.0 * unit**2, 9.0 * unit**2), 2.0 * unit, **sums)
        np.testing.assert_allclose(Onward.nothing(BOX).with_more(brighter, 1).chances(0.5) * unit, s, rtol=1e-5)


def walk_of(scene: Case, ours: Any, seed: int) -> Collected:
    """Return the data of one walk, from which a table would learn, with sums by cell as NumPy arrays."""
    leaves = scene.leaves()
    job = Job(scene.scene, scene.scene.sensors()[0], learning_seed(seed), SPP, scene.params)
    samples = ours.passes(job, Purpose.BOTH)[0]
    found = collect(samples, scene.adjoint)
    scene.release(leaves)
    squares = np.array(found.squares).reshape(-1, CELLS)
    return replace(found, squares=squares, followed=np.array(found.followed), left=np.array(found.left))


def collected(name: str, change: Callable[[Case, Any], None], count: int, block: int) -> np.ndarray:
    """Return the data that walks of two bounces collect after the first vertex, by octant of the outgoing ray. Each
    seed has one row. A row holds the squared contributions of each quantity, the later vertices, and the rays.
    """
    scene, ours, _ = guided(name, 3, max_depth=3)
    change(scene, ours)
    rows = []
    for seed in seeds(count, block):
        found = walk_of(scene, ours, seed)
        parts = [*found.squares, found.followed, found.left]
        rows.append(np.concatenate([part.astype(np.float64).reshape(-1, 8).sum(0) for part in parts]))
    return np.stack(rows)


def certain(scene: Case, ours: Any) -> None:
    """Let all paths survive."""
    harsh(scene, ours, np.inf)


@functools.cache
def heard_of_all() -> np.ndarray:
    """Return the data that walks without roulette collect. Their weights are 1, which no power changes."""
    return collected("two_emitters", certain, 24, 1)


@pytest.mark.parametrize("fault", [None, "square", "length"])
def test_collected_values_do_not_depend_on_roulette(fault: str | None, monkeypatch: Any) -> None:
    """The collected values do not contain the weights of roulette. Otherwise, a table would learn from its own
    weights.
    """
    expected = heard_of_all()
    if fault is not None:
        right = collecting.Trail.survives
        power = {"square": 3.0, "length": 0.0}[fault]
        monkeypatch.setattr(collecting.Trail, "survives", lambda self, weight: right(self, weight**power))
    result = compare(collected("two_emitters", harsh, 24, 0), expected, block=None)
    print(fault, result)
    assert bool(result) == (fault is None)


def test_later_contributions_are_collected_at_the_ray_of_the_bounce() -> None:
    """The numbers of rays and later vertices, and the squared contributions, equal sums in NumPy over the paths of the
    same seed.
    """

    class Keeping(Hooks):
        """Records for each path the ray that leaves the first vertex, its throughput, and the contribution of the
        second vertex.
        """

        def __init__(self, width: int) -> None:
            self.kept = dr.zeros(mi.Float, 10 * width)
            self.lane = 10 * dr.arange(mi.UInt32, width)

        def keep(self, first: int, active: Any, *values: Any) -> None:
            for k, value in enumerate(values):
                dr.scatter(self.kept, mi.Float(value), self.lane + (first + k), active)

        def vertex(self, state: Any, vertex: Any, connection: Any, scattering: Any, numbers: Any) -> Any:
            C = vertex.product.times(connection.c, vertex.depth).value()
            image = dr.squared_norm(self.colours.seen(C))
            self.keep(8, vertex.depth == 2, dr.select(connection.active, image, 0), 1)
            weight = dr.max(self.colours.seen(vertex.product.times(scattering.s, vertex.depth).magnitude()))
            self.keep(0, (vertex.depth == 1) & scattering.active, 1, weight, *vertex.si.p, *scattering.d)
            return state

    scene, ours, _ = guided("two_emitters", 1, max_depth=3)
    certain(scene, ours)
    found = walk_of(scene, ours, 5)
    job = Job(scene.scene, scene.scene.sensors()[0], learning_seed(5), SPP, scene.params)
    leaves = scene.leaves()  # differentiated parameters affect how lamps are drawn
    [samples] = ours.passes(job, Purpose.BOTH)
    scene.release(leaves)
    hooks = Keeping(samples.width)
    with dr.suspend_grad():
        dr.eval(walk(samples, hooks), hooks.kept)
    rows = np.array(hooks.kept, np.float64).reshape(-1, 10)
    rows = rows[(rows[:, 0] > 0) & (rows[:, 1] > 0)].T
    cell = np.array(samples.guide.table.survival.cell(mi.Point3f(*rows[2:5]), mi.Vector3f(*rows[5:8])))
    for values, sums in ((rows[0], found.left), (rows[9], found.followed), (rows[8] / rows[1] ** 2, found.squares[-1])):
        assert values.any()
        np.testing.assert_allclose(np.bincount(cell, values, CELLS), sums, rtol=1e-3, atol=1e-6 * sums.max())


def test_vertices_beyond_the_capacity_are_summed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The result is the same if one vertex or both vertices fit into the storage. In walks of two bounces, rays leave
    only the first vertex.
    """
    scene, ours, _ = guided("two_emitters", 1, max_depth=3)
    found = []
    for places in (32, 1):
        monkeypatch.setattr(collecting, "PLACES", places)
        found.append(walk_of(scene, ours, 5))
    assert found[0].left.sum() > 0
    for name in ("squares", "followed", "left"):
        np.testing.assert_allclose(getattr(found[1], name), getattr(found[0], name), rtol=1e-4)


def test_trained_tables_end_paths_with_small_contributions() -> None:
    """With the trained table, walks of equal seeds are shorter than walks without roulette."""
    scene, ours, _ = guided("roulette", 4, rr_depth=100)
    lengths = []
    for table in ("learned", "certain"):
        if table == "certain":
            certain(scene, ours)
        lengths.append(np.array(walk_of(scene, ours, 7).whole).reshape(-1, BINS)[-1].sum())
    print(lengths)
    assert lengths[0] < lengths[1]
