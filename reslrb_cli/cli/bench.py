"""`reslrb bench`: time and memory of gradient steps against path depth."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.options import (
    COUNT,
    ComparisonOptions,
    Counts,
    Keeper,
    check_writable,
    comparison_options,
    exit_code,
    is_given,
    measuring,
    optional_experiment_arguments,
    origin_of,
)
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.methods import BENCHED, DEEPEST, MeasurementPlan, bench_plan, plays_roulette

if TYPE_CHECKING:
    from reslrb_cli.records.measurements import BenchRecord


@dataclass(frozen=True)
class BenchOptions(ComparisonOptions):
    """The options of the command, by the names of its parameters."""

    swept: str
    values: tuple[int, ...] | None
    max_depth: int


@click.command("bench")
@optional_experiment_arguments
@click.option("--sweep", "swept", type=click.Choice(["depth", "spp"]), default="depth", show_default=True,
              help="Quantity to vary: path depth or samples per pixel. The path depth is that of CONFIG unless it is "
                   "varied.")  # fmt: skip
@click.option("--values", type=Counts(), metavar="LIST",
              help=
        "Values to measure, e.g. 4,16,64. Default: depths by --max-depth, a quarter to four times "
        "run.spp.")  # fmt: skip
@click.option("--max-depth", type=click.IntRange(min=2, max=COUNT.max), default=DEEPEST, show_default=True,
              help="Greatest path depth; the measured depths are 2, 4, 8, ... and this one.")  # fmt: skip
@click.option("--integrators", metavar="LIST",
              help="Integrators to compare: TYPE[:ESTIMATOR][(OPTION=VALUE,...)] or your own "
                   "FILE.py:CLASS, separated by "
                   "commas; OPTION is one of the integrator's. Default: those of "
                   f"{BENCHED} that support CONFIG. Times are divided by those of ptracer, or else of the "
                   "first.")  # fmt: skip
@comparison_options
def command(**given: Any) -> int:
    """Measure time and peak memory of gradient steps against path depth or sample count (--sweep).

    A step computes the image of CONFIG's first sensor, the loss, and the gradient of every parameter. Without CONFIG,
    the scene is a Cornell box (--set scene.options.size=64, run.spp=4, ...). Each integrator runs in its own processes.
    If an integrator runs out of memory, its result is recorded as out_of_memory. The measurement of the other
    integrators continues. Ctrl-C keeps finished results.
    """
    began, options = time.monotonic(), BenchOptions(**given)
    from reslrb_cli.backend.installation import load_packages

    load_packages()  # before the imports below need them
    from reslrb_cli.records.measurements import BenchStatus

    config, swept, values, json_file = options.config(), options.swept, options.values, options.json_file
    if (swept != "depth" or values is not None) and is_given("max_depth"):
        reason = "needs --sweep depth" if values is None else "has no effect with --values"
        raise ConfigError("--max-depth", "", f"{reason}; use --set integrator.max_depth={options.max_depth}")
    check_writable("--json", json_file)
    plan = bench_plan(
        config, swept, values or (), options.integrators, options.max_depth, budget_s=options.budget,
        rounds=options.rounds,
    )  # fmt: skip
    results, interrupted = _run(plan, json_file, began)
    states = {record.status for record in results}
    return exit_code(interrupted, BenchStatus.OK in states, states)


def _run(plan: MeasurementPlan, json_file: Path | None, began: float) -> tuple[list[BenchRecord], bool]:
    """Measure, print and write. Return all results, and True if the user interrupted."""
    from reslrb_cli.measure.bench import Bench
    from reslrb_cli.report.tables import bench_cells, bench_columns

    table, notes = bench_columns([case.label for case in plan.cases], plan.swept), []
    say = logging.getLogger(__name__).info
    with measuring(Bench, plan, began, say) as (session, interrupts):
        keeper = Keeper(json_file, origin_of(plan.variant), session.results)
        echo(_conditions(plan))
        echo(table.head())
        for records in session.run():
            for record in records:
                value = record.method.spp if plan.swept == "spp" else record.method.max_depth
                echo(table.line(bench_cells(record, value)))
                notes += [f"{plan.swept} {value}, {record.method.label}: {record.message}"] if record.message else []
            keeper.refresh()
        keeper.finish(interrupts.requested)
        for note in notes:
            echo(note)
        return session.results(), interrupts.requested


def _conditions(plan: MeasurementPlan) -> str:
    """Describe the measurement in one line."""
    config, own = plan.config, plan.config.integrator
    deepest = max(plan.values) if plan.swept == "depth" else own.max_depth
    parts = [str(config.source)]
    parts += [] if plan.swept == "depth" else [f"depth {own.max_depth}"]
    parts += [] if plan.swept == "spp" else [f"{config.run.spp} spp"]
    parts.append(f"roulette from depth {own.rr_depth}" if plays_roulette(deepest, own.rr_depth) else "no roulette")
    limit = "" if plan.memory_limit is None else f", {plan.memory_limit / 2**30:.2f} GiB each"
    return ", ".join([*parts, "dL/dI known in advance", f"ratios to {plan.baseline.label}{limit}"])
