"""What `convergence` makes of methods whose cost, noise and bias are known: with processes that only pretend."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from measure.pretended_steps import SHAPES, TRUTH, Pretence, Stage

from reslrb_cli.config import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.cases import parse_cases
from reslrb_cli.measure.convergence.judgement import Judgement, Results
from reslrb_cli.measure.convergence.members import MOST_REFERENCE_STEPS, MOST_STEPS, Role
from reslrb_cli.measure.convergence.plan import Plan
from reslrb_cli.measure.convergence.session import Session
from reslrb_cli.records.bench import BenchStatus
from reslrb_cli.records.convergence import MethodRecord
from reslrb_cli.report.convergence_table import closing_sentence, notes

CONFIG = """\
scene: {file: scene.xml}
target: {render: {}}
parameters: [{key: a}, {key: b}]
integrator: {max_depth: 4, rr_depth: 9}
run: {spp: 4}
"""
LIST = "ptracer,reslrb:stack,reslrb:event"
SIGNAL = float(TRUTH @ TRUTH)


def plan(cases: str = LIST, **changes: Any) -> Plan:
    values: dict[str, Any] = {
        "config": loads(CONFIG, Path("x.yaml")), "variant": "llvm_ad_rgb", "cases": parse_cases(cases, deep=False),
        "reference": parse_cases("reslrb:stack")[0], "objective": "fixed", "memory_limit": None, "memory": 2**40,
        "budget_s": 0.0, "rounds": 32,
    }  # fmt: skip
    return Plan(**(values | changes))


def play(
    folder: Path, stage: Stage, what: Plan, stop: Callable[[], bool] = lambda: False
) -> tuple[Session, Results, list[str]]:
    said: list[str] = []
    session = Session(what, folder, stop, said.append, stage.start, stage.clock)
    for _ in session.run():
        pass
    assert stage.alive == 0
    return session, Judgement(session).results(), said


def of(results: Results, label: str, parameter: str = "all") -> MethodRecord:
    return next(r for r in results.methods if (r.method.label, r.parameter) == (label, parameter))


def test_cost_error_slope_and_efficiency_are_those_of_the_methods(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4, 0.5), case_reslrb_stack=Pretence(0.1, 0.6),
                  case_reslrb_event=Pretence(0.05, 1.2))  # fmt: skip
    _, results, _ = play(tmp_path, stage, plan())
    for label, step_s, noise in (("ptracer", 0.4, 0.5), ("reslrb:stack", 0.1, 0.6), ("reslrb:event", 0.05, 1.2)):
        record = of(results, label)
        assert (record.status, record.biased, record.cold_s) == (BenchStatus.OK, False, 1.0)
        assert record.step_s == pytest.approx(step_s)
        assert record.relative_rmse == pytest.approx(noise, rel=0.1)
        assert record.efficiency.low < 1 / (noise**2 * step_s) < record.efficiency.high
        assert abs(record.slope.value + 0.5) < record.slope.high - record.slope.low < 0.2
        assert abs(record.bias_z) < record.bias_z_limit
        seconds = record.seconds_to["0.1"]
        assert seconds == pytest.approx(step_s * noise**2 / 0.01, rel=0.25)
        assert record.extrapolated == [name for name in ("0.1", "0.03", "0.01") if
                                       record.seconds_to[name] > record.repeats * step_s or float(name) < record.reference_rmse]  # fmt: skip # noqa: E501
    assert closing_sentence(results.methods).startswith("Best for this scene: reslrb:stack; ")


def test_steps_go_on_from_those_that_compiled_and_no_two_share_seeds(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4))
    session, _, _ = play(tmp_path, stage, plan(rounds=4))
    names = ["case ptracer", "case reslrb:stack", "case reslrb:event", "reference reslrb:stack"]
    assert list(dict.fromkeys(question["of"] for question in stage.asked if question["of"])) == names
    for member in session.members:
        assert member.taken == 2 + 4 * member.count  # one cold, one without a new kernel, then turns
    for method in stage.methods.values():
        assert method.steps == list(range(len(method.steps)))
    purposes = {player.first["purpose"] for player in ()}  # the names, by which seeds differ, are the players' own
    assert purposes == set()
    assert stage.purposes == [f"convergence, {name}" for name in names]


def test_turns_are_interleaved_and_about_as_long(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4), case_reslrb_stack=Pretence(0.1), case_reslrb_event=Pretence(0.01))
    session, _, _ = play(tmp_path, stage, plan(rounds=None, budget_s=20.0))
    names = ["case ptracer", "case reslrb:stack", "case reslrb:event", "reference reslrb:stack"]
    turns = [names[(r + k) % 4] for r in range(session.rounds) for k in range(4)]
    assert stage.turns == names + turns
    assert [m.count for m in session.of(Role.CASE)] == [2, 4, MOST_STEPS]
    together = 2 * 0.4 + 4 * 0.1 + MOST_STEPS * 0.01
    assert session.of(Role.REFERENCE)[0].count == min(round(together / 2 / 0.1), MOST_REFERENCE_STEPS)


def test_what_others_did_to_the_caches_costs_nothing(tmp_path: Path) -> None:
    _, results, _ = play(tmp_path, Stage(case_ptracer=Pretence(0.1, late_s=0.3)), plan(rounds=4))
    assert of(results, "ptracer").step_s == pytest.approx(0.1)


def test_a_number_of_rounds_makes_the_steps_the_same_everywhere(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4), independent_prb=Pretence(0.1))
    stage.facts["independent"] = {"a": "prb", "b": "prb"}
    session, _, _ = play(tmp_path, stage, plan(rounds=3))
    assert [(m.role, m.count, len(m.rows)) for m in session.members] == [
        (Role.CASE, 2, 6), (Role.CASE, 2, 6), (Role.CASE, 2, 6), (Role.REFERENCE, 8, 24), (Role.INDEPENDENT, 4, 12)
    ]  # fmt: skip


def test_a_planted_bias_of_three_percent_is_reported(tmp_path: Path) -> None:
    slow = {name: Pretence(0.2, 0.1) for name in ("case_ptracer", "case_reslrb_stack", "reference_reslrb_stack")}
    stage = Stage(case_reslrb_event=Pretence(0.05, 0.1, bias=0.03), **slow)
    _, results, _ = play(tmp_path, stage, plan())
    sound, biased = of(results, "reslrb:stack"), of(results, "reslrb:event")
    assert [r.biased for r in (sound, biased, of(results, "ptracer"))] == [False, True, False]
    assert biased.bias == pytest.approx(0.03, rel=0.2)
    assert biased.bias_z > biased.bias_z_limit
    assert (biased.bias_reference, biased.independent) == ("ptracer", True)
    # Squared bias counts as variance does, and keeps the error from 1 %; without it this would be the most efficient.
    assert biased.efficiency.low < 1 / (0.05 * (0.1**2 + 0.03**2)) < biased.efficiency.high
    assert biased.efficiency.value > 2 * sound.efficiency.value
    assert (biased.seconds_to["0.01"], sound.seconds_to["0.01"] is not None) == (None, True)
    sentence = closing_sentence(results.methods)
    assert sentence.startswith(("Best for this scene: ptracer", "Best for this scene: reslrb:stack"))
    assert "The biased reslrb:event has" in sentence
    assert "but its error stays above 0.032." in sentence
    assert any(note.startswith("reslrb:event, all: biased by 0.032 of the whole") for note in notes(results.methods))


def test_what_errors_are_taken_from_is_judged_too(tmp_path: Path) -> None:
    """With a biased one, errors of unbiased methods are wrong: said, and they are not called biased."""
    stage = Stage(reference_reslrb_stack=Pretence(0.1, 0.1, bias=0.1), case_reslrb_stack=Pretence(0.1, 0.1),
                  case_ptracer=Pretence(0.1, 0.1), case_reslrb_event=Pretence(0.1, 0.1, bias=0.1))  # fmt: skip
    _, results, _ = play(tmp_path, stage, plan())
    reference = next(r for r in results.references if r.parameter == "a")
    assert (reference.biased, reference.bias_reference) == (True, "ptracer")
    assert of(results, "reslrb:stack").biased is False
    event = of(results, "reslrb:event", "a")
    assert event.biased is True
    assert event.bias == pytest.approx(0.1, rel=0.2)  # against ptracer, not against what is as wrong


def test_ptracer_among_the_methods_stands_for_itself(tmp_path: Path) -> None:
    session, results, _ = play(tmp_path, Stage(), plan(rounds=8))
    assert not session.of(Role.INDEPENDENT)  # no roulette at this depth: the same integrator
    assert of(results, "ptracer").bias_reference == "reslrb:stack"
    assert of(results, "reslrb:event").bias_reference == "ptracer"


@pytest.mark.parametrize("cases", ["reslrb:stack", "ptracer,reslrb:stack"])
def test_else_an_independent_reference_takes_turns_of_its_own(tmp_path: Path, cases: str) -> None:
    stage = Stage(independent_ptracer=Pretence(0.01))
    roulette = loads(CONFIG, Path("x.yaml"), ["integrator.rr_depth=3"])
    session, results, _ = play(tmp_path, stage, plan(cases, rounds=8, config=roulette))
    [judge] = session.of(Role.INDEPENDENT)
    assert judge.config.integrator.options()["rr_depth"] == 1_000_000
    assert of(results, "reslrb:stack").bias_reference == "ptracer"


def test_where_there_is_no_independent_reference_that_is_said(tmp_path: Path) -> None:
    facts = {"independent": {"a": "ptracer", "b": None}, "why": {"a": "", "b": "not ptracer: it differs"}}
    stage = Stage(facts, case_reslrb_event=Pretence(0.1, 0.1, bias=0.1), reference_reslrb_stack=Pretence(noise=0.1))
    _, results, said = play(tmp_path, stage, plan())
    assert "b: no independent reference (not ptracer: it differs); biases are judged by reslrb:stack" in said
    event = of(results, "reslrb:event", "b")
    assert (event.biased, event.bias_reference, event.independent) == (True, "reslrb:stack", False)
    assert of(results, "reslrb:event", "a").independent is True
    reference = next(r for r in results.references if r.parameter == "b")
    assert (reference.biased, reference.bias_z, reference.message) == (None, None, "there is no independent reference")


def test_the_noise_of_one_image_is_no_bias(tmp_path: Path) -> None:
    """With the configuration's loss dL/dI is held at several images; their noise is in the reference's error."""
    quiet = Pretence(0.1, 0.02, image_noise=0.1)
    stage = Stage(reference_reslrb_stack=quiet, independent_ptracer=Pretence(0.1, 0.02, image_noise=0.1),
                  case_reslrb_stack_adjoint_batched_=Pretence(0.1, 0.05),
                  case_reslrb_stack_adjoint_correlated_=Pretence(0.1, 0.05, bias=0.5))  # fmt: skip
    cases = "reslrb:stack(adjoint=batched),reslrb:stack(adjoint=correlated)"
    session, results, _ = play(tmp_path, stage, plan(cases, objective="loss", rounds=32))
    assert [m.method.adjoint for m in session.members] == ["batched", "correlated", None, None]
    assert [r.biased for r in results.methods if r.parameter == "all"] == [False, True]
    reference = next(r for r in results.references if r.parameter == "all")
    assert reference.reference_rmse == pytest.approx(0.1 / np.sqrt(8), rel=0.3)
    assert of(results, "reslrb:stack(adjoint=batched)").method.estimator == "stack"


def test_a_sweep_of_samples(tmp_path: Path) -> None:
    """Each number of samples is a method of its own; the reference has those of the configuration."""
    four, sixteen = Pretence(0.1, 1.0), Pretence(0.3, 0.5)
    stage = Stage(case_reslrb_stack__4_spp=four, case_reslrb_stack__16_spp=sixteen)
    session, results, _ = play(tmp_path, stage, plan("reslrb:stack", spps=(4, 16)))
    assert [(m.label, m.spp, m.config.run.spp) for m in session.members] == [
        ("reslrb:stack, 4 spp", 4, 4), ("reslrb:stack, 16 spp", 16, 16), ("reslrb:stack", 4, 4), ("ptracer", 4, 4)
    ]  # fmt: skip
    assert of(results, "reslrb:stack, 16 spp").relative_rmse == pytest.approx(0.5, rel=0.1)
    assert of(results, "reslrb:stack, 16 spp").method.spp == 16
    assert closing_sentence(results.methods).startswith("Best for this scene: reslrb:stack, 16 spp; 1.3 [")
    spps = {question["of"]: question["spp"] for question in stage.asked if question["of"]}
    assert spps["case reslrb:stack, 16 spp"] == 16


def test_a_method_that_ends_or_breaks_is_recorded_and_the_rest_goes_on(tmp_path: Path) -> None:
    stage = Stage(case_reslrb_stack=Pretence(ends=5), case_reslrb_event=Pretence(nan_at=20))
    _, results, said = play(tmp_path, stage, plan())
    ended, broken, sound = (of(results, label) for label in ("reslrb:stack", "reslrb:event", "ptracer"))
    assert (ended.status, ended.efficiency, ended.seconds_to["0.1"]) == (BenchStatus.OUT_OF_MEMORY, None, None)
    assert "not finite" in broken.message
    assert broken.relative_rmse is None
    assert sound.biased is False
    assert closing_sentence(results.methods) == "Best for this scene: ptracer, the only one that was measured."
    assert "reslrb:stack, all: ended by SIGKILL" in notes(results.methods)
    assert said[0] == "old"  # what every process warns of is said once
    assert said.count("old") == 1


def test_an_end_while_it_compiles_is_said(tmp_path: Path) -> None:
    stage = Stage(case_reslrb_stack=Pretence(ends=1))
    _, results, said = play(tmp_path, stage, plan())
    assert "reslrb:stack: out_of_memory: ended by SIGKILL" in said
    assert of(results, "reslrb:stack").status is BenchStatus.OUT_OF_MEMORY


def test_without_what_errors_are_taken_from_there_are_none(tmp_path: Path) -> None:
    _, results, said = play(tmp_path, Stage(reference_reslrb_stack=Pretence(ends=1)), plan())
    assert "reslrb:stack: out_of_memory: ended by SIGKILL" in said
    assert {record.relative_rmse for record in results.methods} == {None}
    assert results.points == results.references == []
    assert "Nothing can be said" in closing_sentence(results.methods)


def test_an_independent_reference_that_ends_is_replaced(tmp_path: Path) -> None:
    stage = Stage(independent_ptracer=Pretence(ends=1))
    _, results, _ = play(tmp_path, stage, plan("reslrb:event"))
    assert of(results, "reslrb:event").bias_reference == "reslrb:stack"
    assert of(results, "reslrb:event").independent is False


@pytest.mark.parametrize("default", [True, False])
def test_only_what_nobody_named_is_left_out(tmp_path: Path, default: bool) -> None:
    stage = Stage({"without": {"ptracer": "it emits wrongly"}})
    session, _, said = play(tmp_path, stage, plan(default=default, rounds=4))
    assert ("left out: ptracer: it emits wrongly" in said) is default
    assert ("ptracer" in [m.label for m in session.of(Role.CASE)]) is not default


@pytest.mark.parametrize("after", [0, 5, 12, 40, 120])
def test_a_stop_keeps_what_is_done(tmp_path: Path, after: int) -> None:
    answers = iter(range(10**6))
    stage = Stage(case_ptracer=Pretence(0.4))
    session, results, _ = play(tmp_path, stage, plan(), stop=lambda: next(answers) > after)
    for member in session.members:
        assert len(member.rows) == len(member.turns)
        assert len(set(member.turns)) == len(member.seconds)
    assert len(results.methods) in (0, 9)


@pytest.mark.parametrize(
    ("budget_s", "measured"), [(60.0, True), (14.0, False), (11.0, False), (6.0, False), (2.0, False)]
)
def test_the_budget_covers_compilation_and_one_too_small_says_what_it_would_take(
    tmp_path: Path, budget_s: float, measured: bool
) -> None:
    stage = Stage(case_ptracer=Pretence(0.4, cold_s=2.0))
    _, results, said = play(tmp_path, stage, plan(rounds=None, budget_s=budget_s))
    assert stage.now <= max(budget_s, 1.0)
    assert any(record.relative_rmse is not None for record in results.methods) is measured
    assert any("budget" in line for line in said) is not measured
    advice = [line for line in said if "allow about" in line]
    if advice:
        enough = float(advice[-1].split("allow about ")[1].split(" s")[0])
        again = Stage(case_ptracer=Pretence(0.4, cold_s=2.0))
        _, results, _ = play(tmp_path, again, plan(rounds=None, budget_s=1.05 * enough))
        assert any(record.relative_rmse is not None for record in results.methods)
        assert enough > budget_s


def test_no_budget_is_overrun(tmp_path: Path) -> None:
    """Steps of seconds: a round would take longer than what some of these leave after compiling."""
    for budget_s in range(8, 60, 4):
        stage = Stage(case_ptracer=Pretence(3.0, cold_s=3.0))
        play(tmp_path, stage, plan(rounds=None, budget_s=float(budget_s)))
        assert stage.now <= budget_s


def test_the_budget_is_kept_and_used(tmp_path: Path) -> None:
    stage = Stage(case_ptracer=Pretence(0.4, cold_s=2.0))
    play(tmp_path, stage, plan(rounds=None, budget_s=100.0))
    assert 88 < stage.now < 100


def test_lines_of_json(tmp_path: Path) -> None:
    _, results, _ = play(tmp_path, Stage(case_reslrb_event=Pretence(bias=0.4)), plan())
    common = ["kind", "label", "integrator", "estimator", "capacity", "adjoint", "spp", "parameter"]
    point = json.loads(results.points[0].to_json())
    assert list(point) == [*common, "steps", "elapsed_s", "relative_rmse", "reference_rmse", "repeats"]
    assert (point["kind"], point["spp"], point["parameter"], point["adjoint"]) == ("point", 4, "a", None)
    method = json.loads(of(results, "reslrb:event").to_json())
    assert method["kind"] == "method"
    assert list(method)[:8] == common
    assert set(method["slope"]) == set(method["efficiency"]) == {"value", "low", "high"}
    assert list(method["seconds_to"]) == ["0.1", "0.03", "0.01"]
    assert method["seconds_to"] == {"0.1": None, "0.03": None, "0.01": None}  # none can be reached
    assert method["bias_z"] > 0
    assert [json.loads(r.to_json())["kind"] for r in results.references] == ["reference"] * 3
    assert {r.parameter for r in results.methods} == {*SHAPES, "all"}


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("reslrb:stack(max_depth=3)", "all share one max_depth; take --set integrator.max_depth=3"),
        ("reslrb:stack(adjoint=batched)", "has no effect where dL/dI is known; change --objective"),
        ("reslrb:auto", "`auto` measures which to take"),
        ("path", "integrator.type: must be one of"),
    ],
)
def test_wrong_lists_are_located(text: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plan(text).check()
    assert str(caught.value).startswith("--integrators")
    assert line in str(caught.value)
