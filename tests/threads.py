"""Kernels of the default suite are computed by the thread that launches them.

Dr.Jit's other threads look for work for 20 ms, after each kernel, before they sleep: longer than most kernels of these
tests take, and on cores that the tests beside them need. `-m long`, whose kernels are large, has as many threads as
users have, and so have processes that tests start.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

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
