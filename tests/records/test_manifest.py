"""Manifests: what they say once their process has gone."""

from __future__ import annotations

import errno
import json
import os
import threading
from pathlib import Path

import pytest

from reslrb_cli.records import manifest as manifests
from reslrb_cli.records.lock import FolderLock, Holder
from reslrb_cli.records.manifest import MANIFEST_FILE, Manifest, Status, read_manifest


def make_manifest(**changes):
    return Manifest(**{"variant": "llvm_ad_rgb", "device": "a CPU", "seed": 3, "config": "c.yaml", **changes})


def abandoned(folder: Path) -> Manifest:
    """The manifest of a run whose process, with a lock, has gone."""
    manifest = make_manifest(process=Holder.here(locked=True))
    manifest.write(folder)
    return manifest


def stored(folder: Path):
    return json.loads((folder / MANIFEST_FILE).read_text())


def test_a_run_that_was_killed_is_interrupted(tmp_path):
    abandoned(tmp_path)
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 0}\n{"itera')
    (tmp_path / ".report.html.77.part").write_text("half")
    os.utime(tmp_path / "metrics.jsonl", (2e9, 2e9))
    assert stored(tmp_path)["status"] == "running"
    content = read_manifest(tmp_path)
    assert (content["status"], content["ended"]) == ("interrupted", "2033-05-18T03:33:20+00:00")
    assert "ended before the run did" in content["error"]
    # on the disk too, with what the process left behind
    assert stored(tmp_path) == content == read_manifest(tmp_path)
    assert (tmp_path / "metrics.jsonl").read_text() == '{"iteration": 0}\n'
    assert sorted(os.listdir(tmp_path)) == [MANIFEST_FILE, "metrics.jsonl"]


def test_a_run_that_goes_on_is_running(tmp_path):
    abandoned(tmp_path)
    with FolderLock(tmp_path):
        assert read_manifest(tmp_path)["status"] == "running"
    assert stored(tmp_path)["status"] == "running"


def test_a_reader_who_may_not_write_is_told_the_same(tmp_path, monkeypatch):
    abandoned(tmp_path)

    def fail(*args, **options):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(manifests, "write_atomically", fail)
    assert read_manifest(tmp_path)["status"] == "interrupted"
    assert stored(tmp_path)["status"] == "running"


@pytest.mark.parametrize("status", [Status.FINISHED, Status.INTERRUPTED, Status.FAILED])
def test_what_has_ended_stays_as_it_ended(tmp_path, status):
    abandoned(tmp_path).end(tmp_path, status, "a line")
    before = stored(tmp_path)
    assert read_manifest(tmp_path) == before
    assert (before["status"], before["error"]) == (status.value, "a line")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"program": "other"}', "[" * 100_000, "\udcff"])
def test_what_is_no_manifest_of_ours(tmp_path, text):
    (tmp_path / MANIFEST_FILE).write_bytes(text.encode(errors="surrogateescape"))
    assert read_manifest(tmp_path) is None
    assert read_manifest(tmp_path / "nowhere") is None


def test_the_last_word_of_a_process_that_ends_at_once_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(manifests, "_WRITING", threading.Lock())
    manifest = make_manifest()
    manifest.write(tmp_path)
    for work in (
        lambda: manifest.end_for_good(tmp_path, Status.INTERRUPTED),
        lambda: manifest.end(tmp_path, Status.FINISHED),  # the thread that works knows nothing of it
    ):
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        thread.join(timeout=0.5)
    assert thread.is_alive()
    assert stored(tmp_path)["status"] == "interrupted"
