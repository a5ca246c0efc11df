"""What a scene needs, and scenes that light tracing cannot render."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import numpy as np
import pytest

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.scene.catalog import summarise
from reslrb_cli.scene.needs import check_camera_paths, check_supported, light_obstacle, look, scene_needs

GLASS = {"type": "dielectric"}


@pytest.fixture(autouse=True)
def _without_scenes_of_before() -> Iterator[None]:
    """Mitsuba asks all emitters that there are, also a `timed_sunsky` of a scene that an error still holds."""
    yield
    gc.collect()


def test_plain_scene(make_scene):
    scene = make_scene()
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.emitters == ("PointLight",)
    assert needs.environment is None
    assert needs.has_smooth
    absent = ("has_delta_lobes", "has_null", "has_shading_normals", "has_visible_emitters", "thin_lens")
    assert [name for name in (*absent, "moving_shutter", "has_instances") if getattr(needs, name)] == []
    check_supported(scene, scene.sensors()[0])


def test_everything(make_scene):
    scene = make_scene(
        camera={"type": "thinlens", "aperture_radius": 0.1, "shutter_close": 1.0},
        sky={"type": "constant"},
        veil={"type": "sphere", "bsdf": {"type": "mask", "bsdf": GLASS, "opacity": 0.5}},
    )
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.emitters[needs.environment] == "ConstantBackgroundEmitter"
    assert needs.has_delta_lobes
    assert needs.has_null
    assert needs.has_visible_emitters
    assert needs.thin_lens
    assert needs.moving_shutter


@pytest.mark.parametrize("flat", [True, False])
def test_shading_normals(make_scene, tmp_path, flat):
    import mitsuba as mi

    mesh = mi.Mesh("m", 3, 1, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [0, 0, 0, 1, 0, 0, 0, 1, 0]
    params["faces"] = [0, 1, 2]
    params["vertex_normals"] = [0, 0, 1] * 3 if flat else [0, 0, 1, 0.6, 0, 0.8, 0, 0, 1]
    params.update()
    scene = make_scene(mesh=mesh)
    assert scene_needs(scene, scene.sensors()[0]).has_shading_normals is not flat


def test_nested_bsdfs_and_groups_are_seen(make_scene, tmp_path):
    import mitsuba as mi

    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "cube.ply"))
    group = {"type": "shapegroup", "cube": {"type": "ply", "filename": str(tmp_path / "cube.ply"), "bsdf": GLASS}}
    scene = make_scene(group=group, copy={"type": "instance", "group": {"type": "ref", "id": "group"}})
    needs = scene_needs(scene, scene.sensors()[0])
    assert needs.has_delta_lobes
    assert needs.has_instances
    assert summarise(scene).shapes == {"Rectangle": 1, "PLYMesh": 1}


def test_view(make_scene):
    import mitsuba as mi

    far = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 9], up=[0, 1, 0])
    scene = make_scene(sky={"type": "constant"})
    view = look(scene, scene.sensors()[0])
    assert 0 < view.smooth < 1
    assert view.specular == 0
    assert view.smooth + view.nothing == pytest.approx(1)
    assert view.emission == pytest.approx(view.nothing)
    scene = make_scene(camera={"type": "perspective", "to_world": far})
    assert look(scene, scene.sensors()[0]).nothing == 1
    check_supported(scene, scene.sensors()[0])  # black, but rightly so


def test_mask_in_front_is_looked_through(make_scene):
    scene = make_scene(veil={"type": "sphere", "radius": 2, "bsdf": {"type": "null"}})
    assert look(scene, scene.sensors()[0]) == look(make_scene(), make_scene().sensors()[0])


@pytest.mark.parametrize(
    ("changes", "hide_emitters", "reason"),
    [
        ({"camera": {"type": "orthographic"}}, False, "OrthographicCamera; light paths connect to"),
        ({"camera": {"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1}}}, False, "DistantSensor"),
        ({"sky": {"type": "timed_sunsky"}}, False, "is a `timed_sunsky`"),
        ({"plane": {"type": "rectangle", "bsdf": GLASS}}, False, "only smooth specular surfaces"),
        (
            {"plane": {"type": "rectangle", "bsdf": {"type": "conductor"}}, "sky": {"type": "constant"}},
            True,
            "specular",
        ),
        (
            {"fog": {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}},
            False,
            "shape fog bounds a participating medium",
        ),
    ],
)
def test_refused(make_scene, changes, hide_emitters, reason):
    scene = make_scene(**changes)
    with pytest.raises(UnsupportedScene, match=reason):
        check_supported(scene, scene.sensors()[0], hide_emitters)


def test_specular_scene_with_a_visible_light(make_scene):
    scene = make_scene(plane={"type": "rectangle", "bsdf": GLASS}, sky={"type": "constant"})
    check_supported(scene, scene.sensors()[0])


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


def test_summary_of_what_cannot_be_rendered(make_scene):
    sensor = summarise(make_scene(camera={"type": "orthographic"})).sensors[0]
    assert sensor.view is None
    assert "OrthographicCamera" in sensor.obstacle


def test_fractions_are_of_the_crop_window(make_scene):
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 16, "height": 12, "crop_offset_x": 7, "crop_offset_y": 5, "crop_width": 2,
            "crop_height": 2}  # fmt: skip
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0])
    scene = make_scene(camera={"type": "perspective", "fov": 60, "to_world": to_world, "film": film})
    assert look(scene, scene.sensors()[0]).smooth == 1
    assert np.isclose(look(make_scene(), make_scene().sensors()[0]).smooth, 0.45, atol=0.15)


def test_light_that_camera_paths_cannot_find_is_refused_for_prb(make_scene):
    scene = make_scene()
    check_camera_paths(scene, scene.sensors()[0])
    scene = make_scene(lamp={"type": "rectangle", "emitter": {"type": "directionalarea"}})
    with pytest.raises(UnsupportedScene, match="`prb` cannot evaluate; take integrator"):
        check_camera_paths(scene, scene.sensors()[0])


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
        ({"camera": {"type": "perspective", "inside": {"type": "homogeneous"}}}, "sensor camera stands in"),
        ({"bulb": {"type": "point", "inside": {"type": "homogeneous"}}}, "emitter bulb stands in a participating"),
        ({"sky": {"type": "timed_sunsky"}}, "take a `sunsky`"),
        ({"ball": {"type": "sphere", "bsdf": WARM}}, "Mitsuba cannot evaluate bsdf bsdf: .*not implemented"),
    ],
)  # fmt: skip
def test_what_no_integrator_knows_is_refused_alike(make_scene, changes, reason):
    scene = make_scene(**changes)
    said = []
    for check in (check_supported, check_camera_paths):
        with pytest.raises(UnsupportedScene, match=reason) as error:
            check(scene, scene.sensors()[0])
        said.append(str(error.value))
    assert said[0] == said[1]
    assert "integrator.type" not in said[0]


def test_a_medium_that_rays_cannot_meet_is_nobodys(make_scene):
    scene = make_scene(group={"type": "shapegroup", "fog": FOG})
    check_supported(scene, scene.sensors()[0])
    check_camera_paths(scene, scene.sensors()[0])


@pytest.mark.parametrize(
    ("changes", "way"),
    [
        ({"camera": {"type": "orthographic"}}, "sensors; take integrator.type: prb"),
        ({"plane": {"type": "rectangle", "bsdf": {"type": "hair"}}}, "another material; take integrator.type: prb"),
        ({"plane": {"type": "rectangle", "bsdf": GLASS}}, "rough surface, or take integrator.type: prb"),
        (
            {"camera": {"type": "orthographic"}, "lamp": BEAM},
            "sensors; nor can paths the other way round.*`prb` cannot",
        ),
    ],
)
def test_the_way_out_is_named_where_there_is_one(make_scene, changes, way):
    scene = make_scene(**changes)
    with pytest.raises(UnsupportedScene, match=f"{way}[^;]*$"):
        check_supported(scene, scene.sensors()[0])


@pytest.mark.parametrize(("bsdf", "same"), [("hair", False), ("pplastic", True), ("principled", True)])
def test_a_material_is_refused_to_light_paths_that_differs_with_light_and_view_exchanged(make_scene, bsdf, same):
    import mitsuba as mi

    scene = make_scene(plane={"type": "rectangle", "bsdf": {"type": bsdf}})
    material = next(shape for shape in scene.shapes() if shape.id() == "plane").bsdf()
    light, view = (mi.Vector3f(mi.ScalarVector3f(way)) for way in ([0.36, 0.48, 0.8], [-0.64, 0.48, 0.6]))
    values = []
    for wi, wo in ((light, view), (view, light)):
        si = mi.SurfaceInteraction3f()
        si.wi = wi
        values.append(np.array(material.eval(mi.BSDFContext(), si, wo)).ravel() / np.array(wo.z))
    assert np.allclose(*values, rtol=1e-3) is same
    assert (light_obstacle(scene, scene.sensors()[0]) is None) is same
