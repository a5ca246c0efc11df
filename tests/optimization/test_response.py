"""Recovered responses: the gain of images, its derivatives, views that share a curve, and whole recoveries of a room
from pictures with film curves.
"""

from __future__ import annotations

import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from kit import area, diffuse, ref, scene, sensor, shape
from optimization.judged import iterate_to_the_end
from PIL import Image

import reslrb_cli as rl
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.optimization.uncertainty import candidates, fit
from reslrb_cli.optimization.uncertainty.candidates import may_have_response
from reslrb_cli.optimization.uncertainty.curvature import LossCurvature, plan_changes
from reslrb_cli.optimization.uncertainty.measuring import Certainty
from reslrb_cli.optimization.views import set_targets, target_arrays
from reslrb_cli.report.spread import misfit_lines
from reslrb_cli.runs.prepare import with_freed
from reslrb_cli.scene.response import SRGB

pytestmark = pytest.mark.usefixtures("llvm")

ROOM = {"floor": (0.45, 0.30, 0.18), "back": (0.70, 0.66, 0.55), "left": (0.62, 0.12, 0.10),
        "right": (0.15, 0.45, 0.20), "ball": (0.10, 0.18, 0.45), "ceiling": (0.85, 0.85, 0.82)}  # fmt: skip
PLACES = {
    "floor": '<rotate x="1" angle="-90"/><translate y="-1"/>',
    "ceiling": '<rotate x="1" angle="90"/><translate y="1"/>',
    "back": '<translate z="-1"/>', "left": '<rotate y="1" angle="90"/><translate x="-1"/>',
    "right": '<rotate y="1" angle="-90"/><translate x="1"/>',
}  # fmt: skip
EYES = "0, 0, 3.6", "0.6, 0.3, 3.4"
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {file: photo0.png, exposure: auto}
parameters: [PARAMETERS]
integrator: {type: reslrb, max_depth: 8}
loss: {type: relative_l2}
optimizer: {type: auto}
run: {iterations: 100, spp: 32}
"""


def room(colours: dict[str, tuple[float, float, float]], size: int) -> str:
    """Return a closed room with a ball and a lamp at its ceiling."""
    parts = [sensor(eye, size=size, fov=36) for eye in EYES]
    for name, colour in colours.items():
        parts.append(diffuse(", ".join(map(str, colour)), name))
        if name == "ball":
            place = '<scale value="0.4"/><translate x="0.3" y="-0.6"/>'
            parts.append(shape("sphere", "sphere", ref(name), place=place))
        else:
            parts.append(shape("rectangle", f"{name}_wall", ref(name), place=PLACES[name]))
    place = '<scale value="0.35"/><rotate x="1" angle="90"/><translate y="0.98" z="0.1"/>'
    parts.append(shape("rectangle", "panel", diffuse("0, 0, 0"), area("6, 5.5, 5"), place=place))
    return scene(*parts)


def encoded(light: np.ndarray) -> np.ndarray:
    """Return the sRGB values of light."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def filmed(light: np.ndarray) -> np.ndarray:
    """Return the values of a film curve by Narkowicz, which no curve of six numbers equals."""
    return encoded(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14))


def write_room(folder: Path, curve=encoded, size: int = 12, spp: int = 64, suffix: str = "png") -> Path:
    """Write the room in grey, a photograph of its true colours by each sensor, and a configuration."""
    grey = dict.fromkeys(ROOM, (0.5, 0.5, 0.5))
    (folder / "scene.xml").write_text(room(grey, size))
    (folder / "true.xml").write_text(room(ROOM, size))
    true = mi.load_file(str(folder / "true.xml"))
    path = mi.load_dict({"type": "path", "max_depth": 8})
    for number in range(len(EYES)):
        light = np.array(mi.render(true, integrator=path, sensor=number, spp=spp, seed=7))
        pixels = np.round(255 * curve(light)).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"photo{number}.{suffix}", quality=95, subsampling=0)
    keys = ", ".join(f"{{key: {name}.reflectance.value, bounds: [0, 1]}}" for name in ROOM)
    (folder / "room.yaml").write_text(CONFIG.replace("PARAMETERS", keys).replace("png", suffix))
    return folder


@pytest.fixture
def folder(tmp_path):
    return write_room(tmp_path)


def make(folder, *sets):
    return assemble(load(folder / "room.yaml", list(sets)))


def with_numbers(problem, key, numbers):
    """Return the problem at these numbers of a response."""
    problem.optimizer.set_value(key, mi.Float(np.asarray(numbers, np.float32)) + dr.opaque(mi.Float, 0))
    problem.apply()
    return problem


NUMBERS = {"{curve: auto}": [0.8, 0.9, 1.1, 1.3, 1.6, 2.5], "{gamma: auto}": [1.9]}


@pytest.mark.parametrize("response", NUMBERS)
def test_the_gain_is_that_of_a_known_response(folder, response):
    """Image times gain over target is image over the target that the same numbers decode."""
    kind, numbers = response[1:6], NUMBERS[response]
    problem = with_numbers(make(folder, f"target.response={response}"), "response", numbers)
    given = {"curve": numbers, "gamma": numbers[0]}[kind]
    known = make(folder, f"target.response={{{kind}: {given}}}", "target.exposure=1").views[0]
    view = problem.views[0]
    image = mi.TensorXf(np.random.default_rng(0).uniform(0.1, 1, view.target.shape).astype(np.float32))
    ratio = np.array(view.exposed(image)) / np.array(view.target)
    expected = np.array(image) / np.array(known.target)
    seen = np.array(view.target) > 0.004
    assert seen.mean() > 0.5
    np.testing.assert_allclose(ratio[seen], expected[seen], rtol=2e-3)
    np.testing.assert_allclose(view.exposed_array(np.array(image)), np.array(view.exposed(image)), rtol=1e-4)
    # The light of the target is shown as the target.
    light = np.array(view.target) * np.array(image) / np.array(view.exposed(image))
    np.testing.assert_allclose(view.shown_array(light)[seen], np.array(view.target)[seen], rtol=1e-3)
    assert np.all(view.shown_array(1.2 * light)[seen] > 1.05 * np.array(view.target)[seen])
    # Another process has the same gain.
    other = with_numbers(assemble_scene(problem.config), "response", numbers)
    set_targets(other.views, target_arrays(problem.views))
    np.testing.assert_array_equal(np.array(other.views[0].exposed(image)), np.array(view.exposed(image)))


@pytest.mark.parametrize("response", NUMBERS)
@pytest.mark.parametrize("adjoint", ["batched", "correlated"])
def test_derivatives_agree_with_differences(folder, response, adjoint):
    """Those of the response and of the exposure, at common random numbers if the adjoint is correlated."""
    sets = "target.exposure=per_channel", f"run.adjoint={adjoint}", "loss={type: l2}", "run.spp=128"
    problem = make(folder, f"target.response={response}", *sets)
    numbers = np.array(NUMBERS[response])
    with_numbers(problem, "response", numbers)
    sample_gradient(problem, problem.integrator, 0, "test", 128)
    found = take_gradient(problem)["response"]

    [view] = problem.views
    image = mi.TensorXf(problem.render(0, 4096, 0, "test"))

    def loss(offset):
        with_numbers(problem, "response", numbers + offset)
        return float(view.compare(image)[0])

    expected = [(loss(1e-2 * unit) - loss(-1e-2 * unit)) / 2e-2 for unit in np.eye(numbers.size)]
    np.testing.assert_allclose(found, expected, rtol=0.05, atol=0.03 * np.abs(expected).max())


def test_the_entries_of_a_response_are_judged_one_by_one(folder):
    """They take part in the joint steps of `auto`."""
    problem = make(folder, "target.response={curve: auto}")
    assert problem.optimizer.is_small("response")
    assert problem.optimizer.block.at["response"].stop - problem.optimizer.block.at["response"].start == 6


def test_the_numbers_of_a_response_have_spreads_of_their_own(folder):
    """Only textures and heightmaps of as many entries have one spread."""
    problem = make(folder, "target.response={curve: auto}")
    certainty = Certainty(problem)
    certainty.rates = [1.0]
    found = certainty._measured({"response": np.ones((3, 6))}, 40, set())
    assert found["response"].is_small
    assert not found["response"].is_map


def test_contrasts_that_no_pixel_shows_follow_their_neighbours(folder):
    """The cost's gradient agrees with differences, and is 0 if all contrasts are equal. A gamma has no cost."""
    problem = make(folder, "target.response={curve: auto}")
    values = np.array([1, 1.2, 0.8, 2, 3, 1.5])
    costs = [problem.costs({"response": values + 1e-4 * unit})[0]["response"]["smoothness"] for unit in np.eye(6)]
    cost, gradient = problem.costs({"response": values})
    assert cost["response"]["smoothness"] == pytest.approx(0.6e-4 * np.sum(np.diff(np.log(values)) ** 2), rel=0.6)
    np.testing.assert_allclose(
        (np.array(costs) - cost["response"]["smoothness"]) / 1e-4, gradient["response"], rtol=2e-3
    )
    np.testing.assert_allclose(problem.costs({"response": np.full(6, 1.3)})[1]["response"], 0, atol=1e-12)
    assert make(folder, "target.response={gamma: auto}").regularizers == {}


def test_views_share_a_response_or_have_their_own(folder):
    views = "views=[{target: photo0.png}, {sensor: 1, target: photo1.png}]"
    sets = [views, "target={exposure: auto, response: {curve: auto}}"]
    shared = make(folder, *sets)
    assert [view.response.key for view in shared.views] == ["response", "response"]
    assert shared.selection.keys[-2:] == ["response", "exposure"]
    own = views.replace("photo1.png", "photo1.png, response: {gamma: auto}")
    problem = make(folder, own, sets[1])
    assert [view.response.key for view in problem.views] == ["response", "response.1"]
    assert [problem.selection.array(key).shape for key in ("response", "response.1")] == [(6,), ()]
    fixed = make(folder, views.replace("photo1.png", "photo1.png, response: linear"), sets[1])
    assert fixed.views[1].response is None
    assert float(np.array(fixed.views[1].target).max()) == pytest.approx(
        float(np.array(Image.open(folder / "photo1.png")).max()) / 255
    )
    # The gradient of a shared response is the sum of those of the views.
    images = [mi.TensorXf(np.random.default_rng(n).uniform(0.1, 1, (12, 12, 3)).astype(np.float32)) for n in range(3)]
    parts = []
    for views in (shared.views, shared.views[:1], shared.views[1:]):
        for view in views:
            shared.on_samples(view)(images[view.sensor], images[2])
        parts.append(np.array(shared.optimizer.gradient("response")))
        shared.optimizer.clear_gradient("response")
    np.testing.assert_allclose(parts[0], parts[1] + parts[2], rtol=1e-4)
    assert np.abs(parts[1] - parts[2]).max() > 0


@pytest.mark.parametrize(("curve", "is_named"), [(filmed, True), (encoded, False)])
def test_a_run_names_the_response_that_explains_the_misfit(tmp_path, curve, is_named, monkeypatch):
    """The room has its true colours, except for a grey floor that is recovered."""
    write_room(tmp_path, lambda light: curve(2 * light), spp=1024)
    key = "floor.reflectance.value"
    problem = make(tmp_path, "scene.file=true.xml", f"parameters=[{{key: {key}, bounds: [0, 1]}}]", "run.spp=64")
    monkeypatch.setattr(candidates, "MOST_TESTED", 2)
    curvature = LossCurvature(problem, 256, of_target=False)
    curvature.along(plan_changes(problem, {key: 0.5, "exposure": 1.0}, 0.1), lambda: True)
    problem.optimizer.set_value("exposure", mi.Float(2.0) + dr.opaque(mi.Float, 0))
    problem.apply()
    found = candidates.judge_fit(problem, fit.measure_fit(problem, curvature, lambda: True), curvature, lambda: True)
    assert found.is_significant == is_named
    assert [each.key for each in found.candidates[:1]] == ["response"] * is_named
    if is_named:
        first = found.candidates[0]
        assert first.explained > 0.5
        assert first.p < 1e-3
        assert not first.proposed or first.proposed[4] > 1.5 > first.proposed[2]  # as the film curve has it
        assert misfit_lines({"certainty": {"fit": found.to_json()}})[2].startswith(
            "  target.response: {curve: auto}  # "
        )


@pytest.mark.parametrize(("sets", "may"), [
    ([], True), (["target.response=srgb"], True), (["target.response=linear"], False), (["target.exposure=2"], False),
    (["target.response={gamma: 2}"], False), (["target.response={curve: auto}"], False),
    (["target.white_balance={scene: A}"], False),
])  # fmt: skip
def test_a_response_is_tested_if_it_could_be_recovered(folder, sets, may):
    assert may_have_response(make(folder, *sets)) == may


def test_callers_that_need_the_scene_alone_use_the_first_response(folder):
    views = "views=[{target: photo0.png, exposure: auto, response: {gamma: auto}}]"
    config = load(
        folder / "room.yaml", ["target={response: {curve: auto}, exposure: auto}", views]
    ).with_exposures_fixed()
    assert (config.target.response, config.target.exposure) == (SRGB, 1)
    assert (config.views[0].response.gamma, config.views[0].exposure) == (2.2, 1)


def test_free_recovers_the_response(folder):
    config = load(folder / "room.yaml")
    freed = with_freed(config, ["response", "panel.bsdf.reflectance.value"], "--free")
    assert freed.target.response.recovered == "curve"
    assert freed.parameters[-1].keys == ["panel.bsdf.reflectance.value"]
    fixed = load(folder / "room.yaml", ["target.exposure=1"])
    with pytest.raises(ConfigError, match=r"response.curve: is recovered only up to a factor"):
        with_freed(fixed, ["response"], "--free")


def test_a_resumed_run_keeps_its_response(folder):
    """In Python. The picture has a gamma of 1.8, and all colours are known. A copy stops half-way."""
    write_room(folder, lambda light: np.clip(light, 0, 1) ** (1 / 1.8))
    settings = {
        "scene.file": str(folder / "true.xml"), "target.response": {"gamma": "auto"}, "run.spp": 64,
        "run.iterations": 12, "run.final_spp": 16, "parameters": [{"key": "floor.reflectance.value", "bounds": [0, 1]}],
    }  # fmt: skip
    with rl.optimize(str(folder / "room.yaml"), folder=str(folder / "run"), overrides=settings) as run:
        for record in run:
            if record.iteration == 5:
                break
    half = float(run.parameters["response"])
    assert half != pytest.approx(2.2)
    with rl.optimize(resume=str(folder / "run")) as run:
        assert float(run.parameters["response"]) == pytest.approx(half)
        for _ in run:
            pass
        image, target = run.images[0], run.targets[0]
    assert float(run.parameters["response"]) == pytest.approx(1.8, abs=0.1)
    # The image is shown through the response.
    assert np.median(np.abs(image[:, :, :3] / target - 1)) < 0.1
    manifest = json.loads((folder / "run/manifest.json").read_text())
    assert [view["response"] for view in manifest["views"]] == ["response"]


def recover(folder: Path, *sets: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Run a recovery. Returns the values and their spreads, by parameter. Those of colours are errors."""
    problem = make(folder, *sets)
    certainty, last = iterate_to_the_end(problem)
    found = certainty.measure(last.iteration + 1, last.elapsed_s, lambda: False)
    spreads = {key: np.ravel(each.spread) for key, each in found.parameters.items()}
    values = problem.values()
    for name, true in ROOM.items():
        values[f"{name}.reflectance.value"] -= true
    return {key.removesuffix(".reflectance.value"): (value, spreads[key]) for key, value in values.items()}


@pytest.mark.long
def test_a_room_is_recovered_from_a_picture_with_a_film_curve(tmp_path):
    """The film curve is not one of those that six numbers give. Without a response, colours are far off."""
    write_room(tmp_path, lambda light: filmed(2 * light), size=24, spp=4096)
    sets = "run.spp=256", "run.iterations=60"
    found = recover(tmp_path, "target.response={curve: auto}", *sets)
    assert max(np.abs(found[name][0]).max() for name in ROOM) < 0.05
    assert found["response"][0][5] > 3
    plain = recover(tmp_path, "run.spp=32", "run.iterations=30")
    assert np.mean([np.abs(plain[name][0]).max() > 0.1 for name in ROOM]) > 0.8


@pytest.mark.long
def test_a_room_with_the_usual_curve_needs_no_response_but_may_have_one(tmp_path):
    """Contrasts that pixels show end at 1, within their spread."""
    write_room(tmp_path, lambda light: encoded(1.5 * light), size=24, spp=4096)
    found = recover(tmp_path, "target.response={curve: auto}", "run.spp=256", "run.iterations=60")
    assert max(np.abs(found[name][0]).max() for name in ROOM) < 0.06
    value, spread = found["response"]
    assert len(spread) == 6
    assert np.all(np.abs(value[1:4] - 1) < np.maximum(3 * spread[1:4].astype(float), 0.05))


@pytest.mark.long
def test_two_views_share_a_curve(tmp_path):
    """Their exposures differ by a known factor, which is found as well."""
    exposures = iter((1.2, 2.4))
    write_room(tmp_path, lambda light: filmed(next(exposures) * light), size=24, spp=4096)
    views = "views=[{target: photo0.png, exposure: auto}, {sensor: 1, target: photo1.png, exposure: auto}]"
    found = recover(tmp_path, views, "target={response: {curve: auto}}", "run.spp=128", "run.iterations=60")
    assert max(np.abs(found[name][0]).max() for name in ROOM) < 0.05
    assert found["exposure.1"][0] / found["exposure.0"][0] == pytest.approx(2, rel=0.03)
