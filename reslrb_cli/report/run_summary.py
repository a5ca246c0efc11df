"""A finished run in a few lines, for a terminal: how it ended, and its parameters.

How certain its values are is said in words, of the manifest's `results`, whose `certainty` may be missing.
"""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any, NamedTuple

from reslrb_cli.optimization.errors import ErrorMeter
from reslrb_cli.records.measurements import INCOMPLETE, incomplete_records
from reslrb_cli.records.metrics import Record
from reslrb_cli.report.format import count, line, number, shorten, with_error

#: The verdict on a value that can be relied on, as recorded; all others say what keeps it from that.
SETTLED, MOVING, UNDETERMINED = "settled", "still moving", "not determined"
NOISE, UNSEEN = "below the noise", "not seen"

#: What of a spread the target's noise makes, at least, where that is what hides a value.
OF_TARGET = 0.7

#: Where a value has gone and has to go farther than this share of what its steps allow, they are too short.
REACHED = 0.5

#: More iterations than this many times those of a run are not proposed, nor fewer.
LEAST_LONGER, MOST_LONGER = 2, 5

#: What a rate is divided by where the loss rose, and the samples of a noisy target are multiplied by.
LOWER, MORE_SAMPLES = 3, 16

#: What is proposed, that which makes the others of no use first.
ORDER = (
    "a lower rate",
    "scale: auto",
    "a higher rate",
    "a new run from here",
    "more iterations",
    "more samples for it",
)

#: Quantities of what emits, which may be of any size.
EMITTED = ("radiance", "irradiance", "intensity")

#: Parameters with one verdict that are named.
MOST_NAMED = 3

#: A key in a line of text has at most so many characters, and beside a verdict.
PARTNER_WIDTH = 40

#: The same beside a bar.
BESIDE_A_BAR = 32


def descriptions(record: Record, meter: ErrorMeter) -> list[str]:
    """The record's loss, and its parameters' error where that is known, in ever fewer words.

    Where the parameters' units differ, the error is the largest relative one.
    """
    loss = f"loss {record.loss:.4g}"
    if record.parameter_rmse is not None:
        rmse = f"RMSE {record.parameter_rmse:.4g}"
        return [f"{loss}, parameter {rmse}", f"{loss}, {rmse}", loss]
    relative = meter.relative(record.parameter_errors)
    if not relative:
        return [loss]
    key = max(relative, key=lambda key: relative[key])
    error = f"error {relative[key]:.4g}"
    return [f"{loss}, relative {error} at worst ({shorten(key, BESIDE_A_BAR)})", f"{loss}, relative {error}", loss]


def is_settled(results: Mapping[str, Any], key: str) -> bool:
    """Whether the value of a parameter can be relied on, as far as was measured."""
    return bool(_about(results, key).get("verdict") == SETTLED)


class Remedy(NamedTuple):
    """What would help, in a word or two, and the setting for it."""

    words: str
    setting: str


def verdict_words(results: Mapping[str, Any], key: str) -> str:
    """The verdict on a parameter, with the share of its entries that have it and of those that no view shows, and what
    would help; empty where nothing was measured."""
    about = _about(results, key)
    verdict, shares = about.get("verdict", ""), about.get("shares") or {}
    words = str(verdict)
    if verdict == UNDETERMINED and about.get("partner"):
        words += f": {shorten(about['partner'], PARTNER_WIDTH)} makes up for it"
    if verdict == NOISE and _is_of_target(about):
        words += " of the target"
    share = shares.get(verdict)
    words = words if share is None or share == 1 else f"{words} ({100 * share:.3g} %)"
    unseen = shares.get(UNSEEN) if verdict != UNSEEN else None
    words += f", {100 * unseen:.3g} % not seen" if unseen else ""
    remedy = find_remedy(results, key)
    return f"{words}: {remedy.words}" if remedy is not None else words


def find_remedy(results: Mapping[str, Any], key: str) -> Remedy | None:
    """What the run shows to be wrong with its steps, of a value that is still moving, or with its target, of one that
    the noise of that hides; None of any other, and where too little was recorded."""
    about, measured = _about(results, key), results.get("certainty") or {}
    if about.get("verdict") == NOISE and _is_of_target(about) and measured.get("target_spp"):
        return Remedy("more samples for it", f"--set target.render.spp={MORE_SAMPLES * measured['target_spp']}")
    moved, rate, iterations = about.get("moved"), about.get("rate"), measured.get("iterations")
    if about.get("verdict") != MOVING or moved is None or not rate or not iterations:
        return None
    if (results.get("loss_trend") or {}).get("change") == "rose":
        if incomplete_records(results.get("incomplete") or ()):
            return None
        return Remedy("a lower rate", _rate_setting(measured, rate, 1 / LOWER))
    way = moved + max((abs(value) for value in about.get("to_go") or () if value is not None), default=0.0)
    reach = about.get("reach")
    if reach and way > REACHED * reach:
        emits = (results.get("parameters") or {}).get(key, {}).get("quantity")
        if emits in EMITTED and measured.get("scale") == "none":
            return Remedy("scale: auto", "--set optimizer.scale=auto")
        return Remedy("a higher rate", _rate_setting(measured, rate, max(2 * way / reach, 2.0)))
    if (results.get("loss_trend") or {}).get("late") == "flat":  # more of the same steps gain nothing
        return Remedy("a new run from here", "initial: {run: RUN} for each parameter")
    longer = min(max(way / moved if moved else MOST_LONGER, LEAST_LONGER), MOST_LONGER)
    return Remedy("more iterations", f"--set run.iterations={int(float(f'{longer * iterations:.2g}'))}")


def spread_words(results: Mapping[str, Any], key: str, sign: str = "+-") -> str:
    """One standard deviation of each entry of a small parameter, or of a typical entry; empty where none is known."""
    spread = _about(results, key).get("spread")
    if not spread:
        return ""
    if all(value == spread[0] for value in spread):
        return f"{sign} {number(spread[0], 2)}"
    return f"{sign} " + " ".join("-" if value is None else number(value, 2) for value in spread)


def certainty_lines(results: Mapping[str, Any]) -> list[str]:
    """For each verdict but the good one a line that names the parameters that have it."""
    verdicts = {key: about.get("verdict", SETTLED) for key, about in _parameters(results).items()}
    lines = []
    for verdict in dict.fromkeys(verdict for verdict in verdicts.values() if verdict != SETTLED):
        keys = [key for key in verdicts if verdicts[key] == verdict]
        named = ", ".join(shorten(key, KEY_WIDTH) for key in keys[:MOST_NAMED])
        rest = f" and {count(len(keys) - MOST_NAMED, 'more parameter')}" if len(keys) > MOST_NAMED else ""
        remedies = [remedy for key in keys if (remedy := find_remedy(results, key)) is not None]
        of_target = " of the target" if verdict == NOISE and remedies else ""
        line = f"{'not converged, ' if verdict == MOVING else ''}{verdict}{of_target}: {named}{rest}"
        shares = [record.percent() for record in incomplete_records(results.get("incomplete") or ())
                  if record.parameter in keys and verdict == INCOMPLETE]  # fmt: skip
        line += f" ({', '.join(shares)} of it is missing)" if shares else ""
        if remedies:  # that of the steps first, if there is one: more of the wrong ones do not help
            remedy = min(remedies, key=lambda each: ORDER.index(each.words))
            line += f" ({remedy.words}: {remedy.setting})"
        lines.append(line)
    return lines


def noise_line(results: Mapping[str, Any]) -> str:
    """What a reader of spreads has to know of a target whose noise they do not have; empty where they have it."""
    measured = results.get("certainty") or {}
    if measured.get("target_noise") not in ("left out", "in part"):
        return ""
    which = "" if measured["target_noise"] == "left out" else " that are files"
    return f"spread: by the noise of the run; noise and errors of targets{which} are not in it"


def _is_of_target(about: Mapping[str, Any]) -> bool:
    """Whether the noise of the target makes most of a spread."""
    pairs = zip(about.get("of_target") or (), about.get("spread") or (), strict=False)
    return any(part is not None and whole and part > OF_TARGET * whole for part, whole in pairs)


def _rate_setting(measured: Mapping[str, Any], rate: float, factor: float) -> str:
    """Another learning rate, of all parameters or of one that has its own."""
    value = f"{float(f'{factor * rate:.1g}'):g}"
    common = rate == measured.get("learning_rate")
    return f"--set optimizer.learning_rate={value}" if common else f"its own learning_rate: {value}"


def _parameters(results: Mapping[str, Any]) -> dict[str, Any]:
    return dict((results.get("certainty") or {}).get("parameters") or {})


def _about(results: Mapping[str, Any], key: str) -> dict[str, Any]:
    return dict(_parameters(results).get(key) or {})


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
    trend, ratio = results.get("loss_trend") or {}, _image_ratio(results)
    if trend.get("change") in ("rose", "flat") and not (ratio is not None and ratio < IMPROVED):
        start, end = (with_error(trend[at]["mean"], trend[at]["error"], sign) for at in ("start", "end"))
        less = trend["end"]["mean"] < trend["start"]["mean"]
        flat = "fell by no more than its noise" if less else "did not fall"
        lines.append(
            f"the loss {'rose' if trend['change'] == 'rose' else flat} ({start} at the start, {end} at the end)"
        )
    if not trend and ratio is not None and ratio > ROSE_IF_SHORT:
        start, end = (number(results["image_loss"][at], 3) for at in ("initial", "final"))
        lines.append(f"the images got farther from their targets (loss {start} to {end})")
    worse = [key for key in results.get("worse") or () if key in results["parameter_rmse"]]
    errors = {key: results["parameter_rmse"][key] for key in worse}
    worse.sort(key=lambda key: -errors[key]["final"] / max(errors[key]["initial"], 1e-30))
    lines += [f"{shorten(key, KEY_WIDTH)} got worse (RMSE {_from_to(errors[key])})" for key in worse[:MOST_NAMED]]
    if len(worse) > MOST_NAMED:
        lines.append(f"and so did {count(len(worse) - MOST_NAMED, 'more parameter')}")
    if lines:
        lines += _reasons(results)
    return [*lines, *certainty_lines(results)]


def _reasons(results: Mapping[str, Any]) -> list[str]:
    """What may have kept a run from getting better, as far as its settings tell."""
    samples = results.get("samples") or {}
    found = [f"its steps followed derivatives without silhouettes and edges of shadows ({record.percent()} of that of "
             f"{shorten(record.parameter, KEY_WIDTH)} is missing), and a lower rate does not help"
             for record in incomplete_records(results.get("incomplete") or ())]  # fmt: skip
    step, target = samples.get("step"), samples.get("target")
    if step and target and target < FEW_STEPS * step:
        found.append(
            f"the target itself has {count(target, 'sample')} per pixel only: --set target.render.spp="
            f"{max(FEW_STEPS * step, 4 * target)} makes a cleaner one"
        )
    if (results.get("iterations") or LEAST_JUDGED) < LEAST_JUDGED:
        found.append(f"{count(results.get('iterations') or 0, 'iteration')} are few: --set run.iterations=200")
    return found


def _image_ratio(results: Mapping[str, Any]) -> float | None:
    """The loss of the saved images, which have less noise than those of the iterations, at the end over that at the
    start; None where one is not known."""
    losses = results.get("image_loss") or {}
    initial, final = losses.get("initial"), losses.get("final")
    if initial is None or final is None:
        return None
    return float(final / initial) if initial else math.inf if final else 1.0


def _from_to(pair: Mapping[str, float | None]) -> str:
    start, end = number(pair.get("initial"), 3), number(pair.get("final"), 3)
    return f"{start} to {end}" if start else end


#: Parameters that are listed; a run with more says so, and its page has them all.
MOST_LISTED = 12

#: A key in the table has at most so many characters, and at least.
WIDEST_KEY, NARROWEST_KEY = 48, 24

#: Columns where there is no terminal.
NO_TERMINAL = 200

#: What stands over the keys, and between two columns.
HEAD, GAP = "parameter", "  "

#: Columns of values: what stands above each, and its name in the results.
MOMENTS = (("start", "initial"), ("end", "final"), ("true", "true"))


def terminal_width() -> int:
    """Columns of standard output; what stands in a file or a pipe may be wider than most terminals."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else NO_TERMINAL


def parameter_lines(results: Mapping[str, Any], width: int) -> list[str]:
    """Values at start and end, true values, errors, spreads and verdicts, in lines of at most `width` characters.

    Textures are told by mean and range. A table where that fits, else a block for each parameter. `results` is what
    `Results.to_json` made.
    """
    parameters = results.get("parameters") or {}
    shown = [key for key, about in parameters.items() if about.get("initial")]
    listed = shown[:MOST_LISTED]
    if not listed:
        return []
    relative = units_differ(results)
    columns = {title: [_value(parameters[key].get(moment)) for key in listed] for title, moment in MOMENTS}
    columns["relative error" if relative else "RMSE"] = [error_words(results, key, relative) for key in listed]
    columns = {title: cells for title, cells in columns.items() if any(cells)}
    verdicts = [verdict_words(results, key) for key in listed]
    if any(verdicts):
        columns |= {"spread": [spread_words(results, key) for key in listed], "verdict": verdicts}
    titles, rows = list(columns), list(zip(*columns.values(), strict=True))
    lines = _table(listed, titles, rows, width) or _blocks(listed, titles, rows, width)
    if len(shown) > len(listed):
        lines.append(shorten(f"and {count(len(shown) - len(listed), 'more parameter')}, on the page", width))
    return [*lines, *wrap(noise_line(results), width)]


def units_differ(results: Mapping[str, Any]) -> bool:
    """Whether the errors of a run have no common unit, so that they compare as shares of the truth alone."""
    return bool(results.get("parameter_rmse")) and (results.get("rmse") or {}).get("initial") is None


def error_words(results: Mapping[str, Any], key: str, relative: bool) -> str:
    """The error of one parameter at start and end, `0.189 to 0.222`; empty where it is not known."""
    pair = (results.get("relative_error" if relative else "parameter_rmse") or {}).get(key) or {}
    if pair.get("initial") is None:
        return ""
    return _from_to(pair) + (", worse" if key in (results.get("worse") or ()) else "")


def _value(about: Mapping[str, Any] | None) -> str:
    """All numbers of a small parameter; mean and range of a large one."""
    if not about:
        return ""
    if "value" in about:
        values = about["value"] if isinstance(about["value"], list) else [about["value"]]
        return " ".join(number(value, 3) for value in values)
    if about["min"] == about["max"]:
        return number(about["min"], 3)
    mean = " ".join(number(value, 3) for value in about["mean"])
    return f"{mean} ({number(about['min'], 3)} to {number(about['max'], 3)})"


def _table(keys: Sequence[str], titles: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """One line a parameter; nothing where that does not fit."""
    widths = [max(len(title), *(len(row[column]) for row in rows)) for column, title in enumerate(titles)]
    left = width - sum(widths) - len(GAP) * len(widths)
    first = min(max(map(len, (HEAD, *keys))), WIDEST_KEY, left)
    if first < min(max(map(len, keys)), NARROWEST_KEY):
        return []
    named = [(HEAD, titles), *zip(keys, rows, strict=True)]
    return [line([shorten(key, first), *row], [first, *widths]) for key, row in named]


def _blocks(keys: Sequence[str], titles: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """A line for the key, and one for each value; long ones go on below their beginning."""
    lines, indent = [], max(map(len, titles)) + 2 * len(GAP)
    for key, row in zip(keys, rows, strict=True):
        lines.append(shorten(key, width))
        for title, cell in zip(titles, row, strict=True):
            head = f"{GAP}{title}".ljust(indent)
            lines += wrap(cell, max(width, indent + 20), initial_indent=head, subsequent_indent=" " * indent)
    return lines
