"""Which texels a sensor sees."""

from __future__ import annotations

import numpy as np

from reslrb_cli.scene.visibility import visible_texels

KEY = "floor.reflectance.data"


def test_all_of_an_open_floor(make_scene):
    scene = make_scene()
    mask = visible_texels(scene, scene.sensors(), KEY)
    assert mask.shape == (4, 6)
    assert mask.all()


def test_crop_window_and_orientation(make_scene):
    import mitsuba as mi

    # The lower left quarter of the film: its rows run downwards, the texture's rows with v, upwards.
    film = {"type": "hdrfilm", "width": 16, "height": 16, "crop_offset_x": 0, "crop_offset_y": 8, "crop_width": 8,
            "crop_height": 8}  # fmt: skip
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0])
    scene = make_scene(camera={"type": "perspective", "fov": 60, "to_world": to_world, "film": film})
    expected = np.zeros((4, 6), dtype=bool)
    expected[:2, :3] = True
    assert np.array_equal(visible_texels(scene, scene.sensors(), KEY), expected)


def test_pixels_that_are_left_out_show_nothing(make_scene):
    """As a mask has them: those of the film's left half, (H, W)."""
    scene = make_scene()
    height, width = (int(n) for n in reversed(scene.sensors()[0].film().crop_size()))
    kept = np.ones((height, width), dtype=bool)
    kept[:, : width // 2] = False
    expected = np.zeros((4, 6), dtype=bool)
    expected[:, 3:] = True
    assert np.array_equal(visible_texels(scene, scene.sensors(), KEY, [kept]), expected)
    assert visible_texels(scene, scene.sensors(), KEY, [None]).all()


def test_hidden_texels_and_what_hides(make_scene):
    import mitsuba as mi

    half = mi.ScalarTransform4f().translate([0.5, 0, 0.01]).scale([0.5, 1, 1])
    expected = np.ones((4, 6), dtype=bool)
    expected[:, 3:] = False
    for bsdf in ({"type": "diffuse"}, {"type": "dielectric"}):  # a light path cannot connect through glass
        scene = make_scene(lid={"type": "rectangle", "to_world": half, "bsdf": bsdf})
        assert np.array_equal(visible_texels(scene, scene.sensors(), KEY), expected)
    scene = make_scene(lid={"type": "rectangle", "to_world": half, "bsdf": {"type": "null"}})
    assert visible_texels(scene, scene.sensors(), KEY).all()


def test_nested_shared_and_repeated(make_scene):
    import mitsuba as mi

    values = mi.TensorXf(np.full((4, 6, 3), 0.5, np.float32))
    scale = mi.ScalarTransform4f().scale([3, 2, 1])
    texture = {"type": "bitmap", "raw": True, "data": values, "to_uv": scale}
    scene = make_scene(floor={"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}})
    assert visible_texels(scene, scene.sensors(), "floor.brdf_0.reflectance.data").all()


def test_emission_is_not_a_matter_of_sight(make_scene):
    import mitsuba as mi

    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}
    scene = make_scene(sky=sky)
    assert visible_texels(scene, scene.sensors(), "sky.data").all()
