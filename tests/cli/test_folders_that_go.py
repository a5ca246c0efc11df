"""Run folders that are removed, emptied, moved or replaced while a run is at work."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli.failing import RUN, failing_last, lines
from cli.tiny import KEY, faults

from reslrb_cli.records.manifest import read_content


def test_a_folder_that_is_removed_ends_the_run(optimize, during):
    during(lambda record: shutil.rmtree(RUN) if record.iteration == 1 else None)
    code, out, err = optimize("--set", "run.iterations=50")
    assert (code, out) == (6, "")
    [line] = lines(err)
    assert "runs/tiny: has gone while the run went on; " in line
    assert line.endswith("runs/tiny was removed or moved away")
    assert os.listdir("runs") == []


def test_what_is_in_a_folder_is_removed_and_what_can_be_kept_is(optimize, during):
    """As by `rm -rf` that has not come to the folder itself: what is then written is what the last line names."""

    def remove(record):
        if record.iteration == 1:
            for path in RUN.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    during(remove)
    code, out, err = optimize("--set", "run.iterations=50")
    assert (code, faults(RUN, code, err), out) == (6, [], "")
    [line] = lines(err)
    assert "runs/tiny/metrics.jsonl: has been removed while the run went on; " in line
    assert "; kept: the state after 3 of 3 iterations, in " in line
    assert line.endswith("runs/tiny/checkpoint")
    content = read_content(RUN)
    assert (content["status"], content["error"], content["results"]["iterations"]) == ("failed", line, 3)
    assert content["missing"] == {"final images": "the run failed"}
    with np.load(RUN / "checkpoint" / "state.npz") as state:
        assert int(state["iteration"]) == 3
        kept = state[f"parameter/{KEY}"]
    with np.load(RUN / "parameters" / "parameters.npz") as values:
        assert np.array_equal(values[KEY], kept)


@pytest.mark.parametrize(("fails", "kept"), [(set(), "values after 3"), ({"write_parameters"}, None)])
def test_the_last_line_says_what_is_there_without_a_state(optimize, during, monkeypatch, fails, kept):
    """The state cannot be written, and the one that there was has been removed."""

    def remove(record):
        if record.iteration == 1:
            shutil.rmtree(RUN / "checkpoint")
            shutil.rmtree(RUN / "parameters")
            (RUN / "metrics.jsonl").unlink()

    during(remove)
    failing_last(monkeypatch, "save_checkpoint")
    for name in fails:
        failing_last(monkeypatch, name, calls=2)
    code, _, err = optimize()
    assert (code, faults(RUN, code, err)) == (6, [])
    line = read_content(RUN)["error"]
    assert lines(err)[-1] == line
    if kept is None:
        assert line.endswith("; nothing of the run was kept")
    else:
        assert f"; kept: the {kept} iterations, in " in line
        assert line.endswith("runs/tiny/parameters; no state to go on from")
    assert (RUN / "parameters" / "parameters.npz").exists() == (kept is not None)
    assert not (RUN / "checkpoint" / "state.npz").exists()


def test_another_run_that_has_taken_the_name_is_left_alone(optimize, during):
    seen = []

    def take(record):
        if record.iteration == 1:
            RUN.rename("runs/moved")
            RUN.mkdir()
            (RUN / "theirs").write_text("another run")
        elif record.iteration == 2:
            seen.append(record)

    during(take)
    code, out, err = optimize("--set", "run.checkpoint_every={iterations: 1}")
    assert (code, out, os.listdir(RUN)) == (6, "", ["theirs"])
    assert seen == []  # at once, not when all is done
    [line] = lines(err)
    assert "runs/tiny: has gone while the run went on; " in line
    assert line.endswith("runs/tiny was removed or moved away; what is there now is another's, and was left as it is")


def test_a_folder_that_was_moved_keeps_what_it_has(optimize, during):
    during(lambda record: RUN.rename("runs/moved") if record.iteration == 1 else None)
    code, _, err = optimize()
    assert code == 6
    assert lines(err)[-1].endswith("runs/tiny was removed or moved away")
    moved = Path("runs/moved")
    assert len((moved / "metrics.jsonl").read_text().splitlines()) == 2
    assert read_content(moved)["status"] == "running"
    assert json.loads((moved / "manifest.json").read_text())
