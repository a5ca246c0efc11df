"""Limits of a run's memory: films, textures and steps that need more memory than is free are refused.

Sizes in the configuration and the scene file are checked before anything is built (`check_described`). Films and
textures of a hundred million entries would take a minute to make. The estimates are lower bounds of the memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import drjit as dr
import mitsuba as mi

from reslrb_cli.backend.doctor import free_bytes, local_bytes
from reslrb_cli.config.files import in_words
from reslrb_cli.config.integrators import ReslrbConfig
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators.stack import entry_bytes
from reslrb_cli.integrators.reslrb import LightTracer, Reslrb
from reslrb_cli.optimization.loading import pass_spp
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.scene.xml.build import film_sizes
from reslrb_cli.scene.xml.read import Description
from reslrb_cli.transport.plan import Plan

#: Images of the film's size in memory during a step: block, image, parts of the loss, gradient, adjoint; also those of
#: a batch.
FILM_IMAGES = 12

#: Copies of a parameter: gradients, the optimiser's moments, and their next values.
PARAMETER_COPIES = 8

#: Minimum bytes per entry of a parameter: value, the optimiser's copy, gradient, and the array for updates.
ENTRY_BYTES = 4 * 4

#: Minimum bytes per pixel: five images (block, image, dL/dI, its adjoint, target) of three floats.
PIXEL_BYTES = 5 * 3 * 4

#: Bytes that every machine has.
SMALL = 2**28

#: Minimum share of the estimated memory that a step takes, by `run.adjoint`: 0.93, 0.58 and 0.44 were measured.
SURE = {"batched": 0.8, "independent": 0.5, "correlated": 0.4}

#: Integrators with evaluated loops, and minimum bytes of a path's state there: ray, throughput, generator.
NAIVE, PATH_BYTES = ("ptracer", "walk_ad"), 48

#: Bytes of thread-local memory per vertex in `trajectory`, as measured by `bench`.
RECORD_BYTES = 60

COARSER = "use a smaller film or coarser textures"


# --- memory of a step -------------------------------------------------------------------------------------------------


def pixels_of(scene: mi.Scene, sensors: Sequence[int]) -> list[int]:
    """Return each full film's pixel count, without its crop window. The pixel count determines the number of light
    paths.
    """
    return [int(dr.prod(scene.sensors()[index].film().size())) for index in sensors]


def plans(problem: Problem, integrator: LightTracer) -> list[Plan]:
    """Return the plan of each view."""
    sensors, params = problem.scene.sensors(), problem.selection.params
    return [integrator.plan(problem.scene, sensors[index], params) for index in problem.sensors]


def step_parts(
    config: Config, blocks: Sequence[int], parameters: Iterable[int], paths: Iterable[int] = ()
) -> dict[str, int]:
    """Return the minimum bytes of a step, by part. `blocks` has the entries of each view's block, `parameters` those of
    each parameter, and `paths` the bytes of each array that is stored for the paths of a pass.
    """
    parts = {
        "images and parameters": FILM_IMAGES * allocated(4 * max(blocks))
        + sum(PARAMETER_COPIES * allocated(4 * size) for size in parameters),
        "targets": sum(allocated(4 * block) for block in blocks),
        "stored paths": sum(map(allocated, paths)),
    }
    return {part: int(SURE[config.adjoint] * size) for part, size in parts.items()}


def _stored_paths(problem: Problem, integrator: Reslrb) -> list[int]:
    """Return the bytes of each array that a step stores for its paths, for the view with the most bytes."""
    config, samples = problem.config, pass_spp(problem.config)
    planned = plans(problem, integrator)  # always, because it raises UnsupportedScene before anything is rendered
    if config.adjoint != "correlated" or samples != config.share_spp:
        return []  # dL/dI is known before the paths are traced, and nothing of them outlives the kernel
    found: list[int] = []
    for plan, count in zip(planned, pixels_of(problem.scene, problem.sensors), strict=True):
        width = round(samples * count * integrator.share_of_light(plan))
        found = max(found, [size * width for size in entry_bytes(integrator.kept(plan))], key=sum)
    return found


def allocated(size: int) -> int:
    """Return the bytes that the allocator uses for an array: a power of two."""
    return max(1 << (size - 1).bit_length(), 64) if size else 0


# --- checks of memory -------------------------------------------------------------------------------------------------


def check_described(config: Config, description: Description) -> None:
    """Raise ConfigError if the scene's film has too many samples for a step. Also raise ConfigError if a step needs
    more than the free memory.

    The check uses the scene's smallest film, because the sensors of the run are not known yet.
    """
    film = min(film_sizes(description), key=lambda size: size.cropped, default=None)
    if film is None or not film.cropped:
        return  # without a size in the file, Mitsuba's own film is used, which is small
    key = "scene.file" if config.scene.size is None else "scene.size"
    _check_samples(config, film.width * film.height)
    textures, pixels = _textures(config), film.cropped * PIXEL_BYTES
    texels = {name: width * height * ENTRY_BYTES for name, (width, height) in textures.items()}
    if isinstance(config.integrator, ReslrbConfig):
        pixels = sum(step_parts(config, [film.cropped * (film.channels + 1)], ()).values())
        sure = SURE[config.adjoint]
        texels = {name: int(PARAMETER_COPIES * allocated(4 * w * h) * sure) for name, (w, h) in textures.items()}
    needed = pixels + sum(texels.values())
    free = free_for(needed)
    what = f"a film of {film.width}x{film.height} pixels"
    what += "".join(f" and {width}x{height} texels" for width, height in list(textures.values())[:2])
    what += " and more" if len(textures) > 2 else ""
    if needed > free:
        largest = max(texels, key=lambda name: texels[name], default=key)
        key = largest if texels.get(largest, 0) > pixels else key
        reason = f"{what}: a step takes at least {in_words(needed)}, and {in_words(free)} are free"
        raise ConfigError(config.source, key, f"{reason}; {COARSER}")


def _textures(config: Config) -> dict[str, tuple[int, int]]:
    """Return a mapping from the key of each size setting to the (width, height) of the parameter."""
    found = {}
    for place, spec in enumerate(config.parameters):
        at, size = ("resolution", spec.resolution)
        if spec.heightmap is not None:
            at, size = ("heightmap.resolution", spec.heightmap.resolution)
        if size is not None:
            found[f"parameters[{place}].{at}"] = size
    return found


def check_films(config: Config, scene: mi.Scene, sensors: Sequence[int]) -> None:
    """Raise ConfigError if a film has too many samples for a step."""
    for pixels in pixels_of(scene, sensors):
        _check_samples(config, pixels)


def _check_samples(config: Config, pixels: int) -> None:
    obstacle = config.samples_obstacle(pixels)
    if obstacle is not None:
        raise ConfigError(config.source, "run.spp", obstacle)


def free_for(needed: int) -> int:
    """Return the free bytes. For small needs, the function skips the query of the free bytes, because querying a GPU
    driver takes a while.
    """
    return needed if needed < SMALL else free_bytes(mi.variant())


def check_step(problem: Problem) -> None:
    """Raise ConfigError if a step takes more memory than is free. The problem needs no targets."""
    config, integrator = problem.config, problem.integrator
    if not isinstance(integrator, Reslrb):
        _check_baseline(problem)
        return
    films = [problem.scene.sensors()[index].film() for index in problem.sensors]
    blocks = [int(dr.prod(film.crop_size())) * (film.base_channels_count() + 1) for film in films]
    sizes = (int(dr.prod(dr.shape(problem.selection.value(key)))) for key in problem.selection.keys)
    parts = step_parts(config, blocks, sizes, _stored_paths(problem, integrator))
    needed = sum(parts.values())
    free = free_for(needed)
    if needed <= free:
        return
    largest = max(parts, key=lambda name: parts[name])
    key, advice = "scene.file", COARSER
    if largest == "stored paths":
        key, advice = "run.spp", "set integrator.samples_per_pass, or leave run.adjoint at auto, which stores no paths"
    reason = f"a step takes at least {in_words(needed)} ({largest} {in_words(parts[largest])}), and "
    raise ConfigError(config.source, key, f"{reason}{in_words(free)} are free; {advice}")


def _check_baseline(problem: Problem) -> None:
    """Raise ConfigError if an integrator other than `reslrb` stores more path data than fits into memory."""
    config = problem.config
    kind, depth = config.integrator.type, config.integrator.max_depth
    most = local_bytes() // RECORD_BYTES
    if kind == "trajectory" and depth > most and not mi.variant().startswith("cuda"):
        reason = f"the record of {depth} segments does not fit on a thread's stack; use at most {most}, raise "
        raise ConfigError(
            config.source, "integrator.max_depth", f"{reason}`ulimit -s`, or use reslrb, which needs no record"
        )
    if kind not in NAIVE:
        return
    paths = pass_spp(config) * max(pixels_of(problem.scene, problem.sensors))
    needed = paths * PATH_BYTES
    free = free_for(needed)
    if needed > free:
        reason = f"{kind} stores the state of all {paths} light paths of a pass, at least {in_words(needed)}, and "
        reason += f"{in_words(free)} are free; lower run.spp, set integrator.samples_per_pass, or use reslrb, which "
        raise ConfigError(config.source, "run.spp", f"{reason}keeps none")
