"""Fit of a few parameters to photographs by differences of images, without reverse steps.

Gauss-Newton steps (Levenberg 1944) use derivatives J from differences of images. An image has two sets of samples, and
each product has one factor of either set, so noise does not bias it:

    L = 1/2 sum W r_a r_b,   g = 1/2 (J_a W r_b + J_b W r_a),   H = J_a W J_b
    x <- x - (H + d diag H)^-1 g

r is the residual, and W is d2L/dI2. All images of a fit have the same samples, so their losses are comparable. A step
is kept if L falls by more than the standard error of its fall, so a few bright pixels cannot carry it. Otherwise, it is
tried again with a larger d. Entries at a bound do not move outwards.

J needs an image for each parameter, and a step needs one. So J is measured again only if steps fail. Until then, it
follows the images of the steps (Broyden 1965): the part of a step's change that J does not explain is shared between
the parameters by their effects.

A roughness can have several local minima, because it moves light in the image. `scan_roughnesses` therefore renders
several values of each one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from reslrb_cli.optimization.assemble import set_values
from reslrb_cli.optimization.nonfinite import finite
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.uncertainty.candidates import LEAST_EIGENVALUE, changes_of
from reslrb_cli.optimization.uncertainty.curvature import (
    LossCurvature,
    ParameterChange,
    ParameterDirection,
    raise_eigenvalues,
)
from reslrb_cli.optimization.uncertainty.posterior import pseudo_inverse
from reslrb_cli.optimization.views import SHARED
from reslrb_cli.scene.catalog import COLOUR
from reslrb_cli.statistics import Array

#: Maximum numbers of measurements of J, of steps with one measurement, and of lengths that are tried for each step.
MOST_MEASURED, MOST_STEPS, MOST_TRIES = 4, 12, 5
#: First d, and the factor by which it falls after a step and rises after a refused one.
DAMPING, FACTOR = 1e-3, 10.0
#: Relative decrease of the loss by the steps of one measurement, below which the fit ends.
CONVERGED = 0.03
#: Largest logarithm of a factor in one step.
LONGEST = 0.7
#: Values of a roughness that are tried, as shares of the distance between its bounds.
TRIED = (0.08, 0.2, 0.4, 0.65, 0.9)


class ImageFit:
    """Derivatives and residuals of images at the values of `problem`, and steps from there.

    `x` (M,) has the coordinates of the directions: the value of an entry, or the factor of a whole texture. `J` (M, N)
    and `residuals` (N,) have one array for each set of samples. `is_complete` is false if `go_on` has ended the
    measurement.
    """

    def __init__(self, problem: Problem, spp: int, go_on: Callable[[], bool]) -> None:
        changes = changes_of(problem)
        self.known = LossCurvature(problem, spp, of_target=False)
        self.known.along(changes, go_on)
        self.directions = own = self.known.directions
        self.is_complete = len(self.directions) == sum(len(change.directions) for change in changes)
        self.start = {key: np.array(value, dtype=np.float64) for key, value in problem.values().items()}
        self.bounds = {key: problem.selection.specs[key].bounds or (-np.inf, np.inf) for key in self.start}
        self.x = np.array([1.0 if each.entry is None else self.start[each.key].ravel()[each.entry] for each in own])
        limits = [(0.0, np.inf) if each.entry is None else self.bounds[each.key] for each in own]
        self.low, self.high = np.array(limits).reshape(-1, 2).T
        self.J = self.known.derivatives
        self.residuals = residuals_of(self.known, self.known.images)

    def values(self, x: Array) -> dict[str, Array]:
        """Return the values at coordinates (M,)."""
        values = {key: value.copy() for key, value in self.start.items()}
        for each, at in zip(self.directions, x, strict=True):
            if each.entry is None:
                values[each.key][..., slice(None) if each.channel is None else each.channel] *= at
            else:
                values[each.key].reshape(-1)[each.entry] = at
        return {key: np.asarray(np.clip(value, *self.bounds[key])) for key, value in values.items()}

    @property
    def loss(self) -> float:
        return 0.5 * float(np.sum(self.known.weights * self.residuals[0] * self.residuals[1]))

    def step(self, damping: float) -> Array:
        """Return the coordinates (M,) after a step. Positive parameters without an upper bound change by a factor."""
        own, at, (a, b), (one, other) = self.directions, self.x, self.J, self.residuals
        is_factor = np.array([each.entry is not None for each in own]) & (at > 0) & np.isinf(self.high)
        unit, weighted = np.where(is_factor, at, 1.0), a * self.known.weights
        g = 0.5 * unit * (weighted @ other + b @ (self.known.weights * one))
        H = raise_eigenvalues(weighted, b, np.zeros((len(a), len(a))))[0] * np.outer(unit, unit)
        H += damping * np.diag(np.diag(H))
        free = np.diag(H) > 0
        while True:
            step = np.zeros(len(g))
            step[free] = -np.linalg.solve(H[np.ix_(free, free)], g[free])
            outwards = free & ((at <= self.low) & (step < 0) | (at >= self.high) & (step > 0))
            if not outwards.any():
                break
            free &= ~outwards
        step[is_factor] = np.clip(step[is_factor], -LONGEST, LONGEST)
        du = next((size for each, size in zip(own, step, strict=True) if each.key == SHARED), 0.0)
        new = at + step
        # The images hardly change if the exposure rises and all colours fall. A step is one of E and E c, as in
        # `block.py`.
        is_colour = np.array([bool(COLOUR.search(each.key)) for each in own])
        new[is_colour] = ((1 + du) * at + step)[is_colour] * np.exp(-du)
        new[is_factor] = at[is_factor] * np.exp(step[is_factor])
        return np.asarray(np.clip(new, self.low, self.high))

    def move(self, x: Array, residuals: tuple[Array, Array]) -> None:
        """Move to coordinates (M,) with these residuals, and let J follow."""
        change = x - self.x
        effect = np.abs(np.einsum("mn,n,mn->m", self.J[0], self.known.weights, self.J[1])) * change
        J = []
        for own, before, after in zip(self.J, self.residuals, residuals, strict=True):
            changes = own != 0  # not the channels on which a colour has no effect
            total = (changes * (effect * change)[:, None]).sum(axis=0)
            missing = after - before - change @ own
            J.append(own + changes * effect[:, None] * (missing / np.where(total > 0, total, np.inf)))
        self.x, self.residuals, self.J = x, residuals, (J[0], J[1])


def residuals_of(known: LossCurvature, images: Sequence[Sequence[Array]]) -> tuple[Array, Array]:
    """Return the differences (N,) of two sets of images and the targets."""
    trues = [view.kept(np.array(view.target, dtype=np.float64)) for view in known.problem.trained]
    one, other = (known.in_a_row([finite(image - true) for image, true in zip(own, trues, strict=True)])
                  for own in images)  # fmt: skip
    return one, other


def fall_of(weights: Array, before: tuple[Array, Array], after: tuple[Array, Array]) -> tuple[float, float]:
    """Return the fall of the loss between two pairs of residuals (N,), and its standard error."""
    falls = 0.5 * weights * (before[0] * before[1] - after[0] * after[1])
    return float(falls.sum()), float(np.sqrt(np.square(falls).sum()))


def fit_by_differences(problem: Problem, spp: int, go_on: Callable[[], bool]) -> tuple[Problem, bool]:
    """Return the problem with values that fit its targets, and whether the fit has ended before the time. Images have
    two sets of `spp` samples per pixel.
    """
    for _ in range(MOST_MEASURED):
        fit = ImageFit(problem, spp, go_on)
        if not fit.is_complete:
            return problem, False
        first, start, damping, tries = fit.loss, fit.residuals, DAMPING, 0
        for _ in range(MOST_STEPS):
            x = fit.step(damping)
            residuals = residuals_of(fit.known, fit.known.see_at(fit.values(x)))
            fall, error = fall_of(fit.known.weights, fit.residuals, residuals)
            is_kept = fall > error
            if is_kept:
                fit.move(x, residuals)
            damping, tries = (damping / FACTOR, 0) if is_kept else (damping * FACTOR, tries + 1)
            if tries == MOST_TRIES or not go_on() or (is_kept and fall < CONVERGED * fit.loss):
                break
        problem = set_values(problem, fit.values(fit.x))
        fall, _ = fall_of(fit.known.weights, start, fit.residuals)
        if fall <= CONVERGED * first or not go_on():
            break
    return problem, go_on()


def scan_roughnesses(
    problem: Problem, keys: Sequence[str], known: LossCurvature, go_on: Callable[[], bool]
) -> dict[str, float]:
    """Return the values of roughnesses that reduce the loss, out of `TRIED`. Others are left out.

    The parameters whose derivatives `known` has measured at the values of `problem` would follow. Effects of several
    roughnesses on the images are added. One roughness at a time changes, as long as the loss falls by more than the
    standard error of its fall.
    """
    changes = []
    for key in keys:
        array, (low, high) = problem.selection.array(key), problem.selection.specs[key].bounds or (0.0, 1.0)
        direction = ParameterDirection(key, np.ones(array.size))
        for share in TRIED:
            changes.append(ParameterChange({key: np.full_like(array, low + share * (high - low))}, 1.0, [direction]))
    images = LossCurvature(problem, known.spp, of_target=False)
    images.along(changes, go_on)
    if len(images.directions) < len(changes):
        return {}
    residuals = residuals_of(images, images.images)
    rows = (np.vstack(pair) for pair in zip(residuals, images.derivatives, strict=True))
    one, other = _beside(known, *rows)

    def residuals_at(chosen: Mapping[str, int]) -> tuple[Array, Array]:
        places = [0, *chosen.values()]
        return one[places].sum(axis=0), other[places].sum(axis=0)

    chosen: dict[str, int] = {}
    while True:
        before, falls = residuals_at(chosen), []
        for place, change in enumerate(changes, 1):
            [key] = change.values
            fall, error = fall_of(images.weights, before, residuals_at({**chosen, key: place}))
            falls.append((fall, error, key, place))
        fall, error, key, place = max(falls, default=(0.0, 0.0, "", 0))
        if not fall > error:
            return {key: float(changes[place - 1].values[key].ravel()[0]) for key, place in chosen.items()}
        chosen[key] = place


def _beside(known: LossCurvature, one: Array, other: Array) -> tuple[Array, Array]:
    """Return rows (K, N) of two sets of samples without the parts that the known directions can cause."""
    (a, b), weights = known.derivatives, known.weights
    if not len(a):
        return one, other
    H = (a * weights) @ b.T
    inverse = pseudo_inverse(0.5 * (H + H.T), LEAST_EIGENVALUE)
    return one - ((one * weights) @ b.T @ inverse) @ a, other - ((other * weights) @ a.T @ inverse) @ b
