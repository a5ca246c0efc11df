"""Files that are either complete or absent, however the process ends.

Unfinished files are named `.NAME.PID.part`, unfinished folders `.reslrb-*`. A process that fails removes its own files.
A process that exits at once calls `remove_unfinished`. Files of killed processes are recognised by their names.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from reslrb_cli.errors import ConfigError, is_machine_fault

_PART = re.compile(r"\..+\.\d+\.part")

#: Prefix of the names of unfinished folders.
FOLDER_PREFIX = ".reslrb-"

#: Unfinished files and folders of this process.
unfinished: set[Path] = set()


def write_atomically(path: Path, write: Callable[[IO[bytes]], object], durable: bool = False) -> None:
    """Let `write` fill a temporary file beside `path`, then rename the file. Readers never see a partial file.

    With `durable`, the file also survives a loss of power. Raises OSError, which names `path`.
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
        # Write errors name no file, and rename errors name two.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
        unfinished.discard(part)


@contextmanager
def unfinished_folder(parent: Path) -> Iterator[Path]:
    """Yield a new folder in `parent`. Unless the block renames it, the folder is removed at the end."""
    path = parent / f"{FOLDER_PREFIX}{secrets.token_hex(8)}"
    unfinished.add(path)
    try:
        path.mkdir()
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        unfinished.discard(path)


def remove_unfinished() -> None:
    """Remove the unfinished files and folders of this process. Call this before an immediate exit."""
    for path in list(unfinished):
        with contextlib.suppress(OSError):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def remove_parts(folder: Path) -> None:
    """Remove unfinished files in `folder` and its subfolders."""
    for parent, _, names in os.walk(folder):  # does not follow links
        for name in names:
            if _PART.fullmatch(name):
                with contextlib.suppress(OSError):
                    os.unlink(os.path.join(parent, name))


def _sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, if the system supports that."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def writing(option: str, path: Path) -> Iterator[None]:
    """Turn errors of writing `path` into a ConfigError that names `option`. Machine faults are unchanged."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        if is_machine_fault(error):
            raise
        place, reason = getattr(error, "filename", None) or path, getattr(error, "strerror", None) or error
        raise ConfigError(option, "", f"cannot write {place}: {reason}") from None
