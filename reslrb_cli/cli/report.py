"""`reslrb report`: a page, a figure or a table about runs and measurements."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import click

from reslrb_cli.cli.options import check_writable
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import ConfigError, ExitCode

#: Maximum number of runs and files on one page, which contains their images.
MOST_SOURCES = 100


@click.command("report")
@click.argument("paths", metavar="RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE",
              help=
        "File to write: a page (.html), a figure (.pdf, .svg, .png) or a table (.csv, .tex). Default for one run "
        "or sweep: its own page.")  # fmt: skip
def command(paths: tuple[Path, ...], output: Path | None) -> int:
    """Write a page, a figure or a table about runs and measurements.

    RUN is a run folder of `optimize`, a folder of a `sweep`, or a file that `bench`, `gradcheck` or `convergence` wrote
    with --json. On a page, several of these follow one another. Unfinished runs are shown up to their last iteration.

    The suffix of FILE selects the output. Figures show error against time for convergences and sweeps, and time and
    memory against depth for benches. Convergences of several depths give efficiency against depth.
    """
    from reslrb_cli.backend.installation import load_packages

    load_packages()  # Mitsuba reads the images
    from reslrb_cli.records.sweeps import PAGE_FILE
    from reslrb_cli.report.publish import write
    from reslrb_cli.report.sources import ShownRun, SweepRuns, read_sources

    if len(paths) > MOST_SOURCES:
        raise ConfigError("RUN", "", f"{len(paths)} are given; a page shows at most {MOST_SOURCES}")
    gc.collect()  # so that unused objects, such as a scene, are not frozen below
    gc.disable()  # Python would search millions of numbers for cycles, again and again
    try:
        sources = read_sources(paths)
    finally:
        gc.enable()
    gc.freeze()
    if output is None:
        if len(sources) != 1 or not isinstance(sources[0], ShownRun | SweepRuns):
            raise ConfigError("--output", "", "is missing; give a file to write, e.g. -o page.html or -o figure.pdf")
        output = sources[0].path / ("report.html" if isinstance(sources[0], ShownRun) else PAGE_FILE)
    check_writable("--output", output)
    write(sources, output, "--output")
    echo(f"look at {os.path.relpath(output)}")
    return ExitCode.DONE
