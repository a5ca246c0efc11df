"""How a run ends, in process: each part alone, the manifest first, nothing lost, and the truth in the folder."""

from __future__ import annotations

import os
import signal
from unittest import mock

import numpy as np
import pytest
from cli.calling import read_metrics
from cli.failing import RUN, failing_last, full, lines
from cli.tiny import COMPLETE, KEY, faults, files

from reslrb_cli.cli import main
from reslrb_cli.cli.terminal import SIGNALS
from reslrb_cli.records import metrics
from reslrb_cli.records.manifest import read_content
from reslrb_cli.runs import recorder as recording


@pytest.mark.parametrize("optimize", ["real page"], indirect=True)
def test_a_run_that_ends_well_is_complete(optimize):
    code, out, err = optimize()
    assert faults(RUN, code, err) == []
    assert COMPLETE <= files(RUN)
    content = read_content(RUN)
    assert (content["status"], content["missing"], content["error"]) == ("finished", {}, None)
    assert content["process"]["pid"] == os.getpid()
    assert "report.html" in out


# --- signals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_a_run_after_the_iteration(optimize, during, number):
    during(lambda record: os.kill(os.getpid(), number) if record.iteration == 1 else None)
    code, out, err = optimize()
    assert (code, faults(RUN, code, err)) == (130, [])
    assert COMPLETE <= files(RUN)
    assert read_content(RUN)["results"]["iterations"] == len(read_metrics(RUN)) == 2
    assert out.splitlines()[-1].startswith("interrupted after 2 iterations")


@pytest.mark.parametrize(("name", "call"), [("write_image", 0), ("write_parameters", 2), ("write_image", 2)])
def test_a_signal_while_files_are_written_leaves_none_of_them_out(optimize, monkeypatch, name, call):
    real, calls = getattr(recording, name), []

    def interrupted(*args):
        if len(calls) == call:
            os.kill(os.getpid(), signal.SIGTERM)
        calls.append(args)
        real(*args)

    monkeypatch.setattr(recording, name, interrupted)
    code, _, err = optimize()
    begun = call > 0  # all iterations are done by then, and nothing is left that could be cut short
    assert (code, faults(RUN, code, err)) == (0 if begun else 130, [])
    assert files(RUN) >= (COMPLETE if begun else COMPLETE - {"metrics.jsonl"})


def test_a_run_that_is_ended_at_once_is_interrupted(optimize, during, monkeypatch):
    runs, seen = [], []
    monkeypatch.setattr("reslrb_cli.records.manifest._WRITING", mock.MagicMock())
    run = recording.Recording.run
    monkeypatch.setattr(recording.Recording, "run", lambda self, *args: runs.append(self) or run(self, *args))

    def abandon(record):
        if record.iteration == 2:
            runs[0].abandon()  # as the thread does that ends the process
            seen.append(read_content(RUN))

    during(abandon)
    optimize()
    [content] = seen
    assert (content["status"], content["results"]["iterations"]) == ("interrupted", 3)
    assert content["ended"]


# --- checkpoints and locks --------------------------------------------------------------------------------------------


def test_there_is_a_checkpoint_before_the_first_iteration(optimize, monkeypatch):
    seen = []

    def look(problem, on_nonfinite, state):
        with np.load(RUN / "checkpoint" / "state.npz") as state:
            seen.append((int(state["iteration"]), state[f"parameter/{KEY}"].mean()))
        return iter(())

    monkeypatch.setattr(recording, "optimize", look)
    optimize()
    assert seen == [(0, 0.5)]


def test_a_run_in_progress_is_not_replaced(optimize, during):
    seen = []

    def force(record):
        if record.iteration == 1:
            seen.append(optimize("--force"))
            seen.append(read_content(RUN)["status"])

    during(force)
    code, _, err = optimize()
    assert (code, faults(RUN, code, err)) == (0, [])
    (refused, out, err), status = seen
    assert (refused, out, status) == (2, "", "running")
    [line] = lines(err)
    assert line.startswith("tiny.yaml: run.name: ")
    assert f"in use by a run (process {os.getpid()} on " in line
    assert len(read_metrics(RUN)) == 5
    assert optimize("--force", "--quiet")[0] == 0
    assert sorted(os.listdir("runs")) == ["tiny"]


# --- failures, part by part -------------------------------------------------------------------------------------------


#: By the part that fails: what writes it, how often that is called before the end, and what is not there.
PARTS = {
    "checkpoint": ("save_checkpoint", 1, set()),
    "parameters": ("write_parameters", 2, {f"parameters/{name}" for name in
                   ("parameters.npz", "parameters.json", f"{KEY}.exr", f"{KEY}.png")}),
    "final images": ("write_image", 2, {"images/final.exr", "images/final.png"}),
}  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
def test_a_part_that_fails_leaves_the_others_alone(optimize, monkeypatch, part):
    name, before, absent = PARTS[part]
    failing_last(monkeypatch, name, calls=before)
    code, out, err = optimize()
    assert (code, faults(RUN, code, err), out) == (6, [], "")
    assert COMPLETE - files(RUN) == absent
    content = read_content(RUN)
    assert list(content["missing"]) == [part]
    assert content["results"]["iterations"] == 5
    [line] = lines(err)
    assert line == content["error"]
    kept = 0 if part == "checkpoint" else 5
    assert line.startswith(
        "runs/tiny/x: No space left on device; kept: the " + ("state after 5" if kept else "initial")
    )
    with np.load(RUN / "checkpoint" / "state.npz") as state:
        assert int(state["iteration"]) == kept


def test_without_its_page_a_run_is_finished(optimize, monkeypatch):
    monkeypatch.setattr(recording, "write_report", full)
    code, out, err = optimize()
    assert (code, faults(RUN, code, err)) == (0, [])
    assert COMPLETE - files(RUN) == {"report.html"}
    assert read_content(RUN)["missing"] == {"page": "runs/tiny/x: No space left on device"}
    assert [line for line in lines(err) if "the page was not written: runs/tiny/x: No space left" in line]
    assert out.rstrip().endswith("look at runs/tiny")


def test_a_page_that_we_cannot_draw_is_no_reason_either(optimize, monkeypatch):
    def draw(folder, *now):
        raise KeyError("initial")

    monkeypatch.setattr(recording, "write_report", draw)
    code, _, err = optimize()
    assert (code, faults(RUN, code, err)) == (0, [])
    assert "the page was not written: KeyError: 'initial'" in err


def test_when_all_fails_the_manifest_says_so_in_one_line(optimize, monkeypatch):
    failing_last(monkeypatch, "save_checkpoint")
    failing_last(monkeypatch, "write_parameters", calls=2)
    monkeypatch.setattr(recording, "write_report", full)
    monkeypatch.setattr(metrics.MetricsWriter, "write", full)
    code, out, err = optimize()
    assert (code, faults(RUN, code, err), out) == (6, [], "")
    [line] = lines(err)
    content = read_content(RUN)
    assert (content["status"], content["error"]) == ("failed", line)
    assert set(content["missing"]) == {"checkpoint", "parameters", "final images", "page"}
    assert "kept: the initial state" in line


def test_a_failure_of_ours_is_noted_and_keeps_its_traceback(optimize, during, monkeypatch):
    during(lambda record: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main.main(["optimize", "tiny.yaml"])
    content = read_content(RUN)
    assert (content["status"], content["error"]) == ("failed", "ZeroDivisionError: division by zero")
    assert content["missing"] == {"final images": "the run failed"}
    assert (RUN / "checkpoint" / "state.npz").exists()


def test_memory_that_runs_out_at_the_end_keeps_what_was_found(optimize, monkeypatch):
    def fail():
        raise RuntimeError("jit_malloc(): out of memory! Could not allocate 5 bytes")

    failing_last(monkeypatch, "write_image", fail, calls=2)
    code, _, err = optimize()
    assert code == 4
    assert lines(err)[-1] == read_content(RUN)["error"]
    assert COMPLETE - files(RUN) == {"images/final.exr", "images/final.png"}
