"""Steps on several processes: the numbers of one, whoever computes them and whatever becomes of them."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from cli import tiny
from runs.going_on import MOTION, optimize, write_experiment

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ReslrbError
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.state import guiding_of
from reslrb_cli.runs.prepare import Course, prepare

engine = pytest.importorskip("reslrb_cli.cluster.engine", reason="pip install reslrb[cluster]", exc_type=ImportError)

SETS = ["run.iterations=3", "run.spp=8", "run.measuring=0", "run.certainty=false"]
#: Experiments by name: two rounds and one, guided emission, views, exposures, what moves, passes, a loss in halves.
CASES = {
    "guided, scaled": ["run.shards=4", "integrator.guiding=on", "optimizer.scale=auto", "run.views_per_iteration=2"],
    "views": ["run.shards=3", "run.adjoint=batched", "integrator.guiding=on"],
    "exposure": ["run.shards=6", f"parameters=[{{key: {tiny.KEY}, initial: 0.5}}]", "views.1.exposure=auto"],
    "motion": ["run.shards=6", f"parameters[2]={MOTION}"],
    "passes": ["run.shards=2", "integrator.samples_per_pass=1", "run.spp=6"],
    "halves": ["run.shards=6", "loss.scale=fitted"],
}
VIEWS = "views=[{sensor: 0}, {sensor: 1, weight: 2}, {sensor: 2}]"


@pytest.fixture
def experiment(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RESLRB_CACHE", str(tmp_path / "cache"))
    return tmp_path


@contextmanager
def one_thread():
    """Sums of a kernel have one order then."""
    dr.sync_thread()
    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(before)


def make(folder: Path, *sets: str) -> Course:
    views = [VIEWS] if "passes" not in sets else []
    config = load(folder / "tiny.yaml", [*SETS, *views, *sets]).with_code()
    return prepare(config, "llvm_ad_rgb", lambda line: None, lambda line: None)[0]


def end(course: Course, after: Callable[[int], object] = lambda iteration: None) -> dict[str, np.ndarray]:
    """The values after the iterations, and what tables have learned."""
    with one_thread():
        for state, _ in iterate(course.stages, course.state):
            after(state.iteration)
        guiding = guiding_of(course.problem)
        return course.problem.values() | ({} if guiding is None else guiding.state()[1])


def test_workers_come_to_the_numbers_of_one_process(experiment: Path) -> None:
    check(experiment, "guided, scaled", 2)


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2, 3, 5])
@pytest.mark.parametrize("case", CASES)
def test_any_number_of_workers_comes_to_the_same(experiment: Path, case: str, workers: int) -> None:
    check(experiment, case, workers)


OWN = """import drjit as dr
from mitsuba.ad.integrators.prb_basic import BasicPRBIntegrator


def own(image, target):
    return dr.mean(dr.abs(image - target), axis=None)
"""

#: Both run on workers: of `batched` shards each takes dL/dI by itself.
OWN_SETS = ["run.shards=3", "run.adjoint=batched", "loss={type: custom, file: own.py:own}",
            "integrator={type: custom, file: own.py:BasicPRBIntegrator, max_depth: 3}"]  # fmt: skip


def test_workers_run_a_users_code_where_the_run_may(experiment: Path) -> None:
    (experiment / "own.py").write_text(OWN)
    compare(experiment, OWN_SETS, 2)
    course = make(experiment, *OWN_SETS)
    (experiment / "own.py").write_text(OWN + "# another\n")
    with engine.local_engine(course, 1, threads=1) as local:
        course.compute_with(local)
        with pytest.raises(ReslrbError, match="has changed since"):
            end(course)


def check(folder: Path, case: str, workers: int) -> None:
    compare(folder, CASES[case], workers)


def compare(folder: Path, sets: list[str], workers: int) -> None:
    """Bit by bit, with one thread each."""
    alone = end(make(folder, *sets))
    course = make(folder, *sets)
    with engine.local_engine(course, workers, threads=1) as local:
        course.compute_with(local)
        together = end(course)
    assert {name: array.tobytes() for name, array in alone.items()} == {
        name: array.tobytes() for name, array in together.items()
    }


@pytest.mark.long
@pytest.mark.parametrize("killing", ["2 of 2", "6 of 1", "6 of 3"])
def test_killed_workers_lose_nothing(experiment: Path, killing: str) -> None:
    """One of them is killed at a random moment of each iteration but the first."""
    kills, workers = (int(word) for word in killing.split(" of "))
    sets = ["run.shards=4", f"run.iterations={kills}", "views=[{sensor: 0}]"]
    alone = end(make(experiment, *sets))
    course, rng = make(experiment, *sets), random.Random(workers)
    with engine.local_engine(course, workers, threads=1) as local:
        course.compute_with(local)
        killed: list[int] = []

        def kill(pid: int, wait: float) -> None:
            time.sleep(wait)
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

        def strike(iteration: int) -> None:
            pids = sorted(local._client.run(os.getpid).values())
            threading.Thread(target=kill, args=(rng.choice(pids), rng.uniform(0, 0.05))).start()

        together = end(course, strike)
        time.sleep(0.2)
    assert len(killed) == kills
    assert {name: array.tobytes() for name, array in alone.items()} == {
        name: array.tobytes() for name, array in together.items()
    }


BAD = [
    (["--cluster", "2"], "--cluster: must be local:N"),
    (["--cluster", "local:0"], "--cluster: must be local:N"),
    (["--cluster", "tls://here:8786"], "--cluster: must be local:N"),
    (["--cluster", "local:2"], "run.shards: a step is one shard"),
    (["--cluster", "local:2", "--set", "run.shards=4", "--dry-run"], "leave --cluster out"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_what_cannot_be_shared_out_is_refused(experiment: Path, capsys, arguments, message) -> None:
    assert optimize("tiny.yaml", *arguments) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_without_dask_it_says_what_to_install(experiment: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert optimize("tiny.yaml", "--cluster", "local:2", "--set", "run.shards=4") == 2
    assert "pip install reslrb[cluster]" in capsys.readouterr().err
