"""Run folders: names, what --force may replace, and that nothing half-made stays."""

from __future__ import annotations

import json
import os

import pytest

from reslrb_cli.config.limits import NAME_BYTES
from reslrb_cli.config.names import check_name
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.run_folder import RunFolder, check_output


def make_manifest(**changes):
    return Manifest(**{"variant": "llvm_ad_rgb", "device": "a CPU", "seed": 3, "config": "c.yaml", **changes})


def create(output, name="run", force=False, **changes):
    return RunFolder.create("c.yaml", output, name, force, "scene: {}\n", make_manifest(**changes))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_new_folder_is_whole(tmp_path):
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
    (tmp_path / "run-3").write_text("a file of that name")
    assert [create(tmp_path).path.name for _ in range(3)] == ["run", "run-2", "run-4"]


def test_the_longest_name_leaves_room_for_a_number(tmp_path):
    name = check_name("ü" * (NAME_BYTES // 2))
    assert [create(tmp_path, name).path.name for _ in range(2)] == [name, f"{name}-2"]


def test_an_empty_folder_of_that_name_is_not_taken_over(tmp_path):
    (tmp_path / "run").mkdir()
    assert create(tmp_path).path.name == "run-2"
    assert names(tmp_path / "run") == []


def test_force_replaces_a_run_and_leaves_what_is_not_its_own(tmp_path):
    first = create(tmp_path).path
    (first / "notes.txt").write_text("mine")
    (first / "report.html").write_text("old")
    (first / "images" / "final.exr").write_text("old")
    folder = create(tmp_path, force=True, seed=4)
    assert folder.path == first
    assert (first / "notes.txt").read_text() == "mine"
    assert not (first / "report.html").exists()
    assert names(first / "images") == []
    assert json.loads((first / "manifest.json").read_text())["seed"] == 4
    assert names(tmp_path) == ["run"]


def test_force_does_not_follow_links(tmp_path):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.tex").write_text("years")
    run = create(tmp_path / "runs").path
    (run / "images").rmdir()
    (run / "images").symlink_to(precious)
    create(tmp_path / "runs", force=True)
    assert names(precious) == ["thesis.tex"]


@pytest.mark.parametrize("kind", ["folder", "foreign manifest", "file", "link"])
def test_force_refuses_what_is_no_run_folder(tmp_path, kind):
    path = tmp_path / "run"
    if kind == "file":
        path.write_text("precious")
    elif kind == "link":
        path.symlink_to(create(tmp_path, "other").path)
    else:
        path.mkdir()
        (path / "thesis.tex").write_text("years")
        if kind == "foreign manifest":
            (path / "manifest.json").write_text('{"name": "a web app"}')
    before = names(tmp_path)
    for attempt in (lambda: check_output("c.yaml", tmp_path, "run", True), lambda: create(tmp_path, force=True)):
        with pytest.raises(ConfigError, match=r"^c\.yaml: run\.name: .*not a run folder"):
            attempt()
    assert names(tmp_path) == before


def test_an_output_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "runs").write_text("")
    for output in (tmp_path / "runs", tmp_path / "runs" / "deeper"):
        with pytest.raises(ConfigError, match=r"^c\.yaml: run\.output: "):
            check_output("c.yaml", output, "run", False)
        with pytest.raises(ConfigError, match=r"^c\.yaml: run\.output: "):
            create(output)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")
def test_an_unwritable_output_is_refused_for_root_too(tmp_path):
    from pathlib import Path

    with pytest.raises(ConfigError, match=r"run\.output: cannot write to"):
        check_output("c.yaml", Path("/proc/runs"), "run", False)


def test_checking_leaves_nothing_behind(tmp_path):
    check_output("c.yaml", tmp_path / "new" / "runs", "run", False)
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "../up", "a\\b"])
def test_names_that_leave_the_output_are_refused(tmp_path, name):
    with pytest.raises(ConfigError, match=r"run\.name"):
        check_output("c.yaml", tmp_path, name, False)


def test_a_failed_start_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(Manifest, "write", lambda self, folder: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(ConfigError, match="No space left"):
        create(tmp_path / "runs")
    assert names(tmp_path / "runs") == []


def test_the_end_is_written(tmp_path):
    manifest = make_manifest()
    folder = RunFolder.create("c.yaml", tmp_path, "run", False, "", manifest)
    manifest.end(folder.path, Status.FAILED, "out of memory")
    content = json.loads((folder.path / "manifest.json").read_text())
    assert (content["status"], content["error"]) == ("failed", "out of memory")
    assert content["ended"] >= content["started"]
    assert "manifest.json" in names(folder.path)
    assert not [name for name in names(folder.path) if name.endswith(".part")]
