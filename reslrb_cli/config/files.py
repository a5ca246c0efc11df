"""The one door for files that a user names: regular, not too large, and else one located line."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from ..errors import ConfigError

#: As far as the system has them: never wait, hand down to no child, change no line ends.
_FLAGS = ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY")


def open_file(path: Path, most: int | None = None) -> BinaryIO:
    """Open the file `path` to read it. Raises ConfigError, located in it, where it cannot be.

    Refused are folders, everything that is no regular file (to read a pipe, a socket or a device may take for ever) and
    files of more than `most` bytes; None for any size, where it is not read as a whole.
    """
    try:
        _check(path, os.stat(path), most)  # before it is opened: to open some devices does something already
        descriptor = os.open(path, os.O_RDONLY | sum(getattr(os, flag, 0) for flag in _FLAGS))
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
