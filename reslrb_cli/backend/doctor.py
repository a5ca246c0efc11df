"""Examination for `reslrb doctor`: versions, libraries, device, and a trial of each backend.

The module also reports a device's name, its memory, and the number of paths that the device traces at once.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from reslrb_cli.backend import llvm
from reslrb_cli.backend.probe import Probe, probe
from reslrb_cli.backend.variant import missing_cuda, package_version
from reslrb_cli.errors import BackendError

#: Lanes of a vector on the CPU, at most (AVX-512); resident threads of a large GPU, where the driver does not tell.
LLVM_LANES, LARGE_GPU = 16, 132 * 2048

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


def memory_bytes(variant: str) -> int:
    """Return the memory that `variant` can use, in bytes: the GPU's memory, or the part of the machine's memory that
    this process may use.
    """
    if variant.startswith("cuda"):
        return gpu_bytes("memory.total", 2**40)  # unknown: more than any has, so that it never counts as scarce
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        return min(total, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):  # no control groups, or `max`: no limit
        return total


def resident_paths() -> int:
    """Return the number of lanes that the current device runs simultaneously. Each lane has its own thread-local
    memory.
    """
    import drjit as dr
    import mitsuba as mi

    if not mi.variant().startswith("cuda"):
        return (dr.thread_count() + 1) * LLVM_LANES
    import ctypes

    try:
        driver, count = ctypes.CDLL("libcuda.so.1"), []
        for attribute in (16, 39):  # multiprocessors, and the most threads on each
            value = ctypes.c_int()
            if driver.cuDeviceGetAttribute(ctypes.byref(value), attribute, 0):
                return LARGE_GPU
            count.append(value.value)
    except (OSError, AttributeError):
        return LARGE_GPU
    return count[0] * count[1]


_WITHOUT_METADATA = ["mitsuba", "drjit", "numpy"]


@dataclass(frozen=True)
class Backend:
    """Backend of Dr.Jit.

    `missing` is one line that explains why the backend does not work. `missing` is empty if the backend works. `trial`
    holds the measured times of one kernel and one ray.
    """

    variant: str
    missing: str
    device: str
    library: str
    trial: Probe


@dataclass(frozen=True)
class Report:
    """Result of the examination. `variant` is the variant that `auto` selects, or None if no backend works."""

    variant: str | None
    python: str
    platform: str
    packages: dict[str, str | None]
    backends: tuple[Backend, ...]


def examine() -> Report:
    """Examine this machine; takes a few seconds, and never raises for missing parts."""
    missing = missing_cuda()
    device, trial = ("", Probe(missing)) if missing else (device_name("cuda_ad_rgb"), probe("cuda_ad_rgb"))
    backends = (Backend("cuda_ad_rgb", missing, device, "", trial), _llvm())
    return Report(
        variant=next((backend.variant for backend in backends if not backend.missing), None),
        python=f"{platform.python_version()} ({sys.executable})",
        platform=platform.platform(),
        packages={name: package_version(name) for name in ["reslrb", *_required()]},
        backends=backends,
    )


def _required() -> list[str]:
    """Return the names of the required packages, without optional ones."""
    try:
        needs = metadata.requires("reslrb") or []
    except metadata.PackageNotFoundError:
        return _WITHOUT_METADATA
    names = (re.match(r"[\w.-]+", need) for need in needs if "extra ==" not in need)
    return [name[0] for name in names if name]


def _llvm() -> Backend:
    device = device_name("llvm_ad_rgb")
    try:
        library = llvm.require()
    except BackendError as error:
        return Backend("llvm_ad_rgb", str(error), device, "", Probe(str(error)))
    trial = probe("llvm_ad_rgb")
    return Backend("llvm_ad_rgb", trial.failure, device, f"libLLVM {library.version}, {library.path}", trial)
