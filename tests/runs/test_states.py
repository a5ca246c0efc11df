"""States that are damaged, nearly right, or made by an enemy: the run goes on, or one line says why not."""

from __future__ import annotations

import io
import json
import logging
import os
import random
import shutil
import struct
import subprocess
import sys
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli import tiny
from cli.test_storms import mount
from runs.going_on import left_over, optimize, records_of, state_of
from scene.mutations import mutate_bytes
from scene.test_hostile import Hostile, judge
from turns import a_few

from reslrb_cli.cli import main
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.checkpoint import Archive, open_state, save_checkpoint
from reslrb_cli.records.lock import FolderLock
from reslrb_cli.records.manifest import read_manifest

# States that are damaged, or made by an enemy; folders and locks; what may change and what not.

STATE, PREVIOUS = "checkpoint/state.npz", "checkpoint/previous.npz"


@pytest.fixture
def run(interrupted: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(interrupted, tmp_path / "run"))


def told(capsys: pytest.CaptureFixture[str], run: Path, *args: str) -> str:
    """The one line with which `--resume` is refused, without the folder; the run is as it was."""
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
    """Write the states of a run anew, with other arrays and values; None leaves out."""
    for name in (STATE, PREVIOUS):
        with np.load(run / name) as state:
            kept = {key: state[key] for key in state.files}
        told = json.loads(kept.pop("state").tobytes()) | (values or {})
        kept |= arrays or {}
        kept["state"] = np.frombuffer(json.dumps(told).encode(), np.uint8)
        np.savez(run / name, **{key: value for key, value in kept.items() if value is not None})


PARAMETER = f"parameter/{tiny.KEY}"
EVIL: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "NaN": ({PARAMETER: np.full((4, 4, 3), np.nan, np.float32)}, {}, f"`{PARAMETER}` holds a value that is not finite"),
    "a shape": ({PARAMETER: np.ones((4, 5, 3), np.float32)}, {}, f"has `{PARAMETER}` of shape 4x5x3; it must be 4x4x3"),
    "a type": ({PARAMETER: np.ones((4, 4, 3), np.float64)}, {}, "is float64 in place of float32"),
    "a value above its bound": (
        {PARAMETER: np.full((4, 4, 3), 1.5, np.float32)}, {},
        f"{PARAMETER}: holds 1.5, outside of 0 to 1, its bounds: not as a run writes it"),
    "one value below its bound": (
        {PARAMETER: np.eye(4, dtype=np.float32)[..., None].repeat(3, 2) - np.float32(1e-6)}, {},
        f"{PARAMETER}: holds -1e-06, outside of 0 to 1, its bounds"),
    "a beginning out of bounds": (
        {f"initial/{tiny.KEY}": np.full((4, 4, 3), -2, np.float32)}, {}, f"initial/{tiny.KEY}: holds -2, outside"),
    "a best out of bounds": (
        {f"best/{tiny.KEY}": np.full((4, 4, 3), 7, np.float32)}, {"best": {"iteration": 1, "loss": 2}},
        f"best/{tiny.KEY}: holds 7, outside of 0 to 1"),
    "integers": ({PARAMETER: np.ones((4, 4, 3), np.int32)}, {}, "is int32 in place of float32"),
    "no value": ({PARAMETER: None}, {}, f"lacks `{PARAMETER}`"),
    "a foreign value": ({"parameter/../../etc/passwd": np.ones(3, np.float32)}, {}, "is no parameter of this run"),
    "NaN moments": (
        {f"optimizer/{tiny.KEY}/1": np.full(48, np.nan, np.float32)}, {}, "holds a value that is not finite"),
    "a moment's shape": ({f"optimizer/{tiny.KEY}/2": np.ones(47, np.float32)}, {}, "of shape 47; it must be 48"),
    "no moments": ({f"optimizer/{tiny.KEY}/1": None}, {}, f"lacks `optimizer/{tiny.KEY}/1`"),
    "objects": ({"mask/x": np.array([{}], dtype=object)}, {}, "is damaged, cut off, or not written by a run ("),
    "text": ({"mask/x": np.array("x")}, {}, "is damaged, cut off, or not written by a run ("),
    "no state": ({"state": None}, {}, ""),
    "iterations": ({}, {"iteration": -1}, "iteration: Input should be greater than or equal to 0: not as"),
    "more iterations than lines": ({}, {"iteration": 6}, "metrics.jsonl: holds 4 of the 6 iterations"),
    "too many iterations": ({}, {"iteration": 7}, "run.iterations: is 6; the run has done 7 already"),
    "a time": ({}, {"elapsed_s": "long"}, "elapsed_s: Input should be a valid number"),
    "an infinite time": ({}, {"elapsed_s": 1e999}, "is no JSON, as a run writes it (Infinity is no number)"),
    "units": ({}, {"units": {"wall": [1, 1]}}, "units.wall: is of a parameter that the run does not have"),
    "a unit": ({}, {"units": {tiny.KEY: [0, 1]}}, f"units.{tiny.KEY}.0: Input should be greater than 0"),
    "a list of units": ({}, {"units": [1]}, "units: Input should be an object"),
    "scaling": ({}, {"scaling": [{"key": tiny.KEY}]}, "scaling.0.entries: Field required"),
    "best": ({}, {"best": {"iteration": 1, "loss": 2}}, f"lacks `best/{tiny.KEY}`"),
    "a best loss": (
        {f"best/{tiny.KEY}": np.ones((4, 4, 3), np.float32)}, {"best": {"iteration": 1}}, "best.loss: Field required"),
    "images": ({}, {"images": {"trained": "x", "held_out": []}}, "images.trained: Input should be a valid array"),
    "a configuration": ({}, {"config": 5}, "config: Input should be a valid string"),
    "another configuration": ({}, {"config": "a: [b"}, "checkpoint/state.npz:1: not valid YAML"),
    "a version": ({}, {"format": 99}, "state: is of another version of reslrb"),
    "another variant": ({}, {"variant": "scalar_rgb"}, "variant: is none of those that a run can have"),
    "keys": ({}, {"certainty": {"seen": 0, "keys": 5}}, "certainty.keys: Input should be a valid array"),
    "a long configuration": ({}, {"config": "a" * 2000000}, "config: String should have at most "),
    "a decision": ({}, {"decisions": [{"setting": 3}]}, "decisions.0."),
    "a variant": ({}, {"variant": 3}, "variant: Input should be a valid string"),
    "a mask": ({f"mask/{tiny.KEY}": np.ones((9, 9), bool)}, {}, "of shape 9x9; it must be 4x4"),
    "a best that is none": ({}, {"best": 0}, "best: Input should be an object"),
}  # fmt: skip

FEW = ("NaN", "a shape", "a value above its bound", "one value below its bound", "a best out of bounds",
       "a foreign value", "NaN moments", "objects", "no state", "iterations", "more iterations than lines", "units",
       "scaling", "a configuration", "a version")  # fmt: skip


@pytest.mark.parametrize("case", a_few(EVIL, FEW))
def test_a_state_that_no_run_wrote_is_told_in_a_line(case: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arrays, values, message = EVIL[case]
    rewritten(run, arrays, values)
    if case == "no state":
        for iteration in (3, 4):
            save_checkpoint(run / "checkpoint", iteration, {tiny.KEY: np.ones((4, 4, 3), np.float32)}, {})
        message = "holds values alone, not the state of a run"
    assert message in told(capsys, run)


def forged(head: bytes, data: bytes = b"", name: str = "x.npy", kind: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of one entry with this head."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as archive:
        archive.writestr(name, b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data)
    return file.getvalue()


HEAD = b"{'descr': '<f4', 'fortran_order': False, 'shape': (%s,), }\n"
DAMAGED: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda data: b"",
    "zeros": lambda data: bytes(len(data)),
    "half": lambda data: data[: len(data) // 2],
    "all but a byte": lambda data: data[:-1],
    "a bit": lambda data: data[:700] + bytes([data[700] ^ 1]) + data[701:],
    "huge": lambda data: forged(HEAD % b"1000000000000000000"),
    "negative": lambda data: forged(HEAD % b"-1, -4", bytes(16)),
    "compressed": lambda data: forged(HEAD % b"1000", bytes(4000), kind=zipfile.ZIP_DEFLATED),
    "another place": lambda data: forged(HEAD % b"1", bytes(4), name="../../x"),
    "a program": lambda data: forged(b"__import__('os').system('touch evil')\n", bytes(4)),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_state_is_told(case: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in (STATE, PREVIOUS):
        (run / name).write_bytes(DAMAGED[case]((run / name).read_bytes()))
    line = told(capsys, run)
    assert line.startswith("checkpoint/state.npz: "), line
    assert "is damaged, cut off, or not written by a run" in line
    assert not Path("evil").exists()


def test_every_byte_of_a_state_is_under_guard(run: Path) -> None:
    """A byte that changes is seen, or is one of those that say nothing of the values (dates, versions, comments)."""
    whole = (run / STATE).read_bytes()
    with Archive(run / STATE) as archive:
        values = {name: archive.array(name).tobytes() for name in archive.heads}
    chance = np.random.default_rng(1)
    seen = 0
    for place in chance.choice(len(whole), 150, replace=False):
        (run / STATE).write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        try:
            archive, _ = open_state(run / STATE)
        except ConfigError:  # and nothing else
            seen += 1
        else:
            with archive:
                assert {name: archive.array(name).tobytes() for name in archive.heads} == values, place
    assert seen > 100


def test_the_state_before_is_taken_and_that_is_said(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / STATE).write_bytes((run / STATE).read_bytes()[:-40])
    assert optimize("--resume", str(run)) == 0
    err = capsys.readouterr().err
    assert "state.npz: is damaged, cut off, or not written by a run" in err
    assert "going on from the state before, after 3 iterations" in err
    assert [record["iteration"] for record in records_of(run)] == list(range(6))
    assert int(state_of(run)["iteration"]) == 6
    with np.load(run / PREVIOUS) as previous:  # not the damaged one
        assert int(previous["iteration"]) == 5


def test_what_differs_is_shown(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, run, "--set", "run.spp=8").startswith("--set: run.spp: is 8, 4 in the run; ")
    line = told(capsys, run, *(word for each in ("run.seed=1", "run.spp=8", "loss.type=l1", "run.reach_spp=9")
                               for word in ("--set", each)))  # fmt: skip
    assert all(part in line for part in ("is l1, l2 in the run", "run.spp is 8", "1 more"))
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("max_depth: 3", "max_depth: 4"))
    assert told(capsys, run).startswith("config.yaml: integrator.max_depth: is 4, 3 in the run; ")


def test_who_changed_it_is_named(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Not an override that may change what it does, beside a file in which something else was changed."""
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("max_depth: 3", "max_depth: 4"))
    line = told(capsys, run, "--set", "run.iterations=9")
    assert line.startswith("config.yaml: integrator.max_depth: is 4, 3 in the run; ")


def test_a_scene_that_changed_is_another_experiment(
    run: Path, interrupted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = interrupted.parents[1] / "scene.xml"
    text = scene.read_text()
    scene.write_text(text.replace("8, 8, 8", "9, 9, 9"))
    try:
        assert "scene.file: has changed since " in told(capsys, run)
    finally:
        scene.write_text(text)


def test_what_may_change_is_said_in_the_manifest(run: Path, tmp_path: Path) -> None:
    """Iterations, learning rates, and the folder, in which case the first one stays as it was."""
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    sets = ["run.iterations=7", "optimizer.learning_rate=0.1", f"run.output={tmp_path}/other"]
    assert optimize("--resume", str(run), "--quiet", *(word for each in sets for word in ("--set", each))) == 0
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    [resumed] = json.loads((tmp_path / "other/tiny/manifest.json").read_text())["resumed"]
    assert resumed["changed"] == {"run.iterations": [6, 7], "optimizer.learning_rate": [0.02, 0.1]}
    records = records_of(tmp_path / "other/tiny")
    assert [record["lr"] for record in records] == [0.02] * 4 + [0.1] * 3
    assert {path.name for path in run.iterdir()} == {path.name for path in (tmp_path / "other/tiny").iterdir()}


def test_a_run_that_is_done_says_so(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert optimize("--resume", str(run), "--quiet") == 0
    before = (run / "manifest.json").read_bytes()
    capsys.readouterr()
    assert optimize("--resume", str(run)) == 0
    assert "is finished, after 6 of 6 iterations; --set run.iterations=NUMBER goes on" in capsys.readouterr().out
    assert (run / "manifest.json").read_bytes() == before
    assert "run.iterations: is 5; the run has done 6 already" in told(capsys, run, "--set", "run.iterations=5")


def test_no_run_is_told(tmp_path: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, tmp_path / "nothing") == f"{tmp_path}/nothing: no such folder"
    (tmp_path / "empty").mkdir()
    assert "is no run's folder" in told(capsys, tmp_path / "empty")
    shutil.rmtree(run / "checkpoint")
    assert "has no checkpoint/state.npz" in told(capsys, run)


@pytest.mark.skipif(os.name != "posix", reason="links")
@pytest.mark.parametrize("name", ["checkpoint", "images", "parameters/best", "metrics.jsonl"])
def test_links_do_not_lead_out_of_the_folder(
    name: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of somebody else's making; what they lead to stays as it is, and the run can go on elsewhere."""
    victim = tmp_path / "victim"
    if (run / name).exists():
        (run / name).rename(victim)
    else:
        victim.mkdir()
    (run / name).symlink_to(victim)
    before = {path: path.read_bytes() for path in [victim, *victim.rglob("*")] if path.is_file()}
    assert told(capsys, run).startswith(f"{name}: is a link, by which the run would write elsewhere; put ")
    if name != "checkpoint":
        return
    assert optimize("--resume", str(run), "--quiet", "--set", f"run.output={tmp_path}/other") == 0
    assert {path: path.read_bytes() for path in [victim, *victim.rglob("*")] if path.is_file()} == before
    assert len(records_of(tmp_path / "other/tiny")) == 6


@pytest.mark.skipif(os.name != "posix", reason="no locks")
def test_a_run_at_work_is_left_alone(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FolderLock(run):
        assert "is in use by a run (process" in told(capsys, run)


def test_lines_that_were_lost_are_told(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (run / "metrics.jsonl").read_bytes().splitlines(keepends=True)
    (run / "metrics.jsonl").write_bytes(b"".join(lines[:2]))
    assert told(capsys, run).startswith("metrics.jsonl: holds 2 of the 4 iterations of the checkpoint; put it back")
    (run / "metrics.jsonl").write_bytes(b"".join([lines[0], lines[2], *lines[2:]]))
    assert told(capsys, run).startswith("metrics.jsonl: line 2: is not what a run writes")
    (run / "metrics.jsonl").write_bytes(b"".join(lines[:3]))  # the last one is in the state as well
    assert optimize("--resume", str(run), "--quiet") == 0
    assert [record["iteration"] for record in records_of(run)] == list(range(6))


def test_a_folder_that_cannot_be_written_to_is_told(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And the run can go on in another."""
    place = tmp_path / "disk"
    place.mkdir()
    mount(place, 4096)
    try:
        shutil.copytree(run, place, dirs_exist_ok=True)
        subprocess.run(["mount", "-o", "remount,ro", place], check=True)
        assert "cannot be written to (Read-only file system); to go on in another folder, add" in told(capsys, place)
        assert optimize("--resume", str(place), "--quiet", "--set", f"run.output={tmp_path}/other") == 0
        assert len(records_of(tmp_path / "other/tiny")) == 6
    finally:
        while os.path.ismount(place):
            subprocess.run(["umount", str(place)], check=True)


# Hundreds of states that are nearly right, in processes with limits: the run goes on, or one line says why not.

Array = np.ndarray[Any, Any]

#: What an array of a state may be in place of what it is.
ARRAYS: tuple[Callable[[Array], Array], ...] = (
    lambda array: array * np.nan,
    lambda array: array * np.inf,
    lambda array: array * 0,
    lambda array: array * -1e30,
    lambda array: array.ravel()[:-1],
    lambda array: array.ravel()[:0],
    lambda array: array[None],
    lambda array: np.asfortranarray(array.T),
    lambda array: np.zeros(2**22, np.float32),
    lambda array: array.astype(np.float64),
    lambda array: array.astype(np.float16),
    lambda array: array.astype(np.int32),
    lambda array: array.astype(bool),
    lambda array: array.astype(">f4"),
    lambda array: array.astype("S8"),
    lambda array: np.array([{}], dtype=object),
)
#: What a value of its JSON may be.
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 5, 2**31, 10**30, -0.5, 1e308, 1e999, "", "x", "../../etc/passwd", "\x1b[31m"),
    *([], {}, [None], [1e308] * 3, [[1]], {"x": 1}, "a" * 10_000, [0] * 10_000, json.loads("[" * 500 + "]" * 500)),
)


def forge(rng: random.Random, path: Path) -> None:
    """Write a state anew, its checksums right, with another array or value, one left out, or one under another name."""
    with np.load(path) as state:
        arrays = {name: state[name] for name in state.files}
    values = json.loads(arrays.pop("state").tobytes())
    for _ in range(rng.choice((1, 1, 2, 3))):
        if rng.random() < 0.5 and arrays:
            name = rng.choice(sorted(arrays))
            kind = rng.random()
            if kind < 0.6:
                with np.errstate(all="ignore"):
                    arrays[name] = rng.choice(ARRAYS)(arrays[name])
            elif kind < 0.8:
                del arrays[name]
            else:
                arrays[rng.choice(("parameter/x", "../x", f"best/{tiny.KEY}", f"squares/{tiny.KEY}"))] = arrays[name]
        else:
            owner, key = rng.choice(list(_places(values)))
            if rng.random() < 0.8:
                owner[key] = rng.choice(VALUES)
            else:
                del owner[key]
    arrays["state"] = np.frombuffer(json.dumps(values).encode(), np.uint8)
    np.savez(path, **arrays)


def _places(values: Any) -> Any:
    """Every place of a JSON value: what holds it, and its key or index there."""
    for key, value in list(values.items() if isinstance(values, dict) else enumerate(values)):
        yield values, key
        if isinstance(value, (dict, list)):
            yield from _places(value)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.usefixtures("llvm")
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and limits memory")
@pytest.mark.parametrize(("first", "count"), [(0, 6), pytest.param(1000, 200, marks=pytest.mark.long)])
def test_mutated_states(interrupted: Path, tmp_path: Path, first: int, count: int) -> None:
    """Of one in four the newest state alone, so that the run goes on with the one before; of the others both are."""
    hostile, seen, faults = Hostile(tmp_path), Counter[object](), []
    run = tmp_path / "runs/tiny"
    run.parent.mkdir()
    try:
        for seed in range(first, first + count):
            rng = random.Random(seed)
            shutil.rmtree(run, ignore_errors=True)
            shutil.copytree(interrupted, run)
            for name in (STATE,) if seed % 4 == 0 else (STATE, PREVIOUS):
                if rng.random() < 0.5:
                    forge(rng, run / name)
                else:
                    (run / name).write_bytes(mutate_bytes(rng, (run / name).read_bytes(), head=2000))
            before = contents(tmp_path)
            answer = hostile.ask("resume runs/tiny")
            found = judge(seed, answer, seen)
            after = contents(tmp_path)
            if answer["code"] == 2:
                found += [] if after == before else [f"seed {seed}: refused, and changed the folder"]
            elif answer["code"] == 0:
                lines = [record["iteration"] for record in records_of(run)]
                found += [] if lines == list(range(6)) else [f"seed {seed}: {lines}"]
                found += [] if int(state_of(run)["iteration"]) == 6 else [f"seed {seed}: its state is not the last"]
                found += [] if left_over(run) == [] else [f"seed {seed}: left {left_over(run)}"]
                manifest = read_manifest(run)
                found += (
                    [] if manifest is not None and manifest["status"] == "finished" else [f"seed {seed}: {manifest}"]
                )
            outside = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
            found += [f"seed {seed}: wrote {name}" for name in outside if not Path(name).is_relative_to(run)]
            faults += found
    finally:
        hostile.end()
    print(dict(seen))
    assert faults == []
    assert seen[0] >= count / 6
    assert seen[2] >= count / 6
