"""The film's border, left out where paths from the camera and paths from the lights are compared.

Light tracing loses there what samples just outside of the film would have added (`references.interior`).
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from reslrb_cli.measure.convergence.sampler import to_tensor
from reslrb_cli.measure.references import interior
from reslrb_cli.optimization.losses import Loss
from reslrb_cli.optimization.problem import Problem


def leave_out_border(problem: Problem) -> bool:
    """Have the loss of a problem take pixels along the border as the target has them; whether there are any.

    Losses do not know of sensors: films of one size have the widest border of them all.
    """
    insides: dict[tuple[int, ...], np.ndarray] = {}
    for index in problem.sensors:
        sensor = problem.scene.sensors()[index]
        width, height = (int(n) for n in sensor.film().crop_size())
        inside = interior((height, width), sensor)
        insides[height, width] = inside & insides.get((height, width), inside)
    if all(inside.all() for inside in insides.values()):
        return False
    masks = {shape: to_tensor(inside[:, :, None]) for shape, inside in insides.items()}
    problem.loss = _masked(problem.loss, masks)
    return True


def _masked(loss: Loss, masks: dict[tuple[int, ...], mi.TensorXf]) -> Loss:
    def masked(image: mi.TensorXf, target: mi.TensorXf) -> mi.Float:
        mask = masks[tuple(target.shape[:2])]
        return loss(image * mask + target * (1 - mask), target)

    return masked
