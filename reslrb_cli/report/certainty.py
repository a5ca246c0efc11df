"""How certain the values of a run are, in words; `results` is the manifest's, whose `certainty` may be missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reslrb_cli.records.decisions import PaidRecord, RivalRecord
from reslrb_cli.report.format import count, duration, number, shorten

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
ORDER = ("a lower rate", "scale: auto", "a higher rate", "more iterations", "more samples for it")


#: Quantities of what emits, which may be of any size.
EMITTED = ("radiance", "irradiance", "intensity")


#: Parameters with one verdict that are named.
MOST_NAMED = 3


#: A key in a line of text has at most so many characters, and beside a verdict.
KEY_WIDTH, PARTNER_WIDTH = 60, 40


def is_settled(results: Mapping[str, Any], key: str) -> bool:
    """Whether the value of a parameter can be relied on, as far as was measured."""
    return bool(_about(results, key).get("verdict") == SETTLED)


@dataclass(frozen=True)
class Remedy:
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
        return Remedy("a lower rate", _rate_setting(measured, rate, 1 / LOWER))
    way = moved + max((abs(value) for value in about.get("to_go") or () if value is not None), default=0.0)
    reach = about.get("reach")
    if reach and way > REACHED * reach:
        emits = (results.get("parameters") or {}).get(key, {}).get("quantity")
        if emits in EMITTED and measured.get("scale") == "none":
            return Remedy("scale: auto", "--set optimizer.scale=auto")
        return Remedy("a higher rate", _rate_setting(measured, rate, max(2 * way / reach, 2.0)))
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
    found: dict[str, list[str]] = {}
    for key, about in _parameters(results).items():
        verdict = about.get("verdict", SETTLED)
        if verdict != SETTLED:
            found.setdefault(verdict, []).append(key)
    lines = []
    for verdict, keys in found.items():
        named = ", ".join(shorten(key, KEY_WIDTH) for key in keys[:MOST_NAMED])
        rest = f" and {count(len(keys) - MOST_NAMED, 'more parameter')}" if len(keys) > MOST_NAMED else ""
        remedies = [remedy for key in keys if (remedy := find_remedy(results, key)) is not None]
        of_target = " of the target" if verdict == NOISE and remedies else ""
        line = f"{'not converged, ' if verdict == MOVING else ''}{verdict}{of_target}: {named}{rest}"
        if remedies:  # that of the steps first, if there is one: more of the wrong ones do not help
            remedy = min(remedies, key=lambda each: ORDER.index(each.words))
            line += f" ({remedy.words}: {remedy.setting})"
        lines.append(line)
    return lines


def certainty_words(results: Mapping[str, Any]) -> str:
    """What spreads and verdicts rest on; empty where there are none."""
    measured = results.get("certainty")
    if not measured:
        return ""
    parts = [count(measured["gradients"], "gradient")]
    parts += [count(measured["changes"], "pair") + " of images"] if measured["changes"] else []
    parts += [count(measured["probes"], "random probe")] if measured["probes"] else []
    noise = {
        "measured": ", and the noise of the rendered target",
        "in part": ", and the noise of the targets that were rendered, not that of the others",
        "left out": "; noise of the target is not in it",
    }.get(measured.get("target_noise", ""), "")
    cost = f"{duration(measured['measure_s'])}, {100 * measured['share']:.2g} % of the iterations' time"
    return (
        "Spread is one standard deviation of a final value about the optimum, by the noise of gradients and the "
        f"curvature of the loss, where it ended (of a texture that of a typical entry that is seen, the others known)"
        f"{noise}; from {', '.join(parts)}, in {cost}."
    )


def noise_line(results: Mapping[str, Any]) -> str:
    """What a reader of spreads has to know of a target whose noise they do not have; empty where they have it."""
    measured = results.get("certainty") or {}
    if measured.get("target_noise") not in ("left out", "in part"):
        return ""
    which = "" if measured["target_noise"] == "left out" else " that are files"
    return f"spread: by the noise of the run; noise and errors of targets{which} are not in it"


def rival_line(measured: Mapping[str, Any] | None) -> str:
    """How another integrator did beside the run's own; empty where none was tried."""
    try:
        return RivalRecord.from_json(dict(measured or {})).line()
    except TypeError:  # there was none, or another version's
        return ""


def paid_line(kind: type[PaidRecord], measured: Mapping[str, Any] | None) -> str:
    """Whether another way of drawing samples paid; empty where that was not left to measurement."""
    try:
        return kind.from_json(dict(measured or {})).line()
    except TypeError:  # as above
        return ""


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
