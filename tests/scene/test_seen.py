"""Pixels that see smooth specular lobes: which surfaces count, through what, and how far the filter spreads them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.scene.visibility import SeenSpecular, sees_lamps, sees_specular

#: Columns of a film of 16x8 pixels, in a view of 4 by 2, that a pane from 0 to 1 covers.
COVERED = slice(8, 12)
MIRROR = {"type": "conductor"}
DIFFUSE = {"type": "diffuse"}
BLEND = {"type": "blendbsdf", "weight": 0.5, "one": {"type": "twosided", "bsdf": DIFFUSE}, "two": MIRROR}


def seen(bsdf: dict, filter: str = "box", in_front: dict | None = None) -> SeenSpecular:
    """What a sensor sees of a pane, two rows high, before a diffuse wall, with another pane before all of it."""
    T = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 2 * np.degrees(np.arctan(2 / 100)),
            "to_world": T().look_at(origin=[0, 0, 100], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 16, "height": 8, "rfilter": {"type": filter}},
        },
        "light": {"type": "constant"},
        "wall": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(9), "bsdf": DIFFUSE},
        "pane": {
            "type": "rectangle",
            "to_world": T().translate([0.5, 0, 0]).scale([0.499, 0.2, 1]),
            "bsdf": bsdf,
        },
    }
    if in_front is not None:
        scene["front"] = {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(9), "bsdf": in_front}
    loaded = mi.load_dict(scene, optimize=False)
    return sees_specular(loaded, loaded.sensors()[0])


def pixels(margin: int = 0) -> np.ndarray:
    """The pixels of the pane, and so many around it."""
    mask = np.zeros((8, 16), dtype=bool)
    mask[3 - margin : 5 + margin, COVERED.start - margin : COVERED.stop + margin] = True
    return mask


@pytest.mark.usefixtures("llvm")
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
def test_which_surfaces_count(bsdf: dict, kind: str | None) -> None:
    found = seen(bsdf)
    for name in ("alone", "mixed"):
        expected = pixels() if name == kind else np.zeros((8, 16), dtype=bool)
        assert np.array_equal(getattr(found, name), expected), name


@pytest.mark.usefixtures("llvm")
def test_glass_is_seen_through_what_lets_light_pass() -> None:
    veil = {"type": "mask", "opacity": 0.5, "bsdf": DIFFUSE}
    found = seen(MIRROR, in_front=veil)
    assert np.array_equal(found.alone, pixels())
    assert not seen(MIRROR, in_front=DIFFUSE).alone.any()


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(("filter", "margin"), [("tent", 1), ("gaussian", 2)])
def test_the_filter_spreads_it(filter: str, margin: int) -> None:
    assert np.array_equal(seen(MIRROR, filter).alone, pixels(margin))


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("size", [16, 300])
@pytest.mark.parametrize("sensor", [{}, {"type": "thinlens", "aperture_radius": 2.0, "focus_distance": 50.0}])
def test_pixels_that_see_lamps(size: int, sensor: dict) -> None:
    T = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 2 * np.degrees(np.arctan(2 / 100)),
            "to_world": T().look_at(origin=[0, 0, 100], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size // 2, "rfilter": {"type": "box"}},
        }
        | sensor,
        "wall": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(9), "bsdf": DIFFUSE},
        "veil": {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(9), "bsdf": {"type": "null"}},
    }
    dark = mi.load_dict(scene | {"light": {"type": "point", "position": [0, 0, 50]}}, optimize=False)
    assert not sees_lamps(dark, dark.sensors()[0]).any()
    place = T().translate([0.5, 0, 0]).scale([0.5, 0.25, 1])  # columns 1/2 to 3/4, rows 3/8 to 5/8, where it is sharp
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}
    lit = mi.load_dict(scene | {"lamp": lamp}, optimize=False)
    found = sees_lamps(lit, lit.sensors()[0])
    assert found.shape == (size // 2, size)
    height, width = (np.arange(n) + 0.5 for n in found.shape)
    x, y = width / size, height / (size // 2)
    inside = ((y > 3 / 8) & (y < 5 / 8))[:, None] & ((x > 1 / 2) & (x < 3 / 4))
    assert found[inside].all()
    # A lens that is focused on half the distance spreads a lamp over the whole of this film.
    near = 2.0 / 4 * 1.1 if sensor else 1.5 / min(size // 2, 128)
    far = ((y < 3 / 8 - 2 * near) | (y > 5 / 8 + 2 * near))[:, None] | ((x < 1 / 2 - near) | (x > 3 / 4 + near))
    assert not found[far].any()
    assert found.sum() > (1.5 if sensor else 0.9) * inside.sum()
