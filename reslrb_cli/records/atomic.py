"""Files that are either whole or absent, however the process ends.

What is under way has a name of its own (`.NAME.PID.part`, `.reslrb-*` for folders). A process that fails removes it,
one that is ended at once does so by `remove_unfinished`, and what a killed process leaves is found by its name.
"""

from __future__ import annotations

import contextlib
import glob
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from reslrb_cli.errors import ConfigError, is_machine_fault
from reslrb_cli.records.lock import FolderLock, is_alive

_PART = re.compile(r"\..+\.\d+\.part")

#: How the names of folders that are not finished begin.
FOLDER_PREFIX = ".reslrb-"

#: Files and folders that this process is about to finish.
unfinished: set[Path] = set()


def write_atomically(path: Path, write: Callable[[IO[bytes]], object], durable: bool = False) -> None:
    """Let `write` fill a neighbour of `path` and rename it into place, so that no reader sees half a file.

    With `durable` a machine that loses its power does not lose the file either. Raises OSError, which names `path`.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    unfinished.add(part)
    try:
        with part.open("wb") as file:
            write(file)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(part, path)
        if durable:
            _sync_folder(path.parent)
    except OSError as error:
        # An error of writing names no file, one of renaming names two.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        unfinished.discard(part)


@contextmanager
def unfinished_folder(parent: Path, lock: bool = True) -> Iterator[Path]:
    """Yield a new folder in `parent`, which the block may rename; else remove it at the end, with its content.

    The folder is locked meanwhile: other processes remove an old folder without a lock. With `lock=False` the block
    locks it.
    """
    path = parent / f"{FOLDER_PREFIX}{secrets.token_hex(8)}"
    unfinished.add(path)
    try:
        path.mkdir()
        with FolderLock(path) if lock else contextlib.nullcontext():
            yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        unfinished.discard(path)


def remove_unfinished() -> None:
    """Remove what this process has not finished; to be called when it is about to end in the midst of it."""
    for path in list(unfinished):
        with contextlib.suppress(OSError):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def remove_parts(folder: Path) -> None:
    """Remove the files in `folder` and in the folders below it that a process began and never finished."""
    for parent, _, names in os.walk(folder):  # which follows no links
        for name in names:
            if _PART.fullmatch(name):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(parent, name))


def remove_parts_of(path: Path) -> None:
    """Remove what processes that are no more began to write in place of the file `path`, and never finished."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        if _PART.fullmatch(part.name) and not is_alive(int(part.name.split(".")[-2])):
            with contextlib.suppress(OSError):
                part.unlink()


def _sync_folder(folder: Path) -> None:
    """Have a renamed file's name on the disk too, where the system can do that for a folder."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def writing(option: str, path: Path) -> Iterator[None]:
    """Have an error of writing `path` located by the option (ConfigError); one of the machine stays what it is."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if is_machine_fault(error):
            raise
        place, reason = getattr(error, "filename", None) or path, getattr(error, "strerror", None) or error
        raise ConfigError(option, "", f"cannot write {place}: {reason}") from None
