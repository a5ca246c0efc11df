"""Choice of the Mitsuba variant: CUDA if Mitsuba can trace rays with it, otherwise LLVM."""

from __future__ import annotations

import ctypes
import functools
import gc
import logging
import os
import subprocess
import sys
from importlib import metadata
from types import ModuleType

from reslrb_cli.backend import llvm
from reslrb_cli.backend.installation import MISSING_LIBRARY, load_packages, prefer_own_plugins, python_command
from reslrb_cli.backend.shared_library import missing_library
from reslrb_cli.errors import BackendError, ConfigError

logger = logging.getLogger(__name__)

# A constant that no kernel cache contains makes the compiler run; `minimum` is the instruction that libLLVM 15 and 16
# fail on.
_SCRIPT = """
import sys, time
import reslrb_cli
from reslrb_cli.backend.installation import load_packages, prefer_own_plugins

dr, mi = load_packages()
mi.set_variant(sys.argv[1])
prefer_own_plugins()
salt = (time.time_ns() & 0xFFFFFF) * 1e-6
value = dr.minimum(dr.sin(dr.arange(mi.Float, 1 << 20)) + salt, 0.5)
assert abs(value[0] - min(salt, 0.5)) < 1e-4, f"wrong result {value[0]}"

scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere"}})
t = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1))).t
assert abs(t[0] - 2) < 1e-4, f"a ray met the unit sphere at {t[0]} instead of 2"
"""

#: Prefix of the line of our own error in a traceback.
_OURS = "reslrb_cli.errors.BackendError: "


def set_variant(name: str = "auto") -> str:
    """Set the variant `name` and return the variant. `auto` is `cuda_ad_rgb` if it works, otherwise `llvm_ad_rgb`.

    Raises BackendError, before Mitsuba is imported, if the backend of `name` is missing.
    """
    chosen, why = choose(name)
    if chosen.startswith("cuda") and name != "auto":
        missing = missing_cuda(chosen)
        if missing:
            advice = "install NVIDIA's driver (535 or newer, with OptiX), or use `variant: llvm_ad_rgb`"
            raise BackendError(f"variant {chosen}: {missing}; {advice}")
    library = llvm.require() if chosen.startswith("llvm") else None
    dr, mi = load_packages()
    if chosen not in mi.variants():
        raise BackendError(f"this Mitsuba has no variant {chosen}; it has {', '.join(mi.variants())}")
    if library is not None:
        _check_loaded_llvm(dr)
    is_first = mi.variant() is None
    try:
        mi.set_variant(chosen)
    except (ImportError, AttributeError, RuntimeError) as error:
        raise BackendError(f"variant {chosen} does not start: {error}") from error
    _have_two_threads(dr)
    prefer_own_plugins()
    if is_first:
        gc.freeze()  # a search of all modules for unused scenes takes 0.04 s, and a run makes several
    logger.info("variant %s%s%s", chosen, f" (libLLVM {library.version})" if library else "", why)
    return chosen


def keep_variant(name: str, source: object) -> str:
    """Set the variant `name` if none is set, and return the current variant. `auto` accepts any supported variant.

    Raises ConfigError, located in `source`, if another variant is set. A change of variant would invalidate the
    caller's objects.
    """
    mi = sys.modules.get("mitsuba")
    now: str | None = None if mi is None else mi.variant()
    if now is None:
        return set_variant(name)
    if name not in ("auto", now):
        advice = "remove `variant`, or use another process"
        raise ConfigError(source, "variant", f"is {name}, but {now} is set in this process; {advice}")
    check_variant(now)
    return set_variant(now)


def choose(name: str = "auto") -> tuple[str, str]:
    """Return the variant for `name`, and an explanation for the log."""
    if name != "auto":
        return name, ""
    missing = missing_cuda("cuda_ad_rgb")
    return ("llvm_ad_rgb", f"; no CUDA: {missing}") if missing else ("cuda_ad_rgb", "")


def works_under(variant: str) -> bool:
    """True if the integrators support `variant`. A supported variant has derivatives, and no polarization."""
    return variant.endswith(("_ad_rgb", "_ad_mono", "_ad_spectral"))


@functools.cache
def check_variant(variant: str | None) -> None:
    """Raise BackendError if the current variant is not supported, none is set, or its libLLVM would end the process."""
    import mitsuba as mi

    if variant is None or not works_under(variant):
        is_set = "no variant is set" if variant is None else f"variant {variant} is set, which reslrb does not support"
        works = ", ".join(sorted(filter(works_under, mi.variants()), key=lambda name: not name.endswith("_rgb")))
        raise BackendError(f"{is_set}; call mitsuba.set_variant(...) with one of {works}")
    if variant.startswith("llvm") and (fault := llvm.loaded_fault()):
        raise BackendError(fault)


def missing_cuda(variant: str = "cuda_ad_rgb") -> str:
    """Return the reason why Mitsuba cannot trace rays with the CUDA variant, or "" if it can.

    Without NVIDIA's driver the answer is immediate. With the driver, a separate process traces a ray, because a GPU in
    a container often has CUDA but no OptiX.
    """
    try:
        ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1")
    except OSError:
        return "no NVIDIA driver (libcuda.so.1) found"
    return probe(variant)


@functools.cache
def probe(variant: str) -> str:
    """Compile and run one kernel and trace one ray under `variant`, in a separate process. Returns the reason of a
    failure in one line, or "" if the variant works.

    A faulty driver or libLLVM may crash the process instead of raising an exception. Only a parent process can detect
    this.
    """
    command = [*python_command(_SCRIPT), variant]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return "no result within 300 s"
    except OSError as error:
        return f"could not be tested ({error})"
    if done.returncode == 0:
        return ""
    missing = missing_library(done.stderr)
    if missing:
        return f"Mitsuba needs {missing}, which is missing; {MISSING_LIBRARY}"
    said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    if done.returncode < 0:
        return f"ended by signal {-done.returncode}: {said[0] if said else 'no message'}"
    return said[-1].removeprefix(_OURS) if said else f"ended with code {done.returncode}"


def package_version(name: str) -> str | None:
    """Return the version of an installed package, or None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _have_two_threads(dr: ModuleType) -> None:
    """Give Dr.Jit two threads if the process has one core.

    With one thread, Mitsuba 3.9 never finishes reading or writing an EXR file.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if cores == 1 and dr.thread_count() == 1:
        dr.set_thread_count(2)


def _check_loaded_llvm(dr: ModuleType) -> None:
    """Raise BackendError if Dr.Jit has no usable libLLVM, or a libLLVM that would end the process.

    Both can happen only if Dr.Jit was imported before reslrb_cli, and chose its libLLVM itself.
    """
    fault = llvm.loaded_fault()
    if not fault and not dr.has_backend(dr.JitBackend.LLVM):
        fault = "Dr.Jit was imported before reslrb_cli and found no usable libLLVM; import reslrb_cli first, or set "
        fault += llvm.VARIABLE
    if fault:
        raise BackendError(fault)
