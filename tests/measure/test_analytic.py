"""Scenes and motions with known images and known derivatives."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare, renders
from measure.analytic_motion import KnownMotion, ball_lens, lamp_over_plane, tilted_surface
from turns import a_few, taking_turns

from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.comparison import Family, compare_expectations
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.references import Situation, prb_gradient, ptracer_gradient
from reslrb_cli.measure.scenes.analytic import (
    ALBEDO,
    UP,
    Known,
    KnownScene,
    beam_through_slab,
    fresnel,
    furnace,
    furnace_scene,
    plane_points,
    refraction_scene,
    slab_scene,
)
from reslrb_cli.measure.scenes.moving import displacement, number, pose
from reslrb_cli.measure.scenes.small import SIZE, diffuse, pinhole, rectangle, rgb
from reslrb_cli.records.measurements import Verdict
from reslrb_cli.transport.walk import Segment

# Scenes with known images test the formulas' consistency, Mitsuba's integrators, and our gradients.

LIGHT = (0.4, 0.8, -0.3)


def irradiance(light: tuple[float, float, float], height: float, fov: float, size: int) -> np.ndarray:
    """Return the mean irradiance of each pixel (H, W, 1) from a point light of unit power on the plane y = 0 (J. H.
    Lambert).
    """
    points, weights = plane_points(height, fov, size)
    to_light = np.array(light) - points
    return (to_light[..., 1] / np.linalg.norm(to_light, axis=-1) ** 3 @ weights)[..., None]


def plane_scene() -> KnownScene:
    """Return a point light over a plane. The light is off the camera's axis."""
    intensity = (2, 3, 4)

    def scene() -> dict:
        return {
            "type": "scene",
            "camera": pinhole([0, 1.5, 0], [0, 0, 0], [0, 0, -1], 50),
            "light": {"type": "point", "position": list(LIGHT), "intensity": rgb(*intensity)},
            "plane": rectangle(diffuse(*ALBEDO), rotate=UP, scale=2),
        }

    by_albedo = irradiance(LIGHT, 1.5, 50, SIZE) / np.pi * intensity
    known = Known(by_albedo * ALBEDO, {"albedo": by_albedo, "intensity": by_albedo * ALBEDO / intensity})
    keys = {"albedo": "plane.bsdf.reflectance.value", "intensity": "light.intensity.value"}
    return KnownScene(scene, known, keys, 2)


SCENES = {
    "furnace": (lambda: furnace_scene((0.5, 0.8, 0.9), (1, 2, 0.5), 16, 8), 64, "path"),
    "plane": (plane_scene, 256, "path"),
    "refraction": (refraction_scene, 256, "ptracer"),
    "slab": (slab_scene, 512, "ptracer"),
    "slab_head_on": (lambda: slab_scene(degrees=0, max_depth=4), 256, "ptracer"),
}


def twice(exact: np.ndarray) -> np.ndarray:
    """Return a sample of two equal values without noise."""
    return np.stack([exact, exact])


def test_prb_is_no_reference_inside_of_an_emitting_sphere(llvm: str):
    """`prb` is 0.2 to 0.4 % off there, which is far more than its noise."""
    cube = furnace_scene((0.5, 0.8, 0.9), (1, 2, 0.5), 16, 8).scene()
    walls = {name: value for name, value in cube["walls"].items() if name != "type"}
    scene = mi.load_dict({**cube, "walls": {"type": "sphere", "radius": 2, **walls}})
    params = mi.traverse(scene)
    [key] = [key for key in params.keys() if key.endswith("reflectance.value")]  # noqa: SIM118 (not a mapping)
    at = Situation.of(scene, scene.sensors()[0], params, 4, False, paths="camera")
    assert "inside of an emitting sphere" in (prb_gradient(at, key) or "")
    assert ptracer_gradient(at, key) is None


def test_furnace_approaches_its_limit():
    limit = furnace(0.9, 2.0, -1, 1)
    deep = furnace(0.9, 2.0, 1024, 1)
    assert limit.image[0, 0] == pytest.approx([20.0] * 3)
    assert limit.derivatives["albedo"][0, 0] == pytest.approx([200.0] * 3)
    for name in ("albedo", "emission"):
        assert deep.derivatives[name] == pytest.approx(limit.derivatives[name], rel=1e-12)


def test_white_furnace_counts_its_bounces():
    known = furnace(1.0, 0.5, 1024, 1)
    assert known.image[0, 0, 0] == pytest.approx(512)
    assert known.derivatives["albedo"][0, 0, 0] == pytest.approx(0.5 * 1023 * 1024 / 2)
    with pytest.raises(ValueError, match="without bound"):
        furnace(1.0, 0.5, -1, 1)


def test_black_furnace_reflects_once_to_first_order():
    known = furnace(0.0, 3.0, 8, 1)
    assert known.image[0, 0, 0] == 3
    assert known.derivatives["albedo"][0, 0, 0] == 3


def test_fresnel():
    assert fresnel(np.array(0.0), 1.5) == pytest.approx(0.04)
    assert fresnel(np.array(0.7), 1.0) == pytest.approx(0)
    brewster = np.arctan(1.5)  # light of only one polarisation is reflected
    assert fresnel(np.array(brewster), 1.5) == pytest.approx(np.sin(2 * brewster - np.pi / 2) ** 2 / 2)
    assert fresnel(np.array(np.pi / 2), 1.5) == pytest.approx(1)


def test_a_medium_of_index_one_has_no_effect():
    alone = np.array([9, 6, 5]) * irradiance((0.3, 1.6, -0.2), 0.9, 60, SIZE)
    transmitted = alone * np.array([0.9, 0.8, 0.6])
    assert refraction_scene(1.0).known.image == pytest.approx(transmitted * np.array(ALBEDO) / np.pi, rel=1e-9)


@pytest.mark.parametrize("name", ["albedo", "radiance", "transmittance", "reflectance"])
def test_slab_derivatives(name: str):
    values = {"albedo": 0.5, "radiance": 2.0, "transmittance": 0.8, "reflectance": 0.7}

    def image(step: float) -> float:
        changed = values | {name: values[name] + step}
        known = beam_through_slab(**changed, ior=2.0, angle=0.9, max_depth=12, size=1)
        return float(known.image[0, 0, 0])

    exact = beam_through_slab(**values, ior=2.0, angle=0.9, max_depth=12, size=1).derivatives[name][0, 0, 0]
    assert exact == pytest.approx((image(1e-5) - image(-1e-5)) / 2e-5, rel=1e-6)


@pytest.mark.parametrize("name", a_few(SCENES, [name for name in SCENES if name != "slab_head_on"]))
def test_images(name: str, llvm: str):
    make, spp, stock = SCENES[name]
    known: KnownScene = make()
    case = Case(known.scene(), known.keys.values())
    for kind in ("reslrb", stock):
        tracer = integrator(kind, known.max_depth)
        images = renders(lambda seed, tracer=tracer: render_image(tracer, case.scene, 0, seed, spp), seeds(8))
        result = compare(images, twice(known.known.image), block=4)
        print(name, kind, result)
        assert result, kind
        assert result.relative_error < 0.02


@taking_turns("name", list(SCENES), "estimator", ["reservoir", "gather"], ["furnace", "slab"])
def test_gradients(name: str, estimator: str, llvm: str):
    make, spp, _ = SCENES[name]
    known: KnownScene = make()
    case = Case(known.scene(), known.keys.values())
    ours = case.gradients(integrator("reslrb", known.max_depth, estimator=estimator), seeds(12), spp)
    exact = known.gradient(case.weights)
    result = compare(ours, twice(exact), block=None)
    print(name, estimator, result)
    assert result
    error = np.linalg.norm(ours.std(0)) / np.sqrt(12) / np.linalg.norm(exact)
    assert error < 0.05, "too noisy to see a fault"


# Derivatives of motions, compared with geometrical optics.

MOTIONS: dict[str, Callable[[], KnownMotion]] = {
    "tilted_surface": tilted_surface,
    "ball_lens": ball_lens,
    "lamp_over_plane": lamp_over_plane,
}


def gradients(motion: KnownMotion, count: int = 8, spp: int = 128) -> np.ndarray:
    case = motion.scene.setup()
    case.weigh(motion.weights)
    return case.gradients(integrator("reslrb", **motion.scene.options, estimator="stack"), seeds(count), spp)


def test_moves_follow_their_amplitudes(llvm: str):
    """The degrees of freedom of a pose act in their order, and turns and sizes about the pivot."""
    amplitudes = [mi.Float(0.5), mi.Float(np.pi / 2), mi.Float(1.0)]
    move = pose("lamp.position", ("tx", "rz", "s"), (1, 0, 0))
    np.testing.assert_allclose(move.value(mi.Point3f(2, 0, 0), amplitudes).numpy().ravel(), [1, 3, 0], atol=1e-6)
    turned = move.value(mi.AffineTransform4f().translate([2, 0, 0]), amplitudes) @ mi.Point3f(0, 0, 0)
    np.testing.assert_allclose(turned.numpy().ravel(), [1, 3, 0], atol=1e-6)
    moved = displacement("top.vertex_positions", np.array([[[1, 0, 0]], [[0, 2, 0]], [[0, 0, 3]]]))
    np.testing.assert_allclose(moved.value(mi.Float(1, 1, 1), amplitudes), [1.5, 1 + np.pi, 4], rtol=1e-6)
    assert (move.size, moved.size, number("a").size) == (3, 3, 1)
    assert number("a").value(mi.Float(0.25), amplitudes[:1])[0] == 0.75


@pytest.mark.parametrize("name", a_few(MOTIONS, ()))
def test_derivatives(name: str):
    motion = MOTIONS[name]()
    ours = gradients(motion)
    largest = float(np.abs(motion.derivatives).max())
    # The formula omits some terms. The bias is relative to each derivative, because the ball's derivatives differ in
    # kind.
    bias = motion.tolerance * np.maximum(np.abs(motion.derivatives), 0.01 * largest)
    found = compare_expectations(ours, motion.derivatives, Family(rows=1, entries=ours.shape[1]), bias=bias)
    print(name, ours.mean(0), motion.derivatives, found)
    assert found.verdict is Verdict.HOLDS
    error = ours.std(0, ddof=1).max() / np.sqrt(len(ours)) / largest
    assert error < 4e-3, "too noisy to see a fault"


def test_a_surface_that_does_not_refract(monkeypatch: pytest.MonkeyPatch):
    right = Segment.next_ray
    monkeypatch.setattr(Segment, "next_ray", lambda self, attached=False: dr.detach(right(self, attached)))
    motion = tilted_surface()
    ours = gradients(motion, 3)
    assert abs(ours.mean() / motion.derivatives[0] - 1) > 0.1


def test_the_focus_of_a_ball_depends_on_its_index():
    for ior in (1.4, 1.8):
        across, along, grown = ball_lens(ior=ior, radius=2.0, offset=0.02).derivatives
        assert along / across == pytest.approx(-0.02 * 2 * (ior - 1) / (ior * 2.0))
        assert grown / across == pytest.approx(0.02)
