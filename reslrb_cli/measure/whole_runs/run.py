"""One run of one method, as the session sees it, and the times at which all of them are looked at."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from reslrb_cli.measure.contestant import Contestant
from reslrb_cli.records.convergence import Method
from reslrb_cli.records.whole_runs import RunPointRecord

#: Times at which runs are looked at.
POINTS = 16


@dataclass(kw_only=True)
class Run(Contestant):
    """A process under way, and where it stands: `state` is the newest that is known, `points` those at given times.

    `counted_s` is the time of its own that it has had, at least. Values go by way of `out`.
    """

    method: Method
    seed: int
    out: Path
    state: RunPointRecord
    counted_s: float = 0.0
    first_s: float | None = None
    peak_mib: float = 0.0
    points: list[RunPointRecord] = field(default_factory=list)

    def complete(self, limit_s: float) -> bool:
        """Whether it came to the end of its time."""
        return bool(self.points) and self.points[-1].elapsed_s == limit_s


def times(limit_s: float) -> list[float]:
    """When runs are looked at, in seconds: closer together at their beginning, where losses fall fastest."""
    return [limit_s * (number / POINTS) ** 2 for number in range(1, POINTS + 1)]
