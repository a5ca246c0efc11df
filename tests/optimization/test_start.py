"""Heightmaps that begin by transport: as `reslrb lens` has them, wherever the scene stands, and what is refused."""

from __future__ import annotations

import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from click.testing import CliRunner

from reslrb_cli.cli.lens import command
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization import start
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.records.checkpoint import STATE_FILE, open_state
from reslrb_cli.records.images import write_file
from reslrb_cli.records.tree import Stored
from reslrb_cli.runs.prepare import Course
from reslrb_cli.scene.images import read_image

pytestmark = pytest.mark.usefixtures("llvm")

OPTIONS = {
    "lens": [],
    "mirror": ["--mirror", "--tilt", "0", "15"],
    "near": ["--light-distance", "400", "--tilt", "10", "15", "--thickness", "40"],
    "round": ["--outline", "round"],
}
START = "{transport: {receiver: screen, floor: 0.2}}"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What `reslrb lens` writes of a picture without symmetry, by kind."""
    folder = tmp_path_factory.mktemp("start")
    y, x = np.mgrid[:32, :32] / 32
    blob = np.exp(-((x - 0.25) ** 2 + (y - 0.2) ** 2) / 0.02) + 0.5 * np.exp(-((x - 0.8) ** 2 + (y - 0.4) ** 2) / 0.02)
    picture = np.repeat((0.3 + 0.7 * blob)[:, :, None], 3, 2).astype(np.float32)
    write_file(folder / "p.exr", picture, linear=True)
    for kind, options in OPTIONS.items():
        args = [str(folder / "p.exr"), "-o", str(folder / kind), "--pixels", "32", "--floor", "0.2", *options]
        assert CliRunner().invoke(command, args, catch_exceptions=False).exit_code == 0
    return {kind: folder / kind for kind in OPTIONS}


def begun(folder: Path, *sets: str, initial: str = START) -> Problem:
    """The problem in `folder`, its face where it begins."""
    problem = assemble_scene(load(folder / "lens.yaml", [f"parameters.0.initial={initial}", *sets]))
    starts = start.prepare(problem)
    return start.begin(make_targets(problem, print), starts, print)


def heights(problem: Problem) -> np.ndarray:
    """Of the face, about their middle."""
    found = problem.selection.array("face.heightmap")[:, :, 0]
    assert np.array_equal(found, np.array(problem.optimizer["face.heightmap"])[:, :, 0])
    return found - found.mean()


def expected(folder: Path) -> np.ndarray:
    """What `reslrb lens` begins with, about its middle."""
    found = read_image(folder / "start.exr", "linear", signed=True)[:, :, 0]
    return found - found.mean()


def copied(folder: Path, to: Path) -> ElementTree.Element:
    """A copy of an experiment; its scene, to be changed and written by `put`."""
    shutil.copytree(folder, to)
    return ElementTree.parse(to / "scene.xml").getroot()


def put(root: ElementTree.Element, folder: Path) -> Path:
    ElementTree.ElementTree(root).write(folder / "scene.xml")
    return folder


def by_id(root: ElementTree.Element, id: str) -> ElementTree.Element:
    found = root.find(f".//*[@id='{id}']")
    assert found is not None
    return found


def replaced(root: ElementTree.Element, id: str, text: str) -> None:
    """The scene with another object in place of `id`."""
    root.remove(by_id(root, id))
    root.append(ElementTree.fromstring(text))


def moved(folder: Path, to: Path, scale: float) -> Path:
    """An experiment whose whole scene is turned, scaled and moved."""
    root, matrix = copied(folder, to), np.eye(4)
    axis = np.array([1.0, 2, -1]) / np.sqrt(6)
    cross = np.cross(np.eye(3), -axis)
    turn = np.eye(3) + np.sin(0.9) * cross + (1 - np.cos(0.9)) * cross @ cross
    matrix[:3, :3], matrix[:3, 3] = scale * turn, scale * np.array([30.0, -20, 70])
    for lookat in root.iter("lookat"):
        for name in ("origin", "target", "up"):
            point = np.array([float(each) for each in lookat.attrib[name].split(",")])
            point = turn @ point if name == "up" else matrix[:3, :3] @ point + matrix[:3, 3]
            lookat.set(name, ", ".join(f"{each:.9g}" for each in point))
    for element in root.iter("matrix"):
        was = np.array([float(each) for each in element.attrib["value"].split()]).reshape(4, 4)
        element.set("value", " ".join(f"{each:.9g}" for each in (matrix @ was).ravel()))
    for element in root.iter("float"):
        if element.attrib["name"].endswith("_clip"):
            element.set("value", f"{scale * float(element.attrib['value']):.9g}")
    for element in root.iter("rgb"):
        if element.attrib["name"] == "intensity":
            element.set("value", f"{scale**2 * float(element.attrib['value']):.9g}")
    transform = ElementTree.SubElement(by_id(root, "face"), "transform", name="to_world")
    ElementTree.SubElement(transform, "matrix", value=" ".join(f"{each:.9g}" for each in matrix.ravel()))
    return put(root, to)


@pytest.mark.parametrize("kind", OPTIONS)
def test_it_is_where_the_command_begins(kind: str, written: dict[str, Path]) -> None:
    found, wanted = heights(begun(written[kind])), expected(written[kind])
    assert np.abs(found - wanted)[8:-8, 8:-8].max() < 0.01 * np.ptp(wanted)


@pytest.mark.parametrize(("kind", "scale"), [("lens", 1e-3), ("mirror", 40.0), ("near", 0.1)])
def test_a_scene_that_is_turned_and_scaled_begins_so_too_and_throws_its_target(
    kind: str, scale: float, written: dict[str, Path], tmp_path: Path
) -> None:
    # what keeps the faces apart is in millimetres, which the scene is not in any more
    problem = begun(moved(written[kind], tmp_path / "moved", scale), "parameters[0].regularizers=[]")
    wanted = expected(written[kind])
    assert np.abs(heights(problem) / scale - wanted).max() < 0.01 * np.ptp(wanted)
    image = np.array(mi.render(problem.scene, spp=256, seed=1, integrator=mi.load_dict({"type": "ptracer"})))[:, :, 1]
    target = np.array(problem.views[0].target)[:, :, 1]
    turns = [target, target[::-1], target[:, ::-1], target[::-1, ::-1], target.T]
    likeness = [np.corrcoef(image.ravel(), turn.ravel())[0, 1] for turn in turns]
    assert likeness[0] > 0.99
    assert likeness[0] > max(likeness[1:]) + 0.05
    assert image.sum() == pytest.approx(target.sum(), rel=0.03)


def test_a_camera_that_looks_askew_sees_the_same_target(written: dict[str, Path], tmp_path: Path) -> None:
    root = copied(written["lens"], tmp_path / "askew")
    lookat = next(root.iter("lookat"))
    origin, target = (
        np.array([float(each) for each in lookat.attrib[name].split(",")]) for name in ("origin", "target")
    )
    lookat.set("origin", ", ".join(f"{each:.9g}" for each in origin + 0.35 * np.linalg.norm(target - origin)))
    lookat.set("up", "1, 0.1, 0")
    next(each for each in root.iter("float") if each.attrib["name"] == "fov").set("value", "75")
    for name in ("resx", "resy"):
        next(each for each in root.iter("default") if each.attrib["name"] == name).set("value", "80")
    folder = put(root, tmp_path / "askew")
    shown = assemble_scene(load(folder / "lens.yaml"))  # it stands at the command's heights
    image = np.array(mi.render(shown.scene, spp=1024, seed=2, integrator=mi.load_dict({"type": "ptracer"})))
    write_file(folder / "target.exr", image.astype(np.float32), linear=True)
    problem = assemble_scene(load(folder / "lens.yaml", [f"parameters.0.initial={START}"]))
    [begins] = start.prepare(problem)
    receiver, _ = begins._picture(problem.scene, image[:, :, 1].astype(np.float64))
    assert receiver.size == pytest.approx((100, 100), abs=5)  # the picture's, within two of the film's pixels
    assert np.hypot(*receiver.middle[:2]) < 3
    start.begin(make_targets(problem, print), [begins], print)
    again = np.array(mi.render(problem.scene, spp=256, seed=3, integrator=mi.load_dict({"type": "ptracer"})))
    assert np.corrcoef(again[:, :, 1].ravel(), image[:, :, 1].ravel())[0, 1] > 0.97


def test_a_rectangle_with_a_grid_begins_as_a_mesh_does(written: dict[str, Path], tmp_path: Path) -> None:
    root = copied(written["lens"], tmp_path / "grid")
    replaced(root, "face", '<shape type="rectangle" id="face"><boolean name="face_normals" value="true"/>'
             '<transform name="to_world"><scale value="50"/></transform><ref id="glass"/></shape>')  # fmt: skip
    found = heights(begun(put(root, tmp_path / "grid"), "parameters.0.heightmap.grid=96"))
    assert np.abs(found - expected(written["lens"])).max() < 0.01 * np.ptp(found)


def test_a_small_lamp_is_as_a_point_light(written: dict[str, Path], tmp_path: Path) -> None:
    root = copied(written["near"], tmp_path / "area")
    look = next(by_id(root, "beam").iter("lookat")).attrib
    replaced(root, "beam", '<shape type="disk" id="bulb"><transform name="to_world"><scale value="2"/>'
             f'<lookat origin="{look["origin"]}" target="{look["target"]}" up="0, 1, 0"/></transform>'
             '<emitter type="area"><rgb name="radiance" value="9"/></emitter></shape>')  # fmt: skip
    found = heights(begun(put(root, tmp_path / "area")))
    assert np.abs(found - expected(written["near"])).max() < 0.03 * np.ptp(found)


def test_light_that_meets_the_face_first_leaves_by_the_plane_behind_it(
    written: dict[str, Path], tmp_path: Path
) -> None:
    root = copied(written["lens"], tmp_path / "reversed")
    root.remove(by_id(root, "lamp"))
    root.append(ElementTree.fromstring(
        '<emitter type="directional" id="sky"><vector name="direction" x="0" y="0" z="-1"/>'
        '<rgb name="irradiance" value="4"/></emitter>'))  # fmt: skip
    root.remove(by_id(root, "screen"))
    root.append(ElementTree.fromstring(
        '<shape type="rectangle" id="screen"><transform name="to_world"><scale value="150"/>'
        '<translate z="-225"/></transform><bsdf type="diffuse"/></shape>'))  # fmt: skip
    lookat = next(root.iter("lookat"))
    lookat.set("origin", "0, 0, -75")
    lookat.set("target", "0, 0, -225")
    problem = begun(put(root, tmp_path / "reversed"))
    image = np.array(mi.render(problem.scene, spp=512, seed=1, integrator=mi.load_dict({"type": "ptracer"})))[:, :, 1]
    target = np.array(problem.views[0].target)[:, :, 1]
    assert np.corrcoef(image.ravel(), target.ravel())[0, 1] > 0.95


LAMP = '<emitter type="{}" id="second"><rgb name="{}" value="1"/></emitter>'
SPHERE = (
    '<shape type="sphere" id="{}"><float name="radius" value="{}"/><point name="center" x="0" y="0" z="{}"/>{}</shape>'
)

REFUSALS = {
    "no lamp": (
        "beam",
        '<emitter type="point" id="out"><rgb name="intensity" value="0"/></emitter>',
        "",
        "takes a lamp, and the scene has none",
    ),
    "several lamps": (None, LAMP.format("point", "intensity"), "", "`beam`, `second`; name one by `lamp`"),
    "sky": ("lamp", LAMP.format("constant", "radiance"), "", "`second` is a ConstantBackgroundEmitter"),
    "curved receiver": (
        "screen", SPHERE.format("screen", 150, 300, '<bsdf type="diffuse"/>'), ".receiver", "`screen` is a Sphere",
    ),
    "no receiver": ("screen", None, ".receiver", "`screen` is no shape of the scene; it has `back`"),
    "curved glass": ("back", SPHERE.format("back", 20, -20, '<ref id="glass"/>'), "", "`back`, before it, is curved"),
    "receiver beside": (
        "screen",
        '<shape type="rectangle" id="screen"><transform name="to_world"><scale value="100"/><rotate y="1" angle="-90"/>'
        '<translate x="600" y="0" z="100"/></transform><bsdf type="diffuse"/></shape>', "", "cannot be",
    ),
    "light along the face": (
        "lamp", '<emitter type="directional" id="low"><vector name="direction" x="1" y="0" z="0.01"/></emitter>', "",
        "the light of `low` comes along `face`",
    ),
    "receiver on the lamp's side": (
        "lamp", '<emitter type="directional" id="high"><vector name="direction" x="0" y="0" z="-1"/></emitter>', "",
        "stands on the side of `face` that `high` is on",
    ),
    "two planes": (
        None, '<shape type="rectangle" id="third"><transform name="to_world"><scale value="50"/><translate z="-10"/>'
        '</transform><ref id="glass"/></shape>', "", "`back` and `third`",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSALS)
def test_what_cannot_be_is_refused_at_its_key_before_anything_is_rendered(
    name: str, written: dict[str, Path], tmp_path: Path
) -> None:
    gone, new, option, message = REFUSALS[name]
    root = copied(written["lens"], tmp_path / "no")
    if gone is not None:
        parent = next(each for each in root.iter() if by_id(root, gone) in list(each))
        parent.remove(by_id(root, gone))
    if new is not None:
        root.append(ElementTree.fromstring(new))
    if name == "receiver beside":
        look = next(root.iter("lookat"))
        look.set("origin", "300, 0, 100")
        look.set("target", "600, 0, 100")
    problem = assemble_scene(load(put(root, tmp_path / "no") / "lens.yaml", [f"parameters.0.initial={START}"]))
    with pytest.raises(ConfigError) as caught:
        start.prepare(problem) if name != "receiver beside" else begun(tmp_path / "no")
    assert caught.value.key == f"parameters[0].initial.transport{option}"
    assert message in caught.value.message
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("initial", "key", "message"), [
    ("{transport: {}}", "parameters[0].initial.transport.receiver", ""),
    ("{transport: {receiver: screen, floor: 1}}", "parameters[0].initial.transport.floor", "below 1"),
    ("{transport: {receiver: screen, floor: low}}", "parameters[0].initial.transport.floor", "auto"),
])  # fmt: skip
def test_wrong_settings_are_located(initial: str, key: str, message: str, written: dict[str, Path]) -> None:
    with pytest.raises(ConfigError) as caught:
        load(written["lens"] / "lens.yaml", [f"parameters.0.initial={initial}"])
    assert caught.value.key == key
    assert message in caught.value.message


def test_a_curved_face_is_refused(written: dict[str, Path], tmp_path: Path) -> None:
    folder = put(copied(written["lens"], tmp_path / "curved"), tmp_path / "curved")
    mesh = mi.load_dict({"type": "ply", "filename": str(folder / "face.ply")})
    params = mi.traverse(mesh)
    at = np.array(params["vertex_positions"]).reshape(-1, 3)
    at[:, 2] = (at[:, 0] / 50) ** 2
    params["vertex_positions"] = at.ravel()
    params.update()
    mesh.write_ply(str(folder / "face.ply"))
    with pytest.raises(ConfigError, match="`face` is curved"):
        begun(folder)


def test_of_two_faces_one_may_ask(written: dict[str, Path], tmp_path: Path) -> None:
    folder = put(copied(written["lens"], tmp_path / "two"), tmp_path / "two")
    text = (folder / "lens.yaml").read_text()
    again = f"  - heightmap: {{mesh: back, resolution: [8, 8], grid: 8}}\n    initial: {START}\n"
    (folder / "lens.yaml").write_text(text.replace("integrator:", again + "integrator:", 1))
    with pytest.raises(ConfigError) as caught:
        begun(folder)
    assert caught.value.key == "parameters[1].initial.transport"


def test_bounds_that_exclude_it_are_refused(written: dict[str, Path]) -> None:
    with pytest.raises(ConfigError) as caught:
        begun(written["lens"], "parameters.0.bounds=[-0.1, 0.1]")
    assert caught.value.key == "parameters[0].bounds"


def test_a_run_that_is_gone_on_with_has_the_start_that_it_had(
    written: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load(
        written["round"] / "lens.yaml",
        [f"parameters.0.initial={START}", "integrator.guiding=off", "integrator.sequence=independent"],
    )
    first = assemble(config)
    Course(first, mi.variant()).save(tmp_path)

    def made_anew(*_: object) -> None:
        raise AssertionError("the start is made anew")

    monkeypatch.setattr(start, "_read", made_anew)
    again = assemble(config, settled=Stored(*open_state(tmp_path / STATE_FILE)))
    assert np.array_equal(heights(again), heights(first))
