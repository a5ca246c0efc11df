"""`reslrb init`: a configuration for a scene, to begin with."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from reslrb_cli.cli.experiment import check_writable
from reslrb_cli.cli.output import echo
from reslrb_cli.config import loads
from reslrb_cli.errors import ConfigError, UnsupportedScene, is_machine_fault
from reslrb_cli.records.atomic import write_atomically

if TYPE_CHECKING:
    import mitsuba as mi

    from reslrb_cli.scene.photograph import Photograph

Size = tuple[int, int]
#: By how much the ratio of a photograph's sides may differ from the film's.
_RATIO = 0.01


@click.command("init")
@click.argument("scene_file", metavar="SCENE", type=click.Path(path_type=Path))
@click.option("--target", type=click.Path(path_type=Path), help="Photograph to recover the scene's parameters from.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Configuration to write; default: the scene's name with .yaml, in the working directory.",
)
@click.option("--force", is_flag=True, help="Replace files that exist.")
def command(scene_file: Path, target: Path | None, output: Path | None, force: bool) -> None:
    """Write a commented configuration for the scene in the file SCENE, which `reslrb optimize` takes.

    It recovers the colours of the materials that are largest in view; what else can be recovered stands there as
    comments, with bounds and present values. With --target the film gets the photograph's ratio of sides, at a size
    with which a run takes minutes, and a copy of the photograph of that size is written beside the configuration.
    """
    from reslrb_cli.backend.variant import set_variant

    named = scene_file.absolute().parent.name if scene_file.stem == "scene" else scene_file.stem
    path = output or Path(f"{named}.yaml")
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError("--output", "", f"{path} must end in .yaml, as configurations do")
    _check_free(path, force)
    check_writable("--output", path)
    set_variant("auto")

    from reslrb_cli.cli.first_config import FirstConfig
    from reslrb_cli.scene import load_scene, select_parameters
    from reslrb_cli.scene.depth import find_depth
    from reslrb_cli.scene.photograph import open_photograph, write_smaller
    from reslrb_cli.scene.proposal import propose

    photo = None if target is None else open_photograph(target)
    scene = load_scene(scene_file)
    film = scene.sensors()[0].film()
    own, whole = ((int(size[0]), int(size[1])) for size in (film.crop_size(), film.size()))
    size = choose_size(own, photo, fixed=own != whole)
    proposals = propose(scene, 0)
    if not proposals:
        raise ConfigError(scene_file, "", "nothing in it can be recovered; reslrb inspect --all says why")
    image, copied = target, False
    if photo is not None and target is not None and photo.size != size:
        image = path.with_name(f"{target.stem}-{size[0]}x{size[1]}{'.png' if photo.is_integer else '.exr'}")
        copied = True
        _check_free(image, force)
    is_integer = photo is not None and photo.is_integer
    integrator, depth = _integrator(scene), find_depth(scene, 0)
    first = FirstConfig(scene_file, image, is_integer, size, own, integrator, depth, proposals)
    text = first.text(path)
    select_parameters(scene, loads(text, path).parameters, path)  # what is wrong is to show before anything is written
    try:
        if copied and photo is not None and image is not None:
            write_smaller(photo, size, image)
        write_atomically(path, lambda file: file.write(text.encode()))
    except OSError as error:
        if is_machine_fault(error):
            raise
        raise ConfigError("--output", "", f"cannot write {error.filename}: {error.strerror}") from None
    made = f" and {image}" if copied else ""
    count = sum(proposal.first for proposal in proposals)
    echo(f"{path}{made}: {count} of {len(proposals)} parameters, at {size[0]}x{size[1]} pixels")
    echo(f"next: look at it, and `reslrb optimize {path}`" + ("" if target is not None else ", once there is a target"))


def choose_size(film: Size, photo: Photograph | None, fixed: bool = False) -> Size:
    """The (width, height) of a film with which a run takes minutes, in the ratio of the photograph, or its own.

    A `fixed` one, which is a window of a larger film, stays as it is. Raises ConfigError for a photograph whose ratio
    is not that of the film.
    """
    from reslrb_cli.cli.first_config import PIXELS

    width, height = film if photo is None else photo.size
    if photo is not None and abs(width / height * film[1] / film[0] - 1) > _RATIO:
        fits = (width, round(width * film[1] / film[0]))
        fits = fits if fits[1] <= height else (round(height * film[0] / film[1]), height)
        raise ConfigError(
            photo.path,
            "",
            f"is {width}x{height} pixels, and the scene's film {film[0]}x{film[1]}, of another ratio; cut it to "
            f"what the film sees, such as {fits[0]}x{fits[1]}, or give the film and its view the photograph's ratio",
        )
    if fixed:
        return film
    scale = min(1.0, (PIXELS / (width * height)) ** 0.5)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def _integrator(scene: mi.Scene) -> str:
    """The integrator that can render the scene: paths from the light, or where these cannot, from the sensor."""
    from reslrb_cli.scene import check_camera_paths, check_supported

    try:
        check_supported(scene, scene.sensors()[0], False)
    except UnsupportedScene as error:
        try:
            check_camera_paths(scene)
        except UnsupportedScene:
            raise error from None
        return "prb"
    return "reslrb"


def _check_free(path: Path, force: bool) -> None:
    if os.path.lexists(path) and not (force and path.is_file()):
        raise ConfigError(path, "", "exists" + ("; --force replaces it" if path.is_file() else " and is no file"))
