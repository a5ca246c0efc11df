"""Derivatives of camera paths when shapes move, against finite differences of images by Mitsuba's `path`.

In the cases, a shape fills the whole image, so that no edge covers or uncovers light. test_edges.py has edges. Other
tests compare the classes of light paths and camera paths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import Agreement, compare
from conformance.edge_cases import ABOVE, LAMPS, SIZE, _camera, _open
from conformance.moving import Moving, turned
from measure.faults import Fault, assert_found, planted
from turns import a_few

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.gradients import integrator, relative, seeds, smooth_weights
from reslrb_cli.measure.scenes.moving import Latents
from reslrb_cli.measure.scenes.small import bitmap, diffuse, lit_square, look_at, rectangle, rgb, transform

pytestmark = pytest.mark.usefixtures("registers")

#: Translation along z, and rotation by units of `TURN` degrees about an axis through the origin.
MOTION, TURN, STEP = ("z", "turn"), 30.0, 0.02
NOISE = np.random.default_rng(3)
TEXELS, SKY = NOISE.uniform(0.1, 0.9, (6, 6, 3)), NOISE.uniform(0.1, 3, (8, 16, 3))


def two_sided(bsdf: Any) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": bsdf}


def wall(bsdf: Any) -> Any:
    return rectangle(two_sided(bsdf), transform(scale=6))


def painted() -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": bitmap(TEXELS, "bilinear")}


SHAPES: dict[str, Callable[[], dict[str, Any]]] = {
    "matte": lambda: {"shape": wall(diffuse(0.7, 0.5, 0.3))},
    "painted": lambda: {"shape": wall(painted())},
    "plastic": lambda: {"shape": wall({"type": "roughplastic", "alpha": 0.2})},
    "mirror": lambda: {"shape": wall({"type": "conductor"})},
    "glass": lambda: {
        "shape": rectangle({"type": "dielectric"}, transform(translate=[0, 0, 0.6], scale=6)),
        "under": rectangle({"type": "dielectric"}, transform(translate=[0, 0, 0.3], rotate=([1, 0, 0], 180), scale=6)),
        "floor": lit_square(bitmap(TEXELS, "bilinear"), transform(scale=9)),
    },
}
EMITTERS: dict[str, Callable[[], dict[str, Any]]] = {
    **LAMPS,
    "wide": lambda: lit_square(rgb(1, 1, 1), look_at(ABOVE, [0, 0, 0], [0, 1, 0]) @ transform(scale=2)),
    "sky": lambda: {"type": "envmap", "bitmap": mi.Bitmap(SKY.astype(np.float32))},
}


@dataclass(frozen=True)
class Case:
    """A moving shape of `SHAPES` under an emitter of `EMITTERS`. With `reflector`, a second surface reflects light."""

    shape: str
    lamp: str
    depth: int = 2
    reflector: bool = False

    @property
    def name(self) -> str:
        """The name of the test."""
        return f"{self.shape}-{self.lamp}-{self.depth}"

    def moving(self) -> Moving:
        """Load the scene."""
        first: list[Any] = []

        def place(params: mi.SceneParameters, latents: Latents) -> None:
            key = "shape.to_world"
            first.append(mi.AffineTransform4f(params[key].matrix))
            motion = turned(TURN * latents["turn"], [0.3, 1.0, 0.5], [0.0, 0.0, latents["z"]])
            params[key] = motion @ first[0]

        scene = {"type": "scene", "camera": _camera([0.4, -3, 2.2], [0, 0, 0], 25), "lamp": EMITTERS[self.lamp]()}
        if self.reflector:
            place_of = transform(translate=[0, 6, 2], rotate=([1, 0, 0], 90), scale=9)
            scene["reflector"] = rectangle(two_sided(diffuse(0.3, 0.6, 0.8)), place_of)
        moving = Moving(scene | SHAPES[self.shape](), dict.fromkeys(MOTION, 0.0), place)
        moving.weigh(smooth_weights(SIZE, SIZE))
        return moving

    def agreement(self) -> Agreement:
        """Return the comparison of gradients with finite differences."""
        moving, path = self.moving(), integrator("path", self.depth)
        tracer = integrator("reslrb", self.depth, estimator="stack", paths="camera")
        found = [np.concatenate([*moving.gradient(tracer, seed, 64).values()]) for seed in seeds(8)]

        def difference(seed: int, name: str) -> float:
            ends = [moving.value(path, seed, 256, **{name: step}) for step in (STEP, -STEP)]
            return (ends[0] - ends[1]) / (2 * STEP)

        differences = np.array([[difference(seed, name) for name in MOTION] for seed in seeds(8, 1)])
        # The differences themselves have an error of the second order in the step.
        noise = np.random.default_rng(1).normal(size=differences.shape) * 5e-4 * np.abs(differences).max()
        return compare(np.array(found), differences + noise, block=None)


CASES = [
    Case("matte", "wide"), Case("matte", "sphere_lamp"), Case("matte", "spot"), Case("painted", "sky"),
    Case("matte", "area", 3, reflector=True), Case("plastic", "area"), Case("mirror", "sky"),
    Case("glass", "sky", 3),
]  # fmt: skip
BY_NAME = {case.name: case for case in CASES}


@pytest.mark.parametrize("case", a_few(CASES, ["matte-wide-2", "glass-sky-3"]))
def test_gradient(case: Case):
    agreement = case.agreement()
    print(f"{case.name}: {agreement}")
    assert agreement, agreement
    assert agreement.relative_error < 0.03


FAULTS = [
    Fault("places_have_no_derivative", "matte-wide-2", "estimators.attached_camera:AttachedCameraFrame.differentiate",
          "factor * (own + later)", "own + later"),
    Fault("lamps_have_no_distance", "matte-area-3", "transport.camera:next_event_again",
          "measure / dr.detach(measure)", "mi.Float(1)"),
    Fault("sky_is_constant", "mirror-sky-2", "estimators.attached_camera:AttachedCameraFrame.differentiate",
          "-ray.d", "dr.detach(-ray.d)"),
    Fault("adjoint_of_rays_left_out", "glass-sky-3", "estimators.attached_camera:AttachedCameraFrame.differentiate",
          "dr.select(scattered, moved, 0)", "0"),
    Fault("weights_of_next_events_left_out", "matte-wide-2", "transport.camera:_weigh",
          "event.scale * weight", "event.scale"),
    Fault("spheres_sampled_by_directions", "matte-sphere_lamp-2", "transport.camera:_spheres",
          "samples.plan.attached", "False"),
]  # fmt: skip


@planted(FAULTS)
def test_fault(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    agreement = BY_NAME[fault.check].agreement
    assert_found(fault, monkeypatch, lambda: (found := agreement()) and found.relative_error <= 0.03)


# ---- Parameters that do not move ----


def test_other_parameters_have_their_usual_derivatives():
    """With a motion beside them, colours and radiance have the same derivatives as without one, at equal seeds."""
    scene = _open("area") | {"shape": rectangle(two_sided(diffuse(0.4, 0.5, 0.6)), transform(translate=[0, 0, 0.5]))}
    keys = ["floor.bsdf.reflectance.value", "shape.bsdf.brdf_0.reflectance.value", "lamp.emitter.radiance.value"]

    def place(params: mi.SceneParameters, latents: Latents) -> None:
        params["shape.to_world"] = turned(0 * latents["z"], [0, 0, 1], [0, 0, latents["z"]]) @ mi.AffineTransform4f(
            dr.detach(params["shape.to_world"]).matrix
        )

    tracer = integrator("reslrb", 4, estimator="stack", paths="camera")
    alone = Moving(scene, dict.fromkeys(keys)).gradient(tracer)
    beside = Moving(scene, dict.fromkeys(keys) | {"z": 0.0}, place).gradient(tracer)
    for key in keys:
        assert relative(beside[key], alone[key]) < 1e-4, key


# ---- Classes of paths ----


def glass_and_mirrors() -> dict[str, Any]:
    """Return a scene with light through glass, from mirrors, and from rough metal."""
    return _open("near") | {
        "shape": {"type": "sphere", "center": [-0.4, 0.3, 0.6], "radius": 0.5, "bsdf": {"type": "dielectric"}},
        "mirror": {"type": "sphere", "center": [0.8, 0.6, 0.5], "radius": 0.4, "bsdf": {"type": "conductor"}},
        "metal": {"type": "sphere", "center": [0.4, -0.7, 0.5], "radius": 0.5,
                  "bsdf": {"type": "roughconductor", "alpha": 0.3}},
        "plastic": {"type": "sphere", "center": [-0.6, -0.7, 0.25], "radius": 0.25, "bsdf": {"type": "plastic"}},
    }  # fmt: skip


IMAGE_SPP = 256


@cache
def weighted_images() -> np.ndarray:
    """Return images (8, H, W, C) of both kinds of paths, combined by weights."""
    moving, tracer = Moving(glass_and_mirrors(), {}), integrator("reslrb", 6, estimator="stack", paths="both")
    return np.array([render_image(tracer, moving.loaded, 0, seed, IMAGE_SPP) for seed in seeds(8, 1)], np.float64)


def images_by_class() -> np.ndarray:
    """Return images (8, H, W, C) of both kinds of paths, divided by class."""
    moving, tracer = Moving(glass_and_mirrors(), {}), integrator("reslrb", 6, estimator="stack", paths="both")
    dr.enable_grad(moving.params["shape.to_world"])
    sensor, plain = moving.loaded.sensors()[0], mi.TensorXf(np.zeros((SIZE, SIZE, 3), np.float32))
    jobs = [Job(moving.loaded, sensor, dr.opaque(mi.UInt32, seed), IMAGE_SPP, moving.params) for seed in seeds(8)]
    return np.array([tracer.known(job, plain) for job in jobs], np.float64)


def test_classes_contain_all_light_once():
    agreement = compare(images_by_class(), weighted_images(), block=2)
    print(agreement)
    assert agreement, agreement


CLASS_FAULTS = [
    Fault("light_paths_have_all_light", "", "transport.walk:walk", "connected &= begins | (path.depth > 1)", "pass"),
    Fault("camera_paths_hit_all_light", "", "transport.camera:_meet", "active &= ~own_class.excludes_hit()", "pass"),
    Fault("metal_counts_twice", "", "transport.camera:camera_walk",
          "~((own_class.before != 0) & begins_caustic(bsdf, False))", "True"),
    Fault("caustics_in_mirrors_left_out", "", "transport.camera:PathClass.past",
          "dr.select(scattering.is_delta, mi.UInt32(0), 1)", "mi.UInt32(1)"),
]  # fmt: skip


@planted(CLASS_FAULTS)
def test_fault_of_classes(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    expected = weighted_images()  # without the fault
    assert_found(fault, monkeypatch, lambda: compare(images_by_class(), expected, block=2))


def test_forward_mode_refuses_moving_camera_paths():
    moving = CASES[0].moving()
    dr.enable_grad(moving.params["shape.to_world"])
    job = Job(moving.loaded, moving.loaded.sensors()[0], dr.opaque(mi.UInt32, 1), 4, moving.params)
    with pytest.raises(UnsupportedScene, match="forward mode has no derivatives of moving shapes for camera paths"):
        integrator("reslrb", 2, estimator="stack", paths="camera").tangent(job)


@pytest.mark.parametrize(("paths", "refused"), [("light", True), ("both", True), ("camera", False)])
def test_a_box_filter_is_refused_if_light_paths_move_over_the_film(paths: str, refused: bool):
    camera = _camera([0.4, -3, 2.2], [0, 0, 0], 25)
    camera["film"]["rfilter"] = {"type": "box"}
    scene = mi.load_dict({"type": "scene", "camera": camera, "lamp": EMITTERS["wide"](), **SHAPES["matte"]()})
    params = mi.traverse(scene)
    dr.enable_grad(params["shape.to_world"])
    job = Job(scene, scene.sensors()[0], dr.opaque(mi.UInt32, 1), 4, params)
    tracer = integrator("reslrb", 2, estimator="stack", paths=paths)
    if refused:
        with pytest.raises(UnsupportedScene, match="has a box filter"):
            tracer.passes(job)
    else:
        assert tracer.passes(job)
