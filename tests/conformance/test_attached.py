"""Derivatives of what moves light: `stack` against naive AD of the same paths, ours and Mitsuba's.

At equal seeds rounding alone is between them, so that a distance is a fault, and not noise. `walk_ad` shares our walk's
faults; `ptracer` shares none, but its shadow rays start a little off the surface, which is what the two references are
apart by. So a fault of the walk shows where `stack` is farther from `ptracer` than that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conformance.attached_cases import CASES, AttachedCase
from conformance.attached_faults import FAULTS, AttachedFault
from conformance.moving import Moving, enclosed
from measure.test_mutations import plant

from reslrb_cli.integrators.protocol import StepIntegrator
from reslrb_cli.measure.comparison import Family, compare_expectations
from reslrb_cli.measure.gradients import integrator, relative, seeds
from reslrb_cli.records.measurements import Verdict

pytestmark = pytest.mark.usefixtures("llvm")

#: What Mitsuba's own light tracer differs by, relative to the entries, over many seeds (`measure.gradcheck`).
STOCK_ROUNDING = 1e-3
#: What twice the distance of the two references may be: more is a fault of the walk that both of ours share.
FARTHEST = 1e-3
#: An odd number of them, so that the median is one of theirs.
SEEDS = (1, 2, 3)
BY_NAME = {case.name: case for case in CASES}
DEEP = {"slab.vertex_positions": None, "shell.bsdf.reflectance.value": None}


def tracer(case: AttachedCase, name: str) -> StepIntegrator:
    """One of the integrators of a case."""
    options: dict[str, Any] = {"hide_emitters": True} | case.both
    if name != "ptracer":
        options |= {"filter_normalization": "detached"}
    if name == "walk_ad":
        options |= {"attached": True}
    if name == "reslrb":
        options |= {"estimator": "stack", "attached_sampling": "follow"} | case.ours
    return integrator(name, case.depth, **options)


def distances(case: AttachedCase) -> Iterator[tuple[str, float, float]]:
    """Of each comparison: what it is, the distance, and the largest that may be.

    Medians over seeds: rounding sends a path of rough glass another way now and then, on some processors more often
    than on others, and its seed then says nothing. A fault of the code is there at every seed.
    """
    moving = case.moving()
    tracers = {name: tracer(case, name) for name in ("reslrb", "walk_ad", *(["ptracer"] if case.stock else []))}
    found = [{name: moving.gradient(each, seed, case.spp) for name, each in tracers.items()} for seed in SEEDS]

    def distance(name: str, left: str, right: str) -> float:
        return float(np.median([relative(gradients[left][name], gradients[right][name]) for gradients in found]))

    for name in found[0]["walk_ad"]:
        assert all(gradients["walk_ad"][name].any() for gradients in found), f"nothing to compare: {name}"
        # What the references differ by is theirs, and much where terms cancel. If NaN stood anywhere it would show.
        apart = distance(name, "walk_ad", "ptracer") if case.stock else 0.0
        limit = max(case.limit, 2 * apart)
        for reference in list(tracers)[1:]:
            yield f"{name}, {reference}", distance(name, "reslrb", reference), limit


def check(case: AttachedCase) -> None:
    """Assert that every distance is within its limit, and that the references themselves agree."""
    for what, distance, limit in distances(case):
        print(f"{case.name}: {what}: {distance:.1e}, at most {limit:.1e}")
        assert distance <= limit, f"{what}: {distance:.1e} > {limit:.1e}"
        assert limit <= FARTHEST, f"{what}: the references are {limit / 2:.1e} apart"


@pytest.mark.parametrize("name", [pytest.param(c.name, marks=() if c.quick else pytest.mark.long) for c in CASES])
def test_equal_seeds(name: str):
    check(BY_NAME[name])


@pytest.mark.long
@pytest.mark.parametrize("name", [case.name for case in CASES if case.stock])
def test_means_over_seeds_agree_with_ptracer(name: str):
    """By gradcheck's tests: they would see a fault that the distances at one seed are too coarse for."""
    case, many = BY_NAME[name], seeds(8)
    moving = case.moving()
    ours, stock = (
        [moving.gradient(tracer(case, integrator), seed, case.spp) for seed in many]
        for integrator in ("reslrb", "ptracer")
    )
    naive = moving.gradient(tracer(case, "walk_ad"), many[0], case.spp)
    for key in ours[0]:
        mine, theirs = (np.stack([gradient[key] for gradient in side]) for side in (ours, stock))
        # An entry is a sum of terms as large as the largest one, which may cancel: what rounding and the references'
        # own distance leave is by their size, not by its. `apart` is that of naive AD of our walk from stock.
        apart = relative(naive[key], theirs[0])
        assert apart <= FARTHEST / 2
        floor = max(case.limit, apart) * float(np.abs(theirs.mean(0)).max())
        found = compare_expectations(mine, theirs, Family(30, 3000), rounding=STOCK_ROUNDING, bias=floor)
        print(name, key, found)
        assert found.verdict is not Verdict.FAILS


def deep(depth: int, stack_size: int, **options: Any) -> dict[str, np.ndarray]:
    """The gradient through long paths, with a stack of this size."""
    moving = Moving(enclosed(albedo=0.95), DEEP)
    return moving.gradient(integrator("reslrb", depth, estimator="stack", stack_size=stack_size, **options), 3, 4)


@pytest.mark.parametrize(
    ("depth", "sizes", "options"),
    [
        (16, (2,), {"rr_depth": 4}),
        pytest.param(16, (1, 8), {"rr_depth": 4}, marks=pytest.mark.long),
        pytest.param(16, (1, 2, 8), {}, marks=pytest.mark.long),
        pytest.param(128, (1, 2, 8), {}, marks=pytest.mark.long),
        pytest.param(128, (1, 2, 8), {"rr_depth": 4}, marks=pytest.mark.long),
    ],
)
def test_a_small_stack_equals_a_large_one(depth: int, sizes: tuple[int, ...], options: dict[str, Any]):
    expected = deep(depth, 128, **options)
    for size in sizes:
        for key, value in deep(depth, size, **options).items():
            # Rounding makes 4e-7 with vectors of 16 lanes, 1.7e-5 with those of 8.
            assert relative(value, expected[key]) < 1e-4, f"{key}, {size} places"
            assert value.any()


@pytest.mark.long
def test_normalization_of_the_filter_makes_a_difference():
    """Else that it is attached or detached would not show in any of these tests."""
    case = BY_NAME["slab"]
    moving = case.moving()
    attached, detached = (
        moving.gradient(integrator("reslrb", case.depth, estimator="stack", filter_normalization=kind))
        for kind in ("attached", "detached")
    )
    assert relative(attached["slab.vertex_positions"], detached["slab.vertex_positions"]) > 1e-3
    naive = moving.gradient(integrator("walk_ad", case.depth, attached=True))
    assert relative(attached["slab.vertex_positions"], naive["slab.vertex_positions"]) < case.limit


# ---- The code broken on purpose ----


def test_enough_faults():
    assert len(FAULTS) >= 10
    assert {fault.case for fault in FAULTS} <= set(BY_NAME)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_it_fits_the_code(fault: AttachedFault, monkeypatch: pytest.MonkeyPatch):
    plant(fault, monkeypatch)


@pytest.mark.parametrize(
    "fault", [pytest.param(f, id=f.name, marks=() if f.quick else pytest.mark.long) for f in FAULTS]
)
def test_fault(fault: AttachedFault, monkeypatch: pytest.MonkeyPatch):
    plant(fault, monkeypatch)
    with pytest.raises(AssertionError):
        check(replace(BY_NAME[fault.case], stock=fault.stock))
