"""The bounds of what a user hands in, and the one door for files that a user names.

Each bound stands with its reason; beyond one, input is refused at once. A file that is named has to be regular and not
too large, or there is one located line.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from reslrb_cli.errors import ConfigError, one_line

# --- configurations: read within a second or two, at some 50 microseconds a value -------------------------------------

#: Bytes of a configuration's file. One with every default written out takes 2 kB.
CONFIG_BYTES = 2**18

#: Number of `--set`, and characters of all of them together.
OVERRIDES = 1000
OVERRIDES_LENGTH = 2**16

#: Values and keys of a configuration, with every alias and every `<<` spelt out: a few hundred bytes of aliases of
#: aliases can stand for billions. A parameter with every default written out has some 20.
NODES = 20_000

#: Sections within sections. The deepest setting, `target.render.parameters.KEY.file`, is five deep.
DEPTH = 20

#: Characters of a parameter's key or glob. To make a pattern of one takes time that grows with the square of it.
KEY_LENGTH = 1000

#: Integers are below this, and above its negative: nothing that a file counts has more than 64 bits.
INTEGER_END = 2**64

# --- names and paths --------------------------------------------------------------------------------------------------

#: Bytes of a part of a path: no file system in use takes more.
PART_BYTES = 255

#: Bytes of a whole path. Linux takes 4095; the rest is for what a run adds to it below its folder.
PATH_BYTES = 3000

#: Bytes of a run's folder: PART_BYTES, less what is put before and behind it: `-2` and so on, and the mark of a
#: folder that is not whole yet.
NAME_BYTES = 200

# --- paths of light ---------------------------------------------------------------------------------------------------

#: Segments of a path that a limit can name; beyond it -1 says the same. Roulette lets at most 95 % of the paths go on
#: at each vertex: of 10^20 paths not one is a thousand vertices longer than `rr_depth`.
PATH_LENGTH = 2**16 - 1

#: Entries of an array in a kernel's thread-local memory: Dr.Jit's bound.
LOCAL_ENTRIES = 2**16

#: Connections, or events, that are kept of a path. Each is code of its own in the kernel, and the time to compile it
#: grows faster than their number: on two cores 64 took seconds, 256 most of a minute.
CAPACITY = 1024

#: Light paths of one pass: their numbers have 32 bits.
PASS_PATHS = 2**32 - 1

#: Samples per pixel of one pass. In single precision a sum loses terms below a 2^24th of it, and thousands of such
#: passes can be added to one another.
PASS_SAMPLES = 2**18

#: Passes of a step, each of which is launched by itself and has a seed that is made before the first of them.
PASSES = 2**16

# --- files that a configuration names ---------------------------------------------------------------------------------

#: Pixels of an image: 16384 x 8192, the largest environment map in use. Decoded they take 1.5 GiB.
PIXELS = 2**27

#: Bytes of an image's file: that many pixels of four floats, not compressed, and something for the file's head.
IMAGE_BYTES = 16 * PIXELS + 2**20


def as_path(given: object, name: str, what: str) -> Path:
    """Return the path that the argument `name` of a call is. Raises ConfigError for another object, and names `what`
    the call takes."""
    if isinstance(given, (str, os.PathLike)):
        return Path(given)
    raise ConfigError(name, "", f"is {one_line(repr(given), 60)}, not {what}")


def open_file(path: Path, most: int | None = None) -> BinaryIO:
    """Open the file `path` to read it. Raises ConfigError, located in it, where it cannot be.

    Refused are folders, everything that is no regular file (to read a pipe, a socket or a device may take for ever) and
    files of more than `most` bytes; None for any size, where it is not read as a whole.
    """
    try:
        _check(path, os.stat(path), most)  # before it is opened: to open some devices does something already
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            _check(path, os.fstat(descriptor), most)  # it may have been replaced in between
        except BaseException:
            os.close(descriptor)
            raise
        return os.fdopen(descriptor, "rb")
    except FileNotFoundError:
        raise ConfigError(path, "", "no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a null character, or half of a surrogate pair
        raise ConfigError(path, "", f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_file(path: Path, most: int) -> bytes:
    """All bytes of the file `path`; raises as `open_file`, also where it turns out to be larger than it says."""
    with open_file(path, most) as file:
        try:
            data = file.read(most + 1) or b""  # None of a file of the system's own that would make wait
        except OSError as error:
            raise ConfigError(path, "", f"cannot be read: {error.strerror}") from None
    if len(data) > most:
        raise ConfigError(path, "", f"has more than {in_words(most)}")
    return data


def in_words(count: float) -> str:
    """A number of bytes in words, in the units of `peak_mib`: `300 B`, `256 KiB`, `1.5 MiB`, `2 GiB`."""
    for unit, name in ((2**40, "TiB"), (2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB")):
        if count >= unit:
            return f"{count / unit:.1f}".removesuffix(".0") + f" {name}"
    return f"{count:.0f} B"


def _check(path: Path, status: os.stat_result, most: int | None) -> None:
    kind = stat.S_IFMT(status.st_mode)
    if kind == stat.S_IFDIR:
        raise ConfigError(path, "", "is a folder, not a file")
    if kind != stat.S_IFREG:
        names = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}
        raise ConfigError(path, "", f"is {names.get(kind, 'something else')}, not a regular file")
    if most is not None and status.st_size > most:
        raise ConfigError(path, "", f"has {in_words(status.st_size)}; more than {in_words(most)} are not read")


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
