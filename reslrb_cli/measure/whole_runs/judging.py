"""The process that judges whole runs, as the session sees it: it makes the target, or takes over an earlier one's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.contestant import Contestant
from reslrb_cli.measure.earlier import Earlier
from reslrb_cli.measure.processes import Refused
from reslrb_cli.measure.whole_runs.resuming import check_judge, restore_targets
from reslrb_cli.records.bench import BenchStatus


class Judging:
    """A `process` under way that answers until `stop()`, or until time is up, `over()`; `label` names its integrator.

    `late` says that time was up over one of its answers.
    """

    def __init__(self, process: Any, label: str, stop: Callable[[], bool], over: Callable[[], bool]) -> None:
        self._contestant = Contestant(process, False)
        self._label, self._stop, self._over = label, stop, over

    @property
    def late(self) -> bool:
        """Whether time was up over one of its answers."""
        return self._contestant.late

    def open(self) -> dict[str, Any] | None:
        """What it says first, its scene loaded; None where time was up."""
        return self._contestant.answer(self._stop, self._over)

    def prepare(self, targets: Path, **ask: float | bool) -> dict[str, Any]:
        """Have it make the targets, and write them; `ask` and the facts that it returns are those of `judge.prepare`.

        There are none where time was up.
        """
        return self.ask({"prepare": ask, "out": str(targets)}) or {}

    def restore(self, targets: Path, earlier: Earlier) -> dict[str, Any]:
        """Have it judge as that of an earlier session; returns its facts, with what a judgement takes now.

        Raises ConfigError where it finds another loss of the initial values.
        """
        restore_targets(earlier, targets)
        facts: dict[str, Any] = earlier.head["facts"]
        ask = {"spp": facts["spp"], "masked": facts["masked"]}
        found = self.ask({"restore": ask, "targets": str(targets)})
        if found is None:
            return facts
        check_judge(earlier, found)
        return facts | {"judge_s": found["judge_s"]}

    def ask(self, question: dict[str, Any]) -> dict[str, Any] | None:
        """An answer; None where the budget was spent over it. Raises Refused where the process ended."""
        judge = self._contestant
        answer = judge.ask(question, self._stop, self._over)
        if judge.end is not None:
            memory = judge.end.status is BenchStatus.OUT_OF_MEMORY
            line = f"--reference {self._label}: {judge.end.reason}"
            raise Refused(line, ExitCode.OUT_OF_MEMORY if memory else ExitCode.CHECK_FAILED)
        return answer

    def close(self) -> None:
        """End the process."""
        self._contestant.process.close()
