"""`reslrb convergence`: error of the gradient, or of the image, against run time."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.options import (
    ComparisonOptions,
    Counts,
    Keeper,
    check_writable,
    comparison_options,
    draws_option,
    exit_code,
    experiment_arguments,
    measuring,
    origin_of,
)
from reslrb_cli.cli.terminal import echo
from reslrb_cli.config.optimizers import loss_words
from reslrb_cli.measure.methods import MeasurementPlan, convergence_plan, plays_roulette
from reslrb_cli.records.measurements import BenchStatus
from reslrb_cli.report.format import WITHOUT_BORDER, Columns

if TYPE_CHECKING:
    from reslrb_cli.measure.convergence import Session
    from reslrb_cli.measure.judgement import ConvergenceResults


@dataclass(frozen=True)
class ConvergenceOptions(ComparisonOptions):
    """The options of the command, by the names of its parameters."""

    objective: str
    spps: tuple[int, ...] | None
    reference: str | None
    draws: Path | None


@click.command("convergence")
@experiment_arguments
@click.option("--integrators", metavar="LIST",
              help=
        "Methods to compare: TYPE[:ESTIMATOR][(OPTION=VALUE,...)], separated by commas; OPTION is one of the "
        "integrator's, or, with --objective loss, adjoint. Default: ptracer, prb, the estimators, stack with "
        "guiding, and its camera paths alone and beside light paths, if they support CONFIG; with loss, the "
        "choices of adjoint.")  # fmt: skip
@click.option("--objective", type=click.Choice(["fixed", "loss", "image"]), default="fixed", show_default=True,
              help=
        "fixed: the gradient with dL/dI of a reference image; loss: the gradient of CONFIG's loss, as "
        "run.adjoint says; image: the image.")  # fmt: skip
@click.option("--spp", "spps", type=Counts(), metavar="LIST",
              help="Samples per pixel of a step; several values are compared, e.g. 4,16,64. Default: "
                   "run.spp.")  # fmt: skip
@click.option("--reference", metavar="METHOD",
              help=
        "Method whose mean over many steps is the reference for errors. Default: reslrb:stack with half light "
        "paths and half camera paths, if CONFIG allows it.")  # fmt: skip
@draws_option
@comparison_options
def command(**given: Any) -> int:
    """Measure how fast each method's error falls for CONFIG. The parameters have initial values, and the first sensor
    is used.

    The methods take turns. Each method runs in its own process and takes steps of run.spp samples per pixel. Errors are
    relative to the size of the estimated quantity. With independent samples, the slope is -1/2. Efficiency is 1 /
    (relative variance * seconds). Ctrl-C keeps finished results. docs/convergence.md explains the columns.
    """
    began, options = time.monotonic(), ConvergenceOptions(**given)
    from reslrb_cli.backend.installation import load_packages
    from reslrb_cli.config.loader import check_code

    load_packages()  # before the imports below need them

    config, objective, json_file = options.config(), options.objective, options.json_file
    if objective == "loss":
        check_code(config)
    check_writable("--json", json_file)
    check_writable("--draws", options.draws)
    plan = convergence_plan(
        config, objective, options.integrators, options.reference, options.spps or (), budget_s=options.budget,
        rounds=options.rounds,
    )  # fmt: skip
    results, interrupted = _run(plan, options, began)
    done = any(record.relative_rmse is not None for record in results.methods)
    return exit_code(interrupted, done, {record.status for record in results.methods})


def _run(plan: MeasurementPlan, options: ConvergenceOptions, began: float) -> tuple[ConvergenceResults, bool]:
    """Measure, print and write. Return the results, and True if the user interrupted."""
    from reslrb_cli.measure.convergence import Session
    from reslrb_cli.measure.draws import DrawsFile
    from reslrb_cli.measure.judgement import Judgement
    from reslrb_cli.report.tables import (
        closing_sentence,
        method_cells,
        notes,
        reference_line,
        result_lines,
    )

    with measuring(Session, plan, began, file=DrawsFile(options.draws)) as (session, interrupts):
        keeper = Keeper(options.json_file, origin_of(plan.variant), lambda: result_lines(Judgement(session).results()))
        table: Columns | None = None
        for rounds in session.run():
            keeper.refresh()
            if rounds < 4 or rounds & (rounds - 1):
                continue  # print lines only when the number of rounds has doubled
            if table is None:
                echo(_conditions(plan, session))
                table = _table(session)
                echo(table.head())
            judgement = Judgement(session)
            for member in session.of("case"):
                if judgement.ready and member.status is not BenchStatus.REFUSED:
                    echo(table.line(method_cells(judgement.overall(member), f"{rounds} rounds")))
        keeper.finish(interrupts.requested)
        results = Judgement(session).results()
        if table is None and session.facts:
            echo(_conditions(plan, session))
        table = _table(session)
        echo(table.head())
        for record in results.methods:
            echo(table.line(method_cells(record)))
        remarks = [results.remark] if results.remark else []
        for line in [*map(reference_line, results.references), *notes(results.methods), *remarks]:
            echo(line)
        echo(closing_sentence(results.methods, results.references))
        return results, interrupts.requested


def _table(session: Session) -> Columns:
    """Return a table with columns that fit the finished and the expected results of the session."""
    from reslrb_cli.report.tables import method_columns

    labels = [member.label for member in session.of("case")]
    return method_columns(labels, [*session.facts.get("shapes", ()), "999 rounds"])


def _conditions(plan: MeasurementPlan, session: Session) -> str:
    """Describe the measurement in one line."""
    config, facts = plan.config, session.facts
    depth, rr_depth = config.integrator.max_depth, config.integrator.rr_depth
    roulette = f"roulette from depth {rr_depth}" if plays_roulette(depth, rr_depth) else "no roulette"
    what = {"fixed": "dL/dI fixed", "loss": f"loss {loss_words(config.losses)}", "image": "the image"}[plan.quantity]
    if plan.quantity != "image" and any(spec.regularizers for spec in config.parameters):
        what += ", without the regularizers, which have no noise"
    spp = ", ".join(map(str, plan.values))
    parts = [str(config.source), f"{spp} spp", roulette, what, facts.get("pictures", "")]
    parts.append(WITHOUT_BORDER if facts.get("masked") else "")
    return ", ".join(part for part in parts if part)
