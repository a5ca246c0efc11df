"""What our light tracers have in common: `ptracer`'s options, a plan, passes, the image and its tangent.

They know nothing of Mitsuba's plugins; `adapter.py` makes plugins of them.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
from typing_extensions import Self

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators import Estimator
from reslrb_cli.integrators import freezing
from reslrb_cli.integrators import light_tracer as lt
from reslrb_cli.integrators.guiding import Purpose, learning_seed
from reslrb_cli.integrators.hearing import hear
from reslrb_cli.integrators.interface import Derivative, Job
from reslrb_cli.integrators.preparation import Motion, Preparation, sensor_number
from reslrb_cli.transport.accumulation import in_passes
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples, passes


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
        `guided` whether emission is drawn from what earlier paths said (`guiding.py`),
        `low_discrepancy` whether the numbers of a path's beginning are (`nets.py`).
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
            return lt.image_of([samples], estimator)

        with dr.suspend_grad():
            parts = self.passes(replace(job, params=None))  # an image has no use for what derivatives ask of a walk
            if evaluate and self.freezes(parts):
                return self.preparation.recordings.call("image", parts[0], image)
            result = lt.image_of(parts, estimator)
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
            in_passes(parts, lt.splat_tangents, block)
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
