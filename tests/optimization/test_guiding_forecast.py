"""How much of a run is learning: by its length, and what a forecast makes of steps that learned."""

from __future__ import annotations

from pathlib import Path

import pytest
from optimization.deciding import begin

from reslrb_cli.config.loader import load
from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.sampling import FEW_ENTRIES, ROUNDS, ROUNDS_OF_FEW, lessons, sizes
from reslrb_cli.optimization.forecast import _with_learning


@pytest.mark.parametrize("iterations", [1, 3, 23])
@pytest.mark.parametrize(
    "how", [["run.adjoint=correlated"], ["run.spp=8"], ["run.spp=8", "run.first_batch=again"]], ids=str
)
def test_a_run_learns_as_often_as_is_said_of_it(
    how: list[str], iterations: int, llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path, monkeypatch)
    settings = [*how, f"run.iterations={iterations}", "integrator.guiding=on", "integrator.estimator=stack"]
    problem, learned = assemble(load("tiny.yaml", ["run.adjoint=batched", *settings])), []
    right = Guiding.due

    def due(self: Guiding, number: int) -> bool:
        learned.append(right(self, number))
        return learned[-1]

    monkeypatch.setattr(Guiding, "due", due)
    for iteration in range(iterations):
        loop.gradient(problem, iteration, loop.Split())
    assert sum(learned) == pytest.approx(iterations * lessons(problem))
    size = sizes(problem, 1.0)
    few = sum(problem.selection.array(key).size for key in problem.selection.keys) < FEW_ENTRIES
    assert size.rounds == (ROUNDS_OF_FEW if few else ROUNDS)
    assert size.lessons * size.step / size.call == pytest.approx(lessons(problem))


@pytest.mark.parametrize("lesson", [0.0, 0.5, 3.0])
def test_what_learning_takes_counts_as_often_as_a_run_has_it(lesson: float) -> None:
    """Learning is among the steps that are timed twice in ten times, and in two of three."""
    for learned in ([0, 0, 1, 0, 0, 0, 0, 0, 1, 0], [2, 0, 1]):
        times = [1.0 + lesson * count for count in learned]
        for mean in (0.0, 0.08, 2.0):
            assert _with_learning(times, learned, mean) == pytest.approx(1 + lesson * mean)


def test_where_all_of_them_learn_or_none_the_mean_is_all_that_is_known() -> None:
    assert _with_learning([1.0, 3.0], [1, 2], 0.5) == 2
    assert _with_learning([1.0, 3.0], [0, 0], 0.5) == 2
