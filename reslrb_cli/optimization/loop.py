"""The optimisation loop, which yields records and opens no file, and its learning-rate schedules.

A schedule gives the learning-rate factor for iteration i of n. The factor goes from 1 at the first iteration to
`final_fraction` at the last.

A run ends early if its time is up (`run.max_seconds`), or, with `optimizer: auto`, if all parameters are close enough
to the optimum (`close_enough`).
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import takewhile
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.errors import NonFinite
from reslrb_cli.integrators.step import Refused, gradient_step, render_image
from reslrb_cli.optimization.losses import own_losses
from reslrb_cli.optimization.nonfinite import (
    Findings,
    count_nonfinite,
    finite_square_norm,
    held_back,
    why_end,
    zero_nonfinite,
)
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import measure_curvatures
from reslrb_cli.optimization.shards import add_gradient, scaled
from reslrb_cli.optimization.state import State, held_tables, put, standing
from reslrb_cli.optimization.uncertainty.curvature import LossCurvature, plan_changes
from reslrb_cli.optimization.views import View
from reslrb_cli.records.clock import StepClock, peak_mib, reset_peak
from reslrb_cli.records.metrics import Record, Regularized
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import rms

#: Functions of a run's progress (0 to 1) and the final fraction. `cosine` is half a period (Loshchilov and Hutter 2017,
#: without restarts); `exponential` has the same factor from each iteration to the next.
SCHEDULES: dict[str, Callable[[float, float], float]] = {
    "constant": lambda progress, final: 1.0,
    "cosine": lambda progress, final: final + (1.0 - final) * 0.5 * (1.0 + math.cos(math.pi * progress)),
    "exponential": lambda progress, final: float(final**progress),
}


def learning_rate_factor(
    schedule: str, iteration: int, iterations: int, final_fraction: float, least: float = 0.0
) -> float:
    """Return the factor on the learning rate in `iteration` (0-based) of `iterations`. Raises KeyError for an unknown
    schedule.

    `least` (0 to 1) is the minimum progress of a run that ends before its last iteration.
    """
    return SCHEDULES[schedule](_progress(iteration, iterations, least), final_fraction)


def _progress(iteration: int, iterations: int, least: float) -> float:
    """Return the progress of a run, from 0 in its first iteration to 1 in its last."""
    return max(iteration / max(iterations - 1, 1), least)


#: The part of a run after which images are no longer blurred. With `auto`, this part has at most `MOST_BLURRED`
#: iterations, because `auto` needs few.
BLURRED, MOST_BLURRED = 0.5, 20


def set_blur(problem: Problem, iteration: int, least: float) -> None:
    """Set the blur of all training views for `iteration` (0-based). It falls linearly to 0.

    `least` (0 to 1) is the minimum progress of a run that ends before its last iteration.
    """
    iterations = problem.config.run.iterations
    if problem.optimizer.measures_curvature:
        iterations = min(iterations, round(MOST_BLURRED / BLURRED))
    factor = max(1.0 - _progress(iteration, iterations, least) / BLURRED, 0.0)
    for view in problem.trained:
        view.blur = factor * problem.first_blur(view)


def time_share(limit_s: float | None, state: State) -> float:
    """Return the elapsed share of a run's time, or 0 without a limit. The first iteration does not count, because it
    compiles kernels.
    """
    if limit_s is None or not state.iteration:
        return 0.0
    return min((state.elapsed_s - state.first_s) / max(limit_s - state.first_s, 1e-9), 1.0)


def out_of_time(limit_s: float | None, state: State) -> str:
    """Return a message if one more iteration of mean duration would exceed the limit, otherwise "". The mean excludes
    the first iteration.
    """
    mean_s = (state.elapsed_s - state.first_s) / max(state.iteration - 1, 1)
    if limit_s is None or state.elapsed_s + mean_s <= limit_s:
        return ""
    return f"the time is up, after {state.elapsed_s:.3g} s of iterations"


#: Fewest iterations of a run with `auto`. Distance to the optimum at which such a run ends: a share of a value's root
#: mean square, or of this share of its extent if that is larger. It is a quarter of the tolerance of a verdict. With a
#: transform, the distance of the optimiser's variable counts. It is at least the relative distance of the value. Until
#: steps are means of `AVERAGED` gradients, the error still falls fast, and the distance must be smaller by this factor.
LEAST_ITERATIONS, CLOSE, LEAST_SHARE, AVERAGED = 20, 0.025, 0.2, 15


def close_enough(problem: Problem, iteration: int) -> str:
    """Return a message if more iterations would not help, otherwise "". `iteration` is the number of iterations."""
    optimizer = problem.optimizer
    if not optimizer.measures_curvature:
        return ""
    measured = 2 ** ((iteration + 1).bit_length() - 1) - 2 if optimizer.has_large else 0  # the last measurement
    if iteration < max(LEAST_ITERATIONS, 1.5 * measured):
        return ""
    for key in optimizer.keys():  # noqa: SIM118 (not a mapping)
        extent = optimizer.extent(key)
        value = 1.0 if optimizer.variable(key).transform else rms(problem.selection.array(key))
        value = 0.0 if key in optimizer.extents else value / extent  # the origin of a motion is arbitrary
        distance, limit = optimizer.to_go(key), CLOSE * max(value, LEAST_SHARE)
        if distance > limit or (AVERAGED * distance > limit and optimizer.averaged(key) < AVERAGED):
            return ""
    return f"every parameter is within about {100 * CLOSE:g} % of the optimum"


#: Displacement of small parameters as a share of half their extent, the divisor of a step's samples for each of the two
#: sets that measure their curvature, and the largest ratio of the samples of these sets to those of the steps. A longer
#: displacement would smooth sharp caustics.
DISPLACEMENT, PART, MOST = 0.02, 4, 1.0


def measure_curvature(problem: Problem, iteration: int) -> None:
    """Measure the curvature for `auto`, if it is due. The gradient of `iteration` must be accumulated.

    The curvature of large parameters is measured with the samples of the iteration (`bends_large`), and the joint
    curvature of small parameters by images with their own samples (`joint_cost`).
    """
    optimizer = problem.optimizer
    if optimizer.block.at and joint_cost(iteration) is not None:
        measure_block(problem, iteration)
    if bends_large(optimizer, iteration):
        random = np.random.default_rng(seed(problem.config.run.seed, iteration, 0, "displacement"))
        with optimizer.displaced(random), held_tables(problem):
            problem.apply()
            _, _, counts, refused, _ = gradient(problem, iteration)
        problem.apply()
        for key, count in counts.items():
            problem.left_out[f"the measured gradient of {key}"] += int(count[0])
        for sensor, each in refused:
            problem.left_out[f"measured dL/dI of sensor {sensor}"] += int(each.count[0])


def bends_large(optimizer: Optimizer, iteration: int) -> bool:
    """Return True if the curvature of large parameters is measured: with `auto`, in the iterations 0, 2, 6, 14, 30 and
    so on. Tables of guided emission then do not learn, because both gradients need the same samples.
    """
    return optimizer.has_large and (iteration + 2) & (iteration + 1) == 0


def candidates() -> Iterator[int]:
    """Yield the iterations in which the joint curvature may be measured: 0, 1, 2, 4, 7, 11, 17 and so on."""
    iteration = 0
    while True:
        yield iteration
        iteration += iteration // 2 + 1


def joint_cost(iteration: int, cost: float = 0.0, least: float = 0.0) -> float | None:
    """Return the cost of the joint measurement in `iteration`, in samples of a step, or None if there is none.

    A candidate is left out if measuring would take more than its share of the samples. The first `LEAST_ITERATIONS`
    steps count from the start. A measurement usually has the `cost`. If that is too much, the first one may cost less,
    but not less than `least`.
    """
    spent, paid, due = 0.0, None, -1
    for due in takewhile(lambda due: due <= iteration, candidates()):
        left = MOST * (due + LEAST_ITERATIONS) - spent
        paid = cost if cost <= left else left if not spent and least <= left else None
        spent += paid or 0.0
    return paid if due == iteration else None


def measure_block(problem: Problem, iteration: int) -> None:
    """Measure the joint curvature of all small parameters for `auto` by differences of images, if its samples fit."""
    optimizer, block = problem.optimizer, problem.optimizer.block
    if block.is_known:
        return
    scales = {key: 0.5 * max(optimizer.extent(key), 1e-30) if optimizer.variable(key).transform is None
              else rms(problem.selection.array(key)) or 1.0 for key in block.at}  # fmt: skip
    changes = plan_changes(problem, scales, DISPLACEMENT)
    part, unit = part_of_samples(problem), problem.samples_per_pass or 1
    images = 2 * (len(changes) + 1) * len(problem.trained) / len(problem.drawn(iteration))
    cost, least = (images * spp / problem.config.run.spp for spp in (part, unit))
    paid = joint_cost(iteration, cost, least)
    if paid is None:
        return
    part = max(int(part * paid / cost) // unit, 1) * unit
    curvature = LossCurvature(problem, part, of_target=False, round=iteration)
    directions, *_ = curvature.along(changes, lambda: True)
    # A texture has no entries, but channels.
    at = np.array([block.at[each.key].start + (each.entry or each.channel or 0) for each in directions])
    slopes = np.concatenate([optimizer.slopes(key) for key in block.at])
    whole, (found, error) = np.zeros((len(slopes), len(slopes))), curvature.for_steps(directions)
    whole[np.ix_(at, at)] = found * np.outer(slopes[at], slopes[at])
    # If shapes move, noise and curvature change as the blur falls.
    block.bend(whole, 0.0 if optimizer.extents else error)
    problem.apply()


def part_of_samples(problem: Problem) -> int:
    """Return the samples per pixel of an image that `auto` measures: 1 / `PART` of those of a step, in whole passes."""
    unit = problem.samples_per_pass or 1
    return max(problem.config.run.spp // PART // unit, 1) * unit


#: Most halvings of a step, and the rise of the loss, as a share of the loss, above which n is halved too.
HALVINGS, RISE = 3, 0.1


def update(problem: Problem, iteration: int, factor: float, held: Collection[str]) -> dict[str, int]:
    """Update all parameters but `held`. Returns the number of non-finite entries of updates by key.

    Where shapes, lamps or heightmaps move, the loss is far from quadratic, and a step of `auto` may be much too long.
    The step of all small parameters is then halved until the loss does not rise (backtracking; Armijo 1966). After a
    large rise, n is halved too, because the mean of n gradients misleads.
    """
    optimizer = problem.optimizer
    searched = optimizer.measures_curvature and bool(optimizer.extents)
    before = {key: dr.detach(optimizer[key]) for key in optimizer.block.at if searched}
    first = exposed_images(problem, iteration) if searched else []
    updates = optimizer.step(factor, skip=held)
    problem.apply()
    for _ in range(HALVINGS if searched else 0):
        loss, now = blurred_losses(problem, iteration, first, exposed_images(problem, iteration))
        if not now > loss:
            break
        for key, value in before.items():
            optimizer.set_value(key, 0.5 * (value + dr.detach(optimizer[key])))
        if now - loss > RISE * abs(loss):
            optimizer.block.distrust()
        problem.apply()
    return updates


def exposed_images(problem: Problem, iteration: int) -> list[mi.TensorXf]:
    """Return the images of the views of `iteration` at the current values, exposed, with a part of its samples."""
    images = []
    for view, _ in problem.drawn(iteration):
        at = seed(problem.config.run.seed, iteration, view.sensor, "step length")
        image = render_image(problem.integrator, problem.scene, view.sensor, at, part_of_samples(problem))
        images.append(view.exposed(image))
        count = count_nonfinite(images[-1] if view.weights is None else dr.select(view.weights > 0, images[-1], 0))
        dr.eval(images[-1], count)
        problem.left_out[f"a measured image of sensor {view.sensor}"] += int(count[0])
    return images


def blurred_losses(problem: Problem, iteration: int, *images: Sequence[mi.TensorXf]) -> list[float]:
    """Return the losses of several sets of exposed images, with the blur of `iteration`. Pixels that are not finite in
    any of the sets are left out of all.
    """
    totals = [0.0] * len(images)
    for place, (view, scale) in enumerate(problem.drawn(iteration)):
        seen = [each[place] for each in images]
        known = functools.reduce(operator.and_, (dr.isfinite(image.array) for image in seen))
        for number, image in enumerate(seen):
            kept = mi.TensorXf(dr.select(known, image.array, view.target.array), image.shape)
            totals[number] += scale * float(view.blurred_objective(kept)[0])
    return totals


#: The moments are set to zero each time a large loss has fallen to this fraction. A first loss is large if the loss of
#: a black image is below this fraction of it. Losses count from the loss of the target itself.
FALL = 0.1


def loss_of(problem: Problem, iteration: int, image: Callable[[View], mi.TensorXf]) -> float:
    """Return the loss of `iteration` if the views had these exposed images."""
    return sum(scale * view.share * float(view.judge(image(view))[0]) for view, scale in problem.drawn(iteration))


#: Iterations between two evaluations of held-out views.
HELD_OUT_EVERY = 10


Told = Callable[[Findings], None]


def step(problem: Problem, state: State, on_nonfinite: Told = lambda found: None) -> tuple[State, Record]:
    """Make the iteration after `state` and return the new state and the record.

    An iteration consists of a step and an update. The step computes image, loss and gradient of every sensor, and the
    loss is the mean over the sensors. Equal states lead to equal states. If the problem's values differ from `state`,
    the function first sets the problem to `state`. After the iteration, the problem has the values of the returned
    state.

    Non-finite values never reach a parameter. The module `nonfinite` describes how the run reacts to non-finite values,
    and when a run ends (`State.end`). `on_nonfinite` is called before the update, while the scene is unchanged. With
    `optimizer.scale: curvature`, the first step measures before its iteration, and `elapsed_s` includes the time of the
    measurement. The schedule follows either the iteration count or the elapsed time (`run.max_seconds`), whichever has
    progressed further.

    A first loss is large if it exceeds ten times the loss of a black image. After a large first loss, the step sets the
    optimiser's moments to zero each time the loss has fallen by another factor of ten. Otherwise, the large first
    gradients would shorten the steps for a hundred iterations or more. Losses count from that of the target itself
    (`loss_of`), because your own losses may be negative.
    """
    config, optimizer, iteration, level = problem.config, problem.optimizer, state.iteration, state.level
    if optimizer.stands_at is not state:
        put(problem, state)
    clock = StepClock(state.elapsed_s)
    scaling = state.scaling
    if config.optimizer.scale != "none" and scaling is None:
        with clock.counted(), held_tables(problem):
            scaling = measure_curvatures(problem)
    errors = problem.meter.errors(problem.selection.array)
    held_out = problem.held_out_loss() if iteration % HELD_OUT_EVERY == 0 else None
    elapsed = time_share(problem.limit_s, state)
    set_blur(problem, iteration, elapsed)
    with clock.step() as times, held_tables(problem) if bends_large(optimizer, iteration) else nullcontext():
        loss, squares, counts, refused, costs = gradient(problem, iteration)
        dr.eval(loss, squares, counts)
    gradients = {key: optimizer.gradient(key) for key in optimizer.keys()}  # noqa: SIM118 (not a mapping)
    before_s = clock.elapsed_s
    if optimizer.measures_curvature:
        with clock.counted():
            measure_curvature(problem, iteration)
    curvature_s = clock.elapsed_s - before_s
    factor = learning_rate_factor(
        config.optimizer.schedule,
        iteration,
        config.run.iterations,
        config.optimizer.final_fraction,
        elapsed,
    )
    with clock.counted():
        value = float(loss[0])
        found = _findings(problem, iteration, value, counts, refused)
        if found:
            on_nonfinite(found)
        held = held_back(config.run.on_nonfinite, found, optimizer.keys())
        if iteration == 0:
            black = loss_of(problem, 0, lambda view: dr.zeros(mi.TensorXf, view.target.shape))
            best = loss_of(problem, 0, lambda view: view.target)
            level = value - best if FALL * (value - best) > black - best else 0.0
        elif level > 0 and (above := value - loss_of(problem, iteration, lambda view: view.target)) < FALL * level:
            level = above
            optimizer.forget()
        for key in found.gradients if config.run.on_nonfinite == "zero" else ():
            zero_nonfinite(optimizer[key])
        found.updates = update(problem, iteration, factor, held)
        told, found.measured = bool(found), problem.take_left_out()
        if found and not told:
            on_nonfinite(found)
    standstill = state.standstill + 1 if held or found.updates else 0
    state = replace(
        state,
        iteration=iteration + 1,
        elapsed_s=clock.elapsed_s,
        first_s=state.first_s if iteration else clock.elapsed_s,
        peak_mib=max(state.peak_mib, peak_mib(dr.backend_v(loss))),
        standstill=standstill,
        scaling=scaling,
        level=level,
        end=why_end(config.run.on_nonfinite, found, standstill),
        gradients=gradients,
    )
    stopped = out_of_time(problem.limit_s, state) or close_enough(problem, state.iteration)
    state = standing(problem, replace(state, stopped=stopped))
    return state, Record(
        iteration=iteration,
        loss=value,
        step_ms=times.wall_ms,
        codegen_ms=times.codegen_ms,
        elapsed_s=clock.elapsed_s,
        peak_mib=state.peak_mib,
        spp=config.run.spp,
        lr=config.optimizer.learning_rate * factor,
        grad_norm=float(sum(float(square[0]) for square in squares.values()) ** 0.5),
        nonfinite=found.total,
        parameter_rmse=problem.meter.total(errors),
        parameter_errors=errors,
        nonfinite_by_parameter=found.by_parameter,
        held_out=held_out,
        regularized=None if costs is None else Regularized(costs, problem.held()),
        curvature_s=curvature_s,
    )


def iterate(problem: Problem, state: State, on_nonfinite: Told = lambda found: None) -> Iterator[tuple[State, Record]]:
    """Make all remaining iterations of the run, starting at `state`. `step` makes each iteration.

    Raises NonFinite if the run fails.
    """
    reset_peak()
    while state.iteration < problem.config.run.iterations and not state.stopped:
        state, record = step(problem, state, on_nonfinite)
        problem.optimizer.stands_at = state
        yield state, record
        if state.end:
            raise NonFinite(state.end)


def optimize(problem: Problem, on_nonfinite: Told = lambda found: None) -> Iterator[Record]:
    """Yield the records of all iterations of `problem` from its current values. Parameters are updated before each
    record.
    """
    for _, record in iterate(problem, standing(problem), on_nonfinite):
        yield record


def _findings(
    problem: Problem, iteration: int, loss: float, counts: dict[str, Any], refused: list[tuple[int, Refused]]
) -> Findings:
    """Return the values of a step that were not finite. `refused` are the counts by sensor."""
    found = Findings(iteration, loss=not math.isfinite(loss), own=own_losses(problem.config))
    found.measured = dict(+problem.left_out)
    found.gradients = {key: int(count[0]) for key, count in counts.items() if count[0]}
    found.lost = [key for key, bad in found.gradients.items() if bad == dr.prod(dr.shape(problem.optimizer[key]))]
    for sensor, view in refused:
        first = view.entry()
        if first is not None:
            found.refused[sensor] = int(view.count[0]), first
    return found


def gradient(
    problem: Problem, iteration: int
) -> tuple[Any, dict[str, Any], dict[str, Any], list[tuple[int, Refused]], dict[str, dict[str, float]] | None]:
    """Accumulate the gradient of the loss into the parameters.

    Returns arrays of width 1: the loss, two numbers for each parameter, the refused entries by sensor, and the costs of
    regularizers by key and type (None without any). The two numbers are the sum of squares of the gradient's finite
    entries, and the number of non-finite entries.
    """
    config = problem.config
    total: Any = 0.0
    refused: list[tuple[int, Refused]] = []
    costs = None
    apart = config.shards != 1
    if apart:
        loss, refused = add_gradient(problem, iteration)
        total = mi.Float(loss)
        gradients = {key: problem.optimizer.gradient(key) for key in problem.selection.keys}
    for view, scale in () if apart else problem.drawn(iteration):
        step = gradient_step(
            problem.integrator,
            problem.scene,
            view.sensor,
            scaled(view, scale),
            seed=seed(config.run.seed, iteration, view.sensor, "image"),
            **config.step_options(),
            params=problem.selection.params,
            on_samples=problem.on_samples(view),
        )
        # One view's kernels must not wait for the next one's: memory would grow with the number of views.
        gradients = problem.gradients()
        dr.eval(step.loss, gradients)
        total = total + step.loss
        refused.append((view.sensor, step.refused))
    if problem.regularizers:
        costs = problem.regularize()
        gradients = {key: problem.optimizer.gradient(key) for key in gradients}
    squares = {key: finite_square_norm(value) for key, value in gradients.items()}
    return total, squares, {key: count_nonfinite(value) for key, value in gradients.items()}, refused, costs
