"""`init`: a configuration that `optimize` takes, from a scene alone and from a scene and a photograph."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.calling import reslrb
from cli.photographs import write_noise
from click.testing import Result

from reslrb_cli.cli.first_config import PIXELS
from reslrb_cli.config import Config, TargetConfig, load
from reslrb_cli.optimization.problem import assemble_scene
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.scene import load_scene
from reslrb_cli.scene.proposal import propose
from reslrb_cli.scene.target import decode_srgb

pytestmark = pytest.mark.usefixtures("llvm")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene in a folder `room` of the working directory."""
    (tmp_path / "room").mkdir()
    tiny.write_experiment(tmp_path / "room")
    (tmp_path / "room/tiny.yaml").unlink()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def of_photograph(folder: Path, width: int, height: int) -> tuple[Config, Result]:
    result = reslrb("init", "room/scene.xml", "--target", write_noise(folder / "photo.png", width, height))
    assert result.exit_code == 0, result.output
    return load(folder / "room.yaml"), result


def test_a_scene_alone_gets_a_configuration_that_lacks_its_photograph_only(folder: Path) -> None:
    result = reslrb("init", "room/scene.xml")
    assert result.exit_code == 0, result.output
    assert "room.yaml: 1 of 3 parameters, at 8x8 pixels" in result.output
    config = load(folder / "room.yaml")
    assert [spec.keys for spec in config.parameters] == [[tiny.KEY]]
    assert config.parameters[0].bounds == (0, 1)
    assert (config.loss.type, config.optimizer.schedule, config.integrator.max_depth) == ("relative_l2", "cosine", 8)
    assert "# - {key: lamp.emitter.radiance.value, bounds: [0, .inf]}" in (folder / "room.yaml").read_text()
    missing = reslrb("optimize", "room.yaml")
    assert missing.exit_code == 2
    assert "target.file: no such file" in missing.output
    write_noise(folder / "photo.png", 8, 8)
    done = reslrb("optimize", "room.yaml", "--set", "run.iterations=2", "--set", "integrator.estimator=stack")
    assert done.exit_code == 0, done.output
    assert read_manifest(folder / "runs/room")["status"] == "finished"


def test_what_is_commented_out_is_accepted_once_it_is_not(folder: Path) -> None:
    assert reslrb("init", "room/scene.xml").exit_code == 0
    text = (folder / "room.yaml").read_text().replace("  # - {", "  - {")
    (folder / "room.yaml").write_text(text)
    values = assemble_scene(load(folder / "room.yaml")).values()
    assert set(values) == {tiny.KEY, "lamp.emitter.radiance.value", "lamp.bsdf.reflectance.value"}


def test_nothing_is_replaced_unless_that_is_asked_for(folder: Path) -> None:
    (folder / "room.yaml").write_text("mine")
    refused = reslrb("init", "room/scene.xml")
    assert refused.exit_code == 2
    assert "room.yaml: exists; --force replaces it" in refused.output
    assert (folder / "room.yaml").read_text() == "mine"
    assert reslrb("init", "room/scene.xml", "--force").exit_code == 0
    copy = f"photo-{int(PIXELS**0.5)}x{int(PIXELS**0.5)}.png"
    (folder / copy).write_text("mine, too")
    target = write_noise(folder / "photo.png", 300, 300)
    refused = reslrb("init", "room/scene.xml", "-o", "other.yaml", "--target", target)
    assert refused.exit_code == 2
    assert f"{copy}: exists" in refused.output
    assert (folder / copy).read_text() == "mine, too"
    assert not (folder / "other.yaml").exists()


def test_a_photograph_says_how_large_the_film_is(folder: Path) -> None:
    config, _ = of_photograph(folder, 12, 12)
    assert config.scene.size == (12, 12)
    assert config.target.file == [folder / "photo.png"]
    problem = assemble_scene(config)
    assert tuple(problem.scene.sensors()[0].film().size()) == (12, 12)


def test_a_large_photograph_is_copied_at_a_size_that_runs_in_minutes(folder: Path) -> None:
    config, result = of_photograph(folder, 600, 597)  # as near as a camera comes to the film's ratio
    width, height = config.scene.size or (0, 0)
    assert 0.9 * PIXELS < width * height <= 1.02 * PIXELS
    assert f"photo-{width}x{height}.png" in result.output
    assert config.target.file == [folder / f"photo-{width}x{height}.png"]
    assert tuple(mi.Bitmap(str(config.target.file[0])).size()) == (width, height)


def test_exposure_is_recovered_where_the_photograph_clips(folder: Path) -> None:
    of_photograph(folder, 8, 8)
    known = "exposure" in TargetConfig.model_fields
    assert ("exposure: auto" in (folder / "room.yaml").read_text()) is known
    image = np.full((8, 8, 3), 0.5, np.float32)
    mi.Bitmap(image).write(str(folder / "linear.exr"))
    assert reslrb("init", "room/scene.xml", "--target", "linear.exr", "--force").exit_code == 0
    assert "exposure" not in (folder / "room.yaml").read_text()


def test_a_texture_of_8_bits_is_offered_recovered_and_exported(folder: Path) -> None:
    """As most textures are: read as floats while loading, and the scene's file stays as it is."""
    pixels = np.random.default_rng(6).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    mi.Bitmap(pixels).write(str(folder / "room/poster.png"))
    scene = folder / "room/scene.xml"
    text = tiny.SCENE.replace("poster.exr", "poster.png").replace('<boolean name="raw" value="true"/>', "")
    scene.write_text(text.replace('<string name="format" value="variant"/>', ""))
    before = scene.read_bytes()
    made = reslrb("init", "room/scene.xml")
    assert made.exit_code == 0, made.output
    [line] = [line for line in (folder / "room.yaml").read_text().splitlines() if f"- {{key: {tiny.KEY}" in line]
    assert "4x4 texels" in line
    assert line.endswith("8 bits, read as floats if recovered")
    sets = ["target={render: {spp: 16}}", "run.iterations=2", "integrator.estimator=stack"]
    done = reslrb("optimize", "room.yaml", *(text for each in sets for text in ("--set", each)))
    assert done.exit_code == 0, done.output
    linear = decode_srgb(pixels.astype(np.float32) / 255)
    true = np.array(mi.Bitmap(str(folder / f"runs/room/parameters/true/{tiny.KEY}.exr")))
    assert np.allclose(true, linear, atol=1e-6)
    written = reslrb("export", "runs/room", "-o", "out")
    assert written.exit_code == 0, written.output
    found = mi.traverse(mi.load_file(str(folder / "out/scene.xml"), optimize=False))[tiny.KEY]
    recovered = np.array(mi.Bitmap(str(folder / f"runs/room/parameters/{tiny.KEY}.exr")))
    assert np.array_equal(np.array(found), recovered)
    assert not np.allclose(recovered, linear, atol=1e-3), "two iterations have moved nothing"
    assert scene.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("room/scene.xml", "--target", "wide.png"), "is 16x8 pixels, and the scene's film 8x8, of another ratio"),
        (("room/scene.xml", "--target", "wide.png"), "such as 8x8"),
        (("room/scene.xml", "--target", "none.png"), "none.png: no such file"),
        (("room/scene.xml", "--target", "room/scene.xml"), "is not an image that can be read"),
        (("room/none.xml",), "none.xml: no such file"),
        (("room/scene.xml", "-o", "config.txt"), "must end in .yaml"),
        (("room/scene.xml", "-o", "nowhere/config.yaml"), "cannot write"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(folder: Path, arguments: tuple[str, ...], message: str) -> None:
    write_noise(folder / "wide.png", 16, 8)
    result = reslrb("init", *arguments)
    assert result.exit_code == 2
    assert message in result.output
    assert {path.name for path in folder.iterdir()} == {"room", "wide.png"}


#: A floor that fills most of the picture, with a texture of its own; a ball; what is not seen; what has no effect.
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


def test_what_is_large_in_view_comes_first(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(VIEW)
    found = propose(load_scene(tmp_path / "scene.xml"), 0)
    tiles = [f"Rectangle_1.bsdf.brdf_0.reflectance.color{k}.value" for k in range(2)]
    assert [item.info.key for item in found[:2]] == tiles
    first = [item.info.key for item in found if item.first]
    assert first == [*tiles, "Sphere_2.bsdf.brdf_0.base_color.value"]  # no lamp's black, roughness, or mirror
    shares = {item.info.key: item.share for item in found}
    assert shares["Cube_1.bsdf.specular_reflectance.value"] > 0.02
    assert shares["hidden.reflectance.value"] == 0
    assert 0.02 < shares["Sphere_2.bsdf.brdf_0.roughness.value"] < shares[tiles[0]] < 1
    assert not any("clearcoat.value" in key for key in shares), "it is 0, by which Mitsuba leaves it out for good"
