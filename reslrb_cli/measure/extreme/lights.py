"""Light: very dim and very bright, small, grazing, seen a thousand times, or not at all."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import camera as pinhole
from reslrb_cli.measure.analytic_scenes import furnace_scene
from reslrb_cli.measure.extreme.case import Exact, ExtremeCase, Stock, Twin, Zero
from reslrb_cli.measure.small_scenes import camera, diffuse, lamp, rgb, room, transform

WALL = "wall.brdf_0.reflectance.value"
LAMP = "lamp.emitter.radiance.value"
ROULETTE = {"max_depth": 5, "rr_depth": 2}


def lit(scale: float) -> dict:
    """The room under a lamp of so many times its usual radiance."""
    return room(lamp=lamp(radiance=rgb(3 * scale, 4 * scale, 5 * scale)))


def two_lamps() -> dict:
    dim = lamp(radiance=rgb(3e-25, 2e-25, 1e-25)) | {
        "to_world": transform(translate=[0.9, 0.8, 1.6], rotate=([1, 0.5, 0], 120), scale=0.4)}  # fmt: skip
    return room(lamp=lamp(radiance=rgb(1e25, 2e25, 3e25)), dim=dim)


def small_lamp(radiance: float) -> dict:
    """A lamp of side 1e-4."""
    tiny = transform(translate=[0.2, 1.6, 0.2], rotate=([1, 0, 0], 90), scale=0.5e-4)
    return room(lamp=lamp(radiance=rgb(radiance, 2 * radiance, radiance)) | {"to_world": tiny})


def sun() -> dict:
    """A sky of 8 x 16 texels, one of which is a million times brighter than the others."""
    import mitsuba as mi

    sky = np.random.default_rng(2).uniform(0.5, 1.5, (8, 16, 3)).astype(np.float32)
    sky[2, 5] = 1e6
    return room(lamp=None, sky={"type": "envmap", "bitmap": mi.Bitmap(sky)})


def skimming() -> dict:
    """Parallel light at half a degree over the floor."""
    height = float(np.tan(np.deg2rad(0.5)))
    light = {"type": "directional", "direction": [-0.9, -height, -0.43], "irradiance": rgb(90, 80, 70)}
    return room(lamp=None, wall_shape=None, side_shape=None, light=light)


def speck() -> dict:
    """A hall lit by a beam on a speck that stands before the lens, at a ten thousandth of the walls' distance."""
    import mitsuba as mi

    def facing(origin: list, target: list, half: float) -> Any:
        aim = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0])
        return aim @ mi.ScalarTransform4f().scale(half)

    at = [0.01, 0.0, -0.05]
    return {
        "type": "scene",
        "camera": pinhole([0, 0, 0], [0, 0, -1], [0, 1, 0], 50) | {"near_clip": 1e-3},
        "box": {"type": "cube", "flip_normals": True, "to_world": transform(translate=[0, 0, -100], scale=500),
                "bsdf": diffuse(0.6, 0.7, 0.5)},
        "speck": {"type": "rectangle", "bsdf": diffuse(0.5, 0.6, 0.8), "to_world": facing(at, [0.01, 0, 1], 2e-3)},
        "lamp": {"type": "rectangle", "bsdf": diffuse(0, 0, 0), "to_world": facing([20, 8, 15], at, 5e-4),
                 "emitter": {"type": "directionalarea", "radiance": rgb(3, 2, 4)}},
    }  # fmt: skip


def away() -> dict:
    """The camera looks into the void."""
    import mitsuba as mi

    back = mi.ScalarTransform4f().look_at(origin=[1.2, 0.6, 4], target=[2.5, 1.4, 8], up=[0, 1, 0])
    return room(camera=camera() | {"to_world": back})


def white(max_depth: int) -> Any:
    return furnace_scene((1, 1, 1), (0.5, 1, 2), max_depth, 4)


def grey(max_depth: int) -> Any:
    return furnace_scene((0.5, 0.8, 0.9), (1, 2, 0.5), max_depth, 8)


def white_box() -> dict:
    """A closed white box that holds a white cube, behind which the camera does not see."""
    import mitsuba as mi

    view = mi.ScalarTransform4f().look_at(origin=[0.8, 0.7, 0.8], target=[-0.2, -0.2, -0.2], up=[0, 1, 0])
    return {
        "type": "scene",
        "camera": camera(size=8) | {"to_world": view, "fov": 80},
        "box": {"type": "cube", "flip_normals": True, "bsdf": diffuse(1, 0.99, 1)},
        "cube": {"type": "cube", "bsdf": diffuse(1, 1, 0.98),
                 "to_world": transform(rotate=([1, 2, 3], 40), scale=0.35)},
        "lamp": lamp(radiance=rgb(3, 4, 5)) | {
            "to_world": transform(translate=[0.2, 0.99, 0.2], rotate=([1, 0, 0], 90), scale=0.3),
            "bsdf": diffuse(0.9, 0.9, 0.9)},
    }  # fmt: skip


FURNACE = ("walls.bsdf.reflectance.value", "walls.emitter.radiance.value")

CASES = [
    ExtremeCase("emission_1e-25", "a lamp of radiance 1e-25 under a fixed adjoint image", lambda: lit(1e-25),
                (WALL, LAMP), Twin(lambda: lit(1), {WALL: 1e-25})),
    ExtremeCase("emission_1e-25_roulette", "the same with Russian roulette, which goes by throughput",
                lambda: lit(1e-25), (WALL, LAMP), Twin(lambda: lit(1), {WALL: 1e-25}), spp=256, options=ROULETTE),
    ExtremeCase("emission_1e+25", "a lamp of radiance 1e+25 under a fixed adjoint image", lambda: lit(1e25),
                (WALL, LAMP), Twin(lambda: lit(1), {WALL: 1e25})),
    ExtremeCase("emission_1e-25_and_1e+25", "both in one scene", two_lamps,
                (WALL, LAMP, "dim.emitter.radiance.value"), Stock("ptracer"), spp=128),
    ExtremeCase("lamp_of_area_1e-8", "a lamp of side 1e-4 and radiance 4e8", lambda: small_lamp(4e8), (WALL, LAMP),
                Stock("ptracer")),
    ExtremeCase("lamp_of_area_1e-8_roulette", "the same of radiance 1: what a path carries is 1e-8 from the start",
                lambda: small_lamp(1), (WALL, LAMP), Stock("ptracer"), spp=256, options=ROULETTE),
    ExtremeCase("sun_1e6", "a sun of contrast 1e6 in an environment map", sun, ("sky.data", WALL), Stock("prb"),
                spp=256),
    ExtremeCase("grazing_light", "parallel light at half a degree over a floor", skimming,
                ("floor.brdf_0.reflectance.value", "light.irradiance.value"), Stock("ptracer"), spp=256),
    ExtremeCase("connection_1e8", "the first connection of each path weighs 1e8 times more than all others", speck,
                ("speck.bsdf.reflectance.value", "box.bsdf.reflectance.value", LAMP), Stock("ptracer"),
                image="ptracer", spp=256, options={"max_depth": 5}, residual=True),
    ExtremeCase("no_connection", "no light path connects to a sensor that looks away", away, (WALL, LAMP), Zero()),
    ExtremeCase("furnace", "a closed furnace, 16 bounces", lambda: grey(16).scene(), FURNACE,
                Exact(lambda: grey(16)), options={"max_depth": 16}, residual=True),
    ExtremeCase("furnace_roulette", "a closed furnace without a depth limit: roulette alone ends its paths",
                lambda: grey(-1).scene(), FURNACE, Exact(lambda: grey(-1)), spp=64, seeds=12,
                options={"max_depth": -1, "rr_depth": 5}, residual=True),
    ExtremeCase("furnace_1024", "a furnace of albedo 1, 1024 bounces", lambda: white(1024).scene(), FURNACE,
                Exact(lambda: white(1024)), spp=256, image="", options={"max_depth": 1024}, naive=False, residual=True),
    ExtremeCase("white_box_100", "a white box with an obstacle, 100 bounces: more than have a bit for visibility",
                white_box, ("box.bsdf.reflectance.value", "cube.bsdf.reflectance.value"), Stock("ptracer"),
                image="ptracer", options={"max_depth": 100, "hide_emitters": True}, residual=True),
    ExtremeCase("furnace_black", "a furnace of albedo 0, whose derivative is its first bounce",
                lambda: furnace_scene((0, 0, 0), (1, 2, 0.5), 8, 8).scene(), FURNACE,
                Exact(lambda: furnace_scene((0, 0, 0), (1, 2, 0.5), 8, 8)), options={"max_depth": 8}),
]  # fmt: skip
