"""What a run will take, memory and time: measured on a few of its own steps, with a target of few samples."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.backend.device import resident_paths
from reslrb_cli.backend.memory import free_bytes
from reslrb_cli.config import Config
from reslrb_cli.integrators import Reslrb as Tracer
from reslrb_cli.optimization.certainty import LEAST_ITERATIONS
from reslrb_cli.optimization.choice import Cache, find_options, settle_integrator
from reslrb_cli.optimization.problem import Problem, assemble_scene
from reslrb_cli.optimization.rendering import saved_spp
from reslrb_cli.optimization.sequence_choice import settle_sampling
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.trial import measure_steps

#: Steps, more or less, that the verdicts on the values take after the last one.
VERDICTS = 30


@dataclass(frozen=True)
class Forecast:
    """Bytes of the iterations, by part (`parts`; all that the allocator gives out adds up to `peak`), and beside them
    `scratch`, thread-local; seconds of the run, by part. `iteration_s` is one iteration, `start_s` what the first ones
    take longer when all kernels are there, `compile_s` what compiling them took now, `spp` the samples of the steps
    that were measured."""

    parts: dict[str, int]
    scratch: int
    free: int
    iterations: int
    iteration_s: float
    start_s: float
    compile_s: float
    pilot_s: float
    target_s: float
    images_s: float
    verdicts_s: float
    spp: int

    @property
    def peak(self) -> int:
        """Bytes of the allocator at the most, as `peak_mib` in `metrics.jsonl` has them."""
        return sum(self.parts.values())

    @property
    def elapsed_s(self) -> float:
        """Seconds of the iterations, as `elapsed_s` in `metrics.jsonl` counts them, with all kernels there."""
        return self.iterations * self.iteration_s + self.start_s

    @property
    def whole_s(self) -> float:
        """Seconds of the whole run, with kernels and pilot as they are kept now."""
        return self.elapsed_s + self.target_s + self.images_s + self.verdicts_s


def make_forecast(
    config: Config,
    say: Callable[[str], None],
    cache: Cache | None = None,
    before: Callable[[Problem], object] = lambda problem: None,
) -> Forecast:
    """Measure a few steps of the run that `config` describes; a variant must be set.

    `say` is told what takes long; what a pilot learns is kept in `cache`, for the run. `before` is called where a run
    measures what it does before its first iteration: with its integrator settled, and its parameters where they begin.
    Raises ConfigError and UnsupportedScene as the run would, and what its steps raise.
    """
    problem = assemble_scene(_with_short_target(config))
    options = find_options(problem)
    buffers = _buffers(problem)
    make_targets(problem, say)
    problem.truth.clear()  # errors are no part of a step
    settle_integrator(problem, options, say, cache)
    settle_sampling(problem, say, cache)
    image_s = _image_seconds(problem)
    before(problem)
    say("measuring a few steps")
    steps, scratch = measure_steps(problem), _scratch(problem)
    run, measured = config.run, (problem.pilot, problem.guided, problem.sequence)
    targets = sum(4 * int(dr.prod(view.target.shape)) for view in problem.views)
    parts = {
        "geometry": buffers["geometry"],
        "textures and other values of the scene": buffers["values"],
        "targets": targets,
        "optimiser's state": _state_bytes(problem),
    }
    parts["images of a step, gradients, what is kept of paths (reservoir)"] = max(steps.peak - sum(parts.values()), 0)
    between = run.iterations // run.images_every if run.images_every else 0
    images = 2 * saved_spp(problem, between=False) + between * saved_spp(problem, between=True)
    render = config.target.render
    views = len(problem.views)
    return Forecast(
        parts=parts,
        scratch=scratch,
        free=free_bytes(mi.variant()),
        iterations=run.iterations,
        iteration_s=steps.step_s,
        start_s=steps.start_s,
        compile_s=steps.compile_s,
        pilot_s=sum(each.measure_s + each.compile_s for each in measured if each and not each.cached),
        target_s=0.0 if render is None else image_s * render.spp * views,
        images_s=image_s * images * views,
        verdicts_s=VERDICTS * steps.step_s if run.certainty and run.iterations >= LEAST_ITERATIONS else 0.0,
        spp=steps.spp,
    )


def _with_short_target(config: Config) -> Config:
    """The experiment with a target of no more samples than tell its noise from a step's: four steps' worth."""
    render = config.target.render
    if render is None:
        return config
    unit = (render.integrator or config.integrator).options().get("samples_per_pass") or 1
    spp = min(render.spp, -(-4 * config.run.spp // unit) * unit)
    target = config.target.model_copy(update={"render": render.model_copy(update={"spp": spp})})
    return config.model_copy(update={"target": target})


def _image_seconds(problem: Problem) -> float:
    """Seconds that a sample per pixel of a saved image takes, of the first view."""
    view, spp = problem.views[0], saved_spp(problem, between=True)
    problem.render(view.sensor, spp, 0, "forecast")  # compiles, and records what is small: several times as long
    begin = time.perf_counter()
    problem.render(view.sensor, spp, 1, "forecast")
    return (time.perf_counter() - begin) / spp


# --- what memory is for -----------------------------------------------------------------------------------------------


def _buffers(problem: Problem) -> dict[str, int]:
    """Bytes of the scene's values that a script can reach, those of shapes apart."""
    found = {"geometry": 0, "values": 0}
    params = problem.selection.params
    for key in params.properties:
        value = params[key]
        if isinstance(value, dr.ArrayBase):
            name = key.rpartition(".")[2]
            part = "geometry" if name.startswith(("vertex_", "faces", "to_world")) else "values"
            found[part] += _bytes(value)
    return found


def _bytes(value: dr.ArrayBase) -> int:
    """Bytes of an array of Dr.Jit."""
    return int(dr.prod(dr.shape(value))) * int(dr.itemsize_v(value))


def _state_bytes(problem: Problem) -> int:
    """Bytes of the optimiser's state: values and moments."""
    return sum(_bytes(value) for value in problem.optimizer.state().values() if isinstance(value, dr.ArrayBase))


def _scratch(problem: Problem) -> int:
    """Thread-local bytes of all paths that are traced at a time."""
    integrator = problem.integrator
    if not isinstance(integrator, Tracer):
        return 0
    plans = [
        integrator.plan(problem.scene, problem.scene.sensors()[index], problem.selection.params)
        for index in problem.sensors
    ]
    return max(integrator.estimator.scratch_bytes(plan) for plan in plans) * resident_paths()
