"""Cases of the extreme suite: colours, films, light and losses at the ends of their ranges."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.measure.extreme.suite import IMAGE, Differences, ExtremeCase, Stock, exact
from reslrb_cli.measure.scenes.analytic import (
    DOWN,
    FURNACE,
    RADIANCE,
    KnownScene,
    furnace_scene,
    speck_in_view,
    texels_over_plane,
)
from reslrb_cli.measure.scenes.small import (
    bitmap,
    camera,
    diffuse,
    lamp,
    lit_square,
    look_at,
    pinhole,
    rectangle,
    rgb,
    room,
    texture,
    transform,
)

FLOOR = "floor.brdf_0.reflectance.data"
WALL = "wall.brdf_0.reflectance.value"
LAMP = "lamp.emitter.radiance.value"


def columns(*texels: tuple[float, ...]) -> dict:
    """A texture with the columns `texels` and two rows. Mitsuba needs at least two rows."""
    row = np.array(texels, float).reshape(1, len(texels), -1)
    return bitmap(np.repeat(row, 2, 0))


def matte(reflectance: Any) -> dict:
    """A diffuse two-sided BSDF."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def dark(value: float) -> dict:
    """The room, with one black or nearly black texel on the floor."""
    return room(floor=matte(columns((value, value, value), (0.6, 0.3, 0.5))))


def bright(value: float) -> dict:
    """The room, with a white or nearly white floor and wall."""
    return room(floor=matte(columns((value, value, value), (value, 0.3, value))), wall=matte(rgb(value, value, value)))


#: Roulette starts at the second vertex.
ROULETTE = {"max_depth": 5, "rr_depth": 2}

COLOURS_CASES = [
    ExtremeCase(
        "albedo_0_in_one_channel", "texels that are exactly 0 in one channel, so ds/s is 0/0",
        lambda: room(floor=matte(columns((0.5, 0.0, 0.4), (0.6, 0.3, 0.0)))), (FLOOR, WALL), Differences(0.05, "up")),
    ExtremeCase(
        "albedo_0", "texels that are exactly 0 in all channels: the throughput is 0, but its derivative is not",
        lambda: dark(0), (FLOOR, WALL), Differences(0.05, "up")),
    ExtremeCase(
        "albedo_0_roulette", "texels that are exactly 0, with Russian roulette on throughput alone",
        lambda: dark(0), (FLOOR, WALL), Differences(0.05, "up"), spp=256, seeds=12, options=ROULETTE),
    ExtremeCase(
        "albedo_1e-6", "texels of one millionth: the contribution behind them is tiny, but its derivative is not",
        lambda: dark(1e-6), (FLOOR, WALL), Stock("ptracer")),
    ExtremeCase(
        "albedo_1e-6_roulette", "texels of one millionth, with Russian roulette",
        lambda: dark(1e-6), (FLOOR, WALL), Stock("ptracer"), spp=256, seeds=12, options=ROULETTE),
    ExtremeCase(
        "albedo_1", "a floor and a wall that are exactly white", lambda: bright(1), (FLOOR, WALL), Stock("ptracer")),
    ExtremeCase(
        "albedo_1-1e-6", "a floor and a wall that are one millionth below white",
        lambda: bright(1 - 1e-6), (FLOOR, WALL), Stock("ptracer")),
    ExtremeCase(
        "pure_colours", "red light on a green floor and a blue wall: the image is black, but its derivative is not",
        lambda: room(floor=matte(columns((0, 0.8, 0), (0, 0.5, 0))), wall=matte(rgb(0, 0, 0.7)),
                     side=matte(rgb(0, 0.7, 0)), lamp=lamp(radiance=rgb(5, 0, 0))), (FLOOR, WALL, LAMP),
        Differences(0.05, "up")),
    ExtremeCase(
        "pure_colours_roulette", "products that are zero in different channels, with Russian roulette",
        lambda: room(floor=matte(columns((0.9, 0, 0), (0, 0.9, 0))), wall=matte(rgb(0, 0.8, 0.8)),
                     side=matte(rgb(0.8, 0, 0.8)), lamp=lamp(radiance=rgb(5, 5, 0))), (FLOOR, WALL, LAMP),
        Differences(0.05, "up"), spp=256, options=ROULETTE),
    ExtremeCase(
        "lamp_0", "a lamp of radiance 0: the image is black, but its derivative equals that of a white lamp",
        lambda: room(lamp=lamp(radiance=rgb(0, 0, 0))), (LAMP,), Differences(0.5, "up"), seeds=8),
]  # fmt: skip


def seen(camera: dict, **change: Any) -> dict:
    """The room with a floor texture of 2 x 2 texels, the minimum size in Mitsuba."""
    return room(camera=camera, floor=matte(texture(2, 2) | change))


def strip() -> dict:
    """A film of one column of 4096 pixels."""
    film = camera()["film"] | {"width": 1, "height": 4096}
    return seen(camera() | {"film": film, "fov": 0.2})


FILMS_CASES = [
    ExtremeCase("one_pixel", "a film of one pixel", lambda: seen(camera(size=1)), (FLOOR, LAMP), Stock("ptracer"),
                spp=8192),
    ExtremeCase("one_sample", "one light path for each of 256 pixels", lambda: seen(camera()), (FLOOR, LAMP),
                Stock("ptracer"), spp=1, seeds=64),
    ExtremeCase("one_texel", "one texel that covers all of the floor",
                lambda: seen(camera(), to_uv=transform(scale=0.4)), (FLOOR, LAMP), Stock("ptracer")),
    ExtremeCase("film_1x4096", "a film of one column of 4096 pixels", strip, (FLOOR, LAMP), Stock("ptracer"),
                spp=64),
    ExtremeCase("film_border", "a filter that reaches beyond the film's border, where samples are lost",
                lambda: seen(camera("gaussian", size=4)), (FLOOR, LAMP), Stock("ptracer"), image="ptracer", spp=1024),
    ExtremeCase("film_crop", "a crop window of 3 x 2 pixels, and a filter that reaches beyond its border",
                lambda: seen(camera("tent", crop_offset_x=6, crop_offset_y=12, crop_width=3, crop_height=2)),
                (FLOOR, LAMP), Stock("ptracer"), image="ptracer", spp=512),
]  # fmt: skip


def lit(scale: float) -> dict:
    """The room with the lamp's radiance multiplied by `scale`."""
    return room(lamp=lamp(radiance=rgb(3 * scale, 4 * scale, 5 * scale)))


def two_lamps() -> dict:
    dim = lamp(radiance=rgb(3e-25, 2e-25, 1e-25)) | {
        "to_world": transform(translate=[0.9, 0.8, 1.6], rotate=([1, 0.5, 0], 120), scale=0.4)}  # fmt: skip
    return room(lamp=lamp(radiance=rgb(1e25, 2e25, 3e25)), dim=dim)


def small_lamp(radiance: float) -> dict:
    """A lamp with sides of length 1e-4."""
    tiny = transform(translate=[0.2, 1.6, 0.2], rotate=([1, 0, 0], 90), scale=0.5e-4)
    return room(lamp=lamp(radiance=rgb(radiance, 2 * radiance, radiance)) | {"to_world": tiny})


def sun() -> dict:
    """A sky of 8 x 16 texels, one of which is a million times brighter than the others."""
    sky = np.random.default_rng(2).uniform(0.5, 1.5, (8, 16, 3)).astype(np.float32)
    sky[2, 5] = 1e6
    return room(lamp=None, sky={"type": "envmap", "bitmap": mi.Bitmap(sky)})


def skimming() -> dict:
    """Parallel light that meets the floor at half a degree from the floor's plane."""
    height = float(np.tan(np.deg2rad(0.5)))
    light = {"type": "directional", "direction": [-0.9, -height, -0.43], "irradiance": rgb(90, 80, 70)}
    return room(lamp=None, wall_shape=None, side_shape=None, light=light)


def speck() -> dict:
    """A hall lit by a beam that hits a speck. The speck is close to the camera, at 1e-4 of the walls' distance."""

    def facing(origin: list, target: list, half: float) -> Any:
        return look_at(origin, target, [0, 1, 0]) @ transform(scale=half)

    at = [0.01, 0.0, -0.05]
    return {
        "type": "scene",
        "camera": pinhole([0, 0, 0], [0, 0, -1], [0, 1, 0], 50),
        "box": {"type": "cube", "flip_normals": True, "to_world": transform(translate=[0, 0, -100], scale=500),
                "bsdf": diffuse(0.6, 0.7, 0.5)},
        "speck": rectangle(diffuse(0.5, 0.6, 0.8), facing(at, [0.01, 0, 1], 2e-3)),
        "lamp": lit_square(rgb(3, 2, 4), facing([20, 8, 15], at, 5e-4), "directionalarea"),
    }  # fmt: skip


def away() -> dict:
    """A camera that sees nothing."""
    return room(camera=camera() | {"to_world": look_at([1.2, 0.6, 4], [2.5, 1.4, 8], [0, 1, 0])})


def grey(max_depth: int, size: int = 8) -> KnownScene:
    """A furnace whose radiance converges."""
    return furnace_scene((0.5, 0.8, 0.9), (1, 2, 0.5), max_depth, size)


def white_box() -> dict:
    """A closed white box with a white cube. The camera does not see behind the cube."""
    view = look_at([0.8, 0.7, 0.8], [-0.2, -0.2, -0.2], [0, 1, 0])
    return {
        "type": "scene",
        "camera": camera(size=8) | {"to_world": view, "fov": 80},
        "box": {"type": "cube", "flip_normals": True, "bsdf": diffuse(1, 0.99, 1)},
        "cube": {"type": "cube", "bsdf": diffuse(1, 1, 0.98),
                 "to_world": transform(rotate=([1, 2, 3], 40), scale=0.35)},
        "lamp": lit_square(rgb(3, 4, 5), translate=[0.2, 0.99, 0.2], rotate=DOWN, scale=0.3)
        | {"bsdf": diffuse(0.9, 0.9, 0.9)},
    }  # fmt: skip


LIGHTS_CASES = [
    ExtremeCase("emission_1e-25", "a lamp of radiance 1e-25 under a fixed adjoint image", lambda: lit(1e-25),
                (WALL, LAMP), Stock("ptracer", lambda: lit(1), {WALL: 1e-25})),
    ExtremeCase("emission_1e-25_roulette", "a lamp of radiance 1e-25, with Russian roulette on throughput",
                lambda: lit(1e-25), (WALL, LAMP), Stock("ptracer", lambda: lit(1), {WALL: 1e-25}), spp=256,
                seeds=12, options=ROULETTE),
    ExtremeCase("emission_1e+25", "a lamp of radiance 1e+25 under a fixed adjoint image", lambda: lit(1e25),
                (WALL, LAMP), Stock("ptracer", lambda: lit(1), {WALL: 1e25})),
    ExtremeCase("emission_1e-25_and_1e+25", "lamps of radiance 1e-25 and 1e+25 in one scene", two_lamps,
                (WALL, LAMP, "dim.emitter.radiance.value"), Stock("ptracer"), spp=128),
    ExtremeCase("lamp_of_area_1e-8", "a lamp of side 1e-4 and radiance 4e8", lambda: small_lamp(4e8), (WALL, LAMP),
                Stock("ptracer")),
    ExtremeCase("lamp_of_area_1e-8_roulette", "a lamp of side 1e-4 and radiance 1, with Russian roulette",
                lambda: small_lamp(1), (WALL, LAMP), Stock("ptracer"), spp=256, seeds=12, options=ROULETTE),
    ExtremeCase("sun_1e6", "a sun of contrast 1e6 in an environment map", sun, ("sky.data", WALL), Stock("prb"),
                spp=256, seeds=12),
    ExtremeCase("grazing_light", "parallel light at half a degree over a floor", skimming,
                ("floor.brdf_0.reflectance.value", "light.irradiance.value"), Stock("ptracer"), spp=256),
    ExtremeCase("connection_1e8", "the first connection has 1e8 times the weight of all other connections", speck,
                ("speck.bsdf.reflectance.value", "box.bsdf.reflectance.value", LAMP), Stock("ptracer"),
                image="ptracer", spp=256, seeds=24, options={"max_depth": 5}),
    ExtremeCase("no_connection", "no light path connects, because the sensor looks away", away, (WALL, LAMP),
                Stock("ptracer"), open_ended=dict.fromkeys((WALL, LAMP), "no path reaches it")),
    exact("furnace", "a closed furnace, 16 bounces", lambda: grey(16), FURNACE, 16),
    exact("furnace_roulette", "a closed furnace without a depth limit: only Russian roulette ends the paths",
          lambda: grey(-1), FURNACE, -1, options={"max_depth": -1, "rr_depth": 5}, seeds=12),
    exact("furnace_1024", "a furnace of albedo 1, 1024 bounces",
          lambda: furnace_scene((1, 1, 1), (0.5, 1, 2), 1024, 4), FURNACE, 1024, spp=256, seeds=20, image="",
          naive=False),
    ExtremeCase("white_box_100", "a white box with an obstacle, and more bounces than bits for visibility",
                white_box, ("box.bsdf.reflectance.value", "cube.bsdf.reflectance.value"), Stock("ptracer"),
                seeds=12, options={"max_depth": 100, "hide_emitters": True}),
    exact("furnace_black", "a furnace of albedo 0: only the first bounce has a derivative",
          lambda: furnace_scene((0, 0, 0), (1, 2, 0.5), 8, 8), FURNACE, 8,
          open_ended={IMAGE: "a camera ray may slip between two triangles of a face"}),
]  # fmt: skip

LIT_FLOOR = "floor.brdf_0.reflectance.value"


def mixed(weights: np.ndarray) -> np.ndarray:
    """Weights for each channel and pixel, with either sign. The mean weight is not zero."""
    return weights * np.random.default_rng(4).choice([-1.0, 1.0], weights.shape, p=[0.35, 0.65]).astype(np.float32)


def spoilt(value: float) -> Any:
    """Weights with `value` in one channel of each of three pixels."""

    def spoil(weights: np.ndarray) -> np.ndarray:
        weights = weights.copy()
        for channel, (row, column) in enumerate(((5, 9), (8, 8), (11, 3))):
            weights[row, column, channel] = value
        return weights

    return spoil


def _sums(name: str, spp: int) -> ExtremeCase:
    """A furnace with a film of one pixel, so that all samples are added to the same few sums."""
    return exact(name, f"{spp:.0e} samples in one pixel, in single precision", lambda: grey(2, 1), FURNACE, 2, image="",
                 spp=spp, seeds=1, naive=False, equal=5e-3)  # fmt: skip


LOSSES_CASES = [
    ExtremeCase("negative_loss", "a loss with negative derivatives", room, (LIT_FLOOR, LAMP), Stock("ptracer"),
                weights=np.negative, signed=True),
    ExtremeCase("mixed_loss", "a loss whose derivatives have both signs, by channel and pixel", room, (LIT_FLOOR, LAMP),
                Stock("ptracer"), weights=mixed, signed=True, spp=256),
    ExtremeCase("nan_loss", "NaN in the loss's derivative is refused and counted", room, (LIT_FLOOR, LAMP),
                Stock("ptracer"), weights=spoilt(np.nan)),
    ExtremeCase("infinite_loss", "infinity in the loss's derivative is refused and counted", room, (LIT_FLOOR, LAMP),
                Stock("ptracer"), weights=spoilt(-np.inf)),
    _sums("sums_1e7", 10**7),
    _sums("sums_1e8", 10**8),
]  # fmt: skip

#: The parameters of `texels_over_plane`.
PLANE = "plane.bsdf.reflectance.value"
TEXELS = {"albedo": PLANE, "texels": f"{RADIANCE}.data"}


def spots() -> KnownScene:
    """A lamp with three bright texels and thirteen black ones."""
    texels = np.zeros((4, 4, 3))
    texels[0, 0], texels[1, 2], texels[2, 2] = (9, 8, 7), (3, 4, 5), (30, 20, 10)
    return texels_over_plane(texels)


#: Lamps that no sample finds, or one sample in a thousand.
UNFOUND_CASES = [
    exact("lamp_of_a_thousandth_of_a_pixel", "a visible lamp that one in a thousand primary rays hits",
          lambda: speck_in_view(side=0.0037, radiance=(300, 200, 400)), {"radiance": LAMP}, 1, image="ptracer",
          seeds=8),
    exact("black_texels", "a lamp with black texels, which are never sampled in proportion to radiance", spots,
          TEXELS, 2, spp=256),
    exact("black_lamp", "a lamp with only black texels, so no density is proportional to radiance",
          lambda: texels_over_plane(np.zeros((2, 2, 3))), TEXELS, 2, spp=256,
          open_ended={PLANE: "there is no light that it could reflect"}),
]  # fmt: skip
