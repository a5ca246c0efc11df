"""Interface through which a step uses integrators, stock or from this package."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi

#: From an image (H, W, C) to dL/dI, of the same shape.
Derivative: TypeAlias = "Callable[[mi.TensorXf], mi.TensorXf]"  # a string: the type exists only after a variant is set


@dataclass(frozen=True)
class Job:
    """Set of samples: a scene seen through a sensor, with given random numbers.

    `seed` is an opaque UInt32, and `spp` the number of samples per pixel. `params` is the scene's `mi.traverse`.
    Entries of `params` that track derivatives are differentiated. `params` is None for an image without derivatives.
    `plans` stores facts about scene and parameters for one step. Jobs that are derived from one another share `plans`.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    seed: mi.UInt32
    spp: int
    params: mi.SceneParameters | None = None
    plans: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)


class StepIntegrator:
    """Integrator of images and gradients. Images and dL/dI are tensors (H, W, C). Gradients are added to the job's
    parameters.

    `correlated` and `known` suit integrators whose gradient is a separate pass, `backward`.
    """

    def image(self, job: Job) -> mi.TensorXf:
        """Return the image, without derivatives."""
        raise NotImplementedError

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective. `gradient` is dL/dI."""
        raise NotImplementedError

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """Return the image. Adds the gradient that the image's own samples give for dL/dI = `derivative(image)`."""
        image = self.image(job)
        self.backward(job, derivative(image))
        return image

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """Return the image. Adds the gradient of the same samples for a dL/dI that is known before the image."""
        return self.correlated(job, lambda image: gradient)


def first_channels(image: mi.TensorXf, count: int) -> mi.TensorXf:
    """Return `image[..., :count]` with a derivative that keeps NaN.

    The derivative of a slice uses atomic sums, which drop NaN on a CPU (`transport.factors.showing`).
    """
    *pixels, channels = image.shape
    if channels == count:
        return image
    lane = dr.arange(mi.UInt32, math.prod(pixels) * count)
    index = lane // count * channels + lane % count
    flat = dr.gather(type(image.array), image.array, index, True, dr.ReduceMode.Permute)
    return type(image)(flat, (*pixels, count))
