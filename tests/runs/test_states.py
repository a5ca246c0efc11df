"""With states that are damaged or do not fit, the run continues or one line gives the reason."""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli import tiny
from cli.test_storms import mount
from runs.going_on import differences, one_thread, optimize, records_of, state_of

from reslrb_cli.cli import main
from reslrb_cli.cli import optimize as cli_optimize
from reslrb_cli.config.loader import load
from reslrb_cli.errors import BackendError, ConfigError
from reslrb_cli.records.checkpoint import read_state, save_checkpoint
from reslrb_cli.records.lock import FolderLock, Holder
from reslrb_cli.records.run_folder import RunFolder, read_config, read_value, recovered
from reslrb_cli.runs import prepare, recorder, resume
from reslrb_cli.runs.log import append_log
from reslrb_cli.runs.prepare import moves

STATE, PREVIOUS = "checkpoint/state.npz", "checkpoint/previous.npz"


@pytest.fixture
def run(interrupted: Path, tmp_path: Path) -> Path:
    """Copy of the interrupted run."""
    return Path(shutil.copytree(interrupted, tmp_path / "run"))


def told(capsys: pytest.CaptureFixture[str], run: Path, *args: str) -> str:
    """Return the one line with which `--resume` refuses the run, without the folder. The run must stay unchanged."""
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        main.main(["optimize", "--resume", str(run), "--quiet", *args])
    logging.getLogger("reslrb_cli").handlers.clear()
    out, err = capsys.readouterr()
    assert (end.value.code, out) == (2, ""), err
    assert "Traceback" not in err
    after = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert after.keys() == before.keys()
    assert [path for path in after if after[path] != before[path]] == []
    [line] = [line for line in err.splitlines() if not line.startswith("variant ")]
    return line.replace(f"{run}/", "")


def rewritten(run: Path, arrays: dict[str, Any] | None = None, values: dict[str, Any] | None = None) -> None:
    """Write the states of a run again with other arrays and values. A value of None removes its entry."""
    for name in (STATE, PREVIOUS):
        with np.load(run / name) as state:
            kept = {key: state[key] for key in state.files}
        told = json.loads(kept.pop("state").tobytes()) | (values or {})
        kept |= arrays or {}
        kept["state"] = np.frombuffer(json.dumps(told).encode(), np.uint8)
        np.savez(run / name, **{key: value for key, value in kept.items() if value is not None})


PARAMETER = f"parameter/{tiny.KEY}"
WRONG: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "a shape": ({PARAMETER: np.ones((4, 3, 4), np.float32)}, {}, f"{PARAMETER}: has shape (4, 3, 4), not (4, 4, 3)"),
    "objects": ({"mask/x": np.array([{}], dtype=object)}, {}, "is damaged, cut off, or not written by reslrb ("),
    "no state": ({"state": None}, {}, ""),
    "more iterations than its history": ({}, {"iteration": 6}, "history/loss: has shape (4,), not (6,)"),
    "another last record": ({}, {"last": None}, "last: is not the record of iteration 3"),
    "no history": ({"history/rate": None}, {}, "history/rate: is missing"),
    "too many iterations": ({}, {"iteration": 7}, "run.iterations: is 6; the run has done 7 already"),
    "a time": ({}, {"elapsed_s": "long"}, "elapsed_s: Input should be a valid number"),
    "a number as text": ({}, {"elapsed_s": "1.5"}, "elapsed_s: Input should be a valid number"),
    "a decision": ({}, {"decisions": [{"setting": 3}]}, "decisions.0."),
    "an earlier version": ({}, {"format": 2}, "state: is of another version of reslrb"),
    "a later version": ({}, {"format": 99}, "state: is of another version of reslrb"),
}


@pytest.mark.parametrize("case", WRONG)
def test_an_unfitting_state_is_one_line(case: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, values, message = WRONG[case]
    rewritten(run, arrays, values)
    if case == "no state":
        for iteration in (3, 4):
            save_checkpoint(run / "checkpoint", iteration, {f"parameter/{tiny.KEY}": np.ones((4, 4, 3), np.float32)})
        message = "holds values alone, not the state of a run"
    assert message in told(capsys, run)


DAMAGED: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda data: b"",
    "half": lambda data: data[: len(data) // 2],
    "a bit": lambda data: data[:700] + bytes([data[700] ^ 1]) + data[701:],
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_state_is_reported(case: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in (STATE, PREVIOUS):
        (run / name).write_bytes(DAMAGED[case]((run / name).read_bytes()))
    line = told(capsys, run)
    assert line.startswith("checkpoint/state.npz: "), line
    assert "is damaged, cut off, or not written by reslrb" in line


def test_the_previous_state_is_used_and_reported(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / STATE).write_bytes((run / STATE).read_bytes()[:-40])
    assert optimize("--resume", str(run)) == 0
    err = capsys.readouterr().err
    assert "state.npz: is damaged, cut off, or not written by reslrb" in err
    assert "continuing from the previous state, after 3 iterations" in err
    assert [record["iteration"] for record in records_of(run)] == list(range(6))
    assert int(state_of(run)["iteration"]) == 6
    with np.load(run / PREVIOUS) as previous:  # not the damaged state
        assert int(previous["iteration"]) == 5


def test_a_continued_run_that_stops_at_once_keeps_both_states(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records = recorder.Recording.records
    monkeypatch.setattr(recorder.Recording, "records", lambda self, stop: records(self, lambda: True))
    assert optimize("--resume", str(run), "--quiet") == 130
    assert [int(read_state(run / name)[0]["iteration"]) for name in (PREVIOUS, STATE)] == [3, 4]


def test_a_missing_state_is_reported(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / STATE).unlink()
    assert optimize("--resume", str(run), "--quiet") == 0
    err = capsys.readouterr().err
    assert "state.npz: is missing; continuing from the previous state, after 3 iterations" in err


def test_long_settings_are_cut_off_in_messages() -> None:
    for value, shown in ((None, "not set"), ("x" * 60, "x" * 60), ("x" * 61, "x" * 57 + "...")):
        assert prepare._shown(value) == shown


def test_a_damaged_state_does_not_become_the_previous_one(run: Path) -> None:
    """Only one more state is saved. The state that the run continued from is then the previous one."""
    (run / STATE).write_bytes(b"damaged")
    assert optimize("--resume", str(run), "--quiet", "--set", "run.checkpoint_every={iterations: 100}") == 0
    iterations = [int(read_state(run / name)[0]["iteration"]) for name in (PREVIOUS, STATE)]
    assert iterations == [3, 6]


def test_the_manifest_of_a_resumed_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It has this process, and the versions that have changed. A line names them."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    content = json.loads((run / "manifest.json").read_text())
    content |= {"process": content["process"] | {"pid": gone.pid}, "versions": content["versions"] | {"drjit": "0.1"}}
    content |= {"started": "2026-01-02T03:04:05+00:00", "commit": "0123abc"}
    (run / "manifest.json").write_text(json.dumps(content))
    assert optimize("--resume", str(run), "--quiet") == 0
    after, now = json.loads((run / "manifest.json").read_text()), version("drjit")
    assert (after["process"]["pid"], after["process"]["locked"]) == (os.getpid(), True)
    assert [after[key] for key in ("started", "commit")] == [content[key] for key in ("started", "commit")]
    assert after["resumed"][0]["versions"] == {"drjit": ["0.1", now]}
    line = f"versions have changed since the run began: drjit 0.1 then, {now} now; results may differ"
    assert line in capsys.readouterr().err
    assert optimize("--resume", str(run), "--quiet", "--set", "run.iterations=7") == 0
    assert "versions have changed" not in capsys.readouterr().err


def test_a_loss_of_power_keeps_manifest_and_metrics(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a state or a reader relies on is flushed before the state or the new name appears."""
    flush, replace_file, events = os.fsync, os.replace, list[tuple[str, str]]()

    def note(kind: str, path: object) -> None:
        name = re.sub(r"^\.|\.\d+\.part$", "", Path(os.fspath(path)).name)  # type: ignore[call-overload]
        events.append((kind, name))

    def fsync(descriptor: int) -> None:
        note("flush", os.readlink(f"/proc/self/fd/{descriptor}"))
        flush(descriptor)

    def renamed(source: Any, target: Any, **given: Any) -> None:
        note("rename", target)
        replace_file(source, target, **given)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", renamed)
    assert optimize("--resume", str(run), "--quiet", "--set", "run.checkpoint_every={iterations: 1}") == 0
    written = [n for n, event in enumerate(events) if event == ("rename", "manifest.json")]
    assert len(written) == 2
    for n in written:
        assert events[n - 1] == ("flush", "manifest.json")
        assert events[n + 1] == ("flush", run.name)
    states = [n for n, event in enumerate(events) if event == ("flush", "next.npz")]
    assert len(states) == 2
    for n in states:
        assert events[n - 1] == ("flush", "metrics.jsonl")
        assert events[n + 1 : n + 3] == [("rename", "next.npz"), ("flush", "checkpoint")]


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_a_run_continues_with_the_variant_of_its_start(
    variant: str, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where its configuration has `variant: auto`, which now means another one."""
    rewritten(run, values={"variant": variant})
    asked: list[str] = []

    def start(config: Any) -> str:
        asked.append(config.variant)
        raise BackendError("enough")

    monkeypatch.setattr(cli_optimize, "start_variant", start)
    assert optimize("--resume", str(run), "--quiet") == 3
    assert asked == [variant]


def test_differences_are_shown(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, run, "--set", "run.spp=8").startswith("--set: run.spp: is 8, 4 in the run; ")
    assert "loss.type: is l1, l2 in the run" in told(capsys, run, "--set", "run.iterations=9", "--set", "loss.type=l1")
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("max_depth: 3", "max_depth: 4"))
    # The override only changes a setting that may change, so the file is the source of the change.
    line = told(capsys, run, "--set", "run.iterations=9")
    assert line.startswith("config.yaml: integrator.max_depth: is 4, 3 in the run; ")


def test_changed_files_are_another_experiment(run: Path, interrupted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scene, and an image that it names."""
    for name, message in (("scene.xml", "scene.file: {} has changed since "),
                          ("poster.exr", "scene.file (poster.exr): has changed since ")):  # fmt: skip
        file = interrupted.parents[1] / name
        content = file.read_bytes()
        file.write_bytes(content.replace(b"8, 8, 8", b"9, 9, 9") + b" ")
        try:
            assert message.format(file) in told(capsys, run)
        finally:
            file.write_bytes(content)


def test_changeable_settings_are_in_the_manifest(run: Path, tmp_path: Path) -> None:
    """Iterations and learning rates can change. A copy of the folder continues as the folder would."""
    copy = tmp_path / "other/copy"
    shutil.copytree(run, copy)
    sets = ["run.iterations=7", "optimizer.learning_rate=0.1"]
    assert optimize("--resume", str(copy), "--quiet", *(word for each in sets for word in ("--set", each))) == 0
    [resumed] = json.loads((copy / "manifest.json").read_text())["resumed"]
    assert resumed["changed"] == {"run.iterations": [6, 7], "optimizer.learning_rate": [0.02, 0.1]}
    assert [record["lr"] for record in records_of(copy)] == [0.02] * 4 + [0.1] * 3
    assert len(records_of(run)) < 7


@pytest.mark.parametrize("change", ["run.output=other", "run.name=other"])
def test_a_run_continues_in_its_own_folder(change: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = told(capsys, run, "--set", change)
    assert line.startswith(f"--set: {change.partition('=')[0]}: cannot change now; to leave ")
    assert line.endswith("as it is, copy it and resume the copy")


def test_a_finished_run_is_reported(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert optimize("--resume", str(run), "--quiet") == 0
    before = (run / "manifest.json").read_bytes()
    capsys.readouterr()
    assert optimize("--resume", str(run)) == 0
    assert "is finished, after 6 of 6 iterations; --set run.iterations=NUMBER continues it" in capsys.readouterr().out
    assert (run / "manifest.json").read_bytes() == before
    assert "run.iterations: is 5; the run has done 6 already" in told(capsys, run, "--set", "run.iterations=5")


def test_a_full_disk_leaves_the_run_as_it_was(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The state is not blamed, and stays."""

    def fail(*given: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = (run / STATE).read_bytes()
    monkeypatch.setattr(resume, "write_beginning", fail)
    assert optimize("--resume", str(run), "--quiet") == 6
    assert (run / STATE).read_bytes() == before


def test_a_missing_run_is_reported(tmp_path: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, tmp_path / "nothing") == f"{tmp_path}/nothing: no such file or folder"
    (tmp_path / "empty").mkdir()
    assert "is no run's folder" in told(capsys, tmp_path / "empty")
    shutil.rmtree(run / "checkpoint")
    assert "has no checkpoint/state.npz" in told(capsys, run)


@pytest.mark.skipif(os.name != "posix", reason="no locks")
def test_a_running_run_is_left_alone(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FolderLock.__init__, "__defaults__", (0.05, False))  # waits for a shorter time
    with FolderLock(run):
        assert "is in use by a run (a loop of this process; leave it" in told(capsys, run)
    process = subprocess.Popen(["sleep", "60"])
    (run / "manifest.json").write_text(
        json.dumps(
            json.loads((run / "manifest.json").read_text())
            | {"process": asdict(replace(Holder.here(True), pid=process.pid))}
        )
    )
    process.kill()
    process.wait()
    with FolderLock(run):
        assert f"is in use by a run (process {process.pid} on " in told(capsys, run)


def test_a_run_needs_no_log(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The log has a gap, or is missing. The results in the manifest do not depend on it."""
    whole, lines = run.with_name("whole"), (run / "metrics.jsonl").read_bytes().splitlines(keepends=True)
    shutil.copytree(run, whole)
    (run / "metrics.jsonl").write_bytes(b"".join(lines[:2]))
    with one_thread():
        assert [optimize("--resume", str(each), "--quiet") for each in (whole, run)] == [0, 0]
    assert "metrics.jsonl: lacks 2 of the 4 iterations of the checkpoint" in capsys.readouterr().err
    assert [record["iteration"] for record in records_of(run)] == [0, 1, 4, 5]
    assert differences(whole, run) == ["records_of"]
    (run / "metrics.jsonl").unlink()
    assert optimize("--resume", str(run)) == 0
    assert "is finished, after 6 of 6 iterations" in capsys.readouterr().out


def test_a_moved_run_continues(run: Path, interrupted: Path, tmp_path: Path) -> None:
    """The files of the experiment were moved with the run. Their former places do not exist."""
    place, away = tmp_path / "elsewhere", interrupted.parents[1] / "scene.old"
    (place / "runs").mkdir(parents=True)
    moved = run.rename(place / "runs/tiny")
    scene = interrupted.parents[1] / "scene.xml"
    for file in (scene, scene.with_name("poster.exr")):
        shutil.copy(file, place)
    scene.rename(away)
    try:
        assert optimize("--resume", str(moved), "--quiet") == 0
        config = load(moved / "config.yaml")
        assert config.scene.file == place / "scene.xml"
        other = place / "other.xml"
        (place / "scene.xml").rename(other)
        again = ["--resume", str(moved), "--quiet", "--set", "run.iterations=7"]
        assert optimize(*again, "--set", f"scene.file={other}") == 0
        assert json.loads((moved / "manifest.json").read_text())["resumed"][1]["changed"]["scene.file"][1] == str(other)
        assert int(state_of(moved)["iteration"]) == 7
    finally:
        away.rename(scene)


def test_a_copied_run_uses_the_files_of_the_first_one(run: Path, interrupted: Path, tmp_path: Path) -> None:
    """Although other files lie where its own would lie if they had been moved."""
    copy = Path(shutil.copytree(run, tmp_path / "other/runs/tiny"))
    (tmp_path / "other/scene.xml").write_text("another scene")
    assert read_config(copy).scene.file == interrupted.parents[1] / "scene.xml"


def test_only_the_place_of_a_file_may_change(interrupted: Path) -> None:
    code = ["loss={type: custom, file: /a/own.py:f}", "integrator.max_depth=3"]
    config = load(interrupted / "config.yaml", code)
    cases: dict[tuple[str, object, object], bool] = {
        ("scene.file", "/a/scene.xml", "/b/other.xml"): True,
        ("scene.file", None, "/b/scene.xml"): False,
        ("scene.file", "/a/scene.xml", None): False,
        ("loss.file", "/a/own.py:f", "/b/other.py:f"): True,
        ("loss.file", "/a/own.py:f", "/a/own.py:g"): False,
        ("run.spp", 4, 8): False,
    }
    for (key, before, now), allowed in cases.items():
        assert moves(key, (before, now), config) == allowed, key


def test_files_of_initial_values_may_change(tmp_path: Path) -> None:
    tiny.write_experiment(tmp_path)
    config = load(tmp_path / "tiny.yaml", ["parameters[0].initial={file: poster.exr}"])
    assert {key.partition(" ")[0] for key in prepare.digests(config)} == {"scene.file"}


def test_a_continued_run_keeps_its_past_and_tidies_up(run: Path) -> None:
    """The record of the past has entries that only a measurement before the first iteration can make."""
    manifest = json.loads((run / "manifest.json").read_text())
    past = {"incomplete": [{"parameter": "a", "share": 0.5}], "started": "2026-01-01T00:00:00+00:00", "commit": "abc"}
    past |= {"resumed": [{"iteration": 2}], "versions": manifest["versions"] | {"mitsuba": "0.1"}}
    (run / "manifest.json").write_text(json.dumps(manifest | past))
    (run / "images/.x.png.77.part").touch()
    assert optimize("--resume", str(run), "--quiet") == 0
    found = json.loads((run / "manifest.json").read_text())
    assert {key: found[key] for key in ("incomplete", "started", "commit")} == {
        key: past[key] for key in ("incomplete", "started", "commit")
    }
    first, second = found["resumed"]
    assert (first, second["iteration"], second["changed"]) == ({"iteration": 2}, 4, {})
    assert not os.path.lexists(run.parent / "latest")  # the link stays at the newest run
    assert second["versions"] == {"mitsuba": ["0.1", manifest["versions"]["mitsuba"]]}
    assert list(run.rglob(".*.part")) == []


def test_unfinished_files_of_a_run_are_removed_at_its_end(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = recorder.write_parameters
    monkeypatch.setattr(recorder, "write_parameters", lambda *given: ((run / ".y.1.part").touch(), write(*given)))
    assert optimize("--resume", str(run), "--quiet") == 0
    assert list(run.rglob(".*.part")) == []


@pytest.mark.parametrize("known", [{}, {"iterations": 7}])
def test_an_abandoned_run_is_interrupted(tmp_path: Path, known: dict[str, int]) -> None:
    """A folder that somebody has removed stays removed."""
    ended: list[Any] = []
    manifest = SimpleNamespace(results=dict(known), end_for_good=lambda *given: ended.append(given))
    course = SimpleNamespace(last=SimpleNamespace(elapsed_s=2.5))
    for is_there in (False, True):
        folder = SimpleNamespace(path=tmp_path, is_there=is_there)
        run: Any = SimpleNamespace(manifest=manifest, course=course, done=3, folder=folder)
        recorder.Recording.abandon(run)
        assert ended == [(tmp_path, "interrupted")] * is_there
    assert manifest.results == (known or {"iterations": 3, "elapsed_s": 2.5})
    course.last, manifest.results = None, {}
    recorder.Recording.abandon(run)
    assert manifest.results == {}


def test_recovered_values_are_found_from_any_folder(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.parent)
    assert [str(spec.initial.run) for spec in recovered(Path("run"), ()).parameters] == [str(run)]


def test_any_text_can_be_logged(run: Path) -> None:
    append_log(RunFolder(run), ["a\udcff"])
    assert (run / "run.log").read_text().endswith("a\\udcff\n")
    (run / "run.log").unlink()
    append_log(RunFolder(run), [])
    append_log(RunFolder(run / "gone"), ["b"])
    assert not (run / "run.log").exists()


def test_the_commit_is_that_of_the_configuration(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders: list[Path] = []
    monkeypatch.setattr(prepare, "commit_of", folders.append)
    monkeypatch.chdir("/")
    assert optimize(str(run / "config.yaml"), "--quiet", "--set", "run.iterations=1", "--set", "run.name=x") == 0
    assert folders == [run]


def test_a_missing_file_is_named(run: Path, interrupted: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = interrupted.parents[1] / "scene.xml"
    line = told(capsys, run, "--set", f"scene.file={run}/other.xml")
    assert line.startswith("config.yaml: scene.file: other.xml is missing since "), line
    (run / "other.xml").write_text(scene.read_text().replace("8, 8, 8", "9, 9, 9"))
    assert "other.xml has changed since " in told(capsys, run, "--set", f"scene.file={run}/other.xml")


def test_values_outlive_the_checkpoints(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected = read_value(run, tiny.KEY)
    shutil.rmtree(run / "checkpoint")
    assert (read_value(run, tiny.KEY) == expected).all()
    with pytest.raises(SystemExit) as end:
        main.main(["export", str(run), "-o", str(tmp_path / "out")])
    assert not end.value.code, capsys.readouterr().err
    with pytest.raises(ConfigError, match=f"did not recover `other`; it has `{tiny.KEY}`$"):
        read_value(run, "other")
    np.savez(run / "parameters/parameters.npz", **{f"key{number}": np.zeros(3) for number in range(4)})
    with pytest.raises(ConfigError, match=r"did not recover `key9`; it has `key.` and `key.` and `key.` and 1 more$"):
        read_value(run, "key9")
    (run / "parameters/parameters.npz").unlink()
    with pytest.raises(ConfigError, match=r"has no checkpoint/state\.npz"):
        read_value(run, tiny.KEY)


def test_an_unwritable_folder_is_reported(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    mount(place, 4096)
    try:
        shutil.copytree(run, place, dirs_exist_ok=True)
        subprocess.run(["mount", "-o", "remount,ro", place], check=True)
        assert "cannot be written to (Read-only file system); copy it to another place" in told(capsys, place)
    finally:
        while os.path.ismount(place):
            subprocess.run(["umount", str(place)], check=True)
