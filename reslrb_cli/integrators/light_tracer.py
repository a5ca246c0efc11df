"""What is done with the samples of a light-traced image: image pass, replay, forward mode, naive AD."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators import Estimator
from reslrb_cli.estimators.base import Pass
from reslrb_cli.integrators.hooks import RecordedObjective, TangentSplat, TrackedSplat
from reslrb_cli.integrators.tangents import AttachedTangentSplat
from reslrb_cli.scene.emitted import emitted_rays
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.transport.accumulation import finish_pass, in_passes
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.hooks import Splat
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.splat import AdjointImage, Film
from reslrb_cli.transport.transmittance import forward_derivatives
from reslrb_cli.transport.visible import differentiate_visible_radiance, primary_ray, visible_radiance, visible_tangent
from reslrb_cli.transport.visible_lamps import moving_splats, small_splat
from reslrb_cli.transport.walk import walk


def settle(scene: mi.Scene) -> None:
    """Have textures and emitters set up now what they set up when they are first used (padded storage, distributions).

    In the midst of tracing this would cut the first step's kernels in two, and the second would compile them anew.
    Raises UnsupportedScene where there is an emitter that Mitsuba cannot sample, such as a spot with a checkerboard.
    """
    with dr.suspend_grad():
        for texture in SceneGraph.of(scene).of_type(mi.Texture):
            if texture.class_name().startswith("BitmapTexture"):
                texture.eval(dr.zeros(mi.SurfaceInteraction3f))
        _, weight = emitted_rays(scene, mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
        dr.eval(weight)


def splat_visible_emission(samples: Samples, block: mi.ImageBlock, loop_mode: str = "symbolic") -> None:
    """Add C_0 to the block."""
    if samples.plan.visible_emission:
        primary = primary_ray(samples)
        radiance = visible_radiance(samples.plan, samples.scene, primary, loop_mode)
        samples.film.put(block, primary.u, radiance * primary.weight * samples.fraction, primary.active)
    if samples.plan.small_lamps:
        samples.film.put(block, *small_splat(samples))


def splat_image(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the samples' contributions to the block; keep nothing."""
    splat_visible_emission(samples, block)
    walk(samples, Splat(samples, block))


def image_of(samples: list[Samples], estimator: Estimator | None) -> mi.TensorXf:
    """The image of all passes, as the estimator makes it where it makes one of its own (else None); nothing is kept."""
    film = samples[0].film
    block = film.block()

    def splat(part: Samples, own: mi.ImageBlock | None) -> None:
        if estimator is None:
            splat_image(part, own)
        else:
            forward(part, estimator, own)

    in_passes(samples, splat, block)
    return film.develop(block)


def forward(
    samples: Samples, estimator: Estimator, block: mi.ImageBlock | None, adjoint: AdjointImage | None = None
) -> Any:
    """Trace the samples: add their contributions to the block (None: no image). What is kept of each path is returned,
    and not evaluated."""
    if block is not None:
        splat_visible_emission(samples, block)
    return estimator.forward(Pass(samples, block, adjoint))


@dataclass
class Trace:
    """Samples that have been traced: their image, and what is kept of their paths if they fit in one pass.

    Several passes keep nothing, which would grow with the number of passes: each is traced again before its replay.
    """

    samples: list[Samples]
    image: mi.TensorXf | None = None
    state: Any = None

    @property
    def film(self) -> Film:
        return self.samples[0].film


def trace_image(samples: list[Samples], estimator: Estimator) -> Trace:
    """Trace all passes: the image, and what the estimator keeps of each path."""
    trace = Trace(samples)
    if len(samples) == 1:
        block = trace.film.block()
        trace.state = forward(samples[0], estimator, block)
        # One kernel: all that it yields is evaluated together, since what came later would trace everything again.
        dr.schedule(block.tensor())
        dr.eval(trace.state)
        trace.image = trace.film.develop(block)
    else:
        trace.image = image_of(samples, None if estimator.splats_all else estimator)
    dr.eval(trace.image)
    return trace


def replay(samples: Samples, estimator: Estimator, state: Any, adjoint: AdjointImage) -> None:
    """Add the derivatives of the objective, whose derivative with respect to the film is `adjoint`."""
    differentiate_visible_emission(samples, adjoint)
    estimator.backward(Pass(samples, None, adjoint), state)


def replay_all(
    trace: Trace, estimator: Estimator, gradient: mi.TensorXf, params: mi.SceneParameters | None = None
) -> None:
    """Add the gradient of the objective with dL/dI `gradient` (H, W, C) to `params`, which one pass need not know."""
    adjoint = trace.film.adjoint(gradient)
    if trace.state is None:
        differentiate_passes(trace.samples, estimator, None, adjoint, params)
        return
    # Isolated: on their way to the parameters gradients are evaluated, and with them all that they hang on, which is to
    # be one kernel. They set out once, at the end.
    with dr.isolate_grad():
        replay(trace.samples[0], estimator, trace.state, adjoint)


def fused(
    samples: list[Samples], estimator: Estimator, gradient: mi.TensorXf, params: mi.SceneParameters | None = None
) -> mi.TensorXf:
    """The image, and the same gradient, where dL/dI is known before either."""
    film = samples[0].film
    block = film.block()
    differentiate_passes(samples, estimator, block, film.adjoint(gradient), params)
    return film.develop(block)


def differentiate_passes(
    samples: list[Samples],
    estimator: Estimator,
    block: mi.ImageBlock | None,
    adjoint: AdjointImage,
    params: mi.SceneParameters | None,
) -> None:
    """Trace samples whose dL/dI is known and add their derivatives, and to the block (None: none) their contributions.

    What is kept of a path goes from one to the other within the kernel, and takes no memory.
    """

    def differentiate(part: Samples, own: mi.ImageBlock | None) -> None:
        with dr.isolate_grad():  # as above
            replay(part, estimator, forward(part, estimator, own, adjoint), adjoint)
            image = [] if own is None else [own.tensor()]
            dr.schedule(image)
            if len(samples) > 1:
                finish_pass(image)

    in_passes(samples, differentiate, block, params)


def reverse_recorded(samples: Samples, adjoint: AdjointImage) -> None:
    """Add the same derivatives by Dr.Jit's own reversal of the walk, which records the loop's state on the way."""
    differentiate_visible_emission(samples, adjoint)
    with dr.resume_grad():
        S = walk(samples, RecordedObjective(samples, adjoint))
        dr.backward_from(S, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)


def differentiate_visible_emission(samples: Samples, adjoint: AdjointImage) -> None:
    """Add the derivatives of C_0."""
    plan = samples.plan
    if plan.visible_emission and (plan.differentiate_emission or plan.differentiate_null):
        primary = primary_ray(samples)
        delta = adjoint.lookup(primary.u, primary.active) * primary.weight * samples.fraction
        differentiate_visible_radiance(plan, samples.scene, primary, delta)
    if plan.small_lamps and plan.differentiate_emission:
        with dr.resume_grad():
            u, C, active = small_splat(samples)
            objective = dr.dot(adjoint.lookup(u, active), C)
            dr.backward_from(objective, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    if plan.visible_moving_lamps:
        with dr.resume_grad():
            for u, C, active in moving_splats(samples):
                dr.backward_from(dr.dot(adjoint.lookup(u, active, plan.attached_normalization), C))


def splat_tangents(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the forward-mode derivative of the samples' contributions to the block, exactly and in one traversal."""
    plan, dE = samples.plan, mi.Spectrum(0)
    with dr.resume_grad():
        if plan.differentiate_emission:
            E = sample_emission(samples, samples.sampler()).weight
            [dE] = forward_derivatives(E)
        if plan.visible_emission and (plan.differentiate_emission or plan.differentiate_null):
            primary = primary_ray(samples)
            tangent = visible_tangent(plan, samples.scene, primary)
            samples.film.put(block, primary.u, tangent * primary.weight * samples.fraction, primary.active)
        if plan.small_lamps and plan.differentiate_emission:
            u, C, active = small_splat(samples)
            [tangent] = forward_derivatives(C)
            samples.film.put(block, u, tangent, active)
    hooks = AttachedTangentSplat if plan.attached else TangentSplat
    walk(samples, hooks(samples, block, dE))


def splat_tracked(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the contributions with derivatives tracked to the block: naive AD, its memory proportional to depth."""
    with dr.resume_grad():
        splat_visible_emission(samples, block, "evaluated")
        for u, C, active in moving_splats(samples):  # twice, so that the image stays as it is
            samples.film.put(block, u, C, active, samples.plan.attached_normalization)
            samples.film.put(block, dr.detach(u), -dr.detach(C), active)
        walk(samples, TrackedSplat(samples, block, samples.plan.attached))
