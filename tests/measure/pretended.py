"""Processes that only pretend to measure, for tests of what a sweep does with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from reslrb_cli.config.loader import loads
from reslrb_cli.measure.processes import Ended, Refused, Stopped
from reslrb_cli.records.measurements import BenchStatus


class Pretended:
    """A process that writes down what it is asked, and ends at the question that `ends` gives for (type, depth)."""

    log: list[tuple[int, str, Any]] = []  # noqa: RUF012 (shared by all, as the machine is)
    ends: dict[tuple[str, int], int] = {}  # noqa: RUF012
    refusing: set[str] = set()  # noqa: RUF012
    alive = 0

    def __init__(self, first: dict[str, Any]) -> None:
        config = loads(first["config"], "x.yaml")
        self.type, self.depth = config.integrator.type, config.integrator.max_depth
        self.asked, self.closed = 0, False
        self.question: dict[str, Any] | None = None
        Pretended.alive += 1

    def ask(self, question: dict[str, Any]) -> None:
        self.asked, self.question = self.asked + 1, question
        Pretended.log.append((self.depth, self.type, question["round"]))

    def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
        if stop():
            raise Stopped
        if self.type in self.refusing:
            raise Refused("no derivatives of what moves light", 2)
        if self.ends.get((self.type, self.depth)) == self.asked:
            raise Ended(BenchStatus.OUT_OF_MEMORY, "ended by SIGSEGV")
        if self.question is None:
            return {"width": 6, "height": 5}
        ms = float(self.depth * (1 + self.question["round"]) * {"ptracer": 4, "reslrb": 2, "walk_ad": 5}[self.type])
        parts = {"kernel_ms": ms / 2, "codegen_ms": ms / 8, "tracing_ms": 3 * ms / 8}
        answer = {"step_ms": ms, **parts, "new_kernels": 2 if self.asked < 3 else 0}
        return answer | ({"peak_mib": 1.5, "scratch_bytes": 60} if self.question["cold"] else {})

    def close(self) -> None:
        Pretended.alive -= not self.closed
        self.closed = True
