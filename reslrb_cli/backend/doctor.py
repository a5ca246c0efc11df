"""Gathers what `reslrb doctor` says: versions, libraries, device, and a trial of each backend."""

from __future__ import annotations

import platform
import re
import sys
from dataclasses import dataclass
from importlib import metadata

from reslrb_cli.backend import llvm
from reslrb_cli.backend.device import device_name
from reslrb_cli.backend.probe import Probe, probe
from reslrb_cli.backend.variant import missing_cuda, package_version
from reslrb_cli.errors import BackendError

_WITHOUT_METADATA = ["mitsuba", "drjit", "numpy"]


@dataclass(frozen=True)
class Backend:
    """One backend: `missing` says in one line what it lacks (empty: nothing), `trial` what a kernel and a ray took."""

    variant: str
    missing: str
    device: str
    library: str
    trial: Probe


@dataclass(frozen=True)
class Report:
    """All of it; `variant` is what `auto` stands for here, None where no backend works."""

    variant: str | None
    python: str
    platform: str
    packages: dict[str, str | None]
    backends: tuple[Backend, ...]


def examine() -> Report:
    """Looks at this machine; takes a few seconds, and never raises for what is missing."""
    backends = (_cuda(), _llvm())
    return Report(
        variant=next((backend.variant for backend in backends if not backend.missing), None),
        python=f"{platform.python_version()} ({sys.executable})",
        platform=platform.platform(),
        packages={name: package_version(name) for name in ["reslrb", *_required()]},
        backends=backends,
    )


def _required() -> list[str]:
    """Names of the packages that this one needs, its optional ones left out."""
    try:
        needs = metadata.requires("reslrb") or []
    except metadata.PackageNotFoundError:
        return _WITHOUT_METADATA
    names = (re.match(r"[\w.-]+", need) for need in needs if "extra ==" not in need)
    return [name[0] for name in names if name]


def _cuda() -> Backend:
    missing = missing_cuda()
    trial = Probe(missing) if missing else probe("cuda_ad_rgb")
    return Backend("cuda_ad_rgb", missing, "" if missing else device_name("cuda_ad_rgb"), "", trial)


def _llvm() -> Backend:
    device = device_name("llvm_ad_rgb")
    try:
        library = llvm.require()
    except BackendError as error:
        return Backend("llvm_ad_rgb", str(error), device, "", Probe(str(error)))
    trial = probe("llvm_ad_rgb")
    return Backend("llvm_ad_rgb", trial.failure, device, f"libLLVM {library.version}, {library.path}", trial)
