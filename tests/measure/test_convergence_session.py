"""The turns of methods in `convergence`, their lengths, and the treatment of methods that end, tested with pretended
processes.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from measure.pretended_steps import CONFIG, Pretence, Stage, of, plan, play

from reslrb_cli.config.loader import loads
from reslrb_cli.measure.convergence import Role
from reslrb_cli.records.measurements import BenchStatus
from reslrb_cli.report.tables import closing_sentence, notes


def test_steps_continue_after_compilation_with_distinct_seeds(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4))
    session, _, _ = play(tmp_path, stage, plan(rounds=4))
    names = ["case ptracer", "case reslrb:stack", "case reslrb:event", "reference reslrb:stack"]
    assert list(dict.fromkeys(question["of"] for question in stage.asked if question["of"])) == names
    for member in session.members:
        assert member.taken == 2 + 4 * member.count  # a cold step, one without a new kernel, then rounds
    for method in stage.methods.values():
        assert method.steps == list(range(len(method.steps)))
    purposes = {player.first["purpose"] for player in ()}  # seeds differ by the names of the players
    assert purposes == set()
    assert stage.purposes == [f"convergence, {name}" for name in names]


def test_turns_are_interleaved(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4), case_reslrb_stack=Pretence(0.1), case_reslrb_event=Pretence(0.01))
    session, _, _ = play(tmp_path, stage, plan(rounds=None, budget_s=20.0))
    names = ["case ptracer", "case reslrb:stack", "case reslrb:event", "reference reslrb:stack"]
    turns = [names[(r + k) % 4] for r in range(session.rounds) for k in range(4)]
    assert stage.turns == names + turns


def test_cache_effects_of_others_are_not_timed(tmp_path: Path) -> None:
    _, results, _ = play(tmp_path, Stage(case_ptracer=Pretence(0.1, late_s=0.3)), plan(rounds=4))
    assert of(results, "ptracer").step_s == pytest.approx(0.1)


def test_a_number_of_rounds_fixes_the_steps_everywhere(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4), independent_prb=Pretence(0.1))
    stage.facts["independent"] = {"a": "prb", "b": "prb"}
    session, _, _ = play(tmp_path, stage, plan(rounds=3))
    assert [(m.role, m.count, len(m.rows)) for m in session.members] == [
        (Role.CASE, 2, 6), (Role.CASE, 2, 6), (Role.CASE, 2, 6), (Role.REFERENCE, 8, 24), (Role.INDEPENDENT, 4, 12)
    ]  # fmt: skip


def test_ptracer_among_the_methods_is_its_own_reference(tmp_path: Path) -> None:
    session, results, _ = play(tmp_path, Stage(), plan(rounds=8))
    assert not session.of(Role.INDEPENDENT)  # without roulette, both integrators are the same
    assert of(results, "ptracer").bias_reference == "reslrb:stack"
    assert of(results, "reslrb:event").bias_reference == "ptracer"


@pytest.mark.parametrize("cases", ["reslrb:stack", "ptracer,reslrb:stack"])
def test_otherwise_an_independent_reference_takes_turns(tmp_path: Path, cases: str) -> None:
    stage = Stage(independent_ptracer=Pretence(0.01))
    roulette = loads(CONFIG, Path("x.yaml"), ["integrator.rr_depth=3"])
    session, results, _ = play(tmp_path, stage, plan(cases, rounds=8, config=roulette))
    [judge] = session.of(Role.INDEPENDENT)
    assert judge.config.integrator.options()["rr_depth"] == 1_000_000
    assert of(results, "reslrb:stack").bias_reference == "ptracer"


def test_an_ended_method_is_recorded_and_the_rest_continues(tmp_path: Path) -> None:
    stage = Stage(case_reslrb_stack=Pretence(ends=5), case_reslrb_event=Pretence(nan_at=20))
    _, results, said = play(tmp_path, stage, plan())
    ended, broken, sound = (of(results, label) for label in ("reslrb:stack", "reslrb:event", "ptracer"))
    assert (ended.status, ended.efficiency, ended.seconds_to["0.1"]) == (BenchStatus.OUT_OF_MEMORY, None, None)
    assert "not finite" in broken.message
    assert broken.relative_rmse is None
    assert sound.biased is False
    assert closing_sentence(results.methods) == "Best for this scene: ptracer, the only one that was measured."
    assert "reslrb:stack, all: ended by SIGKILL" in notes(results.methods)
    assert said[0] == "old"  # a warning of every process is printed once
    assert said.count("old") == 1


def test_too_few_rounds_are_no_spent_budget(tmp_path: Path) -> None:
    _, results, _ = play(tmp_path, Stage(), plan(rounds=2))
    assert {record.message for record in results.methods} == {"results need 3 rounds; set --rounds"}


def test_an_end_during_compilation_is_reported(tmp_path: Path) -> None:
    stage = Stage(case_reslrb_stack=Pretence(ends=1))
    _, results, said = play(tmp_path, stage, plan())
    assert "reslrb:stack: out_of_memory: ended by SIGKILL" in said
    assert of(results, "reslrb:stack").status is BenchStatus.OUT_OF_MEMORY


def test_without_a_reference_there_are_no_errors(tmp_path: Path) -> None:
    _, results, said = play(tmp_path, Stage(reference_reslrb_stack=Pretence(ends=1)), plan())
    assert "reslrb:stack: out_of_memory: ended by SIGKILL" in said
    assert {record.relative_rmse for record in results.methods} == {None}
    assert results.points == results.references == []
    assert "Nothing can be said" in closing_sentence(results.methods)


def test_an_ended_independent_reference_is_replaced(tmp_path: Path) -> None:
    stage = Stage(independent_ptracer=Pretence(ends=1))
    _, results, _ = play(tmp_path, stage, plan("reslrb:event"))
    assert of(results, "reslrb:event").bias_reference == "reslrb:stack"


def test_records_have_the_options_of_their_method(tmp_path: Path) -> None:
    session, _, _ = play(tmp_path, Stage(), plan("reslrb:reservoir(capacity=2)", rounds=4))
    assert [(m.method.estimator, m.method.capacity) for m in session.of(Role.CASE)] == [("reservoir", 2)]


@pytest.mark.parametrize("default", [True, False])
def test_only_unnamed_methods_are_left_out(tmp_path: Path, default: bool) -> None:
    stage = Stage({"without": {"ptracer": "it emits wrongly"}})
    session, _, said = play(tmp_path, stage, plan(default=default, rounds=4))
    assert ("left out: ptracer: it emits wrongly" in said) is default
    assert ("ptracer" in [m.label for m in session.of(Role.CASE)]) is not default


@pytest.mark.parametrize("after", [0, 5, 12, 40, 120])
def test_a_stop_keeps_finished_measurements(tmp_path: Path, after: int) -> None:
    answers = iter(range(10**6))
    stage = Stage(case_ptracer=Pretence(0.4))
    session, results, _ = play(tmp_path, stage, plan(), stop=lambda: next(answers) > after)
    for member in session.members:
        assert len(member.rows) == len(member.turns)
        assert len(set(member.turns)) == len(member.seconds)
    assert len(results.methods) in (0, 9)


@pytest.mark.parametrize(
    ("budget_s", "measured"), [(60.0, True), (11.5, False), (8.5, False), (3.5, False), (0.5, False)]
)
def test_the_budget_covers_compilation_and_a_small_one_is_reported(
    tmp_path: Path, budget_s: float, measured: bool
) -> None:
    stage = Stage(case_ptracer=Pretence(0.4, cold_s=2.0))
    _, results, said = play(tmp_path, stage, plan(rounds=None, budget_s=budget_s))
    assert stage.now <= max(budget_s, 1.0) + 0.1  # a session looks at the clock every 0.05 s
    assert any(record.relative_rmse is not None for record in results.methods) is measured
    assert any("budget" in line for line in said) is not measured


def test_no_budget_is_exceeded(tmp_path: Path) -> None:
    """Each step takes seconds. For some of these budgets, a round takes longer than the time left after compilation."""
    for budget_s in range(8, 60, 4):
        stage = Stage(case_ptracer=Pretence(3.0, cold_s=3.0))
        play(tmp_path, stage, plan(rounds=None, budget_s=float(budget_s)))
        assert stage.now <= budget_s + 0.1


def test_the_budget_is_kept_and_used(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4, cold_s=2.0))
    play(tmp_path, stage, plan(rounds=None, budget_s=100.0))
    assert 88 < stage.now < 100
