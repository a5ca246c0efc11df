"""Step: image, loss, and the gradient of every parameter, by any integrator.

`adjoint` selects the samples that dL/dI comes from.

- `correlated`: image and gradient use one set of samples, as in naive AD of one rendering.
- `independent`: the samples of the gradient have their own seed, as in `mi.render`.
- `batched`: the samples are divided into batches. Each batch takes dL/dI from the image of the earlier batches
    (`_batched`).

Entries of dL/dI that are not finite are set to 0, and counted (`Refused`). One NaN in dL/dI would turn the gradients of
all parameters on that pixel's paths into NaN. The kernel that computes dL/dI also counts the non-finite entries. Only
code that reads the count waits for the kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Literal, TypeAlias, get_args

import drjit as dr
import mitsuba as mi

from reslrb_cli.backend.variant import check_variant
from reslrb_cli.config.files import PASS_SAMPLES, PASSES
from reslrb_cli.estimators.base import one_of
from reslrb_cli.integrators.baselines import NaiveAD, Projective, Replayed
from reslrb_cli.integrators.context import resolve_sensor
from reslrb_cli.integrators.protocol import Job, StepIntegrator
from reslrb_cli.scene.plastic import with_tables

Adjoint = Literal["correlated", "independent", "batched"]
Objective: TypeAlias = "Callable[[mi.TensorXf], mi.Float | mi.TensorXf]"

#: Called with an image and the dL/dI with which its samples were differentiated.
OnSamples: TypeAlias = "Callable[[mi.TensorXf, mi.TensorXf], None]"
BATCH_STREAM = 0xBA7C4E5  # separates the batches' seeds from those of passes and of the second samples
NONE = 0xFFFFFFFF


@dataclass
class Refused:
    """Entries of dL/dI that were not finite.

    `count` is the number of entries that are not finite. `first` is the flat index of the first non-finite entry.
    `count` and `first` are arrays of width 1. `shape` is the shape (H, W, C) of dL/dI.
    """

    count: mi.UInt32 = field(default_factory=lambda: dr.zeros(mi.UInt32, 1))
    first: mi.UInt32 = field(default_factory=lambda: dr.full(mi.UInt32, NONE, 1))
    shape: tuple[int, ...] = (0, 0, 0)

    def take(self, gradient: mi.TensorXf) -> mi.TensorXf:
        """Return dL/dI with 0 for entries that are not finite. Adds the number of these entries to `count`. Does not
        evaluate either of them.
        """
        self.shape, flat = gradient.shape, gradient.array
        bad = ~dr.isfinite(flat)
        # Only lanes with non-finite values use atomics: none if nothing is wrong.
        dr.scatter_reduce(dr.ReduceOp.Add, self.count, mi.UInt32(1), mi.UInt32(0), bad, dr.ReduceMode.Direct)
        index = dr.arange(mi.UInt32, dr.width(flat))
        dr.scatter_reduce(dr.ReduceOp.Min, self.first, index, mi.UInt32(0), bad, dr.ReduceMode.Direct)
        return type(gradient)(dr.select(bad, 0, flat), gradient.shape)

    def entry(self) -> tuple[int, int, int] | None:
        """Return pixel (x, y) and channel of the first entry that is not finite, or None if all entries are finite.
        Waits for the step.
        """
        index = int(self.first[0])
        if index == NONE:
            return None
        _, width, channels = self.shape
        return index // channels % width, index // channels // width, index % channels


@dataclass
class StepResult:
    """Result of a step, without gradients: the image (H, W, C) and the loss (width 1), both detached.

    Entries of dL/dI that are not finite count as 0. `refused` holds the number of non-finite entries, and the index of
    the first one.
    """

    image: mi.TensorXf
    loss: mi.Float | mi.TensorXf
    refused: Refused = field(default_factory=Refused)


def interface_of(integrator: StepIntegrator | mi.Integrator) -> StepIntegrator:
    """Return the step interface of a plugin. An object that already is a step interface is returned unchanged."""
    if not isinstance(integrator, mi.Integrator):
        return integrator
    tracer: StepIntegrator | None = getattr(integrator, "tracer", None)  # of the plugins that are created here
    if tracer is not None:
        return tracer
    if isinstance(integrator, mi.AdjointIntegrator):
        return NaiveAD(integrator)
    return Projective(integrator) if hasattr(integrator, "proj_detail") else Replayed(integrator)


def render_image(
    integrator: StepIntegrator, scene: mi.Scene, sensor: mi.Sensor | int, seed: int, spp: int
) -> mi.TensorXf:
    """Return the image (H, W, C) without derivatives."""
    return integrator.image(Job(scene, resolve_sensor(scene, sensor), dr.opaque(mi.UInt32, seed), spp))


def gradient_step(
    integrator: StepIntegrator | mi.Integrator,
    scene: mi.Scene,
    sensor: mi.Sensor | int,
    objective: Objective,
    *,
    seed: int,
    spp: int,
    adjoint: Adjoint = "correlated",
    params: mi.SceneParameters | None = None,
    batches: int = 4,
    on_samples: OnSamples | None = None,
) -> StepResult:
    """Render, evaluate `objective(image)`, and add its gradient to the scene's parameters that track derivatives.

    - `objective` maps the image, a tensor (H, W, C) that tracks derivatives, to a scalar.
    - `sensor` is a sensor of the scene, or its index.
    - `params` are the scene's parameters, by default `mi.traverse(scene)`.
    - `spp` is a sample count. 0 means the sensor's sample count.
    - `batches` is the number of batches for `adjoint="batched"`. The returned loss then belongs to the image of all
        samples.
    - `on_samples` is called for each differentiated set of samples, with the set's image and dL/dI. The callback can
        then differentiate a factor of the image with the same samples.

    Raises ValueError for invalid arguments, and BackendError under an unsupported variant of Mitsuba.
    """
    job = make_job(scene, sensor, seed, spp, params)
    one_of("adjoint", adjoint, get_args(Adjoint))
    _check_number("batches", batches, 2 if adjoint == "batched" else 1, PASSES)
    work = interface_of(integrator)
    with with_tables(job.params):
        return _step(work, job, objective, adjoint, batches, on_samples)


def _step(
    work: StepIntegrator, job: Job, objective: Objective, adjoint: Adjoint, batches: int, on_samples: OnSamples | None
) -> StepResult:
    if adjoint == "batched":
        return _batched(work, job, objective, batches, on_samples)
    refused = Refused()
    if adjoint == "independent":
        image = work.image(job)
        loss, gradient = derivative_of(objective, image, refused)
        _differentiate(work, replace(job, seed=second_seed(job.seed)), gradient, on_samples)
        return StepResult(image, loss, refused)
    found: list[tuple[mi.Float | mi.TensorXf, mi.TensorXf]] = []

    def derivative(image: mi.TensorXf) -> mi.TensorXf:
        found.append(derivative_of(objective, image, refused))
        return found[0][1]

    image = work.correlated(job, derivative)
    [(loss, gradient)] = found
    if on_samples is not None:
        on_samples(image, gradient)
    return StepResult(image, loss, refused)


def known_step(
    integrator: StepIntegrator | mi.Integrator, scene: mi.Scene, sensor: mi.Sensor | int, gradient: mi.TensorXf, *,
    seed: int, spp: int, params: mi.SceneParameters | None = None,
) -> StepResult:  # fmt: skip
    """Make a step with a dL/dI that is known before the image: `gradient` (H, W, C). The loss is the sum of dL/dI times
    I.

    One set of samples serves both. If the estimator of `reslrb` supports it, one traversal splats and differentiates.
    The other arguments are those of `gradient_step`.
    """
    refused = Refused()
    gradient = refused.take(dr.detach(gradient))
    job = make_job(scene, sensor, seed, spp, params)
    with with_tables(job.params):
        image = interface_of(integrator).known(job, gradient)
    return StepResult(image, dr.sum((image * gradient).array), refused)


def given_step(
    integrator: StepIntegrator | mi.Integrator, scene: mi.Scene, sensor: mi.Sensor | int, gradient: mi.TensorXf, *,
    seed: int, spp: int, params: mi.SceneParameters | None = None, on_samples: OnSamples | None = None,
) -> None:  # fmt: skip
    """Add the gradient estimated from the samples with the seed `seed`. `gradient` (H, W, C) is dL/dI.

    `gradient` must be finite and come from other samples. The other arguments are those of `gradient_step`.
    """
    job = make_job(scene, sensor, seed, spp, params)
    with with_tables(job.params):
        _differentiate(interface_of(integrator), job, gradient, on_samples)


def _check_number(name: str, value: object, least: int, most: int) -> None:
    """Raise ValueError if an argument is not a whole number between `least` and `most`."""
    if not isinstance(value, Integral) or not least <= int(value) <= most:
        raise ValueError(f'"{name}" must be an integer from {least} to {most}, not {value!r}')


def _differentiate(work: StepIntegrator, job: Job, gradient: mi.TensorXf, on_samples: OnSamples | None) -> None:
    """Add the gradient of samples with a known dL/dI. An image of the samples is rendered only if `on_samples` needs
    the image.
    """
    if on_samples is None:
        work.backward(job, gradient)
    else:
        on_samples(work.known(job, gradient), gradient)


def make_job(scene: mi.Scene, sensor: mi.Sensor | int, seed: int, spp: int, params: mi.SceneParameters | None) -> Job:
    """Return a job from a user's arguments. `params` are by default `mi.traverse(scene)`.

    Raises ValueError, and BackendError under an unsupported variant.
    """
    check_variant(mi.variant())
    _check_number("spp", spp, 0, PASSES * PASS_SAMPLES)
    if isinstance(seed, Integral):
        _check_number("seed", seed, 0, 2**32 - 1)
    image_seed = mi.UInt32(seed)
    dr.make_opaque(image_seed)
    return Job(
        scene, resolve_sensor(scene, sensor), image_seed, spp, params if params is not None else mi.traverse(scene)
    )


def _batched(
    integrator: StepIntegrator, job: Job, objective: Objective, batches: int, on_samples: OnSamples | None
) -> StepResult:
    """Make a step in batches (dual buffer of Deng et al. 2022). Batch b takes dL/dI from the image of the earlier
    batches.

    No path uses a dL/dI that contains it. The gradient of an L2 loss is therefore unbiased, as with `independent`, but
    needs only half the paths. The first batch contributes only to the image.
    """
    job = replace(job, spp=job.spp or int(job.sensor.sampler().sample_count()))
    if job.spp % batches:
        raise ValueError(f"the samples per pixel ({job.spp}) must be a multiple of the batches ({batches})")
    parts = [replace(job, seed=seed, spp=job.spp // batches) for seed in batch_seeds(job.seed, batches)]
    share = 1 / (batches - 1)  # the gradient is the mean over the batches that have a dL/dI
    image, refused = integrator.image(parts[0]), Refused()
    for b in range(1, batches):
        _, gradient = derivative_of(objective, image, refused)
        own = integrator.known(parts[b], gradient * share)
        if on_samples is not None:
            on_samples(own, gradient * share)
        image = image + (own - image) / (b + 1)
        dr.eval(image)
    return StepResult(image, dr.detach(objective(image)), refused)


def derivative_of(
    objective: Objective, image: mi.TensorXf, refused: Refused
) -> tuple[mi.Float | mi.TensorXf, mi.TensorXf]:
    """Return loss and dL/dI, evaluated together. Entries of dL/dI that are not finite are set to 0 and counted."""
    with dr.resume_grad(), dr.isolate_grad():
        leaf = type(image)(image)
        dr.enable_grad(leaf)
        loss = objective(leaf)
        dr.backward_from(loss)
        gradient = dr.grad(leaf)
    loss, gradient = dr.detach(loss), refused.take(dr.detach(gradient))
    dr.eval(loss, gradient, refused)
    return loss, gradient


def batch_seeds(seed: mi.UInt32 | int, batches: int) -> list[mi.UInt32]:
    """Return the seed of each batch."""
    seeds = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(BATCH_STREAM + b))[0] for b in range(batches)]
    dr.make_opaque(seeds)
    return seeds


def second_seed(seed: mi.UInt32) -> mi.UInt32:
    """Return the seed of the gradient's separate samples."""
    result = mi.sample_tea_32(seed, mi.UInt32(1))[0]
    dr.make_opaque(result)
    return result
