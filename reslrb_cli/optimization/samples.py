"""Gradient samples: steps that measure, and leave the parameters as they are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from reslrb_cli.integrators import gradient_step
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


def sample_gradient(problem: Problem, integrator: Any, round: int, purpose: str, spp: int) -> dict[str, Any]:
    """One step of all views, evaluated, with the seeds of `round` and `purpose`.

    Returns the gradient of each parameter as it is accumulated in `problem.optimizer`; `take_gradient` has to follow.
    """
    run = problem.config.run
    for view in problem.trained:
        step = gradient_step(
            integrator, problem.scene, view.sensor, view.objective, seed=seed(run.seed, round, view.sensor, purpose),
            **{**problem.config.step_options(), "spp": spp}, params=problem.selection.params,
            on_samples=problem.on_samples(view),
        )  # fmt: skip
        gradients = problem.gradients()
        dr.eval(step.loss, gradients)
    return gradients


def take_gradient(problem: Problem) -> dict[str, np.ndarray[Any, Any]]:
    """The gradients that have been accumulated, each in a row, 0 where they are not finite; they are cleared."""
    taken = {}
    for key, value in problem.gradients().items():
        gradient = np.array(value, dtype=np.float32)
        taken[key] = np.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0).ravel()
        problem.optimizer.clear_gradient(key)
    return taken
