"""Sentence about a run: its course, the next step, and the conditions for a good run."""

from __future__ import annotations

from typing import Any

import pytest

from reslrb_cli.report.run_summary import Outcome, outcome_of

FELL = {"change": "fell", "late": "flat"}


def results(*verdicts: str, trend: dict[str, Any] = FELL, **other: Any) -> dict[str, Any]:
    parameters = {f"p{place}": {"verdict": verdict} for place, verdict in enumerate(verdicts)}
    return {"iterations": 100, "loss_trend": trend, "certainty": {"parameters": parameters, "iterations": 100}} | other


def outcome(found: dict[str, Any], **manifest: Any) -> Outcome:
    return outcome_of({"status": "finished", "config": "a room.yaml"} | manifest, found, "runs/room")


def test_only_a_falling_loss_and_settled_parameters_are_good() -> None:
    assert outcome(results("settled", "settled")) == Outcome(
        "good", "The loss fell, and all 2 parameters are settled.", "Write the recovered scene:",
        "reslrb export runs/room -o recovered",
    )  # fmt: skip
    assert outcome(results("settled", "settled", worse=["p0"])).grade == "open"
    for verdict in ("still moving", "not determined", "at its bound", "derivative incomplete", "below the noise"):
        found = outcome(results("settled", verdict))
        assert found.grade == "open"
        assert found.sentence == f"The loss fell, and 1 of 2 parameters settled. p1: {verdict}."


@pytest.mark.parametrize("change", ["rose", "flat"])
def test_a_loss_that_did_not_fall_is_not_good(change: str) -> None:
    found = outcome(results("settled", trend={"change": change}))
    assert found == Outcome("open", "The loss did not fall, so the values are no better than at the start.")
    better = {"image_loss": {"initial": 1.0, "final": 0.5}}  # saved images have less noise
    assert outcome(results("settled", trend={"change": change}, **better)).grade == "good"


def test_the_remedy_is_a_command() -> None:
    found = results("settled", "still moving")
    found["certainty"]["parameters"]["p1"] |= {"moved": 1.0, "rate": 0.01, "reach": 100.0, "to_go": [2.0]}
    found["loss_trend"] = {"change": "fell", "late": "fell"}
    told = outcome(found)
    assert told.proposal == "Try more iterations:"
    assert told.command == "reslrb optimize --resume runs/room --set run.iterations=300"


def test_a_remedy_that_needs_a_new_run_starts_from_the_configuration() -> None:
    found = results("still moving", trend={"change": "rose"})
    found["certainty"] |= {"learning_rate": 0.03}
    found["certainty"]["parameters"]["p0"] |= {"moved": 1.0, "rate": 0.03}
    told = outcome(found)
    assert told.proposal == "Try a lower rate:"
    assert told.command == "reslrb optimize 'a room.yaml' --set optimizer.learning_rate=0.01"


def test_a_run_that_did_not_measure_certainty() -> None:
    found = {"iterations": 50, "loss_trend": {"change": "fell", "late": "fell"},
             "image_loss": {"initial": 2.0, "final": 0.5}}  # fmt: skip
    assert outcome(found) == Outcome(
        "open", "The loss fell from 2 to 0.5, and was still falling at the end.", "Continue the run:",
        "reslrb optimize --resume runs/room --set run.iterations=100",
    )  # fmt: skip
    assert outcome(found | {"loss_trend": FELL}).grade == "open"
    assert outcome({"iterations": 3}).sentence == "The run finished after 3 iterations, too few to judge its result."


def test_runs_that_ended_early() -> None:
    failed = outcome({"iterations": 3}, status="failed")
    assert (failed.grade, failed.sentence) == ("failed", "The run failed after 3 iterations.")
    assert failed.command == "reslrb optimize --resume runs/room"
    assert outcome({}, status="failed").command == ""
    assert outcome({"iterations": 1}, status="interrupted").sentence == "The run was interrupted after 1 iteration."
    assert outcome({}, status="running") == Outcome("open", "The run is in progress.")
