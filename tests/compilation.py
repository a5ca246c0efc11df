"""How tests compute: kernels without LLVM's optimisations, by one thread."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

from reslrb_cli.backend import llvm, shared_library

# Kernels of the default suite are compiled without LLVM's optimisations: most of its time was spent on those.
#
# LLVM gets the same kernels; its optional passes are left out, by `-opt-bisect-limit=0`, its documented way of doing
# so. No pass may reassociate or approximate, so values are the same; the kernels run slower, which small ones do not
# feel. `-m long`, whose kernels run for minutes, has LLVM as users have it.

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


# Kernels of the default suite are computed by the thread that launches them.
#
# Dr.Jit's other threads look for work for 20 ms, after each kernel, before they sleep: longer than most kernels of
# these tests take, and on cores that the tests beside them need. `-m long`, whose kernels are large, has as many
# threads as users have, and so have processes that tests start.

#: Of OpenEXR, as Mitsuba's packages bring it along.
LIBRARY = "libIlmThread-mitsuba.so"
POOL = "_ZN13IlmThread_2_510ThreadPool"
PROVIDER = "PNS_18ThreadPoolProviderE"
MAKE, COMMON, PROVIDE = (
    f"{POOL}C1Ej",
    f"{POOL}16globalThreadPoolEv",
    f"{POOL}17setThreadProviderE{PROVIDER}",
)


def compute_alone() -> bool:
    """One thread from now on, once a variant is set; False where this Mitsuba's OpenEXR cannot do with it.

    With Mitsuba's provider of threads nothing of an EXR file would ever be read or written (CONTRIBUTING.md). A pool
    of no threads has one that does at once what it is given; it is put in the place of Mitsuba's.
    """
    import drjit as dr
    import mitsuba as mi

    try:
        library = ctypes.CDLL(str(Path(mi.__file__).parent / LIBRARY))
        make, common, provide = (getattr(library, name) for name in (MAKE, COMMON, PROVIDE))
    except (OSError, AttributeError):
        return False
    common.restype = ctypes.c_void_p
    none = (ctypes.c_void_p * 2)()  # a ThreadPool: its methods, its data; of the data, users and provider
    make(none, 0)
    provider = ctypes.c_void_p.from_address(none[1] + ctypes.sizeof(ctypes.c_void_p))
    provide(ctypes.c_void_p(common()), provider)
    dr.set_thread_count(1)
    return True
