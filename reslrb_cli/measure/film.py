"""Films made smaller for a measurement."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


def shrink(scene: Any, sensor: int, pixels: int) -> None:
    """Make the film of a sensor, given by its index, no larger than about so many pixels; its view stays the same.

    A crop window shrinks with it.
    """
    target = scene.sensors()[sensor]
    width, height = (int(n) for n in target.film().size())
    factor = (pixels / (width * height)) ** 0.5
    if factor >= 1:
        return
    params = mi.traverse(target)

    def scaled(name: str, least: int) -> list[int]:
        return [max(round(n * factor), least) for n in params[name]]

    size, offset = scaled("film.size", 1), scaled("film.crop_offset", 0)
    offset = [min(o, n - 1) for o, n in zip(offset, size, strict=True)]
    window = [min(w, n - o) for w, n, o in zip(scaled("film.crop_size", 1), size, offset, strict=True)]
    for name, value in (("film.size", size), ("film.crop_size", window), ("film.crop_offset", offset)):
        params[name] = type(params[name])(*value)
    params.update()
