"""Guided emission is unbiased, also if the scene changes."""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from conformance.drawing import BY_NAME, SPP, guided, strength
from conformance.guiding_faults import FAULTS, learned_in_its_midst, same_numbers

import reslrb_cli
from reslrb_cli.estimators import base
from reslrb_cli.guiding import collect
from reslrb_cli.guiding import tables as guiding
from reslrb_cli.guiding.tables import EVERY, Guiding, make_grid
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.scenes.small import SIZE, diffuse, rgb, texture, transform
from reslrb_cli.transport import plan
from reslrb_cli.transport.samples import Guide, Table

pytestmark = pytest.mark.usefixtures("llvm")


# Guided numbers are uniform on average, and tables learn from numbers of their own. Faults that could cause bias are
# planted. test_drawing.py compares means of whole steps.

LANES = 2**14


def test_renders_of_a_script_learn_from_each_other() -> None:
    """The renders are forward and backward passes of `mi.render`. The tables are kept in the integrator."""
    reslrb_cli.register()
    scene = Case(BY_NAME["two_emitters"].scene(), BY_NAME["two_emitters"].keys)
    plugin = mi.load_dict({"type": "reslrb", "estimator": "stack", "max_depth": 4, "guiding": "on"})
    for seed in range(3):
        leaves = scene.leaves()
        image = mi.render(scene.scene, scene.params, integrator=plugin, spp=4, seed=seed)
        dr.backward(scene.objective(image))
        assert all(np.isfinite(np.array(dr.grad(leaf))).all() for leaf in leaves.values())
        scene.release(leaves)
    assert plugin.tracer.preparation.guiding.learned[0].calls == 3
    assert strength(plugin.tracer) > 1.2
    with pytest.raises(RuntimeError, match='"guiding" must be one of auto, off, on, not "maybe"'):
        mi.load_dict({"type": "reslrb", "guiding": "maybe"})


@pytest.mark.parametrize("fault", [None, *(pytest.param(one, marks=pytest.mark.long) for one in FAULTS)])
def test_samples_are_stratified_by_weight(fault: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """With any table, weighted means of functions of the numbers equal the means of uniform numbers. The test detects
    every planted fault.
    """
    if fault is not None:
        fault(monkeypatch)
    result = drawn_evenly()
    print(fault, result)
    assert bool(result) == (fault is None)


def drawn_evenly() -> Any:
    """Compare weighted sums over the numbers' intervals with sums of uniform numbers. The grid has three emitters and a
    table of large contrasts.
    """
    grid = make_grid([True] * 4, [1.0, 2.0, 0.5])
    density = np.random.default_rng(3).gamma(0.05, size=grid.cells)
    guide = Guide.of(Table.of(grid, guiding.apportion(grid, density)), LANES)
    rows = []
    for number in range(32):
        random = np.random.default_rng([number, 1])
        own = [mi.Float(random.random(LANES, np.float32)) for _ in range(5)]
        drawn = guide.draw(grid, LANES, mi.PCG32(LANES, number), own[0], mi.Point2f(*own[1:3]), mi.Point2f(*own[3:]))
        numbers = [drawn.choice, drawn.position.x, drawn.position.y, drawn.direction.x, drawn.direction.y]
        rows.append(histogram(numbers, np.array(drawn.weight, np.float64)))
    return compare(np.stack(rows), uniform(), block=None)


@functools.cache
def uniform() -> np.ndarray:
    """Return the sums of uniform numbers, with which the test compares each fault."""
    draws = (np.random.default_rng(number).random((5, LANES), np.float32) for number in range(32))
    return np.stack([histogram(list(own), np.ones(LANES)) for own in draws])


def histogram(numbers: list[Any], weights: np.ndarray) -> np.ndarray:
    """Return sums of weights over eighths of each number, and over pairs of halves of each two numbers."""
    values = np.stack([np.array(number, np.float64) for number in numbers])
    assert values.min() >= 0
    assert values.max() < 1
    single = [np.bincount((row * 8).astype(int), weights, 8) for row in values]
    halves = (values * 2).astype(int)
    pairs = [np.bincount(2 * a + b, weights, 4) for k, a in enumerate(halves) for b in halves[:k]]
    return np.concatenate([*single, *pairs])


@pytest.mark.parametrize("fault", [None, same_numbers, learned_in_its_midst])
def test_tables_use_their_own_random_numbers_and_change_between_steps(
    fault: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault is not None:
        fault(monkeypatch)
    assert learns_apart(monkeypatch) == (fault is None)


def learns_apart(patch: pytest.MonkeyPatch) -> bool:
    """Return True if the walks of each of two steps use one table, and learning uses seeds that no other walk has."""
    walks: dict[bool, list[tuple[int, int]]] = {True: [], False: []}
    right, tables = base.walk, []  # held, so that no other table reuses an address

    def seen(learning: bool) -> Any:
        def walk(samples: Any, *given: Any) -> Any:
            tables.append(samples.guide.table)
            walks[learning].append((int(samples.seed[0]), id(samples.guide.table.slots)))
            return right(samples, *given)

        return walk

    patch.setattr(base, "walk", seen(False))
    patch.setattr(collect, "walk", seen(True))
    scene, ours, _ = guided("two_emitters", 0, estimator="gather")
    del ours.preparation.guiding.due
    for seed in (1, 2):
        scene.gradient(ours, seed, SPP, adjoint="correlated")
    assert len(walks[True]) >= 2
    by_seed: dict[int, set[int]] = {}
    for seed, table in walks[False]:
        by_seed.setdefault(seed, set()).add(table)
    one_each = len(by_seed) == 2 and all(len(each) == 1 for each in by_seed.values())
    return one_each and not {seed for seed, _ in walks[True]} & set(by_seed)


# A scene that changes so that a table becomes wrong: a shutter slides from one opening of a room to the other.

#: Steps with each of the two openings. The shutter slides just after the tables have learned, so that the time to the
#: next learning is as long as it ever is.
BEFORE, WITHIN = 2 * EVERY, 20
AT_FIRST, AT_LAST = 2.0, 1.1  # largest error of a guided step, relative to unguided samples
TELLING = 0.1  # largest standard error, as a share of the limit, that allows a verdict
RIGHT, LEFT = 0.6, -0.6  # positions of the shutter
KEY = "ground.reflectance.data"


def place(x: float) -> Any:
    """Return the position of the shutter, closely below the ceiling."""
    return transform(translate=[x, 0.98, 0], rotate=([1, 0, 0], 90), scale=[0.25, 0.35, 1])


def chamber() -> dict[str, Any]:
    """Return a closed room under a sky, with two openings in its ceiling. A shutter covers the opening on the right."""
    grey = {"type": "twosided", "bsdf": diffuse(0.6, 0.6, 0.6)}
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 80,
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0.2, 0.9], target=[0, -1, -0.2], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb",
                     "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        "ground": {"type": "diffuse", "reflectance": texture(3, 6)},
        "grey": grey,
        "floor": {"type": "rectangle", "to_world": transform(translate=[0, -1, 0], rotate=([1, 0, 0], -90)),
                  "bsdf": {"type": "ref", "id": "ground"}},
        "shutter": {"type": "rectangle", "to_world": place(RIGHT), "bsdf": {"type": "ref", "id": "grey"}},
        "sky": {"type": "constant", "radiance": rgb(1.0, 1.2, 1.5)},
    }  # fmt: skip
    for number in range(4):
        turned = transform(rotate=([0, 1, 0], 90 * number), translate=[0, 0, -1])
        scene[f"wall_{number}"] = {"type": "rectangle", "to_world": turned, "bsdf": {"type": "ref", "id": "grey"}}
    strips = ((0, 0.65, 1, 0.35), (0, -0.65, 1, 0.35), (-0.9, 0, 0.1, 0.3), (0, 0, 0.4, 0.3), (0.9, 0, 0.1, 0.3))
    for number, (x, z, wide, deep) in enumerate(strips):
        lies = transform(translate=[x, 1, z], rotate=([1, 0, 0], 90), scale=[wide, deep, 1])
        scene[f"strip_{number}"] = {"type": "rectangle", "to_world": lies, "bsdf": {"type": "ref", "id": "grey"}}
    return scene


def slide(scene: Case, x: float) -> None:
    """Move the shutter to the horizontal position `x`."""
    scene.params["shutter.to_world"] = mi.Transform4f(place(x).matrix)
    scene.params.update()


def rows(scene: Case, ours: Any, count: int, block: int) -> np.ndarray:
    """Return the gradients of `count` steps from which no table learns, (count, P)."""
    tables = ours.preparation.guiding
    if tables is not None:
        tables.held = True
    found = scene.gradients(ours, seeds(count, block), SPP, adjoint="correlated")
    if tables is not None:
        tables.held = False
    return found


def errors(count: int, before: int = BEFORE) -> tuple[tuple[float, float], ...]:
    """Return root mean square errors of guided steps relative to unguided steps, with standard errors. The errors are
    measured before the shutter slides, in the first step afterwards, and WITHIN steps later.
    """
    scene = Case(chamber(), [KEY])
    ours, plain = (integrator("reslrb", 5, 1000, estimator="stack", guiding=tables) for tables in ("on", "off"))
    found, blocks = [], iter(range(100))

    def compared() -> tuple[float, float]:
        squares = []
        for each in (ours, plain):
            gradients = rows(scene, each, count, next(blocks))
            squares.append(np.square(gradients - gradients.mean(0)).sum(1) / (count - 1))
        guided, even = (row.sum() for row in squares)
        spread = sum(row.var(ddof=1) * count / row.sum() ** 2 for row in squares)
        ratio = float(np.sqrt(guided / even))
        return ratio, ratio * float(np.sqrt(spread)) / 2

    for seed in range(before):
        scene.gradient(ours, 9000 + seed, SPP, adjoint="correlated")
    found.append(compared())
    slide(scene, LEFT)
    found.append(compared())
    for seed in range(WITHIN):
        scene.gradient(ours, 9500 + seed, SPP, adjoint="correlated")
    found.append(compared())
    return tuple(found)


def holds(found: tuple[tuple[float, float], ...]) -> bool:
    """Return True if no error exceeds its limit by more than three of its standard errors."""
    print(found)
    assert found[0][0] + 3 * found[0][1] < 1, "the table has learned nothing"
    assert found[1][0] - 3 * found[1][1] > 1, "what has changed does not matter to the table"
    beyond = [ratio - 3 * error > limit for (ratio, error), limit in zip(found[1:], (AT_FIRST, AT_LAST), strict=True)]
    telling = (error < TELLING * limit for (_, error), limit in zip(found, (1, AT_FIRST, AT_LAST), strict=True))
    assert any(beyond) or all(telling), "too few steps to tell"
    return not any(beyond)


@pytest.mark.long
@pytest.mark.parametrize(("count", "before"), [(32, BEFORE), (100, 8 * EVERY)])
def test_a_wrong_table_does_little_harm_and_is_soon_corrected(count: int, before: int) -> None:
    assert holds(errors(count, before))


@pytest.mark.long
def test_tables_that_update_too_late_are_too_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.guiding import tables

    monkeypatch.setattr(tables, "EVERY", 2 * EVERY)
    assert not holds(errors(32))


@pytest.mark.long
def test_tables_that_stop_learning_stay_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    right = Guiding.due

    def due(self: Guiding, number: int) -> bool:
        return right(self, number) and (not self.learned or self.learned[0].calls <= BEFORE)

    monkeypatch.setattr(Guiding, "due", due)
    assert not holds(errors(32))


@pytest.mark.long
def test_tables_without_a_uniform_share_are_too_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guiding, "GUIDE_UNIFORM", 0.02)
    monkeypatch.setattr(plan, "SLOTS_PER_CELL", 64)
    assert not holds(errors(32))
