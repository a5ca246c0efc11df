"""What comes after the last vertex with anything to differentiate, or has no such vertex, costs nothing.

That results stay right is for test_estimators.py, whose cases differentiate one surface of several.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from reslrb_cli.estimators import gather, reservoir, stack
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.scenes.small import diffuse, room

pytestmark = pytest.mark.usefixtures("llvm")
FLOOR = ("floor.brdf_0.reflectance.value",)
ALL = (*FLOOR, *(f"{name}.reflectance.value" for name in ("wall.brdf_0", "side.brdf_0", "cave.bsdf")))
MAX_DEPTH, SPP = 8, 16


@pytest.fixture(scope="module")
def scene(llvm: str) -> dict:
    """The corner of a room in a bright cave: few vertices of a path are on the floor."""
    return room(cave={"type": "sphere", "radius": 8.0, "flip_normals": True, "bsdf": diffuse(0.9, 0.9, 0.9)})


@pytest.mark.parametrize(
    ("estimator", "owner", "method", "what"),
    [
        ("gather", gather.Taking, "__init__", lambda arguments: arguments[1].last),
        ("reservoir", reservoir.ReservoirReplay, "__init__", lambda arguments: arguments[1][0].last),
        ("stack", stack, "walk_back", lambda arguments: arguments[1].height),
    ],
)
@pytest.mark.parametrize("adjoint", ["independent", "correlated"])
def test_vertices_after_the_last_to_differentiate_are_not_visited_again(
    scene: dict,
    monkeypatch: pytest.MonkeyPatch,
    estimator: str,
    owner: Any,
    method: str,
    what: Callable[[Any], Any],
    adjoint: str,
) -> None:
    original, means = getattr(owner, method), []

    def noting(*arguments: Any) -> Any:
        own = arguments[1:] if method == "__init__" else arguments
        means.append(float(np.mean(np.array(what(own), dtype=float))))
        return original(*arguments)

    monkeypatch.setattr(owner, method, noting)
    for keys in (FLOOR, ALL):
        Case(scene, keys).gradient(integrator("reslrb", MAX_DEPTH, estimator=estimator), 1, SPP, adjoint=adjoint)
    print(estimator, adjoint, means)
    assert len(means) == 2
    assert 0 < means[0] < 0.7 * means[1]


def test_connections_without_anything_to_differentiate_are_no_candidates(scene: dict) -> None:
    case = Case(scene, FLOOR)

    def gradients(**options: str) -> np.ndarray:
        return case.gradients(integrator("reslrb", MAX_DEPTH, **options), seeds(24), SPP, adjoint="correlated")

    exact = gradients(estimator="gather")
    # What selection adds to the variance. The retained image needs every connection as a candidate.
    ours, of_all = (
        np.square(gradients(estimator="reservoir", image=image) - exact).sum() for image in ("all", "retained")
    )
    print(ours / of_all)
    assert ours < 0.7 * of_all


def test_without_an_image_the_others_are_not_even_connected(scene: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    original, shares = stack.walk_back, []

    def noting(p: Any, pushed: stack.Pushed) -> Any:
        shares.append(float(np.mean(np.array(pushed.last > 0, dtype=float))))
        return original(p, pushed)

    monkeypatch.setattr(stack, "walk_back", noting)
    for keys in (FLOOR, ALL):
        Case(scene, keys).gradient(integrator("reslrb", MAX_DEPTH, estimator="stack"), 1, SPP, adjoint="independent")
    print(shares)
    assert 0 < shares[0] < 0.7 * shares[1]
