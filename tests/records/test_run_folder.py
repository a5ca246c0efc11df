"""Run folders, their manifests, and the cache of measurements of earlier runs."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.tiny import ROOT
from compilation import search_path

from reslrb_cli.config.files import NAME_BYTES
from reslrb_cli.config.run import check_name
from reslrb_cli.errors import ConfigError, MachineError
from reslrb_cli.records import manifest as manifests
from reslrb_cli.records.decisions import CACHE_FILE, MOST, Decision, DecisionCache, cache_folder, key_of
from reslrb_cli.records.lock import FolderLock, Holder
from reslrb_cli.records.manifest import MANIFEST_FILE, Manifest, Status, read_manifest
from reslrb_cli.records.run_folder import RunFolder, check_output, check_writable, exposed, link_latest, opened

# Run folders: their names, and that no half-made folder remains.


def make_manifest(**changes):
    return Manifest(**{"variant": "llvm_ad_rgb", "device": "a CPU", "seed": 3, "config": "c.yaml", **changes})


def create(output, name="run", **changes):
    """Return a new run folder that no process uses any more."""
    with RunFolder.create("c.yaml", output, name, "scene: {}\n", make_manifest(**changes)) as folder:
        return folder


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_new_folder_is_complete(tmp_path):
    check_output("c.yaml", tmp_path / "deep" / "runs")
    assert names(tmp_path) == []
    folder = create(tmp_path / "deep" / "runs")
    assert folder.path == tmp_path / "deep" / "runs" / "run"
    assert names(folder.path) == ["checkpoint", "config.yaml", "images", "manifest.json", "parameters"]
    assert names(tmp_path / "deep" / "runs") == ["run"]
    manifest = json.loads((folder.path / "manifest.json").read_text())
    assert manifest["status"] == "running"
    assert manifest["seed"] == 3
    assert {"reslrb", "mitsuba", "drjit", "python"} <= set(manifest["versions"])
    assert manifest["command_line"]
    assert os.access(folder.path, os.R_OK | os.X_OK)


def test_taken_names_get_a_number(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run-3").write_text("a file of that name")
    assert [create(tmp_path).path.name for _ in range(2)] == ["run-2", "run-4"]
    assert names(tmp_path / "run") == []


def test_the_newest_folder_has_a_link(tmp_path, monkeypatch):
    first, second = create(tmp_path), create(tmp_path)
    for folder in (first, second, first):
        link_latest(folder.path)
        assert os.readlink(tmp_path / "latest") == folder.path.name
    assert names(tmp_path) == ["latest", "run", "run-2"]
    with opened(tmp_path / "latest") as (folder, _):
        link_latest(second.path)  # by another run
        assert folder.path == first.path
        assert folder.is_there
    assert create(tmp_path, "latest").path.name == "latest-2"

    def no_links(*_, **__):
        raise OSError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "symlink_to", no_links)
        link_latest(first.path)
    assert os.readlink(tmp_path / "latest") == second.path.name
    assert names(tmp_path) == ["latest", "latest-2", "run", "run-2"]
    for make in (Path.mkdir, Path.touch):  # neither a folder nor a file is replaced
        other = tmp_path / make.__name__
        other.mkdir()
        make(other / "latest")
        link_latest(create(other).path)
        assert not (other / "latest").is_symlink()
        assert names(other) == ["latest", "run"]


def test_many_runs_at_once_leave_one_link(tmp_path):
    folders = [create(tmp_path).path for _ in range(8)]
    threads = [threading.Thread(target=lambda at=at: [link_latest(at) for _ in range(50)]) for at in folders]
    link_latest(folders[0])
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        assert (tmp_path / "latest").is_dir()
    for thread in threads:
        thread.join()
    assert (tmp_path / "latest").resolve() in folders
    assert len(names(tmp_path)) == 9


def test_a_name_that_another_run_takes_first_is_left_to_it(tmp_path, monkeypatch):
    """Between the question whether the name is free and the renaming. Other errors end the run."""
    rename, failing = os.rename, []

    def taking(old, new):
        if Path(new).name == "run":
            failing or Path(new).mkdir()
            raise OSError(errno.ENOTEMPTY, "Directory not empty", str(new))
        rename(old, new)

    monkeypatch.setattr(os, "rename", taking)
    assert create(tmp_path).path.name == "run-2"
    (tmp_path / "run").rmdir()
    failing.append(True)
    with pytest.raises(ConfigError, match="Directory not empty"):
        create(tmp_path)


def test_the_longest_name_leaves_room_for_a_number(tmp_path):
    name = check_name("ü" * (NAME_BYTES // 2))
    assert [create(tmp_path, name).path.name for _ in range(2)] == [name, f"{name}-2"]


def test_an_output_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "runs").write_text("")
    for output in (tmp_path / "runs", tmp_path / "runs" / "deeper"):
        with pytest.raises(ConfigError, match=r"^c\.yaml: run\.output: "):
            check_output("c.yaml", output)
        with pytest.raises(ConfigError, match=r"^c\.yaml: run\.output: "):
            create(output)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")
def test_an_unwritable_output_is_refused_even_for_root(tmp_path):
    with pytest.raises(ConfigError, match=r"run\.output: cannot write to"):
        check_output("c.yaml", Path("/proc/runs"))


def test_a_full_disk_is_not_blamed_on_the_configuration(tmp_path, monkeypatch):
    def fail(*args, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", fail)
    with pytest.raises(MachineError, match="No space left on device"):
        check_output("c.yaml", tmp_path)
    with pytest.raises(MachineError, match="no run folder was made"):
        create(tmp_path)
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("number", "kind", "message"),
    [
        (errno.ENOSPC, MachineError, "run: No space left on device; nothing of the run was changed"),
        (errno.EROFS, ConfigError, r"run: cannot be written to \(Read-only file system\); copy it to another place"),
    ],
)
def test_a_folder_that_cannot_be_written_to_is_not_continued(tmp_path, monkeypatch, number, kind, message):
    folder = create(tmp_path)
    (folder.path / "images").rmdir()
    (folder.path / ".x.1.part").write_text("")
    check_writable(folder)
    assert names(folder.path) == ["checkpoint", "config.yaml", "images", "manifest.json", "parameters"]

    def fail(folder):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("reslrb_cli.records.metrics.mend", fail)
    with pytest.raises(kind, match=message):
        check_writable(folder)


def test_without_locks_runs_still_work(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def fail(descriptor, operation):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", fail)
    with RunFolder.create("c.yaml", tmp_path, "run", "", make_manifest()) as folder:
        content = read_manifest(folder.path)
        assert (content["status"], content["process"]["locked"]) == ("running", False)
        with pytest.raises(ConfigError, match="is in use by a run"), opened(folder.path):
            pass


CONTEND = """
import os, sys, time
from pathlib import Path
from reslrb_cli.records.manifest import Manifest, Status, read_manifest
from reslrb_cli.records.run_folder import RunFolder
output, count = Path(sys.argv[1]), int(sys.argv[2])
for number in range(count):
    mark = f"{os.getpid()}-{number}"
    manifest = Manifest(variant=mark, device="", seed=number, config="c.yaml")
    with RunFolder.create("c.yaml", output, "run", mark, manifest) as folder:
        for name in ("metrics.jsonl", "images/final.exr", "checkpoint/state.npz", "report.html"):
            (folder.path / name).write_text(mark)
            time.sleep(0.01)
        manifest.end(folder.path, Status.FINISHED)
        found = {path.read_text() for path in folder.path.rglob("*") if path.is_file() and path.suffix != ".json"}
        print("mixed" if found != {mark} or mark not in (folder.path / "manifest.json").read_text() else "ran")
"""


@pytest.mark.parametrize(("count", "each"), [(2, 6), pytest.param(8, 40, marks=pytest.mark.long)])
def test_concurrent_runs_have_folders_of_their_own(tmp_path, count, each):
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT)}
    command = [sys.executable, "-c", CONTEND, str(tmp_path), str(each)]
    runs = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
            for _ in range(count)]  # fmt: skip
    done = [run.communicate() for run in runs]
    assert [err for _, err in done] == [""] * count
    outcomes = [line for out, _ in done for line in out.splitlines()]
    assert len(outcomes) == count * each
    assert set(outcomes) == {"ran"}
    assert len(names(tmp_path)) == count * each


# The content of manifests after their process has ended.


def abandoned(folder: Path) -> Manifest:
    """Write and return the manifest of a run whose process, with a lock, has ended."""
    manifest = make_manifest(process=Holder.here(locked=True))
    manifest.write(folder)
    return manifest


def stored(folder: Path):
    return json.loads((folder / MANIFEST_FILE).read_text())


def test_a_killed_run_is_interrupted(tmp_path):
    abandoned(tmp_path)
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 0}\n{"itera')
    (tmp_path / ".report.html.77.part").write_text("half")
    os.utime(tmp_path / "metrics.jsonl", (2e9, 2e9))
    assert stored(tmp_path)["status"] == "running"
    content = read_manifest(tmp_path)
    assert (content["status"], content["ended"]) == ("interrupted", "2033-05-18T03:33:20+00:00")
    assert "ended before the run did" in content["error"]
    # The disk is repaired too, with the files that the process left behind
    assert stored(tmp_path) == content == read_manifest(tmp_path)
    assert (tmp_path / "metrics.jsonl").read_text() == '{"iteration": 0}\n'
    assert sorted(os.listdir(tmp_path)) == [MANIFEST_FILE, "metrics.jsonl"]


@pytest.mark.parametrize("name", [MANIFEST_FILE, "metrics.jsonl", "checkpoint", "images", "parameters"])
def test_the_last_file_of_a_killed_run_tells_its_end(tmp_path, name):
    abandoned(tmp_path)
    (tmp_path / name).touch()
    os.utime(tmp_path / name, (2e9, 2e9))
    assert read_manifest(tmp_path, mend=False)["ended"] == "2033-05-18T03:33:20+00:00"


def test_a_continued_run_is_running(tmp_path):
    abandoned(tmp_path)
    with FolderLock(tmp_path):
        assert read_manifest(tmp_path)["status"] == "running"
    assert stored(tmp_path)["status"] == "running"


def test_a_reader_leaves_a_folder_to_others(tmp_path, monkeypatch):
    """A process that holds the lock, or that has just written the manifest, mends it itself."""
    abandoned(tmp_path)
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_SH)
    assert read_manifest(tmp_path)["status"] == "interrupted"
    assert stored(tmp_path)["status"] == "running"
    os.close(descriptor)
    contents = [stored(tmp_path), stored(tmp_path) | {"seed": 4}]
    monkeypatch.setattr(manifests, "read_content", lambda folder: contents.pop(0))
    assert read_manifest(tmp_path)["status"] == "interrupted"
    assert (stored(tmp_path)["status"], contents) == ("running", [])


def test_a_reader_without_write_permission_sees_the_same(tmp_path, monkeypatch):
    abandoned(tmp_path)

    def fail(*args, **options):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(manifests, "write_atomically", fail)
    assert read_manifest(tmp_path)["status"] == "interrupted"
    assert stored(tmp_path)["status"] == "running"


def test_an_ended_run_keeps_its_status(tmp_path):
    abandoned(tmp_path).end(tmp_path, Status.FAILED, "a line")
    before = stored(tmp_path)
    assert read_manifest(tmp_path) == before
    assert (before["status"], before["error"]) == ("failed", "a line")


def test_a_manifest_is_json_without_extensions(tmp_path):
    manifest = make_manifest()
    manifest.results = {"loss": float("nan")}
    with pytest.raises(ValueError, match="not JSON compliant"):
        manifest.write(tmp_path)


@pytest.mark.parametrize("text", ["{", "[]", '{"program": "other"}', "[" * 100_000, "\udcff"])
def test_foreign_manifests(tmp_path, text):
    (tmp_path / MANIFEST_FILE).write_bytes(text.encode(errors="surrogateescape"))
    assert read_manifest(tmp_path) is None
    assert read_manifest(tmp_path / "nowhere") is None


def test_the_last_status_of_an_exiting_process_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(manifests, "_WRITING", threading.Lock())
    manifest = make_manifest()
    manifest.write(tmp_path)
    for work in (
        lambda: manifest.end_for_good(tmp_path, Status.INTERRUPTED),
        lambda: manifest.end(tmp_path, Status.FINISHED),  # the worker thread does not know of the end
    ):
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        thread.join(timeout=0.5)
    assert thread.is_alive()
    assert (stored(tmp_path)["status"], stored(tmp_path)["ended"] is None) == ("interrupted", False)


# The cache of decisions.


def made(value: object) -> Decision:
    return Decision(setting="guiding", value=str(value), why="measured")


def test_entries_are_kept(tmp_path: Path) -> None:
    keys = [key_of(value) for value in ({"a": 1, "b": [2]}, {"b": [2], "a": 1}, {"a": 2})]
    assert (keys[0] == keys[1], keys[0] == keys[2]) == (True, False)
    DecisionCache(tmp_path / "new").put(keys[0], made(1))
    DecisionCache(tmp_path / "new").put(keys[2], made(2))
    cache = DecisionCache(tmp_path / "new")
    assert [cache.get(key) for key in (*keys[1:], "c")] == [made(1), made(2), None]


def test_jobs_at_the_same_time_lose_no_entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = DecisionCache._read

    def slow(self: DecisionCache) -> dict[str, Any]:
        found = read(self)
        time.sleep(0.02)
        return found

    monkeypatch.setattr(DecisionCache, "_read", slow)
    threads = [threading.Thread(target=DecisionCache(tmp_path).put, args=(str(n), made(n))) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [DecisionCache(tmp_path).get(str(n)) for n in range(6)] == [made(n) for n in range(6)]


def test_the_oldest_entries_are_dropped(tmp_path: Path) -> None:
    cache = DecisionCache(tmp_path)
    (tmp_path / CACHE_FILE).write_text(json.dumps({str(k): made(k).to_json() for k in range(MOST)}))
    cache.put("new", made("new"))
    assert [cache.get(key) for key in ("0", "1", "new")] == [None, made(1), made("new")]
    cache.put("1", made("again"))  # becomes the newest
    assert list(json.loads((tmp_path / CACHE_FILE).read_text()))[-2:] == ["new", "1"]
    cache.put("newer", made("newer"))
    assert [cache.get(key) for key in ("1", "2", "3")] == [made("again"), None, made(3)]


@pytest.mark.parametrize("content", ["{", "[1]", '{"a": 3}', "\xff"])
def test_a_broken_file_counts_as_empty_and_is_repaired(tmp_path: Path, content: str) -> None:
    (tmp_path / CACHE_FILE).write_bytes(content.encode("latin-1"))
    cache = DecisionCache(tmp_path)
    assert cache.get("a") is None
    cache.put("a", made(1))
    assert cache.get("a") == made(1)


def test_an_unwritable_place_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    DecisionCache(tmp_path / "file" / "deeper").put("a", made(1))
    assert DecisionCache(tmp_path / "file" / "deeper").get("a") is None


@pytest.mark.parametrize("exposure", [2.0, np.array([2, 3, 4], np.float32)])
def test_an_exposure_scales_the_colours_only(exposure: Any) -> None:
    image = exposed(np.ones((2, 2, 5), np.float32), exposure, 3)
    assert (image == np.append(np.broadcast_to(exposure, 3), [1, 1])).all()


def test_location(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RESLRB_CACHE", "/own")
    assert cache_folder() == Path("/own")
    monkeypatch.delenv("RESLRB_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert cache_folder() == Path("/xdg/reslrb")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "reslrb"


def test_a_decision_may_tell_the_time_of_its_measurement() -> None:
    made = Decision(setting="paths", value="light", why="it is faster", seconds=1.25)
    plain = "paths light: it is faster"
    assert [made.line(), replace(made, seconds=0.0).line(cost=True)] == [plain, plain]
    assert made.line(cost=True) == f"{plain} (measured in 1.2 s)"
    assert replace(made, cached=True).line(cost=True) == f"{plain} (as an earlier run measured)"
