"""The extreme suite, a part of it by default and all of it with `-m long`. The suite finds earlier faults again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.estimators.base import Pass
from reslrb_cli.estimators.gather import Gathering, Taking
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.measure import extreme
from reslrb_cli.measure.comparison import ALPHA, Family, compare_expectations, divisions, overall, parts
from reslrb_cli.measure.extreme import MOST_CASES, WAYS, run_case
from reslrb_cli.measure.gradients import integrator, seeds
from reslrb_cli.measure.scenes import case as scenes_case
from reslrb_cli.measure.scenes.case import Differences, ReferenceGradients
from reslrb_cli.measure.scenes.catalogue import CASES, TAGGED
from reslrb_cli.records.measurements import Comparison, GradcheckRecord, Reference, Verdict

#: The case of the default suite: a lamp of which no point can be drawn. test_replay.py has values that are not finite,
#: and test_plan.py scenes without a connection. Tests of roulette with its fault, and of a furnace, stand below.
FEW = ("black_lamp",)


def failures(records: Iterable[GradcheckRecord]) -> list[str]:
    """Return the failing records as JSON, one line each."""
    return [record.to_json() for record in records if record.holds is False]


def test_names():
    assert 40 <= len(CASES) <= MOST_CASES
    assert len(CASES) == sum(map(len, TAGGED.values())), "no two have the same"


def counted(monkeypatch: pytest.MonkeyPatch, name: str, estimators: Iterable[str] | None) -> list[GradcheckRecord]:
    """Run a case. Assert that its correction counts all comparisons by z scores, and their entries."""
    made: list[tuple[Family, int]] = []

    def compare(ours: np.ndarray, reference: np.ndarray, family: Family, **options: Any) -> Comparison:
        shape = options.get("shape")
        sizes = ours.shape[1] if shape is None else parts(ours, shape, divisions(shape)[0]).shape[1]
        made.append((family, sizes if shape is None else sizes + overall(ours).shape[1]))
        return compare_expectations(ours, reference, family, **options)

    monkeypatch.setattr(extreme, "compare_expectations", compare)
    records = list(run_case(CASES[name], estimators))
    [family] = {family for family, _ in made}
    assert family == Family(len(made), sum(entries for _, entries in made), ALPHA / MOST_CASES)
    assert not failures(records)
    return records


@pytest.mark.parametrize(("name", "estimator"), [(name, "stack") for name in FEW])
def test_case(monkeypatch: pytest.MonkeyPatch, name: str, estimator: str):
    records = counted(monkeypatch, name, [estimator])
    assert {record.label for record in records} == {f"reslrb:{estimator}"}


def test_images_with_heavy_tails_are_open_only_for_a_reason():
    """One seed has a firefly, and the other noise hides no deviation."""
    random, case, family = np.random.default_rng(1), CASES["furnace"], Family(10, 1000)
    ours, stock = (1 + 0.01 * random.normal(size=(16, 8, 8, 3)) for _ in range(2))
    assert extreme._images(case, ours, stock, family).verdict is Verdict.HOLDS
    ours[3] += 50
    found = extreme._images(case, ours, stock, family)
    assert (found.verdict, found.message[:13]) == (Verdict.FAILS, "heavy_tailed:")
    known = replace(case, open_ended={extreme.IMAGE: "a reason"})
    found = extreme._images(known, ours, stock, family)
    assert (found.verdict, found.message) == (Verdict.HEAVY_TAILED, "a reason")


class Polynomial:
    """Stand-in for a `Case` of three parameters, with derivatives (1, 2, 3) and a third-order term along each axis."""

    size = 3

    def __init__(self) -> None:
        self.taken: list[tuple[range, int, float, str]] = []

    def directions(self, count: int) -> np.ndarray:
        return np.array([[1.0, -1.0, 0.5], [-0.5, 1.0, -1.0]])[:count]

    def differences(self, _tracer: Any, along: np.ndarray, seeds: range, spp: int, step: float, sides: str = "both"
                    ) -> np.ndarray:  # fmt: skip
        self.taken.append((seeds, spp, step, sides))
        return np.tile(along @ [1, 2, 3] + 5 * step**2, (len(seeds), 1))


@pytest.mark.parametrize("name", ["albedo_0", "albedo_0_roulette", "opacity_0.4", "slope_0"])
def test_differences_along_random_directions_and_amplitudes(name: str, monkeypatch: pytest.MonkeyPatch):
    case, setup, options = CASES[name], Polynomial(), list[dict[str, Any]]()
    monkeypatch.setattr(scenes_case, "integrator", lambda _name, **given: options.append(given))
    source = case.source
    assert isinstance(source, Differences)
    found = source.samples(case, setup)
    roulette = "rr_depth" in case.options
    assert options == [{"max_depth": case.options["max_depth"]}], "without roulette"
    assert found.paired is not roulette
    near = (seeds(case.seeds, 1 if roulette else 0), case.spp, source.step, source.sides)
    assert found.values.shape == (case.seeds, source.directions(setup))
    if source.left is None:
        assert setup.taken == [near]
        expected = setup.directions(2) if source.sides == "both" else np.abs(setup.directions(2))
        np.testing.assert_array_equal(found.along, expected)
        return
    assert setup.taken == [near, (*near[:2], 2 * source.step, "both")]
    np.testing.assert_allclose(found.values[0], [1, 2, 3])
    np.testing.assert_allclose(found.bias, 0.5 * source.step**2 + source.left * np.sqrt(14 / 3))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("refraction", "point or parallel lights"),
        ("slab", "directionalarea"),
        ("nested_dielectrics", "hardly ever find"),
    ],
)
def test_camera_paths_are_left_out_of_light_that_they_cannot_find(name: str, reason: str):
    [record] = run_case(CASES[name], ["stack(paths=camera)"])
    assert (record.verdict, record.options) == (Verdict.NO_REFERENCE, {"paths": "camera"})
    assert reason in record.message


@pytest.mark.long
def test_along_the_border_camera_paths_are_compared_with_a_complete_reference():
    """`ptracer` loses light along the film's border, and is therefore no reference for camera paths. The comparison
    would report the missing light.
    """
    records = list(run_case(CASES["film_crop"], WAYS[:1]))
    assert {record.reference.value for record in records} == {"walk_ad", "prb", "path"}
    assert {record.options["paths"] for record in records} == {"both"}
    assert all(record.holds for record in records)


def test_refused_entries_are_counted_at_each_seed(monkeypatch: pytest.MonkeyPatch):
    """Three entries of dL/dI are not finite."""
    ones = np.ones((3, 6))
    monkeypatch.setattr(scenes_case.Stock, "samples", lambda *_: ReferenceGradients(ones))
    case = replace(CASES["nan_loss"], naive=False, image="", seeds=3)
    for refused, verdict in (([3, 3, 3], Verdict.HOLDS), ([3, 2, 3], Verdict.FAILS)):
        steps = ones, np.ones((3, 16, 16, 3)), refused
        monkeypatch.setattr(extreme, "_steps", lambda *_, steps=steps: steps)
        *_, record = run_case(case, ["stack"])
        assert (record.parameter, record.reference, record.verdict) == (None, Reference.ANALYTIC, verdict)


def test_moving_cases_use_only_light_paths():
    assert not list(run_case(CASES["slope_0"], WAYS))


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_every_case(monkeypatch: pytest.MonkeyPatch, name: str):
    counted(monkeypatch, name, None)


def lost(case: str, estimator: str) -> list[str]:
    return failures(run_case(CASES[case], [estimator]))


@pytest.mark.long
def test_selection_by_contribution_loses_later_vertices_of_a_heavy_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("reslrb_cli.estimators.selection.SHARE", 0.0)
    records = run_case(CASES["connection_1e8"], ["reservoir", "event"])
    assert {record.label for record in records if record.holds is False} == {"reslrb:reservoir", "reslrb:event"}


@pytest.mark.long
def test_roulette_by_throughput_loses_light_behind_a_dark_surface(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("reslrb_cli.transport.factors.DIM", 1e-30)
    assert lost("albedo_1e-6_roulette", "stack")


@pytest.mark.long
def test_roulette_by_power_loses_dim_lamps(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("reslrb_cli.transport.factors.DIMMEST", 1.0)
    assert lost("emission_1e-25_roulette", "gather")


@pytest.mark.long
def test_sampling_by_radiance_undersamples_the_sky_beside_a_sun(monkeypatch: pytest.MonkeyPatch):
    def variance() -> float:
        # Half of the seeds are enough. Eight seeds give the variance to within a half, and the test looks for a factor
        # of 100.
        rows = run_case(CASES["sun_1e6"], ["stack"], seeds=8)
        [ratio] = [row.variance_ratio for row in rows if row.parameter == "sky.data" and row.reference == "prb"]
        assert ratio is not None
        return ratio

    before = variance()
    monkeypatch.setattr("reslrb_cli.transport.lamps.DEFENSIVE", 1e-9)
    assert variance() > 100 * before


def test_a_replay_leaves_no_residue_because_its_sums_are_compensated(monkeypatch: pytest.MonkeyPatch):
    case = CASES["furnace"]

    def left() -> float:
        """Return the size of what the replay leaves of the sums, divided by the size of the sums at the start."""
        setup = case.setup()
        leaves, seed = setup.leaves(), mi.UInt32(1)
        tracer = integrator("reslrb", **case.options, estimator="gather")
        with dr.suspend_grad(), dr.isolate_grad():
            [samples] = tracer.passes(Job(setup.scene, setup.scene.sensors()[0], seed, case.spp, setup.params))
            p = Pass(samples, None, samples.film.adjoint(setup.weights))
            state = p.walk(Gathering(p))
            dr.eval(state)
            [S] = state.S
            last = p.walk(Taking(p, state.visibility, S), state.visibility.last > 0)
            sizes = [np.linalg.norm(np.array(value, np.float64)) for value in (last.value + last.rest, S.value)]
        setup.release(leaves)
        return float(sizes[0] / sizes[1])

    def add(value: Any, rest: Any, term: Any) -> tuple[Any, Any]:
        return value + term, rest

    assert left() < 1e-10
    monkeypatch.setattr("reslrb_cli.estimators.gather.AdjointSum._add", staticmethod(add))
    assert left() > 1e-8
