"""What `reslrb convergence --runs` does: whole optimisations, printed and written as they come."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from reslrb_cli.cli.experiment import allowance
from reslrb_cli.cli.interrupts import Interrupts
from reslrb_cli.cli.keeping import Keeper, read_earlier
from reslrb_cli.cli.measured import origin_of
from reslrb_cli.cli.output import echo
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.earlier import Earlier
from reslrb_cli.measure.processes import abandon_all
from reslrb_cli.measure.whole_runs.outcome import outcome
from reslrb_cli.measure.whole_runs.plan import RunsPlan
from reslrb_cli.measure.whole_runs.resuming import KIND, check
from reslrb_cli.measure.whole_runs.session import RunsSession
from reslrb_cli.records.bench import BenchStatus
from reslrb_cli.records.convergence import SummaryRecord
from reslrb_cli.records.lines import Line
from reslrb_cli.records.whole_runs import RunBestRecord, RunMethodRecord, RunPointRecord
from reslrb_cli.report.whole_runs_plot import plot_runs
from reslrb_cli.report.whole_runs_table import RunsTable, best_line, closing_sentence, notes
from reslrb_cli.report.words import WITHOUT_BORDER, count


def measure_runs(
    plan: RunsPlan, resumed: Path | None, json_file: Path | None, plot_file: Path | None, began: float, where: str
) -> int:
    """Measure, print, write and draw; returns the exit code. `began` is when the command was called, by `monotonic`.

    `resumed` is the JSON file that is gone on from, if any.
    """
    points: list[RunPointRecord] = []
    earlier = None if resumed is None else Earlier(KIND, resumed, *read_earlier(resumed))
    if earlier is not None:
        check(plan, earlier, where)
    echo(f"{where}; {allowance(plan.budget_s, None, 'run')}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="reslrb-convergence-")))

        def tidy() -> None:
            abandon_all()
            shutil.rmtree(folder, ignore_errors=True)

        interrupts = stack.enter_context(Interrupts(last_act=tidy))
        table = RunsTable(list(plan.names))
        spent_s = time.monotonic() - began
        session = RunsSession(
            plan, folder, lambda: interrupts.requested, echo, spent_s=spent_s, earlier=earlier, device=where
        )
        points += [point for run in session.runs for point in run.points]  # of earlier sessions

        def show(point: RunPointRecord) -> None:
            if point.elapsed_s == session.limit_s:
                echo(table.point(point, session.run_of(point).first_s))

        def found() -> tuple[list[RunMethodRecord], list[RunBestRecord], str]:
            now = outcome(session.runs, session.limit_s, plan.names)
            bests = [replace(record, line=best_line(record)) for record in now.bests]
            return now.methods, bests, closing_sentence(now.loss, now.error, session.limit_s)

        def outcome_lines() -> list[Line]:
            records, bests, sentence = found()
            return [*records, *bests, SummaryRecord(sentence)]

        keeper = Keeper(json_file, origin_of(plan.variant), lambda: points, outcome_lines, session.keep)
        headed = False
        for point in session.run():
            if not headed:
                headed = True
                echo(_conditions(plan, session))
                echo(table.head())
                for other in points:
                    show(other)
            points.append(point)
            show(point)
            keeper.refresh()
        keeper.finish([*points, *outcome_lines()])
        records, bests, sentence = found()
        echo(table.head())
        for record in records:
            echo(table.line(record))
        for line in [*notes(records), *(best.line for best in bests), sentence]:
            echo(line)
        conditions = _conditions(plan, session)
    if plot_file is not None and points:
        plot_runs(points, session.facts.get("error_of", ""), plot_file, f"{where}\n{conditions}")
        echo(f"look at {os.path.relpath(plot_file)}")
    return ExitCode.INTERRUPTED if interrupts.requested else _exit_code(records)


def _conditions(plan: RunsPlan, session: RunsSession) -> str:
    """What was measured, in one line."""
    optimizer, facts = plan.config.optimizer, session.facts
    parts = [
        str(plan.config.source),
        f"{count(plan.runs, 'seed')}, {session.limit_s:.3g} s each",
        f"loss {plan.config.loss.type}",
        f"{optimizer.type} at {optimizer.learning_rate:g}" + "".join(f", x {rate:g}" for rate in plan.rates),
        facts.get("pictures", ""),
        facts.get("error_of", ""),
        WITHOUT_BORDER if facts.get("masked") else "",
    ]
    return ", ".join(part for part in parts if part)


def _exit_code(records: list[RunMethodRecord]) -> ExitCode:
    """A comparison in which something was optimised is done; else what kept it from that decides."""
    if any(record.iterations is not None and record.iterations.high > 0 for record in records):
        return ExitCode.DONE
    states = {record.status for record in records}
    return ExitCode.OUT_OF_MEMORY if states == {BenchStatus.OUT_OF_MEMORY} else ExitCode.CHECK_FAILED
