"""Run folders that are gone on with: opened under their lock, or copied into a new one."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from reslrb_cli.errors import ConfigError, MachineError, is_machine_fault
from reslrb_cli.records import metrics
from reslrb_cli.records.atomic import remove_parts, unfinished, write_atomically
from reslrb_cli.records.lock import FolderLock, Holder, InUse
from reslrb_cli.records.manifest import Manifest, Status, read_manifest
from reslrb_cli.records.run_folder import SUBFOLDERS, RunFolder


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[RunFolder, dict[str, Any]]]:
    """The run folder `path`, locked while the block works, and what its manifest says.

    Raises ConfigError, located in the folder, where it is no run's, or a run is at work in it.
    """
    if not path.is_dir():
        what = "is a file, not the folder of a run" if os.path.lexists(path) else "no such folder"
        raise ConfigError(path, "", what)
    content = read_manifest(path)  # which puts that of a killed run right
    if content is None:
        raise ConfigError(path, "", "is no run's folder: it has no manifest.json that a run wrote")
    try:
        lock = FolderLock(Path(os.path.realpath(path)))
    except InUse:
        raise _in_use(path, content) from None
    except OSError as error:
        raise ConfigError(path, "", f"cannot be opened: {error.strerror}") from None
    with RunFolder(path, lock) as folder:
        if not lock.real and content.get("status") == Status.RUNNING:
            raise _in_use(path, content)
        yield folder, read_manifest(path) or content


def check_writable(folder: RunFolder) -> None:
    """Raise ConfigError, located in the folder, where nothing can be written to it, MachineError for a full disk.

    What is written has to stay in the folder, so that links in it are refused, which no run makes. What a process that
    is no more never came to finish is removed.
    """
    _check_links(folder.path)
    try:
        for name in SUBFOLDERS:
            (folder.path / name).mkdir(exist_ok=True)
        for place in (folder.path, *(folder.path / name for name in SUBFOLDERS)):
            _write_and_remove(place / f".resume.{os.getpid()}.part")
        metrics.mend(folder.path)
        remove_parts(folder.path)
    except OSError as error:
        if is_machine_fault(error):
            raise MachineError(f"{folder.path}: {error.strerror}; nothing of the run was changed") from None
        raise ConfigError(
            folder.path,
            "",
            f"cannot be written to ({error.strerror}); to go on in another folder, add --set run.output=FOLDER",
        ) from None


def _check_links(folder: Path) -> None:
    """Raise ConfigError for links in a run's folder by which it would write elsewhere: those to folders, and that of
    the metrics, which are added to. All other files are replaced, links and all."""
    entries = [folder / metrics.FILE_NAME, *(folder / name for name in SUBFOLDERS)]
    for name in SUBFOLDERS:
        entries += [Path(parent, below) for parent, folders, _ in os.walk(folder / name) for below in folders]
    for entry in entries:
        if entry.is_symlink():
            reason = "is a link, by which the run would write elsewhere; put what it leads to in its place"
            raise ConfigError(entry, "", f"{reason}, or add --set run.output=FOLDER")


def copy_into(folder: RunFolder, earlier: Path) -> None:
    """Copy what a run has written from the folder `earlier` into a new one, but for its page and its configuration.

    Raises OSError.
    """
    for name in SUBFOLDERS:
        for path in sorted((earlier / name).rglob("*")):
            target = folder.path / name / path.relative_to(earlier / name)
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                continue  # nothing that a run writes
            if path.is_dir():
                target.mkdir(exist_ok=True)
            else:
                _copy(path, target)
    if (earlier / metrics.FILE_NAME).is_file():
        _copy(earlier / metrics.FILE_NAME, folder.path / metrics.FILE_NAME)


def _copy(path: Path, target: Path) -> None:
    with path.open("rb") as file:
        write_atomically(target, lambda copy: shutil.copyfileobj(file, copy))


def _write_and_remove(path: Path) -> None:
    unfinished.add(path)
    try:
        path.write_bytes(b"is there room?")
    finally:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        unfinished.discard(path)


def write_beginning(folder: RunFolder, config: str, manifest: Manifest) -> None:
    """Write configuration and manifest of a run that goes on in `folder`. Raises OSError."""
    write_atomically(folder.path / "config.yaml", lambda file: file.write(config.encode()))
    manifest.process = Holder.here(locked=folder.lock is not None and folder.lock.real)
    manifest.write(folder.path)


def _in_use(path: Path, content: dict[str, Any]) -> ConfigError:
    holder = Holder.from_json(content.get("process"))
    who = f"{holder}, since {content.get('started')}" if holder is not None else "another process"
    return ConfigError(path, "", f"is in use by a run ({who}); end that first")
