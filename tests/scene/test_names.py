"""Lasting names: an object without an id goes by its kind and number in the file, in every load alike."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from cli.calling import reslrb

import reslrb_cli
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.load import load_scene

pytestmark = pytest.mark.usefixtures("llvm")
SENSOR = '<sensor type="perspective"><film type="hdrfilm"/></sensor>'
LAMP = '<shape type="sphere"><emitter type="area"><rgb name="radiance" value="$power"/></emitter></shape>'
#: Seven kinds of objects, most of them without an id, and several of a kind.
HOUSE = f"""<scene version="3.0.0"><default name="power" value="3"/>
{SENSOR}
<sensor type="thinlens"><float name="aperture_radius" value="0.1"/><film type="hdrfilm"/></sensor>
<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>
<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"/></bsdf>
<texture type="checkerboard"/>
{LAMP}
{LAMP.replace("<shape", '<shape id="middle"')}
{LAMP}
<shape type="rectangle"><bsdf type="twosided"><bsdf type="plastic"/></bsdf></shape>
<shape type="cube"/>
<emitter type="point"/>
<emitter type="point"/>
</scene>"""


def write(folder: Path, text: str, name: str = "scene.xml") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def keys(file: Path, **options: object) -> list[str]:
    """The keys of a scene, in their order."""
    import mitsuba as mi

    return list(mi.traverse(load_scene(file, options)).properties)


def names(found: list[str]) -> list[str]:
    """The objects that they begin with, in their order."""
    return list(dict.fromkeys(key.partition(".")[0] for key in found if "." in key))


def lit(objects: str) -> str:
    """A scene of `objects` that a lamp lights and a camera sees."""
    return f'<scene version="3.0.0">\n{SENSOR}\n<emitter type="constant" id="sky"/>\n{objects}\n</scene>'


def test_names_say_kind_and_number(tmp_path):
    found = keys(write(tmp_path, HOUSE))
    assert names(found) == [
        *("Perspective_1", "Thinlens_1", "Twosided_1", "Diffuse_2", "Checkerboard_2"),
        *("Sphere_1", "middle", "Sphere_3", "Rectangle_1", "Cube_1", "Point_1", "Point_2"),
    ]
    # below them Mitsuba's own names stay, which say the role that an object plays
    assert {
        "Sphere_3.emitter.radiance.value",
        "Twosided_1.brdf_0.reflectance.value",
        "Perspective_1.film.size",
        "Rectangle_1.bsdf.brdf_0.diffuse_reflectance.value",
        "Diffuse_2.reflectance.color0.value",
    } <= set(found)


def test_a_script_has_the_names_of_the_command_line(tmp_path):
    """Of an older version's file, too, which `mi.load_file` refuses, with textures of 8 bits that are asked for."""
    import mitsuba as mi
    import numpy as np

    mi.Bitmap(np.full((4, 4, 3), 99, np.uint8)).write(str(tmp_path / "8bit.png"))
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="8bit.png"/></texture>'
    house = HOUSE.replace('<shape type="cube"/>', f'<shape type="cube"><bsdf type="diffuse">{texture}</bsdf></shape>')
    file = write(tmp_path, house.replace('type="hdrfilm"', 'type="ldrfilm"'))
    listed = json.loads(reslrb("inspect", str(file), "--json").stdout)["parameters"]
    scene = reslrb_cli.load_scene(file, ["Cube_1.*"], power=7)
    params = mi.traverse(scene)
    assert [entry["key"] for entry in listed] == list(params.properties)
    assert float(params["Sphere_3.emitter.radiance.value"][0][0]) == 7
    assert type(params["Cube_1.bsdf.reflectance.data"]).__name__ == "TensorXf"
    plain = mi.traverse(reslrb_cli.load_scene(str(file)))
    assert float(plain["Sphere_3.emitter.radiance.value"][0][0]) == 3
    assert type(plain["Cube_1.bsdf.reflectance.data"]).__name__ == "TensorXu8"
    one = mi.traverse(reslrb_cli.load_scene(file, "Cube_1.bsdf.reflectance.data"))
    assert type(one["Cube_1.bsdf.reflectance.data"]).__name__ == "TensorXf"
    with pytest.raises(ConfigError, match=r"scene.xml: \$power2: is set in scene.options, but the scene file does not"):
        reslrb_cli.load_scene(file, power2=3)


def test_names_are_the_same_in_every_load_and_process(tmp_path):
    file = write(tmp_path, HOUSE.replace("</scene>", LAMP * 60 + "</scene>"))
    here = keys(file)
    assert keys(file, power=7) == here
    script = (
        "import json, sys, reslrb_cli\n"
        "from pathlib import Path\n"
        "from reslrb_cli.backend.variant import set_variant\n"
        "set_variant('llvm_ad_rgb')\n"
        "import mitsuba as mi\n"
        "from reslrb_cli.scene.load import load_scene\n"
        "print(json.dumps(list(mi.traverse(load_scene(Path(sys.argv[1]))).properties)))"
    )
    command = [sys.executable, "-c", script, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == here


def test_an_id_renames_no_other_object(tmp_path):
    named = HOUSE.replace('<shape type="sphere">', '<shape type="sphere" id="first">', 1)
    before, after = keys(write(tmp_path, HOUSE)), keys(write(tmp_path, named))
    assert [key.replace("Sphere_1.", "first.") for key in before] == after


def test_a_name_that_is_taken_is_not_given_again(tmp_path):
    shapes = '<shape type="sphere" id="Sphere_2"/><shape type="sphere"/><shape type="sphere" id="Sphere_2_2"/>'
    assert names(keys(write(tmp_path, lit(shapes))))[2:] == ["Sphere_2", "Sphere_2_3", "Sphere_2_2"]


def test_numbers_go_on_through_includes(tmp_path):
    (tmp_path / "parts").mkdir()
    write(tmp_path / "parts", f'<scene version="3.0.0">{LAMP}<include filename="more.xml"/>{LAMP}</scene>', "lamps.xml")
    write(tmp_path / "parts", '<scene version="3.0.0"><shape type="cube"/></scene>', "more.xml")
    write(tmp_path, '<bsdf version="3.0.0" type="plastic"/>', "bsdf.xml")
    text = lit(
        '<default name="power" value="1"/><shape type="sphere"/><include filename="parts/lamps.xml"/>'
        '<shape type="sphere"><include filename="bsdf.xml"/></shape><include filename="bsdf.xml"/>'
    )
    found = keys(write(tmp_path, text))
    assert names(found)[2:] == ["Sphere_1", "Sphere_2", "Cube_1", "Sphere_3", "Sphere_4", "Plastic_2"]
    assert "Sphere_4.bsdf.diffuse_reflectance.value" in found


def test_shapes_in_groups_keep_mitsubas_names(tmp_path):
    group = '<shape type="shapegroup" id="g"><shape type="sphere"/><shape type="cube"/></shape>'
    found = keys(write(tmp_path, lit(group + '<shape type="instance"><ref id="g"/></shape><shape type="sphere"/>')))
    assert {"g.shape.to_world", "g.shape_1.faces", "Instance_1.to_world", "Sphere_2.to_world"} <= set(found)


def test_ids_that_mitsuba_takes_for_none(tmp_path, caplog):
    # as `mi.parser.write_file` writes them
    shapes = (
        '<bsdf type="diffuse" id="_unnamed_3"/><shape type="sphere" id="_unnamed_4"><ref id="_unnamed_3"/></shape>'
        '<shape type="sphere" id=""><float name="radius" value="2"/></shape>'
    )
    assert names(keys(write(tmp_path, lit(shapes))))[2:] == ["Diffuse_1", "Sphere_1", "Sphere_2"]
    assert not caplog.records


def test_odd_ids_stay_where_they_can(tmp_path, caplog):
    odd = ["a.b", "two words", "wall [1]*", "lampe-é", "../x"]
    balls = [(name, f'<float name="radius" value="{k + 1}"/>') for k, name in enumerate(odd)]  # none where another is
    shapes = "".join(f'<shape type="sphere" id="{name}">{radius}</shape>' for name, radius in balls)
    found = keys(write(tmp_path, lit(shapes)))
    assert {f"{name}.to_world" for name in odd} <= set(found)
    assert len(set(found)) == len(found)
    assert not caplog.records


@pytest.mark.parametrize("own", ["a&#10;b", "&#x200b;", "x" * 200])
def test_an_id_that_no_key_can_hold_is_replaced(tmp_path, caplog, own):
    shapes = f'<bsdf type="diffuse" id="{own}"/><shape type="sphere"><ref id="{own}"/></shape>'
    file = write(tmp_path, lit(shapes))
    assert "Diffuse_1.reflectance.value" in keys(file)
    [record] = caplog.records
    assert record.getMessage().startswith(f"{file}:4: id `")
    assert record.getMessage().endswith("cannot stand in a key: named Diffuse_1")
    assert record.getMessage().isprintable()
    assert len(record.getMessage()) < 200 + len(str(file))


def test_an_id_of_two_objects_is_kept_by_the_first(tmp_path, caplog):
    file = write(tmp_path, lit('<shape type="sphere" id="ball"/>\n<shape type="cube" id="ball"/>'))
    assert names(keys(file))[2:] == ["ball", "Cube_1"]
    [record] = caplog.records
    assert record.getMessage() == f"{file}:5: id `ball` is that of {file}:4, too: named Cube_1"


def test_a_reference_to_two_objects_is_refused(tmp_path):
    bsdf = '<bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.1"/></bsdf>\n'
    use = '<shape type="sphere"><ref id="paint"/></shape>'
    file = write(tmp_path, lit(bsdf + bsdf.replace("0.1", "0.2") + use))
    with pytest.raises(ConfigError, match=f"refers to `paint`, the id of two objects .{file}:4 and {file}:5"):
        load_scene(file)
    assert "paint.reflectance.value" in keys(write(tmp_path, lit(bsdf + bsdf + use)))  # they say the same
