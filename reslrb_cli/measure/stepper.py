"""Single measured steps of one experiment (`Steps`), and their sizes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.loader import told
from reslrb_cli.config.schema import Config
from reslrb_cli.integrators.step import gradient_step, known_step
from reslrb_cli.measure.processes import Begun
from reslrb_cli.measure.scenes import small
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.loading import load_configured
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
    params = mi.traverse(scene.sensors()[sensor])
    width, height = (int(n) for n in params["film.size"])
    factor = (pixels / (width * height)) ** 0.5
    if factor >= 1:
        return

    def scaled(name: str, least: int) -> list[int]:
        return [max(round(n * factor), least) for n in params[name]]

    size, offset = scaled("film.size", 1), scaled("film.crop_offset", 0)
    offset = [min(o, n - 1) for o, n in zip(offset, size, strict=True)]
    window = [min(w, n - o) for w, n, o in zip(scaled("film.crop_size", 1), size, offset, strict=True)]
    for name, value in (("film.size", size), ("film.crop_size", window), ("film.crop_offset", offset)):
        params[name] = type(params[name])(*value)
    params.update()


_BITS = {"i1": 8, "half": 16, "float": 32, "double": 64, "ptr": 64}

#: One array of its entries for all lanes of a vector (LLVM): `alloca float, i32 112`.
_LLVM_ARRAY = re.compile(r"%arr_\w+ = alloca (\w+), i32 (\d+)")
_LLVM_LANES = re.compile(r"%index_next = add i64 %index, (\d+)")

#: ... or for one thread (CUDA): `.local .align 4 .b32 arr_12[7];`.
_PTX_ARRAY = re.compile(r"\.local \.align \d+ \.[a-z]+(\d+) arr_\w+\[(\d+)\]")


def scratch_bytes(history: Iterable[dict[str, Any]]) -> int:
    """Return the largest thread-local memory of a path in bytes, over all kernels of a `dr.kernel_history()`."""
    texts = [entry["ir"] for entry in history if entry.get("ir") is not None]
    return max((_of_kernel(text if isinstance(text, str) else str(text.getvalue())) for text in texts), default=0)


def _of_kernel(ir: str) -> int:
    bits = sum(int(size) * int(count) for size, count in _PTX_ARRAY.findall(ir))
    arrays = _LLVM_ARRAY.findall(ir)
    if arrays:
        lanes = _LLVM_LANES.search(ir)
        assert lanes is not None, "a kernel says how many lanes it handles at a time"
        sizes = [_BITS.get(kind) or int(kind.removeprefix("i")) for kind, _ in arrays]
        bits += sum(size * int(count) for size, (_, count) in zip(sizes, arrays, strict=True)) // int(lanes[1])
    return bits // 8


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
    mean of (I - G)^2 with `run.adjoint`. G is noise, because its content does not affect the time.
    """

    def __init__(self, config: Config, objective: str) -> None:
        built_in = config.scene.file == small.FILE
        super().__init__(config, small.build(config.scene.options) if built_in else load_configured(config))
        film = self.problem.scene.sensors()[self.sensor].film()
        width, height = film.crop_size()
        self.size = (int(width), int(height))
        shapes = [self.problem.selection.array(key).shape for key in self.problem.selection.keys]
        self.texels = sum(shape[0] * shape[1] for shape in shapes if len(shape) == 3)
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
    stepper = Stepper(told(first), first["objective"])
    size = {"width": stepper.size[0], "height": stepper.size[1], "texels": stepper.texels}
    return size, lambda question: stepper.step(question["round"], question["cold"], question["release"])


def _noise(width: int, height: int, channels: int) -> Any:
    """Return an image (H, W, C) of positive noise, with zeros in the alpha channel."""
    values = np.random.default_rng(1).uniform(0.5, 1.5, (height, width, channels)).astype(np.float32)
    if channels in (2, 4):
        values[:, :, -1] = 0
    image = mi.TensorXf(values)
    dr.make_opaque(image)
    return image
