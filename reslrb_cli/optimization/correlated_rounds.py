"""Rounds of samples that show the bias of `run.adjoint: correlated` before a run begins.

The bias of a loss that is quadratic in the image is inversely proportional to the samples per pixel, whatever their
number: there rounds have fewer than the run's steps, which makes the bias larger beside its noise, and the result is
brought back to those of the run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from reslrb_cli.integrators import cross_step
from reslrb_cli.integrators.tracer import LightTracer
from reslrb_cli.optimization.correlated_bias import Array, CorrelatedBias, find_bias
from reslrb_cli.optimization.samples import take_gradient
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

#: Rounds, and fewer than which say nothing. A round costs two steps of the samples that it has.
ROUNDS, FEWEST_ROUNDS = 8, 6
#: Share of the samples of a run's iterations that the rounds may cost.
SHARE = 1 / 16
#: Part of the run's samples that a round has, and the losses that this is right for.
PART, QUADRATIC = 4, ("l2", "relative_l2")


def measure_correlated_bias(problem: Problem, say: Callable[[str], None]) -> CorrelatedBias | None:
    """Measure the bias of `correlated` at the parameters' values; None where a run has something else, or is too short.

    Needs targets, and leaves neither gradient nor change behind.
    """
    run = problem.config.run
    if problem.config.adjoint != "correlated":
        return None
    unit = problem.samples_per_pass or 1
    part = PART if problem.config.loss.type in QUADRATIC else 1
    spp = max(run.spp // part // unit * unit, unit)
    rounds = min(ROUNDS, int(SHARE * run.iterations * run.spp / (2 * spp)))
    if rounds < FEWEST_ROUNDS:
        return None
    say(f"adjoint correlated: measuring its bias, {rounds} rounds of {spp} spp")
    differences: dict[str, list[Array]] = {key: [] for key in problem.selection.keys}
    gradients: dict[str, list[Array]] = {key: [] for key in problem.selection.keys}
    for number in range(rounds):
        own, other = (_gradient(problem, number, purpose, spp) for purpose in ("bias", "bias of another"))
        for key in problem.selection.keys:
            differences[key].append(own[key] - other[key])
            gradients[key].append(other[key])
    count, scale = len(differences), spp / run.spp
    rows = [find_bias(key, differences[key], gradients[key], scale, count) for key in differences]
    return CorrelatedBias(rounds, spp, rows)


def _gradient(problem: Problem, number: int, image: str, spp: int) -> dict[str, Array]:
    """The gradient by samples of a round, with dL/dI from those of `image` in that round: `bias` are the same ones."""
    run, integrator = problem.config.run, problem.integrator
    if isinstance(integrator, LightTracer):  # a recording would cost more than so few steps save
        integrator = integrator.with_options(samples_per_pass=integrator.samples_per_pass, freeze=False)
    problem.apply()
    for view in problem.trained:
        cross_step(
            integrator, problem.scene, view.sensor, view.objective,
            seed=seed(run.seed, number, view.sensor, "bias"),
            image_seed=seed(run.seed, number, view.sensor, image), spp=spp, params=problem.selection.params,
            on_samples=problem.on_samples(view),
        )  # fmt: skip
    return take_gradient(problem)
