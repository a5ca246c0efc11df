"""Locks on run folders, and the identity of the process that uses a folder.

The lock is a kernel lock (`flock`) on the folder itself. The lock leaves no file behind and always ends with its
process. Some network file systems have no locks, or locks that other machines do not see. There, the recorded process
decides.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Seconds to wait for a lock, for writers and for readers. Readers hold it for an instant; neither a run nor another
#: reader must mistake them for a run.
WAIT_SECONDS, READER_WAIT_SECONDS = 1.0, 0.25
_POLL_SECONDS = 0.01
_HELD = {errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES}

#: Folders that this process has locked exclusively, by device and inode. Reading them needs no wait.
_own: set[tuple[int, int]] = set()


class InUse(Exception):
    """Error if another process, or another part of this process, holds the lock."""


class FolderLock:
    """Lock on a folder, from its construction until `release` or the end of the process.

    The lock stays on the folder when the folder is renamed. Several holders can have a `shared` lock if nobody has an
    exclusive one. `real` is False if the file system has no locks. In this case, nothing is locked. Raises InUse if the
    lock is taken, and OSError if the folder does not exist. A link does not count as a folder.
    """

    def __init__(self, folder: Path, wait_s: float = WAIT_SECONDS, shared: bool = False) -> None:
        self._descriptor: int | None = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        self._place: tuple[int, int] | None = None
        try:
            self.real = self._take(self._descriptor, wait_s, shared)
            if self.real and not shared:
                self._place = _place(os.fstat(self._descriptor))
                _own.add(self._place)
        except BaseException:
            self.release()
            raise

    def _take(self, descriptor: int, wait_s: float, shared: bool) -> bool:
        kind, end = fcntl.LOCK_SH if shared else fcntl.LOCK_EX, time.monotonic() + wait_s
        while True:
            try:
                fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno not in _HELD:
                    return False
                if time.monotonic() >= end:
                    raise InUse from None
                time.sleep(_POLL_SECONDS)
            else:
                return True

    def is_of(self, folder: Path) -> bool:
        """True if `folder` is the locked folder. The locked folder may have been moved or removed since locking."""
        try:
            return self._descriptor is not None and os.path.samestat(os.fstat(self._descriptor), os.lstat(folder))
        except OSError:
            return False

    def release(self) -> None:
        """Release the lock."""
        if self._place is not None:
            _own.discard(self._place)
            self._place = None
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


@dataclass(frozen=True)
class Holder:
    """Process that uses a run folder, as recorded in the manifest.

    `boot` identifies one boot of a machine, or is None if the system does not provide it. `boot` differs between
    machines. Containers on one machine share one `boot`. `locked` says whether the process has a lock.
    """

    host: str
    pid: int
    boot: str | None
    locked: bool

    @staticmethod
    def here(locked: bool) -> Holder:
        """Return the holder for this process."""
        return Holder(platform.node(), os.getpid(), _boot(), locked)

    @staticmethod
    def from_json(data: Mapping[str, Any] | None) -> Holder | None:
        """Return the holder recorded in a manifest, or None if there is none, or if it is damaged."""
        try:
            found = Holder(**(data or {}))
        except TypeError:
            return None
        return found if isinstance(found.pid, int) else None

    def is_gone(self, folder: Path) -> bool:
        """Whether this process, which used `folder`, has certainly ended.

        False if the process's end is uncertain, for example for a process on another machine without common locks.
        """
        here = Holder.here(locked=False)
        same_kernel = self.host == here.host or (self.boot is not None and self.boot == here.boot)
        if self.locked:
            try:
                if _place(os.stat(folder)) in _own:
                    return False
                with FolderLock(folder, READER_WAIT_SECONDS, shared=True) as lock:
                    if lock.real:
                        # Network disks (no block device, major number 0) may not share locks between machines.
                        return same_kernel or os.major(os.stat(folder).st_dev) != 0
            except InUse:
                return False
            except OSError:
                pass  # the folder cannot be opened, so there is no lock to test
        return self.host == here.host and (self.boot != here.boot or not _is_alive(self.pid))

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"


def _is_alive(process: int) -> bool:
    """True if a process with the number `process` exists."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # a process of another user
        return True
    return True


def _place(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _boot() -> str | None:
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return None
