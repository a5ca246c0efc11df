"""Light tracers: the common base, and reservoir light replay backpropagation.

`LightTracer` provides the options of `ptracer`, a plan, passes, the image and the image's tangent. `Reslrb` adds
gradients by one of the estimators. The classes do not depend on Mitsuba's plugins. `plugin.py` makes plugins from them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from reslrb_cli.estimators.base import Estimator, Pass
from reslrb_cli.estimators.camera import differentiate_camera_paths, splat_camera_paths
from reslrb_cli.estimators.camera_edges import differentiate_edges_of_camera_paths
from reslrb_cli.estimators.chain_edges import (
    differentiate_edges_behind_chains,
    has_edges_behind_chains,
    weigh_cells,
    with_intervals,
)
from reslrb_cli.estimators.edges import differentiate_edges
from reslrb_cli.guiding.collect import collect
from reslrb_cli.guiding.pixels import wanted
from reslrb_cli.guiding.tables import Purpose, learning_seed
from reslrb_cli.integrators import freezing
from reslrb_cli.integrators.context import Preparation
from reslrb_cli.integrators.forward import tangent_of
from reslrb_cli.integrators.plans import AttachedOptions, SamplingOptions
from reslrb_cli.integrators.protocol import Derivative, Job, StepIntegrator
from reslrb_cli.transport.densities import EmitterDensities
from reslrb_cli.transport.edges import weigh_edges
from reslrb_cli.transport.emission import differentiate_visible_emission, splat_visible_emission
from reslrb_cli.transport.faces import weigh_faces
from reslrb_cli.transport.film import AdjointImage
from reslrb_cli.transport.pixel_shares import PixelShares
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples, finish_pass, in_passes, passes
from reslrb_cli.transport.walk import Splat, walk


class LightTracer(StepIntegrator):
    """Light tracer with derivatives in forward mode only. OPTIONS are the names and defaults of `ptracer`'s options."""

    OPTIONS: ClassVar[Mapping[str, Any]] = {
        "max_depth": -1,
        "rr_depth": 5,
        "hide_emitters": False,
        "samples_per_pass": None,
    }

    def __init__(
        self, max_depth: int = -1, rr_depth: int = 5, hide_emitters: bool = False, samples_per_pass: int | None = None,
        freeze: bool = False, motion: AttachedOptions | None = None, sampling: SamplingOptions | None = None,
    ) -> None:  # fmt: skip
        """Make the tracer. Raises ValueError, which names the option, for an invalid value.

        `freeze` tells whether launches are recorded (`freezing.py`), and `motion` has the options of attached
        derivatives.
        """
        if max_depth < -1:
            raise ValueError('"max_depth" must be -1 (no limit) or a value >= 0')
        if rr_depth <= 0:
            raise ValueError('"rr_depth" must be greater than zero')
        if samples_per_pass is not None and samples_per_pass <= 0:
            raise ValueError('"samples_per_pass" must be greater than zero')
        self.max_depth, self.rr_depth, self.hide_emitters = max_depth, rr_depth, hide_emitters
        self.samples_per_pass, self.freeze = samples_per_pass, freeze
        motion, sampling = motion or AttachedOptions(), sampling or SamplingOptions()
        self.preparation = Preparation(max_depth, rr_depth, hide_emitters, motion, sampling)

    def with_options(self, *, samples_per_pass: int | None, freeze: bool) -> Self:
        """Return a copy of the tracer with other values of `samples_per_pass` and `freeze`. Both tracers share the
        facts of a scene.
        """
        other = copy.copy(self)
        other.samples_per_pass, other.freeze = samples_per_pass, freeze
        return other

    @property
    def paths(self) -> str:
        """Kinds of paths: light, camera or both."""
        return self.preparation.sampling.paths

    @property
    def light_share(self) -> float:
        """Share of light paths in the samples if there are both kinds."""
        return self.preparation.sampling.light_share

    def afresh(self, light_share: float | None = None, **settings: str) -> Self:
        """Return a copy of the tracer with no facts about any scene, and with changed `settings`
        (`SamplingOptions.chosen`).

        If `light_share` is given, the copy traces light paths and camera paths, with this share of light paths. Images
        then have the same film border for any share.
        """
        other = copy.copy(self)
        changes: dict[str, Any] = {"chosen": {**self.preparation.sampling.chosen, **settings}}
        if light_share is not None:
            changes |= {"paths": "both", "whole": True, "light_share": light_share}
        other.preparation = self.preparation.afresh(**changes)
        return other

    def shared_out(self, noted: Mapping[str, NDArray[np.float32]]) -> Self:
        """Return a copy of the tracer with no facts about any scene. The copy distributes its camera paths by the
        densities `noted`.

        The keys of the densities (`note_pixels`) are sensor numbers.
        """
        other = self.afresh(pixels="measured")
        other.preparation = other.preparation.afresh(given={int(number): density for number, density in noted.items()})
        return other

    def lit_by(self, lit: Mapping[int, tuple[int, ...]]) -> Self:
        """Return a copy of the tracer with no facts about any scene. `lit` has the indices of the emitters that are on,
        by sensor number. For other sensors, all are on.
        """
        other = copy.copy(self)
        other.preparation = self.preparation.afresh(lit=lit)
        return other

    def to_measure(self) -> Self:
        """Return this tracer. If the tracer is guided, return a copy with separate tables instead.

        Measurements before a run must not update the tables of the run. Otherwise the run's tables would depend on
        whether an earlier run has made the measurement.
        """
        return self if self.preparation.guiding is None else self.afresh()

    def expect(self, spp: int) -> None:
        """Set the sample count of the passes that tables learn from. Call this method before the first pass.

        A run calls this method so that its tables have the same cells after a start and after a resume.
        """
        self.preparation.sampling = replace(self.preparation.sampling, expected=spp)

    def plan(self, scene: mi.Scene, sensor: mi.Sensor, params: mi.SceneParameters | None = None) -> Plan:
        """Return the plan for tracing this scene, with derivatives of `params` if given. Raises UnsupportedScene."""
        return self.preparation.plan(scene, sensor, params)

    def passes(
        self, job: Job, purpose: Purpose | None = None, delta: mi.TensorXf | None = None, forward: bool = False
    ) -> list[Samples]:  # fmt: skip
        """Return the samples of a job. If the job's `spp` is 0, the job uses the sensor's own sample count.

        `purpose` selects the table of guided samples. If `purpose` is None, the samples use the gradient's table, or
        the image's table if there is no gradient. If `delta` is given, `delta` also guides the samples. `delta` is
        dL/dI (H, W, C), and must come from other samples. `forward` tells whether the samples are for forward mode.
        Raises ValueError for a negative `spp`.
        """
        if job.spp < 0:
            raise ValueError(f'"spp" must be 0 (the sensor\'s own sample count) or more, not {job.spp}')
        spp = job.spp or job.sensor.sampler().sample_count()
        unit = min(self.samples_per_pass or spp, spp)
        purpose = purpose or (Purpose.IMAGE if job.params is None else Purpose.GRADIENT)
        asked = self.preparation, unit, purpose is Purpose.IMAGE, forward
        if asked not in job.plans:  # once per step, not once per batch
            job.plans[asked] = self.preparation.plan(job.scene, job.sensor, job.params, *asked[1:])
        plan, table = job.plans[asked], None
        if (guiding := self.preparation.guiding) is not None:
            table = guiding.table(self.preparation.sensor_number(job.scene, job.sensor), purpose, delta)
        given = job.scene, job.sensor, job.seed, spp, self.samples_per_pass, table
        parts = passes(plan, *given, *self._sides(plan, job.scene), self._shares(job, plan))
        if not plan.has_edges or purpose is Purpose.IMAGE:
            return parts
        now = self.preparation.edges(plan).now()
        tables = [
            replace(weigh_edges(side, now), chains=weigh_cells(side), faces=weigh_faces(side, now))
            for side in parts[0].sides()
        ]

        def with_edges(part: Samples) -> Samples:
            sides = zip(part.sides(), tables, strict=True)
            own = (replace(table, chains=with_intervals(side, table.chains, len(parts))) for side, table in sides)
            return part.with_edges(*own)

        return [with_edges(part) for part in parts]

    def _sides(self, plan: Plan, scene: mi.Scene) -> tuple[float, EmitterDensities | None]:
        """Return the share of light paths. Also return the emitters' densities if paths from both sides are
        weighted, or not all emitters are lit.
        """
        needed = plan.weighs or plan.lit is not None
        return self.light_share, self.preparation.emitters(plan, scene) if needed else None

    def _shares(self, job: Job, plan: Plan) -> Callable[[int], PixelShares | None] | None:
        """Return the distribution of the job's camera paths, or None for a uniform distribution.

        The tracer measures an unknown distribution once, for the differentiated parameters.
        """
        preparation = self.preparation
        if "pixels" not in plan.on:
            return None
        number = preparation.sensor_number(job.scene, job.sensor)
        known = preparation.sampling.given
        if job.params is not None and number not in known:
            known = preparation.noted(job.params)
            if number not in known:
                known[number] = self.note_pixels(job)
        return partial(preparation.shares, known[number]) if number in known else None

    def note_pixels(self, job: Job, curvature: NDArray[np.floating] | None = None) -> NDArray[np.float32]:
        """Return the density (H, W) of camera paths over the pixels of a job's sensor, for the current scene. The mean
        density is 1.

        `curvature` (H, W) is the curvature of the loss (`pixels.py`). The job's seed and samples do not matter.
        """
        plan = self.preparation.plan(job.scene, job.sensor, job.params)
        entries = self.preparation.entries(plan, job.params)
        with dr.suspend_grad():
            return wanted(plan, job.scene, job.sensor, entries, *self._sides(plan, job.scene), curvature)

    def learn(self, job: Job, gradient: mi.TensorXf) -> None:
        """Update the tables, if an update is due. The update uses separate samples and the known dL/dI.

        Call this method after a gradient. The next gradient uses the result.
        """
        guiding = self.preparation.guiding
        if guiding is not None and guiding.due(self.preparation.sensor_number(job.scene, job.sensor)):
            self.learn_now(job, gradient)

    def learn_now(self, job: Job, gradient: mi.TensorXf) -> None:
        """Update the tables, even if no update is due."""
        guiding = self.preparation.guiding
        assert guiding is not None
        with dr.suspend_grad():
            samples = self.passes(replace(job, seed=learning_seed(job.seed)), Purpose.BOTH)[0]
            if self.freezes([samples]) and samples.width <= freezing.MOST_PATHS_APART:
                collected = self.preparation.recordings.call("collect", samples, collect, gradient)
            else:
                collected = collect(samples, gradient)
            guiding.learn(self.preparation.sensor_number(job.scene, job.sensor), samples.width, collected)

    def image(self, job: Job, evaluate: bool = True) -> mi.TensorXf:
        """Return the image (H, W, C), without derivatives."""
        with dr.suspend_grad():
            parts = self.passes(job, Purpose.IMAGE)  # an image needs nothing that derivatives need
            if not evaluate:
                return image_of(parts)
            image = self.launch("image", parts, image_of)
            dr.eval(image)
            return image

    def tangent(self, job: Job) -> mi.TensorXf:
        """Return the derivative (H, W, C) of the image along the tangents of the job's parameters (forward mode)."""
        with dr.suspend_grad():
            return tangent_of(self.passes(job, forward=True))

    def launch(
        self, kind: str, parts: list[Samples], work: Callable[..., Any], *inputs: Any,
        params: mi.SceneParameters | None = None,
    ) -> Any:  # fmt: skip
        """Call `work(parts, *inputs, params)`, or launch a recording of this call. With one pass, `params` may
        be None.
        """
        if self.freezes(parts):
            recordings = self.preparation.recordings
            return recordings.call(kind, parts[0], lambda part, *given: work([part], *given), *inputs)
        return work(parts, *inputs) if params is None else work(parts, *inputs, params=params)

    def freezes(self, parts: list[Samples]) -> bool:
        """True if a recording traces these samples. Large sets of samples gain little from a recording."""
        [first, *others] = parts
        return self.freeze and not others and first.width <= freezing.MOST_PATHS and first.film.is_recordable


class Reslrb(LightTracer):
    """Light tracer that differentiates the paths of its image by an estimator."""

    def __init__(self, estimator: Estimator, **common: Any) -> None:
        super().__init__(**common)
        self.estimator = estimator

    def share_of_light(self, plan: Plan) -> float:
        """Return the share of the samples that are light paths."""
        return {"light": 1.0, "camera": 0.0}.get(plan.paths, self.light_share)

    def kept(self, plan: Plan) -> Any:
        """Return the types of all data stored for a light path, as in `Estimator.kept`. Camera paths store nothing."""
        return [] if plan.paths == "camera" else self.estimator.of(plan).kept(plan)

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """Return the image. Adds the gradient that the image's own samples give for dL/dI = `derivative(image)`."""
        with dr.suspend_grad():
            parts = self.passes(job, Purpose.BOTH)
            image, state = self.launch("trace", parts, partial(trace_image, self.estimator))
        gradient = derivative(image)
        self._differentiate(parts, gradient, job.params, state)
        self.learn(job, gradient)
        return image

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective. `gradient` (H, W, C) is dL/dI."""
        with dr.suspend_grad():
            parts = self.passes(job, delta=gradient)
        self._differentiate(parts, gradient, job.params)
        self.learn(job, gradient)

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """Return the image. Adds the gradient for a given dL/dI, `gradient` (H, W, C). dL/dI is known before the image.

        If the estimator supports a common traversal, one set of samples is traced once for image and gradient.
        """
        with dr.suspend_grad():
            parts = self.passes(job, Purpose.BOTH, gradient)
            image = self.launch("fused", parts, partial(fused, self.estimator, True), gradient, params=job.params)
        self.learn(job, gradient)
        return image

    def _differentiate(
        self, parts: list[Samples], gradient: mi.TensorXf, params: mi.SceneParameters | None, state: Any = None
    ) -> None:
        """Add the gradient. If `state` is None, the paths are traced again, otherwise `state` has their stored data."""
        with dr.suspend_grad():
            if state is None:
                work = partial(fused, self.estimator, False)
                self.launch("trace and replay", parts, work, gradient, params=params)
            else:
                self.launch("replay", parts, partial(backward_stored, self.estimator), gradient, state)


def image_of(samples: list[Samples]) -> mi.TensorXf:
    """Return the image of all passes without storing any data."""
    film = samples[0].film
    block = film.block()

    def splat(part: Samples, own: mi.ImageBlock | None) -> None:
        splat_visible_emission(part, own)
        for side in part.sides():
            if side.plan.camera:
                splat_camera_paths(side, own)
            else:
                walk(side, Splat(side, own))

    in_passes(samples, splat, block)
    return film.develop(block)


def forward(
    samples: Samples, estimator: Estimator, block: mi.ImageBlock | None, adjoint: AdjointImage | None = None
) -> Any:
    """Trace the samples and return what the estimator stores of each path. The returned data are not evaluated.

    Contributions are splatted to the block. If the block is None, there is no image. If the `adjoint` is known, an
    estimator may already add derivatives: `stack` walks back here. Derivatives of camera paths are always added here.
    """
    if block is not None:
        splat_visible_emission(samples, block)
    state = None
    for side in samples.sides():
        p = Pass(side, block, adjoint)
        if not side.plan.camera:
            state = estimator.of(side.plan).forward(p)
        elif adjoint is not None:
            differentiate_camera_paths(p, estimator.stack_size)
        elif block is not None:
            splat_camera_paths(side, block)
    return state


def trace_image(estimator: Estimator, samples: list[Samples]) -> tuple[mi.TensorXf, Any]:
    """Return the image of all passes, and the estimator's stored data of each path.

    With several passes, nothing is stored, because the data would grow with the number of passes. Each pass is then
    traced again before its replay.
    """
    state = None
    if len(samples) > 1:
        image = image_of(samples)
    else:
        film = samples[0].film
        block = film.block()
        state = forward(samples[0], estimator, block)
        # One kernel: all outputs are evaluated together, because a later evaluation would trace everything again.
        dr.schedule(block.tensor())
        dr.eval(state)
        image = film.develop(block)
    dr.eval(image)
    return image, state


def backward(
    samples: Samples, estimator: Estimator, state: Any, adjoint: AdjointImage, after_forward: bool = False
) -> None:
    """Add the derivatives that `forward` has not added. `state` is what `forward` has returned.

    `after_forward` is true if `forward` knew the `adjoint`. It has then added the derivatives of camera paths.
    """
    differentiate_visible_emission(samples, adjoint)
    for side in samples.sides():
        p = Pass(side, None, adjoint)
        if not side.plan.camera:
            estimator.of(side.plan).backward(p, state)
        elif not after_forward:
            differentiate_camera_paths(p, estimator.stack_size)
    for side in samples.sides() if samples.edges is not None else ():
        terms = differentiate_edges_of_camera_paths if side.plan.camera else differentiate_edges
        p = Pass(side, None, adjoint)
        terms(p)
        if has_edges_behind_chains(side.plan):
            differentiate_edges_behind_chains(p)


def backward_stored(estimator: Estimator, samples: list[Samples], gradient: mi.TensorXf, state: Any) -> None:
    """Add the gradient. `gradient` (H, W, C) is dL/dI, and `state` is the stored data of the paths of the only pass."""
    [part] = samples
    adjoint = part.film.adjoint(gradient)
    # Derivatives wait at the edge of this block, and go on to the parameters together at its end. Otherwise, each of
    # them would be evaluated on its way, in a kernel of its own that traces the paths again.
    with dr.isolate_grad():
        backward(part, estimator, state, adjoint)


def fused(
    estimator: Estimator, with_image: bool, samples: list[Samples], gradient: mi.TensorXf,
    params: mi.SceneParameters | None = None,
) -> mi.TensorXf | None:  # fmt: skip
    """Trace samples with a known dL/dI, `gradient` (H, W, C), and add the gradient. Return the image if requested.

    For `stack`, `forward` does nearly all work, and `backward` adds the derivatives of emission and edges. The data of
    a path stay within the kernel, and take no memory. With one pass, `params` may be None.
    """
    film = samples[0].film
    block = film.block() if with_image else None
    adjoint = film.adjoint(gradient)

    def differentiate(part: Samples, own: mi.ImageBlock | None) -> None:
        with dr.isolate_grad():  # as in `backward_stored`
            state = forward(part, estimator, own, adjoint)
            backward(part, estimator, state, adjoint, after_forward=True)
            image = [] if own is None else [own.tensor()]
            dr.schedule(image)
            if len(samples) > 1:
                finish_pass(image)

    in_passes(samples, differentiate, block, params)
    return None if block is None else film.develop(block)
