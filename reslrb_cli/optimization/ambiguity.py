"""Whether the images tell exposures from parameters, asked before the first iteration.

Let D_k be how all views' images, exposed and without what their masks leave out, change with the logarithm of parameter
k, all its entries at once: (J((1 + h) x_k) - J(x_k)) / h, at common random numbers. An exposure's own is its views'
images themselves. With all emission unknown, for example, the sum over the lamps is the exposure's. In general there
are combinations without an effect where the matrix of cosines

    G_kl = <D_k, D_l> / (|D_k| |D_l|)

has an eigenvalue near 0; its eigenvector says which values are in the combination.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.exposure import SHARED
from reslrb_cli.optimization.sensitivity import see_images

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

#: The relative step h.
STEP = 0.02
#: Eigenvalues below it are taken for 0: two directions at less than a degree to each other.
LEAST = 1e-4
#: A value whose part in the eigenvector is smaller has none in the combination.
PART = 0.1


@dataclasses.dataclass(frozen=True)
class Ambiguous:
    """Values that can change together without the images showing it: exposures, and parameters."""

    exposures: list[str]
    parameters: list[str]


def check_exposures(problem: Problem) -> None:
    """Raise ConfigError where the images cannot tell an exposure from parameters, which it names.

    Takes one image of each view for every parameter; nothing where no exposure is recovered. The problem has its
    targets, and is left as it was.
    """
    found = find_ambiguous(problem) if problem.selection.factors else None
    if found is None:
        return
    both = " and ".join(f"`{key}`" for key in found.exposures), ", ".join(f"`{key}`" for key in found.parameters)
    raise ConfigError(
        problem.config.source,
        _place(problem, found.exposures[0]),
        f"the images cannot tell {both[0]} from {both[1]}: changed together, they look the same; give one of them a "
        "number, such as exposure: 1, or remove a parameter whose value is known",
    )


def find_ambiguous(problem: Problem) -> Ambiguous | None:
    """The first combination of exposures and parameters that the images do not show; None where there is none."""
    problem.apply()
    base = _row(problem)
    factors, rows, keys = problem.selection.factors, [], []
    for key in problem.selection.keys:
        value = dr.detach(problem.optimizer[key])
        moved = value * dr.opaque(dr.leaf_t(value), 1 + STEP)
        problem.apply({key: moved})
        row = (_row(problem) - base) / STEP
        if np.isfinite(row).all() and (norm := float(np.linalg.norm(row))) > 0:
            rows.append(row / norm)
            keys.append(key)
    problem.apply()
    if not rows:
        return None
    matrix = np.stack(rows)
    values, vectors = np.linalg.eigh(matrix @ matrix.T)
    for value, vector in zip(values, vectors.T, strict=True):
        parts = [key for key, part in zip(keys, vector, strict=True) if abs(part) > PART]
        exposures = [key for key in parts if key in factors]
        parameters = [key for key in parts if key not in factors]
        if value < LEAST and exposures and parameters:
            return Ambiguous(exposures, parameters)
    return None


def _place(problem: Problem, key: str) -> str:
    """Where the exposure of that key stands in the configuration."""
    for number, spec in enumerate(problem.config.views or ()):
        if spec.exposure is not None and key == f"{SHARED}.{spec.sensor}":
            return f"views[{number}].exposure"
    return "target.exposure"


def _row(problem: Problem) -> np.ndarray:
    """The images of all views in a row, each by the root of its share of the loss."""
    images = see_images(problem)
    return np.concatenate(
        [np.sqrt(view.share) * image.ravel() for view, image in zip(problem.trained, images, strict=True)]
    )
