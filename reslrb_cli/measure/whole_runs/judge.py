"""What all runs are judged by, in a process of its own (`worker.py`): one target, and images of the same samples.

A method's own loss is of the image that it renders itself: its noise, and where `run.adjoint` takes it from, are part
of it. So losses are taken here, of images by one integrator with the same seeds for all values; none of it is in the
time of any method.
"""

from __future__ import annotations

import time
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config import loads
from reslrb_cli.measure.border_mask import leave_out_border
from reslrb_cli.measure.convergence.survey import affordable_paths, find_references, multiple_of, shorten_target
from reslrb_cli.measure.whole_runs.runner import copies, load
from reslrb_cli.measure.worker import Begun
from reslrb_cli.optimization import find_reached
from reslrb_cli.optimization.errors import ErrorMeter
from reslrb_cli.optimization.problem import Problem, assemble_scene
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.views import set_targets, target_arrays

Array = np.ndarray[Any, Any]

#: The purpose of the samples of the images.
_PURPOSE = "convergence, runs"
#: The share of the time that the target may take.
TARGET_SHARE = 0.1
#: The fewest samples per pixel of the images, whatever they take: the noise of fewer would be all that losses show.
LEAST_SPP = 16


class Judge:
    """Losses and errors of the parameters of `problem`, whose targets are made; `spp` are those of an image."""

    def __init__(self, problem: Problem, spp: int) -> None:
        self.problem, self.spp, self.meter = problem, spp, problem.error_meter()

    def loss(self, values: dict[str, Array]) -> float:
        """The loss of images with `values`, by key, of all views by their shares."""
        problem = self.problem
        problem.selection.set_arrays(values)
        total = 0.0
        for view in problem.trained:
            image = problem.render(view.sensor, self.spp, 0, _PURPOSE)
            total += float(view.objective(mi.TensorXf(np.ascontiguousarray(image)))[0])
        return total

    def error(self, values: dict[str, Array]) -> float | None:
        """The error of all parameters together; None where no true value is known."""
        return joint_error(self.meter, values)


def joint_error(meter: ErrorMeter, values: dict[str, Array]) -> float | None:
    """The root mean square error of all parameters, or, where they have no common unit, of their relative errors."""
    errors = meter.errors(lambda key: values[key])
    total = meter.total(errors)
    if total is not None:
        return total
    relative = list(meter.relative(errors).values())
    return float(np.sqrt(np.mean(np.square(relative)))) if relative else None


def begin(first: dict[str, Any]) -> Begun:
    """Begin the process. The first question is to `prepare`: it names the file for the targets, `out`; see `prepare`.

    Or it is to `restore` what an earlier process has prepared: it names the file of its `targets`; see `restore`.
    Each other one names a file of `values`; its answer has their `loss` and `error`.
    """
    start = time.perf_counter()
    problem = assemble_scene(loads(first["config"], first["source"]))
    loading_s = time.perf_counter() - start
    judges: list[Judge] = []

    def answer(question: dict[str, Any]) -> dict[str, Any]:
        if "prepare" in question:
            judge, facts = prepare(problem, question["out"], **question["prepare"])
            judges.append(judge)
            return facts
        if "restore" in question:
            judge, facts = restore(problem, question["targets"], **question["restore"])
            judges.append(judge)
            return facts
        values = load(question["values"], problem.selection.keys)
        return {"loss": judges[0].loss(values), "error": judges[0].error(values)}

    return {"loading_s": loading_s}, answer


def prepare(
    problem: Problem, out: str, budget_s: float, image_s: float, camera: bool, named: bool
) -> tuple[Judge, dict[str, Any]]:
    """Make the targets, and write them to `out`; `budget_s` is the time of the whole, `image_s` that of one judgement.

    Where the `camera`'s paths take part, which may be left out unless they are `named`, all leave out the film's
    border. The facts: `masked` (whether that is so), `without` (stock integrators that are right for nothing here, and
    the reason), `loss` and `error` of the initial values, the seconds that a judgement takes (`judge_s`), the samples
    of its images (`spp`), and in words `pictures` and `error_of`.
    """
    without = find_references(problem, "loss")["without"]
    initial = copies(problem)
    films = [problem.scene.sensors()[sensor].film() for sensor in problem.sensors]
    pixels = sum(int(np.prod(film.crop_size())) for film in films)
    paths = affordable_paths(problem, pixels, TARGET_SHARE * budget_s)
    shortened = shorten_target(problem, paths // pixels)
    make_targets(problem, lambda line: None)
    find_reached(problem)
    with open(out, "wb") as file:
        np.savez(file, **target_arrays(problem.views))  # type: ignore[arg-type]
    masked = camera and (named or "prb" not in without) and leave_out_border(problem)
    affordable = affordable_paths(problem, pixels, image_s) // pixels
    spp = multiple_of(max(affordable, LEAST_SPP), problem.samples_per_pass)
    judge, facts = _judge(problem, spp, initial)
    error = facts["error"]
    kind = (
        "" if error is None else "RMSE of the parameters" if judge.meter.one_unit else "relative RMSE of the parameters"
    )
    pictures = f"losses of images of {spp} spp{shortened}"
    return judge, facts | {"without": without, "error_of": kind, "pictures": pictures, "spp": spp, "masked": masked}


def restore(problem: Problem, targets: str, spp: int, masked: bool) -> tuple[Judge, dict[str, Any]]:
    """What judges as another did, by the `targets` in a file that `prepare` wrote, and images of so many samples.

    The facts: `loss` and `error` of the initial values, and `judge_s`.
    """
    initial = copies(problem)
    shorten_target(problem, 1)
    make_targets(problem, lambda line: None)  # for the sake of the true values
    with np.load(targets) as found:
        set_targets(problem.views, found)
    find_reached(problem)
    if masked:
        leave_out_border(problem)
    return _judge(problem, spp, initial)


def _judge(problem: Problem, spp: int, initial: dict[str, Array]) -> tuple[Judge, dict[str, Any]]:
    """What judges, warm, and what it says of the initial values."""
    judge = Judge(problem, spp)
    judge.loss(initial)  # which compiles
    start = time.perf_counter()
    loss = judge.loss(initial)
    return judge, {"loss": loss, "judge_s": time.perf_counter() - start, "error": judge.error(initial)}
