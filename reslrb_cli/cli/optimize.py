"""`reslrb optimize`: recover the parameters of a configuration, continue a run, or recover further ones of a run.

`--dry-run` prints the forecast of a run (`show_forecast`). `Progress` shows how far a run is.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.options import (
    FOLDER,
    ExperimentOptions,
    allow_code_option,
    optional_experiment_arguments,
    start_variant,
)
from reslrb_cli.cli.terminal import echo, has_room
from reslrb_cli.cluster.connection import Cluster
from reslrb_cli.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from reslrb_cli.config.schema import Config
    from reslrb_cli.optimization.problem import ErrorMeter, Problem
    from reslrb_cli.records.metrics import Record
    from reslrb_cli.runs.callbacks import Callback
    from reslrb_cli.runs.prepare import PreparedRun


def show_forecast(config: Config) -> None:
    """Measure a few steps of `config` and print the expected memory and time of a run's iterations.

    A variant must be set. The function writes only the caches of kernels and decisions. A later run reuses these
    caches.
    """
    from reslrb_cli.measure.missing import check_missing
    from reslrb_cli.optimization.forecast import forecast_lines
    from reslrb_cli.records.decisions import DecisionCache

    say = logger.info
    lines = forecast_lines(config, say, DecisionCache(), lambda problem: check_missing(problem, say, logger.warning)[0])
    for line in [f"forecast of {config.source}; nothing was written", *lines]:
        echo(line)


NOTICE = "stopping after this iteration; a second signal stops at once"
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class OptimizeOptions(ExperimentOptions):
    """The options of the command, by the names of its parameters."""

    dry_run: bool
    free: tuple[str, ...]
    resumed: Path | None
    cluster: str | None
    log: tuple[str, ...]
    quiet: bool

    def config(self) -> Config:
        """Load the configuration, or with `--free` also that of a run, with its values. Raises ConfigError."""
        path = self.config_file
        if path is None or not path.is_dir():
            return super().config()
        from reslrb_cli.records.manifest import read_content
        from reslrb_cli.records.run_folder import recovered

        if self.free:
            return recovered(path, self.overrides).with_code(self.allow_code)
        if read_content(path) is None:
            return super().config()
        reason = f"is the folder of a run; `--resume {path}` continues it, and `{path} --free KEY` starts a new run "
        raise ConfigError(path, "", f"{reason}from its values, which recovers KEY too")


@click.command("optimize")
@optional_experiment_arguments
@click.option(
    "--dry-run",
    is_flag=True,
    help="Measure a few steps, print the memory and time of the iterations, and stop. Writes no run folder.",
)
@click.option(
    "--free",
    multiple=True,
    metavar="KEY",
    help="Recover this parameter of the scene too; `inspect` lists the keys. `response` is the curve of the camera. If "
    "CONFIG is the folder of a run, the new run starts from the values that it found. May be repeated.",
)
@click.option(
    "--resume",
    "resumed",
    type=FOLDER,
    metavar="RUN",
    help="Continue the run in this folder, in place of CONFIG. --set may change iterations and learning rates.",
)
@allow_code_option
@click.option("--cluster", metavar="WHERE", help=
              "Distribute the shards of each step (run.shards) to workers: local:N, N processes on this machine, or "
              "tls://HOST:PORT, the workers of a dask scheduler; the result is that of one process. Needs `pip install "
              "reslrb[cluster]`.")  # fmt: skip
@click.option(
    "--log", multiple=True, metavar="NAME",
    help="Also log the run to tensorboard, mlflow or wandb (`pip install 'reslrb[tensorboard]'`, ...), or to a "
    "callback that another package offers under this name. Adds to run.callbacks. May be repeated.",
)  # fmt: skip
@click.option("--quiet", is_flag=True, help="Print only the last line.")
def command(**given: Any) -> int:
    """Recover the parameters of CONFIG from its target images.

    With --free KEY, CONFIG may also be the folder of a run.

    Writes a run folder. The last line of the output names the folder. Ctrl-C, SIGTERM and SIGHUP end the run after the
    current iteration, with a complete folder. A second signal ends the run at once. --resume RUN continues any run that
    has ended.
    """
    options = OptimizeOptions(**given)
    if options.quiet:
        logging.getLogger("reslrb_cli").setLevel(logging.WARNING)
    workers = None if options.cluster is None else Cluster.parse(options.cluster)
    if options.resumed is not None:
        if options.dry_run:
            raise click.UsageError("--dry-run is for a new run, --resume continues one; give only one of them")
        if options.config_file is not None:
            raise click.UsageError("--resume RUN uses the configuration of the run; leave out CONFIG")
        if options.free:
            run = options.resumed
            raise click.UsageError(f"--free starts a new run, --resume continues one; give `optimize {run} --free KEY`")
        return _resume(options.resumed, options, workers)
    if options.dry_run and workers is not None:
        raise click.UsageError("--dry-run measures only this process; leave out --cluster")
    if options.config_file is None:
        raise click.UsageError("Missing argument 'CONFIG'")
    return _begin(options.config_file, options, workers)


def _check_shards(config: Config, workers: Cluster | None) -> None:
    """Raise ConfigError if `--cluster` is used with only one shard."""
    if workers is not None and config.shards == 1:
        reason = "--cluster needs more than one shard; set run.shards to auto, or to a number above 1"
        raise ConfigError(config.source, "run.shards", reason)


def _begin(config_file: Path, options: OptimizeOptions, workers: Cluster | None) -> int:
    from reslrb_cli.records.run_folder import check_output

    config = options.config()
    _check_shards(config, workers)
    check_output(config_file, config.run.output)
    if workers is not None:
        workers.check()
    variant = start_variant(config)
    if options.free:
        from reslrb_cli.runs.prepare import with_freed

        config = with_freed(config, options.free, "--free")
    callbacks = _callbacks(config, options)
    if options.dry_run:
        show_forecast(config)
        return ExitCode.DONE

    from reslrb_cli.runs.prepare import begin

    return _run(begin(config, variant, logger.info, logger.warning), workers, callbacks, options.quiet)


def _callbacks(config: Config, options: OptimizeOptions) -> list[Callback]:
    """Return the callbacks of `run.callbacks` and `--log`. Raises ConfigError."""
    from reslrb_cli.runs.loggers import callbacks_of

    return callbacks_of(config, options.log, "--log")


def _resume(run: Path, options: OptimizeOptions, workers: Cluster | None) -> int:
    from reslrb_cli.runs.resume import open_earlier

    with open_earlier(run, options.overrides) as earlier:
        if earlier.is_done:
            echo(earlier.done_line("--set", "="))
            return ExitCode.DONE
        earlier.config = config = earlier.config.with_code(options.allow_code)
        _check_shards(config, workers)
        if workers is not None:
            workers.check()
        variant = start_variant(config.model_copy(update={"variant": earlier.settled.variant}))
        callbacks = _callbacks(config, options)
        begun = earlier.begin(variant, logger.info, logger.warning)
        logger.info(f"continuing {run} after {earlier.iteration} of {config.run.iterations} iterations")
        return _run(begun, workers, callbacks, options.quiet)


def _run(begun: PreparedRun, workers: Cluster | None, callbacks: list[Callback], quiet: bool) -> int:
    """Run in the folder. Signals are handled before the folder is created, so the folder always records how the run
    ended.
    """
    if workers is not None:
        from reslrb_cli.cluster.engine import engine_at

        with engine_at(begun.course, workers) as engine:
            begun.course.compute_with(engine)
            return _run(begun, None, callbacks, quiet)
    from reslrb_cli.cli.terminal import Interrupts
    from reslrb_cli.records.manifest import Status
    from reslrb_cli.records.run_folder import link_latest
    from reslrb_cli.records.sweeps import is_sweep
    from reslrb_cli.report.run_summary import free_command, last_line, parameter_lines, terminal_width
    from reslrb_cli.runs.recorder import Recording

    course, manifest = begun.course, begun.manifest
    iterations = course.problem.config.run.iterations
    with Interrupts(notice=None if quiet else NOTICE) as interrupts, begun.place() as place:
        if not course.done and not is_sweep(place.path.parent):
            link_latest(place.path)
        recording = Recording(course, place, manifest, begun.calls(callbacks, place.path), begun.said)
        interrupts.last_act = recording.abandon
        with Progress(iterations, quiet, course.results.meter, course.done, course.problem) as progress:
            status = recording.run(progress.show, lambda: interrupts.requested)
    if not quiet:
        for line in parameter_lines(manifest.results, terminal_width()):
            echo(line)
    kept = course.nonfinite, course.regularized
    tallies = [str(tally) for tally in kept if tally.iterations]
    page = place.path / "report.html"
    echo(last_line(status.value, manifest.results, tallies, os.path.relpath(page if page.exists() else place.path)))
    if not quiet and status is Status.INTERRUPTED:
        echo(f"next: `reslrb optimize --resume {os.path.relpath(place.path)}` continues this run")
    if not quiet and (command := free_command(manifest.content(), os.path.relpath(place.path))):
        echo(f"next: `{command}` starts from these values, and recovers what would reduce the misfit too")
    if not quiet and status is Status.FINISHED and course.problem.config.fabrication is not None:
        echo(f"next: `reslrb export {os.path.relpath(place.path)} -o FOLDER` writes the solid")
    return ExitCode.DONE if status is Status.FINISHED else ExitCode.INTERRUPTED


#: Without a terminal, a line is written after each tenth of the iterations and after this many seconds.
SECONDS_PER_LINE = 10.0

#: Format of the bar, and the columns that it needs besides the text `desc` and the remaining time. The end of a longer
#: line is cut off.
BAR, BAR_COLUMNS = "{percentage:3.0f}%|{bar}| {desc}, {n_fmt}/{total_fmt}{postfix}", 28
#: Newest iterations from which the remaining time is estimated.
RECENT = 64


class Progress:
    """Progress of a run with `total` iterations on standard error: a bar on a terminal that has a width, plain lines
    otherwise.

    As a context manager, `Progress` closes the bar at the end. `done` iterations were finished before the run was
    resumed. `meter` measures the errors of the parameters. `problem` tells which iterations measure curvature, and the
    time limit.
    """

    def __init__(
        self, total: int, quiet: bool, meter: ErrorMeter, done: int = 0, problem: Problem | None = None
    ) -> None:
        self._stream = sys.stderr
        self._quiet = quiet or self._stream is None  # the program was started without one
        self._total, self._meter, self._problem = total, meter, problem
        self._records: deque[Record] = deque(maxlen=RECENT)
        self._before_s = 0.0  # `elapsed_s` before these records
        self._bar: Any = None
        self._last_line, self._tenth = time.monotonic(), 10 * done // total
        if not self._quiet and has_room(self._stream):
            from tqdm import tqdm

            self._bar = tqdm(
                total=total, initial=done, file=self._stream, unit="it", dynamic_ncols=True, bar_format=BAR
            )

    def show(self, record: Record) -> None:
        """Show that the iteration of `record` is done. A closed terminal does not end the run."""
        from reslrb_cli.report.run_summary import descriptions

        if self._quiet:
            return
        texts, done, now = descriptions(record, self._meter), record.iteration + 1, time.monotonic()
        with contextlib.suppress(OSError):
            if self._bar is not None:
                left = self._left(record)
                room = (self._bar.format_dict["ncols"] or 0) - BAR_COLUMNS - len(left)
                self._bar.set_description_str(next((t for t in texts if len(t) <= room), texts[-1]), refresh=False)
                self._bar.set_postfix_str(left, refresh=False)
                self._bar.update()
                if done == self._total:  # no iterations follow
                    self._bar.close()
            elif 10 * done // self._total != self._tenth or now - self._last_line >= SECONDS_PER_LINE:
                self._tenth, self._last_line = 10 * done // self._total, now
                click.echo(f"{done}/{self._total}: {texts[0]}, {record.elapsed_s:.1f} s", file=self._stream)

    def _left(self, record: Record) -> str:
        """Return the time that the remaining iterations will take, as the forecast of a run estimates it."""
        from reslrb_cli.optimization.forecast import IterationTimes

        if len(self._records) == RECENT:
            self._before_s = self._records[0].elapsed_s
        elif not self._records and record.iteration:
            self._before_s = record.elapsed_s - record.step_ms / 1e3 - record.curvature_s
        self._records.append(record)
        optimizer = None if self._problem is None else self._problem.optimizer
        times = IterationTimes.of(list(self._records), optimizer, self._before_s)
        left_s = times.seconds(record.iteration + 1, self._total)
        if self._problem is not None and self._problem.limit_s is not None:
            left_s = max(min(left_s, self._problem.limit_s - record.elapsed_s), 0.0)
        most = "at most " if optimizer is not None and optimizer.measures_curvature else ""
        return f"{most}{self._bar.format_interval(left_s)} left"

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            with contextlib.suppress(OSError):
                self._bar.close()
