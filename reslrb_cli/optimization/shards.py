"""Step in shards: sets of whole views, or shares of the samples of one view, computed separately.

A `Task` has all data that a shard needs besides the problem. `shard_image` and `shard_gradient` depend only on task and
problem. Both functions return NumPy arrays and leave no changes. The sums therefore do not depend on where and in which
order shards are computed.

A view has S shares. I_s is the image of share s, w_s its part of the samples (1 / S), and J_s the derivative of I_s
with respect to the parameters.

    I = sum of w_s I_s,    gradient = sum over s of w_s J_s^T dL/dI

With one round, each share computes dL/dI from its own samples, as `run.adjoint` specifies. With two rounds (`auto`),
each share evaluates dL/dI at the mean image of the other shares, (I - w_s I_s) / (1 - w_s). No path then uses a dL/dI
to which the path itself contributes. For an L2 loss, the gradient with two rounds is the sum over all pairs of
different shares. The gradient is unbiased. Images and gradients are added in the order of the shards, in double
precision.

Tables of guided emission do not change while shards are computed. If a table update is due, the tables learn once per
step from separate samples. The update uses dL/dI at the mean image of all shards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.step import NONE, Refused, derivative_of, given_step, gradient_step, render_image
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.state import guiding_of, held_tables
from reslrb_cli.optimization.views import View, to_tensor
from reslrb_cli.records.tree import like, to_array
from reslrb_cli.seeds import seed

Array = np.ndarray[Any, Any]
S = TypeVar("S")
T = TypeVar("T")

#: Computes the shards: calls a function with the problem and further arguments, a task first. Yields position and
#: result of each call, in any order.
Engine = Callable[[Problem, Callable[..., Any], Sequence[tuple[Any, ...]]], Iterable[tuple[int, Any]]]


class Part(NamedTuple):
    """Samples of one view in a shard: its sensor, the factor of its loss, the seed, and the blur (`View.blur`)."""

    sensor: int
    scale: float
    seed: int
    blur: float = 0.0


@dataclass(frozen=True)
class Task:
    """Shard of a step with `spp` samples per pixel: whole views, or a part `weight` of the samples of one view.

    With `images`, the result includes the images of the samples.
    """

    iteration: int
    parts: tuple[Part, ...]
    spp: int
    weight: float
    images: bool


@dataclass(frozen=True)
class ShardGradient:
    """Result of a shard.

    `gradients` has the gradient of each parameter (float32). For each part, the result has the loss and the refused
    entries of dL/dI. A record of refused entries has the entry count, the first entry's flat index, and the array's
    shape. If requested, the result also has the part's image, (H, W, C).
    """

    gradients: dict[str, Array]
    losses: tuple[float, ...] = ()
    refused: tuple[tuple[int, int, tuple[int, ...]], ...] = ()
    images: tuple[Array, ...] = ()


# --- shards -----------------------------------------------------------------------------------------------------------


def make_tasks(problem: Problem, iteration: int, images: bool = False) -> list[Task]:
    """Return the shards of an iteration in order. With `images`, shards of whole views return images, too."""
    config, drawn = problem.config, problem.drawn(iteration)
    shares, count = config.shares, min(config.shards, len(drawn))
    if shares > 1:
        sets = [[one] for one in drawn for _ in range(shares)]
    else:
        ends = [len(drawn) * place // count for place in range(count + 1)]
        sets = [drawn[first:end] for first, end in pairwise(ends)]
    purposes = [f"image, shard {shard}" for shard in range(len(sets))]
    return [
        Task(
            iteration,
            tuple(
                Part(view.sensor, scale, seed(config.run.seed, iteration, view.sensor, purpose), view.blur)
                for view, scale in own
            ),
            config.share_spp,
            1 / shares,
            images or shares > 1,
        )
        for own, purpose in zip(sets, purposes, strict=True)
    ]


def shard_image(problem: Problem, task: Task) -> Array:
    """Return the image of a shard of one view as float32, (H, W, C)."""
    [part] = task.parts
    with held_tables(problem):
        return np.array(render_image(problem.integrator, problem.scene, part.sensor, part.seed, task.spp))


def shard_gradient(problem: Problem, task: Task, delta: Array | None = None) -> ShardGradient:
    """Return the gradient of a shard. The shard computes its own dL/dI. A shard of one view can instead use `delta`, in
    the shape of `shard_image`.

    Previously accumulated gradients are lost.
    """
    config = problem.config
    found: list[tuple[float, tuple[int, int, tuple[int, ...]], Array | None]] = []
    with held_tables(problem):
        _clear(problem)
        views = {view.sensor: view for view in problem.views}
        for part in task.parts:
            view = replace(views[part.sensor], blur=part.blur)
            at = problem.integrator, problem.scene, part.sensor
            own: dict[str, Any] = {"params": problem.selection.params, "on_samples": problem.on_samples(view)}
            if delta is not None:
                given_step(*at, _tensor(delta), seed=part.seed, spp=task.spp, **own)
                continue
            own |= config.step_options(shard=True)
            step = gradient_step(*at, scaled(view, part.scale), seed=part.seed, **own)
            # One view's kernels must not wait for the next one's.
            dr.eval(step.loss, problem.gradients())
            refused = int(step.refused.count[0]), int(step.refused.first[0]), tuple(step.refused.shape)
            found.append((float(step.loss[0]), refused, np.array(step.image) if task.images else None))
        gradients = {key: to_array(value) for key, value in problem.gradients().items()}
        _clear(problem)
    losses, refused_parts, images = zip(*found, strict=True) if found else ((), (), ())
    return ShardGradient(gradients, losses, refused_parts, tuple(image for image in images if image is not None))


def scaled(view: View, scale: float) -> Callable[[mi.TensorXf], mi.Float]:
    """Return a view's term in the loss, times `scale`."""
    return view.objective if scale == 1 else lambda image: view.objective(image) * scale


def _tensor(image: Array) -> mi.TensorXf:
    return to_tensor(image.astype(np.float32, copy=False))


def _clear(problem: Problem) -> None:
    for key in problem.optimizer.keys():  # noqa: SIM118 (not a mapping)
        problem.optimizer.clear_gradient(key)


# --- sums of shards ---------------------------------------------------------------------------------------------------


def serially(state: S, function: Callable[..., T], work: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, T]]:
    """Compute shards one after the other in this process. The function is an `Engine` for any `state`."""
    for place, given in enumerate(work):
        yield place, function(state, *given)


def in_order(found: Iterable[tuple[int, T]]) -> Iterator[T]:
    """Yield results in the order of their positions. Early results wait for their turn."""
    early: dict[int, T] = {}
    place = 0
    for at, result in found:
        early[at] = result
        while place in early:
            yield early.pop(place)
            place += 1


class Sum:
    """Weighted sum of arrays, in double precision, in the order of the additions."""

    def __init__(self) -> None:
        self.total: Array | None = None

    def add(self, array: Array, weight: float) -> None:
        """Add `weight` times an array. Values that are not finite stay in the sum."""
        with np.errstate(invalid="ignore", over="ignore"):
            own = array.astype(np.float64) * weight
            self.total = own if self.total is None else self.total + own

    def without(self, array: Array, weight: float) -> Array:
        """Return the float32 mean of all arrays except `array`. `weight` is the weight of `array` if all weights sum to
        1.
        """
        assert self.total is not None
        with np.errstate(invalid="ignore", over="ignore"):
            return np.asarray((self.total - array.astype(np.float64) * weight) / (1 - weight), dtype=np.float32)


def add_gradient(problem: Problem, iteration: int) -> tuple[float, list[tuple[int, Refused]]]:
    """Set the parameters' gradients to the sum over an iteration's shards.

    Returns the loss, and the refused entries of dL/dI by sensor.
    """
    engine, guiding = problem.engine or serially, guiding_of(problem)
    due = [] if guiding is None else _due(problem, guiding, iteration)
    tasks = make_tasks(problem, iteration, images=bool(due))
    total: dict[str, Sum] = {key: Sum() for key in problem.selection.keys}
    means: dict[int, Sum] = {}
    refused: dict[int, Refused] = {}
    loss = 0.0
    deltas: list[Array | None] = [None] * len(tasks)
    if problem.config.in_rounds:
        images = list(in_order(engine(problem, shard_image, [(task,) for task in tasks])))
        for task, image in zip(tasks, images, strict=True):
            means.setdefault(task.parts[0].sensor, Sum()).add(image, task.weight)
        deltas = [_delta(problem, task, image, means, refused) for task, image in zip(tasks, images, strict=True)]
        del images
    work = [(task, delta) for task, delta in zip(tasks, deltas, strict=True)]
    for task, found in zip(tasks, in_order(engine(problem, shard_gradient, work)), strict=True):
        for key, gradient in found.gradients.items():
            total[key].add(gradient, task.weight)
        for part, image in zip(task.parts, found.images, strict=False):
            means.setdefault(part.sensor, Sum()).add(image, task.weight)
        for part, told in zip(task.parts, found.refused, strict=False):
            _count(refused.setdefault(part.sensor, Refused()), *told)
        loss += sum(found.losses) if problem.config.shares == 1 else 0.0
    scales = {part.sensor: part.scale for task in tasks for part in task.parts}
    shown = {view.sensor: (view, scales[view.sensor]) for view in problem.views if view.sensor in means}
    for sensor, (view, scale) in shown.items() if problem.config.shares > 1 else ():
        loss += float(scaled(view, scale)(_mean(means[sensor]))[0])
    for key, leaf in ((key, problem.optimizer[key]) for key in problem.selection.keys):
        with np.errstate(over="ignore", invalid="ignore"):
            gradient = np.asarray(total[key].total, dtype=np.float32)
        dr.set_grad(leaf, like(dr.detach(leaf), gradient))
    for sensor in due:
        _teach(problem, iteration, shown[sensor][0], means[sensor])
    return loss, list(refused.items())


def _mean(found: Sum) -> mi.TensorXf:
    assert found.total is not None
    with np.errstate(over="ignore", invalid="ignore"):
        return _tensor(found.total)


def _delta(problem: Problem, task: Task, image: Array, means: dict[int, Sum], refused: dict[int, Refused]) -> Array:
    """Return dL/dI for one share of a view, evaluated at the mean image of the view's other shares."""
    [part] = task.parts
    view = next(view for view in problem.views if view.sensor == part.sensor)
    others = _tensor(means[part.sensor].without(image, task.weight))
    _, gradient = derivative_of(scaled(view, part.scale), others, refused.setdefault(part.sensor, Refused()))
    return np.array(gradient)


def _count(refused: Refused, count: int, first: int, shape: tuple[int, ...]) -> None:
    """Add the refused entries of a shard. The first refused entry comes from the first shard with refused entries."""
    if count and int(refused.first[0]) == NONE:
        refused.first, refused.shape = dr.opaque(mi.UInt32, first), shape
    refused.count = dr.opaque(mi.UInt32, int(refused.count[0]) + count)


# --- guided emission --------------------------------------------------------------------------------------------------


def _due(problem: Problem, guiding: Guiding, iteration: int) -> list[int]:
    """Count the iteration for the guiding tables, and return the sensors whose tables learn in the iteration."""
    sensors = [view.sensor for view, _ in problem.drawn(iteration)]
    problem.integrator.plan(problem.scene, problem.scene.sensors()[sensors[0]])  # creates the grid
    return [sensor for sensor in sensors if guiding.due(sensor)]


def _teach(problem: Problem, iteration: int, view: View, image: Sum) -> None:
    """Update the guiding tables of a view, with dL/dI at the view's mean image."""
    config = problem.config
    _, gradient = derivative_of(view.objective, _mean(image), Refused())
    sensor, own = problem.scene.sensors()[view.sensor], seed(config.run.seed, iteration, view.sensor, "image")
    job = Job(problem.scene, sensor, dr.opaque(mi.UInt32, own), config.set_spp, problem.selection.params)
    problem.integrator.learn_now(job, gradient)
