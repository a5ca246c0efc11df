"""Light tracers: what ours have in common, reservoir light replay backpropagation, and what is done with samples.

In common they have `ptracer`'s options, a plan, passes, the image and its tangent (`LightTracer`). `Reslrb` has images
and gradients by one of the estimators. They know nothing of Mitsuba's plugins; `plugin.py` makes plugins of them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.estimators.base import Estimator, Pass, one_of
from reslrb_cli.estimators.camera import (
    camera_scratch_bytes,
    differentiate_camera_paths,
    splat_camera_paths,
    splat_camera_tangents,
)
from reslrb_cli.guiding.collect import hear
from reslrb_cli.guiding.pixels import wanted
from reslrb_cli.guiding.tables import Purpose, learning_seed
from reslrb_cli.integrators import freezing
from reslrb_cli.integrators.context import Preparation, sensor_number
from reslrb_cli.integrators.differentiated import Motion
from reslrb_cli.integrators.forward import splat_tangents
from reslrb_cli.integrators.protocol import Derivative, Job
from reslrb_cli.transport.densities import EmitterDensities
from reslrb_cli.transport.film import AdjointImage, PixelShares
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples, finish_pass, in_passes, passes
from reslrb_cli.transport.visible import differentiate_visible_emission, splat_visible_emission
from reslrb_cli.transport.walk import Splat, walk

PATHS = ("light", "camera", "both")


class LightTracer:
    """A light tracer without derivatives but for forward mode; OPTIONS are names and defaults as `ptracer` has them."""

    OPTIONS: ClassVar[Mapping[str, Any]] = {
        "max_depth": -1,
        "rr_depth": 5,
        "hide_emitters": False,
        "samples_per_pass": None,
    }
    image_apart = True
    #: Which paths there are, and the share of light paths in the samples where there are both kinds.
    paths: str = "light"
    light_share: float = 0.5

    def __init__(
        self, max_depth: int = -1, rr_depth: int = 5, hide_emitters: bool = False, samples_per_pass: int | None = None,
        freeze: bool = False, motion: Motion | None = None, guided: bool = False, low_discrepancy: bool = False,
    ) -> None:  # fmt: skip
        """Raises ValueError, which names the option, where one has a value that it cannot have.

        `freeze` says whether launches are recorded (`freezing.py`), `motion` how derivatives of what moves are taken,
        `guided` whether emission is drawn from what earlier paths said (`tables.py`),
        `low_discrepancy` whether the numbers of a path's beginning are (`sobol.py`).
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
        self, *, guided: bool | None = None, images: bool | None = None, low_discrepancy: bool | None = None,
        light_share: float | None = None, shares_out: bool | None = None,
    ) -> Self:  # fmt: skip
        """The same, which knows nothing of any scene yet, with other ways of drawing samples; None: as it has it.

        Guided emission or none, `images`: of images too; low-discrepancy numbers or independent ones; paths from both
        sides, of which `light_share` are light paths: images have the film's border of both, whatever that share is;
        camera paths that are shared out over the pixels, or evenly spread.
        """
        other = copy.copy(self)
        other.preparation = self.preparation.afresh(guided, images, low_discrepancy)
        if light_share is not None:
            other.have_paths("both", light_share, whole=True)
        if shares_out is not None:
            other.preparation.shares_out = shares_out
        return other

    def shared_out(self, noted: Mapping[str, NDArray[np.float32]]) -> Self:
        """The same, which knows nothing of any scene yet, with camera paths shared out over the pixels as was noted of
        them, by the number of the sensor (`note_pixels`)."""
        other = self.afresh(shares_out=True)
        other.preparation.given = {int(number): density for number, density in noted.items()}
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

    def have_paths(self, paths: str, light_share: float, whole: bool = False) -> None:
        """Have light paths, camera paths, or both, `light_share` of the samples being light paths; a share of 0 or 1
        leaves one kind of them. `whole`: light paths alone, too, have the film's border that the others have."""
        one_of("paths", paths, PATHS)
        if not 0 <= light_share <= 1:
            raise ValueError(f'"light_share" must lie in [0, 1], not {light_share}')
        if paths == "both" and light_share in (0, 1):
            paths = "light" if light_share else "camera"
        self.paths, self.light_share = paths, light_share
        self.preparation.paths, self.preparation.whole = paths, whole or paths != "light"
        if paths == "camera":  # of which none begins where a table says
            self.preparation.guiding = None

    def plan(self, scene: mi.Scene, sensor: mi.Sensor, params: mi.SceneParameters | None = None) -> Plan:
        """What a walk of this scene needs, with derivatives of `params`, if any. Raises UnsupportedScene."""
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
        purpose = purpose or (Purpose.IMAGE if job.params is None else Purpose.GRADIENT)
        asked = self.preparation, purpose is Purpose.IMAGE, unit
        if asked not in job.plans:  # once a step, and not once a batch
            job.plans[asked] = self.preparation.plan(job.scene, job.sensor, job.params, unit, asked[1])
        plan, table = job.plans[asked], None
        guiding = self.preparation.guiding
        if guiding is not None and guiding.serves(purpose):
            table = guiding.table(sensor_number(job.scene, job.sensor), purpose, delta)
        given = job.scene, job.sensor, job.seed, spp, self.samples_per_pass, table
        return passes(plan, *given, *self._sides(plan, job.scene), self._shares(job, plan))

    def _sides(self, plan: Plan, scene: mi.Scene) -> tuple[float, EmitterDensities | None]:
        """The share of light paths, and the emitters' densities, where paths from both sides are weighed."""
        return self.light_share, self.preparation.emitters(plan, scene) if plan.weighs else None

    def _shares(self, job: Job, plan: Plan) -> Callable[[int], PixelShares | None] | None:
        """Return how the job's camera paths are shared out; None: evenly.

        Where nobody has said so before, it is found out once for the parameters that are differentiated.
        """
        preparation = self.preparation
        if plan.paths == "light" or not preparation.shares_out:
            return None
        number, size = sensor_number(job.scene, job.sensor), job.sensor.film().crop_size()
        known = preparation.given
        if job.params is not None and number not in known:
            known = preparation.noted(job.params)
            if number not in known:
                known[number] = self.note_pixels(job)
        return preparation.shares(number, known[number], (int(size[0]), int(size[1]))) if number in known else None

    def note_pixels(self, job: Job, curvature: NDArray[np.floating] | None = None) -> NDArray[np.float32]:
        """Return the density of camera paths over the pixels (H, W) of a job's sensor, with mean 1, as the scene is now
        and for a loss of this `curvature` (H, W) (`pixels.py`). The job's seed and samples play no part."""
        plan = self.preparation.plan(job.scene, job.sensor, job.params)
        entries = self.preparation.entries(plan, job.params)
        with dr.suspend_grad():
            return wanted(plan, job.scene, job.sensor, entries, *self._sides(plan, job.scene), curvature)

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

    def image(self, job: Job, evaluate: bool = True) -> mi.TensorXf:
        """The image (H, W, C), without derivatives."""
        with dr.suspend_grad():
            parts = self.passes(job, Purpose.IMAGE)  # an image has no use for what derivatives ask of a walk
            if not evaluate:
                return image_of(parts)
            image = self.launch("image", parts, image_of)
            dr.eval(image)
            return image

    def tangent(self, job: Job) -> mi.TensorXf:
        """The derivative (H, W, C) of the image along the tangents of the job's parameters (forward mode)."""
        with dr.suspend_grad():
            parts = self.passes(job)
            if parts[0].plan.moving_emission:
                raise UnsupportedScene("forward mode has no derivatives of emitters that move; take reverse mode")
            film = parts[0].film
            block = film.block()
            in_passes(parts, _splat_tangents, block)
            return film.develop(block, tangent=True)

    def launch(
        self, kind: str, parts: list[Samples], work: Callable[..., Any], *inputs: Any,
        params: mi.SceneParameters | None = None,
    ) -> Any:  # fmt: skip
        """`work(parts, *inputs, params)`, or a recording of that, launched again; one pass need not know `params`."""
        if self.freezes(parts):
            recordings = self.preparation.recordings
            return recordings.call(kind, parts[0], lambda part, *given: work([part], *given), *inputs)
        return work(parts, *inputs) if params is None else work(parts, *inputs, params=params)

    def freezes(self, parts: list[Samples]) -> bool:
        """Whether these samples are traced from a recording; large ones, and so several passes, gain little."""
        return self.freeze and len(parts) == 1 and parts[0].width <= freezing.MOST_PATHS


class Reslrb(LightTracer):
    """Derivatives by a replay of each path; the options beside OPTIONS are those of the estimator."""

    OPTIONS: ClassVar[Mapping[str, Any]] = {
        **LightTracer.OPTIONS,
        "estimator": "reservoir",
        "freeze": False,
        "attached": "auto",
        "filter_normalization": "attached",
        "attached_sampling": "auto",
        "guiding": "off",
        "sequence": "independent",
        "paths": "light",
        "light_share": 0.5,
        "pixels": "even",
    }

    def __init__(self, estimator: Estimator, **common: Any) -> None:
        super().__init__(**common)
        self.estimator = estimator

    @classmethod
    def of(
        cls, estimator: str | None = None, attached: bool | str = "auto", filter_normalization: str = "attached",
        attached_sampling: str = "auto", guiding: str = "off", sequence: str = "independent", paths: str = "light",
        light_share: float = 0.5, pixels: str = "even", **options: Any,
    ) -> Reslrb:  # fmt: skip
        """From the estimator's name and all options. Raises ValueError where one is wrong."""
        estimator = estimator or ("stack" if paths == "camera" else cls.OPTIONS["estimator"])
        if estimator == "auto":
            raise ValueError(
                '"estimator" auto needs an experiment to measure on (`reslrb optimize`); as a plugin, name one of '
                + ", ".join(ESTIMATORS)
            )
        if estimator not in ESTIMATORS:
            raise ValueError(f'"estimator" must be one of {", ".join(ESTIMATORS)}, not "{estimator}"')
        kind = ESTIMATORS[estimator]
        own = {name: options.pop(name) for name in kind.OPTIONS if name in options}
        if paths == "camera" and estimator != "stack":
            raise ValueError(
                f'"estimator" {estimator} chooses among the connections of light paths, of which paths: camera has '
                "none; leave it out, or take stack"
            )
        obstacle = None if kind.attaches else _no_attached(estimator)
        motion = Motion(attached, filter_normalization, obstacle, attached_sampling)
        for name, value, values in (
            ("guiding", guiding, ("on", "off")),
            ("sequence", sequence, ("independent", "low_discrepancy")),
            ("pixels", pixels, ("even", "measured")),
        ):
            if value == "auto":
                raise ValueError(
                    f'"{name}" auto needs an experiment to measure on (`reslrb optimize`); say {" or ".join(values)}'
                )
            one_of(name, value, values)
        options |= {"guided": guiding == "on", "low_discrepancy": sequence == "low_discrepancy"}
        made = cls(kind(**own), motion=motion, **options)
        made.have_paths(paths, light_share)
        made.preparation.shares_out = pixels == "measured"
        return made

    def share_of_light(self, plan: Plan) -> float:
        """The share of the samples that are light paths."""
        return {"light": 1.0, "camera": 0.0}.get(plan.paths, self.light_share)

    def kept(self, plan: Plan) -> Any:
        """All that memory holds of a light path at once, as `Estimator.kept` has it; of camera paths it is nothing."""
        return [] if plan.paths == "camera" else self.estimator.kept(plan)

    def scratch_bytes(self, plan: Plan) -> int:
        """Thread-local bytes of each path that is being traced, of either kind."""
        light = 0 if plan.paths == "camera" else self.estimator.scratch_bytes(plan)
        return light if plan.paths == "light" else max(light, camera_scratch_bytes(plan, self.estimator.stack_size))

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """The image, and the gradient of the same samples with the dL/dI that `derivative(image)` returns."""
        with dr.suspend_grad():
            parts = self.passes(job, Purpose.BOTH)
            traced = Trace(parts, *self.launch("trace", parts, partial(trace_image, self.estimator)))
        gradient = derivative(traced.image)
        self._replay(traced, gradient, job.params)
        self.learn(job, gradient)
        return traced.image

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective with dL/dI `gradient` (H, W, C)."""
        with dr.suspend_grad():
            trace = Trace(self.passes(job, delta=gradient))
        self._replay(trace, gradient, job.params)
        self.learn(job, gradient)

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """The image, and the gradient of the objective with dL/dI `gradient` (H, W, C), known before either.

        One set of samples, traced once for both where the estimator can.
        """
        with dr.suspend_grad():
            parts = self.passes(job, Purpose.BOTH, gradient)
            image = self.launch("fused", parts, partial(fused, self.estimator), gradient, params=job.params)
        self.learn(job, gradient)
        return image

    def _replay(self, trace: Trace, gradient: mi.TensorXf, params: mi.SceneParameters | None) -> None:
        kind, state = ("trace and replay", []) if trace.state is None else ("replay", [trace.state])
        with dr.suspend_grad():
            self.launch(kind, trace.samples, partial(replay_all, self.estimator), gradient, *state, params=params)


def _no_attached(estimator: str) -> str:
    able = ", ".join(name for name, kind in ESTIMATORS.items() if kind.attaches)
    return (
        f"estimator {estimator} has no derivatives of what moves light: it would need the Jacobians that reservoir "
        f"takes at every vertex, and gain nothing by them; take {able}"
    )


def _splat_tangents(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the forward-mode derivative of all paths' image to the block."""
    splat_tangents(samples, block)
    for side in samples.sides():
        if side.plan.camera:
            splat_camera_tangents(side, block)


def image_of(samples: list[Samples]) -> mi.TensorXf:
    """The image of all passes; nothing is kept."""
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
    """Trace the samples: add their contributions to the block (None: no image). What is kept of each path is returned,
    and not evaluated."""
    if block is not None:
        splat_visible_emission(samples, block)
    state = None
    for side in samples.sides():
        p = Pass(side, block, adjoint)
        if not side.plan.camera:
            state = estimator.forward(p)
        elif adjoint is not None:
            differentiate_camera_paths(p, estimator.stack_size)
        elif block is not None:
            splat_camera_paths(side, block)
    return state


@dataclass
class Trace:
    """Samples that have been traced: their image, and what is kept of their paths if they fit in one pass."""

    samples: list[Samples]
    image: mi.TensorXf | None = None
    state: Any = None


def trace_image(estimator: Estimator, samples: list[Samples]) -> tuple[mi.TensorXf, Any]:
    """The image of all passes, and what the estimator keeps of each path.

    Several passes keep nothing, which would grow with the number of passes: each is traced again before its replay.
    """
    state = None
    if len(samples) > 1:
        image = image_of(samples)
    else:
        film = samples[0].film
        block = film.block()
        state = forward(samples[0], estimator, block)
        # One kernel: all that it yields is evaluated together, since what came later would trace everything again.
        dr.schedule(block.tensor())
        dr.eval(state)
        image = film.develop(block)
    dr.eval(image)
    return image, state


def replay(samples: Samples, estimator: Estimator, state: Any, adjoint: AdjointImage, done: bool = False) -> None:
    """Add the derivatives of the objective, whose derivative with respect to the film is `adjoint`; `done`: those of
    camera paths are there, from their only traversal."""
    differentiate_visible_emission(samples, adjoint)
    for side in samples.sides():
        p = Pass(side, None, adjoint)
        if not side.plan.camera:
            estimator.backward(p, state)
        elif not done:
            differentiate_camera_paths(p, estimator.stack_size)


def replay_all(
    estimator: Estimator, samples: list[Samples], gradient: mi.TensorXf, state: Any = None,
    params: mi.SceneParameters | None = None,
) -> None:  # fmt: skip
    """Add the gradient of the objective with dL/dI `gradient` (H, W, C) to `params`, which one pass need not know.

    `state` is what is kept of the paths of one pass; None: they are traced anew.
    """
    adjoint = samples[0].film.adjoint(gradient)
    if state is None:
        differentiate_passes(samples, estimator, None, adjoint, params)
        return
    # Isolated: on their way to the parameters gradients are evaluated, and with them all that they hang on, which is to
    # be one kernel. They set out once, at the end.
    with dr.isolate_grad():
        replay(samples[0], estimator, state, adjoint)


def fused(
    estimator: Estimator, samples: list[Samples], gradient: mi.TensorXf, params: mi.SceneParameters | None = None
) -> mi.TensorXf:
    """The image, and the same gradient, where dL/dI is known before either."""
    film = samples[0].film
    block = film.block()
    differentiate_passes(samples, estimator, block, film.adjoint(gradient), params)
    return film.develop(block)


def differentiate_passes(
    samples: list[Samples], estimator: Estimator, block: mi.ImageBlock | None, adjoint: AdjointImage,
    params: mi.SceneParameters | None,
) -> None:  # fmt: skip
    """Trace samples whose dL/dI is known and add their derivatives, and to the block (None: none) their contributions.

    What is kept of a path goes from one to the other within the kernel, and takes no memory.
    """

    def differentiate(part: Samples, own: mi.ImageBlock | None) -> None:
        with dr.isolate_grad():  # as above
            replay(part, estimator, forward(part, estimator, own, adjoint), adjoint, done=True)
            image = [] if own is None else [own.tensor()]
            dr.schedule(image)
            if len(samples) > 1:
                finish_pass(image)

    in_passes(samples, differentiate, block, params)
