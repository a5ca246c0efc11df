"""Images with many samples, in passes that fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from reslrb_cli.integrators import Reslrb, render_image
from reslrb_cli.integrators.freezing import MOST_PATHS_APART
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

#: Paths in one pass. Baselines keep the state of every path in memory; 2**22 of them stay below 2 GB.
PATHS_PER_PASS = 2**22
#: Samples per pixel of images that are saved between the first and the last, at least.
BETWEEN_SPP = 64


def passes(spp: int, pixels: int, multiple: int | None, paths_per_pass: int = PATHS_PER_PASS) -> Iterator[int]:
    """Yield the samples per pixel of each pass; they sum to `spp`.

    `multiple` is the integrator's `samples_per_pass`, which must divide the samples of every pass (None: no matter);
    it divides `spp`.
    """
    unit = multiple or 1
    most = max(paths_per_pass // (pixels * unit), 1) * unit
    while spp > 0:
        yield min(most, spp)
        spp -= most


def saved_spp(problem: Problem, between: bool) -> int:
    """Samples per pixel of the initial and the final image, `run.final_spp` or the next more that passes divide.

    Of images `between`, which only show how far a run is, a multiple of the run's own.
    """
    run, unit = problem.config.run, problem.samples_per_pass or 1
    if between:
        return run.spp * -(-BETWEEN_SPP // run.spp)  # passes that divide a step divide this as well
    return run.final_spp if unit >= run.final_spp else unit * -(-run.final_spp // unit)


def render_in_passes(
    integrator: Any,
    scene: Any,
    sensor: int,
    spp: int,
    run_seed: int,
    iteration: int,
    purpose: str,
    multiple: int | None,
) -> np.ndarray[Any, Any]:
    """Render `sensor` with `spp` samples per pixel; return the image, (H, W, C) float32.

    Each pass has its own seed, from `run_seed`, `iteration`, `sensor`, `purpose` and the number of the pass; the mean
    is taken in double precision.
    """
    width, height = scene.sensors()[sensor].film().crop_size()
    pixels = int(width) * int(height)
    if isinstance(integrator, Reslrb) and min(spp * pixels, PATHS_PER_PASS) > MOST_PATHS_APART:
        integrator = integrator.with_options(samples_per_pass=integrator.samples_per_pass, freeze=False)
    total: np.ndarray[Any, Any] | None = None
    for number, part in enumerate(passes(spp, pixels, multiple)):
        pass_seed = seed(run_seed, iteration, sensor, f"{purpose}, pass {number}")
        with dr.suspend_grad():
            image = np.array(render_image(integrator, scene, sensor, pass_seed, part), dtype=np.float64) * (part / spp)
        total = image if total is None else total + image
    assert total is not None, "spp is at least 1"
    return total.astype(np.float32)
