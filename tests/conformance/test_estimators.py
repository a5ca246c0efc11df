"""Every estimator in every case: exact ones equal naive AD of the same paths, the others do in expectation.

The cases' own references (test_gradient_reference.py) say that naive AD of our walk is right. Here it is the reference
at equal seeds, which sees what a test over many seeds cannot.
"""

from __future__ import annotations

import numpy as np
import pytest
from agreement import compare
from conformance.gradient_cases import AT_EQUAL_SEEDS, CASES, GradientCase
from turns import a_few, taking_turns

from reslrb_cli.measure.gradients import Case, integrator, relative, seeds

pytestmark = pytest.mark.usefixtures("llvm")
EXACT = {"gather": {}, "stack": {}, "stack_of_2": {"estimator": "stack", "stack_size": 2}}
RANDOM = {
    "reservoir": {},
    "reservoir_of_4": {"estimator": "reservoir", "capacity": 4},
    "event": {},
    "event_of_4": {"estimator": "event", "capacity": 4},
}
BY_ADJOINT = {
    "reservoir_by_adjoint": {"estimator": "reservoir", "weight": "adjoint"},
    "event_by_adjoint": {"estimator": "event", "weight": "adjoint"},
}
#: Options that belong to the reservoir alone.
OF_RESERVOIR = {"image"}


def estimator(case: GradientCase, name: str, options: dict):
    """The integrator of a case with this estimator."""
    own = {key: value for key, value in case.options.items() if key not in OF_RESERVOIR}
    return integrator("reslrb", **case.both | own | {"estimator": name} | options)


@taking_turns("case", CASES, "adjoint", ("correlated", "independent"), AT_EQUAL_SEEDS)
def test_exact_estimators_equal_naive_ad(case: GradientCase, adjoint: str):
    scene = Case(case.scene(), case.keys)
    own = {key: value for key, value in case.options.items() if key not in OF_RESERVOIR}
    reference = scene.gradient(integrator("walk_ad", **case.both | own), 5, case.spp, adjoint=adjoint)
    for name, options in EXACT.items():
        ours = scene.gradient(estimator(case, name, options), 5, case.spp, adjoint=adjoint)
        error = relative(ours, reference)
        print(case.name, adjoint, name, f"{error:.1e}")
        assert error < 1e-4, f"{name}, {adjoint}: {error:.1e}"


def agree(case: GradientCase, count: int, candidates: dict[str, dict], adjoint: str) -> None:
    """Compare each candidate with `gather` over `count` other seeds."""
    scene = Case(case.scene(), case.keys)
    reference = scene.gradients(estimator(case, "gather", {}), seeds(count, 1), case.spp, adjoint=adjoint)
    for name, options in candidates.items():
        ours = scene.gradients(estimator(case, name, options), seeds(count), case.spp, adjoint=adjoint)
        result = compare(ours, reference, block=None)
        print(case.name, name, result)
        assert result, name
        assert np.isfinite(ours).all()


FEW = ("texture", "roulette", "crop", "glass", "mask_texture_in_view", "area_texture", "two_emitters")


@pytest.mark.parametrize("case", a_few([case for case in CASES if case.name in FEW], ["texture"]))
def test_random_estimators_agree(case: GradientCase):
    agree(case, 16, RANDOM, "correlated")
    agree(case, 16, BY_ADJOINT, "independent")


def test_event_agrees_where_lobes_are_not_connected():
    [case] = [case for case in CASES if case.name == "glass"]
    agree(case, 16, {"event": {}}, "correlated")


@pytest.mark.long
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_random_estimators_agree_over_many_seeds(case: GradientCase):
    count = 200 if case.name in FEW else 40
    agree(case, count, RANDOM, "correlated")
    agree(case, count, BY_ADJOINT, "independent")


@pytest.mark.parametrize("name", ["reservoir", "gather", "event", "stack"])
@pytest.mark.parametrize("max_depth", [0, 1])
def test_without_light_paths_the_gradient_is_zero(name: str, max_depth: int):
    case = next(case for case in CASES if case.name == "texture")
    scene = Case(case.scene(), case.keys)
    assert not scene.gradient(integrator("reslrb", estimator=name, max_depth=max_depth), 3, 4).any()
