"""The film's border, left out where paths from the camera and paths from the lights are compared.

Light tracing loses there what samples just outside of the film would have added (`scene.seen.interior`).
"""

from __future__ import annotations

import numpy as np

from reslrb_cli.optimization.problem import Problem
from reslrb_cli.scene.seen import interior


def leave_out_border(problem: Problem) -> bool:
    """Have the losses of a problem, which has its targets, leave out pixels along the border; whether there are any."""
    found = False
    for view in problem.views:
        target = np.array(view.target)
        weights = interior(target.shape, problem.scene.sensors()[view.sensor]).astype(np.float32)
        if weights.all():
            continue
        found = True
        if view.weights is not None:
            weights *= np.array(view.weights)[:, :, 0]
        view.see(target, weights)
    return found
