"""Directions in which images are differentiated: entries of small parameters, and textures brightened as a whole."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]

#: A parameter of at most so many entries is looked at entry by entry.
MOST_ENTRIES = 4
#: Parts of keys of what mixes channels: a number is read out of such textures.
MIXING = ("alpha", "roughness", "weight", "opacity", "normalmap", "bump", "metallic", "anisotropic")


@dataclass(frozen=True)
class Direction:
    """One coordinate: `vector`, in the layout of a gradient in a row, is what a unit of it adds to the parameter `key`.

    `channel` is the only channel of images that it changes, or None. `scale` is the size of the coordinate. `entry` is
    that of a small parameter; None where all of a texture's channel change together, in proportion to what they are.
    """

    key: str
    vector: Array
    scale: float
    channel: int | None = None
    entry: int | None = None


@dataclass(frozen=True)
class Change:
    """A rendering of `values` (by key, as `Selection.array` has them), `amount` of each of these directions away."""

    values: dict[str, Array]
    amount: float
    directions: list[Direction]


def row_of(problem: Problem, key: str) -> Array:
    """A parameter's value in a row, as its gradient is (`samples.take_gradient`), an environment map's halo in it."""
    return np.array(dr.detach(problem.optimizer[key]), dtype=np.float64).ravel()


def separates(problem: Problem, key: str) -> bool:
    """Whether each channel of a parameter changes that channel of images alone, as colours do where there are three."""
    if not mi.is_rgb or any(view.target.shape[2] != 3 for view in problem.trained):
        return False
    if any(part in MIXING for part in key.replace("_", ".").split(".")):
        return False
    array = problem.selection.array(key)
    if array.ndim == 3:
        return array.shape[2] == 3 and not problem.selection.quantity(key)
    return isinstance(problem.optimizer[key], mi.Color3f)


def plan_changes(problem: Problem, scales: Mapping[str, float], share: float, most: int) -> list[Change]:
    """The renderings that the directions of all parameters take, `share` of the scale away, small parameters first.

    At most `most` of them: parameters that are left have no directions.
    """
    small = [key for key in problem.selection.keys if problem.selection.array(key).size <= MOST_ENTRIES]
    textures = [key for key in problem.selection.keys if problem.selection.array(key).ndim == 3]
    changes: list[Change] = []
    for key in (*small, *(key for key in textures if key not in small)):
        made = _entries(problem, key, scales[key], share) if key in small else _wholes(problem, key, share)
        if len(changes) + len(made) <= most:
            changes += made
    return changes


def _entries(problem: Problem, key: str, scale: float, share: float) -> list[Change]:
    row, array = row_of(problem, key), problem.selection.array(key)
    directions = [
        Direction(key, unit, scale, channel if separates(problem, key) else None, channel)
        for channel, unit in enumerate(np.eye(row.size))
    ]
    groups = [directions] if separates(problem, key) else [[direction] for direction in directions]
    low, high = problem.selection.spec(key).bounds or (-np.inf, np.inf)
    changes = []
    for group in groups:
        step = sum(direction.vector for direction in group) * scale * share
        up = _within(row + step, low, high)
        side = 1.0 if up >= _within(row - step, low, high) else -1.0
        moved = (row + side * step).reshape(array.shape)
        changes.append(Change({key: moved}, side * scale * share, group))
    return changes


def _wholes(problem: Problem, key: str, share: float) -> list[Change]:
    array, row = problem.selection.array(key), row_of(problem, key)
    channels = array.shape[2]
    if not np.any(row) or (channels > 1 and not separates(problem, key)):
        return []
    # Darker, so that no bound is passed but by what is negative.
    values = {key: array * (1 - share)}
    of = [np.where(np.arange(row.size) % channels == channel, row, 0.0) for channel in range(channels)]
    single = channels == 1
    return [
        Change(values, -share, [Direction(key, v, 1.0, None if single else c) for c, v in enumerate(of) if v.any()])
    ]


def _within(moved: Array, low: float, high: float) -> int:
    """How many entries are within the bounds."""
    return int(np.sum((moved >= low) & (moved <= high)))


def units(directions: Iterable[Direction], gradients: Mapping[str, Array]) -> Array:
    """Derivatives along directions (M, ...) of gradients by key (..., N)."""
    return np.array([gradients[direction.key] @ direction.vector for direction in directions])
