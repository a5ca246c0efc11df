"""Measurement of the time and memory of steps."""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr

MIB = 2.0**20


@dataclass
class StepTimes:
    """Times of one step in milliseconds, filled in at the end of the step.

    `wall_ms` is the wall time. `kernel_ms` is the execution time of kernels. `codegen_ms` is the time to generate and
    compile kernels. Both come from `dr.kernel_history`. `new_kernels` counts kernels that no earlier step of the same
    clock launched. The history's `cache_hit` cannot replace `new_kernels`, because `cache_hit` is also true for kernels
    from the disk cache.
    """

    wall_ms: float = 0.0
    kernel_ms: float = 0.0
    codegen_ms: float = 0.0
    new_kernels: int = 0


class StepClock:
    """Clock for steps. The clock also adds up the time of an optimisation. The time for writing files does not
    count.
    """

    def __init__(self, elapsed_s: float = 0.0) -> None:
        self.elapsed_s = elapsed_s
        #: Kernel history of the last step.
        self.history: list[dict[str, Any]] = []
        self._known: set[Any] = set()

    @contextmanager
    def step(self) -> Iterator[StepTimes]:
        """Time the block as one step, with the kernel history enabled, and wait for its kernels."""
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
        """Add the time of the block to `elapsed_s`."""
        start = time.perf_counter()
        yield
        dr.sync_thread()
        self.elapsed_s += time.perf_counter() - start


def summarise(history: list[dict[str, Any]]) -> tuple[float, float]:
    """Sum a kernel history in milliseconds: execution, and code generation with compilation.

    Copies and reductions count as execution.
    """
    execution = sum(entry.get("execution_time", 0.0) for entry in history)
    codegen = sum(entry.get("codegen_time", 0.0) + entry.get("backend_time", 0.0) for entry in history)
    return float(execution), float(codegen)


def reset_peak() -> None:
    """Reset the memory peak to the memory in use now.

    The flush is needed because the allocator's statistics also count blocks that are kept for reuse. The garbage
    collection is needed because nothing else frees unused scenes.
    """
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()


def peak_mib(backend: Any) -> float:
    """Return the peak of allocated memory since `reset_peak`, in MiB, on `backend` (a `dr.JitBackend`).

    Thread-local memory (`dr.Local`) is not included.
    """
    return float(dr.detail.malloc_watermark(backend)) / MIB
