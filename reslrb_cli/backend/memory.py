"""Memory: what is free now, what a thread has for its own, and arrays of NumPy's copied into Dr.Jit's own.

`free_bytes`, `resident_bytes` and `local_bytes` are what a forecast is held against.

`own_memory` copies, since Dr.Jit takes up NumPy's memory as it lies, and compiles and records for its alignment, which
is random: the next array of the same size may lie otherwise, and then all is compiled and recorded once more.
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

#: What a thread's stack has where the system sets no limit: glibc's own.
_UNLIMITED_STACK = 2 * 2**20

#: What of it is in use where a kernel begins.
_IN_USE = 2**20

#: Lanes of a vector by what the processor knows, the widest first; the backend takes the widest.
_LANES = (("avx512vl", 16), ("avx", 8))


def free_bytes(variant: str) -> int:
    """Bytes that a process of `variant` can still have: of the GPU's memory, or of the machine's.

    Where nothing tells, the whole of it (`device.memory_bytes`). What this process has already counts as taken.
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
    """Bytes of memory that this process has had at the most, all that is in it counted."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def local_bytes() -> int:
    """Bytes of thread-local memory that a path can have on the CPU: its share of a thread's stack, on which it lies.

    A kernel that wants more writes over what lies behind the stack, or ends the process.
    """
    stack, _ = resource.getrlimit(resource.RLIMIT_STACK)
    stack = _UNLIMITED_STACK if stack == resource.RLIM_INFINITY else stack
    flags = (of_system("/proc/cpuinfo", "flags") or "").split()
    return max(stack - _IN_USE, 0) // next((lanes for name, lanes in _LANES if name in flags), 4)


def own_memory(kind: type[Any], array: np.ndarray[Any, Any]) -> Any:
    """`array` (n,) as a flat array of type `kind`, bit by bit, evaluated."""
    given = kind(np.ascontiguousarray(array))
    copy = dr.empty(kind, dr.width(given))
    # Gathered in its own order, an array would be returned as it is.
    dr.scatter(copy, given, dr.arange(dr.uint32_array_t(kind), dr.width(given)))
    dr.eval(copy)
    return copy
