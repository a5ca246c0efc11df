"""Light tracers: what ours have in common, and what is done with the samples of an image.

In common they have `ptracer`'s options, a plan, passes, the image and its tangent (`LightTracer`, `Reversed`). With the
samples an image pass, a replay, forward mode or naive AD is done. They know nothing of Mitsuba's plugins; `plugin.py`
makes plugins of them.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
from typing_extensions import Self

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators.base import Estimator, Pass
from reslrb_cli.guiding.collect import hear
from reslrb_cli.guiding.tables import Purpose, learning_seed
from reslrb_cli.integrators import freezing
from reslrb_cli.integrators.context import Motion, Preparation, sensor_number
from reslrb_cli.integrators.forward import AttachedTangentSplat, RecordedObjective, TangentSplat, TrackedSplat
from reslrb_cli.integrators.protocol import Derivative, Job
from reslrb_cli.transport.connection import forward_derivatives
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.film import AdjointImage, Film
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples, finish_pass, in_passes, passes
from reslrb_cli.transport.visible import (
    differentiate_visible_radiance,
    moving_splats,
    primary_ray,
    small_splat,
    visible_radiance,
    visible_tangent,
)
from reslrb_cli.transport.walk import Splat, walk


class LightTracer:
    """A light tracer without derivatives but for forward mode; OPTIONS are names and defaults as `ptracer` has them."""

    OPTIONS: ClassVar[Mapping[str, Any]] = {
        "max_depth": -1,
        "rr_depth": 5,
        "hide_emitters": False,
        "samples_per_pass": None,
    }
    image_apart = True

    def __init__(
        self,
        max_depth: int = -1,
        rr_depth: int = 5,
        hide_emitters: bool = False,
        samples_per_pass: int | None = None,
        freeze: bool = False,
        motion: Motion | None = None,
        guided: bool = False,
        low_discrepancy: bool = False,
    ) -> None:
        """Raises ValueError, which names the option, where one has a value that it cannot have.

        `freeze` says whether launches are recorded (`freezing.py`), `motion` how derivatives of what moves are taken,
        `guided` whether emission is drawn from what earlier paths said (`tables.py`),
        `low_discrepancy` whether the numbers of a path's beginning are (`random.py`).
        """
        if max_depth < -1:
            raise ValueError('"max_depth" must be -1 (no limit) or a value >= 0')
        if rr_depth <= 0:
            raise ValueError('"rr_depth" must be greater than zero')
        if samples_per_pass is not None and samples_per_pass <= 0:
            raise ValueError('"samples_per_pass" must be greater than zero')
        self.max_depth, self.rr_depth, self.hide_emitters = max_depth, rr_depth, hide_emitters
        self.samples_per_pass, self.freeze = samples_per_pass, freeze
        self.preparation = Preparation(max_depth, rr_depth, hide_emitters, motion or Motion(), guided, low_discrepancy)

    def with_options(self, *, samples_per_pass: int | None, freeze: bool) -> Self:
        """The same with other passes, or without recordings; both share what they find out about a scene."""
        other = copy.copy(self)
        other.samples_per_pass, other.freeze = samples_per_pass, freeze
        return other

    def afresh(
        self, *, guided: bool | None = None, images: bool | None = None, low_discrepancy: bool | None = None
    ) -> Self:
        """The same, which knows nothing of any scene yet, with other ways of drawing samples; None: as it has it.

        Guided emission or none, `images`: of images too; low-discrepancy numbers or independent ones.
        """
        other = copy.copy(self)
        other.preparation = self.preparation.afresh(guided, images, low_discrepancy)
        return other

    def to_measure(self) -> Self:
        """This one, or, where it is guided, one with tables of its own: whoever measures steps before a run teaches
        those of the run nothing, which is then the same whether they were measured now or by an earlier one."""
        return self if self.preparation.guiding is None else self.afresh()

    def expect(self, spp: int) -> None:
        """Be told how many samples per pixel there are in each pass that tables learn from, whatever passes come first.

        A run says so: it is then the same whether it begins or goes on.
        """
        self.preparation.expected = spp

    def plan(self, scene: mi.Scene, sensor: mi.Sensor, params: mi.SceneParameters | None = None) -> Plan:
        """What a walk of this scene needs, with derivatives of `params`, if any.

        Raises UnsupportedScene for what cannot work.
        """
        return self.preparation.plan(scene, sensor, params)

    def passes(self, job: Job, purpose: Purpose | None = None, delta: mi.TensorXf | None = None) -> list[Samples]:
        """The samples of a job; where its `spp` is 0, the sensor's own number of them.

        The `purpose` says what guided samples are drawn by; None: for the gradient, or the image where there is none.
        So does dL/dI `delta` (H, W, C), which the samples have had no part in. Raises ValueError for an `spp` below 0.
        """
        if job.spp < 0:
            raise ValueError(f'"spp" must be 0 (the sensor\'s own sample count) or more, not {job.spp}')
        spp = job.spp or job.sensor.sampler().sample_count()
        unit = min(self.samples_per_pass or spp, spp)
        plan, table = self.preparation.plan(job.scene, job.sensor, job.params, unit), None
        guiding = self.preparation.guiding
        if guiding is not None:
            purpose = purpose or (Purpose.IMAGE if job.params is None else Purpose.GRADIENT)
            if guiding.serves(purpose):
                table = guiding.table(sensor_number(job.scene, job.sensor), purpose, delta)
        return passes(plan, job.scene, job.sensor, job.seed, spp, self.samples_per_pass, table)

    def learn(self, job: Job, gradient: mi.TensorXf) -> None:
        """Have the tables learn, where they are due to, from other samples than those of the job; dL/dI is known.

        After a gradient: what has been learned counts from the next one on.
        """
        guiding = self.preparation.guiding
        if guiding is not None and guiding.due(sensor_number(job.scene, job.sensor)):
            self.learn_now(job, gradient)

    def learn_now(self, job: Job, gradient: mi.TensorXf) -> None:
        """Have the tables learn, due or not."""
        guiding = self.preparation.guiding
        assert guiding is not None
        with dr.suspend_grad():
            samples = self.passes(replace(job, seed=learning_seed(job.seed)), Purpose.BOTH)[0]
            if self.freezes([samples]) and samples.width <= freezing.MOST_PATHS_APART:
                said = self.preparation.recordings.call("hear", samples, hear, gradient)
            else:
                said = hear(samples, gradient)
            guiding.learn(sensor_number(job.scene, job.sensor), samples.width, said)

    def image_estimator(self) -> Estimator | None:
        """The estimator that makes images of its own; None where they show every connection."""
        return None

    def image(self, job: Job, evaluate: bool = True) -> mi.TensorXf:
        """The image (H, W, C), without derivatives."""
        estimator = self.image_estimator()

        def image(samples: Samples) -> mi.TensorXf:
            return image_of([samples], estimator)

        with dr.suspend_grad():
            parts = self.passes(replace(job, params=None))  # an image has no use for what derivatives ask of a walk
            if evaluate and self.freezes(parts):
                return self.preparation.recordings.call("image", parts[0], image)
            result = image_of(parts, estimator)
            if evaluate:
                dr.eval(result)
            return result

    def tangent(self, job: Job) -> mi.TensorXf:
        """The derivative (H, W, C) of the image along the tangents of the job's parameters (forward mode)."""
        with dr.suspend_grad():
            parts = self.passes(job)
            if parts[0].plan.moving_emission:
                raise UnsupportedScene("forward mode has no derivatives of emitters that move; take reverse mode")
            film = parts[0].film
            block = film.block()
            in_passes(parts, splat_tangents, block)
            return film.develop_tangent(block)

    def freezes(self, parts: list[Samples]) -> bool:
        """Whether these samples are traced from a recording; large ones, and so several passes, gain little."""
        return self.freeze and len(parts) == 1 and parts[0].width <= freezing.MOST_PATHS


class Reversed(LightTracer):
    """A light tracer whose gradient is a pass of its own, `backward`."""

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective with dL/dI `gradient` (H, W, C)."""
        raise NotImplementedError

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """The image, and the gradient of the same samples with the dL/dI that `derivative(image)` returns."""
        image = self.image(job)
        self.backward(job, derivative(image))
        return image

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """The same where dL/dI is known before the image."""
        return self.correlated(job, lambda image: gradient)


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
