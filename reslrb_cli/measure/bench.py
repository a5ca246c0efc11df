"""Time and memory of a step against path depth, for several integrators side by side; or against something else.

At each depth (or number of samples, or size of the film or of textures: `sweep` says which) every case has a process
of its own, and all live at once. They load the scene, take a cold step each, then as many as it takes until no new
kernel comes (stock integrators need a few), and then steps in rounds, one each in turn, so that a drift of the machine
hits all alike; only one computes at a time. Ratios are taken within a round, whose steps also share a seed. The order
turns from round to round.

A case that runs out of memory is tried again at greater depths: what is recorded was seen, and a failure costs no more
time than it takes to fill the memory once.

A case that nobody named, but the default list, and that refuses the scene, is left out, and named with its reason.

The budget covers loading and compiling. Once it is spent, what is not warm is left out, and named, with what it would
take; what is takes one round, if it had none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from reslrb_cli.config import dump
from reslrb_cli.measure.bench_book import Book
from reslrb_cli.measure.bench_run import Result, Run, results
from reslrb_cli.measure.pace import GROWTH, NO_TIME, Pace
from reslrb_cli.measure.processes import Stopped
from reslrb_cli.measure.sweep import WIDTHS, Sweep
from reslrb_cli.measure.tasks import start_process

#: Steps after the cold one until no new kernel comes, at most.
MAX_WARM_UPS = 4
#: Where the cases of a depth together hold more than this share of the memory, each releases its own after a step.
MEMORY_SHARE = 0.7
MIB = 2**20
#: First steps that take longer are told of as they are done, in seconds.
SLOW = 10.0


def bench(
    sweep: Sweep,
    stop: Callable[[], bool],
    say: Callable[[str], None],
    start: Callable[[dict[str, Any]], Any] = start_process,
    book: Book | None = None,
    between: Callable[[], None] = lambda: None,
    spent_s: float = 0.0,
) -> Iterator[list[Result]]:
    """Measure depth by depth what `book` does not have yet; yield the results of each.

    Ends early, with what is done, once `stop()`.

    `say` is told what the budget, of which `spent_s` have gone before, did not suffice for, and, once, what the scene's
    loading warned of. `between` is called between rounds, with all that is measured in the book. Raises Refused where a
    case that may not be left out cannot begin.
    """
    book = book or Book(sweep)
    values = book.to_do()
    pace = Pace(sweep.budget_s - spent_s, len(values), sweep.rounds)
    warned: set[str] = set()
    for number, value in enumerate(values):
        if pace.over():
            say(f"not measured: {sweep.name(*values[number:])}: {NO_TIME}")
            return
        pace.begin_depth()
        runs = book.runs[value] = _begin(book, value, start)
        try:
            _measure(sweep, runs, sweep.name(value), pace, stop, say, warned, between)
            stopped = False
        except Stopped:
            stopped = True
        finally:
            for run in runs:
                if run.process is not None:
                    run.process.close()
        for run in runs:
            if run.refusal is not None:
                say(f"left out: {run.case.label}: {run.refusal}")
                book.left_out.append(run.case)
        late = [run for run in runs if run.late and not run.steps]
        if late:
            names = ", ".join(run.case.label for run in late)
            say(f"not measured: {sweep.name(value)}, {names}: {NO_TIME}{_needed(pace, runs, len(values) - number)}")
        book.done.add(value)
        yield results(runs, value, sweep)
        if stopped:
            return


def _needed(pace: Pace, runs: list[Run], left: int) -> str:
    """What the depth that has just ended, and those that are `left` with it, would have taken."""
    late = sum(run.late for run in runs)
    warm = sum(run.at_work for run in runs)
    if warm == 0:
        return "; nothing had compiled by then, so allow several times as much"
    # What has not compiled is taken to take as long as what has; deeper paths take longer.
    whole_s = pace.spent_s + pace.depth_s * (late / warm + sum(GROWTH**k for k in range(1, left)))
    return f"; all of it takes about {whole_s:.0f} s"


def _begin(book: Book, value: int, start: Callable[[dict[str, Any]], Any]) -> list[Run]:
    """The cases at one value, with what has been measured of them; those that ended at it are not begun again."""
    before = {run.case.label: run for run in book.runs.get(value, ())}
    runs = []
    for case in book.sweep.cases:
        if case not in book.left_out:
            config = book.sweep.at(case, value)
            may_refuse = book.sweep.may_refuse(case)
            run = before.get(case.label) or Run(process=None, may_refuse=may_refuse, case=case, config=config)
            if run.alive:
                run.process = start(_first(book.sweep, run, value))
            runs.append(run)
    return runs


def _first(sweep: Sweep, run: Run, value: int) -> dict[str, Any]:
    first: dict[str, Any] = {
        "config": dump(run.config),
        "source": str(run.config.source),
        "variant": sweep.variant,
        "objective": sweep.objective,
        "memory_limit": sweep.memory_limit,
    }
    if sweep.swept in WIDTHS:
        first[f"{sweep.swept}_width"] = value
    return first


def _measure(
    sweep: Sweep,
    runs: list[Run],
    name: str,
    pace: Pace,
    stop: Callable[[], bool],
    say: Callable[[str], None],
    warned: set[str],
    between: Callable[[], None],
) -> None:
    def alive() -> list[Run]:
        return [run for run in runs if run.at_work]

    for run in alive():
        answer = run.answer(stop, pace.over)
        if answer is not None:
            run.size, run.texels = (answer["width"], answer["height"]), answer.get("texels")
            for line in answer.get("warnings", ()):
                if line not in warned:  # every process loads the same scene
                    warned.add(line)
                    say(line)
    for run in alive():
        before = run.cold
        run.cold = run.step(0, True, False, stop, pace.over) or before
        if run.alive and run.cold is not None and run.cold["step_ms"] > 1e3 * SLOW:
            say(f"{name}, {run.case.label}: the first step took {run.cold['step_ms'] / 1e3:.0f} s")
        for _ in range(MAX_WARM_UPS):
            answer = run.step(0, False, _tight(sweep, runs), stop, pace.over) if run.alive else None
            if answer is None or not answer["new_kernels"]:
                break
    tight = _tight(sweep, runs)
    if tight:
        say(f"{name}: together the cases need more than the memory; each releases its own after a step")
    # Rounds go on from those of an earlier session, whose numbers made the seeds, until all have enough of them.
    first = 1 + max((round for run in runs for round in run.steps), default=-1)
    pace.begin_rounds(min((len(run.steps) for run in alive()), default=0))
    done = 0
    while alive() and pace.another(done):
        turn = alive()
        for run in turn[done % len(turn) :] + turn[: done % len(turn)]:
            answer = run.step(first + done + 1, False, tight, stop)
            if answer is not None:
                run.steps[first + done] = answer
        done += 1
        between()


def _tight(sweep: Sweep, runs: list[Run]) -> bool:
    held = sum(run.cold["peak_mib"] for run in runs if run.cold is not None and run.at_work) * MIB
    return held > MEMORY_SHARE * sweep.memory
