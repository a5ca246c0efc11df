"""Files are whole or absent, and what was never finished is removed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from reslrb_cli.records.atomic import (
    Reserve,
    remove_parts,
    remove_unfinished,
    size_of,
    unfinished_folder,
    write_atomically,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_is_there_once_it_is_whole(tmp_path: Path, durable: bool) -> None:
    path, seen = tmp_path / "file", []

    def write(file):
        file.write(b"new")
        file.flush()
        seen.append((path.read_bytes(), names(tmp_path)))

    path.write_bytes(b"old")
    write_atomically(path, write, durable)
    assert seen == [(b"old", [f".file.{os.getpid()}.part", "file"])]
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["file"]


def test_a_failure_leaves_what_was_there_and_names_the_file(tmp_path: Path) -> None:
    def fail(file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    (tmp_path / "file").write_bytes(b"old")
    with pytest.raises(OSError, match="No space left on device") as error:
        write_atomically(tmp_path / "file", fail)
    assert (error.value.errno, error.value.filename) == (28, str(tmp_path / "file"))
    assert (tmp_path / "file").read_bytes() == b"old"
    assert names(tmp_path) == ["file"]
    with pytest.raises(FileNotFoundError) as gone:
        write_atomically(tmp_path / "nowhere" / "file", lambda file: None)
    assert str(gone.value) == f"[Errno 2] No such file or directory: '{tmp_path / 'nowhere' / 'file'}'"


def test_a_process_that_ends_at_once_can_tidy_up(tmp_path: Path) -> None:
    def leave(file):
        file.write(b"half")
        with unfinished_folder(tmp_path) as folder:
            (folder / "file").write_text("")
            assert len(names(tmp_path)) == 2
            remove_unfinished()
            assert names(tmp_path) == []

    with pytest.raises(FileNotFoundError):
        write_atomically(tmp_path / "file", leave)


def test_an_unfinished_folder_stays_if_it_gets_a_name(tmp_path: Path) -> None:
    with unfinished_folder(tmp_path) as folder:
        (folder / "file").write_text("x")
    assert names(tmp_path) == []
    with unfinished_folder(tmp_path) as folder:
        folder.rename(tmp_path / "name")
    assert names(tmp_path) == ["name"]


def test_what_killed_processes_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "elsewhere").mkdir()
    left = [tmp_path / ".manifest.json.123.part", tmp_path / "images" / ".final.exr.99.part"]
    kept = [tmp_path / "notes.part", tmp_path / ".part", tmp_path / "images" / ".mine.part"]
    for path in (*left, *kept, tmp_path / "elsewhere" / ".x.1.part"):
        path.write_text("")
    (tmp_path / "images" / "link").symlink_to(tmp_path / "elsewhere")
    remove_parts(tmp_path / "images")
    assert [path.exists() for path in left] == [True, False]
    assert (tmp_path / "elsewhere" / ".x.1.part").exists()
    remove_parts(tmp_path)
    assert not any(path.exists() for path in left)
    assert all(path.exists() for path in kept)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system takes up no room for files")
def test_a_reserve_takes_up_room_until_it_is_released(tmp_path: Path) -> None:
    reserve = Reserve(tmp_path)
    reserve.hold(100_000)
    assert size_of(tmp_path) == 100_000
    assert next(tmp_path.iterdir()).stat().st_blocks * 512 >= 100_000
    reserve.release()
    reserve.release()
    assert names(tmp_path) == []
    reserve.hold(100_000)  # and its process is ended at once
    remove_unfinished()
    assert names(tmp_path) == []
    reserve.hold(100_000)  # and its process is killed
    remove_parts(tmp_path)
    assert names(tmp_path) == []


def test_no_room_for_a_reserve_is_no_reserve(tmp_path: Path) -> None:
    Reserve(tmp_path / "nowhere").hold(10)
    Reserve(tmp_path).hold(1 << 60)
    assert names(tmp_path) == []
