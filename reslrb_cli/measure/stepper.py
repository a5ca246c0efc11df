"""Single measured steps of one experiment (`Steps`), and changes of film and texture sizes."""

from __future__ import annotations

from collections.abc import Callable
from fnmatch import fnmatchcase
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.loader import told
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.step import gradient_step, known_step
from reslrb_cli.measure.scenes import small
from reslrb_cli.measure.workers import Begun, scratch_bytes
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.loading import choose_sensors, load_configured
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.clock import StepClock, StepTimes, peak_mib, reset_peak
from reslrb_cli.seeds import seed


def multiple_of(spp: int, unit: int | None) -> int:
    """Return the greatest multiple of `unit` that is at most `spp`, but at least `unit`."""
    unit = unit or 1
    return max(spp // unit, 1) * unit


def shrink(scene: Any, sensor: int, pixels: int) -> None:
    """Reduce the film of the sensor with the index `sensor` to about `pixels` pixels. The view stays the same.

    A crop window shrinks with it.
    """
    width, height = (int(n) for n in scene.sensors()[sensor].film().size())
    factor = (pixels / (width * height)) ** 0.5
    if factor < 1:
        scale(scene, sensor, factor)


def scale(scene: Any, sensor: int, factor: float) -> None:
    """Multiply width and height of a sensor's film and of its crop window by `factor`. `sensor` is the index of the
    sensor.
    """
    params = mi.traverse(scene.sensors()[sensor])

    def scaled(name: str, least: int) -> list[int]:
        return [max(round(n * factor), least) for n in params[name]]

    size, offset = scaled("film.size", 1), scaled("film.crop_offset", 0)
    offset = [min(o, n - 1) for o, n in zip(offset, size, strict=True)]
    window = [min(w, n - o) for w, n, o in zip(scaled("film.crop_size", 1), size, offset, strict=True)]
    for name, value in (("film.size", size), ("film.crop_size", window), ("film.crop_offset", offset)):
        params[name] = type(params[name])(*value)
    params.update()


def with_textures(problem: Problem, width: int) -> Config:
    """Return the experiment of `problem` with textures and heightmaps of this width. Aspect ratios stay the same.

    Parameters with several keys keep their size. Raises ConfigError if no texture can be resampled.
    """
    parameters, found = [], False
    for spec in problem.config.parameters:
        shape = None if len(spec.keys) > 1 else _shape_of(spec, problem)
        if shape is not None:
            found = True
            size = (width, max(round(width * shape[0] / shape[1]), 1))
            if spec.heightmap is None:
                changes: dict[str, Any] = {"resolution": size}
            else:
                changes = {"heightmap": spec.heightmap.model_copy(update={"resolution": size})}
            parameters.append(spec.model_copy(update=changes))
        else:
            parameters.append(spec)
    if not found:
        raise ConfigError("--sweep", "", "texture: no parameter is a texture that can be resampled")
    return problem.config.model_copy(update={"parameters": parameters})


def _shape_of(spec: ParameterSpec, problem: Problem) -> tuple[int, ...] | None:
    """Return the shape of the first texture that `spec` names, directly or by a glob."""
    for key, shape in texture_shapes(problem).items():
        if any(name == key or fnmatchcase(key, name) for name in spec.names):
            return shape
    return None


def texture_shapes(problem: Problem) -> dict[str, tuple[int, ...]]:
    """Return the shapes (H, W, C) of all parameters that are textures or heightmaps, by key."""
    shapes = {key: problem.selection.array(key).shape for key in problem.selection.keys}
    return {key: shape for key, shape in shapes.items() if len(shape) == 3}


class Steps:
    """Timed steps of an experiment with its first sensor. The parameters keep their initial values."""

    def __init__(self, config: Config, scene: Any = None) -> None:
        self.problem, self.clock = assemble_scene(config.with_exposures_fixed(), scene), StepClock()
        self.sensor = self.problem.sensors[0]

    def gradient(
        self, seed: int, given: mi.TensorXf | Callable[[mi.TensorXf], mi.Float], spp: int
    ) -> tuple[dict[str, Any], StepTimes]:
        """Return the gradients by key, and times of the step alone. `given` is dL/dI, or the loss as a function of the
        image.
        """
        problem = self.problem
        problem.apply()
        for key in problem.selection.keys:
            dr.clear_grad(problem.optimizer[key])
        seen = problem.integrator, problem.scene, self.sensor
        common: dict[str, Any] = {"seed": seed, "spp": spp, "params": problem.selection.params}
        with self.clock.step() as times:
            if callable(given):
                result = gradient_step(*seen, given, **(problem.config.step_options() | common))
            else:
                result = known_step(*seen, given, **common)
            gradients = problem.gradients()
            dr.eval(result.image, result.loss, gradients)
        return gradients, times

    def told(self, answer: dict[str, Any], cold: bool, release: bool) -> dict[str, Any]:
        """Return the answer for a step. For a `cold` step, the answer includes the peak memory of Dr.Jit's arrays.
        `release` frees the allocator's cache.
        """
        if cold:
            answer["peak_mib"] = peak_mib(dr.backend_v(mi.Float))
        self.clock.history = []
        if release:
            dr.flush_malloc_cache()
        return answer


class Stepper(Steps):
    """The steps of `bench`.

    `objective` is `fixed` or `l2`. `fixed` is sum(G * I) with an image G that is known before the image I. `l2` is the
    mean of (I - G)^2 with `run.adjoint`. G is noise, because its content does not affect the time. `film_width` in
    pixels and `texture_width` in texels replace the widths of the film and of all textures that are parameters.
    """

    def __init__(
        self, config: Config, objective: str, film_width: int | None = None, texture_width: int | None = None
    ) -> None:
        if texture_width is not None:
            config = with_textures(assemble_scene(config, _load(config)), texture_width)
        scene = _load(config)
        if film_width is not None:
            sensor = choose_sensors(config, scene)[0]
            scale(scene, sensor, film_width / int(scene.sensors()[sensor].film().crop_size()[0]))
        super().__init__(config, scene)
        film = self.problem.scene.sensors()[self.sensor].film()
        width, height = film.crop_size()
        self.size = (int(width), int(height))
        self.texels = sum(shape[0] * shape[1] for shape in texture_shapes(self.problem).values())
        image = _noise(*self.size, int(film.base_channels_count()))
        self._given = image if objective == "fixed" else lambda seen: dr.mean(dr.square(seen - image).array)

    def step(self, round: int, cold: bool, release: bool) -> dict[str, Any]:
        """Take one step and measure it. For a `cold` step, memory is measured as well. Every step that is not `cold`
        runs twice, and only the second run is timed.

        `release` frees the allocator's cache afterwards.
        """
        run, new_kernels = self.problem.config.run, 0
        at = seed(run.seed, round, self.sensor, "image")
        if cold:
            reset_peak()
        else:
            # Other processes may have changed the caches since the last step, which must not cost this one.
            new_kernels = self.gradient(at, self._given, run.spp)[1].new_kernels
        times = self.gradient(at, self._given, run.spp)[1]
        answer = {
            "step_ms": times.wall_ms,
            "kernel_ms": times.kernel_ms,
            "codegen_ms": times.codegen_ms,
            "tracing_ms": max(times.wall_ms - times.kernel_ms - times.codegen_ms, 0.0),
            "new_kernels": new_kernels + times.new_kernels,
        }
        if cold:
            answer["scratch_bytes"] = scratch_bytes(self.clock.history)
        return self.told(answer, cold, release)


def begin_steps(first: dict[str, Any]) -> Begun:
    """Start the process. The process first reports the size of film and textures. Each question then asks for a
    step.
    """
    config = told(first)
    stepper = Stepper(config, first["objective"], first.get("film_width"), first.get("texture_width"))
    size = {"width": stepper.size[0], "height": stepper.size[1], "texels": stepper.texels}
    return size, lambda question: stepper.step(question["round"], question["cold"], question["release"])


def _load(config: Config) -> Any:
    """Load the scene of an experiment, which may be the built-in one."""
    if config.scene.file == small.FILE:
        return small.build(config.scene.options)
    return load_configured(config)


def _noise(width: int, height: int, channels: int) -> Any:
    """Return an image (H, W, C) of positive noise, with zeros in the alpha channel."""
    values = np.random.default_rng(1).uniform(0.5, 1.5, (height, width, channels)).astype(np.float32)
    if channels in (2, 4):
        values[:, :, -1] = 0
    image = mi.TensorXf(values)
    dr.make_opaque(image)
    return image
