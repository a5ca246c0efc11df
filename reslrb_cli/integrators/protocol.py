"""The interface of an integrator, ours or a stock one, for a step, and the refusal of dL/dI that is not finite.

Derivatives of a loss that are not finite are refused, which is to say taken for 0, and counted. One NaN in dL/dI would
make a gradient NaN wherever a path of that pixel passes, and some estimators would lose it on the way. Both are done in
the kernel that computes dL/dI, and nobody waits for the count but who reads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import drjit as dr
import mitsuba as mi

#: From an image (H, W, C) to dL/dI, of the same shape.
Derivative: TypeAlias = "Callable[[mi.TensorXf], mi.TensorXf]"  # text: the type is there once a variant is set


@dataclass(frozen=True)
class Job:
    """One set of samples: of which scene, through which sensor, with which random numbers.

    `seed` is an opaque UInt32, `spp` are samples per pixel. Those of `params`, the scene's `mi.traverse`, that track
    derivatives are differentiated; None for an image alone.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    seed: mi.UInt32
    spp: int
    params: mi.SceneParameters | None = None


class StepIntegrator(Protocol):
    """Images and gradients; images and dL/dI are tensors (H, W, C), gradients are added to the job's parameters."""

    #: Whether `correlated` has image and dL/dI evaluated before the rest of its work begins; naive AD has not.
    image_apart: bool

    def image(self, job: Job) -> mi.TensorXf:
        """The image, without derivatives."""
        ...

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective with dL/dI `gradient`."""
        ...

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """The image, and the gradient of the same samples with the dL/dI that `derivative(image)` returns."""
        ...

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """The image, and the gradient of the same samples, where dL/dI is known before either."""
        ...


NONE = 0xFFFFFFFF


def _count() -> mi.UInt32:
    return dr.zeros(mi.UInt32, 1)


def _first() -> mi.UInt32:
    return dr.full(mi.UInt32, NONE, 1)


@dataclass
class Refused:
    """Entries of dL/dI that were not finite: how many, and the first one's flat index, of width 1; the shape of dL/dI,
    (H, W, C)."""

    count: mi.UInt32 = field(default_factory=_count)
    first: mi.UInt32 = field(default_factory=_first)
    shape: tuple[int, ...] = (0, 0, 0)

    def take(self, gradient: mi.TensorXf) -> mi.TensorXf:
        """dL/dI with 0 for what is not finite, which is added to the count; neither is evaluated here."""
        self.shape, flat = gradient.shape, gradient.array
        bad = ~dr.isfinite(flat)
        # Atomics of the lanes that are not finite alone: none where nothing is wrong.
        dr.scatter_reduce(dr.ReduceOp.Add, self.count, mi.UInt32(1), mi.UInt32(0), bad, dr.ReduceMode.Direct)
        index = dr.arange(mi.UInt32, dr.width(flat))
        dr.scatter_reduce(dr.ReduceOp.Min, self.first, index, mi.UInt32(0), bad, dr.ReduceMode.Direct)
        return type(gradient)(dr.select(bad, 0, flat), gradient.shape)

    def entry(self) -> tuple[int, int, int] | None:
        """Pixel (x, y) and channel of the first of them; None where there is none. Waits for the step."""
        index = int(self.first[0])
        if index == NONE:
            return None
        _, width, channels = self.shape
        return index // channels % width, index // channels // width, index % channels


def first_channels(image: mi.TensorXf, count: int) -> mi.TensorXf:
    """`image[:, :, :count]`, whose derivative keeps a NaN.

    That of a slice adds up with atomics, which drop it on a CPU (`transport.factors.showing`).
    """
    height, width, channels = image.shape
    if channels == count:
        return image
    lane = dr.arange(mi.UInt32, height * width * count)
    index = lane // count * channels + lane % count
    flat = dr.gather(type(image.array), image.array, index, True, dr.ReduceMode.Permute)
    return type(image)(flat, (height, width, count))
