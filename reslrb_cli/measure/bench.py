"""Time and memory of a step against path depth or the number of samples, for several integrators side by side.

At each value of the swept quantity, every case has its own process, and all processes exist at once. The cases take
turns (`Engine`), and the steps of a round have the same seeds. Ratios compare steps of the same round.

A case that runs out of memory is tried again at greater depths, so every record is an observation. A measurement begins
anew each time, because times of two days are not comparable. A case of the default list that does not support the scene
is left out, with the reason. The budget includes loading and compiling. Once the budget is spent, the measurement ends,
and the output names the cases without results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
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
        times = {name: getattr(draws, name) for name in ("step_ms", "kernel_ms", "codegen_ms")}
        times["tracing_ms"] = np.maximum(draws.step_ms - draws.kernel_ms - draws.codegen_ms, 0.0)
        if baseline.status is BenchStatus.OK:
            _, own, its = np.intersect1d(draws.seeds, baseline.draws.seeds, return_indices=True)
            for name in ("step", "kernel"):
                own_ms, its_ms = times[f"{name}_ms"][own], getattr(baseline.draws, f"{name}_ms")[its]
                times[f"{name}_ratio"] = own_ms[its_ms > 0] / its_ms[its_ms > 0]
        for name, values in times.items():
            known = values[~np.isnan(values)].tolist()
            figures[name] = Spread.of(known) if known else None
        figures |= {name: getattr(draws, name) for name in ("cold_ms", "peak_mib", "scratch_bytes")}
        figures["repeats"] = len(member.kept)
    return BenchRecord(member.method, member.status, message=member.reason, **figures)


class Bench(Engine):
    """Measurement for each value of the sweep.

    `runs` has the members by value, and `left_out` the cases that do not support the scene.
    """

    def __init__(
        self, plan: MeasurementPlan, stop: Callable[[], bool], say: Callable[[str], None], **given: Any
    ) -> None:
        super().__init__(plan, stop, say, BENCH_ROUNDS, **given)
        self.runs, self.left_out = dict[int, list[Member]](), list[NamedIntegrator]()

    def results(self, values: Iterable[int] | None = None) -> list[BenchRecord]:
        """Return the results so far, in the order of the sweep, by default for all values."""
        found = []
        for runs in (self.runs[value] for value in (self.runs if values is None else values)):
            baseline = next(run for run in runs if run.case == self.plan.baseline)
            done = [run for run in runs if run.status in (BenchStatus.OUT_OF_MEMORY, BenchStatus.FAILED) or run.kept]
            found += [bench_record(run, baseline, self.sizes) for run in done]
        return found

    def measure(self) -> Iterator[list[BenchRecord]]:
        """Measure. Yields an empty list after each round, and a value's results when the value is finished. Prints
        missing measurements.
        """
        plan, values, stopped = self.plan, self.plan.values, False
        for number, value in enumerate(values):
            if self.is_late():
                self.say(f"not measured: {plan.swept} {', '.join(map(str, values[number:]))}: {NO_TIME}")
                return
            self.members = self.runs[value] = []
            for case in (case for case in plan.cases if case not in self.left_out):
                config = plan.at(case, value)
                self.members.append(Member(
                    case=case, config=config, label=case.label, quantity="step", spp=config.run.spp, purpose="image",
                    about={"label": case.label, "value": value}, file=self.file,
                    may_refuse=plan.default and case != plan.baseline,
                ))  # fmt: skip
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
                self.say(f"not measured: {plan.swept} {value}, {', '.join(self.unmeasured)}: {NO_TIME}")
            yield self.results([value])
            if stopped:
                return
