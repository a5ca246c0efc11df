"""Image, for each emitter of Mitsuba: `reslrb` against `path`, and against `ptracer` at equal seeds."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from conformance.scenes import (
    SAME,
    WHITE,
    agreement,
    bitmap,
    camera,
    difference_from_ptracer,
    lamp,
    rectangle,
    rgb,
    stage,
    transform,
)

from reslrb_cli.errors import UnsupportedScene

pytestmark = pytest.mark.usefixtures("samples")

#: A lamp that the camera sees.
VISIBLE = {"position": (0, 1.6, -0.8), "target": (0, 0.3, 2)}


def from_above():
    return transform().look_at(origin=[0.5, 2.5, 1.6], target=[0, 0.3, 0], up=[0, 1, 0])


def two_axes():
    return transform().rotate([0, 1, 0], 100) @ transform().rotate([1, 0, 0], 50)


def sky(to_world=None, peak: float = 10.0):
    """An environment map with one bright texel."""
    data = np.random.default_rng(3).uniform(0.1, 1, (8, 16, 3)).astype(np.float32)
    data[2, 3] = peak
    return {"type": "envmap", "bitmap": mi.Bitmap(data)} | ({} if to_world is None else {"to_world": to_world})


def sphere_lamp():
    emitter = {"type": "area", "radiance": rgb(9, 8, 5)}
    return {"type": "sphere", "center": [0.3, 1.5, -0.5], "radius": 0.2, "bsdf": WHITE, "emitter": emitter}


def masked_lamp():
    bsdf = {"type": "mask", "opacity": bitmap(4, 4, channels=1), "bsdf": WHITE}
    return lamp(**VISIBLE) | {"bsdf": bsdf}


EMITTERS = {
    "area": lambda: lamp(),
    "visible area": lambda: lamp(**VISIBLE),
    "textured area": lambda: lamp(**VISIBLE, radiance=bitmap(4, 4, high=9)),
    "sphere": sphere_lamp,
    "area with mask": masked_lamp,
    "point": lambda: {"type": "point", "position": [0.5, 1.9, 0.6], "intensity": rgb(3, 4, 5)},
    "spot": lambda: {"type": "spot", "intensity": rgb(9, 8, 5), "cutoff_angle": 30, "to_world": from_above()},
    "textured spot": lambda: {"type": "spot", "intensity": rgb(9, 8, 5), "texture": bitmap(4, 4), "cutoff_angle": 30,
                              "to_world": from_above()},
    "projector": lambda: {"type": "projector", "irradiance": bitmap(6, 4), "fov": 50, "to_world": from_above()},
    "directional": lambda: {"type": "directional", "irradiance": rgb(3, 4, 5), "direction": [-0.3, -1, -0.4]},
    "constant": lambda: {"type": "constant", "radiance": rgb(1, 0.8, 0.5)},
    "envmap": lambda: sky(),
    "envmap, one axis": lambda: sky(transform().rotate([0, 1, 0], 100)),
    "envmap, two axes": lambda: sky(two_axes()),
    "sunsky": lambda: {"type": "sunsky", "sun_direction": [0.3, 0.5, 0.8], "sun_aperture": 20.0},
    "sunsky, turned": lambda: {"type": "sunsky", "sun_direction": [0.3, 0.8, 0.5],
                               "to_world": transform().rotate([1, 0, 0], -90)},
}  # fmt: skip
ENVIRONMENTS = [name for name in EMITTERS if name.startswith(("constant", "envmap", "sunsky"))]
#: Stock light tracing places the disk of an environment map wrongly, and does not connect through masks.
NOT_PTRACER = [name for name in EMITTERS if name.startswith("envmap") or "mask" in name]

#: Those that by default `ptracer` alone is a reference of: like one of the others they are there for.
BY_PTRACER = ("area", "textured area", "spot", "textured spot", "directional", "sunsky")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.long if n in BY_PTRACER else ()) for n in EMITTERS])
def test_emitter_against_path(name):
    result = agreement(stage({"emitter": EMITTERS[name]()}))
    assert result, result


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ("constant", "envmap, two axes") else pytest.mark.long) for n in ENVIRONMENTS],
)
def test_hidden_environment_against_path(name):
    # Hidden area lights are not compared: `path` looks through them, light paths are stopped by them.
    result = agreement(stage({"emitter": EMITTERS[name]()}), hide_emitters=True)
    assert result, result


@pytest.mark.parametrize("name", [name for name in EMITTERS if name not in NOT_PTRACER])
def test_emitter_against_ptracer_at_equal_seeds(name):
    assert difference_from_ptracer(stage({"emitter": EMITTERS[name]()})) < SAME


def test_directionalarea():
    # `path` cannot see it.
    scene = stage({"lamp": lamp(type="directionalarea")})
    result = agreement(scene, "ptracer")
    assert result, result
    assert difference_from_ptracer(scene) < SAME


def test_timed_sunsky_is_refused():
    with pytest.raises(UnsupportedScene, match="timed_sunsky"):
        agreement(stage({"emitter": {"type": "timed_sunsky"}}), seeds=2, spp=1)


def several(**environment):
    return {
        "lamp": lamp(**VISIBLE),
        "point": {"type": "point", "position": [-0.5, 1.9, 0.6], "intensity": rgb(1, 2, 1)},
        "environment": environment,
    }


@pytest.mark.parametrize("kind", ["envmap", "constant"])
def test_several_emitters(kind):
    environment = sky(two_axes(), peak=5.0) if kind == "envmap" else {"type": "constant", "radiance": 0.3}
    scene = stage(several(**environment))
    result = agreement(scene)
    assert result, result
    if kind == "constant":
        assert difference_from_ptracer(scene) < SAME


def test_emitters_with_sampling_weights():
    emitters = several(type="constant", radiance=0.3)
    emitters["point"]["sampling_weight"] = 3.0
    result = agreement(stage(emitters))
    assert result, result


def test_environment_behind_nothing_but_a_floor():
    # The camera stands outside of the scene's bounding sphere, far from what it sees.
    floor = rectangle(WHITE, transform().rotate([1, 0, 0], -90) @ transform().scale(0.3))
    sensor = camera(to_world=transform().look_at(origin=[0, 3, 4], target=[0, 0, 0], up=[0, 1, 0]), fov=10)
    result = agreement(stage({"sky": sky(two_axes())}, sensor, ball=None, wall=None, floor=floor))
    assert result, result
