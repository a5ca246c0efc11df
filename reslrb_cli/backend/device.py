"""Names of the devices that kernels run on."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
from pathlib import Path


def device_name(variant: str) -> str:
    """The device that the Mitsuba variant `variant` runs on."""
    return gpu_name() if variant.startswith("cuda") else f"{cpu_name()}, {os.cpu_count()} threads"


def gpu_name() -> str:
    """The NVIDIA GPU and its driver's version, as far as `nvidia-smi` tells."""
    command = shutil.which("nvidia-smi")
    if command is None:
        return "NVIDIA GPU"
    query = [command, "--query-gpu=name,driver_version", "--format=csv,noheader"]
    return subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip().replace("\n", "; ")


def cpu_name() -> str:
    """The processor's model, or at least its architecture."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1] if found else platform.machine()
