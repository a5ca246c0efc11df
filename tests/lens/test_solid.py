"""Solids are closed, have the volume that the heights define, and can be read by other code. Impossible solids are
refused.
"""

from __future__ import annotations

import contextlib
import io
import json
import locale
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from cli.tiny import done, reslrb
from turns import a_few

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.errors import ConfigError, ExitCode
from reslrb_cli.lens import solid as solids
from reslrb_cli.lens.solid import Sheet, as_sheet, make_solid, measured
from reslrb_cli.runs import export
from reslrb_cli.scene.images import read_image

SIZE = (60.0, 40.0)
Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]


def ripples(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 2 * np.sin(x / 7) * np.cos(y / 5 + 0.3) + 0.02 * x


def grid(heights: Heights, nx: int = 61, ny: int = 41, size: tuple[float, float] = SIZE) -> tuple[Any, Any]:
    """Return the vertices and triangles of a face."""
    x, y = np.meshgrid(*(np.linspace(-s / 2, s / 2, n) for s, n in zip(size, (nx, ny), strict=True)))
    at = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    cells = [np.stack([at, at + 1, at + nx + 1], 1), np.stack([at, at + nx + 1, at + nx], 1)]
    return np.stack([x, y, heights(x, y)], -1).reshape(-1, 3), np.concatenate(cells)


def sheet(heights: Heights = ripples, *shape: int, name: str = "face") -> Sheet:
    return as_sheet(name, *grid(heights, *shape))


def plan(**options: Any) -> Fabrication:
    return Fabrication(**{"thickness": 8.0, **options})


#: For each solid of a height field: its options, and the area around the face.
SHAPES: dict[str, tuple[dict[str, Any], float]] = {
    "rectangle": ({}, 0.0),
    "rim": ({"rim": 5.0}, 70.0 * 50 - 60 * 40),
    "round": ({"outline": "round"}, 0.0),
    "round, rim": ({"outline": "round", "rim": 5.0}, np.pi * (35 * 25 - 30 * 20)),
    "mirror": ({"kind": "mirror"}, 0.0),
}


def integral(heights: Heights, outline: str) -> float:
    """Return the integral of the heights over the face in mm^3, by the midpoint rule on fine cells."""
    x, y = np.meshgrid(*((np.arange(600) + 0.5) / 600 * s - s / 2 for s in SIZE))
    inside = (2 * x / SIZE[0]) ** 2 + (2 * y / SIZE[1]) ** 2 <= 1 if outline == "round" else np.ones_like(x)
    return float(np.mean(heights(x, y) * inside) * SIZE[0] * SIZE[1])


def edge_heights(heights: Heights, outline: str) -> np.ndarray:
    t = np.linspace(0, 2 * np.pi, 20001)
    x, y = np.cos(t), np.sin(t)
    if outline == "rectangle":
        x, y = (v / np.maximum(np.abs(x), np.abs(y)) for v in (x, y))
    return heights(x * SIZE[0] / 2, y * SIZE[1] / 2)


@pytest.mark.parametrize("name", a_few(SHAPES, ["round, rim", "mirror"]))
def test_a_solid_is_closed_oriented_outward_and_has_the_volume_of_its_heights(name: str) -> None:
    options, beside = SHAPES[name]
    wanted = plan(**options)
    solid = make_solid(sheet(ripples, 241, 161), wanted)
    volume = integral(ripples, wanted.outline) - integral(lambda x, y: np.full_like(x, -8.0), wanted.outline)
    volume += beside * (edge_heights(ripples, wanted.outline).min() - 0.1 + 8)
    assert solid.volume == pytest.approx(volume, rel=1e-3)
    files = {"stl": solids.stl(solid), "ply": solids.ply_file(solid.points, solid.triangles)}
    for kind, content in files.items():
        read = trimesh.load(io.BytesIO(content), file_type=kind)
        assert read.is_watertight  # each edge belongs to two triangles
        assert read.is_winding_consistent  # in opposite directions
        assert read.euler_number == 2
        assert len(read.faces) == len(solid.triangles)
        assert read.area_faces.min() > 0
        assert read.volume == pytest.approx(volume, rel=1e-3)  # positive, since normals point outwards
        assert np.array(read.extents) == pytest.approx(solid.extent, rel=1e-6)


def test_stl_has_the_normals_of_its_triangles() -> None:
    content = solids.stl(make_solid(sheet(), plan()))
    records = np.frombuffer(content[84:], [("n", "<f4", 3), ("at", "<f4", (3, 3)), ("extra", "<u2")])
    assert int(np.frombuffer(content[80:84], "<u4")[0]) == len(records)
    read = trimesh.load(io.BytesIO(content), file_type="stl", process=False)
    assert np.sum(records["n"] * read.face_normals, axis=1) == pytest.approx(1, abs=1e-5)


def test_the_front_equals_the_traced_mesh() -> None:
    points, triangles = grid(ripples)
    shuffled = np.random.default_rng(3).permutation(len(points))
    inverse = np.argsort(shuffled)
    mixed = as_sheet("face", points[shuffled], inverse[triangles][:, ::-1])
    solid = make_solid(mixed, plan())
    corners = {tuple(sorted(map(tuple, solid.points[t]))) for t in solid.triangles}
    assert {tuple(sorted(map(tuple, points[t]))) for t in triangles} <= corners
    assert mixed.z == pytest.approx(sheet().z)


def test_a_round_outline_follows_its_ellipse() -> None:
    points, triangles = solids.cut_round(sheet(), (30, 20))
    edge = points[solids.edge_loop(triangles)]
    assert np.hypot(edge[:, 0] / 30, edge[:, 1] / 20) == pytest.approx(1, abs=1e-12)
    assert solids._areas(points, triangles).min() > 0
    # The face keeps its heights at the cut, up to the error of a vertex that was moved on a bent face.
    assert edge[:, 2] == pytest.approx(ripples(edge[:, 0], edge[:, 1]), abs=0.02)


@pytest.mark.parametrize("outline", ["rectangle", "round"])
@pytest.mark.parametrize("sign", [1, -1])
def test_radius_slope_and_relief_of_a_sphere_are_reported(sign: int, outline: str) -> None:
    radius = 90.0

    def cap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return sign * (radius - np.sqrt(radius**2 - x**2 - y**2))

    wanted = plan(outline=outline, thickness=9.0)
    made = sheet(cap)
    told = measured(make_solid(made, wanted), made, wanted)
    face = told["faces"]["face"]
    far = np.hypot(30, 20) if outline == "rectangle" else 30
    relief = radius - np.sqrt(radius**2 - far**2)
    assert face["relief"] == pytest.approx(relief, rel=2e-3)
    assert face["steepest_slope_degrees"] == pytest.approx(np.degrees(np.arcsin(far / radius)), rel=0.03)
    assert told["least_thickness"] == pytest.approx(9 if sign > 0 else 9 - relief, abs=0.01)
    if sign > 0:
        assert face["smallest_concave_radius"] == pytest.approx(radius, rel=2e-3)
    else:
        assert face["smallest_concave_radius"] is None
    assert solids.hollows(made, wanted).max() == pytest.approx(sign / radius, rel=2e-3)


def test_hollows_are_found_in_every_direction() -> None:
    wanted = plan()
    for angle in (0.0, 0.5, 1.1):

        def trough(x: np.ndarray, y: np.ndarray, angle: float = angle) -> np.ndarray:
            return (x * np.cos(angle) + y * np.sin(angle)) ** 2 / (2 * 25)

        # A parabola has its smallest radius where it is flat.
        assert 1 / solids.hollows(sheet(trough), wanted).max() == pytest.approx(25, rel=1e-3)


def test_heights_survive_16_bits() -> None:
    heights = sheet().z
    numbers, offset, step = solids.scaled(heights, np.ones(heights.shape, bool))
    assert numbers.dtype == np.uint16
    assert (numbers.min(), numbers.max()) == (0, 65535)
    assert np.abs(offset + step * numbers - heights).max() <= 0.5001 * step
    flat, offset, step = solids.scaled(np.full((3, 3), 2.5), np.ones((3, 3), bool))
    assert (flat.max(), offset, step) == (0, 2.5, 0)


def test_invalid_solids_are_refused() -> None:
    points, triangles = grid(ripples)
    torn, scattered, holed = points.copy(), points.copy(), triangles[:-7]
    torn[5, 2] = np.nan
    scattered[900, 0] += 0.3
    dome = sheet(lambda x, y: -(x**2) / 450)  # 2 mm deep at its edge
    cases: list[tuple[Callable[[], object], str]] = [
        (lambda: as_sheet("face", torn, triangles), "fabrication.face: `face` has vertices that are not finite"),
        (lambda: as_sheet("face", scattered, triangles), "vertices that are not on a grid"),
        (lambda: as_sheet("face", points[:-1], triangles[:10]), "vertices that are not on a grid"),
        (lambda: as_sheet("face", points, holed), "folds, or has holes"),
        (lambda: as_sheet("face", points, np.concatenate([triangles, triangles[:1, ::-1]])), "folds, or has holes"),
        (lambda: make_solid(dome, plan(thickness=1.5)),
         "fabrication.thickness: 1.5 mm: front and back overlap by 0.5 mm; it must be above 2"),
        (lambda: make_solid(dome, plan(thickness=2.05, rim=3.0)), "overlap by 0.05 mm"),
        (lambda: make_solid(as_sheet("face", points + np.array([1.0, 0, 0]), triangles), plan()), "must be at 0"),
        (lambda: make_solid(as_sheet("face", points + np.array([0, 0, 30.0]), triangles), plan()),
         "it must be about z = 0"),
    ]  # fmt: skip
    for make, line in cases:
        with pytest.raises(ConfigError) as error:
            make()
        assert line in str(error.value)
    assert make_solid(dome, plan(thickness=2.05)).volume > 0  # the overlap above comes from the rim


# ---- by the command


@pytest.fixture
def run(lens: Path) -> Path:
    """Folder of a lens run with one iteration from its start."""
    return lens / "runs/lens"


@pytest.mark.long
def test_the_folder_of_a_run_holds_the_solid_of_its_scene(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = done("export", run, "-o", out).output
    told = json.loads((out / "fabrication.json").read_text())
    face = mi.traverse(mi.load_file(str(out / "scene.xml"), optimize=False))
    points = np.array(face["face.vertex_positions"]).reshape(-1, 3)
    read = trimesh.load(out / "lens.stl")
    assert read.is_watertight
    assert told["volume_mm3"] == pytest.approx(read.volume, rel=1e-6)
    assert told["extent"] == pytest.approx(read.extents.tolist(), rel=1e-6)
    assert read.bounds[0, 2] == -25  # a quarter of the size
    corners = {tuple(point) for point in np.asarray(read.vertices, np.float32).tolist()}
    assert {tuple(point) for point in points.tolist()} <= corners
    assert "lens.stl: 75 x 100 x" in said
    # Heights as seen from the receiver's side, with y up.
    map = told["faces"]["face"]["heights"]
    wanted = points[:, 2].reshape(96, 72)[::-1]  # three vertices per pixel
    numbers = np.array(mi.Bitmap(str(out / "heights.png")))
    assert numbers.dtype == np.uint16
    step = map["png"]["step"]
    assert np.abs(map["png"]["offset"] + step * numbers.reshape(96, 72) - wanted).max() <= 0.51 * step
    exact = read_image(out / "heights.exr", "linear", signed=True)[:, :, 0]
    assert np.array_equal(exact, wanted)
    assert map["pitch"] == pytest.approx([75 / 71, 100 / 95])


def write_mesh(read: trimesh.Trimesh, path: Path) -> None:
    """Write the vertices and triangles of `read` as a PLY file with Mitsuba."""
    made = mi.Mesh("solid", len(read.vertices), len(read.faces))
    values = mi.traverse(made)
    values["vertex_positions"] = np.asarray(read.vertices, np.float32).ravel()
    values["faces"] = np.asarray(read.faces, np.uint32).ravel()
    values.update()
    made.write_ply(str(path))


def test_the_reloaded_solid_casts_the_image_of_the_scene(run: Path, tmp_path: Path) -> None:
    said = done("export", run, "-o", tmp_path / "out").output
    assert "interpolated" not in said
    read = trimesh.load(tmp_path / "out/lens.stl")
    assert read.is_watertight
    assert read.is_winding_consistent
    told = json.loads((tmp_path / "out/fabrication.json").read_text())
    heights = read_image(tmp_path / "out/heights.exr", "linear", signed=True)[:, :, 0].astype(np.float64)
    middles = (heights[1:, 1:] + heights[:-1, 1:] + heights[1:, :-1] + heights[:-1, :-1]) / 4
    assert read.volume == pytest.approx(75 * 100 * (25 + middles.mean()), rel=1e-3)
    assert told["volume_mm3"] == pytest.approx(read.volume, rel=1e-5)

    text = (tmp_path / "out/scene.xml").read_text()
    shown = mi.load_file(str(tmp_path / "out/scene.xml"), optimize=False)
    write_mesh(read, tmp_path / "out/made.ply")
    own, faces = re.subn(r'<shape type="\w+" id="(face|back)">.*?</shape>', "", text, flags=re.DOTALL)
    assert faces == 2
    made = """<shape type="ply"><string name="filename" value="made.ply"/><boolean name="face_normals" value="true"/>
        <ref id="glass"/></shape></scene>"""
    (tmp_path / "out/made.xml").write_text(own.replace("</scene>", made))
    solid = mi.load_file(str(tmp_path / "out/made.xml"), optimize=False)
    images = [np.array(mi.render(scene, spp=64, seed=1)) for scene in (shown, solid)]
    # The light paths are the same up to rounding.
    assert np.abs(images[0] - images[1]).mean() < 1e-3 * images[0].mean()
    target = np.array(mi.Bitmap(str(run.parents[1] / "lens/target.exr")))
    losses = [float(np.mean((image - target) ** 2)) for image in images]
    assert losses[1] == pytest.approx(losses[0], rel=0.02)
    # Every ray enters once and leaves once, so that no surfaces cross.
    x, y = (np.random.default_rng(3).uniform(-0.49, 0.49, (2, 4096)) * [[75], [100]]).astype(np.float32)
    ray, count = mi.Ray3f(mi.Point3f(x, y, 99), mi.Vector3f(0, 0, -1)), 0
    alone = mi.load_dict({"type": "scene", "it": {"type": "ply", "filename": str(tmp_path / "out/made.ply")}})
    for _ in range(3):
        si = alone.ray_intersect(ray)
        count = count + np.array(si.is_valid()).astype(int)
        ray = si.spawn_ray(ray.d)
    assert np.all(count == 2)


def test_interpolated_normals_give_a_warning(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "smooth"
    shutil.copytree(run.parents[1] / "lens", folder)
    scene = (folder / "scene.xml").read_text()
    assert scene.count('<boolean name="face_normals" value="true"/>') == 1
    (folder / "scene.xml").write_text(scene.replace('<boolean name="face_normals" value="true"/>', ""))
    said = done("export", run, "-o", tmp_path / "out", "--set", f"scene.file={folder}/scene.xml").output
    assert "`face` was shaped with interpolated normals, which a solid does not have" in said


def test_3mf_is_reloaded_in_millimetres(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("lib3mf")
    with contextlib.suppress(locale.Error):  # this locale may be missing
        locale.setlocale(locale.LC_CTYPE, "C.UTF-8")
    before = locale.setlocale(locale.LC_ALL)
    done("export", run, "-o", tmp_path / "out")
    assert locale.setlocale(locale.LC_ALL) == before
    with zipfile.ZipFile(tmp_path / "out/lens.3mf") as archive:
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    assert model.get("unit") == "millimeter"
    space = {"m": model.tag[1:].partition("}")[0]}
    points = [[float(v.get(axis, "")) for axis in "xyz"] for v in model.iterfind(".//m:vertex", space)]
    triangles = [[int(t.get(f"v{k}", "")) for k in (1, 2, 3)] for t in model.iterfind(".//m:triangle", space)]
    assert len(list(model.iterfind(".//m:build/m:item", space))) == 1
    read, other = trimesh.Trimesh(points, triangles), trimesh.load(tmp_path / "out/lens.stl")
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.volume == pytest.approx(other.volume, rel=1e-5)
    assert read.bounds == pytest.approx(other.bounds, abs=1e-4)
    assert np.sort(read.triangles_center, axis=0) == pytest.approx(np.sort(other.triangles_center, axis=0), abs=1e-3)
    pytest.importorskip("lxml")
    assert trimesh.load(tmp_path / "out/lens.3mf", force="mesh").volume == pytest.approx(read.volume)


def test_invalid_files_are_refused_in_one_line(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "_writes_3mf", lambda: False)
    for name, settings, line in (
        ("a.step", (), "a.step is the name of a file; give a folder, into which the solid is written as .stl and .3mf"),
        ("a.stl", (), "a.stl is the name of a file; give a folder"),
        ("out", ("fabrication.thickness=1",), "fabrication.thickness: 1 mm: front and back overlap by"),
        ("out", ("fabrication.face=plate",), "fabrication.face: there is no mesh `plate` in the scene"),
        ("out", ("fabrication.thickness=0",), "fabrication.thickness: must be"),
    ):
        options = [word for setting in settings for word in ("--set", setting)]
        result = reslrb("export", run, "-o", tmp_path / name, *options)
        assert isinstance(result.exception, ConfigError) or result.exit_code == ExitCode.USAGE
        assert line in f"{result.output}{result.exception}"
        assert not list(tmp_path.iterdir())
    # Without the section `fabrication`, the export writes a scene and tells how to get a solid.
    said = done("export", run, "-o", tmp_path / "bare", "--set", "fabrication=null").output
    assert "no solid was made of `face`: --set fabrication.thickness=25 makes one of that thickness" in said
    # A folder gets all files that can be written, and a line says which one is missing.
    section = ("--set", "fabrication=null", "--set", "fabrication.thickness=25")
    said = done("export", run, "-o", tmp_path / "out", *section).output
    assert "lens.3mf is not written: lib3mf is missing" in said
    assert trimesh.load(tmp_path / "out/lens.stl").is_watertight
    assert not (tmp_path / "out/lens.3mf").exists()
