"""Checks whether memory or step time grows during a run, by statistics that a busy machine does not mislead.

Time is CPU time of the process. Each window keeps the shortest of its blocks, because other programs can only add time.
Memory is resident memory, compared by medians of windows.
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
#: Number of blocks in a window.
BLOCKS = 10
#: Significance level, so low that none of dozens of runs fails by chance.
LEVEL = 1e-3


@dataclass
class Watched:
    """Measurements of a run. Each window has the CPU seconds of an iteration, the resident memory in MiB and the
    allocator's peak in MiB. `block` iterations are timed together.
    """

    block: int
    seconds: list[float] = field(default_factory=list)
    resident: list[float] = field(default_factory=list)
    peaks: list[float] = field(default_factory=list)

    @property
    def growth(self) -> float:
        """Growth of the resident memory in MiB from the second tenth to the last tenth. The first tenth is a
        warm-up.
        """
        tenth = len(self.resident) // 10
        return statistics.median(self.resident[-tenth:]) - statistics.median(self.resident[tenth : 2 * tenth])

    @property
    def peak_growth(self) -> float:
        """Growth of the allocator's peak in MiB after the first tenth. It never falls."""
        return self.peaks[-1] - self.peaks[len(self.peaks) // 10]

    @property
    def trend(self) -> tuple[float, float]:
        """Relative growth of the step time over the run, without the first tenth, and the growth's p-value. The growth
        is the Theil-Sen slope, and the p-value comes from Kendall's tau, two-sided.
        """
        times = np.array(self.seconds[len(self.seconds) // 10 :])
        at = np.linspace(0, 1, len(times))
        slope = stats.theilslopes(times, at)[0]
        return float(slope / np.median(times)), float(stats.kendalltau(at, times).pvalue)

    def faults(self) -> list[str]:
        """Return the faults. Memory grows by more than 1 % and 2 MiB, or the peak by more than 1 % and 0.05 MiB. Step
        time grows significantly, by more than 5 %.
        """
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
    """Go through all records of a run, and return the measurements of memory and time."""
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
    """Return this process's resident memory in MiB."""
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024
