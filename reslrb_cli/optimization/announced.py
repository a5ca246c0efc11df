"""Whether there is room for what a configuration and a scene's file say of their sizes, before anything is built.

Films and textures of a hundred million entries take a minute to make; that there is no room for them is known before.
"""

from __future__ import annotations

import logging

from reslrb_cli.config import Config, Reslrb
from reslrb_cli.config.files import in_words
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.budget import FILM_IMAGES, PARAMETER_COPIES, allocated
from reslrb_cli.optimization.room import PIXEL_BYTES, SURE, check_film, free_for, too_large
from reslrb_cli.scene.description import Description, FilmSize, film_sizes

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
    return isinstance(config.integrator, Reslrb) and config.run.memory_budget is None


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
