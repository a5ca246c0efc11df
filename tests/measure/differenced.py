"""Scenes whose parameters move light (`AttachedScene`), and what finite differences find there (`Differenced`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.scenes.moving import AMPLITUDES, Move, moving_case

#: Pixels of a film, each way.
SIZE = 32

#: At how many seeds truncation is measured, by differences of twice the step: one in so many, and at least that many.
ONE_IN, EXTRAPOLATED = 4, 3


@dataclass(frozen=True)
class AttachedScene:
    """One scene. `scene` and `moves` are functions, since they need Mitsuba; the first of the amplitudes says most.

    Finite differences hold: no silhouette, no edge of a shadow and no edge at rest that moved paths sweep over;
    dL/dI is smooth and vanishes at the film's border. `step` is that of the amplitudes, `options` the integrators'.
    Less noise comes by `seeds`, not by `spp`: from a thousand on, what sums of an image lose in single precision shows
    in its differences.
    """

    name: str
    about: str
    scene: Callable[[], dict]
    moves: Callable[[Any], Sequence[Move]]
    step: float = 0.01
    spp: int = 64
    seeds: int = 8
    options: Mapping[str, Any] = field(default_factory=lambda: {"max_depth": 4})

    def case(self) -> Case:
        """The scene, loaded, with its amplitudes as the one parameter."""
        return moving_case(self.scene(), self.moves)


@dataclass(frozen=True)
class Differenced:
    """Derivatives of the objective along K amplitudes, ours and by finite differences: (N, K) at N seeds.

    `differences` are central ones, `correction` (M, K) what Richardson's extrapolation to a step of 0 adds to them, at
    the first seeds. The rest is relative to the root mean square of the reference: `error` the largest deviation of the
    means, `standard_error` the largest one of these deviations, `truncation` the largest correction.
    """

    ours: np.ndarray
    differences: np.ndarray
    correction: np.ndarray

    @property
    def reference(self) -> np.ndarray:
        """The means of the differences, extrapolated: (K,)."""
        mean: np.ndarray = self.differences.mean(0) + self.correction.mean(0)
        return mean

    @property
    def scale(self) -> float:
        return float(np.sqrt(np.mean(np.square(self.reference))))

    @property
    def errors(self) -> np.ndarray:
        """Of each amplitude, signed: (K,)."""
        errors: np.ndarray = (self.ours.mean(0) - self.reference) / self.scale
        return errors

    @property
    def error(self) -> float:
        return float(np.abs(self.errors).max())

    @property
    def standard_errors(self) -> np.ndarray:
        """Of each amplitude: (K,)."""
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


def compare_with_differences(scene: AttachedScene, estimator: str = "stack", count: int | None = None) -> Differenced:
    """Differentiate a scene by an estimator, and by finite differences of its image at the same random numbers."""
    case = scene.case()
    tracer = integrator("reslrb", **scene.options, estimator=estimator)
    chosen = seeds(count or scene.seeds)
    ours = case.gradients(tracer, chosen, scene.spp)
    directions = np.eye(len(case.initial[AMPLITUDES]))
    near = case.differences(tracer, directions, chosen, scene.spp, scene.step)
    few = chosen[: max(len(chosen) // ONE_IN, EXTRAPOLATED)]
    far = case.differences(tracer, directions, few, scene.spp, 2 * scene.step)
    return Differenced(ours, near, (near[: len(few)] - far) / 3)
