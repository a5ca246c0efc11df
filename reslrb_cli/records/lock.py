"""Who works in a run folder: a lock on the folder, and the name of the process that has it.

The lock is the kernel's (`flock` on the folder itself). It leaves no file, and it ends with its process, whatever ends
that. Some network file systems have no locks, or none that other machines see: there the process's name decides.
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

#: Who reads a folder, or puts its manifest right, has the lock for an instant: no run is refused over that, and no
#: other reader takes it for a run.
WAIT_SECONDS, READER_WAIT_SECONDS = 1.0, 0.25
_POLL_SECONDS = 0.01
_HELD = {errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES}

#: The folders that this process has locked for itself, by device and inode: who reads its own need not wait for them.
_own: set[tuple[int, int]] = set()


class InUse(Exception):
    """Another process, or another part of this one, has the lock."""


class FolderLock:
    """The lock on a folder, from its construction until `release` or the end of the process.

    The folder keeps it when it is renamed. Several may have a `shared` one, as long as nobody has it alone. `real` is
    False where the file system has no locks, and nothing is locked. Raises InUse, and OSError where there is no such
    folder (a link to one is none).
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
        """Whether the folder at that path is the one that is locked, which may have been moved or removed since."""
        try:
            return self._descriptor is not None and os.path.samestat(os.fstat(self._descriptor), os.lstat(folder))
        except OSError:
            return False

    def release(self) -> None:
        """Let others have it."""
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
    """A process that works in a run folder, as its manifest names it.

    `boot` tells one start of a machine from the next (None: the system does not say), and so two machines, or two
    containers on one machine, of which the latter share it. `locked` says whether the process has a lock.
    """

    host: str
    pid: int
    boot: str | None
    locked: bool

    @staticmethod
    def here(locked: bool) -> Holder:
        """This process."""
        return Holder(platform.node(), os.getpid(), _boot(), locked)

    @staticmethod
    def from_json(data: Mapping[str, Any] | None) -> Holder | None:
        """What a manifest says; None where it says nothing."""
        try:
            return Holder(**data) if data is not None else None
        except TypeError:
            return None

    def is_gone(self, folder: Path) -> bool:
        """Whether this process, which worked in `folder`, has surely ended.

        Where that cannot be known, as of a process on another machine without common locks, it has not.
        """
        here = Holder.here(locked=False)
        same_kernel = self.host == here.host or (self.boot is not None and self.boot == here.boot)
        if self.locked:
            try:
                if _place(os.stat(folder)) in _own:
                    return False
                with FolderLock(folder, READER_WAIT_SECONDS, shared=True) as lock:
                    if lock.real:
                        # Not everywhere do machines share locks of network disks, which have no block device.
                        return same_kernel or os.major(os.stat(folder).st_dev) != 0
            except InUse:
                return False
            except OSError:
                pass  # the folder cannot be opened: no lock to ask
        return self.host == here.host and (self.boot != here.boot or not is_alive(self.pid))

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"


def is_alive(process: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True


def _place(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _boot() -> str | None:
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return None
