"""`reslrb gradcheck --missing`: what of a scene's derivatives is in no attached gradient."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from reslrb_cli.cli.output import echo
from reslrb_cli.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from reslrb_cli.config import Config

#: Options that say something about comparisons, of which there is none.
FOREIGN = {"suite": "--suite", "cases": "--case", "estimators": "--estimators", "markdown_file": "--markdown",
           "folder": "--images", "resumed": "--resume"}  # fmt: skip


def refuse_comparisons(context: click.Context) -> None:
    """Raise ConfigError where an option of the command has no part in this."""
    for name, option in FOREIGN.items():
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise ConfigError(option, "", "does not go with --missing, which compares no estimators; leave out one")
    if context.params["config_file"] is None:
        raise ConfigError("--missing", "", "needs a CONFIG, whose parameters and loss it looks at")


def run_missing(
    config: Config,
    variant: str,
    budget: float,
    seeds: int | None,
    spp: int | None,
    along: int | None,
    json_file: Path | None,
) -> int:
    """Measure, print and write; returns the exit code. `variant` must be set."""
    from reslrb_cli.cli.interrupts import Interrupts
    from reslrb_cli.cli.measured import measured_lines
    from reslrb_cli.measure.missing_check import MissingCheck

    check = MissingCheck(config, budget, seeds, spp, along)
    echo(check.conditions())
    with ExitStack() as stack:
        writer = None if json_file is None else stack.enter_context(measured_lines(json_file, variant))
        interrupts = stack.enter_context(Interrupts())
        for record in check.run(lambda: interrupts.requested):
            if writer is not None:
                writer.write(record)
            echo(record.line())
        return ExitCode.INTERRUPTED if interrupts.requested else ExitCode.DONE
