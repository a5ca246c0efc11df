"""Finds where a step came upon a value that is not finite: the path, its vertex and the factor, or the loss's pixel.

The paths of the step are traced again from their seeds, and every factor is looked at, with its derivative in the
direction in which all entries of the parameters grow alike: what is not finite in one direction is not in this one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from reslrb_cli.integrators import Reslrb, gradient_step, sample_sets
from reslrb_cli.measure.offender_paths import search_paths
from reslrb_cli.measure.offender_tables import Witness, purposes
from reslrb_cli.optimization.loading import LIGHT_TRACERS, pass_spp
from reslrb_cli.optimization.moving import is_attached
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.state import guiding_of
from reslrb_cli.optimization.views import View
from reslrb_cli.records.offender import Offender
from reslrb_cli.seeds import seed
from reslrb_cli.transport.guide import Table
from reslrb_cli.transport.samples import Samples, passes

Array = np.ndarray[Any, Any]

SUM = "sum of contributions, each of which is finite; the largest"
LOSS = "derivative of the loss, dL/dI"
IMAGE = "image (of this integrator no paths are looked at)"
GRADIENT = "gradient (of this integrator no paths are looked at) of"


def find_offenders(problem: Problem, iteration: int) -> list[Offender]:
    """The first value that is not finite of each view in which there is any; the parameters are those of `problem`."""
    found = []
    guided = guiding_of(problem) is not None
    # What is not drawn in this iteration has taught no table anything.
    for view in [view for view, _ in problem.drawn(iteration)] if guided else problem.views:
        offender = _of_view(problem, iteration, view)
        if offender is not None:
            found.append(offender)
    return found


def _of_view(problem: Problem, iteration: int, view: View) -> Offender | None:
    step_seed = seed(problem.config.run.seed, iteration, view.sensor, "image")
    guiding = guiding_of(problem)
    witness = None if guiding is None else Witness(guiding)
    if witness is not None:
        problem.integrator.preparation.draw_from(witness, problem.scene)
    step = _take_step(problem, view, step_seed)
    if problem.config.integrator.type not in LIGHT_TRACERS:
        return _of_step(step, view.sensor, view.target, None)
    if not is_attached(problem):
        _set_tangents(problem)
    found = [search_paths(*part, step.pixel) for part in _parts(problem, view, step_seed, witness)]
    problem.apply()
    offenders = sorted((part for part in found if part.offender is not None), key=lambda part: not part.there)
    if offenders:
        return offenders[0].offender
    largest = [part.largest for part in found if part.largest is not None]
    most = max(largest, key=lambda entry: max(map(abs, entry.value)), default=None)
    return _of_step(step, view.sensor, view.target, most)


def _parts(
    problem: Problem, view: View, step_seed: int, witness: Witness | None = None
) -> Iterator[tuple[Samples, int, str]]:
    """The samples of a step, pass by pass, with the sensor's index and a name; light paths are those of the run.

    Of a guided one the `witness` knows what it was drawn from.
    """
    scene, sensor = problem.scene, problem.scene.sensors()[view.sensor]
    options = problem.config.integrator.options()
    names = ("max_depth", "rr_depth", "hide_emitters", "sequence")
    shared = {name: options[name] for name in names if name in options}
    tracer = Reslrb.of(estimator="gather", **shared)
    # Of what moves light, contributions alone are looked at: `gather` has no derivatives of it.
    params = None if is_attached(problem) else problem.selection.params
    sets = sample_sets(step_seed, problem.config.step_options())
    tables: list[Table | None] = [None] * len(sets)
    if witness is not None:
        tracer.expect(pass_spp(problem.config))
        tracer.preparation.draw_from(witness, scene)  # for the sake of its grid
        wanted, noted = purposes(problem, view), iter(witness.drawn[:])
        tables = [next(noted) if witness.serves(purpose) else None for _, _, purpose in wanted]
        sets = [(sets[place][0] + word, *sets[place][1:]) for place, word, _ in wanted]
    plan = tracer.plan(scene, sensor, params)
    for (name, samples_seed, spp), table in zip(sets, tables, strict=True):
        parts = passes(plan, scene, sensor, samples_seed, spp, problem.samples_per_pass, table)
        for number, samples in enumerate(parts):
            yield samples, view.sensor, name if len(parts) == 1 else f"{name}, pass {number + 1}"


def _set_tangents(problem: Problem) -> None:
    """Give every entry of every parameter the tangent 1, as far as what of the scene holds it."""
    params, keys = problem.selection.params, problem.selection.keys
    keys = [key for key in keys if key in params]  # an exposure is no part of any path
    for key in keys:
        leaf = problem.optimizer[key]
        dr.set_grad(leaf, 1.0)
        params[key] = leaf
    params.update()
    for key in keys:
        dr.enqueue(dr.ADMode.Forward, problem.optimizer[key])
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)


@dataclass
class Step:
    """Image (H, W, C) and gradients of a step, and the first entry (x, y, channel) of dL/dI that was refused."""

    image: Array
    gradients: dict[str, Array]
    refused: tuple[int, int, int] | None

    @property
    def pixel(self) -> tuple[int, int] | None:
        """The pixel of that entry."""
        return None if self.refused is None else self.refused[:2]


def _take_step(problem: Problem, view: View, step_seed: int) -> Step:
    """The view's step, as the run took it; leaves no gradient behind."""
    optimizer, keys = problem.optimizer, problem.selection.keys
    step = gradient_step(
        problem.integrator, problem.scene, view.sensor, view.objective,
        seed=step_seed, **problem.config.step_options(), params=problem.selection.params,
        on_samples=problem.on_samples(view),
    )  # fmt: skip
    gradients = {key: np.array(gradient) for key, gradient in problem.gradients().items()}
    for key in keys:
        optimizer.clear_gradient(key)
    return Step(np.array(step.image), gradients, step.refused.entry())


def _of_step(step: Step, sensor: int, target: Any, largest: Offender | None) -> Offender | None:
    """What is left where no path has anything: sums that overflow, and the loss."""
    image = step.image
    if step.refused is not None:
        x, y, channel = step.refused
        if np.isfinite(image[y, x]).all():
            here, wanted = (np.array(array)[y, x].tolist() for array in (image, target))
            return Offender(sensor, (x, y), f"{LOSS}, channel {channel}", [], None, here, wanted)
    if all(np.isfinite(array).all() for array in [image, *step.gradients.values()]):
        return None
    if largest is not None:
        return Offender(sensor, largest.pixel, SUM, largest.value, largest.where)
    return _without_paths(sensor, image, np.array(target), step.gradients)


def _without_paths(sensor: int, image: Array, target: Array, gradients: dict[str, Array]) -> Offender:
    """What there is to say where paths were not looked at: the pixel, or else the parameter."""
    if not np.isfinite(image).all():
        y, x, _ = (int(index) for index in np.argwhere(~np.isfinite(image))[0])
        return Offender(sensor, (x, y), IMAGE, image[y, x].tolist(), None, image[y, x].tolist(), target[y, x].tolist())
    [key, *_] = [key for key, gradient in gradients.items() if not np.isfinite(gradient).all()]
    return Offender(sensor, None, f"{GRADIENT} {key}", [], None)
