"""Image, for sensors, films and filters: `reslrb` against `path`, and against `ptracer` at equal seeds."""

from __future__ import annotations

import numpy as np
import pytest
from conformance.scenes import (
    SAME,
    agreement,
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
from turns import a_few

pytestmark = pytest.mark.usefixtures("samples")
CROP = {"crop_offset_x": 7, "crop_offset_y": 5, "crop_width": 17, "crop_height": 13}
FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")
FORMATS = ("rgba", "luminance", "luminance_alpha", "xyz", "xyza")


def seen(sensor, **things):
    """The stage under a lamp that the camera sees, over a checkered floor."""
    flat = transform().rotate([1, 0, 0], -90) @ transform().scale(2)
    floor = rectangle({"type": "diffuse", "reflectance": bitmap(16, 16)}, flat)
    light = lamp(side=0.8, position=(-0.4, 1.7, -0.6), target=(0, 0.3, 2))
    return stage({"lamp": light}, sensor, floor=floor, **things)


@pytest.mark.parametrize("name", FILTERS)
def test_filter_equals_ptracer_at_equal_seeds(name):
    assert difference_from_ptracer(seen(camera(32, 32, rfilter=name))) < SAME


@pytest.mark.parametrize("name", a_few(FILTERS, ("box", "lanczos")))
def test_filter(name):
    # `path` gathers splats from beyond the film's border, which light paths do not reach: 4 pixels are left out.
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
    # The same light paths, those that miss the crop window lost.
    assert np.abs(part - whole[5:18, 7:24]).mean() < SAME * whole.mean()


@pytest.mark.parametrize("kind", a_few(FORMATS, ("luminance_alpha", "xyz")))
def test_pixel_format(kind):
    scene = seen(camera(film={"pixel_format": kind}))
    result = agreement(scene)
    assert result, result
    # `ptracer` divides colours by an alpha that it never normalises.
    if not kind.endswith("a") and "alpha" not in kind:
        assert difference_from_ptracer(scene) < SAME


def test_alpha_is_opaque():
    (image,) = images(seen(camera(film={"pixel_format": "rgba"})), "reslrb", range(1), 4)
    assert (image[..., 3] == 1).all()


def test_half_precision_film():
    result = agreement(seen(camera(film={"component_format": "float16"})))
    assert result, result


def test_thin_lens():
    scene = seen(camera(type="thinlens", aperture_radius=0.4, focus_distance=2.0))  # floor and lamp out of focus
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
    # A screen near the sensor, which the near plane cuts away, and so lets be seen what it hides.
    screen = rectangle({"type": "diffuse"}, transform().translate([0.5, 1.3, 3]) @ transform().scale(0.15))
    result = agreement(seen(camera(**kind | planes), **({"screen": screen} if "near_clip" in planes else {})))
    assert result, result


@pytest.mark.parametrize("focus", [{}, {"focus_distance": 0.9}, {"focus_distance": 30.0}, {"focus_distance": 2.0}])
def test_a_lens_that_focuses_outside_of_its_clip_planes(focus):
    # Stock light tracing has it see nothing then, or, on the far plane, where it focuses by default, a part.
    result = agreement(seen(camera(type="thinlens", aperture_radius=0.1, near_clip=1.0, far_clip=7.0, **focus)))
    assert result, result


@pytest.mark.parametrize("film", [{}, CROP])
def test_principal_point(film):
    # `ptracer` clips it to where the film would be without the offset.
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
