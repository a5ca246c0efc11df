"""Films and textures of other sizes, for a measurement."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any

import mitsuba as mi

from reslrb_cli.config import Config
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.problem import Problem


def shrink(scene: Any, sensor: int, pixels: int) -> None:
    """Make the film of a sensor, given by its index, no larger than about so many pixels; its view stays the same.

    A crop window shrinks with it.
    """
    width, height = (int(n) for n in scene.sensors()[sensor].film().size())
    factor = (pixels / (width * height)) ** 0.5
    if factor < 1:
        scale(scene, sensor, factor)


def widen(scene: Any, sensor: int, width: int) -> None:
    """Make the part of a sensor's film that is rendered about so many pixels wide; its view stays the same."""
    scale(scene, sensor, width / int(scene.sensors()[sensor].film().crop_size()[0]))


def scale(scene: Any, sensor: int, factor: float) -> None:
    """Make the film of a sensor, given by its index, so many times as wide and as high, its crop window with it."""
    params = mi.traverse(scene.sensors()[sensor])

    def scaled(name: str, least: int) -> list[int]:
        return [max(round(n * factor), least) for n in params[name]]

    size, offset = scaled("film.size", 1), scaled("film.crop_offset", 0)
    offset = [min(o, n - 1) for o, n in zip(offset, size, strict=True)]
    window = [min(w, n - o) for w, n, o in zip(scaled("film.crop_size", 1), size, offset, strict=True)]
    for name, value in (("film.size", size), ("film.crop_size", window), ("film.crop_offset", offset)):
        params[name] = type(params[name])(*value)
    params.update()


def with_textures(problem: Problem, width: int) -> Config:
    """The experiment of `problem` with textures, and heightmaps, that wide, as high as their shapes ask for.

    What several keys share keeps its size. Raises ConfigError where there is no texture to be resampled.
    """
    parameters, found = [], False
    for spec in problem.config.parameters:
        shape = None if len(spec.keys) > 1 else _shape_of(spec, problem)
        if shape is not None:
            found = True
            size = (width, max(round(width * shape[0] / shape[1]), 1))
            if spec.heightmap is None:
                changes: dict[str, Any] = {"resolution": size}
            else:
                changes = {"heightmap": spec.heightmap.model_copy(update={"resolution": size})}
            parameters.append(spec.model_copy(update=changes))
        else:
            parameters.append(spec)
    if not found:
        raise ConfigError("--sweep", "", "texture: none of the parameters is a texture that can be resampled")
    return problem.config.model_copy(update={"parameters": parameters})


def _shape_of(spec: ParameterSpec, problem: Problem) -> tuple[int, ...] | None:
    """The shape of the first texture that a parameter of the configuration names, alone or by a glob."""
    for key, shape in texture_shapes(problem).items():
        if any(name == key or fnmatchcase(key, name) for name in spec.names):
            return shape
    return None


def texture_shapes(problem: Problem) -> dict[str, tuple[int, ...]]:
    """Shapes (H, W, C) of the parameters that are textures or heightmaps, by key."""
    shapes = {key: problem.selection.array(key).shape for key in problem.selection.keys}
    return {key: shape for key, shape in shapes.items() if len(shape) == 3}
