"""`reslrb convergence --runs` from the command line, on a poster of 8x8 pixels."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cli.test_convergence import call, read
from cli.tiny import ROOT, write_experiment
from compilation import search_path

from reslrb_cli.measure.optimization_benchmark.rank import POINTS

pytestmark = pytest.mark.usefixtures("llvm")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (("--runs", "2", "--objective", "fixed"), "--objective: does not go with --runs"),
        (("--runs", "2", "--rounds", "3"), "--rounds: does not go with --runs: runs have a time"),
        (("--runs", "2", "--resume", "c.jsonl"), "c.samples.npz: no such file"),
        (("--runs", "0"), "0 is not in the range"),
        (("--rates", "1,3"), "--rates: are those of whole optimisations; add --runs N"),
        (("--runs", "2", "--rates", "1,0"), "0 is no factor above 0"),
        (("--runs", "2", "--rates", "1,3,1.0"), "names a factor twice"),
        (("--runs", "2", "--rates", "fast"), "'fast' is not a valid float"),
        (("--runs", "2", "--integrators", "reslrb:stack,path"), "--integrators path: integrator.type: must be one of"),
        (("--integrators", "reslrb:auto"), "`auto` measures which to take"),
    ],
)
def test_bad_input_is_one_located_line(
    folder: Path, args: tuple[str, ...], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("tiny.yaml", *args) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert line in printed.err
    assert len(printed.err.splitlines()) == 1


@pytest.mark.long
def test_whole_runs_from_end_to_end(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Losses fall from what all begin with, the budget is kept, and all that is said is in the file."""
    names = ["ptracer", "reslrb:stack", "reslrb:auto"]
    args = ["--runs", "2", "--budget", "90", "--integrators", ",".join(names), "--json", "c.jsonl"]
    began = time.monotonic()
    assert call("tiny.yaml", *args, "--set", "run.iterations=100000", "--set", "target.render.spp=4096") == 0
    assert time.monotonic() - began < 90
    lines = read(folder / "c.jsonl")
    points = [line for line in lines if line["kind"] == "run_point"]
    methods = [line for line in lines if line["kind"] == "run_method"]
    assert [line["label"] for line in methods] == names
    assert {(line["label"], line["seed"]) for line in points} == {(name, seed) for name in names for seed in (0, 1)}
    for method in methods:
        own = [point for point in points if point["label"] == method["label"]]
        assert len(own) == 2 * POINTS
        assert (method["runs"], method["status"], method["message"]) == (2, "ok", "")
        for what in ("loss", "parameter_error"):
            ends = sorted(point[what] for point in own if point["elapsed_s"] == method["elapsed_s"])
            assert [method[what]["low"], method[what]["high"]] == pytest.approx(ends)
        assert method["loss"]["high"] < 0.5 * points[0]["loss"]
        assert method["parameter_error"]["high"] < points[0]["parameter_error"]
        assert 0 < method["first_s"]["low"] < method["elapsed_s"]
        assert method["iterations"]["low"] > 5
    assert {point["loss"] for point in points if point["iteration"] == 0} == {points[0]["loss"]}
    assert lines[-1]["kind"] == "summary"
    printed = capsys.readouterr().out
    assert lines[-1]["line"] in printed
    assert any(line.startswith("reslrb:auto: ") for line in printed.splitlines())  # what its pilot chose
    assert (folder / "c.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_a_budget_that_is_too_small_says_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("tiny.yaml", "--runs", "3", "--budget", "5", "--integrators", "reslrb:stack") == 1
    printed = capsys.readouterr()
    assert "the budget of 5 s" in printed.out
    assert "Traceback" not in printed.err


@pytest.mark.long
def test_an_interrupt_keeps_what_is_done(folder: Path) -> None:
    script = "import sys; sys.argv[0] = 'reslrb'; from reslrb_cli.cli import run; run()"
    args = ["convergence", "tiny.yaml", "--runs", "50", "--budget", "2000", "--integrators", "reslrb:stack", "--json",
            "c.jsonl"]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", script, *args], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.split()[:2] == ["reslrb:stack", "1"]:  # the second seed is done
            process.send_signal(signal.SIGINT)
            break
    rest = process.stdout.read()
    assert process.wait() == 130
    assert "the only one that was measured" in rest
    lines = [json.loads(line) for line in (folder / "c.jsonl").read_text().splitlines()]
    assert {point["seed"] for point in lines if point["kind"] == "run_point"} >= {0, 1}
    assert lines[-2]["runs"] == 2
