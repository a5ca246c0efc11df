"""Loader of a shared library with dependencies in the same folder. As a script, the module prints the LLVM version of a
library.

The module imports nothing of this package, so it can run by path in a bare interpreter. If a library crashes during
loading, only this interpreter ends.
"""

from __future__ import annotations

import ctypes
import re
import sys
from pathlib import Path

# glibc: "libz3.so.4: cannot open shared object file: ...", macOS: "Library not loaded: @rpath/libz3.dylib"
_MISSING = re.compile(
    r"(?:^|\s)(?P<so>[\w.+-]+\.so[\w.]*): cannot open shared object|Library not loaded: (?P<dylib>\S+)"
)


def missing_library(message: str) -> str | None:
    """Return the file name of the library that the dynamic loader reports as missing in `message`, or None."""
    found = _MISSING.search(message)
    return (found["so"] or Path(found["dylib"]).name) if found else None


def load(path: Path, depth: int = 0) -> ctypes.CDLL:
    """Load the library `path`. Dependencies that the system lacks are loaded from the same folder. Raises OSError.

    The dynamic loader uses libraries that are already in the process. Loading the dependencies first is therefore
    enough. Neither an rpath nor LD_LIBRARY_PATH is needed.
    """
    while True:
        try:
            return ctypes.CDLL(str(path))
        except OSError as error:
            missing = missing_library(str(error))
            beside = sorted(path.parent.glob(f"{missing}*")) if missing else []
            if not beside or depth > 8:
                raise
            load(beside[0], depth + 1)
            depth += 1


def llvm_version(library: ctypes.CDLL) -> tuple[int, int, int] | None:
    """Return the version of a loaded libLLVM, or None for versions before 16, which report no version."""
    if not hasattr(library, "LLVMGetVersion"):
        return None
    parts = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, parts))
    return parts[0].value, parts[1].value, parts[2].value


if __name__ == "__main__":
    try:
        version = llvm_version(load(Path(sys.argv[1])))
    except OSError as error:
        sys.exit(str(error))
    print(".".join(map(str, version)) if version else "unknown")
