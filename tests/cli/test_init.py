"""`init` writes a configuration for `optimize` from a scene and a photograph."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.tiny import reslrb, settings
from click.testing import Result
from kit import scene, sensor, shape

from reslrb_cli.cli.init import PIXELS, _entry, _note, choose_size
from reslrb_cli.config.loader import load
from reslrb_cli.config.parameters import tint_of
from reslrb_cli.config.schema import Config
from reslrb_cli.config.views import TargetConfig
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.scene.catalog import Value
from reslrb_cli.scene.images import image_size, orientation_of
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.proposal import TEXELS, _resolution, find_movable_in_view, propose, usual_bounds
from reslrb_cli.scene.response import decode_srgb

pytestmark = pytest.mark.usefixtures("llvm", "compared")


# `init` writes a configuration that `optimize` accepts, from a scene alone and from a scene with a photograph.


def write_noise(path: Path, width: int, height: int) -> Path:
    """Write an 8-bit image of random pixels."""
    tiny.write_photo(path, np.random.default_rng(3).uniform(0, 0.9, (height, width, 3)))
    return path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory with a scene in its folder `room`."""
    (tmp_path / "room").mkdir()
    tiny.write_experiment(tmp_path / "room")
    (tmp_path / "room/tiny.yaml").unlink()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def of_photograph(folder: Path, width: int, height: int) -> tuple[Config, Result]:
    result = tiny.done(
        "init", "room/scene.xml", "--target", write_noise(folder / "photo.png", width, height), "--fit", 0
    )
    return load(folder / "room.yaml"), result


def test_a_scene_alone_gets_a_configuration_without_a_photograph(folder: Path) -> None:
    result = tiny.done("init", "room/scene.xml")
    assert "room.yaml: 1 of 3 parameters, at 8x8 pixels" in result.output
    config = load(folder / "room.yaml")
    assert [spec.keys for spec in config.parameters] == [["lamp.emitter.radiance.value"]]
    assert config.parameters[0].bounds == (0, np.inf)
    assert (config.loss.type, config.optimizer.type, config.integrator.max_depth) == ("relative_l2", "auto", 8)
    # The scene knows the pattern of its texture.
    assert f"# - {{tint: {tiny.KEY}, bounds: [0, 1.144]}}" in (folder / "room.yaml").read_text()
    missing = reslrb("optimize", "room.yaml")
    assert missing.exit_code == 2
    assert f"room.yaml: target.file: {folder / 'photo.png'}: no such file" in missing.output
    write_noise(folder / "photo.png", 8, 8)
    tiny.done("optimize", "room.yaml", "--set", "run.iterations=2", "--set", "integrator.estimator=stack")
    assert read_manifest(folder / "runs/room")["status"] == "finished"


def test_the_brightness_of_a_lamp_is_proposed_and_not_its_place(folder: Path) -> None:
    """`auto` refuses places. The floor is smooth glass, so no material is proposed."""
    lamp = '<emitter type="point" id="lamp"><point name="position" value="0, 0, 3"/></emitter>'
    text = scene(sensor("0, 0, 4"), shape("rectangle", "floor", '<bsdf type="dielectric"/>'), lamp)
    (folder / "room/scene.xml").write_text(text)
    tiny.done("init", "room/scene.xml")
    config = load(folder / "room.yaml")
    assert [spec.keys for spec in config.parameters] == [["lamp.intensity.value"]]
    assert config.optimizer.type == "auto"


def test_commented_settings_are_valid(folder: Path) -> None:
    tiny.done("init", "room/scene.xml")
    text = (folder / "room.yaml").read_text().replace("  # - {", "  - {")
    (folder / "room.yaml").write_text(text)
    values = assemble_scene(load(folder / "room.yaml")).values()
    assert set(values) == {tint_of(tiny.KEY), "lamp.emitter.radiance.value", "lamp.bsdf.reflectance.value"}


def test_nothing_is_replaced(folder: Path) -> None:
    (folder / "room.yaml").write_text("mine")
    refused = reslrb("init", "room/scene.xml")
    assert refused.exit_code == 2
    assert "room.yaml: exists; remove or rename it" in refused.output
    assert (folder / "room.yaml").read_text() == "mine"
    copy = f"photo-{int(PIXELS**0.5)}x{int(PIXELS**0.5)}.png"
    (folder / copy).write_text("mine, too")
    target = write_noise(folder / "photo.png", 300, 300)
    refused = reslrb("init", "room/scene.xml", "-o", "other.yaml", "--target", target)
    assert refused.exit_code == 2
    assert f"{copy}: exists" in refused.output
    assert (folder / copy).read_text() == "mine, too"
    assert not (folder / "other.yaml").exists()


@pytest.mark.parametrize("is_flat", [True, False])
def test_a_texture_is_recovered_at_first_unless_it_has_a_pattern(folder: Path, is_flat: bool) -> None:
    """Colours of three channels differ in a flat texture, too."""
    texels = np.tile(np.array([0.7, 0.3, 0.2], np.float32), (4, 4, 1))
    texels[2, 1] += 0 if is_flat else 0.05
    mi.Bitmap(texels).write(str(folder / "room/poster.exr"))
    tiny.done("init", "room/scene.xml")
    keys = [key for spec in load(folder / "room.yaml").parameters for key in spec.keys]
    assert (tiny.KEY in keys) is is_flat
    assert f"- {{{'key' if is_flat else 'tint'}: {tiny.KEY}" in (folder / "room.yaml").read_text()


def test_a_second_call_with_the_same_photograph_uses_the_same_copy(folder: Path) -> None:
    target = write_noise(folder / "photo.png", 300, 300)
    tiny.done("init", "room/scene.xml", "--target", target, "--fit", 0)
    [copy] = folder.glob("photo-*")
    before = copy.stat().st_mtime_ns
    tiny.done("init", "room/scene.xml", "-o", "other.yaml", "--target", target, "--fit", 0)
    assert load(folder / "other.yaml").target.file == load(folder / "room.yaml").target.file == copy
    assert copy.stat().st_mtime_ns == before
    copy.write_bytes(copy.read_bytes()[:-1] + b"x")  # another file of this size
    refused = reslrb("init", "room/scene.xml", "-o", "third.yaml", "--target", target)
    assert (refused.exit_code, f"{copy.name}: exists" in refused.output) == (2, True)


def test_a_large_photograph_is_reduced_for_a_short_run(folder: Path) -> None:
    config, result = of_photograph(folder, 600, 597)  # a camera comes no closer to the film's aspect ratio
    width, height = config.scene.size or (0, 0)
    assert 0.9 * PIXELS < width * height <= 1.02 * PIXELS
    assert f"photo-{width}x{height}.png" in result.output
    assert config.target.file == folder / f"photo-{width}x{height}.png"
    assert tuple(mi.Bitmap(str(config.target.file)).size()) == (width, height)


def test_exposure_is_recovered_if_the_photograph_clips(folder: Path) -> None:
    config, _ = of_photograph(folder, 12, 12)
    assert (config.scene.size, config.target.file) == ((12, 12), folder / "photo.png")
    known = "exposure" in TargetConfig.model_fields
    assert ("exposure: auto" in (folder / "room.yaml").read_text()) is known
    image = np.full((8, 8, 3), 0.5, np.float32)
    mi.Bitmap(image).write(str(folder / "linear.exr"))
    tiny.done("init", "room/scene.xml", "--target", "linear.exr", "-o", "linear.yaml", "--fit", 0)
    assert "exposure" not in (folder / "linear.yaml").read_text()


def test_an_8_bit_texture_is_offered_recovered_and_exported(folder: Path) -> None:
    """Most textures have 8 bits. They are read as floats while loading, and the scene file does not change."""
    pixels = np.random.default_rng(6).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    mi.Bitmap(pixels).write(str(folder / "room/poster.png"))
    scene = folder / "room/scene.xml"
    text = tiny.SCENE.replace("poster.exr", "poster.png").replace('<boolean name="raw" value="true"/>', "")
    scene.write_text(text.replace('<string name="format" value="variant"/>', ""))
    before = scene.read_bytes()
    tiny.done("init", "room/scene.xml")
    [line] = [line for line in (folder / "room.yaml").read_text().splitlines() if f"- {{tint: {tiny.KEY}" in line]
    assert "4x4 texels" in line
    assert line.endswith("8 bits, read as floats if recovered")
    assert line.startswith("  # - ")
    text = (folder / "room.yaml").read_text()
    entry = line.replace("# - ", "- ", 1).replace("{tint: ", "{key: ")
    (folder / "room.yaml").write_text(text.replace(line, re.sub(r"bounds: \[.*?\]", "bounds: [0, 1]", entry)))
    sets = ["target={render: {spp: 16}}", "run.iterations=2", "integrator.estimator=stack"]
    tiny.done("optimize", "room.yaml", *(text for each in sets for text in ("--set", each)))
    linear = decode_srgb(pixels.astype(np.float32) / 255)
    true = np.array(mi.Bitmap(str(folder / f"runs/room/parameters/true/{tiny.KEY}.exr")))
    assert np.allclose(true, linear, atol=1e-6)
    tiny.done("export", "runs/room", "-o", "out")
    found = mi.traverse(mi.load_file(str(folder / "out/scene.xml"), optimize=False))[tiny.KEY]
    recovered = np.array(mi.Bitmap(str(folder / f"runs/room/parameters/{tiny.KEY}.exr")))
    assert np.array_equal(np.array(found), recovered)
    assert not np.allclose(recovered, linear, atol=1e-3), "two iterations have moved nothing"
    assert scene.read_bytes() == before


#: A floor with its own texture that fills most of the image, a ball, an object that is not seen, and parameters without
#: effect.
VIEW = """<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="16"/>
<integer name="height" value="16"/></film>
<transform name="to_world"><lookat origin="0, 5, 5" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
<texture type="checkerboard" id="tiles"><rgb name="color0" value="0.2"/><rgb name="color1" value="0.6"/></texture>
<bsdf type="diffuse" id="hidden"><rgb name="reflectance" value="0.3"/></bsdf>
<shape type="sphere"><point name="center" x="0" y="-9" z="0"/><ref id="hidden"/></shape>
<shape type="sphere"><bsdf type="twosided"><bsdf type="principled"><rgb name="base_color" value="0.4"/></bsdf></bsdf>
</shape>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="8"/></transform>
<bsdf type="twosided"><bsdf type="diffuse"><ref id="tiles" name="reflectance"/></bsdf></bsdf></shape>
<shape type="cube"><transform name="to_world"><translate x="-2.5" y="1"/></transform><bsdf type="conductor"/></shape>
<shape type="sphere"><point name="center" x="1.5" y="1" z="0"/><emitter type="area"/></shape></scene>"""


@pytest.mark.usefixtures("combined")
def test_large_visible_parameters_come_first(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(VIEW)
    made = load_scene(tmp_path / "scene.xml")
    movable = find_movable_in_view(made, 0)  # not the floor
    assert [id for id, *_ in movable] == ["Sphere_3", "Sphere_2", "Cube_1"]
    assert [free for *_, free in movable] == ["translation", "translation", "translation, rotation"]
    found = propose(made, 0)
    tiles = [f"Rectangle_1.bsdf.brdf_0.reflectance.color{k}.value" for k in range(2)]
    assert [item.info.key for item in found[:2]] == tiles
    first = [item.info.key for item in found if item.first]
    assert first == [*tiles, "Sphere_2.bsdf.brdf_0.base_color.value"]  # not the lamp's black, roughness or the mirror
    shares = {item.info.key: item.share for item in found}
    assert shares["Cube_1.bsdf.specular_reflectance.value"] > 0.02
    assert shares["hidden.reflectance.value"] == 0
    assert 0.02 < shares["Sphere_2.bsdf.brdf_0.roughness.value"] < shares[tiles[0]] < 1
    assert not any("clearcoat.value" in key for key in shares), "it is 0, by which Mitsuba leaves it out for good"


#: A bulb over a plate. The visible surfaces show how bright the bulb is. The present values are wrong.
BULB = """<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="24"/>
<integer name="height" value="24"/><string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
<float name="fov" value="45"/>
<transform name="to_world"><lookat origin="0, -3, 3" target="0, 0, 0.5" up="0, 0, 1"/></transform></sensor>
<shape type="rectangle" id="plate"><transform name="to_world"><scale value="2"/></transform>{plate}</shape>
<shape type="sphere" id="bulb"><point name="center" x="0.2" y="0.4" z="1"/><float name="radius" value="0.4"/>
<emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter></shape></scene>"""
PAINT = '<bsdf type="diffuse"><rgb name="reflectance" value="{}"/></bsdf>'
METAL = """<bsdf type="roughconductor"><string name="material" value="Al"/><float name="alpha" value="{}"/>
<rgb name="specular_reflectance" value="1"/></bsdf>"""
LAMP, WRONG, RIGHT = "bulb.emitter.radiance.value", "5, 5, 5", "12, 11, 10"
#: For each name: the plate with wrong values, the plate with true values, and the true values of the parameters.
RECOVERED = {
    "a lamp and a wall": (PAINT.format("0.5, 0.5, 0.5"), PAINT.format("0.7, 0.35, 0.2"),
                          {LAMP: [12, 11, 10], "plate.bsdf.reflectance.value": [0.7, 0.35, 0.2]}),
    "a roughness and a lamp": (METAL.format(0.6), METAL.format(0.25),
                               {LAMP: [12, 11, 10], "plate.bsdf.alpha.value": 0.25}),
}  # fmt: skip


def write_bulb(folder: Path, name: str) -> None:
    """Write `bulb.xml` with wrong values, and `bulb.exr`, the scene's image with the right values."""
    wrong, right, _ = RECOVERED[name]
    (folder / "bulb.xml").write_text(BULB.format(plate=wrong, radiance=WRONG))
    (folder / "right.xml").write_text(BULB.format(plate=right, radiance=RIGHT))
    scene = mi.load_file(str(folder / "right.xml"))
    image = mi.render(scene, spp=4096, integrator=mi.load_dict({"type": "path", "max_depth": 8}))
    mi.Bitmap(image).write(str(folder / "bulb.exr"))


@pytest.mark.long
@pytest.mark.parametrize("name", RECOVERED)
def test_the_generated_configuration_recovers_lamps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The unedited configuration is accurate within 5 %. The lamp must become far brighter, and no learning
    rate can anticipate the unit of the lamp.
    """
    monkeypatch.chdir(tmp_path)
    write_bulb(tmp_path, name)
    tiny.done("init", "bulb.xml", "--target", "bulb.exr")
    config = load(tmp_path / "bulb.yaml")
    assert {spec.keys[0] for spec in config.parameters} == set(RECOVERED[name][2])
    assert config.optimizer.type == "auto"
    # The configuration decides neither the estimator nor the measurements of the result, so the test sets both.
    done = tiny.done("optimize", "bulb.yaml", *settings("integrator.estimator=stack", "run.final_spp=16"))
    values = np.load(tmp_path / "runs/bulb/parameters/parameters.npz")
    for key, right in RECOVERED[name][2].items():
        np.testing.assert_allclose(np.ravel(values[key]), np.ravel(right), rtol=0.05, err_msg=done.output)
    certainty = read_manifest(tmp_path / "runs/bulb")["results"]["certainty"]
    assert {about["verdict"] for about in certainty["parameters"].values()} == {"settled"}
    assert certainty["target_noise"] == "left out"
    assert "noise and errors of targets are not in it" in done.output


def test_lamps_of_a_clipped_photograph_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bulb.xml").write_text(BULB.format(plate=METAL.format(0.3), radiance=WRONG))
    photo = write_noise(tmp_path / "photo.png", 24, 24)
    tiny.done("init", "bulb.xml", "--target", photo, "--fit", 0)
    config = load(tmp_path / "bulb.yaml")
    assert [spec.keys for spec in config.parameters] == [["plate.bsdf.alpha.value"]]
    assert config.target.exposure == "auto"


def test_only_the_front_of_a_lamp_is_in_view(tmp_path: Path) -> None:
    """The back of an area light is dark at any radiance and reflectance."""
    shares = []
    for angle in (0, 180):
        lamp = '<shape type="rectangle" id="panel"><transform name="to_world"><scale value="0.5"/>'
        lamp += f'<rotate x="1" angle="{angle}"/><translate x="-1" z="2"/></transform><emitter type="area"/></shape>'
        text = BULB.format(plate=PAINT.format("0.5"), radiance=WRONG).replace("</scene>", f"{lamp}</scene>")
        (tmp_path / "scene.xml").write_text(text)
        found = {item.info.key: item for item in propose(load_scene(tmp_path / "scene.xml"), 0, lamps=True)}
        light, paint = found["panel.emitter.radiance.value"], found["panel.bsdf.reflectance.value"]
        shares.append((light.share > 0, light.first, paint.share > 0))
    assert shares == [(True, True, True), (False, False, False)]


# `init` with choices: the sensor, and values that a scene file leaves open.

#: Two sensors, of which the second sees only the ball. The scene file leaves the film size of the first sensor open.
CHOICES = """<scene version="3.0.0"><default name="side" value="16"/><default name="note" value="a &quot;b&quot;"/>
<sensor type="perspective" id="floor"><film type="hdrfilm"><integer name="width" value="$side"/>
<integer name="height" value="$side"/></film>
<transform name="to_world"><lookat origin="0, 5, 0" target="0, 0, 0" up="0, 0, 1"/></transform></sensor>
<sensor type="perspective" id="ball"><film type="hdrfilm"><integer name="width" value="12"/>
<integer name="height" value="8"/></film><float name="fov" value="10"/>
<transform name="to_world"><lookat origin="9, 1, 9" target="9, 1, 0" up="0, 1, 0"/></transform></sensor>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.4"/></bsdf></shape>
<shape type="sphere"><point name="center" x="9" y="1" z="0"/>
<bsdf type="diffuse"><rgb name="reflectance" value="0.4"/></bsdf></shape>
<emitter type="constant"/></scene>"""


@pytest.fixture
def choices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "hall.xml").write_text(CHOICES)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_one_of_several_sensors_is_named(choices: Path) -> None:
    first = reslrb("init", "hall.xml")
    assert "sensor 0 (floor); --sensor selects another: 1 (ball)" in first.output
    config = load(choices / "hall.yaml")
    assert [view.sensor for view in config.views] == [0]
    assert config.parameters[0].keys == ["Rectangle_1.bsdf.reflectance.value"]
    (choices / "hall.yaml").unlink()
    other = reslrb("init", "hall.xml", "--sensor", 1, "--target", write_noise(choices / "photo.png", 12, 8), "--fit", 0)
    assert "sensor 1 (ball); --sensor selects another: 0 (floor)" in other.output
    config = load(choices / "hall.yaml")
    assert [view.sensor for view in config.views] == [1]
    assert config.scene.size is None  # this sensor's film is as large as the photograph
    assert [spec.keys for spec in config.parameters] == [["Sphere_1.bsdf.reflectance.value"]]
    # The ball and the light each have one colour, so the exposure cannot be told from the colour of the ball.
    few = settings("run.iterations=2", "integrator.estimator=stack", "target.exposure=1")
    tiny.done("optimize", "hall.yaml", *few)
    missing = reslrb("init", "hall.xml", "--sensor", 2, "-o", "other.yaml")
    assert missing.exit_code == 2
    assert "--sensor: is 2; the scene has 0 (floor), 1 (ball)" in missing.output


def test_a_photograph_is_oriented_as_a_person_sees_it(choices: Path) -> None:
    """A phone that is held upright stores landscape pixels and an EXIF orientation."""
    from PIL import Image, ImageOps  # comes with matplotlib

    def photograph(width: int, height: int, orientation: int) -> None:
        pixels = np.random.default_rng(4).integers(40, 200, (height, width, 3), dtype=np.uint8)
        image = Image.fromarray(pixels)
        exif = image.getexif()
        exif[0x0112] = orientation
        image.save(choices / "photo.jpg", exif=exif)

    def init() -> Result:
        (choices / "hall.yaml").unlink(missing_ok=True)
        return reslrb("init", "hall.xml", "--sensor", 1, "--target", "photo.jpg", "--fit", 0)

    told = "photo.jpg: turned by 90 degrees clockwise, as its EXIF orientation says"
    photograph(8, 12, 6)  # the film is 12x8
    made = init()
    assert made.exit_code == 0, made.output
    assert told in made.output
    config = load(choices / "hall.yaml")
    assert (config.scene.size, config.views[0].target) == (None, choices / "photo.jpg")
    few = settings("run.iterations=1", "integrator.estimator=stack", "target.exposure=1", "target.mask=none")
    done = tiny.done("optimize", "hall.yaml", *few)
    assert told in done.output
    target = np.array(mi.Bitmap(str(choices / "runs/hall/images/target.exr")))
    seen = np.array(ImageOps.exif_transpose(Image.open(choices / "photo.jpg"))).astype(np.float32) / 255
    assert np.allclose(target, decode_srgb(seen), atol=1e-5)
    photograph(600, 900, 8)  # the copy is upright and smaller
    assert init().exit_code == 0
    copy = load(choices / "hall.yaml").views[0].target
    assert (orientation_of(copy), image_size(copy)[0] > image_size(copy)[1]) == (1, True)
    photograph(12, 8, 5)
    refused = init()
    assert refused.exit_code == 2
    assert "is 8x12 pixels, the scene's film 12x8" in refused.output
    assert "crop it to the film's view, such as 8x5" in refused.output


def test_a_scene_that_hides_its_lights_keeps_hiding_them(choices: Path) -> None:
    scene = choices / "hall.xml"
    tiny.done("init", "hall.xml")
    assert "hide_emitters" not in (choices / "hall.yaml").read_text()
    for name, value in (("hide_emitters", "true"), ("hideEmitters", "true"), ("hide_emitters", "false")):
        own = f'<integrator type="path"><boolean name="{name}" value="{value}"/></integrator>'
        scene.write_text(CHOICES.replace("<sensor", own + "<sensor", 1))
        (choices / "hall.yaml").unlink()
        tiny.done("init", "hall.xml")
        assert load(choices / "hall.yaml").integrator.hide_emitters == (value == "true")
    scene.write_text(scene.read_text().replace('"false"', '"true"'))
    write_noise(choices / "photo.png", 16, 16)
    made = tiny.done("init", "hall.xml", "-o", "photo.yaml", "--target", "photo.png", "--fit", 0)
    assert "set it if photo.png does not show them" in made.output
    assert "  # hide_emitters: true" in (choices / "photo.yaml").read_text()
    assert not load(choices / "photo.yaml").integrator.hide_emitters  # the photograph shows what is behind the scene


def test_open_variables_of_a_scene_are_named_and_can_be_set(choices: Path) -> None:
    made = reslrb("init", "hall.xml")
    assert "at 16x16 pixels" in made.output
    assert '  # options: {side: 16, note: "a \\"b\\""}  # ' in (choices / "hall.yaml").read_text()
    (choices / "hall.yaml").unlink()
    for length, listed in ((34, "note: {}"), (35, "...")):  # 40 characters, or more
        (choices / "long.xml").write_text(CHOICES.replace("a &quot;b&quot;", length * "b"))
        tiny.done("init", "long.xml", "-o", f"{length}.yaml")
        found = listed.format(length * "b")
        assert f"  # options: {{side: 16, {found}}}" in (choices / f"{length}.yaml").read_text()
    made = reslrb("init", "hall.xml", "--set", "scene.options.side=20")
    assert "at 20x20 pixels" in made.output
    assert load(choices / "hall.yaml").scene.options == {"side": 20}
    for setting, message in (("scene.options.width=3", "$width: is set in scene.options, but the scene file does not"),
                             ("run.spp=4", "--set run.spp=4: init takes only scene.options.NAME=VALUE"),
                             ("scene.options.side=[3]", "scene.options.side")):  # fmt: skip
        refused = reslrb("init", "hall.xml", "--set", setting, "-o", "other.yaml")
        assert refused.exit_code == 2
        assert message in refused.output
    (choices / "hall.xml").write_text(CHOICES.replace('<default name="side" value="16"/>', ""))
    refused = reslrb("init", "hall.xml", "-o", "other.yaml")
    assert refused.exit_code == 2
    assert "set scene.options.side" in refused.output
    tiny.done("init", "hall.xml", "-o", "other.yaml", "--set", "scene.options.side=8")


def test_the_reason_for_camera_paths_is_given(choices: Path) -> None:
    """`init` prints the reason, and writes the reason as a complete comment into the file."""
    (choices / "hall.xml").write_text(CHOICES.replace('"perspective" id="floor"', '"orthographic" id="the # floor"'))
    made = reslrb("init", "hall.xml")
    reason = "sensor the # floor is a OrthographicCamera; light paths connect to `perspective` and `thinlens` sensors"
    assert f"integrator.paths: camera, since light paths cannot render this: {reason}" in made.output
    lines = (choices / "hall.yaml").read_text().splitlines()
    place = lines.index("integrator:")
    comment = [line.strip(" #") for line in lines[place + 1 : lines.index("  type: reslrb")]]
    assert " ".join(comment) == f"paths from the sensor, because light paths cannot render this: {reason}"
    assert 1 <= len(comment) <= 2
    assert load(choices / "hall.yaml").integrator.paths == "camera"
    (choices / "hall.yaml").unlink()
    made = reslrb("init", "hall.xml", "--sensor", 1)
    assert "since" not in made.output
    assert "since" not in (choices / "hall.yaml").read_text()


@pytest.mark.parametrize(
    ("film", "photo", "fixed", "size"),
    [
        ((64, 32), None, False, (64, 32)),
        ((1024, 256), None, False, (256, 64)),
        ((1024, 256), None, True, (1024, 256)),
        ((64, 32), (2048, 512), False, "such as 1024x512"),
        ((64, 32), (512, 2048), False, "such as 512x256"),
        ((1000, 1012), (100, 100), False, "such as 99x100"),  # as high as 100x101 would be too high
        ((100, 100), (1000, 1009), False, (127, 129)),
        ((100000, 1), None, False, (40477, 1)),
    ],
)
def test_the_size_of_a_first_run(film, photo, fixed, size):
    stored = photo and SimpleNamespace(size=photo, path="a.png")
    if isinstance(size, str):
        with pytest.raises(ConfigError, match=f"with another aspect ratio; crop it to .*{size}"):
            choose_size(film, stored, fixed)
    else:
        assert choose_size(film, stored, fixed) == size


def test_an_advised_crop_is_smaller_than_the_photograph_and_is_accepted():
    shapes = [(81, 80), (2, 3), (3, 1), (1, 3), (1000, 7), (30, 30), (4, 10), (33, 100), (10, 1), (640, 480)]
    for film, photo in itertools.product(shapes, shapes):
        try:
            choose_size(film, SimpleNamespace(size=photo, path="a.png"))
        except ConfigError as error:
            width, height = map(int, re.search(r"such as (\d+)x(\d+)", str(error)).groups())
            assert 1 <= width * height < photo[0] * photo[1], (film, photo)
            assert width <= photo[0], (film, photo)
            assert height <= photo[1], (film, photo)
            choose_size(film, SimpleNamespace(size=(width, height), path="a.png"))
    assert choose_size((81, 80), SimpleNamespace(size=(30, 30), path="a.png")) == (30, 30)


@pytest.mark.parametrize(
    ("share", "words"), [(0.0049, "not seen itself"), (0.0051, "1 % of the picture"), (1.0, "100 % of the picture")]
)
def test_a_comment_states_the_share_of_the_picture(share: float, words: str) -> None:
    info = SimpleNamespace(key="a.b", value=None, shape=(), remark="a remark")
    assert _note(SimpleNamespace(key="a.b", info=info, share=share)) == f"{words}, a remark"
    explained = _note(SimpleNamespace(key="a.b", info=info, share=share), {"a.b": 0.236})
    assert explained == f"{words}, explains 24 % of the misfit, a remark"


@pytest.mark.parametrize(
    ("shape", "value", "words"),
    [
        ((4, 8, 3), Value(None, 0.5, 0.125, 0.75), ["8x4 texels", "0.125 to 0.75"]),
        ((3,), Value([0.12345, 1, 2], 0, 0, 0), ["now 0.123 1 2"]),
        ((7,), Value(None, 0.5, 0.125, 0.75), ["0.125 to 0.75"]),
    ],
)
def test_a_comment_states_the_value(shape: tuple[int, ...], value: Value, words: list[str]) -> None:
    info = SimpleNamespace(key="a.b", value=value, shape=shape, remark=None)
    assert _note(SimpleNamespace(key="a.b", info=info, share=1.0)) == ", ".join(["100 % of the picture", *words])


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ((3,), None),
        ((TEXELS, TEXELS, 3), None),
        ((TEXELS // 2, TEXELS + 1, 3), (TEXELS, TEXELS // 2)),
        ((4 * TEXELS, TEXELS, 1), (TEXELS // 4, TEXELS)),
        ((1, 4 * TEXELS, 3), (TEXELS, 3)),
    ],
)
def test_a_large_texture_is_recovered_at_fewer_texels(shape: tuple[int, ...], size: tuple[int, int] | None) -> None:
    assert _resolution(SimpleNamespace(shape=shape)) == size


@pytest.mark.parametrize(
    ("key", "low", "high", "bounds"),
    [
        ("wall.reflectance.data", 0.0, 1.0, "[0, 1]"),
        ("wall.reflectance.data", 0.0, 1.01, None),
        ("wall.reflectance.data", -0.01, 1.0, None),
        ("mesh.vertex_color", 0.5, 0.5, "[0, 1]"),
        ("metal.alpha_u", 0.02, 0.3, "[0.02, 1]"),
        ("metal.alpha.value", 0.01, 0.01, None),
        ("metal.eta.value", 0.1, 10, "[0, 10]"),
        ("glass.eta", 1.5, 1.5, "[1.01, 3]"),
        ("glass.Vd", 59, 59, "[10, 100]"),
        ("lamp.emitter.radiance.value", 0, 1e6, "[0, .inf]"),
        ("sky.scale", 3, 3, "[0, .inf]"),
        ("sky.turbidity", 1, 10, "[1, 10]"),
        ("glass.B1", 1, 1, "[0.5, 2]"),
        ("glass.C1", 0.006, 0.006, "[0, 0.08]"),
        ("glass.C3", 100, 100, "[50, 200]"),
        ("wall.normal", 0, 1, None),
    ],
)
def test_usual_bounds(key: str, low: float, high: float, bounds: str | None) -> None:
    info: Any = SimpleNamespace(key=key, value=Value(None, low, low, high))
    assert usual_bounds(info) == bounds
    if key == "wall.reflectance.data":
        assert usual_bounds(SimpleNamespace(key=key, value=None)) == "[0, 1]"


@pytest.mark.parametrize(
    ("bounds", "resolution", "text"),
    [
        (None, None, "{key: a.b}"),
        ("[0, 1]", None, "{key: a.b, bounds: [0, 1]}"),
        ("[0, 1]", (32, 16), "{key: a.b, bounds: [0, 1], resolution: [32, 16]}"),
    ],
)
def test_an_entry_of_a_parameter(bounds: str | None, resolution: tuple[int, int] | None, text: str) -> None:
    assert _entry(SimpleNamespace(key="a.b", bounds=bounds, resolution=resolution)) == text
