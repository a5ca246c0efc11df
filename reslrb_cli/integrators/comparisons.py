"""The walk of `reslrb` differentiated in other ways, to compare with: by naive AD, and by Dr.Jit's own reversal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators import light_tracer as lt
from reslrb_cli.integrators.interface import Derivative, Job
from reslrb_cli.integrators.preparation import Motion
from reslrb_cli.integrators.tracer import Reversed
from reslrb_cli.transport.accumulation import in_passes
from reslrb_cli.transport.samples import Samples

#: No light may reach what is differentiated.
_MAY_LACK = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad


class WalkAd(Reversed):
    """The same walk under naive AD: for comparisons at equal seeds."""

    OPTIONS: ClassVar[Mapping[str, Any]] = {
        **Reversed.OPTIONS,
        "attached": False,
        "filter_normalization": "attached",
    }
    image_apart = False

    def __init__(self, attached: bool = False, filter_normalization: str = "attached", **common: Any) -> None:
        """`attached`: rays and film positions have their derivatives too."""
        super().__init__(motion=Motion(attached, filter_normalization), **common)

    def graph(self, job: Job) -> mi.TensorXf:
        """The image (H, W, C) with its whole graph; to be called where gradients are enabled."""
        parts = self.passes(job)
        film = parts[0].film
        block = film.block()
        for samples in parts:
            lt.splat_tracked(samples, block)
        return film.develop(block)

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        with dr.isolate_grad():
            image = self.graph(job)
            dr.backward_from(image * derivative(dr.detach(image)), flags=_MAY_LACK)
        return dr.detach(image)

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        with dr.resume_grad(), dr.isolate_grad():
            dr.backward_from(self.graph(job) * gradient, flags=_MAY_LACK)

    def tangent(self, job: Job) -> mi.TensorXf:
        with dr.resume_grad():
            return dr.forward_to(self.graph(job))


class Trajectory(Reversed):
    """The same walk in a loop that Dr.Jit itself reverses, from a record of its state in thread-local memory."""

    def __init__(self, max_depth: int = -1, **common: Any) -> None:
        super().__init__(max_depth, motion=Motion(attached=False), **common)
        if max_depth == -1:
            raise ValueError('"max_depth" must be given: it is the size of the record')

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        with dr.suspend_grad():
            parts = self.passes(job)
            if parts[0].plan.differentiate_null:
                raise UnsupportedScene(
                    "trajectory: Dr.Jit cannot reverse the loop through masks within that of the path; give "
                    "parameters to other surfaces than masks alone"
                )
            adjoint = parts[0].film.adjoint(gradient)

            def differentiate(part: Samples, block: mi.ImageBlock | None) -> None:
                with dr.isolate_grad():  # as in `replay_all`; without it the derivatives of textures are lost
                    lt.reverse_recorded(part, adjoint)

            in_passes(parts, differentiate, None, job.params)
