"""What a whole run decides by measurement before its first iteration, as `optimize` does; times of steps are given."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optimization.deciding import begin, fix_times

from reslrb_cli.config.loader import dump, load
from reslrb_cli.measure.optimization_benchmark import evaluate
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import target_arrays

pytestmark = pytest.mark.usefixtures("llvm")
SIZE = ["scene.size=[32, 32]", "run.spp=64", "run.iterations=2", "run.measuring=1000"]


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return begin(tmp_path, monkeypatch)


def begun(experiment: Path, monkeypatch: pytest.MonkeyPatch, *settings: str) -> tuple[dict[str, Any], Problem]:
    """What the process says first, and the problem that it optimises."""
    targets = experiment / "targets.npz"
    with targets.open("wb") as file:
        np.savez(file, **target_arrays(assemble(load("tiny.yaml", SIZE)).views))  # type: ignore[arg-type]
    given: list[Problem] = []

    def spy(problem: Problem, **options: Any) -> Iterator[Any]:
        given.append(problem)
        return iter(())

    monkeypatch.setattr(evaluate, "optimize", spy)
    config = load("tiny.yaml", [*SIZE, *settings])
    first = {"config": dump(config), "source": str(config.source), "targets": str(targets), "masked": False}
    said, _ = evaluate.begin_run(first)
    return said, given[0]


@pytest.mark.parametrize(
    ("ms", "chose"),
    [(0.2, ["guiding on", "sequence low_discrepancy"]), (1000.0, ["guiding off", "sequence independent"])],
)
def test_what_is_left_to_measurement_is_decided(
    ms: float, chose: list[str], experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fix_times(monkeypatch, {"guiding": ms, "sequence": ms, "sequence alone": 1000.0})
    said, problem = begun(experiment, monkeypatch, "integrator.guiding=auto", "integrator.sequence=auto")
    assert said["chose"] == chose
    plan = problem.integrator.plan(problem.scene, problem.scene.sensors()[0])
    assert (problem.integrator.preparation.guiding is not None) == (plan.sequence is not None) == (ms < 1)


def test_nothing_is_measured_of_what_is_named(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said, problem = begun(experiment, monkeypatch, "integrator.guiding=on")
    assert said["chose"] == []
    assert problem.integrator.preparation.guiding is not None
