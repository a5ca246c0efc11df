"""What the program finds in scenes with every plugin (`said.check`): parameters, features, proposals and views."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.every_plugin import ROWS, Row, write_files
from golden import said

from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.scene import upsampling
from reslrb_cli.scene.catalog import summarise
from reslrb_cli.scene.edges import EdgeSet, edge_kinds
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.needs import blend_warning, camera_finds_all, scene_needs, stock_clip, usual_paths
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.proposal import find_movable_in_view, propose
from reslrb_cli.scene.visibility import interior, sees_lamps, sees_specular

pytestmark = pytest.mark.usefixtures("combined")
#: Media, samplers and filters differ little in what the program finds.
ALIKE = ("medium", "phase", "volume", "sampler", "rfilter", "integrator")
LOADED = [row for row in ROWS if not row.loading and row.kind not in ALIKE]


@pytest.fixture(scope="module", autouse=True)
def folder(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Make a folder with the files that scenes name the working directory."""
    folder, before = tmp_path_factory.mktemp("files"), Path.cwd()
    write_files(folder)
    os.chdir(folder)
    yield
    os.chdir(before)


def described(file: str) -> dict[str, Any]:
    """Return all facts about the scene of a file, by name. Parameters are named by their keys."""
    gc.collect()  # Mitsuba asks emitters of former scenes, too
    scene = load_scene(Path(file))
    summary, sensors = summarise(scene), scene.sensors()
    found: dict[str, Any] = {f"parameter {info.key}": said.plain(info) for info in summary.parameters}
    found |= {f"sensor {view.index}": said.plain(view) for view in summary.sensors}
    found |= {name: getattr(summary, name) for name in ("emitters", "bsdfs", "shapes", "triangles", "movable")}
    if summary.sensors[0].view is None:
        return found
    needs = scene_needs(scene, sensors[0])
    found |= {f"needs {name}": said.plain(value) for name, value in vars(needs).items()}
    found["clip"] = stock_clip(needs)
    found["blends"] = blend_warning(SceneGraph.of(scene), needs.blends)
    found["paths"] = [usual_paths(scene, sensors, depth, hidden, moves)
                      for depth in (2, 4) for hidden in (False, True) for moves in (False, True)]  # fmt: skip
    found["camera finds all"] = [camera_finds_all(scene, depth, gloss) for depth in (2, 3) for gloss in (False, True)]
    for proposal in propose(scene, 0, lamps=True):
        found[f"proposal {proposal.info.key}"] = said.plain(proposal) | {"info": None}
    found["in view"] = find_movable_in_view(scene, 0)
    found["specular"] = [int(sees_specular(scene, sensors[0], partly).sum()) for partly in (False, True)]
    found["lamps"] = int(sees_lamps(scene, sensors[0]).sum())
    found["interior"] = int(interior((16, 16), sensors[0]).sum())
    return found


@pytest.fixture(scope="module")
def plain() -> dict[str, Any]:
    """Facts about the scene that all others extend."""
    Path("plain.xml").write_text(Row("", "").xml())
    return described("plain.xml")


def test_the_plain_scene(plain: dict[str, Any]) -> None:
    said.check("scene", plain)


@pytest.mark.parametrize("row", LOADED, ids=[row.name for row in LOADED])
def test_every_plugin(row: Row, plain: dict[str, Any]) -> None:
    Path("scene.xml").write_text(row.xml())
    found = described("scene.xml")
    said.check(f"scene with {row.name}", {key: value for key, value in found.items() if plain.get(key) != value})


# Motions, heightmaps and edges of every shape.

IDS = ("box", "inside_out", "ball", "tube", "disk", "sheet", "roof", "bulb", "spot", "sun")


@pytest.fixture
def solids(make_scene: Callable[..., Any]) -> Any:
    """A scene with an object of every kind that can move. `roof` has no vertex normals, and two faces."""
    T = mi.ScalarTransform4f
    roof = mi.Mesh("roof", 4, 2, has_vertex_texcoords=True)
    params = mi.traverse(roof)
    params["vertex_positions"] = [-1, 0, 2, 1, 0, 2, 1, 1, 2.5, -1, -1, 2.8]
    params["faces"], params["vertex_texcoords"] = [0, 1, 2, 0, 3, 1], [0, 0.5, 1, 0.5, 1, 1, 0, 0]
    params.update()
    turned = T().translate([1, 0.5, 2]).rotate([0, 1, 1], 20)
    return make_scene(
        box={"type": "cube", "to_world": turned.scale([0.3, 0.2, 0.4])},
        inside_out={"type": "cube", "flip_normals": True, "to_world": T().translate([-2, 1, 1]).scale(0.3)},
        ball={"type": "sphere", "center": [-1, 0, 1], "radius": 0.5},
        tube={"type": "cylinder", "p0": [0, -1, 0], "p1": [0, -1, 0.5], "radius": 0.2},
        disk={"type": "disk", "to_world": turned.scale(0.7)},
        sheet={"type": "rectangle", "to_world": T().translate([0, 0, 0.5]).rotate([1, 0, 0], 30).scale(0.4)},
        roof=roof,
        bulb={"type": "point", "position": [0.5, 1, 4]},
        spot={"type": "spot", "to_world": T().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0])},
        sun={"type": "directional", "direction": [0, 0.6, -0.8]},
    )


def numbers(value: Any) -> Any:
    """Return the numbers of an array of Dr.Jit, or of a transform, for comparison."""
    return said.plain(np.array(getattr(value, "matrix", value) if "Transform" in type(value).__name__ else value))


def give_tangents(values: Iterable[Any]) -> None:
    """Propagate tangents of 0.5 in all entries of the values."""
    for value in values:
        dr.set_grad(value, 0.5)
        dr.enqueue(dr.ADMode.Forward, value)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)


@pytest.mark.parametrize("id", IDS)
def test_motions(id: str, solids: Any) -> None:
    free = {"sun": ["rotation"], "bulb": ["translation"], "spot": ["translation", "rotation"]}
    specs = [{"motion": {"of": id, "free": free.get(id, ["translation", "rotation", "scale"])}}]
    if id in ("box", "inside_out", "roof"):
        specs.append({"heightmap": {"mesh": id, "resolution": [3, 2]}})
    selection = select_parameters(solids, [ParameterSpec(**spec) for spec in specs], "c.yaml")
    deformation = selection.deformation
    found: dict[str, Any] = {"extents": deformation.extents, "quantities": deformation.quantities}
    found["kinds"] = {key: selection.kind(key) for key in selection.keys}
    given = {"translation": [0.1, -0.2, 0.3], "rotation": [10, 20, 30], "scale": 1.5,
             "heightmap": np.arange(6).reshape(2, 3, 1) / 10}  # fmt: skip
    selection.set_arrays({key: np.float32(given[key.rpartition(".")[2]]) for key in selection.keys})
    found["placed"] = {key: numbers(selection.params[key]) for key in selection.scene_keys}
    for value in deformation.values.values():
        dr.enable_grad(value)
    selection.hand_over(dict(deformation.values))
    for key in selection.scene_keys:
        leaf = selection.params[key]
        dr.set_grad(leaf, 0)
        dr.backward(dr.sum(dr.square(dr.ravel(leaf.matrix if hasattr(leaf, "matrix") else leaf))))
    selection.collect()
    found["gradients"] = {key: numbers(dr.grad(value)) for key, value in deformation.values.items()}
    selection.hand_over(dict(deformation.values))
    give_tangents(deformation.values.values())
    selection.push()
    found["tangents"] = {key: numbers(dr.grad(selection.params[key])) for key in selection.scene_keys}
    said.check(f"motion of {id}", found)


@pytest.mark.parametrize("id", IDS[:7])
def test_edges(id: str, solids: Any) -> None:
    """Lamps move, so that no random rays decide which edges count."""
    [shape] = [shape for shape in solids.shapes() if shape.id() == id]
    edges = EdgeSet((shape,), solids, lamps_move=True)
    table = edges.now()
    names = [each.name for each in fields(table) if each.name not in ("shape", "balls", "chains", "faces")]
    found = {name: numbers(getattr(table, name)) for name in names}
    found["occluders"] = [other.id() for other in edges.occluders]
    found["balls"] = [[numbers(ball.center), numbers(ball.radius)] for ball in table.balls]
    found["kinds"] = sorted(edge_kinds([shape]))
    said.check(f"edges of {id}", found)


def test_lamps(make_scene: Callable[..., Any]) -> None:
    """Lamps of every shape, with a texture, with one colour, and along the normal."""
    kinds = {
        "plain": {"type": "area"},
        "textured": {"type": "area", "radiance": {"type": "checkerboard"}},
        "parallel": {"type": "directionalarea"},
    }
    shapes = {"rectangle": {}, "disk": {}, "sphere": {"flip_normals": True}, "cylinder": {}, "cube": {}}
    lamps = {
        f"{shape}_{name}": {"type": shape, **options, "emitter": emitter}
        for shape, options in shapes.items() for name, emitter in kinds.items()
    }  # fmt: skip
    scene = make_scene(**lamps)
    names = ("is_sphere", "surrounds", "is_beam", "faces_by_area", "has_faces")
    found = {lamp.shape.id(): [said.plain(lamp), [getattr(lamp, name) for name in names]]
             for lamp in SceneGraph.of(scene).find_lamps(scene)}  # fmt: skip
    said.check("lamps", found)


@pytest.mark.usefixtures("spectral")
@pytest.mark.parametrize("rough", [{}, {"alpha": 0.2}, {"alpha": 0.3, "distribution": "ggx", "ext_ior": 1.2}])
def test_glass_with_dispersion(rough: dict[str, Any]) -> None:
    """Values, densities and samples for directions on both sides, in both modes of transport."""
    glass = mi.load_dict({"type": "dispersivedielectric", "material": "F2", **rough})
    si = dr.zeros(mi.SurfaceInteraction3f, 6)
    si.wi = dr.normalize(mi.Vector3f([0, 0.3, 0.6, 0.2, -0.5, 0.9], [0.1, 0, 0.2, 0.4, 0.1, 0], [1, 1, 1, -1, -1, 0.5]))
    si.wavelengths = mi.Spectrum(450, 520, 590, 660)
    wo = dr.normalize(
        mi.Vector3f([0, -0.2, -0.4, -0.1, 0.3, -0.9], [-0.1, 0, -0.1, -0.3, 0, 0], [1, -1, -1, 1, -1, 0.5])
    )
    found: dict[str, Any] = {"text": str(glass), "indices": [np.array(each).tolist() for each in glass.indices(si)]}
    for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance):
        context = mi.BSDFContext(mode)
        value, density = glass.eval_pdf(context, si, wo)
        bs, weight = glass.sample(context, si, mi.Float(0.05, 0.3, 0.55, 0.8, 0.95, 0.5), mi.Point2f(0.3, 0.7))
        parts = (value, density, weight, bs.wo, bs.pdf, bs.eta, mi.Float(bs.sampled_type))
        found[str(mode)] = [np.array(each, np.float64).round(5).tolist() for each in parts]
    said.check(f"glass with dispersion {rough}", found)


@pytest.mark.usefixtures("spectral")
def test_recovered_colours(make_scene: Callable[..., Any]) -> None:
    """Colours and spectra of textures, surfaces and lamps in a spectral variant: before and after new values were set,
    their gradients, tangents, and condition numbers.
    """
    pixels = np.random.default_rng(4).uniform(0.1, 0.9, (3, 2, 3)).astype(np.float32)

    def image(raw: bool) -> dict[str, Any]:
        return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": raw}

    def wall(reflectance: Any, **more: Any) -> dict[str, Any]:
        return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}, **more}

    def rgb(*value: float) -> dict[str, Any]:
        return {"type": "rgb", "value": list(value)}

    scene = make_scene(
        plain=wall(rgb(0.2, 0.5, 0.7)), image=wall(image(False)), raw=wall(image(True)),
        grey=wall({"type": "uniform", "value": 0.3}), bulb={"type": "point", "intensity": rgb(3, 2, 1)},
        lamp=wall(rgb(0, 1, 0), emitter={"type": "area", "radiance": rgb(0, 0, 4)}),
        sky={"type": "envmap", "bitmap": mi.Bitmap(np.tile(pixels, (1, 2, 1)))},
    )  # fmt: skip
    params = mi.traverse(scene)
    keys = [key for key in sorted(params.keys()) if key.endswith((".value", ".data", "scale"))]
    found: dict[str, Any] = {}
    for key in keys:
        colours = upsampling.is_upsampled(params, key) and upsampling.colour_in_scene(params, key)
        found[key] = [numbers(upsampling.values_of(params, key)), numbers(colours)]
    free = [key for key in keys if upsampling.is_upsampled(params, key)]
    selection = select_parameters(scene, [ParameterSpec(key=key) for key in free], "c.yaml")
    colours = selection.colours
    found["start"] = {key: numbers(selection.array(key)) for key in free}
    selection.set_arrays({key: 0.5 * selection.array(key) for key in free})
    found["colours"] = {key: numbers(selection.array(key)) for key in free}
    found["keys"] = [colours.keys, [key in colours for key in keys]]
    for key in free:
        dr.enable_grad(colours[key])
    selection.hand_over({key: colours[key] for key in free})
    leaves = sorted({name for key in free for name in (key, upsampling.emitted(key)) if name in colours.properties})
    found["placed"] = {key: numbers(params[key]) for key in leaves}
    for key in leaves:
        dr.set_grad(params[key], 0)
        dr.backward(dr.sum(dr.square(dr.ravel(params[key]))))
    found["cancellation"] = colours.cancellation()
    selection.collect()
    found["gradients"] = {key: numbers(dr.grad(colours[key])) for key in free}
    selection.hand_over({key: colours[key] for key in free})
    give_tangents(colours[key] for key in free)
    selection.push()
    found["tangents"] = {key: numbers(dr.grad(params[key])) for key in leaves}
    said.check("recovered colours", found)


@pytest.mark.usefixtures("spectral")
def test_spectra_of_colours() -> None:
    """Coefficients from the table and from the equations, for dark, bright and saturated colours, with each channel as
    the largest one.
    """
    rgb = [
        [0.02, 0.5, 0.9, 0.1, 0.3, 0.7, 0.98],
        [0.03, 0.4, 0.1, 0.8, 0.3, 0.9, 0.99],
        [0.01, 0.6, 0.2, 0.1, 0.9, 0.1, 0.97],
    ]
    colours = mi.Color3f(*rgb)
    wavelengths = np.array([450.0, 550, 650])
    found = {}
    for name, made in (("table", upsampling._from_table(colours)), ("solved", upsampling.coefficients(colours))):
        c = np.array(made, np.float64)
        v = (c[0] * wavelengths[:, None] + c[1]) * wavelengths[:, None] + c[2]
        found[name] = [
            (0.5 + 0.5 * v / np.sqrt(1 + v**2)).round(4).tolist(),
            upsampling.colours_of(c.T).round(4).tolist(),
        ]
    said.check("spectra of colours", found)
