"""A step: image, loss, and the gradient of every parameter, by any integrator, with delta from a choice of samples.

correlated     one set of samples for image and gradient; what naive AD of one render does
independent    the gradient's samples have a seed of their own; what `mi.render` does
batched        the samples in batches, each with delta from the image of those before it (`_batched`)

With `halves`, each of these sets of samples is two, of half the samples each, and images are (2, H, W, C): where a loss
multiplies an image by itself, it takes the two, whose noise is independent (`Halves`).

Derivatives of a loss that are not finite are refused, which is to say taken for 0, and counted (`Refused`). One NaN in
dL/dI would make a gradient NaN wherever a path of that pixel passes, and some estimators would lose it on the way. Both
are done in the kernel that computes dL/dI, and nobody waits for the count but who reads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any, Literal, TypeAlias, get_args

import drjit as dr
import mitsuba as mi

from reslrb_cli.backend.variant import check_variant
from reslrb_cli.config.files import PASS_SAMPLES, PASSES
from reslrb_cli.estimators.base import one_of
from reslrb_cli.integrators.baselines import NaiveAD, Projective, Replayed
from reslrb_cli.integrators.context import resolve_sensor
from reslrb_cli.integrators.own import OwnIntegrator
from reslrb_cli.integrators.plugin import TRACERS, make_tracer
from reslrb_cli.integrators.protocol import Derivative, Job, StepIntegrator, halves_of, whole_of

Adjoint = Literal["correlated", "independent", "batched"]
Objective: TypeAlias = "Callable[[mi.TensorXf], mi.Float | mi.TensorXf]"

#: Told of an image and of the dL/dI that its samples were differentiated with.
OnSamples: TypeAlias = "Callable[[mi.TensorXf, mi.TensorXf], None]"
BATCH_STREAM = 0xBA7C4E5  # keeps the batches' seeds apart from those of passes and of the second samples
HALF_STREAM = 0x4A1F5  # and those of halves from all of these
NONE = 0xFFFFFFFF


@dataclass
class Refused:
    """Entries of dL/dI that were not finite: how many, and the first one's flat index, of width 1; the shape of dL/dI,
    (H, W, C), or of halves (2, H, W, C)."""

    count: mi.UInt32 = field(default_factory=lambda: dr.zeros(mi.UInt32, 1))
    first: mi.UInt32 = field(default_factory=lambda: dr.full(mi.UInt32, NONE, 1))
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
        height, width, channels = self.shape[-3:]
        return index // channels % width, index // channels // width % height, index % channels


@dataclass
class StepResult:
    """What a step yields besides gradients: the image (H, W, C) and the loss (width 1), both detached.

    Entries of dL/dI that are not finite count as 0; `refused` says how many there were, and where the first. `seen` is
    the image as the objective had it, (2, H, W, C) of halves.
    """

    image: mi.TensorXf
    loss: mi.Float | mi.TensorXf
    refused: Refused = field(default_factory=Refused)
    seen: mi.TensorXf | None = None


def make_integrator(type: str, **options: Any) -> StepIntegrator:
    """An integrator by its plugin's name and options: `reslrb`, `walk_ad`, or a stock one such as `ptracer`, `prb`; or
    `custom`, a user's own (`OwnIntegrator`).

    An option that is None is left out: Mitsuba would end the process. Raises ValueError for one that is unknown.
    """
    given = {name: value for name, value in options.items() if value is not None}
    if type in TRACERS:
        return make_tracer(type, given)
    if type == "custom":
        return OwnIntegrator(**given)
    properties = mi.Properties(type)
    for name, value in given.items():
        properties[name] = value
    # `mi.load_dict` would look for a library `plugins/prb.so`, and so run one that lies in the working folder: it does
    # not know of plugins that are written in Python.
    integrator = mi.PluginManager.instance().create_object(properties)
    if properties.unqueried():
        raise ValueError(f"{type} has no option {', '.join(properties.unqueried())}")
    return interface_of(integrator)


def interface_of(integrator: StepIntegrator | mi.Integrator) -> StepIntegrator:
    """What a gradient step works with, of a plugin or of what already is that."""
    if not isinstance(integrator, mi.Integrator):
        return integrator
    tracer: StepIntegrator | None = getattr(integrator, "tracer", None)  # of the plugins that are made here
    if tracer is not None:
        return tracer
    if isinstance(integrator, mi.AdjointIntegrator):
        return NaiveAD(integrator)
    return Projective(integrator) if hasattr(integrator, "proj_detail") else Replayed(integrator)


class Halves:
    """`work` with images (2, H, W, C), of two independent halves of a job's samples, of which the image is the mean.

    A dL/dI of that shape holds the derivatives with respect to each half's image. Raises ValueError for samples per
    pixel that are not even.
    """

    def __init__(self, work: StepIntegrator) -> None:
        self.work, self.image_apart = work, work.image_apart

    def image(self, job: Job) -> mi.TensorXf:
        """The images, without derivatives."""
        return _both(*(self.work.image(half) for half in half_jobs(job)))

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective with dL/dI `gradient`."""
        for half, own in zip(half_jobs(job), _apart(gradient), strict=True):
            self.work.backward(half, own)

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """The images, and the gradient of the same samples with the dL/dI that `derivative(images)` returns."""
        first, second = half_jobs(job)
        images: list[mi.TensorXf] = []

        def of_first(image: mi.TensorXf) -> mi.TensorXf:
            gradients: list[mi.TensorXf] = []

            def of_second(other: mi.TensorXf) -> mi.TensorXf:
                images.append(_both(image, other))
                gradients.extend(_apart(derivative(images[0])))
                return gradients[1]

            self.work.correlated(second, of_second)
            return gradients[0]

        self.work.correlated(first, of_first)  # the first half is traced, then the second; then both are differentiated
        return images[0]

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """The images, and the gradient of the same samples, where dL/dI is known before either."""
        parts = zip(half_jobs(job), _apart(gradient), strict=True)
        return _both(*(self.work.known(half, own) for half, own in parts))


def half_jobs(job: Job) -> tuple[Job, Job]:
    """The two halves of a job. Raises ValueError where its samples per pixel are not even."""
    if job.spp < 2 or job.spp % 2:
        raise ValueError(f"the samples per pixel of a set ({job.spp}) must be even, where they are halved")
    first, second = (replace(job, seed=seed, spp=job.spp // 2) for seed in half_seeds(job.seed))
    return first, second


def half_seeds(seed: mi.UInt32 | int) -> list[mi.UInt32]:
    """The seeds of the two halves of a set of samples."""
    seeds = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(HALF_STREAM + half))[0] for half in (0, 1)]
    dr.make_opaque(seeds)
    return seeds


def _both(first: mi.TensorXf, second: mi.TensorXf) -> mi.TensorXf:
    """Two images (H, W, C) as one tensor (2, H, W, C), detached."""
    flat = dr.concat((dr.detach(first.array), dr.detach(second.array)))
    return type(first)(flat, (2, *first.shape))


def _apart(gradient: mi.TensorXf) -> tuple[mi.TensorXf, mi.TensorXf]:
    parts = halves_of(gradient)
    dr.eval(parts)
    return parts


def render_image(integrator: StepIntegrator, scene: mi.Scene, sensor: mi.Sensor | int, seed: int, spp: int,
                 halves: bool = False) -> mi.TensorXf:  # fmt: skip
    """The image (H, W, C) without derivatives, or the images (2, H, W, C) of two halves of the samples."""
    work = Halves(integrator) if halves else integrator
    return work.image(Job(scene, resolve_sensor(scene, sensor), dr.opaque(mi.UInt32, seed), spp))


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
    on_image: Callable[[], None] | None = None,
    batches: int = 4,
    on_samples: OnSamples | None = None,
    halves: bool = False,
) -> StepResult:
    """Render, evaluate `objective(image)`, and add its gradient to every parameter of the scene that tracks one.

    `objective` maps the image, a tensor (H, W, C) that tracks derivatives, to a scalar; `sensor` is one of the scene's
    or its index; `params` are the scene's parameters where the caller has them at hand (`mi.traverse` otherwise).
    `on_image` is called once the image and the loss are evaluated, where a step has such a moment. `batches` belong to
    `adjoint="batched"`, whose loss is that of all samples' image. `on_samples` is called with the image of each set of
    samples that is differentiated, and with the dL/dI that it is differentiated with: what the image alone is
    multiplied by has its derivative from the same samples. With `halves`, what `objective` and
    `on_samples` are given are the images (2, H, W, C) of two halves of the samples (`protocol.whole_of`), whose number
    has to be even in every set.

    `spp` of 0 are the sensor's own number. Raises ValueError for numbers out of their range and for words that are
    none of the above, and BackendError under a variant of Mitsuba that reslrb does not work with.
    """
    check_variant(mi.variant())
    one_of("adjoint", adjoint, get_args(Adjoint))
    _check_number("spp", spp, 0, PASSES * PASS_SAMPLES)
    _check_number("batches", batches, 2 if adjoint == "batched" else 1, PASSES)
    if isinstance(seed, Integral):
        _check_number("seed", seed, 0, 2**32 - 1)
    work, job = interface_of(integrator), _job(scene, sensor, seed, spp, params)
    if halves:
        work = Halves(work)
    if adjoint == "batched":
        return _batched(work, job, objective, batches, on_samples)
    losses: list[mi.Float | mi.TensorXf] = []
    gradients: list[mi.TensorXf] = []
    refused = Refused()

    def derivative(image: mi.TensorXf) -> mi.TensorXf:
        together = adjoint == "correlated" and not work.image_apart
        loss, gradient = derivative_of(objective, image, refused, None if together else on_image)
        losses.append(loss)
        gradients.append(gradient)
        return gradient

    if adjoint == "correlated":
        image = work.correlated(job, derivative)
        if on_samples is not None:
            on_samples(image, gradients[0])
    else:
        image = work.image(job)
        _differentiate(work, replace(job, seed=second_seed(job.seed)), derivative(image), on_samples)
    return StepResult(whole_of(image), losses[0], refused, image)


def known_step(
    integrator: StepIntegrator | mi.Integrator, scene: mi.Scene, sensor: mi.Sensor | int, gradient: mi.TensorXf, *,
    seed: int, spp: int, params: mi.SceneParameters | None = None,
) -> StepResult:  # fmt: skip
    """A step whose dL/dI, `gradient` (H, W, C), is known before its image: the loss is the sum of dL/dI times I.

    One set of samples for both; an estimator of `reslrb` that can splats and differentiates in one traversal. The rest
    is as in `gradient_step`.
    """
    refused = Refused()
    gradient = refused.take(dr.detach(gradient))
    image = interface_of(integrator).known(_job(scene, sensor, seed, spp, params), gradient)
    return StepResult(image, dr.sum((image * gradient).array), refused)


def given_step(
    integrator: StepIntegrator | mi.Integrator, scene: mi.Scene, sensor: mi.Sensor | int, gradient: mi.TensorXf, *,
    seed: int, spp: int, params: mi.SceneParameters | None = None, on_samples: OnSamples | None = None,
    halves: bool = False,
) -> None:  # fmt: skip
    """Add the gradient by the samples of `seed`, with dL/dI `gradient`, (H, W, C) or of halves (2, H, W, C), which is
    from other samples, and finite. The rest is as in `gradient_step`."""
    work = interface_of(integrator)
    _differentiate(Halves(work) if halves else work, _job(scene, sensor, seed, spp, params), gradient, on_samples)


def _check_number(name: str, value: object, least: int, most: int) -> None:
    """Raise ValueError for an argument that is no whole number from `least` to `most`."""
    if not isinstance(value, Integral) or not least <= int(value) <= most:
        raise ValueError(f'"{name}" must be a whole number from {least} to {most}, not {value!r}')


def _differentiate(work: StepIntegrator, job: Job, gradient: mi.TensorXf, on_samples: OnSamples | None) -> None:
    """Add the gradient of samples with a known dL/dI; their image is made only where somebody wants it."""
    if on_samples is None:
        work.backward(job, gradient)
    else:
        on_samples(work.known(job, gradient), gradient)


def _job(scene: mi.Scene, sensor: mi.Sensor | int, seed: int, spp: int, params: mi.SceneParameters | None) -> Job:
    image_seed = mi.UInt32(seed)
    dr.make_opaque(image_seed)
    return Job(
        scene, resolve_sensor(scene, sensor), image_seed, spp, params if params is not None else mi.traverse(scene)
    )


def _batched(
    integrator: StepIntegrator, job: Job, objective: Objective, batches: int, on_samples: OnSamples | None
) -> StepResult:
    """A step in batches (design of Deng et al. 2022's dual buffer): batch b takes delta from the image of those before.

    No path sees a delta that it helped to make, so that the gradient of an L2 loss is unbiased, as with `independent`,
    from half the paths. The first batch gives an image alone.
    """
    if job.spp < 1 or job.spp % batches:
        raise ValueError(f"the samples per pixel ({job.spp}) must be a multiple of the batches ({batches})")
    parts = [replace(job, seed=seed, spp=job.spp // batches) for seed in batch_seeds(job.seed, batches)]
    share = 1 / (batches - 1)
    image, refused = integrator.image(parts[0]), Refused()
    for b in range(1, batches):
        _, gradient = derivative_of(objective, image, refused)
        own = integrator.known(parts[b], gradient * share)
        if on_samples is not None:
            on_samples(own, gradient * share)
        image = image + (own - image) / (b + 1)
        dr.eval(image)
    return StepResult(whole_of(image), dr.detach(objective(image)), refused, image)


def derivative_of(
    objective: Objective, image: mi.TensorXf, refused: Refused, on_image: Callable[[], None] | None = None
) -> tuple[mi.Float | mi.TensorXf, mi.TensorXf]:
    """Loss and dL/dI, evaluated in one go; what of the latter is not finite is refused."""
    with dr.resume_grad(), dr.isolate_grad():
        leaf = type(image)(image)
        dr.enable_grad(leaf)
        loss = objective(leaf)
        dr.backward_from(loss)
        gradient = dr.grad(leaf)
    loss, gradient = dr.detach(loss), refused.take(dr.detach(gradient))
    dr.eval(loss, gradient, refused)
    if on_image is not None:
        on_image()
    return loss, gradient


def sample_sets(seed: int, options: dict[str, Any]) -> list[tuple[str, mi.UInt32, int]]:
    """The sets of samples of a step with these options (`Config.step_options`): name, seed, samples per pixel."""
    spp, adjoint = options["spp"], options["adjoint"]
    if options.get("halves"):
        return [
            (f"{name}, half {half + 1}", own, each // 2)
            for name, whole, each in sample_sets(seed, options | {"halves": False})
            for half, own in enumerate(half_seeds(whole))
        ]
    if adjoint == "batched":
        seeds = batch_seeds(seed, options["batches"])
        return [(f"batch {b + 1}", batch, spp // len(seeds)) for b, batch in enumerate(seeds)]
    first = dr.opaque(mi.UInt32, seed)
    if adjoint == "correlated":
        return [("image and gradient", first, spp)]
    return [("image", first, spp), ("gradient", second_seed(first), spp)]


def batch_seeds(seed: mi.UInt32 | int, batches: int) -> list[mi.UInt32]:
    """The seed of each batch."""
    seeds = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(BATCH_STREAM + b))[0] for b in range(batches)]
    dr.make_opaque(seeds)
    return seeds


def second_seed(seed: mi.UInt32) -> mi.UInt32:
    """The seed of the gradient's own samples."""
    result = mi.sample_tea_32(seed, mi.UInt32(1))[0]
    dr.make_opaque(result)
    return result
