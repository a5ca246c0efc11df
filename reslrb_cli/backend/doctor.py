"""This machine: backends and packages for `reslrb doctor`, and the name and memory of the device.

Forecasts of memory use `free_bytes`, `resident_bytes` and `local_bytes` as limits.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from reslrb_cli.backend import llvm
from reslrb_cli.backend.variant import missing_cuda, package_version, probe
from reslrb_cli.errors import BackendError

#: Stack size of a thread if the system sets no limit: glibc's default.
_UNLIMITED_STACK = 2 * 2**20

#: Part of the stack that is in use when a kernel starts.
_IN_USE = 2**20

#: Lanes of a vector by processor feature, the widest first; the backend uses the widest.
_LANES = (("avx512vl", 16), ("avx", 8))

#: Seconds for `nvidia-smi`, which hangs if the driver does.
PATIENCE = 20.0


def device_name(variant: str) -> str:
    """Return the device of a Mitsuba variant: GPU and driver version, or processor and threads."""
    if variant.startswith("cuda"):
        return "; ".join(ask_gpu("name,driver_version")) or "NVIDIA GPU"
    return f"{of_system('/proc/cpuinfo', 'model name') or platform.machine()}, {os.cpu_count()} threads"


def ask_gpu(query: str) -> list[str]:
    """Return the line that `nvidia-smi` prints for each GPU. Numbers have no units.

    The list is empty if the program is missing or does not answer in time.
    """
    command = shutil.which("nvidia-smi")
    if command is None:
        return []
    words = [command, f"--query-gpu={query}", "--format=csv,noheader,nounits"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return []
    return done.stdout.strip().splitlines()


def gpu_bytes(kind: str, most: int) -> int:
    """Return `memory.total` or `memory.free` of the GPU with the smallest value, at most `most`. Returns `most` if it
    is unknown.
    """
    return min([most, *(int(line) * 2**20 for line in ask_gpu(kind) if line.isdigit())])


def of_system(file: str, name: str) -> str | None:
    """Return the value of the first entry `name` in a system file, or None without an entry."""
    try:
        found = re.search(rf"^{name}\s*:\s*(.+)$", Path(file).read_text(), re.MULTILINE)
    except OSError:
        return None
    return found and found[1]


#: The control groups of this process, and the folder of all groups.
OWN_GROUPS, GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def _group_limits() -> Iterator[tuple[int, int]]:
    """Yield the limit and the use of memory, in bytes, of each control group around this process.

    Slurm and systemd set limits on nested groups. Version 1 of control groups has other names.
    """
    try:
        lines = OWN_GROUPS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        kinds, _, path = line.partition(":")[2].partition(":")
        if kinds and "memory" not in kinds.split(","):
            continue
        top = GROUPS / "memory" if kinds else GROUPS
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes") if kinds else ("memory.max", "memory.current")
        group = top / path.lstrip("/")
        for each in (group, *group.parents):  # a container may not see the group, but those above
            if each.is_relative_to(top):
                with contextlib.suppress(OSError, ValueError):  # no file, or `max`: no limit
                    limit, used = (int((each / name).read_text()) for name in names)
                    yield limit, used


def memory_bytes(variant: str) -> int:
    """Return the memory that `variant` can use, in bytes: the GPU's memory, or the part of the machine's memory that
    this process may use.
    """
    if variant.startswith("cuda"):
        return gpu_bytes("memory.total", 2**40)  # unknown: more than any has, so that it never counts as scarce
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([total, *(limit for limit, _ in _group_limits())])


def free_bytes(variant: str) -> int:
    """Return the number of bytes that a process of `variant` can still allocate on the GPU or the machine.

    Memory of this process counts as used. If the free memory is unknown, returns all memory (`memory_bytes`).
    """
    if variant.startswith("cuda"):
        return gpu_bytes("memory.free", memory_bytes(variant))
    known = [memory_bytes(variant)]
    if available := of_system("/proc/meminfo", "MemAvailable"):
        known.append(int(available.removesuffix(" kB")) * 1024)
    known += [limit - used for limit, used in _group_limits()]
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


@dataclass(frozen=True)
class Backend:
    """Backend of Dr.Jit. `missing` is one line that explains why the backend does not work, or "" if it works."""

    variant: str
    missing: str
    device: str
    library: str = ""


def backends() -> list[Backend]:
    """Test both backends, which takes a few seconds. `auto` selects the first one that works."""
    missing, device = missing_cuda(), device_name("llvm_ad_rgb")
    cuda = Backend("cuda_ad_rgb", missing, "" if missing else device_name("cuda_ad_rgb"))
    try:
        library = llvm.require()
    except BackendError as error:
        return [cuda, Backend("llvm_ad_rgb", str(error), device)]
    return [cuda, Backend("llvm_ad_rgb", probe("llvm_ad_rgb"), device, f"libLLVM {library.version}, {library.path}")]


def packages() -> dict[str, str | None]:
    """Return the versions of `reslrb` and the packages that it needs. The version of a missing package is None."""
    return {name: package_version(name) for name in ["reslrb", *_required()]}


def _required() -> list[str]:
    """Return the names of the required packages, without optional ones."""
    try:
        needs = metadata.requires("reslrb") or []
    except metadata.PackageNotFoundError:
        return ["mitsuba", "drjit", "numpy"]
    names = (re.match(r"[\w.-]+", need) for need in needs if "extra ==" not in need)
    return [name[0] for name in names if name]
