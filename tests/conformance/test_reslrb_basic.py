"""`reslrb_basic` has the image of `ptracer` and the gradient of `reslrb` with its reservoir, in constant memory."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import Agreement, compare, is_same, renders
from conformance import test_memory
from conformance.scenes import plugin

import reslrb_cli
from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators.own import OwnIntegrator
from reslrb_cli.integrators.step import interface_of, render_image
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.scenes.small import camera, columns, diffuse, glass, lamp, matte, rgb, room, sphere, texture

bright = test_memory.case  # a fixture
FILE = Path(reslrb_cli.__file__).parent / "integrators" / "reslrb_basic.py"
DEPTH = 4
COUNT = 48

#: A texture, a colour, and a lamp out of view.
FLOOR, WALL, LIGHT = "floor.brdf_0.reflectance.data", "wall.brdf_0.reflectance.value", "lamp.emitter.radiance.value"
ROUGH = "floor.brdf_0.alpha.value"


@pytest.fixture(autouse=True, scope="module")
def _registered(llvm: str) -> None:
    reslrb_cli.register()


def basic(module: ModuleType | None = None, **options: Any) -> Any:
    """Return the step interface of the integrator, or of the class in `module`."""
    options = {"max_depth": DEPTH, **options}
    if module is None:
        return interface_of(mi.load_dict({"type": "reslrb_basic", **options}))
    properties = mi.Properties("reslrb_basic")
    for name, value in options.items():
        properties[name] = value
    return interface_of(module.ReslrbBasic(properties))


@pytest.fixture(scope="module")
def case(llvm: str) -> Case:
    return Case(room(floor=matte(texture(4, 4)), camera=camera("gaussian")), (FLOOR, WALL, LIGHT))


@pytest.fixture(scope="module")
def reference(case: Case) -> np.ndarray:
    """Gradients of the estimator `reservoir`."""
    return gradients_of_reslrb(case)


@pytest.fixture(scope="module")
def rough(llvm: str) -> tuple[Case, np.ndarray]:
    """Roughness of a floor of metal, and its gradients. Its df / f depends on the direction, unlike that of colours."""
    case = Case(room(floor={"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.4}}), (ROUGH,))
    return case, gradients_of_reslrb(case)


def gradients_of_reslrb(case: Case) -> np.ndarray:
    return case.gradients(integrator("reslrb", DEPTH, 1000, estimator="reservoir"), seeds(COUNT, 1), 64)


def agreement(case: Case, ours: Any, reference: np.ndarray, count: int) -> Agreement:
    result = compare(case.gradients(ours, seeds(count), 64), reference, block=None)
    print(result)
    return result


@pytest.mark.parametrize(
    ("max_depth", "hide_emitters"), [(DEPTH, False), pytest.param(2, True, marks=pytest.mark.long)]
)
def test_the_image_is_that_of_ptracer(max_depth: int, hide_emitters: bool):
    """A lamp in view contributes as well, unless emitters are hidden."""
    sign = lamp(radiance=rgb(0.5, 0.6, 0.7)) | {"to_world": mi.ScalarTransform4f().translate([0, -0.2, 0.5]).scale(0.2)}
    case = Case(room(sign=sign, camera=camera("gaussian")), (WALL,))
    options = {"hide_emitters": hide_emitters}
    ours, theirs = (
        renders(lambda seed, tracer=tracer: render_image(tracer, case.scene, 0, seed, 64), seeds(24, k))
        for k, tracer in enumerate((basic(max_depth=max_depth, **options),
                                    integrator("ptracer", max_depth, 1000, **options)))
    )  # fmt: skip
    result = compare(ours, theirs)
    print(result)
    assert result
    assert result.relative_error < 0.01


def test_the_gradient_is_that_of_reslrb(case: Case, reference: np.ndarray):
    result = agreement(case, basic(), reference, COUNT)
    assert result
    assert result.relative_error < 0.01, "more noise would hide faults"


def test_the_last_factor_is_that_of_the_sensor(rough: tuple[Case, np.ndarray], tmp_path: Path):
    assert agreement(rough[0], basic(), rough[1], COUNT)
    assert not agreement(
        rough[0], basic(faulty("dr.select(depth == I, to_sensor, to_next)", "to_next", tmp_path)), rough[1], COUNT
    )


FACTOR = "dr.select(f_s != 0, A / dr.detach(f_s), 0)"
#: Faults by name: text of the file, and what replaces it.
FAULTS = {
    "no probability": ("dr.select(I > 0, W / w, 0)", "dr.select(I > 0, 1, 0)"),
    "reservoir's number not replayed": ("sampler.next_1d(active)  # consume_reservoir_rng()", "pass"),
    "no connection": (FACTOR, FACTOR.replace("f_s != 0", "(f_s != 0) & (depth < I)")),
    "connection alone": (FACTOR, FACTOR.replace("f_s != 0", "(f_s != 0) & (depth == I)")),
    "no emission": ("backward(E, dr.select(E != 0, A / dr.detach(E), 0))", "pass"),
    "stopped where not kept": ("active &= (depth <", "active &= kept & (depth <"),  # as in Figure 4
    "always kept": ("sampler.next_1d(active) * W < w_i", "sampler.next_1d(active) * w_i < w_i"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_found(fault: str, case: Case, reference: np.ndarray, tmp_path: Path):
    assert not agreement(case, basic(faulty(*FAULTS[fault], tmp_path)), reference, COUNT // 3)


def faulty(text: str, replacement: str, folder: Path) -> ModuleType:
    """Return the module with a replaced text."""
    source = FILE.read_text(encoding="utf-8")
    assert source.count(text) == 1
    return module_of(source.replace(text, replacement), folder)


def module_of(source: str, folder: Path) -> ModuleType:
    file = folder / "basic_copy.py"
    file.write_text(source, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_replay_meets_the_same_vertices(case: Case, tmp_path: Path):
    """The film positions of both passes are equal to the bit, up to the kept connection."""
    module, spp = module_of(FILE.read_text(encoding="utf-8"), tmp_path), 4
    count = spp * int(np.prod(case.weights.shape[:2]))
    met: list[tuple[Any, Any]] = []  # of each pass: the number of vertices, and their film positions
    connect = module.connect_to_sensor

    def noting(sensor: Any, sampler: Any, si: Any, ray: Any, active: Any) -> Any:
        ds, wo, importance = connect(sensor, sampler, si, ray, active)
        lane, (numbers, places) = dr.arange(mi.UInt32, count), met[-1]
        slot = dr.scatter_inc(numbers, lane, active)
        dr.scatter(places, ds.uv.x, lane * DEPTH + slot, active)
        return ds, wo, importance

    class Noting(module.ReslrbBasic):  # type: ignore[misc, name-defined]
        def primal(self, *args: Any) -> Any:
            met.append((dr.zeros(mi.UInt32, count), dr.full(mi.Float, np.nan, count * DEPTH)))
            return super().primal(*args)

        def adjoint(self, *args: Any) -> Any:
            met.append((dr.zeros(mi.UInt32, count), dr.full(mi.Float, np.nan, count * DEPTH)))
            return super().adjoint(*args)

    module.connect_to_sensor, module.ReslrbBasic = noting, Noting
    case.gradient(basic(module), 3, spp)
    _, (numbers, first), (replayed, second) = ((np.array(a), np.array(b)) for a, b in met)
    again = ~np.isnan(second)
    assert again.sum() == replayed.sum() > 0
    assert np.array_equal(first[again], second[again])
    assert 0 < (replayed < numbers).mean() < 1
    assert set(replayed) == set(range(DEPTH))


def test_the_gradient_of_a_lamp_in_view_is_that_of_reslrb(llvm: str, tmp_path: Path):
    """A texture of three channels has a graph between its data and the values of both passes' lookups."""
    radiance = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.random.default_rng(0).uniform(1, 9, (2, 2, 3)))}
    sign = lamp(radiance=radiance) | {"to_world": mi.ScalarTransform4f().translate([0, -0.2, 0.5]).scale(0.2)}
    case = Case(room(sign=sign), ("sign.emitter.radiance.data",))
    expected = gradients_of_reslrb(case)
    assert agreement(case, basic(), expected, COUNT)
    assert not agreement(case, basic(faulty("backward(Le, dr", "dr.detach(dr", tmp_path)), expected, COUNT // 3)


@pytest.mark.parametrize("is_right", [True, False])
def test_the_gradient_reaches_a_value_before_the_parameters(is_right: bool, llvm: str, tmp_path: Path):
    """`render_backward` without `mi.render`: one number is behind the lamp and the wall."""
    scene = mi.load_dict(room(lamp=lamp()), optimize=False)
    params, tracer = mi.traverse(scene), plugin("reslrb_basic", max_depth=DEPTH)
    if not is_right:
        properties = mi.Properties("reslrb_basic")
        properties["max_depth"] = DEPTH
        tracer = faulty("dr.isolate_grad()", "dr.resume_grad()", tmp_path).ReslrbBasic(properties)

    def set_to(value: mi.Float) -> None:
        params[LIGHT], params[WALL] = type(params[LIGHT])(10 * value), type(params[WALL])(value)
        params.update()

    dr.enable_grad(latent := mi.Float(0.5))
    set_to(latent)
    ones = dr.ones(mi.TensorXf, tracer.render(scene, spp=1).shape)
    for seed in range(16):
        tracer.render_backward(scene, params, ones, seed=seed, spp=64)
    sums = []
    for value in (0.49, 0.51):
        set_to(mi.Float(value))
        sums.append(np.mean([np.sum(tracer.render(scene, seed=seed, spp=256)) for seed in range(16)]))
    assert (dr.grad(latent)[0] / 16 == pytest.approx((sums[1] - sums[0]) / 0.02, rel=0.02)) == is_right


def test_a_black_lamp_in_view_has_a_derivative(llvm: str):
    case = Case(room(sign=lamp(radiance=rgb(0, 0, 0)) | {"to_world": mi.ScalarTransform4f().scale(0.3)}),
                ("sign.emitter.radiance.value",))  # fmt: skip
    assert (np.abs(case.gradient(basic(), 1, 64)) > 0).all()


def test_negative_radiance_gives_the_gradient_of_the_negative_image(llvm: str):
    """An optimizer may overshoot. The weight of a connection is positive all the same."""
    bright, negative = (
        Case(room(lamp=lamp(radiance=rgb(value, value, value))), (WALL,)).gradient(basic(), 1, 64)
        for value in (10, -10)
    )
    assert (bright != 0).all()
    np.testing.assert_allclose(negative, -bright, rtol=1e-4)


def test_under_mi_render(case: Case):
    key = "wall.brdf_0.reflectance.value"
    scene = mi.load_dict(room(), optimize=False)
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, integrator=plugin("reslrb_basic"), spp=16)
    dr.backward(dr.mean(image, axis=None))
    assert np.array(dr.grad(params[key])).min() > 0


def test_zero_channels_give_finite_gradients(llvm: str):
    """The derivative at a zero channel is left out, and that of the others is not."""
    case = Case(room(floor=columns((0.0, 0.5, 0.0), (0.6, 0.3, 0.5))), (FLOOR,))
    gradient = case.gradient(basic(), 1, 64).reshape(2, 2, 3)
    assert np.isfinite(gradient).all()
    assert (gradient[:, 0, [0, 2]] == 0).all()
    assert (gradient[:, 0, 1] > 0).all()


def test_memory_is_flat_in_depth(bright: Case, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(test_memory, "SPP", 64)
    peaks = {depth: test_memory.peak(bright, "reslrb_basic", depth, adjoint="independent") for depth in (2, 128)}
    print(peaks)
    assert max(peaks.values()) < 4 * 64 * 16 * 16  # not one number per path
    assert max(peaks.values()) <= 1.02 * min(peaks.values()), peaks


def test_the_class_is_usable_as_an_own_integrator(case: Case):
    own = OwnIntegrator(f"{FILE}:ReslrbBasic", DEPTH, 5, False, allowed=True, paths="light")
    assert is_same(case.gradient(own, 5, 4), case.gradient(basic(), 5, 4))


SCRIPT = """
import reslrb_cli
import mitsuba as mi
reslrb_cli.register()
for variant in ("llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)
    scene = mi.load_dict(mi.cornell_box() | {"integrator": {"type": "reslrb_basic", "max_depth": 3}})
    print(mi.render(scene, spp=1).array.numpy().mean() > 0)
"""


@pytest.mark.long
def test_another_variant_has_another_class():
    run = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False)
    assert run.stdout.split() == ["True", "True"], run.stderr


MIRROR = sphere({"type": "conductor", "specular_reflectance": rgb(0.9, 0.8, 0.7)}, [0, -0.7, 0], 0.3)
VEIL = sphere({"type": "mask", "opacity": 0.5, "bsdf": diffuse(0.5, 0.5, 0.5)}, [0, -0.7, 0], 0.3)
SUN = {"type": "directional", "direction": [0, -1, 0], "irradiance": rgb(1, 1, 1)}
INSTANCE = {
    "group": {"type": "shapegroup", "ball": sphere(diffuse(0.5, 0.5, 0.5), [0, -0.7, 0], 0.3)},
    "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}},
}
REFUSED: list[tuple[dict[str, Any], str, str]] = [
    ({"sky": {"type": "constant"}}, "", "reslrb_basic supports area and point lamps, not sky; use reslrb"),
    ({"sun": SUN}, "", "reslrb_basic supports area and point lamps, not sun; use reslrb"),
    ({"veil": VEIL}, "", "is transparent to shadow rays; use reslrb"),
    ({"camera": {"type": "orthographic", "id": "camera"}}, "", "supports perspective and thinlens, not sensor camera"),
    ({"fog": sphere(glass(), [0, 0, 0], 0.3) | {"interior": {"type": "homogeneous"}}}, "", "participating media"),
    (INSTANCE, "", "neither participating media nor instances, as in shape copy"),
    ({}, "floor_shape.to_world", "floor_shape.to_world: reslrb_basic has derivatives of BSDFs and of emission only"),
    ({}, "lamp.to_world", "lamp.to_world: reslrb_basic has derivatives"),
    ({}, "camera.to_world", "camera.to_world: reslrb_basic has derivatives"),
    ({"ball": MIRROR}, "ball.bsdf.specular_reflectance.value", "has no derivatives of smooth specular BSDFs"),
]


@pytest.mark.parametrize(("more", "key", "reason"), REFUSED, ids=[f"{key}-{reason[:40]}" for _, key, reason in REFUSED])
def test_refusals_are_one_line_under_mi_render(more: dict[str, Any], key: str, reason: str):
    scene = mi.load_dict(room(**more), optimize=False)
    params = mi.traverse(scene)
    if key:
        dr.enable_grad(params[key])
        params.update()
    with pytest.raises(UnsupportedScene) as error:
        dr.backward(dr.mean(mi.render(scene, params, integrator=plugin("reslrb_basic"), spp=1), axis=None))
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_a_texture_of_a_smooth_bsdf_is_refused_beside_a_diffuse_one():
    """The dictionary of parameters names one of its parents only."""
    shared = {"type": "ref", "id": "shared"}
    scene = mi.load_dict(
        {"type": "scene", "shared": texture(2, 2)}
        | room(
            ball=sphere({"type": "diffuse", "reflectance": shared}, [0, 0, 0], 0.3),
            other=sphere({"type": "conductor", "specular_reflectance": shared}, [0, -0.7, 0], 0.3),
        ),
        optimize=False,
    )
    params = mi.traverse(scene)
    [key] = [key for key in params.properties if key.endswith(".data")]
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(UnsupportedScene, match="no derivatives of smooth specular BSDFs"):
        dr.backward(dr.mean(mi.render(scene, params, integrator=plugin("reslrb_basic"), spp=1), axis=None))


def test_forward_mode_is_refused():
    scene = mi.load_dict(room(), optimize=False)
    params = mi.traverse(scene)
    dr.enable_grad(params[WALL])
    params.update()
    image = mi.render(scene, params, integrator=plugin("reslrb_basic"), spp=1)
    with pytest.raises(UnsupportedScene, match="forward mode"):
        dr.forward(params[WALL])
    assert image.shape == (16, 16, 3)
