"""What a scene needs, and scenes that light tracing cannot render."""

from __future__ import annotations

import numpy as np
import pytest

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.scene import check_camera_paths, check_supported, look, scene_needs, summarise

GLASS = {"type": "dielectric"}


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


def test_clip_planes_are_needed_where_anything_is_outside_of_them(make_scene):
    import mitsuba as mi

    def needs(camera, **things):
        scene = make_scene(camera={"type": "perspective", "to_world": view} | camera, **things)
        found = scene_needs(scene, scene.sensors()[0])
        return found.near_clip, found.lens_clip

    place = mi.ScalarTransform4f().translate
    view = mi.ScalarTransform4f().look_at(origin=[0.5, 0.4, 3], target=[0, 0, 0], up=[0, 1, 0])
    lens = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}
    room = {"type": "cube", "flip_normals": True, "to_world": mi.ScalarTransform4f().scale(5)}  # around the sensor
    ball = {"type": "sphere", "radius": 5.0}
    for around in (room, ball):
        assert needs({}, around=around) == (False, False)
        assert needs(lens, around=around) == (False, False)
        assert needs(lens | {"far_clip": 7.0}, around=around) == (False, True)
    pane = {"type": "rectangle", "to_world": place([0.5, 0.4, 2.5]) @ mi.ScalarTransform4f().scale(0.01)}
    assert needs({"near_clip": 0.4}, pane=pane) == (False, False)
    assert needs({"near_clip": 0.6}, pane=pane) == (True, False)
    assert needs(lens | {"near_clip": 0.6}, pane=pane) == (True, True)
    beside = pane | {"to_world": place([2.5, 0.4, 2.5]) @ mi.ScalarTransform4f().scale(0.01)}
    assert needs({"near_clip": 0.6}, pane=beside) == (False, False)
    assert needs({"near_clip": 0.6, "fov": 150.0}, pane=beside) == (True, False)
    crossing = pane | {"to_world": place([0.5, 0.4, 2.99]) @ mi.ScalarTransform4f().scale(5)}  # no corner is near
    assert needs({"near_clip": 0.6}, pane=crossing) == (True, False)


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
    with pytest.raises(UnsupportedScene, match="`prb` cannot evaluate"):
        check_camera_paths(scene, scene.sensors()[0])
