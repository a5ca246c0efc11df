"""`reslrb` as a Mitsuba plugin and in our own step, as in a script. Every option has an effect."""

from __future__ import annotations

import gc
import re
import subprocess
import sys
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare, renders
from conformance.gradient_cases import TEXELS, _textured
from conformance.scenes import plugin
from turns import a_few

from reslrb_cli import register, step
from reslrb_cli.config.integrators import AUTO_VALUES
from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.step import Adjoint, gradient_step, render_image
from reslrb_cli.measure.gradients import Case, integrator, relative, seeds
from reslrb_cli.measure.scenes.small import camera, diffuse, lamp, rgb, room, transform, veiled

pytestmark = pytest.mark.usefixtures("llvm")
ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
import reslrb_cli
import mitsuba as mi
if {before}:
    reslrb_cli.register()
mi.set_variant("llvm_ad_rgb")
if not {before}:
    reslrb_cli.register()
import drjit as dr
scene = mi.load_dict(mi.cornell_box() | {{"integrator": {{"type": "reslrb", "max_depth": 3}}}}, optimize=False)
params = mi.traverse(scene)
key = "white.reflectance.value"
dr.enable_grad(params[key])
params.update()
dr.backward(dr.mean(mi.render(scene, params, spp=1), axis=None))
print("gradient", dr.grad(params[key]).numpy().min() > 0)
for variant in ("llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)
    print(mi.load_dict({{"type": "reslrb", "max_depth": 3}}).max_depth)
"""


@pytest.mark.parametrize("before", a_few([True, False], ["False"]))
def test_register_before_and_after_the_variant(before: bool):
    run = subprocess.run([sys.executable, "-c", SCRIPT.format(before=before)], capture_output=True, text=True,
                         cwd=ROOT, timeout=120)  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == ["gradient", "True", "3", "3"]


REGISTERED = """
import reslrb_cli
try:
    reslrb_cli.step(None, None, 0, None, seed=0, spp=1)
except reslrb_cli.errors.BackendError as error:
    print(error)
import mitsuba as mi
for variant in ("scalar_rgb", "llvm_ad_spectral_polarized", "llvm_ad_mono_polarized"):
    mi.set_variant(variant)
    for call in (reslrb_cli.register, lambda: reslrb_cli.load_scene("none.xml"),
                 lambda: mi.load_dict({"type": "reslrb"})):
        try:
            call()
        except Exception as error:
            assert f"variant {variant} is set" in str(error), error
            assert "one of llvm_ad_rgb, cuda_ad_rgb, " in str(error), error
            print(type(error).__name__)
mi.set_variant("llvm_ad_mono")
print(mi.load_dict({"type": "reslrb", "max_depth": 3}).max_depth)
"""


def test_unsupported_variants_are_refused_with_the_supported_ones():
    """A missing variant is refused too. A variant that is set later is also refused, even if no plugin was ever
    registered under it.
    """
    run = subprocess.run([sys.executable, "-c", REGISTERED], capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    none, *others = run.stdout.splitlines()
    assert none.startswith("no variant is set; call mitsuba.set_variant(...) with one of llvm_ad_rgb")
    assert others == ["BackendError", "BackendError", "RuntimeError"] * 3 + ["3"]


@pytest.mark.long
def test_the_script_of_the_docs_runs():
    """The Python blocks of docs/integrator.md run one after the other, and reduce the loss."""
    text = (ROOT / "docs" / "integrator.md").read_text(encoding="utf-8")
    script = "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL))
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    lines = run.stdout.splitlines()
    losses = [float(line.split()[1].strip("[]")) for line in lines[:10]]
    assert losses[-1] < losses[0]
    assert lines[10].startswith("(64, 64, 3)"), lines[10]


@pytest.fixture(autouse=True)
def _registered(llvm: str) -> None:
    register()


@pytest.fixture(scope="module")
def case(llvm: str) -> Case:
    """Case with the textured room."""
    return Case(_textured(), (TEXELS,))


@pytest.fixture(scope="module")
def shown(llvm: str) -> Case:
    """Case with the textured room and an emitter in view."""
    sign = lamp(radiance=rgb(0.5, 0.6, 0.7)) | {"to_world": _facing()}
    return Case(_textured(sign=sign), (TEXELS,))


def _facing() -> Any:
    return transform(translate=[0.2, -0.1, 1.2], rotate=([0, 1, 0], 15), scale=0.4)


def test_defaults_match_ptracer():
    ours, stock = plugin("reslrb", -1, 5), str(plugin("ptracer", -1, 5))
    default = mi.load_dict({"type": "reslrb"})
    assert (default.max_depth, default.rr_depth, default.hide_emitters) == (ours.max_depth, ours.rr_depth, False)
    assert default.samples_per_pass is None
    assert f"max_depth = {default.max_depth}" in stock.replace("4294967295", "-1")
    assert f"rr_depth = {default.rr_depth}" in str(mi.load_dict({"type": "ptracer"}))


def test_the_default_renders_and_differentiates_what_glass_shows():
    """Without options, the plugin shows a glass ball as `path` does, and its gradient agrees with differences."""
    ball = {"type": "sphere", "center": [0.1, 0.0, 0.1], "radius": 0.35, "bsdf": {"type": "dielectric"}}
    case = Case(_textured(ball=ball), ("wall.brdf_0.reflectance.value",))
    ours, stock = (mi.load_dict({"type": name, "max_depth": 4, "rr_depth": 100}) for name in ("reslrb", "path"))
    images = [
        renders(
            lambda seed, each=each: mi.render(case.scene, integrator=each, seed=seed, spp=64), range(first, first + 8)
        )
        for first, each in ((0, ours), (50, stock))
    ]
    assert compare(*images)
    along, tracer = np.ones(3), ours.tracer
    differences = [case.difference(tracer, along, seed, 64, 0.1, "both") for seed in seeds(8, 1)]
    assert compare(case.gradients(tracer, seeds(8), 64) @ along[:, None], np.array(differences)[:, None], block=None)


AUTO = {"paths": "both", "guiding": "off", "sequence": "low_discrepancy", "pixels": "even"}


@pytest.mark.parametrize("given", [{}, {"estimator": "auto"}, dict.fromkeys(AUTO_VALUES, "auto")], ids=len)
def test_the_default_is_a_run_that_measures_nothing(case: Case, given: dict[str, str]):
    """`auto` is accepted for each setting that a run decides, and is the default if no estimator is named."""
    tracer = mi.load_dict({"type": "reslrb", **given}).tracer
    assert type(tracer.estimator).__name__ == "Stack"
    chosen = tracer.preparation.sampling.chosen
    assert {"paths": tracer.plan(case.scene, case.scene.sensors()[0]).paths, **chosen, "edges": "on"} == AUTO | {
        "edges": "on"
    }
    moving = Case(_textured(camera=camera("gaussian")), ())
    for key, paths in (("wall_shape.to_world", "camera"), ("lamp.to_world", "light")):
        dr.enable_grad(moving.params[key])
        moving.params.update()
        plan = tracer.plan(moving.scene, moving.scene.sensors()[0], moving.params)
        assert plan.paths == paths
        assert plan.has_edges
        dr.disable_grad(moving.params[key])
        moving.params.update()


def test_a_named_estimator_has_plain_settings():
    sampling = mi.load_dict({"type": "reslrb", "estimator": "stack"}).tracer.preparation.sampling
    assert (sampling.paths, sampling.on) == ("light", frozenset())


def test_auto_leaves_out_edges_that_do_not_exist_and_says_so():
    moving = Case(_textured(camera=camera("gaussian")), ())
    sensor = moving.scene.sensors()[0]
    dr.enable_grad(moving.params["floor_shape.to_world"])
    moving.params.update()
    follows = mi.load_dict({"type": "reslrb", "attached_sampling": "follow"}).tracer
    with pytest.warns(UserWarning, match="attached_sampling: follow has no derivatives of edges"):
        assert not follows.plan(moving.scene, sensor, moving.params).has_edges
    usual = mi.load_dict({"type": "reslrb"}).tracer
    with pytest.warns(UserWarning, match="forward mode has no derivatives of edges"):
        plan = usual.preparation.plan(moving.scene, sensor, moving.params, forward=True)
    assert (plan.paths, plan.has_edges) == ("light", False)
    assert usual.plan(moving.scene, sensor, moving.params).has_edges


SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
COUNTS = [f"{paths}-{spp}" for paths in ("light", "both") for spp in (1, 2, 3, 7, 12, 16)]


def test_auto_says_that_derivatives_of_moving_lamps_lack_mirrors():
    for floor, lacks in ((diffuse(0.5, 0.5, 0.5), False), ({"type": "conductor"}, True)):
        moving = Case(room(floor=floor, camera=camera("gaussian")), ())
        dr.enable_grad(moving.params["lamp.to_world"])
        moving.params.update()
        tracer, sensor = mi.load_dict({"type": "reslrb"}).tracer, moving.scene.sensors()[0]
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            for _ in range(2):
                assert tracer.plan(moving.scene, sensor, moving.params).paths == "light"
        assert len([each for each in found if "only light paths have derivatives" in str(each.message)]) == lacks


@pytest.mark.parametrize("count", a_few(COUNTS, ["light-7"]))
def test_every_sampler_makes_any_number_of_samples(count: str):
    """Samplers round the number of samples up, for example to a square number. `ptracer` then traces more paths."""
    paths, spp = count.split("-")
    tracer, means = integrator("reslrb", 2, estimator="stack", paths=paths), []
    for name in SAMPLERS:
        view = camera(size=4) | {"sampler": {"type": name}}
        scene = mi.load_dict({"type": "scene", **_textured(camera=view)})
        means.append(renders(lambda seed: render_image(tracer, scene, 0, seed, int(spp)), range(8)).mean())  # noqa: B023
    assert means == pytest.approx([means[0]] * len(means), rel=0.6 / int(spp) ** 0.5)


def test_sensors_beside_the_scene_have_facts_of_their_own(case: Case):
    """Two sensors that are no part of the scene have films of different sizes. Each has its own distribution of camera
    paths, so the second one has the gradient that it has alone.
    """
    small, large = (mi.load_dict(camera(size=size)) for size in (6, 16))
    found = []
    for sensors in ([large], [small, large]):
        tracer = integrator("reslrb", estimator="stack", paths="camera", pixels="measured")
        for sensor in sensors:
            dr.enable_grad(case.params[TEXELS])
            case.params.update()
            step(tracer, case.scene, sensor, lambda image: dr.sum(image, axis=None), seed=1, spp=16, params=case.params)
            gradient = np.array(dr.grad(case.params[TEXELS]))
            case.set(case.initial)
        found.append(gradient)
    assert np.abs(found[0]).max() > 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4)


@pytest.mark.parametrize(
    "options",
    [
        {"max_depth": -2},
        {"rr_depth": 0},
        {"samples_per_pass": 0},
        {"estimator": "rezervoir"},
        {"max_dpth": 3},
        {"max_depth": "deep"},
        {"capacity": 0},
        {"capacity": 1025},  # every capacity has its own kernel code
    ],
    ids=str,
)
def test_wrong_options_raise(options: dict[str, Any]):
    with pytest.raises((ValueError, RuntimeError, TypeError)):
        mi.load_dict({"type": "reslrb", **options})


@pytest.mark.parametrize("name", ["estimator", "weight"])
def test_walk_ad_has_no_estimators(name: str):
    with pytest.raises(RuntimeError):
        mi.load_dict({"type": "walk_ad", name: "all"})


def test_unknown_options_of_an_integrator_are_refused():
    for type in ("reslrb", "ptracer", "prb"):
        with pytest.raises(ValueError, match=f"{type} has no option colour"):
            make_integrator(type, colour=3)
        assert make_integrator(type, max_depth=3, rr_depth=None) is not None


def test_samples_that_passes_do_not_divide_raise(case: Case):
    with pytest.raises(ValueError, match="multiple"):
        render_image(integrator("reslrb", samples_per_pass=3), case.scene, 0, 1, 16)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": -1}, '"spp" must be an integer from 0 to'),
        ({"spp": 1.5}, '"spp" must be an integer from 0 to .*, not 1.5'),
        ({"spp": 10**13}, '"spp" must be an integer'),
        ({"seed": -1}, '"seed" must be an integer from 0 to 4294967295, not -1'),
        ({"seed": 2**32}, '"seed" must be an integer'),
        ({"sensor": 1}, '"sensor" is 1, but the scene has one sensor, index 0'),
        ({"sensor": -1}, '"sensor" is -1'),
        ({"adjoint": "batches"}, '"adjoint" must be one of correlated, independent, batched, not "batches"'),
        ({"adjoint": "batched", "batches": 1}, '"batches" must be an integer from 2 to'),
        ({"adjoint": "batched", "batches": 3}, r"the samples per pixel \(4\) must be a multiple of the batches \(3\)"),
    ],
    ids=str,
)
def test_a_step_with_arguments_out_of_range_raises(case: Case, options: dict[str, Any], message: str):
    given = {"sensor": 0, "seed": 1, "spp": 4} | options
    with pytest.raises(ValueError, match=message):
        step(plugin("reslrb"), case.scene, given.pop("sensor"), case.objective, params=case.params, **given)


@pytest.mark.parametrize("adjoint", get_args(Adjoint))
@pytest.mark.parametrize("name", ["reslrb", "prb"])
def test_zero_samples_are_those_of_the_sensor(case: Case, adjoint: str, name: str):
    count = case.scene.sensors()[0].sampler().sample_count()
    options = {"adjoint": adjoint, "batches": min(count, 4)}
    found, expected = (case.gradients(plugin(name), [1], spp, **options) for spp in (0, count))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    assert expected.any()


def test_a_step_accepts_numpy_numbers(case: Case):
    given = {"seed": np.uint32(1), "spp": np.int64(4)}
    result = step(plugin("reslrb"), case.scene, np.int64(0), case.objective, params=case.params, **given)
    assert np.isfinite(np.array(result.image)).all()


def test_mi_render_with_samples_out_of_range_raises(case: Case):
    with pytest.raises(ValueError, match=r'^"spp" must be 0 \(the sensor\'s own sample count\) or more, not -1'):
        mi.render(case.scene, integrator=plugin("reslrb"), spp=-1)
    with pytest.raises(ValueError, match="are more than 65536 passes"):
        render_image(integrator("reslrb", samples_per_pass=1), case.scene, 0, 1, 10**6)


def test_mi_render_backward_through_a_latent_variable(case: Case):
    """The parameters are a function of a latent variable. Gradients reach this variable, and agree with the gradients
    of our own step.
    """
    ours, key, steps = plugin("reslrb"), TEXELS, []
    for seed in seeds(12):
        latent = mi.Float(0.8)
        dr.enable_grad(latent)
        value = mi.TensorXf(case.initial[key].reshape(case.params[key].shape)) * latent
        case.params[key] = case.values.colours._spectra(key, value)[key] if mi.is_spectral else value
        case.params.update()
        image = mi.render(case.scene, case.params, integrator=ours, seed=seed, spp=64)
        dr.backward(case.objective(image))
        steps.append(float(dr.grad(latent)[0]))
    case.set(case.initial)
    case.set({key: 0.8 * case.initial[key]})
    direct = case.gradients(ours, seeds(12, 1), 64) @ case.initial[key]
    case.set(case.initial)
    assert np.mean(steps) > 0
    assert compare(np.array(steps)[:, None], direct[:, None], block=None)


def test_mi_render_adds_to_existing_gradients(case: Case):
    ours, leaf = plugin("reslrb"), mi.TensorXf(case.params[TEXELS])
    dr.enable_grad(leaf)
    sums = []
    for seed in (1, 2):
        case.params[TEXELS] = mi.TensorXf(leaf)
        case.params.update()
        dr.backward(case.objective(mi.render(case.scene, case.params, integrator=ours, seed=seed, spp=16)))
        sums.append(np.array(dr.grad(leaf)))
    case.set(case.initial)
    assert (sums[1] > sums[0]).mean() > 0.9


@pytest.mark.long
def test_one_latent_for_several_sensors(llvm: str):
    """Propagation for one view must not remove the edges above the parameters. The next view needs these edges."""
    scene = Case(_textured(other=camera()), (TEXELS,))
    for name in ("reslrb", "walk_ad", "ptracer", "prb"):
        tracer, sums = integrator(name), []
        latent = mi.Float(1)
        dr.enable_grad(latent)
        scene.params[TEXELS] = mi.TensorXf(scene.initial[TEXELS].reshape(scene.params[TEXELS].shape)) * latent
        scene.params.update()
        for sensor in (0, 1):
            gradient_step(tracer, scene.scene, sensor, scene.objective, seed=5, spp=16, params=scene.params)
            sums.append(np.array(dr.grad(scene.params[TEXELS])).sum())
        dr.enqueue(dr.ADMode.Backward, scene.params[TEXELS])
        dr.traverse(dr.ADMode.Backward)
        assert sums[1] == pytest.approx(2 * sums[0], rel=1e-4), name
        assert float(dr.grad(latent)[0]) > 0, name
        scene.set(scene.initial)


@pytest.mark.parametrize(
    ("key", "reason"),
    [("floor_shape.to_world", "use auto"), ("lamp.to_world", "use auto"), ("camera.to_world", "not of the sensor")],
)
def test_naive_ad_refuses_moving_scenes_with_a_reason(key: str, reason: str):
    case = Case(_textured(), (TEXELS,))  # its sensor has a box filter
    dr.enable_grad(case.params[key])
    case.params.update()
    with pytest.raises(UnsupportedScene, match=reason):
        gradient_step(integrator("walk_ad"), case.scene, 0, case.objective, seed=1, spp=4)


MEDIUM = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "albedo": 0.5}}
FOGGED = {"inside": {"type": "homogeneous"}}
VEIL = {"type": "rectangle", "bsdf": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}}
HAIR = {"type": "sphere", "radius": 0.2, "bsdf": {"type": "hair"}}
MIRRORS = {key: {"type": "conductor"} for key in ("floor", "wall", "side")}
CHECKERED = {"type": "spot", "texture": {"type": "checkerboard"}}
MOVES = {"estimator": "stack"}
FOLLOWS = MOVES | {"edges": "on", "attached_sampling": "follow"}
ORTHOGRAPHIC = {"type": "orthographic", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
REFUSED: list[tuple[dict[str, Any], dict[str, Any], str, str]] = [
    ({"fog": MEDIUM}, {}, "", "shape fog bounds a participating medium; no integrator here supports media"),
    ({"fog": MEDIUM}, {}, TEXELS, "shape fog bounds a participating medium"),
    (
        {"camera": ORTHOGRAPHIC | {"type": "perspective"} | FOGGED},
        {},
        TEXELS,
        "sensor camera is inside a participating medium; no integrator here",
    ),
    ({"bulb": {"type": "point"} | FOGGED}, {}, "", "emitter bulb is inside a participating medium; no integrator here"),
    ({"sky": {"type": "timed_sunsky"}}, {}, "", "emitter sky is a `timed_sunsky`"),
    ({"camera": ORTHOGRAPHIC}, {}, "", "sensor camera is a OrthographicCamera; light paths connect to"),
    ({}, {}, "camera.to_world", "camera.to_world: light tracing has derivatives of surfaces and emitters, not of the"),
    ({}, {"estimator": "event"}, "floor_shape.to_world", "estimator event has no derivatives of moving light"),
    ({}, {"estimator": "event"}, "lamp.to_world", "estimator event has no derivatives of moving light: it would need"),
    ({}, {"estimator": "stack"}, "floor_shape.to_world", "sensor camera has a box filter"),
    ({}, {"estimator": "stack"}, "lamp.to_world", "sensor camera has a box filter"),
    ({}, {"attached": False}, "floor_shape.to_world", "attached: false leaves out the derivatives of parameters that"),
    ({"veil": VEIL}, MOVES, "floor_shape.to_world", "attached derivatives do not support masks and other surfaces"),
    ({}, FOLLOWS, "floor_shape.to_world", "attached_sampling: follow has no derivatives of edges between two surfaces"),
    ({"spot": CHECKERED}, {}, "", "Mitsuba cannot sample the rays of emitter spot: "),
    ({"spot": CHECKERED}, {}, TEXELS, "Mitsuba cannot sample the rays of emitter spot: "),
    ({"ball": HAIR}, {}, "", "bsdf bsdf is `hair`, which changes if light and view are exchanged: light paths would"),
    (MIRRORS, {}, "", "sensor camera sees only smooth specular surfaces (glass, mirrors), to which light paths"),
]
#: Refused in forward mode only.
BACKWARD_ONLY: list[tuple[dict[str, Any], dict[str, Any], str, str]] = [
    ({}, MOVES | {"edges": "on"}, "floor_shape.to_world", "forward mode has no derivatives of edges; use reverse mode"),
    ({}, MOVES, "lamp.to_world", "forward mode has no derivatives of moving emitters; use reverse mode"),
]


MODES = [
    *((*row, dr.ADMode.Backward) for row in REFUSED),
    *((*row, dr.ADMode.Forward) for row in REFUSED if row[2]),
    *((*row, dr.ADMode.Forward) for row in BACKWARD_ONLY),
]


@pytest.mark.parametrize(
    ("more", "options", "key", "reason", "mode"), MODES, ids=[f"{row[3][:50]}-{row[4].name}" for row in MODES]
)
def test_the_reason_of_a_refusal_is_the_message_under_mi_render(
    more: dict[str, Any], options: dict[str, str], key: str, reason: str, mode: dr.ADMode
):
    gc.collect()  # an emitter of an earlier scene would take part in indirect calls
    smooth = {"camera": camera("gaussian")} if options.get("estimator") == "stack" and "box" not in reason else {}
    scene = mi.load_dict({"type": "scene", **_textured(), **smooth, **more}, optimize=False)
    params, tracer = mi.traverse(scene), plugin("reslrb", **options)
    if key:
        dr.enable_grad(params[key])
        params.update()

    def differentiate() -> None:
        image = mi.render(scene, params if key else None, integrator=tracer, spp=1)
        assert key, "an image is refused at once"
        if mode == dr.ADMode.Backward:
            dr.backward(dr.mean(image, axis=None))
        else:
            dr.set_grad(params[key], params[key])
            dr.forward_to(image)

    with pytest.raises(UnsupportedScene) as error:
        differentiate()
    assert str(error.value).startswith(reason)
    assert error.value.__cause__ is None


def test_other_integrators_keep_their_errors(case: Case):
    class Failing(mi.CppADIntegrator):
        def render(self, *args: Any, **options: Any) -> mi.TensorXf:
            raise ValueError("of its own")

    with pytest.raises(RuntimeError) as error:
        mi.render(case.scene, integrator=Failing(mi.Properties("failing")), spp=1)
    assert str(error.value.__cause__) == "of its own"


def test_step_returns_image_and_loss(case: Case):
    for adjoint in ("correlated", "independent"):
        result = step(integrator("reslrb"), case.scene, 0, case.objective, seed=9, spp=16, adjoint=adjoint)
        image = np.array(result.image)
        assert image.shape == (16, 16, 3)
        assert np.array(result.loss) == pytest.approx(np.sum(image * np.array(case.weights)), rel=1e-5)
        assert not dr.grad_enabled(result.image)
        assert np.allclose(image, np.array(render_image(integrator("reslrb"), case.scene, 0, 9, 16)), rtol=1e-4)


@pytest.mark.long
def test_max_depth(case: Case):
    """Depths 0 and 1 give no light, because no emitter is in view, and no derivatives. Larger depths give more
    light.
    """
    totals = [case.weighted(case.image(integrator("reslrb", depth), 1, 64)) for depth in (0, 1, 2, 3, 6)]
    assert totals[:2] == [0, 0]
    assert all(low < high for low, high in pairwise(totals[1:]))
    for depth in (0, 1):
        assert not case.gradient(integrator("reslrb", depth), 1, 16).any()


def test_hide_emitters(shown: Case):
    images = [np.array(render_image(integrator("reslrb", hide_emitters=hide), shown.scene, 0, 1, 64))
              for hide in (False, True)]  # fmt: skip
    lit = np.abs(images[0] - images[1]).sum(-1) > 0.1
    assert 0.02 < lit.mean() < 0.5


@pytest.mark.long
def test_rr_depth_ends_paths(case: Case):
    early, late = (case.gradients(integrator("reslrb", 8, rr), seeds(8), 16) for rr in (1, 1000))
    assert relative(early, late) > 0.01


def test_samples_per_pass(case: Case):
    whole, parts = integrator("reslrb"), integrator("reslrb", samples_per_pass=16)
    one, several = (np.array(render_image(tracer, case.scene, 0, 1, 64)) for tracer in (whole, parts))
    assert relative(one, several) > 1e-3  # the samples differ
    assert one.mean() == pytest.approx(several.mean(), rel=0.05)  # in the same number
    only = np.array(render_image(integrator("reslrb", samples_per_pass=64), case.scene, 0, 1, 64))
    assert relative(one, only) < 1e-5


def test_a_plan_is_not_reused_for_another_scene(llvm: str):
    """Scenes are created and deleted, and their addresses are used again. A scene's needs must not be read from another
    scene.
    """
    import gc

    tracer, plain = integrator("reslrb"), room()
    for _ in range(6):
        scene = Case(plain, ("wall.brdf_0.reflectance.value",))
        assert not tracer.plan(scene.scene, scene.scene.sensors()[0]).needs.has_null
        del scene
        gc.collect()
        masked = Case(veiled(0.5), ("wall.brdf_0.reflectance.value",))
        assert tracer.plan(masked.scene, masked.scene.sensors()[0]).needs.has_null
        del masked
        gc.collect()
