"""Room on the disk for the last things that a run writes."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from reslrb_cli.records.atomic import unfinished


class Reserve:
    """A file in `folder` that takes up room until `release`: the end of a run then fits on a disk that is full.

    Where there is no room even for that, or the system cannot take any, nothing is kept.
    """

    def __init__(self, folder: Path) -> None:
        # named as a file that was never finished, so that it is removed like one
        self._path = folder / f".reserve.{os.getpid()}.part"

    def hold(self, size: int) -> None:
        """Take up so many bytes."""
        unfinished.add(self._path)
        try:
            descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, size)
            finally:
                os.close(descriptor)
        except (OSError, AttributeError):  # AttributeError: a system without it
            self.release()

    def release(self) -> None:
        """Free them."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        unfinished.discard(self._path)


def size_of(folder: Path) -> int:
    """Bytes of all files in `folder`."""
    return sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
