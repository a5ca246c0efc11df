"""Visible lamps smaller than a pixel. Sampled points on the lamps find their light, and rays through pixels do not find
the light again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from conformance.moving import Moving, flat
from conformance.moving_lamps import over_floor, smooth_weights
from conformance.operations import count, with_change
from conformance.test_kernels import Kernels
from measure.faults import Fault, plant, planted
from turns import a_few

from reslrb_cli.measure.extreme import run_case
from reslrb_cli.measure.gradients import Case, integrator, relative
from reslrb_cli.measure.scenes.analytic import RADIANCE, speck_in_view
from reslrb_cli.measure.scenes.case import SceneCase, exact
from reslrb_cli.measure.scenes.small import camera, diffuse, load, rgb, room, transform
from reslrb_cli.scene import graph

pytestmark = pytest.mark.usefixtures("llvm")
KEY = f"{RADIANCE}.value"
SPECKS = ("speck.emitter.radiance.value", "other.emitter.radiance.value")


def third() -> Any:
    """Return a lamp that covers about a quarter of a pixel. The lamp is large enough for primary rays to show their
    contribution.
    """
    return speck_in_view(0.06)


def speck(at: list[float], kind: str = "sphere", **emitter: Any) -> dict[str, Any]:
    """Return a small lamp with scale 0.01."""
    return {"type": kind, "to_world": transform(translate=at, scale=0.01), "bsdf": diffuse(0, 0, 0),
            "emitter": {"type": "area", "radiance": rgb(900, 600, 400)} | emitter}  # fmt: skip


def two(**changes: Any) -> dict[str, Any]:
    """Return a room lit only by two small lamps, which the camera sees."""
    specks = {"speck": speck([0.1, 0.8, 0.4]), "other": speck([-0.3, 0.3, 0.5], radiance=rgb(100, 300, 900))}
    return room(lamp=None, **specks | changes)


def veiled() -> dict[str, Any]:
    """Return the room of `two` with a mask, through which other objects are seen."""
    bsdf = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}
    placed = transform(translate=[0.6, -0.3, 0.2], rotate=([1, 0, 0], -80), scale=0.3)
    return two(veil={"type": "rectangle", "to_world": placed, "bsdf": bsdf})


def through_a_lens() -> dict[str, Any]:
    """Return the room of `two` with a camera that is out of focus."""
    return two(camera=camera() | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0})


CASES = {
    "third": exact("third", "", third, {"radiance": KEY}, 1, image="ptracer"),
    "two": SceneCase("two", "", two, SPECKS, image="ptracer"),
    # There is no stock image: `ptracer` loses light where a mask is seen, and `path` hardly ever finds the specks.
    "veiled": SceneCase("veiled", "", veiled, SPECKS, image=""),
    "lens": SceneCase("lens", "", through_a_lens, SPECKS, image="ptracer", spp=256),
}  # fmt: skip


def failures(name: str) -> set[str]:
    """Return the references that do not hold for `stack`."""
    records = list(run_case(CASES[name], ["stack"]))
    for record in records:
        print(record.to_json())
    assert len(records) >= 3
    return {record.reference.value for record in records if record.holds is False}


@pytest.mark.parametrize("name", [name if name == "third" else pytest.param(name, marks=pytest.mark.long)
                                  for name in CASES])  # fmt: skip
def test_images_and_gradients(name: str):
    assert len(found(CASES[name].scene())) == (1 if name == "third" else 2)
    assert not failures(name)


def test_forward_mode():
    case, known = Case(third().scene(), (KEY,)), third()
    tracer = integrator("reslrb", 1, estimator="stack")
    direction = np.array([1.0, 2.0, -0.5])
    assert case.tangent(tracer, direction, 3, 64) == pytest.approx(known.gradient(case.weights) @ direction, rel=0.01)


@pytest.mark.long
def test_a_recorded_step_equals_the_step_and_later_ones_compile_nothing():
    case, kernels = Case(two(), SPECKS), Kernels()
    plain, frozen = (integrator("reslrb", 3, estimator="stack", freeze=freeze) for freeze in (False, True))
    for seed in (1, 2, 3):
        expected = case.gradient(plain, seed, 16)
        assert relative(case.gradient(frozen, seed, 16), expected) < 1e-5
    for seed in (4, 5):
        found = kernels.new(lambda: case.gradient(plain, seed, 16))  # noqa: B023
        assert seed == 4 or found == []


# ---- Which lamps are small ----


def found(scene: dict[str, Any]) -> tuple[Any, ...]:
    """Return the small lamps of a scene's plan."""
    loaded = load(scene)
    return integrator("reslrb", 4).plan(loaded, loaded.sensors()[0]).small_lamps


def looking(origin: list[float], target: list[float]) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0])


def behind() -> dict[str, Any]:
    """Return the room of `two`, with a screen that hides both small lamps from the camera."""
    placed = looking([1.0, 0.5, 3.3], [1.2, 0.6, 4]) @ mi.ScalarTransform4f().scale(9)
    return two(screen={"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5), "to_world": placed})


@pytest.mark.parametrize(
    ("make", "number"),
    [
        (room, 0),
        (two, 2),
        (behind, 0),
        (lambda: two(camera=camera() | {"to_world": looking([0, 0, 9], [0, 0, 20])}), 0),
        (lambda: two(other=speck([-0.3, 0.3, 0.5], "rectangle", type="directionalarea")), 1),
        (lambda: speck_in_view(0.2).scene(), 0),
    ],
    ids=["a large one", "two", "behind a screen", "out of view", "parallel", "of two pixels"],
)  # fmt: skip
def test_classification_of_small_lamps(make: Callable[[], dict[str, Any]], number: int):
    assert len(found(make())) == number


def test_too_many_lamps_are_left_to_primary_rays(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(graph, "MOST", 1)
    assert found(two()) == ()


def test_scenes_without_small_lamps_have_no_extra_operations():
    """Scenes with small lamps have extra operations."""
    operations = {}
    for name, make in {"none": room, "some": two}.items():
        scene = load(make())
        ours = integrator("reslrb", 4, estimator="stack")
        plan = ours.plan(scene, scene.sensors()[0])
        other = with_change(plan, small_lamps=() if plan.small_lamps else plan.needs.lamps)
        operations[name] = [sum(count(ours, p, scene, scene.sensors()[0])) for p in (plan, other)]
    assert operations["none"][0] < operations["none"][1]
    assert operations["some"][0] > operations["some"][1]


# ---- Lamps that move ----


def radiance_gradient(key: str, moves: bool, size: float) -> np.ndarray:
    """Return the derivative by the radiance of a visible lamp. The radiance is the only parameter, or with `moves` also
    the lamp's position.
    """
    rest = mi.AffineTransform4f(transform(rotate=([1, 0, 0], -80), scale=size).matrix)

    def place(params: mi.SceneParameters, latents: dict[str, Any]) -> None:
        x = latents.get("x", mi.Float(0.1))
        params["light.to_world"] = mi.AffineTransform4f().translate(mi.Vector3f(x, 0.5, 0)) @ rest

    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": rgb(3, 2, 4)}}
    start = {key: None} | ({"x": 0.1} if moves else {})
    moving = Moving(over_floor(lamp, floor=flat(diffuse(0, 0, 0))), start, place)
    moving.weigh(smooth_weights())
    return moving.gradient(integrator("reslrb", 1, estimator="stack"), 1, 64)[key]


@pytest.mark.parametrize("size", a_few([0.4, 0.01], ["0.01"]))
def test_radiance_counts_once_if_its_lamp_moves_too(size: float):
    """Primary rays and the points that follow the moving lamp must not both count the radiance."""
    key = "light.emitter.radiance.value"
    alone, beside = (radiance_gradient(key, moves, size) for moves in (False, True))
    assert alone.all()
    assert relative(beside, alone) < 1e-4


# ---- The code broken on purpose ----

SPLAT = "transport.lamp_light:small_points"
FAULTS = [
    Fault("left_out", "third", "transport.emission:splat_visible_emission", "if samples.plan.small_lamps",
          "if False", frozenset({("stack", "ptracer")})),
    Fault("not_differentiated", "third", "transport.emission:differentiate_visible_emission",
          "plan.small_lamps and plan", "False and plan", frozenset({("stack", "walk_ad"), ("stack", "analytic")})),
    Fault("primary_rays_find_them_too", "third", "transport.emission:_radiance",
          "emitter != mi.EmitterPtr(lamp.emitter)", "mi.Bool(True)",
          frozenset({("stack", "analytic"), ("stack", "ptracer")})),
    Fault("cosine_forgotten", "two", "transport.lamp_light:_points", "cos * weight", "weight",
          frozenset({("stack", "ptracer")})),
    Fault("turns_not_counted", "two", SPLAT, "(mi.Float(count) / mi.Float(lanes))", "1",
          frozenset({("stack", "ptracer")})),
    Fault("one_lamp_for_all", "two", SPLAT, "dr.select(turn == number, mi.UInt32(lamp.index), index)", "index",
          frozenset({("stack", "ptracer")})),
]  # fmt: skip


@planted(FAULTS)
def test_fault(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    plant(fault, monkeypatch)
    assert {reference for _, reference in fault.fails} <= failures(fault.check)
