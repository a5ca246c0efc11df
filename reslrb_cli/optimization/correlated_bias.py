"""The bias that `run.adjoint: correlated` makes in a gradient, seen in rounds of few samples before a run begins.

With delta(I) = dL/dI and J the derivative of the image by the parameters, each of its samples,

    g = J(samples)^T delta(I(samples))          correlated: noise of I meets its own in J
    h = J(samples)^T delta(I(other samples))    independent

have expectations that differ by the bias b = E[g - h]. That of a loss that is quadratic in the image is inversely
proportional to the samples per pixel: there rounds have fewer than the run's steps, which makes the bias larger beside
its noise, and the result is brought back to those of the run.

Rounds r of independent samples give d_r = g_r - h_r and h_r. Inner products of expectations are estimated without bias
from pairs of different rounds (U-statistics)

    <a, c> = mean over r != s of <a_r, c_s>

and their standard errors by the jackknife over rounds. Two things are asked of each parameter: what share of the
gradient the bias makes, <b, h> / <h, h>, where noise does not hide the gradient; and whether the bias is longer than
the gradient, <b, b> > <h, h>, which keeps its sense where the gradient vanishes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from reslrb_cli.config.optimizers import losses_of
from reslrb_cli.integrators.step import cross_step
from reslrb_cli.optimization.losses import QUADRATIC
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import take_gradient, unrecorded
from reslrb_cli.records.decisions import Jsonable
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array, jackknife_variance

logger = logging.getLogger(__name__)

#: Rounds, and fewer than which say nothing. A round costs two steps of the samples that it has.
ROUNDS, FEWEST_ROUNDS = 8, 6
#: Share of the samples of a run's iterations that the rounds may cost.
SHARE = 1 / 16
#: Part of the run's samples that a round has where the loss is quadratic, for which alone that is right.
PART = 4
#: Probability that a run without bias is told of one: that of three standard errors.
ALPHA = 0.0027


@dataclass(frozen=True)
class Bias:
    """Of one parameter: the bias as a share of the gradient, with its standard error; None where noise hides that.

    `along` says that this share is no accident, `exceeds` that the bias is longer than the gradient, by no accident.
    """

    key: str
    share: float | None
    error: float | None
    along: bool
    exceeds: bool


@dataclass(frozen=True)
class CorrelatedBias(Jsonable):
    """What was measured, by parameter, in so many rounds of `spp` samples per pixel."""

    rounds: int
    spp: int
    parameters: list[Bias]

    def line(self) -> str | None:
        """What the user is told, of the parameter that has the largest bias; None where none was seen."""
        seen = [row for row in self.parameters if row.along or row.exceeds]
        if not seen:
            return None
        worst = max(seen, key=lambda row: abs(row.share) if row.along and row.share is not None else np.inf)
        more = f" ({len(seen) - 1} more {'has' if len(seen) == 2 else 'have'} one)" if len(seen) > 1 else ""
        what = f"{share_words(worst)} of the gradient of" if worst.along else "larger than the gradient of"
        name = f"`{worst.key}`" if worst.along else f"`{worst.key}` itself"
        return f"run.adjoint: correlated: at the start its bias is {what} {name}{more}; `batched` has none of it"


def share_words(row: Bias, sign: str = "+-") -> str:
    """A bias as a share of the gradient, with its standard error; empty where noise hides it."""
    if row.share is None or row.error is None:
        return ""
    digits = 0 if row.error >= 0.005 else 1
    return f"{100 * row.share:+.{digits}f} % {sign} {max(100 * row.error, 10**-digits):.{digits}f} %"


def measure_correlated_bias(problem: Problem) -> CorrelatedBias | None:
    """Measure the bias of `correlated` at the parameters' values; None where a run has something else, or is too short.

    Needs targets, and leaves neither gradient nor change behind.
    """
    run = problem.config.run
    if problem.config.adjoint != "correlated":
        return None
    unit = (problem.samples_per_pass or 1) * problem.config.halves
    fitted = problem.config.halves == 2  # which is not quadratic
    part = PART if all(loss.type in QUADRATIC for loss in losses_of(problem.config.loss)) and not fitted else 1
    own_spp = problem.config.share_spp
    spp = max(own_spp // part // unit * unit, unit)
    rounds = min(ROUNDS, int(SHARE * run.iterations * run.spp / (2 * spp)))
    if rounds < FEWEST_ROUNDS:
        return None
    logger.debug(f"adjoint correlated: measuring its bias, {rounds} rounds of {spp} spp")
    own, other = ([_gradient(problem, number, image, spp) for number in range(rounds)] for image in _IMAGES)
    rows, keys = [], problem.selection.keys
    for key in keys:
        differences = [a[key] - b[key] for a, b in zip(own, other, strict=True)]
        rows.append(find_bias(key, differences, [b[key] for b in other], spp / own_spp, len(keys)))
    return CorrelatedBias(rounds, spp, rows)


#: The seeds of the image that dL/dI is of: those of the gradient's own samples, and others.
_IMAGES = ("bias", "bias of another")


def _gradient(problem: Problem, number: int, image: str, spp: int) -> dict[str, Array]:
    """The gradient by samples of a round, with dL/dI from those of `image` in that round."""
    run, integrator = problem.config.run, unrecorded(problem.integrator)
    problem.apply()
    for view in problem.trained:
        cross_step(
            integrator, problem.scene, view.sensor, view.objective,
            seed=seed(run.seed, number, view.sensor, _IMAGES[0]),
            image_seed=seed(run.seed, number, view.sensor, image), spp=spp, params=problem.selection.params,
            on_samples=problem.on_samples(view), halves=problem.config.halves == 2,
        )  # fmt: skip
    return take_gradient(problem)


def find_bias(
    key: str, differences: Sequence[Array], gradients: Sequence[Array], scale: float = 1.0, parameters: int = 1
) -> Bias:
    """Judge the bias of a parameter by d_r and h_r of each round; it is `scale` times as large in the run.

    Corrected for the number of parameters, each with two questions.
    """
    from scipy import stats  # here, since every run would wait a second for it that few have a use for

    d, h = (np.array(rows, dtype=np.float64) for rows in (differences, gradients))
    d = d * scale
    products = np.array([d @ h.T, h @ h.T, d @ d.T])
    limit = float(stats.t.isf(ALPHA / (4 * parameters), len(d) - 1))
    gradient, gradient_error = _with_error(products, lambda u: u[1])
    share, error = _with_error(products, lambda u: u[0] / (u[1] or np.inf))
    excess, excess_error = _with_error(products, lambda u: u[2] - u[1])
    known = gradient > limit * gradient_error
    return Bias(
        key,
        share=share if known else None,
        error=error if known else None,
        along=known and abs(share) > limit * error,
        exceeds=excess > limit * excess_error,
    )


def _with_error(products: Array, function: Callable[[Array], float]) -> tuple[float, float]:
    """`function` of the means over r != s of (K, R, R) inner products (K,), and its standard error."""

    def at(left: Array) -> float:
        off_diagonal = left.sum(axis=(1, 2)) - np.trace(left, axis1=1, axis2=2)
        return float(function(off_diagonal / (left.shape[1] * (left.shape[1] - 1))))

    without = [at(np.delete(np.delete(products, r, axis=1), r, axis=2)) for r in range(products.shape[1])]
    return at(products), float(np.sqrt(jackknife_variance(np.array(without))))
