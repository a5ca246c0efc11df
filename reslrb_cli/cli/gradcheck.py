"""`reslrb gradcheck`: whether the gradients of a scene can be trusted."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.experiment import COUNT, allowance, check_writable, optional_experiment_arguments, resume_option
from reslrb_cli.cli.missing import refuse_comparisons, run_missing
from reslrb_cli.cli.output import echo
from reslrb_cli.cli.suite import refuse_foreign, run_suite_command
from reslrb_cli.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from reslrb_cli.measure.gradcheck import Gradcheck, Result
    from reslrb_cli.records.gradcheck import GradcheckRecord

logger = logging.getLogger(__name__)


@click.command("gradcheck")
@optional_experiment_arguments
@click.option("--suite", type=click.Choice(["extreme"]),
              help="Run scenes of its own in place of CONFIG: extreme, those in which gradients break.")  # fmt: skip
@click.option("--case", "cases", multiple=True, metavar="NAME", help="Run this case of the suite; may be repeated.")
@click.option("--estimators", metavar="LIST",
              help="What to check: ESTIMATOR[(OPTION=VALUE,...)], separated by commas. Default: all four, with the "
                   "options of CONFIG.")  # fmt: skip
@click.option("--budget", type=click.FloatRange(min=0), default=45.0, show_default=True, metavar="SECONDS",
              help="Time for the whole, loading and compiling included; it decides how many seeds there are. What it "
                   "does not suffice for is named, with what it would take.")  # fmt: skip
@click.option("--seeds", type=click.IntRange(min=3, max=COUNT.max), metavar="N",
              help="Number of seeds, whatever time they take, those of --resume included.")  # fmt: skip
@resume_option
@click.option("--spp", type=COUNT,
              help="Samples per pixel of one gradient. Default: 65536 light paths, no more than run.spp.")  # fmt: skip
@click.option("--missing", is_flag=True,
              help="Measure instead what no gradient of this kind has: the share of each parameter's derivative that "
                   "silhouettes, edges of shadows and light that leaves the film make up.")  # fmt: skip
@click.option("--directions", type=click.IntRange(min=1, max=64), metavar="N",
              help="With --missing: along how many directions of each parameter. Default: 3.")  # fmt: skip
@click.option("--json", "json_file", type=click.Path(path_type=Path, dir_okay=False),
              help="Write one object a line, one for each comparison.")  # fmt: skip
@click.option("--markdown", "markdown_file", type=click.Path(path_type=Path, dir_okay=False),
              help="Write the table as Markdown.")  # fmt: skip
@click.option("--images", "folder", type=click.Path(path_type=Path, file_okay=False),
              help="Write maps of the gradients of textures, their references and z into this folder, as PNG and as "
                   "layers of EXR files.")  # fmt: skip
@click.pass_context
def command(
    context: click.Context,
    config_file: Path | None,
    overrides: tuple[str, ...],
    suite: str | None,
    cases: tuple[str, ...],
    estimators: str | None,
    budget: float,
    seeds: int | None,
    resumed: Path | None,
    spp: int | None,
    missing: bool,
    directions: int | None,
    json_file: Path | None,
    markdown_file: Path | None,
    folder: Path | None,
) -> int:
    """Compare the gradients of every parameter of CONFIG with references, at its initial values.

    Each estimator is compared with naive AD of the same paths (walk_ad), with a stock integrator where one counts as a
    reference (ptracer, else prb), with finite differences, with forward mode, and with the exact value where the scene
    is known to have one. Without CONFIG the scene is a Cornell box (--set scene.options.size=64, ...). The exit code is
    1 where a comparison fails; the last lines say which, and by how much. docs/gradcheck.md explains the columns.
    """
    began = time.monotonic()
    from reslrb_cli.backend.device import device_name
    from reslrb_cli.backend.installation import load_packages
    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.cli.keeping import read_earlier
    from reslrb_cli.config import load, loads

    load_packages()  # before what follows asks for them
    from reslrb_cli.measure import cornell_box
    from reslrb_cli.measure.cases import all_estimators, parse_estimators
    from reslrb_cli.measure.earlier import Earlier
    from reslrb_cli.measure.gradcheck import Gradcheck
    from reslrb_cli.measure.gradcheck_resuming import KIND
    from reslrb_cli.measure.gradcheck_resuming import settings as settings_to_keep
    from reslrb_cli.measure.participants import Settings
    from reslrb_cli.records.gradcheck import Verdict

    if missing:
        refuse_comparisons(context)
    elif directions is not None:
        raise ConfigError("--directions", "", "goes with --missing alone")
    json_file = json_file or resumed
    check_writable("--json", json_file)
    check_writable("--markdown", markdown_file)
    if suite is not None:
        refuse_foreign(context)
        return run_suite_command(cases, estimators, seeds, json_file, markdown_file, resumed)
    if cases:
        raise ConfigError("--case", "", "names a case of a suite; take --suite extreme with it")
    if config_file is None:
        config = loads(cornell_box.CONFIG, cornell_box.SOURCE, overrides)
    else:
        config = load(config_file, overrides)
    if missing:
        variant = set_variant(config.variant)
        echo(f"{device_name(variant)}, {variant}")
        return run_missing(config, variant, budget, seeds, spp, directions, json_file, resumed)
    listed = all_estimators(config) if estimators is None else parse_estimators(estimators)
    _check_folder(folder)
    settings = Settings(config, listed, budget, seeds, spp, estimators is not None, time.monotonic() - began)
    settings.configs()  # before anything is loaded
    variant = set_variant(config.variant)
    to_keep = settings_to_keep(settings, variant, device_name(variant))
    earlier = None if resumed is None else Earlier(KIND, resumed, *read_earlier(resumed))
    if earlier is not None:
        earlier.check(to_keep)
    check = Gradcheck(settings, earlier=earlier)
    echo(f"{device_name(variant)}, {variant}; {allowance(budget, seeds, 'seed')}")
    echo(check.conditions())
    records, interrupted = _run(check, variant, to_keep, json_file, folder)
    _finish(records, markdown_file)
    if interrupted:
        return ExitCode.INTERRUPTED
    nothing = all(record.verdict in (Verdict.NOT_MEASURED, Verdict.NO_REFERENCE) for record in records)
    failed = nothing or any(record.holds is False for record in records)
    return ExitCode.CHECK_FAILED if failed else ExitCode.DONE


def _run(
    check: Gradcheck, variant: str, to_keep: dict[str, Any], json_file: Path | None, folder: Path | None
) -> tuple[list[GradcheckRecord], bool]:
    """Measure, print and write; returns all records, and whether the user interrupted."""
    from reslrb_cli.cli.interrupts import Interrupts
    from reslrb_cli.cli.keeping import Keeper
    from reslrb_cli.cli.measured import origin_of
    from reslrb_cli.records.gradcheck import Verdict
    from reslrb_cli.report.gradcheck_table import Table

    records: list[GradcheckRecord] = []
    drawn = False
    keeper = Keeper(json_file, origin_of(variant), lambda: records, lambda: [], lambda: check.kept(to_keep))
    with Interrupts() as interrupts:
        table = Table(check.expected())
        echo(table.head())
        for result in check.run(lambda: interrupts.requested, logger.info, keeper.refresh):
            records.append(result.record)
            keeper.refresh()
            if result.record.verdict is not Verdict.NOT_MEASURED:  # the last lines say how many there are
                echo(table.line(result.record))
            _draw(result, folder)
            drawn = drawn or result.maps is not None
        keeper.finish(records)
    if folder is not None and drawn:
        echo(f"look at {os.path.relpath(folder)}")
    return records, interrupts.requested


def _draw(result: Result, folder: Path | None) -> None:
    if folder is None or result.maps is None:
        return
    from reslrb_cli.report.gradcheck_maps import plot_maps

    folder.mkdir(parents=True, exist_ok=True)
    plot_maps(result.record, result.maps.gradient, result.maps.reference, result.maps.z, folder)


def _finish(records: list[GradcheckRecord], markdown_file: Path | None) -> None:
    """Print what it comes to, and write the Markdown table."""
    from reslrb_cli.report.gradcheck_table import markdown_table, summary_lines

    for line in summary_lines(records) if records else ["interrupted before there were enough seeds to compare"]:
        echo(line)
    if markdown_file is not None:
        markdown_file.write_text(markdown_table(records), encoding="utf-8")


def _check_folder(folder: Path | None) -> None:
    """Raise ConfigError where maps could not be written."""
    if folder is None:
        return
    above = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise ConfigError("--images", "", f"cannot write into {above}")
