"""`attached_sampling`: light that follows a surface, and light that goes on to the same place.

In scenes where nothing is hidden, and no edge is at rest where light is seen, both are right, and their means agree.
Where there is such an edge, finite differences say which is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from measure.differenced import AttachedScene, compare_with_differences
from measure.moving_light import SCENES, moved, point, room, smooth_texture, wall

from reslrb_cli.integrators.differentiated import stays
from reslrb_cli.measure.comparison import Family, compare_expectations
from reslrb_cli.measure.gradients import integrator, seeds
from reslrb_cli.measure.scenes.moving import Move, Pose
from reslrb_cli.measure.scenes.small import diffuse

pytestmark = pytest.mark.usefixtures("llvm")
WHITE = diffuse(0.8, 0.7, 0.6)
BRUSHED = {"type": "roughconductor", "material": "none", "alpha": 0.4, "sample_visible": False}


def lit_wall(bsdf: dict[str, Any] = WHITE) -> dict[str, Any]:
    """A point light over a floor that lights a wall; the camera sees the wall alone, and not its edges."""
    scene = room(wall=wall(WHITE), lamp=point((0.1, 0.7, 0.2)))
    floor = scene["floor"] | {"bsdf": bsdf}
    return {name: thing for name, thing in scene.items() if name not in ("top", "bottom")} | {"floor": floor}


def ball() -> dict[str, Any]:
    """A point light inside of a ball, and a camera there."""
    scene = lit_wall()
    shell = {"type": "sphere", "center": [0, 1, 0], "radius": 2.0, "flip_normals": True, "bsdf": WHITE}
    return {name: scene[name] for name in ("type", "camera", "lamp")} | {"shell": shell}


def tilted(scene: Any) -> list[Move]:
    return [Pose("floor.to_world", ("ty", "rx", "rz"))]


def pushed(scene: Any) -> list[Move]:
    return [Pose("wall.to_world", ("tx", "ry", "rz"), (1, 1, 0))]


def grown(scene: Any) -> list[Move]:
    return [Pose("shell.to_world", ("s", "tx"), (0, 1, 0))]


def rough(name: str) -> AttachedScene:
    return replace(SCENES[name], spp=64, options=dict(SCENES[name].options))


AGREEING = {
    "bounce": replace(SCENES["bounce"], spp=64),
    "bounce_texture": AttachedScene("", "", lambda: room(wall=wall(smooth_texture()["bsdf"])), moved, spp=64,
                                    options={"max_depth": 5}),
    "rough_mirror": rough("rough_mirror"),
    "rough_surface": rough("rough_surface"),
    "moved_floor": AttachedScene("", "", lit_wall, tilted, options={"max_depth": 3}),
    "moved_wall": AttachedScene("", "", lit_wall, pushed, options={"max_depth": 3}),
    "moved_shell": AttachedScene("", "", ball, grown, options={"max_depth": 4}),
    "brushed_floor": AttachedScene("", "", lambda: lit_wall(BRUSHED), tilted, spp=256, options={"max_depth": 3}),
}  # fmt: skip
QUICK = ("bounce", "moved_floor", "moved_wall")
#: Of these, which take few seeds, by default: light that reflects off what moves, and is reflected again.
FEWEST = ("bounce",)


def gradients(scene: AttachedScene, sampling: str, count: int, first: int = 1) -> np.ndarray:
    """At `count` seeds from the `first` on: (N, K)."""
    tracer = integrator("reslrb", **dict(scene.options) | {"attached_sampling": sampling}, estimator="stack")
    return scene.case().gradients(tracer, seeds(count, first), scene.spp)


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in FEWEST else pytest.mark.long) for n in AGREEING])
def test_both_agree(name: str):
    count = 16 if name in QUICK else 64
    followed, stayed = (gradients(AGREEING[name], way, count, first) for way, first in (("follow", 1), ("stay", 100)))
    found = compare_expectations(stayed, followed, Family(len(AGREEING), 40), paired=False)
    print(name, found.verdict, f"relative L2 {found.relative_l2:.4f}, z max {found.z_max:.2f}, variance of stay over "
          f"follow {found.variance_ratio:.2f}, could be seen: {found.detectable:.3f}")  # fmt: skip
    assert np.abs(followed.mean(0)).min() > 0
    assert found.z_max < found.z_max_limit
    assert found.z_rms < found.z_rms_limit


@pytest.mark.long
def test_a_corner_at_rest():
    """Directions that turn sweep over it, which `auto` leaves alone: finite differences hold with it, and fail
    without."""
    scene = SCENES["bounce_corner"]
    right = compare_with_differences(scene, count=4)
    # Differences are of the image alone, which is the same for both.
    wrong = replace(right, ours=gradients(scene, "follow", len(right.ours), first=0))
    print(f"auto: {right}; follow: {wrong}")
    assert right.error < 4 * right.standard_error < 0.6
    assert wrong.error > 8 * wrong.standard_error


@pytest.mark.long
@pytest.mark.parametrize("name", ["bounce", "bounce_steps", "bounce_corner"])
def test_where_auto_stays_finite_differences_agree(name: str):
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
        (BRUSHED, "auto", 3, (False, False)),  # behind the wall, which is diffuse, nothing is seen
        (BRUSHED, "stay", 3, (True, False)),
    ],
    ids=str,
)
def test_what_auto_takes(bsdf: dict[str, Any], sampling: str, max_depth: int, expected: tuple[bool, bool]):
    import drjit as dr
    import mitsuba as mi

    case = AttachedScene("", "", lambda: lit_wall(bsdf), tilted).case()
    tracer = integrator("reslrb", max_depth, estimator="stack", attached_sampling=sampling)
    leaves = case.leaves()
    assert any(dr.grad_enabled(leaf) for leaf in leaves.values())
    plan = tracer.plan(case.scene, case.scene.sensors()[0], case.params)
    assert (plan.stays, plan.glossy_follows) == expected
    bsdfs = [mi.load_dict(each) for each in (WHITE, BRUSHED)]
    assert stays(plan, "auto", bsdfs) == (max_depth > 2, max_depth > 2)
