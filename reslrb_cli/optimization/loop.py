"""The optimisation loop, which yields records and opens no file, and its learning-rate schedules.

A schedule is the factor of iteration i of n, from 1 at the first to `final_fraction` at the last.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.integrators.step import Refused, gradient_step
from reslrb_cli.optimization.nonfinite import Findings, RefusedAt, count_nonfinite, finite_square_norm, zero_nonfinite
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import rescale
from reslrb_cli.optimization.state import State
from reslrb_cli.optimization.views import View
from reslrb_cli.records.clock import peak_mib, reset_peak
from reslrb_cli.records.metrics import Record
from reslrb_cli.seeds import seed


def constant(progress: float, final_fraction: float) -> float:
    """1 throughout."""
    return 1.0


def cosine(progress: float, final_fraction: float) -> float:
    """Half a period of a cosine (Loshchilov and Hutter 2017, without restarts)."""
    return final_fraction + (1.0 - final_fraction) * 0.5 * (1.0 + math.cos(math.pi * progress))


def exponential(progress: float, final_fraction: float) -> float:
    """The same factor from each iteration to the next."""
    return float(final_fraction**progress)


SCHEDULES: dict[str, Callable[[float, float], float]] = {
    "constant": constant,
    "cosine": cosine,
    "exponential": exponential,
}


def learning_rate_factor(
    schedule: str, iteration: int, iterations: int, final_fraction: float, least: float = 0.0
) -> float:
    """Return the factor of `iteration` (0-based) of `iterations`. Raises KeyError for an unknown schedule.

    `least` (0 to 1) is how far a run is at least, of which less than all iterations will be made.
    """
    return SCHEDULES[schedule](max(iteration / max(iterations - 1, 1), least), final_fraction)


#: Iterations between two looks at what is held out.
HELD_OUT_EVERY = 10


def optimize(
    problem: Problem,
    on_nonfinite: Callable[[Findings], None] = lambda found: None,
    state: State | None = None,
    progress: Callable[[], float] = lambda: 0.0,
) -> Iterator[Record]:
    """Run the iterations of `problem`, one record each; the parameters are updated when a record is yielded.

    They go on from `state`, if one is given, and leave there what the next one goes on from.

    An iteration is a step (image, loss and gradient of every sensor; the loss is the mean over the sensors) and an
    update. What is not finite reaches no parameter; what happens instead, and when NonFinite is raised, is in
    `NonFinitePolicy`. `on_nonfinite` is told of it before the update, while the scene is as it was in the step.
    `optimizer.scale: auto` measures before the first iteration, and `elapsed_s` counts that. Where a time may end the
    run, `progress` says what share of it has gone (0 to 1): the schedule is as far as that, or as the iterations.
    """
    config = problem.config
    state = State(problem) if state is None else state
    clock, policy, clamp, peak_before = state.clock, state.policy, state.clamp, state.peak_mib
    reset_peak()
    if config.optimizer.scale == "auto" and state.sensitivities is None:
        with clock.counted():
            state.sensitivities = rescale(problem)
    meter = problem.error_meter()
    for iteration in range(state.iteration, config.run.iterations):
        errors = meter.errors(problem.selection.array)
        held_out = problem.held_out_loss() if iteration % HELD_OUT_EVERY == 0 else None
        with clock.step() as times:
            split = Split()
            loss, squares, counts, refused = gradient(problem, iteration, split)
            dr.eval(loss, squares, counts)
        factor = learning_rate_factor(
            config.optimizer.schedule, iteration, config.run.iterations, config.optimizer.final_fraction, progress()
        )
        with clock.counted():
            value = float(loss[0])
            found = _findings(problem, iteration, value, counts, refused)
            if found:
                on_nonfinite(found)
            held = policy.held(found, problem.optimizer.keys())
            for key in found.gradients if policy.kind == "zero" else ():
                zero_nonfinite(problem.optimizer[key])
            moved = [key for key in problem.optimizer.keys() if key not in held]  # noqa: SIM118 (not a mapping)
            clamped = None if clamp is None else clamp.apply({key: problem.optimizer[key] for key in moved})
            found.updates = problem.optimizer.step(factor, skip=held)
            problem.apply()
        policy.see(found, held)
        state.iteration = iteration + 1
        state.peak_mib = max(peak_before, peak_mib(dr.backend_v(loss)))
        yield Record(
            iteration=iteration,
            loss=value,
            step_ms=times.wall_ms,
            primal_ms=split.primal_ms,
            adjoint_ms=None if split.primal_ms is None else times.wall_ms - split.primal_ms,
            codegen_ms=times.codegen_ms,
            elapsed_s=clock.elapsed_s,
            peak_mib=state.peak_mib,
            spp=config.run.spp,
            lr=config.optimizer.learning_rate * factor,
            grad_norm=float(sum(float(square[0]) for square in squares.values()) ** 0.5),
            nonfinite=found.total,
            parameter_rmse=meter.total(errors),
            parameter_errors=errors,
            nonfinite_by_parameter=found.by_parameter,
            clamped=clamped,
            held_out=held_out,
        )
        policy.check(found)


def _findings(
    problem: Problem, iteration: int, loss: float, counts: dict[str, Any], refused: list[tuple[int, Refused]]
) -> Findings:
    """What of a step was not finite; `refused` are the steps' counts, by sensor."""
    found = Findings(iteration, loss=not math.isfinite(loss))
    found.gradients = {key: int(count[0]) for key, count in counts.items() if count[0]}
    found.lost = [key for key, bad in found.gradients.items() if bad == dr.prod(dr.shape(problem.optimizer[key]))]
    for sensor, view in refused:
        first = view.entry()
        if first is not None:
            found.refused[sensor] = RefusedAt(int(view.count[0]), first)
    return found


def _scaled(view: View, scale: float, image: mi.TensorXf) -> mi.Float:
    """A view's part of the loss, `scale` times."""
    return view.objective(image) if scale == 1 else view.objective(image) * scale


class Split:
    """Tells the time of a step up to its image and loss, where the integrator has a moment in which both are there."""

    def __init__(self) -> None:
        self.primal_ms: float | None = 0.0
        self._start: float | None = None

    def start(self) -> None:
        """A view begins."""
        if self._start is not None:  # the view before never came to `image`
            self.primal_ms = None
        self._start = time.perf_counter()

    def image(self) -> None:
        """Its image and loss are evaluated, or launched."""
        dr.sync_thread()
        if self.primal_ms is not None and self._start is not None:
            self.primal_ms += 1e3 * (time.perf_counter() - self._start)
        self._start = None

    def end(self) -> None:
        """No view is left."""
        if self._start is not None:
            self.primal_ms = None


def gradient(
    problem: Problem, iteration: int, split: Split
) -> tuple[Any, dict[str, Any], dict[str, Any], list[tuple[int, Refused]]]:
    """Accumulate the gradient of the loss into the parameters.

    `split` is told of each view's parts. Returns width-1 arrays: the loss, for each parameter the gradient's sum
    of squares (of its finite entries) and the number of entries that are not finite, and by sensor what was refused.
    """
    config = problem.config
    total: Any = 0.0
    refused = []
    for view, scale in problem.drawn(iteration):
        split.start()
        step = gradient_step(
            problem.integrator,
            problem.scene,
            view.sensor,
            functools.partial(_scaled, view, scale),
            seed=seed(config.run.seed, iteration, view.sensor, "image"),
            **config.step_options(),
            params=problem.selection.params,
            on_image=split.image,
            on_samples=problem.on_samples(view),
        )
        # One view's kernels are not to wait for the next one's: memory would grow with the number of views.
        gradients = problem.gradients()
        dr.eval(step.loss, gradients)
        total = total + step.loss
        refused.append((view.sensor, step.refused))
    split.end()
    squares = {key: finite_square_norm(value) for key, value in gradients.items()}
    return total, squares, {key: count_nonfinite(value) for key, value in gradients.items()}, refused
