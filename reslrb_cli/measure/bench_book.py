"""Everything that a `bench` has measured so far, in this session and in earlier ones."""

from __future__ import annotations

from reslrb_cli.errors import ConfigError
from reslrb_cli.measure import earlier
from reslrb_cli.measure.bench_run import Result, Run, results
from reslrb_cli.measure.cases import Case
from reslrb_cli.measure.earlier import Earlier
from reslrb_cli.measure.pace import MAX_ROUNDS
from reslrb_cli.measure.sweep import Sweep
from reslrb_cli.records.samples import Kept

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
        self._settings = earlier.settings(
            sweep.config,
            sweep.variant,
            device,
            integrators=[case.label for case in sweep.cases],
            baseline=sweep.baseline.label,
            values=list(sweep.values),
            objective=sweep.objective,
            sweep=sweep.swept,
            **{"memory limit": sweep.memory_limit},
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
        return earlier.head(KIND, self._settings, values=values, left_out=left_out), {}
