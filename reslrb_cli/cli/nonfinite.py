"""`reslrb inspect --nonfinite`: find the first value of a run that is not finite."""

from __future__ import annotations

import dataclasses
import json
import logging
from typing import TYPE_CHECKING

import click

from reslrb_cli.cli.terminal import echo
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, ExitCode
from reslrb_cli.records.checkpoint import NONFINITE_FILE_NAME
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.metrics import finite
from reslrb_cli.records.run_folder import RunFolder

if TYPE_CHECKING:
    from reslrb_cli.measure.nonfinite_trace import Offender


OPTION = "--nonfinite"


def show_offenders(config: Config, as_json: bool) -> int:
    """Print the origin of the run's first value that is not finite; return exit code 1 if all values are finite now."""
    run = config.source.parent
    if read_manifest(run) is None:
        raise ConfigError(config.source, OPTION, "is not in a run folder; give the config.yaml of a run")
    if not (RunFolder(run).checkpoint / NONFINITE_FILE_NAME).exists():
        raise ConfigError(config.source, OPTION, "all values of this run were finite")
    if config.codes:
        raise ConfigError(config.source, OPTION, f"does not run your own code, which {next(iter(config.codes))} names")
    from reslrb_cli.measure.nonfinite_trace import find_offenders
    from reslrb_cli.runs.resume import problem_before_nonfinite

    problem, iteration = problem_before_nonfinite(run, logging.getLogger(__name__).info)
    found = find_offenders(problem, iteration)
    if as_json:
        report = {"iteration": iteration, "offenders": [dataclasses.asdict(entry) for entry in found]}
        click.echo(json.dumps(finite(report, str), indent=2, allow_nan=False))
    else:
        lines = [line for entry in found for line in offender_lines(entry, iteration)]
        for line in lines or [f"iteration {iteration}: all values are finite now"]:
            echo(line)
    return ExitCode.DONE if found else ExitCode.CHECK_FAILED


def offender_lines(offender: Offender, iteration: int) -> list[str]:
    """Return lines about the first value of one view that is not finite."""
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


def _numbers(values: list[float]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in values)})"
