"""Time and memory of a step against path depth or the number of samples, for several integrators side by side.

`sweep` selects the quantity. At each value, every case (`BenchRun`) has its own process, and all processes exist at
once (`Bench`). Each process takes a cold step. Further steps follow until no new kernel is compiled. Then rounds
follow. In each round, every process takes one step, and the order of the processes changes from round to round. The
steps of a round share a seed. Ratios compare steps of the same round.

A case that runs out of memory is tried again at greater depths, so every record is an observation. A measurement begins
anew each time, because times of two days are not comparable. A case of the default list that does not support the scene
is left out, with the reason. The budget includes loading and compiling. Once the budget is spent, cases that still
compile are left out, and the output names these cases. Each case that has compiled takes part in at least one round.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from reslrb_cli.config.schema import Config
from reslrb_cli.measure.arena import MAX_ROUNDS, NO_TIME, Arena, Contestant
from reslrb_cli.measure.methods import NamedIntegrator, Sweep, paths_in_records
from reslrb_cli.measure.processes import Stopped
from reslrb_cli.records.measurements import BenchRecord, BenchStatus, Spread

#: Sizes that all cases have in common; None until a case has loaded its scene.
SIZES = ("width", "height", "texels")

#: Measured quantities of every step.
TIMES = ("step_ms", "kernel_ms", "codegen_ms", "tracing_ms")


@dataclass(frozen=True)
class BenchResult:
    """Record of a case, its ratios to the baseline, and further data that the record lacks.

    `value` is the value of the varied quantity. `kernel_ratio` and `step_ratio` are the case's times divided by the
    baseline's times, round by round. They are None if either time is missing.
    """

    case: NamedIntegrator
    value: int
    record: BenchRecord
    kernel_ratio: Spread | None
    step_ratio: Spread | None
    reason: str


@dataclass(kw_only=True)
class BenchRun(Contestant):
    """One case at one value. `steps` has its steps by round."""

    case: NamedIntegrator
    config: Config
    steps: dict[int, dict[str, Any]] = field(default_factory=dict)

    @property
    def done(self) -> bool:
        """Whether it has any result."""
        return self.end is not None or bool(self.steps)

    def question(self, round: int | None) -> dict[str, Any]:
        """Return the request for one step with the seed of the round."""
        return {"round": 0 if round is None else round + 1}

    def keep(self, round: int, answer: dict[str, Any]) -> None:
        """Record a step."""
        self.steps[round] = answer


def _result(run: BenchRun, value: int, baseline: BenchRun, size: Mapping[str, int | None]) -> BenchResult:
    options, figures = run.config.integrator.options(), dict[str, Any](size)
    if run.end is None:
        figures |= {name: Spread.of([step[name] for step in run.steps.values()]) for name in TIMES}
        figures["repeats"] = len(run.steps)
        if run.cold:
            figures |= {"cold_ms": run.cold["step_ms"]}
            figures |= {name: run.cold[name] for name in ("peak_mib", "scratch_bytes")}
    record = BenchRecord(
        integrator=run.case.type,
        estimator=run.case.estimator,
        capacity=options.get("capacity"),
        max_depth=run.config.integrator.max_depth,
        rr_depth=options["rr_depth"],
        spp=run.config.run.spp,
        status=BenchStatus.OK if run.end is None else run.end.status,
        **paths_in_records(run.config),
        label=run.case.label,
        options=run.case.options,
        **figures,
    )
    kernel, step = (_ratio(run, baseline, key) for key in ("kernel_ms", "step_ms"))
    return BenchResult(run.case, value, record, kernel, step, "" if run.end is None else run.end.reason)


def _ratio(run: BenchRun, baseline: BenchRun, key: str) -> Spread | None:
    """Return ratios of the common rounds. Returns None if the runs have no common rounds, or if one of the runs has
    ended.
    """
    both = [(step[key], baseline.steps[round][key]) for round, step in run.steps.items() if round in baseline.steps]
    ratios = [own / its for own, its in both if its and run.end is None and baseline.end is None]
    return Spread.of(ratios) if ratios else None


#: The function that a process runs.
STEPS = "reslrb_cli.measure.steps:begin_steps"


class Bench(Arena[Sweep, BenchRun, list[BenchResult]]):
    """Measurement for each value of the sweep (see `Arena`). No process writes into its folder.

    `runs` has the runs by value, and `left_out` the cases that do not support the scene. `size` has the `width` and
    `height` of the film in pixels, and the `texels` of all textures that are parameters.
    """

    MOST_ROUNDS = MAX_ROUNDS

    def _set_up(self) -> int:
        self.runs, self.left_out = dict[int, list[BenchRun]](), list[NamedIntegrator]()
        self.size: dict[str, int | None] = dict.fromkeys(SIZES)
        return len(self.plan.values)

    def results(self) -> list[BenchResult]:
        """Return the results so far, in the order of the sweep."""
        return [result for value in self.plan.values if value in self.runs for result in self._results(value)]

    def _results(self, value: int) -> list[BenchResult]:
        runs = self.runs[value]
        baseline = next(run for run in runs if run.case == self.plan.baseline)
        return [_result(run, value, baseline, self.size) for run in runs if run.done]

    def _course(self) -> Iterator[list[BenchResult]]:
        """Measure. Yields an empty list after each round, and a value's results when the value is finished. Prints
        missing measurements.
        """
        plan, values = self.plan, self.plan.values
        for number, value in enumerate(values):
            if self._pace.over():
                self._say(f"not measured: {plan.name(*values[number:])}: {NO_TIME}")
                return
            self._pace.begin_depth()
            stopped = False
            try:
                self._begin(value)
                for _ in self._measure():
                    yield []
            except Stopped:
                stopped = True
            late = [run for run in self.members if run.late and not run.steps]
            for run in self.members:
                run.close()
                if run.refusal is not None:
                    self._say_end(run, run.case.label)
                    self.left_out.append(run.case)
            if late:
                names = ", ".join(run.case.label for run in late)
                self._say(f"not measured: {plan.name(value)}, {names}: {NO_TIME}")
            yield self._results(value)
            if stopped:
                return

    def _begin(self, value: int) -> None:
        """Start the cases at one value."""
        plan, self.members = self.plan, []
        self.runs[value] = self.members
        for case in plan.cases:
            if case not in self.left_out:
                config = plan.at(case, value)
                process = self._start(plan.first(config), STEPS)
                self.members.append(
                    BenchRun(process=process, may_refuse=plan.may_refuse(case), case=case, config=config)
                )

    def _measure(self) -> Iterator[int]:
        for run in self._alive():
            answer = self._open(run)
            if answer is not None:
                self.size = {name: answer[name] for name in SIZES}
        for run in self._alive():
            self._warm_up(run)
        return self._take_rounds()
