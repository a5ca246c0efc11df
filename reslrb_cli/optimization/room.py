"""Whether there is room for what a configuration asks for: said before anything is allocated, with the reason.

Held against what is free are lower bounds, so that nothing is refused that the machine can hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mitsuba as mi

from reslrb_cli.backend.memory import free_bytes, local_bytes
from reslrb_cli.config import Config
from reslrb_cli.config.files import in_words
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators import Reslrb as Tracer
from reslrb_cli.optimization.budget import estimate
from reslrb_cli.records.clock import rough_duration

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

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
