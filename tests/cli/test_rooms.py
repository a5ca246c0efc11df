"""The configuration that `init` writes recovers the colours of rooms as Blender's exporter writes them.

Each room has two-sided `principled` materials at Blender's grey of 0.8, PLY meshes, an environment map, an area lamp
and point lamps. The photograph has 8 bits and an unknown exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli import corners, tiny
from cli.tiny import settings
from kit import area, diffuse, scene, sensor, shape

pytestmark = [pytest.mark.usefixtures("llvm"), pytest.mark.long]

Colour = tuple[float, float, float]
GREY: Colour = (0.8, 0.8, 0.8)
#: Name of a floor whose colour is a texture, and of a table of rough metal.
WOOD, METAL = "wood", "metal"
#: Texels of the floor in full view, in front of the furniture.
SHOWN = np.s_[4:7, 2:14]


@dataclass(frozen=True)
class Room:
    """Colours of floor, ceiling, back, left wall, right wall, sofa and table, lamps, and the photograph's exposure.

    `points` are the intensities of the point lamps.
    """

    colours: tuple[Colour | str, ...]
    lamp: float
    sky: float
    points: tuple[float, ...] = ()
    exposure: float = 0.6
    roughness: float = 0.5


PARTS = ("floor", "ceiling", "back", "left", "right", "sofa", "table")
POINTS = ((1.0, 2.8, 1.7), (-1.2, 1.0, 1.9))
ROOMS = {
    "sofa": Room(
        ((0.45, 0.30, 0.18), (0.85, 0.85, 0.82), (0.70, 0.66, 0.55), (0.62, 0.12, 0.10), (0.15, 0.45, 0.20),
         (0.10, 0.18, 0.45), (0.35, 0.22, 0.12)), 12, 0.5, (3,)),
    "strong lamp": Room(
        ((0.25, 0.22, 0.20), (0.75, 0.75, 0.75), (0.35, 0.50, 0.60), (0.55, 0.50, 0.15), (0.60, 0.60, 0.60),
         (0.40, 0.08, 0.06), (0.15, 0.12, 0.10)), 60, 0.1, roughness=0.4),
    "dark": Room(
        ((0.08, 0.06, 0.04), (0.25, 0.25, 0.28), (0.10, 0.15, 0.22), (0.20, 0.04, 0.05), (0.06, 0.12, 0.07),
         (0.05, 0.05, 0.06), (0.12, 0.08, 0.03)), 25, 1, (6,), roughness=0.6),
    "texture": Room(
        (WOOD, (0.80, 0.78, 0.75), (0.30, 0.45, 0.35), (0.50, 0.45, 0.40), (0.65, 0.25, 0.15), (0.20, 0.20, 0.22),
         (0.55, 0.40, 0.25)), 15, 0.4, (2, 4)),
    "bright": Room(
        ((0.60, 0.55, 0.50), (0.90, 0.90, 0.90), (0.85, 0.80, 0.70), (0.80, 0.82, 0.85), (0.75, 0.30, 0.25),
         (0.12, 0.30, 0.32), METAL), 4, 0.3, (1,), exposure=1.4, roughness=0.3),
}  # fmt: skip


def quads(part: str) -> list[list[tuple[float, float, float]]]:
    """Return the corners of a part's faces. The room is open at y = 0, towards the camera."""
    flat = {
        "floor": [(-2, 0, 0), (2, 0, 0), (2, 4, 0), (-2, 4, 0)],
        "ceiling": [(-2, 0, 2.4), (-2, 4, 2.4), (2, 4, 2.4), (2, 0, 2.4)],
        "back": [(-2, 4, 0), (2, 4, 0), (2, 4, 2.4), (-2, 4, 2.4)],
        "left": [(-2, 0, 0), (-2, 4, 0), (-2, 4, 2.4), (-2, 0, 2.4)],
        "right": [(2, 0, 0), (2, 0, 2.4), (2, 4, 2.4), (2, 4, 0)],
        "lamp": [(-0.5, 1.5, 2.38), (-0.5, 2.5, 2.38), (0.5, 2.5, 2.38), (0.5, 1.5, 2.38)],
    }
    if part in flat:
        return [flat[part]]
    low, high = {"sofa": ((-1.6, 2.4, 0.05), (0.2, 3.6, 0.7)), "table": ((0.5, 1.6, 0.45), (1.6, 2.6, 0.55))}[part]
    found = []
    for axis in range(3):
        for end in (low, high):
            corners = [list(end) for _ in range(4)]
            for corner, (one, two) in zip(corners, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
                for other, side in zip([place for place in range(3) if place != axis], (one, two), strict=True):
                    corner[other] = (low, high)[side][other]
            found.append([(x, y, z) for x, y, z in corners])
    return found


def write_mesh(path: Path, faces: list[list[tuple[float, float, float]]]) -> None:
    header = ["ply", "format ascii 1.0", f"element vertex {4 * len(faces)}"]
    header += [f"property float {name}" for name in "xyzst"]
    header += [f"element face {2 * len(faces)}", "property list uchar int vertex_indices", "end_header"]
    places = ((0, 0), (1, 0), (1, 1), (0, 1))
    vertices = [" ".join(map(str, (*corner, *at))) for face in faces for corner, at in zip(face, places, strict=True)]
    first = [4 * number for number in range(len(faces))]
    triangles = [f"3 {n} {n + a} {n + a + 1}" for n in first for a in (1, 2)]
    path.write_text("\n".join([*header, *vertices, *triangles, ""]))


def material(part: str, colour: Colour | str, roughness: float, is_true: bool) -> str:
    if colour == METAL:
        alpha = 0.2 if is_true else 0.5
        inner = f'''<bsdf type="roughconductor"><string name="material" value="Al"/>
            <float name="alpha" value="{alpha}"/></bsdf>'''
    else:
        base = "{:g} {:g} {:g}".format(*(colour if is_true and not isinstance(colour, str) else GREY))
        value = f'<rgb name="base_color" value="{base}"/>'
        if colour == WOOD:
            value = f'''<texture type="bitmap" name="base_color"><boolean name="raw" value="true"/>
                <string name="filename" value="{WOOD if is_true else "grey"}.exr"/></texture>'''
        inner = f'''<bsdf type="principled">{value}<float name="roughness" value="{roughness}"/>
            <float name="specular" value="0.5"/></bsdf>'''
    return f'<bsdf type="twosided" id="mat-{part}">{inner}</bsdf>'


def wood() -> np.ndarray:
    rng = np.random.default_rng(3)
    boards = (0.6 + 0.8 * rng.random((1, 16, 1))) * (0.8 + 0.4 * rng.random((16, 16, 1)))
    return (np.array([0.45, 0.28, 0.15]) * boards).astype(np.float32)


def write_room(
    folder: Path, room: Room, size: tuple[int, int], spp: int, material: Callable[..., str] = material
) -> None:
    """Write `scene.xml`, in which all colours are grey, and `photo.png` of the scene with the true colours."""
    for part in (*PARTS, "lamp"):
        write_mesh(folder / f"{part}.ply", quads(part))
    sky = np.ones((16, 32, 3), np.float32)
    sky[:8], sky[8:] = (1.2, 1.4, 1.8), (0.5, 0.45, 0.4)
    pictures = {"sky": sky, "wood": wood(), "grey": np.full((16, 16, 3), 0.8, np.float32)}
    for name, picture in pictures.items():
        mi.Bitmap(picture).write(str(folder / f"{name}.exr"))
    camera = sensor("0.1, -2.2, 1.35", "0, 3, 1.05", "0, 0, 1", size=size, fov=62, rfilter="gaussian")
    ply = {part: f'<string name="filename" value="{part}.ply"/>' for part in (*PARTS, "lamp")}
    flat = '<boolean name="face_normals" value="true"/>'
    parts = ['<integrator type="path"><integer name="max_depth" value="24"/></integrator>', camera]
    parts += [shape("ply", part, ply[part], flat, f'<ref id="mat-{part}" name="bsdf"/>') for part in PARTS]
    black = '<bsdf type="diffuse"><rgb name="reflectance" value="0 0 0"/></bsdf>'
    parts.append(shape("ply", "lamp", ply["lamp"], black, area(f"{room.lamp} {0.95 * room.lamp} {0.85 * room.lamp}")))
    for number, ((x, y, z), power) in enumerate(zip(POINTS, room.points, strict=False)):
        place = f'<point name="position" x="{x}" y="{y}" z="{z}"/>'
        light = f'<rgb name="intensity" value="{power} {0.9 * power} {0.7 * power}"/>'
        parts.append(f'<emitter type="point" id="light-{number}">{place}{light}</emitter>')
    parts.append(f'''<emitter type="envmap" id="World"><string name="filename" value="sky.exr"/>
        <float name="scale" value="{room.sky}"/></emitter>''')
    for is_true, name in ((False, "scene.xml"), (True, "true.xml")):
        pairs = zip(PARTS, room.colours, strict=True)
        materials = [material(part, colour, room.roughness, is_true) for part, colour in pairs]
        (folder / name).write_text(scene(*materials, *parts))
    image = np.array(mi.render(mi.load_file(str(folder / "true.xml")), spp=spp))[:, :, :3]
    photo = mi.Bitmap((room.exposure * image).astype(np.float32))
    photo.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True).write(str(folder / "photo.png"))


#: Settings that need no measurements.
QUICK = ("integrator.paths=both", "integrator.guiding=off", "integrator.pixels=even", "run.final_spp=16")


def recover(folder: Path, room: Room, *sets: str) -> tuple[dict[str, float], float]:
    """Run the configuration that `init` writes. Return the largest error of each part's colour, and the exposure."""
    tiny.done("init", folder / "scene.xml", "--target", folder / "photo.png", "-o", folder / "room.yaml", "--fit", 600)
    tiny.done("optimize", folder / "room.yaml", *settings(*sets))
    values = np.load(folder / "runs/room/parameters/parameters.npz")
    errors = {}
    for part, colour in zip(PARTS, room.colours, strict=True):
        keys = [key for key in values.files if key.startswith(f"mat-{part}.") and "base_color" in key]
        [value] = [values[key] for key in keys] or [None]
        if value is None or colour == METAL:
            continue
        off = value[SHOWN] - wood()[SHOWN] if colour == WOOD else value - colour
        errors[part] = float(np.abs(off.reshape(-1, 3).mean(0)).max())
    return errors, float(values["exposure"].ravel()[0])


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_dark_room_beside_an_unknown_exposure_is_recovered(tmp_path: Path) -> None:
    """The first loss is 300 times that of a black image. The loss hardly changes if the exposure rises and all colours
    fall.
    """
    write_room(tmp_path, ROOMS["dark"], (24, 15), 4096)
    errors, exposure = recover(tmp_path, ROOMS["dark"], *QUICK)
    assert len(errors) == len(PARTS)
    assert max(errors.values()) < 0.015, errors
    assert exposure == pytest.approx(0.6, rel=0.03)


@pytest.mark.parametrize("name", ROOMS)
def test_colours_of_rooms_from_blender_are_recovered(tmp_path: Path, name: str) -> None:
    write_room(tmp_path, ROOMS[name], (160, 100), 1024)
    errors, exposure = recover(tmp_path, ROOMS[name])
    off = abs(exposure / ROOMS[name].exposure - 1)
    iterations = tiny.manifest("runs/room")["results"]["iterations"]
    print(f"{name}, {iterations} iterations: largest colour error {max(errors.values()):.3f}, exposure {off:.1%} off")
    assert len(errors) >= len(PARTS) - 1
    assert max(errors.values()) < 0.03, errors
    assert exposure == pytest.approx(ROOMS[name].exposure, rel=0.03)


#: Exposures that end more than 3 % off. Pictures of 48x30 pixels hardly tell an exposure from colours and roughnesses.
OFF = {"sofa": 0.06, "dark": 0.06, "bright": 0.09}
TEXTURE = pytest.mark.xfail(
    reason="the first fit leaves out pixels that see the textured floor; one of two runs ended 0.1 off"
)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[TEXTURE] if name == "texture" else []) for name in ROOMS])
def test_colours_of_rooms_with_unknown_roughnesses_are_recovered(tmp_path: Path, name: str) -> None:
    """The file has the roughness 0.5 everywhere. The true ones are random."""
    random = np.random.default_rng(1)
    roughnesses = dict(zip(PARTS, random.choice([0.2, 0.35, 0.5, 0.7, 0.9], len(PARTS)), strict=True))

    def own(part: str, colour: Colour | str, roughness: float, is_true: bool) -> str:
        return material(part, colour, roughnesses[part] if is_true else 0.5, is_true)

    write_room(tmp_path, ROOMS[name], (48, 30), 1024, own)
    errors, exposure = recover(tmp_path, ROOMS[name], *QUICK)
    off = abs(exposure / ROOMS[name].exposure - 1)
    print(f"{name}: largest colour error {max(errors.values()):.3f}, exposure {off:.1%} off")
    assert len(errors) >= len(PARTS) - 1
    assert max(errors.values()) < 0.05, errors
    assert off < OFF.get(name, 0.03)


def test_a_right_model_explains_its_photograph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 40 corners with photographs of 8 bits by `path`, at most 2 have a misfit."""
    ps = []
    for seed in range(40):
        (folder := tmp_path / str(seed)).mkdir()
        monkeypatch.chdir(folder)
        corners.write_corner(folder, 200 + seed, (32, 20), is_right=True)
        tiny.done("init", "corner.xml", "--target", "photo.png", "--fit", 0)
        tiny.done("optimize", "corner.yaml", *settings(*QUICK))
        fit = tiny.manifest("runs/corner")["results"]["certainty"]["fit"]
        ps.append(fit["p"])
        print(seed, fit["p"], fit["is_significant"], [each["key"] for each in fit["candidates"]], flush=True)
    assert sum(p <= 0.01 for p in ps) <= 2, ps


#: Surfaces of a closed box: the steps that place a square of side 2.
BOX = {
    "floor": '<scale x="2" y="3"/><translate y="1"/>',
    "ceiling": '<scale x="2" y="3"/><translate y="1" z="2.5"/>',
    "back": '<scale x="2" y="1.25"/><rotate x="1" angle="90"/><translate y="4" z="1.25"/>',
    "front": '<scale x="2" y="1.25"/><rotate x="1" angle="90"/><translate y="-2" z="1.25"/>',
    "left": '<scale x="1.25" y="3"/><rotate y="1" angle="90"/><translate x="-2" y="1" z="1.25"/>',
    "right": '<scale x="1.25" y="3"/><rotate y="1" angle="90"/><translate x="2" y="1" z="1.25"/>',
}


def write_box(folder: Path, seed: int) -> dict[str, np.ndarray]:
    """Write `box.xml`, a closed box with grey surfaces in view, and `box.exr`, its picture by `path` with random
    colours. Return these colours. Ceiling and front are out of view, and have their true colours.
    """
    rng = np.random.default_rng(seed)
    colours = {part: rng.uniform(0.1, 0.85, 3).round(3) for part in BOX}
    hidden = ("ceiling", "front")
    for name, true in (("box", False), ("true", True)):
        parts = [sensor("0.1, -1.8, 1.3", "0, 3, 0.35", "0, 0, 1", size=(48, 30), fov=55, rfilter="gaussian")]
        for part, place in BOX.items():
            colour = colours[part] if true or part in hidden else (0.5, 0.5, 0.5)
            inner = diffuse("{:g}, {:g}, {:g}".format(*colour))
            parts.append(shape("rectangle", part, f'<bsdf type="twosided">{inner}</bsdf>', place=place))
        place = '<scale x="0.6" y="0.5"/><rotate x="1" angle="180"/><translate y="2.2" z="2.48"/>'
        parts.append(shape("rectangle", "lamp", diffuse("0, 0, 0"), area("12, 11, 10"), place=place))
        (folder / f"{name}.xml").write_text(scene(*parts))
    made = mi.load_file(str(folder / "true.xml"))
    path = mi.load_dict({"type": "path", "max_depth": 16})
    images = [np.array(mi.render(made, integrator=path, spp=1024, seed=number)) for number in range(8)]
    mi.Bitmap(np.mean(images, axis=0)[:, :, :3].astype(np.float32)).write(str(folder / "box.exr"))
    return {part: colour for part, colour in colours.items() if part not in hidden}


def key_of(part: str, values: Mapping[str, np.ndarray]) -> str:
    [key] = [key for key in values if key.startswith(f"{part}.")]
    return key


def test_errors_of_a_box_are_as_large_as_their_spreads(tmp_path: Path) -> None:
    """If 1 % of the light was missing, because paths were too short, all colours would be too bright by more than their
    spread. The errors of one box are correlated, so 8 boxes would be too few: five runs printed 0.74 to 0.93.
    """
    ratios = []
    for seed in range(24):
        folder = tmp_path / str(seed)
        folder.mkdir()
        colours = write_box(folder, seed)
        tiny.done("init", folder / "box.xml", "--target", folder / "box.exr", "-o", folder / "box.yaml")
        tiny.done("optimize", folder / "box.yaml", *settings(f"run.output={folder}/runs"))
        values = np.load(folder / "runs/box/parameters/parameters.npz")
        certainty = tiny.manifest(folder / "runs/box")["results"]["certainty"]["parameters"]
        for part, colour in colours.items():
            key = key_of(part, values)
            ratios.append((values[key] - colour) / certainty[key]["spread"])
            assert certainty[key]["verdict"] == "settled"
    square = float(np.sqrt(np.mean(np.square(ratios))))
    print(f"errors over spreads: root mean square {square:.2f}, mean {np.mean(ratios):.2f}")
    assert 0.8 < square < 1.3


def test_a_lamp_out_of_view_is_told_from_the_colours(tmp_path: Path) -> None:
    """The lamp starts at a quarter of its radiance, without bounds."""
    colours = write_box(tmp_path, 5)
    text = (tmp_path / "box.xml").read_text()
    lamp, dark = area("12, 11, 10"), area("3, 3, 3")
    assert lamp in text
    (tmp_path / "box.xml").write_text(text.replace(lamp, dark))
    tiny.done("init", tmp_path / "box.xml", "--target", tmp_path / "box.exr", "-o", tmp_path / "box.yaml")
    written = (tmp_path / "box.yaml").read_text()
    line = "  # - {key: lamp.emitter.radiance.value, bounds: [0, .inf]}"
    assert line in written
    (tmp_path / "box.yaml").write_text(written.replace(line, "  - {key: lamp.emitter.radiance.value}"))
    tiny.done("optimize", tmp_path / "box.yaml")
    values = np.load(tmp_path / "runs/box/parameters/parameters.npz")
    for part, colour in colours.items():
        np.testing.assert_allclose(values[key_of(part, values)], colour, atol=0.02)
    np.testing.assert_allclose(values["lamp.emitter.radiance.value"], [12, 11, 10], rtol=0.03)
