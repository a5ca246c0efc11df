"""`reslrb inspect --nonfinite` on run folders that are damaged, cut off, empty, or of another run."""

from __future__ import annotations

import io
import json
import logging
import os
import shutil
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from cli.test_nonfinite import CONFIG, KEY, PLAIN, SCENE
from cli.test_nonfinite import reslrb_nonfinite as reslrb

from reslrb_cli.cli import main
from reslrb_cli.records.decisions import Decision

ARCHIVE, MANIFEST, TARGET = "checkpoint/nonfinite.npz", "manifest.json", "images/target.exr"


@pytest.fixture(scope="module")
def finished(llvm, tmp_path_factory):
    """The folder of a run that met values that are not finite."""
    import mitsuba as mi

    folder = tmp_path_factory.mktemp("run")
    wall = np.full((8, 8, 3), 0.5, np.float32)
    wall[4, 1, 1] = np.nan
    mi.Bitmap(wall).write(str(folder / "wall.exr"))
    mi.Bitmap(np.full((8, 8, 3), 0.2, np.float32)).write(str(folder / "target.exr"))
    (folder / "scene.xml").write_text(SCENE.replace("REFLECTANCE", PLAIN))
    (folder / "config.yaml").write_text(CONFIG)
    before = os.getcwd()
    os.chdir(folder)
    try:
        with pytest.raises(SystemExit) as end:
            main.main(["optimize", "config.yaml", "--quiet", "--set", "run.on_nonfinite=stop"])
    finally:
        os.chdir(before)
        logging.getLogger("reslrb_cli").handlers.clear()
    assert end.value.code == 5
    return folder / "runs/config"


@pytest.fixture
def run(finished, tmp_path):
    """A copy of it."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def told(capsys, run):
    """The line that ends the command, without the folder."""
    code, out, err = reslrb(capsys, "inspect", run / "config.yaml", "--nonfinite")
    assert (code, out) == (2, ""), err
    assert "Traceback" not in err
    return err.splitlines()[-1].replace(f"{run}/", "")


def test_a_whole_folder_is_replayed(run, capsys):
    code, out, _ = reslrb(capsys, "inspect", run / "config.yaml", "--nonfinite")
    assert code == 0
    assert out.startswith("iteration 0, sensor 0")


def test_paths_are_of_the_run_s_sequence(run):
    from reslrb_cli.cli.nonfinite import load_replay
    from reslrb_cli.config.loader import load
    from reslrb_cli.measure.nonfinite_trace import _parts

    config = (run / "config.yaml").read_text()
    for sequence in ("independent", "low_discrepancy"):
        (run / "config.yaml").write_text(config.replace("sequence: independent", f"sequence: {sequence}"))
        problem = load_replay(load(run / "config.yaml")).problem
        own = problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).sequence
        assert (own is not None) == (sequence == "low_discrepancy")
        assert {samples.plan.sequence for samples, *_ in _parts(problem, problem.views[0], 1)} == {own}


def test_paths_are_of_the_sequence_that_was_decided(run, capsys):
    from reslrb_cli.cli.nonfinite import load_replay
    from reslrb_cli.config.loader import load
    from reslrb_cli.measure.nonfinite_trace import _parts

    config = (run / "config.yaml").read_text()
    assert "sequence: independent" in config
    (run / "config.yaml").write_text(config.replace("sequence: independent", "sequence: auto"))
    manifest = json.loads((run / "manifest.json").read_text())
    for paid in (True, False):
        value = "low_discrepancy" if paid else "independent"
        found = Decision(setting="sequence", value=value, why="").to_json()
        (run / "manifest.json").write_text(json.dumps(manifest | {"decisions": [found]}))
        problem = load_replay(load(run / "config.yaml")).problem
        own = problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).sequence
        assert (own is not None) == paid
        assert {samples.plan.sequence for samples, *_ in _parts(problem, problem.views[0], 1)} == {own}


def test_a_guided_run_without_its_tables_is_refused(run, capsys):
    config = (run / "config.yaml").read_text()
    assert "guiding: 'off'" in config
    refused = f"{ARCHIVE}: calls: is missing: what the paths of a guided step were drawn from"
    (run / "config.yaml").write_text(config.replace("guiding: 'off'", "guiding: 'on'"))
    assert told(capsys, run) == refused
    # And one of which a decision said so; what was left off by it is replayed.
    (run / "config.yaml").write_text(config.replace("guiding: 'off'", "guiding: auto"))
    assert reslrb(capsys, "inspect", run / "config.yaml", "--nonfinite")[0] == 0
    manifest = json.loads((run / "manifest.json").read_text())
    for found, line in (
        ([Decision(setting="guiding", value="on", why="").to_json()], refused),
        ([], ""),
        ([{"guided": "on"}], "manifest.json: decisions: is not what a run decided, as it writes it"),
    ):
        (run / "manifest.json").write_text(json.dumps(manifest | {"decisions": found}))
        if line:
            assert told(capsys, run) == line
        else:
            assert reslrb(capsys, "inspect", run / "config.yaml", "--nonfinite")[0] == 0


LEARNED = {"guiding/0/sums": np.ones((2, 16), np.float32), "guiding/0/draws": np.ones(16, np.float32),
           "guiding/0/onward": np.ones((4, 16), np.float32), "guiding/0/frame": np.ones(8),
           "guiding/0/film": np.ones((2, 16), np.float32)}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"calls": np.zeros((1, 3), np.int64)}, "calls: is not the gradients of sensors"),
        ({"calls": np.array([[0, -1]])}, "calls: is not the gradients of sensors"),
        ({"calls": np.array([[0, 1]])}, "guiding: is not what was learned of this scene"),
        ({"calls": np.array([[7, 1]]), **{f"guiding/7/{n.rpartition('/')[2]}": a for n, a in LEARNED.items()}},
         "guiding: is not what was learned of this scene"),
        ({"calls": np.array([[0, 1]]), **LEARNED}, "guiding/0/sums: is not what was learned of this scene"),
    ],
)  # fmt: skip
def test_tables_of_another_run_are_told(changes, what, run, capsys):
    config = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(config.replace("guiding: 'off'", "guiding: 'on'"))
    (run / ARCHIVE).write_bytes(archive(**changes))
    assert told(capsys, run).startswith(f"{ARCHIVE}: {what}")


def arrays(**changes):
    """What the archive of the run holds, with changes; None leaves out."""
    all_ = {"iteration": np.array(0), f"parameter/{KEY}": np.full(3, 0.5, np.float32)} | changes
    return {name: value for name, value in all_.items() if value is not None}


def archive(save=np.savez, **changes):
    file = io.BytesIO()
    save(file, **arrays(**changes))
    return file.getvalue()


def huge():
    """An archive whose array says that it has a billion billion entries."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as members:
        head = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000000000,), }\n"
        members.writestr(f"parameter/{KEY}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head)
        members.writestr("iteration.npy", b"x")
    return file.getvalue()


class Evil:
    """Makes a file when it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("evil"),)


DAMAGED = {
    "empty": b"",
    "no archive": b"no archive",
    "an array": b"\x93NUMPY\x01\x00v\x00",
    "of zeros": bytes(5000),
    "pickled": archive(iteration=np.array([Evil()], dtype=object)),
    "compressed": archive(np.savez_compressed),
    "huge": huge(),
    "iteration of text": archive(iteration=np.array("x")),
    "parameter of text": archive(**{f"parameter/{KEY}": np.array("x")}),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_archive_is_told(case, run, capsys):
    (run / ARCHIVE).write_bytes(DAMAGED[case])
    assert told(capsys, run).startswith(f"{ARCHIVE}: is damaged, cut off, or not written by a run (")
    assert not Path("evil").exists()


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_an_archive_that_is_cut_off_is_told(share, run, capsys):
    data = (run / ARCHIVE).read_bytes()
    (run / ARCHIVE).write_bytes(data[: int(share * len(data))])
    assert told(capsys, run).startswith(f"{ARCHIVE}: is damaged")


def test_bytes_that_changed_are_told(run, capsys):
    data = bytearray((run / ARCHIVE).read_bytes())
    place = data.index(np.float32(0.5).tobytes())
    data[place : place + 4] = np.float32(0.75).tobytes()
    (run / ARCHIVE).write_bytes(data)
    assert "another checksum than was written" in told(capsys, run)


FOREIGN = {
    "another shape": ({f"parameter/{KEY}": np.zeros((3, 1), np.float32)}, "is float32 of shape (3, 1), not numbers of"),
    "another type": ({f"parameter/{KEY}": np.zeros(3, np.int64)}, "is int64 of shape (3,), not numbers of shape (3,)"),
    "not finite": ({f"parameter/{KEY}": np.full(3, np.nan, np.float32)}, "holds a value that is not finite"),
    "another key": ({f"parameter/{KEY}": None, "parameter/a": np.zeros(3, np.float32)}, "it has `a`"),
    "no key": ({f"parameter/{KEY}": None}, f"it lacks `{KEY}`"),
    "no iteration": ({"iteration": None}, "lacks `iteration`"),
    "several iterations": ({"iteration": np.arange(3)}, "has `iteration` of shape 3; it must be one number"),
    "half an iteration": ({"iteration": np.array(0.5)}, "`iteration` is no array of numbers"),
    "a later iteration": ({"iteration": np.array(7)}, "iteration: is 7; the run has 3 iterations"),
    "a negative iteration": ({"iteration": np.array(-1)}, "iteration: is -1; the run has"),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_an_archive_of_another_run_is_told(case, run, capsys):
    changes, what = FOREIGN[case]
    (run / ARCHIVE).write_bytes(archive(**changes))
    line = told(capsys, run)
    assert line.startswith(f"{ARCHIVE}: ")
    assert what in line


def test_a_pipe_in_place_of_the_archive(run, capsys):
    (run / ARCHIVE).unlink()
    os.mkfifo(run / ARCHIVE)
    assert told(capsys, run) == f"{ARCHIVE}: is a pipe, not a regular file"


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "[" * 100_000, '{"program": "other"}', "\0", "NaN"])
def test_a_damaged_manifest_is_none(text, run, capsys):
    (run / MANIFEST).write_text(text)
    assert told(capsys, run).startswith("config.yaml: --nonfinite: is not in a run folder")


MANIFESTS = {
    "memory is a list": ({"memory": [1]}, "memory: is damaged: input should be an object"),
    "no samples": ({"memory": {"samples_per_pass": 0}}, "memory.samples_per_pass: is not a number of samples"),
    "samples are text": ({"memory": {"samples_per_pass": "4"}}, "memory.samples_per_pass: is not a number of samples"),
}


@pytest.mark.parametrize("case", MANIFESTS)
def test_a_manifest_of_another_kind_is_told(case, run, capsys):
    changes, what = MANIFESTS[case]
    content = json.loads((run / MANIFEST).read_text())
    (run / MANIFEST).write_text(json.dumps(content | changes))
    assert told(capsys, run).startswith(f"{MANIFEST}: {what}")


def test_targets_that_are_none_are_told(run, capsys):
    import mitsuba as mi

    data = (run / TARGET).read_bytes()
    (run / TARGET).write_bytes(data[: len(data) // 2])
    assert told(capsys, run).startswith(f"{TARGET}: is damaged or cut off")
    mi.Bitmap(np.zeros((8, 8, 1), np.float32)).write(str(run / TARGET))
    assert told(capsys, run) == f"{TARGET}: must have the film's channels; its own: 1, the film's: 3"
    mi.Bitmap(np.zeros((4, 8, 3), np.float32)).write(str(run / TARGET))
    assert told(capsys, run) == f"{TARGET}: is 8x4 pixels; it must be 8x8"
    (run / TARGET).unlink()
    assert told(capsys, run) == f"{TARGET}: no such file"
