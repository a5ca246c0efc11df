"""Summary of a run in a few lines: how it ended, its parameters, their certainty, and what to do next.

The functions take the `results` of the manifest, which may lack `certainty`.
"""

from __future__ import annotations

import math
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any, NamedTuple

from reslrb_cli.optimization.problem import ErrorMeter
from reslrb_cli.records.manifest import Status
from reslrb_cli.records.measurements import INCOMPLETE, MISFIT, incomplete_records
from reslrb_cli.records.metrics import Record
from reslrb_cli.report import spread
from reslrb_cli.report.format import count, line, number, shorten, with_error
from reslrb_cli.report.spread import MOVING

#: Recorded verdicts on a value: SETTLED is reliable, and the others give the reason why a value is not.
SETTLED, UNDETERMINED = "settled", "not determined"
NOISE, UNSEEN, LOST = "below the noise", "not seen", "effect lost"

#: Minimum share of the target's noise in a spread for it to be the cause that hides a value.
OF_TARGET = 0.7

#: Steps are too short if the distance that a value has moved and must still move exceeds this share of their reach.
REACHED = 0.5

#: Bounds of a proposed number of iterations, as multiples of those of the run.
LEAST_LONGER, MOST_LONGER = 2, 5

#: Divisor of the learning rate if the loss rose, and factor for the samples of a noisy target.
LOWER, MORE_SAMPLES = 3, 16

#: The proposal for which a run continues; the others need a new run.
LONGER = "more iterations"

#: Proposals: a target with more samples, another loss, and a further parameter, which would explain a misfit.
CLEANER, UNBIASED, RECOVER = "a cleaner target", "a loss without bias", "another parameter"

#: Proposals in the order of priority: the first ones make the later ones useless.
ORDER = ("a limit", "a lower rate", "a higher rate", "a new run from here", LONGER, RECOVER, UNBIASED, CLEANER)

#: Maximum number of parameters named for one verdict.
MOST_NAMED = 3

#: Maximum width of a key beside a verdict.
PARTNER_WIDTH = 40

#: Maximum width of a key beside a progress bar.
BESIDE_A_BAR = 32


def descriptions(record: Record, meter: ErrorMeter) -> list[str]:
    """Return the loss and, if known, the parameter error of a record, as texts of decreasing length.

    If the units of the parameters differ, the error is the largest relative error.
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
    """Whether the value of a parameter was found to be reliable."""
    return bool(_about(results, key).get("verdict") == SETTLED)


class Remedy(NamedTuple):
    """Proposal in a few words, and the setting that implements the proposal. Of two equal proposals, the one with the
    larger `size` serves both.
    """

    words: str
    setting: str
    size: float = 0.0

    def command(self, manifest: Mapping[str, Any], folder: str) -> str:
        """Return the command that continues or repeats the run in `folder` with this setting. Return the setting alone
        if it belongs into the configuration file.
        """
        if not self.setting.startswith("--"):
            return self.setting
        words = {LONGER: ["--resume", folder], RECOVER: [folder]}.get(self.words, [f"{folder}/config.yaml"])
        return f"{_optimize(manifest, *words)} {self.setting}"


def _optimize(manifest: Mapping[str, Any], *words: str) -> str:
    """Return the command `reslrb optimize` with these words. It may run the code that the run of `manifest` may run."""
    allowed = ["--allow-code"] if "--allow-code" in (manifest.get("command_line") or ()) else []
    return shlex.join(["reslrb", "optimize", *words, *allowed])


def advice(results: Mapping[str, Any]) -> Remedy | None:
    """Return the most important proposal for a run, or None. All texts about the run give this proposal only, because
    two proposals may contradict each other.
    """
    found = [find_remedy(results, key) for key in verdicts_of(results)]
    found += [_cleaner_target(results), _longer(results), _recover(results)]
    remedies = [remedy for remedy in found if remedy is not None]
    return min(remedies, key=lambda each: (ORDER.index(each.words), -each.size), default=None)


def _cleaner_target(results: Mapping[str, Any]) -> Remedy | None:
    """Return the proposal for a run that did not improve and has few samples in its target."""
    samples = results.get("samples") or {}
    step, target = samples.get("step"), samples.get("target")
    if not (step and target and target < FEW_STEPS * step and _no_progress(results)):
        return None
    return _samples(max(FEW_STEPS * step, 4 * target))


def _samples(spp: int) -> Remedy:
    return Remedy(CLEANER, f"--set target.render.spp={spp}", spp)


def _longer(results: Mapping[str, Any]) -> Remedy | None:
    """Return the proposal for a run of few iterations that did not improve, although its target has enough samples, and
    for a run without verdicts whose loss was still falling.
    """
    done, late = results.get("iterations") or LEAST_JUDGED, (results.get("loss_trend") or {}).get("late")
    if done < LEAST_JUDGED and _no_progress(results) and _cleaner_target(results) is None:
        return _iterations(200)
    if late == "fell" and not verdicts_of(results) and _loss_fell(results):
        return _iterations(2 * done)
    return None


def _recover(results: Mapping[str, Any]) -> Remedy | None:
    """Return the proposal for a run whose model does not fit, if further parameters would reduce the misfit."""
    keys = spread.leading_keys(results)
    return Remedy(RECOVER, " ".join(shlex.join(["--free", key]) for key in keys)) if keys else None


def free_command(manifest: Mapping[str, Any], folder: str) -> str:
    """Return the command that starts from the values of the run in `folder`, and also recovers what would reduce its
    misfit. The result is empty if the run's proposal is another one.
    """
    best = advice(manifest.get("results") or {})
    return best.command(manifest, folder) if best is not None and best.words == RECOVER else ""


def _iterations(count: int) -> Remedy:
    return Remedy(LONGER, f"--set run.iterations={count}", count)


def verdict_words(results: Mapping[str, Any], key: str) -> str:
    """Return the verdict on the parameter `key`, with the proposal if it is the run's (`advice`). The result is empty
    if nothing was measured.

    The result includes the share of entries with this verdict and the share of entries that no view shows.
    """
    about = _about(results, key)
    verdict, shares = about.get("verdict", ""), about.get("shares") or {}
    words = str(verdict)
    if verdict == UNDETERMINED and about.get("partner"):
        words += f": {shorten(about['partner'], PARTNER_WIDTH)} makes up for it"
    if verdict == NOISE and _is_of_target(about):
        words += _source(results)
    share = shares.get(verdict)
    words = words if share is None or share == 1 else f"{words} ({100 * share:.3g} %)"
    unseen = shares.get(UNSEEN) if verdict != UNSEEN else None
    words += f", {100 * unseen:.3g} % not seen" if unseen else ""
    remedy, best = find_remedy(results, key), advice(results)
    return (
        f"{words}: {remedy.words}" if remedy is not None and best is not None and remedy.words == best.words else words
    )


def find_remedy(results: Mapping[str, Any], key: str) -> Remedy | None:
    """Return a proposal for a parameter whose value is still moving, for a value that the target's noise hides, or for
    a value that has lost its effect.

    Return None for all other values, and if the records are insufficient.
    """
    about, measured = _about(results, key), spread.certainty_of(results)
    if about.get("verdict") == LOST:
        return Remedy("a limit", "its own bounds: [LOW, HIGH]")
    if about.get("verdict") == NOISE and measured.get("is_biased") and _is_of_target(about):
        return Remedy(UNBIASED, "--set loss.type=l2")
    if about.get("verdict") == NOISE and _is_of_target(about) and measured.get("target_spp"):
        return _samples(MORE_SAMPLES * measured["target_spp"])
    if about.get("verdict") == MISFIT:
        return _recover(results)
    moved, rate, iterations = about.get("moved"), about.get("rate"), measured.get("iterations")
    if about.get("verdict") != MOVING or moved is None or not iterations:
        return None
    if (results.get("loss_trend") or {}).get("change") == "rose":
        if rate is None or incomplete_records(results.get("incomplete") or ()):
            return None
        return Remedy("a lower rate", *_rate_setting(measured, rate, 1 / LOWER))
    way = moved + max((abs(value) for value in about.get("to_go") or () if value is not None), default=0.0)
    reach = about.get("reach")
    if reach and rate and way > REACHED * reach:
        return Remedy("a higher rate", *_rate_setting(measured, rate, max(2 * way / reach, 2.0)))
    # More of the same steps would not help, or the run would end again at once.
    if (results.get("loss_trend") or {}).get("late") == "flat" or (rate is None and results.get("stopped")):
        return Remedy("a new run from here", "initial: {run: RUN} for each parameter")
    longer = min(max(way / moved if moved else MOST_LONGER, LEAST_LONGER), MOST_LONGER)
    return _iterations(int(float(f"{longer * iterations:.2g}")))


def certainty_lines(results: Mapping[str, Any]) -> list[str]:
    """Return one line for each verdict except `settled`, with the parameters that have this verdict, and the run's
    proposal (`advice`) if it is about them.
    """
    verdicts, best = verdicts_of(results), advice(results)
    lines = []
    for verdict in dict.fromkeys(verdict for verdict in verdicts.values() if verdict != SETTLED):
        keys = [key for key in verdicts if verdicts[key] == verdict]
        named = ", ".join(shorten(key, KEY_WIDTH) for key in keys[:MOST_NAMED])
        rest = f" and {count(len(keys) - MOST_NAMED, 'more parameter')}" if len(keys) > MOST_NAMED else ""
        hidden = any(verdict == NOISE and _is_of_target(_about(results, key)) for key in keys)
        of_target = _source(results) if hidden else ""
        line = f"{'not converged, ' if verdict == MOVING else ''}{verdict}{of_target}: {named}{rest}"
        shares = [record.percent() for record in incomplete_records(results.get("incomplete") or ())
                  if record.parameter in keys and verdict == INCOMPLETE]  # fmt: skip
        line += f" ({', '.join(shares)} of it is missing)" if shares else ""
        line += f" ({spread.misfit_words(results)})" if verdict == MISFIT else ""
        own = {remedy.words for key in keys if (remedy := find_remedy(results, key)) is not None}
        line += f" ({best.words}: {best.setting})" if best is not None and best.words in own else ""
        lines.append(line)
    return lines


def _source(results: Mapping[str, Any]) -> str:
    """Return the source of the noise that hides values if `_is_of_target` is true."""
    return " of the images" if spread.certainty_of(results).get("is_biased") else " of the target"


def _is_of_target(about: Mapping[str, Any]) -> bool:
    """True if the target's noise, or a bias by noise of the images, makes up more than `OF_TARGET` of any entry's
    spread.
    """
    pairs = zip(about.get("of_target") or (), about.get("spread") or (), strict=False)
    return any(part is not None and whole and part > OF_TARGET * whole for part, whole in pairs)


def _rate_setting(measured: Mapping[str, Any], rate: float, factor: float) -> tuple[str, float]:
    """Return the setting for another learning rate, and the factor. The setting changes the rate of all parameters, or
    the rate of one parameter that has its own.
    """
    value = f"{float(f'{factor * rate:.1g}'):g}"
    common = rate == measured.get("learning_rate")
    return f"--set optimizer.learning_rate={value}" if common else f"its own learning_rate: {value}", factor


def verdicts_of(results: Mapping[str, Any]) -> dict[str, str]:
    """Return the verdict on each parameter. The result is empty if nothing was measured."""
    return {key: str(about.get("verdict", SETTLED)) for key, about in spread.certainties(results).items()}


def _about(results: Mapping[str, Any], key: str) -> dict[str, Any]:
    return dict(spread.certainties(results).get(key) or {})


#: An image has improved if its loss ratio, end over start, is below this value.
IMPROVED = 0.9

#: In a run too short to know the noise of its loss, the loss of the saved images rose if it grew by more than the first
#: factor. A target is noisy if it has fewer samples than the second number of steps together.
ROSE_IF_SHORT, FEW_STEPS = 1.1, 16

#: Losses of runs with fewer iterations are not judged.
LEAST_JUDGED = 20

#: Maximum width of a key in a line of text.
KEY_WIDTH = 60


def last_line(status: str, results: Mapping[str, Any], tallies: Sequence[str], report: str) -> str:
    """Return the last line on the terminal: how the run ended, its results, warnings, and the path of its page.

    `results` are those of the manifest.
    """
    parts = [f"{status} after {count(results['iterations'], 'iteration')}"]
    parts += [] if results["loss"] is None else [f"loss {number(results['loss'])}"]
    parts += [line for line in (error_line(results), *tallies) if line]
    return "; ".join([", ".join(parts), *warnings(results), f"look at {report}"])


def error_line(results: Mapping[str, Any]) -> str | None:
    """Return the error of all parameters at start and end, or the largest relative error if the units differ.

    `results` is the result of `Results.to_json`. None if no true value is known.
    """
    total = results.get("rmse") or {}
    if total.get("final") is not None:
        return f"parameter RMSE {_from_to(total)}"
    key = worst(results)
    if key is None:
        return None
    return f"relative error {_from_to(results['relative_error'][key])} at worst ({shorten(key, KEY_WIDTH)})"


def total_error(results: Mapping[str, Any], moment: str) -> float | None:
    """Return the error of all parameters together at a `moment`, `initial` or `final`. If they have no common unit, it
    is the root mean square of their relative errors. Return None if no true value is known.
    """
    if not units_differ(results):
        return (results.get("rmse") or {}).get(moment)
    errors = [pair.get(moment) for pair in (results.get("relative_error") or {}).values()]
    known = [error for error in errors if error is not None]
    return math.sqrt(sum(error**2 for error in known) / len(known)) if known else None


def worst(results: Mapping[str, Any]) -> str | None:
    """Return the key with the largest relative error at the end, or None."""
    errors = {key: pair.get("final") for key, pair in (results.get("relative_error") or {}).items()}
    known = {key: error for key, error in errors.items() if error is not None}
    return max(known, key=lambda key: known[key]) if known else None


def warnings(results: Mapping[str, Any], sign: str = "+-") -> list[str]:
    """Return warnings about a run that did not fail: a loss that did not fall, errors that rose, unreliable values."""
    lines = _no_progress(results, sign)
    return [
        *lines, *(_reasons(results) if lines else ()), *certainty_lines(results), *(results.get("unmeasured") or ())
    ]  # fmt: skip


def _no_progress(results: Mapping[str, Any], sign: str = "+-") -> list[str]:
    """Return lines about a loss that did not fall, images that became worse, and errors that rose."""
    lines = []
    trend, ratio = results.get("loss_trend") or {}, image_ratio(results)
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
    return lines


def _reasons(results: Mapping[str, Any]) -> list[str]:
    """Return possible reasons why a run did not improve, as far as its records show."""
    found = [f"the steps followed an incomplete derivative ({record.percent()} of the derivative of "
             f"{shorten(record.parameter, KEY_WIDTH)} is missing), and a lower rate does not help"
             for record in incomplete_records(results.get("incomplete") or ())]  # fmt: skip
    best = advice(results)
    if _cleaner_target(results) is not None:
        line = f"the target itself has {count(results['samples']['target'], 'sample')} per pixel only"
        found.append(line + (f": {best.setting} makes a cleaner one" if best and best.words == CLEANER else ""))
    if (results.get("iterations") or LEAST_JUDGED) < LEAST_JUDGED:
        line = f"{count(results.get('iterations') or 0, 'iteration')} are few"
        found.append(line + (f": {best.setting}" if best and best.words == LONGER else ""))
    return found


def image_ratio(results: Mapping[str, Any]) -> float | None:
    """Return the loss of the final saved images divided by the loss of the initial saved images. Return None if either
    loss is unknown.

    Saved images have less noise than the images of the iterations.
    """
    losses = results.get("image_loss") or {}
    initial, final = losses.get("initial"), losses.get("final")
    if initial is None or final is None or min(initial, final) < 0:  # your own losses may be negative
        return None
    return float(final / initial) if initial else math.inf if final else 1.0


def _from_to(pair: Mapping[str, float | None]) -> str:
    start, end = number(pair.get("initial"), 3), number(pair.get("final"), 3)
    return f"{start} to {end}" if start else end


#: Maximum number of listed parameters. The page of a run lists all of them.
MOST_LISTED = 12

#: Maximum and minimum width of a key in the table.
WIDEST_KEY, NARROWEST_KEY = 48, 24

#: Width if there is no terminal.
NO_TERMINAL = 200

#: Title of the column of keys, and gap between two columns.
HEAD, GAP = "parameter", "  "

#: Columns of values: title and name in the results.
MOMENTS = (("start", "initial"), ("end", "final"), ("true", "true"))


def terminal_width() -> int:
    """Return the width of standard output. Files and pipes may be wider than most terminals."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else NO_TERMINAL


def parameter_lines(results: Mapping[str, Any], width: int) -> list[str]:
    """Return the values at start and end, true values, errors, spreads and verdicts, in lines of at most `width`.

    Textures are shown as mean and range. If a table fits, the lines form a table, otherwise one block per parameter.
    `results` is the result of `Results.to_json`.
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
        columns |= {"spread": [spread.spread_words(results, key) for key in listed], "verdict": verdicts}
    titles, rows = list(columns), list(zip(*columns.values(), strict=True))
    lines = _table(listed, titles, rows, width) or _blocks(listed, titles, rows, width)
    if len(shown) > len(listed):
        lines.append(shorten(f"and {count(len(shown) - len(listed), 'more parameter')}, on the page", width))
    return [*lines, *wrap(spread.noise_line(results), width), *spread.misfit_lines(results)]


def units_differ(results: Mapping[str, Any]) -> bool:
    """Whether the errors of a run have no common unit, so that only relative errors can be compared."""
    return bool(results.get("parameter_rmse")) and (results.get("rmse") or {}).get("initial") is None


def error_words(results: Mapping[str, Any], key: str, relative: bool) -> str:
    """Return the error of one parameter at start and end, for example `0.189 to 0.222`. The result is empty if
    unknown.
    """
    pair = (results.get("relative_error" if relative else "parameter_rmse") or {}).get(key) or {}
    if pair.get("initial") is None:
        return ""
    return _from_to(pair) + (", worse" if key in (results.get("worse") or ()) else "")


def _value(about: Mapping[str, Any] | None) -> str:
    """Return all numbers of a small parameter, or the mean and range of a large one."""
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
    """Return one line per parameter, or an empty list if the lines do not fit."""
    widths = [max(len(title), *(len(row[column]) for row in rows)) for column, title in enumerate(titles)]
    left = width - sum(widths) - len(GAP) * len(widths)
    first = min(max(map(len, (HEAD, *keys))), WIDEST_KEY, left)
    if first < min(max(map(len, keys)), NARROWEST_KEY):
        return []
    named = [(HEAD, titles), *zip(keys, rows, strict=True)]
    return [line([shorten(key, first), *row], [first, *widths]) for key, row in named]


def _blocks(keys: Sequence[str], titles: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Return one line per key and one per value. Long values are wrapped with indentation."""
    lines, indent = [], max(map(len, titles)) + 2 * len(GAP)
    for key, row in zip(keys, rows, strict=True):
        lines.append(shorten(key, width))
        for title, cell in zip(titles, row, strict=True):
            head = f"{GAP}{title}".ljust(indent)
            lines += wrap(cell, max(width, indent + 20), initial_indent=head, subsequent_indent=" " * indent)
    return lines


# --- the outcome in one sentence, and what to do next -----------------------------------------------------------------


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
    done, status = results.get("iterations") or 0, manifest.get("status")
    if status == Status.RUNNING:
        return Outcome("open", "The run is in progress.")
    if status in (Status.FAILED, Status.INTERRUPTED):
        grade, what = ("failed", "failed") if status == Status.FAILED else ("open", "was interrupted")
        sentence = f"The run {what} after {count(done, 'iteration')}."
        if not done:
            return Outcome(grade, sentence)
        proposal = "Continue it" + (", after you have corrected the error:" if grade == "failed" else ":")
        return Outcome(grade, sentence, proposal, _optimize(manifest, "--resume", folder))
    if _loss_fell(results) is None:
        few = ", too few to judge its result" if done < LEAST_JUDGED else ""
        return Outcome("open", f"The run finished after {count(done, 'iteration')}{few}.")
    better, sentence = _improvement(results)
    verdicts = verdicts_of(results)
    open_keys = [key for key, verdict in verdicts.items() if verdict != SETTLED]
    if better and verdicts and not open_keys and not results.get("worse"):
        all_of = "its parameter is" if len(verdicts) == 1 else f"all {len(verdicts)} parameters are"
        export = shlex.join(["reslrb", "export", folder, "-o", "recovered"])
        return Outcome("good", f"{sentence}, and {all_of} settled.", "Write the recovered scene:", export)
    remedy = advice(results)
    rest = (f"Try {remedy.words}:", remedy.command(manifest, folder)) if remedy is not None else ("", "")
    if rest[1] and not rest[1].startswith("reslrb "):
        rest = (f"{rest[0][:-1]}, with this in the configuration:", rest[1])
    if better and results.get("is_design"):  # no true values, so no certainty is missing
        export = shlex.join(["reslrb", "export", folder, "-o", "solid"])
        return Outcome("good", f"{sentence}.", *(rest if rest[1] else ("Write the solid:", export)))
    sentence += _settled(verdicts, open_keys, better)
    if results.get("worse") and not open_keys:
        sentence += f". {shorten(results['worse'][0], KEY_WIDTH)} is farther from its true value than at the start"
    return Outcome("open", f"{sentence}.", *rest)


def _settled(verdicts: Mapping[str, str], open_keys: Sequence[str], better: bool) -> str:
    """Return the end of a sentence: how many parameters settled, and the first one that did not."""
    settled = len(verdicts) - len(open_keys)
    if not verdicts:
        return ". The certainty of the values was not measured" if better else ""
    if not better and not settled:
        return ""
    words = f", {'and' if better else 'though'} {settled} of {count(len(verdicts), 'parameter')} settled"
    if open_keys:
        words += f". {shorten(open_keys[0], KEY_WIDTH)}: {verdicts[open_keys[0]]}"
    if len(open_keys) > 1:
        words += f". The table shows {count(len(open_keys) - 1, 'more parameter')} that did not settle"
    return words


def _improvement(results: Mapping[str, Any]) -> tuple[bool, str]:
    """Return whether the values are better than at the start, as far as loss and known errors show, and a sentence
    about it without its full stop.
    """
    trend, fell = results.get("loss_trend") or {}, bool(_loss_fell(results))
    start, end = (total_error(results, moment) for moment in ("initial", "final"))
    loss = "The loss fell" if fell else "The loss rose" if trend.get("change") == "rose" else "The loss did not fall"
    error = (
        ""
        if start is None or end is None
        else "fell"
        if end < IMPROVED * start
        else "rose"
        if end > start
        else "hardly fell"
    )
    if fell and error in ("", "fell"):
        losses = {} if verdicts_of(results) else results.get("image_loss") or {}
        loss += f" from {number(losses['initial'], 3)} to {number(losses['final'], 3)}" if len(losses) == 2 else ""
        late = not verdicts_of(results) and trend.get("late") == "fell"
        return True, loss + ", and was still falling at the end" * late
    if not error:
        return False, f"{loss}, so nothing shows that the values are better than at the start"
    joined = "and" if fell == (error == "fell") else "but"
    words = f"{loss}, {joined} the error of the parameters {error} ({number(start, 3)} to {number(end, 3)})"
    return error == "fell", words


def _loss_fell(results: Mapping[str, Any]) -> bool | None:
    """Whether the loss fell, according to its trend or the saved images. None if neither is known."""
    change, ratio = (results.get("loss_trend") or {}).get("change"), image_ratio(results)
    if change is None and ratio is None:
        return None
    return change == "fell" or (ratio is not None and ratio < IMPROVED)
