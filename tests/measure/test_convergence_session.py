"""The turns of methods in `convergence`, their lengths, and the treatment of methods that end, tested with pretended
processes.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from measure.pretended_steps import CONFIG, LIST, Pretence, Stage, of, plan, play

from reslrb_cli.config.loader import loads
from reslrb_cli.measure import convergence, draws
from reslrb_cli.measure.judgement import ConvergenceResults
from reslrb_cli.measure.methods import ROUNDS
from reslrb_cli.records.measurements import BenchStatus, MethodRecord
from reslrb_cli.report.tables import closing_sentence, notes, result_lines

NAMES = [f"{name}, 4 spp" for name in ("case ptracer", "case reslrb:stack", "case reslrb:event",
                                       "reference reslrb:stack")]  # fmt: skip


def test_steps_continue_after_compilation_with_distinct_seeds() -> None:
    stage = Stage(case_ptracer=Pretence(0.4))
    session, _, _ = play(stage, plan(rounds=4))
    assert list(dict.fromkeys(question["of"] for question in stage.asked if question["of"])) == NAMES
    for member, name in zip(session.members, NAMES, strict=True):
        asked = [question["numbers"] for question in stage.asked if question["of"] == name]
        count = member.count
        turns = [[*range(turn * count, (turn + 1) * count)] for turn in range(4)]
        assert asked == [[0], [0], *turns]  # a cold step, one without a new kernel, then rounds
        assert member.draws.seeds.tolist() == [*range(4 * count)]
    assert stage.purposes == [f"convergence, {name}" for name in NAMES]  # seeds differ by purposes


def test_turns_are_interleaved() -> None:
    stage = Stage(case_ptracer=Pretence(0.4), case_reslrb_stack=Pretence(0.1), case_reslrb_event=Pretence(0.01))
    session, _, _ = play(stage, plan(rounds=9))
    assert session.rounds == 9
    assert stage.turns == [NAMES[(r + k) % 4] for r in range(session.rounds) for k in range(4)]


def test_cache_effects_of_others_are_not_timed() -> None:
    _, results, _ = play(Stage(case_ptracer=Pretence(0.1, late_s=0.3)), plan(rounds=4))
    assert of(results, "ptracer").step_s == pytest.approx(0.1)


def test_a_number_of_rounds_fixes_the_steps_everywhere() -> None:
    stage = Stage(case_ptracer=Pretence(0.4), independent_prb=Pretence(0.1))
    stage.facts["independent"] = {"a": "prb", "b": "prb"}
    session, _, _ = play(stage, plan(rounds=3))
    assert [(m.role, m.count, len(m.draws)) for m in session.members] == [
        ("case", 2, 6), ("case", 2, 6), ("case", 2, 6), ("reference", 8, 24), ("independent", 4, 12)
    ]  # fmt: skip


def test_ptracer_among_the_methods_is_its_own_reference() -> None:
    session, results, _ = play(Stage(), plan(rounds=8))
    assert not session.of("independent")  # without roulette, both integrators are the same
    assert of(results, "ptracer").bias_reference == "reslrb:stack"
    assert of(results, "reslrb:event").bias_reference == "ptracer"


@pytest.mark.parametrize("cases", ["reslrb:stack", "ptracer,reslrb:stack"])
def test_otherwise_an_independent_reference_takes_turns(cases: str) -> None:
    stage = Stage(independent_ptracer=Pretence(0.01))
    roulette = loads(CONFIG, Path("x.yaml"), ["integrator.rr_depth=3"])
    session, results, _ = play(stage, plan(cases, rounds=8, config=roulette))
    [judge] = session.of("independent")
    assert judge.config.integrator.options()["rr_depth"] == 1_000_000
    assert of(results, "reslrb:stack").bias_reference == "ptracer"


def test_an_ended_method_is_recorded_and_the_rest_continues() -> None:
    stage = Stage(case_reslrb_stack=Pretence(ends=5), case_reslrb_event=Pretence(nan_at=20))
    _, results, said = play(stage, plan())
    ended, broken, sound = (of(results, label) for label in ("reslrb:stack", "reslrb:event", "ptracer"))
    assert (ended.status, ended.efficiency, ended.seconds_to["0.1"]) == (BenchStatus.OUT_OF_MEMORY, None, None)
    assert "not finite" in broken.message
    assert broken.relative_rmse is None
    assert sound.biased is False
    assert closing_sentence(results.methods) == "Best for this scene: ptracer, the only one that was measured."
    assert "reslrb:stack, all: ended by SIGKILL" in notes(results.methods)
    assert said[0] == "old"  # a warning of every process is printed once
    assert said.count("old") == 1


def test_without_a_reference_there_are_no_errors() -> None:
    _, results, said = play(Stage(reference_reslrb_stack=Pretence(ends=1)), plan())
    assert "reslrb:stack: out_of_memory: ended by SIGKILL" in said
    assert {record.relative_rmse for record in results.methods} == {None}
    assert results.points == results.references == []
    assert "Nothing can be said" in closing_sentence(results.methods)


def test_an_ended_independent_reference_is_replaced() -> None:
    stage = Stage(independent_ptracer=Pretence(ends=1))
    _, results, _ = play(stage, plan("reslrb:event"))
    assert of(results, "reslrb:event").bias_reference == "reslrb:stack"


def test_records_have_the_options_of_their_method() -> None:
    _, results, _ = play(Stage(), plan("reslrb:reservoir(capacity=2)", rounds=4))
    method = of(results, "reslrb:reservoir(capacity=2)").method
    assert (method.options["estimator"], method.options["capacity"]) == ("reservoir", 2)
    assert (method.spp, method.max_depth, method.adjoint) == (4, 4, None)


@pytest.mark.parametrize("default", [True, False])
def test_only_unnamed_methods_are_left_out(default: bool) -> None:
    stage = Stage({"without": {"ptracer": "it emits wrongly"}})
    session, _, said = play(stage, plan(default=default, rounds=4))
    assert ("left out: ptracer: it emits wrongly" in said) is default
    assert ("ptracer" in [m.label for m in session.of("case")]) is not default


@pytest.mark.parametrize("after", [0, 5, 12, 40, 120])
def test_a_stop_keeps_finished_measurements(after: int) -> None:
    answers = iter(range(10**6))
    stage = Stage(case_ptracer=Pretence(0.4))
    session, results, _ = play(stage, plan(), stop=lambda: next(answers) > after)
    for member in session.members:
        assert len(member.draws) == len(member.turns) == member.count * len(member.kept)
        assert len(member.kept) == len(member.seconds)
    assert len(results.methods) in (0, 9)


@pytest.mark.parametrize(
    ("budget_s", "measured"), [(60.0, True), (11.5, False), (8.5, False), (3.5, False), (0.5, False)]
)
def test_the_budget_covers_compilation_and_a_small_one_is_reported(budget_s: float, measured: bool) -> None:
    stage = Stage(case_ptracer=Pretence(0.4, cold_s=2.0))
    _, results, said = play(stage, plan(rounds=None, budget_s=budget_s))
    assert stage.now <= max(budget_s, 1.0) + 0.1  # a session looks at the clock every 0.05 s
    assert any(record.relative_rmse is not None for record in results.methods) is measured
    assert any("budget" in line for line in said) is not measured


def test_the_budget_is_used_and_never_exceeded() -> None:
    """Each step takes seconds. For some of these budgets, a round takes longer than the time left after compilation."""
    for budget_s in range(8, 60, 4):
        stage = Stage(case_ptracer=Pretence(3.0, cold_s=3.0))
        play(stage, plan(rounds=None, budget_s=float(budget_s)))
        assert budget_s - 0.1 <= stage.now <= budget_s + 0.1


def test_without_rounds_and_with_time_there_is_a_fixed_number_of_rounds() -> None:
    stage = Stage()
    session, _, _ = play(stage, plan(rounds=None, budget_s=1e4))
    assert (session.rounds, stage.now < 1e3) == (ROUNDS, True)


# A file of draws.


def taken(stage: Stage) -> dict[str, int]:
    """Return how many turns each process has taken."""
    return {name: stage.turns.count(name) for name in dict.fromkeys(stage.turns)}


def figures(results: ConvergenceResults) -> list[tuple[MethodRecord, ...]]:
    """Return all records, without the rounding that another order of sums may change."""
    return [(*results.points, *results.methods, *results.references)]


def test_a_second_call_draws_only_what_is_missing(tmp_path: Path) -> None:
    file, usual, last = tmp_path / "d.npz", "ptracer,reslrb:stack", "case reslrb:event, 4 spp"
    first, more, other, again = Stage(), Stage(), Stage(), Stage()
    play(first, plan(usual, rounds=4), file=file)
    assert taken(first) == dict.fromkeys([*NAMES[:2], NAMES[3]], 4)
    play(more, plan(usual, rounds=10), file=file)
    assert taken(more) == dict.fromkeys([*NAMES[:2], NAMES[3]], 6)
    assert min(question["image"] for question in more.asked if len(question["numbers"]) > 1) == 4
    assert (first.surveys, more.surveys) == (1, 0)
    _, results, _ = play(other, plan("reslrb:event,ptracer", rounds=10), file=file)
    assert taken(other) == {last: 10}
    assert [record.repeats for record in results.methods] == [20] * 6
    _, whole, said = play(again, plan(LIST, rounds=10), file=file)
    assert (again.asked, again.now, said) == ([], 0.0, [])
    at_once = play(Stage(), plan(LIST, rounds=10))[1]
    assert figures(whole) == figures(at_once)


def test_the_next_call_continues_where_the_budget_ended(tmp_path: Path) -> None:
    file, budget = tmp_path / "d.npz", {"rounds": None, "budget_s": 20.0}
    session, _, _ = play(Stage(), plan("ptracer", **budget), file=file)
    assert 4 < session.rounds < ROUNDS
    more, last = Stage(), Stage()
    play(more, plan("ptracer", **budget), file=file)
    play(last, plan("ptracer", rounds=None, budget_s=1e4), file=file)
    counts = [taken(more), taken(last)]
    assert all(session.rounds + sum(count[name] for count in counts) in (ROUNDS, ROUNDS + 1) for name in counts[0])


def test_an_interrupted_call_keeps_its_draws(tmp_path: Path) -> None:
    file, answers, rest = tmp_path / "d.npz", iter(range(10**6)), Stage()
    session, _, _ = play(Stage(), plan(rounds=8), stop=lambda: next(answers) > 300, file=file)
    kept = {member.purpose.partition(", ")[2]: len(member.kept) for member in session.members}
    assert 0 < min(kept.values()) < 8
    play(rest, plan(rounds=8), file=file)
    assert taken(rest) == {name: 8 - count for name, count in kept.items()}


@pytest.mark.parametrize("change", ["run.seed=7", "integrator.rr_depth=8"])
def test_draws_of_another_situation_are_not_used(tmp_path: Path, change: str) -> None:
    file, stage = tmp_path / "d.npz", Stage()
    play(Stage(), plan("reslrb:stack", rounds=3), file=file)
    _, _, said = play(stage, plan("reslrb:stack", rounds=3, config=loads(CONFIG, Path("x.yaml"), [change])), file=file)
    assert set(taken(stage).values()) == {3}
    what = "seed" if "seed" in change else "settings"
    assert f"reslrb:stack: draws on file are of other {what}, dL_dI, so they are not used" in said
    kept = Stage()
    play(kept, plan("reslrb:stack", rounds=3), file=file)
    assert kept.asked == []


def test_times_of_two_sessions_are_never_mixed_in_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "d.npz"
    _, results, _ = play(Stage(), plan("ptracer", rounds=4), file=file)
    assert results.remark == ""
    monkeypatch.setattr(draws, "this_session", lambda: "elsewhere, later")
    _, results, _ = play(Stage(), plan("ptracer,reslrb:event", rounds=4), file=file)
    assert results.remark.startswith("times are from 2 sessions")
    assert "elsewhere, later" in results.remark
    assert result_lines(results)[-1].remark == results.remark
    assert play(Stage(), plan("reslrb:event", rounds=4), file=file)[1].remark == ""


def test_a_refusal_is_remembered(tmp_path: Path) -> None:
    file, again = tmp_path / "d.npz", Stage()
    for stage in (Stage(case_reslrb_event=Pretence(refuses=True)), again):
        _, results, said = play(stage, plan(rounds=3, default=True), file=file)
        assert "left out: reslrb:event: cannot be done here" in said
        assert {record.method.label for record in results.methods} == {"ptracer", "reslrb:stack"}
    assert again.asked == []


@pytest.mark.parametrize(("fitting", "rounds"), [(5, 5), (1, convergence.FEWEST + 1)])
def test_too_many_draws_for_the_memory_are_reported(fitting: int, rounds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(convergence, "MEMORY", 4 * 63 * 12 * fitting)
    session, _, said = play(Stage(), plan("ptracer,reslrb:stack", rounds=9))
    assert session.rounds == rounds
    assert f"the memory for draws ends after {rounds} rounds" in said
