"""Files that are complete or absent: any file, checkpoints, and file names."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.records import checkpoint, measurement_files, sweeps
from reslrb_cli.records.atomic import remove_parts, remove_unfinished, unfinished_folder, write_atomically, writing
from reslrb_cli.records.checkpoint import newest_checkpoint, open_archive, read_state, save_checkpoint
from reslrb_cli.records.images import MOST_BYTES, file_stem
from reslrb_cli.records.measurement_files import Origin, write_lines

# Files are whole or absent, and unfinished files are removed.


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path, seen = tmp_path / "file", []

    def write(file):
        file.write(b"new")
        file.flush()
        seen.append((path.read_bytes(), names(tmp_path)))

    path.write_bytes(b"old")
    write_atomically(path, write, True)
    assert seen == [(b"old", [f".file.{os.getpid()}.part", "file"])]
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("durable", [False, True])
def test_a_durable_file_and_its_name_are_flushed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, durable: bool
) -> None:
    """The content before the renaming, and the name after it."""
    steps: list[str] = []
    sync, replace = os.fsync, os.replace

    def syncing(descriptor: int) -> None:
        place = os.readlink(f"/proc/self/fd/{descriptor}")
        steps.append("name" if place == str(tmp_path) else f"{os.stat(place).st_size} bytes")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", syncing)
    monkeypatch.setattr(os, "replace", lambda *places: (steps.append("replace"), replace(*places)))
    write_atomically(tmp_path / "file", lambda file: file.write(b"new"), durable)
    assert steps == (["3 bytes", "replace", "name"] if durable else ["replace"])


def test_a_failure_keeps_the_old_file_and_names_it(tmp_path: Path) -> None:
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


def test_a_process_that_exits_at_once_can_tidy_up(tmp_path: Path) -> None:
    def leave(file):
        file.write(b"half")
        with unfinished_folder(tmp_path) as folder:
            (folder / "file").write_text("")
            assert len(names(tmp_path)) == 2
            remove_unfinished()
            assert names(tmp_path) == []

    with pytest.raises(FileNotFoundError):
        write_atomically(tmp_path / "file", leave)


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (OSError(errno.EACCES, "Permission denied", "b/c"), ConfigError, "--json: cannot write b/c: Permission denied"),
        (OSError(errno.EACCES, "Permission denied"), ConfigError, "--json: cannot write a: Permission denied"),
        (RuntimeError("no such format"), ConfigError, "--json: cannot write a: no such format"),
        (OSError(errno.ENOSPC, "No space left on device", "a"), OSError, "No space left on device"),
        (ValueError("a bug"), ValueError, "a bug"),
    ],
)
def test_errors_of_writing_name_the_option(error: Exception, kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message) as found, writing("--json", Path("a")):
        raise error
    assert (found.value is error) is (kind is not ConfigError)


def test_a_file_of_json_is_written_through_a_link(tmp_path: Path) -> None:
    """A link may lead to another disk. It stays a link."""
    target, link = tmp_path / "target", tmp_path / "link"
    for content in ("", "earlier\n"):
        link.unlink(missing_ok=True)
        target.write_text(content)
        link.symlink_to("target")
        write_lines(link, [Origin("cpu", "llvm_ad_rgb")])
        assert link.is_symlink()
        assert target.read_text().count("\n") == 1
        assert "llvm_ad_rgb" in target.read_text()


def test_an_unfinished_folder_stays_if_it_gets_a_name(tmp_path: Path) -> None:
    with unfinished_folder(tmp_path) as folder:
        (folder / "file").write_text("x")
    assert names(tmp_path) == []
    with unfinished_folder(tmp_path) as folder:
        folder.rename(tmp_path / "name")
    assert names(tmp_path) == ["name"]


def test_leftovers_of_killed_processes_are_removed(tmp_path: Path) -> None:
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


# The remains of a checkpoint whose writing ends at any moment.


def save(folder: Path, iteration: int, size: int = 64) -> None:
    save_checkpoint(folder, iteration, {"parameter/a": np.full(size, iteration, np.float32)}, {"elapsed_s": 1.0})


def iteration_of(path: Path) -> int:
    arrays, values = read_state(path)
    assert float(arrays["parameter/a"][0]) == values["iteration"]
    return int(values["iteration"])


def test_a_kill_at_any_moment_leaves_a_complete_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test copies the folder before and after every call that changes the disk while the fourth state is
    written.
    """
    folder, left = tmp_path / "checkpoint", []
    folder.mkdir()
    for iteration in (1, 2, 3):
        save(folder, iteration)

    def copying(name: str) -> Callable[..., Any]:
        real = getattr(os, name)

        def call(*args: Any) -> Any:
            left.append(shutil.copytree(folder, tmp_path / f"{len(left)}-before-{name}"))
            result = real(*args)
            left.append(shutil.copytree(folder, tmp_path / f"{len(left)}-after-{name}"))
            return result

        return call

    with monkeypatch.context() as patch:
        for name in ("replace", "fsync"):
            patch.setattr(os, name, copying(name))
        save(folder, 4)
    assert len(left) >= 8
    found = []
    for place in left:
        newest = newest_checkpoint(place)
        assert newest is not None
        found.append((iteration_of(newest), iteration_of(place / "previous.npz")))
    assert found[0] == (3, 2)
    assert found[-1] == (4, 3)
    assert set(found) == {(3, 2), (3, 3), (4, 3)}


def test_on_a_full_disk_both_states_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path, 1)
    save(tmp_path, 2)

    def never(*args: Any, **options: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_archive", never)
    with pytest.raises(OSError, match="No space left"):
        save(tmp_path, 3)
    assert (iteration_of(tmp_path / "state.npz"), iteration_of(tmp_path / "previous.npz")) == (2, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "state: is no JSON, as a run writes it"),
        ("[1]", "state: is of another version of reslrb"),
        (f'{{"format": {checkpoint.FORMAT + 1}}}', "state: is of another version of reslrb"),
    ],
)
def test_a_state_that_is_no_json_is_located(tmp_path: Path, text: str, message: str) -> None:
    np.savez(tmp_path / "state.npz", state=np.frombuffer(text.encode(), np.uint8))
    with pytest.raises(ConfigError, match=rf"state\.npz: {message}"):
        read_state(tmp_path / "state.npz")


@pytest.mark.parametrize(("error", "reason"), [(EOFError(), "EOFError"), (ValueError("no zip"), "no zip")])
def test_a_damaged_archive_has_a_reason(tmp_path: Path, error: Exception, reason: str) -> None:
    np.savez(tmp_path / "state.npz", a=np.ones(3))
    with (
        pytest.raises(ConfigError, match=rf"or not written by reslrb \({reason}\)$"),
        open_archive(tmp_path / "state.npz"),
    ):
        raise error


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.ENOSPC, "full"), RuntimeError("out of memory")])
def test_a_fault_of_the_machine_is_not_blamed_on_an_archive(tmp_path: Path, error: Exception) -> None:
    np.savez(tmp_path / "state.npz", a=np.ones(3))
    with pytest.raises(type(error)), open_archive(tmp_path / "state.npz"):
        raise error


def test_unopenable_files_are_located(tmp_path: Path) -> None:
    np.savez(tmp_path / "state.npz", a=np.ones(3))
    with pytest.raises(ConfigError, match="holds values alone, not the state of a run"):
        read_state(tmp_path / "state.npz")
    assert newest_checkpoint(tmp_path / "none") is None


# Every parameter has its own files, whatever its key is.


def test_similar_keys_have_distinct_file_names() -> None:
    long = "a" * 300
    keys = ["a b", "a_b", "a/b", "a__b", "a  b", "a\x1bb", long, long + "b", f"{long} b", f"{long}_b", "é" * 200 + "/"]
    names = [file_stem(key) for key in keys]
    assert len(set(names)) == len(keys)
    assert all(len(name.encode()) <= MOST_BYTES and "/" not in name and name.isprintable() for name in names)
    assert [file_stem(key) for key in ("a_b", "Wände.alpha-2")] == ["a_b", "Wände.alpha-2"]
    assert file_stem("a b").startswith("a_b-")
    assert file_stem("a b") == file_stem("a b")


@pytest.mark.parametrize(("number", "kept"), [(errno.EACCES, True), (errno.EXDEV, True), (errno.ENOSPC, False)])
def test_a_file_that_cannot_be_replaced_is_written_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, kept: bool
) -> None:
    def refuse(path: Path, write: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(measurement_files, "write_atomically", refuse)
    with contextlib.nullcontext() if kept else pytest.raises(OSError, match="No space"):  # type: ignore[attr-defined]
        write_lines(tmp_path / "a", [Origin("cpu", "llvm_ad_rgb")])
    assert (tmp_path / "a").exists() is kept


def test_the_plan_of_a_sweep_survives_a_loss_of_power(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []

    def write(path: Path, write: object, durable: bool = False) -> None:
        given.append((path.name, durable))

    monkeypatch.setattr(sweeps, "write_atomically", write)
    sweeps.SweepPlan("c", [], [], [3]).write(tmp_path)
    assert given == [("sweep.json", True)]
