"""A resumed run ends with the same bits as a run without interruption. This also holds for a killed run."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cli import tiny
from compilation import search_path
from kit import count_iterations
from runs.going_on import (
    MOTION,
    begin_alone,
    differences,
    left_over,
    optimize,
    records_of,
    run_and_kill,
    state_of,
    work_alone,
)
from turns import a_few

from reslrb_cli.cli import main
from reslrb_cli.guiding.tables import Learned
from reslrb_cli.optimization import loop, optimizers
from reslrb_cli.records.checkpoint import STATE_FILE, read_state
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.runs.resume import OpenedRun

# A resumed run ends where the whole run would have ended, bit for bit, with one thread.

RUN = Path("runs/tiny")
#: Enough iterations for the best parameters to be known when the run is killed.
ITERATIONS = [
    word
    for setting in ("run.iterations=18", "run.checkpoint_every={iterations: 6}", "run.certainty=false")
    for word in ("--set", setting)
]
AUTO = "optimizer={type: auto}"
BATCHED = ["run.spp=8", "run.adjoint=batched"]

#: The texture alone.
SIMPLE = ["--set", f"parameters=[{{key: {tiny.KEY}, initial: 0.5, bounds: [0, 1]}}]"]
#: The start is so far away that losses fall from the first iteration to the last.
VIEWS = "views=[{sensor: 0}, {sensor: 1}, {sensor: 2}]"
FALLING = ["--set", f"parameters=[{{key: {tiny.KEY}, initial: 0.05, bounds: [0, 1]}}]"]

#: Settings by name: every optimiser, schedule and transform, measurements before the first iteration, and views.
CASES: dict[str, list[str]] = {
    "adam": [],
    "cosine": ["optimizer.schedule=cosine"],
    # The joint curvature of small parameters is measured in the iterations 11 and 17, around the newest state.
    "auto": [AUTO],
    "auto, exposure": [AUTO, "views=[{sensor: 0}, {sensor: 1, exposure: auto}]"],
    "sgd": ["optimizer.type=sgd", "optimizer.learning_rate=0.5"],
    "momentum": ["optimizer={type: sgd, momentum: 0.8, learning_rate: 0.1}"],
    "sigmoid, momentum": ["parameters[0].transform=sigmoid", "optimizer={type: sgd, momentum: 0.8}"],
    "log": ["parameters[1].transform=log", "parameters[1].bounds=[0.1, 20]"],
    "curvature, sigmoid": [tiny.DESCENT, "optimizer.schedule=cosine", "parameters[0].transform=sigmoid"],
    "views": [VIEWS, "run.views_per_iteration=1"],
    "held out": [VIEWS, "run.views_per_iteration=1", "run.held_out=[2]", tiny.DESCENT],
    "exposure": [
        "parameters=[{key: poster.reflectance.data, initial: 0.5, bounds: [0.3, 0.7]}]",
        "views=[{sensor: 0}, {sensor: 1, exposure: auto}]",
    ],
    "motion, curvature": [f"parameters[2]={MOTION}", tiny.DESCENT, VIEWS],
    "certainty": ["run.certainty=true", "run.iterations=24", "run.checkpoint_every={iterations: 5}"],
    "independent, l1": ["run.adjoint=independent", "loss.type=l1"],
    "reservoir": [*BATCHED, "integrator.estimator=reservoir"],
    "event": [*BATCHED, "integrator.estimator=event"],
    "gather": [*BATCHED, "integrator.estimator=gather"],
    "guided": [*BATCHED, "integrator.guiding=on", "integrator.estimator=stack"],
    "pixels": [*BATCHED, "run.spp=16", "integrator={estimator: stack, paths: both, pixels: measured}"],
    "shards": ["run.spp=8", "run.shards=4", "integrator.guiding=on", tiny.DESCENT],
    "shards of views": [*BATCHED, VIEWS, "run.shards=2"],
    "passes": [*BATCHED, "integrator.samples_per_pass=1"],
    "a list of losses": ["loss=[{type: l1}, {type: l2, weight: 0.5}]"],
    "prb": ["integrator={type: prb, max_depth: 3}", "parameters=[{key: poster.reflectance.data, initial: 0.5}]"],
}
FEW = ("auto, exposure", "pixels", "shards")
#: The number of iterations after which a run is killed, and the number in its newest state at that time. Certainty
#: makes its notes at four fifths of the iterations, which must come before this state.
KILLED: dict[str, tuple[int, int]] = {"certainty": (23, 20)}


@pytest.fixture
def experiment(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    begin_alone(tmp_path, monkeypatch)
    return tmp_path


@pytest.mark.parametrize("case", a_few(CASES, FEW))
def test_a_killed_run_resumes_to_the_same_end(case: str, experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run is killed three iterations after its newest state. These iterations are computed again."""
    sets = [word for setting in CASES[case] for word in ("--set", setting)]
    at, newest = KILLED.get(case, (15, 12))
    whole, left = run_and_kill(monkeypatch, at, *ITERATIONS, *sets)
    shutil.rmtree(experiment / "cache", ignore_errors=True)  # remove earlier decisions
    assert int(state_of(left)["iteration"]) == newest
    assert optimize("--resume", str(left), "--quiet") == 0
    assert differences(whole, left) == []
    assert left_over(left) == []
    assert [record["iteration"] for record in records_of(left)] == list(range(len(records_of(whole))))
    manifest = json.loads((left / "manifest.json").read_text())
    assert manifest["status"] == "finished"
    [resumed] = manifest["resumed"]
    assert (resumed["iteration"], resumed["changed"]) == (newest, {})


def test_a_run_with_wrong_tables_resumes(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The newest state is from a moment at which the count of gradients restarts at 0."""
    right = Learned.with_more

    def wrong(*given: Any) -> Learned:
        return replace(right(*given), worse=2.0)

    monkeypatch.setattr(Learned, "with_more", wrong)
    settings = [*CASES["guided"], "run.iterations=9", "run.checkpoint_every={iterations: 5}"]
    sets = [word for setting in settings for word in ("--set", setting)]
    whole, left = run_and_kill(monkeypatch, 7, *ITERATIONS, *sets)
    assert read_state(left / "checkpoint" / STATE_FILE)[1]["guiding"] == {"0": 0}
    assert optimize("--resume", str(left), "--quiet") == 0
    assert differences(whole, left) == []


@pytest.mark.long
def test_a_resumed_run_can_be_resumed_again(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A finished run is resumed twice with more iterations. Its result equals that of one run with all iterations."""
    assert optimize("tiny.yaml", "--quiet", *ITERATIONS, *SIMPLE, "--set", "run.name=whole") == 0
    assert optimize("tiny.yaml", "--quiet", *ITERATIONS, "--set", "run.iterations=7", *SIMPLE) == 0
    for iterations in (13, 18):
        assert optimize("--resume", str(RUN), "--quiet", "--set", f"run.iterations={iterations}") == 0
    assert differences(Path("runs/whole"), RUN) == []
    resumed = json.loads((RUN / "manifest.json").read_text())["resumed"]
    assert [(each["iteration"], each["changed"]) for each in resumed] == [
        (7, {"run.iterations": [7, 13]}), (13, {"run.iterations": [13, 18]})
    ]  # fmt: skip


def _without_moments(self, values, units, moments):
    for key, own in self._own.items():
        own[key] = values[key]


def _another_seed(run_seed, iteration, view, purpose):
    from reslrb_cli.seeds import seed

    return seed(run_seed, iteration + 1, view, purpose)


@pytest.mark.parametrize(
    "fault",
    a_few(["no moments", "another seed", "no last steps", "metrics not cut back"], ()),
)
def test_lost_state_is_detected(fault: str, experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each planted fault drops a part of the state, changes seeds, or keeps surplus metrics."""
    from reslrb_cli.runs import prepare, resume

    restore = prepare.RunProgress.restore

    def without_steps(self, stored):
        restore(self, stored)
        self.certainty.last = {}

    # A state in the last fifth of the run has all parts.
    sets = ["--set", "run.checkpoint_every={iterations: 15}"]
    begun = FALLING if fault != "no last steps" else []  # only small parameters have last steps
    whole, left = run_and_kill(monkeypatch, 17, *ITERATIONS, *sets, *begun)
    places = {
        "no moments": (optimizers.Optimizer, "restore", _without_moments),
        "another seed": (loop, "seed", _another_seed),
        "no last steps": (prepare.RunProgress, "restore", without_steps),
        "metrics not cut back": (resume, "cut_back", lambda folder, count: 0),
    }
    monkeypatch.setattr(*places[fault])
    assert optimize("--resume", str(left), "--quiet") == 0
    assert differences(whole, left) != []


def test_a_state_survives_a_round_trip(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a failure in the middle of an update, the folder keeps the state of the last complete iteration. The run
    resumes from this state.
    """
    step, calls = optimizers.Optimizer.step, []

    def failing(self, factor, skip=()):
        calls.append(factor)
        done = step(self, factor, skip)
        if len(calls) == 6:
            raise RuntimeError("in the midst")
        return done

    monkeypatch.setattr(optimizers.Optimizer, "step", failing)
    with pytest.raises(RuntimeError, match="in the midst"):
        main.main(["optimize", "tiny.yaml", "--quiet", *ITERATIONS, *SIMPLE])
    monkeypatch.setattr(optimizers.Optimizer, "step", step)
    assert int(state_of(RUN)["iteration"]) == len(records_of(RUN)) == 5
    assert optimize("tiny.yaml", "--quiet", *ITERATIONS, *SIMPLE, "--set", "run.name=whole") == 0
    assert optimize("--resume", str(RUN), "--quiet") == 0
    assert differences(Path("runs/whole"), RUN) == []


# Runs that are killed at random moments, or whose disks are too small, until they finish.

#: The program, with steps computed by one thread.
SCRIPT = f"""import sys; sys.path[:0] = [{str(tiny.ROOT)!r}, {str(tiny.ROOT / "tests")!r}]; sys.argv[0] = 'reslrb'
import pytest, reslrb_cli
from runs.going_on import work_alone
work_alone(pytest.MonkeyPatch())
from reslrb_cli.cli import run; run()"""
#: A state is saved after each iteration, so writing states takes a large part of the time.
SETS = ["--set", "run.checkpoint_every={iterations: 1}", "--set", "run.certainty=false", "--quiet"]


def start(folder: Path, *args: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "RESLRB_CACHE": str(folder / "cache"), "PYTHONPATH": search_path(tiny.ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, "optimize", *args],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, err = process.communicate(timeout=300)
    return process.returncode, err


def kill_at_random(process: subprocess.Popen[str], run: Path, chance: random.Random) -> None:
    """Kill the process at a random moment, mostly in the middle of its iterations."""
    if chance.random() < 0.2:
        time.sleep(chance.uniform(0, 4))
    else:
        before, limit = count_iterations(run), time.monotonic() + 60
        while count_iterations(run) <= before and process.poll() is None and time.monotonic() < limit:
            time.sleep(0.005)
        time.sleep(chance.uniform(0, 0.3))
    process.kill()
    process.communicate()


@pytest.mark.long
@pytest.mark.usefixtures("llvm")
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="sends SIGKILL")
def test_a_run_killed_fifty_times_reaches_the_same_end(tmp_path: Path) -> None:
    """Each killed life has its own process. The last life ends in this process."""

    def finish(*words: str) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(tmp_path)
            patch.setenv("RESLRB_CACHE", str(tmp_path / "cache"))
            work_alone(patch)
            assert optimize(*words) == 0

    tiny.write_experiment(tmp_path)
    whole = words = ["tiny.yaml", *SETS, "--set", "run.iterations=1200"]
    finish(*whole, "--set", "run.name=whole")
    run, chance = tmp_path / "runs/tiny", random.Random(11)
    for _ in range(50):
        kill_at_random(start(tmp_path, *words), run, chance)
        words = whole
        if run.exists():
            manifest = read_manifest(run)
            assert manifest is not None
            assert manifest["status"] in ("interrupted", "finished")
            assert left_over(run) == []  # a reader has repaired the folder
            if (run / "checkpoint/state.npz").exists():
                assert int(state_of(run)["iteration"]) <= count_iterations(run)
                words = ["--resume", str(run), "--quiet"]
            else:
                shutil.rmtree(run)
    finish(*words)
    assert differences(tmp_path / "runs/whole", run) == []
    assert [record["iteration"] for record in records_of(run)] == list(range(1200))
    assert read_manifest(run)["status"] == "finished"  # type: ignore[index]


@pytest.mark.parametrize(
    ("status", "done", "of", "stopped", "seconds", "changed", "is_done", "line"),
    [
        ("finished", 9, 9, "", None, (), True, "after 9 of 9 iterations; --set run.iterations=NUMBER continues it"),
        ("interrupted", 9, 9, "", None, (), False, None),
        ("finished", 9, 12, "", None, ("run.iterations",), False, None),
        ("finished", 5, 9, "no time", 3, (), True,
         "after 5 of 9 iterations; --set run.max_seconds=NUMBER continues it"),
        ("finished", 5, 9, "no time", 8, ("run.max_seconds",), False, None),
        ("finished", 9, 9, "no time", 8, ("run.max_seconds",), True,
         "after 9 of 9 iterations; --set run.iterations=NUMBER continues it"),
        ("finished", 5, 9, "converged", None, (), True, "after 5 of 9 iterations: converged"),
        ("interrupted", 5, 9, "converged", None, (), False, None),
    ],
)  # fmt: skip
def test_a_run_is_complete_unless_a_setting_continues_it(
    status: str, done: int, of: int, stopped: str, seconds: float | None, changed: tuple[str, ...], is_done: bool,
    line: str | None,
) -> None:  # fmt: skip
    stored: Any = SimpleNamespace(read=lambda kind: SimpleNamespace(stopped=stopped))
    settings = SimpleNamespace(iterations=of, max_seconds=seconds)
    config: Any = SimpleNamespace(run=settings, source=Path("runs/a/config.yaml"))
    nothing: Any = None
    manifest = {"status": status}
    run = OpenedRun(nothing, manifest, stored, nothing, config, dict.fromkeys(changed, (1, 2)), done)
    assert run.is_done is is_done
    assert run.has_stopped is bool(stopped and "run.max_seconds" not in changed)
    if line is not None:
        assert run.done_line("--set", "=") == f"runs/a: is finished, {line}"
