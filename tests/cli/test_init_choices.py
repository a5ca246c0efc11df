"""`init` where there is something to choose: among sensors, and values of what a scene file leaves open."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli.calling import reslrb, settings
from cli.photographs import write_noise
from click.testing import Result

from reslrb_cli.config.loader import load
from reslrb_cli.scene.images import decode_srgb, image_size, orientation_of

pytestmark = pytest.mark.usefixtures("llvm")

#: Two sensors, the second of which sees the ball alone, on a film that the file leaves open.
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


def test_of_several_sensors_one_is_named(choices: Path) -> None:
    first = reslrb("init", "hall.xml")
    assert "sensor 0 (floor); --sensor takes another: 1 (ball)" in first.output
    config = load(choices / "hall.yaml")
    assert (config.scene.sensors, config.parameters[0].keys) == ([0], ["Rectangle_1.bsdf.reflectance.value"])
    other = reslrb("init", "hall.xml", "--sensor", 1, "--target", write_noise(choices / "photo.png", 12, 8), "--force")
    assert "sensor 1 (ball); --sensor takes another: 0 (floor)" in other.output
    config = load(choices / "hall.yaml")
    assert (config.scene.sensors, config.scene.size) == ([1], None)  # that one's film is as large as the photograph
    assert [spec.keys for spec in config.parameters] == [["Sphere_1.bsdf.reflectance.value"]]
    # A ball of one colour under a light of one colour: its exposure cannot be told from it.
    few = settings("run.iterations=2", "integrator.estimator=stack", "target.exposure=1")
    done = reslrb("optimize", "hall.yaml", *few)
    assert done.exit_code == 0, done.output
    missing = reslrb("init", "hall.xml", "--sensor", 2, "--force")
    assert missing.exit_code == 2
    assert "--sensor: is 2; the scene has 0 (floor), 1 (ball)" in missing.output


def test_a_photograph_is_taken_as_a_person_sees_it(choices: Path) -> None:
    """A phone that was held upright writes lying pixels, and EXIF beside them."""
    from PIL import Image, ImageOps  # comes with matplotlib

    def photograph(width: int, height: int, orientation: int) -> None:
        pixels = np.random.default_rng(4).integers(40, 200, (height, width, 3), dtype=np.uint8)
        image = Image.fromarray(pixels)
        exif = image.getexif()
        exif[0x0112] = orientation
        image.save(choices / "photo.jpg", exif=exif)

    def init() -> Result:
        return reslrb("init", "hall.xml", "--sensor", 1, "--target", "photo.jpg", "--force")

    told = "photo.jpg: turned by 90 degrees clockwise, as its EXIF orientation says"
    photograph(8, 12, 6)  # the film is 12x8
    made = init()
    assert made.exit_code == 0, made.output
    assert told in made.output
    config = load(choices / "hall.yaml")
    assert (config.scene.size, config.target.file) == (None, [choices / "photo.jpg"])
    few = settings("run.iterations=1", "integrator.estimator=stack", "target.exposure=1", "target.mask=none")
    done = reslrb("optimize", "hall.yaml", *few)
    assert done.exit_code == 0, done.output
    assert told in done.output
    target = np.array(mi.Bitmap(str(choices / "runs/hall/images/target.exr")))
    seen = np.array(ImageOps.exif_transpose(Image.open(choices / "photo.jpg"))).astype(np.float32) / 255
    assert np.allclose(target, decode_srgb(seen), atol=1e-5)
    photograph(600, 900, 8)  # copied, upright and smaller
    assert init().exit_code == 0
    [copy] = load(choices / "hall.yaml").target.file or []
    assert (orientation_of(copy), image_size(copy)[0] > image_size(copy)[1]) == (1, True)
    photograph(12, 8, 5)
    refused = init()
    assert refused.exit_code == 2
    assert "is 8x12 pixels, and the scene's film 12x8" in refused.output
    assert "cut it to what the film sees, such as 8x5" in refused.output


def test_a_scene_that_hides_its_lights_keeps_hiding_them(choices: Path) -> None:
    scene = choices / "hall.xml"
    assert reslrb("init", "hall.xml").exit_code == 0
    assert "hide_emitters" not in (choices / "hall.yaml").read_text()
    for name, value in (("hide_emitters", "true"), ("hideEmitters", "true"), ("hide_emitters", "false")):
        own = f'<integrator type="path"><boolean name="{name}" value="{value}"/></integrator>'
        scene.write_text(CHOICES.replace("<sensor", own + "<sensor", 1))
        assert reslrb("init", "hall.xml", "--force").exit_code == 0
        assert load(choices / "hall.yaml").integrator.hide_emitters == (value == "true")


def test_what_a_scene_leaves_open_is_named_and_can_be_set(choices: Path) -> None:
    made = reslrb("init", "hall.xml")
    assert "at 16x16 pixels" in made.output
    assert '  # options: {side: 16, note: "a \\"b\\""}  # ' in (choices / "hall.yaml").read_text()
    made = reslrb("init", "hall.xml", "--set", "scene.options.side=20", "--force")
    assert "at 20x20 pixels" in made.output
    assert load(choices / "hall.yaml").scene.options == {"side": 20}
    for setting, message in (("scene.options.width=3", "$width: is set in scene.options, but the scene file does not"),
                             ("run.spp=4", "--set run.spp=4: init takes scene.options.NAME=VALUE alone"),
                             ("scene.options.side=[3]", "scene.options.side")):  # fmt: skip
        refused = reslrb("init", "hall.xml", "--set", setting, "--force")
        assert refused.exit_code == 2
        assert message in refused.output
    (choices / "hall.xml").write_text(CHOICES.replace('<default name="side" value="16"/>', ""))
    refused = reslrb("init", "hall.xml", "--force")
    assert refused.exit_code == 2
    assert "set scene.options.side" in refused.output
    assert reslrb("init", "hall.xml", "--force", "--set", "scene.options.side=8").exit_code == 0


#: A lamp whose rays Mitsuba cannot sample, behind glass; paths from the camera find its light.
CHECKED = """<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>
<integer name="height" value="8"/></film>
<transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
<shape type="rectangle"><bsdf type="diffuse"/></shape>
<shape type="rectangle"><transform name="to_world"><translate x="9" z="1"/></transform>
<bsdf type="thindielectric"/></shape>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><translate z="5"/></transform>
<emitter type="area" id="lamp"><texture type="checkerboard" name="radiance"/></emitter></shape></scene>"""


def test_light_that_cannot_be_sampled_is_left_to_camera_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shop.xml").write_text(CHECKED)
    monkeypatch.chdir(tmp_path)
    assert reslrb("inspect", "shop.xml").exit_code == 0
    assert reslrb("init", "shop.xml", "--target", write_noise(tmp_path / "photo.png", 8, 8)).exit_code == 0
    assert load(tmp_path / "shop.yaml").integrator.type == "prb"
    text = (tmp_path / "shop.yaml").read_text()
    assert "# by paths from the sensor, since light paths cannot render this: Mitsuba cannot sample the rays of" in text
    assert "integrator.type: prb" not in text
    refused = reslrb("optimize", "shop.yaml", *settings("integrator.type=reslrb"))
    assert refused.exit_code == 2
    assert "scene.file: Mitsuba cannot sample the rays of emitter lamp" in refused.output


def test_it_says_why_paths_from_the_sensor_were_chosen(choices: Path) -> None:
    """In the file, in comments that are left whole, and where it is called."""
    (choices / "hall.xml").write_text(CHOICES.replace('"perspective" id="floor"', '"orthographic" id="the # floor"'))
    made = reslrb("init", "hall.xml")
    reason = "sensor the # floor is a OrthographicCamera; light paths connect to `perspective` and `thinlens` sensors"
    assert f"integrator.type: prb, since light paths cannot render this: {reason}" in made.output
    lines = (choices / "hall.yaml").read_text().splitlines()
    place = lines.index("integrator:")
    comment = [line.strip(" #") for line in lines[place + 1 : lines.index("  type: prb")]]
    assert " ".join(comment) == f"by paths from the sensor, since light paths cannot render this: {reason}"
    assert 1 <= len(comment) <= 2
    assert load(choices / "hall.yaml").integrator.type == "prb"
    made = reslrb("init", "hall.xml", "--sensor", 1, "--force")
    assert "since" not in made.output
    assert "since" not in (choices / "hall.yaml").read_text()
