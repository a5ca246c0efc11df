"""Features that a scene does not need are left out. Kernels become smaller, and no result changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.gradient_cases import TEXELS
from conformance.operations import count, tracking, with_change
from turns import a_few, taking_turns

from reslrb_cli.config.integrators import AUTO_VALUES
from reslrb_cli.estimators import gather, reservoir, stack
from reslrb_cli.integrators.context import Preparation
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.step import gradient_step, known_step
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.scenes.small import camera, diffuse, rgb, room, texture, transform
from reslrb_cli.optimization.autotune.sampling import plan_rows
from reslrb_cli.records.decisions import Decision

pytestmark = pytest.mark.usefixtures("llvm")


# Code that a scene does not need is left out: the kernels shrink, and no result changes.  Each omission is undone by
# force. The same step, with the same random numbers, is traced with and without it.

ESTIMATORS = ("reservoir", "gather", "event", "stack")
#: Estimators whose draws depend on few features. `event` draws among everything that can be differentiated.
STEADY = ("reservoir", "gather", "stack")
#: Features that make `reservoir` draw among other connections. test_gradients.py checks that both kinds of draws are
#: right.
CANDIDATES = ("differentiate_null",)
WALL = "wall.brdf_0.reflectance.value"
RADIANCE = "lamp.emitter.radiance.value"


def plain(**changes: Any) -> dict:
    """Return the room with a textured floor."""
    return room(floor={"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(3, 4)}}, **changes)


def in_the_dark(**changes: Any) -> dict:
    """Return the room of `plain`, lit by a point light."""
    return plain(lamp=None, light={"type": "point", "position": [0.2, 1.2, 0.3], "intensity": rgb(3, 4, 5)}, **changes)


def through_a_lens() -> dict:
    """Return the room of `plain`, seen through a lens."""
    return plain(camera=camera(sensor="thinlens"))


def with_glass() -> dict:
    """Return the room of `plain` with a ball of glass. Nothing of the ball is differentiated."""
    bsdf = {"type": "dielectric"}
    return plain(ball={"type": "sphere", "center": [0.1, 0, 0.1], "radius": 0.35, "bsdf": bsdf})


def with_veil() -> dict:
    """Return the room of `plain` with a mask. Nothing of the mask is differentiated."""
    bsdf = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}
    placed = transform(translate=[0.1, 0.2, 0.2], rotate=([1, 0, 0], -80), scale=0.5)
    return plain(veil={"type": "rectangle", "to_world": placed, "bsdf": bsdf})


def step(case: Case, ours: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return image and gradient of one step with known dL/dI."""
    with tracking(case.params, case.keys):
        leaves = [case.params[key] for key in case.keys]
        for leaf in leaves:
            dr.set_grad(leaf, 0)
        result = known_step(ours, case.scene, 0, mi.TensorXf(case.weights), seed=5, spp=16, params=case.params)
        gradient = np.concatenate([np.array(dr.grad(leaf), np.float64).ravel() for leaf in leaves])
    return np.array(result.image, np.float64), gradient


def both_ways(make: Callable[[], dict], keys: tuple[str, ...], feature: str, estimator: str) -> tuple[Any, Any]:
    """Return (operations, image, gradient) of the planned step, and of the step with `feature` switched on by force."""
    results = []
    for forced in (False, True):
        case = Case(make(), keys)
        ours = integrator("reslrb", 5, estimator=estimator)
        if forced:
            with tracking(case.params, case.keys):
                plan = with_change(ours.plan(case.scene, case.scene.sensors()[0], case.params), **{feature: True})
            ours.preparation.plan = lambda *_: plan  # noqa: B023
        with tracking(case.params, case.keys):
            plan_now = ours.plan(case.scene, case.scene.sensors()[0], case.params)
            operations = sum(count(ours, plan_now, case.scene, case.scene.sensors()[0]))
        results.append((operations, *step(case, ours)))
    return results[0], results[1]


def differs(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest difference relative to the largest entry."""
    return float(np.abs(a - b).max() / np.abs(b).max())


#: Each row: the feature (a member of the plan or of its needs), a scene that does not need it, the parameters, and the
#: estimators whose kernels shrink.
OMISSIONS = [
    ("has_visible_emitters", in_the_dark, (TEXELS,), STEADY),
    ("has_shading_normals", plain, (TEXELS,), STEADY),
    ("has_perturbed_normals", plain, (TEXELS,), STEADY),
    ("has_null", plain, (TEXELS,), STEADY),
    ("has_instances", plain, (TEXELS,), STEADY),
    ("principal_point", plain, (TEXELS,), STEADY),
    ("near_clip", plain, (TEXELS,), STEADY),
    ("lens_clip", through_a_lens, (TEXELS,), STEADY),
    # The scene must not hold the lamp, whose surface is black: connections from there would be drawn, too.
    ("track_zeros", in_the_dark, (TEXELS,), STEADY),
    ("bsdfs_read_geometry", plain, (TEXELS,), ("stack",)),
    ("differentiate_delta", with_glass, (TEXELS,), STEADY),
    # With the feature, `gather` remembers the last vertex with a differentiated parameter, in as many operations.
    ("differentiate_null", with_veil, (TEXELS,), ("reservoir", "stack")),
    # Dr.Jit drops these features by itself, since nothing reads their results.
    ("has_delta_lobes", plain, (TEXELS,), ()),
    ("thin_lens", plain, (TEXELS,), ()),
]

#: The default suite runs one estimator per row: the next one of those whose kernels shrink.
QUICK = [(shrinks or STEADY)[number % len(shrinks or STEADY)] for number, (*_, shrinks) in enumerate(OMISSIONS)]
#: Features that need `-m long`: Dr.Jit drops them by itself, or they are numbers of the sensor.
SIMILAR = ("has_delta_lobes", "thin_lens", "principal_point", "near_clip", "lens_clip", "has_instances")


@pytest.mark.parametrize(
    ("feature", "make", "keys", "shrinks", "estimator"),
    [
        pytest.param(
            *row,
            estimator,
            id=f"{row[0]}-{estimator}",
            marks=() if estimator == quick and row[0] not in SIMILAR else pytest.mark.long,
        )
        for row, quick in zip(OMISSIONS, QUICK, strict=True)
        for estimator in STEADY
    ],
)
def test_an_omission_changes_nothing_and_shrinks_the_kernel(feature, make, keys, shrinks, estimator):
    (operations, image, gradient), (forced, forced_image, forced_gradient) = both_ways(make, keys, feature, estimator)
    assert differs(image, forced_image) < 1e-6
    if not (estimator == "reservoir" and feature in CANDIDATES):
        assert differs(gradient, forced_gradient) < 1e-6
    assert np.abs(gradient).max() > 0
    assert operations < forced if estimator in shrinks else operations <= forced


#: The requested parameters, and the parameters that are added to them.
ASKED = {
    "emitters only": ((RADIANCE,), (TEXELS,)),
    "BSDFs only": ((TEXELS,), (RADIANCE,)),
    "textured BSDF only": ((TEXELS,), (WALL,)),
    "plain BSDF only": ((WALL,), (TEXELS,)),
}


@taking_turns("asked", list(ASKED), "estimator", ESTIMATORS)
def test_only_requested_parameters_are_differentiated(asked: str, estimator: str):
    """Differentiating another parameter does not change a parameter's derivative with `gather` and `stack`. With every
    estimator, the kernels become larger.
    """
    keys, more = ASKED[asked]
    results = []
    for chosen in (keys, keys + more):
        case = Case(plain(), chosen)
        ours = integrator("reslrb", 5, estimator=estimator)
        with tracking(case.params, chosen):
            plan = ours.plan(case.scene, case.scene.sensors()[0], case.params)
            kernels = count(ours, plan, case.scene, case.scene.sensors()[0])
        image, gradient = step(case, ours)
        results.append((kernels, image, gradient[: case.initial[keys[0]].size]))
    (kernels, image, gradient), (all_kernels, all_image, all_gradient) = results
    assert differs(image, all_image) < 1e-6
    if estimator in ("gather", "stack"):  # draws of the others depend on what can be differentiated
        assert differs(gradient, all_gradient) < 1e-6
    assert sum(kernels) < sum(all_kernels)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_emitters_alone_need_no_replay(estimator: str):
    """Besides the walk that makes the image, a step needs only the small kernel of emission."""
    case = Case(plain(), (RADIANCE,))
    ours = integrator("reslrb", 5, estimator=estimator)
    with tracking(case.params, case.keys):
        plan = ours.plan(case.scene, case.scene.sensors()[0], case.params)
        walk, *others = count(ours, plan, case.scene, case.scene.sensors()[0])
    assert sum(others) < walk / 2


def test_rows_explain_needed_features() -> None:
    case, ours = Case(through_a_lens(), (TEXELS,)), integrator("reslrb", 5, estimator="stack")
    with tracking(case.params, case.keys):
        rows = plan_rows(ours.plan(case.scene, case.scene.sensors()[0], case.params), [])
    assert {row.feature for row in rows if row.needed} == {"visible emitters", "derivatives of BSDFs"}
    assert all(row.reason for row in rows)


def test_every_automatic_setting_has_a_row_with_the_reason_of_its_decision() -> None:
    plan = integrator("reslrb", 5).plan(scene := Case(plain(), (TEXELS,)).scene, scene.sensors()[0])
    decisions = [Decision(setting=setting, value="auto", why=f"reason {k}") for k, setting in enumerate(AUTO_VALUES)]
    texts = [row.reason for row in plan_rows(plan, decisions)]
    assert all(any(text.endswith(f"{each.setting}: auto, {each.why}") for text in texts) for each in decisions)


def test_a_step_makes_two_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batched step makes one plan for the image of the first batch, and one plan for everything that is
    differentiated. The step does not make a plan for each batch.
    """
    original, asked = Preparation.plan, []

    def noting(self: Preparation, scene: Any, sensor: Any, params: Any, spp: int, image: bool, forward: bool) -> Any:
        asked.append(not image)
        return original(self, scene, sensor, params, spp, image, forward)

    monkeypatch.setattr(Preparation, "plan", noting)
    case, ours = Case(plain(), (TEXELS,)), integrator("reslrb", 5, estimator="stack", guiding="on")
    for seed in range(3):
        case.gradient(ours, seed, 16, adjoint="batched")
        assert asked == [False, True]
        asked.clear()


# Code for what follows the last vertex with a differentiated parameter costs nothing. So does code for paths without
# such a vertex.  test_gradients.py checks that results stay right: its cases differentiate one surface of several.

FLOOR_ALONE = ("floor.brdf_0.reflectance.value",)
ALL = (*FLOOR_ALONE, *(f"{name}.reflectance.value" for name in ("wall.brdf_0", "side.brdf_0", "cave.bsdf")))
MAX_DEPTH, SPP = 8, 16


@pytest.fixture(scope="module")
def scene(llvm: str) -> dict:
    """Corner of a room in a bright cave. Only a few vertices of a path are on the floor."""
    return room(cave={"type": "sphere", "radius": 8.0, "flip_normals": True, "bsdf": diffuse(0.9, 0.9, 0.9)})


@pytest.mark.parametrize(
    ("estimator", "owner", "method", "what"),
    [
        ("gather", gather.Taking, "__init__", lambda arguments: arguments[1].last),
        ("reservoir", reservoir.ReservoirReplay, "__init__", lambda arguments: arguments[1][0].last),
        ("stack", stack, "walk_back", lambda arguments: arguments[3].count),
    ],
)
@pytest.mark.parametrize("adjoint", a_few(["independent", "correlated"], ["independent"]))
def test_vertices_after_the_last_differentiable_one_are_not_revisited(
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
    for keys in (FLOOR_ALONE, ALL):
        Case(scene, keys).gradient(integrator("reslrb", MAX_DEPTH, estimator=estimator), 1, SPP, adjoint=adjoint)
    print(estimator, adjoint, means)
    assert len(means) == 2
    assert 0 < means[0] < 0.7 * means[1]


@pytest.mark.long
def test_connections_without_differentiable_vertices_are_no_candidates(
    scene: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = Case(scene, FLOOR_ALONE)

    def gradients(**options: str) -> np.ndarray:
        return case.gradients(integrator("reslrb", MAX_DEPTH, **options), seeds(24), SPP, adjoint="correlated")

    exact = gradients(estimator="gather")
    # The variance that selection adds.
    ours = np.square(gradients(estimator="reservoir") - exact).sum()
    monkeypatch.setattr(reservoir.ReservoirSelection, "concerned", lambda *_: mi.Bool(True))
    of_all = np.square(gradients(estimator="reservoir") - exact).sum()
    print(ours / of_all)
    assert ours < 0.7 * of_all


def test_without_an_image_other_vertices_are_not_connected(scene: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    original, shares = stack.walk_back, []

    def noting(p: Any, form: Any, ring: Any, state: stack.StackState, *rest: Any) -> Any:
        connected = (state.useful > 0) | dr.any(state.D != 0)
        shares.append(float(np.mean(np.array(connected, dtype=float))))
        return original(p, form, ring, state, *rest)

    monkeypatch.setattr(stack, "walk_back", noting)
    for keys in (FLOOR_ALONE, ALL):
        Case(scene, keys).gradient(integrator("reslrb", MAX_DEPTH, estimator="stack"), 1, SPP, adjoint="independent")
    print(shares)
    assert 0 < shares[0] < 0.7 * shares[1]


# Steps in which no light path meets anything: the gradient is zero, and nothing fails.


def lit_from_behind() -> mi.Scene:
    """Return a scene with a wall, and a lamp that faces away from it."""
    lamp = mi.ScalarTransform4f().translate([0, 0, 5])
    return mi.load_dict({
        "type": "scene",
        "sensor": {
            "type": "perspective", "fov": 50.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
        },
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area"}},
    }, optimize=False)  # fmt: skip


@pytest.mark.parametrize("adjoint", ["correlated", "independent", "batched"])
@pytest.mark.parametrize("name", a_few(["ptracer", "reslrb"], ["reslrb"]))
def test_the_gradient_is_zero(name: str, adjoint: str) -> None:
    scene = lit_from_behind()
    params = mi.traverse(scene)
    [key] = [key for key in params.keys() if key.startswith("wall") and key.endswith("reflectance.value")]  # noqa: SIM118
    dr.enable_grad(params[key])
    params.update()
    options: dict[str, Any] = {"batches": 2} if adjoint == "batched" else {}

    def loss(image: Any) -> Any:
        return dr.mean(dr.square(image - 0.5).array)

    integrator = make_integrator(name, max_depth=3)
    step = gradient_step(integrator, scene, 0, loss, spp=4, seed=1, adjoint=adjoint, params=params, **options)
    dr.eval(step.loss)
    assert np.array(step.loss) == pytest.approx(0.25)
    assert (np.array(dr.grad(params[key])) == 0).all()
