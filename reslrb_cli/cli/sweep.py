"""`reslrb sweep`: run an experiment with several settings and seeds, and tabulate the results.

A search chooses the settings of each run by the results of earlier runs. `jobs.py` has the processes of the runs.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.jobs import Jobs, call
from reslrb_cli.cli.options import (
    COUNT,
    FOLDER,
    allow_code_option,
    is_given,
    optional_experiment_arguments,
)
from reslrb_cli.cli.terminal import Interrupts, echo
from reslrb_cli.errors import BackendError, ExitCode, MachineError

if TYPE_CHECKING:
    from reslrb_cli.records.metrics import Line
    from reslrb_cli.records.sweeps import Combination, SweepPlan
    from reslrb_cli.report.sources import SweepRuns

NOTICE = "stopping after this iteration of the current runs; a second signal stops at once"

#: Minimum time between two pages, as a multiple of the time for the last page, because runs wait for it.
PAGE_SHARE = 5.0


@dataclass(frozen=True)
class SweepOptions:
    """The options of `sweep`, by the names of their parameters."""

    config_file: Path | None
    overrides: tuple[str, ...]
    vary: tuple[str, ...]
    seeds: int | None
    search: str | None
    trials: int | None
    jobs: int
    folder: Path | None
    resumed: Path | None
    allow_code: bool


@click.command("sweep")
@optional_experiment_arguments
@click.option(
    "--vary",
    multiple=True,
    metavar="KEY=[VALUE, ...]",
    help="Setting to vary, as for --set, and a list of its values in YAML. If repeated, all combinations are "
    "run. A value of `integrator` may be TYPE[:ESTIMATOR][(OPTION=VALUE,...)]. With --search, also a range: "
    "KEY={low: 0.01, high: 0.3, log: true}.",
)
@click.option(
    "--seeds",
    type=COUNT,
    metavar="N",
    help="Number of runs of each combination, with seeds from run.seed on. Default: 1, or that of the sweep.",
)
@click.option(
    "--search",
    type=click.Choice(["optuna"]),
    help="Search for the best values, in place of all combinations: Optuna chooses them by the results so far.",
)
@click.option("--trials", type=COUNT, metavar="N", help="Number of combinations that a search tries.")
@click.option(
    "--jobs",
    type=COUNT,
    default=1,
    show_default=True,
    metavar="N",
    help="Number of runs at the same time, if cores, memory and GPUs suffice.",
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
def command(**given: Any) -> int:
    """Run the experiment of CONFIG with several seeds for every combination of settings, and compare the results.

    Each run has a folder in FOLDER. The folder's name shows the run's settings. FOLDER/sweep.html has the table, curves
    and pictures, and FOLDER/results.jsonl the results of every run and combination. All combinations are checked before
    the first run starts. If a run fails, the run's table row shows the failure, and the other runs continue. Ctrl-C
    ends the sweep after the current iteration. To continue a sweep, even after a kill, use --resume FOLDER. This also
    repeats failed runs.

    With --search, a trial is one combination. The best trial has the lowest error of the parameters if the true values
    are known, otherwise the lowest final loss. --resume FOLDER continues with the trials so far, and --trials adds
    more. Failed trials are not repeated.
    """
    from reslrb_cli.runs.search import check_search
    from reslrb_cli.runs.sweep import make_plan, resumed, started

    options = SweepOptions(**given)
    seeds, trials = options.seeds, options.trials
    if options.resumed is not None:
        if any(map(is_given, ("config_file", "overrides", "vary", "folder", "search"))):
            more = "--seeds, --trials, --jobs or --allow-code"
            raise click.UsageError(f"--resume continues a sweep with its own settings; add only {more}")
        folder, place = options.resumed, resumed(options.resumed, seeds, options.allow_code, trials)
    elif options.config_file is None:
        raise click.UsageError("Missing argument 'CONFIG'")
    else:
        if (options.search is None) != (trials is None):
            raise click.UsageError("a search needs both --search optuna and --trials N")
        path, overrides = options.config_file, options.overrides
        plan = make_plan(path, options.vary, seeds or 1, overrides, options.allow_code, trials)
        if trials is not None:
            check_search(plan)
        run = next(iter(plan.configs.values())).run
        folder = options.folder or run.output / f"{run.folder_name}-sweep"
        place = started(folder, plan)
    with place as sweep:
        return _run(folder, sweep, options.jobs)


def _run(folder: Path, sweep: SweepPlan, number: int) -> int:
    """Run the remaining runs of the sweep, at most `number` at once. Update its page and its results, and print the
    results.
    """
    from reslrb_cli.backend.installation import load_packages
    from reslrb_cli.backend.variant import choose
    from reslrb_cli.config.loader import load

    load_packages()  # Mitsuba reads the images
    from reslrb_cli.records.measurement_files import LivePage, write_lines
    from reslrb_cli.records.sweeps import PAGE_FILE, RESULTS_FILE, config_file, label
    from reslrb_cli.report.page import write_page
    from reslrb_cli.report.page.sweep import FIGURES, lines, objective, ranked, run_records
    from reslrb_cli.report.sources import read_sweep_runs
    from reslrb_cli.runs.search import Remaining
    from reslrb_cli.runs.sweep import command as command_of

    def write(live: bool = True) -> SweepRuns:
        source = read_sweep_runs(folder)
        write_page([source], folder / PAGE_FILE, live=live)
        write_lines(folder / RESULTS_FILE, _results(source))
        return source

    page = LivePage(write, "the sweep's page", PAGE_SHARE)
    remaining = Remaining(folder, sweep)
    again = f"`reslrb sweep --resume {os.path.relpath(folder)}`"
    go_on = f"{again} continues"

    def start(name: str, combination: Combination, seed: int) -> None:
        config = load(config_file(folder, combination))
        place = f"run {remaining.number(name)} of {remaining.sweep.size}"
        echo(f"{place}: {label(combination.settings)}, seed {seed}")
        arguments = command_of(folder, remaining.sweep, combination, seed)
        fresh = config.run.max_seconds is not None
        jobs.start(name, lambda slot: call(arguments, interrupts, slot, fresh))

    variant = choose(remaining.variant)[0] if number > 1 else ""
    with Interrupts(notice=NOTICE) as interrupts, Jobs(number, variant) as jobs:
        interrupts.last_act = jobs.end
        if jobs.number < number:
            echo(f"{jobs.number} runs at once: this machine has no more GPUs, or cores")
        while True:
            while jobs.may_start() and not interrupts.requested and (run := remaining.next()) is not None:
                page.refresh()
                start(*run)
            if not jobs.busy:
                break
            for name, (code, line) in jobs.ended():
                if code == ExitCode.INTERRUPTED or (interrupts.requested and code != ExitCode.DONE):
                    interrupts.requested = True  # a run that was interrupted alone also ends the sweep
                    continue
                if code == ExitCode.MACHINE:
                    raise MachineError(f"{line}; {go_on}")
                if code == ExitCode.BACKEND:
                    raise BackendError(line)
                echo(f"  {name}: {line}" if jobs.number > 1 else f"  {line}")
                remaining.end(name, code, line)
        sweep, records = remaining.sweep, run_records(write(live=False))
    for line in lines(sweep, records):
        echo(line)
    done, failed = sum(run.is_done for run in records), sum(run.status == "failed" for run in records)
    interrupted = interrupts.requested and done + failed < sweep.size
    if sweep.search and not interrupted and len(sweep.combinations) < sweep.search.trials:
        echo(f"the search ends after {len(sweep.combinations)} trials: it finds no further combinations")
    if of := sweep.search and objective(sweep, records):
        best = config_file(folder, ranked(sweep, records).combinations[0])
        echo(f"the best trial by {FIGURES[of]}: {os.path.relpath(best)}")
    ended = "interrupted" if interrupted else "finished"
    more = f"; {again} repeats the failed runs" if failed and not sweep.search else ""
    more = f"; {go_on}" if interrupted else more
    which = f"{done} of {len(records)} runs done" + (f", {failed} failed" if failed else "")
    echo(f"{ended}, {which}; look at {os.path.relpath(folder / PAGE_FILE)}{more}")
    if interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.CHECK_FAILED if failed and not (sweep.search and done) else ExitCode.DONE


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
