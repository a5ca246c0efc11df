"""`reslrb init`: a configuration for a scene, to begin with."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from reslrb_cli.cli.experiment import check_writable
from reslrb_cli.cli.listing import LISTED_SENSORS
from reslrb_cli.cli.output import echo
from reslrb_cli.config import loads
from reslrb_cli.config.overrides import parse_override
from reslrb_cli.config.text import write
from reslrb_cli.errors import ConfigError, UnsupportedScene, is_machine_fault
from reslrb_cli.records.atomic import write_atomically

if TYPE_CHECKING:
    import mitsuba as mi

    from reslrb_cli.scene.photograph import Photograph
    from reslrb_cli.scene.proposal import Proposal

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
@click.option(
    "--sensor",
    "index",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Index of the sensor that sees what the photograph shows.",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="scene.options.NAME=VALUE",
    help="Value of a $NAME of the scene file, in place of its own; stands in the configuration, too. May be repeated.",
)
@click.option(
    "--recover",
    "wanted",
    multiple=True,
    metavar="KEY",
    help="What to recover, in place of what is large in view: a key as `reslrb inspect` lists it, or a glob such as "
    "'*.radiance.value'. May be repeated.",
)
@click.option("--force", is_flag=True, help="Replace files that exist.")
def command(
    scene_file: Path,
    target: Path | None,
    output: Path | None,
    index: int,
    overrides: tuple[str, ...],
    wanted: tuple[str, ...],
    force: bool,
) -> None:
    """Write a commented configuration for the scene in the file SCENE, which `reslrb optimize` takes.

    It recovers the colours of the materials that are largest in view, the roughness of metals, and how bright lamps
    are that are in view themselves (not from a photograph of 8 or 16 bits, where they are clipped); what else can be
    recovered stands there as comments, with bounds and present values, and --recover takes other parameters. With
    --target the film gets the photograph's ratio of sides, at a size with which a run takes minutes, and a copy of the
    photograph of that size is written beside the configuration. Of several sensors it is the first that saw the
    photograph, unless --sensor names another.
    """
    from reslrb_cli.backend.variant import set_variant

    named = scene_file.absolute().parent.name if scene_file.stem == "scene" else scene_file.stem
    path = output or Path(f"{named}.yaml")
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError("--output", "", f"{path} must end in .yaml, as configurations do")
    _check_free(path, force)
    check_writable("--output", path)
    options = _read_options(scene_file, overrides)
    set_variant("auto")

    from reslrb_cli.cli.first_config import FirstConfig
    from reslrb_cli.scene import select_parameters, turned_line
    from reslrb_cli.scene.depth import find_depth
    from reslrb_cli.scene.load import load_described, read_as_floats
    from reslrb_cli.scene.photograph import open_photograph, write_smaller

    photo = None if target is None else open_photograph(target)
    turned = None if target is None else turned_line(target)
    if turned is not None:
        echo(turned)
    scene, description = load_described(scene_file, options)
    sensors = [str(sensor.id()) for sensor in scene.sensors()]
    _tell_sensor(index, sensors)
    sensor = scene.sensors()[index]
    film = sensor.film()
    own, whole = ((int(size[0]), int(size[1])) for size in (film.crop_size(), film.size()))
    size = choose_size(own, photo, fixed=own != whole)
    integrator, reason = _integrator(scene, sensor, description.hides_emitters, scene_file)
    is_integer = photo is not None and photo.is_integer
    proposals = _propose(scene_file, scene, index, wanted, lamps=not is_integer and not description.hides_emitters)
    image, copied = target, False
    if photo is not None and target is not None and photo.size != size:
        image = path.with_name(f"{target.stem}-{size[0]}x{size[1]}{'.png' if photo.is_integer else '.exr'}")
        copied = True
        _check_free(image, force)
    first = FirstConfig(
        scene=scene_file,
        options=options,
        variables=description.variables,
        sensors=sensors,
        sensor=index,
        target=image,
        is_integer=is_integer,
        size=size,
        film=own,
        integrator=integrator,
        reason=reason,
        hides_emitters=description.hides_emitters,
        depth=find_depth(scene, index),
        proposals=proposals,
    )
    text = first.text(path)
    specs = loads(text, path).parameters
    scene = read_as_floats(scene, description, [key for spec in specs for key in spec.keys])
    select_parameters(scene, specs, path)  # what is wrong is to show before anything is written
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
    if reason is not None:
        echo(f"integrator.type: {integrator}, since light paths cannot render this: {reason}")
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


def _read_options(scene_file: Path, overrides: tuple[str, ...]) -> Mapping[str, bool | int | float | str]:
    """The values of the scene file's variables that `--set` gives. Raises ConfigError for another setting."""
    for override in map(parse_override, overrides):
        if override.location[:2] != ("scene", "options"):
            raise ConfigError(
                override.label, "", "init takes scene.options.NAME=VALUE alone; other settings go into what it writes"
            )
    stand_ins = {"target": {"render": {}}, "parameters": [{"key": "*"}]}
    text = write({"scene": {"file": str(scene_file.absolute())}, **stand_ins})
    return loads(text, scene_file, overrides).scene.options


def _tell_sensor(index: int, sensors: Sequence[str]) -> None:
    """Say which sensor is taken where there are several. Raises ConfigError for one that is not there."""
    named = [f"{number} ({name})" for number, name in enumerate(sensors)]
    if index >= len(sensors):
        more = "" if len(named) <= LISTED_SENSORS else " ..."
        raise ConfigError("--sensor", "", f"is {index}; the scene has {', '.join(named[:LISTED_SENSORS])}{more}")
    if len(sensors) > 1:
        others = [name for number, name in enumerate(named) if number != index]
        more = "" if len(others) <= LISTED_SENSORS else f" and {len(others) - LISTED_SENSORS} more"
        echo(f"sensor {named[index]}; --sensor takes another: {', '.join(others[:LISTED_SENSORS])}{more}")


def _propose(scene_file: Path, scene: mi.Scene, index: int, wanted: tuple[str, ...], lamps: bool) -> list[Proposal]:
    """What of the scene can be recovered, at least one to begin with. Raises ConfigError where there is nothing."""
    from reslrb_cli.scene.proposal import propose

    try:
        proposals = propose(scene, index, lamps, wanted)
    except LookupError as error:
        more = f"reslrb inspect {scene_file} lists the keys"
        raise ConfigError("--recover", "", f"`{error.args[0]}` is nothing that can be recovered; {more}") from None
    if not proposals:
        raise ConfigError(scene_file, "", "nothing in it can be recovered; reslrb inspect --all says why")
    return proposals


def _integrator(scene: mi.Scene, sensor: mi.Sensor, hides_emitters: bool, file: Path) -> tuple[str, str | None]:
    """The integrator that can render the scene, and why it is not light paths where these cannot.

    Raises ConfigError, located in the scene's `file`, where none can.
    """
    from reslrb_cli.scene.needs import camera_obstacle, check_supported, light_obstacle

    obstacle = light_obstacle(scene, sensor, hides_emitters)
    if obstacle is None:
        return "reslrb", None
    if camera_obstacle(scene, sensor) is None:
        return "prb", obstacle
    try:
        check_supported(scene, sensor, hides_emitters)  # which has words for both
    except UnsupportedScene as error:
        raise ConfigError(file, "", str(error)) from None
    raise AssertionError("was refused a moment ago")


def _check_free(path: Path, force: bool) -> None:
    if os.path.lexists(path) and not (force and path.is_file()):
        raise ConfigError(path, "", "exists" + ("; --force replaces it" if path.is_file() else " and is no file"))
