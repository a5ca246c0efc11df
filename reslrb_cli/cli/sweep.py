"""`reslrb sweep`: run an experiment with several settings and seeds, one run after the other, and tabulate the results.

Each run is `reslrb optimize` in its own process, so runs do not share memory, kernels or failures. If the sweep is
killed, `follow` ends its current run, so the sweep can be continued at once.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from reslrb_cli.backend.installation import python_command
from reslrb_cli.cli.options import (
    COUNT,
    FOLDER,
    allow_code_option,
    is_given,
    optional_experiment_arguments,
)
from reslrb_cli.cli.terminal import Interrupts, echo
from reslrb_cli.errors import BackendError, ExitCode, MachineError, one_line
from reslrb_cli.measure.processes import last_words
from reslrb_cli.report.format import shorten

if TYPE_CHECKING:
    from reslrb_cli.records.metrics import Line
    from reslrb_cli.records.sweeps import SweepPlan
    from reslrb_cli.report.sources import SweepRuns

logger = logging.getLogger(__name__)
NOTICE = "stopping after this iteration of the current run; a second signal stops at once"

#: Maximum wait, in seconds, for the end of a run that must end at once.
END_SECONDS = 5.0

_POLL_SECONDS = 0.1

#: Minimum time between two pages, as a multiple of the time for the last page, because runs wait for it.
PAGE_SHARE = 5.0

#: Number of last bytes of a run's output in which its error is searched; start of a line of progress.
MOST_BYTES, _PROGRESS = 1 << 14, re.compile(r"\d+/\d+: ")

#: The program, in a process that ends with this one.
_PROGRAM = "sys.argv[0] = 'reslrb'; from reslrb_cli.cli.sweep import follow; follow()"


@click.command("sweep")
@optional_experiment_arguments
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=[VALUE, ...]",
    help="Setting to vary, as for --set, and a list of its values in YAML. If repeated, all combinations are "
    "run. A value of `integrator` may be TYPE[:ESTIMATOR][(OPTION=VALUE,...)].",
)
@click.option(
    "--seeds",
    type=COUNT,
    metavar="N",
    help="Number of runs of each combination, with seeds from run.seed on. Default: 1, or that of the sweep.",
)
@click.option(
    "-o",
    "--output",
    "folder",
    type=FOLDER,
    metavar="FOLDER",
    help="Folder of the sweep. Default: that of a run, with -sweep after its name.",
)
@click.option(
    "--resume",
    "resumed",
    type=FOLDER,
    metavar="FOLDER",
    help="Continue the sweep in this folder, in place of CONFIG.",
)
@allow_code_option
def command(
    config_file: Path | None,
    overrides: tuple[str, ...],
    vary: tuple[str, ...],
    seeds: int | None,
    folder: Path | None,
    resumed: Path | None,
    allow_code: bool,
) -> int:
    """Run the experiment of CONFIG with several seeds for every combination of settings, one run after the other.

    Each run has a folder in FOLDER. The folder's name shows the run's settings. FOLDER/sweep.html has the table, curves
    and pictures, and FOLDER/results.jsonl the results of every run and combination. All combinations are checked before
    the first run starts. If a run fails, the run's table row shows the failure, and the other runs continue. Ctrl-C
    ends the sweep after the current iteration. To continue a sweep, even after a kill, use --resume FOLDER. This also
    repeats failed runs.
    """
    from reslrb_cli.runs.sweep import make_plan, started
    from reslrb_cli.runs.sweep import resumed as resumed_sweep

    if resumed is not None:
        given = [name for name in ("config_file", "overrides", "vary", "folder") if is_given(name)]
        if given:
            raise click.UsageError("--resume continues a sweep with its own settings; add only --seeds or --allow-code")
        folder, place = resumed, resumed_sweep(resumed, seeds, allow_code)
    elif config_file is None:
        raise click.UsageError("Missing argument 'CONFIG'")
    else:
        plan = make_plan(config_file, vary, seeds or 1, overrides, allow_code)
        run = next(iter(plan.configs.values())).run
        folder = folder or run.output / f"{run.folder_name}-sweep"
        place = started(folder, plan)
    with place as sweep:
        return _run(folder, sweep)


def _run(folder: Path, sweep: SweepPlan) -> int:
    """Run the remaining runs of the sweep, update its page and its results, and print the results."""
    from reslrb_cli.backend.installation import load_packages
    from reslrb_cli.config.loader import load

    load_packages()  # Mitsuba reads the images
    from reslrb_cli.records.measurement_files import LivePage, write_lines
    from reslrb_cli.records.sweeps import PAGE_FILE, RESULTS_FILE, Failure, config_file, label, run_name
    from reslrb_cli.report.page import write_page
    from reslrb_cli.report.page.sweep import lines, run_records
    from reslrb_cli.report.sources import read_sweep_runs
    from reslrb_cli.runs.sweep import command as command_of
    from reslrb_cli.runs.sweep import is_left

    def write(live: bool = True) -> SweepRuns:
        source = read_sweep_runs(folder)
        write_page([source], folder / PAGE_FILE, live=live)
        write_lines(folder / RESULTS_FILE, _results(source))
        return source

    page = LivePage(write, "the sweep's page", PAGE_SHARE)
    runs, interrupted = list(sweep.runs), False
    again = f"`reslrb sweep --resume {os.path.relpath(folder)}`"
    go_on = f"{again} continues"
    with Interrupts(notice=NOTICE) as interrupts:
        for number, (combination, seed) in enumerate(runs, 1):
            name = run_name(combination, seed)
            if not is_left(folder, sweep, name):
                continue
            page.refresh()
            if interrupted := interrupts.requested:
                break
            echo(f"run {number} of {len(runs)}: {label(combination.settings)}, seed {seed}")
            timed = load(config_file(folder, combination)).run.max_seconds is not None
            code, line = call(command_of(folder, sweep, combination, seed), interrupts, fresh=timed)
            if interrupted := code == ExitCode.INTERRUPTED or (interrupts.requested and code != ExitCode.DONE):
                break
            if code == ExitCode.MACHINE:
                raise MachineError(f"{line}; {go_on}")
            if code == ExitCode.BACKEND:
                raise BackendError(line)
            echo(f"  {line}")
            if code != ExitCode.DONE:
                sweep = replace(sweep, failures={**sweep.failures, name: Failure(code, one_line(line))})
                sweep.write(folder)
        records = run_records(write(live=False))
    for line in lines(sweep, records):
        echo(line)
    done, failed = sum(run.is_done for run in records), sum(run.status == "failed" for run in records)
    ended = "interrupted" if interrupted else "finished"
    more = f"; {go_on}" if interrupted else f"; {again} repeats the failed runs" if failed else ""
    which = f"{done} of {len(records)} runs done" + (f", {failed} failed" if failed else "")
    echo(f"{ended}, {which}; look at {os.path.relpath(folder / PAGE_FILE)}{more}")
    if interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.CHECK_FAILED if failed else ExitCode.DONE


def _results(source: SweepRuns) -> list[Line]:
    """Return the lines of `results.jsonl`: the device, the results of runs and combinations, and the best
    combinations.
    """
    from reslrb_cli.records.measurement_files import Origin
    from reslrb_cli.report.page.sweep import best_records, row_records, run_records

    manifest: dict[str, Any] = dict(next(iter(source.runs.values())).manifest) if source.runs else {}
    origin = Origin(str(manifest.get("device", "")), str(manifest.get("variant", "")))
    runs = run_records(source)
    return [origin, *runs, *row_records(source.sweep, runs), *best_records(source.sweep, runs)]


# --- one run, in a process of its own ---------------------------------------------------------------------------------


def call(arguments: Sequence[str], interrupts: Interrupts, fresh: bool = False) -> tuple[int, str]:
    """Run `reslrb` with these arguments in its own process. Returns its exit code and its last line.

    The first signal in `interrupts` is passed on to the process. A second signal ends the run's process together with
    this process. The run folder contains the warnings of the process. A `fresh` process has no cached kernels or
    decisions. Runs with equal time limits therefore start under equal conditions.
    """
    environment = dict(os.environ)
    with (
        tempfile.TemporaryDirectory(prefix="reslrb-sweep-", ignore_cleanup_errors=True) as folder,
        tempfile.TemporaryFile() as output,
    ):
        if fresh:
            environment |= dict.fromkeys(("DRJIT_CACHE_DIR", "OPTIX_CACHE_PATH", "RESLRB_CACHE"), folder)
            environment["CUDA_CACHE_DISABLE"] = "1"
        process = subprocess.Popen(
            [*python_command(_PROGRAM), *arguments],
            stdin=subprocess.PIPE,  # closes when this process ends
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=environment,
        )
        interrupts.last_act = lambda: _end(process)
        told, code = False, None
        try:
            while code is None:
                if interrupts.requested and not told:
                    process.terminate()
                    told = True
                with contextlib.suppress(subprocess.TimeoutExpired):
                    code = process.wait(_POLL_SECONDS)
                _show(next(filter(_PROGRESS.match, reversed(_last_lines(output))), ""))
        finally:
            interrupts.last_act = lambda: None
            _show("")
            process.kill()
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
        said = _last_lines(output)
    if code < 0:
        name = signal.Signals(-code).name
        memory = " (often sent when memory runs out)" if -code == signal.SIGKILL else ""
        return (ExitCode.INTERRUPTED if told else code), f"ended by {name}{memory}: {last_words(chr(10).join(said))}"
    return code, said[-1] if said else f"ended with exit code {code}, without a message"


def _last_lines(output: IO[bytes]) -> list[str]:
    """Return the last lines of a run's `output`. `pread` leaves the file offset alone, which the run writes at."""
    start = max(os.fstat(output.fileno()).st_size - MOST_BYTES, 0)
    text = os.pread(output.fileno(), MOST_BYTES, start).decode(errors="replace")
    return [line for line in text.splitlines() if line.strip()]


def _show(line: str) -> None:
    """Show the progress of a run in place of the terminal's last line. Without a terminal, show nothing."""
    if sys.stderr.isatty():
        text = shorten(f"  {line}" if line else "", shutil.get_terminal_size().columns - 1)
        click.echo(f"\r\x1b[K{text}", err=True, nl=False)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a run's process at once with a repeated signal. The run's manifest then records the end."""
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGTERM)
        process.wait(END_SECONDS)
    with contextlib.suppress(OSError):
        process.kill()


def follow() -> None:
    """Run the program `reslrb` in a process that ends when its standard input closes. The end of the sweep closes this
    input, even if the sweep is killed.
    """

    def end_with_input() -> None:
        os.read(0, 1)
        os._exit(ExitCode.INTERRUPTED)

    threading.Thread(target=end_with_input, daemon=True).start()
    from reslrb_cli.cli import run

    run()
