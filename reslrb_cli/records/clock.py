"""Readings of time and memory around a step."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr

MIB = 2.0**20


@dataclass
class StepTimes:
    """Times of one step in milliseconds; filled in when the step has ended.

    `wall_ms` is what a user waits; `kernel_ms` the execution of kernels and `codegen_ms` their generation and
    compilation, both from `dr.kernel_history`; `new_kernels` the number of kernels that no earlier step of the same
    clock has launched (`cache_hit` does not tell: a kernel from the disk cache is a hit).
    """

    wall_ms: float = 0.0
    kernel_ms: float = 0.0
    codegen_ms: float = 0.0
    new_kernels: int = 0


class StepClock:
    """Times steps, and adds up the time that an optimisation takes without what is written in between."""

    def __init__(self, elapsed_s: float = 0.0) -> None:
        self.elapsed_s = elapsed_s
        #: Kernel history of the last step.
        self.history: list[dict[str, Any]] = []
        self._known: set[Any] = set()

    @contextmanager
    def step(self) -> Iterator[StepTimes]:
        """Time the block as one step, under kernel history; what it launches is waited for."""
        times = StepTimes()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.sync_thread()
            dr.kernel_history_clear()
            with self.counted():
                start = time.perf_counter()
                yield times
                dr.sync_thread()
                times.wall_ms = 1e3 * (time.perf_counter() - start)
            self.history = dr.kernel_history()
        times.kernel_ms, times.codegen_ms = summarise(self.history)
        launched = {entry["hash"] for entry in self.history if entry["type"] == dr.KernelType.JIT}
        times.new_kernels = len(launched - self._known)
        self._known |= launched

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Count the block's time into `elapsed_s`."""
        start = time.perf_counter()
        yield
        dr.sync_thread()
        self.elapsed_s += time.perf_counter() - start


@dataclass(frozen=True)
class WorkerTime:
    """What one worker did: calls that it answered, seconds of computing them, and how many of what it had were asked of
    others too, since it said nothing for long."""

    calls: int = 0
    computing_s: float = 0.0
    again: int = 0

    def __add__(self, other: WorkerTime) -> WorkerTime:
        return WorkerTime(self.calls + other.calls, self.computing_s + other.computing_s, self.again + other.again)


@dataclass(frozen=True)
class SharedTime:
    """Seconds for which workers were asked to compute, by part, and what each of them did, by name.

    `wall_s` goes from the first question of a round to its last answer. Of that the mean worker computed for
    `computing_s`, and waited for `waiting_s` for the one that had most; the rest is `sending_s`, the handing out
    included. `places` are those of the workers, as `--cluster` had them.
    """

    places: tuple[str, ...] = ()
    wall_s: float = 0.0
    computing_s: float = 0.0
    waiting_s: float = 0.0
    workers: dict[str, WorkerTime] = field(default_factory=dict)

    @property
    def sending_s(self) -> float:
        """What is neither computing nor waiting."""
        return max(self.wall_s - self.computing_s - self.waiting_s, 0.0)

    def __add__(self, other: SharedTime) -> SharedTime:
        """Both, one after the other."""
        workers = dict(self.workers)
        for name, spent in other.workers.items():
            workers[name] = workers.get(name, WorkerTime()) + spent
        return replace(
            self,
            places=tuple(dict.fromkeys([*self.places, *other.places])),
            wall_s=self.wall_s + other.wall_s,
            computing_s=self.computing_s + other.computing_s,
            waiting_s=self.waiting_s + other.waiting_s,
            workers=workers,
        )


def summarise(history: list[dict[str, Any]]) -> tuple[float, float]:
    """Sum a kernel history: milliseconds of execution, and of code generation and compilation.

    Copies and reductions count as execution: they are kernels of the step like any other.
    """
    execution = sum(entry.get("execution_time", 0.0) for entry in history)
    codegen = sum(entry.get("codegen_time", 0.0) + entry.get("backend_time", 0.0) for entry in history)
    return float(execution), float(codegen)


def reset_peak() -> None:
    """Start a new memory peak from what is alive now.

    The allocator's statistics count blocks that it holds back for reuse as allocated: without the flush a peak
    would include whatever ran before; and scenes that are done with die by the garbage collector alone.
    """
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()


def peak_mib(backend: Any) -> float:
    """The most memory allocated at once since `reset_peak`, in MiB, on `backend` (a `dr.JitBackend`).

    Thread-local memory (`dr.Local`) is not in it.
    """
    return float(dr.detail.malloc_watermark(backend)) / MIB
