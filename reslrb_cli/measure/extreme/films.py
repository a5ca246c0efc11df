"""Films and textures of the least size, borders and crops."""

from __future__ import annotations

from typing import Any

from reslrb_cli.measure.extreme.case import ExtremeCase, Stock
from reslrb_cli.measure.small_scenes import camera, room, texture, transform

FLOOR = "floor.brdf_0.reflectance.data"
LAMP = "lamp.emitter.radiance.value"


def seen(camera: dict, **change: Any) -> dict:
    """The room with a texture on its floor, of 2 x 2 texels, the least that Mitsuba takes."""
    return room(camera=camera, floor={"type": "twosided", "bsdf": {
        "type": "diffuse", "reflectance": texture(2, 2) | change}})  # fmt: skip


def one_texel() -> dict:
    return seen(camera(), to_uv=transform(scale=0.4))


def strip() -> dict:
    """A film of one column of 4096 pixels."""
    film = camera()["film"] | {"width": 1, "height": 4096}
    return seen(camera() | {"film": film, "fov": 0.2})


def cropped(**film: Any) -> dict:
    return seen(camera("tent", **film))


CASES = [
    ExtremeCase("one_pixel", "a film of one pixel", lambda: seen(camera(size=1)), (FLOOR, LAMP), Stock("ptracer"),
                spp=8192),
    ExtremeCase("one_sample", "one light path for each of 256 pixels", lambda: seen(camera()), (FLOOR, LAMP),
                Stock("ptracer"), spp=1, seeds=160),
    ExtremeCase("one_texel", "one texel that covers all of the floor", one_texel, (FLOOR, LAMP), Stock("ptracer")),
    ExtremeCase("film_1x4096", "a film of one column of 4096 pixels", strip, (FLOOR, LAMP), Stock("ptracer"),
                spp=64),
    ExtremeCase("film_border", "a filter that reaches over the film's border, where samples are lost",
                lambda: seen(camera("gaussian", size=4)), (FLOOR, LAMP), Stock("ptracer"), image="ptracer", spp=1024),
    ExtremeCase("film_crop", "a crop window of 3 x 2 pixels, and a filter that reaches over its border",
                lambda: cropped(crop_offset_x=6, crop_offset_y=12, crop_width=3, crop_height=2), (FLOOR, LAMP),
                Stock("ptracer"), image="ptracer", spp=512),
]  # fmt: skip
