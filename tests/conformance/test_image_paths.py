"""Images of `reslrb` against `path` and `ptracer`: depth, roulette, passes, masks, shapes, sensors and films."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from conformance.scenes import (
    RED,
    SAME,
    WHITE,
    ImageCase,
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
from turns import a_few

from reslrb_cli.measure.scenes.moving import mesh

pytestmark = pytest.mark.usefixtures("samples")

TWO_SIDED = {"type": "twosided", "bsdf": RED}
#: A lamp that the camera sees, and a large lamp that the camera does not see.
VISIBLE = {"position": (0, 1.6, -0.8), "target": (0, 0.3, 2)}
LARGE = {"side": 1.5, "radiance": rgb(2, 3, 4)}


def lit(light: dict[str, Any], sensor: Any = None, **things: Any) -> Any:
    """Return the stage under one lamp."""
    return stage({"lamp": lamp(**light)}, sensor, **things)


def leaf(opacity=None, distance: float = 2.0, size: float = 0.5):
    """Return a perforated sheet between camera and stage. The sheet also covers a part of the background and of the
    visible lamp.
    """
    bsdf = {"type": "mask", "opacity": opacity or bitmap(6, 6, channels=1, low=0), "bsdf": TWO_SIDED}
    to_world = transform().look_at(origin=[0.2, 1.3, distance], target=[0.4, 1.5, 4], up=[0, 1, 0])
    return rectangle(bsdf, to_world @ transform().scale(size))


def facets(bsdf: dict[str, Any], smooth: bool = True, **things: Any) -> mi.Mesh:
    """Return a coarse ball. If `smooth`, its normals are up to 20 degrees off its faces."""
    n, m = 5, 9
    polar, azimuth = np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, m, endpoint=False)
    normals = np.array([[np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)] for t in polar for p in azimuth])
    quads = [(i * m + j, i * m + (j + 1) % m, (i + 1) * m + j, (i + 1) * m + (j + 1) % m)
             for i in range(n) for j in range(m)]  # fmt: skip
    faces = [(a, b, c) for a, b, c, _ in quads[m:]] + [(b, d, c) for _, b, c, d in quads[:-m]]
    return mesh(0.5 * normals + [0, 0.7, 0], np.array(faces), bsdf, None, smooth and normals, "ball", **things)


def shapes() -> dict[str, Any]:
    """Return one object of each kind of shape."""
    return {
        "ball": {"type": "cylinder", "p0": [0, 0.2, 0], "p1": [0.3, 1, 0.2], "radius": 0.3, "bsdf": TWO_SIDED},
        "disk": {"type": "disk", "bsdf": TWO_SIDED, "to_world": transform().translate([-0.8, 0.8, 0.2])
                 @ transform().rotate([1, 0, 0], -60) @ transform().scale(0.4)},
        "inside out": ball(TWO_SIDED, (0.9, 0.4, 0.4), 0.3) | {"flip_normals": True},
        "cube": {"type": "cube", "bsdf": WHITE, "to_world": transform().translate([-0.9, 0.2, 0.8])
                 @ transform().rotate([0, 1, 0], 30) @ transform().scale(0.2)},
    }  # fmt: skip


def instances() -> dict[str, Any]:
    """Return two instances of a group, in place of the ball."""

    def instance(*to_world: Any) -> dict[str, Any]:
        moved = transform().translate(to_world[0]) @ transform().scale(to_world[1])
        return {"type": "instance", "shapegroup": {"type": "ref", "id": "group"}, "to_world": moved}

    return {"ball": None, "group": {"type": "shapegroup", "shape": ball(WHITE, (0, 0, 0), 0.3)},
            "left": instance([-0.5, 0.6, 0], [1, 1.5, 1]), "right": instance([0.5, 0.6, 0], 1)}  # fmt: skip


def closed() -> dict[str, Any]:
    """Return a room that no light leaves, so that every path runs to its end."""
    return {"room": {"type": "cube", "flip_normals": True, "bsdf": WHITE,
                     "to_world": transform().translate([0, 2, 1]) @ transform().scale([3, 2.5, 4])}}  # fmt: skip


MATERIALS = {
    "diffuse": {"type": "twosided", "bsdf": WHITE},
    "roughplastic": {"type": "roughplastic", "alpha": 0.2},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.3},
}
PATHS = [
    *(ImageCase(f"shading_normals_{name}", lambda bsdf=bsdf: lit(LARGE, ball=facets(bsdf)), stock=True)
      for name, bsdf in MATERIALS.items()),
    # The mesh has no smooth normals, because the two ways in which `path` samples an emitter treat them differently.
    ImageCase("mesh_emitter", lambda: stage({}, ball=facets(
        WHITE, False, emitter={"type": "area", "radiance": rgb(2, 1, 1)}))),
    *(ImageCase(f"depth_{depth}", lambda: lit(VISIBLE), depth not in (0, 1), {"max_depth": depth, "rr_depth": 5})
      for depth in (0, 1, 2, 3, -1)),
    *(ImageCase(f"roulette_{name}_{rr_depth}", lambda name=name: lit(LARGE, ball=ball(MATERIALS[name])), True,
                {"max_depth": -1, "rr_depth": rr_depth})
      for name in ("diffuse", "roughdielectric") for rr_depth in (1, 2)),
    ImageCase("mask_before_the_camera", lambda: lit(LARGE, leaf=leaf())),
    # Each surface that light passes straight through counts as a vertex.
    *(ImageCase(f"mask_between_{depth}", lambda: lit(VISIBLE, leaf=leaf()), options={"max_depth": depth})
      for depth in (1, 2, 3, 5)),
    *(ImageCase(f"masks_before_a_{name}_sky", lambda: stage(
        {"sky": {"type": "constant"}}, leaf=leaf(), second=leaf(0.5, distance=2.4, size=0.3)),
        options={"max_depth": 4, "hide_emitters": hidden}) for name, hidden in (("visible", False), ("hidden", True))),
    ImageCase("opaque_and_absent_masks",
              lambda: lit(LARGE, leaf=leaf(1.0, size=0.2), second=leaf(0.0, distance=2.4))),
    ImageCase("shapes", lambda: lit(LARGE, **shapes())),
    ImageCase("instances", lambda: lit(LARGE, **instances())),
    ImageCase("closed_room", lambda: lit(VISIBLE, **closed()), True, {"max_depth": 12, "rr_depth": 4}),
]  # fmt: skip


# Sensors, films and filters.

CROP = {"crop_offset_x": 7, "crop_offset_y": 5, "crop_width": 17, "crop_height": 13}
FILTERS = ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos")
FORMATS = ("rgba", "luminance", "luminance_alpha", "xyz", "xyza")
LENS = {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.2}


def seen(things: dict[str, Any] | None = None, **sensor: Any) -> Any:
    """Return the stage under a lamp that the camera sees, over a checkered floor. `sensor` changes the camera."""
    flat = transform().rotate([1, 0, 0], -90) @ transform().scale(2)
    floor = rectangle({"type": "diffuse", "reflectance": bitmap(16, 16)}, flat)
    light = lamp(side=0.8, position=(-0.4, 1.7, -0.6), target=(0, 0.3, 2))
    return stage({"lamp": light}, camera(**sensor), floor=floor, **(things or {}))


def perforated() -> dict[str, Any]:
    """Return a perforated sheet close to the camera."""
    bsdf = {"type": "mask", "opacity": bitmap(4, 4, channels=1, low=0), "bsdf": {"type": "diffuse"}}
    return {"leaf": rectangle(bsdf, transform().translate([0.2, 1.2, 2]) @ transform().scale(0.4))}


def screen() -> dict[str, Any]:
    """Return a screen that the near plane cuts away, so that the objects behind the screen are visible."""
    to_world = transform().translate([0.5, 1.3, 3]) @ transform().scale(0.15)
    return {"screen": rectangle({"type": "diffuse"}, to_world)}


SENSORS = [
    # `path` gathers splats from beyond the film's border, which light paths do not reach.
    *(ImageCase(f"filter_{name}", lambda name=name: seen(width=32, height=32, rfilter=name), True,
                border=0 if name == "box" else 4) for name in FILTERS),
    *(ImageCase(f"crop_{name}", lambda name=name: seen(rfilter=name, film=CROP), True, spp=512, border=border)
      for name, border in (("box", 0), ("gaussian", 2))),
    # `ptracer` divides colours by an alpha that it never normalizes.
    *(ImageCase(f"format_{kind}", lambda kind=kind: seen(film={"pixel_format": kind}),
                not kind.endswith("a") and "alpha" not in kind) for kind in FORMATS),
    ImageCase("half_precision", lambda: seen(film={"component_format": "float16"})),
    # Floor and lamp are out of focus.
    ImageCase("thin_lens", lambda: seen(type="thinlens", aperture_radius=0.4, focus_distance=2.0), True),
    ImageCase("thin_lens_through_a_mask",
              lambda: seen(perforated(), type="thinlens", aperture_radius=0.2, focus_distance=3.5)),
    ImageCase("moving_shutter", lambda: seen(shutter_open=0.0, shutter_close=1.0), True),
    ImageCase("mirrored_camera", lambda: seen(to_world=camera()["to_world"] @ transform().scale([-1, 1, 1]))),
    ImageCase("near_clip", lambda: seen(near_clip=3.9, far_clip=5.5)),
    *(ImageCase(f"{plane}_clip_of_a_{name}", lambda lens=lens, plane=plane, at=at: seen(
        screen() if plane == "near" else {}, **lens | {f"{plane}_clip": at}))
      for name, lens in (("pinhole", {}), ("lens", LENS)) for plane, at in (("near", 3.9), ("far", 4.6))),
    # With a focus outside its clip planes, a lens in stock light tracing sees nothing. If it focuses on the far plane,
    # as by default, it sees a part.
    *(ImageCase(f"focus_{at}", lambda focus=focus: seen(
        type="thinlens", aperture_radius=0.1, near_clip=1.0, far_clip=7.0, **focus))
      for at, focus in (("default", {}), *((at, {"focus_distance": at}) for at in (0.9, 30.0, 2.0)))),
    # `ptracer` clips the image to where the film would be without the offset.
    *(ImageCase(f"principal_point_of_a_{name}_film", lambda film=film: seen(
        film=film, principal_point_offset_x=0.2, principal_point_offset_y=-0.1))
      for name, film in (("whole", {}), ("cropped", CROP))),
    ImageCase("second_sensor", lambda: seen({"other": camera(24, 16, to_world=transform().look_at(
        [2, 2, 3], [0, 0.5, 0], [0, 1, 0]))}), True, {"sensor": 1}),
    ImageCase("coloured_light_in_a_wide_film", lambda: lit({"radiance": rgb(5, 0, 1)}, camera(48, 16))),
]  # fmt: skip
#: The cases that need `-m long`: each resembles another case.
SIMILAR = (
    "shading_normals_diffuse", "shading_normals_roughplastic", "roulette_roughdielectric_1", "depth_2", "depth_3",
    "roulette_diffuse_1", "roulette_diffuse_2", "roulette_roughdielectric_2", "mask_before_the_camera",
    "mask_between_2", "mask_between_3", "mask_between_5", "filter_box", "filter_tent", "filter_mitchell",
    "filter_catmullrom", "filter_gaussian", "crop_box", "format_rgba", "format_xyz", "depth_-1", "focus_default",
    "mask_between_1", "shapes", "format_luminance", "format_xyza", "thin_lens_through_a_mask", "near_clip",
    "near_clip_of_a_pinhole", "far_clip_of_a_lens", "focus_0.9", "focus_30.0", "focus_2.0",
    "principal_point_of_a_whole_film", "thin_lens", "masks_before_a_hidden_sky", "filter_lanczos",
    "opaque_and_absent_masks", "moving_shutter", "closed_room",
)  # fmt: skip


@pytest.mark.parametrize(
    "case", a_few([*PATHS, *SENSORS], [c.name for c in (*PATHS, *SENSORS) if c.name not in SIMILAR])
)
def test_image(case: ImageCase):
    case.check()


def test_passes_are_unbiased_and_independent():
    scene = lit(VISIBLE)
    result = agreement(scene, reslrb={"samples_per_pass": 32})
    assert result, result
    options = {"max_depth": 5, "rr_depth": 100}
    in_one = images(scene, "reslrb", range(32), 16, **options).std(0).mean()
    in_four = images(scene, "reslrb", range(32), 16, samples_per_pass=4, **options).std(0).mean()
    assert in_four == pytest.approx(in_one, rel=0.1)


def test_the_first_pass_equals_ptracer():
    assert difference_from_ptracer(lit(LARGE), spp=8, reslrb={"samples_per_pass": 8}) < SAME


def test_a_crop_window_is_a_part_of_the_image():
    options = {"max_depth": 5, "rr_depth": 100, "hide_emitters": True}
    (whole,) = images(seen(), "reslrb", range(1), 16, **options)
    (part,) = images(seen(film=CROP), "reslrb", range(1), 16, **options)
    # The light paths are the same, but those that miss the crop window are lost.
    assert np.abs(part - whole[5:18, 7:24]).mean() < SAME * whole.mean()


def test_alpha_is_opaque():
    (image,) = images(seen(film={"pixel_format": "rgba"}), "reslrb", range(1), 4)
    assert (image[..., 3] == 1).all()
