"""What a scene does not need is left out: the kernels shrink, and no result changes.

Each omission is undone by force, and the same step, of the same random numbers, is traced with and without it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from conformance.gradient_cases import FLOOR
from turns import taking_turns

from reslrb_cli.integrators.context import Preparation
from reslrb_cli.integrators.plan_report import FEATURES, count, report_plan, tracking
from reslrb_cli.integrators.step import known_step
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.scenes.small import camera, diffuse, rgb, room, texture, transform

pytestmark = pytest.mark.usefixtures("llvm")
ESTIMATORS = ("reservoir", "gather", "event", "stack")
#: Those whose draws follow from few features; `event` draws among what can be differentiated.
STEADY = ("reservoir", "gather", "stack")
#: What makes `reservoir` draw among other connections. That both are right is for test_estimators.py.
CANDIDATES = ("derivatives of null surfaces",)
WALL = "wall.brdf_0.reflectance.value"
RADIANCE = "lamp.emitter.radiance.value"


def plain(**changes: Any) -> dict:
    """The room with a textured floor."""
    return room(floor={"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(3, 4)}}, **changes)


def in_the_dark(**changes: Any) -> dict:
    """The same, lit by a point."""
    return plain(lamp=None, light={"type": "point", "position": [0.2, 1.2, 0.3], "intensity": rgb(3, 4, 5)}, **changes)


def with_glass() -> dict:
    """The same with a ball of glass in it, of which nothing is differentiated."""
    bsdf = {"type": "dielectric"}
    return plain(ball={"type": "sphere", "center": [0.1, 0, 0.1], "radius": 0.35, "bsdf": bsdf})


def with_veil() -> dict:
    """The same with a mask in it, of which nothing is differentiated."""
    bsdf = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}
    placed = transform(translate=[0.1, 0.2, 0.2], rotate=([1, 0, 0], -80), scale=0.5)
    return plain(veil={"type": "rectangle", "to_world": placed, "bsdf": bsdf})


def step(case: Case, ours: Any) -> tuple[np.ndarray, np.ndarray]:
    """Image and gradient of one step whose dL/dI is known."""
    import drjit as dr
    import mitsuba as mi

    with tracking(case.params, case.keys):
        leaves = [case.params[key] for key in case.keys]
        for leaf in leaves:
            dr.set_grad(leaf, 0)
        result = known_step(ours, case.scene, 0, mi.TensorXf(case.weights), seed=5, spp=16, params=case.params)
        gradient = np.concatenate([np.array(dr.grad(leaf), np.float64).ravel() for leaf in leaves])
    return np.array(result.image, np.float64), gradient


def both_ways(make: Callable[[], dict], keys: tuple[str, ...], feature: str, estimator: str) -> tuple[Any, Any]:
    """(operations, image, gradient) of the step as planned, and with the feature by force."""
    [toggle] = [f.toggle for f in FEATURES if f.name == feature]
    results = []
    for forced in (False, True):
        case = Case(make(), keys)
        ours = integrator("reslrb", 5, estimator=estimator)
        if forced:
            with tracking(case.params, case.keys):
                plan = toggle(ours.plan(case.scene, case.scene.sensors()[0], case.params))
            ours.plan = lambda scene, sensor, params=None: plan  # noqa: B023
        with tracking(case.params, case.keys):
            plan_now = ours.plan(case.scene, case.scene.sensors()[0], case.params)
            operations = sum(count(ours, plan_now, case.scene, case.scene.sensors()[0], known=True))
        results.append((operations, *step(case, ours)))
    return results[0], results[1]


def differs(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference relative to the largest entry."""
    return float(np.abs(a - b).max() / np.abs(b).max())


#: Feature, scene without need of it, parameters, the estimators whose kernels shrink.
OMISSIONS = [
    ("visible emitters", in_the_dark, (FLOOR,), STEADY),
    ("shading-normal correction", plain, (FLOOR,), STEADY),
    ("bump and normal maps", plain, (FLOOR,), STEADY),
    ("null surfaces", plain, (FLOOR,), STEADY),
    ("instances", plain, (FLOOR,), STEADY),
    ("shifted principal point", plain, (FLOOR,), STEADY),
    # Without the lamp, which is black: connections from there would be drawn, too.
    ("zero-factor bookkeeping", in_the_dark, (FLOOR,), STEADY),
    ("geometry read by BSDFs", plain, (FLOOR,), ("stack",)),
    ("derivatives of delta lobes", with_glass, (FLOOR,), STEADY),
    # `gather` then remembers the last vertex with anything to differentiate, in as many operations.
    ("derivatives of null surfaces", with_veil, (FLOOR,), ("reservoir", "stack")),
    # Dr.Jit drops these by itself, since nothing reads what they compute.
    ("delta lobes", plain, (FLOOR,), ()),
    ("lens sampling", plain, (FLOOR,), ()),
]

#: Of each row, by default, one estimator: the next of those whose kernels are to shrink.
QUICK = [(shrinks or STEADY)[number % len(shrinks or STEADY)] for number, (*_, shrinks) in enumerate(OMISSIONS)]


@pytest.mark.parametrize(
    ("feature", "make", "keys", "shrinks", "estimator"),
    [
        pytest.param(*row, estimator, id=f"{row[0]}-{estimator}", marks=() if estimator == quick else pytest.mark.long)
        for row, quick in zip(OMISSIONS, QUICK, strict=True)
        for estimator in STEADY
    ],
)
def test_omission_changes_nothing_and_shrinks(feature, make, keys, shrinks, estimator):
    (operations, image, gradient), (forced, forced_image, forced_gradient) = both_ways(make, keys, feature, estimator)
    assert differs(image, forced_image) < 1e-6
    if not (estimator == "reservoir" and feature in CANDIDATES):
        assert differs(gradient, forced_gradient) < 1e-6
    assert np.abs(gradient).max() > 0
    assert operations < forced if estimator in shrinks else operations <= forced


#: What is asked for, and what beside it.
ASKED = {
    "emitters only": ((RADIANCE,), (FLOOR,)),
    "BSDFs only": ((FLOOR,), (RADIANCE,)),
    "textured BSDF only": ((FLOOR,), (WALL,)),
    "plain BSDF only": ((WALL,), (FLOOR,)),
}


@taking_turns("asked", list(ASKED), "estimator", ESTIMATORS)
def test_only_what_is_asked_for_is_differentiated(asked: str, estimator: str):
    """What is differentiated beside a parameter does not change its derivative, and makes the kernels larger."""
    keys, more = ASKED[asked]
    results = []
    for chosen in (keys, keys + more):
        case = Case(plain(), chosen)
        ours = integrator("reslrb", 5, estimator=estimator)
        with tracking(case.params, chosen):
            plan = ours.plan(case.scene, case.scene.sensors()[0], case.params)
            kernels = count(ours, plan, case.scene, case.scene.sensors()[0], known=True)
        image, gradient = step(case, ours)
        results.append((kernels, image, gradient[: case.initial[keys[0]].size]))
    (kernels, image, gradient), (all_kernels, all_image, all_gradient) = results
    assert differs(image, all_image) < 1e-6
    if estimator in ("gather", "stack"):  # what the others draw depends on what can be differentiated
        assert differs(gradient, all_gradient) < 1e-6
    assert sum(kernels) < sum(all_kernels)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_emitters_alone_replay_no_path(estimator: str):
    """Beside the walk that makes the image, there is only the small kernel of emission."""
    case = Case(plain(), (RADIANCE,))
    ours = integrator("reslrb", 5, estimator=estimator)
    with tracking(case.params, case.keys):
        plan = ours.plan(case.scene, case.scene.sensors()[0], case.params)
        walk, *others = count(ours, plan, case.scene, case.scene.sensors()[0], known=True)
    assert sum(others) < walk / 2


def test_report_counts_every_feature_or_says_why_not():
    case = Case(plain(camera=camera(sensor="thinlens")), (FLOOR,))
    ours = integrator("reslrb", 5, estimator="stack")
    report = report_plan(ours, case.scene, case.scene.sensors()[0], case.params, case.keys, known=False, limit_s=300)
    assert [row.feature for row in report.rows] == [feature.name for feature in FEATURES]
    for row in report.rows:
        counted = row.operations_with is not None and row.operations_without is not None
        assert counted != bool(row.note), row
        if counted:
            here = row.operations_with if row.needed else row.operations_without
            assert here == sum(report.kernels)
            assert row.operations_without <= row.operations_with, row
    needed = {row.feature for row in report.rows if row.needed}
    assert needed == {"visible emitters", "lens sampling", "derivatives of BSDFs"}


def test_report_leaves_the_parameters_as_they_were():
    import drjit as dr

    case = Case(plain(), (FLOOR,))
    ours = integrator("reslrb", 4, estimator="gather")
    report = report_plan(ours, case.scene, case.scene.sensors()[0], case.params, case.keys, known=True, counts=False)
    assert report.kernels is None
    assert not any(dr.grad_enabled(value) for _, value in case.params.items())
    np.testing.assert_array_equal(case.flat(FLOOR), case.initial[FLOOR])


def test_report_stops_counting_in_time():
    case = Case(plain(), (FLOOR,))
    ours = integrator("reslrb", 4, estimator="gather")
    report = report_plan(ours, case.scene, case.scene.sensors()[0], case.params, case.keys, known=True, limit_s=0)
    assert all("not counted" in row.note for row in report.rows)


def test_a_step_plans_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not once a batch: for the image of the first batch, and for all that is differentiated."""
    original, asked = Preparation.plan, []

    def noting(self: Preparation, scene: Any, sensor: Any, params: Any = None, spp: int | None = None) -> Any:
        asked.append(params is not None)
        return original(self, scene, sensor, params, spp)

    monkeypatch.setattr(Preparation, "plan", noting)
    case, ours = Case(plain(), (FLOOR,)), integrator("reslrb", 5, estimator="stack", guiding="on")
    for seed in range(3):
        case.gradient(ours, seed, 16, adjoint="batched")
        assert asked == [False, True]
        asked.clear()
