"""What `inspect --nonfinite` says: where a run first met a value that is not finite."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.output import echo
from reslrb_cli.errors import ExitCode

if TYPE_CHECKING:
    from reslrb_cli.config import Config
    from reslrb_cli.records.offender import Offender


def show_offenders(config: Config, as_json: bool) -> int:
    """Print where the run of `config` first met a value that is not finite; exit code 1 where it does not again."""
    from reslrb_cli.cli.replaying import load_replay
    from reslrb_cli.measure.offender import find_offenders

    replay = load_replay(config)
    found = find_offenders(replay.problem, replay.iteration)
    if as_json:
        report = {"iteration": replay.iteration, "offenders": [dataclasses.asdict(entry) for entry in found]}
        click.echo(json.dumps(without_nan(report), indent=2, allow_nan=False))
    else:
        lines = [line for entry in found for line in offender_lines(entry, replay.iteration)]
        for line in lines or [f"iteration {replay.iteration}: all is finite this time"]:
            echo(line)
    return ExitCode.DONE if found else ExitCode.CHECK_FAILED


def offender_lines(offender: Offender, iteration: int) -> list[str]:
    """One view's offender, in lines."""
    place = "" if offender.pixel is None else f", pixel {offender.pixel}"
    value = f": {_numbers(offender.value)}" if offender.value else ""
    lines = [f"iteration {iteration}, sensor {offender.sensor}{place}", f"  {offender.quantity}{value}"]
    at = offender.where
    if at is not None:
        on = "" if at.surface is None else f", on {at.surface}"
        lines.append(f"  path {at.path} of {at.paths}, samples of {at.samples}, sampler seed {at.seed}")
        lines.append(f"  vertex {at.vertex}, at {_numbers(list(at.position))}{on}")
    if offender.image is not None and offender.target is not None:
        lines.append(f"  image {_numbers(offender.image)}, target {_numbers(offender.target)}")
    return lines


def without_nan(value: Any) -> Any:
    """The same with numbers that are not finite as text, "nan", "inf" and "-inf": JSON has none."""
    if isinstance(value, dict):
        return {key: without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(values: list[float]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in values)})"
