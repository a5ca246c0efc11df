"""Parameters that move light, as a gradient check needs them: which do, by what, and how smoothly."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.scene.catalog import parameter_kind

#: How far the largest step of finite differences moves things, relative to their size, in units of the step.
REACH = 0.1
#: The same of a heightmap, relative to the scene's size.
RELIEF = 0.02
#: The same of what makes up a motion: a turn is in degrees; None stands for `REACH` of the scene's size.
UNITS = {"translation": None, "rotation": 10.0, "scale": REACH}
#: Waves that have room in what is displaced, at most.
WAVES = 1.5


def moves_light(params: mi.SceneParameters, key: str) -> bool:
    """Whether a parameter moves what light meets or leaves from.

    What the scene itself does not have is a function of such: a motion, or a heightmap.
    """
    if key not in params.properties:
        return True
    kind = parameter_kind(params, key)
    return kind == "shape" or (kind == "emitter" and key.rpartition(".")[2] in ("position", "to_world"))


def smooth_weights(height: int, width: int, channels: int = 3) -> np.ndarray:
    """A smooth dL/dI of mean 1 that vanishes at the film's border: light that lands beyond says nothing.

    Finite differences of what moves over the film need it: within each pixel of noise they would have to be small.
    """
    y, x = (np.mgrid[0:height, 0:width] + 0.5) / np.array([height, width]).reshape(2, 1, 1)
    value = np.stack([np.sin(5 * x) * np.cos(4 * y) + 1.5, np.cos(3 * x + 2 * y) + 1.2, x + y], -1)[:, :, :channels]
    inside = np.clip((np.minimum.reduce([x, 1 - x, y, 1 - y]) - 0.08) / 0.2, 0, 1)
    value *= (inside**2 * (3 - 2 * inside))[:, :, None]
    return np.asarray(value / value.mean())


def smooth_rows(key: str, value: Any, extent: float, count: int, seed: int = 3) -> list[np.ndarray]:
    """Directions in which a parameter moves smoothly, each a row, in units of which a fraction is a step.

    Vertices are displaced by waves in all directions, a heightmap by waves over its texels; of what is not so many
    numbers (a position, a rotation) each is moved. `extent` is the scene's size.
    """
    random, found, name = np.random.default_rng(seed), [], key.rpartition(".")[2]
    shape = np.shape(value)
    for _ in range(count):
        if name == "vertex_positions":
            points = np.array(value, float).reshape(-1, 3)
            size = float(np.linalg.norm(np.ptp(points, axis=0)))
            wave = _waves(points / (size or 1.0), random)
            towards = random.normal(size=3)
            row = REACH * size * wave[:, None] * towards / np.linalg.norm(towards)
        elif name not in UNITS and len(shape) >= 2:
            grid = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape[:2]), indexing="ij"), -1)
            wave = _waves(grid.reshape(-1, 2), random).reshape(shape[:2])
            row = RELIEF * extent * np.broadcast_to(wave.reshape(*shape[:2], *(1 for _ in shape[2:])), shape)
        else:
            unit = UNITS.get(name) or REACH * extent
            row = unit * random.uniform(0.5, 1, shape) * random.choice([-1.0, 1.0], shape)
        found.append(np.ravel(row))
    return found


def _waves(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A wave (N,) over points (N, D) of about unit extent."""
    wave = random.normal(size=points.shape[1])
    wave *= random.uniform(0.5, 1) * WAVES * 2 * np.pi / np.linalg.norm(wave)
    return np.asarray(np.cos(points @ wave + random.uniform(0, 2 * np.pi)))
