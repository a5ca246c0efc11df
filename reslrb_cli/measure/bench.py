"""Time and memory of a step against path depth, for several integrators side by side; or against something else.

At each depth (or number of samples, or size of the film or of textures: `sweep` says which) every case has a process
of its own, and all live at once. They load the scene, take a cold step each, then as many as it takes until no new
kernel comes (stock integrators need a few), and then steps in rounds, one each in turn, so that a drift of the machine
hits all alike; only one computes at a time. Ratios are taken within a round, whose steps also share a seed. The order
turns from round to round.

A case that runs out of memory is tried again at greater depths: what is recorded was seen, and a failure costs no more
time than it takes to fill the memory once.

A case that nobody named, but the default list, and that refuses the scene, is left out, and named with its reason.

The budget covers loading and compiling. Once it is spent, what is not warm is left out, and named; what is takes one
round, if it had none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from reslrb_cli.config import Config, dump
from reslrb_cli.measure.cases import Case
from reslrb_cli.measure.contestant import Contestant
from reslrb_cli.measure.pace import NO_TIME, Pace
from reslrb_cli.measure.processes import Process, Stopped
from reslrb_cli.measure.sweep import WIDTHS, Sweep
from reslrb_cli.records.bench import BenchRecord, BenchStatus, Spread

#: Steps after the cold one until no new kernel comes, at most.
MAX_WARM_UPS = 4
#: Where the cases of a depth together hold more than this share of the memory, each releases its own after a step.
MEMORY_SHARE = 0.7
MIB = 2**20
#: What is measured of every step.
TIMES = ("step_ms", "kernel_ms", "codegen_ms", "tracing_ms")
#: First steps that take longer are told of as they are done, in seconds.
SLOW = 10.0


@dataclass(frozen=True)
class Result:
    """A record, what it is compared with, and what the record has no room for.

    `value` is that of what is swept.
    `kernel_ratio` and `step_ratio` are times over those of the baseline, round by round; None where either has none.
    """

    case: Case
    value: int
    record: BenchRecord
    kernel_ratio: Spread | None
    step_ratio: Spread | None
    reason: str


@dataclass(kw_only=True)
class _Run(Contestant):
    """One case at one depth, under way."""

    case: Case
    config: Config
    size: tuple[int, int] | None = None
    texels: int | None = None
    cold: dict[str, Any] | None = None
    steps: dict[int, dict[str, Any]] = field(default_factory=dict)  # by round

    def step(
        self, round: int, cold: bool, release: bool, stop: Callable[[], bool], over: Callable[[], bool] = lambda: False
    ) -> dict[str, Any] | None:
        """One step; None where the process ended over it, or time was up. Raises Stopped once `stop()`."""
        return self.ask({"round": round, "cold": cold, "release": release}, stop, over)


def bench(
    sweep: Sweep,
    stop: Callable[[], bool],
    say: Callable[[str], None],
    start: Callable[[dict[str, Any]], Any] = Process,
) -> Iterator[list[Result]]:
    """Measure depth by depth; yield the results of each. Ends early, with what is done, once `stop()`.

    `say` is told what the budget did not suffice for, and, once, what the scene's loading warned of. Raises Refused
    where a case that may not be left out cannot begin.
    """
    pace = Pace(sweep.budget_s, len(sweep.values), sweep.rounds)
    warned: set[str] = set()
    cases = list(sweep.cases)
    for number, value in enumerate(sweep.values):
        if pace.over():
            say(f"not measured: {sweep.name(*sweep.values[number:])}: {NO_TIME}")
            return
        pace.begin_depth()
        runs = [_begin(sweep, case, value, start) for case in cases]
        try:
            _measure(sweep, runs, sweep.name(value), pace, stop, say, warned)
            stopped = False
        except Stopped:
            stopped = True
        finally:
            for run in runs:
                run.process.close()
        for run in runs:
            if run.refusal is not None:
                say(f"left out: {run.case.label}: {run.refusal}")
                cases.remove(run.case)
        late = ", ".join(run.case.label for run in runs if run.late and not run.steps)
        if late:
            say(f"not measured: {sweep.name(value)}, {late}: {NO_TIME}")
        done = [run for run in runs if run.end is not None or run.steps]
        yield [_result(run, value, sweep, runs) for run in done]
        if stopped:
            return


def _begin(sweep: Sweep, case: Case, value: int, start: Callable[[dict[str, Any]], Any]) -> _Run:
    config = sweep.at(case, value)
    first: dict[str, Any] = {
        "config": dump(config),
        "source": str(config.source),
        "variant": sweep.variant,
        "objective": sweep.objective,
        "memory_limit": sweep.memory_limit,
    }
    if sweep.swept in WIDTHS:
        first[f"{sweep.swept}_width"] = value
    return _Run(start(first), sweep.may_refuse(case), case=case, config=config)


def _measure(
    sweep: Sweep,
    runs: list[_Run],
    name: str,
    pace: Pace,
    stop: Callable[[], bool],
    say: Callable[[str], None],
    warned: set[str],
) -> None:
    def alive() -> list[_Run]:
        return [run for run in runs if run.alive]

    for run in runs:
        answer = run.answer(stop, pace.over)
        if answer is not None:
            run.size, run.texels = (answer["width"], answer["height"]), answer.get("texels")
            for line in answer.get("warnings", ()):
                if line not in warned:  # every process loads the same scene
                    warned.add(line)
                    say(line)
    for run in alive():
        run.cold = run.step(0, True, False, stop, pace.over)
        if run.cold is not None and run.cold["step_ms"] > 1e3 * SLOW:
            say(f"{name}, {run.case.label}: the first step took {run.cold['step_ms'] / 1e3:.0f} s")
        for _ in range(MAX_WARM_UPS):
            answer = run.step(0, False, _tight(sweep, runs), stop, pace.over) if run.alive else None
            if answer is None or not answer["new_kernels"]:
                break
    tight = _tight(sweep, runs)
    if tight:
        say(f"{name}: together the cases need more than the memory; each releases its own after a step")
    pace.begin_rounds()
    done = 0
    while alive() and pace.another(done):
        turn = alive()
        for run in turn[done % len(turn) :] + turn[: done % len(turn)]:
            answer = run.step(done + 1, False, tight, stop)
            if answer is not None:
                run.steps[done] = answer
        done += 1


def _tight(sweep: Sweep, runs: list[_Run]) -> bool:
    held = sum(run.cold["peak_mib"] for run in runs if run.cold is not None and run.alive) * MIB
    return held > MEMORY_SHARE * sweep.memory


def _result(run: _Run, value: int, sweep: Sweep, runs: list[_Run]) -> Result:
    options, ok = run.config.integrator.options(), run.end is None
    baseline = next(other for other in runs if other.case == sweep.baseline)
    width, height = next((other.size for other in runs if other.size is not None), (None, None))
    record = BenchRecord(
        integrator=run.case.type,
        estimator=run.case.estimator,
        capacity=options.get("capacity"),
        max_depth=run.config.integrator.max_depth,
        rr_depth=options["rr_depth"],
        spp=run.config.run.spp,
        width=width,
        height=height,
        status=BenchStatus.OK if run.end is None else run.end.status,
        **{name: Spread.of([step[name] for step in run.steps.values()]) if ok else None for name in TIMES},
        cold_ms=run.cold["step_ms"] if ok and run.cold else None,
        cold_codegen_ms=run.cold["codegen_ms"] if ok and run.cold else None,
        peak_mib=run.cold["peak_mib"] if ok and run.cold else None,
        scratch_bytes=run.cold["scratch_bytes"] if ok and run.cold else None,
        repeats=len(run.steps) if ok else 0,
        texels=next((other.texels for other in runs if other.texels is not None), None),
    )
    comparable = ok and baseline.end is None
    return Result(
        run.case,
        value,
        record,
        _ratio(run, baseline, "kernel_ms") if comparable else None,
        _ratio(run, baseline, "step_ms") if comparable else None,
        "" if run.end is None else run.end.reason,
    )


def _ratio(run: _Run, baseline: _Run, key: str) -> Spread | None:
    """Ratios of the rounds that both have; None where there is none."""
    rounds = [
        run.steps[round][key] / baseline.steps[round][key]
        for round in run.steps
        if baseline.steps.get(round, {}).get(key)
    ]
    return Spread.of(rounds) if rounds else None
