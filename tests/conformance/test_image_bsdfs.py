"""Image, for each surface BSDF of Mitsuba: `reslrb` against `path`, and against `ptracer` at equal seeds."""

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
    difference_from_ptracer,
    floor_camera,
    lamp,
    rectangle,
    rgb,
    stage,
    transform,
)
from turns import a_few

pytestmark = pytest.mark.usefixtures("samples")


def normals():
    """A normal map, tilted by up to 30 degrees."""
    data = np.random.default_rng(1).uniform(-0.4, 0.4, (8, 8, 3)).astype(np.float32)
    data[..., 2] = 1
    data /= np.linalg.norm(data, axis=-1, keepdims=True)
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(data / 2 + 0.5)}


def gray(low: float = 0.1, high: float = 1.0):
    return bitmap(4, 4, channels=1, low=low, high=high)


COPPER = {"type": "roughconductor", "material": "Cu", "alpha": 0.2}
#: Light paths can connect to the sensor from all of these: images equal `path`'s where the sensor sees them.
ROUGH = {
    "diffuse": lambda: {"type": "diffuse", "reflectance": bitmap(8, 8)},
    "roughconductor": lambda: COPPER,
    "anisotropic roughconductor": lambda: {"type": "roughconductor", "material": "Cu", "alpha_u": 0.1, "alpha_v": 0.4,
                                           "distribution": "ggx"},
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.25},
    "roughplastic": lambda: {"type": "roughplastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.2), "alpha": 0.15},
    "pplastic": lambda: {"type": "pplastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.2), "alpha": 0.3},
    "principled": lambda: {"type": "principled", "base_color": rgb(0.6, 0.5, 0.2), "metallic": 0.3, "roughness": 0.4,
                           "specular": 0.5, "clearcoat": 0.5, "clearcoat_gloss": 0.4, "sheen": 0.5, "spec_tint": 0.4,
                           "anisotropic": 0.5},
    "transmitting principled": lambda: {"type": "principled", "base_color": rgb(0.6, 0.5, 0.7), "roughness": 0.4,
                                        "eta": 1.4, "spec_trans": 0.8},
    "principledthin": lambda: {"type": "principledthin", "base_color": rgb(0.6, 0.5, 0.7), "roughness": 0.4, "eta": 1.4,
                               "spec_trans": 0.5, "diff_trans": 0.6},
    "blend": lambda: {"type": "blendbsdf", "weight": gray(), "a": WHITE, "b": COPPER},
    "twosided": lambda: {"type": "twosided", "a": WHITE, "b": RED},
}  # fmt: skip
#: Light passes straight through these, which stock `ptracer` does not connect through.
SEE_THROUGH = {
    "mask": lambda: {"type": "mask", "opacity": gray(low=0), "bsdf": {"type": "twosided", "bsdf": RED}},
    "mask of glass": lambda: {"type": "mask", "opacity": 0.6, "bsdf": {"type": "roughdielectric", "alpha": 0.3}},
    "blend with null": lambda: {"type": "blendbsdf", "weight": 0.4, "a": {"type": "twosided", "bsdf": RED},
                                "b": {"type": "null"}},
    "null": lambda: {"type": "null"},
    "polarizer": lambda: {"type": "polarizer"},
    "retarder": lambda: {"type": "retarder"},
}  # fmt: skip
#: Their shading normals are hidden inside of the BSDF, where `ptracer`'s correction does not see them.
HIDDEN_NORMALS = {
    "bumpmap": lambda: {"type": "bumpmap", "arbitrary": bitmap(8, 8, channels=1), "scale": 0.15, "bsdf": WHITE},
    "bumpmap of glass": lambda: {"type": "bumpmap", "arbitrary": bitmap(8, 8, channels=1), "scale": 0.05,
                                 "bsdf": {"type": "roughdielectric", "alpha": 0.3}},
    "normalmap": lambda: {"type": "normalmap", "normalmap": normals(), "bsdf": {"type": "roughplastic"}},
    "twosided normalmap": lambda: {"type": "twosided", "bsdf": {"type": "normalmap", "normalmap": normals(),
                                                                "bsdf": COPPER}},
    "blend with normalmap": lambda: {"type": "blendbsdf", "weight": 0.3, "a": WHITE,
                                     "b": {"type": "normalmap", "normalmap": normals(), "bsdf": COPPER}},
    "masked normalmap": lambda: {"type": "mask", "opacity": 0.7,
                                 "bsdf": {"type": "normalmap", "normalmap": normals(), "bsdf": WHITE}},
}  # fmt: skip
#: As these, with delta lobes; what the floor receives of them is judged. Without the shadowing function, which a delta
#: lobe evaluates in the wrong one of its two directions.
HIDDEN_SMOOTH = {
    "normalmap of conductor": lambda: {
        "type": "normalmap",
        "normalmap": normals(),
        "bsdf": {"type": "conductor"},
        "use_shadowing_function": False,
    },
    "normalmap of dielectric": lambda: {
        "type": "normalmap",
        "normalmap": normals(),
        "bsdf": {"type": "dielectric"},
        "use_shadowing_function": False,
    },
    "normalmap of plastic": lambda: {
        "type": "normalmap",
        "normalmap": normals(),
        "bsdf": {"type": "plastic"},
        "use_shadowing_function": False,
    },
}  # fmt: skip
#: Lobes that no light path connects to the sensor from: seen directly they lack what they mirror, as with `ptracer`.
SMOOTH = {
    "conductor": lambda: {"type": "conductor", "material": "Au"},
    "dielectric": lambda: {"type": "dielectric"},
    "thindielectric": lambda: {"type": "thindielectric"},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.2)},
    "nonlinear plastic": lambda: {"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.6, 0.2), "nonlinear": True},
    "blend with conductor": lambda: {"type": "blendbsdf", "weight": 0.4, "a": WHITE, "b": {"type": "conductor"}},
    "mask of dielectric": lambda: {"type": "mask", "opacity": 0.6, "bsdf": {"type": "dielectric"}},
    "twosided conductor": lambda: {"type": "twosided", "bsdf": {"type": "conductor"}},
}
SEEN = ROUGH | SEE_THROUGH | HIDDEN_NORMALS
#: A ball refracts light in and out again, which hides what is wrong with one of them; opaque sheets show nothing new.
SHEETS = ("roughdielectric", "principledthin", "mask of glass")
#: Of what throws light on the floor, one of each kind of lobe, and of normal maps.
THROWN = ("conductor", "dielectric", "plastic", "normalmap of dielectric")


def scene_with(bsdf, holder: str, sensor=None):
    """The stage with a ball, or a sheet that is seen from its front, of this BSDF, under a large lamp."""
    tilted = transform().translate([0.2, 0.8, 0.3]) @ transform().rotate([1, 0, 0], -60) @ transform().scale(0.6)
    thing = ball(bsdf) if holder == "ball" else rectangle(bsdf, tilted)
    return stage({"lamp": lamp(side=1.5, radiance=rgb(2, 3, 4))}, sensor, ball=thing)


#: Of balls, by default: others have `ptracer` as their reference, or what they are made of is here.
BALLS = ("roughdielectric", "blend", "mask", "null", "bumpmap", "normalmap")


@pytest.mark.parametrize("name", a_few(SEEN, BALLS))
def test_ball(name):
    result = agreement(scene_with(SEEN[name](), "ball"))
    assert result, result


@pytest.mark.parametrize("name", a_few(SEEN, SHEETS))
def test_sheet(name):
    result = agreement(scene_with(SEEN[name](), "sheet"))
    assert result, result


@pytest.mark.parametrize("name", a_few(SMOOTH | HIDDEN_SMOOTH, THROWN))
def test_what_it_throws_on_the_floor(name):
    thing = ball((SMOOTH | HIDDEN_SMOOTH)[name](), center=(0, 0.9, 0))
    light = lamp(side=1.0, position=(0, 2.2, -1.2), target=(0, 0.9, 0), radiance=rgb(4, 3, 2))
    result = agreement(stage({"lamp": light}, floor_camera(), ball=thing), spp=512)
    assert result, result


@pytest.mark.parametrize("name", [*ROUGH, *(name for name in SMOOTH if "mask" not in name and "thin" not in name)])
def test_equals_ptracer_at_equal_seeds(name):
    assert difference_from_ptracer(scene_with((ROUGH | SMOOTH)[name](), "ball")) < SAME


def test_thin_glass_between_sensor_and_stage():
    # It reflects nothing but the void behind the camera, so that light paths see all that `path` sees.
    pane = rectangle({"type": "thindielectric"}, transform().translate([0.2, 1.1, 2]) @ transform().scale(0.4))
    result = agreement(stage({"lamp": lamp(side=1.5, radiance=rgb(2, 3, 4))}, pane=pane))
    assert result, result
