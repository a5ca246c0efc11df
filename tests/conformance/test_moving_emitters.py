"""Emitters that move."""

from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.moving import Moving, flat
from conformance.moving_lamps import CASES, PIVOT, LampCase, mesh, over_floor, smooth_weights, surface
from conformance.operations import count, tracking
from measure.faults import Fault, plant, planted
from turns import a_few

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators.protocol import StepIntegrator
from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.comparison import Family, compare_expectations
from reslrb_cli.measure.gradients import integrator, relative, seeds
from reslrb_cli.measure.scenes.small import diffuse, load, rgb, transform
from reslrb_cli.records.measurements import Verdict
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.transport.lamps import drawn_face, sums_of_areas

pytestmark = pytest.mark.usefixtures("llvm")


# Emitters that move: derivatives by their position, against finite differences with common random numbers.

#: Allowed difference from finite differences, relative to the root mean square of the derivatives of a case.
CLOSE = 0.005
FAMILY = Family(len(CASES), 5 * len(CASES))


def tracer(case: LampCase, name: str = "reslrb", **options: Any) -> StepIntegrator:
    """Return an integrator with `stack`, or with naive AD of the same walk."""
    own: dict[str, Any] = {"estimator": "stack"} if name == "reslrb" else {"attached": True}
    return integrator(name, **{"max_depth": 2, "hide_emitters": True} | own | case.options | options)


def compare(case: LampCase, count: int) -> Any:
    """Compare derivatives by each latent with finite differences at the same seeds. Units are chosen so that the
    derivatives are similar.
    """
    moving, ours = case.moving(), tracer(case)
    units = {name: 10.0 if name == "angle" else 1.0 for name in case.start}
    steps, differences = [], []
    for seed in seeds(count):
        gradient = moving.gradient(ours, seed, case.spp)
        steps.append([gradient[name][0] * unit for name, unit in units.items()])
        differences.append([
            moving.difference(ours, name, case.step * unit, seed, case.spp) * unit for name, unit in units.items()
        ])  # fmt: skip
    mine, theirs = np.array(steps), np.array(differences)
    size = float(np.sqrt(np.mean(theirs.mean(0) ** 2)))
    return compare_expectations(mine, theirs, FAMILY, bias=CLOSE * size, rounding=0.0)


def check(case: LampCase, count: int) -> None:
    """Assert that derivatives and differences agree, and that their relative L2 distance is below 0.05."""
    found = compare(case, count)
    print(case.name, found)
    assert found.verdict is not Verdict.FAILS, found
    assert (found.relative_l2 or 0.0) < 0.05, found


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name, marks=() if c.quick else pytest.mark.long) for c in CASES])
def test_finite_differences(case: LampCase):
    check(case, 4 if case.quick else case.seeds)


@pytest.mark.long
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_naive_ad(case: LampCase):
    moving = case.moving()
    ours = moving.gradient(tracer(case, attached_sampling="follow"), 1, case.spp)
    naive = moving.gradient(tracer(case, "walk_ad"), 1, case.spp)
    for name, value in ours.items():
        size = np.sqrt(np.mean([float(other @ other) for other in naive.values()]))
        assert abs(value - naive[name])[0] <= 5e-5 * max(size, abs(naive[name][0])), name


def image(scene: Any, name: str = "reslrb", spp: int = 64, **options: Any) -> np.ndarray:
    """Return the image of a scene, without directly visible emitters."""
    options = {"max_depth": 2, "hide_emitters": True} | options
    return np.array(render_image(integrator(name, **options), scene, 0, 5, spp), np.float64)


SKIES = {
    "constant": {"type": "constant"},
    "directional": {"type": "directional", "direction": [0.1, -1, 0]},
    "envmap": {"type": "envmap", "data": None},
    "sunsky": {"type": "sunsky"},
}


def tiles(x: float, sky: dict[str, Any]) -> dict[str, Any]:
    """Return two squares under a sky. One square is shifted by `x`."""
    if sky["type"] == "envmap":
        sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}
    above = mi.ScalarTransform4f().look_at([0, 12, 0], [0, 0, 0], [0, 0, -1])
    other = flat(diffuse(0.8, 0.8, 0.8), scale=0.5) | {"to_world": _aside(x)}
    return over_floor(sky, floor=flat(diffuse(0.8, 0.8, 0.8), scale=0.5), other=other) | {
        "camera": over_floor(sky)["camera"] | {"to_world": above}
    }


def _aside(x: float) -> Any:
    return transform(translate=[x, 0, 0], rotate=([1, 0, 0], -90), scale=0.5)


@pytest.mark.parametrize("name", a_few(["reslrb", "ptracer"], ["reslrb"]))
@pytest.mark.parametrize("sky", a_few(SKIES, ["constant", "directional", "envmap"]))
def test_what_leaves_the_scene_stays_lit(sky: str, name: str):
    scene = load(tiles(0.4, SKIES[sky]))
    before = image(scene, name)
    params = mi.traverse(scene)
    params["other.to_world"] = mi.AffineTransform4f(_aside(4).matrix)
    params.update()
    moved, fresh = image(scene, name).sum(), image(load(tiles(4, SKIES[sky])), name).sum()
    assert moved == pytest.approx(fresh, rel=0.03)
    assert before.sum() < 0.9 * moved  # otherwise nothing moved out: the squares overlapped


def test_a_horizon_is_renewed_only_if_needed():
    scene = load(tiles(4, SKIES["constant"]))
    ours = integrator("reslrb")
    horizons = []
    for x in (4, 3.9, 4.01, 4.1, 0.4):
        params = mi.traverse(scene)
        params["other.to_world"] = mi.AffineTransform4f(_aside(x).matrix)
        params.update()
        horizons.append(ours.plan(scene, scene.sensors()[0]).horizon)
    assert horizons[0] == horizons[1] != horizons[2] == horizons[3] != horizons[4]


def test_a_growing_parallel_lamp_emits_more_light():
    lamp = surface("rectangle", "directionalarea")
    scene = load(over_floor(lamp))
    params = mi.traverse(scene)
    params["light.to_world"] = params["light.to_world"] @ mi.AffineTransform4f().scale(1.5)
    params.update()
    larger = lamp | {"to_world": lamp["to_world"] @ mi.ScalarTransform4f().scale(1.5)}
    assert image(scene).sum() == pytest.approx(image(load(over_floor(larger))).sum(), rel=1e-3)


def test_a_flipped_sphere_emits_outward():
    turned = surface("sphere") | {"to_world": transform(translate=PIVOT, rotate=([1, 0, 0], 90), scale=0.4)}
    straight = surface("sphere") | {"to_world": transform(translate=PIVOT, scale=0.4)}
    expected, found = (image(load(over_floor(lamp)), spp=1024).sum() for lamp in (straight, turned))
    assert found == pytest.approx(expected, rel=0.02)


def seen(lamp: Any, **changes: Any) -> Moving:
    """Return a lamp near the floor that faces the camera and can move."""

    def place(params: mi.SceneParameters, latents: dict[str, Any]) -> None:
        shift = mi.AffineTransform4f().translate(mi.Vector3f(latents["x"], latents["y"], 0))
        moved = shift @ mi.AffineTransform4f().scale(mi.Vector3f(latents["size"]))
        params["light.to_world"] = moved @ mi.AffineTransform4f(transform(rotate=([1, 0, 0], -80), scale=0.4).matrix)

    result = Moving(over_floor(lamp, floor=flat(diffuse(0, 0, 0)), **changes), {"x": 0.1, "y": 0.5, "size": 1.0}, place)
    result.weigh(smooth_weights())
    return result


LAMPS = {
    "rectangle": {"type": "rectangle", "emitter": {"type": "area", "radiance": rgb(3, 2, 4)}},
    "sphere": {"type": "sphere", "emitter": {"type": "area", "radiance": rgb(3, 2, 4)}},
}


@pytest.mark.long
@pytest.mark.parametrize("kind", a_few(LAMPS, ["sphere"]))
def test_the_outline_of_a_visible_lamp_moves(kind: str):
    """Primary rays either hit the lamp or miss it, so their differences are noisy. The test uses large steps and many
    samples.
    """
    moving = seen(LAMPS[kind])
    ours, naive = integrator("reslrb", 1, estimator="stack"), integrator("walk_ad", 1, attached=True)
    gradients = [moving.gradient(ours, seed, 64) for seed in seeds(3)]
    for name, value in moving.gradient(naive, seeds(3)[0], 64).items():
        assert relative(gradients[0][name], value) < 1e-4
    mine = np.array([[gradient[name][0] for name in moving.start] for gradient in gradients])
    theirs = np.array([[moving.difference(ours, name, 0.1, seed, 512) for name in moving.start] for seed in seeds(3)])
    found = compare_expectations(mine, theirs, FAMILY, bias=CLOSE * np.abs(theirs.mean(0)), rounding=0.0)
    print(kind, found)
    assert found.verdict is not Verdict.FAILS, found
    assert (found.relative_l2 or 0.0) < 0.03


def test_a_hidden_lamp_has_no_effect():
    moving = seen(LAMPS["rectangle"])
    hidden = moving.gradient(integrator("reslrb", 2, estimator="stack", hide_emitters=True), 1, 16)
    assert not any(value.any() for value in hidden.values())


def test_walk_ad_shows_a_moving_lamp():
    """`walk_ad` splats the lamp's derivative twice. This derivative must not show in the image."""
    moving = seen(LAMPS["rectangle"])
    results = []
    for name, options in (("walk_ad", {"attached": True}), ("reslrb", {"estimator": "stack"})):
        moving.gradient(integrator(name, 2, **options), 1, 16)
        results.append(moving.image)
    assert relative(*results) < 1e-5


@pytest.mark.parametrize("kind", ["rectangle", "sphere"])
@pytest.mark.parametrize("emitter", ["area", "directionalarea"])
def test_one_kernel_contains_everything(kind: str, emitter: str):
    """The derivative by an entry of a transformation is a sum over all paths. No path is traced again for this
    derivative.
    """
    scene = load(over_floor(surface(kind, emitter)))
    params, sensor = mi.traverse(scene), scene.sensors()[0]
    ours = integrator("reslrb", 3, estimator="stack")
    with tracking(params, ["light.to_world"]):
        kernels = count(ours, ours.plan(scene, sensor, params), scene, sensor)
    assert len(kernels) == 1


REFUSED = {
    "envmap": ({"type": "envmap", "data": None}, "light.to_world", "sampled by its radiance"),
    "sunsky": ({"type": "sunsky"}, "light.to_world", "sampled by its radiance"),
    "sun": ({"type": "sunsky"}, "light.sun_direction", "direction of the light"),
    "cutoff": ({"type": "spot"}, "light.cutoff_angle", "direction of the light"),
}


@pytest.mark.parametrize("name", list(REFUSED))
def test_refused_with_a_reason(name: str):
    light, key, reason = REFUSED[name]
    scene = load(tiles(1, light) if name != "cutoff" else over_floor(light))
    params = mi.traverse(scene)
    assert key in params
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(UnsupportedScene, match=f"{key}: .*{reason}"):
        integrator("reslrb", estimator="stack").plan(scene, scene.sensors()[0], params)


FAULTS = [
    Fault("area_of_faces_detached", "mesh", "transport.lamps:lamp_point", "area / dr.detach(area)", "mi.Float(1)"),
    Fault("start_does_not_move", "parallel", "estimators.attached:differentiate_start", "if plan.moving_emission:",
          "if False:"),
    Fault("normal_of_sphere_as_mitsuba_has_it", "turned", "transport.lamps:lamp_point", "if lamp.is_sphere:",
          "if False:"),
    Fault("parallel_light_off_the_face", "parallel_mesh", "transport.lamps:lamp_ray", "si.sh_frame.n", "si.n"),
    Fault("texture_looked_up_along_a_ray", "textured_mesh", "transport.lamps:_textured_point",
          "mi.RayFlags.All | mi.RayFlags.FollowShape", "mi.RayFlags.All"),
    Fault("density_detached", "parallel", "transport.lamps:lamp_ray", "radiance * weight",
          "radiance * dr.detach(weight)"),
    Fault("rays_detached", "spot", "transport.emission:emission_of",
          "Emission(ray if plan.moving_emission else dr.detach(ray), weight, emitter, position",
          "Emission(dr.detach(ray), weight, emitter, position"),
]  # fmt: skip
#: Tests for faults that finite differences share.
FOUND_BY = {"turned": test_a_flipped_sphere_emits_outward}


@planted(FAULTS)
def test_fault(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    plant(fault, monkeypatch)
    find = FOUND_BY.get(fault.check) or partial(check, next(c for c in CASES if c.name == fault.check), 4)
    with pytest.raises(AssertionError):
        find()


def test_faces_of_a_mesh_match_those_that_mitsuba_samples():
    scene = load(over_floor(mesh()))
    [lamp] = SceneGraph.of(scene).find_lamps(scene)
    [areas] = sums_of_areas([lamp])
    samples = mi.Float(np.random.default_rng(1).random(1000).astype(np.float32))
    ps = lamp.shape.sample_position(0, mi.Point2f(0.3, samples))
    face = drawn_face(areas, samples)
    normal, corner = lamp.shape.face_normal(face), lamp.shape.vertex_position(lamp.shape.face_indices(face)[0])
    assert np.abs(np.array((ps.p - corner).x * normal.x + (ps.p - corner).y * normal.y + (ps.p - corner).z * normal.z)
                  ).max() < 1e-5  # fmt: skip
