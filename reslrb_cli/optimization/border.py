"""A word before an optimisation whose moving light crosses the film's border."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from reslrb_cli.integrators import Job
from reslrb_cli.integrators.border import border_share
from reslrb_cli.integrators.tracer import LightTracer
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.seeds import seed

#: The share of moving light at the border from which on it is worth a word.
NOTICED = 0.01
#: Samples per pixel that it is measured with.
SPP = 8


def warn_of_border(problem: Problem, warn: Callable[[str], None]) -> None:
    """Call `warn` with a line for each view in which more than NOTICED of the light that moves lands at the border."""
    if not isinstance(problem.integrator, LightTracer):
        return
    tracer = problem.integrator.with_options(samples_per_pass=None, freeze=False)
    for index in problem.sensors:
        sensor = problem.scene.sensors()[index]
        number = dr.opaque(mi.UInt32, seed(problem.config.run.seed, 0, index, "border"))
        share = border_share(tracer, Job(problem.scene, sensor, number, SPP, problem.selection.params))
        if share > NOTICED:
            warn(
                f"view {index}: {share:.0%} of the light that moves lands at the film's border, where its derivative "
                "is cut off; a view in which all of it stays inside has none of that"
            )
