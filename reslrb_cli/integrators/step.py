"""A step: image, loss, and the gradient of every parameter, by any integrator, with delta from a choice of samples.

correlated     one set of samples for image and gradient; what naive AD of one render does
independent    the gradient's samples have a seed of their own; what `mi.render` does
batched        the samples in batches, each with delta from the image of those before it (`_batched`)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from reslrb_cli.integrators.adapter import register, resolve_sensor
from reslrb_cli.integrators.refusal import Refused

Adjoint = Literal["correlated", "independent", "batched"]
FirstBatch = Literal["image", "again"]
Objective = Callable[[Any], Any]


BATCH_STREAM = 0xBA7C4E5  # keeps the batches' seeds apart from those of passes and of the second samples


@dataclass
class StepResult:
    """What a step yields besides gradients: the image (H, W, C) and the loss (width 1), both detached.

    Entries of dL/dI that are not finite count as 0; `refused` says how many there were, and where the first.
    """

    image: Any
    loss: Any
    refused: Refused = field(default_factory=Refused)


def make_integrator(type: str, **options: Any) -> Any:
    """An integrator by its plugin's name and options: `reslrb`, `walk_ad`, or a stock one such as `ptracer`, `prb`.

    An option that is None is left out: Mitsuba's parser would end the process.
    """
    register()
    return mi.load_dict({"type": type} | {name: value for name, value in options.items() if value is not None})


def render_image(integrator: Any, scene: Any, sensor: Any, seed: int, spp: int) -> Any:
    """The image (H, W, C) without derivatives."""
    with dr.suspend_grad():
        return integrator.render(scene, resolve_sensor(scene, sensor), dr.opaque(mi.UInt32, seed), spp)


def gradient_step(
    integrator: Any,
    scene: Any,
    sensor: Any,
    objective: Objective,
    *,
    seed: int,
    spp: int,
    adjoint: Adjoint = "correlated",
    params: Any = None,
    on_image: Callable[[], None] | None = None,
    batches: int = 4,
    first_batch: FirstBatch = "image",
) -> StepResult:
    """Render, evaluate `objective(image)`, and add its gradient to every parameter of the scene that tracks one.

    `objective` maps the image, a tensor (H, W, C) that tracks derivatives, to a scalar; `sensor` is one of the scene's
    or its index; `params` are the scene's parameters where the caller has them at hand (`mi.traverse` otherwise).
    `on_image` is called once the image and the loss are evaluated, where a step has such a moment. `batches` and
    `first_batch` belong to `adjoint="batched"`, whose loss is that of all samples' image.
    """
    sensor = resolve_sensor(scene, sensor)
    params = params if params is not None else mi.traverse(scene)
    if adjoint == "batched":
        return _batched(integrator, scene, sensor, objective, seed, spp, params, batches, first_batch)
    image_seed, refused = mi.UInt32(seed), Refused()
    dr.make_opaque(image_seed)
    if hasattr(integrator, "trace") and adjoint == "correlated":  # reslrb
        trace = integrator.trace(scene, sensor, image_seed, spp, params)
        loss, gradient = _derivative(objective, trace.image, refused, on_image)
        integrator.replay(trace, gradient, params)
        return StepResult(trace.image, loss, refused)
    replays = not isinstance(integrator, mi.AdjointIntegrator) and not hasattr(integrator, "tracked_image")
    if replays or adjoint == "independent":
        gradient_seed = image_seed if adjoint == "correlated" else second_seed(image_seed)
        with dr.suspend_grad():
            image = integrator.render(scene, sensor, image_seed, spp)
        loss, gradient = _derivative(objective, image, refused, on_image)
        # Isolated, so that another view's propagation finds the edges above the scene's parameters intact.
        with _naive_ad(integrator), dr.isolate_grad():
            integrator.render_backward(scene, params, gradient, sensor, gradient_seed, spp)
        return StepResult(image, loss, refused)
    with _naive_ad(integrator), dr.isolate_grad():  # as above
        if hasattr(integrator, "tracked_image"):
            image = integrator.tracked_image(scene, sensor, image_seed, spp, params)
        else:
            image = integrator.render(scene, sensor, image_seed, spp, develop=True, evaluate=False)
        loss, gradient = _derivative(objective, dr.detach(image), refused)
        dr.backward_from(image * gradient)
    return StepResult(dr.detach(image), loss, refused)


def known_step(
    integrator: Any, scene: Any, sensor: Any, gradient: Any, *, seed: int, spp: int, params: Any = None
) -> StepResult:
    """A step whose dL/dI, `gradient` (H, W, C), is known before its image: the loss is the sum of dL/dI times I.

    One set of samples for both; an estimator of `reslrb` that can splats and differentiates in one traversal. The rest
    is as in `gradient_step`.
    """
    refused = Refused()
    step = _known(integrator, scene, sensor, refused.take(dr.detach(gradient)), seed, spp, params)
    return StepResult(step.image, step.loss, refused)


def _known(integrator: Any, scene: Any, sensor: Any, gradient: Any, seed: Any, spp: int, params: Any) -> StepResult:
    """The same with a dL/dI that is finite."""

    def objective(image: Any) -> Any:
        return dr.sum((image * gradient).array)

    if not hasattr(integrator, "fused"):
        return gradient_step(integrator, scene, sensor, objective, seed=seed, spp=spp, params=params)
    params = params if params is not None else mi.traverse(scene)
    image_seed = mi.UInt32(seed)
    dr.make_opaque(image_seed)
    image = integrator.fused(scene, resolve_sensor(scene, sensor), image_seed, spp, gradient, params)
    return StepResult(image, objective(image))


def _batched(integrator: Any, scene: Any, sensor: Any, objective: Objective, seed: Any, spp: int, params: Any,
             batches: int, first_batch: FirstBatch) -> StepResult:  # fmt: skip
    """A step in batches (design of Deng et al. 2022's dual buffer): batch b takes delta from the image of those before.

    No path sees a delta that it helped to make, so that the gradient of an L2 loss is unbiased, as with `independent`,
    from half the paths. The first batch gives an image alone, or is traced `again` with the delta of all others.
    """
    if batches < 2 or spp % batches:
        raise ValueError(f"the samples per pixel ({spp}) must be a multiple of the batches ({batches}), at least 2")
    size = spp // batches
    seeds = batch_seeds(seed, batches)
    share = 1 / (batches if first_batch == "again" else batches - 1)
    with dr.suspend_grad():
        first = integrator.render(scene, sensor, seeds[0], size)
    image, refused = first, Refused()
    for b in range(1, batches):
        _, gradient = _derivative(objective, image, refused)
        step = _known(integrator, scene, sensor, gradient * share, seeds[b], size, params)
        image = image + (step.image - image) / (b + 1)
        dr.eval(image)
    if first_batch == "again":
        others = (image * batches - first) / (batches - 1)
        _, gradient = _derivative(objective, others, refused)
        with _naive_ad(integrator), dr.isolate_grad():
            integrator.render_backward(scene, params, gradient * share, sensor, seeds[0], size)
    return StepResult(image, dr.detach(objective(image)), refused)


def _derivative(
    objective: Objective, image: Any, refused: Refused, on_image: Callable[[], None] | None = None
) -> tuple[Any, Any]:
    """Loss and dL/dI, evaluated in one go; what of the latter is not finite is refused."""
    with dr.resume_grad(), dr.isolate_grad():
        attached = type(image)(image)
        dr.enable_grad(attached)
        loss = objective(attached)
        dr.backward_from(loss)
        gradient = dr.grad(attached)
    loss, gradient = dr.detach(loss), refused.take(dr.detach(gradient))
    dr.eval(loss, gradient, refused)
    if on_image is not None:
        on_image()
    return loss, gradient


def sample_sets(seed: int, options: dict[str, Any]) -> list[tuple[str, Any, int]]:
    """The sets of samples of a step with these options (`Config.step_options`): name, seed, samples per pixel."""
    spp, adjoint = options["spp"], options["adjoint"]
    if adjoint == "batched":
        seeds = batch_seeds(seed, options["batches"])
        return [(f"batch {b + 1}", batch, spp // len(seeds)) for b, batch in enumerate(seeds)]
    first = dr.opaque(mi.UInt32, seed)
    if adjoint == "correlated":
        return [("image and gradient", first, spp)]
    return [("image", first, spp), ("gradient", second_seed(first), spp)]


def batch_seeds(seed: int, batches: int) -> list[Any]:
    """The seed of each batch."""
    seeds = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(BATCH_STREAM + b))[0] for b in range(batches)]
    dr.make_opaque(seeds)
    return seeds


def second_seed(seed: Any) -> Any:
    """The seed of the gradient's own samples."""
    result = mi.sample_tea_32(seed, mi.UInt32(1))[0]
    dr.make_opaque(result)
    return result


@contextmanager
def _naive_ad(integrator: Any) -> Iterator[None]:
    """Stock light tracing is differentiable in evaluated loops alone."""
    if isinstance(integrator, mi.AdjointIntegrator):
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            yield
    else:
        yield
