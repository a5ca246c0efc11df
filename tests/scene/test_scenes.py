"""The scenes in `scenes/`: their assets match the script, and their images match their comments."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.step import render_image
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.needs import check_paths, look, scene_needs
from reslrb_cli.scene.parameters import select_parameters, set_values
from reslrb_cli.scene.visibility import visible_texels

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("cornell_floor", "grey_room", "caustic_slab", "furnace", "lens_pose", "caustic_heightmap", "mixed_room")
pytestmark = pytest.mark.usefixtures("llvm")


def make_scenes():
    spec = importlib.util.spec_from_file_location("make_scenes", ROOT / "scripts" / "make_scenes.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def small(name: str):
    return load_scene(ROOT / "scenes" / name / "scene.xml", {"resx": 32, "resy": 32, "spp": 4})


def test_images_match_the_script():
    for name, expected in make_scenes().images().items():
        found = np.array(mi.Bitmap(str(ROOT / "scenes" / name)))
        assert found.shape == expected.shape, name
        assert np.allclose(found, expected, atol=1 / 256 if "sky" in name else 1 / 4096, rtol=1e-5), name


def test_the_stiff_wall_matches_the_script():
    found = np.array(mi.Bitmap(str(ROOT / "scenes" / "stiff" / "wall.png")))
    assert np.abs(np.squeeze(found).astype(int) - make_scenes().mottled_wall(192, 384)).max() <= 1


def test_meshes_match_the_script():
    for name, (positions, normals, *texcoords, faces) in make_scenes().meshes().items():
        mesh = mi.load_dict({"type": "ply", "filename": str(ROOT / "scenes" / name)})
        assert np.allclose(np.array(mesh.vertex_positions_buffer()).reshape(-1, 3), positions, atol=2e-6), name
        assert np.allclose(np.array(mesh.vertex_normals_buffer()).reshape(-1, 3), normals, atol=2e-6), name
        assert mesh.has_vertex_texcoords() == bool(texcoords), name
        for expected in texcoords:
            assert np.allclose(np.array(mesh.vertex_texcoords_buffer()).reshape(-1, 2), expected, atol=2e-6), name
        assert np.array_equal(np.array(mesh.faces_buffer()).reshape(-1, 3), faces), name
        corners = positions.astype(np.float64)[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("fi,fki->fk", across, normals[faces]) > 0).all(), name
        if name.startswith("table/"):  # the outside is outside: the surfaces enclose a positive volume
            assert np.einsum("fi,fi->", corners[:, 0], across) > 0, name
        else:
            assert (normals[:, 1] < 0).all(), name


@pytest.mark.parametrize("name", a_few(["lens_pose", "caustic_heightmap"], ["caustic_heightmap"]))
def test_moving_light_stays_off_the_border(name):
    """At the border, derivatives of the parameters that move the light would be cut off."""
    config = load(ROOT / "configs" / f"{name}.yaml", [])
    render = config.target.render
    scene = load_scene(config.scene.file, {"resx": 32, "resy": 32, "spp": 64})
    set_values(scene, config.parameters, render.parameters, config.source, "target.render.parameters")
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "ptracer", "max_depth": 5}))).mean(axis=2)
    total = image.sum()
    image[2:-2, 2:-2] = 0
    assert image.sum() < 2e-3 * total  # light from reflections inside the glass


def test_floor_has_detail_at_the_scale_of_its_texels():
    floor = make_scenes().images()["cornell_floor/floor.exr"]
    assert floor.shape == (64, 64, 3)
    assert floor.min() >= 0.05
    assert floor.max() <= 0.95
    between_neighbours = np.abs(np.diff(floor, axis=1)).mean()
    assert between_neighbours > 0.4 * np.abs(floor - floor.mean((0, 1))).mean()


@pytest.mark.parametrize("name", NAMES)
def test_mitsuba_alone_loads_and_renders_it(name):
    scene = mi.load_file(str(ROOT / "scenes" / name / "scene.xml"), resx=32, resy=32, spp=4)
    image = np.array(mi.render(scene))
    assert image.shape == (32, 32, 3)
    assert np.isfinite(image).all()
    assert image.mean() > 0.05


@pytest.mark.parametrize("name", NAMES)
def test_config_fits_the_scene(name):
    config = load(ROOT / "configs" / f"{name}.yaml", [])
    scene = load_scene(config.scene.file, config.scene.options)
    check_paths(scene, scene.sensors()[0], "light", config.integrator.hide_emitters)
    assert select_parameters(scene, config.parameters, config.source).keys


def test_cornell_floor_is_visible():
    scene = load_scene(ROOT / "scenes" / "cornell_floor" / "scene.xml")
    mask = visible_texels(scene, scene.sensors(), "floor.reflectance.data")
    assert mask.mean() > 0.7  # a ninth of the floor is under the boxes
    assert look(scene, scene.sensors()[0]).nothing < 0.1


def test_grey_room_is_lit_only_by_a_rotated_sky():
    scene = small("grey_room")
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.emitters == ("EnvironmentMapEmitter",)
    axes = np.array(mi.traverse(scene)["sky.to_world"].matrix).reshape(4, 4)[:3, :3]
    assert (np.abs(axes) > 0.2).sum() >= 6  # rotated about two axes
    assert 0.02 < look(scene, scene.sensors()[0]).nothing < 0.3  # through the windows


def test_caustic_is_not_seen_through_the_glass():
    scene = small("caustic_slab")
    assert look(scene, scene.sensors()[0]).smooth == 1
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.has_delta_lobes
    assert needs.has_shading_normals


def test_mixed_room_has_light_that_each_side_misses():
    """Light paths do not see the mirror. In the caustic on the wall, connections to the lamp find less than a tenth of
    the light that light paths find.
    """
    scene = small("mixed_room")
    image = {name: np.array(mi.render(scene, spp=256, integrator=mi.load_dict(options))).mean(2) for name, options in {
        "light": {"type": "ptracer", "max_depth": 8},
        "direct": {"type": "direct", "bsdf_samples": 0, "emitter_samples": 1},
    }.items()}  # fmt: skip
    mirror, caustic = np.s_[6:16, 19:22], np.s_[6:14, 10:12]
    assert image["light"][mirror].max() == 0
    assert image["light"][caustic].min() > 0.05
    assert image["direct"][caustic].mean() < 0.1 * image["light"][caustic].mean()


@pytest.mark.long
def test_the_target_of_the_mixed_room_is_its_image():
    """Blocks of 16 pixels are compared with an image of light and camera paths. That integrator shares no code with the
    one that made the target.
    """
    scene = load_scene(ROOT / "scenes" / "mixed_room" / "scene.xml", {"resx": 128, "resy": 128})
    both = make_integrator("reslrb", paths="both", estimator="stack", max_depth=8)
    images = np.array([np.array(render_image(both, scene, 0, seed, 16)) for seed in range(8)])
    target = np.array(mi.Bitmap(str(ROOT / "scenes" / "mixed_room" / "target.exr")), dtype=np.float64)
    blocks = images.reshape(8, 8, 16, 8, 16, 3).mean((2, 4, 5))
    error = blocks.mean(0) - target.reshape(8, 16, 8, 16, 3).mean((1, 3, 4))
    allowed = 6 * blocks.std(0, ddof=1) / np.sqrt(8) + 0.02 * blocks.mean(0)  # seeds are few, and the target has noise
    assert (abs(error) < allowed).all()


def test_furnace_is_exact():
    rho, emitted, depth = np.array([0.5, 0.7, 0.3]), np.array([1.0, 0.6, 1.4]), 6
    image = np.array(mi.render(small("furnace"), spp=64, integrator=mi.load_dict({
        "type": "path", "max_depth": depth, "rr_depth": 100})))  # fmt: skip
    expected = emitted * sum(rho**k for k in range(depth))
    assert np.allclose(image, expected, rtol=0.02)
    # The tolerance cannot be smaller: Mitsuba 3.9's `path` gathers 0.2 % too much from a sphere when it samples it from
    # inside.
    assert np.allclose(image.mean((0, 1)), expected, rtol=3e-3)
