"""Scenes whose parameters move light (`attached`), and their comparison with finite differences (`Differenced`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.measure.gradients import integrator, seeds
from reslrb_cli.measure.scenes.case import Differences, Moves, SceneCase
from reslrb_cli.measure.scenes.catalogue import moved
from reslrb_cli.measure.scenes.moving import AMPLITUDES

#: Width and height of a film in pixels.
SIZE = 32

#: Seeds at which differences of twice the step measure truncation: one in this many, and at least this many.
ONE_IN, EXTRAPOLATED = 4, 3


def attached(name: str, about: str, scene: Callable[[], dict], moves: Moves, step: float = 0.01, **more: Any
             ) -> SceneCase:  # fmt: skip
    """Return a case whose parameters move light. The first amplitude of `moves` is the most informative.

    Finite differences hold. Moved paths meet no silhouettes, shadow edges or edges at rest, and dL/dI is smooth and
    vanishes at the film's border. To reduce noise, increase `seeds` and not `spp`. From 1000 samples per pixel on,
    single-precision rounding in image sums affects their differences.
    """
    return moved(name, about, scene, step, moves, depth=4, **more)


@dataclass(frozen=True)
class Differenced:
    """Derivatives of the objective along K amplitudes at N seeds (N, K), from our estimator and from finite
    differences.

    `differences` are central differences. `correction` (M, K) is added by Richardson's extrapolation to a step of 0, at
    the first M seeds. The other values are relative to the root mean square of the reference. `error` is the largest
    deviation of the means, `standard_error` the largest standard error of these deviations, and `truncation` the
    largest correction.
    """

    ours: np.ndarray
    differences: np.ndarray
    correction: np.ndarray

    @property
    def reference(self) -> np.ndarray:
        """Extrapolated means of the differences (K,)."""
        mean: np.ndarray = self.differences.mean(0) + self.correction.mean(0)
        return mean

    @property
    def scale(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.reference))))

    @property
    def errors(self) -> np.ndarray:
        """Signed error of each amplitude (K,), relative to `scale`."""
        errors: np.ndarray = (self.ours.mean(0) - self.reference) / self.scale
        return errors

    @property
    def error(self) -> float:
        return float(np.abs(self.errors).max())

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard error of each amplitude (K,), relative to `scale`."""
        sides = self.ours - self.differences, self.correction
        variance = sum(side.var(0, ddof=1) / len(side) for side in sides)
        errors: np.ndarray = np.sqrt(variance) / self.scale
        return errors

    @property
    def standard_error(self) -> float:
        return float(self.standard_errors.max())

    @property
    def truncation(self) -> float:
        return float(np.abs(self.correction.mean(0)).max() / self.scale)

    def __str__(self) -> str:
        return (
            f"largest deviation {self.error:.2%} of the root mean square, standard error {self.standard_error:.2%}, "
            f"truncation {self.truncation:.2%}"
        )


def compare_with_differences(scene: SceneCase, estimator: str = "stack", count: int | None = None) -> Differenced:
    """Differentiate a scene with an estimator, and with finite differences of its image at the same random numbers.
    Return both.
    """
    assert isinstance(scene.source, Differences)
    case, step = scene.setup(), scene.source.step
    tracer = integrator("reslrb", **scene.options, estimator=estimator)
    chosen = seeds(count or scene.seeds)
    ours = case.gradients(tracer, chosen, scene.spp)
    directions = np.eye(len(case.initial[AMPLITUDES]))
    near = case.differences(tracer, directions, chosen, scene.spp, step)
    few = chosen[: max(len(chosen) // ONE_IN, EXTRAPOLATED)]
    far = case.differences(tracer, directions, few, scene.spp, 2 * step)
    return Differenced(ours, near, (near[: len(few)] - far) / 3)
