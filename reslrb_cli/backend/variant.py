"""Chooses and sets the Mitsuba variant: CUDA where Mitsuba can trace rays on it, LLVM elsewhere."""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import sys
from importlib import metadata
from types import ModuleType

from reslrb_cli.backend import llvm
from reslrb_cli.backend.installation import load_packages, prefer_own_plugins
from reslrb_cli.backend.probe import probe
from reslrb_cli.errors import BackendError, ConfigError

logger = logging.getLogger(__name__)


def set_variant(name: str = "auto") -> str:
    """Sets the variant `name` and returns what was set; `auto` is `cuda_ad_rgb` or else `llvm_ad_rgb`.

    Raises BackendError, before Mitsuba is imported, where the backend that `name` needs is missing.
    """
    chosen, why = choose(name)
    if chosen.startswith("cuda") and name != "auto":
        missing = missing_cuda(chosen)
        if missing:
            advice = "install NVIDIA's driver (535 or newer, with OptiX), or take `variant: llvm_ad_rgb`"
            raise BackendError(f"variant {chosen}: {missing}; {advice}")
    library = llvm.require() if chosen.startswith("llvm") else None
    dr, mi = load_packages()
    if chosen not in mi.variants():
        raise BackendError(f"this Mitsuba has no variant {chosen}; it has {', '.join(mi.variants())}")
    if library is not None:
        _check_loaded_llvm(dr)
    try:
        mi.set_variant(chosen)
    except (ImportError, AttributeError, RuntimeError) as error:
        raise BackendError(f"variant {chosen} does not start: {error}") from error
    _have_two_threads(dr)
    prefer_own_plugins()
    logger.info("variant %s%s%s", chosen, f" (libLLVM {library.version})" if library else "", why)
    return chosen


def keep_variant(name: str, source: object) -> str:
    """Sets the variant `name` where none is set, and returns what is set; `auto` is content with any that works.

    Raises ConfigError, located in `source`, where another one is set: what was made under that would be lost.
    """
    mi = sys.modules.get("mitsuba")
    now: str | None = None if mi is None else mi.variant()
    if now is None:
        return set_variant(name)
    if name not in ("auto", now):
        advice = "leave `variant` out, or take another process"
        raise ConfigError(source, "variant", f"is {name}, but {now} is set in this process; {advice}")
    check_variant(now)
    return set_variant(now)


def choose(name: str = "auto") -> tuple[str, str]:
    """The variant that `name` stands for, and what a log line has to add to it."""
    if name != "auto":
        return name, ""
    missing = missing_cuda("cuda_ad_rgb")
    return ("llvm_ad_rgb", f"; no CUDA: {missing}") if missing else ("cuda_ad_rgb", "")


def works_under(variant: str) -> bool:
    """Whether our integrators work under that variant of Mitsuba: with derivatives, by three colours or one."""
    return variant.endswith(("_ad_rgb", "_ad_mono"))


@functools.cache
def check_variant(variant: str | None) -> None:
    """Raises BackendError where the variant that is set is none under which our integrators work, or none is set."""
    import mitsuba as mi

    if variant is None or not works_under(variant):
        is_set = (
            "no variant is set" if variant is None else f"variant {variant} is set, under which reslrb does not work"
        )
        works = ", ".join(sorted(filter(works_under, mi.variants()), key=lambda name: not name.endswith("_rgb")))
        raise BackendError(f"{is_set}; call mitsuba.set_variant(...) with one of {works}")


def missing_cuda(variant: str = "cuda_ad_rgb") -> str:
    """Why Mitsuba cannot trace rays with the CUDA variant; empty where it can.

    A machine without NVIDIA's driver is told at once. With one, a ray is traced in a process of its own, since a GPU
    in a container often has CUDA but no OptiX.
    """
    try:
        ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1")
    except OSError:
        return "no NVIDIA driver (libcuda.so.1) found"
    return probe(variant).failure


def package_version(name: str) -> str | None:
    """Version of an installed package; None where it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _have_two_threads(dr: ModuleType) -> None:
    """Gives Dr.Jit two threads where the process has one core.

    It would have one, and with one Mitsuba 3.9 never comes to the end of reading or writing an EXR file.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if cores == 1 and dr.thread_count() == 1:
        dr.set_thread_count(2)


def _check_loaded_llvm(dr: ModuleType) -> None:
    """Refuses a libLLVM that a Dr.Jit imported before this package chose for itself."""
    fault = ""
    if not dr.has_backend(dr.JitBackend.LLVM):
        fault = "found no usable libLLVM"
    elif (major := dr.detail.llvm_version()[0]) < llvm.MIN_VERSION:
        fault = f"took libLLVM {major}, which would end the process"
    if fault:
        advice = f"import reslrb_cli first, or set {llvm.VARIABLE}"
        raise BackendError(f"Dr.Jit was imported before reslrb_cli and {fault}; {advice}")
