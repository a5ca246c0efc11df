"""Scenes whose parameters move light (`attached`), and their comparison with finite differences (`Differenced`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reslrb_cli.measure.gradients import integrator, seeds
from reslrb_cli.measure.scenes.case import Moves, SceneCase
from reslrb_cli.measure.scenes.catalogue import moved
from reslrb_cli.statistics import rms

#: Width and height of a film in pixels.
SIZE = 32


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
    """Derivatives of the objective along K amplitudes at N seeds (N, K): `ours`, and the `reference` by extrapolated
    finite differences at the same random numbers.

    `error` is the largest deviation of the means, and `standard_error` the largest standard error of these deviations.
    Both are relative to the root mean square of the reference.
    """

    ours: np.ndarray
    reference: np.ndarray

    @property
    def error(self) -> float:
        return float(np.abs((self.ours - self.reference).mean(0)).max() / rms(self.reference.mean(0)))

    @property
    def standard_error(self) -> float:
        deviations = (self.ours - self.reference).std(0, ddof=1) / np.sqrt(len(self.ours))
        return float(deviations.max() / rms(self.reference.mean(0)))

    def __str__(self) -> str:
        return f"largest deviation {self.error:.2%} of the root mean square, standard error {self.standard_error:.2%}"


def compare_with_differences(scene: SceneCase, estimator: str = "stack", count: int | None = None) -> Differenced:
    """Differentiate a scene with an estimator, and with the finite differences that are its reference."""
    scene = replace(scene, seeds=count or scene.seeds)
    case, tracer = scene.setup(), integrator("reslrb", **scene.options, estimator=estimator)
    ours = case.gradients(tracer, seeds(scene.seeds), scene.spp)
    return Differenced(ours, scene.source.samples(scene, case).values)
