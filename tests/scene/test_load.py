"""Scene files that load, the names of their objects, and one line with the location for a file that does not load."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import reslrb
from turns import a_few

import reslrb_cli
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.catalog import MARGIN, list_parameters
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.xml import build

pytestmark = pytest.mark.usefixtures("llvm")


# Scene files: which files load, and the one located line for each file that does not.

LIT_SPHERE = (
    '<scene version="3.0.0">\n<sensor type="perspective"/>\n<emitter type="constant"/>\n'
    '<shape type="sphere" id="ball"><float name="radius" value="$radius"/></shape>\n</scene>'
)


def load(folder: Path, text: str, **options: object):
    file = folder / "scene.xml"
    file.write_text(text)
    return load_scene(file, options)


def test_options_are_passed_on(tmp_path):
    scene = load(tmp_path, LIT_SPHERE, radius=2.5)
    assert mi.traverse(scene)["ball.to_world"].matrix.numpy()[0, 0, 0] == pytest.approx(2.5)


def test_old_versions_load(tmp_path):
    text = LIT_SPHERE.replace("3.0.0", "0.5.0").replace(
        '<sensor type="perspective"/>',
        '<sensor type="perspective"><transform name="toWorld"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/>'
        "</transform></sensor>",
    )
    scene = load(tmp_path, text, radius=1)
    assert len(scene.shapes()) == 1


def test_files_are_found_beside_the_scene(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write(str(tmp_path / "sub" / "t.exr"))
    text = LIT_SPHERE.replace("</shape>", '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
                              '<string name="filename" value="t.exr"/></texture></bsdf></shape>')  # fmt: skip
    monkeypatch.chdir(tmp_path)
    load(tmp_path / "sub", text, radius=1)


@pytest.mark.parametrize(
    ("text", "options", "where", "what"),
    [
        ("<scene version='3.0.0'>\n<shape type='sphere'>\n</scene>", {}, ":3", "not valid XML"),
        ("", {}, ":1", "not valid XML"),
        (LIT_SPHERE, {}, ":4", "$radius: has no value and no default; set scene.options.radius"),
        (
            LIT_SPHERE,
            {"radius": 1, "height": 2},
            "",
            "$height: is set in scene.options, but the scene file does not use",
        ),
        (LIT_SPHERE, {"radius": "nan"}, ":4", "radius: value `nan` is not a number"),
        (LIT_SPHERE, {"radius": "wide"}, ":4", 'could not parse floating point value "wide"'),
        (LIT_SPHERE.replace("constant", "envmap"), {"radius": 1}, ":3", "filename"),
        (LIT_SPHERE.replace('<emitter type="constant"/>', ""), {"radius": 1}, "", "has no emitters"),
        (LIT_SPHERE.replace("sphere", "hair"), {"radius": 1}, ":4", "`bsplinecurve` draws strands"),
        ('<scene version="3.0.0"><emitter type="constant"/></scene>', {}, "", "is empty"),
        ('<scene version="3.0.0"/>', {}, "", "is empty"),
        ('<shape version="3.0.0" type="sphere"/>', {}, "", "single object"),
    ],
)
def test_errors_are_located(tmp_path, text, options, where, what):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, text, **options)
    line = str(error.value)
    assert line.startswith(f"{tmp_path / 'scene.xml'}{where}: ")
    assert what in line
    assert "\n" not in line
    assert ".cpp" not in line


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (None, "`mesh.obj`: no such file; searched in "),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "the mesh has no faces"),
    ],
)
def test_missing_meshes(tmp_path, text, what):
    if text is not None:
        (tmp_path / "mesh.obj").write_text(text)
    mesh = '<shape type="obj"><string name="filename" value="mesh.obj"/></shape>'
    with pytest.raises(ConfigError) as error:
        load(tmp_path, LIT_SPHERE.replace("</scene>", f"{mesh}</scene>"), radius=1)
    assert what in str(error.value)
    assert "scene.xml:" in str(error.value)


@pytest.mark.parametrize("kind", ["plastic", "roughplastic", "pplastic"])
def test_textures_without_a_mean_are_refused_with_a_remedy(tmp_path, kind):
    name = '<string name="name" value="vertex_color"/>'
    colour = f'<texture type="mesh_attribute" name="diffuse_reflectance">{name}</texture>'
    text = LIT_SPHERE.replace("/></shape>", f"/><bsdf type='{kind}'>{colour}</bsdf></shape>")
    with pytest.raises(ConfigError, match=r"needs the mean of each texture.*use a bitmap, or the bsdf `principled`"):
        load(tmp_path, text, radius="1")


def test_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        load_scene(tmp_path / "none.xml")


def test_folder(tmp_path):
    with pytest.raises(ConfigError, match="is a folder"):
        load_scene(tmp_path)


def test_no_sensor_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no sensor"):
        load(tmp_path, LIT_SPHERE.replace('<sensor type="perspective"/>', ""), radius=1)


ROOM = (
    '<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/>'
    '<shape type="cube"><transform name="to_world"><scale value="$scale"/><translate x="$x"/></transform></shape>'
    "</scene>"
)


@pytest.mark.parametrize(
    ("scale", "x", "advice"),
    [
        (1, 0, None),
        (1, 100, None),
        (1, 1000, "move it to the origin"),
        (1e4, 0, None),
        (1e-2, 0, None),
        (1e-4, 0, "scale it to about 1"),
    ],
)
def test_light_lost_by_ray_offsets_gives_a_warning(tmp_path, caplog, scale: float, x: float, advice: str | None):
    load(tmp_path, ROOM, scale=scale, x=x)
    if advice is None:
        assert not caplog.records
    else:
        [record] = caplog.records
        message = record.getMessage()
        assert message.startswith(f"{tmp_path}/scene.xml: the scene ")
        assert advice in message
        assert "\n" not in message


RAW = '<boolean name="raw" value="true"/>'
#: Options of a texture lookup, all of which must be kept.
LOOKED_UP = (
    '<string name="format" value="fp16"/><string name="filter_type" value="nearest"/>'
    '<string name="wrap_mode" value="mirror"/><transform name="to_uv"><scale x="2.5" y="1.5"/></transform>'
)
#: A wall and a sphere, each with a texture, and a lamp.
WALLS = """<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="16"/>
<integer name="height" value="16"/></film>
<transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
<emitter type="constant"/><shape type="rectangle" id="wall">{material}</shape>
<shape type="sphere" id="ball"><point name="center" x="1" y="1" z="0"/><bsdf type="diffuse">
<texture type="bitmap" name="reflectance"><string name="filename" value="other.png"/></texture></bsdf></shape>
</scene>"""
DIFFUSE = '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{}</texture></bsdf>'
#: Materials with a texture, and the name of the texture's file.
TEXTURES = {
    "RGB": (DIFFUSE, "a.png"),
    "alpha": (DIFFUSE, "rgba.png"),
    "grey": (DIFFUSE, "y.png"),
    "raw": (DIFFUSE.replace("{}", "{}" + RAW), "a.png"),
    "JPEG": (DIFFUSE, "a.jpg"),
    "16 bits": (DIFFUSE, "a16.png"),
    "half floats": (DIFFUSE, "half.exr"),
    "looked up": (DIFFUSE.replace("{}", "{}" + LOOKED_UP), "a.png"),
    "opacity": (
        '<bsdf type="mask"><texture type="bitmap" name="opacity">{}' + RAW + '</texture><bsdf type="diffuse"/></bsdf>',
        "y.png",
    ),
    "roughness": (
        '<bsdf type="roughconductor"><texture type="bitmap" name="alpha">{}' + RAW + "</texture></bsdf>",
        "y.png",
    ),
    "relief": (
        '<bsdf type="bumpmap"><texture type="bitmap">{}' + RAW + '</texture><bsdf type="diffuse"/></bsdf>',
        "y.png",
    ),
    "radiance": (
        '<bsdf type="diffuse"/><emitter type="area"><texture type="bitmap" name="radiance">{}</texture></emitter>',
        "a.png",
    ),
}


@pytest.fixture
def walls(tmp_path, request):
    """Scene file whose wall has the texture under test. Its ball has another texture of 8 bits."""
    random = np.random.default_rng(0)
    for name, channels, kind in (("a.png", 3, np.uint8), ("rgba.png", 4, np.uint8), ("y.png", 1, np.uint8),
                                 ("a.jpg", 3, np.uint8), ("a16.png", 3, np.uint16)):  # fmt: skip
        pixels = random.integers(0, np.iinfo(kind).max + 1, (6, 5, channels), dtype=kind)
        pixels[0, 0] = np.iinfo(kind).max
        mi.Bitmap(pixels).write(str(tmp_path / name))
    mi.Bitmap(random.uniform(0, 1, (6, 5, 3)).astype(np.float16)).write(str(tmp_path / "half.exr"))
    mi.Bitmap(random.integers(0, 256, (64, 64, 3), dtype=np.uint8)).write(str(tmp_path / "other.png"))
    material, name = TEXTURES[request.param]
    text = WALLS.format(material=material.format(f'<string name="filename" value="{name}"/>'))
    (tmp_path / "scene.xml").write_text(text)
    return tmp_path / "scene.xml"


@pytest.mark.parametrize(
    "walls", a_few(TEXTURES, ["alpha", "grey", "raw", "half floats", "looked up", "opacity", "radiance"]), indirect=True
)
def test_a_selected_8_bit_texture_has_the_values_of_mitsuba_as_floats(walls):
    own = load_scene(walls)
    before = {info.key: info for info in list_parameters(mi.traverse(own), values=True) if info.bits is not None}
    [key, other] = sorted(before, key=lambda key: key.startswith("ball"))
    assert (before[key].obstacle, before[other].obstacle) == (None, None)
    scene = load_scene(walls, keys=["wall.*"])
    params = mi.traverse(scene)
    [after] = [info for info in list_parameters(params, values=True) if info.key == key]
    assert (after.bits, after.type, after.shape) == (None, "TensorXf", before[key].shape)
    assert int(params.flags(key)) & int(mi.ParamFlags.NonDifferentiable) == 0
    assert type(params[other]).__name__ == "TensorXu8", "what is not selected takes four times the memory"
    exact = before[key].bits == 8
    assert np.allclose(_numbers(after.value), _numbers(before[key].value), atol=1e-6 if exact else 1e-3)
    text = walls.read_text().replace('<string name="format" value="fp16"/>', "")
    file = text.index("<string name=", text.index('"wall"'))
    walls.with_name("variant.xml").write_text(text[:file] + '<string name="format" value="variant"/>' + text[file:])
    theirs = mi.traverse(mi.load_file(str(walls.with_name("variant.xml")), optimize=False))
    assert np.array_equal(np.array(theirs[key]), np.array(params[key]))
    images = [np.array(mi.render(each, integrator=mi.load_dict({"type": "path"}), spp=4, seed=0))
              for each in (own, scene)]  # fmt: skip
    assert np.allclose(*images, atol=1e-5 if exact else 2e-3)
    selection = select_parameters(scene, [ParameterSpec(key=key, bounds=(0.0, 1.0))], "c.yaml")
    assert np.allclose(selection.array(key), np.array(theirs[key]), atol=MARGIN)  # an opacity of 1 starts inside


def _numbers(value):
    return value.mean, value.low, value.high


@pytest.mark.parametrize("walls", ["RGB"], indirect=True)
def test_nothing_is_rebuilt_without_selected_8_bit_textures(walls):
    types = [type(mi.traverse(load_scene(walls, keys=keys))["ball.bsdf.reflectance.data"]).__name__
             for keys in ([], ["Constant_1.*"], ["wall.bsdf.reflectance.data"], ["*.data"])]  # fmt: skip
    assert types == ["TensorXu8"] * 3 + ["TensorXf"]
    with pytest.raises(ConfigError, match=r"`ball\.bsdf\.reflectance\.data` is stored with 8 bits"):
        select_parameters(load_scene(walls), [ParameterSpec(key="ball.bsdf.reflectance.data")], "c.yaml")


# Lasting names: an object without an id is named by its kind and its number in the file. The name is the same in every
# load.

SENSOR = '<sensor type="perspective"><film type="hdrfilm"/></sensor>'
LAMP = '<shape type="sphere"><emitter type="area"><rgb name="radiance" value="$power"/></emitter></shape>'
#: Seven kinds of objects. Most objects have no id, and several kinds occur more than once.
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
    """Return the keys of a scene in their order."""
    return list(mi.traverse(load_scene(file, options)).properties)


def names(found: list[str]) -> list[str]:
    """Return the objects with which the keys begin, in their order."""
    return list(dict.fromkeys(key.partition(".")[0] for key in found if "." in key))


def lit(objects: str) -> str:
    """Return a scene of `objects` that a lamp lights and a camera sees."""
    return f'<scene version="3.0.0">\n{SENSOR}\n<emitter type="constant" id="sky"/>\n{objects}\n</scene>'


def test_names_have_kind_and_number(tmp_path):
    found = keys(write(tmp_path, HOUSE))
    assert names(found) == [
        *("Perspective_1", "Thinlens_1", "Twosided_1", "Diffuse_2", "Checkerboard_2"),
        *("Sphere_1", "middle", "Sphere_3", "Rectangle_1", "Cube_1", "Point_1", "Point_2"),
    ]
    # Below the objects, Mitsuba's own names stay, because they describe the role of an object
    assert {
        "Sphere_3.emitter.radiance.value",
        "Twosided_1.brdf_0.reflectance.value",
        "Perspective_1.film.size",
        "Rectangle_1.bsdf.brdf_0.diffuse_reflectance.value",
        "Diffuse_2.reflectance.color0.value",
    } <= set(found)


def test_a_script_sees_the_names_of_the_command_line(tmp_path):
    """A script gets the same keys as the command line. The file is of an older version that `mi.load_file` refuses.
    Requested textures of 8 bits are floats.
    """
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


QUAD = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
QUAD += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


def meshes(folder, *parts):
    """Write a scene of meshes. A part is an id and a file."""
    (folder / "meshes").mkdir(exist_ok=True)
    shapes = ""
    for id, file in parts:
        (folder / "meshes" / file).write_text(QUAD)
        own = f' id="{id}"' if id else ""
        shapes += f'<shape type="ply"{own}><string name="filename" value="meshes/{file}"/></shape>'
    return write(folder, lit(shapes))


def test_shapes_without_an_id_are_named_after_their_files(tmp_path):
    """Exporters write `elm__12` for objects without an id."""
    parts = [
        ("", "Lamp.ply"),
        ("elm__12", "Lamp.ply"),
        ("mine", "Wall.ply"),
        ("elm__3", "my table-top.v2.ply"),
        ("", "Lamp_2.ply"),
    ]
    parts += [("elm__4", "mine.ply"), ("Wall", "Other.ply"), ("", "Wall.ply")]
    file = meshes(tmp_path, *parts)
    expected = ["Lamp", "Lamp_2", "mine", "my_table-top_v2", "Lamp_2_2", "mine_2", "Wall", "Wall_2"]
    assert names(keys(file))[2:] == expected
    assert names(keys(file))[2:] == expected


def test_warnings_of_mitsuba_are_one_line_for_each_kind(tmp_path, caplog, capfd):
    file = meshes(tmp_path, *(("", f"{number}.ply") for number in range(30)))
    odd = QUAD.replace("property float z\n", "property float z\nproperty float foo\n")
    for each in (tmp_path / "meshes").iterdir():
        each.write_text(odd.replace("0 0 0\n1 0 0\n0 1 0\n", "0 0 0 1\n1 0 0 1\n0 1 0 1\n"))
    load_scene(file)
    [line] = [record.getMessage() for record in caplog.records]
    assert line.startswith(f"{file}:1: Mitsuba warns: attributes without postfix are not handled for now: attribute")
    assert line.endswith(".ply, and 29 more")
    assert "\x1b" not in "".join(capfd.readouterr())
    mi.Log(mi.LogLevel.Warn, "later")
    assert "later" in "".join(capfd.readouterr())


@pytest.mark.parametrize(
    ("used", "expected"),
    [
        (["Ply_1.bsdf.reflectance.value"], ["Ply_1", "Lamp_2", "Wall"]),
        (["elm__12.faces"], ["Lamp", "elm__12", "Wall"]),
        (["elm__*.faces"], ["Lamp", "elm__12", "elm__3"]),
        (["Ply_*.faces"], ["Ply_1", "Lamp_2", "Wall"]),
        (["*.faces", "Lamp.bsdf.*", "elm__4.x", "Ply_2"], ["Lamp", "Lamp_2", "Wall"]),
    ],
)
def test_earlier_names_stay_where_an_experiment_uses_them(used, expected, tmp_path):
    """Versions before this one numbered the shapes."""
    file = meshes(tmp_path, ("", "Lamp.ply"), ("elm__12", "Lamp.ply"), ("elm__3", "Wall.ply"))
    expected = [name.replace("Lamp_2", "Lamp") if "Lamp" not in expected else name for name in expected]
    assert names(list(mi.traverse(load_scene(file, named=used)).properties))[2:] == expected


def test_a_taken_name_is_not_reused(tmp_path):
    shapes = '<shape type="sphere" id="Sphere_2"/><shape type="sphere"/><shape type="sphere" id="Sphere_2_2"/>'
    assert names(keys(write(tmp_path, lit(shapes))))[2:] == ["Sphere_2", "Sphere_2_3", "Sphere_2_2"]


def test_numbers_continue_through_includes(tmp_path):
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


def test_shapes_in_groups_keep_the_names_of_mitsuba(tmp_path):
    group = '<shape type="shapegroup" id="g"><shape type="sphere"/><shape type="cube"/></shape>'
    found = keys(write(tmp_path, lit(group + '<shape type="instance"><ref id="g"/></shape><shape type="sphere"/>')))
    assert {"g.shape.to_world", "g.shape_1.faces", "Instance_1.to_world", "Sphere_2.to_world"} <= set(found)


def test_ids_that_mitsuba_ignores(tmp_path, caplog):
    # Ids as `mi.parser.write_file` writes them
    shapes = (
        '<bsdf type="diffuse" id="_unnamed_3"/><shape type="sphere" id="_unnamed_4"><ref id="_unnamed_3"/></shape>'
        '<shape type="sphere" id=""><float name="radius" value="2"/></shape>'
    )
    assert names(keys(write(tmp_path, lit(shapes))))[2:] == ["Diffuse_1", "Sphere_1", "Sphere_2"]
    assert not caplog.records


def test_unusual_ids_are_kept_if_possible(tmp_path, caplog):
    odd = ["a.b", "two words", "wall [1]*", "lampe-é", "../x"]
    balls = [(name, f'<float name="radius" value="{k + 1}"/>') for k, name in enumerate(odd)]
    shapes = "".join(f'<shape type="sphere" id="{name}">{radius}</shape>' for name, radius in balls)
    found = keys(write(tmp_path, lit(shapes)))
    assert {f"{name}.to_world" for name in odd} <= set(found)
    assert len(set(found)) == len(found)
    assert not caplog.records


def test_a_duplicate_id_is_refused(tmp_path):
    file = write(tmp_path, lit('<shape type="sphere" id="ball"/>\n<shape type="cube" id="ball"/>'))
    with pytest.raises(ConfigError, match=f"{file}:5: id `ball` is also that of {file}:4; rename one of them"):
        load_scene(file)


def test_unused_children_are_told_by_their_numbers() -> None:
    """Mitsuba numbers children without a name. A number beyond them is the name of a parameter."""
    children = [SimpleNamespace(name=name, tag=tag, is_object=tag != "ref", written=name)
                for name, tag in (("", "bsdf"), ("a", "bsdf"), ("", "ref"), ("", "float"))]  # fmt: skip
    children[3].is_object = False
    element: Any = SimpleNamespace(
        type="sphere", children=children, written="", find=lambda name: children[1] if name == "a" else None
    )
    props: Any = SimpleNamespace(unqueried=lambda: ["_arg_0", "_arg_1", "_arg_2", "a"])
    notes = build._unused(props, element)
    assert [note.element for note in notes] == [children[0], children[2], element, children[1]]
    assert [note.wrong.partition(" in Mitsuba 3")[0] for note in notes] == [
        "sphere does not use a <bsdf>", "sphere does not use a <ref>", "sphere has no parameter `_arg_2`",
        "sphere has no parameter `a`",
    ]  # fmt: skip
