"""How a run ended, in a line: its loss, its errors, and what did not work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from reslrb_cli.report.certainty import certainty_lines
from reslrb_cli.report.words import count, number, shorten, with_error

#: Parameters that got worse, named one by one.
MOST_NAMED = 3
#: What of its loss an image that came closer has left, at most.
IMPROVED = 0.9
#: In a run that is too short to know the noise of its loss, by how much that of the saved images has to rise; and a
#: target that has fewer samples than so many steps is noisy itself.
ROSE_IF_SHORT, FEW_STEPS = 1.1, 16
#: In a run of fewer iterations losses tell nothing.
LEAST_JUDGED = 20
#: A key in a line of text has at most so many characters.
KEY_WIDTH = 60


def last_line(status: str, results: Mapping[str, Any], tallies: Sequence[str], report: str) -> str:
    """What the terminal says last: how the run ended, what it came to, what went wrong, and where its page is.

    `results` is the manifest's.
    """
    parts = [f"{status} after {count(results['iterations'], 'iteration')}"]
    parts += [] if results["loss"] is None else [f"loss {number(results['loss'])}"]
    parts += [line for line in (error_line(results), *tallies) if line]
    return "; ".join([", ".join(parts), *warnings(results), f"look at {report}"])


def error_line(results: Mapping[str, Any]) -> str | None:
    """The error of all parameters at start and end; where their units differ, that of the worst, as a share of it.

    `results` is what `Results.to_json` made. None where no true value is known.
    """
    total = results.get("rmse") or {}
    if total.get("final") is not None:
        return f"parameter RMSE {_from_to(total)}"
    key = worst(results)
    if key is None:
        return None
    return f"relative error {_from_to(results['relative_error'][key])} at worst ({shorten(key, KEY_WIDTH)})"


def worst(results: Mapping[str, Any]) -> str | None:
    """The key with the largest relative error at the end."""
    errors = {key: pair.get("final") for key, pair in (results.get("relative_error") or {}).items()}
    known = {key: error for key, error in errors.items() if error is not None}
    return max(known, key=lambda key: known[key]) if known else None


def warnings(results: Mapping[str, Any], sign: str = "+-") -> list[str]:
    """What went wrong in a run that did not fail, plainly: a loss that did not fall, errors that rose, and values that
    cannot be relied on."""
    lines = []
    trend = results.get("loss_trend") or {}
    if trend.get("change") in ("rose", "flat") and not _image_improved(results):
        start, end = (with_error(trend[at]["mean"], trend[at]["error"], sign) for at in ("start", "end"))
        less = trend["end"]["mean"] < trend["start"]["mean"]
        flat = "fell by no more than its noise" if less else "did not fall"
        lines.append(
            f"the loss {'rose' if trend['change'] == 'rose' else flat} ({start} at the start, {end} at the end)"
        )
    if not trend and _image_rose(results):
        start, end = (number(results["image_loss"][at], 3) for at in ("initial", "final"))
        lines.append(f"the images got farther from their targets (loss {start} to {end})")
    worse = [key for key in results.get("worse") or () if key in results["parameter_rmse"]]
    worse.sort(key=lambda key: -_growth(results["parameter_rmse"][key]))
    for key in worse[:MOST_NAMED]:
        lines.append(f"{shorten(key, KEY_WIDTH)} got worse (RMSE {_from_to(results['parameter_rmse'][key])})")
    if len(worse) > MOST_NAMED:
        lines.append(f"and so did {count(len(worse) - MOST_NAMED, 'more parameter')}")
    if lines:
        lines += _reasons(results)
    return [*lines, *certainty_lines(results)]


def _reasons(results: Mapping[str, Any]) -> list[str]:
    """What may have kept a run from getting better, as far as its settings tell."""
    samples, found = results.get("samples") or {}, []
    step, target = samples.get("step"), samples.get("target")
    if step and target and target < FEW_STEPS * step:
        found.append(
            f"the target itself has {count(target, 'sample')} per pixel only: --set target.render.spp="
            f"{max(FEW_STEPS * step, 4 * target)} makes a cleaner one"
        )
    if (results.get("iterations") or LEAST_JUDGED) < LEAST_JUDGED:
        found.append(f"{count(results.get('iterations') or 0, 'iteration')} are few: --set run.iterations=200")
    return found


def _image_rose(results: Mapping[str, Any]) -> bool:
    """Whether the saved images ended well farther from their targets than they began."""
    losses = results.get("image_loss") or {}
    initial, final = losses.get("initial"), losses.get("final")
    return initial is not None and final is not None and final > ROSE_IF_SHORT * initial


def _image_improved(results: Mapping[str, Any]) -> bool:
    """Whether the saved images, which have less noise than those of the iterations, came closer to their targets."""
    losses = results.get("image_loss") or {}
    initial, final = losses.get("initial"), losses.get("final")
    return initial is not None and final is not None and final < IMPROVED * initial


def _growth(pair: Mapping[str, float]) -> float:
    return pair["final"] / max(pair["initial"], 1e-30)


def _from_to(pair: Mapping[str, float | None]) -> str:
    start, end = number(pair.get("initial"), 3), number(pair.get("final"), 3)
    return f"{start} to {end}" if start else end
