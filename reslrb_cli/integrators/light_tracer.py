"""The samples of one light-traced image, and what is done with them: image pass, replay, forward mode, naive AD."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators import Estimator
from reslrb_cli.estimators.base import Pass
from reslrb_cli.integrators.hooks import AttachedSplat, RecordedObjective, Splat, TangentSplat
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.splat import AdjointImage, Film
from reslrb_cli.transport.transmittance import forward_derivatives
from reslrb_cli.transport.visible import (
    PrimaryRay,
    differentiate_visible_radiance,
    primary_ray,
    visible_radiance,
    visible_tangent,
)
from reslrb_cli.transport.walk import Hooks, walk

SELECTION_STREAM = 0x5E1EC7  # keeps the hooks' numbers apart from the sampler's
VISIBLE_STREAM = 0xD1EC7
PASS_STREAM = 0x9A55E5
#: Samples per pixel of one pass. In single precision a sum loses terms below a 2^24th of it, and thousands of such
#: passes can be added to one another.
LARGEST_PASS = 1 << 18


@dataclass
class Samples:
    """The samples of one pass: which random numbers, how many light paths. `seed` is an opaque UInt32."""

    scene: Any
    sensor: Any
    plan: Plan
    film: Film
    seed: Any
    spp: int
    width: int
    scale: Any  # brings a sum over light paths to an image
    fraction: Any  # of all samples of that image, these are so many

    def sampler(self) -> Any:
        """A sampler at the beginning of these samples' stream."""
        sampler = self.sensor.sampler().clone()
        sampler.set_sample_count(self.spp)
        sampler.set_samples_per_wavefront(self.spp)
        sampler.seed(self.seed, self.width)
        return sampler

    def stream(self, name: int) -> Any:
        """Random numbers beside the sampler's own.

        Hashed for each lane, as Mitsuba's samplers do: generators that differ in their sequence's number alone begin
        with numbers that are evenly spread over the lanes, and off their mean alike for all seeds.
        """
        seed = mi.sample_tea_32(self.seed, mi.UInt32(name))[0]
        state, sequence = mi.sample_tea_32(seed, dr.arange(mi.UInt32, self.width))
        return mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence))

    def context(self, block: Any, adjoint: AdjointImage | None) -> Pass:
        """These samples as an estimator sees them."""

        def walk(hooks: Hooks, active: Any = True) -> Any:
            return trace(self, hooks, active)

        def emission() -> Any:
            return sample_emission(self.plan, self.scene, self.sensor, self.sampler()).weight

        return Pass(self.plan, self.scene, self.sensor, self.film, self.scale, block, adjoint, walk, emission)

    def primary_ray(self) -> PrimaryRay:
        """Rays for C_0, from a stream of their own: the light paths are those of `ptracer` with or without them."""
        return primary_ray(self.plan, self.sensor, _NumberStream(self.stream(VISIBLE_STREAM)), self.width)


class _NumberStream:
    """The two methods of a Mitsuba sampler that emission asks for, over a bare generator."""

    def __init__(self, generator: Any) -> None:
        self.generator = generator

    def next_1d(self) -> Any:
        return self.generator.next_float32()

    def next_2d(self) -> Any:
        return mi.Point2f(self.generator.next_float32(), self.generator.next_float32())


def settle(scene: Any) -> None:
    """Have textures and emitters set up now what they set up when they are first used (padded storage, distributions).

    In the midst of tracing this would cut the first step's kernels in two, and the second would compile them anew.
    """
    with dr.suspend_grad():
        for texture in SceneGraph.of(scene).of_type(mi.Texture):
            if texture.class_name().startswith("BitmapTexture"):
                texture.eval(dr.zeros(mi.SurfaceInteraction3f))
        _, weight, _ = scene.sample_emitter_ray(0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5), True)
        dr.eval(weight)


def make_samples(plan: Plan, scene: Any, sensor: Any, seed: Any, spp: int, total_spp: int) -> Samples:
    """`spp` of `total_spp` samples per pixel; the film's full size counts, not the crop's, as for `ptracer`.

    Raises ValueError where one pass would hold more than 2^32 - 1 paths.
    """
    film = Film(sensor)
    width = spp * int(dr.prod(sensor.film().size()))
    if width > 0xFFFFFFFF:
        raise ValueError(f"{width} paths in one pass are more than 2^32 - 1: set samples_per_pass below {spp}")
    # Opaque: as literals they would give every sample count kernels of its own.
    scale = dr.opaque(mi.Float, float(dr.prod(film.size)) / (float(dr.prod(sensor.film().size())) * total_spp))
    return Samples(scene, sensor, plan, film, mi.UInt32(seed), spp, width, scale, dr.opaque(mi.Float, spp / total_spp))


def passes(plan: Plan, scene: Any, sensor: Any, seed: Any, spp: int, spp_per_pass: int | None) -> list[Samples]:
    """All samples of an image, in passes of `spp_per_pass` samples per pixel, which must divide `spp`, or less.

    The first pass has the seed itself, so that it traces what `ptracer` does.
    """
    unit = spp if spp_per_pass is None else min(spp_per_pass, spp)
    if spp % unit:
        raise ValueError(f"the sample count ({spp}) must be a multiple of samples_per_pass ({unit})")
    sizes = _parts(unit) * (spp // unit)
    # Opaque: a seed that reached the kernel as a literal would compile a new one each step.
    others = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(PASS_STREAM + p))[0] for p in range(1, len(sizes))]
    seeds = [mi.UInt32(seed), *others]
    dr.make_opaque(seeds)
    made = {size: make_samples(plan, scene, sensor, seeds[0], size, spp) for size in set(sizes)}
    return [replace(made[size], seed=s) for size, s in zip(sizes, seeds, strict=True)]


def _parts(spp: int) -> list[int]:
    """The fewest parts of at most LARGEST_PASS samples, of sizes that differ by 1 at most."""
    count = -(-spp // LARGEST_PASS)
    return [spp // count + (part < spp % count) for part in range(count)]


def in_passes(samples: list[Samples], work: Callable[[Samples, Any], None], block: Any, params: Any = None) -> None:
    """Call `work(part, block)` for each pass. It splats into the block (None: nothing), and differentiates `params`
    (None: nothing).

    Of several passes each has a block and gradients of its own, which are added up here: single precision would lose
    the terms of the last pass in the sum of all others.
    """
    if len(samples) == 1:
        work(samples[0], block)
        return
    sums = None if params is None else GradientSum(params)
    for part in samples:
        own = None if block is None else part.film.block()
        work(part, own)
        if own is not None:
            block.put_block(own)
        finish_pass([] if block is None else block.tensor())
        if sums is not None:
            sums.take()
    if sums is not None:
        sums.put()


class GradientSum:
    """Sums the parameters' gradients over passes, apart from where each pass adds its own."""

    def __init__(self, params: Any) -> None:
        with dr.resume_grad():  # where gradients are suspended, nothing says that it tracks them
            self.values = [value for _, value in params.items() if dr.grad_enabled(value)]
        self.totals: list[Any] = []

    def take(self) -> None:
        """Take what has been added to the gradients since the last time."""
        with dr.resume_grad():
            found = [dr.detach(dr.grad(value)) for value in self.values]
            self.totals = [a + b for a, b in zip(self.totals, found, strict=True)] if self.totals else found
            for value in self.values:
                dr.clear_grad(value)
        finish_pass(self.totals)

    def put(self) -> None:
        """Give the sums to the parameters."""
        with dr.resume_grad():
            for value, total in zip(self.values, self.totals, strict=True):
                dr.accum_grad(value, total)


def finish_pass(*results: Any) -> None:
    """Evaluate what a pass yields, and wait for it: memory of passes that are still queued would pile up."""
    dr.eval(*results)
    dr.sync_thread()


def trace(samples: Samples, hooks: Hooks, active: Any = True) -> Any:
    """Run the walk over these samples; the hooks' final state."""
    selection = samples.stream(SELECTION_STREAM) if hooks.numbers else None
    return walk(samples.plan, samples.scene, samples.sensor, samples.sampler(), hooks, active, selection)


def splat_visible_emission(samples: Samples, block: Any, loop_mode: str = "symbolic") -> None:
    """Add C_0 to the block."""
    if samples.plan.visible_emission:
        primary = samples.primary_ray()
        radiance = visible_radiance(samples.plan, samples.scene, primary, loop_mode)
        samples.film.put(block, primary.u, radiance * primary.weight * samples.fraction, primary.active)


def splat_image(samples: Samples, block: Any) -> None:
    """Add the samples' contributions to the block; keep nothing."""
    splat_visible_emission(samples, block)
    trace(samples, Splat(samples, block))


def image_of(samples: list[Samples], estimator: Estimator | None) -> Any:
    """The image of all passes, as the estimator makes it where it makes one of its own (else None); nothing is kept."""
    film = samples[0].film
    block = film.block()

    def splat(part: Samples, own: Any) -> None:
        if estimator is None:
            splat_image(part, own)
        else:
            forward(part, estimator, own)

    in_passes(samples, splat, block)
    return film.develop(block)


def forward(samples: Samples, estimator: Estimator, block: Any, adjoint: AdjointImage | None = None) -> Any:
    """Trace the samples: add their contributions to the block (None: no image). What is kept of each path is returned,
    and not evaluated."""
    if block is not None:
        splat_visible_emission(samples, block)
    return estimator.forward(samples.context(block, adjoint))


@dataclass
class Trace:
    """Samples that have been traced: their image, and what is kept of their paths if they fit in one pass.

    Several passes keep nothing, which would grow with the number of passes: each is traced again before its replay.
    """

    samples: list[Samples]
    image: Any = None
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
    estimator.backward(samples.context(None, adjoint), state)


def replay_all(trace: Trace, estimator: Estimator, gradient: Any, params: Any = None) -> None:
    """Add the gradient of the objective with dL/dI `gradient` (H, W, C) to `params`, which one pass need not know."""
    adjoint = trace.film.adjoint(gradient)
    if trace.state is None:
        differentiate_passes(trace.samples, estimator, None, adjoint, params)
        return
    # Isolated: on their way to the parameters gradients are evaluated, and with them all that they hang on, which is to
    # be one kernel. They set out once, at the end.
    with dr.isolate_grad():
        replay(trace.samples[0], estimator, trace.state, adjoint)


def fused(samples: list[Samples], estimator: Estimator, gradient: Any, params: Any = None) -> Any:
    """The image, and the same gradient, where dL/dI is known before either."""
    film = samples[0].film
    block = film.block()
    differentiate_passes(samples, estimator, block, film.adjoint(gradient), params)
    return film.develop(block)


def differentiate_passes(
    samples: list[Samples], estimator: Estimator, block: Any, adjoint: AdjointImage, params: Any
) -> None:
    """Trace samples whose dL/dI is known and add their derivatives, and to the block (None: none) their contributions.

    What is kept of a path goes from one to the other within the kernel, and takes no memory.
    """

    def differentiate(part: Samples, own: Any) -> None:
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
        S = trace(samples, RecordedObjective(samples, adjoint))
        dr.backward_from(S, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)


def differentiate_visible_emission(samples: Samples, adjoint: AdjointImage) -> None:
    """Add the derivatives of C_0."""
    plan = samples.plan
    if plan.visible_emission and (plan.differentiate_emission or plan.differentiate_null):
        primary = samples.primary_ray()
        delta = adjoint.lookup(primary.u, primary.active) * primary.weight * samples.fraction
        differentiate_visible_radiance(plan, samples.scene, primary, delta)


def splat_tangents(samples: Samples, block: Any) -> None:
    """Add the forward-mode derivative of the samples' contributions to the block, exactly and in one traversal."""
    plan, dE = samples.plan, mi.Spectrum(0)
    with dr.resume_grad():
        if plan.differentiate_emission:
            E = sample_emission(plan, samples.scene, samples.sensor, samples.sampler()).weight
            [dE] = forward_derivatives(E)
        if plan.visible_emission and (plan.differentiate_emission or plan.differentiate_null):
            primary = samples.primary_ray()
            tangent = visible_tangent(plan, samples.scene, primary)
            samples.film.put(block, primary.u, tangent * primary.weight * samples.fraction, primary.active)
    trace(samples, TangentSplat(samples, block, dE))


def splat_attached(samples: Samples, block: Any) -> None:
    """Add the contributions with derivatives attached to the block: naive AD, its memory proportional to depth."""
    with dr.resume_grad():
        splat_visible_emission(samples, block, "evaluated")
        trace(samples, AttachedSplat(samples, block))
