"""Tints of textures: their effect on a scene, their gradients, their settings, and proposals of tints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import yaml
from cli import tiny
from kit import area, diffuse, scene, sensor, shape

import reslrb_cli as rl
from reslrb_cli.config.loader import load
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.runs.prepare import with_freed
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.proposal import propose

KEY, NAME = "floor.reflectance.data", "floor.reflectance.tint"


def select(made: mi.Scene, *specs: dict[str, Any]) -> Any:
    return select_parameters(made, [ParameterSpec(**spec) for spec in specs], "c.yaml")


def texels(made: mi.Scene) -> np.ndarray:
    return np.array(mi.traverse(made)[KEY])


def test_a_tint_multiplies_the_texels(make_scene):
    made = make_scene()
    pattern = texels(made)
    selection = select(made, {"tint": KEY})
    assert (selection.keys, selection.scene_keys) == ([NAME], [KEY])
    assert selection.array(NAME).tolist() == [1, 1, 1]
    assert np.array_equal(texels(made), pattern)
    for tint in ([0.5, 1, 2], [1, 0, 3]):  # of the same pattern
        selection.set_arrays({NAME: np.array(tint)})
        np.testing.assert_allclose(texels(made), pattern * tint, rtol=1e-6)
    assert select(made, {"tint": KEY, "initial": 0.25, "bounds": [0, 2]}).array(NAME).tolist() == [0.25] * 3


def test_a_texture_of_one_channel_has_a_tint_of_one_number(make_scene):
    weight = np.linspace(0.2, 0.8, 12, dtype=np.float32).reshape(3, 4, 1)
    made = make_scene(floor={
        "type": "roughconductor", "alpha": {"type": "bitmap", "raw": True, "data": mi.TensorXf(weight)},
    })  # fmt: skip
    selection = select(made, {"tint": "floor.alpha.data", "initial": 0.5})
    assert selection.array("floor.alpha.tint").shape in ((), (1,))
    np.testing.assert_allclose(np.array(mi.traverse(made)["floor.alpha.data"]), 0.5 * weight, rtol=1e-6)


@pytest.mark.parametrize("variant", ["llvm", "spectral"])
def test_the_gradient_is_the_sum_over_the_texels(make_scene, variant: str, request: pytest.FixtureRequest):
    """With equal seeds, with colours and with their spectra. `variant` is a fixture."""
    request.getfixturevalue(variant)
    by_key, pattern = {}, np.linspace(0.1, 0.9, 4 * 6 * 3).reshape(4, 6, 3)
    for spec in ({"key": KEY}, {"tint": KEY}):
        bitmap = {"type": "bitmap", "raw": not mi.is_spectral, "bitmap": mi.Bitmap(pattern.astype(np.float32))}
        made = make_scene(floor={"type": "diffuse", "reflectance": bitmap})
        selection = select(made, spec)
        case = Case(made, selection.keys, values=selection)
        by_key[selection.keys[0]] = case.gradient(integrator("reslrb", 3), 1, 64)
    expected = (by_key[KEY].reshape(4, 6, 3) * pattern).sum((0, 1))
    assert (expected != 0).all()
    np.testing.assert_allclose(by_key[NAME], expected, rtol=0.02 if mi.is_spectral else 1e-4)


def test_tangents_reach_the_texels(make_scene):
    made = make_scene()
    pattern, selection = texels(made), select(made, {"tint": KEY})
    tint = mi.Color3f(1, 1, 1)
    dr.enable_grad(tint)
    selection.hand_over({NAME: tint})
    dr.set_grad(tint, mi.Color3f(1, 2, 0))
    dr.enqueue(dr.ADMode.Forward, tint)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    selection.push()
    np.testing.assert_allclose(np.array(dr.grad(selection.params[KEY])), pattern * [1, 2, 0], rtol=1e-6)


@pytest.mark.parametrize(("specs", "reason"), [
    ([{"tint": "lamp.intensity.value"}], "parameters[0].tint: `lamp.intensity.value` is no bitmap texture"),
    ([{"tint": "floor.reflectence.data"}], "parameters[0].tint: `floor.reflectence.data` matches no parameter"),
    ([{"tint": KEY}, {"key": KEY}], "parameters[1].key: `floor.reflectance.data` is already matched by parameters[0]"),
    ([{"key": KEY}, {"tint": KEY}], "parameters[1].tint: `floor.reflectance.data` is already matched by parameters[0]"),
    ([{"tint": KEY}, {"tint": KEY}], "parameters[1].tint: `floor.reflectance.data` is already matched"),
    ([{"tint": KEY, "bounds": [2, 3]}], "parameters[0].bounds: exclude the initial value of `floor.reflectance.tint`"),
])  # fmt: skip
def test_what_is_refused(make_scene, specs: list[dict[str, Any]], reason: str):
    with pytest.raises(ConfigError) as error:
        select(make_scene(), *specs)
    assert str(error.value).startswith(f"c.yaml: {reason}")


@pytest.mark.parametrize(("spec", "reason"), [
    ({"tint": KEY, "resolution": [4, 4]}, "has no effect on a tint"),
    ({"tint": KEY, "precondition": 0.1}, "has no effect on a tint"),
    ({"tint": KEY, "key": KEY}, "cannot be combined with `key`"),
])  # fmt: skip
def test_settings_of_the_texels_are_refused(spec: dict[str, Any], reason: str):
    with pytest.raises(ValueError, match=reason):
        ParameterSpec(**spec)


# ---- Scenes with files ----

#: A floor whose pattern is known, on a file of 8 bits or of floats, and a wall.
WALL = "wall.bsdf.reflectance.value"
PATTERN = "floor.bsdf.reflectance.data"
TINT = "floor.bsdf.reflectance.tint"
TRUE = np.array([0.5, 0.8, 0.6])


def write(folder: Path, name: str = "wood.exr", tint: np.ndarray | float = 1.0) -> Path:
    """Write a scene of a floor with a pattern times `tint`, and a wall."""
    random = np.random.default_rng(4)
    values = (random.uniform(0.4, 0.95, (8, 8, 3)) * tint).astype(np.float32)
    bitmap = mi.Bitmap(values)
    if name.endswith(".png"):
        bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    bitmap.write(str(folder / name))
    raw = "false" if name.endswith(".png") else "true"
    floor = f'''<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="{name}"/>
        <boolean name="raw" value="{raw}"/></texture></bsdf>'''
    lamp = '<rotate x="1" angle="180"/><scale value="0.4"/><translate z="2" y="-0.2"/>'
    upright, path = '<rotate x="1" angle="90"/><translate y="1" z="1"/>', folder / "scene.xml"
    path.write_text(scene(
        '<integrator type="path"/>',
        sensor("0, -2.5, 1.2", "0, 0, 0.4", "0, 0, 1", size=(24, 16), fov=60, rfilter="gaussian"),
        shape("rectangle", "floor", floor),
        shape("rectangle", "wall", diffuse("0.5, 0.5, 0.5"), place=upright),
        shape("rectangle", "lamp", diffuse("0, 0, 0"), area("9, 8, 7"), place=lamp),
    ))  # fmt: skip
    return path


def write_run(folder: Path, *parameters: dict[str, Any], name: str = "wood.exr") -> Path:
    """Write a target of the scene with the true tint, the scene without, and the configuration of a run."""
    made = mi.load_file(str(write(folder, name, TRUE)))
    image = np.array(mi.render(made, integrator=mi.load_dict({"type": "path", "max_depth": 4}), spp=2048))
    mi.Bitmap(image[:, :, :3]).write(str(folder / "target.exr"))
    write(folder, name)
    config = {
        "variant": "llvm_ad_rgb", "scene": {"file": "scene.xml"}, "target": {"file": "target.exr"},
        "integrator": {"type": "reslrb", "max_depth": 4}, "optimizer": {"type": "auto"}, "parameters": parameters,
        "run": {"iterations": 40, "spp": 64},
    }  # fmt: skip
    (path := folder / "run.yaml").write_text(yaml.safe_dump(config))
    return path


def recover(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the recovered values, and the record of their certainty."""
    folder = path.parent / "runs/run"
    with rl.optimize(path, folder=folder) as run:
        for _ in run:
            pass
    manifest = json.loads((folder / "manifest.json").read_text())
    return dict(run.parameters), manifest["results"]["certainty"]


@pytest.mark.parametrize(("name", "tolerance"), [("wood.exr", 0.02), ("wood.png", 0.03)])
def test_a_run_recovers_a_tint(tmp_path: Path, llvm: str, name: str, tolerance: float):
    """The texture of 8 bits is read as floats. The tinted texture is exported."""
    path = write_run(tmp_path, {"tint": PATTERN, "bounds": [0, 2]}, {"key": WALL, "bounds": [0, 1]}, name=name)
    values, certainty = recover(path)
    np.testing.assert_allclose(values[TINT], TRUE, rtol=tolerance)
    np.testing.assert_allclose(values[WALL], 0.5, rtol=tolerance)
    assert certainty["parameters"][TINT]["verdict"] == "settled"
    rl.export(tmp_path / "runs/run", tmp_path / "made")
    exported = np.array(mi.traverse(mi.load_file(str(tmp_path / "made/scene.xml")))[PATTERN])
    expected = np.array(mi.traverse(load_scene(write(tmp_path, name), keys=[PATTERN]))[PATTERN])
    np.testing.assert_allclose(exported, expected * values[TINT], rtol=2e-3)


def test_a_wrong_tint_is_named_and_can_be_freed(tmp_path: Path, llvm: str):
    path = write_run(tmp_path, {"key": WALL, "bounds": [0, 1]})
    [first, *_] = recover(path)[1]["fit"]["candidates"]
    assert first["key"] == TINT
    assert first["explained"] > 0.9
    np.testing.assert_allclose(first["proposed"], TRUE, rtol=0.15)
    [_, spec] = with_freed(load(path), [TINT], "--free").parameters
    assert spec.tint == PATTERN
    assert spec.bounds is not None
    assert spec.bounds[0] == 0
    assert 1 < spec.bounds[1] < 1.1  # the largest texel becomes 1
    assert assemble(with_freed(load(path), [TINT], "--free")).selection.keys == [WALL, TINT]


def test_the_first_fit_of_init_frees_a_wrong_tint_and_no_right_one(tmp_path: Path, llvm: str):
    write_run(tmp_path, {"key": WALL})
    for name, is_wrong in (("wrong", True), ("right", False)):
        if not is_wrong:
            write(tmp_path, tint=TRUE)
        file = tmp_path / f"{name}.yaml"
        tiny.done("init", tmp_path / "scene.xml", "--target", tmp_path / "target.exr", "-o", file, "--fit", 300)
        assert any(spec.tint == PATTERN for spec in load(file).parameters) is is_wrong


def test_a_pattern_is_proposed_as_a_tint_and_a_flat_texture_by_its_texels(tmp_path: Path, llvm: str):
    made = load_scene(write(tmp_path))
    found = {each.info.key: each for each in propose(made, 0)}
    assert (found[PATTERN].key, found[PATTERN].first, found[PATTERN].resolution) == (TINT, False, None)
    params = mi.traverse(made)
    params[PATTERN] = dr.full(mi.TensorXf, 0.5, params[PATTERN].shape)
    params.update()
    [flat] = [each for each in propose(made, 0) if each.info.key == PATTERN]
    assert (flat.key, flat.first) == (PATTERN, True)
