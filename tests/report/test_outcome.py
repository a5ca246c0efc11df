"""Sentence about a run: its course, the next step, and the conditions for a good run."""

from __future__ import annotations

import re
from typing import Any

import pytest

from reslrb_cli.report.run_summary import (
    ORDER,
    Outcome,
    advice,
    certainty_lines,
    find_remedy,
    outcome_of,
    verdict_words,
    verdicts_of,
    warnings,
)

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


def test_a_design_is_good_if_its_loss_fell() -> None:
    """A lens has no true values. Its page therefore does not miss their certainty."""
    fell: dict[str, Any] = {"iterations": 100, "loss_trend": FELL, "is_design": True}
    good = outcome(fell)
    assert (good.grade, good.command) == ("good", "reslrb export runs/room -o solid")
    assert "certainty" not in good.sentence
    assert outcome(fell | {"is_design": False}).grade == "open"
    assert outcome(fell | {"loss_trend": {"change": "rose"}}).grade == "open"
    falling = outcome(fell | {"loss_trend": FELL | {"late": "fell"}})
    assert falling.grade == "good"
    assert "--resume" in falling.command


NOTHING = "so nothing shows that the values are better than at the start"


@pytest.mark.parametrize(("change", "words"), [("rose", "rose"), ("flat", "did not fall")])
def test_a_loss_that_did_not_fall_is_not_good(change: str, words: str) -> None:
    found = outcome(results("settled", trend={"change": change}))
    assert found == Outcome("open", f"The loss {words}, {NOTHING}, though 1 of 1 parameter settled.")
    found = outcome(results("not seen", trend={"change": change}))
    assert found == Outcome("open", f"The loss {words}, {NOTHING}.")
    better = {"image_loss": {"initial": 1.0, "final": 0.5}}  # saved images have less noise
    assert outcome(results("settled", trend={"change": change}, **better)).grade == "good"


def errors(start: float, end: float, relative: bool) -> dict[str, Any]:
    """Return results with errors of two parameters, whose units may differ."""
    pairs = {key: {"initial": start, "final": end} for key in ("p0", "p1")}
    total = {"initial": None, "final": None} if relative else {"initial": start, "final": end}
    return {"rmse": total, "parameter_rmse": pairs, "relative_error": pairs}


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("verdict", ["settled", "below the noise"])
@pytest.mark.parametrize(("start", "end", "change"), [(0.057, 0.0034, "fell"), (0.1, 0.3, "rose"),
                                                      (0.1, 0.098, "hardly fell")])  # fmt: skip
@pytest.mark.parametrize("loss", ["fell", "rose", "flat"])
def test_known_errors_decide_and_the_sentence_agrees_with_the_table(
    loss: str, start: float, end: float, change: str, verdict: str, relative: bool
) -> None:
    """Noise of the target can hide a fall of the loss, and a loss can fall though the values become worse."""
    found = outcome(results(verdict, verdict, trend={"change": loss}, **errors(start, end, relative)))
    assert (found.grade == "good") == (change == "fell" and verdict == "settled")
    if (loss, change) == ("fell", "fell"):
        assert "error" not in found.sentence
    else:
        said = {"fell": "The loss fell", "rose": "The loss rose", "flat": "The loss did not fall"}[loss]
        joined = "and" if (loss == "fell") == (change == "fell") else "but"
        words = f"{said}, {joined} the error of the parameters {change} ({start:g} to {end:g})"
        assert found.sentence.startswith(words)
    assert "no better" not in found.sentence
    assert ("settled" in found.sentence) == (verdict == "settled" or change == "fell")


def test_a_run_without_a_remedy_has_no_command() -> None:
    found = outcome(results("settled", "settled", worse=["p0"], **errors(0.2, 0.1, False)))
    assert found.sentence == (
        "The loss fell, and 2 of 2 parameters settled. p0 is farther from its true value than at the start."
    )
    assert found.command == ""


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
    assert told.command == "reslrb optimize runs/room/config.yaml --set optimizer.learning_rate=0.01"
    allowed = outcome(found, command_line=["reslrb", "optimize", "a room.yaml", "--allow-code", "--set", "run.spp=4"])
    assert allowed.command == ("reslrb optimize runs/room/config.yaml --allow-code --set optimizer.learning_rate=0.01")


def many_remedies() -> dict[str, Any]:
    """Return results in which several parameters, the target and the length of the run have proposals."""
    found = results(*["still moving"] * 3, "below the noise", "effect lost", trend=FLAT)
    found |= {"iterations": 10, "samples": {"step": 16, "target": 32}}
    found["certainty"] |= {"learning_rate": 0.03, "target_spp": 32, "iterations": 10}
    moved = [{"moved": 1.0, "rate": 0.03, "reach": 100.0, "to_go": [2.0]}, {"moved": 1.0, "rate": 0.03, "reach": 100.0,
             "to_go": [3.0]}, {"moved": 3.0, "rate": 0.03, "reach": 3.0, "to_go": [7.0]},
             {"spread": [3.0], "of_target": [2.9]}, {}]  # fmt: skip
    for about, more in zip(found["certainty"]["parameters"].values(), moved, strict=True):
        about |= more
    return found


FLAT = {"change": "flat", "late": "unclear", "start": {"mean": 1.0, "error": 0.1}, "end": {"mean": 1.0, "error": 0.1}}


@pytest.mark.parametrize("left_out", range(6))
def test_a_page_has_one_proposal(left_out: int) -> None:
    """All texts of a page give the same setting, the most important one. Without it, they give the next one."""
    found = many_remedies()
    for number in [4, 2, 1, 0, 3][:left_out]:
        del found["certainty"]["parameters"][f"p{number}"]
    best = advice(found)
    expected = ["its own bounds", "learning_rate=0.2", "run.iterations=40", "run.iterations=30",
                "target.render.spp=512", "target.render.spp=256"][left_out]  # fmt: skip
    assert best is not None
    assert expected in best.setting
    texts = [outcome(found).command, *warnings(found)]
    settings = {
        word for text in texts for word in re.findall(r"[\w.]+=[\w.]+", text) if not text.startswith("the loss")
    }
    assert settings == ({best.setting.removeprefix("--set ")} if "=" in best.setting else set())
    own = {verdicts_of(found)[key] for key in verdicts_of(found)
           if (remedy := find_remedy(found, key)) is not None and remedy.words == best.words}  # fmt: skip
    for line in certainty_lines(found):
        assert (best.setting in line) == any(verdict in line for verdict in own)
    table = " ".join(verdict_words(found, key) for key in verdicts_of(found))
    assert [words for words in ORDER if f": {words}" in table] in ([best.words], [])


def test_a_run_that_did_not_measure_certainty() -> None:
    found = {"iterations": 50, "loss_trend": {"change": "fell", "late": "fell"},
             "image_loss": {"initial": 2.0, "final": 0.5}}  # fmt: skip
    assert outcome(found) == Outcome(
        "open", "The loss fell from 2 to 0.5, and was still falling at the end. The certainty of the values was not "
        "measured.", "Try more iterations:", "reslrb optimize --resume runs/room --set run.iterations=100",
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
