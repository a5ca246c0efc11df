"""Exported scenes: Mitsuba alone reads the recovered values and renders the same image, for every kind of parameter."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from agreement import compare

from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene import export as replacing
from reslrb_cli.scene.export import export_scene
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.parameters import Selection, select_parameters
from reslrb_cli.scene.xml.read import Description

pytestmark = pytest.mark.usefixtures("llvm", "compared")
BITMAP = '<string name="filename" value="{}"/><string name="format" value="variant"/>'
EIGHT_BITS = '<string name="filename" value="{}"/>'
#: A scene with every way to specify a recoverable parameter: by number, colour, image, index, mesh and place. Objects
#: are with and without ids, referenced and included, in the scene's own folders and elsewhere.
SCENE = f"""<scene version="3.0.0">
<default name="resx" value="48"/> <default name="resy" value="32"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="$resx"/>
<integer name="height" value="$resy"/><string name="pixel_format" value="rgb"/><rfilter type="gaussian"/></film>
<transform name="to_world"><lookat origin="0, 5, 7" target="0, 0.3, 0" up="0, 1, 0"/></transform></sensor>
<texture type="bitmap" id="wood">{EIGHT_BITS.format("images/wood.png")}</texture>
<include filename="lights.xml"/>
<shape type="rectangle" id="floor"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
    <bsdf type="diffuse"><ref id="wood" name="reflectance"/></bsdf></shape>
<shape type="sphere"><point name="center" x="-2.4" y="0.6" z="0.5"/><float name="radius" value="0.6"/>
    <bsdf type="roughconductor"><string name="material" value="Cu"/><float name="alpha" value="0.3"/></bsdf></shape>
<shape type="sphere"><point name="center" x="-0.9" y="0.6" z="0.9"/><float name="radius" value="0.6"/>
    <bsdf type="roughdielectric"><string name="int_ior" value="bk7"/><float name="alpha" value="0.2"/></bsdf></shape>
<shape type="disk" id="pane"><transform name="to_world"><translate x="0.4" y="1" z="1"/></transform>
    <bsdf type="thindielectric"/></shape>
<shape type="cylinder"><transform name="to_world"><scale value="0.5"/><translate x="1.7"/></transform>
    <bsdf type="twosided"><bsdf type="principled"><rgb name="base_color" value="0.6 0.3 0.2"/>
    <float name="roughness" value="0.4"/></bsdf></bsdf></shape>
<shape type="obj" id="hill"><string name="filename" value="hill.obj"/><boolean name="flip_normals" value="true"/>
    <transform name="to_world"><translate x="2.6" y="0.4" z="0.5"/></transform>
    <bsdf type="twosided"><bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.2 0.5 0.3"/></bsdf>
    </bsdf></shape>
<shape type="ply" id="quilt"><string name="filename" value="quilt.ply"/>
    <transform name="to_world"><translate y="1.5" z="-2"/></transform><bsdf type="twosided"><bsdf type="diffuse">
    <texture type="mesh_attribute" name="reflectance"><string name="name" value="vertex_color"/></texture></bsdf></bsdf>
</shape>
<shape type="shapegroup" id="pair"><shape type="ply"><string name="filename" value="quilt.ply"/></shape>
    <shape type="sphere" id="bead"><float name="radius" value="0.2"/></shape>
    <shape type="ply"><string name="filename" value="quilt.ply"/></shape></shape>
<shape type="instance"><ref id="pair"/><transform name="to_world"><scale value="0.5"/><translate x="-2" y="2"/>
    </transform></shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.6"/><translate x="-3" y="1" z="-1"/></transform>
    <bsdf type="blendbsdf"><texture type="bitmap" name="weight"><string name="filename" value="$elsewhere/grey.exr"/>
    <boolean name="raw" value="true"/></texture><bsdf type="diffuse"/><bsdf type="conductor"/></bsdf>
    <float name="unheard_of" value="3"/></shape>
</scene>
"""
LIGHTS = f"""<scene version="3.0.0">
<shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="90"/><translate y="4"/></transform>
    <emitter type="area"><rgb name="radiance" value="5, 4, 3"/></emitter></shape>
<emitter type="envmap"><string name="filename" value="images/sky.exr"/><float name="scale" value="0.5"/>
    <transform name="to_world"><rotate y="1" angle="40"/></transform></emitter>
<emitter type="point"><point name="position" x="2" y="3" z="2"/><rgb name="intensity" value="6"/></emitter>
<emitter type="spot"><transform name="to_world"><lookat origin="-3, 4, 3" target="0, 0, 0" up="0, 1, 0"/></transform>
    <rgb name="intensity" value="20"/></emitter>
<emitter type="projector"><texture type="bitmap" name="irradiance">{BITMAP.format("$elsewhere/slide.exr")}</texture>
    <float name="scale" value="4"/>
    <transform name="to_world"><lookat origin="3, 4, 3" target="0, 0, 0" up="0, 1, 0"/></transform></emitter>
</scene>
"""
#: Each recovered parameter, and the amount that is added to its values.
KINDS: dict[str, tuple[dict[str, object], float]] = {
    "texture": ({"key": "floor.bsdf.reflectance.data"}, 0.2),
    "finer texture": ({"key": "floor.bsdf.reflectance.data", "resolution": [12, 10]}, 0.2),
    "colour": ({"key": "hill.bsdf.brdf_0.diffuse_reflectance.value"}, 0.3),
    "colour above 1": ({"key": "hill.bsdf.brdf_0.diffuse_reflectance.value"}, 0.9),
    "colour of a group": ({"key": "pair.shape.bsdf.reflectance.value"}, 0.3),
    "roughness": ({"key": "Sphere_1.bsdf.alpha.value"}, 0.3),
    "roughness of plastic": ({"key": "hill.bsdf.brdf_0.alpha"}, 0.3),
    "metal": ({"key": "Sphere_1.bsdf.eta.value"}, 0.8),
    "index": ({"key": "Sphere_2.bsdf.eta"}, 0.4),
    "thin glass": ({"key": "pane.bsdf.eta"}, 0.5),
    "principled": ({"key": "Cylinder_1.bsdf.brdf_0.[!cmafs]*"}, 0.3),
    "lobes": ({"key": "Cylinder_1.bsdf.brdf_0.[cmafs]*.value"}, 0.3),
    "weights": ({"key": "Rectangle_3.bsdf.weight.data"}, 0.3),
    "vertex colours": ({"key": "quilt.vertex_color"}, 0.3),
    "radiance": ({"key": "lamp.emitter.radiance.value"}, 5),
    "sky": ({"key": "Envmap_1.data"}, 0.5),
    "scale of the sky": ({"key": "Envmap_1.scale"}, 0.5),
    "intensity": ({"key": ["Point_1.intensity.value", "Spot_1.intensity.value"]}, 9),
    "slide": ({"key": "Projector_1.irradiance.data"}, 0.6),
    "vertices of a group": ({"key": "pair.shape_1.vertex_positions"}, 0.2),
    "vertices": ({"key": "quilt.vertex_positions"}, 0.2),
    "heightmap": ({"heightmap": {"mesh": "hill", "resolution": [5, 4]}}, 0.5),
    "mesh in motion": ({"motion": {"of": ["hill", "pane"], "free": ["translation", "scale"]}}, 0.4),
    "sphere in motion": ({"motion": {"of": "Sphere_1", "free": ["translation", "scale"]}}, 0.3),
    "rectangle in motion": ({"motion": {"of": "lamp"}}, 1),
    "cylinder in motion": ({"motion": {"of": "Cylinder_1"}}, 0.3),
    "lights in motion": ({"motion": {"of": ["Point_1", "Spot_1", "Projector_1"], "free": ["translation"]}}, 0.8),
}
#: The entries of `KINDS` that can be recovered together.
TOGETHER = [name for name in KINDS if name not in ("finer texture", "colour", "heightmap", "rectangle in motion")]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory, llvm: str) -> Path:
    """The scene file, with the files that it names."""
    folder = tmp_path_factory.mktemp("exporting")
    (folder / "room/images").mkdir(parents=True)
    random = np.random.default_rng(0)

    def image(height: int, width: int, channels: int = 3) -> mi.Bitmap:
        return mi.Bitmap(random.uniform(0.05, 0.6, (height, width, channels)).astype(np.float32))

    wood = image(5, 6).convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)
    wood.write(str(folder / "room/images/wood.png"))
    image(4, 8).write(str(folder / "room/images/sky.exr"))
    image(3, 4).write(str(folder / "slide.exr"))
    image(4, 4, 1).write(str(folder / "grey.exr"))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.5, 0.5, 6), np.linspace(-0.5, 0.5, 6)))
    z = 0.1 * np.sin(6 * x) * np.cos(5 * y)
    faces = [(a, a + 1, a + 6, a + 1, a + 7, a + 6) for a in range(30) if a % 6 < 5]
    triangles = np.array(faces, dtype=np.uint32).reshape(-1, 3)
    lines = [f"v {a:g} {b:g} {c:g}" for a, b, c in zip(x, y, z, strict=True)]
    lines += [f"vt {a + 0.5:g} {b + 0.5:g}" for a, b in zip(x, y, strict=True)]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in triangle) for triangle in triangles]
    (folder / "room/hill.obj").write_text("\n".join(lines) + "\n")
    quilt = mi.Mesh("quilt", len(x), len(triangles), has_vertex_texcoords=True)
    params = mi.traverse(quilt)
    params["vertex_positions"] = np.stack([2 * x, 2 * y, z], 1).astype(np.float32).ravel()
    params["faces"] = triangles.ravel()
    params["vertex_texcoords"] = np.stack([x + 0.5, y + 0.5], 1).astype(np.float32).ravel()
    params.update()
    quilt.add_attribute("vertex_color", 3, random.uniform(0.1, 0.5, 3 * len(x)).astype(np.float32))
    quilt.write_ply(str(folder / "room/quilt.ply"))
    (folder / "room/lights.xml").write_text(LIGHTS)
    (folder / "room/scene.xml").write_text(SCENE)
    return folder / "room/scene.xml"


def described(file: Path, keys: Sequence[str] = ()) -> tuple[mi.Scene, Description]:
    """Return the scene and the description that it was built from."""
    found: list[Description] = []
    return load_scene(file, {"elsewhere": str(file.parent.parent)}, look=found.append, keys=keys), found[0]


def changed(file: Path, names: list[str]) -> tuple[mi.Scene, Description, Selection]:
    """Return the scene with other values of the parameters that `names` recover, its description and the selection."""
    scene, description = described(file, ["floor.*"])
    selection = select_parameters(scene, [ParameterSpec(**KINDS[name][0]) for name in names], "c.yaml")
    random = np.random.default_rng(1)
    values = {key: selection.array(key) for key in selection.keys}
    amounts = dict.fromkeys(values, KINDS[names[0]][1])
    if len(names) > 1:  # each amount in its own unit
        amounts = {key: 0.3 if "value" in key or "data" in key else 0.1 for key in values}
    selection.set_arrays(
        {key: value + amounts[key] * random.uniform(0.5, 1, value.shape) for key, value in values.items()}
    )
    return scene, description, selection


def export(description: Description, selection: Selection, folder: Path) -> None:
    export_scene(description, selection.params, selection.scene_keys, {"type": "path", "max_depth": 5}, folder, "RUN")


def images(scene: mi.Scene, seeds: range, spp: int) -> np.ndarray:
    """Return images (N, H, W, 3) that Mitsuba's own `path` renders."""
    integrator = mi.load_dict({"type": "path", "max_depth": 5})
    return np.stack([np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed)) for seed in seeds])


@pytest.mark.parametrize("names", [TOGETHER, *([name] for name in KINDS if name not in TOGETHER)], ids="/".join)
def test_mitsuba_reads_back_the_recovered_values(names: list[str], file: Path, tmp_path: Path) -> None:
    before = mi.traverse(described(file, ["floor.*"])[0])
    _, description, selection = changed(file, names)
    export(description, selection, tmp_path / "out")
    found = mi.traverse(mi.load_file(str(tmp_path / "out/scene.xml"), optimize=False))
    for key in selection.scene_keys:
        own, old, new = (np.array(getattr(params[key], "matrix", params[key]) if key.endswith("to_world")
                                  else params[key]) for params in (selection.params, before, found))  # fmt: skip
        assert np.allclose(own, new, rtol=1e-5, atol=1e-6), key
        assert own.shape != old.shape or not np.allclose(own, old, rtol=1e-3), f"{key} was not changed"


@pytest.mark.long
def test_the_image_of_all_parameters_equals_that_of_the_scene(file: Path, tmp_path: Path) -> None:
    scene, description, selection = changed(file, TOGETHER)
    export(description, selection, tmp_path / "out")
    ours, theirs = (
        images(scene, range(8), 32), images(mi.load_file(str(tmp_path / "out/scene.xml")), range(100, 108), 32)
    )  # fmt: skip
    result = compare(ours, theirs)
    assert result, result
    original = images(described(file)[0], range(8), 32)
    assert not compare(original, theirs), "the values make no difference, so this would show nothing"


@pytest.mark.long
@pytest.mark.parametrize("name", KINDS)
def test_the_image_equals_that_of_the_scene(name: str, file: Path, tmp_path: Path) -> None:
    scene, description, selection = changed(file, [name])
    export(description, selection, tmp_path / "out")
    theirs = images(mi.load_file(str(tmp_path / "out/scene.xml")), range(100, 112), 64)
    result = compare(images(scene, range(12), 64), theirs)
    assert result, result


def test_it_is_loaded_by_mitsuba_alone_from_any_folder(file: Path, tmp_path: Path) -> None:
    _, description, selection = changed(file, TOGETHER)
    export(description, selection, tmp_path / "out")
    moved = (tmp_path / "out").rename(tmp_path / "moved")
    names = {str(path.relative_to(moved)) for path in moved.rglob("*") if path.is_file()}
    assert {"scene.xml", "recovered/floor.bsdf.reflectance.data.exr", "recovered/hill.ply"} <= names
    assert "images/wood.png" not in names, "what was recovered is copied as it was"
    text = (moved / "scene.xml").read_text()
    for word in (str(tmp_path.parent), "unheard_of", "include"):
        assert word not in text
    assert re.findall(r"\$\w+", text) == ["$resx", "$resy"]
    # With one thread, as in a process on one core, Mitsuba never finishes reading an EXR file.
    script = f"""import drjit as dr, mitsuba as mi
mi.set_variant("scalar_rgb")
dr.set_thread_count(2)
print(mi.load_file({str(moved / "scene.xml")!r}))"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd="/", timeout=300)
    assert done.returncode == 0, done.stderr
    assert "PathIntegrator" in done.stdout


def test_inexpressible_values_are_refused_without_output(file: Path, tmp_path: Path) -> None:
    key, reason = "Spot_1.texture.value", "only reads images there; recover `Spot_1.intensity` instead"
    scene, description = described(file)
    with pytest.raises(ConfigError, match=rf"{key}` has no effect, .*{reason}"):
        export(description, select_parameters(scene, [ParameterSpec(key=key, initial=0.5)], "c.yaml"), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_scenes_own_tables_of_a_metal_are_copied(llvm: str, tmp_path: Path) -> None:
    """The run has read Mitsuba's own table of copper."""
    (tmp_path / "room/data/ior").mkdir(parents=True)
    for name, value in (("Cu.eta", 1.75), ("mine.k", 2.5), ("mine.eta", 0.5)):
        (tmp_path / f"room/data/ior/{name}.spd").write_text(f"400 {value}\n700 {value}\n")
    metals = "".join(
        f'<shape type="sphere"><bsdf type="roughconductor"><string name="material" value="{name}"/></bsdf></shape>'
        for name in ("Cu", "mine")
    )
    lamp = '<emitter type="constant"/><sensor type="perspective"/>'
    (tmp_path / "room/scene.xml").write_text(f'<scene version="3.0.0">{lamp}{metals}</scene>')
    found: list[Description] = []
    scene = load_scene(tmp_path / "room/scene.xml", {}, look=found.append)
    selection = select_parameters(scene, [ParameterSpec(key="Sphere_1.bsdf.alpha.value", initial=0.5)], "c.yaml")
    export(found[0], selection, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out/data/ior").iterdir()} == {"mine.k.spd", "mine.eta.spd"}


@pytest.mark.parametrize("name", ["../../../evil", "a/../../evil", "/tmp/evil", "..\\evil"])
def test_nothing_is_written_outside_of_the_folder(name: str, llvm: str, tmp_path: Path) -> None:
    for table in ("eta", "k"):
        path = tmp_path / f"room/data/ior/{name}.{table}.spd"
        (tmp_path / "room/data/ior/a").mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("400 1.5\n700 1.5\n")
    lamp = '<emitter type="constant"/><sensor type="perspective"/>'
    metal = f'<bsdf type="roughconductor"><string name="material" value="{name}"/></bsdf>'
    (tmp_path / "room/scene.xml").write_text(
        f'<scene version="3.0.0">{lamp}<shape type="sphere">{metal}</shape></scene>'
    )
    found: list[Description] = []
    scene = load_scene(tmp_path / "room/scene.xml", {}, look=found.append)
    selection = select_parameters(scene, [ParameterSpec(key="Sphere_1.bsdf.alpha.value", initial=0.5)], "c.yaml")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ConfigError, match="cannot be exported: the scene names a file outside of the folder"):
        export(found[0], selection, tmp_path / "out/out")
    assert sorted(tmp_path.rglob("*")) == [*before]


@pytest.mark.parametrize(
    ("film", "size", "expected", "default"),
    [
        ("$resx 32", (12, 8), (48, 32), "48"),  # the size of a run is that of its photograph
        ("$resx 32", None, (48, 32), "48"),
        ("48 32", (12, 8), (48, 32), ""),
        ("48 32", (12, 12), (12, 12), ""),  # shows another view
        ("$resx 32 crop", (12, 8), (12, 8), ""),
    ],
)
def test_the_film_keeps_its_own_size_and_variables(
    film: str, size: tuple[int, int] | None, expected: tuple[int, int], default: str, llvm: str, tmp_path: Path
) -> None:
    width, height, *crop = film.split()
    sizes = f'<integer name="width" value="{width}"/><integer name="height" value="{height}"/>'
    sizes += '<integer name="crop_width" value="20"/>' if crop else ""
    (tmp_path / "scene.xml").write_text(
        f"""<scene version="3.0.0"><default name="resx" value="48"/><emitter type="constant"/>
        <sensor type="perspective"><film type="hdrfilm">{sizes}</film></sensor>
        <shape type="sphere" id="ball"/></scene>"""
    )
    found: list[Description] = []
    scene = load_scene(tmp_path / "scene.xml", {}, size, look=found.append)
    selection = select_parameters(scene, [ParameterSpec(key="ball.bsdf.reflectance.value", initial=0.5)], "c.yaml")
    export(found[0], selection, tmp_path / "out")
    written = tmp_path / "out/scene.xml"
    assert tuple(mi.load_file(str(written)).sensors()[0].film().size()) == expected
    assert (f'<default name="resx" value="{default}"/>' in written.read_text()) is bool(default)
    if default:
        assert list(mi.load_file(str(written), resx=96).sensors()[0].film().size()) == [96, 32]


def test_values_that_mitsuba_reads_differently_are_refused_without_output(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = replacing.write_file
    monkeypatch.setattr(replacing, "write_file", lambda path, image, linear: write(path, image[::-1], linear))
    _, description, selection = changed(file, ["texture"])
    with pytest.raises(ConfigError, match="reads another value"):
        export(description, selection, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_values_agree_up_to_rounding_and_grey_agrees_with_colours():
    colour = mi.Color3f(0.5)
    same = [(mi.Float(0.5), colour), (colour, mi.Color3f(0.5, 0.5, 0.500001)), (mi.Float(0), mi.Float(0))]
    other = [(colour, mi.Color3f(0.5, 0.5, 0.51)), (mi.Float(0.4), colour), ([1, 2], [1, 2, 3]), (mi.Float(0), "text")]
    assert all(replacing.same_values(*pair) and replacing.same_values(*pair[::-1]) for pair in same)
    assert not any(replacing.same_values(*pair) or replacing.same_values(*pair[::-1]) for pair in other)


def test_copies_of_files_have_names_of_their_own():
    home, taken = Path("/scene"), {"textures/a.png", "assets/a.png", "assets/a-2.png"}
    assert replacing._free(Path("/scene/textures/b.png"), home, taken) == "textures/b.png"
    assert replacing._free(Path("/scene/textures/A.png"), home, taken) == "textures/A-2.png"
    assert replacing._free(Path("/other/a.png"), home, taken) == "assets/a-3.png"
