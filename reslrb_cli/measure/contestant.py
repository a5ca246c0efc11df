"""One of several that are measured side by side, each in a process of its own, and how it came to its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from reslrb_cli.measure.processes import Ended, Refused, Stopped


@dataclass
class Contestant:
    """A process under way (`processes.Process`); whoever may not refuse ends the whole where it does."""

    process: Any
    may_refuse: bool
    end: Ended | None = None
    refusal: Refused | None = None
    late: bool = False

    @property
    def alive(self) -> bool:
        """Whether it can be asked for more."""
        return self.end is None and self.refusal is None and not self.late

    def ask(
        self, question: dict[str, Any], stop: Callable[[], bool], over: Callable[[], bool] = lambda: False
    ) -> dict[str, Any] | None:
        """One answer; None where the process ended over it, or time was up. Raises Stopped once `stop()`."""
        self.process.ask(question)
        return self.answer(stop, over)

    def answer(self, stop: Callable[[], bool], over: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """The next answer, as of `ask`; the first is what a process says without being asked."""
        try:
            result: dict[str, Any] = self.process.answer(lambda: stop() or over())
            return result
        except Ended as end:
            self.end = end
        except Refused as refusal:
            if not self.may_refuse:
                raise
            self.refusal = refusal
        except Stopped:
            if stop():
                raise
            self.late = True
        self.process.close()  # what it held is for the others
        return None
