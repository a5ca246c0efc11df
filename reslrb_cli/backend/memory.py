"""Memory: free memory, thread-local memory, and copies of NumPy arrays in Dr.Jit's memory.

`free_bytes`, `resident_bytes` and `local_bytes` are the limits for forecasts.

`own_memory` copies an array. Without the copy, Dr.Jit uses NumPy's memory. Dr.Jit's kernels then depend on the
alignment of NumPy's memory. NumPy may align the next array of the same size differently. Dr.Jit would then compile and
record everything again.
"""

from __future__ import annotations

import contextlib
import resource
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from reslrb_cli.backend.doctor import gpu_bytes, memory_bytes, of_system

#: Stack size of a thread if the system sets no limit: glibc's default.
_UNLIMITED_STACK = 2 * 2**20

#: Part of the stack that is in use when a kernel starts.
_IN_USE = 2**20

#: Lanes of a vector by processor feature, the widest first; the backend uses the widest.
_LANES = (("avx512vl", 16), ("avx", 8))


def free_bytes(variant: str) -> int:
    """Return the number of bytes that a process of `variant` can still allocate on the GPU or the machine.

    Memory of this process counts as used. If the free memory is unknown, returns all memory (`device.memory_bytes`).
    """
    if variant.startswith("cuda"):
        return gpu_bytes("memory.free", memory_bytes(variant))
    known = [memory_bytes(variant)]
    if available := of_system("/proc/meminfo", "MemAvailable"):
        known.append(int(available.removesuffix(" kB")) * 1024)
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        limit, used = ((group / name).read_text() for name in ("memory.max", "memory.current"))
        known.append(int(limit) - int(used))
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most != resource.RLIM_INFINITY:
        with contextlib.suppress(OSError, ValueError):
            known.append(most - int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize())
    return max(min(known), 0)


def resident_bytes() -> int:
    """Return the maximum memory of this process so far, in bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def local_bytes() -> int:
    """Return the thread-local bytes that a path can use on the CPU. Each path uses its share of a thread's stack.

    A kernel that needs more thread-local memory than this share overwrites other memory or crashes the process.
    """
    stack, _ = resource.getrlimit(resource.RLIMIT_STACK)
    stack = _UNLIMITED_STACK if stack == resource.RLIM_INFINITY else stack
    flags = (of_system("/proc/cpuinfo", "flags") or "").split()
    return max(stack - _IN_USE, 0) // next((lanes for name, lanes in _LANES if name in flags), 4)


def own_memory(kind: type[Any], array: np.ndarray[Any, Any]) -> Any:
    """Return `array` (n,) as an evaluated flat array of type `kind` with the same bits."""
    given = kind(np.ascontiguousarray(array))
    copy = dr.empty(kind, dr.width(given))
    # A gather in index order would return the array itself.
    dr.scatter(copy, given, dr.arange(dr.uint32_array_t(kind), dr.width(given)))
    dr.eval(copy)
    return copy
