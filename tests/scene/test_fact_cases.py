"""Results of functions about needs, rays and lamps of scenes, as a table of cases (`said.check`)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from golden import said
from golden.cases import Cases, ending

from reslrb_cli.scene import graph, needs, rays
from reslrb_cli.scene.graph import SceneGraph

pytestmark = pytest.mark.usefixtures("combined")
Patch = pytest.MonkeyPatch
case = Cases()


GLASS, MIRROR, COAT = {"type": "dielectric"}, {"type": "conductor"}, {"type": "plastic"}
WHITE = {"type": "diffuse"}
MASK = {"type": "mask", "opacity": 0.5, "bsdf": WHITE}
PANE = {"type": "thindielectric"}
POINT = {"type": "point", "position": [0.0, 0, 3]}


def camera(type: str = "perspective", size: tuple[int, int] = (6, 4), **more: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    eye = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    return {"type": type, "to_world": eye, "film": film, **({} if type == "orthographic" else {"fov": 40}), **more}


def scene_of(**objects: Any) -> Any:
    """Return a scene with a point lamp, and a camera that looks at a rectangle, unless `objects` has others."""
    plain = {"camera": camera(), "lamp": POINT, "wall": {"type": "rectangle", "bsdf": WHITE}}
    kept = {name: each for name, each in (plain | objects).items() if each is not None}
    return mi.load_dict({"type": "scene", **kept}, optimize=False)


def wall(bsdf: Any, x: float = 0.0, z: float = 0.0, scale: float = 1.0, **more: Any) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate([x, 0, z]).scale(scale)
    return {"type": "rectangle", "bsdf": bsdf, "to_world": place, **more}


BEAM = {"type": "directionalarea", "radiance": 3.0}
AREA = {"type": "area", "radiance": 3.0}


def scenes() -> dict[str, Any]:
    blend = {"type": "blendbsdf", "weight": 0.3}
    meter = {"type": "irradiancemeter", "film": {"type": "hdrfilm"}}
    group = {"group": {"type": "shapegroup", "a": {"type": "sphere"}}}
    return {
        "plain": {}, "mirror": {"wall": wall(MIRROR)}, "glass": {"pane": wall(GLASS, z=1)},
        "pane": {"pane": wall(PANE, z=1)},
        "mask": {"pane": wall(MASK, z=1)}, "coat": {"wall": wall(COAT)},
        "rough": {"wall": wall({"type": "roughconductor"})},
        "beam": {"lamp": wall(WHITE, x=3, z=2, emitter=BEAM)},
        "blend": {"wall": wall({**blend, "a": MIRROR, "b": WHITE})},
        "blended coat": {"wall": wall({**blend, "a": COAT, "b": WHITE})},
        "blended masks": {"wall": wall({**blend, "a": MASK, "b": {"type": "null"}})},
        "mask of glass": {"wall": wall({**MASK, "bsdf": PANE})},
        "scaled sun": {"lamp": {"type": "directional", "to_world": mi.ScalarTransform4f().scale(2)}},
        "bumps": {"wall": wall({"type": "bumpmap", "arbitrary": {"type": "checkerboard"}, "bsdf": WHITE})},
        "instances": {**group, "b": {"type": "instance", "c": {"type": "ref", "id": "group"}}},
        "irradiance meter": {"camera": None, "wall": wall(WHITE, sensor=meter)},
        "orthographic": {"camera": camera("orthographic")},
        "thin lens": {"camera": camera("thinlens", aperture_radius=0.3, focus_distance=4.0)},
        "two lamps": {"more": {"type": "constant"}},
        "area lamp": {"lamp": wall(WHITE, x=3, z=2, emitter=AREA)},
    }  # fmt: skip


@case
def facts_of_scenes(patch: Patch) -> Any:
    """Needs with all lamps, with one and with none, and the paths that can render the scene."""
    found = {}
    for name, objects in scenes().items():
        scene = scene_of(**objects)
        sensor, at = scene.sensors()[0], SceneGraph.of(scene)
        about = [said.plain(ending(needs.scene_needs, scene, sensor, lit)) for lit in (None, [0], [])]
        lamps = [[each.get("emitters"), each.get("environment")] for each in about[1:]]
        obstacles = [ending(needs.paths_obstacle, scene, sensor, paths) for paths in ("camera", "both", "prb")]
        kinds = [needs.usual_paths(scene, [sensor], depth, False, False) for depth in (2, 5)]
        kinds += [needs.camera_finds_all(scene, depth, gloss) for depth in (2, 3, -1) for gloss in (False, True)]
        found[name] = [about[0], lamps, obstacles, kinds, needs.blend_warning(at, needs.uneven_blends(at))]
    return found


@case
def nested_surfaces(patch: Patch) -> Any:
    """BSDFs within BSDFs, without their textures, and the BSDFs that own them."""
    chequered = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    blend = {"type": "blendbsdf", "weight": {"type": "checkerboard"}, "a": {**MASK, "bsdf": chequered}, "b": MIRROR}
    found = []
    for bsdf in (WHITE, chequered, MASK, blend, {"type": "twosided", "bsdf": {**blend, "a": chequered}},
                 {"type": "bumpmap", "arbitrary": {"type": "checkerboard"}, "bsdf": COAT}):  # fmt: skip
        at = SceneGraph.of(scene_of(wall=wall(bsdf)))
        found.append([[inner.class_name() for inner in at.nested_bsdfs(each)] for each in at.surface_bsdfs()])
        found[-1] += [[each.class_name() for each in at.owning_bsdfs(inner)] for inner in at.of_type(mi.BSDF)]
    return found


@case
def paths_of_several_sensors(patch: Patch) -> Any:
    """Each order of a sensor that any paths can render and one that camera paths cannot, still and with motions."""
    meter = {"type": "irradiancemeter", "film": {"type": "hdrfilm"}}
    scene = scene_of(wall=wall(WHITE, sensor=meter), mirror=wall(MIRROR, z=0.5, scale=0.3))
    first, second = scene.sensors()
    return [[needs.usual_paths(scene, views, depth, hidden, moves), needs.light_finds_all(scene, views, hidden)]
            for views in ([first], [second], [first, second], [second, first])
            for depth in (2, 5) for hidden in (False, True) for moves in (False, True)]  # fmt: skip


@case
def clip_planes_of_sensors(patch: Patch) -> Any:
    """Objects before the near plane, beside it, and around the sensor, and foci within the planes and outside."""
    found = []
    move = mi.ScalarTransform4f()
    objects = {"before": wall(WHITE, z=4.9, scale=0.01), "behind": wall(WHITE, z=5.5),
               "aside": wall(WHITE, x=2, z=4.9, scale=0.1), "far": wall(WHITE, z=-30),
               "around": {"type": "sphere", "center": [0, 0, 5], "radius": 3.0},
               "touching": {"type": "sphere", "center": [0, 0, 5.3], "radius": 0.4},
               "box": {"type": "cube", "to_world": move.translate([0, 0, 5]).scale(3)},
               "edge": {"type": "cube", "to_world": move.translate([0.5, 0, 4.9]).scale(0.45)}}  # fmt: skip
    sensors = [camera(near_clip=near, far_clip=far) for near, far in ((0.01, 100), (0.2, 100), (0.2, 10))]
    sensors += [camera("thinlens", near_clip=0.2, far_clip=20, aperture_radius=radius, focus_distance=focus)
                for radius, focus in ((0.3, 4.0), (0.3, 0.2), (0.3, 20.0), (0.3, 30.0), (0.01, 0.1))]  # fmt: skip
    for sensor in sensors:
        for name, thing in objects.items():
            scene = scene_of(camera=sensor, thing=thing)
            found.append([name, needs._clip_planes(scene, scene.sensors()[0])])
        scene = scene_of(camera=sensor)
        found.append(["nothing", needs._clip_planes(scene, scene.sensors()[0])])
    return found


@case
def rays_between_points(patch: Patch) -> Any:
    """Shadow rays, hidden targets, and rays past lamps in a row."""
    lamps = {f"l{n}": wall(WHITE, z=1.0 + n, emitter=AREA) for n in range(2)}
    scene = scene_of(**lamps, top=wall(WHITE, z=3.5))
    si = dr.zeros(mi.SurfaceInteraction3f, 5)
    si.p, si.n = mi.Point3f([0, 0.2, 5, 0, 0.9], 0, 0), mi.Normal3f(0, 0, 1)
    targets = mi.Point3f([0, 0.1, 5, 0, 3], 0, [0.5, 1.5, 4, 4, 3])
    found: list[Any] = []
    for has_edges in (False, True):
        ray = rays.shadow_ray(si, targets, has_edges)
        found.append([np.array(each) for each in (ray.o, ray.d, ray.maxt)])
        hidden = [rays.is_hidden(scene, si, targets, has_edges, mi.Bool(True), passes) for passes in (False, True)]
        found += [np.array(each).astype(int) for each in hidden]
    up = mi.Ray3f(si.p + mi.Vector3f(0, 0, 0.1), mi.Vector3f(0, 0, 1))
    ray = rays.past_lamps(scene, up, mi.Bool([True, True, True, True, False]))
    return [*found, np.array(ray.o), np.minimum(np.array(ray.maxt), 1e9), rays.grid(2), rays.visible(200.0)]


@case
def rays_of_sensors_and_lamps(patch: Patch) -> Any:
    found = []
    place, half = mi.Point2f([0.1, 0.5, 0.9], [0.2, 0.5, 0.7]), mi.Point2f(0.5)
    for name in ("plain", "orthographic", "thin lens", "irradiance meter", "beam", "two lamps"):
        scene = scene_of(**scenes()[name])
        ray, weight = rays.sensor_rays(scene.sensors()[0], 0.0, place, mi.Point2f(0.3, 0.6))
        light, power = rays.emitted_rays(scene, mi.Float(0.5), place, half)
        found.append([name, *(np.array(each) for each in (ray.o, ray.d, weight, light.o, light.d, power))])
    odd = scene_of(lamp=wall(WHITE, emitter={"type": "area", "radiance": {"type": "checkerboard"}}))
    return [*found, ending(rays.emitted_rays, odd, mi.Float(0.5), half, half), rays.failure(lambda: None),
            rays.failure(lambda: mi.load_dict({"type": "nothing"})) is None]  # fmt: skip


@case
def small_lamps_in_view(patch: Patch) -> Any:
    """Lamps of several sizes: in view, behind a wall, outside of the view, and more than can be compared."""
    places = ((0, 1, 0.5), (0.5, 1, 1e-3), (0, -1, 1e-3), (9, 1, 1e-3), (-0.5, 1, 0.05))
    lamps = {f"l{n}": wall(WHITE, x=x, z=z, scale=scale, emitter=AREA) for n, (x, z, scale) in enumerate(places)}
    scene = scene_of(beam=wall(WHITE, x=0.2, z=1, scale=1e-3, emitter=BEAM), **lamps)
    found, sensor = SceneGraph.of(scene).find_lamps(scene), scene.sensors()[0]
    seen = [[lamp.shape.id() for lamp in graph.small_lamps(scene, sensor, found)]]
    patch.setattr(graph, "MOST", 2)
    seen.append([lamp.shape.id() for lamp in graph.small_lamps(scene, sensor, found)])
    return seen, [[lamp.shape.id(), round(graph._pixels(sensor, lamp.shape), 4)] for lamp in found]


test_cases = pytest.mark.usefixtures("llvm")(case.test())
