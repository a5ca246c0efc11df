"""Locks on run folders: one holder, release at the end of its process, and assumptions where there are no locks."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
import threading
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from cli.tiny import ROOT
from compilation import search_path

from reslrb_cli.records import lock as locks
from reslrb_cli.records.lock import FolderLock, Holder, InUse

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="tells boots apart as Linux does")

HOLD = """
import sys, time
from pathlib import Path
from reslrb_cli.records.lock import FolderLock
lock = FolderLock(Path(sys.argv[1]))
print("locked", flush=True)
time.sleep(60)
"""


def test_one_at_a_time(tmp_path: Path) -> None:
    with FolderLock(tmp_path) as lock:
        assert lock.real
        with pytest.raises(InUse):
            FolderLock(tmp_path, wait_s=0)
        with pytest.raises(InUse):
            FolderLock(tmp_path, wait_s=0, shared=True)
    FolderLock(tmp_path, wait_s=0).release()


@pytest.mark.parametrize("number", [errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES])
def test_every_error_of_a_held_lock_counts(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", fail)
    with pytest.raises(InUse):
        FolderLock(tmp_path, wait_s=0)


def test_readers_do_not_disturb_each_other_and_nobody_gives_up(tmp_path: Path) -> None:
    reader = FolderLock(tmp_path, wait_s=0, shared=True)
    FolderLock(tmp_path, wait_s=0, shared=True).release()
    threading.Timer(0.2, reader.release).start()
    FolderLock(tmp_path).release()


def test_a_killed_process_holds_no_lock(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    holder = subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": search_path(ROOT)})
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"locked\n"
    with pytest.raises(InUse):
        FolderLock(tmp_path, wait_s=0)
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    FolderLock(tmp_path, wait_s=0).release()


def test_the_lock_moves_with_the_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with FolderLock(tmp_path / "a") as lock:
        (tmp_path / "a").rename(tmp_path / "b")
        (tmp_path / "a").mkdir()
        assert lock.is_of(tmp_path / "b")
        assert not lock.is_of(tmp_path / "a")
        assert not lock.is_of(tmp_path / "c")
        FolderLock(tmp_path / "a", wait_s=0).release()
        with pytest.raises(InUse):
            FolderLock(tmp_path / "b", wait_s=0)


def test_only_a_folder_can_be_locked(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path)
    for name in ("nothing", "file", "link"):
        with pytest.raises(OSError):  # noqa: PT011 (which one is the system's affair)
            FolderLock(tmp_path / name)


def test_a_file_system_without_locks_locks_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(descriptor: int, operation: int) -> None:
        raise OSError(9, "Bad file descriptor")  # as NFS reports for folders

    monkeypatch.setattr(locks.fcntl, "flock", fail)
    with FolderLock(tmp_path) as first, FolderLock(tmp_path) as second:
        assert (first.real, second.real) == (False, False)


def ended_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_dead_holders_with_locks(tmp_path: Path) -> None:
    here = Holder.here(locked=True)
    with FolderLock(tmp_path):
        for holder in (here, replace(here, pid=ended_pid()), replace(here, boot="earlier")):
            assert not holder.is_gone(tmp_path)
    # The process number proves nothing, because this process has the same number.
    assert here.is_gone(tmp_path)
    # After a reboot, and in another container of the same machine, the holder is also gone
    assert replace(here, boot="earlier").is_gone(tmp_path)
    assert replace(here, host="elsewhere").is_gone(tmp_path)


def test_a_process_does_not_wait_for_its_own_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run draws its own page without waiting. Waiting only distinguishes another process's lasting lock from a
    momentary one.
    """
    here = Holder.here(locked=True)
    with monkeypatch.context() as patch, FolderLock(tmp_path):
        patch.setattr(locks.time, "sleep", lambda seconds: pytest.fail("it waits"))
        assert not here.is_gone(tmp_path)
        with pytest.raises(InUse):
            FolderLock(tmp_path, wait_s=0)
        assert not here.is_gone(tmp_path), "who was refused has let go of nothing"
    assert here.is_gone(tmp_path)
    with FolderLock(tmp_path, shared=True):
        assert here.is_gone(tmp_path), "who reads is no run"


def test_another_machine_may_hold_an_invisible_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = Holder("elsewhere", 1, "its own boot", locked=True)
    assert elsewhere.is_gone(tmp_path) == (os.major(os.stat(tmp_path).st_dev) != 0)
    monkeypatch.setattr(os, "major", lambda device: 0)  # as on a network disk
    assert not elsewhere.is_gone(tmp_path)


def test_a_folder_that_cannot_be_opened_has_no_lock_to_test(tmp_path: Path) -> None:
    """On the same machine, the process ID decides who holds the lock."""
    here = Holder.here(locked=True)
    assert not here.is_gone(tmp_path / "gone")
    assert replace(here, pid=ended_pid()).is_gone(tmp_path / "gone")
    assert not replace(here, host="elsewhere", pid=ended_pid()).is_gone(tmp_path / "gone")


def test_a_process_of_another_user_is_alive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(process: int, number: int) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "kill", refuse)
    assert not Holder.here(locked=False).is_gone(tmp_path)


def test_dead_holders_without_locks(tmp_path: Path) -> None:
    here = Holder.here(locked=False)
    assert not here.is_gone(tmp_path)
    assert not replace(here, pid=1).is_gone(tmp_path)
    assert replace(here, pid=ended_pid()).is_gone(tmp_path)
    assert replace(here, boot="earlier").is_gone(tmp_path)
    assert not replace(here, host="elsewhere", pid=ended_pid()).is_gone(tmp_path)


def test_a_holder_is_read_back() -> None:
    here = Holder.here(locked=True)
    assert Holder.from_json(asdict(here)) == here
    assert str(here) == f"process {os.getpid()} on {here.host}"
    for nothing in (None, {}, {"host": "x"}, [3], asdict(here) | {"pid": "text"}):
        assert Holder.from_json(nothing) is None
