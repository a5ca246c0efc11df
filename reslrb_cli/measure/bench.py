"""Time and memory of a step against path depth or the number of samples, for several integrators side by side.

At each value of the swept quantity, every case has its own process, and all processes exist at once. The cases take
turns (`Engine`): in each round, every process takes one timed step, and the steps of a round share a seed. Ratios
compare steps of the same round.

A case that runs out of memory is tried again at greater depths, so every record is an observation. A measurement begins
anew each time, because times of two days are not comparable. A case of the default list that does not support the scene
is left out, with the reason. The budget includes loading and compiling. Once the budget is spent, cases that still
compile are left out, and the output names these cases. Each case that has compiled takes part in at least one round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from reslrb_cli.measure.engine import NO_TIME, Engine, Member, Request
from reslrb_cli.measure.methods import NamedIntegrator, Sweep, paths_in_records
from reslrb_cli.measure.processes import Stopped
from reslrb_cli.records.measurements import BenchRecord, Spread

#: Maximum number of rounds.
MAX_ROUNDS = 25

#: Sizes that all cases have in common; None until a case has loaded its scene.
SIZES = ("width", "height", "texels")


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


def bench_result(member: Member, value: int, baseline: Member, size: Mapping[str, int | None]) -> BenchResult:
    """Return the result of a member's draws, relative to the draws of the baseline."""
    config, case, draws, figures = member.request.config, member.request.case, member.draws, dict[str, Any](size)
    options = config.integrator.options()
    if member.failure is None:
        tracing_ms = np.maximum(draws.step_ms - draws.kernel_ms - draws.codegen_ms, 0.0)
        times = {"step_ms": draws.step_ms, "kernel_ms": draws.kernel_ms, "codegen_ms": draws.codegen_ms}
        figures |= {name: Spread.of(time.tolist()) for name, time in (times | {"tracing_ms": tracing_ms}).items()}
        figures |= {name: getattr(draws, name) for name in ("cold_ms", "peak_mib", "scratch_bytes")}
        figures["repeats"] = len(draws)
    record = BenchRecord(
        integrator=case.type,
        estimator=case.estimator,
        capacity=options.get("capacity"),
        max_depth=config.integrator.max_depth,
        rr_depth=options["rr_depth"],
        spp=config.run.spp,
        status=member.status,
        **paths_in_records(config),
        label=case.label,
        options=case.options,
        **figures,
    )
    kernel, step = (_ratio(member, baseline, name) for name in ("kernel_ms", "step_ms"))
    return BenchResult(case, value, record, kernel, step, "" if member.failure is None else member.failure.reason)


def _ratio(member: Member, baseline: Member, name: str) -> Spread | None:
    """Return ratios of the common rounds. Returns None if the members have no common rounds, or if one has failed."""
    if member.failure is not None or baseline.failure is not None:
        return None
    _, own, its = np.intersect1d(member.draws.seeds, baseline.draws.seeds, return_indices=True)
    own_ms, its_ms = getattr(member.draws, name)[own], getattr(baseline.draws, name)[its]
    ratios = own_ms[its_ms > 0] / its_ms[its_ms > 0]
    return Spread.of(ratios.tolist()) if len(ratios) else None


class Bench(Engine):
    """Measurement for each value of the sweep.

    `runs` has the members by value, and `left_out` the cases that do not support the scene. `size` has the `width` and
    `height` of the film in pixels, and the `texels` of all textures that are parameters.
    """

    def __init__(self, plan: Sweep, stop: Callable[[], bool], say: Callable[[str], None], **given: Any) -> None:
        super().__init__(plan, stop, say, depths=len(plan.values), most=MAX_ROUNDS, **given)
        self.plan = plan
        self.runs, self.left_out = dict[int, list[Member]](), list[NamedIntegrator]()
        self.size: dict[str, int | None] = dict.fromkeys(SIZES)

    def results(self) -> list[BenchResult]:
        """Return the results so far, in the order of the sweep."""
        return [result for value in self.plan.values if value in self.runs for result in self._results(value)]

    def _results(self, value: int) -> list[BenchResult]:
        runs = self.runs[value]
        baseline = next(run for run in runs if run.request.case == self.plan.baseline)
        done = [run for run in runs if run.failure is not None or run.kept]
        return [bench_result(run, value, baseline, self.size) for run in done]

    def measure(self) -> Iterator[list[BenchResult]]:
        """Measure. Yields an empty list after each round, and a value's results when the value is finished. Prints
        missing measurements.
        """
        plan, values, stopped = self.plan, self.plan.values, False
        for number, value in enumerate(values):
            if self.pace.over():
                self.say(f"not measured: {plan.name(*values[number:])}: {NO_TIME}")
                return
            self.pace.begin_depth()
            self.members = self.runs[value] = [
                Member(request=self._request(case, value), file=self.file)
                for case in plan.cases if case not in self.left_out
            ]  # fmt: skip
            try:
                for _ in self.begin(self.members, {}):
                    self.size |= next((run.opening for run in self.members if run.opening), {})
                for _ in self.take_rounds():
                    yield []
            except Stopped:
                stopped = True
            for run in self.members:
                run.close()
                if run.refusal is not None:
                    self.say(f"left out: {run.request.label}: {run.refusal}")
                    self.left_out.append(run.request.case)
            if late := [run.request.label for run in self.members if run.late and not run.kept]:
                self.say(f"not measured: {plan.name(value)}, {', '.join(late)}: {NO_TIME}")
            yield self._results(value)
            if stopped:
                return

    def _request(self, case: NamedIntegrator, value: int) -> Request:
        config = self.plan.at(case, value)
        return Request(
            case=case, config=config, label=case.label, quantity="step", spp=config.run.spp, purpose="image",
            about={"label": case.label, "value": value}, repeats=True, may_refuse=self.plan.may_refuse(case),
        )  # fmt: skip
