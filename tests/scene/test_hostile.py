"""Scene files that Mitsuba would crash on, never finish reading, or not locate. Each gives one line with the
location.
"""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.load import load_scene

pytestmark = pytest.mark.usefixtures("llvm")

HEAD = '<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/><shape type="sphere"/>\n'
TEXTURE = (
    '<bsdf type="diffuse">\n<texture type="bitmap" name="reflectance"><string name="filename" value="{}"/></texture>'
    "</bsdf>"
)
#: Two objects that use each other, each on its own line.
CIRCLE = "<bsdf type='twosided' id='a'><ref id='b'/></bsdf>\n<bsdf type='twosided' id='b'><ref id='a'/></bsdf></scene>"


def write(folder: Path, text: str, name: str = "scene.xml") -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (HEAD + CIRCLE, 2, "circular reference detected: a -> b -> a"),
        (HEAD + TEXTURE.format("pipe") + "</scene>", 3, "pipe is not a regular file"),
        (HEAD + TEXTURE.format("/dev/zero") + "</scene>", 3, "/dev/zero is not a regular file"),
        (HEAD + '<include filename="pipe"/></scene>', 2, "pipe, which is a pipe, a socket or a device"),
    ],
)  # fmt: skip
def test_refused_at_once(tmp_path, text, line, said):
    os.mkfifo(tmp_path / "pipe")
    file = write(tmp_path, text)
    start = time.monotonic()
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert time.monotonic() - start < 60
    assert str(error.value).startswith(f"{file}:{line}: ")
    assert said in str(error.value)
    assert len(str(error.value)) < 400


NAMED = '<string name="filename" value="pipe"/>'
#: One object for each way in which a plugin or the parser opens a file (Mitsuba 3.9.1).
OPENED = {
    **{f"shape {type}": f'<shape type="{type}">{NAMED}</shape>'
       for type in ("obj", "ply", "serialized", "linearcurve", "bsplinecurve", "sdfgrid", "ellipsoids",
                    "ellipsoidsmesh")},
    **{f"bsdf {type}": f'<bsdf type="{type}">{NAMED}</bsdf>' for type in ("measured", "measured_polarized")},
    "texture": f'<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{NAMED}</texture></bsdf>',
    "envmap": f'<emitter type="envmap">{NAMED}</emitter>',
    "volume": f'<medium type="heterogeneous"><volume type="gridvolume" name="albedo">{NAMED}</volume></medium>',
    "spectrum": '<bsdf type="diffuse"><spectrum name="reflectance" filename="pipe"/></bsdf>',
    "lamp": '<emitter type="point"><spectrum name="intensity" filename="pipe"/></emitter>',
    "material": '<bsdf type="conductor"><string name="material" value="mine"/></bsdf>',
    "nested": '<include filename="part.xml"/>',
    "include": '<include filename="pipe"/>',
    "folder": '<path value="pipe"/>',
}  # fmt: skip


@pytest.mark.parametrize("kind", OPENED)
def test_no_pipe_is_opened(kind: str, tmp_path: Path) -> None:
    (tmp_path / "data" / "ior").mkdir(parents=True)
    pipes = [tmp_path / "pipe", tmp_path / "data" / "ior" / "mine.eta.spd"]
    for pipe in pipes:
        os.mkfifo(pipe)
    write(tmp_path, f'<scene version="3.0.0">{OPENED["spectrum"]}</scene>', "part.xml")
    opened = "".join(f": <> {pipe}; " for pipe in pipes)  # frees blocked readers, so that the test fails, not hangs
    with subprocess.Popen(["sh", "-c", f"sleep 30; {opened}"]) as freeing:
        start = time.monotonic()
        with pytest.raises(ConfigError, match=r"no regular file|not a regular file|folder `pipe` not found"):
            load_scene(write(tmp_path, HEAD + OPENED[kind] + "</scene>"))
        assert time.monotonic() - start < 20
        freeing.kill()


@pytest.mark.parametrize(
    ("objects", "said"),
    [
        (
            '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"/></bsdf>',
            "bitmap needs a parameter `filename`",
        ),
        ('<bsdf type="diffuse"><texture type="blendbsdf" name="reflectance"/></bsdf>', "`blendbsdf` is no texture"),
        ('<shape type="perspective"/>', "`perspective` is no shape"),
    ],
)
def test_input_that_crashes_mitsuba(tmp_path, objects, said):
    file = write(tmp_path, HEAD + objects + "</scene>")
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:2: {said}")


PLY = """ply
format ascii 1.0
element vertex {vertices}
property float x
property float y
property float z
element face 1
property list uchar int vertex_index
end_header
0 0 0
1 0 0
0 1 0
3 0 1 {last}
"""


@pytest.mark.parametrize(
    ("vertices", "last", "said"),
    [
        (3, 3, "has a face with vertex 3, but only 3 vertices; write it again"),
        (3, 2, ""),
    ],
)
def test_a_mesh_with_faces_of_missing_vertices_is_refused(tmp_path, vertices, last, said):
    (tmp_path / "mesh.ply").write_text(PLY.format(vertices=vertices, last=last))
    lamp = '<emitter type="point"/><sensor type="perspective"/>'
    mesh = '<shape type="ply" id="mesh"><string name="filename" value="mesh.ply"/></shape>'
    file = write(tmp_path, f"{HEAD}{lamp}{mesh}</scene>")
    if not said:
        assert any(shape.is_mesh() for shape in load_scene(file).shapes())
        return
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(str(file))
    assert said in str(error.value)


def test_a_damaged_texture_is_refused_with_a_location(tmp_path):
    (tmp_path / "a.hdr").write_bytes(b"#?RGBE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n\2\2\0\x08")
    file = write(tmp_path, f"{HEAD}{TEXTURE.format('a.hdr')}</scene>")
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:3: ")
    assert "a.hdr" in str(error.value)


def test_irregular_files(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    for file in (tmp_path / "pipe.xml", Path("/dev/zero")):
        with pytest.raises(ConfigError, match=f"{file}: is a pipe, a socket or a device, not a regular file"):
            load_scene(file)


def test_an_impossible_file_name(tmp_path):
    file = write(tmp_path, HEAD + f'<shape type="ply"><string name="filename" value="{"a" * 5000}"/></shape></scene>')
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:2: ")


@pytest.mark.parametrize(
    "text", ["<shape type='sphere'>\n" * 5000 + "</shape>" * 5000, '<include filename="scene.xml"/>']
)
def test_elements_nested_too_deeply_are_one_line(tmp_path, text):
    file = write(tmp_path, f"{HEAD}{text}</scene>")
    with pytest.raises(ConfigError, match=f"{file}: elements or includes are nested too deeply"):
        load_scene(file)


WEIGHT = '<float name="weight" value="0.5"/>'


@pytest.mark.parametrize("case", ["twosided", "blendbsdf", "mask", "mask, last part first"])
def test_a_bsdf_with_too_many_parts_is_one_line(tmp_path, case):
    """Mitsuba visits a part as often as it is used. A chain of a few parts is no problem."""

    def text(number):
        if case == "twosided":
            nested = '<bsdf type="twosided">' * number + '<bsdf type="diffuse"/>' + "</bsdf>" * number
            return f"<shape type='sphere'>{nested}</shape>"
        parts = ['<bsdf type="diffuse" id="b0"/>']
        for n in range(number):
            use = f'<ref id="b{n}"/>' if long else f'<ref id="b{n}"/><ref id="b{n}"/>{WEIGHT}'
            parts.append(f'<bsdf type="{case.split(",")[0]}" id="b{n + 1}">{use}</bsdf>')
        parts = parts[::-1] if "," in case else parts
        return "".join(parts) + f"<shape type='sphere'><ref id='b{number}'/></shape>"

    long = case.startswith("mask")
    file = write(tmp_path, f"{HEAD}{text(990 if long else 3)}</scene>")
    load_scene(file)
    write(tmp_path, f"{HEAD}{text(3000 if long else 90)}</scene>")
    with pytest.raises(ConfigError, match=rf"{file}:\d+: .*has more than 1000 nested BSDFs and textures"):
        load_scene(file)


@pytest.mark.parametrize("depth", [97, 98, 300, 600, 850, 900, 950, 990])
def test_every_depth_of_elements_loads_or_is_one_line(tmp_path, depth):
    """Every pass over the elements has its own limit of recursion."""
    nested = '<bsdf type="mask">\n' * depth + '<bsdf type="diffuse"/>' + "</bsdf>" * depth
    file = write(tmp_path, f"{HEAD}<shape type='sphere'>{nested}</shape></scene>")
    if depth < 98:  # with the scene, the shape and the last BSDF
        load_scene(file)
        return
    with pytest.raises(ConfigError, match=rf"{file}.*: (is|elements or includes are) nested too deeply"):
        load_scene(file)
