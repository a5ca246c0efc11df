"""Outcome of a run in one sentence, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reslrb_cli.records.manifest import Status
from reslrb_cli.report.format import count, number, shorten
from reslrb_cli.report.run_summary import (
    IMPROVED,
    KEY_WIDTH,
    LEAST_JUDGED,
    ORDER,
    SETTLED,
    Remedy,
    find_remedy,
    image_ratio,
    verdicts_of,
)

#: A remedy for which a run continues; the others need a new run.
LONGER = "more iterations"


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run.

    - `grade`: "good" if the run finished and all its values are reliable, "failed" if it failed, otherwise "open".
    - `sentence`: how the run went.
    - `proposal`: what to do next. The text may be empty.
    - `command`: command for the proposal. The text may be empty.
    """

    grade: str
    sentence: str
    proposal: str = ""
    command: str = ""


def outcome_of(manifest: Mapping[str, Any], results: Mapping[str, Any], folder: str) -> Outcome:
    """Return the outcome of a run in `folder`, from its manifest and the results in it."""
    resume = ["reslrb", "optimize", "--resume", folder]
    done, status = results.get("iterations") or 0, manifest.get("status")
    if status == Status.RUNNING:
        return Outcome("open", "The run is in progress.")
    if status in (Status.FAILED, Status.INTERRUPTED):
        grade, what = ("failed", "failed") if status == Status.FAILED else ("open", "was interrupted")
        sentence = f"The run {what} after {count(done, 'iteration')}."
        if not done:
            return Outcome(grade, sentence)
        proposal = "Continue it" + (", after you have corrected the error:" if grade == "failed" else ":")
        return Outcome(grade, sentence, proposal, shlex.join(resume))
    fell = _loss_fell(results)
    if fell is None:
        few = ", too few to judge its result" if done < LEAST_JUDGED else ""
        return Outcome("open", f"The run finished after {count(done, 'iteration')}{few}.")
    if not fell:
        return _with_remedy(
            "The loss did not fall, so the values are no better than at the start.", manifest, results, resume
        )
    verdicts = verdicts_of(results)
    if not verdicts:
        return _without_verdicts(results, resume)
    open_keys = [key for key, verdict in verdicts.items() if verdict != SETTLED]
    worse = bool(results.get("worse"))
    if not open_keys and not worse:
        all_of = "its parameter is" if len(verdicts) == 1 else f"all {len(verdicts)} parameters are"
        export = shlex.join(["reslrb", "export", folder, "-o", "recovered"])
        return Outcome("good", f"The loss fell, and {all_of} settled.", "Write the recovered scene:", export)
    settled = len(verdicts) - len(open_keys)
    sentence = f"The loss fell, and {settled} of {count(len(verdicts), 'parameter')} settled."
    if open_keys:
        sentence += f" {shorten(open_keys[0], KEY_WIDTH)}: {verdicts[open_keys[0]]}."
    if len(open_keys) > 1:
        sentence += f" The table shows {count(len(open_keys) - 1, 'more parameter')} that did not settle."
    return _with_remedy(sentence, manifest, results, resume)


def _loss_fell(results: Mapping[str, Any]) -> bool | None:
    """Whether the loss fell, according to its trend or the saved images. None if neither is known."""
    change, ratio = (results.get("loss_trend") or {}).get("change"), image_ratio(results)
    if change is None and ratio is None:
        return None
    return change == "fell" or (ratio is not None and ratio < IMPROVED)


def _without_verdicts(results: Mapping[str, Any], resume: list[str]) -> Outcome:
    """Return the outcome of a run that did not measure how certain its values are."""
    losses, late = results.get("image_loss") or {}, (results.get("loss_trend") or {}).get("late")
    pair = f" from {number(losses['initial'], 3)} to {number(losses['final'], 3)}" if len(losses) == 2 else ""
    if late == "fell":
        longer = ["--set", f"run.iterations={2 * (results.get('iterations') or 0)}"]
        return Outcome(
            "open", f"The loss fell{pair}, and was still falling at the end.", "Continue the run:",
            shlex.join([*resume, *longer]),
        )  # fmt: skip
    return Outcome("open", f"The loss fell{pair}. The certainty of the values was not measured.")


def _with_remedy(sentence: str, manifest: Mapping[str, Any], results: Mapping[str, Any], resume: list[str]) -> Outcome:
    """Return an open outcome with the most important proposal among all parameters."""
    found = (find_remedy(results, key) for key in verdicts_of(results))
    remedies: list[Remedy] = [remedy for remedy in found if remedy is not None]
    if not remedies:
        return Outcome("open", sentence)
    remedy = min(remedies, key=lambda each: ORDER.index(each.words))
    if not remedy.setting.startswith("--set "):
        return Outcome("open", sentence, f"Try {remedy.words}, with this in the configuration:", remedy.setting)
    command = resume if remedy.words == LONGER else ["reslrb", "optimize", str(manifest.get("config"))]
    return Outcome("open", sentence, f"Try {remedy.words}:", f"{shlex.join(command)} {remedy.setting}")
