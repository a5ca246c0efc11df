"""Whole runs with several learning rates: each method at its best, and the ratio of two of them with its interval."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measure.pretended_runs import CONFIG, LIST, Pretence, Stage, plan, play

from reslrb_cli.config.loader import loads
from reslrb_cli.measure.methods import at_rate
from reslrb_cli.measure.optimization_benchmark import rank
from reslrb_cli.measure.optimization_benchmark.evaluate import Advance, State
from reslrb_cli.measure.optimization_benchmark.rank import best_of, outcome, ratio
from reslrb_cli.optimization.loop import learning_rate_factor
from reslrb_cli.report.convergence_tables import best_line

RATES = (0.5, 1.0, 4.0)


def test_all_rates_are_multiplied_those_of_single_parameters_too() -> None:
    text = CONFIG.replace(
        "[{key: a}]",
        "[{key: a}, {key: b, learning_rate: 0.3}, {motion: {of: [l], free: [translation, rotation]}, "
        "learning_rate: {rotation: 4}}]",
    )
    config = loads(text + "optimizer: {learning_rate: 0.1}\n", Path("x.yaml"))
    found = at_rate(config, 0.5)
    assert found.optimizer.learning_rate == pytest.approx(0.05)
    assert found.parameters[0].learning_rate is None
    assert found.parameters[1].learning_rate == pytest.approx(0.15)
    assert [found.parameters[2].settings(word).learning_rate for word in ("translation", "rotation")] == [None, 2.0]
    assert at_rate(found, 2.0) == config


def test_each_method_counts_at_its_best_rate(tmp_path: Path) -> None:
    """A pretended iteration leaves `gain` of an error: rates alone do nothing there, so methods have them by name."""
    stage = Stage(ptracer=Pretence(0.9), reslrb_stack=Pretence(0.97))
    what = plan(LIST, rates=RATES, runs=5, budget_s=400.0)
    session, points, _ = play(tmp_path, stage, what)
    labels = [f"{name}, rates x {rate:g}" for name in LIST.split(",") for rate in RATES]
    assert list(what.names) == labels
    assert list(dict.fromkeys(point.method.label for point in points)) == labels
    assert [what.config_at(side).optimizer.learning_rate for side in what.sides] == pytest.approx(
        [0.01, 0.02, 0.08] * 2
    )
    found = outcome(session.members, session.limit_s, what.names)
    assert [record.method.label for record in found.methods] == labels
    assert found.error is not None
    assert (found.error.best, found.error.beats) == ("ptracer", ["reslrb:stack"])
    _, _, _, other = found.bests
    assert (other.label, other.of, other.to) == ("reslrb:stack", "parameter_error", "ptracer")
    iterations = [record.iterations.median for record in found.methods if record.iterations is not None]
    expected = 0.97 ** max(iterations[3:]) / 0.9 ** max(iterations[:3])
    assert other.ratio is not None
    assert other.ratio.value == pytest.approx(expected)
    assert other.ratio.low <= expected <= other.ratio.high
    line = json.loads(other.to_json())
    assert (line["kind"], set(line["ratio"]), set(line["value"])) == (
        "run_best", {"value", "low", "high"}, {"median", "low", "high"},
    )  # fmt: skip
    assert "times that of ptracer at its best" in best_line(other)
    assert "error of reslrb:stack, rates x" in best_line(other)


def test_without_rates_there_are_ratios_of_enough_seeds_alone(tmp_path: Path) -> None:
    for runs, count in ((4, 0), (5, 2)):
        session, _, _ = play(tmp_path, Stage(), plan(runs=runs))
        found = outcome(session.members, session.limit_s, plan().names)
        assert len(found.bests) == count
        assert all(best.at is None and best.to == "ptracer" and best.label == "reslrb:stack" for best in found.bests)
        assert all("rates" not in best_line(best) for best in found.bests)


def test_a_seed_that_was_broken_off_does_not_count(tmp_path: Path) -> None:
    """Of three seeds the last is over for one method alone: medians are over the two that both have."""
    session, _, _ = play(tmp_path, Stage(ptracer=Pretence(0.9)), plan(rates=RATES))
    last = [run for run in session.members if run.seed == 2]
    last[0].points[-1] = replace(last[0].points[-1], loss=0.0, parameter_error=0.0)  # it would be the best
    for run in last[1:]:
        run.points.pop()
    found = outcome(session.members, session.limit_s, plan(rates=RATES).names)
    assert [record.runs for record in found.methods] == [3, 2, 2, 2, 2, 2]
    assert {best.runs for best in found.bests} == {2}
    first = next(best for best in found.bests if best.of == "parameter_error")
    ends = [run.points[-1].parameter_error for run in session.members if run.method.label == first.at and run.seed < 2]
    assert [first.value.low, first.value.high] == sorted(ends)


def test_which_rate_is_the_best() -> None:
    names = {"a, 1": "a", "a, 2": "a", "b, 1": "b", "b, 2": "b"}
    values = {"a, 1": [3.0, 1.0, 9.0], "a, 2": [2.0, 2.5, 2.0], "b, 2": [1.0, 1.0, 1.0]}
    assert best_of(values, names) == {"a": "a, 2", "b": "b, 2"}  # one of b's did not come to its end


def coverage(count: int, seeds: int, spread: float, true: float, levels: tuple[float, ...]) -> float:
    random = np.random.default_rng(3)
    hit = 0
    for _ in range(count):
        luck = random.normal(size=seeds) * spread / 2  # of the seed, which all have in common
        own, base = (
            [list(median * level * np.exp(luck + spread * random.normal(size=seeds))) for level in levels]
            for median in (true, 1.0)
        )
        found = ratio(own, base)
        assert found is not None
        hit += found.low <= true <= found.high
    return hit / count


@pytest.mark.parametrize("levels", [(1.0,), (1.6, 1.0, 1.9)])
def test_intervals_hold_the_truth_as_often_as_they_say(
    levels: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rank, "RESAMPLES", 600)
    assert coverage(300, 8, 0.2, 0.6, levels) > 0.92


def test_an_interval_without_the_resampling_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is of half the width does not hold the truth so often."""
    monkeypatch.setattr(rank, "RESAMPLES", 600)
    monkeypatch.setattr(rank, "CONFIDENCE", 0.6)
    assert coverage(300, 8, 0.2, 0.6, (1.0,)) < 0.92


def test_what_is_no_ratio() -> None:
    assert ratio([[1.0] * 4], [[1.0] * 4]) is None
    assert ratio([[1.0] * 5], [[0.0] * 5]) is None
    assert ratio([[float("inf")] * 5], [[1.0] * 5]) is None
    assert ratio([], [[1.0] * 5]) is None
    found = ratio([[1.0] * 5], [[4.0] * 5])
    assert found is not None
    assert (found.value, found.low, found.high) == (0.25, 0.25, 0.25)


def test_a_schedule_comes_to_its_end_with_the_time() -> None:
    """It is as far as the time behind the first iteration, or as the iterations, whichever is further."""
    now, factors = [0.0], []
    limit_s = 11.0

    def records():
        for iteration in range(100):
            factors.append(learning_rate_factor("exponential", iteration, 10**9, 0.01, advance.progress()))
            now[0] += 1.0
            yield type("Record", (), {"iteration": iteration})

    advance = Advance(records(), dict, 1.0, lambda: now[0])
    state: State = advance.until(limit_s, limit_s)
    assert state.iteration == 10
    # The first ends after 2 s: nine seconds are left, of which the last iteration begins after eight.
    assert factors == pytest.approx([1.0, *(0.01 ** (number / 9) for number in range(9))])
    assert learning_rate_factor("exponential", 5, 11, 0.01, 0.2) == pytest.approx(0.1)  # iterations are further
