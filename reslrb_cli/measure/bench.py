"""Time and memory of a step against path depth, for several integrators side by side; or against something else.

- `Book`: everything that a `bench` has measured so far, in this session and in earlier ones
- `Run`: one case at one value of what is swept: what is measured of it, its record, and what is kept of it
- `bench`: the measurement

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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure import resume_store
from reslrb_cli.measure.arena import in_turn, is_tight, start_process
from reslrb_cli.measure.methods import WIDTHS, Case, Sweep
from reslrb_cli.measure.processes import GROWTH, MAX_ROUNDS, NO_TIME, Contestant, Ended, Pace, Stopped
from reslrb_cli.measure.resume_store import Earlier
from reslrb_cli.records.measurement_files import Kept
from reslrb_cli.records.measurements import BenchRecord, BenchStatus, Spread

#: What is kept says that it is of this.
KIND = "bench"


class Book:
    """Runs by value of what is swept; `left_out` are the cases that refused the scene, `done` the values that are over.

    What an `earlier` session has measured is in it from the beginning. Raises ConfigError where that is of another
    measurement, or where it leaves nothing to do.
    """

    def __init__(self, sweep: Sweep, device: str = "", before: Earlier | None = None) -> None:
        self.sweep, self.runs, self.done = sweep, dict[int, list[Run]](), set[int]()
        self.left_out: list[Case] = []
        self._settings = sweep.settings(
            device,
            baseline=sweep.baseline.label,
            values=list(sweep.values),
            objective=sweep.objective,
            sweep=sweep.swept,
        )
        if before is not None:
            before.check(self._settings)
            self._restore(before)

    @property
    def most(self) -> int:
        """Rounds of a value, at most, those of all sessions together."""
        return self.sweep.rounds or MAX_ROUNDS

    def _restore(self, before: Earlier) -> None:
        sweep = self.sweep
        self.left_out = [case for case in sweep.cases if case.label in before.head["left_out"]]
        for value, entries in before.head["values"]:
            by_label = {entry["case"]: entry for entry in entries}
            self.runs[value] = [
                Run.restored(by_label[case.label], case, sweep.at(case, value), sweep.may_refuse(case))
                for case in sweep.cases
                if case.label in by_label
            ]
            if self._is_over(value):
                self.done.add(value)
        if self.done == set(sweep.values):
            raise ConfigError("--resume", "", f"{before.source} has all of it, {self.most} rounds each; "
                              "more are measured with a larger --rounds")  # fmt: skip

    def _is_over(self, value: int) -> bool:
        """Whether nothing is to be added to the runs at a value."""
        runs = self.runs[value]
        whole = len(runs) == len(self.sweep.cases) - len(self.left_out)
        return whole and all(run.end is not None or len(run.steps) >= self.most for run in runs)

    def to_do(self) -> list[int]:
        """The values that are to be measured, or measured further."""
        return [value for value in self.sweep.values if value not in self.done]

    def results(self, values: set[int] | None = None) -> list[Result]:
        """What the runs at some values, or at all, come to, in the order of the sweep."""
        return [
            result
            for value in self.sweep.values
            if value in self.runs and (values is None or value in values)
            for result in results(self.runs[value], value, self.sweep)
        ]

    def kept(self) -> Kept | None:
        """What a later session needs to go on; None where there is nothing yet."""
        values = [(value, [run.kept() for run in runs if run.done]) for value, runs in self.runs.items()]
        if not any(entries for _, entries in values):
            return None
        left_out = [case.label for case in self.left_out]
        return resume_store.head(KIND, self._settings, values=values, left_out=left_out), {}


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


#: Steps after the cold one until no new kernel comes, at most.
MAX_WARM_UPS = 4

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
                width = {f"{book.sweep.swept}_width": value} if book.sweep.swept in WIDTHS else {}
                run.process = start(book.sweep.first(config) | {"objective": book.sweep.objective} | width)
            runs.append(run)
    return runs


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
        for run in in_turn(alive(), done):
            answer = run.step(first + done + 1, False, tight, stop)
            if answer is not None:
                run.steps[first + done] = answer
        done += 1
        between()


def _tight(sweep: Sweep, runs: list[Run]) -> bool:
    return is_tight(sweep, (run.cold["peak_mib"] for run in runs if run.cold is not None and run.at_work))
