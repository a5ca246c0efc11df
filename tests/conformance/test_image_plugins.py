"""Images of each BSDF and emitter of Mitsuba, and of whole scenes, against `path` and `ptracer`."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
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
    floor_camera,
    images,
    lamp,
    rectangle,
    rgb,
    stage,
    transform,
)
from turns import a_few, real_room

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.measure.references import Situation, ptracer_image
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.rays import visible
from reslrb_cli.scene.upsampling import _responses
from reslrb_cli.scene.visibility import interior, sees_specular

# Image, for each surface BSDF of Mitsuba: `reslrb` against `path`, and against `ptracer` at equal seeds.


def normals():
    """Return a normal map that is tilted by up to 30 degrees."""
    data = np.random.default_rng(1).uniform(-0.4, 0.4, (8, 8, 3)).astype(np.float32)
    data[..., 2] = 1
    data /= np.linalg.norm(data, axis=-1, keepdims=True)
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(data / 2 + 0.5)}


def gray(low: float = 0.1, high: float = 1.0):
    return bitmap(4, 4, channels=1, low=low, high=high)


COPPER = {"type": "roughconductor", "material": "Cu", "alpha": 0.2}
#: Light paths can connect all of these BSDFs to the sensor. Images equal those of `path` where the sensor sees them.
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
#: Light passes straight through these BSDFs. Stock `ptracer` does not connect through them.
SEE_THROUGH = {
    "mask": lambda: {"type": "mask", "opacity": gray(low=0), "bsdf": {"type": "twosided", "bsdf": RED}},
    "mask of glass": lambda: {"type": "mask", "opacity": 0.6, "bsdf": {"type": "roughdielectric", "alpha": 0.3}},
    "blend with null": lambda: {"type": "blendbsdf", "weight": 0.4, "a": {"type": "twosided", "bsdf": RED},
                                "b": {"type": "null"}},
    "null": lambda: {"type": "null"},
    "polarizer": lambda: {"type": "polarizer"},
    "retarder": lambda: {"type": "retarder"},
}  # fmt: skip
#: The shading normals are hidden inside these BSDFs, where `ptracer`'s correction does not see them.
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
#: Hidden normals with delta lobes, judged by the light on the floor. The shadowing function is off, because a delta
#: lobe evaluates it in the wrong one of its two directions.
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
#: No light path can connect these lobes to the sensor. Seen directly they lack what they mirror, as with `ptracer`.
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


def scene_with(bsdf, holder: str, sensor=None):
    """Return the stage under a large lamp. The stage holds a ball of this BSDF, or a sheet that the camera sees from
    its front.
    """
    tilted = transform().translate([0.2, 0.8, 0.3]) @ transform().rotate([1, 0, 0], -60) @ transform().scale(0.6)
    thing = ball(bsdf) if holder == "ball" else rectangle(bsdf, tilted)
    return stage({"lamp": lamp(side=1.5, radiance=rgb(2, 3, 4))}, sensor, ball=thing)


def on_the_floor(bsdf):
    """Return a ball of this BSDF that throws light on the floor, which alone the camera sees."""
    light = lamp(side=1.0, position=(0, 2.2, -1.2), target=(0, 0.9, 0), radiance=rgb(4, 3, 2))
    return stage({"lamp": light}, floor_camera(), ball=ball(bsdf, center=(0, 0.9, 0)))


def pane():
    """Return a pane of thin glass that reflects only the void behind the camera. Light paths see all that `path`
    sees.
    """
    to_world = transform().translate([0.2, 1.1, 2]) @ transform().scale(0.4)
    light = {"lamp": lamp(side=1.5, radiance=rgb(2, 3, 4))}
    return stage(light, pane=rectangle({"type": "thindielectric"}, to_world))


BSDFS = [
    *(ImageCase(f"{holder} of {name}", lambda make=make, holder=holder: scene_with(make(), holder),
                stock=holder == "ball" and name in ROUGH)
      for holder in ("ball", "sheet") for name, make in (ROUGH | SEE_THROUGH | HIDDEN_NORMALS).items()),
    *(ImageCase(f"light of {name}", lambda make=make: on_the_floor(make()), spp=512)
      for name, make in (SMOOTH | HIDDEN_SMOOTH).items()),
    ImageCase("thin glass before the sensor", pane),
]  # fmt: skip
#: The default suite. A ball refracts light in and out again, which can hide a fault of one of the two, so that glass is
#: a sheet here, and a ball in test_image_paths.py (shading normals, roulette). Of the BSDFs that throw light on the
#: floor, it takes a normal map of glass.
#: The other BSDFs have `ptracer` as their reference, or their parts are listed here.
FEW = (
    *(f"ball of {name}" for name in ("mask", "bumpmap")),
    *(f"sheet of {name}" for name in ("roughdielectric", "principledthin")),
    "light of normalmap of dielectric",
    "thin glass before the sensor",
)  # fmt: skip
#: The BSDFs that the default suite compares with `ptracer` alone.
BY_STOCK = ("anisotropic roughconductor", "transmitting principled", "conductor", "nonlinear plastic")


@pytest.mark.usefixtures("samples")
@pytest.mark.parametrize("case", a_few(BSDFS, FEW))
def test_bsdf(case: ImageCase):
    case.check()


@pytest.mark.parametrize(
    "name", a_few([*ROUGH, *(name for name in SMOOTH if "mask" not in name and "thin" not in name)], BY_STOCK)
)
def test_bsdf_equals_ptracer_at_equal_seeds(name):
    assert difference_from_ptracer(scene_with((ROUGH | SMOOTH)[name](), "ball")) < SAME


# Image, for each emitter of Mitsuba: `reslrb` against `path`, and against `ptracer` at equal seeds.

#: A lamp that the camera sees.
VISIBLE = {"position": (0, 1.6, -0.8), "target": (0, 0.3, 2)}


def from_above():
    return transform().look_at(origin=[0.5, 2.5, 1.6], target=[0, 0.3, 0], up=[0, 1, 0])


def two_axes():
    return transform().rotate([0, 1, 0], 100) @ transform().rotate([1, 0, 0], 50)


def sky(to_world=None, peak: float = 10.0):
    """Return an environment map with one bright texel."""
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
#: Stock light tracing misplaces the disk of an environment map, and does not connect through masks.
NOT_PTRACER = [name for name in EMITTERS if name.startswith("envmap") or "mask" in name]


def several(environment, weight: float = 1.0):
    """Return the stage under a lamp, a point light with this sampling weight, and an environment."""
    point = {"type": "point", "position": [-0.5, 1.9, 0.6], "intensity": rgb(1, 2, 1), "sampling_weight": weight}
    return stage({"lamp": lamp(**VISIBLE), "point": point, "environment": environment})


def far_away():
    """Return a floor under a sky. The camera stands outside the scene's bounding sphere, far from what it sees."""
    floor = rectangle(WHITE, transform().rotate([1, 0, 0], -90) @ transform().scale(0.3))
    sensor = camera(to_world=transform().look_at(origin=[0, 3, 4], target=[0, 0, 0], up=[0, 1, 0]), fov=10)
    return stage({"sky": sky(two_axes())}, sensor, ball=None, wall=None, floor=floor)


CONSTANT = {"type": "constant", "radiance": 0.3}
LIT = [
    *(ImageCase(name, lambda make=make: stage({"emitter": make()}), name not in NOT_PTRACER)
      for name, make in EMITTERS.items()),
    # Hidden area lights are not compared: `path` looks through them, but they stop light paths.
    *(ImageCase(f"hidden {name}", lambda make=make: stage({"emitter": make()}), options={"hide_emitters": True})
      for name, make in EMITTERS.items() if name.startswith(("constant", "envmap", "sunsky"))),
    ImageCase("several with a map", lambda: several(sky(two_axes(), peak=5.0))),
    ImageCase("several with a constant", lambda: several(CONSTANT), True),
    ImageCase("several with weights", lambda: several(CONSTANT, 3.0)),
    ImageCase("a sky behind a floor only", far_away),
]  # fmt: skip
#: The cases that need `-m long`: each resembles another case. test_image_paths.py has a lamp in view, and
#: test_camera_paths.py a sphere.
SIMILAR = ("area", "visible area", "sphere", "point", "spot", "textured spot", "projector", "sunsky", "envmap",
           "envmap, one axis", "hidden envmap", "hidden envmap, one axis", "hidden envmap, two axes",
           "hidden sunsky", "hidden sunsky, turned", "several with a constant", "several with a map",
           "sunsky, turned", "area with mask", "constant")  # fmt: skip


@pytest.mark.usefixtures("samples")
@pytest.mark.parametrize("case", a_few(LIT, [case.name for case in LIT if case.name not in SIMILAR]))
def test_emitter(case: ImageCase):
    case.check()


@pytest.mark.usefixtures("samples")
def test_directionalarea():
    # `path` cannot find the light of this emitter.
    scene = stage({"lamp": lamp(type="directionalarea")})
    result = agreement(scene, "ptracer")
    assert result, result
    assert difference_from_ptracer(scene) < SAME


@pytest.mark.usefixtures("samples")
def test_timed_sunsky_is_refused():
    with pytest.raises(UnsupportedScene, match="timed_sunsky"):
        agreement(stage({"emitter": {"type": "timed_sunsky"}}), seeds=2, spp=1)


# Image, for the scenes in `scenes/` and a real room: `reslrb` against `path`, `ptracer` and the analytic answer.

ROOT = Path(__file__).resolve().parents[2]
#: The reference for each scene, and the number of samples per pixel. `path` cannot find a caustic of parallel light.
SCENES = {"cornell_floor": ("path", 256), "grey_room": ("path", 256), "caustic_slab": ("ptracer", 256),
          "furnace": ("path", 256)}  # fmt: skip


def shipped(name: str):
    return load_scene(ROOT / "scenes" / name / "scene.xml", {"resx": 32, "resy": 32})


@pytest.mark.usefixtures("samples")
@pytest.mark.parametrize("name", a_few(SCENES, ()))  # `ptracer` and the analytic answer check others
def test_shipped_scene(name):
    reference, spp = SCENES[name]
    result = agreement(shipped(name), reference, spp=spp, max_depth=8, rr_depth=5)
    assert result, result


@pytest.mark.parametrize("name", [name for name in SCENES if name != "grey_room"])  # its sky is rotated
def test_shipped_scene_equals_ptracer_at_equal_seeds(name):
    assert difference_from_ptracer(shipped(name), max_depth=8) < SAME


@pytest.mark.parametrize("depth", a_few([1, 2, 6], ["6"]))
def test_furnace_against_the_analytic_answer(depth):
    rho, emitted, scene = np.array([0.5, 0.7, 0.3]), np.array([1.0, 0.6, 1.4]), shipped("furnace")
    if mi.is_spectral:  # the same for each wavelength, with the spectra of the scene's own coefficients
        d65, responses, params = *_responses(mi.variant()), dict(mi.traverse(scene))
        v = {part: np.polyval(np.ravel(value).astype(np.float64), visible()) for key, value in params.items()
             for part in ("reflectance", "radiance") if key.endswith(f"{part}.value")}  # fmt: skip
        rho, shape = (0.5 + 0.5 * v[part] / np.sqrt(1 + v[part] ** 2) for part in ("reflectance", "radiance"))
        [scaled] = (np.ravel(value) for key, value in params.items() if key.endswith("d65.values"))
        series = shape * scaled.sum() / d65.sum() * sum(rho**k for k in range(depth))
        expected = series @ responses
    else:
        expected = emitted * sum(rho**k for k in range(depth))
    found = images(scene, "reslrb", range(12), 256, max_depth=depth, rr_depth=3)
    result = compare(found, np.broadcast_to(expected, found.shape))
    assert result, result
    assert np.allclose(found.mean((0, 1, 2)), expected, rtol=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("hide_emitters", [False, True])
def test_real_room(hide_emitters):
    scene = load_scene(real_room(), {"resx": 64, "resy": 36, "max_depth": 8})
    options = {"max_depth": 8, "rr_depth": 5, "hide_emitters": hide_emitters}
    ours = images(scene, "reslrb", range(16), 512, **options)
    theirs = images(scene, "path", range(1000, 1016), 512, **options)
    seen = sees_specular(scene, scene.sensors()[0], partly=True)
    left_out = seen | ~interior(ours.shape[1:], scene.sensors()[0])
    assert left_out.mean() < 0.2
    result = compare(ours * ~left_out[..., None], theirs * ~left_out[..., None])
    assert result, result


@pytest.mark.usefixtures("samples")
def test_a_mirrored_mesh():
    """The faces of a mirrored mesh wind opposite to its normals. `ptracer` renders this mesh black."""
    look = mi.ScalarTransform4f().look_at([0, 2, 5], [0, 0.5, 0], [0, 1, 0])
    down = mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90)
    mirrored = mi.ScalarTransform4f().translate([0, 0.6, 0]).scale([-0.5, 0.5, 0.5])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "filter": {"type": "box"}, "pixel_format": "rgb"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 30, "to_world": look, "film": film},
            "lamp": {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": 8.0}},
            "box": {"type": "cube", "to_world": mirrored, "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        }
    )
    result = agreement(scene, "path", spp=256, max_depth=4, rr_depth=5)
    assert result, result
    at = Situation.of(scene, scene.sensors()[0], mi.traverse(scene), 4, False)
    assert ptracer_image(at) == "it renders mirrored meshes black"
