"""Colours at the ends of their range: albedos of 0 and 1, pure light on pure walls."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.extreme.case import Differences, ExtremeCase, Stock
from reslrb_cli.measure.small_scenes import bitmap, lamp, rgb, room

FLOOR = "floor.brdf_0.reflectance.data"
WALL = "wall.brdf_0.reflectance.value"
LAMP = "lamp.emitter.radiance.value"


def columns(*texels: tuple[float, ...]) -> dict:
    """A texture of these columns, two rows high, which is the least that Mitsuba takes."""
    row = np.array(texels, float).reshape(1, len(texels), -1)
    return bitmap(np.repeat(row, 2, 0))


def matte(reflectance: Any) -> dict:
    """Diffuse on both sides."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


CASES = [
    ExtremeCase(
        "albedo_0_in_one_channel", "texels that are exactly 0 in one channel: ds/s is 0/0 there",
        lambda: room(floor=matte(columns((0.5, 0.0, 0.4), (0.6, 0.3, 0.0)))), (FLOOR, WALL), Differences(0.05, "up")),
    ExtremeCase(
        "albedo_0", "texels that are exactly 0 in all channels: throughput ends there, its derivative does not",
        lambda: room(floor=matte(columns((0, 0, 0), (0.6, 0.3, 0.5)))), (FLOOR, WALL), Differences(0.05, "up")),
    ExtremeCase(
        "albedo_0_roulette", "the same with Russian roulette, which knows throughput alone",
        lambda: room(floor=matte(columns((0, 0, 0), (0.6, 0.3, 0.5)))), (FLOOR, WALL), Differences(0.05, "up"),
        spp=256, options={"max_depth": 5, "rr_depth": 2}),
    ExtremeCase(
        "albedo_1e-6", "texels a millionth above 0: what lies behind weighs a millionth, its derivative does not",
        lambda: room(floor=matte(columns((1e-6, 1e-6, 1e-6), (0.6, 0.3, 0.5)))), (FLOOR, WALL), Stock("ptracer")),
    ExtremeCase(
        "albedo_1e-6_roulette", "the same with Russian roulette",
        lambda: room(floor=matte(columns((1e-6, 1e-6, 1e-6), (0.6, 0.3, 0.5)))), (FLOOR, WALL), Stock("ptracer"),
        spp=256, options={"max_depth": 5, "rr_depth": 2}),
    ExtremeCase(
        "albedo_1", "a floor and a wall that are exactly white",
        lambda: room(floor=matte(columns((1, 1, 1), (1, 0.3, 1))), wall=matte(rgb(1, 1, 1))), (FLOOR, WALL),
        Stock("ptracer")),
    ExtremeCase(
        "albedo_1-1e-6", "the same a millionth below 1",
        lambda: room(floor=matte(columns((1 - 1e-6, 1 - 1e-6, 1 - 1e-6), (1 - 1e-6, 0.3, 1 - 1e-6))),
                     wall=matte(rgb(1 - 1e-6, 1 - 1e-6, 1 - 1e-6))), (FLOOR, WALL), Stock("ptracer")),
    ExtremeCase(
        "pure_colours", "red light on a green floor and a blue wall: the image is black, the derivative is not",
        lambda: room(floor=matte(columns((0, 0.8, 0), (0, 0.5, 0))), wall=matte(rgb(0, 0, 0.7)),
                     side=matte(rgb(0, 0.7, 0)), lamp=lamp(radiance=rgb(5, 0, 0))), (FLOOR, WALL, LAMP),
        Differences(0.05, "up")),
    ExtremeCase(
        "pure_colours_roulette", "each product is zero in a channel of its own, and roulette goes by the others",
        lambda: room(floor=matte(columns((0.9, 0, 0), (0, 0.9, 0))), wall=matte(rgb(0, 0.8, 0.8)),
                     side=matte(rgb(0.8, 0, 0.8)), lamp=lamp(radiance=rgb(5, 5, 0))), (FLOOR, WALL, LAMP),
        Differences(0.05, "up"), spp=256, options={"max_depth": 5, "rr_depth": 2}),
    ExtremeCase(
        "lamp_0", "a lamp of radiance 0: a black image, whose derivative is that of a white lamp",
        lambda: room(lamp=lamp(radiance=rgb(0, 0, 0))), (LAMP,), Differences(0.5, "up")),
]  # fmt: skip
