"""Weights of paths from both sides: those that the kernels used are ratios of explicit densities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from conformance.path_densities import CUTOFF, DEPTH, FOV, WAYS, CameraNotes, Densities, LightNotes, Paths, number, paths_of

from reslrb_cli.transport.camera import camera_walk
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.walk import walk

pytestmark = pytest.mark.usefixtures("llvm")


# Scenes: a room of 4 by 4 by 4 that is open in front, seen from there.


def place(*translate: float, scale: Any = 1, rotate: Any = None) -> Any:
    import mitsuba as mi

    result = mi.ScalarTransform4f().translate(list(translate))
    return (result if rotate is None else result.rotate(*rotate)).scale(scale)


def looking(origin: Any, target: Any, up: Any = (0, 1, 0)) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def texels(height: int, width: int, scale: float = 20) -> dict[str, Any]:
    import mitsuba as mi

    data = np.random.default_rng(3).uniform(0.02, 1, (height, width, 3)).astype(np.float32) * scale
    return {"type": "bitmap", "data": mi.TensorXf(data), "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}


def bitmap(height: int, width: int, channels: int = 3) -> Any:
    import mitsuba as mi

    return mi.Bitmap(np.random.default_rng(4).random((height, width, channels)).astype(np.float32) ** 3 + 0.01)


WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.6]}}
#: Each of their events is delta, or is not, with a similar chance.
HALF = {"type": "blendbsdf", "weight": 0.5, "a": WHITE, "b": {"type": "conductor"}}
PLASTIC = {"type": "plastic", "int_ior": 3.0, "diffuse_reflectance": {"type": "rgb", "value": [0.8, 0.8, 0.8]}}
GLASS = {"type": "dielectric"}


def room(lights: dict[str, Any], sensor: Any = None, film: Any = None, walls: Any = WHITE, **things: Any) -> Any:
    """The scene, and the sensor's own film; walls are those of the floor and the back, the left one is white."""
    import mitsuba as mi

    size = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = {"type": "perspective", "fov": 50.0, "near_clip": 0.1, "to_world": looking([0.5, 2.2, 7], [0, 1.8, 0])}
    wall = {"type": "rectangle"}
    return mi.load_dict({
        "type": "scene", "sensor": view | (sensor or {}) | {"film": size | (film or {})},
        "floor": wall | {"to_world": place(0, 0, 0, rotate=([1, 0, 0], -90), scale=2), "bsdf": walls},
        "back": wall | {"to_world": place(0, 2, -2, scale=2), "bsdf": walls},
        "left": wall | {"to_world": place(-2, 2, 0, rotate=([0, 1, 0], 90), scale=2), "bsdf": WHITE},
        **things, **lights,
    }, optimize=False)  # fmt: skip


def ball(bsdf: Any, center: Any = (0.8, 0.7, 0.3), radius: float = 0.6) -> dict[str, Any]:
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf}


def glow(radiance: Any = None, kind: str = "area", **options: Any) -> dict[str, Any]:
    return {"emitter": {"type": kind, "radiance": radiance or rgb(8, 7, 6), **options}}


def mesh_lamp(radiance: Any, at: Any = (-0.8, 3.4, 0.6)) -> Any:
    """A mesh of two faces, and texture coordinates, that shines down."""
    import mitsuba as mi

    bsdf, emitter = mi.load_dict(WHITE), mi.load_dict(glow(radiance)["emitter"])
    properties = mi.Properties()
    properties["bsdf"], properties["emitter"] = bsdf, emitter
    mesh = mi.Mesh("sheet", 4, 2, has_vertex_texcoords=True, props=properties)
    params = mi.traverse(mesh)
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    positions = np.stack([corner[:, 0] * 0.7, np.zeros(4), corner[:, 1] * 0.5], 1) + np.array(at)
    params["vertex_positions"] = positions.astype(np.float32).ravel()
    params["vertex_texcoords"] = corner.ravel()
    params["faces"] = np.array([[0, 1, 2], [0, 2, 3]], np.uint32).ravel()
    params.update()
    return mesh


def square() -> dict[str, Any]:
    """A rectangle below where the ceiling would be."""
    return {"type": "rectangle", "to_world": place(0.4, 3.9, 0.2, rotate=([1, 0, 0], 90), scale=[0.5, 0.4, 1])}

EMITTERS: dict[str, Any] = {
    "rectangle": lambda: square() | glow(),
    "disk": lambda: {"type": "disk", "to_world": place(-1.2, 3.2, -0.5, rotate=([1, 0, 0], 70), scale=0.4)} | glow(),
    "sphere": lambda: {"type": "sphere", "center": [1.3, 3, -1], "radius": 0.35} | glow(),
    "mesh": lambda: mesh_lamp(rgb(5, 6, 7)),
    "textured": lambda: square() | glow(texels(3, 4)),
    "textured_mesh": lambda: mesh_lamp(texels(4, 2)),
    "point": lambda: {"type": "point", "position": [1, 3, 1], "intensity": rgb(9, 9, 9)},
    "spot": lambda: {"type": "spot", "to_world": looking([-1, 3, 1.5], [0, 1, -1]), "cutoff_angle": CUTOFF,
                     "intensity": rgb(20, 20, 20)},
    "projector": lambda: {"type": "projector", "to_world": looking([1, 2.5, 2], [0, 1, -1]), "fov": FOV,
                          "irradiance": texels(3, 4)},
    "directional": lambda: {"type": "directional", "direction": [0.3, -0.5, -1], "irradiance": rgb(2, 2, 2)},
    "constant": lambda: {"type": "constant", "radiance": rgb(0.5, 0.6, 0.7)},
    "envmap": lambda: {"type": "envmap", "bitmap": bitmap(8, 16), "to_world": place(0, 0, 0, rotate=([1, 2, 3], 70))},
    "directionalarea": lambda: square() | glow(kind="directionalarea"),
}  # fmt: skip


def lights(*names: str, **weights: float) -> dict[str, Any]:
    """These emitters, sampled in proportion to these weights (1 each)."""
    made = {}
    for name in names:
        one = EMITTERS[name]()
        if name in weights:
            (one["emitter"] if "emitter" in one else one)["sampling_weight"] = weights[name]
        made[f"light_{name}"] = one
    return made


@dataclass(frozen=True)
class Case:
    """A scene, options of the integrator, what is differentiated, and the tolerance; `guided`: by random tables."""

    scene: Any
    options: dict[str, Any]
    keys: tuple[str, ...] = ()
    tolerance: float = 1e-3
    guided: bool = False


THIN = {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 6.0}
SHIFTED = {"principal_point_offset_x": 0.15, "principal_point_offset_y": -0.2}
CROPPED = {"crop_width": 9, "crop_height": 7, "crop_offset_x": 3, "crop_offset_y": 4}

CASES = {
    # All that has a place, sampled unequally; half of all events are delta.
    "lamps": lambda: Case(room(
        lights("rectangle", "disk", "sphere", "mesh", "point", "spot", "projector", "directional", disk=3, point=0.5),
        walls=HALF, ball=ball(GLASS, (-0.9, 0.7, 0.5)), mirror=ball({"type": "conductor"}), more=ball(PLASTIC, (0, 2, -1), 0.5)),
        {}),
    "patterns": lambda: Case(room(lights("rectangle", "constant"), walls=HALF, ball=ball(PLASTIC), glass=ball(GLASS, (-0.8, 0.8, 0))), {"light_share": 0.9}),
    "evened": lambda: Case(room(lights("textured", "textured_mesh", "envmap", textured=2), walls=HALF, sensor=SHIFTED, ball=ball(GLASS)), {},
        ("light_textured.emitter.radiance.data", "light_textured_mesh.emitter.radiance.data", "light_envmap.data")),
    "textured": lambda: Case(room(lights("textured", "textured_mesh", "constant"), film=CROPPED), {"light_share": 0.2}),
    "masks": lambda: Case(room(lights("sphere", "directionalarea", sphere=2), sensor=SHIFTED, film=CROPPED,
        veil={"type": "rectangle", "to_world": place(0, 1.5, 1.5, scale=1.5), "bsdf": {"type": "mask", "opacity": 0.4, "a": WHITE}},
        sheet=ball({"type": "thindielectric"}), inner=ball(HALF, radius=0.4)), {"hide_emitters": True}),
    "envmap": lambda: Case(room(lights("envmap"), sensor=THIN, ball=ball(GLASS)), {"rr_depth": 2}),
    "normals": lambda: Case(room(lights("rectangle", "point"), walls={"type": "bumpmap", "t": {"type": "bitmap", "bitmap": bitmap(8, 8, 1), "raw": True}, "scale": 0.3, "a": {"type": "roughconductor", "alpha": 0.3}}, ball=ball({"type": "roughdielectric", "alpha": 0.3})), {}, tolerance=1e-2),
}


def prepared(case: Case) -> Any:
    """Samples of light paths, which know of the camera paths beside them."""
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.integrators.protocol import Job
    from reslrb_cli.integrators.reslrb import Reslrb

    options = {"estimator": "stack", "max_depth": DEPTH, "rr_depth": 100, "paths": "both"} | case.options
    tracer, params = Reslrb.of(**options), None
    if case.keys:
        params = mi.traverse(case.scene)
        params.keep(list(case.keys))
        for key in case.keys:
            dr.enable_grad(params[key])
        params.update()
    with dr.suspend_grad():
        [samples] = tracer.passes(Job(case.scene, case.scene.sensors()[0], mi.UInt32(1), SPP, params))
    return samples


SPP = 64


def found(samples: Any) -> list[Paths]:
    """What both walks have found, each way."""
    import drjit as dr
    import mitsuba as mi

    with dr.suspend_grad():
        notes = CameraNotes(samples.camera)
        camera_walk(samples.camera, notes)
        camera = notes.taken()
        notes = LightNotes(samples)
        walk(samples, notes)
        e = sample_emission(samples, samples.sampler())
        dr.eval(e.ray, e.emitter)
        light = notes.taken()
        # Rays start a little off the lamp.
        back = mi.Ray3f(e.ray.o + 0.01 * e.ray.d, -e.ray.d)
        si = samples.scene.ray_intersect(back)
        on_lamp = si.is_valid() & (si.t < 0.02) & (si.emitter(samples.scene) == e.emitter)
        p, n, uv = dr.select(on_lamp, si.p, e.ray.o), dr.select(on_lamp, si.n, 0), dr.select(on_lamp, si.uv, 0)
        emission = {"d": e.ray.d, "p": p, "n": n, "uv": uv}
        dr.eval(emission)
        emission = {name: np.array(value, np.float64).T for name, value in emission.items()}
        emission["id"] = np.broadcast_to(np.array(number(e.emitter)), samples.width)
    none: dict[str, np.ndarray] = {}
    return [paths_of("H", camera, none), paths_of("N", camera, none), paths_of("L", light, emission)]


@pytest.mark.parametrize("name", CASES)
def test_a_weight_is_a_ratio_of_densities(name: str):
    samples = prepared(CASES[name]())
    densities = Densities(samples)
    for paths in found(samples):
        d = densities.of(paths)
        fit = d["fit"] & (paths.count > 0)
        ratio = d[paths.way] / (d["H"] + d["N"] + d["L"])
        error = np.abs(paths.weight / ratio - 1)[fit]
        print(name, paths.way, len(fit), fit.sum(), "max", error.max(initial=0), "quantiles", np.quantile(error, [.5, .9, .99, .999]) if len(error) else "")
        bad = np.nonzero(fit)[0][error > 1e-3]
        for i in bad[:6]:
            print("   ", paths.weight[i], ratio[i], {k: float(d[k][i]) for k in WAYS}, paths.count[i], paths.delta[i][:paths.count[i]], paths.id[i])
