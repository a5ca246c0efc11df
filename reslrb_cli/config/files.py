"""Limits of settings, each with its reason, and functions that read the user's files."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import IO, BinaryIO

from reslrb_cli.errors import ConfigError, one_line

#: Name in error messages of a mapping or a dictionary that is not from a file.
NAMELESS = "<dict>"

#: Maximum length in bytes of the name of a run folder. File systems allow 255; the rest is for prefixes and suffixes.
NAME_BYTES = 200

#: Largest path length of a limit; -1 means no limit. Roulette lets at most 95 % of the paths continue at each vertex,
#: so none of 10^20 paths is a thousand vertices longer than `rr_depth`. Dr.Jit's largest array in thread-local memory,
#: which holds the record of a path of `trajectory`, has one entry more.
PATH_LENGTH = 2**16 - 1

#: Maximum number of kept connections or events per path. Each has its own code in the kernel, and the compile time
#: grows faster than their number: on two cores, 64 took seconds and 256 most of a minute.
CAPACITY = 1024

#: Light paths of one pass; their indices have 32 bits.
PASS_PATHS = 2**32 - 1

#: Samples per pixel of one pass. A sum in single precision loses terms below 2^-24 of it, but thousands of such passes
#: can be added.
PASS_SAMPLES = 2**18

#: Passes of a step. Each is launched separately, and its seed is drawn before the first pass.
PASSES = 2**16

#: Pixels of an image: 16384 x 8192, the largest environment map in use, 1.5 GiB decoded.
PIXELS = 2**27


def as_path(given: object, name: str, what: str) -> Path:
    """Return the argument `name` of a call as a path. Raises ConfigError for objects that are no path. `what` describes
    valid arguments in the error message.
    """
    if isinstance(given, (str, os.PathLike)):
        return Path(given)
    raise ConfigError(name, "", f"is {one_line(repr(given), 60)}, not {what}")


def open_file(path: Path) -> BinaryIO:
    """Open the file `path` to read it. Raises ConfigError, located in the file `path`, if the file cannot be read.

    The function refuses pipes, sockets and devices, because reading a pipe, socket or device may never end.
    """
    try:
        mode = os.stat(path).st_mode  # before it is opened, because opening some devices has side effects
        if stat.S_ISDIR(mode):
            raise ConfigError(path, "", "is a folder, not a file")
        if not stat.S_ISREG(mode):
            raise ConfigError(path, "", "is a pipe, a socket or a device, not a regular file")
        return path.open("rb")
    except FileNotFoundError:
        raise ConfigError(path, "", "no such file or folder") from None
    except (OSError, ValueError) as error:  # ValueError: a null character or half of a surrogate pair
        raise ConfigError(path, "", f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_file(path: Path) -> bytes:
    """Return all bytes of the file `path`. Raises ConfigError as `open_file` does."""
    with open_file(path) as file:
        try:
            return file.read()
        except OSError as error:
            raise ConfigError(path, "", f"cannot be read: {error.strerror}") from None


def tail(file: IO[bytes], most: int) -> bytes:
    """Return the last `most` bytes of an open file. `pread` leaves its offset alone, where a process may write."""
    return os.pread(file.fileno(), most, max(os.fstat(file.fileno()).st_size - most, 0))


def in_words(count: float) -> str:
    """A number of bytes in words, in the units of `peak_mib`: `300 B`, `256 KiB`, `1.5 MiB`, `2 GiB`."""
    for unit, name in ((2**40, "TiB"), (2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB")):
        if count >= unit:
            return f"{count / unit:.1f}".removesuffix(".0") + f" {name}"
    return f"{count:.0f} B"


def duration(seconds: float) -> str:
    """Return a time in words: `12.3 ms`, `4.56 s`, `3 min 20 s`, `2 h 5 min`, `3.1 days`."""
    if seconds < 1:
        return f"{1e3 * seconds:.3g} ms"
    if seconds < 59.95:
        return f"{seconds:.3g} s"
    if seconds >= 2 * 86400:
        return f"{seconds / 86400:.1f} days"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60} min"
