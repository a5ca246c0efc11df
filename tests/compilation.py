"""In tests, kernels are compiled without LLVM's optimisations and run on one thread."""

from __future__ import annotations

import ctypes
import os
import platform
from pathlib import Path

from reslrb_cli.backend import llvm, shared_library

# The default suite compiles kernels without LLVM's optimisations, because optimisation took most of its time.  LLVM
# gets the same kernels. The documented option `-opt-bisect-limit=0` leaves out its optional passes,
# `-optimize-regalloc=false` allocates registers quickly, and `-combiner-disabled` leaves out the combination of
# operations, which took 29 % of the time. No pass may reassociate or approximate, so the values are the same. The
# kernels run slower, which is negligible for small kernels. Tests whose kernels run for seconds use the fixture
# `registers`, which saves about 10 % of their time. Without combination, LLVM ends the process (`Cannot select`) at a
# comparison of two masks on CPUs with AVX-512. Mitsuba's `checkerboard` has one. Tests that compile such kernels use
# the fixture `combined`.
# `-m long` has kernels that run for minutes, so it uses LLVM as users do.

#: Dr.Jit identifies a cached kernel by its computation, so the kernels of the tests need a folder apart from those of
#: users.
CACHE = Path("~/.drjit-tests")
REGISTERS = "-optimize-regalloc"
OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=0", f"{REGISTERS}=false")
#: Folder with the code that Python runs first in each process that a test starts.
STARTED = Path(__file__).parent / "started"
#: First LLVM version that does not print the name of each pass that it leaves out.
SILENT_SINCE = (20, 0, 0)
#: Option that leaves out the combiner, and the first LLVM version that is known to have it. LLVM ends the process if it
#: does not know an option. Only x86 was tried.
COMBINER, HAS_COMBINER_SINCE = "-combiner-disabled", (22, 0, 0)


def search_path(*first: Path) -> str:
    """Return the PYTHONPATH of a process that searches the given folders before the folders of this process's
    PYTHONPATH.
    """
    return os.pathsep.join([*map(str, first), *filter(None, [os.environ.get("PYTHONPATH")])])


def version_of(library: ctypes.CDLL) -> tuple[int, ...]:
    """Return the version of this libLLVM, or () if it is unknown."""
    return shared_library.llvm_version(library) or ()


def set_options(library: ctypes.CDLL, *options: str) -> None:
    """Set options of libLLVM for all kernels that it compiles from now on."""
    arguments = [b"tests", *map(str.encode, options)]
    library.LLVMParseCommandLineOptions(len(arguments), (ctypes.c_char_p * len(arguments))(*arguments), b"")


def combine(on: bool) -> None:
    """Turn LLVM's combiner on or off, if this libLLVM has an option for it."""
    library = shared_library.load(Path(os.environ[llvm.VARIABLE]))
    if version_of(library) >= HAS_COMBINER_SINCE and platform.machine() == "x86_64":
        set_options(library, f"{COMBINER}={'false' if on else 'true'}")


def allocate_registers(well: bool) -> None:
    """Let LLVM allocate registers well, or quickly as in OPTIONS."""
    library = shared_library.load(Path(os.environ[llvm.VARIABLE]))
    if version_of(library) >= SILENT_SINCE:
        set_options(library, f"{REGISTERS}={'true' if well else 'false'}")


def leave_out_optimisations() -> bool:
    """Make libLLVM leave out optimisations, before Dr.Jit uses libLLVM. The setting also applies to processes that
    inherit the environment. Return False if no libLLVM can leave them out silently.
    """
    path = Path(os.environ.get(llvm.VARIABLE, ""))
    if not path.is_file() or version_of(library := shared_library.load(path)) < SILENT_SINCE:
        return False
    paths = [entry for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    if str(STARTED) not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join([str(STARTED), *paths])
        os.environ["DRJIT_CACHE_DIR"] = str(CACHE.expanduser())
    set_options(library, *OPTIONS)
    combine(False)
    return True


# Most kernels gather. On CPUs with AVX2 that LLVM does not know as fast at it, LLVM replaces a gather by a branch for
# each lane, and one of its passes then starts over. Kernels with gather instructions have far fewer blocks. They
# compile in half the time, and their values are the same.

#: Dr.Jit's functions for the target of its kernels, and the feature of the target.
CORE = "libdrjit-core.so"
CPU, FEATURES, WIDTH, SET_TARGET = (
    "_Z19jit_llvm_target_cpuv",
    "_Z24jit_llvm_target_featuresv",
    "_Z21jit_llvm_vector_widthv",
    "_Z19jit_llvm_set_targetPKcS0_j",
)
GATHERS = b"+fast-gather"


def gather_at_once() -> None:
    """Compile gathers as instructions from now on, once a variant is set, if the CPU has AVX2 and nothing newer."""
    import drjit as dr

    try:
        core = ctypes.CDLL(str(Path(dr.__file__).parent / CORE))
        cpu, features, width, set_target = (getattr(core, name) for name in (CPU, FEATURES, WIDTH, SET_TARGET))
    except (OSError, AttributeError):
        return
    cpu.restype = features.restype = ctypes.c_char_p
    set_target.restype, set_target.argtypes = None, (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32)
    known = (features() or b"").split(b",")
    if b"+avx2" in known and b"+avx512f" not in known and GATHERS not in known:
        set_target(cpu(), b",".join([*known, GATHERS]), width())


#: Function of LLVM's type for a handler of fatal errors. LLVM needs the handler until the process ends.
_Handler = ctypes.CFUNCTYPE(None, ctypes.c_char_p)
_handlers: list[object] = []


def show_fatal_errors(descriptor: int) -> None:
    """Write LLVM's fatal errors to a file descriptor before they end the process. Pytest would lose them, because it
    captures standard error.
    """

    def write(reason: bytes) -> None:
        advice = b"\nA test with this kernel needs the fixture `combined` (tests/compilation.py).\n"
        os.write(descriptor, b"LLVM ERROR: " + reason + advice * reason.startswith(b"Cannot select"))

    _handlers.append(_Handler(write))
    shared_library.load(Path(os.environ[llvm.VARIABLE])).LLVMInstallFatalErrorHandler(_handlers[-1])


# In the default suite, the thread that launches a kernel also computes it.  After each kernel, Dr.Jit's other threads
# look for work for 20 ms before they sleep. This is longer than most kernels of these tests take, and it occupies cores
# that parallel tests need. `-m long` has large kernels and uses as many threads as users have. Processes that tests
# start do the same.

#: OpenEXR library that comes with Mitsuba's packages.
LIBRARY = "libIlmThread-mitsuba.so"
POOL = "_ZN13IlmThread_2_510ThreadPool"
PROVIDER = "PNS_18ThreadPoolProviderE"
MAKE, COMMON, PROVIDE = (
    f"{POOL}C1Ej",
    f"{POOL}16globalThreadPoolEv",
    f"{POOL}17setThreadProviderE{PROVIDER}",
)


def compute_alone() -> bool:
    """Use one thread from now on, once a variant is set. Return False if this Mitsuba's OpenEXR does not work with one
    thread.

    With one thread, Mitsuba's provider of threads would never read or write anything of an EXR file (CONTRIBUTING.md).
    A pool without threads has a provider that runs each task at once. That provider replaces Mitsuba's provider.
    """
    import drjit as dr
    import mitsuba as mi

    try:
        library = ctypes.CDLL(str(Path(mi.__file__).parent / LIBRARY))
        make, common, provide = (getattr(library, name) for name in (MAKE, COMMON, PROVIDE))
    except (OSError, AttributeError):
        return False
    common.restype = ctypes.c_void_p
    none = (ctypes.c_void_p * 2)()  # a ThreadPool points to its methods and its data (users, provider)
    make(none, 0)
    provider = ctypes.c_void_p.from_address(none[1] + ctypes.sizeof(ctypes.c_void_p))
    provide(ctypes.c_void_p(common()), provider)
    dr.set_thread_count(1)
    return True
