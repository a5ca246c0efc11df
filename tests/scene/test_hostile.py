"""Scenes and images that are hostile or nearly right: each works, or is one located line, at once."""

from __future__ import annotations

import json
import os
import random
import re
import select
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from cli.tiny import CONFIG, ROOT, SCENE, write_experiment
from compilation import search_path
from scene.mutations import mutate_bytes, mutate_scene, write_images

from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.xml import read

# Hundreds of scenes and images that are nearly right, in processes with limits: each works, or is one located line.
#
# A few by default. A process that ends in the midst of a case, or takes too long over it, is a fault of ours; nothing
# may be written but the run folder and the cache.

#: A warning in Mitsuba's own log, which it prints in red: of its text nothing else may reach a terminal.
_RED = re.compile(r"\x1b\[31m([^\x1b]*)\x1b\[0m")
#: Seconds that a case may take; a hang takes longer on any machine.
SECONDS = 100
PHOTO = CONFIG.replace("{render: {spp: 16}}", "{file: x.exr}").replace("iterations: 5", "iterations: 1")
PHOTO = PHOTO.replace("spp: 4", "spp: 4, certainty: false, final_spp: 1")
RUN = CONFIG.replace("{render: {spp: 16}}", "{render: {spp: 1}}").replace("file: scene.xml", "file: mutated.xml")
RUN = RUN.replace("iterations: 5, spp: 4", "iterations: 1, spp: 1, final_spp: 1")


class Hostile:
    """The process that is asked; made anew where it ended."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._process = folder, self._start(folder)

    @staticmethod
    def _start(folder: Path) -> subprocess.Popen[str]:
        environment = {**os.environ, "PYTHONPATH": search_path(ROOT, ROOT / "tests")}
        environment["RESLRB_CACHE"] = str(folder / "cache")
        command = [sys.executable, "-m", "scene.mutations"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        return subprocess.Popen(command, cwd=folder, env=environment, text=True, **pipes)  # type: ignore[call-overload,no-any-return]

    def ask(self, question: str) -> dict[str, object]:
        """The answer, with code `hang` or `ended by N` where there is none."""
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(question + "\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], SECONDS)
        line = process.stdout.readline() if ready else ""
        if line:
            return json.loads(line)  # type: ignore[no-any-return]
        process.kill()
        process.wait()
        self._process = self._start(self.folder)
        return {"code": f"ended by {process.returncode}" if ready else "hang", "said": ""}

    def end(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "place"
    place.mkdir()
    write_experiment(place)
    (place / "photo.yaml").write_text(PHOTO)
    (place / "run.yaml").write_text(RUN)
    return place


def state(folder: Path) -> dict[str, bytes]:
    """All files around and in a folder, but for what a run may write."""
    own = (folder / "runs", folder / "cache")
    return {
        str(path): path.read_bytes()
        for path in folder.parent.rglob("*")
        if path.is_file() and not any(path.is_relative_to(place) for place in own)
    }


def judge(seed: int, answer: dict[str, object], seen: Counter[object]) -> list[str]:
    """What is wrong with an answer."""
    code, said = answer["code"], str(answer["said"])
    seen[code] += 1
    if code not in (0, 2, 4, 5) or "Traceback" in said:
        return [f"seed {seed}: {code}: {said}"]
    if code and (not said.strip() or not said.splitlines()[-1].isprintable()):
        return [f"seed {seed}: {code}, and no line: {said!r}"]
    below = _RED.sub(r"\1", str(answer.get("below", "")))
    if not all(character.isprintable() or character in "\n\t" for character in below):
        return [f"seed {seed}: printed past us: {below!r}"]
    return []


def sources(folder: Path) -> list[str]:
    """Scenes to begin with; their files come to lie in `folder`."""
    texts = [SCENE]
    for name in ("lens_pose", "caustic_slab", "grey_room"):
        for file in (ROOT / "scenes" / name).iterdir():
            if file.suffix != ".xml":
                (folder / file.name).write_bytes(file.read_bytes())
        texts.append((ROOT / "scenes" / name / "scene.xml").read_text())
    return texts


@pytest.mark.usefixtures("llvm")
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and limits memory")
@pytest.mark.parametrize(("first", "count"), [(0, 8), pytest.param(1000, 500, marks=pytest.mark.long)])
def test_mutated_scenes(folder: Path, first: int, count: int) -> None:
    hostile, seen, faults = Hostile(folder), Counter[object](), []
    mutated, texts = folder / "mutated.xml", sources(folder)
    meshes = sorted(folder.glob("*.ply"))
    whole = {mesh: mesh.read_bytes() for mesh in meshes}
    try:
        for seed in range(first, first + count):
            rng = random.Random(seed)
            for mesh, data in whole.items():
                mesh.write_bytes(data)
            if seed % 5:
                mutated.write_bytes(mutate_scene(rng, rng.choice(texts)))
            else:  # a good scene, of damaged meshes
                mutated.write_text(rng.choice([text for text in texts if ".ply" in text]))
                for mesh in meshes:
                    mesh.write_bytes(mutate_bytes(rng, whole[mesh]))
            before = state(folder)
            answer = hostile.ask("scene mutated.xml")
            faults += judge(seed, answer, seen)
            if answer["code"] == 0 and seed % 4 == 0:
                faults += judge(seed, hostile.ask("run run.yaml"), seen)
            faults += [] if state(folder) == before else [f"seed {seed}: files were written"]
    finally:
        hostile.end()
    print(dict(seen))
    assert faults == []
    assert seen[0] >= count / 20
    assert seen[2] >= count / 10


@pytest.mark.usefixtures("llvm")
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and limits memory")
@pytest.mark.parametrize(("first", "count"), [(0, 10), pytest.param(1000, 500, marks=pytest.mark.long)])
def test_mutated_images(folder: Path, first: int, count: int) -> None:
    """As a target, and every second one as a texture of the scene."""
    hostile, seen, faults = Hostile(folder), Counter[object](), []
    images = write_images(folder)
    try:
        for seed in range(first, first + count):
            rng = random.Random(seed)
            good = rng.choice(images)
            image = folder / f"mutated{good.suffix}"
            image.write_bytes(mutate_bytes(rng, good.read_bytes()))
            (folder / "mutated.xml").write_text(SCENE.replace("poster.exr", image.name))
            before = state(folder)
            question = "scene mutated.xml" if seed % 2 else f"photo {image.name}"
            faults += judge(seed, hostile.ask(question), seen)
            faults += [] if state(folder) == before else [f"seed {seed}: files were written"]
            image.unlink()
    finally:
        hostile.end()
    print(dict(seen))
    assert faults == []
    assert seen[0] >= count / 20
    assert seen[2] >= count / 4


# Scene files that would take the process down, never end, or fill the memory: one located line, at once.

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


@pytest.mark.usefixtures("llvm")
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


NAMED = '<string name="filename" value="pipe"/>'
#: An object for each way in which a plugin, or the parser, opens a file (Mitsuba 3.9.1).
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
    "rough material": '<bsdf type="roughconductor"><string name="material" value="Cu"/></bsdf>',
    "nested": '<include filename="part.xml"/>',
    "include": '<include filename="pipe"/>',
    "folder": '<path value="pipe"/>',
}  # fmt: skip


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("kind", OPENED)
def test_no_pipe_is_opened_however_a_scene_names_it(kind: str, tmp_path: Path) -> None:
    (tmp_path / "data" / "ior").mkdir(parents=True)
    pipes = [tmp_path / "pipe", *(tmp_path / "data" / "ior" / f"{name}.spd" for name in ("mine.eta", "Cu.k"))]
    for pipe in pipes:
        os.mkfifo(pipe)
    write(tmp_path, f'<scene version="3.0.0">{OPENED["spectrum"]}</scene>', "part.xml")
    opened = "".join(f": <> {pipe}; " for pipe in pipes)  # frees who waits there, so that the test fails, not hangs
    with subprocess.Popen(["sh", "-c", f"sleep 30; {opened}"]) as freeing:
        start = time.monotonic()
        with pytest.raises(ConfigError, match=r"no regular file|not a regular file|folder `pipe` not found"):
            load_scene(write(tmp_path, HEAD + OPENED[kind] + "</scene>"))
        assert time.monotonic() - start < 20
        freeing.kill()


@pytest.mark.usefixtures("llvm")
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


@pytest.mark.usefixtures("llvm")
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


@pytest.mark.usefixtures("llvm")
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


@pytest.mark.usefixtures("llvm")
def test_what_is_no_regular_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    for file in (tmp_path / "pipe.xml", Path("/dev/zero")):
        with pytest.raises(ConfigError, match=f"{file}: is a (pipe|device), not a regular file"):
            load_scene(file)


@pytest.mark.usefixtures("llvm")
def test_files_are_bounded_together(tmp_path, monkeypatch):
    monkeypatch.setattr(read, "MAX_BYTES", 3000)
    write(tmp_path, f'<scene version="3.0.0"><!-- {"x" * 1000} --></scene>', "part.xml")
    file = write(tmp_path, HEAD + '<include filename="part.xml"/>\n' * 9 + "</scene>")
    with pytest.raises(ConfigError, match=f"{file}:4: includes {tmp_path}/part.xml, which is too large: a scene"):
        load_scene(file)
    monkeypatch.setattr(read, "MAX_BYTES", 10)
    with pytest.raises(ConfigError, match=f"{file}: has .* B are not read"):
        load_scene(file)


@pytest.mark.usefixtures("llvm")
def test_a_name_that_no_file_can_have(tmp_path):
    file = write(tmp_path, HEAD + f'<shape type="ply"><string name="filename" value="{"a" * 5000}"/></shape></scene>')
    with pytest.raises(ConfigError) as error:
        load_scene(file)
    assert str(error.value).startswith(f"{file}:2: ")


@pytest.mark.usefixtures("llvm")
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


@pytest.mark.usefixtures("llvm")
def test_includes_are_counted(tmp_path):
    write(tmp_path, '<scene version="3.0.0"/>', "0.xml")
    for level in range(1, 6):
        includes = f'<include filename="{level - 1}.xml"/>' * 10
        write(tmp_path, f'<scene version="3.0.0">{includes}</scene>', f"{level}.xml")
    with pytest.raises(ConfigError, match=r"/1\.xml:1: more than 1000 files are included"):
        load_scene(tmp_path / "5.xml")
