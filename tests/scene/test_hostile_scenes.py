"""Scene files that would take the process down, never end, or fill the memory: one located line, at once."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.xml import read

pytestmark = pytest.mark.usefixtures("llvm")
HEAD = '<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/><shape type="sphere"/>\n'
TEXTURE = (
    '<bsdf type="diffuse">\n<texture type="bitmap" name="reflectance"><string name="filename" value="{}"/></texture>'
    "</bsdf>"
)
#: Two objects that use each other, each in a line of its own.
CIRCLE = "<bsdf type='twosided' id='a'><ref id='b'/></bsdf>\n<bsdf type='twosided' id='b'><ref id='a'/></bsdf></scene>"


def write(folder: Path, text: str, name: str = "scene.xml") -> Path:
    (folder / name).write_text(text)
    return folder / name


def chain(length: int) -> str:
    bsdfs = ["<bsdf type='diffuse' id='b0'/>"]
    bsdfs += [f"<bsdf type='twosided' id='b{i}'><ref id='b{i - 1}'/></bsdf>" for i in range(1, length)]
    return HEAD + "\n".join(bsdfs) + "</scene>"


def entities() -> str:
    nested = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
    return f'<!DOCTYPE scene [\n<!ENTITY e0 "aaaaaaaaaa">{nested}]>\n{HEAD}&e9;</scene>'


def growing() -> str:
    defaults = "\n".join(f'<default name="v{i}" value="{f"$v{i - 1}" * 10}"/>' for i in range(1, 30))
    return f'{HEAD}<default name="v0" value="{"x" * 100}"/>\n{defaults}</scene>'


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (HEAD + "<shape type='sphere'>\n" * 20000 + "</shape>" * 20000, 101, "nested more than 100 levels deep"),
        (HEAD + "<bsdf type='twosided'>\n" * 20000 + "</bsdf>" * 20000, 101, "nested more than 100 levels deep"),
        (HEAD + "<shape type='sphere'>" * 20000, 2, "nested more than 100 levels deep"),
        (chain(20000), 102, "objects use one another in a chain of more than 100"),
        (
            HEAD + CIRCLE,
            2,
            "objects use one another in a circle: a uses b uses a",
        ),
        (
            HEAD + "<alias id='a' as='c'/><bsdf type='twosided' id='a'>\n<ref id='c'/></bsdf></scene>",
            2,
            "objects use one another in a circle: a uses a",
        ),
        (entities(), 2, "declares an XML entity"),
        ('<!DOCTYPE s [<!ENTITY e SYSTEM "file:///etc/passwd">]>\n<scene/>', 1, "declares an XML entity"),
        (growing(), 7, "$v4: makes a text of more than 1048576 characters"),
        (HEAD + '\n<include filename="scene.xml"/></scene>', 3, "files are included more than 15 levels deep"),
        (HEAD + TEXTURE.format("pipe") + "</scene>", 3, "pipe is no regular file"),
        (HEAD + TEXTURE.format("/dev/zero") + "</scene>", 3, "/dev/zero is no regular file"),
        (HEAD + '<include filename="pipe"/></scene>', 2, "pipe, which is a pipe, not a regular file"),
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


@pytest.mark.parametrize(
    ("objects", "said"),
    [
        (
            '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"/></bsdf>',
            "bitmap needs a parameter `filename`",
        ),
        ('<bsdf type="normalmap"><bsdf type="diffuse"/></bsdf>', "normalmap needs a parameter `normalmap`"),
        ('<bsdf type="blendbsdf"><bsdf type="diffuse"/></bsdf>', "blendbsdf needs two BSDFs"),
        ('<bsdf type="diffuse"><texture type="blendbsdf" name="reflectance"/></bsdf>', "`blendbsdf` is no texture"),
        ('<shape type="perspective"/>', "`perspective` is no shape"),
        ('<shape type="sphere"><point name="center" value="1, 2"/></shape>', "<point> needs one or three numbers"),
        (
            '<shape type="sphere"><transform name="to_world"><scale value="2" x="1"/></transform></shape>',
            "<scale> can have `value` or x, y and z, not both",
        ),
    ],
)
def test_what_mitsuba_would_crash_on_or_not_locate(tmp_path, objects, said):
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
        (3, 3, "has a face with vertex 3, and 3 vertices; write it again"),
        (
            4294967296,
            2,
            "mesh.ply says that it has `4294967296` of the element `vertex`, and has 187 B; write it again",
        ),
        (3, 2, ""),
    ],
)
def test_meshes_by_which_memory_would_be_left(tmp_path, vertices, last, said):
    """Of vertices that are not there, and of more of them than there is room for."""
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


def test_a_texture_that_is_damaged_is_refused_where_it_is_named(tmp_path):
    lines = bytes((2, 2, 0, 8)) + bytes((136, 1)) * 4
    image = b"#?RGBE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n" + lines + b"\xff" * 12
    (tmp_path / "a.hdr").write_bytes(image)
    file = write(tmp_path, f"{HEAD}{TEXTURE.format('a.hdr')}</scene>")
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value) == f"{file}:3: filename: {tmp_path}/a.hdr: is damaged or cut off; copy or save it again"
    (tmp_path / "a.hdr").write_bytes(b"P6\n8 0\n255\n" + bytes(24))  # of which Mitsuba makes a texture without texels
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value) == f"{file}:3: filename: {tmp_path}/a.hdr: says that it is 8x0 pixels; save it again"


def test_what_is_no_regular_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    for file in (tmp_path / "pipe.xml", Path("/dev/zero")):
        with pytest.raises(ConfigError, match=f"{file}: is a (pipe|device), not a regular file"):
            load_scene(file)


def test_files_are_bounded_together(tmp_path, monkeypatch):
    monkeypatch.setattr(read, "MAX_BYTES", 3000)
    write(tmp_path, f'<scene version="3.0.0"><!-- {"x" * 1000} --></scene>', "part.xml")
    file = write(tmp_path, HEAD + '<include filename="part.xml"/>\n' * 9 + "</scene>")
    with pytest.raises(ConfigError, match=f"{file}:4: includes {tmp_path}/part.xml, which is too large: a scene"):
        load_scene(file)
    monkeypatch.setattr(read, "MAX_BYTES", 10)
    with pytest.raises(ConfigError, match=f"{file}: has .* B are not read"):
        load_scene(file)


def test_a_name_that_no_file_can_have(tmp_path):
    file = write(tmp_path, HEAD + f'<shape type="ply"><string name="filename" value="{"a" * 5000}"/></shape></scene>')
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:2: ")


def test_names_in_a_mesh_do_not_reach_the_terminal(tmp_path, capfd):
    mesh = (
        b"ply\nformat ascii 1.0\ncomment M\xc3\xbcller\nelement vertex 0\nproperty float x\nelement %s 1\nend_header\n"
    )
    file = write(tmp_path, HEAD + '<shape type="ply"><string name="filename" value="m.ply"/></shape></scene>')
    (tmp_path / "m.ply").write_bytes(mesh % b"\x1b[31mred")
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:2: filename: {tmp_path}/m.ply: its head holds what is no text, ")
    assert str(error.value).isprintable()
    assert capfd.readouterr() == ("", "")
    (tmp_path / "m.ply").write_bytes(mesh % b"red")
    with pytest.raises(ConfigError) as error:  # that of Mitsuba
        load_scene(file)
    assert "no text" not in str(error.value)


def test_includes_are_counted(tmp_path):
    write(tmp_path, '<scene version="3.0.0"/>', "0.xml")
    for level in range(1, 6):
        includes = f'<include filename="{level - 1}.xml"/>' * 10
        write(tmp_path, f'<scene version="3.0.0">{includes}</scene>', f"{level}.xml")
    with pytest.raises(ConfigError, match=r"/1\.xml:1: more than 1000 files are included"):
        load_scene(tmp_path / "5.xml")
