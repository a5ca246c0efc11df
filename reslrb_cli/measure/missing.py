"""How much of a derivative attached gradients lack: silhouettes, edges of shadows, light that leaves the film.

Differences of the image at common random numbers have all of it. Along each of K directions, with F_k the difference
and g_k the attached gradient's,

    m_k = F_k - g_k,   share = sqrt(sum_k m_k^2 / sum_k F_k^2)

Each F_k is extrapolated to a step of 0 from steps h and 2 h (L. F. Richardson, 1911). What noise adds to the squares is
subtracted. The standard error is that of the mean over seeds; a third of a correction that stands out of its own noise
counts as error too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.measure.differences import Direction, choose_step
from reslrb_cli.measure.gradients import Case, seeds
from reslrb_cli.records.missing import NOTHING

#: Seeds that steps are chosen with, and the fewest that a share is made of.
PILOT_SEEDS, FEWEST = 2, 4


@dataclass
class Missing:
    """Samples of the derivatives of one parameter along its directions, seed by seed: (N, K) each."""

    directions: list[Direction]
    ours: list[np.ndarray] = field(default_factory=list)
    near: list[np.ndarray] = field(default_factory=list)
    far: list[np.ndarray] = field(default_factory=list)

    @staticmethod
    def of(case: Case, differenced: Any, directions: Sequence[Direction], spp: int) -> Missing:
        """With a step for each direction."""
        pilot = seeds(PILOT_SEEDS, 9)
        return Missing([choose_step(case, differenced, direction, pilot, spp) for direction in directions])

    def take(self, case: Case, tracer: Any, differenced: Any, seed: int, spp: int, step: Callable) -> None:
        """One more seed; `step` is the gradient step that knows dL/dI."""
        gradient = case.gradient(tracer, seed, spp, step=step)
        self.ours.append(np.array([gradient @ one.vector for one in self.directions]))
        for factor, taken in ((1, self.near), (2, self.far)):
            found = [
                case.difference(differenced, one.vector, seed, spp, factor * one.step, one.sides)
                for one in self.directions
            ]
            taken.append(np.array(found))

    @property
    def count(self) -> int:
        """Seeds so far."""
        return len(self.ours)

    def share(self) -> tuple[float, float] | None:
        """The share and its standard error; None where the differences are not told from 0."""
        ours, near, far = (np.stack(side) for side in (self.ours, self.near, self.far))
        correction = (near - far) / 3
        difference = near + correction
        missing, error = _mean(difference - ours)
        whole, whole_error = _mean(difference)
        corrected, noise = _mean(correction)
        left = np.where(np.abs(corrected) > NOTHING * noise, np.abs(corrected) / 3, 0)
        variance = np.square(error) + np.square(left)
        size = np.square(whole).sum() - np.square(whole_error).sum()
        if size <= NOTHING**2 * np.square(whole_error).sum():
            return None
        found = max(np.square(missing).sum() - np.square(error).sum(), 0.0)
        told = found > NOTHING**2 * variance.sum()
        # Along the missing part where there is one; else in any direction.
        spread = (np.square(missing) @ variance) / np.square(missing).sum() if told else variance.sum()
        return float(np.sqrt(found / size)), float(np.sqrt(spread / size))


def _mean(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (K,) of samples (N, K), and its standard error."""
    return samples.mean(0), samples.std(0, ddof=1) / np.sqrt(len(samples))
