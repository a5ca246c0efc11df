"""Search for the libLLVM that Dr.Jit should load: the newest one on this machine that works.

Dr.Jit looks for libLLVM only in Debian's folders. Dr.Jit also accepts LLVM versions that make Dr.Jit end the process.
For example, LLVM 15 and 16 fail with "Cannot select fminimum" on AVX-512 machines. This module therefore chooses
libLLVM before Dr.Jit is imported, and passes the choice in DRJIT_LIBLLVM_PATH.
"""

from __future__ import annotations

import functools
import os
import platform
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from reslrb_cli.backend import shared_library
from reslrb_cli.errors import BackendError

VARIABLE = "DRJIT_LIBLLVM_PATH"
MIN_VERSION = 19

# scripts/setup unpacks Debian's packages here if the system lacks a library
UNPACKED = Path(__file__).resolve().parents[2] / ".cache" / "lib"
_NAME = re.compile(r"libLLVM(?:-(\d+)(?:\.\d+)*)?(?:\.so(?:\.(\d+)(?:\.\d+)*)?|(?:\.(\d+)(?:\.\d+)*)?\.dylib)")


@dataclass(frozen=True)
class Library:
    """A libLLVM on this machine: its file, its version (`19.1.7`), and the `fault` that rules it out, if any."""

    path: Path
    version: str = ""
    fault: str = ""


def prepare() -> None:
    """Choose libLLVM, unless the user has chosen one or Dr.Jit is already loaded. Also load missing dependencies.

    Never raises; `require` reports failures if LLVM is needed. Warns if Dr.Jit is already loaded and has a libLLVM that
    would end the process.
    """
    mi = sys.modules.get("mitsuba")
    uses_cuda = mi is not None and str(getattr(mi, "variant", str)()).startswith("cuda")
    if not uses_cuda and (fault := loaded_fault()):
        warnings.warn(fault, stacklevel=3)
    if not os.environ.get(VARIABLE) and "drjit" not in sys.modules:
        library, _ = choose()
        if library is not None:
            os.environ[VARIABLE] = str(library.path)
    unpacked = sorted(UNPACKED.glob("libatomic.so*"))  # Dr.Jit's wheels need it; a minimal Debian lacks it
    chosen = Path(os.environ.get(VARIABLE, ""))
    for path in [*unpacked, *([chosen] if chosen.parent == UNPACKED else [])]:
        with suppress(OSError):
            shared_library.load(path)


def loaded_fault() -> str:
    """Return why the libLLVM that Dr.Jit has loaded is unusable, and what to do, or "". Dr.Jit keeps its first libLLVM.

    The result is "" if Dr.Jit is not loaded, or has no libLLVM.
    """
    dr = sys.modules.get("drjit")
    try:
        major = dr.detail.llvm_version()[0] if dr and dr.has_backend(dr.JitBackend.LLVM) else MIN_VERSION
    except AttributeError:  # Dr.Jit is being imported
        return ""
    if major >= MIN_VERSION:
        return ""
    best, _ = choose()
    remedy = _what_to_install() if best is None else f"set {VARIABLE}={best.path}"
    return (
        f"Dr.Jit was imported before reslrb_cli and loaded libLLVM {major}, which can end the process; "
        f"import reslrb_cli before mitsuba and drjit, or {remedy}"
    )


def require() -> Library:
    """Return the libLLVM that Dr.Jit loads. Raises BackendError if libLLVM is missing, broken, or would end the
    process.
    """
    named = os.environ.get(VARIABLE)
    if named:
        library = _examine(Path(named))
        if library.fault:
            raise BackendError(f"{VARIABLE}={named}: {library.fault}; {_what_to_install()}, or unset {VARIABLE}")
        return library
    best, passed_over = choose()
    if best is None:
        found = "; ".join(f"{library.path}: {library.fault}" for library in passed_over) or "none found"
        raise BackendError(
            f"no usable libLLVM ({MIN_VERSION} or newer) on this machine ({found}); {_what_to_install()}"
        )
    return best


@functools.cache
def choose() -> tuple[Library | None, list[Library]]:
    """Return the newest working libLLVM on this machine or None, and the rejected libraries."""
    passed_over: list[Library] = []
    best: Library | None = None
    for path in sorted(candidates(), key=lambda path: -(version_from_name(path) or MIN_VERSION)):
        named = version_from_name(path)
        if best is not None and named is not None and named <= _major(best.version):
            break
        library = _examine(path)
        if library.fault:
            passed_over.append(library)
        elif best is None or _major(library.version) > _major(best.version):
            best = library
    return best, passed_over


def candidates() -> list[Path]:
    """Return every libLLVM in the known folders. Each file appears once, files in the nearest folder first."""
    found = [path for folder in _folders() for path in sorted(folder.glob("libLLVM*")) if _NAME.fullmatch(path.name)]
    unique: dict[Path, Path] = {}
    for path in found:
        with suppress(OSError, RuntimeError):  # a broken or circular link
            unique.setdefault(path.resolve(strict=True), path)
    return list(unique)


def version_from_name(path: Path) -> int | None:
    """Return the major version in the name of the file (`libLLVM-15.so.1`, `libLLVM.so.19.1`), or None."""
    found = _NAME.fullmatch(path.name)
    return next((int(part) for part in found.groups() if part), None) if found else None


@functools.cache
def _examine(path: Path) -> Library:
    """Load the library `path` in a separate process, unless the file name already rules the library out."""
    named = version_from_name(path.resolve())
    if named is not None and named < MIN_VERSION:
        return Library(path, fault=_too_old(str(named)))
    if not path.is_file():
        return Library(path, fault="no such file")
    try:
        command = [sys.executable, "-I", "-S", shared_library.__file__, str(path)]
        probe = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Library(path, fault=f"could not be tested ({error})")
    if probe.returncode != 0:
        message = " ".join(probe.stderr.split()) or f"loading it ended a process with code {probe.returncode}"
        missing = shared_library.missing_library(message)
        return Library(path, fault=f"it needs {missing}, which is missing" if missing else message)
    version = probe.stdout.strip()
    if version == "unknown":
        version = "before 16" if named is None else str(named)
    elif _major(version) >= MIN_VERSION:
        return Library(path, version)
    return Library(path, fault=_too_old(version))


def _too_old(version: str) -> str:
    return f"version {version} is too old; some versions before {MIN_VERSION} make Dr.Jit end the process"


def _major(version: str) -> int:
    return int(version.split(".")[0])


def _folders() -> Iterator[Path]:
    """Yield the folders that may contain a libLLVM. The folders of the Python environment come before the folders of
    the system.
    """
    yield UNPACKED
    roots = [sys.prefix, os.environ.get("CONDA_PREFIX"), sys.base_prefix]
    yield from (Path(root) / "lib" for root in dict.fromkeys(roots) if root)
    for pattern in (
        f"usr/lib/{platform.machine()}-linux-gnu*", "usr/lib64", "usr/lib64/llvm*/lib*", "usr/lib/llvm*/lib*",
        "usr/lib", "usr/local/lib", "usr/local/lib64", "opt/homebrew/opt/llvm*/lib", "usr/local/opt/llvm*/lib",
        "home/linuxbrew/.linuxbrew/opt/llvm*/lib", "usr/lib/llvm/*/lib*",
    ):  # fmt: skip
        yield from sorted(Path("/").glob(pattern))


def _what_to_install() -> str:
    """Return the command that installs a libLLVM on this machine."""
    if os.environ.get("CONDA_PREFIX"):
        return f"install it with `conda install -c conda-forge 'llvmdev>={MIN_VERSION}'`"
    if sys.platform == "darwin":
        return "install it with `brew install llvm`"
    if shutil.which("apt-get"):
        return f"install it with `apt-get install libllvm{MIN_VERSION}` (or run scripts/setup, which needs no root)"
    return f"install the shared library of LLVM {MIN_VERSION} or newer"
