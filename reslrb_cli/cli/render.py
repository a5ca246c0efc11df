"""`reslrb render`: render one image of an experiment's scene."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from reslrb_cli.cli.options import (
    allow_code_option,
    check_writable,
    is_given,
    overrides_option,
    start_variant,
)
from reslrb_cli.cli.terminal import echo
from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.config.views import ViewSpec
from reslrb_cli.config.yaml_text import parse
from reslrb_cli.errors import ConfigError, one_line
from reslrb_cli.records.atomic import writing

#: Formats with linear values; the other `FORMATS` are 8-bit sRGB.
FLOAT_FORMATS = (".exr", ".hdr", ".pfm")
FORMATS = (*FLOAT_FORMATS, ".png", ".jpg", ".jpeg")


class ExposureType(click.ParamType):
    """A factor above 0, or None for `auto`."""

    name = "FACTOR|auto"

    def convert(
        self, value: str | float | None, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | None:
        """Return the factor."""
        if value == "auto" or value is None:
            return None
        try:
            factor = float(value)
        except ValueError:
            factor = math.nan
        if not 0 < factor < math.inf:
            self.fail(f"{value!r} is neither auto nor a number above 0", param, ctx)
        return factor


@click.command("render")
@click.argument("path", metavar="CONFIG|RUN", type=click.Path(path_type=Path))
@overrides_option
@click.option(
    "--value",
    "values",
    multiple=True,
    metavar="KEY=VALUE",
    help="Value of a parameter of the scene, after all others: a number, a list such as [R, G, B], or {file: IMAGE}. "
    "KEY is any key that `inspect` lists. Can be repeated.",
)
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="Image file to write. EXR, HDR and PFM are linear, PNG and JPG are 8-bit sRGB.",
)
@allow_code_option
@click.option(
    "--sensor", type=click.IntRange(min=0), help="Index of the sensor. Default: the first one of the experiment."
)
@click.option(
    "--exposure",
    type=ExposureType(),
    default="1",
    show_default=True,
    help="Factor of the image in a PNG or JPG: a number, or auto, which suits everything in view except lamps. "
    "For a RUN, the default is the run's exposure, also in EXR, HDR and PFM; 1 ignores it.",
)
@click.option(
    "--initial/--scene",
    "initial",
    default=True,
    help="Use the initial values of the parameters (default), or those of the scene file.",
)
def command(
    path: Path,
    overrides: tuple[str, ...],
    values: tuple[str, ...],
    output: Path,
    allow_code: bool,
    sensor: int | None,
    exposure: float | None,
    initial: bool,
) -> None:
    """Render the scene of CONFIG with its integrator, or that of the run in the folder RUN with its recovered values.

    The image has run.spp samples per pixel; --set run.spp=N changes their number. To change the light or a material of
    the recovered scene, use --value.
    """
    given = parse_values(values)
    run = path if path.is_dir() else None
    if run is not None and is_given("initial"):
        raise click.UsageError("a run is rendered with its recovered values; remove --initial or --scene")
    linear = output.suffix.lower() in FLOAT_FORMATS
    if linear and is_given("exposure") and (run is None or exposure != 1):
        raise click.UsageError(f"{output.suffix} is linear; --exposure is for PNG and JPG")
    if run is None:
        config = load(path, overrides)
    else:
        from reslrb_cli.records.run_folder import recovered

        config = recovered(run, overrides)
    config = config.with_code(allow_code)
    check_image_path(output)
    start_variant(config)

    import numpy as np

    from reslrb_cli.optimization.assemble import load_for_rendering
    from reslrb_cli.optimization.loading import render_in_passes
    from reslrb_cli.optimization.views import color_channels
    from reslrb_cli.records.images import write_file
    from reslrb_cli.records.run_folder import exposed, exposures
    from reslrb_cli.report.tonemap import exposure_words

    if sensor is not None:
        config = _of_sensor(config, sensor)
    scene, sensors, integrator, multiple = load_for_rendering(config, initial, given, "--value")
    samples = config.run.spp
    image = render_in_passes(integrator, scene, sensors[0], samples, config.run.seed, 0, "render", multiple)
    own = {} if run is None or is_given("exposure") else exposures(run)
    applied = own.get(sensors[0] if sensor is None else sensor, np.float32(1))
    image = exposed(image, applied, color_channels(scene.sensors()[sensors[0]].film()))
    suits = 1.0 if linear else _suiting(image, scene, scene.sensors()[sensors[0]])
    factor = suits if exposure is None else exposure
    with writing("--output", output):
        write_file(output.resolve(), image * factor, linear)
    words = [f"{image.shape[1]}x{image.shape[0]}", f"{samples} spp", *filter(None, [exposure_words(factor)])]
    hint = "" if suits == 1 or is_given("exposure") else f"; --exposure auto: {exposure_words(suits)}"
    if np.any(applied != 1):
        shown = " ".join(f"{value:.4g}" for value in np.ravel(applied))
        words.append(f"times {shown}, the run's exposure (--exposure 1 ignores it)")
        hint = ""
    echo(f"{output}: {', '.join(words)}{hint}")


def parse_values(texts: Sequence[str]) -> dict[str, Any]:
    """Return the values of `--value` by key. Raises ConfigError."""
    found: dict[str, Any] = {}
    for text in texts:
        label, (key, equals, value) = f"--value {one_line(text, 100)}", text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(label, "", "must be KEY=VALUE, such as lamp.emitter.radiance.value=[8, 7, 5]")
        if key.strip() in found:
            raise ConfigError(label, "", "is given twice; give one value for each key")
        found[key.strip()] = parse(value, label, str)
    return found


def _suiting(image: Any, scene: Any, sensor: Any) -> float:
    """Return the exposure that suits an image of a scene."""
    from reslrb_cli.report.tonemap import exposure_for
    from reslrb_cli.scene.needs import unsupported_part
    from reslrb_cli.scene.visibility import sees_lamps

    return exposure_for(image, None if unsupported_part(scene, sensor) else sees_lamps(scene, sensor))


def _of_sensor(config: Config, sensor: int) -> Config:
    """Return the experiment with only the sensor `sensor`, even if the sensor's view is held out. The lamps of its view
    stay on.
    """
    from reslrb_cli.optimization.loading import find_sensor, read_sensor_ids, view_sensors

    ids = read_sensor_ids(config)
    if not config.shares_sensors:
        find_sensor(sensor, ids, "--sensor", "")
    sensors = view_sensors(config, ids) if config.views else []
    known = dict(zip(sensors, config.views or (), strict=True))
    if config.shares_sensors and sensor not in known:
        raise ConfigError("--sensor", "", f"is {sensor}, but the experiment has {len(known)} views")
    view = known.get(sensor, ViewSpec(sensor=sensor))
    return config.model_copy(
        update={
            "views": [ViewSpec(sensor=view.sensor, lamps=view.lamps)],
            # One image does not need the settings of several views.
            "target": config.target.model_copy(update={"exposure": 1.0}),
            "run": config.run.model_copy(update={"held_out": [], "views_per_iteration": None}),
        }
    )


def check_image_path(path: Path) -> None:
    """Raise ConfigError if no image can be written to `path`, because of its format or its folder."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigError("--output", "", f"{path} has no known image format; use {', '.join(FORMATS)}")
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ConfigError("--output", "", f"{path} is a folder, or in a folder that does not exist")
    if os.path.lexists(path) and not path.is_file():
        raise ConfigError("--output", "", f"{path} is not a regular file")
    check_writable("--output", path)
    # the image is written to a temporary file first, which then replaces `path`
    with writing("--output", path), tempfile.TemporaryFile(dir=path.resolve().parent):
        pass
