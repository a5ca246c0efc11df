"""What is left of a checkpoint whose writing ends at any moment."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.records import checkpoint
from reslrb_cli.records import checkpoint as archive
from reslrb_cli.records.atomic import remove_parts
from reslrb_cli.records.checkpoint import newest_checkpoint, open_state, save_checkpoint


def save(folder: Path, iteration: int, size: int = 64) -> None:
    save_checkpoint(folder, iteration, {"a": np.full(size, iteration, np.float32)}, {}, {"elapsed_s": 1.0})


def iteration_of(path: Path) -> int:
    opened, values = open_state(path)
    with opened:
        assert float(opened.array("parameter/a")[0]) == values["iteration"]
    return int(values["iteration"])


def test_a_kill_at_any_moment_leaves_a_whole_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Copied before and after every call by which the writing of the fourth state changes the disk."""
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
        for name in ("link", "replace", "fsync"):
            patch.setattr(os, name, copying(name))
        save(folder, 4)
    assert len(left) >= 8
    found = []
    for place in left:
        remove_parts(place)
        assert {path.name for path in place.iterdir()} == {"state.npz", "previous.npz"}
        newest = newest_checkpoint(place)
        assert newest is not None
        found.append((iteration_of(newest), iteration_of(place / "previous.npz")))
    assert found[0] == (3, 2)
    assert found[-1] == (4, 3)
    assert set(found) == {(3, 2), (3, 3), (4, 3)}


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP, errno.EMLINK])
def test_file_systems_without_links_keep_both_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refuse(*args: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", refuse)
    for iteration in (1, 2, 3):
        save(tmp_path, iteration)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["previous.npz", "state.npz"]
    assert (iteration_of(tmp_path / "state.npz"), iteration_of(tmp_path / "previous.npz")) == (3, 2)


def test_on_a_disk_without_room_for_three_the_oldest_makes_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 1)
    save(tmp_path, 2)
    write, full = archive.write_archive, OSError(errno.ENOSPC, "No space left on device")

    def sometimes(path: Path, *args: Any, **options: Any) -> None:
        if (tmp_path / "previous.npz").exists():
            assert iteration_of(tmp_path / "state.npz") == 2
            raise full
        write(path, *args, **options)

    monkeypatch.setattr(checkpoint, "write_archive", sometimes)
    save(tmp_path, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["state.npz"]
    assert iteration_of(tmp_path / "state.npz") == 3

    def never(*args: Any, **options: Any) -> None:
        raise full

    monkeypatch.setattr(checkpoint, "write_archive", never)
    with pytest.raises(OSError, match="No space left"):
        save(tmp_path, 4)
    assert iteration_of(tmp_path / "state.npz") == 3


def test_what_cannot_be_opened_is_located(tmp_path: Path) -> None:
    np.savez(tmp_path / "state.npz", a=np.ones(3))
    with pytest.raises(ConfigError, match="holds values alone, not the state of a run"):
        open_state(tmp_path / "state.npz")
    assert newest_checkpoint(tmp_path / "none") is None
