"""Images of `reslrb` against `path` and `ptracer`: depth, roulette, passes, masks, shapes, sensors and films."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from conformance.scenes import (
    RED,
    SAME,
    WHITE,
    agreement,
    ball,
    bitmap,
    camera,
    difference_from_ptracer,
    images,
    lamp,
    rectangle,
    rgb,
    stage,
    transform,
)
from turns import a_few, taking_turns

pytestmark = pytest.mark.usefixtures("samples")


# Image: depth, roulette, passes, shading normals, masks and shapes. `reslrb` is compared with `path` and `ptracer`.

TWO_SIDED = {"type": "twosided", "bsdf": RED}


def visible():
    """Return a lamp that the camera sees."""
    return {"lamp": lamp(position=(0, 1.6, -0.8), target=(0, 0.3, 2))}


def large():
    return {"lamp": lamp(side=1.5, radiance=rgb(2, 3, 4))}


def leaf(opacity=None, distance: float = 2.0, size: float = 0.5):
    """Return a perforated sheet between camera and stage. The sheet also covers a part of the background and of
    `visible()`.
    """
    bsdf = {"type": "mask", "opacity": opacity or bitmap(6, 6, channels=1, low=0), "bsdf": TWO_SIDED}
    to_world = transform().look_at(origin=[0.2, 1.3, distance], target=[0.4, 1.5, 4], up=[0, 1, 0])
    return rectangle(bsdf, to_world @ transform().scale(size))


@pytest.fixture(scope="module")
def facets(tmp_path_factory):
    """Path of a PLY file with a coarse ball. The ball's smooth normals are up to 20 degrees off its faces."""
    n, m = 5, 9
    polar, azimuth = np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, m, endpoint=False)
    normals = np.array([[np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)] for t in polar for p in azimuth])
    quads = [(i * m + j, i * m + (j + 1) % m, (i + 1) * m + j, (i + 1) * m + (j + 1) % m)
             for i in range(n) for j in range(m)]  # fmt: skip
    faces = [(a, b, c) for a, b, c, _ in quads[m:]] + [(b, d, c) for _, b, c, d in quads[:-m]]
    mesh = mi.Mesh("ball", len(normals), len(faces), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = (0.5 * normals + [0, 0.7, 0]).ravel().astype(np.float32)
    params["vertex_normals"] = normals.ravel().astype(np.float32)
    params["faces"] = np.array(faces).ravel().astype(np.uint32)
    params.update()
    path = str(tmp_path_factory.mktemp("mesh") / "ball.ply")
    mesh.write_ply(path)
    return path


MATERIALS = {
    "diffuse": {"type": "twosided", "bsdf": WHITE},
    "roughplastic": {"type": "roughplastic", "alpha": 0.2},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.3},
}


@pytest.mark.parametrize("name", MATERIALS)
def test_shading_normals(facets, name):
    scene = stage(large(), ball={"type": "ply", "filename": facets, "bsdf": MATERIALS[name]})
    result = agreement(scene)
    assert result, result
    assert difference_from_ptracer(scene) < SAME


def test_mesh_emitter(facets):
    # The mesh has no smooth normals, because the two ways in which `path` samples an emitter treat them differently.
    emitter = {"type": "area", "radiance": rgb(2, 1, 1)}
    mesh = {"type": "ply", "filename": facets, "bsdf": WHITE, "face_normals": True, "emitter": emitter}
    result = agreement(stage({}, ball=mesh))
    assert result, result


@pytest.mark.parametrize("depth", a_few([0, 1, 2, 3, -1], ["0", "1", "3", "-1"]))
def test_max_depth(depth):
    scene = stage(visible())
    result = agreement(scene, max_depth=depth, rr_depth=5)
    assert result, result
    if depth not in (0, 1):
        assert difference_from_ptracer(scene, max_depth=depth) < SAME


@taking_turns("name", ["diffuse", "roughdielectric"], "rr_depth", [1, 2])
def test_roulette(rr_depth, name):
    scene = stage(large(), ball=ball(MATERIALS[name]))
    result = agreement(scene, max_depth=-1, rr_depth=rr_depth)
    assert result, result
    assert difference_from_ptracer(scene, max_depth=-1, rr_depth=rr_depth) < SAME


def test_mask_before_the_camera():
    result = agreement(stage(large(), leaf=leaf()))
    assert result, result


@pytest.mark.parametrize("depth", a_few([1, 2, 3, 5], ["1", "5"]))
def test_mask_between_emitter_and_camera(depth):
    # Each surface that light passes straight through counts as a vertex.
    result = agreement(stage(visible(), leaf=leaf()), max_depth=depth)
    assert result, result


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_masks_before_the_sky(hide_emitters):
    scene = stage({"sky": {"type": "constant"}}, leaf=leaf(), second=leaf(0.5, distance=2.4, size=0.3))
    result = agreement(scene, max_depth=4, hide_emitters=hide_emitters)
    assert result, result


def test_opaque_and_absent_masks():
    scene = stage(large(), leaf=leaf(1.0, size=0.2), second=leaf(0.0, distance=2.4))
    result = agreement(scene)
    assert result, result


def test_passes_are_unbiased_and_independent():
    scene = stage(visible())
    result = agreement(scene, reslrb={"samples_per_pass": 32})
    assert result, result
    options = {"max_depth": 5, "rr_depth": 100}
    in_one = images(scene, "reslrb", range(32), 16, **options).std(0).mean()
    in_four = images(scene, "reslrb", range(32), 16, samples_per_pass=4, **options).std(0).mean()
    assert in_four == pytest.approx(in_one, rel=0.1)


def test_the_first_pass_equals_ptracer():
    assert difference_from_ptracer(stage(large()), spp=8, reslrb={"samples_per_pass": 8}) < SAME


def test_shapes():
    things = {
        "ball": {"type": "cylinder", "p0": [0, 0.2, 0], "p1": [0.3, 1, 0.2], "radius": 0.3, "bsdf": TWO_SIDED},
        "disk": {"type": "disk", "bsdf": TWO_SIDED, "to_world": transform().translate([-0.8, 0.8, 0.2])
                 @ transform().rotate([1, 0, 0], -60) @ transform().scale(0.4)},
        "inside out": ball(TWO_SIDED, (0.9, 0.4, 0.4), 0.3) | {"flip_normals": True},
        "cube": {"type": "cube", "bsdf": WHITE, "to_world": transform().translate([-0.9, 0.2, 0.8])
                 @ transform().rotate([0, 1, 0], 30) @ transform().scale(0.2)},
    }  # fmt: skip
    result = agreement(stage(large(), **things))
    assert result, result


def test_instances():
    scene = stage(
        large(),
        ball=None,
        group={"type": "shapegroup", "shape": ball(WHITE, (0, 0, 0), 0.3)},
        left={"type": "instance", "shapegroup": {"type": "ref", "id": "group"},
              "to_world": transform().translate([-0.5, 0.6, 0]) @ transform().scale([1, 1.5, 1])},
        right={"type": "instance", "shapegroup": {"type": "ref", "id": "group"},
               "to_world": transform().translate([0.5, 0.6, 0])},
    )  # fmt: skip
    result = agreement(scene)
    assert result, result


def test_camera_inside_a_closed_room():
    # No light leaves the room, so that every path runs to its end.
    room = {"type": "cube", "flip_normals": True, "bsdf": WHITE,
            "to_world": transform().translate([0, 2, 1]) @ transform().scale([3, 2.5, 4])}  # fmt: skip
    scene = stage(visible(), camera(), room=room)
    result = agreement(scene, max_depth=12, rr_depth=4)
    assert result, result
    assert difference_from_ptracer(scene, max_depth=12) < SAME


# Image, for sensors, films and filters: `reslrb` against `path`, and against `ptracer` at equal seeds.

CROP = {"crop_offset_x": 7, "crop_offset_y": 5, "crop_width": 17, "crop_height": 13}
FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")
FORMATS = ("rgba", "luminance", "luminance_alpha", "xyz", "xyza")


def seen(sensor, **things):
    """Return the stage under a lamp that the camera sees, over a checkered floor."""
    flat = transform().rotate([1, 0, 0], -90) @ transform().scale(2)
    floor = rectangle({"type": "diffuse", "reflectance": bitmap(16, 16)}, flat)
    light = lamp(side=0.8, position=(-0.4, 1.7, -0.6), target=(0, 0.3, 2))
    return stage({"lamp": light}, sensor, floor=floor, **things)


@pytest.mark.parametrize("name", FILTERS)
def test_filter_equals_ptracer_at_equal_seeds(name):
    assert difference_from_ptracer(seen(camera(32, 32, rfilter=name))) < SAME


@pytest.mark.parametrize("name", a_few(FILTERS, ("box", "lanczos")))
def test_filter(name):
    # `path` gathers splats from beyond the film's border, which light paths do not reach. A border of 4 pixels is left
    # out.
    result = agreement(seen(camera(32, 32, rfilter=name)), border=0 if name == "box" else 4)
    assert result, result


@pytest.mark.parametrize("name", ["box", "gaussian"])
def test_crop_window(name):
    scene = seen(camera(rfilter=name, film=CROP))
    result = agreement(scene, border=0 if name == "box" else 2, spp=512)
    assert result, result
    assert difference_from_ptracer(scene) < SAME


def test_crop_window_is_a_part_of_the_image():
    options = {"max_depth": 5, "rr_depth": 100, "hide_emitters": True}
    (whole,) = images(seen(camera()), "reslrb", range(1), 16, **options)
    (part,) = images(seen(camera(film=CROP)), "reslrb", range(1), 16, **options)
    # The light paths are the same, but those that miss the crop window are lost.
    assert np.abs(part - whole[5:18, 7:24]).mean() < SAME * whole.mean()


@pytest.mark.parametrize("kind", a_few(FORMATS, ("luminance_alpha", "xyz")))
def test_pixel_format(kind):
    scene = seen(camera(film={"pixel_format": kind}))
    result = agreement(scene)
    assert result, result
    # `ptracer` divides colours by an alpha that it never normalizes.
    if not kind.endswith("a") and "alpha" not in kind:
        assert difference_from_ptracer(scene) < SAME


def test_alpha_is_opaque():
    (image,) = images(seen(camera(film={"pixel_format": "rgba"})), "reslrb", range(1), 4)
    assert (image[..., 3] == 1).all()


def test_half_precision_film():
    result = agreement(seen(camera(film={"component_format": "float16"})))
    assert result, result


def test_thin_lens():
    scene = seen(camera(type="thinlens", aperture_radius=0.4, focus_distance=2.0))  # floor and lamp are out of focus
    result = agreement(scene)
    assert result, result
    assert difference_from_ptracer(scene) < SAME


def test_thin_lens_through_a_mask():
    leaf = rectangle(
        {"type": "mask", "opacity": bitmap(4, 4, channels=1, low=0), "bsdf": {"type": "diffuse"}},
        transform().translate([0.2, 1.2, 2]) @ transform().scale(0.4),
    )
    result = agreement(seen(camera(type="thinlens", aperture_radius=0.2, focus_distance=3.5), leaf=leaf))
    assert result, result


def test_moving_shutter():
    scene = seen(camera(shutter_open=0.0, shutter_close=1.0))
    result = agreement(scene)
    assert result, result
    assert difference_from_ptracer(scene) < SAME


def test_mirrored_camera():
    to_world = camera()["to_world"] @ transform().scale([-1, 1, 1])
    result = agreement(seen(camera(to_world=to_world)))
    assert result, result


def test_near_clip_cuts_surfaces_away():
    scene = seen(camera(near_clip=3.9, far_clip=5.5))
    result = agreement(scene)
    assert result, result


LENS = {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.2}


@pytest.mark.parametrize("kind", [{}, LENS], ids=["perspective", "thinlens"])
@pytest.mark.parametrize("planes", [{"near_clip": 3.9}, {"far_clip": 4.6}], ids=["near", "far"])
def test_clip_planes(kind, planes):
    # The near plane cuts away a screen near the sensor, so that the objects behind the screen are visible.
    screen = rectangle({"type": "diffuse"}, transform().translate([0.5, 1.3, 3]) @ transform().scale(0.15))
    result = agreement(seen(camera(**kind | planes), **({"screen": screen} if "near_clip" in planes else {})))
    assert result, result


@pytest.mark.parametrize("focus", [{}, {"focus_distance": 0.9}, {"focus_distance": 30.0}, {"focus_distance": 2.0}])
def test_a_lens_focused_outside_its_clip_planes(focus):
    # With such a focus, a lens in stock light tracing sees nothing. If it focuses on the far plane, as by default, it
    # sees a part.
    result = agreement(seen(camera(type="thinlens", aperture_radius=0.1, near_clip=1.0, far_clip=7.0, **focus)))
    assert result, result


@pytest.mark.parametrize("film", [{}, CROP])
def test_principal_point(film):
    # `ptracer` clips the image to where the film would be without the offset.
    scene = seen(camera(film=film, principal_point_offset_x=0.2, principal_point_offset_y=-0.1))
    result = agreement(scene)
    assert result, result


def test_second_sensor():
    scene = seen(camera(), other=camera(24, 16, to_world=transform().look_at([2, 2, 3], [0, 0.5, 0], [0, 1, 0])))
    result = agreement(scene, sensor=1)
    assert result, result
    assert difference_from_ptracer(scene, sensor=1) < SAME


def test_coloured_light_in_a_wide_film():
    result = agreement(stage({"lamp": lamp(radiance=rgb(5, 0, 1))}, camera(48, 16)))
    assert result, result
