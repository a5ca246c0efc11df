"""`reslrb gradcheck --missing`: what of a scene's derivatives is in no attached gradient."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from reslrb_cli.cli.output import echo
from reslrb_cli.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from reslrb_cli.config import Config
    from reslrb_cli.records.missing import MissingRecord

#: Options that say something about comparisons, of which there is none.
FOREIGN = {"suite": "--suite", "cases": "--case", "estimators": "--estimators", "markdown_file": "--markdown",
           "folder": "--images"}  # fmt: skip


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
    resumed: Path | None,
) -> int:
    """Measure, print and write; returns the exit code. `variant` must be set."""
    from reslrb_cli.backend.device import device_name
    from reslrb_cli.cli.interrupts import Interrupts
    from reslrb_cli.cli.keeping import Keeper, read_earlier
    from reslrb_cli.cli.measured import origin_of
    from reslrb_cli.measure.earlier import Earlier, settings
    from reslrb_cli.measure.missing_check import KIND, MissingCheck

    to_keep = settings(config, variant, device_name(variant), spp=spp, directions=along)
    earlier = None
    if resumed is not None:
        earlier = Earlier(KIND, resumed, *read_earlier(resumed))
        earlier.check(to_keep)
    check = MissingCheck(config, budget, seeds, spp, along, earlier)
    echo(check.conditions())
    records: list[MissingRecord] = []
    keeper = Keeper(
        json_file,
        origin_of(variant),
        lambda: records,
        lambda: check.known()[len(records) :],
        lambda: check.kept(to_keep),
    )
    with Interrupts() as interrupts:
        for record in check.run(lambda: interrupts.requested, keeper.refresh):
            records.append(record)
            echo(record.line())
        keeper.finish(check.known())
        return ExitCode.INTERRUPTED if interrupts.requested else ExitCode.DONE
