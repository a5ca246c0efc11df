"""Mitsuba's own integrators, as a gradient step takes them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from reslrb_cli.integrators.interface import Derivative, Job
from reslrb_cli.scene.horizon import Surroundings


@contextmanager
def _no_word_of_signals() -> Iterator[None]:
    """While its own C++ code renders, Mitsuba hears of Ctrl-C, too, and says so on stdout, in red, whatever that is."""
    logger = mi.logger()
    level = logger.log_level()
    logger.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        logger.set_log_level(level)


class Replayed:
    """An integrator whose gradient is a pass of its own, such as `prb`."""

    image_apart = True

    def __init__(self, plugin: mi.Integrator) -> None:
        self.plugin = plugin
        self.surroundings = Surroundings()

    def image(self, job: Job) -> mi.TensorXf:
        """The image, without derivatives."""
        self.surroundings.follow(job.scene)
        with dr.suspend_grad(), _no_word_of_signals():
            return self.plugin.render(job.scene, job.sensor, job.seed, job.spp)

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective with dL/dI `gradient`."""
        self.surroundings.follow(job.scene)
        # Isolated, so that another view's propagation finds the edges above the scene's parameters intact.
        with dr.isolate_grad():
            self.plugin.render_backward(job.scene, job.params, gradient, job.sensor, job.seed, job.spp)

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """The image, and the gradient of the same samples."""
        image = self.image(job)
        self.backward(job, derivative(image))
        return image

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """The same with a dL/dI that is known."""
        return self.correlated(job, lambda image: gradient)


class NaiveAD(Replayed):
    """An integrator that is differentiated with the whole graph of its image, such as `ptracer`: a "sweep".

    Stock light tracing is differentiable in evaluated loops alone.
    """

    image_apart = False

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        self.correlated(job, lambda image: gradient)  # as Mitsuba does, which raises where no path meets anything

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        self.surroundings.follow(job.scene)
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False), dr.isolate_grad():
            with _no_word_of_signals():
                image = self.plugin.render(job.scene, job.sensor, job.seed, job.spp, develop=True, evaluate=False)
            # Where no path of a few meets anything, evaluated loops end before the image depends on a parameter.
            flags = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad
            dr.backward_from(image * derivative(dr.detach(image)), flags=flags)
        return dr.detach(image)
