"""Finds where a step came upon a value that is not finite: the path, its vertex and the factor, or the loss's pixel.

The paths of the step are traced again from their seeds, and every factor is looked at, with its derivative in the
direction in which all entries of the parameters grow alike: what is not finite in one direction is not in this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators import gradient_step, make_integrator, sample_sets
from reslrb_cli.integrators.light_tracer import Samples, trace
from reslrb_cli.measure.offender_walk import QUANTITIES, SearchHooks, Suspect, is_bad
from reslrb_cli.optimization.problem import LIGHT_TRACERS, Problem
from reslrb_cli.records.offender import Offender, PathVertex
from reslrb_cli.seeds import seed
from reslrb_cli.transport.emission import Emission, sample_emission
from reslrb_cli.transport.transmittance import forward_derivatives
from reslrb_cli.transport.visible import visible_radiance, visible_tangent

Array = np.ndarray[Any, Any]

SUM = "sum of contributions, each of which is finite; the largest"
LOSS = "derivative of the loss, dL/dI"
IMAGE = "image (of this integrator no paths are looked at)"
GRADIENT = "gradient (of this integrator no paths are looked at) of"


def find_offenders(problem: Problem, iteration: int) -> list[Offender]:
    """The first value that is not finite of each view in which there is any; the parameters are those of `problem`."""
    found = []
    for sensor, target in zip(problem.sensors, problem.targets, strict=True):
        offender = _of_view(problem, iteration, sensor, target)
        if offender is not None:
            found.append(offender)
    return found


def _of_view(problem: Problem, iteration: int, sensor: int, target: Any) -> Offender | None:
    run = problem.config.run
    step_seed, largest = seed(run.seed, iteration, sensor, "image"), None
    step = _take_step(problem, sensor, target, step_seed)
    if problem.config.integrator.type in LIGHT_TRACERS:
        tracer = _tracer(problem)
        _set_tangents(problem)
        for name, samples_seed, spp in sample_sets(step_seed, run.step_options()):
            parts = tracer.passes(
                problem.scene, problem.scene.sensors()[sensor], samples_seed, spp, problem.selection.params
            )
            for number, samples in enumerate(parts):
                label = name if len(parts) == 1 else f"{name}, pass {number + 1}"
                offender, peak = _of_samples(samples, sensor, label, step.pixel)
                if offender is not None:
                    return offender
                largest = max((largest, peak), key=lambda entry: -1.0 if entry is None else max(map(abs, entry.value)))
        problem.apply()
    return _of_step(step, sensor, target, largest)


def _tracer(problem: Problem) -> Any:
    """An integrator that traces the same light paths as that of the run."""
    options = problem.config.integrator.options()
    shared = {name: options[name] for name in ("max_depth", "rr_depth", "hide_emitters")}
    return make_integrator("reslrb", estimator="gather", samples_per_pass=problem.samples_per_pass, **shared)


def _set_tangents(problem: Problem) -> None:
    """Give every entry of every parameter the tangent 1, as far as what of the scene holds it."""
    params, keys = problem.selection.params, problem.selection.keys
    for key in keys:
        leaf = problem.optimizer[key]
        dr.set_grad(leaf, 1.0)
        params[key] = leaf
    params.update()
    for key in keys:
        dr.enqueue(dr.ADMode.Forward, problem.optimizer[key])
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)


# --- paths ------------------------------------------------------------------------------------------------------------


def _of_samples(
    samples: Samples, sensor: int, label: str, pixel: tuple[int, int] | None
) -> tuple[Offender | None, Offender | None]:
    """The offender of the first path that has one, one to `pixel` where there is any, and the largest contribution."""
    plan = samples.plan
    with dr.suspend_grad():
        with dr.resume_grad():
            E = sample_emission(plan, samples.scene, samples.sensor, samples.sampler())
            [dE] = forward_derivatives(E.weight) if plan.differentiate_emission else [mi.Spectrum(0)]
        hooks = SearchHooks(samples, Emission(E.ray, dr.detach(E.weight)), dE)
        state = trace(samples, hooks)
        dr.eval(state)
    size = np.array(dr.max(dr.abs(state.largest.value)))
    lane = int(np.argmax(np.where(np.isfinite(size), size, 0)))
    peak = _offender(samples, sensor, label, state.largest, state.largest_u, lane) if size[lane] > 0 else None
    lanes = np.flatnonzero(np.array(state.found.kind))
    if lanes.size:
        return _offender(samples, sensor, label, state.found, state.u, _first(lanes, state.u, pixel)), peak
    return _of_visible_emission(samples, sensor, label), peak


def _first(lanes: Array, u: Any, pixel: tuple[int, int] | None) -> int:
    """The first of these lanes, of those that land in `pixel` if any do."""
    x, y = (np.floor(np.array(component))[lanes] for component in u)
    there = lanes[(x == pixel[0]) & (y == pixel[1])] if pixel is not None else lanes[:0]
    return int(there[0] if there.size else lanes[0])


def _of_visible_emission(samples: Samples, sensor: int, label: str) -> Offender | None:
    plan = samples.plan
    if not plan.visible_emission:
        return None
    with dr.suspend_grad():
        primary = samples.primary_ray()
        radiance = visible_radiance(plan, samples.scene, primary)
        tangent = mi.Spectrum(0)
        if plan.differentiate_emission or plan.differentiate_null:
            tangent = visible_tangent(plan, samples.scene, primary)
        si = samples.scene.ray_intersect(primary.ray, primary.active)
        p = dr.select(si.is_valid(), si.p, primary.ray.o)
        for name, value in (("emission E towards the sensor", radiance), ("derivative of emission, dE", tangent)):
            lanes = np.flatnonzero(np.array(primary.active & is_bad(value) & dr.mask_t(primary.u.x)(True)))
            if lanes.size:
                shape = dr.reinterpret_array(mi.UInt32, si.shape)
                suspect = Suspect(mi.UInt32(0), mi.UInt32(0), p, shape, mi.Spectrum(value))
                return _offender(samples, sensor, label, suspect, primary.u, int(lanes[0]), name)
    return None


def _offender(
    samples: Samples, sensor: int, label: str, suspect: Suspect, u: Any, lane: int, quantity: str | None = None
) -> Offender:
    def numbers(value: Any) -> list[float]:
        return [float(np.array(channel).ravel()[lane % dr.width(channel)]) for channel in value]

    def number(value: Any) -> int:
        return int(np.array(value).ravel()[lane % dr.width(value)])

    x, y = numbers(u)
    position = tuple(numbers(suspect.p))
    where = PathVertex(
        label,
        int(samples.seed[0]),
        lane,
        samples.width,
        number(suspect.vertex),
        position,  # type: ignore[arg-type]
        _shape_name(samples.scene, number(suspect.shape)),
    )
    pixel = (int(np.floor(x)), int(np.floor(y)))
    return Offender(sensor, pixel, quantity or QUANTITIES[number(suspect.kind)], numbers(suspect.value), where)


def _shape_name(scene: Any, index: int) -> str | None:
    for shape in scene.shapes():
        if int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) == index:
            return str(shape.id())
    return None


# --- the step itself --------------------------------------------------------------------------------------------------


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


def _take_step(problem: Problem, sensor: int, target: Any, step_seed: int) -> Step:
    """The view's step, as the run took it; leaves no gradient behind."""
    optimizer, keys = problem.optimizer, problem.selection.keys
    step = gradient_step(
        problem.integrator, problem.scene, sensor, lambda image: problem.compare(image, target) / len(problem.sensors),
        seed=step_seed, **problem.config.run.step_options(), params=problem.selection.params,
    )  # fmt: skip
    gradients = {key: np.array(optimizer.gradient(key)) for key in keys}
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
