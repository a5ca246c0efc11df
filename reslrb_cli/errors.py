"""The errors that users see. Each error has an exit code and a one-line message. The message names the location and
never contains a traceback.
"""

from __future__ import annotations

import difflib
import enum
import errno
from collections.abc import Iterable

#: Maximum length of a message, and of the file or key that it names. Quoted text can be as long as a file, so longer
#: text is shortened in the middle.
MESSAGE_LENGTH = 600
PLACE_LENGTH = 300
LINE_LENGTH = MESSAGE_LENGTH + 2 * PLACE_LENGTH


def printable(text: object) -> str:
    """Return `text` with every unprintable character replaced by an escape such as `\\x1b`.

    Unprintable characters are control characters, marks that change the writing direction, line breaks, and the
    surrogates that Python uses for bytes that are not UTF-8. A file name may contain terminal commands as control
    characters. Letters of all scripts are unchanged.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


def one_line(text: object, most: int = MESSAGE_LENGTH) -> str:
    """Return `text` as one printable line of at most `most` characters. In a longer line, `...` replaces the middle."""
    line = " ".join(_shorten(str(text), 8 * most).split())  # shortened first, because splitting a long text is slow
    return _shorten(printable(_shorten(line, most)), most)


def _shorten(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    end = (most - 3) // 3
    return f"{text[: most - 3 - end]}...{text[len(text) - end :]}"


def similar(name: str, known: Iterable[str], count: int = 1, cutoff: float = 0.6) -> list[str]:
    """Return at most `count` of the `known` names that are similar to `name`, the most similar one first. Case does not
    matter. Similarities lie between 0 and 1, and a name with less than `cutoff` does not count.
    """
    names = {each.lower(): each for each in known}
    return [names[each] for each in difflib.get_close_matches(name.lower(), names, n=count, cutoff=cutoff)]


def did_you_mean(name: str, known: Iterable[str], count: int = 1, cutoff: float = 0.6, otherwise: str = "") -> str:
    """Return "did you mean `a` or `b`?" with the `similar` names, or `otherwise` if there are none."""
    near = similar(name, known, count, cutoff)
    return f"did you mean {' or '.join(f'`{each}`' for each in near)}?" if near else otherwise


def known_name(kind: str, name: str, names: Iterable[str]) -> str:
    """Return `name` as `names` spell it. Case does not matter. Raises ValueError with the nearest names, or all."""
    known = {each.lower(): each for each in names}
    if name.lower() in known:
        return known[name.lower()]
    hint = did_you_mean(name, known.values(), 3, otherwise=f"known are {', '.join(known.values())}")
    raise ValueError(f"there is no {kind} {name!r}; {hint}")


class ExitCode(enum.IntEnum):
    """Process exit codes, as documented in the README."""

    DONE = 0
    CHECK_FAILED = 1
    USAGE = 2
    BACKEND = 3
    OUT_OF_MEMORY = 4
    NON_FINITE = 5
    MACHINE = 6
    INTERRUPTED = 130


class ReslrbError(Exception):
    """Base class of all errors that `reslrb` reports itself. The user sees the line `str(error)`."""

    exit_code: ExitCode = ExitCode.USAGE

    def __init__(self, message: str = "") -> None:
        super().__init__(one_line(message, LINE_LENGTH))


class ConfigError(ReslrbError):
    """Error in the configuration or the input. The file and the key give the error's place.

    `source` is the file as the user named it. `key` is the place in the file, such as `parameters[0].bounds`, or empty
    for the whole file. `message` says what is wrong and how to correct it.
    """

    exit_code = ExitCode.USAGE

    def __init__(self, source: object, key: str, message: str) -> None:
        self.source, self.key = one_line(source, PLACE_LENGTH), one_line(key, PLACE_LENGTH)
        self.message = one_line(message)
        super().__init__(": ".join(part for part in (self.source, self.key, self.message) if part))


class UnsupportedScene(ReslrbError):
    """Scene that light tracing cannot render or differentiate. The message gives the reason.

    `option` is the setting that causes the error, such as `estimator`, or empty.
    """

    exit_code = ExitCode.USAGE

    def __init__(self, message: str = "", option: str = "") -> None:
        super().__init__(message)
        self.option = option


class BackendError(ReslrbError):
    """Missing CUDA device or libLLVM. The message says what to install."""

    exit_code = ExitCode.BACKEND


class OutOfMemory(ReslrbError):
    """Exhausted memory of the device or the host."""

    exit_code = ExitCode.OUT_OF_MEMORY


class NonFinite(ReslrbError):
    """Value that must be finite but is not. The error is raised before the value reaches a parameter."""

    exit_code = ExitCode.NON_FINITE


class MachineError(ReslrbError):
    """Machine failure that no setting causes, for example a full disk, a removed folder or a driver error."""

    exit_code = ExitCode.MACHINE


#: Phrases in out-of-memory messages of the backends, the C++ library, the loader and NumPy. Dr.Jit writes the last one
#: during cleanup, for the address of a failed mapping.
_MEMORY_WORDS = (
    "out of memory", "bad alloc", "cannot allocate memory", "could not allocate", "unable to allocate",
    "failed to map segment", "unknown address <0xffffffffffffffff>",
)  # fmt: skip


def mentions_memory(text: str) -> bool:
    """Whether the text of a message says that an allocation failed."""
    text = text.lower().replace("_", " ")
    return any(words in text for words in _MEMORY_WORDS)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception of `reslrb` or of a backend says that an allocation failed."""
    if isinstance(error, MemoryError | OutOfMemory) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    return isinstance(error, RuntimeError | ImportError) and mentions_memory(str(error))


#: File errors that no choice of the user causes: a full disk, a device or a server that does not answer.
_MACHINE_ERRNOS = {
    number
    for name in (
        "ENOSPC", "EDQUOT", "EFBIG", "EIO", "ENXIO", "ENODEV", "ESTALE", "EREMOTEIO", "ETIMEDOUT", "EHOSTDOWN",
        "ENOTCONN", "EMFILE", "ENFILE",
    )
    if (number := getattr(errno, name, None)) is not None
}  # fmt: skip

#: Beginnings of Dr.Jit's messages about a driver or a compiler, and prefixes of CUDA and OptiX error names.
_DRIVER_WORDS = (
    "cuda_check()", "jit_optix_check()", "jit_cuda_compile()", "jit_optix_compile()", "jit_llvm_compile()",
    "CUDA_ERROR_", "OPTIX_ERROR_",
)  # fmt: skip


def is_machine_fault(error: BaseException) -> bool:
    """Whether an exception says that the machine failed. Out-of-memory errors do not count."""
    if isinstance(error, MachineError):
        return True
    if isinstance(error, OSError):
        return error.errno in _MACHINE_ERRNOS
    return isinstance(error, RuntimeError) and any(word in str(error) for word in _DRIVER_WORDS)


#: Maximum length of a quoted library message.
QUOTED_LENGTH = 200


def tell(error: BaseException) -> tuple[str, int] | None:
    """Return the line and the exit code for `error`, or None for a bug. A bug needs its traceback."""
    if isinstance(error, ReslrbError):
        return str(error), error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", ExitCode.INTERRUPTED
    if is_out_of_memory(error):
        advice = "lower run.spp or the size of the film, or set integrator.samples_per_pass"
        return f"out of memory ({one_line(error, QUOTED_LENGTH) or 'host'}); {advice}", ExitCode.OUT_OF_MEMORY
    if isinstance(error, OSError) and (error.filename is not None or is_machine_fault(error)):
        code = ExitCode.MACHINE if is_machine_fault(error) else ExitCode.USAGE
        return ": ".join(str(part) for part in (error.filename, error.strerror) if part is not None), code
    if is_machine_fault(error):
        return f"the driver or its compiler failed: {one_line(error, QUOTED_LENGTH)}", ExitCode.MACHINE
    return None


def describe(error: BaseException) -> str:
    """Return one printable line for any exception."""
    told = tell(error)
    if told is None:
        return f"{type(error).__name__}: {one_line(error, QUOTED_LENGTH)}".rstrip(": ")
    return one_line(told[0], LINE_LENGTH)
