"""How much of a derivative attached gradients lack: silhouettes, edges of shadows, light that leaves the film.

Differences of the image at common random numbers have all of it. Along each of K directions, with F_k the difference
and g_k the attached gradient's,

    m_k = F_k - g_k,   share = sqrt(sum_k m_k^2 / sum_k F_k^2)

D(h), the difference by a step h, is wrong by c h^2 + ..., which two steps cancel (L. F. Richardson, 1911):

    E(h) = (4 D(h) - D(2 h)) / 3

Of steps that halve, the one is taken around which E changes least: at larger ones E is truncated, at smaller ones it is
lost in rounding, which is the same for all seeds where it is the scene that is rounded, or in paths that flip. By how
much E changes there counts as error where it stands out of its noise. What noise adds to the squares is subtracted; the
standard error is that of the mean over seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from reslrb_cli.measure.differences import STEPS, Direction
from reslrb_cli.measure.gradients import Case, seeds
from reslrb_cli.records.missing import NOTHING

#: Seeds that steps are chosen with, and the fewest that a share is made of.
PILOT_SEEDS, FEWEST = 4, 4
#: How often the largest step is halved.
HALVINGS = 8


@dataclass
class Missing:
    """Samples of the derivatives of one parameter along K directions: `ours` N times (K,), `differences` (3, K).

    Of the differences the first are by the step of the direction, the others by twice and four times that.
    """

    directions: list[Direction]
    ours: list[np.ndarray] = field(default_factory=list)
    differences: list[np.ndarray] = field(default_factory=list)

    @staticmethod
    def of(case: Case, differenced: Any, directions: Sequence[Direction], spp: int) -> Missing:
        """With a step for each direction."""
        return Missing([_with_step(case, differenced, direction, spp) for direction in directions])

    def take(self, case: Case, tracer: Any, differenced: Any, seed: int, spp: int, step: Callable) -> None:
        """One more seed; `step` is the gradient step that knows dL/dI."""
        gradient = case.gradient(tracer, seed, spp, step=step)
        self.ours.append(np.array([gradient @ one.vector for one in self.directions]))
        found = [
            [_difference(case, differenced, one, factor * one.step, seed, spp) for one in self.directions]
            for factor in (1, 2, 4)
        ]
        self.differences.append(np.array(found))

    @property
    def count(self) -> int:
        """Seeds so far."""
        return len(self.ours)

    def share(self) -> tuple[float, float] | None:
        """The share and its standard error; None where the differences are not told from 0."""
        near, far, farthest = np.stack(self.differences, 1)
        whole = _extrapolate(near, far)
        missing = whole - np.stack(self.ours)
        change, noise = _mean(whole - _extrapolate(far, farthest))
        left = np.square(np.where(np.abs(change) > NOTHING * noise, change, 0))
        mean, error = _mean(whole)
        size = np.square(mean).sum() - np.square(error).sum()
        if size <= NOTHING**2 * np.square(error).sum():
            return None
        part, error = _mean(missing)
        found = _ratio(missing, whole)
        if np.square(part).sum() <= NOTHING**2 * (np.square(error) + left).sum():
            return found, float(np.sqrt((np.square(error) + left).sum() / size))
        # The part's own noise and that of the whole: by leaving out one seed after the other (jackknife).
        without = [_ratio(np.delete(missing, i, 0), np.delete(whole, i, 0)) for i in range(self.count)]
        variance = (self.count - 1) * np.var(without)
        truncation = (np.square(part) @ left) / np.square(part).sum() / size
        return found, float(np.sqrt(variance + truncation))


def _ratio(missing: np.ndarray, whole: np.ndarray) -> float:
    """Root of the mean square of (N, K) samples of the part over that of the whole, without what noise adds."""
    squares = [np.square(mean).sum() - np.square(error).sum() for mean, error in (_mean(missing), _mean(whole))]
    return float(np.sqrt(max(squares[0], 0.0) / squares[1]))


def _with_step(case: Case, differenced: Any, direction: Direction, spp: int) -> Direction:
    steps = [STEPS[0] / 2**number for number in range(HALVINGS)]
    pilot = seeds(PILOT_SEEDS, 9)
    found = np.array([[_difference(case, differenced, direction, step, seed, spp) for seed in pilot] for step in steps])
    extrapolated = _extrapolate(found[1:], found[:-1])
    change, noise = _mean(np.diff(extrapolated, axis=0).T)
    # From step to step; one that agrees with both its neighbours is no coincidence.
    changed = np.abs(change) + noise
    return replace(direction, step=steps[2 + int(np.argmin(changed[:-1] + changed[1:]))])


def _difference(case: Case, differenced: Any, direction: Direction, step: float, seed: int, spp: int) -> float:
    return case.difference(differenced, direction.vector, seed, spp, step, direction.sides)


def _extrapolate(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    return np.asarray(near + (near - far) / 3)


def _mean(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (K,) of samples (N, K), and its standard error."""
    return samples.mean(0), samples.std(0, ddof=1) / np.sqrt(len(samples))
