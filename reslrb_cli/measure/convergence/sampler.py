"""Steps of one method, timed and kept: gradients or images, in a process of its own (`worker.py`)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import loads
from reslrb_cli.integrators import gradient_step, known_step, render_image
from reslrb_cli.measure.convergence.survey import masked_loss
from reslrb_cli.measure.worker import Begun
from reslrb_cli.optimization.problem import assemble_scene
from reslrb_cli.optimization.views import set_targets, to_tensor
from reslrb_cli.records.clock import StepClock, StepTimes, peak_mib, reset_peak
from reslrb_cli.seeds import seed


class Sampler:
    """Takes steps through the first sensor; the parameters keep their initial values.

    `mode` says what is sampled: `known`, the gradient with dL/dI held at one of `adjoints`; `loss`, the gradient of the
    experiment's own loss with its `run.adjoint`; `image`. `arrays` are the survey's.
    """

    def __init__(self, config: Any, mode: str, arrays: dict[str, np.ndarray]) -> None:
        self.problem, self.mode, self.clock = assemble_scene(config.with_exposures_fixed()), mode, StepClock()
        self.sensor = self.problem.sensors[0]
        self.view = self.problem.views[0]
        if "adjoints" in arrays:
            set_targets([self.view], arrays)
        self.mask = None if arrays["mask"].all() else to_tensor(arrays["mask"])
        self.adjoints = [to_tensor(array) for array in arrays.get("adjoints", ())]
        self.inside = arrays["mask"] != 0

    def step(self, seed: int, spp: int, image: int) -> tuple[np.ndarray, StepTimes]:
        """One sample, all parameters (or pixels) in a row, float32; what it took is of the step alone."""
        problem = self.problem
        if self.mode == "image":
            with dr.suspend_grad(), self.clock.step() as times:
                picture = render_image(problem.integrator, problem.scene, self.sensor, seed, spp)
                dr.eval(picture)
            return (np.array(picture, np.float32) * self.inside).ravel(), times
        problem.apply()
        for key in problem.selection.keys:
            dr.clear_grad(problem.optimizer[key])
        with self.clock.step() as times:
            result = self._gradient(seed, spp, image)
            gradients = problem.gradients()
            dr.eval(result.image, result.loss, gradients)
        row = [np.array(gradients[key], np.float32).ravel() for key in problem.selection.keys]
        return np.concatenate(row), times

    def _gradient(self, seed: int, spp: int, image: int) -> Any:
        problem = self.problem
        common: dict[str, Any] = {"seed": seed, "params": problem.selection.params}
        if self.mode == "known":
            adjoint = self.adjoints[image % len(self.adjoints)]
            return known_step(problem.integrator, problem.scene, self.sensor, adjoint, spp=spp, **common)

        def loss(picture: mi.TensorXf) -> mi.Float:
            return masked_loss(self.view, picture, self.mask)

        options = problem.config.step_options() | {"spp": spp}
        return gradient_step(problem.integrator, problem.scene, self.sensor, loss, **options, **common)


def begin(first: dict[str, Any]) -> Begun:
    """Begin the process. A question asks for `count` steps from number `start` on, with `spp` samples per pixel.

    Its answer has `step_ms` of each and the number of `new_kernels`; the samples (count, P) go to the file `out`. Where
    `cold`, also the peak of Dr.Jit's arrays. Seeds are those of the `purpose`; `image` says which dL/dI.
    """
    config = loads(first["config"], first["source"])
    with np.load(first["arrays"]) as arrays:
        sampler = Sampler(config, first["mode"], {name: arrays[name] for name in arrays.files})

    def answer(question: dict[str, Any]) -> dict[str, Any]:
        if question["cold"]:
            reset_peak()
        rows, taken = [], []
        for number in range(question["start"], question["start"] + question["count"]):
            number_seed = seed(config.run.seed, number, sampler.sensor, first["purpose"])
            row, times = sampler.step(number_seed, question["spp"], question["image"])
            rows.append(row)
            taken.append(times)
        np.save(question["out"], np.stack(rows))
        reply: dict[str, Any] = {
            "step_ms": [times.wall_ms for times in taken],
            "new_kernels": sum(times.new_kernels for times in taken),
        }
        if question["cold"]:
            reply["peak_mib"] = peak_mib(dr.backend_v(mi.Float))
        sampler.clock.history = []
        if question["release"]:
            dr.flush_malloc_cache()
        return reply

    return {}, answer
