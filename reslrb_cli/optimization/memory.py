"""The memory of a run: whether there is room, said before anything is allocated, and passes within a budget.

- How much memory a step takes, and the passes that keep it within a budget: `estimate`, `choose_samples`.
- Whether there is room for what a configuration and a scene's file say of their sizes, before anything is built:
  `check_announced`, `check_described`. Films and textures of a hundred million entries take a minute to make; that
  there is no room for them is known before.
- Whether there is room for what a configuration asks for, with the reason where there is none: the other checks.

Held against what is free are lower bounds, so that nothing is refused that the machine can hold.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from reslrb_cli.backend.doctor import resident_paths
from reslrb_cli.backend.memory import free_bytes, local_bytes
from reslrb_cli.config.files import in_words, rough_duration
from reslrb_cli.config.integrators import Reslrb as ReslrbConfig
from reslrb_cli.config.integrators import divisors, passes_obstacle
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators.base import entry_bytes
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.optimization.decisions import Estimate
from reslrb_cli.records.clock import MIB, peak_mib, reset_peak
from reslrb_cli.scene.xml.check import FilmSize, film_sizes
from reslrb_cli.scene.xml.read import Description

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem


#: Images of the film's size that a step has at once: block, image, loss's parts, gradient, adjoint; a batch's too.
FILM_IMAGES = 12

#: Copies of a parameter: gradients, the optimiser's moments, their next values, the best of a run.
PARAMETER_COPIES = 9

#: And those of a clamp: what is usual, the sums over the iterations, and their next values.
CLAMP_COPIES = 7


def standing() -> int:
    """Bytes that are allocated now."""
    reset_peak()
    return int(peak_mib(dr.backend_v(mi.Float)) * MIB)


def estimate(problem: Problem, integrator: Reslrb, samples: int, fixed: int) -> Estimate:
    """What a step takes whose passes have `samples` samples per pixel; `fixed` stands before it.

    The targets, which may not be there yet, are not part of `fixed`, but of the result's.
    """
    paths = images = targets = scratch = 0
    for index in problem.sensors:
        sensor = problem.scene.sensors()[index]
        plan = integrator.plan(problem.scene, sensor, problem.selection.params)
        width = samples * int(dr.prod(sensor.film().size()))
        if problem.config.adjoint == "correlated" and samples == problem.config.run.spp:
            # Else dL/dI is known before the paths are traced, and nothing of them outlives the kernel.
            paths = max(paths, sum(allocated(size * width) for size in entry_bytes(integrator.estimator.kept(plan))))
        block = int(dr.prod(sensor.film().crop_size())) * (sensor.film().base_channels_count() + 1)
        images = max(images, FILM_IMAGES * allocated(4 * block), 2 * allocated(4 * block) + _replicas(block))
        targets += allocated(4 * block)
        scratch = max(scratch, integrator.estimator.scratch_bytes(plan))
    copies = PARAMETER_COPIES + (0 if problem.config.optimizer.clamp_gradient is None else CLAMP_COPIES)
    for key in problem.selection.keys:
        size = int(dr.prod(dr.shape(problem.selection.value(key))))
        images += copies * allocated(4 * size) + _replicas(size)
    guiding = integrator.preparation.guiding
    tables = 0 if guiding is None else guiding.bytes(len(problem.sensors))
    return Estimate(fixed + targets + tables, images, scratch * resident_paths(), paths)


def choose_samples(problem: Problem, integrator: Reslrb, samples: int, budget: int, fixed: int) -> tuple[int, Estimate]:
    """The largest divisor of `samples` that fits into the budget, and what it takes; 0 and the least where none does.

    `samples` are those of a batch, or of a step.
    """
    pixels = max(int(dr.prod(problem.scene.sensors()[index].film().size())) for index in problem.sensors)
    for size in reversed([size for size in divisors(samples) if passes_obstacle(samples, size, pixels) is None]):
        expected = estimate(problem, integrator, size, fixed)
        if expected.total <= budget:
            return size, expected
    return 0, expected


def allocated(size: int) -> int:
    """Bytes that the allocator takes for an array: a power of two."""
    return max(1 << (size - 1).bit_length(), 64) if size else 0


def _replicas(entries: int) -> int:
    """What scattering into an array takes: on a CPU each thread has a copy of a small one."""
    threads = dr.thread_count() + 1
    if dr.backend_v(mi.Float) != dr.JitBackend.LLVM or entries * threads > dr.expand_threshold():
        return 0
    return allocated(4 * entries * threads)


logger = logging.getLogger(__name__)

#: Bytes that an entry of a parameter takes at the least: value, the optimiser's, gradient, and the array it is set by.
ENTRY_BYTES = 4 * 4

#: Bytes of a step of which a word is said at once, since to make them takes a while.
MUCH = 2**31


def check_announced(config: Config) -> None:
    """Raise ConfigError where film or parameters, as the configuration has them, need more memory than is free."""
    if config.scene.size is not None:
        check_film(config, "scene.size", config.scene.size)
    for place, spec in enumerate(config.parameters):
        resolution = _resolution(spec)
        if resolution is None:
            continue
        needed = resolution[0] * resolution[1] * ENTRY_BYTES
        free = free_for(needed)
        if needed > free:
            texels = f"{resolution[0]}x{resolution[1]} texels"
            raise ConfigError(config.source, _key(place, spec), too_large(texels, needed, free, resolution))


def check_described(config: Config, description: Description) -> None:
    """Raise ConfigError where the scene's film is too large for the samples of a step, or a step for what is free.

    Which of the scene's sensors are in use is not known yet, so that it is the least of their films that counts. Of
    steps that are large and fit, the log has a line.
    """
    film = min(film_sizes(description), key=lambda size: size.cropped, default=None)
    if film is None or not film.cropped:
        return  # a file that does not say has Mitsuba's own film, which is small
    key = "scene.file" if config.scene.size is None else "scene.size"
    check_film(
        config, key, (film.width, film.height) if film.cropped == film.width * film.height else (film.cropped, 1)
    )
    obstacle = config.samples_obstacle(film.width * film.height)
    if obstacle is not None:
        raise ConfigError(config.source, "run.spp", obstacle)
    pixels, texels = _film_bytes(config, film), _texture_bytes(config)
    needed = pixels + sum(texels.values())
    free = free_for(needed)
    if needed > free:
        largest = max(texels, key=lambda place: texels[place], default=None)
        if largest is not None and texels[largest] > pixels:
            key = _key(largest, config.parameters[largest])
        reason = (
            f"{_what(config, film)}, with which a step takes at least {in_words(needed)}, and {in_words(free)} are free"
        )
        raise ConfigError(config.source, key, f"{reason}; take a smaller film or coarser textures")
    if needed > MUCH:
        logger.info(
            f"{_what(config, film)}: a step takes at least {in_words(needed)}, of {in_words(free)} that are free; "
            "loading takes a while"
        )


def _resolution(spec: ParameterSpec) -> tuple[int, int] | None:
    return spec.resolution if spec.heightmap is None else spec.heightmap.resolution


def _key(place: int, spec: ParameterSpec) -> str:
    return f"parameters[{place}].{'resolution' if spec.heightmap is None else 'heightmap.resolution'}"


def _what(config: Config, film: FilmSize) -> str:
    sizes = [size for size in map(_resolution, config.parameters) if size is not None]
    textures = "".join(f" and {width}x{height} texels" for width, height in sizes[:2])
    return f"a film of {film.width}x{film.height} pixels{textures}{' and more' if len(sizes) > 2 else ''}"


def _is_estimated(config: Config) -> bool:
    """Whether what a step takes is known by the estimate that passes are chosen by, and no budget chooses them."""
    return isinstance(config.integrator, ReslrbConfig) and config.run.memory_budget is None


def _film_bytes(config: Config, film: FilmSize) -> int:
    """What the images of a step take at the least, with one target."""
    if not _is_estimated(config):
        return film.cropped * PIXEL_BYTES
    return int((FILM_IMAGES + 1) * allocated(4 * film.cropped * (film.channels + 1)) * SURE[config.adjoint])


def _texture_bytes(config: Config) -> dict[int, int]:
    """What parameters take at the least whose size the configuration names, by their places, each of one channel."""
    found = {}
    for place, spec in enumerate(config.parameters):
        resolution = _resolution(spec)
        if resolution is not None:
            texels = resolution[0] * resolution[1]
            estimated = int(PARAMETER_COPIES * allocated(4 * texels) * SURE[config.adjoint])
            found[place] = estimated if _is_estimated(config) else texels * ENTRY_BYTES
    return found


#: Bytes that every machine has.
SMALL = 2**28

#: Bytes that a pixel takes at the least: five images (block, image, dL/dI, its adjoint, target) of three floats.
PIXEL_BYTES = 5 * 3 * 4

#: What a step takes at the least of what is estimated, by `run.adjoint`: 0.93, 0.58 and 0.44 of it were seen.
SURE = {"batched": 0.8, "independent": 0.5, "correlated": 0.4}

#: Integrators whose loops are evaluated, and bytes of a path's state there at the least: ray, throughput, generator.
NAIVE, PATH_BYTES = ("ptracer", "walk_ad"), 48

#: Bytes of thread-local memory that `trajectory` records of a vertex, as `bench` measured it.
RECORD_BYTES = 60

#: Light paths of a run beyond which a word is said of them, and how many a second that word reckons with.
MANY_PATHS, RATE = 1e11, 1e7


def check_films(config: Config, scene: mi.Scene, sensors: Sequence[int]) -> None:
    """Raise ConfigError where a film is too large, or the samples of a step are too many for it."""
    for index in sensors:
        film = scene.sensors()[index].film()
        width, height = (int(n) for n in film.crop_size())
        check_film(config, "scene.file", (width, height))
        full = film.size()  # light paths are counted by the film without its crop window
        obstacle = config.samples_obstacle(int(full[0]) * int(full[1]))
        if obstacle is not None:
            raise ConfigError(config.source, "run.spp", obstacle)


def check_scratch(problem: Problem, integrator: Tracer) -> None:
    """Raise ConfigError where paths need more thread-local memory than a thread has on the CPU."""
    if mi.variant().startswith("cuda"):
        return  # the driver sees to that, and says so
    for index in problem.sensors:
        plan = integrator.plan(problem.scene, problem.scene.sensors()[index], problem.selection.params)
        needed, most = integrator.estimator.scratch_bytes(plan), local_bytes()
        if needed > most:
            size = problem.config.integrator.options().get("stack_size", 0)
            raise ConfigError(
                problem.config.source,
                "integrator.stack_size",
                f"{size} vertices take {in_words(needed)} of a thread's stack for each path, which has "
                f"{in_words(most)}; take at most {size * most // needed} (longer paths are traced a second time, "
                "and nothing of them is lost), or raise `ulimit -s`",
            )


def check_memory(problem: Problem, integrator: Tracer) -> None:
    """Raise ConfigError where a step takes more memory than is free, its thread-local memory included.

    With a `memory_budget` passes are chosen that keep it, and nothing is said here.
    """
    check_scratch(problem, integrator)
    config = problem.config
    if config.run.memory_budget is not None:
        return
    samples = _pass_samples(config)
    # What stands is taken already.
    expected = estimate(problem, integrator, samples, 0)
    free, needed = free_for(expected.total), expected.total * SURE[config.adjoint]
    if needed <= free:
        return
    parts = {"images and parameters": expected.images, "targets": expected.fixed, "what is kept of paths":
             expected.paths, "thread-local memory": expected.scratch}  # fmt: skip
    largest = max(parts, key=lambda name: parts[name])
    advice = "take a smaller film or coarser textures"
    if expected.paths > expected.total // 2:
        advice = "set run.memory_budget, or leave run.adjoint at auto, with which nothing is kept of paths"
    key = "run.spp" if expected.paths > expected.total // 2 else "scene.file"
    reason = f"a step takes about {in_words(expected.total)} ({largest} {in_words(parts[largest])}), and "
    raise ConfigError(config.source, key, f"{reason}{in_words(free)} are free; {advice}")


def check_baseline(problem: Problem) -> None:
    """Raise ConfigError where an integrator other than `reslrb` keeps more of its paths than there is room for."""
    config = problem.config
    if config.integrator.type == "trajectory" and not mi.variant().startswith("cuda"):
        most = local_bytes() // RECORD_BYTES
        if config.integrator.max_depth > most:
            raise ConfigError(
                config.source,
                "integrator.max_depth",
                f"the record of {config.integrator.max_depth} segments does not fit on a thread's stack; take at most "
                f"{most}, raise `ulimit -s`, or take reslrb, which needs no record",
            )
    if config.integrator.type not in NAIVE:
        return
    paths = 0
    for index in problem.sensors:
        size = problem.scene.sensors()[index].film().size()
        paths = max(paths, _pass_samples(config) * int(size[0]) * int(size[1]))
    free = free_for(paths * PATH_BYTES)
    if paths * PATH_BYTES > free:
        raise ConfigError(
            config.source,
            "run.spp",
            f"{config.integrator.type} keeps the state of all {paths} light paths of a pass, at least "
            f"{in_words(paths * PATH_BYTES)}, and {in_words(free)} are free; lower run.spp, set "
            "integrator.samples_per_pass, or take reslrb, which keeps none",
        )


def outlook(config: Config, scene: mi.Scene, sensors: Sequence[int]) -> str | None:
    """A line on a run whose light paths are so many that it takes hours or more; None of others.

    It is legal, and may be what is wanted.
    """
    run, pixels = config.run, 0
    for index in sensors:
        size = scene.sensors()[index].film().size()
        pixels += int(size[0]) * int(size[1])
    each = run.spp * pixels * (2 if config.adjoint == "independent" else 1)
    if each * run.iterations < MANY_PATHS:
        return None
    return (
        f"{each:.3g} light paths an iteration, {each * run.iterations:.3g} in all: the run takes "
        f"{rough_duration(each * run.iterations / RATE)} at {RATE / 1e6:.0f} million paths a second; "
        "--dry-run measures it"
    )


def _pass_samples(config: Config) -> int:
    """Samples per pixel of the largest pass of a step."""
    spp = config.run.spp // config.run.batches if config.adjoint == "batched" else config.run.spp
    per_pass = config.integrator.options().get("samples_per_pass")
    return spp if per_pass is None else min(spp, int(per_pass))


def free_for(needed: int) -> int:
    """Bytes that are free; of what is small nobody asks, since to ask a GPU's driver takes a while."""
    return needed if needed < SMALL else free_bytes(mi.variant())


def check_film(config: Config, key: str, size: tuple[int, int]) -> None:
    """Raise ConfigError at `key` where the images of a film of this (width, height) need more memory than is free."""
    needed = size[0] * size[1] * PIXEL_BYTES
    free = free_for(needed)
    if needed > free:
        raise ConfigError(config.source, key, too_large(f"a film of {size[0]}x{size[1]} pixels", needed, free, size))


def too_large(what: str, needed: int, free: int, size: tuple[int, int]) -> str:
    """The message on what needs more bytes than are free, and the largest (width, height) of its shape that fits."""
    shrink = (free / needed) ** 0.5
    fits = "x".join(str(max(int(n * shrink), 1)) for n in size)
    return f"{what} takes at least {in_words(needed)}, and {in_words(free)} are free; take at most {fits}"
