"""`reslrb init`: write a first configuration for a scene.

The template `templates/first_config.yaml.j2` holds the configuration's text, with comments on the settings.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from textwrap import wrap
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.inspect import LISTED_SENSORS
from reslrb_cli.cli.options import check_writable
from reslrb_cli.cli.terminal import echo, fill
from reslrb_cli.config.loader import loads, parse_override
from reslrb_cli.config.parameters import entry_of, tinted_by
from reslrb_cli.config.yaml_text import write
from reslrb_cli.errors import ConfigError, UnsupportedScene, describe, printable
from reslrb_cli.records.atomic import write_atomically, writing

if TYPE_CHECKING:
    import mitsuba as mi

    from reslrb_cli.config.schema import Config
    from reslrb_cli.optimization.first_fit import FirstFit
    from reslrb_cli.optimization.problem import Problem
    from reslrb_cli.scene.images import StoredImage
    from reslrb_cli.scene.proposal import Proposal
    from reslrb_cli.scene.xml.read import Description
    from reslrb_cli.statistics import Array


#: Pixels of a film with which a run takes minutes on two cores, with these samples and at most these iterations.
PIXELS = 2**14
SPP, ITERATIONS = 16, 300

#: Time of the first fit in seconds.
FIT_SECONDS = 60.0

#: Maximum number of parameters in comments; a scene can have thousands.
_MOST_OTHERS = 60

#: Maximum number of variables and sensors in a comment, and of characters of a variable.
_MOST_VARIABLES, _MOST_SENSORS, _LONGEST = 8, 6, 40

#: Maximum number of parameters that the line about the first fit names.
_MOST_NAMED = 3

#: Width of a comment with several lines.
_COMMENT = 110
_NUMBER = re.compile(r"-?\d{1,15}(\.\d{1,15})?")
_PLAIN = re.compile(r"(\.\./)*[A-Za-z_][\w.\-]*(/[\w.\-]+)*")


def _first_config(
    path: Path,
    options: Mapping[str, bool | int | float | str],
    variables: Mapping[str, str],
    sensors: Sequence[str],
    sensor: int,
    proposals: Sequence[Proposal],
    movable: Sequence[tuple[str, float, str, str]],
    found: FirstFit | None = None,
    **known: Any,
) -> str:
    """Return the YAML of a configuration that is written to `path`. The template is `first_config.yaml.j2`.

    `options` holds the scene file's variables that the user has set. `variables` holds all variables of the scene file,
    as text. `sensors` holds the ids of the sensors. `sensor` is the index of the sensor in use. `movable` has the
    ids, shares, file names and free motions of the shapes in view that can be moved. `found` is the first fit. `known`
    are other template values, and `has_response` is true if the response of the camera is recovered.
    """
    from reslrb_cli.optimization.views import RESPONSE, SHARED

    explained, values = ({}, {}) if found is None else (found.explained, found.values)
    first = [proposal for proposal in proposals if proposal.first]
    others = [f"{_word(name)}: {_word(text)}" for name, text in variables.items() if name not in options]
    listed = [text for text in others if len(text) <= _LONGEST][:_MOST_VARIABLES]
    named = [f"{number} is {_word(name)}" for number, name in enumerate(sensors[:_MOST_SENSORS])]
    return fill(
        "first_config.yaml.j2",
        {
            "path": partial(_path, folder=path.absolute().parent),
            "comment": _comment,
            "entry": partial(_entry, values=values),
            "note": partial(_note, explained=explained),
        },
        **({"has_response": False} | known),
        file=path.name,
        exposure="{auto: " + _numbers(values[SHARED]) + "}" if SHARED in values else "auto",
        share_of_response=round(100 * explained.get(RESPONSE, 0.0)),
        given=", ".join(f"{_word(name)}: {json.dumps(value)}" for name, value in options.items()),
        rest=", ".join([*listed, "..."] if len(listed) < len(others) else listed),
        sensor=sensor,
        sensors=", ".join(named) + " ..." * (len(sensors) > _MOST_SENSORS) if len(sensors) > 1 else "",
        recovers_lamps=any(proposal.info.kind == "emitter" for proposal in first),
        first=first,
        others=[proposal for proposal in proposals if not proposal.first],
        most_others=_MOST_OTHERS,
        movable=[
            (_text(id), free, f"{100 * share:.0f} % of the picture" + (f", {printable(name)}" if name else ""))
            for id, share, name, free in movable[:_MOST_OTHERS]
        ],
        iterations=ITERATIONS,
        spp=SPP,
    )


def _comment(text: str) -> list[str]:
    """Split a comment into lines."""
    return wrap(printable(text), _COMMENT - len("  # "), break_long_words=False)


def _numbers(value: Array) -> str:
    """Return a number, or a list of one number for each channel, as YAML."""
    numbers = [f"{number:.4g}" for number in value.ravel()]
    return numbers[0] if len(numbers) == 1 else f"[{', '.join(numbers)}]"


def _entry(proposal: Proposal, values: Mapping[str, Array] = MappingProxyType({})) -> str:
    """Return the entry of a parameter."""
    option, name = entry_of(proposal.key)
    parts = [f"{option}: {_text(name)}"]
    parts += [f"initial: {_numbers(values[proposal.key])}"] if proposal.key in values else []
    parts += [f"bounds: {proposal.bounds}"] if proposal.bounds is not None else []
    parts += [f"resolution: {list(proposal.resolution)}"] if proposal.resolution is not None else []
    return "{" + ", ".join(parts) + "}"


def _note(proposal: Proposal, explained: Mapping[str, float] = MappingProxyType({})) -> str:
    info, value = proposal.info, proposal.info.value
    parts = [f"{100 * proposal.share:.0f} % of the picture" if proposal.share >= 0.005 else "not seen itself"]
    parts += [f"{info.shape[1]}x{info.shape[0]} texels"] if len(info.shape) == 3 else []
    if value is not None:
        numbers = None if value.numbers is None else " ".join(f"{number:.3g}" for number in value.numbers)
        parts.append(f"{value.low:.3g} to {value.high:.3g}" if numbers is None else f"now {numbers}")
    if proposal.key in explained:
        parts.append(f"explains {100 * explained[proposal.key]:.0f} % of the misfit")
    return ", ".join(parts if info.remark is None else [*parts, info.remark])


def _path(path: Path, folder: Path) -> str:
    relative = os.path.relpath(path, folder)
    # Files far from the configuration will not be moved with it.
    return _text(str(path.absolute()) if relative.startswith(os.path.join("..", "..", "..")) else relative)


def _word(text: str) -> str:
    """Quote a name or value of the scene file, if needed, so that the text cannot end a comment."""
    return text if _PLAIN.fullmatch(text) or _NUMBER.fullmatch(text) else json.dumps(text)


def _text(text: str) -> str:
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)


Size = tuple[int, int]

#: Tolerance for the aspect ratio of a photograph, relative to the film's.
_RATIO = 0.01


@click.command("init")
@click.argument("scene_file", metavar="SCENE", type=click.Path(path_type=Path))
@click.option(
    "--target", type=click.Path(path_type=Path), help="Photograph from which the parameters of the scene are recovered."
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Configuration to write. Default: the name of the scene's file, or of its folder if the file is scene.xml, "
    "with .yaml, in the working directory.",
)
@click.option(
    "--sensor",
    "index",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Index of the sensor of the photograph.",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Value of a $NAME of the scene file (scene.options.NAME), or the variant; also written to the configuration. "
    "May be repeated.",
)
@click.option(
    "--fit",
    "seconds",
    metavar="SECONDS",
    type=click.FloatRange(min=0),
    default=FIT_SECONDS,
    show_default=True,
    help="Time for a first fit of the photograph, which decides whether roughnesses and the camera's response are "
    "recovered. 0 skips the fit.",
)
def command(
    scene_file: Path,
    target: Path | None,
    output: Path | None,
    index: int,
    overrides: tuple[str, ...],
    seconds: float,
) -> None:
    """Write a commented configuration for the scene in the file SCENE, to use with `reslrb optimize`.

    The configuration recovers the colours of the materials that are largest in view, the roughness of rough
    conductors and glass, and the brightness of visible lamps. Textures with a pattern are left out; their tints
    are listed. Lamps are left out if the photograph has 8 or 16 bits, because such a photograph clips the lamps.
    All other recoverable parameters are listed as comments with bounds and current values. Remove the # of those
    that you want. Shapes in view that can be moved are listed, too.

    With --target, the command first fits the photograph with few samples. If the colours do not explain the
    photograph, the configuration also recovers what does: roughnesses, the camera's response, or both, or the tint
    of a texture. The film gets the photograph's aspect ratio. The film's size is such that a run takes minutes. If
    the photograph has another size than the film, the command writes a resized copy beside the configuration. If
    there are several sensors, the first one is used, unless --sensor names another.
    """
    from reslrb_cli.backend.variant import set_variant

    # abspath, because `..` has no name of its own; the root folder has none.
    folder = Path(os.path.abspath(scene_file)).parent.name if scene_file.stem == "scene" else ""
    named = folder or scene_file.stem
    path = output or Path(f"{named}.yaml")
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError("--output", "", f"{path} must end in .yaml or .yml")
    _check_free(path)
    check_writable("--output", path)
    given = _read_settings(scene_file, overrides)
    options = given.scene.options
    set_variant(given.variant)

    from reslrb_cli.optimization.first_fit import has_candidates
    from reslrb_cli.optimization.views import RESPONSE, own_channels
    from reslrb_cli.scene.images import photo_lines, read_stored
    from reslrb_cli.scene.load import load_scene
    from reslrb_cli.scene.needs import paths_obstacle
    from reslrb_cli.scene.parameters import select_parameters
    from reslrb_cli.scene.proposal import find_movable_in_view, propose, write_smaller
    from reslrb_cli.scene.response import LINEAR
    from reslrb_cli.scene.visibility import find_depth

    photo = None if target is None else read_stored(target, upright=True)
    described: list[Description] = []
    scene = load_scene(scene_file, options, look=described.append)
    [description] = described
    hides = description.hides_emitters and target is None  # a photograph shows its lamps and its background
    sensors = [str(sensor.id()) for sensor in scene.sensors()]
    _tell_sensor(index, sensors)
    sensor = scene.sensors()[index]
    film = sensor.film()
    own, whole = ((int(size[0]), int(size[1])) for size in (film.crop_size(), film.size()))
    size, is_raw = choose_size(own, photo, fixed=own != whole), bool(own_channels(film))
    for line in () if target is None else photo_lines(target, response=LINEAR if is_raw else None):
        echo(line)
    reason = _why_camera(scene, sensor, hides, scene_file)
    is_integer = photo is not None and photo.white is not None
    proposals = propose(scene, index, lamps=not is_integer and not hides)
    if not proposals:
        raise ConfigError(scene_file, "", "has no recoverable parameter; reslrb inspect --all says why")
    image, copied = target, photo is not None and photo.size != size
    if photo is not None and copied:
        image = path.with_name(f"{photo.path.stem}-{size[0]}x{size[1]}{'.png' if is_integer else '.exr'}")
        copied = not _has_copy(image, photo, size, is_raw)
    depth, missing = find_depth(scene, index)

    write_config = partial(
        _first_config, options=options, variables=description.variables, sensors=sensors, sensor=index,
        movable=find_movable_in_view(scene, index), scene=scene_file, size=size, film=own,
        variant=given.variant, is_raw=is_raw, is_integer=is_integer, reason=reason,
        hides_emitters=description.hides_emitters, depth=depth, missing=missing,
    )  # fmt: skip
    found = None
    has_camera = paths_obstacle(scene, sensor, "camera") is None
    if photo is not None and seconds > 0 and has_candidates(scene, proposals, is_integer and not is_raw):
        found = _try_out(photo, size, is_raw, proposals, write_config, seconds, has_camera)
    freed = [] if found is None else found.freed
    proposals, has_response = _with_freed(proposals, freed), RESPONSE in freed
    text = write_config(path, target=image, proposals=proposals, found=found, has_response=has_response)
    specs = loads(text, path).parameters
    scene = load_scene(scene_file, options, keys=[key for spec in specs for key in spec.keys])
    select_parameters(scene, specs, path)  # raises errors before anything is written
    with writing("--output", path):
        if copied and photo is not None and image is not None:
            write_smaller(photo, size, image, is_raw)
        write_atomically(path, lambda file: file.write(text.encode()))
    made = f" and {image}" if copied else ""
    count = sum(proposal.first for proposal in proposals)
    echo(f"{path}{made}: {count} of {len(proposals)} parameters, at {size[0]}x{size[1]} pixels")
    if reason is not None:
        echo(f"integrator.paths: camera, since light paths cannot render this: {reason}")
    if description.hides_emitters and target is not None:
        echo(f"integrator.hide_emitters: the scene hides lamps and background; set it if {target} does not show them")
    echo(f"next: check it, then run `reslrb optimize {path}`" + ("" if target is not None else " with a target"))


def _with_freed(proposals: Sequence[Proposal], freed: Sequence[str]) -> list[Proposal]:
    """Return the proposals, with those of the keys `freed` among the first ones."""
    return [replace(each, first=each.first or each.key in freed) for each in proposals]


def _try_out(
    photo: StoredImage, size: Size, is_raw: bool, proposals: Sequence[Proposal], write_config: Callable[..., str],
    seconds: float, has_camera: bool,
) -> FirstFit | None:  # fmt: skip
    """Fit the photograph. Return None after an error, which does not lose the configuration."""
    from reslrb_cli.optimization.first_fit import assemble_first_fit, try_out
    from reslrb_cli.optimization.uncertainty.measuring import Budget
    from reslrb_cli.optimization.views import RESPONSE
    from reslrb_cli.scene.proposal import LEAST_SHARE, write_smaller

    began = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory(prefix="reslrb-") as folder:
            image = Path(folder) / ("photo.png" if photo.white is not None else "photo.exr")
            write_smaller(photo, size, image, is_raw)
            path = Path(folder) / "fit.yaml"
            tinted = [each.info.key for each in proposals if tinted_by(each.key) and each.share >= LEAST_SHARE]

            def make(freed: Sequence[str]) -> Problem:
                recovered, has_response = _with_freed(proposals, freed), RESPONSE in freed
                text = write_config(path, target=image, proposals=recovered, has_response=has_response)
                # Raises an error if an exposure makes up for all that is freed.
                return assemble_first_fit(loads(text, path), size, has_camera, bool(freed), tinted)

            found = try_out(make, proposals, Budget(seconds, lambda: False))
            if found is not None and found.freed:
                make(found.freed)
    except Exception as error:
        echo(f"the photograph was not fitted: {describe(error)}")
        return None
    if found is not None:
        echo(f"first fit, {time.perf_counter() - began:.0f} s: {_found_words(found)}")
    return found


def _found_words(found: FirstFit) -> str:
    """Return what the first fit has found."""
    from reslrb_cli.optimization.views import RESPONSE

    if found.misfit is None:
        return "not finished; --fit gives it more time"
    if found.misfit == 0:
        return "the colours explain the photograph"
    left = f"the colours leave a misfit of {100 * found.misfit:.2g} %"
    if found.freed:
        words = {RESPONSE: "the camera's response"}
        named = ", ".join(words.get(key, printable(key)) for key in found.freed[:_MOST_NAMED])
        more = " ..." if len(found.freed) > _MOST_NAMED else ""
        return f"{left}, so the run also recovers {named}{more}"
    return f"{left}, which neither roughnesses nor a camera's response nor the tint of a texture explain"


def choose_size(film: Size, photo: StoredImage | None, fixed: bool = False) -> Size:
    """Return the (width, height) of a film that is small enough for a run of minutes. The film has the photograph's
    aspect ratio. Without a photograph, the film keeps its own aspect ratio.

    A `fixed` film, which is a crop of a larger one, keeps its size. Raises ConfigError if the ratios of the photograph
    and the film differ by more than `_RATIO`, and a crop would bring them closer.
    """
    width, height = film if photo is None else photo.size
    if photo is not None and abs(width / height * film[1] / film[0] - 1) > _RATIO:
        lower = width, max(round(width * film[1] / film[0]), 1)
        narrower = max(round(height * film[0] / film[1]), 1), height
        fits = lower if lower[1] <= height else narrower
        if photo.size not in (lower, narrower):
            raise ConfigError(
                photo.path,
                "",
                f"is {width}x{height} pixels, the scene's film {film[0]}x{film[1]}, with another aspect ratio; crop it "
                f"to the film's view, such as {fits[0]}x{fits[1]}, or give the film the photograph's ratio",
            )
    if fixed:
        return film
    scale = min(1.0, (PIXELS / (width * height)) ** 0.5)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def _read_settings(scene_file: Path, overrides: tuple[str, ...]) -> Config:
    """Return a configuration with the scene file's variables and the variant of `--set`. Raises ConfigError for other
    settings.
    """
    for override in map(parse_override, overrides):
        if override.location[:2] != ("scene", "options") and override.location != ("variant",):
            raise ConfigError(
                override.label, "", "init takes only scene.options.NAME=VALUE and variant=NAME; edit other settings in "
                "its output",
            )  # fmt: skip
    stand_ins = {"target": {"render": {}}, "parameters": [{"key": "*"}]}
    text = write({"scene": {"file": str(scene_file.absolute())}, **stand_ins})
    return loads(text, scene_file, overrides)


def _tell_sensor(index: int, sensors: Sequence[str]) -> None:
    """Print which of several sensors is used. Raises ConfigError if the scene has no sensor with this index."""
    named = [f"{number} ({name})" for number, name in enumerate(sensors)]
    if index >= len(sensors):
        more = "" if len(named) <= LISTED_SENSORS else " ..."
        raise ConfigError("--sensor", "", f"is {index}; the scene has {', '.join(named[:LISTED_SENSORS])}{more}")
    if len(sensors) > 1:
        others = [name for number, name in enumerate(named) if number != index]
        more = "" if len(others) <= LISTED_SENSORS else f" and {len(others) - LISTED_SENSORS} more"
        echo(f"sensor {named[index]}; --sensor selects another: {', '.join(others[:LISTED_SENSORS])}{more}")


def _why_camera(scene: mi.Scene, sensor: mi.Sensor, hides_emitters: bool, file: Path) -> str | None:
    """Return the reason if only camera paths can render the scene. Return None if light paths can render the scene,
    too.

    Raises ConfigError, located in the scene's `file`, if no paths can render the scene.
    """
    from reslrb_cli.scene.needs import check_paths, paths_obstacle

    try:
        check_paths(scene, sensor, "light", hides_emitters)
    except UnsupportedScene as error:
        obstacles = [paths_obstacle(scene, sensor, kind) for kind in ("both", "camera")]
        if all(obstacles):
            raise ConfigError(file, "", str(error)) from None  # this message covers both kinds of paths
        return paths_obstacle(scene, sensor, "light", hides_emitters) if obstacles[0] else None
    return None


def _has_copy(image: Path, photo: StoredImage, size: Size, is_raw: bool) -> bool:
    """Whether an earlier call has written this copy of a photograph. Raises ConfigError for any other file."""
    from reslrb_cli.scene.proposal import write_smaller

    if not image.is_file():
        _check_free(image)
        return False
    with tempfile.TemporaryDirectory(prefix="reslrb-") as folder:
        write_smaller(photo, size, made := Path(folder) / image.name, is_raw)
        if made.read_bytes() != image.read_bytes():
            _check_free(image)
    return True


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise ConfigError(path, "", "exists; remove or rename it")
