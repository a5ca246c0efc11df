"""Derivatives of moving light with `reservoir`, and with light that follows a surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.attached_cases import CASES
from conformance.moving_lamps import CASES as LAMPS
from measure.differenced import attached, compare_with_differences
from measure.faults import Fault, plant, planted
from measure.moving_light import SCENES, moved, point, room, shelf, wall

from reslrb_cli.estimators import chain
from reslrb_cli.integrators.plans import stays
from reslrb_cli.integrators.step import gradient_step
from reslrb_cli.measure.comparison import Family, compare_expectations
from reslrb_cli.measure.gradients import integrator, relative, seeds
from reslrb_cli.measure.scenes.case import SceneCase
from reslrb_cli.measure.scenes.moving import Move, pose
from reslrb_cli.measure.scenes.small import diffuse

pytestmark = pytest.mark.usefixtures("llvm")


# `reservoir` with moving light: against naive AD and `stack` at equal seeds, and in expectation.  On specular chains
# with one connection per path, nothing is selected or damped, so that only rounding separates the gradients. With one
# connection per path and diffuse vertices in the chain, damping adds noise of its own, and must not add bias.

#: Relative L2 distance from naive AD on specular chains, at equal seeds.
SPECULAR = 1e-4
#: Cases of test_attached.py in which every path has one connection, which lies behind specular vertices only.
SINGLE = ("slab", "latents", "passes", "thin_lens", "second_sensor", "crop", "lanczos", "mirror")
BY_NAME = {case.name: case for case in CASES}
ONE = attached("one", "one diffuse vertex in the chain", lambda: room(wall=wall(diffuse(0.8, 0.7, 0.6))), moved,
                    spp=64, options={"max_depth": 5})  # fmt: skip
TWO = attached("two", "two diffuse vertices in the chain", shelf, moved, spp=64, options={"max_depth": 6})
BOTH = replace(TWO, name="both", moves=lambda _: [pose("floor.to_world", ("ty",)), pose("wall.to_world", ("tx",))])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "slab" else pytest.mark.long) for name in SINGLE]
)
def test_specular_chains_equal_naive_ad(name: str):
    case = BY_NAME[name]
    moving = case.moving()
    shared = {"hide_emitters": True} | case.both
    ours = moving.gradient(integrator("reslrb", case.depth, estimator="reservoir", **shared), 1, case.spp)
    naive = moving.gradient(integrator("walk_ad", case.depth, attached=True, **shared), 1, case.spp)
    for key, value in naive.items():
        print(name, key, relative(ours[key], value))
        assert value.any()
        assert relative(ours[key], value) < SPECULAR


@dataclass
class Bias:
    """Bias of N gradients, as a fraction of the gradient of `stack`. `value` is the mean difference along this
    gradient, and `error` its standard error.
    """

    value: float
    error: float
    noise: float  # variance beyond that of `stack`, as a fraction of it

    def __str__(self) -> str:
        return f"bias {self.value:.2%} +- {self.error:.2%}, variance {1 + self.noise:.2f} of that of stack"


@cache
def exact_gradients(name: str, sampling: str, count: int) -> np.ndarray:
    """Return the gradients of `stack` in the scene of this name. The gradients are computed once for all tests, and do
    not use any code that the tests break.
    """
    [scene] = [scene for scene in (ONE, TWO, BOTH) if scene.name == name]
    tracer = integrator("reslrb", **scene.options, attached_sampling=sampling, estimator="stack")
    return scene.setup().gradients(tracer, seeds(count), scene.spp)


def bias(scene: SceneCase, sampling: str, count: int, **options: Any) -> Bias:
    """Return the bias of `reservoir` relative to `stack` at equal seeds."""
    exact = exact_gradients(scene.name, sampling, count)
    tracer = integrator("reslrb", **scene.options, attached_sampling=sampling, estimator="reservoir", **options)
    ours = scene.setup().gradients(tracer, seeds(count), scene.spp)
    mean = exact.mean(0)
    along = (ours - exact) @ mean / (mean @ mean)
    noise = (ours - exact).var(0, ddof=1).sum() / exact.var(0, ddof=1).sum()
    return Bias(float(along.mean()), float(along.std(ddof=1) / np.sqrt(count)), float(noise))


@pytest.mark.long
@pytest.mark.parametrize("scene", [pytest.param(ONE, marks=pytest.mark.long), TWO], ids=lambda scene: scene.name)
def test_no_bias_behind_diffuse_vertices(scene: SceneCase):
    found = bias(scene, "stay", 12)
    print(scene.name, found)
    assert abs(found.value) < 4 * found.error
    assert found.error < 0.01


@pytest.mark.long
@pytest.mark.parametrize("sampling", ["follow", "stay"])
@pytest.mark.parametrize("damping", [0.003, 0.01, 0.03, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("scene", [ONE, TWO], ids=lambda scene: scene.name)
def test_no_bias_whatever_the_damping(scene: SceneCase, damping: float, sampling: str):
    found = bias(scene, sampling, 64, jacobian_damping=damping)
    print(scene.name, sampling, damping, found)
    assert abs(found.value) < 4 * found.error
    # The noise that damping adds is proportional to the damping. So is the bias that these seeds must detect.
    assert found.error < max(0.15 * damping, 0.001)


@pytest.mark.long
def test_no_bias_in_blocks(monkeypatch: pytest.MonkeyPatch):
    """A long path is divided into blocks. Only one block counts, multiplied by the number of blocks."""
    monkeypatch.setattr(chain, "BLOCK", 1)
    found = bias(ONE, "stay", 24)
    print(found)
    assert abs(found.value) < 4 * found.error
    assert found.error < 0.02


@pytest.mark.long
def test_without_a_random_sign_it_is_biased(monkeypatch: pytest.MonkeyPatch):
    """Without the random sign, a bias is found. Tests that find no bias are therefore meaningful."""
    monkeypatch.setattr(chain, "sign", lambda numbers: 1)
    found = bias(ONE, "follow", 12, jacobian_damping=0.5)
    print(found)
    assert abs(found.value) > 10 * found.error


@pytest.mark.parametrize(
    "options",
    [
        *(pytest.param(o, marks=pytest.mark.long) for o in ({}, {"capacity": 3}, {"weight": "adjoint"})),
    ],
    ids=str,
)
def test_bounces_with_several_connections(options: dict[str, Any]):
    """Selection adds noise and no bias. Parameters of emission and of BSDFs are differentiated together with moving
    parameters.
    """
    case = BY_NAME["bounces"]
    moving = case.moving()
    shared = {"hide_emitters": True} | case.both
    exact, ours = (
        [moving.gradient(integrator("reslrb", case.depth, estimator=name, **shared, **own), seed) for seed in seeds(16)]
        for name, own in (("stack", {}), ("reservoir", options))
    )
    for key in exact[0]:
        a, b = (np.stack([gradient[key] for gradient in side]) for side in (exact, ours))
        along = (b - a) @ a.mean(0) / np.square(a.mean(0)).sum()
        print(key, along.mean(), along.std(ddof=1) / 4)
        assert abs(along.mean()) < 4 * along.std(ddof=1) / 4
        assert along.std(ddof=1) / 4 < 0.05


@pytest.mark.parametrize("name", ["spot", pytest.param("point", marks=pytest.mark.long)])
def test_a_single_lamp_moves(name: str):
    """If only a lamp moves, vertices have nothing to differentiate. Only the ray that leaves the lamp does. Over a
    floor alone, a path has one connection at any depth.
    """
    [lamp] = [case for case in LAMPS if case.name == name]
    moving = lamp.moving()
    exact, ours = (
        moving.gradient(integrator("reslrb", 5, estimator=estimator, hide_emitters=True), 1, 16)
        for estimator in ("stack", "reservoir")
    )
    for key, value in exact.items():
        print(name, key, relative(ours[key], value))
        assert value.any()
        assert relative(ours[key], value) < SPECULAR


@pytest.mark.parametrize("name", ["bounces", pytest.param("rough_slab", marks=pytest.mark.long)])
def test_two_kernels_equal_one(name: str):
    """If dL/dI is known beforehand, chain and replay are one kernel. Otherwise, the kept state goes through memory.
    Both ways give the same gradient.
    """
    scene = replace(ONE, spp=16)
    case = scene.setup()
    tracer = integrator("reslrb", **scene.options, estimator="reservoir", jacobian_damping=0.01)
    apart = case.gradient(tracer, 1, scene.spp, step=gradient_step)
    tracer.correlated, whole = None, case.gradients(tracer, [1], scene.spp)[0]
    assert relative(apart, whole) < 1e-5


SELECTION, REPLAY = "estimators.chain:ChainSelection", "estimators.chain:ChainReplay"
FAULTS = [
    Fault("no_G", "two", f"{SELECTION}.vertex",
          "row_times(row, J) + before for row, before in zip(jacobian.log_c",
          "row_times(row, J) for row, before in zip(jacobian.log_c"),
    Fault("factors_passed_stay", "both", f"{REPLAY}.vertex", "ahead = row - sum", "ahead = row + 0 * sum"),
    Fault("no_inverse", "slab", f"{REPLAY}.vertex", "row_times(ahead, inverse)", "ahead"),
    Fault("film_position_stays", "slab", "estimators.chain:KeptConnection.of", "[*by_u, *A]", "[*(0 * by_u), *A]"),
    Fault("own_vertex_left_out", "receiver", f"{REPLAY}._differentiate", "own_part + later", "later"),
    Fault("rays_left_out", "slab", f"{REPLAY}._differentiate", "moved + dr.dot(by_s", "0 * moved + dr.dot(by_s"),
]  # fmt: skip


def distance(name: str) -> float:
    """Return the largest distance between `reservoir` and `stack` at equal seeds, which must be rounding alone."""
    case = BY_NAME[name]
    depth = 4 if name == "receiver" else case.depth  # one connection per path
    moving = case.moving()
    exact, ours = (
        moving.gradient(integrator("reslrb", depth, estimator=estimator, hide_emitters=True), 1, case.spp)
        for estimator in ("stack", "reservoir")
    )
    return max(relative(ours[key], value) for key, value in exact.items())


@planted(FAULTS)
def test_fault(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    plant(fault, monkeypatch)
    if fault.check == "two":  # specular factors hardly change
        assert abs(bias(TWO, "stay", 6).value) > 0.1
    elif fault.check == "both":  # the remainder is divided by the damping, of either sign
        assert bias(BOTH, "stay", 6).noise > 5
    else:
        assert distance(fault.check) > 10 * SPECULAR


# `attached_sampling`: light that follows a surface, and light that continues to the same place.  Both are right, and
# their means agree, in scenes where nothing is hidden and no edge rests where light is seen. Where there is such an
# edge, finite differences show which of the two is right.

WHITE = diffuse(0.8, 0.7, 0.6)
BRUSHED = {"type": "roughconductor", "material": "none", "alpha": 0.4, "sample_visible": False}


def lit_wall(bsdf: dict[str, Any] = WHITE) -> dict[str, Any]:
    """Return a scene with a point light over a floor that lights a wall. The camera sees only the wall, without its
    edges.
    """
    scene = room(wall=wall(WHITE), lamp=point((0.1, 0.7, 0.2)))
    floor = scene["floor"] | {"bsdf": bsdf}
    return {name: thing for name, thing in scene.items() if name not in ("top", "bottom")} | {"floor": floor}


def tilted(scene: Any) -> list[Move]:
    return [pose("floor.to_world", ("ty", "rx", "rz"))]


def pushed(scene: Any) -> list[Move]:
    return [pose("wall.to_world", ("tx", "ry", "rz"), (1, 1, 0))]


def rough(name: str) -> SceneCase:
    return replace(SCENES[name], spp=64, options=dict(SCENES[name].options))


AGREEING = {
    "bounce": replace(SCENES["bounce"], spp=64),
    "rough_mirror": rough("rough_mirror"),
    "rough_surface": rough("rough_surface"),
    "moved_floor": attached("", "", lit_wall, tilted, options={"max_depth": 3}),
    "moved_wall": attached("", "", lit_wall, pushed, options={"max_depth": 3}),
}  # fmt: skip
QUICK_SAMPLING = ("bounce", "moved_floor", "moved_wall")
#: The scenes that the default suite runs, because they need few seeds: light reflects off a moving object, and is
#: reflected again.
FEWEST = ("bounce",)


def gradients(scene: SceneCase, sampling: str, count: int, first: int = 1) -> np.ndarray:
    """Return gradients (N, K) at `count` seeds, starting with seed number `first`."""
    tracer = integrator("reslrb", **dict(scene.options) | {"attached_sampling": sampling}, estimator="stack")
    return scene.setup().gradients(tracer, seeds(count, first), scene.spp)


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in FEWEST else pytest.mark.long) for n in AGREEING])
def test_both_agree(name: str):
    count = 16 if name in QUICK_SAMPLING else 64
    followed, stayed = (gradients(AGREEING[name], way, count, first) for way, first in (("follow", 1), ("stay", 100)))
    found = compare_expectations(stayed, followed, Family(len(AGREEING), 40), paired=False)
    print(name, found.verdict, f"relative L2 {found.relative_l2:.4f}, z max {found.z_max:.2f}, variance of stay over "
          f"follow {found.variance_ratio:.2f}, could be seen: {found.detectable:.3f}")  # fmt: skip
    assert np.abs(followed.mean(0)).min() > 0
    assert found.z_max < found.z_max_limit
    assert found.z_rms < found.z_rms_limit


@pytest.mark.long
@pytest.mark.parametrize("name", ["bounce", "bounce_steps", "bounce_corner"])
def test_finite_differences_agree_if_auto_stays(name: str):
    scene = SCENES[name]
    ways = {way: replace(scene, options=dict(scene.options) | {"attached_sampling": way}) for way in ("auto", "follow")}
    found = {way: compare_with_differences(one) for way, one in ways.items()}
    noise = {way: float(np.mean(one.ours.var(0, ddof=1))) for way, one in found.items()}
    print(name, *(f"{way}: {one};" for way, one in found.items()), f"variance {noise['auto'] / noise['follow']:.2f}")
    assert found["auto"].error < 4 * found["auto"].standard_error
    assert noise["auto"] < noise["follow"]
    if name != "bounce":
        assert found["follow"].error > 5 * found["follow"].standard_error


@pytest.mark.parametrize(
    ("bsdf", "sampling", "max_depth", "expected"),
    [
        (WHITE, "auto", 3, (True, False)),
        (WHITE, "auto", 2, (False, False)),
        (WHITE, "follow", 3, (False, False)),
        (BRUSHED, "auto", 3, (False, False)),  # behind the diffuse wall nothing is seen
        (BRUSHED, "stay", 3, (True, False)),
    ],
    ids=str,
)
def test_the_choice_of_auto(bsdf: dict[str, Any], sampling: str, max_depth: int, expected: tuple[bool, bool]):
    case = attached("", "", lambda: lit_wall(bsdf), tilted).setup()
    tracer = integrator("reslrb", max_depth, estimator="stack", attached_sampling=sampling)
    leaves = case.leaves()
    assert any(dr.grad_enabled(leaf) for leaf in leaves.values())
    plan = tracer.plan(case.scene, case.scene.sensors()[0], case.params)
    assert (plan.stays, plan.glossy_follows) == expected
    bsdfs = [mi.load_dict(each) for each in (WHITE, BRUSHED)]
    assert stays(plan, "auto", bsdfs) == (max_depth > 2, max_depth > 2)
