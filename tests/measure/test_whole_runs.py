"""Whole optimisations at equal wall time: with pretended processes of known cost and known losses."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from measure.pretended_runs import CONFIG, STARTUP_S, Pretence, Stage, plan, play

from reslrb_cli.cli.convergence import _runs_exit_code
from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.optimization_benchmark.evaluate import Advance
from reslrb_cli.measure.optimization_benchmark.rank import POINTS, finals, find_best, method_records, times
from reslrb_cli.measure.optimization_benchmark.session import GRACE, GRACE_S
from reslrb_cli.records.measurements import BenchStatus
from reslrb_cli.report.convergence_tables import RunsTable, runs_closing_sentence, runs_notes
from reslrb_cli.report.plots import curve, plot_runs


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
    assert plan(config=config).seeded(config, 7).run.seed == 7


# --- time -------------------------------------------------------------------------------------------------------------


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


# --- verdicts ---------------------------------------------------------------------------------------------------------


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
    assert list(line) == ["kind", "label", "integrator", "estimator", "capacity", "adjoint", "spp", "seed", "elapsed_s",
                          "iteration", "loss", "parameter_error"]  # fmt: skip
    assert line["kind"] == "run_point"
    record = method_records(session.members, session.limit_s)[1]
    line = json.loads(record.to_json())
    assert (line["kind"], line["label"], line["status"]) == ("run_method", "reslrb:stack", "ok")
    assert set(line["loss"]) == {"median", "low", "high"}
    table = RunsTable(["ptracer", "reslrb:stack"])
    assert "1 run" in table.line(record)
    assert len(table.head()) <= 140
    plot_runs(points, "RMSE", tmp_path / "a $ x.png", "x_$1\ny")
    assert (tmp_path / "a $ x.png").read_bytes().startswith(b"\x89PNG")
