"""Losses that stand still: runs that end early."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli.tiny import KEY, manifest, read_metrics
from optimization.toy import CONFIG, make_problem
from runs.going_on import begin_alone, differences, optimize, run_and_kill

from reslrb_cli.config.loader import dump, load, loads
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.loop import Watch
from reslrb_cli.optimization.state import State
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.metrics import Record

# Decisions on made-up losses.


def config(tmp_path: Path, *sets: str) -> Config:
    path = tmp_path / "config.yaml"
    path.write_text(CONFIG)
    return load(path, ["run.iterations=400", *sets])


def follow(given: Config, losses: np.ndarray, held_out: dict[int, float] | None = None) -> list[State]:
    """Return the states after each iteration, until the run stops."""
    watch, state, states = Watch(given), State(0, 0.0, 0.0, 0, {}), []
    for number, loss in enumerate(losses):
        seen = None if held_out is None else held_out.get(number)
        record = Record(number, float(loss), 0, 0, 0, 0, 4, 1, 0, 0, None, held_out=seen)
        state = watch.after(State(number + 1, 0.0, 0.0, 0, {}), record)
        states.append(state)
        if state.stopped:
            break
    return states


STOP = "run.stop={patience: 20, relative: 0.01}"


def test_a_loss_that_falls_by_more_than_its_noise_does_not_stop(tmp_path: Path) -> None:
    rng, given = np.random.default_rng(1), config(tmp_path, STOP)
    fall = 0.98 ** np.arange(400)
    assert len(follow(given, fall)) == 400
    assert all(len(follow(given, fall[:200] + 0.002 * rng.normal(size=200))) == 200 for _ in range(20))


def test_a_loss_that_halves_every_100_iterations_is_not_stopped(tmp_path: Path) -> None:
    """Under noise of 30 %, no two windows of 20 distinguish this loss from a constant one. A constant loss is
    stopped.
    """
    rng, given = np.random.default_rng(2), config(tmp_path, STOP)
    noise = 1 + 0.3 * rng.normal(size=(20, 400))
    assert all(len(follow(given, 0.5 ** (np.arange(400) / 100) * each)) == 400 for each in noise)
    stopped = [len(follow(config(tmp_path, "run.stop={relative: 0.05}"), each)) for each in noise]
    assert max(stopped) < 400, "one that stands is"


def test_a_small_fall_does_not_count_even_without_noise(tmp_path: Path) -> None:
    losses = 1 - 1e-4 * np.arange(400)
    [*_, last] = follow(config(tmp_path, STOP), losses)
    assert last.iteration == 60
    assert last.stopped.startswith("the loss has stopped falling: over the last 60 iterations it fell by 0.2 +- ")
    assert len(follow(config(tmp_path, "run.stop={relative: 0}"), losses)) == 400


def test_non_finite_losses_are_left_out(tmp_path: Path) -> None:
    losses = 0.98 ** np.arange(400)
    losses[::7] = np.nan
    assert len(follow(config(tmp_path, STOP), losses)) == 400
    assert len(follow(config(tmp_path, STOP), np.full(400, np.nan))) == 400


def test_held_out_views_decide_if_there_are_any(tmp_path: Path) -> None:
    given = config(tmp_path, STOP, "run.held_out=[0]")
    falling = 0.98 ** np.arange(400)
    standing = {number: 1.0 + 0.001 * (number // 10 % 2) for number in range(0, 400, 10)}
    assert len(follow(given, falling, standing)) == 60
    assert len(follow(given, np.ones(400), {number: falling[number] for number in standing})) == 400


@pytest.mark.parametrize(
    ("setting", "key", "words"),
    [
        ("run.stop={patience: 4}", "run.stop.patience", "at least 5"),
        ("run.stop={relative: 1}", "run.stop.relative", "below 1"),
    ],
)
def test_invalid_settings(tmp_path: Path, setting: str, key: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        config(tmp_path, setting)
    assert error.value.key == key
    assert words in error.value.message


def test_incompatible_settings(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"run\.stop\.patience: must be at least 20, not 10"):
        config(tmp_path, "run.stop={patience: 10}", "run.held_out=[0]")


def test_unused_options_are_not_written(tmp_path: Path) -> None:
    asked = config(tmp_path, STOP, "optimizer={schedule: cosine}")
    assert loads(dump(asked), tmp_path / "config.yaml") == asked


# Whole runs.

SETS = ["--set", "run.checkpoint_every={iterations: 3}", "--set", "run.certainty=false", "--set", "run.measuring=0"]


@pytest.fixture
def experiment(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    begin_alone(tmp_path, monkeypatch)
    return tmp_path


@pytest.mark.parametrize("at", [18, 19, 20])
def test_a_run_stops_after_a_kill_as_well(experiment: Path, monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """The kill comes before the last iteration, or after it, when its state is already saved."""
    stop = ["--set", "run.stop={patience: 5, relative: 0.9}", "--set", "run.iterations=40"]
    every = ["--set", f"run.checkpoint_every={{iterations: {5 if at == 20 else 3}}}"]
    whole, left = run_and_kill(monkeypatch, at, *SETS, *every, *stop)
    assert len(read_metrics(whole)) == 20
    assert (manifest(whole)["status"], manifest(whole)["results"]["iterations"]) == ("finished", 20)
    assert manifest(whole)["results"]["stopped"].startswith("the loss has stopped falling: ")
    assert optimize("--resume", str(left), "--quiet") == 0
    assert differences(whole, left) == []


@pytest.mark.long
def test_a_stopped_run_continues_on_request(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stop = ["--set", "run.stop={patience: 5, relative: 0.9}", "--set", "run.iterations=24"]
    assert optimize("tiny.yaml", "--quiet", *SETS, *stop) == 0
    assert optimize("--resume", "runs/tiny", "--quiet") == 0
    assert "is finished, after 20 of 24 iterations; --set run.stop=null continues it" in capsys.readouterr().out
    assert optimize("--resume", "runs/tiny", "--quiet", "--set", "run.stop=null") == 0
    assert optimize("tiny.yaml", "--quiet", *SETS, "--set", "run.iterations=24", "--set", "run.name=whole") == 0
    assert len(read_metrics("runs/tiny")) == 24
    with (
        np.load("runs/tiny/parameters/parameters.npz") as one,
        np.load("runs/whole/parameters/parameters.npz") as other,
    ):
        assert one[KEY].tobytes() == other[KEY].tobytes()


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
