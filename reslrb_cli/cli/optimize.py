"""`reslrb optimize`: from a configuration to recovered parameters."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import click

from reslrb_cli.cli.experiment import experiment_arguments, read_config, start_variant
from reslrb_cli.cli.forecasting import show_forecast
from reslrb_cli.cli.output import echo
from reslrb_cli.config import dump
from reslrb_cli.errors import ExitCode, printable
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.run_folder import RunFolder, check_output

NOTICE = "stopping after this iteration; once more, and it ends at once"


@click.command("optimize")
@experiment_arguments
@click.option("--force", is_flag=True, help="Replace the run folder of that name instead of making a numbered one.")
@click.option(
    "--dry-run",
    is_flag=True,
    help="Print what the run will take, memory and time, by a few small steps, and stop; no run folder is written.",
)
@click.option("--quiet", is_flag=True, help="Print the last line only.")
def command(config_file: Path, overrides: tuple[str, ...], force: bool, dry_run: bool, quiet: bool) -> int:
    """Recover the parameters that CONFIG names from its target images.

    Writes a run folder; the last line says where it is. Ctrl-C, SIGTERM and SIGHUP end the run after the current
    iteration, with its folder complete; a second signal ends it at once.
    """
    if quiet:
        logging.getLogger("reslrb_cli").setLevel(logging.WARNING)
    config = read_config(config_file, overrides)
    check_output(config_file, config.run.output, config.run.folder_name, force)
    variant = start_variant(config)
    if dry_run:
        show_forecast(config)
        return ExitCode.DONE

    from reslrb_cli.backend.device import device_name
    from reslrb_cli.cli.interrupts import Interrupts
    from reslrb_cli.cli.progress import Progress
    from reslrb_cli.cli.recording import Recording
    from reslrb_cli.measure.rival import measure_rival
    from reslrb_cli.optimization import assemble
    from reslrb_cli.optimization.border import warn_of_border
    from reslrb_cli.optimization.correlated_rounds import measure_correlated_bias
    from reslrb_cli.optimization.planning import plan_record
    from reslrb_cli.optimization.views import view_records
    from reslrb_cli.records.pilot_cache import PilotCache
    from reslrb_cli.report.run_table import parameter_lines, terminal_width
    from reslrb_cli.report.verdict import last_line

    logger = logging.getLogger(__name__)
    say = logger.info
    cache = PilotCache()
    problem = assemble(config, say, cache, to_run=True)
    bias = measure_correlated_bias(problem, say)
    if bias is not None and bias.line() is not None:
        logger.warning(bias.line())
    warn_of_border(problem, logger.warning)
    rival = measure_rival(problem, cache, say)
    if rival is not None and rival.is_better:
        logger.warning(f"{rival.line()}; --set integrator.type={rival.integrator}")
    manifest = Manifest(
        variant=variant, device=device_name(variant), seed=config.run.seed, config=printable(config_file)
    )
    manifest.plan = plan_record(problem)
    manifest.views = view_records(problem.views)
    manifest.pilot = None if problem.pilot is None else problem.pilot.to_json()
    manifest.rival = None if rival is None else rival.to_json()
    manifest.correlated_bias = None if bias is None else bias.to_json()
    manifest.memory = None if problem.memory is None else problem.memory.to_json()
    run = config.run
    with (
        Interrupts(notice=None if quiet else NOTICE) as interrupts,
        RunFolder.create(config_file, run.output, run.folder_name, force, dump(config), manifest) as folder,
    ):
        recording = Recording(problem, folder, manifest)
        interrupts.last_act = recording.abandon
        with Progress(run.iterations, quiet, recording.results.meter) as progress:
            status = recording.run(progress.show, lambda: interrupts.requested)
    if not quiet:
        for line in parameter_lines(manifest.results, terminal_width()):
            echo(line)
    tallies = [str(tally) for tally in (recording.nonfinite, recording.clamped) if tally.iterations]
    page = folder.path if "page" in manifest.missing else folder.path / "report.html"
    echo(last_line(status.value, manifest.results, tallies, os.path.relpath(page)))
    return ExitCode.DONE if status is Status.FINISHED else ExitCode.INTERRUPTED
