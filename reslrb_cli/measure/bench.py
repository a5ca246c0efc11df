"""Time and memory of a step against path depth or the number of samples, for several integrators side by side.

At each value of the swept quantity, every case has its own process, and all processes exist at once. The cases take
turns (`Engine`), and the steps of a round have the same seeds. Ratios compare steps of the same round.

A case that runs out of memory is tried again at greater depths, so every record is an observation. A measurement begins
anew each time, because times of two days are not comparable. A case of the default list that does not support the scene
is left out, with the reason. The budget includes loading and compiling. Once the budget is spent, the measurement ends,
and the output names the cases without results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from reslrb_cli.measure.engine import NO_TIME, Engine, Member
from reslrb_cli.measure.methods import BENCH_ROUNDS, MeasurementPlan, NamedIntegrator
from reslrb_cli.measure.processes import Stopped
from reslrb_cli.records.measurements import BenchRecord, BenchStatus, Spread


def bench_record(member: Member, baseline: Member, sizes: Mapping[str, Any]) -> BenchRecord:
    """Return the figures of a member's draws, relative to the draws of the baseline. `sizes` has the sizes of film and
    textures, or nothing if they are unknown.
    """
    draws = member.draws
    figures: dict[str, Any] = {name: sizes.get(name) for name in ("width", "height", "texels")}
    if member.status is BenchStatus.OK:
        tracing_ms = np.maximum(draws.step_ms - draws.kernel_ms - draws.codegen_ms, 0.0)
        times = {"step_ms": draws.step_ms, "kernel_ms": draws.kernel_ms, "codegen_ms": draws.codegen_ms}
        figures |= {name: _spread(time) for name, time in (times | {"tracing_ms": tracing_ms}).items()}
        figures |= {name: getattr(draws, name) for name in ("cold_ms", "peak_mib", "scratch_bytes")}
        figures["repeats"] = len(member.kept)
        if baseline.status is BenchStatus.OK:
            _, own, its = np.intersect1d(draws.seeds, baseline.draws.seeds, return_indices=True)
            for name, times_of in (("step_ratio", "step_ms"), ("kernel_ratio", "kernel_ms")):
                own_ms, its_ms = getattr(draws, times_of)[own], getattr(baseline.draws, times_of)[its]
                figures[name] = _spread(own_ms[its_ms > 0] / its_ms[its_ms > 0])
    return BenchRecord(member.method, member.status, message=member.reason, **figures)


def _spread(values: np.ndarray) -> Spread | None:
    """Return the spread of all values except NaN, or None if every value is NaN."""
    known = values[~np.isnan(values)]
    return Spread.of(known.tolist()) if len(known) else None


class Bench(Engine):
    """Measurement for each value of the sweep.

    `runs` has the members by value, and `left_out` the cases that do not support the scene.
    """

    def __init__(
        self, plan: MeasurementPlan, stop: Callable[[], bool], say: Callable[[str], None], **given: Any
    ) -> None:
        super().__init__(plan, stop, say, BENCH_ROUNDS, **given)
        self.runs, self.left_out = dict[int, list[Member]](), list[NamedIntegrator]()

    def results(self) -> list[BenchRecord]:
        """Return the results so far, in the order of the sweep."""
        return [record for value in self.runs for record in self._results(value)]

    def _results(self, value: int) -> list[BenchRecord]:
        runs = self.runs[value]
        baseline = next(run for run in runs if run.case == self.plan.baseline)
        done = [run for run in runs if run.status in (BenchStatus.OUT_OF_MEMORY, BenchStatus.FAILED) or run.kept]
        return [bench_record(run, baseline, self.sizes) for run in done]

    def measure(self) -> Iterator[list[BenchRecord]]:
        """Measure. Yields an empty list after each round, and a value's results when the value is finished. Prints
        missing measurements.
        """
        plan, values, stopped = self.plan, self.plan.values, False
        for number, value in enumerate(values):
            if self.is_late():
                self.say(f"not measured: {plan.name(*values[number:])}: {NO_TIME}")
                return
            cases = [case for case in plan.cases if case not in self.left_out]
            self.members = self.runs[value] = [self._member(case, value) for case in cases]
            try:
                for _ in self.begin(self.members, {}):
                    pass
                for _ in self.take_rounds():
                    yield []
            except Stopped:
                stopped = True
            for run in self.members:
                run.close()
                if run.status is BenchStatus.REFUSED:
                    self.say(f"left out: {run.label}: {run.reason}")
                    self.left_out.append(run.case)
            if self.unmeasured and not stopped:
                self.say(f"not measured: {plan.name(value)}, {', '.join(self.unmeasured)}: {NO_TIME}")
            yield self._results(value)
            if stopped:
                return

    def _member(self, case: NamedIntegrator, value: int) -> Member:
        config = self.plan.at(case, value)
        return Member(
            case=case, config=config, label=case.label, quantity="step", spp=config.run.spp, purpose="image",
            about={"label": case.label, "value": value}, file=self.file,
            may_refuse=self.plan.default and case != self.plan.baseline,
        )  # fmt: skip
