"""Whether memory or step time grows while a run goes on, by statistics that a busy machine does not mislead.

Time is that of the process's own processors, and of each window the least of its blocks: what else runs on the machine
can only add to it. Memory is what the process has resident, medians of windows.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

MIB = 2.0**20
#: Blocks in a window.
BLOCKS = 10
#: A level of significance, so that of dozens of runs not one fails by chance.
LEVEL = 1e-3


@dataclass
class Watched:
    """A run that is watched: processor seconds of an iteration in each window, MiB resident, and the allocator's peak
    in MiB, after each window; `block` iterations are timed together."""

    block: int
    seconds: list[float] = field(default_factory=list)
    resident: list[float] = field(default_factory=list)
    peaks: list[float] = field(default_factory=list)

    @property
    def growth(self) -> float:
        """MiB by which the last tenth has more resident than the second tenth: the first one warms up."""
        tenth = len(self.resident) // 10
        return statistics.median(self.resident[-tenth:]) - statistics.median(self.resident[tenth : 2 * tenth])

    @property
    def peak_growth(self) -> float:
        """The same of the allocator's peak, which never falls."""
        return self.peaks[-1] - self.peaks[len(self.peaks) // 10]

    @property
    def trend(self) -> tuple[float, float]:
        """The share by which the time of a step grows over the run but for its first tenth, by Theil's and Sen's slope,
        and how probable as much is by chance (Kendall's tau, two-sided)."""
        times = np.array(self.seconds[len(self.seconds) // 10 :])
        at = np.linspace(0, 1, len(times))
        slope = stats.theilslopes(times, at)[0]
        return float(slope / np.median(times)), float(stats.kendalltau(at, times).pvalue)

    def faults(self) -> list[str]:
        """What grows: memory by more than 1 % and 2 MiB, step time significantly and by more than 5 %."""
        found = []
        allowed = max(2.0, 0.01 * statistics.median(self.resident))
        if self.growth > allowed:
            found.append(f"memory grows by {self.growth:.2f} MiB")
        if self.peak_growth > max(0.01 * self.peaks[-1], 0.05):
            found.append(f"the allocator's peak grows by {self.peak_growth:.3f} MiB")
        share, chance = self.trend
        if share > 0.05 and chance < LEVEL:
            found.append(f"steps grow by {100 * share:.1f} % (p = {chance:.1e})")
        return found

    def __str__(self) -> str:
        share, chance = self.trend
        return (
            f"{len(self.seconds) * self.block * BLOCKS} iterations of {1e3 * statistics.median(self.seconds):.2f} ms; "
            f"resident {self.resident[-1]:.1f} MiB, grown by {self.growth:.2f}; peak {self.peaks[-1]:.3f} MiB, grown "
            f"by {self.peak_growth:.3f}; time grown by {100 * share:.1f} % (p = {chance:.2g})"
        )


def watch(records: Iterable[Any], block: int = 10) -> Watched:
    """Go through all records of a run, and watch it meanwhile."""
    watched, blocks = Watched(block), []
    begin = time.process_time()
    for record in records:
        if (record.iteration + 1) % block:
            continue
        now = time.process_time()
        blocks.append((now - begin) / block)
        if len(blocks) == BLOCKS:
            watched.seconds.append(min(blocks))
            watched.resident.append(resident())
            watched.peaks.append(record.peak_mib)
            blocks.clear()
        begin = time.process_time()
    return watched


def resident() -> float:
    """MiB of this process's memory now."""
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024
