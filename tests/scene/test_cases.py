"""Results of functions about cameras, images, values and files of scenes, as a table of cases (`said.check`)."""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from golden import said
from golden.cases import Cases, ending
from kit import profile_of

from reslrb_cli.config.loader import loads
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.scene import cameras, catalog, images, load, proposal, values
from reslrb_cli.scene.files import files_of
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.values import ParameterValue, Place
from reslrb_cli.scene.xml.read import read_description, tag_lines

pytestmark = pytest.mark.usefixtures("combined")
Patch = pytest.MonkeyPatch
case = Cases()


def described(text: str, version: str = "3.0.0", options: Any = None) -> Any:
    """Return the description of a scene with this content."""
    Path("scene.xml").write_text(f'<scene version="{version}">{text}</scene>')
    return read_description(Path("scene.xml"), options or {})


def lines(root: Any) -> list[str]:
    return [line.strip() for line, _ in tag_lines(root)]


def picture(name: str, *shape: int, kind: type = np.float32, seed: int = 0) -> None:
    """Write an image of random values."""
    pixels = np.random.default_rng(seed).uniform(0.05, 0.9, shape)
    mi.Bitmap((255 * pixels).astype(kind) if kind is np.uint8 else pixels.astype(kind)).write(name)


# ---- Cameras ----

EYE = [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]


def told(found: Any) -> Any:
    """Return cameras as lists, or an error."""
    if isinstance(found, str):
        return found
    return [[each.name, os.path.relpath(each.image), each.size, each.focal, each.center,
             np.round(each.to_world, 9).tolist()] for each in found]  # fmt: skip


@case
def cameras_of_transforms(patch: Patch) -> Any:
    picture("b.png", 4, 6, 3, kind=np.uint8)
    frame = {"file_path": "a.png", "transform_matrix": EYE, "w": 8, "h": 6, "fl_x": 5, "fl_y": 5}
    changes: list[dict[str, Any]] = [
        {}, {"fl_y": 5.004}, {"fl_y": 5.2}, {"fl_y": 4.8}, {"fl_y": None, "cx": 3, "cy": 2.5}, {"fl_x": None},
        {"fl_x": None, "fl_y": None, "camera_angle_x": 0.9}, {"w": None, "file_path": "b"},
        {"w": None, "file_path": "b.png"},
        {"w": None}, {"w": 0}, {"w": True}, {"cx": -1}, {"transform_matrix": EYE[:3]}, {"transform_matrix": EYE[:2]},
        {"transform_matrix": "x"}, {"file_path": ""}, {"file_path": 3}, {"k1": 0.1}, {"k1": 0}, {"p2": [0, 0]},
        {"is_fisheye": False}, {"is_fisheye": True}, {"camera_model": "opencv"}, {"camera_model": "OPENCV_FISHEYE"},
        {"camera_type": None}, {"ORTHOGRAPHIC": 1}, {"more": 3},
    ]  # fmt: skip
    found = []
    for change in changes:
        Path("t.json").write_text(
            json.dumps({"frames": [{k: v for k, v in (frame | change).items() if v is not None}]})
        )
        found.append([str(change), told(ending(cameras.read_cameras, Path("t.json")))])
    for text in ('{"frames": []}', "[]", "{}", "x", '{"frames": [3]}', json.dumps({**frame, "frames": [{"w": 4}, {}]})):
        Path("t.JSON").write_text(text)
        found.append([text[:20], told(ending(cameras.read_cameras, Path("t.JSON")))])
    return found


@case
def cameras_of_colmap(patch: Patch) -> Any:
    models = ("1 PINHOLE 8 6 5 5 4 3", "1 SIMPLE_PINHOLE 8 6 5 4 3", "# x\n\n1 PINHOLE 8 6 5 5.2 4 3",
              "1 OPENCV 8 6 5 5 4 3", "1 PINHOLE 8 6 5 5 4", "1 PINHOLE 8 6 -5 -5 4 3", "1", "2 PINHOLE 8 6 5 5 4 3",
              "1 PINHOLE 8 0 5 5 4 3")  # fmt: skip
    views = ("1 1 0 0 0 1 2 3 1 a b.png\n\n2 0.8 0 0.6 0 0 0 1 1 c.png\n1 2 3", "# x\n1 1 0 0 0 1 2 3 1 a.png",
             "1 1 0 0 0 1 2 3 1", "1 1 0 0 0 1 2 x 1 a.png", "1 1 0 0 0 1 2 nan 1 a.png",
             "1 0 0 0 0 1 2 3 1 a.png", "")  # fmt: skip
    found = []
    for model, view in [*((each, views[0]) for each in models), *((models[0], each) for each in views[1:])]:
        Path("cameras.txt").write_text(model)
        Path("images.txt").write_text(view)
        found.append([model, view, told(ending(cameras.read_cameras, Path("images.txt")))])
    return found


SENSORS = """<sensor type="thinlens" id="a"><float name="near_clip" value="0.2"/><float name="fov" value="3"/>
<sampler type="independent"/><film type="specfilm" id="f"><integer name="width" value="5"/><rfilter type="box" id="r"/>
<integer name="crop_width" value="2"/><string name="pixel_format" value="rgb"/></film></sensor>
<shape type="sphere" id="view"/>
<sensor type="perspective"/>"""


@case
def sensors_of_cameras(patch: Patch) -> Any:
    made = [cameras.Camera(name, Path("x.png"), (8, 6), 5.0, center, np.array(EYE, float))
            for name, center in (("view", (4, 3)), ("view", (3, 3)), ("b-c", (4, 2)))]  # fmt: skip
    found = []
    for text in (SENSORS, '<shape type="sphere"/>'):
        description = described(text)
        cameras.replace_sensors(description, made)
        found.append([lines(description.root), cameras.sensor_ids(description)])
    return found


@case
def repeated_sensors(patch: Patch) -> Any:
    found = []
    for order in ([0], [1, 0], [0, 0, 1, 1], [], [-1]):
        description = described(SENSORS)
        cameras.repeat_sensors(description, order)
        found.append(lines(description.root) if order == [0, 0, 1, 1] else cameras.sensor_ids(description))
    return [*found, ending(cameras.repeat_sensors, described(""), [])]


# ---- Values of parameters ----

FILM = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'
MESH = """ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z
property float r\nproperty float g\nproperty float b\nelement face 2\nproperty list uchar int vertex_indices
property float w\nend_header\n0 0 0 0.1 0.2 0.3\n1 0 0 0.4 0.5 0.6\n1 1 0 0.7 0.8 0.9\n0 1 0 0.3 0.2 0.1
3 0 1 2 0.5\n3 0 2 3 0.25\n"""
ROOM = f"""<sensor type="perspective" id="camera">{FILM}</sensor>
<shape type="rectangle" id="floor"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
<string name="filename" value="rgb.exr"/></texture></bsdf></shape>
<shape type="rectangle" id="wall"><bsdf type="roughplastic"><texture type="bitmap" name="diffuse_reflectance">
<string name="filename" value="bytes.png"/></texture></bsdf></shape>
<shape type="rectangle" id="door"><bsdf type="blendbsdf"><texture type="bitmap" name="weight">
<string name="filename" value="grey.exr"/><boolean name="raw" value="true"/></texture><bsdf type="diffuse"/>
<bsdf type="roughconductor"><float name="alpha" value="0.3"/></bsdf></bsdf></shape>
<shape type="ply" id="quilt"><string name="filename" value="quilt.ply"/><bsdf type="diffuse">
<rgb name="reflectance" value="0.2 0.3 0.4"/></bsdf></shape>
<shape type="sphere" id="ball"><bsdf type="principled"><float name="spec_trans" value="0"/></bsdf></shape>
<shape type="sphere" id="glass"><bsdf type="dielectric"/></shape>
<emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>
<emitter type="point" id="bulb"><rgb name="intensity" value="3"/></emitter>
<emitter type="directional" id="sun"/>"""


def made_room() -> Any:
    """Write the files of a room, and return its scene."""
    picture("rgb.exr", 3, 4, 3)
    picture("bytes.png", 2, 2, 3, kind=np.uint8)
    picture("grey.exr", 2, 3, 1)
    picture("sky.exr", 3, 6, 3)
    picture("wide.exr", 4, 8, 3, seed=1)
    Path("quilt.ply").write_text(MESH)
    described(ROOM)
    return load.load_scene(Path("scene.xml"))


@case
def initial_values(patch: Patch) -> Any:
    params, found = mi.traverse(made_room()), []
    place = Place("c.yaml", "parameters[0]")
    keys = ("floor.bsdf.reflectance.data", "door.bsdf.weight.data", "quilt.bsdf.reflectance.value",
            "quilt.vertex_color", "quilt.face_weight", "sky.data", "sky.scale", "bulb.intensity.value",
            "wall.bsdf.alpha")  # fmt: skip
    for key in [key for key in keys if key in params.properties]:
        slot = ParameterValue(params, key)
        found.append([key, slot.get().shape, slot.is_texture, slot.halo, slot.is_signed, slot.channels, slot.is_data])
        several = ("scene", 0.5, math.nan, [1, 2, 3], [1], [1, math.inf, 2], np.array(2.0), np.ones(3), np.ones((2, 2)))
        sizes = ((2, 2), (8, 4), (1, 4), (2, 1), (3, 2))
        for given in [*((each, None) for each in several), *(("scene", size) for size in sizes)]:
            array = ending(values.initial_array, slot, *given, place)
            found.append(array if isinstance(array, str) else [array.shape, float(array.sum())])
        array = slot.get()
        slot.set(array * 2)
        found.append(bool(np.allclose(slot.get(), array * 2)))
    return found


@case
def values_of_files(patch: Patch) -> Any:
    made_room()
    params = mi.traverse(load.load_scene(Path("scene.xml")))
    found = []
    for key in ("floor.bsdf.reflectance.data", "door.bsdf.weight.data", "quilt.bsdf.reflectance.value", "sky.data"):
        for name in ("rgb.exr", "bytes.png", "grey.exr", "wide.exr", "gone.exr"):
            for more in ("", ", resolution: [4, 3]", ", initial.color_space: linear"):
                given = f"{{key: {key}, initial: {{file: {name}{', color_space: linear' if 'color' in more else ''}}}}}"
                text = given if "resolution" not in more else given.replace("}}", "}, resolution: [4, 3]}")
                spec = loads(CONFIG, Path("c.yaml"), [f"parameters=[{text}]"]).parameters[0].settings()
                slot = ParameterValue(params, key)
                array = ending(
                    values.initial_array, slot, spec.initial, spec.resolution, Place("c.yaml", "parameters[0]")
                )
                found.append(array if isinstance(array, str) else [array.shape, round(float(array.sum()), 4)])
    return found


CONFIG = "scene: {file: scene.xml}\ntarget: {render: {}}\nparameters: [{key: a}]\n"


@case
def bounds_and_transforms(patch: Patch) -> Any:
    params = mi.traverse(made_room())
    place, found = Place("c.yaml", "parameters[0]"), []
    for key, array in (
        ("floor.bsdf.reflectance.data", np.array([[[0.0, 0.5, 1]]])),
        ("bulb.intensity.value", np.array([1.0, 2, 3])),
    ):
        slot = ParameterValue(params, key)
        for bounds in ((0, 1), (0, 3), (0.1, 9), (1, 3)):
            found.append(ending(values.check_bounds, slot, array, bounds, place))
            for transform in ("none", "log", "sigmoid"):
                spec = ParameterSpec(key=key, transform=transform, bounds=bounds)
                found.append(ending(values.check_transform, slot, array, spec.settings(), place))
    return found


@case
def chosen_parameters(patch: Patch) -> Any:
    """Parameters by key, glob and list, motions and heightmaps, alone and together, and why others are refused."""
    scene = made_room()
    reflectance, colour = "floor.bsdf.reflectance.data", "quilt.bsdf.reflectance.value"
    rows: list[list[dict[str, Any]]] = [
        [{"key": reflectance}], [{"key": "*.reflectance.*"}], [{"key": "nothing*"}],
        [{"key": "floor.bsdf.reflectence.data"}],
        [{"key": colour}, {"key": "quilt.*"}], [{"key": "camera.*"}], [{"key": "camera.film.size"}],
        [{"key": [colour, "bulb.intensity.value"]}], [{"key": [colour, reflectance]}], [{"key": ["quilt.*", colour]}],
        [{"key": "wall.bsdf.diffuse_reflectance.data"}], [{"key": reflectance, "resolution": [6, 5]}],
        [{"key": colour, "resolution": [6, 5]}], [{"key": "ball.bsdf.spec_trans.value"}],
        [{"key": "ball.bsdf.spec_trans.value", "bounds": [0, 1]}], [{"key": colour, "bounds": [0.25, 1]}],
        [{"key": colour, "precondition": 3.0}], [{"key": reflectance, "precondition": 3.0}],
        [{"key": colour, "regularizers": [{"type": "total_variation", "weight": 1}]}],
        [{"motion": {"of": "ball"}}], [{"motion": {"of": "sky"}}], [{"motion": {"of": "nothing"}}],
        [{"motion": {"of": "sun"}}], [{"motion": {"of": "sun", "free": ["translation"]}}],
        [{"motion": {"of": "bulb", "free": ["rotation"]}}], [{"motion": {"of": "bulb", "free": ["scale"]}}],
        [{"motion": {"of": ["ball", "quilt"], "free": ["translation"]}}, {"motion": {"of": "ball", "free": ["scale"]}}],
        [{"motion": {"of": "quilt"}}, {"key": "quilt.vertex_positions"}], [{"key": "floor.translation"}],
        *([{"heightmap": {"mesh": mesh, "resolution": [3, 3]}}] for mesh in ("quilt", "ball")),
        [{"key": "quilt.heightmap"}], [{"key": colour, "initial": [1, 2]}],
        *([{"tint": name}] for name in (reflectance, colour, "wall.bsdf.diffuse_reflectance.data", "sky.data")),
        [{"tint": reflectance}, {"key": "*.reflectance.*"}], [{"tint": "*.reflectance.*"}],
        [{"key": colour, "transform": "log", "initial": 0}],
    ]  # fmt: skip
    found = []
    for row in rows:
        made = ending(lambda: select_parameters(scene, [ParameterSpec(**each) for each in row], "c.yaml"))  # noqa: B023
        if not isinstance(made, str):
            bounds = {key: [*map(float, made.specs[key].bounds or ())] for key in made.keys}
            shapes = {key: made.array(key).shape for key in made.keys}
            made = [made.keys, made.tied, made.scene_keys, bounds, shapes]
        found.append([str(row), made])
    return found


@case
def listed_parameters(patch: Patch) -> Any:
    params = mi.traverse(made_room())
    found = {info.key: [said.plain(info), catalog.owner_of(params, info.key), catalog.coarse_bits(params, info.key)]
             for info in catalog.list_parameters(params, values=True)}  # fmt: skip
    names = {shape.id(): proposal._file_name(shape) for shape in load.load_scene(Path("scene.xml")).shapes()}
    return found, names


# ---- Files ----


@case
def files_of_experiments(patch: Patch) -> Any:
    made_room()
    Path("part").mkdir()
    shutil.copy("rgb.exr", "part/rgb.exr")
    Path("part/more.xml").write_text('<scene version="3.0.0"><texture type="bitmap" id="t"><string name="filename" '
                                     'value="rgb.exr"/></texture></scene>')  # fmt: skip
    described(f'{ROOM}<include filename="part/more.xml"/>')
    frames = [
        {"file_path": f"{name}.exr", "transform_matrix": EYE, "w": 8, "h": 6, "fl_x": 5} for name in ("rgb", "gone")
    ]
    Path("t.json").write_text(json.dumps({"frames": frames}))
    found = []
    for sets in ((), ("target={file: wide.exr}",), ("scene.cameras=t.json",), ("scene.file=gone.xml",),
                 ("parameters=[{key: a, initial: {file: wide.exr}}]",)):  # fmt: skip
        made = ending(lambda: files_of(loads(CONFIG, Path("c.yaml"), sets)))  # noqa: B023
        found.append(made if isinstance(made, str) else {key: os.path.relpath(path) for key, path in made.items()})
    return found


@case
def smaller_photographs(patch: Patch) -> Any:
    """Bytes with and without transparent and clipped pixels, 16 bits, floats with NaN, and raw layers."""
    rng = np.random.default_rng(3)
    plain = rng.integers(0, 255, (4, 6, 3)).astype(np.uint8)
    plain[0, 0, 1] = 255
    clear = np.concatenate([plain, np.full((4, 6, 1), 255, np.uint8)], 2)
    clear[3, 5, 3] = 0
    floats = rng.uniform(0, 2, (4, 6, 3)).astype(np.float32)
    floats[1, 1, 1] = np.nan
    for name, pixels in (
        ("a.png", plain),
        ("b.png", clear),
        ("c.png", plain.astype(np.uint16) * 257),
        ("d.exr", floats),
    ):
        mi.Bitmap(pixels).write(name)
    layers = np.concatenate([floats, 2 * floats[:, :, :1]], 2)
    for name, pixels, names in (("e.exr", floats, ["x", "y", "z"]), ("f.exr", layers, ["R", "G", "B", "depth"])):
        mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, names).write(name)
    found = []
    for name in ("a.png", "b.png", "c.png", "d.exr", "e.exr", "f.exr"):
        photo = images.read_stored(Path(name), upright=True)
        for raw in (False, True):
            path = Path(f"small-{raw}-{name}")
            fault = ending(proposal.write_smaller, photo, (3, 2), path, raw)
            bitmap = mi.Bitmap(str(path)) if path.exists() else None
            tagged = path.exists() and [tag for tag in ("gAMA", "sRGB", "cHRM") if tag.encode() in path.read_bytes()]
            found.append([name, raw, fault, bitmap and [str(bitmap.component_format()), np.array(bitmap)], tagged])
    return found


@case
def colour_profiles(patch: Patch) -> Any:
    """Names of profiles that differ from sRGB, and colours that they convert."""
    colours = np.arange(0, 256, 51, dtype=np.uint8).reshape(1, 2, 3)
    found: list[Any] = [images.foreign_profile(b""), images.foreign_profile(b"x" * 200)]
    for space, gamma in itertools.product(("grey", "sRGB", "Display P3"), (1.0, 1.8, 2.2)):
        profile = profile_of(space, gamma)
        given = colours[:, :, :1] if space == "grey" else colours
        found.append([space, gamma, images.foreign_profile(profile), images._converted(given, profile)])
    return found


# ---- Scenes in memory, and scenes that are wrong ----


@case
def wrong_scenes(patch: Patch) -> Any:
    Path("broken.ply").write_text(MESH.replace("3 0 2 3", "3 0 2 9"))
    ball, lamp, eye = '<shape type="sphere"/>', '<emitter type="point"/>', f'<sensor type="perspective">{FILM}</sensor>'
    far = '<shape type="sphere"><float name="radius" value="{}"/><point name="center" x="{}"/></shape>'
    mesh = '<shape type="ply" id="m"><string name="filename" value="broken.ply"/></shape>'
    lines: list[str] = []
    patch.setattr(load, "warn_once", lambda line, level=0: lines.append(line))
    found = []
    places = ((1, 1e5), (1, 10), (1e-5, 0), (1e-2, 0))
    for text in (ball + lamp + eye, ball + lamp, ball + eye, lamp + eye, mesh + lamp + eye,
                 *(far.format(*each) + lamp + eye for each in places)):  # fmt: skip
        described(text)
        found.append(ending(lambda: type(load.load_scene(Path("scene.xml"))).__name__))
    return found, lines


@case
def equal_values(patch: Patch) -> Any:
    T = mi.ScalarTransform4f
    F, tensor = mi.Float, mi.TensorXf
    pairs = ((1, 1), (1, 2), (1.0, 1), (F(1, 2), F(1, 2)), (F(1, 2), F(1, 3)), (F(1, 2), F(1)),
             (F(math.nan), F(math.nan)),
             (mi.UInt32(1), mi.UInt32(1)), (T(), T().translate([1, 0, 0])), (T(), T()),
             (tensor([1.0, 2], (1, 2)), tensor([1.0, 2], (2, 1))))  # fmt: skip
    return [load._equal(*pair) for pair in pairs]


@case
def restored_scenes(patch: Patch) -> Any:
    scene = made_room()
    held = load.SceneInMemory(scene, "c.yaml")
    params = mi.traverse(scene)

    def numbers(params: Any) -> list[Any]:
        return [np.array(getattr(params[key], "matrix", params[key])) for key in ("sky.data", "ball.to_world")]

    before = numbers(params)
    params["sky.data"] = params["sky.data"] * 2
    params["bulb.intensity.value"] = mi.Color3f(9)
    dr.enable_grad(params["quilt.vertex_positions"])
    params.update()
    uses = held.uses
    params = mi.traverse(held.restore())
    same = [bool((a == b).all()) for a, b in zip(before, numbers(params), strict=True)]
    return [same, np.array(params["bulb.intensity.value"]), dr.grad_enabled(params["quilt.vertex_positions"]),
            held.uses - uses]  # fmt: skip


@case
def merged_scenes(patch: Patch) -> Any:
    ball = {"type": "sphere", "bsdf": {"type": "diffuse"}}
    parts = {"type": "scene", "a": ball, "b": {**ball, "center": [2, 0, 0]}, "lamp": {"type": "point"},
             "camera": {"type": "perspective"}}  # fmt: skip
    named = {"type": "ref", "id": "paint"}  # a material that the user shares is no merged one
    shared = {"type": "scene", "paint": {"type": "diffuse"}} | parts | {"a": {**ball, "bsdf": named}}
    shared["b"] = {**parts["b"], "bsdf": named}
    found = []
    for optimize, whole in itertools.product((False, True), (parts, shared)):
        held = load.SceneInMemory(mi.load_dict(whole, optimize=optimize), "c.yaml")
        keys = sorted(key for key in mi.traverse(held.scene).properties if "reflectance" in key)
        for wanted, objects in ((keys, []), (keys[:1], []), (["b.bsdf.reflectance.value"], []), (["gone.*"], []),
                                ([], ["a"]), ([], ["lamp"]), ([], ["gone"])):  # fmt: skip
            found.append(ending(held.check_merged, wanted, objects, "c.yaml"))
    return found


test_cases = pytest.mark.usefixtures("llvm")(case.test())
