"""Steps of one experiment, measured one by one."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config
from reslrb_cli.integrators import gradient_step, known_step
from reslrb_cli.measure import cornell_box
from reslrb_cli.measure.film import texture_shapes, widen, with_textures
from reslrb_cli.measure.scratch import scratch_bytes
from reslrb_cli.optimization.loading import choose_sensors, load_configured
from reslrb_cli.optimization.problem import assemble_scene
from reslrb_cli.records.clock import StepClock, StepTimes, peak_mib, reset_peak
from reslrb_cli.seeds import seed


class Stepper:
    """Takes steps of an experiment through its first sensor; the parameters keep their initial values.

    `objective` is `fixed`, sum(G * I) with a fixed image G, known before the image I, or `l2`, the mean of (I - G)^2
    with `run.adjoint`. G is noise: what it shows costs nothing. `film_width` and `texture_width`, in pixels and texels,
    are those of the film and of all textures that are parameters, where they are not to be the scene's own.
    """

    def __init__(
        self, config: Config, objective: str, film_width: int | None = None, texture_width: int | None = None
    ) -> None:
        if texture_width is not None:
            config = with_textures(assemble_scene(config, _load(config)), texture_width)
        scene = _load(config)
        if film_width is not None:
            widen(scene, choose_sensors(config, scene)[0], film_width)
        self.problem = assemble_scene(config.with_exposures_fixed(), scene)
        self.sensor = self.problem.sensors[0]
        self.known = objective == "fixed"
        film = self.problem.scene.sensors()[self.sensor].film()
        width, height = film.crop_size()
        self.size = (int(width), int(height))
        self.texels = sum(shape[0] * shape[1] for shape in texture_shapes(self.problem).values())
        self.image = _noise(*self.size, int(film.base_channels_count()))
        self.clock = StepClock()

    def step(self, round: int, cold: bool, release: bool) -> dict[str, Any]:
        """Take one step and measure it, `cold` ones also their memory; others are taken twice, and the second counts.

        `release` gives the allocator's cache back afterwards.
        """
        new_kernels = 0
        if cold:
            reset_peak()
        else:
            # What other processes did since the last step, to caches above all, is to cost this one nothing.
            new_kernels = self._timed(round).new_kernels
        times = self._timed(round)
        new_kernels += times.new_kernels
        answer = {
            "step_ms": times.wall_ms,
            "kernel_ms": times.kernel_ms,
            "codegen_ms": times.codegen_ms,
            "tracing_ms": max(times.wall_ms - times.kernel_ms - times.codegen_ms, 0.0),
            "new_kernels": new_kernels,
        }
        if cold:
            answer["peak_mib"] = peak_mib(dr.backend_v(mi.Float))
            answer["scratch_bytes"] = scratch_bytes(self.clock.history)
        self.clock.history = []
        if release:
            dr.flush_malloc_cache()
        return answer

    def _timed(self, round: int) -> StepTimes:
        problem = self.problem
        problem.apply()
        for key in problem.selection.keys:
            dr.clear_grad(problem.optimizer[key])
        with self.clock.step() as times:
            result = self._take(seed(problem.config.run.seed, round, self.sensor, "image"))
            dr.eval(result.image, result.loss, problem.gradients())
        return times

    def _take(self, seed: int) -> Any:
        problem, run = self.problem, self.problem.config.run
        common = {"seed": seed, "params": problem.selection.params}
        if self.known:
            return known_step(problem.integrator, problem.scene, self.sensor, self.image, spp=run.spp, **common)

        def loss(image: Any) -> Any:
            return dr.mean(dr.square(image - self.image).array)

        return gradient_step(
            problem.integrator, problem.scene, self.sensor, loss, **problem.config.step_options(), **common
        )


def _load(config: Config) -> Any:
    """The scene of an experiment, which may be the built-in one."""
    if config.scene.file == cornell_box.FILE:
        return cornell_box.build(config.scene.options)
    return load_configured(config)


def _noise(width: int, height: int, channels: int) -> Any:
    """An image (H, W, C) of positive noise; nothing in an alpha channel."""
    values = np.random.default_rng(1).uniform(0.5, 1.5, (height, width, channels)).astype(np.float32)
    if channels in (2, 4):
        values[:, :, -1] = 0
    image = mi.TensorXf(values)
    dr.make_opaque(image)
    return image
