"""Path weights with light paths and camera paths. The weights in the kernels are ratios of explicit densities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.path_densities import CameraNotes, Densities, Emission, LightNotes, cosine, emitter_number, paths_of
from measure.faults import Fault, plant, planted
from turns import a_few

from reslrb_cli.integrators.plugin import make_integrator, make_reslrb
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.step import gradient_step
from reslrb_cli.measure.scenes import small
from reslrb_cli.measure.scenes.moving import mesh
from reslrb_cli.transport.camera import camera_walk
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.walk import walk
from reslrb_cli.transport.weights import leave_emitter

pytestmark = pytest.mark.usefixtures("llvm")


# Scenes: a room of 4 by 4 by 4 that is open at the front and the top, where the camera looks in.


def place(*translate: float, scale: Any = 1, rotate: Any = None) -> Any:
    result = mi.ScalarTransform4f().translate(list(translate))
    return (result if rotate is None else result.rotate(*rotate)).scale(scale)


def turned(axis: list[float], angle: float) -> Any:
    return place(0, 0, 0, rotate=(axis, angle))


def looking(origin: Any, target: Any) -> Any:
    return mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0])


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def texels(height: int, width: int) -> dict[str, Any]:
    data = np.random.default_rng(3).uniform(0.4, 20, (height, width, 3)).astype(np.float32)
    return {"type": "bitmap", **small.texels(data), "filter_type": "nearest", "wrap_mode": "clamp"}


def bitmap(height: int, width: int, channels: int = 3) -> Any:
    return mi.Bitmap(np.random.default_rng(4).random((height, width, channels)).astype(np.float32) ** 3 + 0.01)


WHITE = {"type": "diffuse", "reflectance": rgb(0.8, 0.7, 0.6)}
MIRROR, GLASS, ROUGH_GLASS = {"type": "conductor"}, {"type": "dielectric"}, {"type": "roughdielectric", "alpha": 0.3}
#: Half of the scattering events are delta events.
HALF = {"type": "blendbsdf", "weight": 0.5, "a": WHITE, "b": MIRROR}
VEIL = {"type": "mask", "opacity": 0.4, "bsdf": WHITE}
PLASTIC = {"type": "plastic", "int_ior": 3.0, "diffuse_reflectance": rgb(0.8, 0.8, 0.8)}
ROUGH = {"type": "roughconductor", "alpha": 0.3}


def bumpy() -> dict[str, Any]:
    """Return a rough conductor with perturbed normals."""
    return {"type": "bumpmap", "texture": {"type": "bitmap", "bitmap": bitmap(8, 8, 1), "raw": True}, "scale": 0.3,
            "bsdf": ROUGH}  # fmt: skip


def ball(bsdf: Any, center: Any = (0.8, 0.7, 0.3), radius: float = 0.6) -> dict[str, Any]:
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf}


def plate(bsdf: Any, *at: float, scale: Any = 2, rotate: Any = None) -> dict[str, Any]:
    return {"type": "rectangle", "bsdf": bsdf, "to_world": place(*at, scale=scale, rotate=rotate)}


def sheet(at: Any, bsdf: Any = WHITE, emitter: Any = None, leaning: float = 0, size: float = 0.6) -> Any:
    """Return a mesh of two faces that faces down. If `leaning` is above 0, the vertex normals lean outwards by
    `leaning`.
    """
    corner, faces = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32), np.array([[0, 1, 2], [0, 2, 3]])
    positions = np.insert(corner * size, 1, 0, axis=1) + np.array(at)
    normals = np.insert((corner - 0.5) * leaning, 1, -1, axis=1)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    things = {} if emitter is None else {"emitter": emitter}
    return mesh(positions, faces, bsdf, corner, leaning > 0 and normals, "sheet", **things)


def room(lights: dict[str, Any], sensor: Any = None, film: Any = None, walls: Any = WHITE, **things: Any) -> Any:
    """Return the scene. The floor and the back wall have the BSDF `walls`. The left wall is white."""
    size = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = {"type": "perspective", "fov": 50.0, "near_clip": 0.1, "to_world": looking([0.5, 2.2, 7], [0, 1.8, 0])}
    return mi.load_dict({
        "type": "scene", "sensor": view | (sensor or {}) | {"film": size | (film or {})},
        "floor": plate(walls, 0, 0, 0, rotate=([1, 0, 0], -90)), "back": plate(walls, 0, 2, -2),
        "left": plate(WHITE, -2, 2, 0, rotate=([0, 1, 0], 90)), **things, **lights,
    }, optimize=False)  # fmt: skip


def glow(radiance: Any = None, kind: str = "area") -> dict[str, Any]:
    return {"type": kind, "radiance": radiance or rgb(8, 7, 6)}


def lamp(emitter: Any = None) -> dict[str, Any]:
    """Return a rectangular lamp that shines down."""
    return plate(WHITE, 0.4, 3.9, 0.2, rotate=([1, 0, 0], 90), scale=[0.5, 0.4, 1]) | {"emitter": emitter or glow()}


CUTOFF, FOV = 50.0, 70.0  # angles of the spot and the projector, in degrees
MESH = (-0.8, 3.4, 0.6)
EMITTERS: dict[str, Callable[[], Any]] = {
    "rectangle": lamp,
    "disk": lambda: {"type": "disk", "to_world": place(-1.2, 3.2, -0.5, rotate=([1, 0, 0], 70), scale=0.4),
                     "emitter": glow()},
    "sphere": lambda: ball(WHITE, (1.3, 3, -1), 0.35) | {"emitter": glow()},
    "cylinder": lambda: {"type": "cylinder", "p0": [-1, 3, 0], "p1": [1, 3, 0.3], "radius": 0.2, "emitter": glow()},
    "mesh": lambda: sheet(MESH, emitter=glow()),
    "textured": lambda: lamp(glow(texels(3, 4))),
    "textured_mesh": lambda: sheet(MESH, emitter=glow(texels(4, 2))),
    "point": lambda: {"type": "point", "position": [1, 3, 1], "intensity": rgb(9, 9, 9)},
    "spot": lambda: {"type": "spot", "to_world": looking([-1, 3, 1.5], [0, 1, -1]), "cutoff_angle": CUTOFF,
                     "intensity": rgb(20, 20, 20)},
    "scaled_spot": lambda: EMITTERS["spot"]() | {"to_world": looking([-1, 3, 1.5], [0, 1, -1]).scale(2)},
    "projector": lambda: {"type": "projector", "to_world": looking([1, 2.5, 2], [0, 1, -1]), "fov": FOV,
                          "irradiance": texels(3, 4)},
    "directional": lambda: {"type": "directional", "direction": [0.3, -0.5, -1], "irradiance": rgb(2, 2, 2)},
    "constant": lambda: {"type": "constant", "radiance": rgb(0.5, 0.6, 0.7)},
    "envmap": lambda: {"type": "envmap", "bitmap": bitmap(8, 16), "to_world": turned([0.6, 0, 0.8], 70)},
    "inside": lambda: ball(WHITE, (0, 2, 2), 12) | {"flip_normals": True, "emitter": glow()},
    "sunsky": lambda: {"type": "sunsky", "to_world": turned([1, 0, 0], -90)},
    "textured_sphere": lambda: ball(WHITE, (1.3, 3, -1), 0.35) | {"emitter": glow(texels(3, 4))},
    "textured_disk": lambda: {"type": "disk", "to_world": place(-1.2, 3.2, -0.5, rotate=([1, 0, 0], 70), scale=0.4),
                     "emitter": glow(texels(3, 4))},
    "directionalarea": lambda: lamp(glow(kind="directionalarea")),
}  # fmt: skip


def lights(*names: str, **weights: float) -> dict[str, Any]:
    """Return the named emitters. Sampling is proportional to `weights` (default 1)."""
    made = {f"light_{name}": EMITTERS[name]() for name in names}
    for name, weight in weights.items():
        one = made[f"light_{name}"]
        one.get("emitter", one)["sampling_weight"] = weight
    return made


THIN = {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 6.0}
SHIFTED = {"principal_point_offset_x": 0.15, "principal_point_offset_y": -0.2}
CROPPED = {"crop_width": 9, "crop_height": 7, "crop_offset_x": 3, "crop_offset_y": 4}
EVENED = ("light_textured.emitter.radiance.data", "light_textured_mesh.emitter.radiance.data", "light_envmap.data")


@dataclass(frozen=True)
class Case:
    """A scene, the keys of its differentiated parameters, and options of the integrator. If `guided`, the tables learn
    from a random dL/dI. If `shared`, a random density distributes the camera paths over the pixels.
    """

    scene: Callable[[], Any]
    keys: tuple[str, ...] = ()
    paths: str = "both"
    max_depth: int = 6
    light_share: float = 0.5
    rr_depth: int = 100
    hide_emitters: bool = False
    guided: bool = False
    shared: bool = False
    spp: int = 48


CASES = {
    # Emitters with a position, which are sampled with unequal weights.
    "lamps": Case(lambda: room(
        lights("rectangle", "disk", "sphere", "mesh", "point", "spot", "projector", "directional", disk=3, point=0.5),
        ball=ball(GLASS), other=ball(MIRROR, (-0.9, 0.7, 0.5)))),
    # All patterns of delta and other vertices.
    "patterns": Case(lambda: room(
        lights("rectangle", "constant", constant=2), walls=HALF, right=plate(HALF, 2, 2, 0, rotate=([0, 1, 0], -90)),
        above=plate(HALF, 0, 4.2, 0, rotate=([1, 0, 0], 90)), ball=ball(PLASTIC), other=ball(GLASS, (-0.8, 0.8, 0))),
        spp=192),
    # Textures and maps that are differentiated, and are therefore drawn more evenly.
    "evened": Case(lambda: room(
        lights("textured", "textured_mesh", "envmap", textured=2), sensor=SHIFTED, walls=HALF), EVENED),
    "textured": Case(lambda: room(
        lights("textured", "textured_mesh", "constant"), film=CROPPED, sensor={"near_clip": 2.0},
        close=plate(WHITE, 0.4, 2.1, 6, scale=0.1)), light_share=0.2),
    # A hidden lamp stands before the camera, too.
    "masks": Case(lambda: room(
        lights("sphere", "directionalarea", sphere=3), sensor=SHIFTED, film=CROPPED,
        shade=ball(VEIL, (1.3, 3, -1), 0.7),
        front=plate(WHITE, 0.3, 2, 4.5, rotate=([0, 1, 0], 180), scale=0.7) | {"emitter": glow()},
        shell=ball({"type": "thindielectric"}), core=ball(HALF, radius=0.4)), hide_emitters=True, spp=96),
    "envmap": Case(lambda: room(lights("envmap"), sensor=THIN, ball=ball(GLASS)), rr_depth=2),
    "perturbed": Case(lambda: room(lights("rectangle", "point"), walls=bumpy(), ball=ball(ROUGH_GLASS)),
                      light_share=0.8),
    "smooth": Case(lambda: room(lights("sphere", "constant"), sensor=THIN,
                                roof=sheet([-2, 3.6, -2], HALF, leaning=3, size=4)), spp=192),
    "rough": Case(lambda: room(lights("rectangle", "constant"), walls=HALF, ball=ball(ROUGH_GLASS, radius=1.2))),
    "camera": Case(lambda: room(lights("sphere", "constant", "point", point=2), walls=HALF,
                                shade=ball(VEIL, radius=0.9), core=ball(ROUGH_GLASS)), paths="camera"),
    "guided": Case(lambda: room(lights("rectangle", "spot"), walls=ROUGH, ball=ball(PLASTIC)), guided=True),
    "shared": Case(lambda: room(lights("rectangle", "constant"), walls=HALF, ball=ball(GLASS), film=CROPPED,
                                sensor=SHIFTED), shared=True),
}  # fmt: skip


CASES |= {f"only_{name}": Case(partial(lambda name: room(lights(name), walls=HALF, ball=ball(GLASS)), name))
          for name in EMITTERS}  # fmt: skip


def prepared(case: Case) -> Any:
    """Return samples of light paths together with their camera paths, or samples of camera paths only."""
    names = ("paths", "max_depth", "light_share", "rr_depth", "hide_emitters")
    options = {name: getattr(case, name) for name in names} | {"estimator": "stack"}
    scene, params = case.scene(), None
    tracer = make_reslrb(**options, guiding="on" if case.guided else "off")
    if case.shared:
        size = scene.sensors()[0].film().crop_size()
        density = np.random.default_rng(2).exponential(size=(size[1], size[0])).astype(np.float32)
        tracer = tracer.shared_out({"0": density})
    if case.keys:
        params = mi.traverse(scene)
        for key in case.keys:
            dr.enable_grad(params[key])
        params.update()
    job = Job(scene, scene.sensors()[0], mi.UInt32(1), case.spp, params)
    if case.guided:
        size = job.sensor.film().crop_size()
        tracer.plan(scene, job.sensor)
        tracer.learn_now(job, mi.TensorXf(np.random.default_rng(1).normal(size=(size[1], size[0], 3))))
    with dr.suspend_grad():
        [samples] = tracer.passes(job)
    assert (samples.guide is not None and samples.plan.aimed) == case.guided
    return samples


def found(samples: Any) -> dict[str, Any]:
    """Return the paths that each way has found."""
    with dr.suspend_grad():
        camera = CameraNotes(samples.camera or samples)
        camera_walk(camera.samples, camera)
        seen = camera.taken()
        result = {way: paths_of(way, seen) for way in ("H", "N")}
        if samples.camera is not None:
            light = LightNotes(samples)
            walk(samples, light)
            result["L"] = paths_of("L", light.taken(), Emission.of(samples))
        return result


@dataclass(frozen=True)
class Comparison:
    """Result of one way, over paths that rounding does not affect. `error` is the error of the weights relative to the
    ratios of densities. `patterns` are the patterns of delta vertices. `missed` are the emitters that no path has
    found.
    """

    error: np.ndarray
    patterns: list[tuple[bool, ...]]
    missed: set[str]

    @property
    def holds(self) -> bool:
        return bool(np.all(self.error < TOLERANCE))


TOLERANCE = 1e-3


def compared(case: Case) -> dict[str, Comparison]:
    """Return for each way the comparison of a case's weights with its densities."""
    samples = prepared(case)
    densities, result = Densities(samples, samples.camera or samples, CUTOFF, FOV), {}
    for way, paths in found(samples).items():
        d = densities.of(paths)
        direct, fit = paths.count == 0, d["fit"] & (paths.count > 0)
        with np.errstate(all="ignore"):
            ratio = d[way] / (d["H"] + d["N"] + d["L"])
            error = (np.abs(paths.weight - ratio) / np.maximum(ratio, 1e-5))[fit]
        error = np.append(np.nan_to_num(error, nan=np.inf), np.abs(paths.weight[direct] - 1))
        patterns = [pattern for pattern, here in zip(paths.patterns(), fit, strict=True) if here]
        missed = {e.class_name() for e in samples.scene.emitters() if emitter_number(e) not in paths.id[fit]}
        result[way] = Comparison(error, patterns, missed)
    return result


@cache
def as_it_stands(name: str) -> dict[str, Comparison]:
    """Return the comparison of a case. The result is cached for all tests."""
    return compared(CASES[name])


POINTS = ("PointLight", "SpotLight", "Projector", "DirectionalEmitter")
#: Cases that need `-m long`: each resembles another case. Plans for single emitters differ, and one of them runs.
SIMILAR = ("rough", "smooth", *(name for name in CASES if name.startswith("only") and name != "only_directional"))


@pytest.mark.parametrize("name", a_few(CASES, [name for name in CASES if name not in SIMILAR]))
def test_a_weight_is_a_ratio_of_densities(name: str):
    ways = as_it_stands(name)
    assert {way: one.error.max(initial=0) for way, one in ways.items() if not one.holds} == {}
    assert ways["H"].missed <= {*POINTS, "DirectionalArea"}
    assert ways["N"].missed <= {"DirectionalArea"}
    assert "L" not in ways or (ways["L"].missed == set() and len(ways["L"].error) > 500)


def test_every_pattern_of_delta_vertices_is_covered():
    met = {way: set(one.patterns) for way, one in as_it_stands("patterns").items()}
    every = {pattern for m in range(1, 6) for pattern in product((False, True), repeat=m)}
    assert met["H"] == every
    assert met["N"] == {pattern for pattern in every if not pattern[-1]}
    assert met["L"] == {pattern for pattern in every if not pattern[0]}


@pytest.mark.parametrize(
    "name",
    a_few(
        [n for n in CASES if n not in ("guided", "camera", "only_scaled_spot")],
        ["lamps", "evened", "masks", "envmap"],
    ),
)
def test_the_density_of_rays_matches_the_sampled_ones(name: str):
    """The weight of a ray determines its density. The weight is the light along the ray, times the cosine at a lamp,
    divided by the density.
    """
    samples = prepared(CASES[name])
    densities = Densities(samples, samples.camera, CUTOFF, FOV)
    with dr.suspend_grad():
        rays, again = Emission.of(samples), sample_emission(samples, samples.sampler())
        rivals = leave_emitter(samples.plan, samples.emitters, samples.scene, again)
        M, V = (np.array(value, np.float64) for value in (rivals.M, rivals.V))
    cos = np.where(np.linalg.norm(rays.nz, axis=1) > 0, cosine(rays.nz, rays.d), 1)
    fit = (cos > 0.02) & (rays.light > 0) & ((M > 0) | (V > 0))
    e = (rays.light * cos / rays.weight)[fit]
    by_hand = densities.ends(rays, rays.z + rays.d, -rays.d)
    with np.errstate(all="ignore"):
        own = np.where(V > 0, 1 / V, by_hand["sampled"] / M)
    assert fit.mean() > 0.99 or name in ("masks", "only_directionalarea")  # parallel light has no densities
    np.testing.assert_allclose(by_hand["sent"][fit], e, rtol=2 * TOLERANCE)
    np.testing.assert_allclose((own * cos)[fit], e, rtol=TOLERANCE)


# Faults: each one is found, and only by the ways that contain it.


def by_ways(ways: str) -> frozenset[tuple[str | None, str]]:
    """Return the failures of these ways: H, N and L."""
    return frozenset((None, way) for way in ways)


#: Each fault, with the ways whose weights it makes wrong.
FAULTS = [
    Fault("light_without_reverse", "small", "transport.weights:weight_of_connection", "arrived.V * back", "arrived.V",
          by_ways("L")),
    Fault("met_without_reverse", "small", "transport.camera:_behind", "here.V * ways.back", "here.V", by_ways("HN")),
    Fault("sampled_without_reverse", "small", "transport.camera:_weigh", "own.V * ways.ahead_back", "own.V",
          by_ways("N")),
    Fault("more_light_paths", "small", "transport.walk:walk", "N = samples.ratio_at", "N = 2 * samples.ratio_at",
          by_ways("L")),
    Fault("fewer_camera_paths", "small", "transport.camera:camera_walk",
          "samples.ratio_at(first.u) /", "2 * samples.ratio_at(first.u) /", by_ways("HN")),
    Fault("shared_evenly_for_all", "shared", "transport.samples:Samples.ratio_at",
          "mean / self.shares.count(pixel, inside)", "1", by_ways("HNL")),
    Fault("shared_evenly_for_light", "shared", "transport.walk:walk",
          "N = samples.ratio_at(connection.u)", "N = samples.ratio", by_ways("L")),
    Fault("emitted_without_choice", "small", "transport.densities:EmitterDensities.of",
          "= choice[number] * own", "= own * (choice[number] if index else 1)", by_ways("HNL")),
    Fault("sampled_without_choice", "small", "transport.weights:leave_emitter", "M = choice * own", "M = own",
          by_ways("L")),
    Fault("delta_by_flags", "small", "transport.bsdf:scatter",
          "mi.has_flag(lobe, mi.BSDFFlags.Delta) & ~is_null",
          "mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) & ~is_null", by_ways("HNL")),
    Fault("null_is_a_vertex", "small", "transport.camera:_behind", "if plan.needs.has_null", "if False", by_ways("HN")),
    Fault("null_is_a_vertex_of_light", "small", "transport.walk:walk",
          "path.rivals.after_null(arrived), behind", "behind, behind", by_ways("L")),
    Fault("null_restarts_distance", "small", "transport.weights:Rivals.after_null",
          "distance=arrived.distance", "distance=mi.Float(0)", by_ways("HNL")),
    Fault("sides_forgotten", "smooth", "transport.camera:_behind", "dr.select(ways.valid, m, 0)", "m",
          by_ways("HN")),
    Fault("aperture_forgotten", "small", "transport.camera:camera_walk", "mi.Float(near)", "mi.Float(0)",
          by_ways("HN")),
    Fault("twice_as_many_on_both_sides", "small", "transport.samples:passes",
          "width / (n_camera / crop)", "2 * width / (n_camera / crop)", by_ways("HNL")),
    Fault("crop_forgotten", "cropped", "transport.samples:passes",
          "width / (n_camera / crop)", "width / (n_camera / pixels)", by_ways("HNL")),
]  # fmt: skip
CASES |= {
    "small": Case(lambda: room(lights("rectangle", "disk", disk=3), walls=HALF,
                               veil=plate(VEIL, 0, 1.5, 1.5, scale=1.5))),
    "cropped": Case(lambda: room(lights("constant"), film=CROPPED)),
}  # fmt: skip


@planted(FAULTS)
def test_a_fault_is_found(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    assert all(one.holds for one in as_it_stands(fault.check).values())
    plant(fault, monkeypatch)
    result = compared(CASES[fault.check])
    assert {(None, way) for way, one in result.items() if not one.holds} == fault.fails


# Faults of the walk back, which the weights do not show. Naive AD finds them at equal seeds.

WALKS_BACK = {
    "walk_back_forgets_what_is_met": ("CameraSweep.vertex", "if met is not None:", "if False:", 16),
    "blocks_forget_what_is_met": ("CameraSweep.vertex", "if met is not None:",
                                  "if met is not None and self.ring.end is None:", 1),
}  # fmt: skip


def gradient(**options: Any) -> np.ndarray:
    """Return the derivatives by all colours of a room, estimated with camera paths. All integrators use the same camera
    paths.
    """
    scene = room(lights("rectangle", "constant"), walls=HALF)
    params = mi.traverse(scene)
    params.keep([key for key in params.keys() if key.endswith(("reflectance.value", "radiance.value"))])  # noqa: SIM118
    for key in list(params.keys()):
        dr.enable_grad(params[key])
    params.update()
    weights = np.random.default_rng(5).random(12 * 16 * 3).astype(np.float32)
    integrator = make_integrator(max_depth=5, rr_depth=100, paths="camera", **options)
    gradient_step(integrator, scene, 0, lambda image: dr.sum(image.array * mi.Float(weights)), seed=3, spp=16,
                  params=params, adjoint="independent")  # fmt: skip
    return np.concatenate([np.ravel(np.array(dr.grad(value))) for _, value in params.items()])


@cache
def by_naive_ad() -> np.ndarray:
    return gradient(type="walk_ad")


@pytest.mark.parametrize("name", WALKS_BACK)
def test_a_walk_back_that_forgets_is_found(name: str, monkeypatch: pytest.MonkeyPatch):
    where, right, wrong, stack_size = WALKS_BACK[name]
    options = {"type": "reslrb", "estimator": "stack", "stack_size": stack_size}
    np.testing.assert_allclose(gradient(**options), by_naive_ad(), rtol=1e-4)
    plant(Fault(name, "", f"estimators.camera:{where}", right, wrong), monkeypatch)
    assert np.abs(gradient(**options) / by_naive_ad() - 1).max() > 0.01
