"""Sampled gradients and images at the current values, and units for gradient descent (`scale: curvature`).

Gradient samples are steps that leave the parameters unchanged (`sample_gradient`).

Units for gradient descent (`measure_curvatures`): lambda is the largest curvature of the loss in the optimiser's
variable v. Power iteration computes lambda from differences of gradients at common random numbers. h is chosen so that
the image changes by about 3 %. Then neither rounding nor curvature dominates the differences.

    H d = (g(v + h d) - g(v - h d)) / (2 h),   d <- H d / |H d|,   lambda = |H d|

At a bound, the ends are clipped, and the difference is divided by the distance of the clipped ends.

Every iteration has its own samples, in two halves. Their difference shows the noise e of H d. Noise along H d changes
lambda by the same share. Noise across H d turns the next d away, which lowers lambda by |e|^2 / (2 lambda^2). An
iteration whose two shares exceed `TOLERANCE` doubles the samples of the next one, up to those of a step.

The gradient is divided by lambda and by the number of parameters. If the diagonal blocks of a positive matrix have norm
1, the matrix norm is at most the number of blocks. A rate of 1 is Newton's step along the steepest direction. Gradient
descent converges for learning rates below 2, as long as the curvature keeps its initial value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.integrators.step import gradient_step, render_image
from reslrb_cli.optimization.nonfinite import finite
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.decisions import Scaled
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array, rms


def sample_gradient(problem: Problem, integrator: Any, round: int, purpose: str, spp: int) -> dict[str, Any]:
    """Take one step of all views with the seeds of `round` and `purpose`, and evaluate the result.

    The gradients are accumulated in `problem.optimizer`. Call `take_gradient` afterwards.
    """
    run, refused = problem.config.run, []
    for view in problem.trained:
        step = gradient_step(
            integrator, problem.scene, view.sensor, view.objective, seed=seed(run.seed, round, view.sensor, purpose),
            **{**problem.config.step_options(), "spp": spp}, params=problem.selection.params,
            on_samples=problem.on_samples(view),
        )  # fmt: skip
        gradients = problem.gradients()
        dr.eval(step.loss, gradients)
        refused.append((view.sensor, step.refused))
    for sensor, each in refused:
        if count := int(each.count[0]):
            problem.left_out[f"measured dL/dI of sensor {sensor}"] += count
    return gradients


def take_gradient(problem: Problem) -> dict[str, Array]:
    """Return the accumulated gradients as flat arrays, and clear the accumulated gradients. Non-finite values
    become 0.
    """
    taken = {}
    for key, value in problem.gradients().items():
        row = np.array(value, dtype=np.float32).ravel()
        taken[key] = finite(problem.leave_out(f"the measured gradient of {key}", row))
        problem.optimizer.clear_gradient(key)
    return taken


def unrecorded(integrator: Any) -> Any:
    """Return the integrator without recordings. For only a few steps, a recording costs more than it saves."""
    if not isinstance(integrator, LightTracer):
        return integrator
    return integrator.with_options(samples_per_pass=integrator.samples_per_pass, freeze=False)


_PURPOSE = "conditioning"

#: Part of the image that a change of h should change: target and accepted range.
AIM, LEAST, MOST = 0.03, 0.003, 0.3
#: Maximum number of renderings for each parameter while h is searched.
TRIALS = 8


def see_images(problem: Problem, spp: int | None = None, round: int = 0, purpose: str = _PURPOSE) -> list[Array]:
    """Render every training view, exposed and without alpha, always from the same seeds. Masked pixels are 0. Values
    that are not finite are NaN.

    `spp` replaces the run's samples per pixel.
    """
    run, images = problem.config.run, []
    for view in problem.trained:
        at = seed(run.seed, round, view.sensor, purpose)
        image = render_image(problem.integrator, problem.scene, view.sensor, at, spp or run.spp)
        exposed = view.kept(np.array(view.exposed(image), dtype=np.float64))
        images.append(problem.leave_out(f"a measured image of sensor {view.sensor}", exposed))
    return images


#: Differences of gradients for the largest curvature, and the relative error of the curvature that steps tolerate.
POWER_ITERATIONS, TOLERANCE = 8, 0.05
#: Part of a step's samples in each half of the first difference.
FIRST_PART = 16


def measure_curvatures(problem: Problem) -> list[Scaled]:
    """Measure the steepest curvature of all parameters and return it. Gradient descent then scales each parameter's
    steps by the inverse of the measured curvature.

    A parameter without an effect on the image keeps its units. An interrupt stops the measurement before the next
    rendering (`Problem.stop_if_interrupted`). The values are then not those of the start.
    """
    optimizer, measured, spp = problem.optimizer, [], problem.config.run.spp
    starts = {key: dr.detach(optimizer[key]) for key in problem.selection.keys}
    problem.apply()
    images = see_images(problem, 2 * _sample_counts(problem)[0])
    size = math.sqrt(sum(float(np.square(finite(image)).sum()) for image in images))
    for key, start in starts.items():
        variable = optimizer.variable(key)
        v = variable.from_scene(start)
        gradient = finite(_gradients_at(problem, key, v, spp, [0])[0])
        row = Scaled(key, gradient.size, rms(np.array(start)), rms(gradient))
        found = _steepest(problem, key, v, gradient, size)
        optimizer.set_value(key, start)
        if found > 0:
            unit = replace(variable, gain=1 / (found * len(starts)))
            optimizer.set_variable(key, unit)
            step = _like(v, gradient * (unit.gain * optimizer.rate(key)))
            first = rms(np.array(unit.to_scene(v - step)) - np.array(start))
            row = replace(row, curvature=found, first_step=first)
        measured.append(row)
    problem.apply()
    return measured


def _steepest(problem: Problem, key: str, v: Any, gradient: Array, size: float) -> float:
    """Return the loss's largest curvature in `v`, the optimiser's variable of `key`. Return 0 if `v` has no visible
    effect. `size` is the L2 norm of the images at the start.
    """
    counts = _sample_counts(problem)
    spp = 2 * counts[0]
    direction = gradient / (np.linalg.norm(gradient) or 1.0)
    step = 0.01 * (rms(np.array(v)) or 1.0) * math.sqrt(gradient.size)
    variable = problem.optimizer.variable(key)

    def ends() -> tuple[list[Any], float]:
        """Return both ends of a difference, within the bounds, and their distance."""
        pair = [variable.clamp(v + _like(v, side * step * direction)) for side in (1, -1)]
        return pair, float(np.linalg.norm(np.array(pair[0] - pair[1], dtype=np.float64)))

    far = 0.0
    for _ in range(TRIALS):
        images, (pair, wide) = [], ends()
        for end in pair:
            problem.stop_if_interrupted()
            problem.apply({key: variable.to_scene(end)})
            images.append(see_images(problem, spp))
        changes = (0.5 * finite(a - b) for a, b in zip(*images, strict=True))
        change = math.sqrt(sum(float(np.square(each).sum()) for each in changes)) / (size or 1.0)
        if change == 0 and spp < problem.config.run.spp:  # few samples may miss the effect
            spp = problem.config.run.spp
            continue
        if not 0 < change < math.inf:
            step *= 1e3 if change == 0 else 1e-3
            continue
        if LEAST <= change <= MOST or (change < LEAST and wide == far):  # the bounds are no further apart
            break
        step, far = step * AIM / change, wide
    else:
        return 0.0
    found = 0.0
    for number in range(POWER_ITERATIONS):
        pair, wide = ends()
        rounds = [2 * number + 1, 2 * number + 2]
        rows = np.stack([_gradients_at(problem, key, end, counts[0], rounds) for end in pair])
        if not np.isfinite(rows).all(axis=(0, 1)).any():  # this pair of gradients tells nothing
            continue
        halves = finite(rows[0] - rows[1]) / (wide or 1.0)
        bent, noise = halves.mean(axis=0), (halves[0] - halves[1]) / 2
        before, found = found, float(np.linalg.norm(bent))
        if not 0 < found < math.inf:
            return 0.0
        direction = bent / found
        if before:  # with the same change of the image as before
            step *= math.sqrt(before / found)
        if len(counts) > 1 and abs(noise @ direction) / found + 0.5 * (noise @ noise) / found**2 > TOLERANCE:
            del counts[0]
    return found


def _sample_counts(problem: Problem) -> list[int]:
    """Return the possible samples per pixel of one half of a difference, ascending. The largest is half of a step's, or
    a step's if those cannot be halved.
    """
    spp, multiple = problem.config.run.spp, problem.samples_per_pass or 1
    batches = problem.config.step_options().get("batches", 1)
    parts = [spp // part for part in (FIRST_PART, 8, 4, 2) if spp % (part * batches) == 0]
    return [part for part in parts if part // batches % min(multiple, part // batches) == 0] or [spp]


def _gradients_at(problem: Problem, key: str, v: Any, spp: int, rounds: Sequence[int]) -> Array:
    """Return dL/dv (R, N) at the value `v` of the optimiser's variable for `key`, for each of the `rounds`. A round
    always has the same samples. Values that are not finite are NaN.
    """
    problem.stop_if_interrupted()
    optimizer = problem.optimizer
    variable = optimizer.variable(key)
    optimizer.set_value(key, variable.to_scene(v))
    problem.apply()
    rows = []
    for round in rounds:
        problem.stop_if_interrupted()
        sample_gradient(problem, problem.integrator, round, _PURPOSE, spp)
        problem.regularize()
        row = np.array(variable.chain(v, optimizer.gradient(key)), dtype=np.float64).ravel()
        take_gradient(problem)
        rows.append(np.where(np.isfinite(row), row, np.nan))
    return np.array(rows)


def _like(value: Any, row: Array) -> Any:
    """Return the numbers of `row` as an array of the type and shape of `value`."""
    return type(value)(row.reshape(np.array(value).shape).astype(np.float32))


def scale_line(row: Scaled) -> str:
    """Return a line for the user about the scale of one parameter."""
    if row.curvature is None:
        return f"{row.key} has no effect on the image at its start; it is not scaled"
    return f"{row.key} moves by about {row.first_step or 0.0:.3g} at first"
