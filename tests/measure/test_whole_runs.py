"""Whole optimisations at equal wall time: decisions, rates, going on."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from measure.pretended_runs import CONFIG, LIST, STARTUP_S, Pretence, Stage, plan, play
from optimization.deciding import begin, fix_times

from reslrb_cli.cli.convergence import _runs_exit_code
from reslrb_cli.config.loader import dump, load, loads
from reslrb_cli.errors import ConfigError, ExitCode
from reslrb_cli.measure.methods import RunsPlan, at_rate, parse_cases, with_run
from reslrb_cli.measure.optimization_benchmark import evaluate, rank
from reslrb_cli.measure.optimization_benchmark.evaluate import Advance, State
from reslrb_cli.measure.optimization_benchmark.rank import (
    POINTS,
    best_of,
    finals,
    find_best,
    method_records,
    outcome,
    ratio,
    times,
)
from reslrb_cli.measure.optimization_benchmark.session import GRACE, GRACE_S, RunsSession
from reslrb_cli.measure.resume_store import Earlier
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import learning_rate_factor
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import target_arrays
from reslrb_cli.records.measurement_files import read_samples, write_samples
from reslrb_cli.records.measurements import BenchStatus
from reslrb_cli.report.convergence_tables import best_line, runs_cells, runs_closing_sentence, runs_columns, runs_notes
from reslrb_cli.report.plots import curve, plot_runs

# Whole optimisations at equal wall time: with pretended processes of known cost and known losses.


def iterations_by(seconds: float, played: Pretence) -> int:
    """What is done by then: one after `loading_s` + `first_s` + `step_s`, then one more each step."""
    left = seconds - played.loading_s - played.first_s
    return max(int(np.floor(left / played.step_s + 1e-9)), 0)


def test_known_curves_have_known_medians_and_bands(tmp_path: Path) -> None:
    slow, fast = Pretence(0.9, 0.4, 2.0), Pretence(0.95, 0.1)
    session, points, _ = play(tmp_path, Stage(ptracer=slow, reslrb_stack=fast), plan())
    assert len(points) == 2 * 3 * POINTS
    for label, played in (("ptracer", slow), ("reslrb:stack", fast)):
        own = [point for point in points if point.method.label == label]
        for time, band in curve(own, "parameter_error"):
            done = iterations_by(time, played)
            values = [1.0] * 3 if done == 0 else [played.gain**done * (1 + seed / 100) for seed in range(3)]
            assert (band.low, band.median, band.high) == pytest.approx(tuple(values))
        assert [point.elapsed_s for point in own if point.seed == 1] == times(session.limit_s)
    records = method_records(session.members, session.limit_s)
    assert [(record.method.label, record.runs) for record in records] == [("ptracer", 3), ("reslrb:stack", 3)]
    for record, played in zip(records, (slow, fast), strict=True):
        done = iterations_by(session.limit_s, played)
        assert record.iterations is not None
        assert (record.iterations.low, record.iterations.high) == (done, done)
        assert record.first_s is not None
        assert record.first_s.median == pytest.approx(played.loading_s + played.first_s + played.step_s)
        assert record.loss is not None
        assert record.loss.median == pytest.approx((played.gain**done * 1.01) ** 2)


def test_the_time_is_equal_and_the_budget_kept_and_used(tmp_path: Path) -> None:
    """Compiling counts, judging does not: what an image takes changes how long runs are, and nothing else."""
    for judge_s in (0.01, 0.3):
        fast, slow = Pretence(step_s=0.1), Pretence(step_s=0.7)
        stage = Stage(judge_s, ptracer=slow, reslrb_stack=fast)
        session, points, said = play(tmp_path, stage, plan(budget_s=90.0))
        assert 65 < stage.now < 90
        assert said == ["old"]
        each_s = (0.97 * 90 - 2 - STARTUP_S - 0.3 - stage.target_s) / 6
        assert session.limit_s == pytest.approx((each_s - POINTS * judge_s - STARTUP_S - GRACE_S) / (1 + GRACE))
        for point in points:
            assert point.iteration == iterations_by(point.elapsed_s, slow if point.method.label == "ptracer" else fast)


@pytest.mark.parametrize("budget_s", [20, 25, 32, 40, 60])
@pytest.mark.parametrize("step_s", [0.05, 1.5, 30.0])
def test_no_budget_is_overrun(tmp_path: Path, budget_s: float, step_s: float) -> None:
    stage = Stage(ptracer=Pretence(step_s=step_s))
    play(tmp_path, stage, plan(budget_s=float(budget_s)))
    assert stage.now <= budget_s


def test_turns_are_interleaved_seed_by_seed(tmp_path: Path) -> None:
    stage = Stage()
    play(tmp_path, stage, plan(runs=2))
    names = ["ptracer", "reslrb_stack"]
    assert stage.turns == [(names[(turn + k) % 2], seed) for seed in (0, 1) for turn in range(POINTS) for k in range(2)]
    assert stage.most_alive == 3  # the methods of one seed, and the judge


def test_a_step_that_is_not_done_in_time_does_not_count(tmp_path: Path) -> None:
    """What compiles for longer than its time is cut off, and stands where it began."""
    stage = Stage(ptracer=Pretence(first_s=500.0))
    _, points, said = play(tmp_path, stage, plan())
    assert "ptracer, seed 0: cut off in iteration 1" in said
    own = [point for point in points if point.method.label == "ptracer"]
    assert len(own) == 3 * POINTS
    assert {(point.iteration, point.loss) for point in own} == {(0, 1.0)}
    assert stage.now < 100


def test_what_has_done_all_its_iterations_stays_where_it_is(tmp_path: Path) -> None:
    session, points, said = play(tmp_path, Stage(reslrb_stack=Pretence(iterations=5)), plan())
    last = [point for point in points if point.elapsed_s == session.limit_s and point.method.label == "reslrb:stack"]
    assert [point.iteration for point in last] == [5] * 3
    assert "reslrb:stack: all iterations were done after 1.2 s; raise run.iterations to have it go on" in said


def test_an_unchanged_state_is_judged_once(tmp_path: Path) -> None:
    stage = Stage(ptracer=Pretence(iterations=1), reslrb_stack=Pretence(iterations=2))
    play(tmp_path, stage, plan(runs=1))
    assert stage.judged in (2, 3)


def test_a_method_that_ends_is_recorded_and_the_rest_goes_on(tmp_path: Path) -> None:
    session, _, said = play(tmp_path, Stage(ptracer=Pretence(ends_s=2.0)), plan())
    assert "ptracer, seed 0: out_of_memory: ended by SIGKILL" in said
    assert len([line for line in said if line.startswith("ptracer")]) == 1  # another seed would need as much
    ended, sound = method_records(session.members, session.limit_s)
    assert (ended.status, ended.runs, ended.loss) == (BenchStatus.OUT_OF_MEMORY, 0, None)
    assert runs_notes([ended, sound]) == ["ptracer: 1 of 1 ended before their time: ended by SIGKILL"]
    assert sound.runs == 3
    verdict = find_best(finals(session.members, session.limit_s, "loss"))
    assert "reslrb:stack, the only one that was measured" in runs_closing_sentence(verdict, None, session.limit_s)


def test_what_cannot_do_the_scene_is_left_out_of_the_default_list_alone(tmp_path: Path) -> None:
    stage = Stage(without={"ptracer": "no derivative"}, reslrb_event=Pretence(refuses=True))
    cases = "ptracer,reslrb:stack,reslrb:event"
    _, points, said = play(tmp_path, stage, plan(cases, default=True))
    assert {point.method.label for point in points} == {"reslrb:stack"}
    assert {"left out: ptracer: no derivative", "left out: reslrb:event: cannot be done here"} <= set(said)
    _, points, _ = play(tmp_path, Stage(without={"ptracer": "no derivative"}), plan())
    assert {point.method.label for point in points} == {"ptracer", "reslrb:stack"}


@pytest.mark.parametrize("after", [3, 50, 300, 900])
def test_an_interrupt_keeps_what_is_done(tmp_path: Path, after: int) -> None:
    whole = play(tmp_path, Stage(), plan())[1]
    answers = iter(range(10**6))
    session, points, _ = play(tmp_path, Stage(), plan(), lambda: next(answers) > after)
    assert len(points) < len(whole)
    assert points == whole[: len(points)]
    assert sum(record.runs for record in method_records(session.members, session.limit_s)) == len(
        [point for point in points if point.elapsed_s == session.limit_s]
    )


@pytest.mark.parametrize("budget_s", [1.0, 4.0, 8.0, 14.0])
def test_a_budget_that_is_too_small_says_what_it_would_take(tmp_path: Path, budget_s: float) -> None:
    _, points, said = play(tmp_path, Stage(), plan(budget_s=budget_s))
    assert points == []
    assert "the budget of" in said[-1]
    if "allow more than" in said[-1]:
        needed = float(said[-1].split("allow more than ")[1].split(" s")[0])
        assert budget_s < needed
        assert play(tmp_path, Stage(), plan(budget_s=needed + 1))[1]


def test_runs_that_all_compile_for_too_long_end_after_the_first_seed(tmp_path: Path) -> None:
    played = Pretence(first_s=500.0)
    session, points, said = play(tmp_path, Stage(ptracer=played, reslrb_stack=played), plan())
    assert {point.seed for point in points} == {0}
    assert find_best(finals(session.members, session.limit_s, "loss")) is None
    assert _runs_exit_code(method_records(session.members, session.limit_s)) == ExitCode.CHECK_FAILED
    assert said[-1].startswith("no method came to an iteration in the")


def test_auto_says_what_its_pilot_chose_and_is_allowed(tmp_path: Path) -> None:
    stage = Stage(reslrb_auto=Pretence(chose=("estimator auto: stack", "guiding on")))
    _, points, said = play(tmp_path, stage, plan("reslrb:auto"))
    assert said.count("reslrb:auto: estimator auto: stack") == said.count("reslrb:auto: guiding on") == 1
    assert {point.method.estimator for point in points} == {"auto"}


def test_seeds_follow_that_of_the_configuration() -> None:
    config = loads(CONFIG, Path("x.yaml"), ["run.seed=4294967295"])
    assert plan(config=config).seeds == [4294967295, 0, 1]
    assert with_run(config, seed=7).run.seed == 7


def test_a_state_stands_from_its_end_on_and_copies_of_values_take_no_time() -> None:
    """Iterations end 3, 4, 5, 6 and 10 s after the start, of which loading takes 1; each copy would take 5 more."""
    now, done = [100.0], [0]

    def records() -> Any:
        for iteration, taken_s in enumerate([2.0, 1.0, 1.0, 1.0, 4.0]):
            now[0] += taken_s
            done[0] += 1
            yield SimpleNamespace(iteration=iteration)

    def take() -> dict[str, np.ndarray]:
        now[0] += 5.0
        return {"a": np.array(float(done[0]))}

    advance = Advance(records(), take, 1.0, lambda: now[0])
    assert [advance.until(time, 9.5).iteration for time in (0.5, 2.9, 3.0, 4.5, 4.9, 5.0)] == [0, 0, 1, 2, 2, 3]
    state = advance.until(9.5, 9.5)
    assert (state.iteration, state.elapsed_s, float(state.values["a"])) == (4, 6.0, 4.0)
    assert not advance.finished
    assert advance.first_s == 3.0


def test_who_is_told_apart() -> None:
    low, high = [1.0, 1.1, 1.2, 1.3, 1.4], [2.0, 2.1, 2.2, 2.3, 2.4]
    verdict = find_best({"b": high, "a": low, "c": [1.05, 1.15, 1.25, 1.35, 9.0]})
    assert verdict is not None
    assert (verdict.best, verdict.tied, verdict.beats, verdict.too_few) == ("a", ["c"], ["b"], False)
    few = find_best({"a": low[:3], "b": high[:3]})
    assert few is not None
    assert (few.tied, few.too_few, few.enough) == (["b"], True, 4)
    assert runs_closing_sentence(few, verdict, 9.5) == (
        "After 9.5 s of each run, all costs counted: best by the loss is a, tied with b; best by the error of the "
        "parameters is a, tied with c, ahead of b. Told apart by the Mann-Whitney test at 5%, corrected for the number "
        "of methods; so few runs are too few for that, 4 of each could do."
    )
    assert find_best({}) is None


def test_equal_methods_are_seldom_told_apart() -> None:
    random = np.random.default_rng(5)
    wrong = 0
    for _ in range(400):
        verdict = find_best({name: list(random.normal(size=6)) for name in "abcd"})
        assert verdict is not None
        wrong += bool(verdict.beats)
    # The best of four is compared with the three others: more often than at one test, far less than at no correction.
    assert wrong <= 0.12 * 400


def test_records_and_lines(tmp_path: Path) -> None:
    session, points, _ = play(tmp_path, Stage(), plan(runs=1))
    line = json.loads(points[-1].to_json())
    assert list(line) == ["kind", "label", "integrator", "estimator", "capacity", "adjoint", "spp", "paths",
                          "light_share", "seed", "elapsed_s", "iteration", "loss", "parameter_error"]  # fmt: skip
    assert line["kind"] == "run_point"
    record = method_records(session.members, session.limit_s)[1]
    line = json.loads(record.to_json())
    assert (line["kind"], line["label"], line["status"]) == ("run_method", "reslrb:stack", "ok")
    assert set(line["loss"]) == {"median", "low", "high"}
    table = runs_columns(["ptracer", "reslrb:stack"])
    assert "1 run" in table.line(runs_cells(record))
    assert len(table.head()) <= 140
    plot_runs(points, "RMSE", tmp_path / "a $ x.png", "x_$1\ny")
    assert (tmp_path / "a $ x.png").read_bytes().startswith(b"\x89PNG")


# What a whole run decides by measurement before its first iteration, as `optimize` does; times of steps are given.

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


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("ms", "chose"),
    [(0.2, ["sequence independent", "guiding on"]), (1000.0, ["sequence low_discrepancy", "guiding off"])],
)
def test_what_is_left_to_measurement_is_decided(
    ms: float, chose: list[str], experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fix_times(monkeypatch, {"guiding": ms})
    said, problem = begun(experiment, monkeypatch, "integrator.guiding=auto", "integrator.sequence=auto")
    assert said["chose"] == chose
    plan = problem.integrator.plan(problem.scene, problem.scene.sensors()[0])
    assert (problem.integrator.preparation.guiding is not None) == (plan.sequence is None) == (ms < 1)


@pytest.mark.usefixtures("llvm")
def test_nothing_is_measured_of_what_is_named(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said, problem = begun(experiment, monkeypatch, "integrator.guiding=on")
    assert said["chose"] == []
    assert problem.integrator.preparation.guiding is not None


# Whole runs with several learning rates: each method at its best, and the ratio of two of them with its interval.

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


# Whole runs that go on from others: more seeds, each with the time of those before it; with pretended processes.


def play_again(
    folder: Path, stage: Stage, what: RunsPlan, earlier: Earlier | None = None, after: int = 10**6
) -> tuple[RunsSession, list[str]]:
    said, answers = list[str](), iter(range(10**6))
    folder.mkdir(exist_ok=True)
    session = RunsSession(
        what, folder, lambda: next(answers) > after, said.append, stage.start, stage.clock, earlier=earlier
    )
    list(session.run())
    assert stage.alive == 0
    return session, said


def again(session: RunsSession, file: Path) -> Earlier:
    kept = session.kept()
    assert kept is not None
    write_samples(file, *kept)
    return Earlier("convergence --runs", Path("c.jsonl"), *read_samples(file))


def test_seeds_go_on_with_the_same_target_and_the_same_time(tmp_path: Path) -> None:
    first, _ = play_again(tmp_path / "a", Stage(), plan(runs=2, budget_s=80.0))
    earlier = again(first, tmp_path / "c.samples.npz")
    stage = Stage()
    second, said = play_again(tmp_path / "b", stage, plan(runs=4, budget_s=300.0), earlier)
    assert said == ["old"]
    assert {seed for _, seed in stage.turns} == {2, 3}
    assert second.limit_s == first.limit_s
    assert [run.seed for run in second.members] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert all(len(run.points) == POINTS and run.complete(second.limit_s) for run in second.members)
    for before, run in zip(first.members, second.members, strict=False):
        assert before.points == run.points
    records = method_records(second.members, second.limit_s)
    assert [record.runs for record in records] == [4, 4]
    # The cost to the first iteration is that of all four.
    assert records[0].first_s is not None
    assert records[0].first_s.median == pytest.approx(0.2 + 0.5 + 0.1)
    assert (tmp_path / "b/targets.npz").exists()


@pytest.mark.parametrize("after", [20, 700])
def test_a_seed_that_was_broken_off_is_made_anew(tmp_path: Path, after: int) -> None:
    whole, _ = play_again(tmp_path / "a", Stage(), plan())
    stopped, _ = play_again(tmp_path / "b", Stage(), plan(), after=after)
    kept = stopped.kept()
    over = sum(run.complete(stopped.limit_s) for run in stopped.members) // 2
    if over == 0:
        assert kept is None
        return
    assert over < 3
    stage = Stage()
    second, _ = play_again(tmp_path / "c", stage, plan(), again(stopped, tmp_path / "c.samples.npz"))
    assert {seed for _, seed in stage.turns} == set(range(over, 3))
    assert [run.points for run in second.members] == [run.points for run in whole.members]


def test_what_had_no_memory_is_not_tried_again(tmp_path: Path) -> None:
    first, _ = play_again(tmp_path / "a", Stage(ptracer=Pretence(ends_s=2.0)), plan(runs=1))
    stage = Stage()
    second, _ = play_again(
        tmp_path / "b", stage, plan(runs=2, budget_s=300.0), again(first, tmp_path / "c.samples.npz")
    )
    assert {name for name, _ in stage.turns} == {"reslrb_stack"}
    ended, sound = method_records(second.members, second.limit_s)
    assert (ended.status, ended.runs, sound.runs) == (BenchStatus.OUT_OF_MEMORY, 0, 2)


def test_a_budget_without_room_for_one_seed_says_what_it_takes(tmp_path: Path) -> None:
    first, _ = play_again(tmp_path / "a", Stage(), plan(runs=2, budget_s=80.0))
    earlier = again(first, tmp_path / "c.samples.npz")
    stage = Stage()
    second, said = play_again(tmp_path / "b", stage, plan(runs=3, budget_s=20.0), earlier)
    assert stage.now < 20
    assert len(second.members) == 4
    kept = second.kept()
    assert kept is not None
    assert kept[0]["runs"] == earlier.head["runs"]  # nothing is lost
    needed = float(said[-1].split("allow more than ")[1].split(" s")[0])
    more, _ = play_again(tmp_path / "c", Stage(), plan(runs=3, budget_s=needed + 1), earlier)
    assert len(more.members) == 6


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"config": loads(CONFIG, Path("x.yaml"), ["optimizer.learning_rate=0.5"])}, "optimizer.learning_rate is 0.02"),
        ({"cases": "reslrb:stack"}, "integrators is ['ptracer', 'reslrb:stack'] there, ['reslrb:stack']"),
        ({"reference": parse_cases("ptracer")[0]}, "reference is reslrb:stack there, ptracer here"),
    ],
)
def test_only_the_same_is_gone_on_from(tmp_path: Path, change: dict[str, Any], line: str) -> None:
    earlier = again(play_again(tmp_path / "a", Stage(), plan(runs=1))[0], tmp_path / "c.samples.npz")
    with pytest.raises(ConfigError, match=re.escape(f"--resume: c.jsonl is of another measurement: {line}")):
        play_again(tmp_path / "b", Stage(), plan(**({"runs": 2} | change)), earlier)
    with pytest.raises(ConfigError, match=r"c\.jsonl has 1 run of each already; name more with --runs"):
        play_again(tmp_path / "b", Stage(), plan(runs=1), earlier)
    assert plan(device="x").settings()["device"] == "x, llvm_ad_rgb"  # as in the files of earlier versions


def test_another_loss_of_the_initial_values_is_another_scene(tmp_path: Path) -> None:
    earlier = again(play_again(tmp_path / "a", Stage(), plan(runs=1))[0], tmp_path / "c.samples.npz")
    earlier.head["facts"]["loss"] *= 1.01
    stage = Stage()
    with pytest.raises(ConfigError, match=r"the initial loss is 1\.01 there, 1 here: has a file of the scene changed"):
        play_again(tmp_path / "b", stage, plan(runs=2), earlier)
    assert stage.alive == 0
