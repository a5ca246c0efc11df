"""One case of a `bench` at one value of what is swept: what is measured of it, its record, and what is kept of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from reslrb_cli.config import Config
from reslrb_cli.measure.cases import Case
from reslrb_cli.measure.contestant import Contestant
from reslrb_cli.measure.processes import Ended
from reslrb_cli.measure.sweep import Sweep
from reslrb_cli.records.bench import BenchRecord, BenchStatus, Spread

#: What is measured of every step.
TIMES = ("step_ms", "kernel_ms", "codegen_ms", "tracing_ms")


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
class Run(Contestant):
    """One case at one value; `process` is None where none is under way, `steps` are by round.

    `size` is the film's, width and height in pixels; `texels` those of all textures that are parameters.
    """

    case: Case
    config: Config
    size: tuple[int, int] | None = None
    texels: int | None = None
    cold: dict[str, Any] | None = None
    steps: dict[int, dict[str, Any]] = field(default_factory=dict)

    @property
    def at_work(self) -> bool:
        """Whether it can be asked for more."""
        return self.process is not None and self.alive

    @property
    def done(self) -> bool:
        """Whether it has anything to say."""
        return self.end is not None or bool(self.steps)

    def step(
        self, round: int, cold: bool, release: bool, stop: Callable[[], bool], over: Callable[[], bool] = lambda: False
    ) -> dict[str, Any] | None:
        """One step; None where the process ended over it, or time was up. Raises Stopped once `stop()`."""
        return self.ask({"round": round, "cold": cold, "release": release}, stop, over)

    def kept(self) -> dict[str, Any]:
        """What a later session needs, as JSON has it."""
        steps = {str(round): step for round, step in self.steps.items()}
        return {"case": self.case.label, "size": self.size, "texels": self.texels, "cold": self.cold, "steps": steps,
                "end": self.end and self.end.kept()}  # fmt: skip

    @classmethod
    def restored(cls, entry: Mapping[str, Any], case: Case, config: Config, may_refuse: bool) -> Run:
        """A run that `kept` returned, without a process."""
        size = entry["size"]
        return cls(
            process=None,
            may_refuse=may_refuse,
            end=Ended.restored(entry["end"]),
            case=case,
            config=config,
            size=None if size is None else (size[0], size[1]),
            texels=entry["texels"],
            cold=entry["cold"],
            steps={int(round): step for round, step in entry["steps"].items()},
        )


def results(runs: Sequence[Run], value: int, sweep: Sweep) -> list[Result]:
    """What those of the cases at one value that have anything to say come to."""
    return [_result(run, value, sweep, runs) for run in runs if run.done]


def _result(run: Run, value: int, sweep: Sweep, runs: Sequence[Run]) -> Result:
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


def _ratio(run: Run, baseline: Run, key: str) -> Spread | None:
    """Ratios of the rounds that both have; None where there is none."""
    rounds = [
        run.steps[round][key] / baseline.steps[round][key]
        for round in run.steps
        if baseline.steps.get(round, {}).get(key)
    ]
    return Spread.of(rounds) if rounds else None
