"""What `convergence` makes of methods whose cost, noise and bias are known: with processes that only pretend."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from measure.pretended_steps import SHAPES, Pretence, Stage, of, plan, play

from reslrb_cli.measure.convergence.judgement import HEAVY, Judgement
from reslrb_cli.measure.convergence.setup import Role
from reslrb_cli.records.measurements import BenchStatus
from reslrb_cli.report.convergence_tables import closing_sentence, notes


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


def test_noise_whose_tails_are_too_heavy_for_intervals_is_reported(tmp_path: Path) -> None:
    """One step in 64 that is a hundred times as noisy as the others: it has all of the variance.

    A sample without it has a hundredth of the error, and an interval that says nothing of it.
    """
    heavy = Pretence(0.1, 0.1, outliers=(30,))
    session, results, _ = play(tmp_path, Stage(case_reslrb_stack=heavy, case_reslrb_event=Pretence(0.1, 0.1)), plan())
    for key in (*SHAPES, "all"):
        flagged, sound = of(results, "reslrb:stack", key), of(results, "reslrb:event", key)
        assert "carry the variance" in flagged.message, key
        assert flagged.biased is None  # its z scores prove nothing either
        assert (sound.message, sound.biased) == ("", False)
    [member] = [member for member in session.of(Role.CASE) if member.label == "reslrb:stack"]
    assert Judgement(session).overall(member).message == HEAVY  # also in the lines that come while it goes on
    lucky = play(tmp_path, Stage(case_reslrb_stack=Pretence(0.1, 0.1)), plan())[1]
    assert of(lucky, "reslrb:stack").efficiency.low > 10 * of(results, "reslrb:stack").efficiency.value
    assert any(note.startswith("reslrb:stack, all: single") for note in notes(results.methods))
    assert closing_sentence(results.methods).startswith("Best for this scene: reslrb:event")


def test_tails_that_are_no_worse_than_usual_are_not_reported(tmp_path: Path) -> None:
    """Every fourth step ten times as noisy: many steps carry the variance, and intervals hold."""
    stage = Stage(case_reslrb_stack=Pretence(0.1, 0.05, outliers=tuple(range(0, 200, 4)), outlier=10.0))
    _, results, _ = play(tmp_path, stage, plan())
    record = of(results, "reslrb:stack")
    assert (record.message, record.biased) == ("", False)
    truth = 1 / (0.1 * 0.05**2 * (3 + 10**2) / 4)
    assert record.efficiency.low < truth < record.efficiency.high


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
