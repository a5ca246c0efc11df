"""Kernels of the default suite are compiled without LLVM's optimisations: most of its time was spent on those.

LLVM gets the same kernels; its optional passes are left out, by `-opt-bisect-limit=0`, its documented way of doing so.
No pass may reassociate or approximate, so values are the same; the kernels run slower, which small ones do not feel.
`-m long`, whose kernels run for minutes, has LLVM as users have it.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

from reslrb_cli.backend import llvm, shared_library

#: Dr.Jit knows a kernel on the disk by what it computes, so those of users have to lie elsewhere.
CACHE = Path("~/.drjit-tests")
OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=0")
#: What Python runs first in a process that a test starts.
STARTED = Path(__file__).parent / "started"
#: Older ones name each pass that they leave out.
SILENT_SINCE = (20, 0, 0)


def search_path(*first: Path) -> str:
    """PYTHONPATH of a process that looks in these folders first, and then where this one would."""
    return os.pathsep.join([*map(str, first), *filter(None, [os.environ.get("PYTHONPATH")])])


def is_silent(library: ctypes.CDLL) -> bool:
    """Whether this libLLVM leaves passes out without a word."""
    version = shared_library.llvm_version(library)
    return version is not None and version >= SILENT_SINCE


def leave_out_optimisations() -> bool:
    """Tells libLLVM, before Dr.Jit uses it, to leave optimisations out, here and in processes that inherit the
    environment; False where there is no libLLVM that could."""
    path = Path(os.environ.get(llvm.VARIABLE, ""))
    if not path.is_file() or not is_silent(library := shared_library.load(path)):
        return False
    paths = [entry for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    if str(STARTED) not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join([str(STARTED), *paths])
        os.environ["DRJIT_CACHE_DIR"] = str(CACHE.expanduser())
    arguments = [b"tests", *map(str.encode, OPTIONS)]
    library.LLVMParseCommandLineOptions(len(arguments), (ctypes.c_char_p * len(arguments))(*arguments), b"")
    return True
