"""The requirements of a scene, the depth of its paths, and the pixels of a sensor."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.scene import graph, rays
from reslrb_cli.scene.catalog import summarise
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.needs import (
    CROSSINGS,
    check_paths,
    look,
    paths_obstacle,
    scene_needs,
)
from reslrb_cli.scene.proposal import propose
from reslrb_cli.scene.visibility import (
    DEPTHS,
    LOST,
    find_depth,
    sees_even_lamps,
    sees_lamps,
    sees_specular,
    visible_texels,
    widened,
)

pytestmark = pytest.mark.usefixtures("llvm")

# The needs of a scene, and scenes that light tracing cannot render.

GLASS = {"type": "dielectric"}


@pytest.fixture(autouse=True)
def _without_scenes_of_before() -> Iterator[None]:
    """Collect garbage after the test. Mitsuba asks all existing emitters, also a `timed_sunsky` of a scene that an
    error still holds.
    """
    yield
    gc.collect()


def test_plain_scene(make_scene):
    scene = make_scene()
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.emitters == ("PointLight",)
    assert needs.environment is None
    absent = ("has_delta_lobes", "has_null", "has_shading_normals", "has_visible_emitters", "thin_lens")
    assert [name for name in (*absent, "moving_shutter", "has_instances") if getattr(needs, name)] == []
    check_paths(scene, scene.sensors()[0], "light")


def test_everything(make_scene):
    scene = make_scene(
        camera={"type": "thinlens", "aperture_radius": 0.1, "shutter_close": 1.0},
        sky={"type": "constant"},
        veil={"type": "sphere", "bsdf": {"type": "mask", "bsdf": GLASS, "opacity": 0.5}},
    )
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.environment == "ConstantBackgroundEmitter"
    assert needs.has_delta_lobes
    assert needs.has_null
    assert needs.has_visible_emitters
    assert needs.thin_lens
    assert needs.moving_shutter


@pytest.mark.parametrize("flat", [True, False])
def test_shading_normals(make_scene, tmp_path, flat):
    mesh = mi.Mesh("m", 3, 1, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [0, 0, 0, 1, 0, 0, 0, 1, 0]
    params["faces"] = [0, 1, 2]
    params["vertex_normals"] = [0, 0, 1] * 3 if flat else [0, 0, 1, 0.6, 0, 0.8, 0, 0, 1]
    params.update()
    scene = make_scene(mesh=mesh)
    assert scene_needs(scene, scene.sensors()[0]).has_shading_normals is not flat


def test_nested_bsdfs_and_groups_are_seen(make_scene, tmp_path):
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "cube.ply"))
    group = {"type": "shapegroup", "cube": {"type": "ply", "filename": str(tmp_path / "cube.ply"), "bsdf": GLASS}}
    scene = make_scene(group=group, copy={"type": "instance", "group": {"type": "ref", "id": "group"}})
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.has_delta_lobes
    assert needs.has_instances
    assert summarise(scene).shapes == {"Rectangle": 1, "PLYMesh": 1}


def test_view(make_scene):
    far = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 9], up=[0, 1, 0])
    scene = make_scene(sky={"type": "constant"})
    view = look(scene, scene.sensors()[0])
    assert 0 < view.smooth < 1
    assert view.specular == 0
    assert view.smooth + view.nothing == pytest.approx(1)
    assert view.emission == pytest.approx(view.nothing)
    scene = make_scene(camera={"type": "perspective", "to_world": far})
    assert look(scene, scene.sensors()[0]).nothing == 1
    check_paths(scene, scene.sensors()[0], "light")  # correctly black


def test_mask_in_front_is_looked_through(make_scene):
    scene = make_scene(veil={"type": "sphere", "radius": 2, "bsdf": {"type": "null"}})
    assert look(scene, scene.sensors()[0]) == look(make_scene(), make_scene().sensors()[0])


@pytest.mark.parametrize(
    ("changes", "hide_emitters", "reason"),
    [
        ({"camera": {"type": "orthographic"}}, False, "OrthographicCamera; light paths connect to"),
        ({"camera": {"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1}}}, False, "DistantSensor"),
        ({"plane": {"type": "rectangle", "bsdf": GLASS}}, False, "only smooth specular surfaces"),
        (
            {"plane": {"type": "rectangle", "bsdf": {"type": "conductor"}}, "sky": {"type": "constant"}},
            True,
            "specular",
        ),
    ],
)
def test_refused(make_scene, changes, hide_emitters, reason):
    scene = make_scene(**changes)
    with pytest.raises(UnsupportedScene, match=reason):
        check_paths(scene, scene.sensors()[0], "light", hide_emitters)


@pytest.mark.parametrize("plugin", ["directional", "projector"])
def test_scaled_emitters_are_refused_for_both_kinds_of_paths(make_scene, plugin):
    def scene(scale):
        turned = mi.ScalarTransform4f().look_at([0, 0, 3], [1, 0, 0], [0, 1, 0])
        return make_scene(beam={"type": plugin, "to_world": turned @ mi.ScalarTransform4f().scale(scale)})

    scaled, plain = scene(2.0), scene(1.0)
    with pytest.raises(UnsupportedScene, match=f"a `{plugin}` with a scale .*; remove the scale, or use .*: light$"):
        check_paths(scaled, scaled.sensors()[0], "both")
    check_paths(scaled, scaled.sensors()[0], "camera")
    check_paths(scaled, scaled.sensors()[0], "light")
    check_paths(plain, plain.sensors()[0], "both")


def test_specular_scene_with_a_visible_light(make_scene):
    scene = make_scene(plane={"type": "rectangle", "bsdf": GLASS}, sky={"type": "constant"})
    check_paths(scene, scene.sensors()[0], "light")


def test_summary(make_scene):
    summary = summarise(make_scene())
    assert summary.emitters == {"PointLight": 1}
    assert summary.bsdfs == {"SmoothDiffuse": 1}
    assert summary.triangles == 2
    sensor = summary.sensors[0]
    assert (sensor.type, sensor.size, sensor.filter, sensor.channels) == ("PerspectiveCamera", (16, 12), "BoxFilter", 3)
    assert sensor.obstacle is None
    by_key = {info.key: info for info in summary.parameters}
    assert by_key["floor.reflectance.data"].shape == (4, 6, 3)
    assert by_key["floor.reflectance.data"].obstacle is None
    assert by_key["plane.to_world"].discontinuous
    assert by_key["plane.to_world"].obstacle.startswith("is recovered as a motion")


def test_summary_of_an_unrenderable_scene(make_scene):
    sensor = summarise(make_scene(camera={"type": "orthographic"})).sensors[0]
    assert sensor.view is None
    assert "OrthographicCamera" in sensor.obstacle


def test_fractions_refer_to_the_crop_window(make_scene):
    film = {"type": "hdrfilm", "width": 16, "height": 12, "crop_offset_x": 7, "crop_offset_y": 5, "crop_width": 2,
            "crop_height": 2}  # fmt: skip
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0])
    scene = make_scene(camera={"type": "perspective", "fov": 60, "to_world": to_world, "film": film})
    assert look(scene, scene.sensors()[0]).smooth == 1
    assert np.isclose(look(make_scene(), make_scene().sensors()[0]).smooth, 0.45, atol=0.15)


def test_light_that_camera_paths_cannot_find_is_refused_for_prb(make_scene):
    scene = make_scene()
    check_paths(scene, scene.sensors()[0], "prb")
    scene = make_scene(lamp={"type": "rectangle", "emitter": {"type": "directionalarea"}})
    with pytest.raises(UnsupportedScene, match="`prb` cannot evaluate; use integrator"):
        check_paths(scene, scene.sensors()[0], "prb")


FOG = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
BEAM = {"type": "rectangle", "emitter": {"type": "directionalarea"}}
WARM = {"type": "roughconductor", "alpha": {"type": "blackbody", "temperature": 9.0}}
REF = {"type": "ref", "id": "group"}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"fog": FOG}, "shape fog bounds a participating medium.*remove it from the scene file"),
        ({"group": {"type": "shapegroup", "fog": FOG}, "one": {"type": "instance", "g": REF}},
         "shape fog bounds a participating medium"),
        ({"camera": {"type": "perspective", "inside": {"type": "homogeneous"}}}, "sensor camera is inside"),
        ({"bulb": {"type": "point", "inside": {"type": "homogeneous"}}}, "emitter bulb is inside a participating"),
        ({"sky": {"type": "timed_sunsky"}}, "use a `sunsky`"),
        ({"ball": {"type": "sphere", "bsdf": WARM}}, "Mitsuba cannot evaluate bsdf bsdf: .*not implemented"),
    ],
)  # fmt: skip
def test_scenes_unknown_to_every_integrator_are_refused_alike(make_scene, changes, reason):
    scene = make_scene(**changes)
    said = []
    for paths in ("light", "prb"):
        with pytest.raises(UnsupportedScene, match=reason) as error:
            check_paths(scene, scene.sensors()[0], paths)
        said.append(str(error.value))
    assert said[0] == said[1]
    assert "integrator.type" not in said[0]


def test_an_unreachable_medium_is_ignored(make_scene):
    scene = make_scene(group={"type": "shapegroup", "fog": FOG})
    check_paths(scene, scene.sensors()[0], "light")
    check_paths(scene, scene.sensors()[0], "prb")


@pytest.mark.parametrize(
    ("changes", "way"),
    [
        ({"camera": {"type": "orthographic"}}, "sensors; use integrator: {type: reslrb, paths: camera}"),
        (
            {"plane": {"type": "rectangle", "bsdf": {"type": "hair"}}},
            "material; use integrator: {type: reslrb, paths: camera}",
        ),
        ({"plane": {"type": "rectangle", "bsdf": GLASS}}, "surface, or use integrator: {type: reslrb, paths: both}"),
        (
            {"camera": {"type": "orthographic"}, "lamp": BEAM},
            "sensors; other paths cannot render it either.*`prb` cannot",
        ),
    ],
)
def test_an_existing_remedy_is_named(make_scene, changes, way):
    scene = make_scene(**changes)
    with pytest.raises(UnsupportedScene, match=f"{way}[^;]*$"):
        check_paths(scene, scene.sensors()[0], "light")


@pytest.mark.parametrize("paths", ["camera", "both"])
def test_a_blocked_remedy_is_not_named(make_scene, paths):
    scene = make_scene(camera={"type": "orthographic"}, lamp=BEAM)
    with pytest.raises(UnsupportedScene, match="other paths cannot render it either") as error:
        check_paths(scene, scene.sensors()[0], paths)
    assert "use integrator" not in str(error.value)


@pytest.mark.parametrize(("bsdf", "same"), [("hair", False), ("pplastic", True), ("principled", True)])
def test_asymmetric_materials_are_refused_for_light_paths(make_scene, bsdf, same):
    scene = make_scene(plane={"type": "rectangle", "bsdf": {"type": bsdf}})
    material = next(shape for shape in scene.shapes() if shape.id() == "plane").bsdf()
    light, view = (mi.Vector3f(mi.ScalarVector3f(way)) for way in ([0.36, 0.48, 0.8], [-0.64, 0.48, 0.6]))
    values = []
    for wi, wo in ((light, view), (view, light)):
        si = mi.SurfaceInteraction3f()
        si.wi = wi
        values.append(np.array(material.eval(mi.BSDFContext(), si, wo)).ravel() / np.array(wo.z))
    assert np.allclose(*values, rtol=1e-3) is same
    assert (paths_obstacle(scene, scene.sensors()[0], "light") is None) is same


# The required depth of paths, in a closed glowing sphere whose light of every depth is known.


def inside(albedo: float) -> mi.Scene:
    """Return a scene with a camera in a sphere of this albedo that emits 1. Paths of at most d segments show the sum of
    albedo^k over k < d.
    """
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60, "film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "sphere": {
                "type": "sphere",
                "flip_normals": True,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
            },
        }
    )


@pytest.mark.parametrize(
    ("albedo", "segments"),
    [(0.4, 8), (0.5, 16), (0.97, 64), pytest.param(0.8, 32, marks=pytest.mark.long)],
)
def test_missing_light_is_that_of_longer_paths(albedo: float, segments: int) -> None:
    found, missing = find_depth(inside(albedo), 0)
    assert found == segments
    if segments == DEPTHS[-1]:
        assert missing is None
        return
    exact = (albedo**segments - albedo ** DEPTHS[-1]) / (1 - albedo ** DEPTHS[-1])
    assert missing == pytest.approx(exact, rel=0.1)
    assert albedo**segments < LOST < albedo ** (segments // 2)


# Which texels a sensor sees.

KEY = "floor.reflectance.data"


def test_an_open_floor_in_full(make_scene):
    scene = make_scene()
    mask = visible_texels(scene, scene.sensors(), KEY)
    assert mask.shape == (4, 6)
    assert mask.all()


def test_texels_are_visible_through_as_many_surfaces_as_pixels(make_scene):
    place = mi.ScalarTransform4f()
    for count, is_seen in ((12, True), (CROSSINGS, False)):
        veil = {"type": "rectangle", "bsdf": {"type": "null"}}
        places = [place.translate([0, 0, 0.2 + 0.01 * number]).scale(9) for number in range(count)]
        scene = make_scene(**{f"veil_{number}": veil | {"to_world": at} for number, at in enumerate(places)})
        assert visible_texels(scene, scene.sensors(), KEY).any() == is_seen


def test_proposals_see_through_eight_panes(make_scene):
    pane = {"type": "rectangle", "bsdf": {"type": "thindielectric"}}
    places = [mi.ScalarTransform4f().translate([0, 0, 0.2 + 0.1 * number]).scale(9) for number in range(8)]
    panes = {f"pane_{number}": pane | {"to_world": place} for number, place in enumerate(places)}
    [floor] = [item for item in propose(make_scene(**panes), 0) if item.info.key == KEY]
    assert floor.share > 0.1


def test_crop_window_and_orientation(make_scene):
    # The lower left quarter of the film. The film's rows run downwards, and the texture's rows run upwards, with v.
    film = {"type": "hdrfilm", "width": 16, "height": 16, "crop_offset_x": 0, "crop_offset_y": 8, "crop_width": 8,
            "crop_height": 8}  # fmt: skip
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0])
    scene = make_scene(camera={"type": "perspective", "fov": 60, "to_world": to_world, "film": film})
    expected = np.zeros((4, 6), dtype=bool)
    expected[:2, :3] = True
    assert np.array_equal(visible_texels(scene, scene.sensors(), KEY), expected)


def mirrored(make_scene, bsdf):
    """Return the scene of the floor, which the sensor sees only through a pane."""
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0])
    pane = mi.ScalarTransform4f().translate([0, 0, 2]).scale(3)
    return make_scene(camera={"type": "perspective", "fov": 30, "to_world": to_world, "film": film},
                      pane={"type": "rectangle", "bsdf": bsdf, "to_world": pane})  # fmt: skip


def test_camera_paths_see_through_glass(make_scene):
    scene = mirrored(make_scene, {"type": "dielectric"})
    seen, all_of_it = (visible_texels(scene, scene.sensors(), KEY, (), each) for each in (False, True))
    assert not seen.any()
    assert all_of_it.any()
    scene = mirrored(make_scene, {"type": "conductor"})  # the mirror shows what is behind the sensor
    assert not visible_texels(scene, scene.sensors(), KEY, (), True).any()


def test_excluded_pixels_show_nothing(make_scene):
    """A mask (H, W) excludes pixels, here the left half of the film."""
    scene = make_scene()
    height, width = (int(n) for n in reversed(scene.sensors()[0].film().crop_size()))
    kept = np.ones((height, width), dtype=bool)
    kept[:, : width // 2] = False
    expected = np.zeros((4, 6), dtype=bool)
    expected[:, 3:] = True
    assert np.array_equal(visible_texels(scene, scene.sensors(), KEY, [kept]), expected)
    assert visible_texels(scene, scene.sensors(), KEY, [None]).all()


def test_hidden_texels_and_occluders(make_scene):
    half = mi.ScalarTransform4f().translate([0.5, 0, 0.01]).scale([0.5, 1, 1])
    expected = np.ones((4, 6), dtype=bool)
    expected[:, 3:] = False
    for bsdf in ({"type": "diffuse"}, {"type": "dielectric"}):  # a light path cannot connect through glass
        scene = make_scene(lid={"type": "rectangle", "to_world": half, "bsdf": bsdf})
        assert np.array_equal(visible_texels(scene, scene.sensors(), KEY), expected)
    scene = make_scene(lid={"type": "rectangle", "to_world": half, "bsdf": {"type": "null"}})
    assert visible_texels(scene, scene.sensors(), KEY).all()


def test_nested_shared_and_repeated(make_scene):
    values = mi.TensorXf(np.full((4, 6, 3), 0.5, np.float32))
    scale = mi.ScalarTransform4f().scale([3, 2, 1])
    texture = {"type": "bitmap", "raw": True, "data": values, "to_uv": scale}
    scene = make_scene(floor={"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}})
    assert visible_texels(scene, scene.sensors(), "floor.brdf_0.reflectance.data").all()


def test_emission_does_not_affect_visibility(make_scene):
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}
    scene = make_scene(sky=sky)
    assert visible_texels(scene, scene.sensors(), "sky.data").all()


# Pixels that see smooth specular lobes: which surfaces count, through which surfaces, and how far the filter spreads
# these pixels.

#: The columns that a pane from 0 to 1 covers, on a film of 16x8 pixels with a view of 4 by 2.
COVERED = slice(8, 12)
MIRROR = {"type": "conductor"}
DIFFUSE = {"type": "diffuse"}
BLEND = {"type": "blendbsdf", "weight": 0.5, "one": {"type": "twosided", "bsdf": DIFFUSE}, "two": MIRROR}


def before_wall(width: int, filter: str = "box", **sensor: Any) -> dict:
    """Return a sensor far before a diffuse wall. The film is `width` pixels wide and half as high."""
    T = mi.ScalarTransform4f
    view = {
        "type": "perspective",
        "fov": 2 * np.degrees(np.arctan(2 / 100)),
        "to_world": T().look_at(origin=[0, 0, 100], target=[0, 0, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": width, "height": width // 2, "rfilter": {"type": filter}},
    }
    wall = {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(9), "bsdf": DIFFUSE}
    return {"type": "scene", "sensor": view | sensor, "wall": wall}


def seen(bsdf: dict, filter: str = "box", in_front: dict | None = None, partly: bool = False) -> np.ndarray:
    """Return the pixels where a sensor sees specular surfaces of a pane, two rows high, before a diffuse wall. If
    `in_front` is given, another pane stands before both.
    """
    T = mi.ScalarTransform4f
    place = T().translate([0.5, 0, 0]).scale([0.499, 0.2, 1])
    scene = before_wall(16, filter) | {
        "light": {"type": "constant"}, "pane": {"type": "rectangle", "to_world": place, "bsdf": bsdf}
    }  # fmt: skip
    if in_front is not None:
        scene["front"] = {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(9), "bsdf": in_front}
    loaded = mi.load_dict(scene, optimize=False)
    return sees_specular(loaded, loaded.sensors()[0], partly)


def pixels(margin: int = 0) -> np.ndarray:
    """Return a mask of the pane's pixels and of `margin` pixels around them."""
    mask = np.zeros((8, 16), dtype=bool)
    mask[3 - margin : 5 + margin, COVERED.start - margin : COVERED.stop + margin] = True
    return mask


@pytest.mark.parametrize(
    ("bsdf", "kind"),
    [
        (MIRROR, "alone"),
        ({"type": "dielectric"}, "alone"),
        ({"type": "twosided", "bsdf": MIRROR}, "alone"),
        ({"type": "plastic"}, "mixed"),
        ({"type": "thindielectric"}, "mixed"),
        (BLEND, "mixed"),
        (DIFFUSE, None),
        ({"type": "roughconductor"}, None),
        ({"type": "roughplastic"}, None),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_counted_surfaces(bsdf: dict, kind: str | None) -> None:
    assert np.array_equal(seen(bsdf), pixels() & (kind == "alone"))
    assert np.array_equal(seen(bsdf, partly=True), pixels() & (kind is not None))


def test_glass_is_visible_through_transparent_surfaces() -> None:
    veil = {"type": "mask", "opacity": 0.5, "bsdf": DIFFUSE}
    assert np.array_equal(seen(MIRROR, in_front=veil), pixels())
    assert not seen(MIRROR, in_front=DIFFUSE).any()


@pytest.mark.parametrize(("filter", "margin"), [("tent", 1), ("gaussian", 2)])
def test_the_filter_spreads_visibility(filter: str, margin: int) -> None:
    assert np.array_equal(seen(MIRROR, filter), pixels(margin))


@pytest.mark.parametrize("size", [16, 300])
@pytest.mark.parametrize("sensor", [{}, {"type": "thinlens", "aperture_radius": 2.0, "focus_distance": 50.0}])
def test_pixels_that_see_lamps(size: int, sensor: dict) -> None:
    T = mi.ScalarTransform4f
    veil = {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(9), "bsdf": {"type": "null"}}
    scene = before_wall(size, **sensor) | {"veil": veil}
    dark = mi.load_dict(scene | {"light": {"type": "point", "position": [0, 0, 50]}}, optimize=False)
    assert not sees_lamps(dark, dark.sensors()[0]).any()
    place = T().translate([0.5, 0, 0]).scale([0.5, 0.25, 1])  # sharp at columns 1/2 to 3/4, rows 3/8 to 5/8
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}
    lit = mi.load_dict(scene | {"lamp": lamp}, optimize=False)
    found = sees_lamps(lit, lit.sensors()[0])
    assert found.shape == (size // 2, size)
    height, width = (np.arange(n) + 0.5 for n in found.shape)
    x, y = width / size, height / (size // 2)
    inside = ((y > 3 / 8) & (y < 5 / 8))[:, None] & ((x > 1 / 2) & (x < 3 / 4))
    assert found[inside].all()
    # A lens focused at half the distance spreads a lamp over this whole film.
    near = 2.0 / 4 * 1.1 if sensor else 1.5 / min(size // 2, 128)
    far = ((y < 3 / 8 - 2 * near) | (y > 5 / 8 + 2 * near))[:, None] | ((x < 1 / 2 - near) | (x > 3 / 4 + near))
    assert not found[far].any()
    # Even lamps are found at each pixel. A sky, the back of a lamp and a lamp with a texture do not count.
    even = sees_even_lamps(lit, lit.sensors()[0])
    assert even[inside].all() or sensor
    assert not even[far].any()
    screen = mi.load_dict({"type": "bitmap", "data": mi.TensorXf(np.ones((2, 2, 3))), "raw": True})
    turned = {"lamp": {**lamp, "to_world": place @ T().rotate([0, 1, 0], 180)}}
    textured = {"lamp": lamp | {"emitter": {"type": "area", "radiance": screen}}}
    for other in ({"sky": {"type": "constant"}}, turned, textured):
        seen = mi.load_dict(scene | other, optimize=False)
        assert not sees_even_lamps(seen, seen.sensors()[0]).any()
    assert found.sum() > (1.5 if sensor else 0.9) * inside.sum()


@pytest.mark.parametrize("margin", [0, 1, 3, 20])
def test_pixels_are_widened_as_by_a_maximum_filter(margin: int) -> None:
    pixels = np.random.default_rng(0).random((7, 13)) < 0.05
    np.testing.assert_array_equal(widened(pixels, margin), maximum_filter(pixels, 2 * margin + 1))


def test_a_shape_in_a_group_is_shown_if_the_scene_has_it_too():
    group, scene = (SimpleNamespace(class_name=lambda name=name: name) for name in ("ShapeGroupPlugin", "Scene"))
    assert not SceneGraph(parents={"shape": [group]}).is_shown("shape")
    assert SceneGraph(parents={"shape": [group, scene]}).is_shown("shape")


@pytest.mark.parametrize(
    ("kind", "faces", "parallel", "beam"),
    [
        ("Rectangle", False, True, True),
        ("Disk", False, True, True),
        ("Rectangle", False, False, False),
        ("Sphere", False, True, False),
        ("Mesh", True, True, True),
        ("Mesh", False, True, False),
    ],
)
def test_beams_are_parallel_light_of_flat_faces(
    monkeypatch: pytest.MonkeyPatch, kind: str, faces: bool, parallel: bool, beam: bool
) -> None:
    monkeypatch.setattr(graph, "interpolates_normals", lambda shape: not faces)
    shape = SimpleNamespace(class_name=lambda: kind, is_mesh=lambda: kind == "Mesh", has_flipped_normals=lambda: True)
    lamp = graph.Lamp(shape, None, 0, parallel, None)
    assert lamp.is_beam is beam
    assert lamp.surrounds is (kind == "Sphere" and not parallel)


def test_rays_pass_hidden_lamps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ray that meets nothing, under a sky, has the emitter of the sky."""

    def bounded(state: Any, condition: Any, body: Any, label: str) -> Any:
        for _ in range(9):
            if not dr.any(condition(*state)):
                return state
            state = body(*state)
        raise AssertionError("the loop does not end")

    monkeypatch.setattr(rays.dr, "while_loop", bounded)
    at = mi.ScalarTransform4f().translate
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    scene = mi.load_dict(
        {"type": "scene", "sky": {"type": "constant"}, "near": {**lamp, "to_world": at([0, 0, 1])},
         "far": {**lamp, "to_world": at([0, 0, 3])}, "wall": {"type": "rectangle", "to_world": at([0, 0, 5])},
         "shade": {"type": "rectangle", "to_world": at([9, 0, 2])}}
    )  # fmt: skip
    origin = mi.Point3f([0, 0, 0, 9, 99, 0], 0, [0, 0, 2, 0, 0, 0])
    ray = mi.Ray3f(origin, mi.Vector3f(0, 0, 1), 0, [])
    ray.maxt = mi.Float(10, 2, 10, 10, 10, 10)
    active = mi.Bool(True, True, True, True, True, False)
    moved = rays.past_lamps(scene, ray, active)
    start = [3, 1, 3, 0, 0, 0]
    assert np.array(moved.o.z) == pytest.approx(start, abs=1e-3)
    assert np.array(moved.o.z + moved.maxt) == pytest.approx(np.array(origin.z + ray.maxt), abs=1e-2)
    si = dr.zeros(mi.SurfaceInteraction3f, 6)
    si.p, si.n = origin, mi.Normal3f(0, 0, 1)
    behind = mi.Point3f(origin.x, 0, [4, 6, 4, 4, 4, 6])
    for has_edges in (False, True):
        hidden = [np.array(rays.is_hidden(scene, si, behind, has_edges, active, passes)).tolist() for passes in (1, 0)]
        assert hidden == [[False, True, False, True, False, False], [True, True, True, True, False, False]]
