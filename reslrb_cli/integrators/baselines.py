"""Baselines: Mitsuba's integrators, and the light paths of `reslrb` with other derivatives.

`Replayed`, `Projective` and `NaiveAD` adapt Mitsuba's integrators to a gradient step. `WalkAd` differentiates light
paths by naive AD. `Trajectory` uses Dr.Jit's reversal of loops.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators.camera import splat_camera_paths
from reslrb_cli.integrators.plans import AttachedOptions, SamplingOptions
from reslrb_cli.integrators.protocol import Derivative, Job, StepIntegrator
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.scene.deformation import Surroundings
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import differentiate_visible_emission, splat_visible_emission
from reslrb_cli.transport.factors import MAY_LACK, Product
from reslrb_cli.transport.film import AdjointImage
from reslrb_cli.transport.lamp_light import moving_splats
from reslrb_cli.transport.samples import Samples, in_passes
from reslrb_cli.transport.walk import Hooks, Splat, Vertex, walk


@contextmanager
def _no_word_of_signals() -> Iterator[None]:
    """Suppress Mitsuba's message about Ctrl-C, which its C++ code prints to stdout in red while it renders."""
    logger = mi.logger()
    level = logger.log_level()
    logger.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        logger.set_log_level(level)


class Replayed(StepIntegrator):
    """Mitsuba integrator whose gradient is a separate pass, such as `prb`."""

    def __init__(self, plugin: mi.Integrator) -> None:
        self.plugin = plugin
        self._scene: mi.Scene | None = None  # kept alive, so that no other scene gets its address
        self._surroundings = Surroundings()

    def _surround(self, scene: mi.Scene) -> None:
        """Update the emitters of the scene to its current bounds."""
        if self._scene is not scene:
            self._scene, self._surroundings = scene, Surroundings()
        self._surroundings.follow(scene)

    def image(self, job: Job) -> mi.TensorXf:
        self._surround(job.scene)
        with dr.suspend_grad(), _no_word_of_signals():
            return self.plugin.render(job.scene, job.sensor, job.seed, job.spp)

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        self._surround(job.scene)
        # Isolated, so that the propagation of another view finds the edges above the scene's parameters intact.
        with dr.isolate_grad():
            self.plugin.render_backward(job.scene, job.params, gradient, job.sensor, job.seed, job.spp)


class Projective(Replayed):
    """Adapter for Mitsuba's projective integrators, such as `prb_projective`. Results do not depend on earlier
    calls.
    """

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        given = {name: getattr(self.plugin, name) for name in ("sppc", "sppp", "sppi")}
        # Mitsuba keeps the first step's threshold, so a resumed run would have another one.
        self.plugin.octree_contruction_thres = 0
        try:
            for name, spp in given.items():
                setattr(self.plugin, name, job.spp if spp is None else spp)
            # Mitsuba ignores all three if a sample count is given. It warns of the film's border, but not of shadows.
            with _no_word_of_signals():
                super().backward(replace(job, spp=0), gradient)
        finally:
            for name, spp in given.items():
                setattr(self.plugin, name, spp)

    def obstacle(self, scene: mi.Scene, sensors: Iterable[mi.Sensor], moved: Iterable[mi.Object]) -> str | None:
        """Return why Mitsuba 3.9 computes outlines that the sensor sees wrongly, or None.

        If `sppp` is 0, such outlines are left out, and nothing is checked. A sensor that is not perspective is refused
        for any `moved` shapes. Shadow edges are not checked.
        """
        advice = "or leave out these outlines by `sppp: 0` in an integrator of your own (type: custom)"
        for sensor in sensors if self.plugin.sppp != 0 else ():
            if sensor.class_name() != "PerspectiveCamera":
                return (
                    f"has outlines only for perspective sensors, and {sensor.id()} is none; use a perspective "
                    f"sensor, {advice}"
                )
            rectangle = next((shape for shape in moved if shape.class_name() == "Rectangle"), None)
            if rectangle is not None:
                return f"has wrong outlines of rectangles such as {rectangle.id()}; use a mesh instead, {advice}"
        return None


class NaiveAD(Replayed):
    """Integrator, such as `ptracer`, that is differentiated through the whole computation graph of its image.

    Mitsuba's light tracer is differentiable only in evaluated loops.
    """

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        self.correlated(job, lambda image: gradient)  # as in Mitsuba, which raises if no path hits anything

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        self._surround(job.scene)
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False), dr.isolate_grad():
            with _no_word_of_signals():
                image = self.plugin.render(job.scene, job.sensor, job.seed, job.spp, develop=True, evaluate=False)
            # If none of a few paths hits anything, evaluated loops end before the image depends on a parameter.
            dr.backward_from(image * derivative(dr.detach(image)), flags=MAY_LACK)
        return dr.detach(image)


def splat_tracked(samples: Samples, block: mi.ImageBlock) -> None:
    """Splat the contributions to the block with tracked derivatives, for naive AD. Memory is proportional to depth."""
    with dr.resume_grad():
        splat_visible_emission(samples, block, "evaluated")
        for u, C, active, colours in moving_splats(samples):  # twice, so that the image stays the same
            samples.film.put(block, u, C, active, colours, samples.plan.attached_normalization)
            samples.film.put(block, dr.detach(u), -dr.detach(C), active, colours)
        for side in samples.sides():
            if side.plan.camera:
                splat_camera_paths(side, block, tracked=True)
            else:
                hooks = Splat(side, block)
                hooks.tracked, hooks.attached = True, side.plan.attached
                walk(side, hooks)


class WalkAd(LightTracer):
    """Naive AD of the light paths that `reslrb` traces, for comparisons at equal seeds."""

    OPTIONS: ClassVar[Mapping[str, Any]] = {
        **LightTracer.OPTIONS,
        "attached": False,
        "filter_normalization": "attached",
        "paths": "light",
        "light_share": 0.5,
    }

    def __init__(
        self, attached: bool = False, filter_normalization: str = "attached", paths: str = "light",
        light_share: float = 0.5, **common: Any,
    ) -> None:  # fmt: skip
        """Make the integrator. If `attached`, rays and film positions also have derivatives."""
        sampling = SamplingOptions(paths=paths, light_share=light_share)
        super().__init__(motion=AttachedOptions(attached, filter_normalization), sampling=sampling, **common)

    def graph(self, job: Job) -> mi.TensorXf:
        """Return the image (H, W, C) with its whole graph. Call it with enabled gradients."""
        parts = self.passes(job)
        film = parts[0].film
        block = film.block()
        for samples in parts:
            splat_tracked(samples, block)
        return film.develop(block)

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        with dr.resume_grad(), dr.isolate_grad():
            image = self.graph(job)
            dr.backward_from(image * derivative(dr.detach(image)), flags=MAY_LACK)
        return dr.detach(image)

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        self.correlated(job, lambda image: gradient)

    def tangent(self, job: Job) -> mi.TensorXf:
        with dr.resume_grad():
            return dr.forward_to(self.graph(job))


class RecordedObjective(Hooks):
    """Hooks that sum each path's share of the objective, S = sum_i delta_i C_i, with tracked derivatives.

    A splat in a reversed loop would have no derivative, because side effects are not part of the loop's state.
    """

    tracked = True

    def __init__(self, samples: Samples, adjoint: AdjointImage) -> None:
        self.samples, self.adjoint = samples, adjoint
        self.max_iterations = max(samples.plan.max_depth - 1, 1)

    def start(self, product: Product) -> mi.Float:
        return mi.Float(0)

    def vertex(
        self, state: mi.Float, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> mi.Float:  # fmt: skip
        C = vertex.product.times(connection.c, vertex.depth).scaled(self.samples.scale).value()
        delta = self.adjoint.lookup(connection.u, connection.active, self.colours)
        return state + dr.select(connection.active, dr.dot(delta, C), 0)


class Trajectory(LightTracer):
    """The light paths of `reslrb`, traced in a loop that Dr.Jit reverses. Dr.Jit records the loop state in thread-local
    memory.
    """

    def __init__(self, max_depth: int = -1, **common: Any) -> None:
        super().__init__(max_depth, motion=AttachedOptions(attached=False), **common)
        if max_depth == -1:
            raise ValueError('"max_depth" is missing: it is the size of the record')

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        with dr.suspend_grad():
            parts = self.passes(job)
            if parts[0].plan.differentiate_null:
                raise UnsupportedScene(
                    "trajectory: Dr.Jit cannot reverse the loop through masks inside the loop of the path; recover "
                    "parameters of other surfaces, too"
                )
            adjoint = parts[0].film.adjoint(gradient)

            def differentiate(part: Samples, block: mi.ImageBlock | None) -> None:
                with dr.isolate_grad():  # as in `backward_stored`; without it, the derivatives of textures are lost
                    differentiate_visible_emission(part, adjoint)
                    with dr.resume_grad():
                        dr.backward_from(walk(part, RecordedObjective(part, adjoint)), flags=MAY_LACK)

            in_passes(parts, differentiate, None, job.params)
