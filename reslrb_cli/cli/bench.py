"""`reslrb bench`: time and memory of gradient steps against path depth."""

from __future__ import annotations

import logging
import os
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.options import (
    COUNT,
    Counts,
    allowance,
    check_writable,
    is_given,
    optional_experiment_arguments,
    resume_option,
)
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from reslrb_cli.config.schema import Config
    from reslrb_cli.measure.bench import Book, Result
    from reslrb_cli.measure.methods import Sweep
    from reslrb_cli.records.measurements import BenchRecord, BenchStatus


#: What is compared where the user names nothing.
INTEGRATORS = "ptracer,reslrb:reservoir,reslrb:event,reslrb:gather,reslrb:stack,trajectory"
_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30}


class Size(click.ParamType):
    """A number of bytes such as `2GiB`."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(|k|M|G|Ki|Mi|Gi)B?", str(value).strip())
        size = 0.0 if match is None else float(match[1]) * _UNITS[match[2]]
        if not 1 <= size < 2**63:
            self.fail(f"`{value}` is no size; write it as in 2GiB or 500MB", param, ctx)
        return int(size)


budget_option = click.option(
    "--budget", type=click.FloatRange(min=0), default=240.0, show_default=True, metavar="SECONDS",
    help="Time for the whole, loading and compiling included; what it does not suffice for is named, with what it "
         "would take.",
)  # fmt: skip

memory_limit_option = click.option(
    "--memory-limit", type=Size(),
    help="Address space of each process, e.g. 2GiB (CPU only); default: the machine's memory.",
)  # fmt: skip


def files_of(resumed: Path | None, json_file: Path | None, plot_file: Path | None) -> tuple[Path | None, Path | None]:
    """The files of `--json` and `--plot`, by default that of `--resume` and one beside it. Raises ConfigError."""
    json_file = json_file or resumed
    if json_file is not None and plot_file is None:
        plot_file = json_file.with_suffix(".png")
    for option, path in (("--json", json_file), ("--plot", plot_file)):
        check_writable(option, path)
    return json_file, plot_file


def machine_of(config: Config, memory_limit: int | None) -> dict[str, Any]:
    """What computes, as a `Measurement` has it: variant, memory, and the limit of each process. Raises ConfigError."""
    from reslrb_cli.backend.doctor import memory_bytes
    from reslrb_cli.backend.variant import choose

    variant, _ = choose(config.variant)
    on_gpu, memory = variant.startswith("cuda"), memory_bytes(variant)
    if on_gpu and memory_limit is not None:
        raise ConfigError("--memory-limit", "", f"bounds address space, which says nothing of {variant}'s memory")
    return {"variant": variant, "memory": memory, "memory_limit": memory_limit or (None if on_gpu else memory)}


def exit_code(done: bool, states: set[BenchStatus]) -> ExitCode:
    """A comparison in which something could be measured is `done`; else what kept it from that decides."""
    from reslrb_cli.records.measurements import BenchStatus

    if done:
        return ExitCode.DONE
    return ExitCode.OUT_OF_MEMORY if states == {BenchStatus.OUT_OF_MEMORY} else ExitCode.CHECK_FAILED


@click.command("bench")
@optional_experiment_arguments
@click.option("--sweep", "swept", type=click.Choice(["depth", "spp", "film", "texture"]), default="depth",
              show_default=True,
              help="What is varied: path depth, samples per pixel, or the width of the film or of textures that are "
                   "parameters; path depth is CONFIG's where another one is.")  # fmt: skip
@click.option("--values", type=Counts(), metavar="LIST",
              help="What it is varied over, e.g. 4,16,64. Default: depths by --max-depth, a quarter to four times "
                   "run.spp, film widths 32 to 256, texture widths 16 to 1024.")  # fmt: skip
@click.option("--max-depth", type=click.IntRange(min=2, max=COUNT.max), default=32, show_default=True,
              help="Greatest path depth; measured are 2, 4, 8, ... and this one.")  # fmt: skip
@click.option("--integrators", metavar="LIST",
              help="What to compare: TYPE[:ESTIMATOR][(OPTION=VALUE,...)], separated by commas; OPTION is one of the "
                   f"integrator's, or adjoint. Default: those of {INTEGRATORS} that can do CONFIG.")  # fmt: skip
@click.option("--baseline", metavar="NAME",
              help="Entry of that list that times are divided by; default: ptracer, or else the first.")  # fmt: skip
@click.option("--objective", type=click.Choice(["fixed", "l2"]), default="fixed", show_default=True,
              help="fixed: dL/dI is given before the image; l2: it comes from the image, by run.adjoint.")  # fmt: skip
@memory_limit_option
@budget_option
@click.option("--rounds", type=click.IntRange(min=1, max=COUNT.max), metavar="N",
              help="Number of steps of each, whatever time they take, those of --resume included.")  # fmt: skip
@resume_option
@click.option("--json", "json_file", type=click.Path(path_type=Path, dir_okay=False),
              help="Write one object a line, as results come.")  # fmt: skip
@click.option("--plot", "plot_file", type=click.Path(path_type=Path, dir_okay=False),
              help="PNG of time and memory against what is varied; default: beside the JSON file.")  # fmt: skip
def command(
    config_file: Path | None,
    overrides: tuple[str, ...],
    swept: str,
    values: tuple[int, ...] | None,
    max_depth: int,
    integrators: str | None,
    baseline: str | None,
    objective: str,
    memory_limit: int | None,
    budget: float,
    rounds: int | None,
    resumed: Path | None,
    json_file: Path | None,
    plot_file: Path | None,
) -> int:
    """Measure time and peak memory of gradient steps against path depth, or what else --sweep names.

    A step is image, loss and gradient of every parameter of CONFIG, seen through its first sensor. Without CONFIG the
    scene is a Cornell box (--set scene.options.size=64, run.spp=4, ...). Each integrator runs in processes of its own;
    one that runs out of memory is recorded as out_of_memory, and the rest goes on. Ctrl-C keeps what is done, and what
    --json has written can be gone on from, however the process ended.
    """
    began = time.monotonic()
    from reslrb_cli.backend.doctor import device_name
    from reslrb_cli.backend.installation import load_packages
    from reslrb_cli.config.loader import load, loads

    load_packages()  # before what follows asks for them
    from reslrb_cli.cli.options import read_earlier
    from reslrb_cli.measure.bench import KIND, Book
    from reslrb_cli.measure.methods import SWEPT, Sweep, choose_baseline, depths, parse_cases, usual_values
    from reslrb_cli.measure.resume_store import Earlier
    from reslrb_cli.measure.scenes import small
    from reslrb_cli.records.measurements import BenchStatus

    if config_file is None:
        config = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, overrides)
    else:
        config = load(config_file, overrides)
    if (swept != "depth" or values is not None) and is_given("max_depth"):
        reason = "goes with --sweep depth" if values is None else "does not go with --values"
        raise ConfigError("--max-depth", "", f"{reason}; take --set integrator.max_depth={max_depth}")
    cases = parse_cases(integrators or INTEGRATORS, deep=swept == "depth")
    json_file, plot_file = files_of(resumed, json_file, plot_file)
    sweep = Sweep(
        **machine_of(config, memory_limit),
        config=config,
        cases=cases,
        baseline=choose_baseline(cases, baseline),
        values=sorted(values or (depths(max_depth) if swept == "depth" else usual_values(swept, config))),
        objective=objective,
        budget_s=budget,
        rounds=rounds,
        default=integrators is None,
        swept=swept,
    )
    sweep.check()
    earlier = None if resumed is None else Earlier(KIND, resumed, *read_earlier(resumed))
    device = device_name(sweep.variant)
    book = Book(sweep, device, earlier)
    echo(f"{device}, {sweep.variant}; {allowance(budget, rounds, 'round')}")
    echo(_conditions(config, sweep))
    results, interrupted = _run(sweep, book, json_file, began)
    if plot_file is not None and results:
        from reslrb_cli.report.plots import plot_bench

        series = [(case.label, [(r.value, r.record) for r in results if r.case == case]) for case in cases]
        abscissa = "path depth" if swept == "depth" else SWEPT[swept]
        plot_bench(series, plot_file, f"{device}\n{_conditions(config, sweep)}", abscissa)
        echo(f"look at {os.path.relpath(plot_file)}")
    states = {result.record.status for result in results}
    return ExitCode.INTERRUPTED if interrupted else exit_code(BenchStatus.OK in states, states)


def _run(sweep: Sweep, book: Book, json_file: Path | None, began: float) -> tuple[list[Result], bool]:
    """Measure, print and write; returns all results, and whether the user interrupted."""
    from reslrb_cli.cli.options import Keeper, origin_of
    from reslrb_cli.cli.terminal import Interrupts
    from reslrb_cli.measure.bench import bench
    from reslrb_cli.measure.processes import abandon_all
    from reslrb_cli.report.tables import bench_cells, bench_columns

    table, notes = bench_columns([case.label for case in sweep.cases], sweep.swept), []

    def show(rows: list[Result]) -> None:
        for row in rows:
            echo(table.line(bench_cells(row)))
            if row.reason:
                notes.append(f"{sweep.name(row.value)}, {row.case.label}: {row.reason}")

    def under_way() -> list[BenchRecord]:
        return [row.record for row in book.results(set(book.runs) - book.done)]

    origin = origin_of(sweep.variant)
    keeper = Keeper(json_file, origin, lambda: [row.record for row in book.results(book.done)], under_way, book.kept)
    with Interrupts(last_act=abandon_all) as interrupts:
        echo(table.head())
        show(book.results(book.done))
        say = logging.getLogger(__name__).info
        spent_s = time.monotonic() - began
        for rows in bench(sweep, lambda: interrupts.requested, say, book=book, between=keeper.refresh, spent_s=spent_s):
            show(rows)
            keeper.refresh()
        keeper.finish([row.record for row in book.results()])
        for note in notes:
            echo(note)
        return book.results(), interrupts.requested


def _conditions(config: Config, sweep: Sweep) -> str:
    """What was measured, in one line."""
    rr_depth, own = config.integrator.rr_depth, config.integrator.max_depth
    deepest = max(sweep.values) if sweep.swept == "depth" else own
    roulette = "no roulette" if 0 <= deepest < rr_depth else f"roulette from depth {rr_depth}"
    parts = [str(config.source)]
    parts += [] if sweep.swept == "depth" else [f"depth {own}"]
    parts += [] if sweep.swept == "spp" else [f"{config.run.spp} spp"]
    delta = "dL/dI known before" if sweep.objective == "fixed" else f"l2, adjoint {config.adjoint}"
    limit = "" if sweep.memory_limit is None else f", {sweep.memory_limit / 2**30:.2f} GiB each"
    return ", ".join([*parts, roulette, delta, f"ratios over {sweep.baseline.label}{limit}"])
