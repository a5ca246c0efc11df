"""Tests of the spectral variants alone. `test_spectral.py` runs them in a process of their own."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import colour
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare, renders
from cli.tiny import done, settings
from click.testing import CliRunner
from conformance.scenes import camera, lamp, rgb, stage

import reslrb_cli as rl
from reslrb_cli.cli import main
from reslrb_cli.config.loader import loads
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.records.images import write_file
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.run_folder import read_value
from reslrb_cli.scene.export import export_scene
from reslrb_cli.scene.images import read_photo
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.proposal import propose
from reslrb_cli.scene.upsampling import DARKEST, coefficients, colour_in_scene, colours_of
from reslrb_cli.scene.xml.read import Description

#: Wavelengths in nm, and spectra with these nodes.
NODES = np.linspace(400, 700, 7)
RHO = np.array([0.2, 0.3, 0.6, 0.4, 0.7, 0.5, 0.8])
EMITTED = np.array([0.5, 1.5, 1.0, 3.0, 2.0, 2.5, 1.0])
DEPTH = 6
PATHS = ["light", "camera", "both"]


def spectrum(values: np.ndarray, kind: str) -> dict[str, Any]:
    """Return a spectrum with the values at NODES."""
    text = ", ".join(map(str, values))
    if kind == "regular":
        return {"type": kind, "wavelength_min": 400.0, "wavelength_max": 700.0, "values": text}
    return {"type": kind, "wavelengths": ", ".join(map(str, NODES)), "values": text}


def furnace(kind: str = "regular") -> dict[str, Any]:
    """Return a sensor in a sphere with one reflectance and one emission."""
    return {
        "type": "scene",
        "wall": {"type": "sphere", "flip_normals": True,
                 "bsdf": {"type": "diffuse", "reflectance": spectrum(RHO, kind)},
                 "emitter": {"type": "area", "radiance": spectrum(EMITTED, kind)}},
        "sensor": {"type": "perspective", "fov": 60, "film": {
            "type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "rgb", "rfilter": {"type": "box"}}},
    }  # fmt: skip


def closed_form() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the colour of the furnace, and its derivatives (NODES, 3) by the values of reflectance and emission."""
    fine = np.linspace(400, 700, 3001)
    step = fine[1] - fine[0]
    weights = np.full(fine.size, step)
    weights[[0, -1]] *= 0.5
    responses = np.array(mi.linear_rgb_rec(mi.Float(fine.astype(np.float32))), np.float64).reshape(3, -1).T
    responses *= weights[:, None] * float(mi.MI_CIE_Y_NORMALIZATION)
    rho, Le = np.interp(fine, NODES, RHO), np.interp(fine, NODES, EMITTED)
    hats = np.stack([np.interp(fine, NODES, row) for row in np.eye(len(NODES))])
    series = sum(rho**k for k in range(DEPTH))
    slope = sum(k * rho ** (k - 1) for k in range(1, DEPTH))
    return (Le * series) @ responses, (hats * Le * slope) @ responses, (hats * series) @ responses


@pytest.mark.parametrize("kind", ["regular", "irregular"])
@pytest.mark.parametrize("paths", PATHS)
def test_the_furnace_has_its_colour(paths: str, kind: str) -> None:
    scene = Case(furnace(kind), []).scene
    tracer = integrator("reslrb", DEPTH, paths=paths)
    found = renders(lambda seed: render_image(tracer, scene, 0, seed, 256), range(16)).mean((1, 2))
    expected, *_ = closed_form()
    z = (found.mean(0) - expected) / (found.std(0, ddof=1) / 4)
    print(paths, kind, found.mean(0), expected, z)
    assert np.abs(z).max() < 4.5
    assert found.std(0).max() < 0.05 * expected.mean()


@pytest.mark.parametrize("kind", ["regular", "irregular"])
@pytest.mark.parametrize("estimator", ["stack", "reservoir", "gather", "event"])
@pytest.mark.parametrize("paths", PATHS)
def test_the_furnace_has_its_derivatives(paths: str, estimator: str, kind: str) -> None:
    if paths == "camera" and estimator != "stack":
        pytest.skip("camera paths have one estimator")
    keys = ["wall.bsdf.reflectance.values", "wall.emitter.radiance.values"]
    case = Case(furnace(kind), keys)
    tracer = integrator("reslrb", DEPTH, paths=paths, estimator=estimator)
    found = case.gradients(tracer, seeds(16), 256)
    _, by_rho, by_Le = closed_form()
    weights = np.array(case.weights).sum((0, 1))
    expected = np.concatenate([by_rho @ weights, by_Le @ weights])
    z = (found.mean(0) - expected) / (found.std(0, ddof=1) / 4)
    print(paths, estimator, kind, np.round(z, 1))
    assert np.abs(z).max() < 5.5
    assert (found.std(0) / 4).max() < 0.05 * np.abs(expected).max()


def test_coefficients_have_their_colour() -> None:
    """Spectra have exactly their colour, and are almost those of Mitsuba's table, except near black and white."""
    colours = np.random.default_rng(1).random((400, 3)).astype(np.float32)
    colours[:20] = colours[:20, :1]  # greys
    colours[20:24] = [0, 0, 0], [1, 1, 1], [0, 0.5, 0], [1, 0, 0.2]
    colours[200:300] = 1 - 0.01 * colours[200:300]
    colours[300:] *= 0.01
    found = np.array(coefficients(mi.Color3f(*(mi.Float(np.ascontiguousarray(column)) for column in colours.T)))).T
    expected = np.array([np.ravel(mi.srgb_model_fetch(mi.ScalarColor3f(*map(float, colour)))) for colour in colours])
    np.testing.assert_allclose(colours_of(found), np.clip(colours, DARKEST, 1 - DARKEST), atol=1e-5)
    wavelengths = np.linspace(400, 700, 7)[:, None]
    ours, theirs = (0.5 + 0.5 * v / np.sqrt(1 + v**2) for v in (
        (c[:, 0] * wavelengths + c[:, 1]) * wavelengths + c[:, 2] for c in (found, expected)))  # fmt: skip
    np.testing.assert_allclose(ours[:, :200], theirs[:, :200], atol=0.01)


def test_coefficients_have_derivatives() -> None:
    colour = mi.Color3f(
        [0.3, 0.8, 0.1, 0.5, 0.2, 0.99], [0.5, 0.2, 0.1, 0.5, 0.9, 0.995], [0.2, 0.4, 0.6, 0.5, 0.01, 0.992]
    )
    dr.enable_grad(colour)
    c = coefficients(colour)
    v = (c.x * 530 + c.y) * 530 + c.z
    dr.backward(0.5 + 0.5 * v * dr.rsqrt(dr.square(v) + 1))
    gradient = np.array(dr.grad(colour))

    def value(change: np.ndarray) -> np.ndarray:
        moved = np.array(dr.detach(colour)) + change
        c = np.array(coefficients(mi.Color3f(*(mi.Float(row.astype(np.float32)) for row in moved))), np.float64)
        v = (c[0] * 530 + c[1]) * 530 + c[2]
        return 0.5 + 0.5 * v / np.sqrt(1 + v**2)

    for channel in range(3):
        change = np.zeros((3, 1))
        change[channel] = 2e-3
        np.testing.assert_allclose((value(change) - value(-change)) / 4e-3, gradient[channel], rtol=0.01, atol=0.005)


def test_the_condition_of_gradients_by_colours() -> None:
    """The condition number is that of the product of the Jacobian matrix and the spectrum's gradient. The gradient is
    collected as before.
    """
    key = "wall.bsdf.reflectance.value"
    scene = furnace()
    scene["wall"]["bsdf"]["reflectance"] = rgb(0.3, 0.8, 0.1)
    case = Case(scene, [key])
    leaves = case.leaves()
    [found] = case.values.colours._found.values()
    gradient = np.array([3.5e5, 550.0, 1.0])
    dr.set_grad(found.leaves[key].leaf, mi.Color3f(*gradient.tolist()))
    jacobian = []
    for part in range(3):
        colour = mi.Color3f(dr.detach(leaves[key]))
        dr.enable_grad(colour)
        dr.backward(coefficients(colour)[part])
        jacobian.append(np.array(dr.grad(colour)).ravel())
    terms = np.array(jacobian) * gradient[:, None]
    expected = np.linalg.norm(np.abs(terms).sum(0)) / np.linalg.norm(terms.sum(0))
    assert expected > 2
    assert case.values.colours.cancellation() == {key: pytest.approx(expected, rel=1e-3)}
    case.values.collect()
    np.testing.assert_allclose(np.ravel(dr.grad(leaves[key])), terms.sum(0), rtol=1e-3)


def test_the_condition_of_gradients_that_are_zero() -> None:
    """The condition number is 1 if no path connects, as in the extreme case `no_connection`."""
    scene = furnace()
    scene["wall"]["emitter"]["radiance"] = rgb(8, 7, 6)
    key = "wall.emitter.radiance.value"
    case = Case(scene, [key])
    case.leaves()
    assert case.values.colours.cancellation() == {key: 1}


SPECFILM = {
    "type": "specfilm", "width": 8, "height": 6, "rfilter": {"type": "gaussian"},
    "blue": {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 500.0, "values": "0, 1, 0"},
    "green": {"type": "regular", "wavelength_min": 470.0, "wavelength_max": 600.0, "values": "0, 1, 1, 0"},
    "red": {"type": "regular", "wavelength_min": 560.0, "wavelength_max": 700.0, "values": "0, 1, 0.5"},
    "wide": {"type": "regular", "wavelength_min": 420.0, "wavelength_max": 680.0, "values": "1, 2"},
}  # fmt: skip


@pytest.mark.parametrize("paths", PATHS)
def test_a_film_with_its_own_responses(paths: str) -> None:
    """The image equals that of `path`, in each channel."""
    scene = stage({"lamp": lamp(radiance=rgb(8, 7, 6))}, camera() | {"film": SPECFILM})
    tracer, reference = integrator("reslrb", 4, paths=paths), integrator("path", 4)
    ours = renders(lambda seed: render_image(tracer, scene, 0, seed, 256), range(8))
    theirs = renders(lambda seed: render_image(reference, scene, 0, seed, 256), range(100, 108))
    inner = (slice(None), slice(1, -1), slice(1, -1))
    result = compare(ours[inner], theirs[inner], block=2)
    assert ours.shape[-1] == 4
    assert result, result


SCENE = """<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="4"/><integer name="height" value="4"/><rfilter type="box"/></film></sensor>
    <shape type="sphere" id="wall"><boolean name="flip_normals" value="true"/>
        <bsdf type="diffuse"><spectrum name="reflectance" value="400:0.2, 550:0.6, 700:0.4"/></bsdf>
        <emitter type="area"><spectrum type="regular" name="radiance"><string name="values" value="1, 2, 1"/>
            <float name="wavelength_min" value="400"/><float name="wavelength_max" value="700"/></spectrum></emitter>
    </shape>
</scene>
"""


def recover_and_export(folder: Path, text: str, config: dict[str, Any]) -> tuple[rl.Run, list[rl.Record], Any]:
    """Run an experiment with this scene. Return the run, its records, and the parameters of the exported scene."""
    (folder / "scene.xml").write_text(text)
    config |= {"variant": mi.variant(), "scene": {"file": str(folder / "scene.xml")}}
    config["run"]["output"] = str(folder)
    run = rl.optimize(rl.load(config), folder=str(folder / "run"))
    records = list(run)
    result = CliRunner().invoke(main, ["export", str(folder / "run"), "-o", str(folder / "made")])
    assert result.exit_code == 0, result.output
    return run, records, mi.traverse(mi.load_file(str(folder / "made" / "scene.xml"), optimize=False))


def test_a_run_recovers_spectra_and_exports_them(tmp_path: Path) -> None:
    keys = ["wall.bsdf.reflectance.values", "wall.emitter.radiance.values"]
    config = {
        "target": {"render": {"spp": 16384, "parameters": {keys[0]: [0.3, 0.5, 0.4], keys[1]: [1.5, 2.5, 1.0]}}},
        "parameters": [{"key": keys[0], "bounds": [0, 1]}, {"key": keys[1], "bounds": [0.1, 5]}],
        "integrator": {"type": "reslrb", "max_depth": 4, "paths": "light"},
        "optimizer": {"type": "adam", "learning_rate": 0.05},
        "run": {"iterations": 30, "spp": 1024},
    }
    run, records, made = recover_and_export(tmp_path, SCENE, config)
    assert records[-1].loss < 0.5 * records[0].loss
    for key in keys:
        np.testing.assert_allclose(np.ravel(made[key]), np.ravel(run.parameters[key]), rtol=1e-5)


def test_a_bump_map_is_no_colour(tmp_path: Path) -> None:
    """Its bitmap stays raw, although it may have the name of a spot's colour. The bitmap of a reflectance does not."""
    write_file(tmp_path / "a.exr", np.full((4, 4, 3), 0.5, np.float32), linear=True)
    file = '<string name="filename" value="a.exr"/><boolean name="raw" value="true"/>'
    paint = f'<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{file}</texture></bsdf>'
    bumps = f'<bsdf type="bumpmap"><texture type="bitmap" name="texture">{file}</texture>{paint}</bsdf>'
    first, last = SCENE.index("<bsdf"), SCENE.index("</bsdf>") + len("</bsdf>")
    (tmp_path / "scene.xml").write_text(SCENE[:first] + bumps + SCENE[last:])
    scene = load_scene(tmp_path / "scene.xml")
    assert np.isfinite(np.array(render_image(integrator("reslrb", 2), scene, 0, 0, 4))).all()
    [key] = [key for key in mi.traverse(scene).properties if key.endswith("reflectance.data")]
    np.testing.assert_allclose(colour_in_scene(mi.traverse(scene), key), 0.5, rtol=0.01)


def camera_sees_a_black_body(scene: dict[str, Any]) -> np.ndarray:
    """Return the colour that camera paths see if Mitsuba loads the scene. Assert that light paths are refused."""
    stock = mi.load_dict(scene, optimize=False)
    with pytest.raises(UnsupportedScene, match="of emitter emitter, a `blackbody`; load the scene with"):
        render_image(integrator("reslrb", 2), stock, 0, 0, 1)
    return renders(lambda seed: render_image(integrator("path", 2), stock, 0, seed, 1024), range(4)).mean((0, 1, 2))


def test_a_black_body_becomes_a_regular_spectrum() -> None:
    """Mitsuba cannot sample its wavelengths along light paths, but camera paths evaluate it."""
    glow = {"type": "sphere", "radius": 0.3, "center": [0, 1.5, 3],
            "emitter": {"type": "area", "radiance": {"type": "blackbody", "temperature": 3000.0}}}  # fmt: skip
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 4]).scale(3)}
    own = {"type": "scene", "wall": wall, "glow": glow, "sensor": furnace()["sensor"]}
    seen = camera_sees_a_black_body(own)
    gc.collect()  # light paths ask the emitters of all scenes in memory
    scene = rl.load_scene(own)
    assert np.shape(mi.traverse(scene)["glow.emitter.radiance.values"]) == (95,)
    found = renders(lambda seed: render_image(integrator("reslrb", 2), scene, 0, seed, 1024), range(4)).mean((0, 1, 2))
    np.testing.assert_allclose(found, seen, rtol=0.02)


def test_spectra_get_bounds_and_black_lamps_are_not_proposed() -> None:
    """Mitsuba's coefficients of black belong to a reflectance of 4e-9."""
    black = {"type": "diffuse", "reflectance": rgb(0, 0, 0)}
    before = mi.ScalarTransform4f().translate([0, 0, 0.8]).rotate([1, 0, 0], 180).scale(0.2)
    panel = {"type": "rectangle", "to_world": before, "bsdf": black,
             "emitter": {"type": "area", "radiance": rgb(2, 2, 2)}}  # fmt: skip
    metal = {"type": "sphere", "radius": 0.2, "center": [1, 0, 0],
             "bsdf": {"type": "roughconductor", "material": "Cu"}}  # fmt: skip
    scene = Case(furnace() | {"panel": panel, "metal": metal}, []).scene
    found = {each.info.key: each for each in propose(scene, 0, lamps=True)}
    assert {key: each.bounds for key, each in found.items() if key.endswith("values")} == {
        "wall.bsdf.reflectance.values": "[0, 1]",
        "wall.emitter.radiance.values": "[0, .inf]",
        "metal.bsdf.eta.values": "[0, 10]",
        "metal.bsdf.k.values": "[0, 10]",
    }
    own = found["panel.bsdf.reflectance.value"]
    assert own.share > 0.02
    assert own.info.value is not None
    assert own.info.value.high == 0
    assert not own.first


def test_a_recovered_colour_of_a_lamp_is_exported(tmp_path: Path) -> None:
    """The colour determines the lamp's spectrum of D65, which has no element of its own."""
    start = SCENE.index('<spectrum type="regular" name="radiance">')
    end = SCENE.index("</spectrum></emitter>")
    lit = f'{SCENE[:start]}<rgb name="radiance" value="1, 2, 1"/>{SCENE[end + len("</spectrum>") :]}'
    key = "wall.emitter.radiance.value"
    config = {
        "target": {"render": {"spp": 16}},
        "parameters": [{"key": key, "initial": [3.0, 1.0, 0.5]}],
        "integrator": {"type": "reslrb", "max_depth": 3, "paths": "light"},
        "run": {"iterations": 1, "spp": 16, "measuring": 0},
    }
    run, _, made = recover_and_export(tmp_path, lit, config)
    np.testing.assert_allclose(colour_in_scene(made, key), np.ravel(run.parameters[key]), rtol=0.01)


#: Forms of spectra that the exported scene must give in another way.
FORMS = """<scene version="3.0.0"><sensor type="perspective"/>
<emitter type="point" id="bulb"><spectrum name="intensity" value="12"/></emitter>
<emitter type="point" id="tinted"><spectrum type="d65" name="intensity"><rgb name="color" value="1, 0.5, 0.2"/>
    </spectrum></emitter>
<emitter type="point" id="tube"><spectrum type="illuminant" name="intensity"><string name="name" value="FL2"/>
    </spectrum></emitter>
<shape type="sphere" id="ball"><bsdf type="conductor"><string name="material" value="Cu"/></bsdf></shape></scene>"""


def test_every_form_of_a_spectrum_is_exported(tmp_path: Path) -> None:
    """A number of an emitter is uniform, and not D65. A material's name gives eta and k, so both are written."""
    (tmp_path / "scene.xml").write_text(FORMS)
    found: list[Description] = []
    scene = load_scene(tmp_path / "scene.xml", look=found.append)
    keys = ["bulb.intensity.value", "tinted.intensity.value", "tube.intensity.values", "ball.bsdf.k.values"]
    selection = select_parameters(scene, [ParameterSpec(key=key) for key in keys], "c.yaml")
    selection.set_arrays({key: 2.0 * selection.array(key) for key in keys})
    export_scene(found[0], selection.params, selection.scene_keys, {"type": "path"}, tmp_path / "made", "RUN")
    made = mi.traverse(mi.load_file(str(tmp_path / "made" / "scene.xml"), optimize=False))
    for key in keys:
        own = colour_in_scene(made, key) if key.startswith("tinted") else np.ravel(made[key])
        np.testing.assert_allclose(own, selection.array(key).ravel(), rtol=0.01, err_msg=key)


CHANNEL = """<spectrum type="sensitivity" name="{}"><string name="camera" value="Nikon 5100"/>
    <string name="channel" value="{}"/></spectrum>"""
CAMERA = f"""<scene version="3.0.0">
    <sensor type="perspective"><film type="specfilm">
        <integer name="width" value="8"/><integer name="height" value="8"/>
        {CHANNEL.format("R", "red")}{CHANNEL.format("G", "green")}{CHANNEL.format("B", "blue")}</film></sensor>
    <shape type="rectangle" id="plate"><transform name="to_world"><scale value="9"/><rotate y="1" angle="180"/>
        <translate z="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.3, 0.2"/></bsdf></shape>
    <emitter type="constant"><spectrum type="illuminant" name="radiance"><string name="name" value="A"/></spectrum>
    </emitter>
</scene>
"""


def take_raw_photograph(image: np.ndarray) -> None:
    """Write the scene and a raw photograph into the working folder. A camera balances the image (8, 8, 3) for the
    illuminant A, and writes 16 bits. White surfaces are grey, and the largest channel stays.
    """
    Path("plate.xml").write_text(CAMERA)
    curves, light = colour.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"], colour.SDS_ILLUMINANTS["A"]
    white = np.interp(curves.wavelengths, light.wavelengths, light.values) @ curves.values
    mi.Bitmap(np.uint16(np.clip(image * 0.8 * white.max() / white, 0, 1) * 65535 + 0.5)).write("raw.png")


def test_a_raw_photograph_gets_the_colours_of_the_lamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    image = np.random.default_rng(1).uniform(0.1, 0.3, (8, 8, 3))
    take_raw_photograph(image)
    problem = assemble(loads(f"""
        variant: {mi.variant()}
        scene: {{file: plate.xml}}
        target: {{file: raw.png, color_space: linear, white_balance: {{scene: A}}, mask: none}}
        parameters: [{{key: plate.bsdf.reflectance.value}}]
        integrator: {{type: prb}}
    """, str(tmp_path / "plate.yaml")))  # fmt: skip
    np.testing.assert_allclose(np.array(problem.views[0].target), 0.8 * image, rtol=1e-3)


def test_a_colour_is_recovered_from_a_raw_photograph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mitsuba's `path` renders the image."""
    monkeypatch.chdir(tmp_path)
    Path("plate.xml").write_text(CAMERA)
    scene, tracer = load_scene(Path("plate.xml")), mi.load_dict({"type": "path", "max_depth": 2})
    take_raw_photograph(np.array(mi.render(scene, integrator=tracer, spp=16384)))
    done("init", "plate.xml", "--target", "raw.png", "--set", f"variant={mi.variant()}")
    assert "color_space: linear" in Path("plate.yaml").read_text()
    done("optimize", "plate.yaml", *settings(
        "target.white_balance={scene: A}", "target.exposure=0.8", "parameters[0].initial=0.5", "integrator.max_depth=2",
        "integrator.paths=camera", "run.iterations=120", "run.spp=128", "run.name=it",
    ))  # fmt: skip
    found = read_value(Path("runs/it"), "plate.bsdf.reflectance.value")
    np.testing.assert_allclose(found, [0.6, 0.3, 0.2], atol=0.01)
    assert read_manifest(Path("runs/it"))["views"][0]["channels"] == ["R", "G", "B"]


def test_a_photograph_lacks_a_channel_of_the_film(tmp_path: Path) -> None:
    names, path = ["blue", "green", "red"], tmp_path / "seen.exr"
    mi.Bitmap(np.ones((2, 2, 3), np.float32), mi.Bitmap.PixelFormat.MultiChannel, names).write(str(path))
    assert read_photo(path, channels=["red", "blue"]).image.shape == (2, 2, 2)
    with pytest.raises(ConfigError, match="the film also needs wide"):
        read_photo(path, channels=["red", "wide"])


def test_the_coefficients_of_an_environment_map_are_no_zeros() -> None:
    """Coefficients may be negative. Only the radiance of a texel can be a zero factor."""
    for darkest, zeros in ((0.01, False), (0.0, True)):
        texels = np.random.default_rng(4).uniform(0.1, 1, (4, 8, 3)).astype(np.float32)
        texels[1, 2] = darkest
        case = Case(stage({"light": {"type": "envmap", "bitmap": mi.Bitmap(texels)}}), ["light.data"])
        ours, leaves = integrator("reslrb", estimator="stack"), case.leaves()
        plan = ours.plan(case.scene, case.scene.sensors()[0], case.params)
        case.release(leaves)
        assert plan.differentiate_emission
        assert plan.track_zeros == zeros
