"""Finite differences of the objective at common random numbers, along a few directions of one parameter.

The step h is chosen by a sweep. Central differences, and the one-sided ones of three nodes, are wrong by c h^2 + ...,
so that two steps tell the truncation error of the smaller one (L. F. Richardson, 1911),

    D(h) - F' ~ (D(r h) - D(h)) / (r^2 - 1),

while noise that grows as h shrinks, from paths that flip, shows in how much D(r h) - D(h) varies between seeds. Where
light is moved, rounding can be the same for all seeds, for it is the scene that is rounded: a change that does not
shrink with h is no truncation, and counts in full. The step with the least sum is taken, and its error comes with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from reslrb_cli.measure.gradients import Case
from reslrb_cli.measure.moving import smooth_rows

#: Steps that are tried, in units of the direction.
STEPS = (0.1, 0.01, 0.001)
#: How many seeds the comparison may have, by which the noise of a single one is judged.
PLANNED_SEEDS = 16


@dataclass(frozen=True)
class Direction:
    """A direction in the space of all parameters (P,), whose entries are in the parameters' own units.

    `sides` are as in `Case.difference`; `step` is in units of `vector`, `truncation` the error that it brings, a bound
    on its absolute value, in units of the difference.
    """

    vector: np.ndarray
    sides: str
    step: float = STEPS[0]
    truncation: float = 0.0

    def difference(self, case: Case, integrator: Any, seed: int, spp: int) -> float:
        """The objective's derivative along the direction."""
        return case.difference(integrator, self.vector, seed, spp, self.step, self.sides)


def directions(case: Case, key: str, bounds: tuple[float, float], count: int, seed: int = 3) -> list[Direction]:
    """Up to `count` directions along which the parameter `key` alone changes, and can without leaving its `bounds`.

    All entries of the first grow, so that nothing cancels; in the others signs are random. Where some entry is too near
    to a bound for the largest step, differences are one-sided, and every entry moves away from the bound it is nearer
    to. Entries are 0.5 to 1 of the width of the bounds, or of the parameter's own size where these are infinite.
    """
    random, found = np.random.default_rng(seed), []
    values, (low, high) = case.initial[key], bounds
    scale = high - low if np.isfinite(high - low) else float(np.sqrt(np.mean(values**2))) or 1.0
    reach = STEPS[0] * scale
    near_a_bound = bool(np.any(values - reach < low) or np.any(values + reach > high))
    inward = np.where(high - values >= values - low, 1.0, -1.0)
    for number in range(min(count, len(values))):
        size = scale * random.uniform(0.5, 1.0, len(values))
        signs = np.ones(len(values)) if number == 0 else random.choice([-1.0, 1.0], len(values))
        row = size * (inward if near_a_bound else signs)
        found.append(Direction(_embed(case, key, row), "up" if near_a_bound else "both"))
    return found


def moving_directions(case: Case, key: str, extent: float, count: int) -> list[Direction]:
    """Directions along which a parameter that moves light changes smoothly (`moving.smooth_rows`)."""
    rows = smooth_rows(key, case.values.value(key), extent, count)
    return [Direction(_embed(case, key, row), "both") for row in rows]


def choose_step(case: Case, integrator: Any, direction: Direction, seeds: Sequence[int], spp: int) -> Direction:
    """The same direction with the step of the least error, estimated from differences at these seeds, two at least."""
    samples = {
        step: np.array([replace(direction, step=step).difference(case, integrator, seed, spp) for seed in seeds])
        for step in STEPS
    }
    best, least, before = direction, np.inf, np.inf
    for larger, smaller in pairwise(STEPS):
        change = samples[larger] - samples[smaller]
        spread = float(change.std(ddof=1))
        changed = abs(float(change.mean())) + spread / np.sqrt(len(seeds))
        # Kinks make errors that shrink as h does, no slower.
        truncation = changed / ((larger / smaller) ** 2 - 1) if changed <= before * smaller / larger else changed
        before = changed
        error = truncation + spread / np.sqrt(PLANNED_SEEDS)
        if error < least:
            best, least = replace(direction, step=smaller, truncation=truncation), error
    return best


def natural_bounds(kind: str, values: np.ndarray) -> tuple[float, float]:
    """What a parameter of this kind (`ParameterInfo.kind`) may be: 0 to 1 for what a BSDF has, where it is so now."""
    if kind != "emitter" and np.all((values >= 0) & (values <= 1)):
        return 0.0, 1.0
    return (0.0, np.inf) if np.all(values >= 0) else (-np.inf, np.inf)


def _embed(case: Case, key: str, row: np.ndarray) -> np.ndarray:
    """A row of one parameter among zeros for the others."""
    return np.concatenate([row if other == key else np.zeros(len(v)) for other, v in case.initial.items()])
