"""Runs that end early, because their time is up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from cli.tiny import manifest
from optimization.toy import make_problem
from runs.going_on import begin_alone, optimize

from reslrb_cli.records.decisions import Decision

SETS = ["--set", "run.checkpoint_every={iterations: 3}", "--set", "run.certainty=false", "--set", "run.measuring=0"]


@pytest.fixture
def experiment(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    begin_alone(tmp_path, monkeypatch)
    return tmp_path


def test_a_run_at_its_time_limit_continues_with_more_time(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["--set", "run.iterations=1000000", "--set", "run.max_seconds=0.001"]
    assert optimize("tiny.yaml", "--quiet", *SETS, *more) == 0
    results = manifest("runs/tiny")["results"]
    assert (results["iterations"], manifest("runs/tiny")["status"]) == (1, "finished")
    assert results["stopped"].startswith("the time is up, after ")
    assert optimize("--resume", "runs/tiny", "--quiet", "--set", "run.iterations=2000000") == 0
    assert "after 1 of 2000000 iterations; --set run.max_seconds=NUMBER continues it" in capsys.readouterr().out
    limit = results["elapsed_s"] + 0.5
    assert optimize("--resume", "runs/tiny", "--quiet", "--set", f"run.max_seconds={limit}") == 0
    results = manifest("runs/tiny")["results"]
    assert results["iterations"] > 1
    assert results["elapsed_s"] < limit + 0.5


def test_measuring_before_the_first_iteration_counts_in_the_time(tmp_path: Path) -> None:
    problem = make_problem(tmp_path, sets=["run.max_seconds=10"])
    one, other = (Decision(setting=name, value="on", why="", seconds=2.0) for name in ("guiding", "paths"))
    assert problem.limit_s == 10
    assert replace(problem, decisions=[one, other]).limit_s == 6
    assert replace(problem, decisions=[one, replace(other, cached=True)]).limit_s == 8
